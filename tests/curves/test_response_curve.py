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
    assert [len(curve.at(w)) for w in (0.3, 0.5, 2.5, 3.0)] == [1, 1, 1, 0]
    i = 100
    at = curve.orbit(i)
    np.testing.assert_allclose([at.q, at.period], [curve.q[i], 2 * np.pi / curve.values[i]])
    with pytest.raises(IndexError, match="`orbit"):
        curve.orbit(len(curve))
    with pytest.raises(ValueError, match="`branch.* but that is a fold"):
        curve.branch(0)


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_den_hartog():
    """The published digit: F = 0.3 of the drive, ω = 1.3: X = 1.315348196714902; and along the curve."""
    start = jl.periodic(dry, -1.2, 0.65, {"w": 1.3, "F": 0.3}, section=once)
    curve = jl.response_curve(start, over="w", values=(1.1, 1.9))
    np.testing.assert_allclose(hartog(1.3, 0.3), 1.315348196714902, rtol=1e-14)
    np.testing.assert_allclose(curve.amplitude["q"], hartog(np.asarray(curve.values), 0.3), rtol=1e-7)
    assert bool(jnp.all(curve.is_stable)) and curve.special == ()


def rubbing(w, F, guess):
    """(X, time of slipping) of a motion with one stop in each half period, from the equations of its sliding part."""

    def left(x):
        X, t1, t2 = x  # sticks at −X until cos ω t1 + X = F, slides up until t2, sticks at X; every half period
        P = 1 / (1 - w**2)
        steady = lambda t: P * np.cos(w * t) - F
        rate = lambda t: -w * P * np.sin(w * t)
        a, b = -X - steady(t1), -rate(t1)
        q = steady(t2) + a * np.cos(t2 - t1) + b * np.sin(t2 - t1)
        v = rate(t2) - a * np.sin(t2 - t1) + b * np.cos(t2 - t1)
        return [np.cos(w * t1) + X - F, q - X, v]

    x, _, found, _ = fsolve(left, guess, full_output=True, xtol=1e-13)
    assert found == 1
    return x


@pytest.mark.slow
def test_stops_of_dry_friction():
    """F = 0.8 of the drive: below ω = 0.7688 there is a stop in each half period. The amplitude with stops, and where they end: where the
    block slips on as soon as it has stopped.

    Source: Den Hartog (1931), his motions with one stop, whose equations are solved here by SciPy.
    """
    F = 0.8
    start = jl.periodic(dry, 0.9, 0.6, {"w": 0.55, "F": F}, section=once)
    curve = jl.response_curve(start, over="w", values=(0.4, 0.85))
    assert [point.kind for point in curve.special] == ["sticking"]
    w, amplitude = np.asarray(curve.values), np.asarray(curve.amplitude["q"])
    place = int(np.argmin(np.abs(w - 0.55)))
    guess, known = np.array([amplitude[place], -2.0, 3.5]), {}
    candidates = [[amplitude[place], t1, t2] for t1 in np.linspace(-6, 0, 13) for t2 in np.linspace(1, 8, 15)]
    for guess in candidates:
        try:
            x = rubbing(w[place], F, guess)
        except AssertionError:
            continue
        if abs(x[0] - amplitude[place]) < 1e-5 and 0 < x[2] - x[1] < np.pi / w[place]:
            known[place] = x
            break
    limit = float(curve.special[0].value)
    for i in [*range(place + 1, len(w)), *range(place - 1, -1, -1)]:
        if w[i] < limit - 1e-6:
            known[i] = rubbing(w[i], F, known[i - 1] if i > place else known[i + 1])
            np.testing.assert_allclose(amplitude[i], known[i][0], rtol=1e-7)
        elif w[i] > limit + 1e-6:
            np.testing.assert_allclose(amplitude[i], hartog(w[i], F), rtol=1e-7)
    assert len(known) > 10
    last = known[max(known)]
    together = lambda w: (lambda x: x[1] + np.pi / w - x[2])(rubbing(w, F, last))  # how long it sticks
    np.testing.assert_allclose(limit, brentq(together, limit - 0.02, limit + 0.002, xtol=1e-13), rtol=1e-7)


