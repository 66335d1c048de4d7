"""Steps end where functions of a system jump or bend, and derivatives see it: against an event code in SciPy, and closed forms."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxlag as jl
from jaxlag import elements

FREE = lambda qdot: 0.5 * qdot**2
UNITS = [(1.0, 1.0), (1e-9, 1e-6), (1e6, 1e3)]  # of length and of time


def force(q, qdot, k, d, J, C, B, a):
    """A spring and a damper, and behind each a_i a force J, a spring C and a damper B more."""
    return -k * q - d * qdot + jnp.sum(jnp.where(q > a, J - B * qdot, 0.0) + C * jnp.maximum(q - a, 0))


PIECEWISE = jl.System(FREE, force=force)


def by_events(given):
    """q at the end of a motion of `PIECEWISE`, and how many surfaces it has passed, by the events of SciPy: the surface that comes first,
    and v = 0, so that no two are passed unseen within a step that turns.
    """
    (k, d, J, C, B), a, q, v, T = given
    side = np.where(q == a, -k * q - d * v > 0 if v == 0 else v > 0, q > a)
    t, y, passed = 0.0, np.array([q, v]), 0
    while True:
        of_side = side.copy()

        def rate(t, y, side=of_side):
            return [y[1], -k * y[0] - d * y[1] + np.sum(np.where(side, J + C * (y[0] - a) - B * y[1], 0))]

        beyond = lambda t, y, sign=np.where(side, 1, -1): np.min(sign * (y[0] - a))
        turns = lambda t, y: y[1]
        beyond.terminal = turns.terminal = True
        beyond.direction, turns.direction = -1, -np.sign(y[1] or rate(t, y)[1])
        tolerances = {"rtol": 1e-13, "atol": 1e-15, "first_step": min(1e-7, T - t), "max_step": 0.01}  # for its dense output
        found = solve_ivp(rate, (t, T), y, method="DOP853", events=[beyond, turns], **tolerances)
        t, y = found.t[-1], found.y[:, -1]
        if found.status != 1:
            return y[0], passed
        if found.t_events[0].size:
            i = np.argmin(np.where(side, 1, -1) * (y[0] - a))
            side[i], y, passed = not side[i], np.array([a[i], y[1]]), passed + 1
        else:
            y[1] = 0.0


def last(given, length, time):
    """The same by the package, in other units."""
    (k, d, J, C, B), a, q, v, T = given
    params = {"k": k / time**2, "d": d / time, "J": J * length / time**2, "C": C / time**2, "B": B / time, "a": a * length}
    times = jnp.stack([0 * time, T * time])
    return jl.simulate(PIECEWISE, q * length, v * length / time, times, params, rtol=1e-11).q[-1] / length


def random_machine(rng, surfaces):
    """Of random numbers; some start at rest, some on a surface, towards which they are not pushed from both sides."""
    size = lambda low, high: rng.uniform(low, high, surfaces)
    a = np.sort(0.7 * rng.normal(size=surfaces))
    jumps = rng.normal(size=surfaces) * rng.choice([0, 1], size=surfaces)
    k, d, C = rng.uniform(0.5, 9), rng.uniform(0, 0.5), -3 * rng.normal(size=surfaces) ** 2
    q = rng.normal() * 1.5 if rng.random() < 0.7 else a[0]
    v = 0.0 if rng.random() < 0.3 else 2 * rng.normal()
    if v == 0 and q == a[0] and (jumps[0] - k * q) * -k * q < 0:
        v = 1.0
    return (k, d, jumps, C, size(0, 1)), a, q, v, rng.uniform(0.5, 6)


def differences(given, along, flat, back):
    """Of `by_events`, where as many surfaces are passed on both sides, and steps of two sizes agree; otherwise None."""
    of = {h: by_events(jax.tree.map(np.asarray, back(flat + h * along))) for h in (2e-5, 1e-5, -1e-5, -2e-5)}
    coarse, fine = ((of[h][0] - of[-h][0]) / (2 * h) for h in (2e-5, 1e-5))
    alike = all(passed == by_events(given)[1] for _, passed in of.values())
    return fine if alike and abs(coarse - fine) < 1e-5 * (1 + abs(fine)) else None


def check_random_machines(count, seed, surfaces=4):
    rng, derivative, seen = np.random.default_rng(seed), jax.jit(jax.value_and_grad(last)), 0
    for i in range(count):
        given = random_machine(rng, surfaces)
        flat, back = ravel_pytree(jax.tree.map(np.asarray, given))
        expected, passed = by_events(given)
        value, slopes = derivative(jax.tree.map(jnp.asarray, given), *UNITS[i % len(UNITS)])
        np.testing.assert_allclose(value, expected, rtol=1e-8, atol=1e-8, err_msg=f"{i}: {given}")
        along = rng.normal(size=flat.size)
        if given[2] == given[1][0]:  # it stays on the surface on which it starts
            along[-3] = along[2 + 3 * surfaces]
        expected = differences(given, along, flat, back)
        if expected is not None:
            seen += passed
            np.testing.assert_allclose(ravel_pytree(slopes)[0] @ along, expected, rtol=1e-5, atol=1e-5, err_msg=f"{i}: {given}")
    assert seen > count


def test_random_machines_against_events_of_scipy():
    check_random_machines(30, 0)


@pytest.mark.slow
@pytest.mark.parametrize("surfaces", [1, 4, 20])
def test_many_random_machines_against_events_of_scipy(surfaces):
    check_random_machines(70, surfaces, surfaces)


@pytest.mark.slow
def test_a_table_is_located_knot_by_knot():
    """Energy of ½q̇² + a·V(q) with V broken is kept to rounding, from knot to knot; the last position is that of parabolas."""
    knots = np.linspace(-2, 2, 21)
    heights = knots**2 + 0.1 * np.sin(9 * knots)
    system = jl.System(lambda q, qdot, a, unit: 0.5 * qdot**2 - a * unit**2 * jnp.interp(q / unit, knots, heights))

    def parabolas(a, q, T):
        """From knot to knot by the formula of constant acceleration."""
        t, v, i = 0.0, 0.0, int(np.searchsorted(knots, q, side="right") - 1)
        while True:
            f = -a * (heights[i + 1] - heights[i]) / (knots[i + 1] - knots[i])
            times = [
                (sign * np.sqrt(v**2 + 2 * f * (x - q)) - v) / f
                for x in knots[i : i + 2]
                for sign in (1, -1)
                if v**2 + 2 * f * (x - q) >= 0
            ]
            until = min(s for s in times if s > 1e-9)
            if t + until >= T:
                return q + v * (T - t) + f * (T - t) ** 2 / 2
            t, q, v = t + until, q + v * until + f * until**2 / 2, v + f * until
            i += 1 if v > 0 else -1

    run = lambda a, q, unit: jl.simulate(system, q * unit, 0.0, jnp.array([0.0, 5.0]), {"a": a, "unit": unit}, rtol=1e-10)
    at = jax.jit(lambda a, q, unit: run(a, q, unit).q[-1] / unit)
    derivative = jax.jit(jax.grad(at))
    for q in (0.93, 0.9, 1.1):
        for unit in (1.0, 1e-9):
            np.testing.assert_allclose(at(1.3, q, unit), parabolas(1.3, q, 5.0), atol=1e-9)
            expected = (parabolas(1.3 + 1e-6, q, 5.0) - parabolas(1.3 - 1e-6, q, 5.0)) / 2e-6
            np.testing.assert_allclose(derivative(1.3, q, unit), expected, rtol=1e-6)


@pytest.mark.slow
def test_a_broken_table_of_two_thousand_knots():
    """Duffing's spring q + q³ by a table: within its interpolation of the smooth one."""
    knots = np.linspace(-1.5, 1.5, 2001)
    table = jl.System(FREE, force=lambda q: -jnp.interp(q, knots, knots + knots**3))
    motion = jl.simulate(table, 1.0, 0.0, np.linspace(0, 10, 11))
    smooth = solve_ivp(lambda t, y: [y[1], -y[0] - y[0] ** 3], (0, 10), [1.0, 0.0], rtol=1e-12, atol=1e-12, t_eval=motion.ts)
    np.testing.assert_allclose(motion.q, smooth.y[0], atol=20 * 6 * (3 / 2000) ** 2 / 8)


