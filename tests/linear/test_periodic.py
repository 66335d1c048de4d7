"""Periodic motions against closed forms and shooting by SciPy: limit cycles, forced vibration, impacts, friction that sticks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxlag as jl

G = 9.81
top = jl.Event(lambda qdot: qdot, direction=jl.direction.Falling())
van_der_pol = jl.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2, force=lambda q, qdot, mu: mu * (1 - q**2) * qdot)


def cycle(mu):
    return jl.periodic(van_der_pol, 1.0, 0.0, {"mu": mu}, section=top, longest=20.0)


def by_shooting(mu):
    """The amplitude, the period and the multiplier exp(∫μ(1 − q²)dt), of the cycle to which SciPy's motion has settled."""
    turning = lambda t, y: y[1]
    turning.direction = -1
    rates = lambda t, y: [y[1], mu * (1 - y[0] ** 2) * y[1] - y[0], mu * (1 - y[0] ** 2)]
    found = solve_ivp(rates, (0, 80), [2.0, 0.0, 0.0], "DOP853", rtol=1e-13, atol=1e-13, events=turning)
    (before, last), (earlier, state) = found.t_events[0][-2:], found.y_events[0][-2:]
    return state[0], last - before, np.exp(state[2] - earlier[2])


@pytest.mark.slow
def test_van_der_pol():
    orbit, (amplitude, period, multiplier) = cycle(1.0), by_shooting(1.0)
    np.testing.assert_allclose([orbit.q, orbit.period], [amplitude, period], rtol=1e-9)
    np.testing.assert_allclose(orbit.multipliers, [multiplier, 0], rtol=1e-7, atol=1e-12)
    assert orbit.is_stable and "stable" in repr(orbit)
    motion = orbit.motion(11)
    np.testing.assert_allclose([motion.q[-1], motion.qdot[-1]], [motion.q[0], motion.qdot[0]], atol=1e-7)


@pytest.mark.slow
def test_derivatives_of_a_cycle():
    """By mu, forward and reverse, of the period, the amplitude and the multiplier; against differences of SciPy's."""
    numbers = lambda mu: (lambda orbit: jnp.stack([orbit.q, orbit.period, orbit.multipliers[0].real]))(cycle(mu))
    expected = (np.array(by_shooting(1.001)) - by_shooting(0.999)) / 0.002
    forward = jax.jacfwd(numbers)(1.0)
    np.testing.assert_allclose(forward, expected, rtol=2e-5)
    np.testing.assert_allclose(jax.grad(lambda mu: numbers(mu)[1])(1.0), forward[1], rtol=1e-9)
    fine = (numbers(1.0001) - numbers(0.9999)) / 2e-4
    np.testing.assert_allclose(forward, fine, rtol=1e-6, atol=1e-8)


forced = jl.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2, dissipation=lambda qdot, d: d * qdot**2, force=lambda t, w: jnp.cos(w * t))
once_a_period = jl.Every(lambda w: 2 * jnp.pi / w)


def driven(w, d):
    """q = Re A exp(iωt) with A = 1/(1 − ω² + 2iδω)."""
    return 1 / (1 - w**2 + 2j * d * w)


@pytest.mark.parametrize(("w", "d"), [(1.3, 0.05), (2.1, -0.05)])
def test_forced_vibration(w, d):
    """Multipliers exp((−δ ± i√(1 − δ²))T): where damping is negative, the vibration is left."""
    A, T = driven(w, d), 2 * np.pi / w
    orbit = jl.periodic(forced, 1.0, 0.0, {"w": w, "d": d}, section=once_a_period)
    np.testing.assert_allclose([orbit.q, orbit.qdot, orbit.period], [A.real, (1j * w * A).real, T], rtol=1e-8)
    expected = np.exp((-d + 1j * np.sqrt(1 - d**2)) * T)
    np.testing.assert_allclose(sorted(orbit.multipliers, key=np.imag), sorted([expected, expected.conj()], key=np.imag), rtol=1e-8)
    assert expected.real < 1 and orbit.is_stable == (d > 0)


@pytest.mark.slow
def test_forced_vibration_at_a_late_time():
    """Clocks tell the phase to 3e-7."""
    w, d = 1.3, 0.05
    A, T, params = driven(w, d), 2 * np.pi / w, {"w": w, "d": d}
    for late in (1e9, 1.7e9):
        orbit = jl.periodic(forced, 1.0, 0.0, params, section=once_a_period, t=late)
        turned = A * np.exp(1j * w * late)
        np.testing.assert_allclose([orbit.q, orbit.qdot], [turned.real, (1j * w * turned).real], atol=2e-6)
        motion = jl.simulate(forced, turned.real, (1j * w * turned).real, late + np.linspace(0, T, 9), params, rtol=1e-11)
        np.testing.assert_allclose(motion.q, (A * np.exp(1j * w * np.asarray(motion.ts))).real, atol=2e-6)