knocking = jl.System(
    lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2,
    dissipation=lambda qdot, d: 0.5 * d * qdot**2,
    force=lambda t, w: jnp.cos(w * t),
    unilateral={"stop": jl.Contact(lambda q, s: s - q, restitution=0.8)},
)


def bounce(w, guess, s=0.0, d=0.1, e=0.8, sign=-1.0):
    """ω at which the motion that hits once in a period has a multiplier `sign`, and the instant and speed of its impact.

    Source: Shaw & Holmes, Journal of Sound and Vibration 90 (1983) 129-155: the motion between impacts in closed form, and the derivative
    of the map of impacts.
    """
    damped = np.sqrt(1 - d**2 / 4)

    def flight(w, start, v, t):
        A = 1 / (1 - w**2 + 1j * d * w)
        steady = lambda t: np.array([(A * np.exp(1j * w * t)).real, (1j * w * A * np.exp(1j * w * t)).real])
        a = np.array([s, v]) - steady(start)
        h = t - start
        c, n, fade = np.cos(damped * h), np.sin(damped * h) / damped, np.exp(-d * h / 2)
        M = fade * np.array([[c + d / 2 * n, n], [-n, c - d / 2 * n]])
        return steady(t) + M @ a, M

    def hits(w, tau, v):
        """The state just before the next impact, and the derivative of (instant, speed) there by those of this one."""
        T = 2 * np.pi / w
        after, M = flight(w, tau, -e * v, tau + T)
        bend = lambda t, u: np.cos(w * t) - d * u - s
        # δ(q, q̇) just after the impact by (δτ, δv), at fixed time; then flight; then the next instant
        start = np.array([[e * v, 0.0], [-bend(tau, -e * v), -e]])
        end = M @ start
        u = after[1]
        dt = -end[0] / u
        return after, np.array([dt, end[1] + bend(tau + T, u) * dt])

    def left(x):
        w, tau, v = x
        after, J = hits(w, tau, v)
        return [after[0] - s, after[1] - v, np.linalg.det(J - sign * np.eye(2))]

    x, _, found, message = fsolve(left, [w, *guess], full_output=True, xtol=1e-12)
    assert found == 1, message
    return x


@pytest.fixture(scope="module")
def hammer():
    motion = jl.simulate(knocking, -0.5, 0.0, 2 * np.pi / 2.2 * np.arange(101), {"w": 2.2, "d": 0.1, "s": 0.0})
    orbit = jl.periodic(knocking, motion.q[-1], motion.qdot[-1], {"w": 2.2, "d": 0.1, "s": 0.0}, section=once)
    return jl.response_curve(orbit, over="w", values=(1.8, 3.2))


@pytest.mark.slow
def test_flip_of_the_impact_oscillator(hammer):
    """Where the motion with one impact gives way to one of two periods, in closed form; and that motion, which branches off there."""
    (flip,) = hammer.special
    assert flip.kind == "flip"
    np.testing.assert_allclose(flip.orbit.multipliers[0], -1, atol=1e-7)
    motion = flip.orbit.motion(4001)
    i = int(np.argmax(np.diff(np.asarray(motion.contacts["stop"].impacts))))
    w, *_ = bounce(float(flip.value), [float(motion.ts[i]), float(motion.qdot[i])])
    np.testing.assert_allclose(flip.value, w, rtol=1e-8)
    twice = hammer.branch(0, steps=8)
    at = twice.orbit(4)
    motion = at.motion(3)
    np.testing.assert_allclose(at.period, 4 * np.pi / twice.values[4], rtol=1e-12)
    np.testing.assert_allclose([motion.q[2], motion.qdot[2]], [at.q, at.qdot], atol=1e-7)
    assert abs(float(motion.q[1] - motion.q[0])) > 1e-3  # not after one period


