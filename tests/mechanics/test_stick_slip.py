"""Dry friction: exact stopping, exact sticking, gradients of where a motion ends, against closed forms and SciPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxlag as jl
from jaxlag import dissipation

SHARP = {"rtol": 1e-9, "atol": 1e-11}
G = 9.81


def oscillator_energy(q, qdot, c):
    return 0.5 * qdot**2 - 0.5 * c * q**2


def dry(qdot, F):
    return F * jnp.abs(qdot)


oscillator = jl.System(oscillator_energy, dissipation={"dry": dry})


def rest(x0, F, end=20.0):
    return jl.simulate(oscillator, x0, 0.0, jnp.stack([0.0 * end, end]), {"c": 4.0, "F": F}, **SHARP).q[-1]


def exact_rest(x0, F, c=4.0):
    """Each half-swing loses 2F/c, until |x| ≤ F/c."""
    while abs(x0) > F / c:
        x0 = -(x0 - np.sign(x0) * 2 * F / c)
    return x0


@functools.cache
def long_oscillation(x0=1.0, F=0.3):
    ts = np.concatenate([np.linspace(0, 14, 57), [1014.0]])
    return jl.simulate(oscillator, x0, 0.0, ts, {"c": 4.0, "F": F}, works=True, **SHARP)


@pytest.mark.fast
def test_an_oscillator_comes_to_rest_and_stays_there():
    motion = long_oscillation()
    np.testing.assert_allclose(motion.q[-1], 0.05, atol=1e-8)
    assert motion.qdot[-1] == 0
    np.testing.assert_allclose(motion.q[-1], motion.q[-2], atol=1e-15)
    assert motion.stats["transitions"][-1] == 7
    np.testing.assert_allclose(motion.stats["time_stuck"][-1], 1014 - 7 * np.pi / 2, atol=1e-8)  # seven half-swings of π/ω
    card = repr(motion)
    assert "7 transitions, stuck for 1003" in card and "energy balance" in card


def test_half_swings_of_the_oscillator():
    """Between the turns: x = ±F/c + A cos ωt, samples across the kinks included."""
    motion = long_oscillation()
    ts, half, shift = np.asarray(motion.ts[:56]), np.pi / 2, 0.3 / 4
    k = np.floor(ts / half)
    sign = (-1.0) ** k
    amplitude = 1.0 - shift - 2 * shift * k
    moving = k < 7
    expected = sign * (shift + amplitude * np.cos(2 * (ts - k * half)))
    np.testing.assert_allclose(motion.q[:56][moving], expected[moving], atol=1e-7)


def test_the_bound_decides_between_rest_and_motion():
    assert np.all(long_oscillation(0.0749).q == 0.0749)
    moving = long_oscillation(0.0751)
    np.testing.assert_allclose([moving.q[-1], moving.stats["transitions"][-1]], [exact_rest(0.0751, 0.3), 1], atol=1e-9)


two_pucks = jl.System(
    lambda qdot, m: 0.5 * m * qdot @ qdot,
    dissipation=lambda qdot, F, k: F * dissipation.speed(qdot[:2]) + dissipation.drag(qdot[2:], k),
)


@pytest.mark.parametrize(("speed", "k"), [(0.5, 4.0), (5e-3, 1e6), (5e-7, 1e12)])
def test_friction_and_drag_in_a_plane_oppose_slip_however_slow(speed, k):
    along = np.array([0.6, -0.8])
    found = jl.acceleration(two_pucks, jnp.zeros(4), speed * jnp.concatenate([along, along]), {"m": 2.0, "F": 3.0, "k": k})
    np.testing.assert_allclose(found.qddot, np.concatenate([-1.5 * along, -k * speed**2 / 2 * along]), rtol=1e-12)


def test_friction_is_a_result_within_its_bound():
    motion = long_oscillation()
    found = motion.friction["dry"]
    assert np.all(np.abs(found.force) <= 0.3 * (1 + 1e-12))
    np.testing.assert_allclose(found.force[-1], 4 * 0.05, atol=1e-7)  # holds the spring
    slipping = ~np.asarray(found.sticking) & (np.asarray(motion.qdot) != 0)
    np.testing.assert_allclose(found.force[slipping], -0.3 * np.sign(motion.qdot[slipping]), rtol=1e-12)
    assert found.sticking[-1] and not found.sticking[3]
    assert np.max(np.abs(motion.balance())) < 1e-8
    np.testing.assert_allclose(motion.work()["dry"][-1], -(2.0 - 2 * 0.05**2), rtol=1e-7)  # all of the spring's energy but what is held


@pytest.mark.parametrize(
    "derivative", [jax.jacfwd, pytest.param(jax.grad, marks=pytest.mark.slow), pytest.param(jax.jacrev, marks=pytest.mark.slow)]
)
def test_gradient_of_the_point_of_rest(derivative):
    np.testing.assert_allclose(derivative(rest, (0, 1))(1.0, 0.3), (-1.0, 3.5), atol=1e-6)


@pytest.mark.slow
def test_a_thousand_oscillators_at_once():
    rng = np.random.default_rng(0)
    x0, F = rng.uniform(-2, 2, 1000), rng.uniform(0.1, 1.0, 1000)
    exact = np.array([exact_rest(x, f) for x, f in zip(x0, F, strict=True)])
    # the recursion jumps where |x| = F/c: leave out those closer to it than the tolerance
    close = [min(abs(abs(y) - f / 4), abs(abs(exact_rest(x, f)) - f / 4)) < 1e-7 for x, f, y in zip(x0, F, exact, strict=True)]
    found = jax.vmap(lambda x, F: rest(x, F, 80.0))(jnp.asarray(x0), jnp.asarray(F))
    assert np.sum(close) < 5
    np.testing.assert_allclose(np.asarray(found)[~np.array(close)], exact[~np.array(close)], atol=1e-7)


def incline_energy(q, qdot, m, alpha):
    return 0.5 * m * qdot**2 + m * G * jnp.sin(alpha) * q


def floor_friction(qdot, mu, m, alpha):
    return mu * m * G * jnp.cos(alpha) * jnp.abs(qdot)


def plane_energy(q, qdot, m, alpha):
    return 0.5 * m * qdot @ qdot + m * G * (jnp.sin(alpha) * q[0] - jnp.cos(alpha) * q[1])


def floor_friction_of_reaction(qdot, multipliers, mu):
    return mu * jnp.abs(multipliers["plane"]) * jnp.abs(qdot[0])


by_formula = jl.System(incline_energy, dissipation={"floor": floor_friction})
by_multiplier = jl.System(plane_energy, dissipation={"floor": floor_friction_of_reaction}, holonomic={"plane": lambda q: q[1]})


def slide(system, start, alpha, ts, mu=0.4):
    return jl.simulate(system, start, 0 * start, ts, {"m": 2.0, "alpha": alpha, "mu": mu})


@pytest.mark.slow
@pytest.mark.parametrize("system, start", [(by_formula, np.array(0.0)), (by_multiplier, np.zeros(2))], ids=["formula", "multiplier"])
def test_a_block_on_an_incline(system, start):
    stuck = slide(system, start, 0.3, [0, 1.0, 1e4])  # tan 0.3 = 0.31 < 0.4
    along = lambda x: np.asarray(x).reshape(3, -1)[:, 0]
    assert np.max(np.abs(stuck.qdot)) <= 1e-14 and np.max(np.abs(stuck.q)) <= 1e-14
    np.testing.assert_allclose(stuck.friction["floor"].force, -2 * G * np.sin(0.3), rtol=1e-12)
    np.testing.assert_allclose(stuck.stats["time_stuck"][-1], 1e4, rtol=1e-12)
    sliding = slide(system, start, 0.6, [0, 1.0, 2.0])
    a = G * (np.sin(0.6) - 0.4 * np.cos(0.6))
    np.testing.assert_allclose(along(sliding.q), [0, a / 2, 2 * a], rtol=1e-12)
    np.testing.assert_allclose(along(sliding.qddot), a, rtol=1e-12)
    slope = jax.grad(lambda mu: jnp.ravel(slide(system, start, 0.6, [0, 1.0, 2.0], mu).q[-1])[0])(0.4)
    np.testing.assert_allclose(slope, -2 * G * np.cos(0.6), rtol=1e-9)


def test_functions_of_a_state_know_friction():
    """At rest within the bound nothing moves; beyond it breaks away."""
    p = {"c": 4.0, "F": 0.3}
    np.testing.assert_allclose(jl.acceleration(oscillator, 0.05, 0.0, p).qddot, 0.0, atol=1e-15)
    np.testing.assert_allclose(jl.acceleration(oscillator, 1.0, 0.0, p).qddot, -3.7, rtol=1e-14)
    np.testing.assert_allclose(jl.acceleration(oscillator, -1.0, 0.0, p).qddot, 3.7, rtol=1e-14)
    np.testing.assert_allclose(jl.acceleration(oscillator, 1.0, 2.0, p).qddot, -4.3, rtol=1e-14)
    np.testing.assert_allclose(jl.powers(oscillator, 1.0, 2.0, p)["dry"], -0.6, rtol=1e-14)


@pytest.mark.slow
def test_a_bead_on_a_hoop():
    """N = |λ| = m v²/R on a horizontal hoop: v(θ) = v₀ e^{−μθ}."""
    hoop = jl.System(
        lambda qdot: 0.5 * qdot @ qdot,
        dissipation={"rub": lambda qdot, multipliers, mu: mu * jnp.abs(multipliers["hoop"]) * dissipation.speed(qdot)},
        holonomic={"hoop": lambda q, R: jnp.sqrt(q @ q) - R},
    )
    motion = jl.simulate(hoop, [2.0, 0.0], [0.0, 3.0], np.linspace(0, 3, 31), {"R": 2.0, "mu": 0.3}, rtol=1e-10, atol=1e-12)
    angle = np.unwrap(np.arctan2(motion.q[:, 1], motion.q[:, 0]))
    np.testing.assert_allclose(np.hypot(*motion.qdot.T), 3 * np.exp(-0.3 * angle), atol=1e-8)


@pytest.mark.slow
def test_a_particle_leaves_a_rough_sphere():
    """v²' = 2gR(sin θ − μ cos θ) + 2μ v², linear in v²: closed form; it leaves where the multiplier changes sign."""
    mu, v0 = 0.1, 1.0
    ball = jl.System(
        lambda q, qdot: 0.5 * (qdot["r"] ** 2 + q["r"] ** 2 * qdot["th"] ** 2) - G * q["r"] * jnp.cos(q["th"]),
        dissipation={"rub": lambda q, qdot, multipliers, mu: mu * jnp.abs(multipliers["sphere"]) * jnp.abs(q["r"] * qdot["th"])},
        holonomic={"sphere": lambda q: q["r"] - 1.0},
    )
    motion = jl.simulate(ball, {"r": 1.0, "th": 0.0}, {"r": 0.0, "th": v0}, np.linspace(0, 0.45, 46), {"mu": mu}, rtol=1e-10, atol=1e-12)
    th = np.asarray(motion.q["th"])
    a, b = -2 * G * (1 - 2 * mu**2) / (1 + 4 * mu**2), -6 * G * mu / (1 + 4 * mu**2)  # particular solution a cos θ + b sin θ
    on = np.asarray(motion.multipliers["sphere"]) > 0
    v2 = a * np.cos(th) + b * np.sin(th) + (v0**2 - a) * np.exp(2 * mu * th)
    assert on[0] and on.sum() > 20
    np.testing.assert_allclose(motion.qdot["th"][on] ** 2, v2[on], rtol=1e-8)
    np.testing.assert_allclose(motion.multipliers["sphere"][on], (G * np.cos(th) - v2)[on], rtol=1e-7, atol=1e-7)


