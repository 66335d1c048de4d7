"""Equilibria and steady motions against closed forms and SciPy, their derivatives too; what has none is refused."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linear_by_hand import central
from scipy.optimize import fsolve

import jaxlag as jl
from jaxlag.examples import pendulum

g = 9.81
EXACT = 1e-12  # Newton's method to rounding

# A pendulum

ANGLE = jl.System(lambda q, qdot, m, l: 0.5 * m * (l * qdot["phi"]) ** 2 + m * g * l * jnp.cos(q["phi"]))
BOB = {"m": 0.7, "l": 0.4}


@pytest.mark.parametrize("guess, expected, stability", [(0.4, 0.0, "stable"), (-0.6, 0.0, "stable"), (2.9, np.pi, "unstable")])
def test_a_pendulum_up_and_down(guess, expected, stability):
    """The stiffness relative to the mass is ±g/l."""
    at = jl.equilibrium(ANGLE, {"phi": guess}, BOB)
    np.testing.assert_allclose(at.q["phi"], expected, rtol=0, atol=EXACT)
    np.testing.assert_array_equal(at.qdot["phi"], 0)
    assert at.stability == stability and stability in str(at)
    np.testing.assert_allclose(at.stiffness, [np.cos(expected) * g / BOB["l"]], rtol=1e-12)


def test_far_from_zero():
    """A spring whose length at rest is a large number in its unit."""
    spring = jl.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * (q - 2e4) ** 2)
    np.testing.assert_allclose(jl.equilibrium(spring, 1e4).q, 2e4, rtol=EXACT)


@pytest.mark.parametrize("x, y, sign, stability", [(0.3, -1.1, 1, "stable"), (-0.1, 0.8, -1, "unstable")])
def test_a_pendulum_on_a_rod(x, y, sign, stability):
    """From a guess off the constraint; λ = −(tension), tension m g below and −m g above."""
    p = pendulum.params | {"m": 0.7}
    at = jl.equilibrium(pendulum.cartesian, {"x": x, "y": y}, p)
    np.testing.assert_allclose([at.q["x"], at.q["y"]], [0, -sign], rtol=0, atol=EXACT)
    np.testing.assert_allclose(at.multipliers["rod"], -sign * 0.7 * g, rtol=EXACT)
    np.testing.assert_allclose(at.stiffness, [sign * g], rtol=1e-11)
    assert at.stability == stability


def double(q, qdot, l):
    """Two equal pendulums, one below the other, without their kinetic coupling."""
    return 0.5 * l**2 * qdot @ qdot + g * l * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))


@pytest.mark.parametrize("guess", [[3.1, 3.1], [np.pi, np.pi], [2.0, -2.5], [0.1, np.pi]])
def test_a_minimum_is_found_from_a_bad_guess(guess):
    """Also from the equilibrium that is a maximum; full turns are of no account."""
    at = jl.equilibrium(jl.System(double), np.array(guess), {"l": 0.4}, stable=True)
    np.testing.assert_allclose(np.cos(at.q), [1, 1], rtol=EXACT)
    np.testing.assert_allclose(np.sin(at.q), [0, 0], atol=EXACT)
    assert at.stability == "stable"
    np.testing.assert_allclose(at.stiffness, [g / 0.4, 2 * g / 0.4], rtol=1e-9)


def test_a_coordinate_that_is_fixed_chooses_among_equilibria():
    """Two masses that only a spring joins rest wherever they are together."""
    pair = jl.System(lambda q, qdot: 0.5 * (qdot["a"] ** 2 + qdot["b"] ** 2) - (q["a"] - q["b"] - 0.1) ** 2)
    for name in "ab":
        at = jl.equilibrium(pair, {"a": 0.4, "b": 0.0}, fixed=(name,))
        a = 0.4 if name == "a" else 0.1
        np.testing.assert_allclose([at.q["a"], at.q["b"]], [a, a - 0.1], rtol=0, atol=EXACT)
    assert at.stability == "neutral"


# A chain of rods between two points: the catenary in steps


LINKS, SPAN, RISE, WEIGHT = 20, 1.0, 0.15, 0.3


def hanging_chain(q, qdot):
    """Equal masses in the joints."""
    return 0.5 * WEIGHT / g * (qdot["x"] @ qdot["x"] + qdot["y"] @ qdot["y"]) - WEIGHT * jnp.sum(q["y"])


def links(q, l):
    x, y = (jnp.diff(q[name], prepend=0.0, append=end) for name, end in (("x", SPAN), ("y", RISE)))
    return jnp.hypot(x, y) - l


CHAIN = jl.System(hanging_chain, holonomic={"links": links})


@functools.cache
def by_statics(l):
    """Angles of the links and their horizontal force H: tan θᵢ₊₁ − tan θᵢ = (weight of a joint)/H, from end to end."""

    def ends(unknown):
        slope, log_H = unknown
        theta = np.arctan(slope + WEIGHT / np.exp(log_H) * np.arange(LINKS))
        return l * np.sum(np.cos(theta)) - SPAN, l * np.sum(np.sin(theta)) - RISE

    slope, log_H = fsolve(ends, [-2.0, np.log(LINKS * WEIGHT / 4)], xtol=1e-14)
    return np.arctan(slope + WEIGHT / np.exp(log_H) * np.arange(LINKS)), np.exp(log_H)


def joints_by_statics(l):
    theta, _ = by_statics(l)
    return l * np.cumsum(np.cos(theta))[:-1], l * np.cumsum(np.sin(theta))[:-1]


LENGTH = 1.4 / LINKS
SAG = {"x": np.linspace(0, 1, LINKS + 1)[1:-1], "y": -0.5 * np.sin(np.linspace(0, np.pi, LINKS + 1)[1:-1])}


@pytest.mark.slow
def test_a_chain_hangs_as_a_catenary():
    """Places of the joints, forces in the links; it is stable."""
    at = jl.equilibrium(CHAIN, SAG, {"l": LENGTH})
    x, y = joints_by_statics(LENGTH)
    np.testing.assert_allclose(at.q["x"], x, rtol=0, atol=1e-11)
    np.testing.assert_allclose(at.q["y"], y, rtol=0, atol=1e-11)
    theta, H = by_statics(LENGTH)
    np.testing.assert_allclose(at.multipliers["links"], -H / np.cos(theta), rtol=1e-10)
    assert at.stability == "stable" and at.stiffness.shape == (LINKS - 2,) and np.all(at.stiffness > 0)


@pytest.mark.slow
def test_the_chain_finds_its_minimum_from_above():
    """Upside down it stands as an arch of links in compression, but not stably."""
    arch = {"x": SAG["x"], "y": RISE - SAG["y"]}
    up = jl.equilibrium(CHAIN, arch, {"l": LENGTH})
    np.testing.assert_allclose(up.q["y"], RISE - joints_by_statics(LENGTH)[1][::-1], rtol=0, atol=1e-11)
    assert up.stability == "unstable" and np.all(up.stiffness < 0) and np.all(up.multipliers["links"] > 0)
    down = jl.equilibrium(CHAIN, arch, {"l": LENGTH}, stable=True)
    np.testing.assert_allclose(down.q["y"], joints_by_statics(LENGTH)[1], rtol=0, atol=1e-10)


@pytest.mark.slow
def test_the_chain_by_the_length_of_its_links():
    height = lambda l: jl.equilibrium(CHAIN, SAG, {"l": l}).q["y"]
    expected = central(lambda l: joints_by_statics(l)[1], LENGTH, 1e-4)
    np.testing.assert_allclose(jax.jacfwd(height)(LENGTH), expected, rtol=1e-7)


# Derivatives of any order


def hoop(q, qdot, R, Omega):
    """A bead on a hoop that turns with Ω: cos θ = g/(Ω² R)."""
    return 0.5 * R**2 * (qdot**2 + (Omega * jnp.sin(q)) ** 2) + g * R * jnp.cos(q)


HOOP = jl.System(hoop)
tilt = lambda x: jnp.arccos(g / (x[1] ** 2 * x[0]))  # x = R, Ω
found_tilt = lambda x: jl.equilibrium(HOOP, 1.0, {"R": x[0], "Omega": x[1]}).q
TURNING = jnp.array([0.2, 9.0])


def test_a_bead_on_a_turning_hoop():
    at = jl.equilibrium(HOOP, 1.0, {"R": 0.2, "Omega": 9.0})
    np.testing.assert_allclose(at.q, tilt(TURNING), rtol=EXACT)
    np.testing.assert_allclose(at.stiffness, [(9 * np.sin(tilt(TURNING))) ** 2], rtol=1e-11)
    assert at.stability == "stable"
    lowest = jl.equilibrium(HOOP, 0.1, {"R": 0.2, "Omega": 9.0})
    np.testing.assert_allclose(lowest.q, 0, atol=EXACT)
    assert lowest.stability == "unstable"


@pytest.mark.slow
@pytest.mark.parametrize(
    "derivative",
    [jax.jacfwd, jax.jacrev, jax.hessian, lambda f: jax.jacrev(jax.jacrev(f)), lambda f: jax.jacfwd(jax.hessian(f))],
    ids=["forwards", "backwards", "second", "backwards twice", "third"],
)
def test_derivatives_of_an_equilibrium_to_the_third_order(derivative):
    np.testing.assert_allclose(derivative(found_tilt)(TURNING), derivative(tilt)(TURNING), rtol=1e-9)


@pytest.mark.slow
def test_many_equilibria_at_once_and_under_jit():
    Omegas = jnp.array([7.5, 9.0, 12.0])
    each = lambda Omega: found_tilt(jnp.stack([0.2, Omega]))
    expected = np.array([tilt((0.2, Omega)) for Omega in Omegas])
    np.testing.assert_allclose(jax.vmap(each)(Omegas), expected, rtol=EXACT)
    np.testing.assert_allclose(jax.jit(each)(9.0), expected[1], rtol=EXACT)
    np.testing.assert_allclose(jax.vmap(jax.grad(each))(Omegas)[1], jax.grad(lambda Omega: tilt((0.2, Omega)))(9.0), rtol=1e-9)


# What does not decide everything


def test_constraints_that_say_the_same_share_the_force():
    """A block on a floor that is stated twice."""
    floor = lambda q: q["y"]
    block = jl.System(lambda q, qdot, m: 0.5 * m * qdot["y"] ** 2 - m * g * q["y"], holonomic={"one": floor, "two": floor})
    at = jl.equilibrium(block, {"y": 0.3}, {"m": 3.0})
    np.testing.assert_allclose(at.q["y"], 0, atol=EXACT)
    np.testing.assert_allclose([at.multipliers["one"], at.multipliers["two"]], [1.5 * g] * 2, rtol=EXACT)
    assert at.stiffness.shape == (0,) and at.stability == "stable"


def test_a_joint_without_mass():
    """Two springs in a row: m g/c₁ and m g (1/c₁ + 1/c₂)."""
    row = jl.System(
        lambda q, qdot, m, c1, c2: (
            0.5 * m * qdot["y"] ** 2 + m * g * q["y"] - 0.5 * c1 * q["joint"] ** 2 - 0.5 * c2 * (q["y"] - q["joint"]) ** 2
        )
    )
    at = jl.equilibrium(row, {"joint": 0.0, "y": 0.0}, {"m": 2.0, "c1": 300.0, "c2": 100.0})
    np.testing.assert_allclose(at.q["joint"], 2 * g / 300, rtol=EXACT)
    np.testing.assert_allclose(at.q["y"], 2 * g * (1 / 300 + 1 / 100), rtol=EXACT)
    assert at.stability == "stable"


def test_a_coordinate_on_which_nothing_depends_stays():
    """A pendulum below a cart that is free to roll."""
    cart = jl.System(
        lambda q, qdot, l: 0.5 * qdot["x"] ** 2 + 0.5 * (qdot["x"] + l * qdot["phi"]) ** 2 + g * l * jnp.cos(q["phi"]),
    )
    at = jl.equilibrium(cart, {"x": 0.7, "phi": 0.3}, {"l": 0.4})
    np.testing.assert_allclose([at.q["x"], at.q["phi"]], [0.7, 0], rtol=0, atol=EXACT)
    assert at.undecided == ("x",) and at.stability == "neutral"
    assert "x" in str(at) and "nothing depends" in str(at)
    np.testing.assert_allclose(at.stiffness, [0, 2 * g / 0.4], atol=1e-9)  # ω² = (1 + m/M) g/l


def test_a_force_has_no_potential():
    """A follower load: its equilibrium is found, its stability not decided by energy."""
    held = jl.System(lambda q, qdot, c: 0.5 * qdot @ qdot - 0.5 * c * q @ q, force=lambda q, F: F * jnp.stack([1.0 - q[1], q[0]]))
    c, F = 5.0, 2.0
    at = jl.equilibrium(held, np.zeros(2), {"c": c, "F": F})
    np.testing.assert_allclose(at.q, np.linalg.solve([[c, F], [-F, c]], [F, 0]), rtol=EXACT)
    assert at.stability not in ("stable", "unstable", "neutral") and at.stiffness is None


def test_states_come_to_rest_too():
    """An integrating controller holds a pendulum where it is told."""
    system = jl.System(
        lambda q, qdot, l: 0.5 * (l * qdot) ** 2 + g * l * jnp.cos(q),
        force=lambda q, qdot, total: total - 4.0 * (q - 0.5) - qdot,
        states={"total": jl.State(lambda q: 3.0 * (0.5 - q))},
    )
    at = jl.equilibrium(system, 0.0, {"l": 0.4})
    np.testing.assert_allclose(at.q, 0.5, rtol=EXACT)
    np.testing.assert_allclose(at.states["total"], g * 0.4 * np.sin(0.5), rtol=EXACT)


# Dry friction: a band of equilibria

rub = {"ground": lambda qdot, F: F * jnp.abs(qdot["x"])}


@pytest.mark.slow
def test_friction_holds_a_block_on_an_incline():
    """Anywhere: m g sin α of at most F."""
    slope = jl.System(lambda q, qdot, m, alpha: 0.5 * m * qdot["x"] ** 2 + m * g * jnp.sin(alpha) * q["x"], dissipation=rub)
    p = {"m": 2.0, "alpha": 0.2, "F": 5.0}
    at = jl.equilibrium(slope, {"x": 0.37}, p)
    np.testing.assert_allclose(at.q["x"], 0.37, rtol=EXACT)
    force, bound = at.friction["ground"]
    np.testing.assert_allclose(np.abs(force), [2 * g * np.sin(0.2)], rtol=1e-10)
    np.testing.assert_allclose(bound, [5.0], rtol=EXACT)
    with pytest.raises(ValueError, match="none was found: friction 'ground' would have to hold 5.798 and holds 5"):
        jl.equilibrium(slope, {"x": 0.37}, p | {"alpha": 0.3})


def test_the_middle_of_the_band_of_a_block_on_a_spring():
    """Where the spring alone holds it; friction could hold F more."""
    spring = jl.System(lambda q, qdot, m, c: 0.5 * m * qdot["x"] ** 2 + m * g * q["x"] - 0.5 * c * q["x"] ** 2, dissipation=rub)
    at = jl.equilibrium(spring, {"x": 0.2}, {"m": 2.0, "c": 90.0, "F": 5.0})
    np.testing.assert_allclose(at.q["x"], 2 * g / 90, rtol=EXACT)
    force, bound = at.friction["ground"]
    np.testing.assert_allclose(force, [0], atol=1e-12)
    np.testing.assert_allclose(bound, [5.0], rtol=EXACT)


# Steady motions


def spherical(q, qdot, l):
    """A conical pendulum."""
    return 0.5 * l**2 * (qdot["theta"] ** 2 + (qdot["phi"] * jnp.sin(q["theta"])) ** 2) + g * l * jnp.cos(q["theta"])


CONICAL = jl.System(spherical)
CIRCLING = {"theta": 0.8, "phi": 0.0}, {"theta": 0.0, "phi": 6.0}


@pytest.mark.slow
def test_a_conical_pendulum():
    """cos θ = g/(l φ̇²): with the speed given, with the angle given, and with neither."""
    l = 0.5
    at = jl.steady(CONICAL, *CIRCLING, {"l": l}, fixed_rates=("phi",))
    np.testing.assert_allclose([at.q["theta"], at.qdot["phi"]], [np.arccos(g / (l * 36)), 6], rtol=EXACT)
    at = jl.steady(CONICAL, *CIRCLING, {"l": l}, fixed=("theta",))
    np.testing.assert_allclose([at.q["theta"], at.qdot["phi"]], [0.8, np.sqrt(g / (l * np.cos(0.8)))], rtol=EXACT)
    at = jl.steady(CONICAL, *CIRCLING, {"l": l})
    np.testing.assert_allclose([at.q["theta"], at.qdot["phi"]], [np.arccos(g / (l * 36)), 6], rtol=EXACT)
    np.testing.assert_array_equal([at.q["phi"], at.qdot["theta"]], 0)


MOTORS = {"none": CONICAL, "holonomic": None, "nonholonomic": None}
MOTORS["holonomic"] = jl.System(spherical, holonomic={"motor": lambda t, q, speed: q["phi"] - speed * t})
MOTORS["nonholonomic"] = jl.System(spherical, nonholonomic={"motor": lambda qdot, speed: qdot["phi"] - speed})


@pytest.mark.parametrize("kind", MOTORS)
@pytest.mark.parametrize("per_time", [1.0, 1e6, pytest.param(1e-6, marks=pytest.mark.slow)])
def test_a_speed_stays_as_given_or_as_a_motor_has_it(kind, per_time):
    """cos θ = g/(l φ̇²), dθ/dφ̇ = 2 cos θ/(φ̇ sin θ), in any unit of time (l is 1/per_time², so that g stays)."""
    l, speed, t = 0.5 / per_time**2, 6.0 * per_time, 0.3 / per_time

    def angle(speed):
        start = {"theta": 0.8, "phi": speed * t}, {"theta": 0.0, "phi": speed if kind == "none" else 6.0 * per_time}
        at = jl.steady(MOTORS[kind], *start, {"l": l, "speed": speed}, t=t)
        return at.q["theta"], at

    slope, at = jax.grad(angle, has_aux=True)(speed)
    expected = np.arccos(g / (l * speed**2))
    np.testing.assert_allclose([at.q["theta"], at.qdot["phi"]], [expected, speed], rtol=EXACT)
    np.testing.assert_allclose(slope, 2 / (np.tan(expected) * speed), rtol=1e-9)


@pytest.mark.slow
def test_speeds_that_the_equations_decide_are_a_guess():
    """A body falls through air at m g/b, and spins as it was spun; a coordinate that t pushes ever harder has no steady motion."""
    falling = jl.System(
        lambda q, qdot, m: 0.5 * m * qdot @ qdot - m * g * q[0],
        dissipation=lambda qdot, b: 0.5 * b * qdot[0] ** 2,
        force=lambda t, a: jnp.stack([a * t, 0.0]),
    )
    speeds = lambda b, a=0.0: jl.steady(falling, np.zeros(2), np.array([-1.0, 3.0]), {"m": 0.4, "b": b, "a": a}).qdot
    np.testing.assert_allclose(speeds(2.0), [-0.2 * g, 3], rtol=EXACT)
    np.testing.assert_allclose(jax.jacfwd(speeds)(2.0), [0.1 * g, 0], rtol=1e-9, atol=1e-12)
    with pytest.raises(ValueError, match="but the motion found does not stay as it is"):
        speeds(2.0, 1.0)


def test_derivatives_of_a_steady_motion():
    """Of the angle by the length, and by the speed that is given."""
    angle = lambda l, speed: jl.steady(CONICAL, CIRCLING[0], {"theta": 0.0, "phi": speed}, {"l": l}, fixed_rates=("phi",)).q["theta"]
    closed = lambda l, speed: jnp.arccos(g / (l * speed**2))
    np.testing.assert_allclose(jax.grad(angle, argnums=(0, 1))(0.5, 6.0), jax.grad(closed, argnums=(0, 1))(0.5, 6.0), rtol=1e-9)


@pytest.mark.slow
def test_the_conical_pendulum_sways_about_its_steady_motion():
    """θ: ω² = φ̇² (1 + 3 cos²θ), by Routh's function."""
    l = 0.5
    at = jl.steady(CONICAL, *CIRCLING, {"l": l}, fixed_rates=("phi",))
    modes = jl.linearise(CONICAL, at, params={"l": l}).modes()
    moving = np.asarray(modes.angular_frequency)[np.asarray(modes.angular_frequency) > 0]
    np.testing.assert_allclose(moving, [6 * np.sqrt(1 + 3 * np.cos(at.q["theta"]) ** 2)], rtol=1e-9)