@pytest.mark.slow
def test_a_stop_that_is_only_just_met():
    """Without impact the amplitude is |1 − ω² + 0.1 iω|⁻¹; at grazing it is 1. The motion that hits is not stable there, turns back, and
    becomes stable at a fold, in closed form; the derivative of the fold by the gap, against differences of the closed form.
    """
    orbit = jl.periodic(knocking, -0.2, 0.0, {"w": 2.2, "d": 0.1, "s": 1.0}, section=once)
    of = {"q": lambda q: q, "speed": lambda qdot: qdot}
    curve = jl.response_curve(orbit, over="w", values=(1.2, 3.0), of=of)
    fold, grazing = curve.special
    assert (fold.kind, grazing.kind) == ("fold", "grazing")
    squared = brentq(lambda u: (1 - u) ** 2 + 0.01 * u - 1, 1.5, 2.5, xtol=1e-15)
    np.testing.assert_allclose(grazing.value, np.sqrt(squared), rtol=1e-8)
    free = np.asarray(curve.values[grazing.index + 1 :])
    np.testing.assert_allclose(curve.amplitude["q"][grazing.index + 1 :], 1 / np.abs(1 - free**2 + 0.1j * free), rtol=1e-7)
    np.testing.assert_allclose(curve.measured["q"].highest[: grazing.index], 1, rtol=1e-9)  # at the stop
    assert not np.any(curve.is_stable[fold.index + 1 : grazing.index])
    motion = fold.orbit.motion(4001)
    i = int(np.argmax(np.diff(np.asarray(motion.contacts["stop"].impacts))))
    hit = [float(motion.ts[i]), float(motion.qdot[i])]
    at = lambda s: bounce(float(fold.value), hit, s=s, sign=1.0)[0]
    np.testing.assert_allclose(fold.value, at(1.0), rtol=1e-8)
    given = lambda s: {"w": 2.2, "d": 0.1, "s": s}
    by_gap = jax.jacfwd(lambda s: jl.response_curve(orbit, given(s), over="w", values=(1.2, 3.0)).special[0].value)(1.0)
    np.testing.assert_allclose(by_gap, (at(1.001) - at(0.999)) / 0.002, rtol=1e-5)


@pytest.mark.slow
def test_an_event_that_begins_to_happen():
    """Two stiffnesses: where a linear motion first reaches the second one, in closed form, named by the system's own event."""
    gears = jl.System(
        lambda q, qdot, s: 0.5 * qdot**2 - 0.5 * q**2,
        dissipation=lambda qdot: 0.05 * qdot**2,
        force=lambda t, w: 0.3 * jnp.cos(w * t),
        events={"far": jl.Event(lambda q, s: q - s, direction=jl.direction.Rising())},
    )
    orbit = jl.periodic(gears, 0.4, 0.0, {"s": 1.0, "w": 0.5}, section=once)
    curve = jl.response_curve(orbit, over="w", values=(0.3, 2.0))
    reach = lambda w: 0.3 / abs(1 - w**2 + 0.1j * w) - 1
    assert [(point.kind, point.what) for point in curve.special] == [("event", "far")] * 2
    expected = [brentq(reach, 0.5, 1.0, xtol=1e-14), brentq(reach, 1.0, 1.5, xtol=1e-14)]
    np.testing.assert_allclose([point.value for point in curve.special], expected, rtol=1e-8)
    assert "event (far) at w" in repr(curve)


swinging = jl.System(  # a pendulum whose support moves up and down
    lambda q, qdot: 0.5 * qdot**2,
    dissipation=lambda qdot, d: 0.5 * d * qdot**2,
    force=lambda t, q, a, h: -(a - 2 * h * jnp.cos(2 * t)) * jnp.sin(q),
)