def test_a_bilinear_oscillator():
    """Springs k below and k + c above zero: a period is π/ω₁ + π/ω₂; by mass, k and c exact."""
    system = jl.System(lambda q, qdot, k, c: 0.5 * qdot**2 - 0.5 * k * q**2 - 0.5 * c * jnp.maximum(q, 0) ** 2)

    def after_periods(x):
        k, c = x
        period = lambda k, c: jnp.pi / jnp.sqrt(k) + jnp.pi / jnp.sqrt(k + c)
        times = jnp.stack([0.0, 5 * jax.lax.stop_gradient(period(k, c))])
        motion = jl.simulate(system, 0.0, 1.0, times, {"k": k, "c": c}, rtol=1e-11)
        return motion.q[-1], 5 * period(k, c)

    x = jnp.array([2.0, 7.0])
    (q, _), (dq, dT) = after_periods(x), jax.jacfwd(after_periods)(x)
    np.testing.assert_allclose(q, 0.0, atol=1e-8)
    np.testing.assert_allclose(dq, -dT, rtol=1e-6)  # a period that is longer by dT comes to zero, at speed 1, later by dT


OF_TIME = jl.System(FREE, force=lambda t, t0, f: jnp.where(t > t0, f, 0.0))
OF_A_STATE = jl.System(FREE, force=lambda z, f: jnp.where(z > 0.2, f, 0.0), states={"z": jl.State(lambda r: r, start=0.0)})
OF_BOTH = jl.System(FREE, force=lambda t, q, t0, f, c: jnp.where(t + c * q > t0, f, 0.0))


