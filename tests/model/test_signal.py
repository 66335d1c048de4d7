"""Measured inputs against SciPy and closed forms; motions, gradients and friction under inputs that jump."""

import itertools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline, interp1d
from scipy.linalg import expm

import jaxlag as jl
from jaxlag import Signal
from jaxlag._motion import solution_map
from jaxlag.interpolation import Cubic, Linear, ZeroOrderHold

RNG = np.random.default_rng(3)
TS = np.cumsum(RNG.uniform(0.05, 0.4, 40)) - 0.3
VALUES = RNG.normal(size=(40, 2))
EVERYWHERE = np.concatenate([np.linspace(TS[0] - 1, TS[-1] + 1, 300), TS])
OF_SCIPY = {
    ZeroOrderHold(): lambda ts, x: interp1d(ts, x, "previous", axis=0),
    Linear(): lambda ts, x: interp1d(ts, x, "linear", axis=0),
    Cubic(): lambda ts, x: CubicSpline(ts, x, bc_type="natural"),
}
every_interpolation = pytest.mark.parametrize("interpolation", OF_SCIPY, ids=repr)
IDENTITY = np.eye(TS.size)


@every_interpolation
def test_values_agree_with_scipy_and_the_ends_are_held(interpolation):
    expected = OF_SCIPY[interpolation](TS, VALUES)(np.clip(EVERYWHERE, TS[0], TS[-1]))
    vectors, scalars = Signal(TS, VALUES, interpolation), Signal(list(TS), list(VALUES[:, 0]), interpolation)
    np.testing.assert_allclose(vectors(EVERYWHERE), expected, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(jax.jit(jax.vmap(scalars))(EVERYWHERE), expected[:, 0], rtol=1e-12, atol=1e-13)
    assert vectors(0.3).shape == (2,) and scalars(1).shape == ()
    np.testing.assert_array_equal(vectors(TS[-1]), VALUES[-1])


@every_interpolation
def test_the_derivative_by_the_values_is_the_interpolation_of_unit_vectors(interpolation):
    """u is linear in its values."""
    expected = OF_SCIPY[interpolation](TS, IDENTITY)(np.clip(EVERYWHERE, TS[0], TS[-1]))
    u = lambda x: Signal(TS, x, interpolation)(EVERYWHERE)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(u)(jnp.asarray(VALUES[:, 0])), expected, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("order", [1, 2])
def test_derivatives_of_a_cubic_signal_by_time(order):
    """At both ends as well, where a motion starts and stops."""
    u, exact = Signal(TS, VALUES, Cubic()), CubicSpline(TS, VALUES, bc_type="natural")
    inside = np.linspace(TS[0], TS[-1], 101)
    derivative = jax.jacfwd(u) if order == 1 else jax.jacfwd(jax.jacfwd(u))
    np.testing.assert_allclose(jax.vmap(derivative)(inside), exact(inside, order), rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(derivative(TS[-1] + 0.1), np.zeros(2))


def test_the_derivative_of_a_cubic_signal_by_its_times():
    at = EVERYWHERE[:300]  # not the times themselves: at the ends u has a kink
    u = lambda ts: jnp.sum(Signal(ts, VALUES, Cubic())(at) ** 2)
    direction, step = np.random.default_rng(2).normal(size=TS.size), 1e-6
    exact = lambda ts: np.sum(CubicSpline(ts, VALUES, bc_type="natural")(np.clip(at, ts[0], ts[-1])) ** 2)
    slope = (exact(TS + step * direction) - exact(TS - step * direction)) / (2 * step)
    np.testing.assert_allclose(jax.grad(u)(jnp.asarray(TS)) @ direction, slope, rtol=1e-6)


@every_interpolation
def test_signals_of_different_lengths_are_filled_up_with_the_last_row(interpolation):
    lengths, at = [40, 25, 2], np.linspace(-1, 12, 200)
    filled = np.minimum(np.arange(40), np.array(lengths)[:, None] - 1)
    together = jax.vmap(lambda ts, x: Signal(ts, x, interpolation)(at))(TS[filled], VALUES[filled])
    for found, n in zip(together, lengths, strict=True):
        np.testing.assert_allclose(found, Signal(TS[:n], VALUES[:n], interpolation)(at), rtol=1e-12, atol=1e-12)


# --- an oscillator under a force

C, B = 4.0, 0.3


def oscillator_energy(q, qdot, c):
    return 0.5 * qdot**2 - 0.5 * c * q**2


oscillator = jl.System(oscillator_energy, dissipation=lambda qdot, b: 0.5 * b * qdot**2, force=lambda t, u: u(t))
FORCE = VALUES[:, 0]
SHARP = {"rtol": 1e-11, "atol": 1e-13}


def driven(u, ts, **numerics):
    return jl.simulate(oscillator, 1.0, 0.0, ts, {"c": C, "b": B, "u": u}, **numerics)


def exact_states(times, values, samples):
    """y and its derivatives by the values, by the exponential of the matrix over each piece between jumps; from rest at q = 1."""
    A = np.array([[0.0, 1, 0], [-C, -B, 1], [0, 0, 0]])
    y, found = np.concatenate([[[1.0], [0.0]], np.zeros((2, len(times)))], axis=1), {}
    grid = np.union1d(times[(times > samples[0]) & (times < samples[-1])], samples)
    for start, stop in itertools.pairwise(grid):
        found[start] = y
        k = max(np.searchsorted(times, start, side="right") - 1, 0)
        input_row = np.concatenate([[values[k]], IDENTITY[k, : len(times)]])
        y = (expm(A * (stop - start)) @ np.concatenate([y, input_row[None]]))[:2]
    found[grid[-1]] = y
    of_samples = np.stack([found[t] for t in samples])
    return of_samples[:, :, 0], of_samples[:, :, 1:]


@pytest.mark.parametrize("samples", [np.linspace(0, 10, 41), TS[2:], np.linspace(TS[-1] - 1, TS[-1] + 1, 41)], ids=["other", "same", "end"])
def test_an_oscillator_under_a_held_force(samples):
    y, _ = exact_states(TS, FORCE, samples)
    motion = driven(Signal(TS, FORCE), samples)
    np.testing.assert_allclose(np.stack([motion.q, motion.qdot], axis=1), y, atol=1e-8)
    sharp = driven(Signal(TS, FORCE), samples, **SHARP)
    np.testing.assert_allclose(np.stack([sharp.q, sharp.qdot], axis=1), y, atol=1e-11)
    held = FORCE[np.searchsorted(TS, samples, side="right") - 1]  # at a jump the new value
    np.testing.assert_allclose(sharp.qddot, held - C * y[:, 0] - B * y[:, 1], atol=1e-10)


@pytest.mark.slow
def test_jumps_are_stepped_on():
    """The same force in a function of time is found there too; passed over: seven times the steps, most of them rejected, less exact."""
    samples = np.linspace(0, 10, 41)

    def looked_up(t, times, values):
        return values[jnp.searchsorted(times, t, side="right") - 1]

    table = jl.System(oscillator_energy, dissipation=lambda qdot, b: 0.5 * b * qdot**2, force=looked_up)
    of = lambda surfaces: jl.simulate(table, 1.0, 0.0, samples, {"c": C, "b": B, "times": TS, "values": FORCE}, surfaces=surfaces)
    found, blind = of(jl.surfaces.Located()), of(jl.surfaces.NotLocated())
    seeing = driven(Signal(TS, FORCE), samples)
    np.testing.assert_allclose(found.q, exact_states(TS, FORCE, samples)[0][:, 0], atol=1e-8)
    assert found.stats["num_steps"] < 4 * TS.size
    assert seeing.stats["num_rejected_steps"] <= TS.size < 1000 < blind.stats["num_rejected_steps"]
    assert 7 * seeing.stats["num_steps"] < blind.stats["num_steps"]
    exact = exact_states(TS, FORCE, samples)[0][:, 0]
    assert 30 * np.max(np.abs(seeing.q - exact)) < np.max(np.abs(blind.q - exact))


def test_jumps_that_coincide_or_nearly_do_cost_nothing():
    """Two signals of opposite values, their times apart by 0 to 4 units of the last place: nothing moves, one step a jump, two at most."""
    cart = jl.System(lambda qdot: 0.5 * qdot**2, force={"one": lambda t, u: u(t), "other": lambda t, w: w(t)})
    times = np.linspace(0, 10, 101)
    later, pushes = times.copy(), np.random.default_rng(1).normal(size=101)
    for _ in range(5):
        motion = jl.simulate(cart, 0.0, 0.0, [0.0, 5, 10], {"u": Signal(times, pushes), "w": Signal(later, -pushes)})
        np.testing.assert_allclose(motion.q, 0, atol=1e-12)
        assert motion.stats["num_steps"] <= 210 and motion.stats["num_rejected_steps"] == 0
        later[1:] = np.nextafter(later[1:], 11)


@pytest.mark.parametrize("start, end", [(-1.0, 1.0), (np.nextafter(0.5, 0), 2.0), (0.5, np.nextafter(2, 3)), (0.5, np.nextafter(2, 1))])
def test_jumps_at_and_next_to_the_ends_and_at_zero(start, end):
    cart = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda t, u: u(t))
    times, pushes = np.array([-2.0, 0.0, 0.5, 2.0]), np.array([5.0, 1.0, 2.0, 3.0])
    v = np.sum(np.clip(np.minimum(np.r_[times[1:], 9], end) - np.maximum(times, start), 0, None) * pushes)
    motion = jl.simulate(cart, 0.0, 0.0, [start, 0.5 * (start + end), end], {"u": Signal(times, pushes)})
    np.testing.assert_allclose(motion.qdot[-1], v, rtol=1e-14)
    np.testing.assert_array_equal(np.asarray(motion.qddot)[[0, -1]], pushes[np.searchsorted(times, [start, end], side="right") - 1])


@pytest.mark.parametrize("solver", [diffrax.Dopri8(), diffrax.Kvaerno5()])
def test_other_solvers_step_on_jumps(solver):
    """Kvaerno5 has a stage beyond the end of its step."""
    samples = np.linspace(0, 5, 11)
    motion = driven(Signal(TS, FORCE), samples, solver=solver, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(motion.q, exact_states(TS, FORCE, samples)[0][:, 0], atol=1e-6)
    assert motion.stats["num_rejected_steps"] < 24


@pytest.mark.slow
@pytest.mark.parametrize("interpolation", [Linear(), Cubic()], ids=repr)
def test_an_oscillator_under_a_smooth_force(interpolation):
    samples, u = np.linspace(0, 5, 21), OF_SCIPY[interpolation](TS, FORCE)
    rates = lambda t, y: [y[1], u(t) - C * y[0] - B * y[1]]
    exact = solve_ivp(rates, (0, 5), [1, 0], method="DOP853", t_eval=samples, rtol=1e-12, atol=1e-13, max_step=0.02).y
    motion = driven(Signal(TS, FORCE, interpolation), samples)
    np.testing.assert_allclose(motion.q, exact[0], atol=1e-6)  # a linear signal has kinks, which the steps go over
    np.testing.assert_allclose(driven(Signal(TS, FORCE, interpolation), samples, **SHARP).qdot, exact[1], atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("derivative, count", [(jax.jacrev, 12), (jax.jacfwd, 40), (jax.jacrev, 40)])
def test_the_derivative_by_held_values(derivative, count):
    """Against the closed form, by as many values as make one Jacobian and by more."""
    times, samples = TS[:count], np.array([0.0, 1.0, TS[count - 1]])
    J = exact_states(times, FORCE[:count], samples)[1]
    both = np.repeat(FORCE[:count, None], 2, axis=1)  # a vector signal of which one entry is used twice: up to 80 numbers
    system = jl.System(oscillator_energy, dissipation=lambda qdot, b: 0.5 * b * qdot**2, force=lambda t, u: 0.25 * u(t)[0] + 0.75 * u(t)[1])
    end = lambda x: jl.simulate(system, 1.0, 0.0, samples, {"c": C, "b": B, "u": Signal(times, x)}, rtol=1e-9, atol=1e-11).q
    found = derivative(end)(jnp.asarray(both))
    np.testing.assert_allclose(found, J[:, 0, :, None] * np.array([0.25, 0.75]), atol=1e-8)


# --- a block on a belt, pulled and pressed down: each of the three jumps at times of its own, and some in common


def block_energy(qdot):
    return 0.5 * qdot**2


belt = jl.System(block_energy, dissipation={"belt": lambda t, qdot, F, u: F(t) * jnp.abs(qdot - u(t))}, force=lambda t, f: f(t))
INPUTS = {
    "f": (np.array([0.0, 0.7, 1.5, 2.5, 3.1, 4.6, 5.0, 6.3]), np.array([0.5, 2.0, 0.3, -2.5, 0.9, 1.1, -0.4, 0.6])),
    "F": (np.array([0.0, 2.0, 3.1, 4.0, 5.5, 7.0]), np.array([1.0, 1.6, 0.7, 1.3, 0.2, 1.5])),
    "u": (np.array([0.0, 1.0, 2.5, 5.0, 6.6]), np.array([0.0, 0.23, -0.21, 0.4, 0.1])),
}
JUMPS = np.unique(np.concatenate([times for times, _ in INPUTS.values()]))
ALONG = np.unique(np.concatenate([np.linspace(0, 8, 33), JUMPS]))


def exact_ride(inputs, samples):
    """Position and velocity, from rest, and whether it sticks: piecewise uniform accelerations."""
    x, v, found = 0.0, 0.0, {}
    at = lambda name, t: inputs[name][1][np.searchsorted(inputs[name][0], t, side="right") - 1]
    grid = np.union1d(samples, [t for t in np.concatenate([times for times, _ in inputs.values()]) if t < samples[-1]])
    for start, left in zip(grid, np.diff(grid, append=grid[-1]), strict=True):
        f, F, u = (at(name, start) for name in ("f", "F", "u"))
        found[start] = x, v, abs(v - u) < 1e-12 and abs(f) <= F
        while left > 0:
            sliding = abs(v - u) > 1e-12
            if not sliding and abs(f) <= F:
                x, v, left = x + u * left, u, 0.0
                continue
            a = f - F * np.sign(v - u if sliding else f)
            stop = (u - v) / a if (u - v) * a > 0 and sliding else np.inf
            dt = min(left, stop)
            x, v, left = x + v * dt + a * dt**2 / 2, u if stop <= left else v + a * dt, left - dt
    return tuple(map(np.array, zip(*(found[t] for t in samples), strict=True)))


def ride(inputs, samples):
    return jl.simulate(belt, 0.0, 0.0, samples, {name: Signal(*given) for name, given in inputs.items()}, rtol=1e-9, atol=1e-11)


@pytest.mark.slow
def test_a_block_breaks_away_and_sticks_where_inputs_jump():
    motion, (x, v, stuck) = ride(INPUTS, ALONG), exact_ride(INPUTS, ALONG)
    np.testing.assert_allclose(motion.q, x, atol=1e-9)
    np.testing.assert_allclose(motion.qdot, v, atol=1e-9)
    np.testing.assert_array_equal(motion.friction["belt"].sticking, stuck)
    bound = Signal(*INPUTS["F"])(ALONG)
    assert np.all(np.abs(motion.friction["belt"].force) <= bound * (1 + 1e-9))
    assert 0.2 < np.mean(stuck) < 0.8 and motion.stats["transitions"][-1] == 9
    assert motion.stats["num_steps"] <= ALONG.size + 9  # uniform accelerations: a step from node to node, and to each transition


def check_derivative_of_a_ride(inputs, derivative):
    """Against finite differences of the closed form."""
    ends = np.array([0.0, 8.0])
    signals = lambda values: {name: (inputs[name][0], values[name]) for name in inputs}
    values = {name: given[1] for name, given in inputs.items()}
    found = derivative(lambda values: ride(signals(values), ends).q[-1])(jax.tree.map(jnp.asarray, values))
    for name in inputs:
        for i, unit in enumerate(np.eye(values[name].size)):
            bumped = lambda h, name=name, unit=unit: exact_ride(signals(values | {name: values[name] + h * unit}), ends)[0][-1]
            slope = (bumped(1e-7) - bumped(-1e-7)) / 2e-7
            np.testing.assert_allclose(found[name][i], slope, atol=3e-7, err_msg=f"{name}[{i}]")


@pytest.mark.slow
def test_the_derivative_of_a_ride_by_all_values():
    check_derivative_of_a_ride(INPUTS, jax.grad)


@pytest.mark.slow
def test_the_derivative_of_a_ride_by_more_values_than_make_one_jacobian():
    rng = np.random.default_rng(8)
    scales = {"f": (-2.0, 2.0), "F": (0.2, 1.5), "u": (-0.3, 0.3)}
    times = {name: np.r_[0.0, np.sort(rng.uniform(0, 8, 19))] for name in scales}
    check_derivative_of_a_ride({name: (times[name], rng.uniform(*scale, 20)) for name, scale in scales.items()}, jax.grad)


@pytest.mark.slow
def test_a_prescribed_speed_that_jumps_is_an_impulse():
    """Two carriages, the distance of which a winch changes at a speed that jumps: their momentum stays, their speeds jump."""
    speeds, m = np.array([0.0, 0.6, -0.4, 0.2]), np.array([1.0, 3.0])
    times = np.array([0.0, 1.0, 1.5, 3.0])
    carriages = jl.System(lambda qdot, m: 0.5 * m @ qdot**2, nonholonomic={"winch": lambda t, qdot, u: qdot[1] - qdot[0] - u(t)})
    samples = np.union1d(np.linspace(0, 4, 9), times)
    motion = jl.simulate(carriages, np.zeros(2), np.ones(2), samples, {"m": m, "u": Signal(times, speeds)}, works=True)
    u = speeds[np.searchsorted(times, samples, side="right") - 1]
    shares = np.array([-m[1], m[0]]) / m.sum()
    np.testing.assert_allclose(motion.qdot, 1 + shares * u[:, None], atol=1e-12)
    wound = np.concatenate([[0], np.cumsum(np.diff(samples) * u[:-1])])
    np.testing.assert_allclose(motion.q, samples[:, None] + shares * wound[:, None], atol=1e-9)
    assert np.max(np.abs(motion.balance())) < 1e-9  # the work of the impulses is that of the projection


def test_the_energy_that_a_jump_brings_in_is_counted():
    """A spring whose other end is moved at once: V jumps."""
    spring = jl.System(lambda t, q, qdot, c, u: 0.5 * qdot**2 - 0.5 * c * (q - u(t)) ** 2)
    samples = np.union1d(np.linspace(0, 5, 11), TS[(TS > 0) & (TS < 5)])
    motion = jl.simulate(spring, 1.0, 0.0, samples, {"c": C, "u": Signal(TS, FORCE)}, works=True)
    assert np.ptp(motion.energy()) > 1 and np.max(np.abs(motion.balance())) < 1e-8


@pytest.mark.slow
def test_a_prescribed_position_is_followed_and_its_force_measured():
    """q = u(t), a cubic signal: λ = m ü, with ü by SciPy."""
    follower = jl.System(lambda qdot, m: 0.5 * m * qdot**2, holonomic={"drive": lambda t, q, u: q - u(t)})
    samples, exact = np.linspace(0, 5, 41), CubicSpline(TS, FORCE, bc_type="natural")
    motion = jl.simulate(follower, exact(0.0), exact(0.0, 1), samples, {"m": 2.0, "u": Signal(TS, FORCE, Cubic())})
    np.testing.assert_allclose(motion.q, exact(samples), atol=1e-12)
    np.testing.assert_allclose(motion.qdot, exact(samples, 1), atol=1e-11)
    np.testing.assert_allclose(motion.multipliers["drive"], 2 * exact(samples, 2), rtol=1e-9, atol=1e-9)


# --- composition with JAX


@pytest.mark.slow
@every_interpolation
def test_vmap_over_signals_with_times_of_their_own_equals_the_loop(interpolation):
    rng = np.random.default_rng(4)
    times, values = np.cumsum(rng.uniform(0.1, 0.6, (4, 12)), axis=1), rng.normal(size=(4, 12))
    samples = np.linspace(0, 5, 6)
    end = lambda times, values: driven(Signal(times, values, interpolation), samples).q
    together = jax.jit(jax.vmap(end))(times, values)
    tolerance = {ZeroOrderHold(): 1e-9, Linear(): 1e-5, Cubic(): 1e-6}[
        interpolation
    ]  # of the integration, whose steps rounding shifts across kinks
    np.testing.assert_allclose(together, [end(*each) for each in zip(times, values, strict=True)], atol=tolerance)
    signals = jax.vmap(lambda times, values: Signal(times, values, interpolation))(times, values)
    np.testing.assert_array_equal(jax.jit(jax.vmap(lambda u: driven(u, samples).q))(signals), together)


@pytest.mark.slow
def test_vmap_over_rides_equals_the_loop():
    samples = np.linspace(0, 8, 9)
    scaled = [{name: (times, s * values) for name, (times, values) in INPUTS.items()} for s in (1.0, 1.3, 0.7)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scaled)
    together = jax.vmap(lambda inputs: ride(inputs, samples))(batch)
    for found, inputs in zip(together.q, scaled, strict=True):
        np.testing.assert_allclose(found, exact_ride(inputs, samples)[0], atol=1e-9)


def test_new_values_trace_nothing(monkeypatch):
    traces, check = [], solution_map.check
    monkeypatch.setattr(solution_map, "check", lambda *args: traces.append(1) or check(*args))
    cart = jl.System(lambda qdot: 0.5 * qdot**2, force={"of its own": lambda t, u: u(t)})
    run = lambda times, values: jl.simulate(cart, 0.0, 0.0, [0.0, 2.0], {"u": Signal(times, values)}).q[-1]
    np.testing.assert_allclose([run([0, 1], [1, 2]), run(np.array([0.0, 0.5]), jnp.array([1.0, -1.0]))], [2.5, -0.25], rtol=1e-12)
    assert len(traces) == 1


@pytest.mark.slow
def test_neither_samples_nor_a_smooth_signal_end_steps():
    """u = 6 t through 101 points, sampled as often: x = t³."""
    ts = np.linspace(0, 1, 101)
    cart = jl.System(lambda qdot: 0.5 * qdot**2, force={"cubic": lambda t, u: u(t)})
    motion = jl.simulate(cart, 0.0, 0.0, ts, {"u": Signal(ts, 6 * ts, Cubic())})
    np.testing.assert_allclose(motion.q, ts**3, atol=1e-12)
    assert motion.stats["num_steps"] < 20


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:jaxlag runs in single precision")
@every_interpolation
def test_single_precision_coordinates_and_double_precision_signals(interpolation):
    """And the other way about: u(t) has the precision of the values."""
    samples = np.linspace(0, 5, 11, dtype=np.float32)
    start = np.float32(1), np.float32(0)
    motion = jl.simulate(oscillator, *start, samples, {"c": C, "b": B, "u": Signal(TS, FORCE, interpolation)})
    assert motion.q.dtype == jnp.float32
    np.testing.assert_allclose(motion.q, driven(Signal(TS, FORCE, interpolation), samples.astype(float)).q, atol=5e-3)
    assert interpolation != ZeroOrderHold() or motion.stats["num_rejected_steps"] <= 5
    single = Signal(TS, FORCE.astype(np.float32), interpolation)
    assert single(0.5).dtype == jnp.float32 and Signal(TS, FORCE, interpolation)(np.float32(0.5)).dtype == jnp.float64
    np.testing.assert_allclose(single(0.5), Signal(TS, FORCE, interpolation)(0.5), rtol=1e-5)


@pytest.mark.filterwarnings("ignore:jaxlag runs in single precision")
def test_single_precision_alone(single_precision):
    samples = np.linspace(0, 5, 11)
    motion = driven(Signal(TS, FORCE), samples)
    assert motion.q.dtype == jnp.float32 and motion.succeeded
    np.testing.assert_allclose(motion.q, exact_states(TS, FORCE, samples)[0][:, 0], atol=2e-3)


# --- what is refused

WRONG = {
    "unknown interpolation": (lambda: Signal(TS, FORCE, "spline"), r"`interpolation` must be .*, but is 'spline'"),
    "a class": (lambda: Signal(TS, FORCE, Linear), r"`interpolation` must be one of .*, but is <class"),
    "one time": (lambda: Signal([0.0], [1.0]), r"`ts` must be a list of at least two times, but has shape \(1,\)"),
    "a table of times": (lambda: Signal(np.ones((3, 2)), np.ones(3)), r"`ts` must be a list of .* times, but has shape \(3, 2\)"),
    "times that go back": (lambda: Signal([0, 2, 1], np.ones(3)), r"`ts` must increase, but ts\[1\] = 2 is followed by ts\[2\] = 1"),
    "a time twice": (lambda: Signal([0, 1, 1], np.ones(3)), r"`ts` must increase, but ts\[1\] = 1 is followed by ts\[2\] = 1.*drop"),
    "a missing time": (lambda: Signal([0, np.nan, 1], np.ones(3)), "`ts` must be finite, but has 1 missing"),
    "an endless time": (lambda: Signal([0, 1, np.inf], np.ones(3)), "`ts` must be finite, but has 1 missing"),
    "complex times": (lambda: Signal([0, 1j], np.ones(2)), "`ts` must be real, but has dtype complex128"),
    "dates": (lambda: Signal(np.array(["2024-01-01", "2024-01-02"], "datetime64[s]"), np.ones(2)), "`ts` must be an array of real"),
    "too few values": (lambda: Signal([0, 1, 2], np.ones(2)), r"`values` must have one row for each of the 3 times, but has shape \(2,\)"),
    "channels first": (lambda: Signal([0, 1, 2], np.ones((2, 3))), r"`values` must have one row .*, but has shape \(2, 3\)"),
    "one value": (lambda: Signal([0, 1, 2], 5.0), r"`values` must have one row for each of the 3 times, but has shape \(\)"),
    "missing samples": (lambda: Signal([0, 1, 2], [[1, np.nan], [1, 2], [np.inf, 2]]), "`values` must be finite, but has 2 missing"),
    "masked samples": (lambda: Signal([0, 1], np.ma.masked_array([1, 2], [False, True])), "`values` must be finite, but has 1 missing"),
    "complex values": (lambda: Signal([0, 1], [1j, 2]), "`values` must be real, but has dtype complex128"),
    "truth values": (lambda: Signal([0, 1], [True, False]), "`values` must be real, but has dtype bool"),
    "text": (lambda: Signal([0, 1], ["on", "off"]), "`values` must be an array of real numbers, but is a list"),
    "nothing among them": (lambda: Signal([0, 1], [1.0, None]), "`values` must be an array of real numbers, but is a list"),
    "nothing": (lambda: Signal([0, 1], None), "`values` must be an array of real numbers, but is a NoneType"),
    "rows of different lengths": (lambda: Signal([0, 1], [[1, 2], [3]]), "`values` must be an array of real numbers.*equal length"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_bad_data_get_a_sentence_with_the_cure(case):
    action, sentence = WRONG[case]
    with pytest.raises((ValueError, TypeError), match=sentence):
        action()


def test_under_jit_missing_values_are_a_result():
    samples = np.linspace(0, 10, 41)
    motion = jax.jit(lambda values: driven(Signal(TS, values), samples))(np.where(TS > 3, np.nan, FORCE))
    assert motion.result == jl.results.RESULTS.not_finite and np.all(np.isnan(motion.q))


def test_a_delay_is_later():
    late = jl.Signal([0.0, 1.0, 3.0], [0.0, 1.0, 5.0], jl.interpolation.Linear(), delay=0.25)
    np.testing.assert_allclose(jax.vmap(late)(jnp.array([0.0, 0.25, 0.75, 2.25])), [0.0, 0.0, 0.5, 3.0], rtol=1e-15)
    np.testing.assert_allclose(late.times, [0.25, 1.25, 3.25], rtol=1e-15)