def governor(q, qdot, l, m, M):
    """Watt's: two balls on arms l, a sleeve of mass M at the other ends of equal links, 2 l cos θ below the top."""
    height = -2 * l * jnp.cos(q["theta"])
    ball = (l * qdot["theta"]) ** 2 + (l * jnp.sin(q["theta"]) * qdot["phi"]) ** 2
    return m * ball + 0.5 * M * (2 * l * jnp.sin(q["theta"]) * qdot["theta"]) ** 2 + 2 * m * g * l * jnp.cos(q["theta"]) - M * g * height


def test_the_height_of_a_governor():
    """l cos θ = (m + M) g/(m φ̇²)."""
    p, speed = {"l": 0.3, "m": 1.2, "M": 4.0}, 16.0
    at = jl.steady(jl.System(governor), {"theta": 0.9, "phi": 0.0}, {"theta": 0.0, "phi": speed}, p, fixed_rates=("phi",))
    np.testing.assert_allclose(p["l"] * np.cos(at.q["theta"]), (1.2 + 4) * g / (1.2 * speed**2), rtol=EXACT)


# What has none


def test_a_stone_that_falls_has_no_equilibrium():
    stone = jl.System(lambda q, qdot, m: 0.5 * m * qdot["x"] ** 2 - m * g * q["x"])
    with pytest.raises(ValueError, match=r"none was found: a force of -29\.4.* is left on 'x'"):
        jl.equilibrium(stone, {"x": 0.0}, {"m": 3.0})
    assert np.isnan(jax.jit(lambda m: jl.equilibrium(stone, {"x": 0.0}, {"m": m}).q["x"])(3.0))