@pytest.mark.slow
@pytest.mark.parametrize("system", [OF_TIME, OF_A_STATE, OF_BOTH], ids=["time", "a state", "time and position"])
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_a_load_that_begins(system, derivative):
    """At rest until t₀: q(T) = f (T − t₀)²/2. By t₀ the derivative was 0."""

    def last(x, length, time):
        t0, f = x
        params = {"t0": t0 * time, "r": 0.2 / (t0 * time), "f": f * length / time**2, "c": 0.3 * time / length}
        return jl.simulate(system, 0 * length, 0 * length / time, jnp.array([0.0, 2.0]) * time, params).q[-1] / length

    compiled = jax.jit(lambda x, *units: (last(x, *units), derivative(last)(x, *units)))
    t0, f = x = jnp.array([0.7, 1.3])
    for units in UNITS:
        value, slopes = compiled(x, *units)
        np.testing.assert_allclose(value, f * (2 - t0) ** 2 / 2, rtol=1e-9)
        np.testing.assert_allclose(slopes, [-f * (2 - t0), (2 - t0) ** 2 / 2], rtol=1e-8)


@pytest.mark.parametrize("f, J", [(1.0, 1.0), (1.0, -0.5), (-1.0, 0.5), (-1.0, 2.0)])
def test_at_rest_on_a_surface_the_acceleration_decides(f, J):
    """It goes to the side to which it is pushed, in a few steps: q(T) = F T²/2."""
    system = jl.System(FREE, force=lambda q, f, J, a: f + jnp.where(q > a, J, 0.0))
    F = f + J if f > 0 else f

    def motion(f, a, length, time):
        params = {"f": f * length / time**2, "J": J * length / time**2, "a": a * length}
        return jl.simulate(system, a * length, 0.0, np.array([0.0, 2.0]) * time, params)

    for units, a in zip(UNITS, (0.86, -0.3, 0.0), strict=True):
        found = motion(f, a, *units)
        np.testing.assert_allclose(found.q[-1] / units[0], a + 2 * F, rtol=1e-9)
        assert found.stats["num_steps"] < 12
        slope = jax.grad(lambda f, units=units, a=a: motion(f, a, *units).q[-1] / units[0])(f)
        np.testing.assert_allclose(slope, 2.0, rtol=1e-8)