@pytest.mark.slow
def test_the_motion_of_an_orbit_is_computed_as_the_orbit_was():
    """Friction F s/√(s² + w²) instead of that which sticks, and given tolerances; against SciPy."""
    F, w = 0.3, 0.05
    rubbing = jl.System(lambda q, qdot: 0.5 * qdot**2 - q**2, dissipation=lambda qdot: F * jnp.abs(qdot), force=lambda t: jnp.cos(t))
    given = dict(friction=jl.Regularised(w), rtol=1e-10, atol=1e-12)
    orbit = jl.periodic(rubbing, 0.5, 0.0, section=jl.Every(2 * np.pi), **given)
    motion = orbit.motion(11)
    rates = lambda t, y: [y[1], np.cos(t) - 2 * y[0] - F * y[1] / np.hypot(y[1], w)]
    expected = solve_ivp(rates, (0, 2 * np.pi), [float(orbit.q), float(orbit.qdot)], "DOP853", rtol=1e-12, atol=1e-14, t_eval=motion.ts)
    np.testing.assert_allclose([motion.q, motion.qdot], expected.y, rtol=0, atol=1e-8)
    np.testing.assert_allclose([motion.q[-1], motion.qdot[-1]], [orbit.q, orbit.qdot], rtol=0, atol=1e-8)
    assert not np.allclose(orbit.motion(11, friction=jl.StickSlip()).q[-1], orbit.q, rtol=0, atol=1e-3)


ball = jl.System(
    lambda q, qdot: 0.5 * qdot**2 - G * q, unilateral={"table": jl.Contact(lambda t, q, A: q - A * jnp.sin(20.0 * t), restitution=0.5)}
)


@pytest.mark.slow
def test_ball_on_a_vibrating_table():
    """Once in a period: it hits with relative speed (1 + e)⁻¹ g T, where the table goes with speed (1 − e)/(1 + e) g T/2. The impact
    takes e² of areas in the plane of states: det = e², and the trace is that of the map of impacts.

    Source: Guckenheimer & Holmes, Nonlinear Oscillations, section 2.4, without the approximation of high flights.
    """
    e, A, w = 0.5, 0.03, 20.0
    T = 2 * np.pi / w
    s = np.arccos((1 - e) / (1 + e) * G * T / 2 / (A * w)) / w  # the time of an impact
    leaves, t = A * w * np.cos(w * s) + e / (1 + e) * G * T, 0.3 * T
    flown = t - s
    expected = A * np.sin(w * s) + leaves * flown - G * flown**2 / 2, leaves - G * flown
    orbit = jl.periodic(ball, 1.01 * expected[0], expected[1], {"A": A}, section=jl.Every(T), t=t)
    np.testing.assert_allclose([orbit.q, orbit.qdot], expected, rtol=1e-8)
    np.testing.assert_allclose(np.prod(orbit.multipliers).real, e**2, rtol=1e-7)
    bend = -A * w**2 * np.sin(w * s)  # of the table, its acceleration; the map of impacts (Δs, Δv) linearised
    hits = leaves - G * T - A * w * np.cos(w * s)
    flight = np.array([[1, -T / hits], [0, 1 + G * T / hits]])
    impact = np.array([[1, 0], [(1 + e) * bend, -e]])
    np.testing.assert_allclose(np.sum(orbit.multipliers).real, np.trace(impact @ flight), rtol=1e-6)


@pytest.mark.slow
def test_stick_slip():
    """A block on a belt: while it sticks it forgets how it came to, and nothing is left of a deviation. Period against SciPy's."""
    mu, v = 1.0, 0.2
    system = jl.System(
        lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2,
        dissipation=lambda qdot, mu: mu * jnp.abs(qdot - 0.2),
        force=lambda qdot: 0.4 * (qdot - 0.2) - 0.3 * (qdot - 0.2) ** 3,
    )
    orbit = jl.periodic(system, 0.0, 0.0, {"mu": mu}, section=top, longest=40.0)
    catches = lambda t, y: y[1] - v + 1e-15
    catches.terminal, catches.direction = True, 1
    rates = lambda t, y: [y[1], mu - y[0] + 0.4 * (y[1] - v) - 0.3 * (y[1] - v) ** 3]
    slip = solve_ivp(rates, (0, 20), [mu, v - 1e-13], "DOP853", rtol=1e-12, atol=1e-14, events=catches)
    np.testing.assert_allclose(orbit.period, slip.t[-1] + (mu - slip.y[0, -1]) / v, rtol=1e-5)
    np.testing.assert_allclose(orbit.multipliers, 0, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"section": jl.Event([1.0])}, "`section` must be an `Event`"),
        ({"longest": None}, "`longest` must be the time"),
        ({"longest": 3.0}, "passes through the section twice"),
        ({"cyclic": "x"}, "`cyclic` must name coordinates"),
    ],
)
def test_clear_errors(change, said):
    with pytest.raises((TypeError, ValueError), match=said):
        jl.periodic(van_der_pol, 1.0, 0.0, {"mu": 1.0}, **{"section": top, "longest": 20.0} | change)


@pytest.mark.slow
def test_what_depends_on_time_is_not_periodic_at_a_section():
    with pytest.raises(ValueError, match="where the system depends on t"):
        jl.periodic(forced, 1.0, 0.0, {"w": 1.3, "d": 0.05}, section=top, longest=20.0)
