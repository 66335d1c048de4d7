"""Forces that jump or bend across a surface: exact, with an event there too; named by `examine` and `fit` where steps do not end there."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._program.choices import choices

FREE = lambda qdot: 0.5 * qdot**2
MUD = lambda q, qdot, a, b: 0.5 * jnp.where(q > a, b, 0.0) * qdot**2  # thick behind a
HIDDEN = lambda q, qdot, a, b: 0.5 * jnp.stack([b, 0.0])[jnp.argmax(jnp.stack([q, a]))] * qdot**2  # the same
STOP = lambda q, a, c: -0.5 * c * jnp.maximum(q - a, 0.0) ** 2
EDGES = {
    "none": None,
    "plain": jl.Event(lambda q, a: q - a),
    "rising": jl.Event(lambda q, a: 1e3 * (q - a), direction=jl.direction.Rising()),
    "curved": jl.Event(lambda q, a: (a - q) * (3 * a**2 + q**2)),
}


def line_of(function):
    return inspect.getsourcelines(function)[1]


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("edge", EDGES)
def test_mud_behind_an_edge(edge, derivative):
    """From q = 0 at speed 1, q(T) = a + (1 − e^{−b (T−a)})/b; the derivative by a was 0, and with an event not right either."""
    system = jl.System(FREE, dissipation=MUD, events=EDGES[edge] and {"edge": EDGES[edge]})

    @jax.jit
    def last(x, unit):
        a, b, T = x
        return jl.simulate(system, 0 * unit, unit, jnp.stack([0.0, T]), {"a": a * unit, "b": b}).q[-1] / unit

    a, b, T = x = jnp.array([0.5, 1.3, 2.0])
    decay = np.exp(-b * (T - a))
    for unit in (1.0, 1e-9, 1e6):
        np.testing.assert_allclose(last(x, unit), a + (1 - decay) / b, rtol=1e-7)
        exact = [1 - decay, -(1 - decay) / b**2 + (T - a) * decay / b, decay]
        np.testing.assert_allclose(derivative(last)(x, unit), exact, rtol=2e-5 if edge == "curved" else 1e-7)


@pytest.mark.slow
def test_a_spring_that_one_runs_into():
    """A half period of contact, and back: q(T) = a − (T − a − π/ω)."""
    system = jl.System(lambda q, qdot, a, c: FREE(qdot) + STOP(q, a, c), events={"edge": EDGES["plain"]})
    last = lambda a, c: jl.simulate(system, 0.0, 1.0, np.array([0.0, 10.0]), {"a": a, "c": c}).q[-1]
    np.testing.assert_allclose(last(0.5, 4.0), 0.5 - (9.5 - np.pi / 2), rtol=1e-7)
    np.testing.assert_allclose(jax.grad(last, (0, 1))(0.5, 4.0), [2.0, -np.pi / 16], rtol=1e-6)


@pytest.mark.parametrize(
    "edge",
    [
        None,
        jl.Event(lambda q, a: q["x"] - a),
        jl.Event(lambda q, a: q["x"] - a, lambda q: {"q": q}),
        jl.Event(lambda q, a: q["x"] - a, lambda q: {"q": q}, direction=jl.direction.Falling()),
    ],
    ids=["none", "plain", "then", "passed the other way"],
)
def test_what_sticks_breaks_away_where_its_load_jumps(edge):
    """A load f on a block with friction F begins where a body, at speed 1, passes a: y(T) = (f − F)(T − a)²/2. dy/da was 0: friction
    alone was seen to end there, at a time of its own.
    """
    system = jl.System(
        lambda qdot: 0.5 * (qdot["x"] ** 2 + qdot["y"] ** 2),
        dissipation=lambda qdot, F: F * jnp.abs(qdot["y"]),
        force=lambda q, a, f: {"y": jnp.where(q["x"] > a, f, 0.0)},
        events=edge and {"edge": edge},
    )

    def last(x, length, time):
        a, f, F, T = x
        params = {"a": a * length, "f": f * length / time**2, "F": F * length / time**2}
        start = {"x": 0 * length, "y": 0 * length}, {"x": length / time, "y": 0 * length}
        return jl.simulate(system, *start, jnp.stack([0 * time, T * time]), params).q["y"][-1] / length

    a, f, F, T = x = jnp.array([0.7, 1.5, 0.4, 2.0])
    exact = [-(f - F) * (T - a), (T - a) ** 2 / 2, -((T - a) ** 2) / 2, (f - F) * (T - a)]
    derivative = jax.jit(jax.value_and_grad(last))
    for units in ((1.0, 1.0), (1e-9, 1e-6), (1e-9, 1e9)):
        value, slope = derivative(x, *units)
        np.testing.assert_allclose(value, (f - F) * (T - a) ** 2 / 2, rtol=1e-7)
        np.testing.assert_allclose(slope, exact, rtol=1e-6)


@pytest.mark.slow
def test_the_user_is_told_where():
    """Each function and its line, the table too; neither dry friction nor guards nor what is smooth."""
    table = lambda q: {"x": -jnp.interp(q["x"], jnp.arange(4.0), jnp.arange(4.0) ** 2) / jnp.where(q["x"] == 0, 1.0, q["x"])}
    hidden = lambda q, qdot, a, b: HIDDEN(q["x"], qdot["x"], a, b)
    system = jl.System(
        {"free": lambda qdot: 0.5 * qdot["x"] ** 2, "stop": lambda q, a, c: STOP(q["x"], a, c), "well": lambda q: -jnp.hypot(q["x"], 1.0)},
        dissipation={
            "mud": lambda q, qdot, a, b: MUD(q["x"], qdot["x"], a, b),
            "rubbing": lambda qdot: 0.1 * jnp.abs(qdot["x"]),
            "hidden": hidden,
        },
        force=table,
    )
    found = jl.examine(system, {"x": 0.3}, {"x": 1.0}, {"a": 0.5, "b": 1.0, "c": 4.0})
    for function, what, line in (("'stop'", "maximum", STOP), ("'mud'", "where", MUD), ("`force`", "interp", table)):
        (surface,) = {surface for surface in found.surfaces if function in surface.function}
        assert f"test_surfaces.py:{line_of(line)}:" in surface.line and surface.located and what in surface.what
        assert f"{surface.what}` of {surface.function}, {surface.line}" in str(found)
    (finding,) = found.findings
    assert "'hidden' chooses" in finding and f"test_surfaces.py:{line_of(HIDDEN)}:" in finding and "jl.Event" in finding
    assert not any(name in surface.function for surface in found.surfaces for name in ("well", "rubbing", "free"))


@pytest.mark.slow
def test_a_fit_does_not_deny_an_influence():
    """Where steps do not end, the derivative by a is 0; a parameter that stands nowhere has none indeed."""
    system, ts = jl.System(FREE, dissipation=HIDDEN), np.linspace(0, 2, 41)
    exact = np.where(ts < 0.5, ts, 0.5 + 1 - np.exp(-np.maximum(ts - 0.5, 0)))
    record = jl.Experiment(ts, exact + 1e-3 * np.random.default_rng(0).normal(size=ts.size), 0.0, 1.0, sigma=1e-3)
    shown = str(jl.fit(system, record, {"a": 0.52, "b": 1.1, "idle": 1.0}, free=("a", "b", "idle")))
    assert "a decides where" in shown and f"test_surfaces.py:{line_of(HIDDEN)}:" in shown
    assert "a has no influence" not in shown and "idle has no influence" in shown
    found = jl.fit(jl.System(FREE, dissipation=MUD), record, {"a": 0.52, "b": 1.1}, free=("a", "b"))
    assert found.converged and abs(found.estimates["a"] - 0.5) < 4 * found.standard_errors["a"] < 0.01


def test_choices_of_programs():
    """Within scans, branches and calls; not behind `stop_gradient`, where a derivative does not see them."""
    of = lambda function: [(what, set(by)) for what, _, by in choices(function, (jnp.ones(3), "q"), (jnp.ones(3), "v"), (1.0, "a"))]
    assert of(lambda q, v, a: jax.lax.fori_loop(0, 3, lambda i, s: s + jnp.clip(q[0] + s, 0, a), 0.0)) == [("clip", {"q", "a"})]
    assert of(lambda q, v, a: jax.lax.cond(q[0] > v[0], jnp.sin, jnp.cos, a)) == [("cond", {"q", "v"})]
    assert of(lambda q, v, a: jax.nn.relu(q[0] - a)) == [("relu", {"q", "a"})]
    assert ("a conversion to integers", {"v"}) in of(lambda q, v, a: q[(10 * v[0]).astype(int)])
    for smooth in (jax.nn.softplus, jax.nn.softmax, jnp.sinc, jnp.exp, lambda q: jnp.logaddexp(q, 1.0), lambda q: jnp.hypot(q, 2.0)):
        assert of(lambda q, v, a, smooth=smooth: smooth(q)) == []