def test_a_load_beyond_the_strongest_spring_force_has_no_equilibrium():
    """A spring that gives way: the greatest force is 1, where Newton's matrix is singular."""
    soft = jl.System(lambda q, qdot: 0.5 * qdot["x"] ** 2 + jnp.cos(q["x"]), force=lambda F: {"x": F})
    np.testing.assert_allclose(jl.equilibrium(soft, {"x": 0.3}, {"F": 0.99}).q["x"], np.arcsin(0.99), rtol=1e-9)
    with pytest.raises(ValueError, match="none was found: a force of 0.01.* is left on 'x'"):
        jl.equilibrium(soft, {"x": 0.3}, {"F": 1.01})


@pytest.mark.slow
def test_rods_that_do_not_reach_are_refused():
    with pytest.raises(ValueError, match="`q` must be near an equilibrium, but none was found"):
        jl.equilibrium(CHAIN, {"x": np.array([0.5]), "y": np.array([-0.2])}, {"l": 0.4})


def test_names_that_are_not_there_are_refused():
    with pytest.raises(ValueError, match="`fixed` must name coordinates, but holds 'z'. The coordinates are phi"):
        jl.equilibrium(ANGLE, {"phi": 0.1}, BOB, fixed=("z",))
    with pytest.raises(ValueError, match="`fixed_rates` must name coordinates, but holds 'z'"):
        jl.steady(CONICAL, *CIRCLING, {"l": 0.5}, fixed_rates=("z",))


def test_a_minimum_needs_a_potential():
    forced = jl.System(lambda q, qdot: 0.5 * qdot**2 - q**2, force={"push": lambda q: 1.0 - 0 * q})
    with pytest.raises(ValueError, match="`stable` must be False where forces are not from L, but there are 'push'"):
        jl.equilibrium(forced, 0.0, stable=True)


def test_a_coordinate_must_not_run_where_something_depends_on_it():
    """A pendulum does not turn uniformly."""
    with pytest.raises(ValueError, match="`qdot` must run in coordinates on which nothing depends|none was found"):
        jl.steady(ANGLE, {"phi": 0.0}, {"phi": 3.0}, BOB)