@pytest.mark.slow
def test_pendulum_with_a_moving_support():
    """It hangs at rest; flips are at Mathieu's characteristic values a₁ and b₁, branch points, where multipliers pass 1, at a₂ and b₂.
    Motions of twice the period branch off.
    """
    h = 0.4
    rest = jl.periodic(swinging, 0.0, 0.0, {"a": 0.3, "h": h, "d": 0.0}, section=jl.Every(jnp.pi))
    curve = jl.response_curve(rest, over="a", values=(0.2, 2.0))
    assert [point.kind for point in curve.special] == ["flip", "flip"]
    np.testing.assert_allclose([point.value for point in curve.special], [mathieu_b(1, h), mathieu_a(1, h)], rtol=1e-9)
    np.testing.assert_array_equal(curve.amplitude["q"], 0)
    rest = jl.periodic(swinging, 0.0, 0.0, {"a": 4.02, "h": h, "d": 0.0}, section=jl.Every(jnp.pi))
    fine = jl.response_curve(rest, over="a", values=(3.9, 4.1))
    assert [point.kind for point in fine.special] == ["branch point", "branch point"]
    np.testing.assert_allclose([point.value for point in fine.special], [mathieu_b(2, h), mathieu_a(2, h)], rtol=1e-8)
    swings = curve.branch(0, values=(-1.0, 3.0), steps=60)
    assert swings.ends[0] == "it branches off there" and float(swings.amplitude["q"][-1]) > 0.3
    motion = swings.orbit(20).motion(3)
    np.testing.assert_allclose(motion.q, [motion.q[0], -motion.q[0], motion.q[0]], atol=1e-8)
    crossing = fine.branch(1, values=(3.5, 5.0), steps=40)
    assert len(crossing) > 40 and float(crossing.amplitude["q"].max()) > 0.05
    motion = crossing.orbit(0).motion(3)
    np.testing.assert_allclose(motion.q[-1], motion.q[0], atol=1e-8)


top = jl.Event(lambda qdot: qdot, direction=jl.direction.Falling())


@pytest.mark.slow
def test_backbone_of_duffing():
    """Free vibrations are one for each amplitude; a damping that comes out as zero numbers them. The frequency by
    elliptic integrals; at amplitude 1 it is 1.3177760649655266.
    """
    free = jl.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2 - 0.25 * q**4, dissipation=lambda qdot, d: 0.5 * d * qdot**2)
    orbit = jl.periodic(free, 1.0, 0.0, {"d": 0.0}, section=top, longest=20.0)
    np.testing.assert_allclose(2 * np.pi / orbit.period, 1.3177760649655266, rtol=1e-9)
    backbone = jl.response_curve(orbit, over="d", values=(-0.1, 0.1), steps=12)
    A = np.asarray(backbone.amplitude["q"])
    frequency = np.pi * np.sqrt(1 + A**2) / (2 * ellipk(A**2 / (2 * (1 + A**2))))
    assert A.max() > 2 and A.size > 12
    np.testing.assert_allclose(2 * np.pi / np.asarray(backbone.period), frequency, rtol=1e-8)
    np.testing.assert_allclose(backbone.values, 0, atol=1e-9)


