"""Measured inputs at machine speed: steps from sample to sample, against NumPy's exact solutions."""

import itertools

import diffrax
import jax
import jax.numpy as jnp
import make_linear_drive
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._program import whole_kernel

M, B, F = 2.0, 3.0, 3.2
PARAMS = {"m": M, "b": B}
CART = jl.System(
    lambda qdot, m: 0.5 * m * qdot**2, dissipation={"oil": lambda qdot, b: 0.5 * b * qdot**2}, force={"motor": lambda t, u: u(t)}
)
DRY = jl.System(
    lambda qdot, m: 0.5 * m * qdot**2,
    dissipation={"oil": lambda qdot, b: 0.5 * b * qdot**2, "rail": lambda qdot, F: F * jnp.abs(qdot)},
    force={"motor": lambda t, u: u(t)},
)
rng = np.random.default_rng(7)
TIMES = np.cumsum(rng.uniform(1e-3, 8e-3, 400)) - 2e-3
VALUES = 3 * np.sign(np.sin(4 * TIMES)) + rng.normal(size=TIMES.size)
HELD = jl.Signal(TIMES, VALUES)


def held(t, delay=0.0):
    return VALUES[np.clip(np.searchsorted(TIMES + delay, t, side="right") - 1, 0, None)]


def moved(q, v, u, h):
    """The cart after a time h under a constant force."""
    final, decay = u / B, np.exp(-B / M * h)
    return q + final * h + (v - final) * M / B * (1 - decay), final + (v - final) * decay


def exactly(ts, delay=0.0, q=0.0, v=0.0):
    """Position and velocity at the times ts, from one jump to the next."""
    found = [(q, v)]
    for start, end in itertools.pairwise(ts):
        times = TIMES + delay
        nodes = [start, *times[(times > start) & (times < end)], end]
        for a, b in itertools.pairwise(nodes):
            q, v = moved(q, v, held((a + b) / 2, delay), b - a)
        found.append((q, v))
    return np.array(found)


def dry(ts):
    """The same with dry friction, which may bring it to rest within an interval, or let it go at the start of one."""
    q, v, found, times = 0.0, 0.0, [(0.0, 0.0)], TIMES
    for start, end in itertools.pairwise(ts):
        nodes = [start, *times[(times > start) & (times < end)], end]
        for a, b in itertools.pairwise(nodes):
            q, v = make_linear_drive.held(q, v, held((a + b) / 2), b - a, M, B, F, 0.0)
        found.append((q, v))
    return np.array(found)


def simulated(system, ts, params, **options):
    motion = jl.simulate(system, 0.0, 0.0, ts, params, **options)
    return np.stack([motion.q, motion.qdot], axis=1), motion


SAMPLES = {"coarse": np.linspace(0, 1.6, 12), "fine": np.linspace(0, 1.6, 1500), "at the jumps": TIMES[1:300]}


@pytest.mark.slow
@pytest.mark.parametrize("ts", SAMPLES.values(), ids=SAMPLES)
def test_a_held_force_against_the_exact_motion(ts):
    found, motion = simulated(CART, ts, PARAMS | {"u": HELD})
    np.testing.assert_allclose(found, exactly(ts), atol=1e-12)
    np.testing.assert_allclose(motion.qddot, (held(ts) - B * found[:, 1]) / M, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [jl.Dopri5(), None], ids=["Dopri5", "Dop853"])
def test_dry_friction_under_a_held_force_against_the_exact_motion(solver):
    ts = SAMPLES["coarse"]
    found, motion = simulated(DRY, ts, PARAMS | {"u": HELD, "F": F}, solver=solver)
    expected = dry(ts)
    np.testing.assert_allclose(found, expected, atol=1e-10)
    assert motion.stats["transitions"][-1] > 10