belt = jl.System(oscillator_energy, dissipation={"belt": lambda qdot, v, vs: dissipation.stribeck(qdot - v, 1.0, 1.5, vs)})


def belt_motion(vs, end=40.0, samples=4001):
    """A block held by a spring on a moving belt, with Stribeck friction."""
    return jl.simulate(belt, 0.0, 0.3, np.linspace(0, end, samples), {"c": 1.0, "v": 0.3, "vs": vs}, **SHARP)


@pytest.mark.slow
def test_stick_slip_on_a_belt():
    """The limit cycle, against SciPy with events: slip from x = F_s/c until the slip velocity is zero again, then ride to F_s/c."""
    vs, v, Fs, Fc = 0.05, 0.3, 1.5, 1.0
    force = lambda s: Fc + (Fs - Fc) * np.exp(-((s / vs) ** 2))
    slip = lambda t, y: [y[1], -y[0] + force(y[1] - v)]
    stops = lambda t, y: y[1] - v if t > 1.0 else -1.0
    stops.terminal, stops.direction = True, 1
    nudge = 1e-7  # a state at rest relative to the belt is where the sign of the slip is decided
    phase = solve_ivp(slip, (0, 50), [Fs, v - nudge], events=stops, method="DOP853", rtol=1e-11, atol=1e-13)
    period = phase.t[-1] + (Fs - phase.y[0, -1]) / v
    motion = belt_motion(vs)
    stuck = np.asarray(motion.friction["belt"].sticking)
    starts = np.flatnonzero(stuck[1:] & ~stuck[:-1]) + 1
    assert len(starts) >= 3 and np.all(np.abs(np.asarray(motion.friction["belt"].force)) <= Fs * (1 + 1e-9))
    # while it rides, x = x₁ + v (t − t₁): the time at which it would have been at F_s/c, a cycle apart
    at = [float(motion.ts[i + 1] + (Fs - motion.q[i + 1]) / v) for i in starts]
    np.testing.assert_allclose(np.diff(at), period, atol=1e-4)


