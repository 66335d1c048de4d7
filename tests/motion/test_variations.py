"""Derivatives are as exact as motions: where these are at rest, straight or symmetric, their steps fit the derivatives all the same."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg

import jaxlag as jl

TS = np.array([0.0, 20.0])
DRIVEN = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, force=lambda t, A: A * jnp.sin(3 * t))
BY_AMPLITUDE = (np.sin(60.0) - 1.5 * np.sin(40.0)) / (4 - 9)  # of q(20), c = 4, from rest
PAIR = jl.System(
    lambda q, qdot, m, T: 0.5 * m * (qdot @ qdot + 0.6 * qdot[0] * qdot[1] - (q[0] - q[1]) ** 2 / T**2),
    dissipation=lambda qdot, F: F * jnp.sum(jnp.abs(qdot)),
    force=lambda t, A, T: A * jnp.sin(t / T) * jnp.array([1.0, 0.0]),
)


def driven(A, unit=1.0, **how):
    return jl.simulate(DRIVEN, 0.0, 0.0, TS * unit, {"c": 4.0 / unit**2, "A": A} if unit == 1.0 else {"c": 4.0, "A": A}, **how).q[-1]


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("A", [0.0, 1e-12, 1.0])
def test_an_amplitude_at_rest(derivative, A):
    """−3e11 before, at A = 0."""
    np.testing.assert_allclose(derivative(driven)(A), BY_AMPLITUDE, rtol=1e-6)


@pytest.mark.slow
def test_an_amplitude_at_rest_in_a_batch():
    many = lambda A: jl.simulate_many(DRIVEN, 0.0, 0.0, TS, {"c": 4.0, "A": A}, over=("A",)).q[:, -1]
    found = jax.jacfwd(many)(jnp.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(found, BY_AMPLITUDE * np.eye(3), atol=1e-6)


@pytest.mark.slow
def test_an_amplitude_is_fitted_from_zero():
    ts = np.linspace(0, 20, 101)
    exact = 0.7 * (np.sin(3 * ts) - 1.5 * np.sin(2 * ts)) / (4 - 9)
    record = jl.Experiment(
        ts, {"q": exact + 1e-3 * np.random.default_rng(1).normal(size=101)}, 0.0, 0.0, observe=lambda q: {"q": q}, sigma=1e-3
    )
    fit = jl.fit(DRIVEN, record, {"c": 4.0, "A": 0.0}, free=("A",))
    sigma = 1e-3 / np.sqrt(np.sum((exact / 0.7) ** 2))
    np.testing.assert_allclose(fit.params["A"], 0.7, atol=4 * sigma)
    np.testing.assert_allclose(fit.standard_errors["A"], sigma, rtol=0.05)


@pytest.mark.slow
def test_many_amplitudes_at_rest_in_reverse():
    """120 numbers are differentiated in reverse, whose steps fit a direction at random."""
    w = np.arange(1, 121) / 10 + 0.05
    system = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2 * q**2, force=lambda t, A: jnp.sum(A * jnp.sin(jnp.asarray(w) * t)))
    last = lambda A: jl.simulate(system, 0.0, 0.0, TS, {"A": A}).q[-1]
    exact = (np.sin(w * 20) - w / 2 * np.sin(40.0)) / (4 - w**2)
    found = jax.grad(last)(jnp.zeros(120))
    np.testing.assert_allclose(found, exact, atol=1e-6 * np.max(np.abs(exact)))
    np.testing.assert_allclose(jax.jvp(last, (jnp.zeros(120),), (jnp.ones(120),))[1], exact.sum(), rtol=1e-6)


def test_an_inverted_pendulum_at_rest():
    """dq(20)/dq₀ = cosh 20: half of it before."""
    system = jl.System(lambda q, qdot: 0.5 * qdot**2 + 0.5 * q**2)
    slope = jax.jacfwd(lambda q0: jl.simulate(system, q0, 0.0, TS).q[-1])(0.0)
    np.testing.assert_allclose(slope, np.cosh(20.0), rtol=1e-6)


def test_a_stiffness_of_zero():
    """½q̇² − c (1 − cos 3q), v₀ = 1: dq/dc at c = 0 is −3 ∫ (T − t) sin 3t dt; −177 before."""
    system = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - c * (1 - jnp.cos(3 * q)))
    slope = jax.grad(lambda c: jl.simulate(system, 0.0, 1.0, np.array([0.0, 10.0]), {"c": c}).q[-1])(0.0)
    np.testing.assert_allclose(slope, -3 * float(mpmath.quad(lambda t: (10 - t) * mpmath.sin(3 * t), np.linspace(0, 10, 11))), rtol=1e-6)


@pytest.mark.slow
def test_a_hanging_rod():
    """A rod pendulum in x, y, driven from rest: linear in A, with ω² = g/l."""
    system = jl.System(
        lambda q, qdot: 0.5 * qdot @ qdot - 9.81 * q[1],
        holonomic={"rod": lambda q: q @ q - 1},
        force=lambda t, A: jnp.stack([A * jnp.sin(3 * t), 0 * t]),
    )
    x = lambda A: jl.simulate(system, jnp.array([0.0, -1.0]), jnp.zeros(2), TS, {"A": A}).q[-1, 0]
    w = np.sqrt(9.81)
    exact = (np.sin(60.0) - 3 / w * np.sin(w * 20)) / (w**2 - 9)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(x)(0.0), exact, rtol=1e-5)


RODS = {
    "plain": lambda q, l: q["r"] - l,
    "squared": lambda q, l: q["r"] ** 2 - l**2,
    "turning": lambda q, l: (q["r"] - l) * (2 + jnp.cos(q["phi"])),
    "logarithm": lambda q, l: jnp.log(q["r"] / l),
}


@pytest.mark.slow
@pytest.mark.parametrize("rod", RODS)
def test_a_rod_in_polar_coordinates(rod):
    """What it holds varies by rounding of rounding alone, which once ended the derivative, in any unit: from rest, through the bottom, by
    the time. Numbers of the pendulum in φ.
    """
    weight = lambda q, m, g, l: m * g * l * jnp.cos(q["phi"])
    held = jl.System(
        lambda q, qdot, m, g: 0.5 * m * (qdot["r"] ** 2 + q["r"] ** 2 * qdot["phi"] ** 2) + weight(q, m, g, q["r"]),
        holonomic={"rod": RODS[rod]},
    )
    plain = jl.System(lambda q, qdot, m, g, l: 0.5 * m * l**2 * qdot["phi"] ** 2 + weight(q, m, g, l))

    @jax.jit
    def of_held(x, unit):
        params, ts = {"m": 1.0, "l": unit, "g": 9.81 * unit}, jnp.stack([0.0, x[2]])
        motion = jl.simulate(held, {"r": unit, "phi": x[0]}, {"r": 0.0, "phi": x[1]}, ts, params)
        return jnp.stack([motion.q["phi"][-1], motion.multipliers["rod"][-1] / unit]), motion.stats["num_steps"]

    @jax.jit
    def of_plain(x):
        motion = jl.simulate(plain, {"phi": x[0]}, {"phi": x[1]}, jnp.stack([0.0, x[2]]), {"m": 1.0, "l": 1.0, "g": 9.81})
        return motion.q["phi"][-1]

    of_held, of_plain = jax.jacfwd(of_held, has_aux=True), jax.jacfwd(of_plain)
    for start in ((0.0, 6.3), (0.5, 0.0), (0.0, 1e-9), (0.0, 0.0)):
        x = jnp.array([*start, 0.5])
        for unit in (1.0, 1e-6, 1e7):
            slopes, steps = of_held(x, unit)
            np.testing.assert_allclose(slopes[0], of_plain(x), rtol=1e-7, atol=1e-8)
            assert np.all(np.isfinite(slopes[1])) and steps < 40


@pytest.mark.slow
def test_a_slider_that_an_amplitude_breaks_away():
    """Dry friction, then sliding: dq/dF of ½(t − t₀)² (t₀ = F) type motions, where the start is at rest."""
    system = jl.System(lambda q, qdot: 0.5 * qdot**2, dissipation=lambda qdot, F: F * jnp.abs(qdot), force=lambda t: t)
    last = lambda F: jl.simulate(system, 0.0, 0.0, np.array([0.0, 2.0]), {"F": F}).q[-1]
    np.testing.assert_allclose(last(0.7), (2 - 0.7) ** 3 / 6, rtol=1e-8)
    np.testing.assert_allclose(jax.grad(last)(0.7), -((2 - 0.7) ** 2) / 2, rtol=1e-6)


@pytest.mark.slow
def test_slip_that_begins_in_a_plane():
    """Behind it the direction follows the load at a rate of 1/|v|. Numbers of SciPy (Radau from a series, differences of fourth order);
    where no step resolves the derivative it is infinite, and no wrong number (−1.6e17 before).
    """
    system = jl.System(
        lambda q, qdot: 0.5 * qdot @ qdot,
        dissipation=lambda qdot, F: F * jl.dissipation.speed(qdot),
        force=lambda t, b: jnp.stack([t, b * t**2]),
    )
    last = lambda b, F: jl.simulate(system, jnp.zeros(2), jnp.zeros(2), np.array([0.0, 2.0]), {"b": b, "F": F}).q[-1]
    np.testing.assert_allclose(last(1.0, 1.0), [0.38173203, 0.56411349], rtol=1e-7)
    np.testing.assert_allclose(jax.jacfwd(last, 1)(1.0, 1.0), [-0.46354488, -0.56886836], rtol=2e-5)
    assert np.all(np.isinf(jax.jacfwd(last)(0.0, 1.0)))


def test_a_direction_of_rounding_alone_costs_few_steps():
    """The mass of a wheel that does not turn, beside a start that matters."""
    system = jl.System(
        lambda q, qdot, m, J: 0.5 * m * qdot[0] ** 2 + 0.5 * J * qdot[1] ** 2 - 2 * q[0] ** 2 - q[1] * (jnp.sqrt(J) ** 2 - J)
    )

    def last(m, J):
        motion = jl.simulate(system, jnp.array([1.0, 0.0]), jnp.zeros(2), TS, {"m": m, "J": J})
        return motion.q[-1, 0], motion.stats["num_steps"]

    (slope, of_wheel), steps = jax.grad(last, (0, 1), has_aux=True)(1.0, 0.3)
    np.testing.assert_allclose(slope, 20 * np.sin(40.0), rtol=1e-6)  # q = cos(2t/√m)
    assert of_wheel == 0 and steps < 200


@pytest.mark.slow
@pytest.mark.parametrize("length, time, mass", [(1.0, 1.0, 1.0), (3e-8, 2e3, 4e-5)])
def test_blocks_that_stick_at_first(length, time, mass):
    """What they hold cancels but for its rounding, and so does what of it varies: steps became as short as times have digits."""
    rest, params = jnp.zeros(2), lambda x: {"A": x[0] * force, "F": x[1] * force, "m": mass, "T": time}
    motion = lambda x: jl.simulate(PAIR, rest, rest, TS / 5 * time, params(x)).q[-1, 0] / length
    force, x = mass * length / time**2, jnp.array([3.0, 1.0])
    by_differences = [(motion(x + dx) - motion(x - dx)) / 2e-5 for dx in 1e-5 * jnp.eye(2)]
    np.testing.assert_allclose(jax.jacfwd(motion)(x), by_differences, rtol=1e-6)
    np.testing.assert_allclose(jax.jacrev(motion)(x), by_differences, rtol=1e-6)


ROW = jl.System(
    lambda q, qdot, c, s, E, T: E / s**2 * (0.5 * T**2 * qdot @ qdot - 0.5 * c * jnp.sum(jnp.diff(q, prepend=0.0) ** 2)),
)


@pytest.mark.parametrize("s, E, T", [(1.0, 1.0, 1.0), (1e-9, 1.0, 1.0), (1.0, 1e9, 1e9), (1e-9, 1e-12, 1e-9)])
@pytest.mark.parametrize("c, start", [(2.0, 1.0), (0.0, 1.0), (2.0, 0.0)])
def test_links_that_a_motion_has_yet_to_reach(s, E, T, c, start):
    """Masses in a row, of which the first one's spring is stretched: what the last does grows as t^8 from nothing. 75 times the steps."""
    n = 4
    K = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    K[-1, -1] = 1
    nothing, one = np.zeros((n, n)), np.eye(n)
    rates, of_c = np.block([[nothing, one], [-c * K, nothing]]), np.block([[nothing, nothing], [-K, nothing]])
    exact = scipy.linalg.expm(5 * np.block([[rates, 0 * rates], [of_c, rates]])) @ np.concatenate([start * np.ones(n), np.zeros(3 * n)])

    def last(c):
        params = {"c": c, "s": s, "E": E, "T": T}
        motion = jl.simulate(ROW, s * start * np.ones(n), np.zeros(n), T * np.linspace(0, 5, 6), params)
        return motion.q[-1] / s, motion.stats["num_steps"]

    for derivative in (jax.jacfwd, jax.jacrev):
        slope, steps = derivative(last, has_aux=True)(c)
        np.testing.assert_allclose(slope, exact[2 * n : 3 * n], atol=2e-8)
        assert steps < 100


HELD = jl.System(
    lambda qdot, m: 0.5 * m * qdot @ qdot,
    force=lambda t, b: b * jnp.sin(2 * t) * jnp.ones(2),
    holonomic={"pin": lambda q, k: q @ k},
    nonholonomic={"blade": lambda qdot: qdot[0] - qdot[1]},
)


def test_nothing_moves_and_nothing_is_loaded_at_the_start():
    """Constraints hold everything and the load grows from zero: what rounding is follows from the forces that come."""
    params, rest = {"m": 2.0, "k": np.array([1.0, 0.5])}, (np.zeros(2), np.zeros(2))
    motion = lambda b: jl.simulate(HELD, *rest, np.linspace(0, 2, 9), params | {"b": b}, throw=False)
    assert motion(1.0).succeeded
    for b in (1.0, 0.0):
        np.testing.assert_allclose(jax.jacfwd(lambda b: motion(b).q[-1])(b), 0.0, atol=1e-12)