@pytest.mark.slow
def test_a_linear_force_against_the_exact_motion():
    """Without damping q̇ is the sum of the trapezia."""
    ts = SAMPLES["at the jumps"]
    signal = jl.Signal(TIMES, VALUES, jl.interpolation.Linear())
    motion = jl.simulate(CART, 0.0, 0.0, ts, {"m": M, "b": 0.0, "u": signal})
    rises = np.diff(ts) * (VALUES[1:299] + VALUES[2:300]) / 2
    np.testing.assert_allclose(motion.qdot, np.concatenate([[0], np.cumsum(rises)]) / M, atol=1e-12)


def end(params, **options):
    return jl.simulate(CART, 0.1, 0.0, SAMPLES["coarse"], params, **options).q[-1]


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_derivatives_in_parameters(derivative):
    found = derivative(lambda b: end({"m": M, "b": b, "u": HELD}))(B)
    h = 1e-5
    other = [end({"m": M, "b": B + k * h, "u": HELD}) for k in (1, -1)]
    np.testing.assert_allclose(found, (other[0] - other[1]) / (2 * h), rtol=1e-6)
    second = jax.hessian(lambda b: end({"m": M, "b": b, "u": HELD}))(B)
    np.testing.assert_allclose(second, (other[0] - 2 * end(PARAMS | {"u": HELD}) + other[1]) / h**2, rtol=1e-3)


@pytest.mark.slow
def test_the_gradient_in_all_values_of_the_signal():
    """More of them than a forward pass takes; the motion is linear in each."""
    gradient = jax.grad(lambda values: end(PARAMS | {"u": jl.Signal(TIMES, values)}))(jnp.asarray(VALUES))
    np.testing.assert_allclose(gradient @ VALUES, end(PARAMS | {"u": HELD}) - end(PARAMS | {"u": jl.Signal(TIMES, 0 * VALUES)}), rtol=1e-9)
    bump = np.zeros(TIMES.size)
    bump[150] = 1.0
    np.testing.assert_allclose(gradient[150], end(PARAMS | {"u": jl.Signal(TIMES, VALUES + bump)}) - end(PARAMS | {"u": HELD}), rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_a_delay_and_its_derivative(derivative):
    """Of a zero-order hold, whose jumps move along with it."""
    ts, delay = SAMPLES["coarse"], 0.0137
    late = lambda delay: jl.simulate(CART, 0.0, 0.0, ts, PARAMS | {"u": jl.Signal(TIMES, VALUES, delay=delay)}).q[-1]
    np.testing.assert_allclose(late(delay), exactly(ts, delay)[-1, 0], atol=1e-12)
    h = 1e-7
    expected = (exactly(ts, delay + h)[-1, 0] - exactly(ts, delay - h)[-1, 0]) / (2 * h)
    np.testing.assert_allclose(derivative(late)(delay), expected, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, diffrax.Tsit5()], ids=["Dop853", "Tsit5"])
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_a_delay_where_every_sample_is_at_a_jump(derivative, solver):
    """The motion is smooth there, though the order of sample and jump changes: the position has a derivative on both sides."""
    ts = np.concatenate([[(TIMES[1] + TIMES[2]) / 2], TIMES[2:300]])
    late = lambda delay: jl.simulate(CART, 0.0, 0.0, ts, PARAMS | {"u": jl.Signal(TIMES, VALUES, delay=delay)}, solver=solver).q[-60:]
    h = 1e-7
    expected = (exactly(ts, h)[-60:, 0] - exactly(ts, -h)[-60:, 0]) / (2 * h)
    np.testing.assert_allclose(derivative(late)(0.0), expected, rtol=2e-5)