def test_a_motion_that_rattles_about_a_jump_is_named():
    """A force −sign(q) with damping: around zero ever faster."""
    system = jl.System(FREE, force=lambda q, qdot: -jnp.sign(q) - 5 * qdot)
    with pytest.raises(RuntimeError, match="rattles about that place"):
        jl.simulate(system, 1.0, 0.0, np.array([0.0, 12.0]), max_steps=20_000)


@pytest.mark.slow
def test_a_witness_that_jumps_where_others_pass_through_zero():
    """A force f on the first third of each cell of width a, and −f/2 on the rest: potential energy is that of straight pieces."""
    system = jl.System(FREE, force=lambda q, a, f: f * jnp.where(jnp.mod(q, a) < a / 3, 1.0, -0.5))

    def by_hand(a, f, q, v, T):
        t = 0.0
        while True:  # v > 0 throughout
            cell, share = np.divmod(q + 1e-12, a)
            g, end = (f, a / 3) if share < a / 3 else (-f / 2, a)
            speed = np.sqrt(v**2 + 2 * g * (cell * a + end - q))
            until = (speed - v) / g
            if t + until > T:
                return q + v * (T - t) + g * (T - t) ** 2 / 2
            t, q, v = t + until, cell * a + end, speed

    a, f = x = jnp.array([0.7, 0.3])
    last = lambda x, unit: jl.simulate(system, 0.1 * unit, unit, np.array([0.0, 9.0]), {"a": x[0] * unit, "f": x[1] * unit}).q[-1] / unit
    for unit in (1.0, 1e-6):
        np.testing.assert_allclose(last(x, unit), by_hand(0.7, 0.3, 0.1, 1.0, 9.0), rtol=1e-9)
        slope = (by_hand(0.7 + 1e-6, 0.3, 0.1, 1.0, 9.0) - by_hand(0.7 - 1e-6, 0.3, 0.1, 1.0, 9.0)) / 2e-6
        np.testing.assert_allclose(jax.grad(last)(x, unit)[0], slope, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [diffrax.Kvaerno5(), jl.Dopri5(), diffrax.Tsit5()])
def test_other_solvers(solver):
    """A half period of contact, and back: q(T) = a − (T − a − π/ω); an implicit stage that was not solved for ended the motion."""
    system = jl.System(lambda q, qdot, a, c: 0.5 * qdot**2 - 0.5 * c * jnp.maximum(q - a, 0.0) ** 2)
    last = lambda a, c: jl.simulate(system, 0.0, 1.0, np.array([0.0, 10.0]), {"a": a, "c": c}, solver=solver).q[-1]
    value, slopes = jax.value_and_grad(last, (0, 1))(0.5, 4.0)
    np.testing.assert_allclose(value, 0.5 - (9.5 - np.pi / 2), rtol=1e-6)
    np.testing.assert_allclose(slopes, [2.0, -np.pi / 16], rtol=1e-5)


@pytest.mark.slow
def test_friction_and_a_constraint_whose_numbers_jump():
    """A block on a straight wire slides from friction F into friction 3F at a: v² = v₀² − 2 F a, and on for (v²)/(6F)."""
    system = jl.System(
        lambda qdot: 0.5 * (qdot["x"] ** 2 + qdot["y"] ** 2),
        dissipation=lambda q, qdot, F, a: F * jnp.where(q["x"] > a, 3.0, 1.0) * jnp.abs(0.8 * qdot["x"] + 0.6 * qdot["y"]),
        holonomic={"wire": lambda q: q["y"] - 0.75 * q["x"]},
    )

    def last(x):
        F, a = x  # along the wire, in quarters
        motion = jl.simulate(system, {"x": 0.0, "y": 0.0}, {"x": 0.8, "y": 0.6}, np.array([0.0, 3.0]), {"F": F, "a": 0.8 * a})
        return motion.q["x"][-1] / 0.8

    F, a = x = jnp.array([0.4, 0.6])
    np.testing.assert_allclose(last(x), a + (1 - 2 * F * a) / (6 * F), rtol=1e-7)
    np.testing.assert_allclose(jax.grad(last)(x), [-1 / (6 * F**2), 1 - 1 / 3], rtol=1e-6)


