"""Pictures of linear systems: the lines that are drawn, against closed forms and SciPy."""

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from scipy import signal

import jaxlag as jl
from jaxlag import plot

matplotlib.use("Agg")
import matplotlib.pyplot as plt

oscillator = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2.0 * q**2, dissipation=lambda qdot: 0.1 * qdot**2)
OMEGA = np.geomspace(0.1, 10, 41)
L, G = 0.5, 9.81


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def response():
    """x of F in m x'' + d x' + c x = F, from SciPy."""
    return signal.freqresp(([1.0], [1.0, 0.2, 4.0]), OMEGA)[1]


def test_bode():
    upper, lower = plot.bode(jl.linearise(oscillator, 0.0, inputs=["q"]), OMEGA, units={"omega": "rad/s"})
    np.testing.assert_allclose(upper.lines[0].get_xydata(), np.stack([OMEGA, np.abs(response())], axis=1), rtol=1e-10)
    np.testing.assert_allclose(lower.lines[0].get_xydata(), np.stack([OMEGA, np.degrees(np.angle(response()))], axis=1), rtol=1e-9)
    assert (upper.get_xscale(), upper.get_yscale(), lower.get_yscale()) == ("log", "log", "linear")
    assert lower.get_xlabel() == "ω (rad/s)" and lower.get_ylabel() == "phase (°)"


def test_nyquist():
    there, mirrored, point = plot.nyquist(jl.linearise(oscillator, 0.0, inputs=["q"]), OMEGA).lines[:3]
    expected = np.stack([response().real, response().imag], axis=1)
    np.testing.assert_allclose(there.get_xydata(), expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(mirrored.get_xydata(), expected * np.array([1, -1]), rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(point.get_xydata(), [[-1, 0]])


@pytest.mark.slow
def test_root_locus():
    """A bead at the bottom of a hoop that turns: λ² = Ω² − g; a ring at Ω = √g, where it diverges."""
    bead = jl.System(lambda q, qdot, w: 0.5 * (qdot**2 + (jnp.sin(q) * w) ** 2) + G * jnp.cos(q))
    values = np.linspace(0.0, 5.0, 21)
    growth, frequency = plot.root_locus(jl.root_locus(bead, 0.0, params={"w": 0.0}, over="w", values=values), units={"w": "rad/s"})
    root = np.sqrt((values**2 - G).astype(complex))
    branches = sorted((line.get_ydata() for line in growth.lines[:2]), key=np.sum)
    np.testing.assert_allclose(branches, [-root.real, root.real], atol=1e-10)
    drawn = np.concatenate([line.get_xydata() for line in frequency.lines[:2]])
    drawn = drawn[np.isfinite(drawn[:, 1])]
    np.testing.assert_allclose(np.sort(drawn[:, 1])[::-1], root.imag[root.imag > 0], atol=1e-10)
    (ring,) = [line for line in growth.lines if line.get_marker() == "o"]
    np.testing.assert_allclose(ring.get_xydata(), [[np.sqrt(G), 0]], atol=1e-10)
    assert ring.get_label() == "divergence destabilises at 3.132" and frequency.get_xlabel() == "w (rad/s)"


def ends(q, l):
    return jnp.cumsum(l * jnp.stack([jnp.sin(q), -jnp.cos(q)], axis=1), axis=0)


def lagrangian(t, q, qdot, params, m):
    return 0.5 * m * jnp.sum(jl.rate(ends)(t, q, qdot, params) ** 2) - m * G * jnp.sum(ends(q, params["l"])[:, 1])


pendulums = jl.System(lagrangian, dissipation={"joint": lambda qdot, b: 0.5 * b * qdot[0] ** 2})
POINTS = {"upper": lambda q, l: ends(q, l)[0], "lower": lambda q, l: ends(q, l)[1]}
LINKS = [((0.0, 0.0), "upper"), ("upper", "lower")]


def modes(b=0.0):
    return jl.linearise(pendulums, jnp.zeros(2), params={"m": 1.0, "l": L, "b": b}).modes()


def test_mode_shapes():
    """Two equal pendulums: ω² = (2 ∓ √2) g/l, and the lower angle ±√2 times the upper one."""
    drawn = plot.mode_shapes(modes(), POINTS, LINKS, amplitude=0.1, units={"x": "m", "t": "s"})
    for ax, sign in zip(drawn, (1, -1), strict=True):
        shape = np.array([1.0, 1.0 + sign * np.sqrt(2)])  # displacements of the two ends
        shape *= 0.1 / np.max(np.abs(shape))
        frequency = np.sqrt((2 - sign * np.sqrt(2)) * G / L) / (2 * np.pi)
        assert ax.get_title() == f"f₀ = {frequency:.4g} Hz, ζ = 0"
        dots = [line.get_xydata()[0] for line in ax.lines if line.get_marker() == "o"]
        rest, extreme = dots[:2], dots[-2:]
        np.testing.assert_allclose(rest, [[0, -L], [0, -2 * L]], atol=1e-12)
        turned = np.sign(extreme[0][0])
        np.testing.assert_allclose(extreme, np.stack([turned * shape, [-L, -2 * L]], axis=1), atol=1e-9)


def test_a_complex_mode_runs_along_ellipses():
    """Of a mode that is damped in one joint, the two ends are not at their extremes all at once."""
    slow = modes(1.0)[0]
    moving = jl.plot.animate(slow, POINTS, links=LINKS, fps=20)
    (a, b) = np.asarray(slow.shapes).ravel()
    assert abs((a * np.conj(b)).imag) > 1e-3 * abs(a * b)
    tracks = []
    for frame in range(moving.frames):
        moving.draw(frame)
        tracks.append([line.get_xdata()[-1] for line in moving.ax.lines if len(line.get_xdata()) == 1])
    tracks = np.array(tracks)[:, np.ptp(tracks, axis=0) > 0]  # of the two ends, and not of the mechanism at rest
    found = np.fft.fft(tracks, axis=0)[-1]  # x = Re(d e^{iφ})
    ratio = (a + b) / a if slow.eigenvalues.imag > 0 else np.conj((a + b) / a)
    np.testing.assert_allclose(np.conj(found[1] / found[0]), ratio, rtol=1e-6)
    assert "ζ" in moving.ax.get_title("left")


@pytest.mark.slow
def test_what_modes_are_not_drawn():
    with pytest.raises(ValueError, match="`trajectory` must be one mode"):
        jl.plot.animate(modes(), POINTS, links=LINKS)
    with pytest.raises(ValueError, match="`amplitude` must be a positive length"):
        plot.mode_shapes(modes(), POINTS, LINKS, amplitude=-1.0)
    with pytest.raises(ValueError, match="`links` must join points"):
        plot.mode_shapes(modes(), POINTS, [("upper", "nothing")])
    params = {"m": 1.0, "l": L, "b": 0.0}
    motion = jl.simulate(pendulums, jnp.array([0.1, 0.1]), jnp.zeros(2), jnp.linspace(0, 1, 3), params)
    with pytest.raises(ValueError, match="`modes` must be those near one state"):
        plot.mode_shapes(jl.linearise(pendulums, motion, params=params).modes()[0], POINTS, LINKS)