@pytest.mark.slow
def test_a_delay_and_the_start_among_more_inputs_than_a_forward_pass_takes():
    """In reverse through the loop: by the time of the start and the delay, with all values of the signal."""
    ts = jnp.asarray(SAMPLES["coarse"])

    def moved(start, delay, values):
        signal = jl.Signal(TIMES, values, delay=delay)
        return jl.simulate(CART, 0.0, 0.0, ts.at[0].add(start), PARAMS | {"u": signal}).q[-1]

    slopes = jax.grad(moved, argnums=(0, 1, 2))(0.0, 0.0137, jnp.asarray(VALUES))
    h = 1e-7
    later = [exactly([k * h, *ts[1:]], 0.0137)[-1, 0] for k in (1, -1)]
    delayed = [exactly(ts, 0.0137 + k * h)[-1, 0] for k in (1, -1)]
    np.testing.assert_allclose(slopes[:2], [(pair[0] - pair[1]) / (2 * h) for pair in (later, delayed)], rtol=1e-5)
    assert slopes[2].shape == VALUES.shape


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_the_derivative_by_the_times_of_jumps(derivative):
    """q(1) = Σ (uᵢ − uᵢ₋₁) (1 − tᵢ)²/2."""
    times, values = jnp.array([0.0, 0.31, 0.7]), np.array([1.0, -2.0, 3.0])
    cart = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda t, u: u(t))
    found = derivative(lambda times: jl.simulate(cart, 0.0, 0.0, [0.0, 1.0], {"u": jl.Signal(times, values)}).q[-1])(times)
    np.testing.assert_allclose(found, [0.0, 3 * 0.69, -5 * 0.3], atol=1e-12)


@pytest.mark.slow
def test_a_force_that_asks_for_another_time():
    """A signal that a function delays by itself is looked up, and right."""
    system = jl.System(lambda qdot, m: 0.5 * m * qdot**2, force=lambda t, u, late: u(t - late))
    ts, signal = SAMPLES["coarse"], jl.Signal(TIMES, VALUES, jl.interpolation.Linear())
    by_hand = jl.simulate(system, 0.0, 0.0, ts, {"m": M, "u": signal, "late": 0.01}, rtol=1e-11, atol=1e-13).q
    delayed = jl.simulate(CART, 0.0, 0.0, ts, {"m": M, "b": 0.0, "u": jl.Signal(TIMES, VALUES, jl.interpolation.Linear(), delay=0.01)}).q
    np.testing.assert_allclose(by_hand, delayed, atol=1e-9)
    with pytest.warns(UserWarning, match=r"Signal\(\.\.\., delay="):
        jl.simulate(system, 0.0, 0.0, ts, {"m": M, "u": HELD, "late": 0.01})


@pytest.mark.slow
def test_two_signals_at_times_of_their_own_before_and_behind_their_samples():
    system = jl.System(lambda qdot: 0.5 * qdot**2, force={"a": lambda t, a: a(t), "b": lambda t, b: b(t)})
    a, b = jl.Signal([0.5, 1.0], [1.0, 2.0]), jl.Signal([0.2, 0.7, 0.9], [0.0, -1.0, 3.0], jl.interpolation.Linear())
    motion = jl.simulate(system, 0.0, 0.0, [0.0, 0.4, 1.0, 2.0], {"a": a, "b": b})
    of_a, of_b = [0.0, 0.4, 1.0, 3.0], [0.0, -0.04, 0.25, 3.25]  # trapezia: −0.25 from 0.2 to 0.7, 0.2 to 0.9, 0.3 to 1
    np.testing.assert_allclose(motion.qdot, np.add(of_a, of_b), atol=1e-12)


@pytest.mark.slow
def test_within_jit_and_in_batches_the_motion_is_the_same():
    expected = end(PARAMS | {"u": HELD})
    every = jax.jit(lambda: end(PARAMS | {"u": HELD}))  # all of it constant
    np.testing.assert_allclose(every(), expected, rtol=1e-13)
    bs = jnp.array([1.0, B, 5.0])
    each = jax.vmap(lambda b: jax.value_and_grad(lambda b: end({"m": M, "b": b, "u": HELD}))(b))
    values, slopes = jax.jit(each)(bs)
    for b, value, slope in zip(bs, values, slopes, strict=True):
        one = jax.value_and_grad(lambda b: end({"m": M, "b": b, "u": HELD}))(b)
        np.testing.assert_allclose((value, slope), one, rtol=1e-10)
    many = jl.simulate_many(CART, 0.1, 0.0, SAMPLES["coarse"], {"m": M, "b": bs, "u": HELD}, over=("b",))
    np.testing.assert_allclose(many.q[:, -1], values, rtol=1e-10)