@pytest.mark.slow
def test_stick_slip_with_a_sudden_drop():
    """v_s → 0: static F_s, sliding F_c; T = (2π − 2 atan(Aω/v))/ω + 2A/v with A = (F_s − F_c)/c."""
    motion = belt_motion(1e-4)
    stuck = np.asarray(motion.friction["belt"].sticking)
    starts = np.flatnonzero(stuck[1:] & ~stuck[:-1]) + 1
    at = [float(motion.ts[i + 1] + (1.5 - motion.q[i + 1]) / 0.3) for i in starts]
    A = 0.5
    np.testing.assert_allclose(np.diff(at), 2 * np.pi - 2 * np.arctan(A / 0.3) + 2 * A / 0.3, rtol=2e-3)  # of the order of v_s/v


@pytest.mark.slow
def test_a_puck_stops_in_a_plane():
    """Straight: v₀²/2a; on a conveyor it turns to run along: the slip keeps its direction and shrinks by a t."""
    plane = jl.System(lambda qdot: 0.5 * qdot @ qdot, dissipation={"ice": lambda qdot, F, u: F * jnp.linalg.norm(qdot - u)})
    run = lambda v0, u, F: jl.simulate(plane, np.zeros(2), v0, [0.0, 1.0, 20.0, 40.0], {"F": F, "u": u}, **SHARP)
    straight = run(np.array([3.0, 4.0]), np.zeros(2), 0.5)
    np.testing.assert_allclose(straight.q[2], 25 * np.array([0.6, 0.8]), atol=1e-9)
    assert np.all(straight.qdot[2:] == 0) and straight.stats["transitions"][-1] == 1
    u, v0, F = np.array([1.0, 0.0]), np.array([0.0, 2.0]), 0.5
    slip0 = v0 - u
    stop = np.linalg.norm(slip0) / F
    ridden = run(v0, u, F)
    np.testing.assert_allclose(ridden.q[2], u * 20 + slip0 * stop / 2, atol=1e-9)
    np.testing.assert_allclose(ridden.qdot[2], u, atol=1e-12)
    slope = jax.grad(lambda F: run(np.array([3.0, 4.0]), np.zeros(2), F).q[-1, 0])(0.5)
    np.testing.assert_allclose(slope, -25 * 0.6 / 0.5, rtol=1e-6)