FLOORS = pytest.mark.parametrize(  # in the loop for each purpose, too
    "events",
    [None, pytest.param({"later": jl.Event(lambda q: q["x"] - 9.0, lambda q: {"q": q})}, marks=pytest.mark.slow)],
    ids=["alone", "with an event"],
)


@pytest.mark.slow
@FLOORS
def test_a_floor_that_bends(events):
    """A ball without restitution slides along a floor and leaves it where the floor falls away: x = a + v t, y = −g t²/2."""
    system = jl.System(
        lambda q, qdot, g: 0.5 * (qdot["x"] ** 2 + qdot["y"] ** 2) - g * q["y"],
        unilateral={"floor": jl.Contact(lambda q, a: q["y"] + 5 * jnp.maximum(q["x"] - a, 0.0))},
        events=events,
    )

    def last(x):
        a, g = x
        return jl.simulate(system, {"x": 0.0, "y": 0.0}, {"x": 1.0, "y": 0.0}, np.array([0.0, 1.0]), {"a": a, "g": g}).q["y"][-1]

    a, g = x = jnp.array([0.4, 9.81])
    np.testing.assert_allclose(last(x), -g * (1 - a) ** 2 / 2, rtol=1e-8)
    np.testing.assert_allclose(jax.grad(last)(x), [g * (1 - a), -((1 - a) ** 2) / 2], rtol=1e-7)


STOP = jl.System(lambda q, qdot, a, c: 0.5 * qdot**2 - 0.5 * c * jnp.maximum(q - a, 0.0) ** 2)


@pytest.mark.slow
def test_many_motions_samples_and_steps():
    """As one by one: at samples between the ends of steps, for members with surfaces of their own, and step by step."""
    ts, stops = np.linspace(0, 3, 31), np.array([0.4, 0.9, 1.4])

    def exact(a, c, t):
        w, s = np.sqrt(c), t - a
        return np.where(s < 0, t, np.where(s < np.pi / w, a + np.sin(w * s) / w, a - (s - np.pi / w)))

    many = jl.simulate_many(STOP, 0.0, 1.0, ts, {"a": stops, "c": 4.0}, over="a", rtol=1e-10)
    np.testing.assert_allclose(many.q, [exact(a, 4.0, ts) for a in stops], atol=1e-8)
    stepper = jl.stepper(STOP, 0.1, {"a": 0.4, "c": 4.0}, rtol=1e-10)
    state = stepper.start(0.0, 1.0)
    _, q = jax.lax.scan(lambda state, _: ((after := stepper(state)), after.q), state, None, 30)
    np.testing.assert_allclose(q, exact(0.4, 4.0, ts[1:]), atol=1e-8)


def test_none_is_located_where_that_is_chosen_or_there_are_many():
    of = lambda surfaces: jl.simulate(STOP, 0.0, 1.0, np.array([0.0, 3.0]), {"a": 0.5, "c": 4.0}, surfaces=surfaces)
    located, not_located = of(jl.surfaces.Located()), of(jl.surfaces.NotLocated())
    assert located.stats["num_steps"] < not_located.stats["num_steps"] == of(jl.surfaces.Located(most=0)).stats["num_steps"]
    with pytest.raises(TypeError, match="surfaces"):
        of("none")
    with pytest.raises(ValueError, match="`most` must be"):
        jl.surfaces.Located(most=-1)
    places = jnp.linspace(0, 1, 33)
    many = jl.System(lambda q, qdot: 0.5 * qdot**2 - jnp.sum(jnp.maximum(q - places, 0.0) ** 2))
    (surface,) = jl.examine(many, 0.3, 0.0).surfaces
    assert not surface.located and jl.examine(STOP, 0.3, 0.0, {"a": 0.5, "c": 4.0}).surfaces[0].located