@pytest.mark.slow
def test_what_is_not_asked_for_does_not_matter():
    """Parts of the result that nobody uses, and a signal that no function names."""
    ts, idle = SAMPLES["coarse"], jl.System(lambda qdot, m: 0.5 * m * qdot**2)
    params = PARAMS | {"u": HELD}
    steps = jax.jit(lambda: jl.simulate(CART, 0.1, 0.0, ts, params).stats["num_steps"])()
    assert steps == jl.simulate(CART, 0.1, 0.0, ts, params).stats["num_steps"]
    value = jax.jit(lambda q0: jax.value_and_grad(lambda q0: jl.simulate(idle, q0, 0.5, ts, params).q[-1])(q0)[0])(0.1)
    np.testing.assert_allclose(value, 0.1 + 0.5 * 1.6, rtol=1e-13)


@pytest.mark.slow
def test_a_held_speed_of_a_belt_takes_the_mass_along():
    """A nonholonomic constraint that jumps is an impulse, which does work."""
    belt = jl.System(lambda qdot, m: 0.5 * m * qdot**2, nonholonomic={"belt": lambda t, qdot, u: qdot - u(t)})
    speed = jl.Signal([0.0, 0.5, 1.0], [1.0, -2.0, 3.0])
    motion = jl.simulate(belt, 0.0, 1.0, [0.0, 0.25, 0.75, 1.5], {"m": M, "u": speed}, works=True)
    np.testing.assert_allclose(motion.q, [0.0, 0.25, 0.0, -0.5 + 1.5], atol=1e-12)
    np.testing.assert_allclose(motion.qdot, [1.0, 1.0, -2.0, 3.0], atol=1e-12)
    total = sum(work[-1] for work in motion.works.values())
    np.testing.assert_allclose(total, 0.5 * M * (9 - 1), rtol=1e-12)