@pytest.mark.slow
def test_two_blocks_on_a_shaken_floor():
    """One rubs on the floor, the other on it: against SciPy with the sign made very steep, and the energy balance of all."""
    blocks = jl.System(
        lambda qdot: qdot["a"] ** 2 + 0.5 * qdot["b"] ** 2,
        dissipation={
            "floor": lambda t, qdot, F1: F1 * jnp.abs(qdot["a"] - jnp.cos(2 * t)),
            "between": lambda qdot, F2: F2 * jnp.abs(qdot["b"] - qdot["a"]),
        },
    )
    ts = np.linspace(0, 10, 101)
    motion = jl.simulate(blocks, {"a": 0.0, "b": 0.0}, {"a": 1.0, "b": 0.0}, ts, {"F1": 3.5, "F2": 1.0}, works=True, **SHARP)
    steep = lambda s: s / np.sqrt(s**2 + 1e-14)

    def rates(t, y):
        floor, between = 3.5 * steep(y[2] - np.cos(2 * t)), 1.0 * steep(y[3] - y[2])
        return [y[2], y[3], (-floor + between) / 2, -between]

    with np.errstate(over="ignore"):  # in trial steps of the implicit method
        reference = solve_ivp(rates, (0, 10), [0, 0, 1, 0], method="Radau", t_eval=ts, rtol=1e-10, atol=1e-12).y
    np.testing.assert_allclose(motion.q["a"], reference[0], atol=1e-5)  # it creeps: the difference is proportional to the width 1e-7
    np.testing.assert_allclose(motion.q["b"], reference[1], atol=1e-5)  # it creeps: the difference is proportional to the width 1e-7
    assert motion.stats["transitions"][-1] >= 8
    assert np.max(np.abs(motion.balance())) < 1e-7
    for name, bound in (("floor", 3.5), ("between", 1.0)):
        assert np.all(np.abs(motion.friction[name].force) <= bound * (1 + 1e-9))