@pytest.mark.slow
def test_torus():
    """A driven oscillator of van der Pol: the pair of multipliers has absolute value 1, det P = exp ∫tr, by SciPy's motion from there."""
    driven = jl.System(
        lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2,
        force=lambda t, q, qdot, mu, w: mu * (1 - q**2) * qdot + 1.5 * jnp.cos(w * t),
    )
    params = {"mu": 0.3, "w": 1.0}
    orbit = jl.periodic(driven, -0.7, 3.0, params, section=once)
    find = lambda mu: jl.response_curve(orbit, params | {"mu": mu}, over="w", values=(0.9, 1.6)).special[0]
    torus = find(0.3)
    assert torus.kind == "torus"
    w = float(torus.value)
    rates = lambda t, y: [y[1], 0.3 * (1 - y[0] ** 2) * y[1] - y[0] + 1.5 * np.cos(w * t), 0.3 * (1 - y[0] ** 2)]
    start = [float(torus.orbit.q), float(torus.orbit.qdot), 0.0]
    found = solve_ivp(rates, (0, 2 * np.pi / w), start, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    np.testing.assert_allclose(found, start, atol=1e-8)
    by_mu = jax.jacfwd(lambda mu: find(mu).value)(0.3)
    np.testing.assert_allclose(by_mu, (find(0.3003).value - find(0.2997).value) / 6e-4, rtol=1e-5)


@pytest.mark.slow
def test_limit_cycles_over_a_parameter():
    """Van der Pol's, from a section that is an event: period against SciPy's at one value."""
    cycles = jl.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2, force=lambda q, qdot, mu: mu * (1 - q**2) * qdot)
    orbit = jl.periodic(cycles, 1.0, 0.0, {"mu": 1.0}, section=top, longest=20.0)
    curve = jl.response_curve(orbit, over="mu", values=(0.1, 4.0))
    assert bool(jnp.all(curve.is_stable))
    np.testing.assert_allclose([curve.at(1.0)[0].period, curve.at(1.0)[0].q], [6.6632868593231, 2.0086198608748], rtol=1e-9)
    turning = lambda t, y: y[1]
    turning.direction = -1
    rates = lambda t, y: [y[1], 4.0 * (1 - y[0] ** 2) * y[1] - y[0]]
    times = solve_ivp(rates, (0, 60), [2.0, 0.0], "DOP853", rtol=1e-12, atol=1e-12, events=turning).t_events[0]
    np.testing.assert_allclose(curve.period[-1], times[-1] - times[-2], rtol=1e-8)


@pytest.mark.slow
def test_a_section_that_is_no_longer_met():
    """A limit cycle of amplitude 2√a, near a small one, meets q = 1 down to a = ¼ only; the curve says so and ends."""
    cycles = jl.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2, force=lambda q, qdot, a: 0.1 * (a - q**2) * qdot)
    crosses = jl.Event(lambda q: q - 1.0, direction=jl.direction.Rising())
    orbit = jl.periodic(cycles, 1.0, 1.0, {"a": 1.0}, section=crosses, longest=20.0)
    curve = jl.response_curve(orbit, over="a", values=(0.05, 1.2))
    said = "no periodic motion that passes through the section is near the last one"
    assert curve.ends == (f"nothing was found beyond: {said}", "an end of `values` is reached")
    assert abs(float(curve.values[0]) - 0.25) < 2e-3 and bool(jnp.all(jnp.isfinite(curve.amplitude["q"])))
    np.testing.assert_allclose(curve.amplitude["q"], 2 * np.sqrt(curve.values), rtol=1e-3)


@pytest.mark.slow
def test_in_single_precision_and_late():
    """float32; and a drive that began long ago."""
    start = jl.periodic(duffing, 0.4, 0.0, PARAMS, section=once, t=1e6 * 4 * np.pi)
    late = jl.response_curve(start, over="w", values=(0.3, 2.5))
    np.testing.assert_allclose([point.value for point in late.special], [1.77971952, 1.32423620], rtol=1e-8)
    np.testing.assert_allclose(late.orbit(5).motion(3).q[-1], late.q[5], atol=1e-8)
    with jax.enable_x64(False):
        start = jl.periodic(duffing, jnp.float32(0.4), jnp.float32(0.0), PARAMS, section=once)
        curve = jl.response_curve(start, over="w", values=(0.3, 2.5))
        assert curve.values.dtype == jnp.float32
        np.testing.assert_allclose([float(point.value) for point in curve.special], [1.7797195, 1.3242362], rtol=1e-4)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"over": "v"}, "`over` must name one number"),
        ({"values": (2.0, 1.0)}, "`values` must be two numbers"),
        ({"values": (1.0, 2.0)}, "`values` must lie around"),
        ({"of": {}}, "`of` must be functions"),
        ({"of": {"x": lambda q: jnp.stack([q, q])}}, "`of` 'x' must return one number"),
        ({"samples": 3}, "`samples`"),
        ({"steps": 0}, "`steps`"),
    ],
)
def test_wrong_arguments(orbit, change, said):
    with pytest.raises((ValueError, TypeError), match=said):
        jl.response_curve(orbit, **({"over": "w", "values": (0.3, 2.5)} | change))