@pytest.mark.slow
@FLOORS
def test_a_floor_that_rises_strikes(events):
    """A ball slides along a floor up to a slope of 45° at a, with restitution e: q̇ = (1, 0) becomes ((1 − e)/2, (1 + e)/2)."""
    system = jl.System(
        lambda qdot: 0.5 * (qdot["x"] ** 2 + qdot["y"] ** 2),
        unilateral={"floor": jl.Contact(lambda q, a: q["y"] - jnp.maximum(q["x"] - a, 0.0), 0.5)},
        events=events,
    )

    def last(a, length):
        start = {"x": 0.0 * length, "y": 0.0 * length}, {"x": length, "y": 0.0 * length}
        motion = jl.simulate(system, *start, np.array([0.0, 2.0]), {"a": a * length})
        return jnp.stack([motion.q["x"][-1], motion.q["y"][-1]]) / length

    for length in (1.0, 1e-9):
        np.testing.assert_allclose(last(0.4, length), [0.4 + 0.25 * 1.6, 0.75 * 1.6], rtol=1e-8)
        np.testing.assert_allclose(jax.jacfwd(last)(0.4, length), [0.75, -0.75], rtol=1e-7)


@pytest.mark.slow
def test_second_derivatives():
    """Of the slope that one runs up: the block is at rest at a + v²/2f."""
    system = jl.System(FREE, force=lambda q, a, f: jnp.where(q > a, -f, 0.0))

    def last(x):
        v, a, f = x
        return jl.simulate(system, 0 * v, v, np.array([0.0, 2.0]), {"a": a, "f": f}).q[-1]

    def exact(x):
        v, a, f = x
        return 2 * v - f * (2 - a / v) ** 2 / 2

    x = jnp.array([0.8, 0.5, 0.3])
    np.testing.assert_allclose(jax.hessian(last)(x), jax.hessian(exact)(x), rtol=1e-7, atol=1e-7)


SATURATED = jl.System(
    FREE, force=lambda q, qdot, e, k, d, u: jnp.clip(-k * q - d * qdot - 0.4 * e, -u, u), states={"e": jl.State(lambda q: q, start=0.0)}
)


def test_a_controller_that_saturates():
    """By position, velocity and integral; against events of SciPy between the three linear systems."""

    def by_hand(k, d, u, T):
        wanted = lambda y: -k * y[0] - d * y[1] - 0.4 * y[2]
        t, y, passed = 0.0, np.array([1.0, 0.0, 0.0]), 0
        side = int(np.sign(wanted(y)) * (abs(wanted(y)) > u))
        while True:
            of = lambda y, side=side: side * u if side else wanted(y)
            ends = [lambda t, y, sign=sign: wanted(y) - sign * u for sign in (-1, 1)]
            for end, sign in zip(ends, (-1, 1), strict=True):
                end.terminal, end.direction = True, 0 if side else sign
            found = solve_ivp(lambda t, y, of=of: [y[1], of(y), y[0]], (t, T), y, "DOP853", rtol=1e-13, atol=1e-14, events=ends)
            t, y = found.t[-1], found.y[:, -1]
            if found.status != 1:
                return y[0], passed
            side, passed = 0 if side else (-1 if found.t_events[0].size else 1), passed + 1
            y = y + 1e-13 * np.array([y[1], of(y), y[0]])  # beyond what it has just met
            t += 1e-13

    last = lambda k, d, u: jl.simulate(SATURATED, 1.0, 0.0, np.array([0.0, 8.0]), {"k": k, "d": d, "u": u}, rtol=1e-11).q[-1]
    given = 3.0, 0.8, 0.6
    expected, passed = by_hand(*given, 8.0)
    value, slopes = jax.value_and_grad(last, (0, 1, 2))(*given)
    assert passed > 3
    np.testing.assert_allclose(value, expected, rtol=1e-8)
    for i, slope in enumerate(slopes):
        step = 1e-5 * np.eye(3)[i]
        difference = (by_hand(*(given + step), 8.0)[0] - by_hand(*(given - step), 8.0)[0]) / 2e-5
        np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_an_event_of_a_velocity_beside_a_surface():
    """With constant forces: where q̇ = v₁, beyond a."""
    system = jl.System(FREE, force=lambda q, a: jnp.where(q > a, 3.0, 1.0), events={"fast": jl.Event(lambda qdot: qdot - 2.5)})
    time = lambda a: jl.simulate(system, 0.0, 0.0, np.array([0.0, 3.0]), {"a": a}).events["fast"].ts[0]
    np.testing.assert_allclose(time(0.5), 1 + 0.5, rtol=1e-9)
    np.testing.assert_allclose(jax.grad(time)(0.5), 1 - 1 / 3, rtol=1e-8)  # √(2a), and (2.5 − √(2a))/3