def chain_energy(q, qdot, c):
    return 0.5 * qdot @ qdot - 0.5 * c * jnp.sum(jnp.diff(q) ** 2) - 0.5 * c * q[0] ** 2


chain = jl.System(chain_energy, dissipation={"floor": lambda qdot, F: F * jnp.sum(jnp.abs(qdot))})


@pytest.mark.slow
def test_a_chain_of_twenty_rubbing_blocks_runs_to_rest():
    start = np.zeros(20), np.r_[np.zeros(19), 3.0]
    motion = jl.simulate(chain, *start, np.linspace(0, 60, 61), {"c": 10.0, "F": 0.2}, works=True)
    assert np.all(motion.qdot[-1] == 0) and np.all(motion.friction["floor"].sticking[-1])
    assert np.max(np.abs(motion.balance())) <= 1e-6
    assert np.all(np.abs(motion.friction["floor"].force) <= 0.2 * (1 + 1e-9))
    springs = np.asarray(jax.grad(lambda q: -chain_energy(q, np.zeros(20), 10.0))(motion.q[-1]))
    np.testing.assert_allclose(motion.friction["floor"].force[-1], springs, atol=1e-10)


@pytest.mark.slow
def test_several_elements_stop_at_the_same_time():
    """Two equal oscillators side by side: their events coincide, and each ends where it ends alone."""
    pair = jl.System(
        lambda q, qdot, c: 0.5 * qdot @ qdot - 0.5 * c * q @ q, dissipation={"dry": lambda qdot, F: jnp.sum(F * jnp.abs(qdot))}
    )
    motion = jl.simulate(pair, [1.0, -1.0], [0.0, 0.0], [0.0, 20.0], {"c": 4.0, "F": 0.3}, **SHARP)
    np.testing.assert_allclose(motion.q[-1], [0.05, -0.05], atol=1e-8)
    assert np.all(motion.qdot[-1] == 0)


@pytest.mark.slow
def test_every_way_to_write_it_is_found():
    ts, p = [0.0, 20.0], {"c": 4.0, "F": 0.3}
    ends = [
        jl.simulate(jl.System(oscillator_energy, dissipation=D), 1.0, 0.0, ts, p, **SHARP).q[-1]
        for D in (
            lambda qdot, F: dissipation.sliding(qdot, 0.1, 3.0) + 0 * F,
            {"half": lambda qdot, F: F * jnp.abs(qdot) / 2, "other half": lambda qdot, F: F / 2 * jnp.sqrt(qdot**2)},
        )
    ]
    np.testing.assert_allclose(ends, 0.05, atol=1e-8)


def test_smooth_terms_stay_smooth():
    cubic = jl.System(
        oscillator_energy, dissipation={"air": lambda qdot, F: F * jnp.abs(qdot) ** 3, "oil": lambda qdot: dissipation.drag(qdot, 0.1)}
    )
    motion = jl.simulate(cubic, 1.0, 0.0, [0.0, 1.0], {"c": 4.0, "F": 0.3})
    assert motion.friction == {} and "transitions" not in motion.stats


