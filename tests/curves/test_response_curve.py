"""Response curves against harmonic balance, closed forms of friction and impact, Mathieu's functions and shooting by SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve
from scipy.special import ellipk, mathieu_a, mathieu_b

import jaxlag as jl

once = jl.Every(lambda w: 2 * jnp.pi / w)
duffing = jl.System(
    lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * q**2 - 0.25 * c * q**4,
    dissipation=lambda qdot, d: 0.5 * d * qdot**2,
    force=lambda t, w: 0.3 * jnp.cos(w * t),
)
PARAMS = {"c": 1.0, "d": 0.1, "w": 0.5}


@pytest.fixture(scope="module")
def orbit():
    return jl.periodic(duffing, 0.4, 0.0, PARAMS, section=once)


@pytest.fixture(scope="module")
def curve(orbit):
    return jl.response_curve(orbit, over="w", values=(0.3, 2.5))


ODD = 15
N = np.arange(1, 2 * ODD, 2)
TAU = 2 * np.pi * np.arange(8 * ODD) / (8 * ODD)
WAVES = np.concatenate([np.cos(np.outer(TAU, N)), np.sin(np.outer(TAU, N))], 1)
TURNED = np.concatenate([-N * np.sin(np.outer(TAU, N)), N * np.cos(np.outer(TAU, N))], 1)  # their derivatives


def balance(x, w, c=1.0, d=0.1):
    """The residual of harmonic balance of Duffing's oscillator and its slope: x holds the cosines and sines of its odd harmonics."""
    q, squares = WAVES @ x, np.tile(N**2, 2)
    left = -(w**2) * WAVES @ (squares * x) + d * w * TURNED @ x + q + c * q**3 - 0.3 * np.cos(TAU)
    slope = -(w**2) * WAVES * squares + d * w * TURNED + (1 + 3 * c * q**2)[:, None] * WAVES
    return WAVES.T @ left / (4 * ODD), WAVES.T @ slope / (4 * ODD)


def fold_by_balance(w, x):
    """(x, ω) at which the slope is singular: Newton's method for R = 0 and ψ R' φ = 0, with its singular vectors."""
    for _ in range(30):
        R, J = balance(x, w)
        x = x - np.linalg.solve(J, R)
    for _ in range(30):
        R, J = balance(x, w)
        u, _, v = np.linalg.svd(J)
        bend = lambda dx, dw: u[:, -1] @ (balance(x + dx, w + dw)[1] - balance(x - dx, w - dw)[1]) @ v[-1] / 2e-4  # noqa: B023
        whole = np.zeros((2 * ODD + 1, 2 * ODD + 1))
        whole[:-1, :-1], whole[:-1, -1] = J, (balance(x, w + 1e-6)[0] - balance(x, w - 1e-6)[0]) / 2e-6
        whole[-1] = [*(bend(1e-4 * e, 0) for e in np.eye(2 * ODD)), bend(0 * x, 1e-4)]
        step = np.linalg.solve(whole, np.append(R, u[:, -1] @ J @ v[-1]))
        x, w = x - step[:-1], w - step[-1]
    assert np.max(np.abs(step)) < 1e-12
    return w, x


def test_folds_of_duffing(curve):
    """Both folds against harmonic balance with 21 odd harmonics, from the states that the curve has there."""
    assert [point.kind for point in curve.special] == ["fold", "fold"]
    assert curve.ends == ("an end of `values` is reached",) * 2
    for point, inward in zip(curve.special, (-1e-3, 1e-3), strict=True):
        near = curve.at(float(point.value) + inward)[0 if inward < 0 else 1]
        motion = near.motion(513)
        turns = np.exp(-1j * np.outer(N, np.asarray(motion.ts[:-1])) * float(near.params["w"]))
        c = 2 * turns @ np.asarray(motion.q[:-1]) / 512
        expected, x = fold_by_balance(float(near.params["w"]), np.concatenate([c.real, -c.imag]))
        np.testing.assert_allclose(point.value, expected, rtol=1e-9)
        grid = np.linspace(0, 2 * np.pi, 40_001)
        q = np.concatenate([np.cos(np.outer(grid, N)), np.sin(np.outer(grid, N))], 1) @ x
        np.testing.assert_allclose(point.amplitude["q"], (q.max() - q.min()) / 2, rtol=1e-7)


def test_points_of_the_curve_are_motions(curve):
    """Harmonics, highest values and multipliers at some points, against SciPy's motions of one period and their variations."""
    for i in (0, 60, 120, len(curve) - 1):
        w, start = float(curve.values[i]), [float(curve.q[i]), float(curve.qdot[i])]
        T = 2 * np.pi / w
        rates = lambda t, y, w=w: [
            y[1], 0.3 * np.cos(w * t) - 0.1 * y[1] - y[0] - y[0] ** 3,
            y[3], -0.1 * y[3] - (1 + 3 * y[0] ** 2) * y[2], y[5], -0.1 * y[5] - (1 + 3 * y[0] ** 2) * y[4],
        ]  # fmt: skip
        ts = np.linspace(0, T, 4097)
        found = solve_ivp(rates, (0, T), [*start, 1, 0, 0, 1], "DOP853", rtol=1e-12, atol=1e-13, t_eval=ts)
        q = found.y[0]
        np.testing.assert_allclose(found.y[:2, -1], start, atol=1e-8)
        np.testing.assert_allclose(curve.measured["q"].highest[i], q.max(), rtol=1e-6)
        expected = [np.mean(q[:-1]), *(2 * np.mean(q[:-1] * np.exp(-1j * n * w * ts[:-1])) for n in range(1, 9))]
        np.testing.assert_allclose(curve.measured["q"].harmonics[i], expected, atol=1e-8)
        variation = found.y[2:, -1].reshape(2, 2).T
        np.testing.assert_allclose(np.sort_complex(curve.multipliers[i]), np.sort_complex(np.linalg.eigvals(variation)), rtol=1e-6)


