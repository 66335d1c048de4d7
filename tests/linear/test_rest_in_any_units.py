"""What is said of rest does not change with units: what falls, what accelerates, what does not stay as it is, which kind it is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

GRAVITY = 9.81
UNITS = [([1.0, 1.0], 1.0, 1.0), ([1e9, 1e-9], 1e-9, 1e6), ([1e-9, 1e9], 1e9, 1e-6), ([1e-9, 1e-9], 1.0, 1.0)]
in_units = pytest.mark.parametrize("length, energy, time", UNITS)


def stated(L, g=None):
    """A system whose coordinates, energy and time have units of their own."""
    holonomic = None if g is None else lambda q, s: g(q / s)
    return jl.System(lambda q, qdot, s, E, tau: E * L(q / s, qdot * tau / s), holonomic=holonomic)


def params_of(length, energy, time):
    return {"s": jnp.asarray(length), "E": energy, "tau": time}


ROD = stated(lambda q, v: 0.5 * v @ v - GRAVITY * q[1], lambda q: q @ q - 1.0)
WELLS = stated(lambda q, v: 0.5 * v @ v - 0.25 * q[0] ** 4 + 0.5 * q[0] ** 2 - 1.5 * (q[0] - q[1]) ** 2)
HOOP = stated(lambda q, v: 0.5 * (v[0] ** 2 + (jnp.sin(q[0]) * v[1]) ** 2) + GRAVITY * jnp.cos(q[0]))


@in_units
@pytest.mark.parametrize("start", [(0.6, 0.8), (0.0, 1.0)])
def test_a_pendulum_falls(start, length, energy, time):
    """Also from its upper position of rest: hanging, with ω² = g/l."""
    s = np.array(length)
    found = jl.equilibrium(ROD, s * np.array(start), params_of(length, energy, time), stable=True)
    np.testing.assert_allclose(found.q / s, [0, -1], atol=1e-12)
    assert found.stability == "stable"
    np.testing.assert_allclose(np.asarray(found.stiffness) * time**2, [GRAVITY], rtol=1e-9)


@in_units
def test_a_fall_from_the_origin(length, energy, time):
    """From the saddle at zero, where no coordinate tells its unit, to x = ±1 with ω² of [[5, −3], [−3, 3]]."""
    s = np.array(length)
    found = jl.equilibrium(WELLS, np.zeros(2), params_of(length, energy, time), stable=True)
    np.testing.assert_allclose(np.abs(found.q / s), [1, 1], rtol=1e-9)
    np.testing.assert_allclose(np.asarray(found.stiffness) * time**2, [4 - np.sqrt(10), 4 + np.sqrt(10)], rtol=1e-8)


TURNED = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
SYMMETRIC = stated(lambda q, v: 0.5 * v @ v - 1.5 * q[1] ** 2 + GRAVITY * q[1] - 1.5 * jnp.sum((TURNED @ q) ** 2) + 1.5 * q @ q)


@in_units
def test_what_depends_on_a_coordinate_by_rounding_alone_holds_it_nowhere(length, energy, time):
    """Two springs cancel in x, which stays as it is given; y sags by m g/c, whatever the unit of time."""
    s = np.array(length)
    at = lambda tau: jl.equilibrium(SYMMETRIC, s * jnp.array([0.3, 0.1]), params_of(length, energy, tau)).q / s
    np.testing.assert_allclose(at(time), [0.3, GRAVITY / 3], rtol=1e-12)
    np.testing.assert_allclose(jax.jacfwd(at)(time) * time, [0, 0], atol=1e-12)


@in_units
@pytest.mark.parametrize("given", [(), ("q[0]", "q[1]")])
def test_a_wheel_at_its_final_speed(given, length, energy, time):
    """Two drives and the drag cancel up to rounding, and so does the force of rolling, whether the speed is given or not."""
    drag = lambda qdot, s, E, tau: E * 0.15 * (qdot[0] * tau / s[0]) ** 2 / tau
    drives = lambda s, E: E * jnp.array([0.1 * 1.7 + 0.2 * 1.7, 0.0]) / s
    rolls = lambda qdot, s, tau: (qdot[0] / s[0] - 0.5 * qdot[1] / s[1]) * tau
    system = jl.System(
        lambda q, qdot, s, E, tau: 0.5 * E * jnp.sum((qdot * tau / s) ** 2), dissipation=drag, force=drives, nonholonomic=rolls
    )
    s = np.array(length)
    find = lambda v, given: jl.steady(system, s * np.array([0.3, 0.0]), s * v / time, params_of(length, energy, time), fixed_rates=given)
    np.testing.assert_allclose(find(np.array([1.7, 3.4]), given).qdot * time / s, [1.7, 3.4], rtol=1e-9)
    if not given:  # nothing depends on a place, so that no coordinate says how large a velocity is
        np.testing.assert_allclose(find(np.array([1.0, 2.4]), given).qdot * time / s, [1.7, 3.4], rtol=1e-9)


@in_units
def test_what_accelerates_is_not_steady(length, energy, time):
    s, params = np.array(length), params_of(length, energy, time)
    beside = np.array([1e-3, -np.sqrt(1 - 1e-6)])
    with pytest.raises(ValueError, match=r"'q\[0\]' accelerates"):
        jl.linearise(ROD, s * beside, params=params)
    with pytest.raises(ValueError, match="must satisfy the constraints"):
        jl.linearise(ROD, s * np.array([0, -1 - 1e-6]), params=params)
    hanging = jl.linearise(ROD, s * np.array([0, -1.0]), params=params)
    np.testing.assert_allclose(np.asarray(hanging.modes().angular_frequency) * time, [np.sqrt(GRAVITY)], rtol=1e-9)


@pytest.mark.parametrize("length", [1.0, 1e-9, 1e9])
def test_constants_are_terms(length):
    """Coordinates that are zero at rest: a bob hangs 0.1 + 0.2 below, which is 0.3 but for rounding."""
    rod = jl.System(lambda q, qdot, s: 0.5 * qdot @ qdot / s**2 - GRAVITY * q[1] / s, holonomic=_rod_from_rest)
    found = jl.linearise(rod, np.zeros(2), params={"s": length})
    np.testing.assert_allclose(found.modes().angular_frequency, [np.sqrt(GRAVITY / 0.3)], rtol=1e-9)


def _rod_from_rest(q, s):
    x, y = q / s
    return x**2 + (y - 0.1 - 0.2) ** 2 - 0.3**2


@in_units
def test_what_does_not_stay_as_it_is(length, energy, time):
    """A bead that runs along its hoop meets gravity; one that runs round with it is steady at cos θ = g/ω²."""
    s, params = np.array(length), params_of(length, energy, time)
    with pytest.raises(ValueError, match="does not stay as it is"):
        jl.steady(HOOP, s * np.array([1.0, 0.0]), s / time * np.array([0.2, 0.0]), params)
    found = jl.steady(HOOP, s * np.array([1.0, 0.0]), s / time * np.array([0.0, 5.0]), params, fixed_rates=["q[1]"])
    np.testing.assert_allclose(found.q[0] / s[0], np.arccos(GRAVITY / 25), rtol=1e-9)


N = 70
CHAIN = stated(lambda q, v: 0.5 * v @ v - 2 * jnp.sum(jnp.diff(q, prepend=0.0, append=0.0) ** 2) + 0.1 * jnp.sum(q))
SAG = 0.0125 * np.arange(1, N + 1) * np.arange(N, 0, -1)  # of −4 (q_{i−1} − 2 q_i + q_{i+1}) = 0.1


@pytest.mark.slow
@pytest.mark.parametrize("length", [1.0, 1e-9, 10.0 ** (9 * (-1.0) ** np.arange(N))])
@pytest.mark.parametrize("energy, time", [(1.0, 1.0), (1e-9, 1e6), (1e9, 1e-6)])
def test_many_at_rest(length, energy, time):
    s = np.broadcast_to(length, (N,))
    params = params_of(s, energy, time)
    found = jl.equilibrium(CHAIN, np.zeros(N), params)
    np.testing.assert_allclose(found.q / s, SAG, rtol=1e-9)
    assert found.stability == "stable"


@pytest.mark.slow
@pytest.mark.parametrize("length", [1.0, 1e-9, 10.0 ** (9 * (-1.0) ** np.arange(N))])
@pytest.mark.parametrize("energy, time", [(1.0, 1.0), (1e-9, 1e6), (1e9, 1e-6)])
def test_the_lowest_of_many_modes(length, energy, time):
    """4 sin(k π/142), where the chain is at rest; refused where it is a tenth part off."""
    s = np.broadcast_to(length, (N,))
    params = params_of(s, energy, time)
    modes = jl.lowest_modes(CHAIN, s * SAG, params, count=3)
    np.testing.assert_allclose(np.asarray(modes.angular_frequency) * time, 4 * np.sin(np.arange(1, 4) * np.pi / (2 * N + 2)), rtol=1e-6)
    with pytest.raises(ValueError, match="must be at rest"):
        jl.lowest_modes(CHAIN, 1.1 * s * SAG, params, count=3)


LIGHT = jl.System(
    lambda q, qdot, K, s: 0.5 * (qdot[0] / s[0]) ** 2 - 0.5 * (q / s) @ K @ (q / s),
    dissipation=lambda qdot, s: 0.5 * jnp.sum((qdot / s) ** 2),
)


def test_coordinates_without_inertia_have_units_of_their_own():
    """Positive where all eigenvalues of K are, in units where they are near one."""
    random = np.random.default_rng(5)
    seen = set()
    for _ in range(60):
        turn = np.linalg.qr(random.normal(size=(4, 4)))[0]
        K = turn @ np.diag(random.uniform(0.3, 3, 4) * random.choice([1, 1, 1, 1, 1, 1, -1], 4)) @ turn.T
        found = jl.equilibrium(LIGHT, np.zeros(4), {"K": K, "s": 10 ** random.uniform(-8, 8, 4)})
        assert found.stability == ("stable" if np.all(np.linalg.eigvalsh(K) > 0) else "unstable")
        seen.add(found.stability)
    assert len(seen) == 2
