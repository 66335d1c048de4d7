"""What is said of a linear system does not depend on the units of its states, nor on what is stiff or fast beside: closed forms, NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from spectra import assert_same_spectrum

import jaxlag as jl


def in_units(q, qdot, M, K, s):
    """Coordinates x = s q."""
    return 0.5 * (s * qdot) @ M @ (s * qdot) - 0.5 * (s * q) @ K @ (s * q)


MASSES = jl.System(in_units, dissipation=lambda qdot, C, s: 0.5 * (s * qdot) @ C @ (s * qdot), force=lambda q, u, b, s: s * b * u + 0.0 * q)


# Coupled one way only


@pytest.mark.parametrize("d", [1e-3, 1e-8, 1e-14])
def test_a_free_mass_with_little_damping(d):
    cart = jl.System(lambda qdot: 0.5 * qdot**2, dissipation=lambda qdot, d: 0.5 * d * qdot**2)
    np.testing.assert_allclose(jl.linearise(cart, 0.0, params={"d": d}).eigenvalues, [0, -d], rtol=1e-12)


@pytest.mark.parametrize("gain", [1.0, 1e6, 1e12])
def test_states_that_follow_from_others(gain):
    """A filter behind a filter, beside an oscillator: the eigenvalues of each; and how much of the slow one is in the fast mode."""
    states = {"y": jl.State(lambda y, x, gain: gain * x - 1e-3 * y), "x": jl.State(lambda x: -x)}
    system = jl.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2, dissipation=lambda qdot: 0.05 * qdot**2, states=states)
    modes = jl.linearise(system, 0.0, params={"gain": gain}).modes()
    np.testing.assert_allclose(modes.eigenvalues, [-1e-3, -0.05 + 1j * np.sqrt(1 - 0.05**2), -1], rtol=1e-9)
    np.testing.assert_allclose(modes.states["y"][2] / modes.states["x"][2], -gain / 0.999, rtol=1e-9)


@pytest.mark.parametrize("unit", [1.0, 1e-9])
def test_a_skate_that_turns_ever_faster(unit):
    """By negative damping, 0.001/0.3; its place follows from where it points to, 5 m/s in metres or nanometres.

    Of ẋ = u, ẏ = 5 ψ, ψ̇ = w, u̇ = 0, ẇ = w/300 the states that stay where they are put are x and y.
    """

    def kinetic(qdot, unit):
        return (qdot["x"] * unit) ** 2 + (qdot["y"] * unit) ** 2 + 0.15 * qdot["psi"] ** 2

    skate = jl.System(
        kinetic,
        dissipation=lambda qdot: -0.5e-3 * qdot["psi"] ** 2,
        nonholonomic={"edge": lambda q, qdot: qdot["x"] * jnp.sin(q["psi"]) - qdot["y"] * jnp.cos(q["psi"])},
    )
    state = {"x": 0.0, "y": 0.0, "psi": 0.0}, {"x": 5 / unit, "y": 0.0, "psi": 0.0}
    modes = jl.linearise(skate, *state, {"unit": unit}).modes()
    np.testing.assert_allclose(jl.linearise(skate, *state, {"unit": unit}).eigenvalues, [0, 0, 0, 0, 1 / 300], rtol=1e-9)
    np.testing.assert_allclose(modes.eigenvalues, [0, 0, 1 / 300], rtol=1e-9)
    assert list(modes.stable) == [True] * 2 + [False]


# Over a parameter


@pytest.mark.parametrize("gain", [1.0, 1e6, 1e9])
def test_stability_beside_a_state_that_only_follows(gain):
    states = {"r": jl.State(lambda r, q, gain: gain * q - 1e-3 * r)}
    system = jl.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2, states=states)
    over = {"b": [-2e-4, 2e-4], "gain": [gain, 2 * gain]}
    found = jl.stability_map(system, lambda: 0.0, params={"b": 0.0, "gain": gain}, over=over)
    np.testing.assert_allclose(found.growth, [[1e-4] * 2, [-1e-4] * 2], rtol=1e-6)
    (crossing,) = jl.root_locus(system, lambda: 0.0, params={"b": 0.0, "gain": gain}, over="b", values=over["b"]).crossings
    np.testing.assert_allclose([crossing.value, crossing.frequency], [0, 1], atol=1e-9)


@pytest.mark.parametrize("stiff", [1e4, 1e10])
def test_a_slow_divergence_beside_a_stiff_joint(stiff):
    def lagrangian(q, qdot, k, kp):
        return 0.5 * 1e-3 * qdot["x"] ** 2 + 0.5 * qdot["p"] ** 2 - 0.5 * k * q["x"] ** 2 - 0.5 * (kp + 0.01) * q["p"] ** 2

    system, at = jl.System(lagrangian, dissipation=lambda qdot: 0.05 * qdot["p"] ** 2), lambda: {"x": 0.0, "p": 0.0}
    (crossing,) = jl.root_locus(system, at, params={"k": stiff, "kp": 0.0}, over="kp", values=[-0.1, 0.1]).crossings
    np.testing.assert_allclose(crossing.value, -0.01, rtol=1e-9)
    assert (crossing.kind, crossing.direction) == ("divergence", "stabilises")
    for kp, kind in ((-0.05, "unstable"), (0.05, "stable")):
        assert jl.equilibrium(system, at(), {"k": min(stiff, 1e7), "kp": kp}).stability == kind  # 1e13/s² hide 0.04


def damped(*ratios):
    """Oscillators of their own, each damped by b times its ratio."""
    squares, ratios = jnp.arange(1.0, len(ratios) + 1) ** 2, jnp.array(ratios)
    return jl.System(
        lambda q, qdot: 0.5 * qdot @ qdot - 0.5 * jnp.sum(squares * q**2), dissipation=lambda qdot, b: 0.5 * b * jnp.sum(ratios * qdot**2)
    )


free_pair = jl.System(
    lambda q, qdot: 0.5 * qdot @ qdot - 2 * (q[0] - q[1]) ** 2, dissipation=lambda qdot, b: 0.5 * b * (qdot[0] - qdot[1]) ** 2
)


@pytest.mark.parametrize("system, n, pairs", [(free_pair, 2, 1), (damped(1.0, 0.3), 2, 2), (damped(1.0, 0.5, 2.0, 1.0), 4, 4)])
def test_each_pair_crosses_once(system, n, pairs):
    """However many cross at one value."""
    crossings = jl.root_locus(system, lambda: jnp.zeros(n), params={"b": 0.0}, over="b", values=[-0.5, -0.1, 0.4]).crossings
    assert [(c.kind, c.direction) for c in crossings] == [("flutter", "stabilises")] * pairs
    np.testing.assert_allclose([float(c.value) for c in crossings], 0, atol=1e-12)
    expected = [np.sqrt(8)] if system is free_pair else np.arange(1.0, n + 1)
    np.testing.assert_allclose(sorted(c.frequency for c in crossings), expected, rtol=1e-9)


# Zeros and the kind of rest


@pytest.mark.parametrize("seed", range(8))
def test_zeros_in_any_units(seed):
    """Against SciPy on [λ²M + λC + K, −b; c, 0]."""
    rng = np.random.default_rng(seed)
    n = 3
    M, K, C = (A @ A.T + 0.3 * np.eye(n) for A in rng.normal(size=(3, n, n)))
    b, c = rng.normal(size=(2, n))
    params = {"M": M, "K": K, "C": 0.1 * C, "b": b, "u": 0.0, "s": 10.0 ** rng.integers(-6, 7, n)}
    linear = jl.linearise(MASSES, np.zeros(n), params=params, inputs=["u"], outputs=lambda q, s: jnp.asarray(c) @ (s * q))
    A = np.block([[np.zeros((n, n)), np.eye(n), np.zeros((n, 1))], [-K, -0.1 * C, b[:, None]], [c[None], np.zeros((1, n + 1))]])
    E = scipy.linalg.block_diag(np.eye(n), M, 0)
    expected = scipy.linalg.eigvals(A, E)
    expected = expected[np.isfinite(expected) & (np.abs(expected) < 1e6)]
    assert_same_spectrum(np.asarray(linear.transfer_zeros()), expected, 1e-5)


@pytest.mark.parametrize("units", [[1.0, 1.0], [1e4, 1e-4], [1e-6, 1e3]])
@pytest.mark.parametrize(
    "K, kind", [([[2.0, 1.0], [1.0, 3.0]], "stable"), ([[1.0, 2.0], [2.0, 4.0]], "neutral"), ([[1.0, 2.0], [2.0, 3.0]], "unstable")]
)
def test_the_kind_of_rest_in_any_units(units, K, kind):
    params = {"M": np.eye(2), "K": np.array(K), "C": np.zeros((2, 2)), "b": np.zeros(2), "u": 0.0, "s": np.array(units)}
    found = jl.equilibrium(MASSES, np.zeros(2), params)
    assert found.stability == kind and found.undecided == ()
    np.testing.assert_allclose(found.stiffness, np.linalg.eigvalsh(K), atol=1e-12)


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6])
def test_a_stable_rest_far_away(unit):
    """From beside the saddle of a tilted double well, q⁴/4 − q²/2 + q/10, in other units."""
    well = lambda q, s: s**2 * ((q / s) ** 4 / 4 - (q / s) ** 2 / 2 + 0.1 * q / s)
    found = jl.equilibrium(jl.System(lambda q, qdot, s: 0.5 * qdot**2 - well(q, s)), 0.05 * unit, {"s": unit}, stable=True)
    assert found.stability == "stable"
    np.testing.assert_allclose(float(found.q) / unit, np.roots([1, 0, -1, 0.1])[0].real, rtol=1e-9)


def wells(q, qdot, s, a):
    """Two double wells, x⁴/4 − x²/2, tilted by a, with a spring between, x = q/s."""
    x, v = q / s, qdot / s
    return 0.5 * v @ v + 0.2 * v[0] * v[1] - jnp.sum(x**4 / 4 - x**2 / 2 - a * x) - 0.25 * (x[0] - x[1]) ** 2


WELLS = jl.System(wells)


@pytest.mark.parametrize("units", [[1.0, 1.0], [1e-9, 1.0], [1e9, 1e-9], [1e-9, 1e-9]])
def test_a_rest_in_any_units(units):
    """At x = 1, and dx/da = 1/(3x² − 1)."""
    s = np.array(units)
    at_rest = lambda a: jl.equilibrium(WELLS, s * np.array([1.3, 0.8]), {"s": s, "a": a}).q / s
    np.testing.assert_allclose(at_rest(0.0), [1, 1], rtol=1e-12)
    np.testing.assert_allclose(jax.jacfwd(at_rest)(0.0), [0.5, 0.5], rtol=1e-10)
    np.testing.assert_allclose(jax.jacrev(at_rest)(0.0), [0.5, 0.5], rtol=1e-10)


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6])
def test_of_many_places_of_rest_the_nearest_in_the_metric_of_the_masses(unit):
    """Masses of 1 and 4 on a spring between them, q₁ − q₂ = 1, from (0, 0): the heavy one moves a quarter as far; y in any unit."""
    pair = jl.System(lambda q, qdot, s: 0.5 * qdot[0] ** 2 + 2 * (qdot[1] / s) ** 2 - 0.5 * (q[0] - q[1] / s - 1) ** 2)
    found = jl.equilibrium(pair, np.zeros(2), {"s": unit})
    np.testing.assert_allclose(found.q / np.array([1, unit]), [0.8, -0.2], rtol=1e-12)