def test_motions_at_a_value(curve):
    """Three of them between the folds, in the order of the curve; the middle one is not stable."""
    found = curve.at(1.6)
    assert [bool(one.is_stable) for one in found] == [True, False, True]
    for one in found:
        np.testing.assert_allclose(one.motion(3).q[-1], one.q, atol=1e-8)
        assert float(one.params["w"]) == 1.6
    assert len(curve.at(0.5)) == 1 and curve.at(3.0) == ()
    i = 100
    at = curve.orbit(i)
    np.testing.assert_allclose([at.q, at.period], [curve.q[i], 2 * np.pi / curve.values[i]])
    with pytest.raises(IndexError, match="`orbit"):
        curve.orbit(len(curve))


@pytest.mark.slow
def test_derivatives_of_folds(orbit):
    """By damping and stiffness, forward and reverse, of places and amplitudes, against differences; and of a motion at one value."""

    def folds(d, c):
        found = jl.response_curve(orbit, {"c": c, "d": d, "w": 0.5}, over="w", values=(0.3, 2.5)).special
        return jnp.stack([x for point in found for x in (point.value, point.amplitude["q"])])

    h = 1e-4
    by_d = (folds(0.1 + h, 1.0) - folds(0.1 - h, 1.0)) / (2 * h)
    by_c = (folds(0.1, 1.0 + h) - folds(0.1, 1.0 - h)) / (2 * h)
    np.testing.assert_allclose(jax.jacfwd(folds)(0.1, 1.0), by_d, rtol=1e-4, atol=1e-5)
    reverse = jax.jacrev(folds, argnums=(0, 1))(0.1, 1.0)
    np.testing.assert_allclose(reverse[0], by_d, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(reverse[1], by_c, rtol=1e-4, atol=1e-5)
    at = lambda d: jl.response_curve(orbit, {"c": 1.0, "d": d, "w": 0.5}, over="w", values=(0.3, 2.5)).at(1.6)[0].q
    np.testing.assert_allclose(jax.grad(at)(0.1), (at(0.1 + h) - at(0.1 - h)) / (2 * h), rtol=1e-5)


def test_in_other_units():
    """Micrometres, kiloseconds, tonnes: the same curve, in numbers of other sizes."""
    length, time, mass = 1e6, 1e-3, 1e-3
    force = mass * length / time**2
    system = jl.System(
        lambda q, qdot, m, k, c: 0.5 * m * qdot**2 - 0.5 * k * q**2 - 0.25 * c * q**4,
        dissipation=lambda qdot, d: 0.5 * d * qdot**2,
        force=lambda t, w, F: F * jnp.cos(w * t),
    )
    found = []
    for l, t, m in ((1, 1, 1), (length, time, mass)):
        f = m * l / t**2
        params = {"m": 1.0 * m, "k": f / l, "c": f / l**3, "d": 0.1 * f * t / l, "F": 0.3 * f, "w": 0.5 / t}
        start = jl.periodic(system, 0.4 * l, 0.0, params, section=once)
        curve = jl.response_curve(start, over="w", values=(0.3 / t, 2.5 / t))
        found.append([float(x) for point in curve.special for x in (point.value * t, point.amplitude["q"] / l)])
    assert force > 0 and len(found[0]) == 4
    np.testing.assert_allclose(found[1], found[0], rtol=1e-8)


dry = jl.System(
    lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2,
    dissipation=lambda qdot, F: F * jnp.abs(qdot),
    force=lambda t, w: jnp.cos(w * t),
)


def hartog(w, F):
    """The amplitude of motion without stops: x = X at t with cos phase, from Den Hartog's closed form.

    Source: Den Hartog, Transactions ASME 53 (1931) APM-107; x² = V² − (F U)², V = 1/(1 − ω²), U = sin(π/ω)/(ω (1 + cos(π/ω))).
    """
    V, U = 1 / (1 - w**2), np.sin(np.pi / w) / (w * (1 + np.cos(np.pi / w)))
    return np.sqrt(V**2 - (F * U) ** 2)


def test_den_hartog():
    """The published digit: F = 0.3 of the drive, ω = 1.3: X = 1.315348196714902; and along the curve."""
    start = jl.periodic(dry, -1.2, 0.65, {"w": 1.3, "F": 0.3}, section=once)
    curve = jl.response_curve(start, over="w", values=(1.1, 1.9))
    np.testing.assert_allclose(hartog(1.3, 0.3), 1.315348196714902, rtol=1e-14)
    np.testing.assert_allclose(curve.amplitude["q"], hartog(np.asarray(curve.values), 0.3), rtol=1e-7)
    assert bool(jnp.all(curve.is_stable)) and curve.special == ()