def test_what_is_hidden_is_refused(orbit):
    curve = lambda d: jl.response_curve(orbit, PARAMS | {"d": d}, over="w", values=(0.3, 2.5)).values
    with pytest.raises(ValueError, match="`params` must be known"):
        jax.jit(curve)(0.1)
    with pytest.raises(ValueError, match="`params` must be known"):
        jax.vmap(curve)(jnp.array([0.1, 0.2]))


def test_shown(curve):
    """What is printed, and the picture: stable parts solid, the unstable one dashed, two folds."""
    import matplotlib as mpl
    import matplotlib.pyplot

    mpl.use("Agg")
    text = repr(curve)
    assert "fold at w = 1.7797" in text and "an end of `values` is reached" in text
    ax = curve.plot()
    styles = [line.get_linestyle() for line in ax.get_lines() if len(line.get_xdata()) > 2]
    assert styles == ["-", "--", "-"]
    assert {text.get_text() for text in ax.get_legend().get_texts()} == {"fold", "unstable"}
    with pytest.raises(ValueError, match="`of` must name"):
        curve.plot(of="x")
    mpl.pyplot.close(ax.figure)


@pytest.mark.slow
def test_a_motor_that_cannot_pass_its_resonance():
    """Sommerfeld's effect: an unbalanced rotor on a spring over the torque of its motor, its angle running on. In each turn the torque does
    the work that is dissipated; near the resonance the speed hardly rises, up to a fold.
    """

    def lagrangian(q, qdot, M, m, e, J, k):
        moving = 0.5 * M * qdot["x"] ** 2 + 0.5 * J * qdot["phi"] ** 2
        return moving + m * (0.5 * qdot["x"] ** 2 - e * jnp.sin(q["phi"]) * qdot["x"] * qdot["phi"]) - 0.5 * k * q["x"] ** 2

    rotor = jl.System(
        lagrangian,
        dissipation=lambda qdot, b, c: 0.5 * b * qdot["x"] ** 2 + 0.5 * c * qdot["phi"] ** 2,
        force=lambda T: {"phi": T, "x": 0.0},
    )
    params = {"M": 10.0, "m": 1.0, "e": 0.02, "J": 0.01, "k": 4000.0, "b": 20.0, "c": 0.01, "T": 0.1}
    once_around = jl.Event(lambda q: jnp.sin(q["phi"]), direction=jl.direction.Rising())
    start = {"x": 0.0, "phi": 0.0}, {"x": 0.0, "phi": 10.0}
    orbit = jl.periodic(rotor, *start, params, section=once_around, longest=3.0, cyclic="phi")
    of = {"x": lambda q: q["x"], "loss": lambda qdot, b, c: b * qdot["x"] ** 2 + c * qdot["phi"] ** 2}
    curve = jl.response_curve(orbit, over="T", values=(0.05, 0.5), of=of)
    assert [point.kind for point in curve.special] == ["fold", "fold"]
    np.testing.assert_allclose(curve.drift["phi"], 2 * np.pi, rtol=1e-8)
    lost = np.asarray(curve.measured["loss"].harmonics[:, 0].real * curve.period)
    np.testing.assert_allclose(lost, 2 * np.pi * np.asarray(curve.values), rtol=1e-7)
    assert bool(jnp.all(jnp.diff(curve.period) < 0))  # the speed rises along the curve, though the torque does not