@pytest.mark.parametrize("length, time", [(1.0, 1.0), (1e-6, 1e-3)])
def test_a_relay_with_hysteresis(length, time):
    """q̈ = −b q̇ ± F, switched at ±h: Tsypkin's half period τ has F (τ/b − 2 tanh(b τ/2)/b²) = 2 h, exactly.

    Source: Tsypkin, Relay Control Systems, section 3.3.
    """
    switched = {name: jl.Event(when, then, direction=of) for name, when, then, of in (
        ("down", lambda q, h: q - h, lambda F: {"states": {"u": -F}}, jl.direction.Rising()),
        ("up", lambda q, h: q + h, lambda F: {"states": {"u": F}}, jl.direction.Falling()),
    )}  # fmt: skip
    states = {"u": jl.State(lambda u: 0 * u, start=lambda F: F)}
    relay = jl.System(FREE, force=lambda qdot, u, b: u - b * qdot, states=states, events=switched)
    b, F, h = 2.0 / time, 3.0 * length / time**2, 0.1 * length

    def period(h):
        motion = jl.simulate(relay, 0.0 * length, 0.0, jnp.array([0.0, 25.0 * time]), {"b": b, "F": F, "h": h}, rtol=1e-11)
        times = motion.events["down"].ts
        last = jnp.sum(jnp.isfinite(times)) - 1
        return times[last] - times[last - 1]

    half = brentq(lambda tau: F * (tau / b - 2 * np.tanh(b * tau / 2) / b**2) - 2 * h, 1e-3 * time, 10 * time, xtol=1e-15 * time)
    found, slope = jax.value_and_grad(period)(h)
    np.testing.assert_allclose(found, 2 * half, rtol=1e-8)
    np.testing.assert_allclose(slope, 4 * b / (F * np.tanh(b * half / 2) ** 2), rtol=1e-6)


@pytest.mark.slow
def test_the_transmission_error_of_a_gear_with_play():
    """Under a load M the driven wheel lags by half the play and M/c, and leads by as much where M is reversed; and derivatives."""
    mesh = jl.System(
        lambda q, qdot, c, play: 0.5 * (qdot["in"] ** 2 + qdot["out"] ** 2) - elements.gap_spring(q["in"] - q["out"], c, play),
        dissipation=lambda qdot: qdot["out"] ** 2 + 0.5 * (qdot["in"] - qdot["out"]) ** 2,
        force=lambda t, M: {"in": jnp.where(t < 40.0, M, -M)},
    )
    rest, M = {"in": 0.0, "out": 0.0}, 0.3

    def errors(x):
        motion = jl.simulate(mesh, rest, rest, jnp.array([0.0, 40.0, 80.0]), {"c": x[0], "play": x[1], "M": M}, rtol=1e-10)
        return (motion.q["in"] - motion.q["out"])[1:]

    c, play = x = jnp.array([4.0, 0.05])
    both_ways = np.array([1.0, -1.0])
    np.testing.assert_allclose(errors(x), both_ways * (play / 2 + M / c), atol=1e-8)
    np.testing.assert_allclose(jax.jacfwd(errors)(x), np.outer(both_ways, [-M / c**2, 0.5]), atol=1e-7)
