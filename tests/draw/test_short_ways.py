"""What is computed draws itself: `motion.plot()` is `plot.motion(motion)`, and so on, with the same settings."""

import matplotlib
import numpy as np
import pytest

import jaxlag as jl
from jaxlag import plot
from jaxlag.examples import pendulum

matplotlib.use("Agg")
import matplotlib.pyplot as plt

CART = jl.System(
    lambda q, qdot, m: 0.5 * m * qdot @ qdot - 0.5 * (q[1] - q[0]) ** 2 - 0.5 * q[0] ** 2,
    dissipation=lambda qdot, b: b * qdot @ qdot,
)
PARAMS = {"m": 1.0, "b": 0.05}
MOTION = jl.simulate(CART, [0.0, 1.0], [0.0, 0.0], np.linspace(0, 4, 41), PARAMS)
POINTS = {"a": lambda q: (q[0], 0.0), "b": lambda q: (2 + q[1], 0.0)}


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def drawn(axes):
    """All that is written and drawn."""
    each = lambda ax: [ax.get_xlabel(), ax.get_ylabel(), *(str(line.get_xydata()) for line in ax.lines)]
    return [[*each(ax), *(text.get_text() for text in ax.texts)] for ax in np.ravel(axes)]


def fit():
    return jl.fit(CART, jl.Experiment(MOTION.ts, MOTION.q, [0.0, 1.0], [0.0, 0.0]), PARAMS | {"b": 0.08}, free=("b",))


near = lambda: jl.linearise(CART, [0.0, 0.0], params=PARAMS)
locus = lambda: jl.root_locus(CART, [0.0, 0.0], params=PARAMS, over="b", values=np.linspace(-0.1, 0.1, 5))
across = {"b": np.linspace(-0.1, 0.1, 3), "m": np.linspace(1.0, 2.0, 3)}


@pytest.mark.parametrize(
    ("of", "draw", "settings"),
    [
        (lambda: MOTION, plot.motion, {"units": {"t": "s", "q": "m"}}),
        (fit, plot.fit, {"units": {"t": "s"}, "level": 0.9}),
        (lambda: near().modes(), plot.mode_shapes, {"points": POINTS}),
        (locus, plot.root_locus, {}),
        (lambda: jl.stability_map(CART, [0.0, 0.0], params=PARAMS, over=across), plot.stability_map, {}),
        (lambda: jl.equations(pendulum.polar, {"r", "phi"}, {"m", "l", "g"}), plot.equations, {}),
    ],
    ids=["motion", "fit", "modes", "locus", "map", "equations"],
)
def test_a_result_draws_itself(of, draw, settings):
    found = of()
    assert drawn(found.plot(**settings)) == drawn(draw(found, **settings)) != []


def test_a_motion_and_a_mode_move():
    moving = MOTION.animate(POINTS, [("a", "b")], fps=10)
    assert moving.frames == plot.animate(MOTION, POINTS, [("a", "b")], fps=10).frames == 41
    assert near().modes()[0].animate(POINTS).frames > 2


def test_a_part_and_a_member_of_motions_draw_themselves():
    members = jl.simulate_many(CART, [0.0, 1.0], [0.0, 0.0], MOTION.ts, PARAMS | {"b": np.array([0.05, 0.1])}, over=("b",))
    (ax,) = members[0][MOTION.ts > 2].plot()
    np.testing.assert_allclose(ax.lines[1].get_ydata(), np.asarray(MOTION.q)[MOTION.ts > 2, 1], rtol=1e-7, atol=1e-7)
    with pytest.raises(ValueError, match="one motion"):
        members.plot()