@pytest.mark.slow
def test_random_pairs_of_oscillators():
    """Ten pairs with random masses, springs, cubic springs and dampers, in random units: at random points of each curve SciPy's motion
    returns, and its variation over a period has these multipliers.
    """
    pair = jl.System(
        lambda q, qdot, m, k, c: 0.5 * m @ qdot**2 - 0.5 * (k[0] * q[0] ** 2 + k[1] * (q[1] - q[0]) ** 2) - 0.25 * c * q[0] ** 4,
        dissipation=lambda qdot, b: 0.5 * (b[0] * qdot[0] ** 2 + b[1] * (qdot[1] - qdot[0]) ** 2),
        force=lambda t, F, w: jnp.array([0.0, 1.0]) * F * jnp.cos(w * t),
    )
    random = np.random.default_rng(11)
    for _ in range(10):
        length, time, mass = 10.0 ** random.uniform(-4, 4, 3)
        force = mass * length / time**2
        m, k = random.uniform(0.5, 2.0, 2), random.uniform(0.5, 3.0, 2)
        b, c, F = random.uniform(0.05, 0.2, 2), random.uniform(0.1, 1.0), random.uniform(0.1, 0.4)
        params = {"m": mass * m, "k": force / length * k, "c": force / length**3 * c, "b": force * time / length * b, "F": force * F}
        low, high = 0.3 / time, 2.5 / time
        start = jl.periodic(pair, jnp.zeros(2), jnp.zeros(2), params | {"w": low}, section=once)
        curve = jl.response_curve(start, over="w", values=(low, high), steps=1500)
        assert curve.values[0] == low and curve.values[-1] == high, curve.ends
        for i in random.choice(len(curve), 3, replace=False):
            w = float(curve.values[i]) * time
            K = np.array([[k[0] + k[1], -k[1]], [-k[1], k[1]]])
            B = np.array([[b[0] + b[1], -b[1]], [-b[1], b[1]]])

            def rates(t, y, m=m, c=c, F=F, w=w, K=K, B=B):
                Y = y.reshape(4, 5)
                bend = np.diag([3 * c * Y[0, 0] ** 2, 0.0])
                own = np.array([0.0, F * np.cos(w * t)]) - K @ Y[:2, 0] - B @ Y[2:, 0] - np.array([c * Y[0, 0] ** 3, 0.0])
                moved = -(K + bend) @ Y[:2, 1:] - B @ Y[2:, 1:]
                return np.concatenate([Y[2:], np.concatenate([own[:, None], moved], 1) / m[:, None]]).ravel()

            x = np.concatenate([np.asarray(curve.q[i]) / length, np.asarray(curve.qdot[i]) * time / length])
            whole = np.concatenate([x[:, None], np.eye(4)], 1).ravel()
            found = solve_ivp(rates, (0, 2 * np.pi / w), whole, "DOP853", rtol=1e-11, atol=1e-12).y[:, -1].reshape(4, 5)
            np.testing.assert_allclose(found[:, 0], x, atol=1e-7 * np.abs(x).max())
            expected = np.linalg.eigvals(found[:, 1:])
            got = np.asarray(curve.multipliers[i])
            np.testing.assert_allclose(np.sort(np.abs(got)), np.sort(np.abs(expected)), rtol=1e-5, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(("length", "time"), [(1.0, 1.0), (1e-9, 1e9), (1e9, 1e-9)])
def test_from_rest_in_any_units(length, time):
    """Over the amplitude of a drive that is zero at first, at rest: q = F/|ω₀² − ω² + 2iδω|."""
    system = jl.System(
        lambda q, qdot, k: 0.5 * qdot**2 - 0.5 * k * q**2,
        dissipation=lambda qdot, d: 0.5 * d * qdot**2,
        force=lambda t, w, F: F * jnp.cos(w * t),
    )
    force = length / time**2
    orbit = jl.periodic(system, 0.0, 0.0, {"k": time**-2, "d": 0.1 / time, "w": 2.2 / time, "F": 0.0}, section=once)
    curve = jl.response_curve(orbit, over="F", values=(0.0, 0.5 * force), steps=60)
    assert curve.ends == ("an end of `values` is reached",) * 2
    np.testing.assert_allclose(curve.amplitude["q"], curve.values * time**2 / abs(1 - 2.2**2 + 0.22j), rtol=1e-7, atol=1e-12 * length)