@pytest.mark.slow
def test_regularised_friction_creeps_as_its_docstring_says():
    w, alpha = 1e-3, 0.3
    motion = jl.simulate(by_formula, 0.0, 0.0, [0.0, 5.0, 10.0], {"m": 2.0, "alpha": alpha, "mu": 0.4}, friction=jl.Regularised(w))
    f, F = np.sin(alpha), 0.4 * np.cos(alpha)
    np.testing.assert_allclose(motion.qdot[1:], w * f / np.sqrt(F**2 - f**2), rtol=1e-5)
    assert motion.friction == {} and "regularised below a slip velocity of 0.001, where it creeps" in repr(motion)
    end = lambda w: jl.simulate(oscillator, 1.0, 0.0, [0.0, 8.0], {"c": 4.0, "F": 0.3}, friction=jl.Regularised(w)).q[-1]
    sharp = jl.simulate(oscillator, 1.0, 0.0, [0.0, 8.0], {"c": 4.0, "F": 0.3}).q[-1]
    assert abs(end(1e-4) - sharp) < 0.2 * abs(end(1e-2) - sharp)


@pytest.mark.slow
def test_clear_errors():
    ts = [0.0, 20.0]
    with pytest.raises(ValueError, match="must have friction bounds that are not negative, but one is"):
        jl.simulate(oscillator, 1.0, 0.0, ts, {"c": 4.0, "F": -0.3})
    with pytest.raises(RuntimeError, match="changed between sliding and sticking more than `max_transitions` times: it chatters"):
        jl.simulate(oscillator, 1.0, 0.0, ts, {"c": 4.0, "F": 0.3}, friction=jl.StickSlip(max_transitions=3))
    bent = jl.System(oscillator_energy, dissipation={"odd": lambda q, qdot, F: F * jnp.abs(qdot**2 - 0.1 * q)})
    with pytest.raises(ValueError, match="`dissipation` 'odd' must be nonsmooth only in slip velocities that are affine in qdot"):
        jl.simulate(bent, 1.0, 0.5, ts, {"c": 4.0, "F": 0.3})


@pytest.mark.slow
def test_painleve_has_a_name():
    """A rod pushed over a rough floor: for tan φ = 2 there is no solution beyond μ = 4/3."""
    tip = lambda q: q["y"] - jnp.sin(q["phi"])
    tip_slip = lambda q, qdot: qdot["x"] + jnp.sin(q["phi"]) * qdot["phi"]
    rod = jl.System(
        lambda q, qdot: 0.5 * (qdot["x"] ** 2 + qdot["y"] ** 2 + qdot["phi"] ** 2 / 3) - G * q["y"],
        dissipation={"floor": lambda q, qdot, multipliers, mu: mu * jnp.abs(multipliers["contact"]) * jnp.abs(tip_slip(q, qdot))},
        holonomic={"contact": tip},
    )
    phi = np.arctan(2.0)
    q0 = {"x": 0.0, "y": np.sin(phi), "phi": phi}
    run = lambda mu, vx: jl.simulate(rod, q0, {"x": vx, "y": 0.0, "phi": 0.0}, [0.0, 0.01], {"mu": mu})
    assert run(0.5, -1.0).succeeded and run(0.5, 1.0).succeeded
    failures = 0
    for vx in (-1.0, 1.0):
        try:
            run(2.0, vx)
        except RuntimeError as error:
            failures += 1
            assert "Painlevé" in str(error)
    assert failures == 1  # pushed one way it jams; pulled the other it slides


@pytest.mark.slow
def test_second_derivatives_of_a_stopping_point():
    """A block that slides to a stop: x = v₀²/2F, all second derivatives in closed form."""
    block = jl.System(lambda qdot: 0.5 * qdot**2, dissipation=dry)
    stop = lambda v0, F: jl.simulate(block, 0.0, v0, [0.0, 10.0], {"F": F}, **SHARP).q[-1]
    exact = lambda v0, F: v0**2 / (2 * F)
    np.testing.assert_allclose(jax.hessian(stop, (0, 1))(2.0, 0.7), jax.hessian(exact, (0, 1))(2.0, 0.7), rtol=1e-6)