@pytest.mark.slow
def test_a_grip_on_a_ramp_that_stops():
    """x follows u(t), a ramp that ends: its velocity jumps, by an impulse of the grip; y hangs on a spring beside."""
    system = jl.System(
        lambda q, qdot, c: 0.5 * qdot["x"] ** 2 + 0.5 * qdot["y"] ** 2 - 0.5 * c * (q["x"] - q["y"]) ** 2,
        holonomic={"grip": lambda q, t, u: q["x"] - u(t)},
    )
    ts = np.linspace(0, 5, 51)
    at_rest = {"x": 0.0, "y": 0.0}

    def run(c, delay):
        u = jl.Signal(np.array([-0.5, 0.0, 0.2, 10.0]), np.array([0.0, 0.0, 1.0, 1.0]), jl.interpolation.Linear(), delay=delay)
        return jl.simulate(system, at_rest, at_rest, ts, {"c": c, "u": u}, rtol=1e-10, atol=1e-12)

    def exact(c, delay):
        w = np.sqrt(c)
        ramp = lambda t: 5 * np.where(t > 0, t - np.sin(w * t) / w, 0)
        y = ramp(ts - delay) - ramp(ts - delay - 0.2)
        x = np.interp(ts, [delay, delay + 0.2], [0, 1])
        return y, c * (x - y)

    motion = run(2.0, 0.15)
    y, force = exact(2.0, 0.15)
    np.testing.assert_allclose(motion.q["y"], y, rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.multipliers["grip"], force, rtol=0, atol=1e-8)
    np.testing.assert_allclose(motion.qdot["x"][4:], 0, atol=1e-12)
    slopes = jax.jacfwd(lambda c, delay: run(c, delay).q["y"], (0, 1))(2.0, 0.15)
    h = 1e-5
    np.testing.assert_allclose(slopes[0], (exact(2.0 + h, 0.15)[0] - exact(2.0 - h, 0.15)[0]) / (2 * h), atol=1e-7)
    np.testing.assert_allclose(slopes[1], (exact(2.0, 0.15 + h)[0] - exact(2.0, 0.15 - h)[0]) / (2 * h), atol=1e-7)
    back = jax.grad(lambda c: run(c, 0.15).q["y"][-1])(2.0)
    np.testing.assert_allclose(back, slopes[0][-1], rtol=1e-8)
    different = {"c": np.array([2.0, 3.0]), "u": jl.Signal([0.0, 0.2, 10.0], [0.0, 1.0, 1.0], jl.interpolation.Linear())}
    many = jl.simulate_many(system, at_rest, at_rest, ts, different, over=("c",), rtol=1e-10, atol=1e-12)
    for of, c in zip(many.q["y"], (2.0, 3.0), strict=True):
        np.testing.assert_allclose(of, exact(c, 0.0)[0], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_single_precision():
    with jax.enable_x64(False):
        found = jl.simulate(CART, np.float32(0), np.float32(0), SAMPLES["coarse"], PARAMS | {"u": jl.Signal(TIMES, VALUES)}).q
        dry_found = jl.simulate(DRY, np.float32(0), np.float32(0), SAMPLES["coarse"], PARAMS | {"u": jl.Signal(TIMES, VALUES), "F": F}).q
        assert found.dtype == dry_found.dtype == jnp.float32
    np.testing.assert_allclose(found, exactly(SAMPLES["coarse"])[:, 0], atol=2e-4)
    np.testing.assert_allclose(dry_found, dry(SAMPLES["coarse"])[:, 0], atol=2e-4)


@pytest.mark.slow
def test_other_entries_of_params_stay_what_they_are():
    """Integers, truth values, text and a cubic signal beside the held one."""
    system = jl.System(lambda qdot, n: 0.5 * n * qdot**2, force=lambda t, u, w, on, name: u(t) + w(t) * on if name == "both" else u(t))
    w = jl.Signal(np.linspace(0, 2, 9), np.ones(9), jl.interpolation.Cubic())
    params = {"n": np.array(2), "on": np.array(True), "name": "both", "w": w, "u": HELD}
    slope = lambda c: jl.simulate(system, 0.0, 0.0, SAMPLES["coarse"], params | {"c": c}).qdot[-1]
    alone = jl.simulate(CART, 0.0, 0.0, SAMPLES["coarse"], {"m": M, "b": 0.0, "u": HELD}).qdot[-1]
    np.testing.assert_allclose(slope(1.0), alone + 1.6 / M, rtol=1e-10)
    assert jax.grad(slope)(1.0) == 0


@pytest.mark.slow
def test_a_failure_has_its_reason():
    motion = jl.simulate(CART, 0.0, 0.0, SAMPLES["coarse"], PARAMS | {"u": HELD}, max_steps=50, throw=False)
    assert motion.result == jl.results.RESULTS.max_steps_reached
    assert np.isfinite(motion.q[0]) and np.isnan(motion.q[-1])
    fading = jl.System(lambda qdot, m: 0.5 * m * qdot**2, force=lambda t, u: u(t) / jnp.maximum(0.8 - t, 0.0))
    assert jl.simulate(fading, 0.0, 0.0, SAMPLES["coarse"], {"m": M, "u": HELD}, throw=False).result != jl.results.RESULTS.successful


@pytest.mark.slow
@pytest.mark.parametrize("system", [CART, DRY], ids=["smooth", "dry"])
def test_the_loop_is_one_kernel(monkeypatch, system):
    allowed = []
    check = whole_kernel._is_allowed
    monkeypatch.setattr(whole_kernel, "_is_allowed", lambda program: allowed.append(check(program)) or allowed[-1])
    jax.clear_caches()
    params = PARAMS | {"u": HELD, "F": F}
    jax.jit(jax.grad(lambda b: jl.simulate(system, 0.0, 0.0, SAMPLES["coarse"], params | {"b": b}).q[-1])).lower(B)
    jax.jit(lambda b: jl.simulate(system, 0.0, 0.0, SAMPLES["coarse"], params | {"b": b}).q[-1]).lower(B)
    assert len(allowed) == 2 and all(allowed)
