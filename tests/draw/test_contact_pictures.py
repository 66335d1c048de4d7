"""Pictures of contacts and events, against the closed form of a bouncing ball."""

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest

import jaxlag as jl
from jaxlag import plot

matplotlib.use("Agg")
from matplotlib import pyplot as plt

G, E = 9.81, 0.5
FIRST, SPEED = np.sqrt(2 / G), np.sqrt(2 * G)
ball = jl.System(
    lambda q, qdot: 0.5 * qdot**2 - G * q,
    unilateral={"floor": jl.Contact(lambda q: q, E)},
    events={"apex": jl.Event(lambda qdot: qdot, direction=jl.direction.Falling())},
)


@pytest.fixture(scope="module")
def bouncing():
    return jl.simulate(ball, 1.0, 0.0, jnp.linspace(0, 2, 201))


@pytest.fixture(autouse=True)
def closed_figures():
    yield
    plt.close("all")


@pytest.mark.slow
def test_forces_have_stems_at_impacts_and_bands_where_contacts_are_closed(bouncing):
    """Impacts at t₁(1 + 2e + 2e² + …) with impulses (1 + e) eᵏ v; closed from t₁(1 + e)/(1 − e)."""
    (ax,) = plot.forces(bouncing, units={"t": "s", "floor": "N"})
    (right,) = set(ax.figure.axes) - {ax}
    times, impulses = right.lines[0].get_data()
    k = np.arange(5)
    np.testing.assert_allclose(times[:5], FIRST * (1 + 2 * np.cumsum(np.append(0, E ** k[1:]))), rtol=1e-9)
    np.testing.assert_allclose(impulses[:5], (1 + E) * SPEED * E**k, rtol=1e-9)
    (band,) = ax.patches
    np.testing.assert_allclose(band.get_x(), FIRST * (1 + E) / (1 - E), atol=0.01)
    np.testing.assert_allclose(band.get_x() + band.get_width(), 2.0)
    assert right.get_ylabel() == "Λ floor (N s)" and {text.get_text() for text in ax.get_legend().texts} == {"closed", "impulse"}
    (low, high), (below, above) = ax.get_ylim(), right.get_ylim()
    np.testing.assert_allclose(low / high, below / above)  # zero is at one height


@pytest.mark.slow
def test_motions_have_lines_at_events(bouncing):
    (ax,) = plot.motion(bouncing)
    lines = [line.get_xdata()[0] for line in ax.lines if line.get_linestyle() == ":"]
    np.testing.assert_allclose(lines[:2], FIRST * (1 + np.array([E, 2 * E + E**2])), rtol=1e-9)
    assert "apex" in [text.get_text() for text in ax.get_legend().texts]


@pytest.mark.slow
def test_a_bouncing_ball_is_animated(bouncing):
    moving = jl.plot.animate(bouncing, {"ball": lambda q: (0.0, q)}, fps=10)
    moving.draw(7)
    flown = 0.7 - FIRST
    np.testing.assert_allclose(moving.ax.lines[-1].get_xydata(), [[0, E * SPEED * flown - G * flown**2 / 2]], atol=1e-6)