@pytest.mark.slow
def test_the_capstan():
    """A rope over a rough drum, half a turn: it slides steadily where one end pulls e^{μπ} times as hard as the other.

    Of N nodes, each turns the rope by δ = π/N and takes (cos δ/2 + μ sin δ/2) / (cos δ/2 − μ sin δ/2) of the pull, which tends to e^{μδ}.
    """
    N, mu, m2 = 6, 0.35, 1.3
    angles = np.pi * (np.arange(N) + 0.5) / N
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    nodes = np.concatenate([ring[:1] - [[0, 2.0]], ring, ring[-1:] - [[0, 2.0]]])
    along = np.stack([np.sin(angles), -np.cos(angles)], axis=1)  # the rope runs to the heavy end, at angle 0

    def drum(q):
        return jnp.sqrt(jnp.sum(q[1:-1] ** 2, axis=1)) - 1

    def rope(q):
        return jnp.sqrt(jnp.sum((q[1:] - q[:-1]) ** 2, axis=1)) - np.sqrt(np.sum((nodes[1:] - nodes[:-1]) ** 2, axis=1))

    def rubbing(q, qdot, multipliers, mu):
        across = jnp.stack([q[1:-1, 1], -q[1:-1, 0]], axis=1)
        return mu * jnp.sum(jnp.abs(multipliers["drum"]) * jnp.abs(jnp.sum(across * qdot[1:-1], axis=1)))

    system = jl.System(
        lambda q, qdot, m: jnp.sum(m[:, None] * (0.5 * qdot**2 - G * q * jnp.array([[0.0, 1.0]]))),
        dissipation={"drum friction": rubbing},
        holonomic={"drum": drum, "rope": rope},
    )
    pulls = lambda N: ((1 + mu * np.tan(np.pi / N / 2)) / (1 - mu * np.tan(np.pi / N / 2))) ** N
    np.testing.assert_allclose(pulls(10_000), np.exp(mu * np.pi), rtol=1e-7)
    half, ratio = np.pi / N / 2, pulls(N)
    crawl = 1e-8 * np.concatenate([[[0, -np.cos(half)]], along, [[0, np.cos(half)]]])
    run = lambda m1: jl.acceleration(system, nodes, crawl, {"m": np.r_[m1, np.full(N, 1e-9), m2], "mu": mu})
    steady = run(m2 * ratio)
    np.testing.assert_allclose(steady.qddot[:, 1], 0, atol=1e-6)
    np.testing.assert_allclose(np.asarray(steady.multipliers["rope"])[[0, -1]], [-m2 * ratio * G, -m2 * G], rtol=1e-6)
    assert run(1.1 * m2 * ratio).qddot[0, 1] < -0.1  # heavier, it runs down


@pytest.mark.slow
def test_friction_beside_a_constraint_of_constant_rows():
    """Up and down a slope x = y of constant rows, whose factors are plain numbers: closed form."""
    slope = jl.System(
        lambda q, qdot: 0.5 * qdot @ qdot - q[1], dissipation=lambda qdot: 0.1 * jnp.abs(qdot[0]), holonomic=lambda q: q[1] - q[0]
    )
    motion = jl.simulate(slope, np.zeros(2), np.ones(2), np.linspace(0.0, 3.0, 31))
    top, turn = 1 / 1.1, 1 / 0.55
    np.testing.assert_allclose(motion.q[-1], np.full(2, top - 0.5 * 0.45 * (3 - turn) ** 2), rtol=1e-9)


def test_more_elements_than_modes_can_be_numbered():
    """Eighty blocks, each under a force of its own: those beyond their bound slide."""
    blocks = jl.System(lambda qdot: 0.5 * qdot @ qdot, dissipation=lambda qdot, F: F * jnp.sum(jnp.abs(qdot)), force=lambda u: u)
    u = np.linspace(-3, 3, 80)
    found = jl.acceleration(blocks, np.zeros(80), np.zeros(80), {"F": 1.5, "u": u}).qddot
    np.testing.assert_allclose(found, np.sign(u) * np.maximum(np.abs(u) - 1.5, 0), atol=1e-14)
