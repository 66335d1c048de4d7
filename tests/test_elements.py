"""Parts that jump or bend, against formulas, SciPy and closed forms of their motions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

import jaxlag as jl
from jaxlag import elements

FREE = lambda qdot: 0.5 * qdot**2
XS, YS = np.array([-1.0, -0.2, 0.5, 2.0]), np.array([2.0, -1.0, 0.5, 0.7])


def test_potentials_have_the_forces_of_their_formulas():
    x = np.linspace(-2.1, 2.1, 43)
    force = lambda potential: jax.vmap(jax.grad(potential))(x)
    np.testing.assert_allclose(force(lambda x: elements.gap_spring(x, 3.0, 0.8)), 3 * np.sign(x) * np.maximum(np.abs(x) - 0.4, 0))
    np.testing.assert_allclose(force(lambda x: elements.preload(x, 3.0, 2.0))[x != 0], (3 * x + 2 * np.sign(x))[x != 0])
    np.testing.assert_allclose(force(lambda x: elements.bilinear(x, 1.0, 3.0, 0.55)), x + 2 * np.maximum(x - 0.55, 0))
    np.testing.assert_allclose(force(lambda x: elements.table_integral(x, XS, YS)), np.interp(x, XS, YS), atol=1e-14)
    np.testing.assert_allclose(elements.table(x, XS, YS), np.interp(x, XS, YS), atol=1e-14)
    for at in (-2.0, -0.5, 0.3, 1.1, 3.0):
        expected = quad(lambda x: np.interp(x, XS, YS), XS[0], at, points=[x for x in XS if x < at], limit=200)[0]
        np.testing.assert_allclose(elements.table_integral(at, XS, YS), expected, atol=1e-12)


def test_stops_push_and_never_pull():
    x, v = (a.ravel() for a in np.meshgrid(np.linspace(-0.1, 0.1, 9), np.linspace(-3, 3, 7)))
    inside = x > 0
    np.testing.assert_allclose(elements.end_stop(x, v, 100.0, 5.0), -np.where(inside, np.maximum(100 * x + 5 * v, 0), 0))
    expected = -np.where(inside, np.maximum(100 * np.abs(x) ** 1.5 * (1 + 0.4 * v), 0), 0)
    np.testing.assert_allclose(elements.hunt_crossley(x, v, 100.0, 0.4), expected)
    slopes = jax.vmap(jax.grad(lambda x, v: elements.hunt_crossley(x, v, 100.0, 0.4), argnums=(0, 1)))(x, v)
    assert np.all(np.isfinite(slopes)) and np.all(slopes[0][~inside] == 0)


def test_a_frequency_that_two_springs_share():
    """2 ω₁ω₂/(ω₁ + ω₂), at every amplitude and in any unit."""
    system = jl.System(lambda q, qdot, c1, c2: 0.5 * qdot**2 - elements.bilinear(q, c1, c2))
    c1, c2 = 2.0, 11.0
    for unit in (1.0, 1e-9, 1e6):
        T = np.pi / np.sqrt(c1) + np.pi / np.sqrt(c2)
        motion = jl.simulate(system, 0.3 * unit, 0.0, np.array([0.0, T, 7 * T]), {"c1": c1, "c2": c2}, rtol=1e-12)
        np.testing.assert_allclose(motion.q / unit, 0.3, rtol=1e-11)


def test_a_drop_on_an_end_stop_against_events_of_scipy():
    """With a force that jumps at first touch, and a stop that lets go before x is 0; by height, damping and the place of the stop."""
    system = jl.System(lambda q, qdot, g: 0.5 * qdot**2 - g * q, force=lambda q, qdot, a, c, d: -elements.end_stop(a - q, -qdot, c, d))

    def by_hand(h, a, d, T, g=9.81, c=400.0):
        t, y, touches, passed = 0.0, np.array([h, 0.0]), False, 0
        while True:
            push = lambda y, touches=touches: c * (a - y[0]) - d * y[1] if touches else 0.0
            if not touches:
                ends = [lambda t, y: y[0] - a]
                ends[0].direction = -1
            else:
                ends = [lambda t, y: c * (a - y[0]) - d * y[1]]  # it would pull
                ends[0].direction = -1
            ends[0].terminal = True
            found = solve_ivp(lambda t, y, push=push: [y[1], push(y) - g], (t, T), y, "DOP853", rtol=1e-13, atol=1e-14, events=ends)
            t, y = found.t[-1], found.y[:, -1]
            if found.status != 1:
                return y[0], passed
            touches, passed = not touches, passed + 1
            if not touches:  # let go: it rises out of the stop, without a force
                out = lambda t, y: y[0] - a
                out.terminal, out.direction = True, 1
                found = solve_ivp(lambda t, y: [y[1], -g], (t, T), y, "DOP853", rtol=1e-13, atol=1e-14, events=[out])
                t, y = found.t[-1], found.y[:, -1]
                if found.status != 1:
                    return y[0], passed

    def last(h, a, d):
        return jl.simulate(system, h, 0.0, np.array([0.0, 1.2]), {"g": 9.81, "a": a, "c": 400.0, "d": d}, rtol=1e-11).q[-1]

    given = np.array([1.0, 0.1, 12.0])
    expected, passed = by_hand(*given, 1.2)
    value, slopes = jax.value_and_grad(last, (0, 1, 2))(*given)
    assert passed >= 2
    np.testing.assert_allclose(value, expected, rtol=1e-8)
    for i, slope in enumerate(slopes):
        step = 1e-5 * np.eye(3)[i]
        np.testing.assert_allclose(slope, (by_hand(*(given + step), 1.2)[0] - by_hand(*(given - step), 1.2)[0]) / 2e-5, rtol=1e-5)


@pytest.mark.slow
def test_where_a_stop_is_follows_from_a_recording():
    """Place, stiffness and damping together."""
    system = jl.System(
        lambda q, qdot, k: 0.5 * qdot**2 - 0.5 * k * q**2, force=lambda q, qdot, a, c, d: elements.end_stop(q - a, qdot, c, d)
    )
    true, ts = {"k": 10.0, "a": 0.03, "c": 400.0, "d": 3.0}, np.linspace(0, 4, 401)
    exact = jl.simulate(system, 0.0, 0.2, ts, true, rtol=1e-10).q
    record = jl.Experiment(ts, np.asarray(exact) + 2e-4 * np.random.default_rng(1).normal(size=ts.size), 0.0, 0.2)
    found = jl.fit(system, record, {"k": 8.0, "a": 0.035, "c": 300.0, "d": 1.0}, free=tuple(true))
    assert found.converged
    for name, value in true.items():
        assert abs(found.estimates[name] - value) < 4 * found.standard_errors[name] < 0.5 * value, (name, str(found))


def test_bad_tables_are_refused():
    with pytest.raises(ValueError, match="`xs` must increase"):
        elements.table(0.3, [0.0, 1.0, 1.0], [0.0, 1.0, 2.0])
    with pytest.raises(ValueError, match="`xs` and `ys` must be of one length"):
        elements.table(0.3, [0.0, 1.0], [0.0, 1.0, 2.0])
    assert np.isfinite(jax.jit(elements.table)(0.3, jnp.asarray(XS), jnp.asarray(YS)))


@pytest.mark.slow
def test_slopes_where_parameters_are_zero():
    """Those towards positive ones: of a stop that is not yet there, a gap without width, a drive without force."""
    stop = jl.System(FREE, force=lambda q, qdot, a, c, d: elements.end_stop(q - a, qdot, c, d))
    last = lambda c, d: jl.simulate(stop, 0.0, 1.0, np.array([0.0, 2.0]), {"a": 0.5, "c": c, "d": d}).q[-1]
    np.testing.assert_allclose(jax.grad(last, (0, 1))(0.0, 0.0), [-(1.5**3) / 6, -(1.5**2) / 2], rtol=1e-7)
    gap = jl.System(lambda q, qdot, s: FREE(qdot) - elements.gap_spring(q, 4.0, s))
    at = lambda s: jl.simulate(gap, 0.3, 0.0, np.array([0.0, np.pi / 4]), {"s": s}).q[-1]
    np.testing.assert_allclose(jax.grad(at)(0.0), 0.5, rtol=1e-6)  # q = s/2 + (0.3 − s/2) cos 2t
    for x, slope in ((0.4, 1.0), (-0.4, -1.0)):
        assert jax.grad(elements.saturation, 1)(x, 0.0) == slope == -jax.grad(elements.dead_zone, 1)(x, 0.0)
    np.testing.assert_allclose(elements.saturation(np.array([-5.0, -0.5, 0.3, 7.0]), 2.0), [-2.0, -0.5, 0.3, 2.0])
