"""Motions against closed forms and published digits; what is kept and what is not."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipj, ellipk

import jaxlag as jl
from jaxlag._motion import scales, solution_map
from jaxlag._motion.results import RESULTS, from_diffrax, reason_of, under_diffrax
from jaxlag.examples import pendulum, vehicle

SHARP = {"solver": diffrax.Dopri8(), "rtol": 1e-11, "atol": 1e-12}


@pytest.mark.slow
def test_polar_and_cartesian_pendulum_are_the_same_motion():
    ts, p = jnp.linspace(0, 20, 401), pendulum.params
    polar = jl.simulate(pendulum.polar, *pendulum.polar_state(2.0, 0.0, p["l"]), ts, p, **SHARP)
    cartesian = jl.simulate(pendulum.cartesian, *pendulum.cartesian_state(2.0, 0.0, p["l"]), ts, p, **SHARP)
    np.testing.assert_allclose(cartesian.q["x"], jnp.sin(polar.q["phi"]), atol=1e-8)
    np.testing.assert_allclose(cartesian.q["y"], -jnp.cos(polar.q["phi"]), atol=1e-8)
    np.testing.assert_allclose(cartesian.multipliers["rod"], polar.multipliers["rod"], atol=1e-7)
    # φ(t) = 2 asin(k cd(√(g/l) t | k²)), k = sin(φ₀/2)
    k = np.sin(1.0)
    sn, cn, dn, _ = ellipj(np.sqrt(9.81) * np.asarray(ts), k**2)
    np.testing.assert_allclose(polar.q["phi"], 2 * np.arcsin(k * cn / dn), atol=1e-8)


@pytest.mark.fast
@pytest.mark.parametrize("amplitude", [0.1, np.pi / 2, 3.0])
def test_period_of_the_pendulum(amplitude):
    """Back at the start after T = 4 √(l/g) K(sin²(φ₀/2)): φ − φ₀ is of second order there, so φ̇ measures the period."""
    p = pendulum.params
    T = 4 / np.sqrt(9.81) * ellipk(np.sin(amplitude / 2) ** 2)
    motion = jl.simulate(pendulum.polar, *pendulum.polar_state(amplitude, 0.0, p["l"]), jnp.array([0, T / 2, T]), p, **SHARP)
    late = motion.qdot["phi"][-1] / motion.qddot["phi"][-1]  # Newton's step to φ̇ = 0
    np.testing.assert_allclose(late / T, 0, atol=1e-9)


spherical = jl.System(lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[2], holonomic={"rod": lambda q, l: q @ q - l**2})


@pytest.mark.slow
def test_spherical_pendulum_stays_on_its_sphere_for_1000_seconds():
    p = {"m": 1.0, "g": 9.81, "l": 1.0}
    q0, v0 = jnp.array([np.sqrt(0.75), 0.0, -0.5]), jnp.array([0.0, np.sqrt(3.0), 0.0])
    ts = jnp.linspace(0, 1000, 2001)
    motion = jl.simulate(spherical, q0, v0, ts, p, solver=diffrax.Dopri8(), rtol=1e-10, atol=1e-12)
    assert np.max(np.abs(jnp.sum(motion.q**2, axis=1) - 1)) <= 1e-12
    assert np.max(np.abs(2 * jnp.sum(motion.q * motion.qdot, axis=1))) <= 1e-12
    energy = 0.5 * jnp.sum(motion.qdot**2, axis=1) + 9.81 * motion.q[:, 2]
    assert np.max(np.abs(energy / energy[0] - 1)) <= 1e-7


@pytest.mark.slow
def test_spherical_pendulum_turns_where_the_closed_form_says():
    """Period of z and apsidal advance by elliptic integrals: z from −0.5 down to −0.8875973996079699 and back."""
    p = {"m": 1.0, "g": 9.81, "l": 1.0}
    q0, v0 = jnp.array([np.sqrt(0.75), 0.0, -0.5]), jnp.array([0.0, np.sqrt(3.0), 0.0])
    T = 1.07966916265728
    end = jl.simulate(spherical, q0, v0, jnp.array([0, T / 2, T]), p, **SHARP)
    np.testing.assert_allclose(end.q[1, 2], -0.8875973996079699, rtol=1e-9)
    np.testing.assert_allclose(end.q[2, 2], -0.5, rtol=1e-9)
    np.testing.assert_allclose(np.arctan2(end.q[2, 1], end.q[2, 0]) % (2 * np.pi), 3.8311623896149762, rtol=1e-9)


def car_axis_lagrangian(t, q, qdot, k, r, w, L, L0):
    xl, yl, xr, yr = q
    xb, yb = car_axis_base(t, r, w, L)
    springs = 0.5 * (jnp.hypot(xl, yl) - L0) ** 2 + 0.5 * (jnp.hypot(xr - xb, yr - yb) - L0) ** 2
    return 0.5 * k * qdot @ qdot - springs - k * (yl + yr)


def car_axis_base(t, r, w, L):
    yb = r * jnp.sin(w * t)
    return jnp.sqrt(L**2 - yb**2), yb


def car_axis_constraints(t, q, r, w, L):
    xl, yl, xr, yr = q
    xb, yb = car_axis_base(t, r, w, L)
    return jnp.stack([xb * xl + yb * yl, (xl - xr) ** 2 + (yl - yr) ** 2 - L**2])


@pytest.mark.slow
def test_car_axis_problem():
    """IVP Test Set (Mazzia & Magherini, release 2.4, 2008), index 3: 18 published digits at t = 3, quadruple-precision GAMD."""
    system = jl.System(car_axis_lagrangian, holonomic={"axis": car_axis_constraints})
    params = {"k": 0.0005, "r": 0.1, "w": 10.0, "L": 1.0, "L0": 0.5}
    start = jnp.array([0, 0.5, 1, 0.5]), jnp.array([-0.5, 0, -0.5, 0])
    motion = jl.simulate(system, *start, jnp.linspace(0, 3, 61), params, solver=diffrax.Dopri8(), rtol=1e-12, atol=1e-12)
    position = [0.493455784275402809122e-1, 0.496989460230171153861, 0.104174252488542151681e1, 0.373911027265361256927]
    velocity = [-0.770583684040972357970e-1, 0.744686658723778553466e-2, 0.175568157537232222276e-1, 0.770341043779251976443]
    np.testing.assert_allclose(motion.q[-1], position, atol=1e-8)
    np.testing.assert_allclose(motion.qdot[-1], velocity, atol=1e-7)
    np.testing.assert_allclose(motion.multipliers["axis"][-1], [-0.473688659084893324729e-2, -0.110468033125734368808e-2], atol=1e-6)


@pytest.mark.slow
def test_chaplygin_sleigh():
    """Bloch, Nonholonomic Mechanics, section 1.7: v = C tanh k(t + t₀), ω = √(m/J) C sech k(t + t₀)."""

    def lagrangian(q, qdot, m, I, a):
        s, c = jnp.sin(q[2]), jnp.cos(q[2])
        centre = qdot[:2] + a * qdot[2] * jnp.stack([-s, c])
        return 0.5 * m * centre @ centre + 0.5 * I * qdot[2] ** 2

    edge = lambda q, qdot: -qdot[0] * jnp.sin(q[2]) + qdot[1] * jnp.cos(q[2])
    system = jl.System(lagrangian, nonholonomic={"edge": edge})
    ts = jnp.linspace(0, 5, 51)
    motion = jl.simulate(system, jnp.zeros(3), jnp.array([-1, 0, 0.7]), ts, {"m": 2.0, "I": 0.3, "a": 0.4}, **SHARP)
    np.testing.assert_allclose(motion.q[-1], [-3.6423913826293206, -1.6157039753708287, 3.841054116288366], atol=1e-9)
    forward = motion.qdot[-1, 0] * np.cos(motion.q[-1, 2]) + motion.qdot[-1, 1] * np.sin(motion.q[-1, 2])
    np.testing.assert_allclose(forward, 1.0732072796508205, atol=1e-9)
    np.testing.assert_allclose(motion.qdot[-1, 2], 0.020171434967878307, atol=1e-9)
    assert np.max(np.abs(jax.vmap(edge)(motion.q, motion.qdot))) < 1e-13


@pytest.mark.slow
def test_knife_edge_on_an_incline():
    """Bloch 2015, section 1.6: a cycloid; λ = −2 m g sin α sin Ωt."""
    system = jl.System(
        lambda q, qdot, m, J, alpha, g: 0.5 * m * (qdot[0] ** 2 + qdot[1] ** 2) + 0.5 * J * qdot[2] ** 2 + m * g * q[0] * jnp.sin(alpha),
        nonholonomic={"edge": lambda q, qdot: qdot[0] * jnp.sin(q[2]) - qdot[1] * jnp.cos(q[2])},
    )
    p = {"m": 1.25, "J": 0.13, "alpha": 0.6, "g": 9.81}
    motion = jl.simulate(system, jnp.zeros(3), jnp.array([0, 0, 1.3]), jnp.array([0, 1, 2.5, 5]), p, **SHARP)
    np.testing.assert_allclose(motion.q[1:, 0], [1.5215342775292227, 0.019184094851414937, 0.07583808898819891], atol=1e-9)
    np.testing.assert_allclose(motion.q[1:, 1], [1.7080377639651245, 5.149829439665222, 10.307912643842267], atol=1e-9)
    multipliers = [-13.34321563523975, 1.4982707142837899, -2.9789507597438254]
    np.testing.assert_allclose(motion.multipliers["edge"][1:], multipliers, atol=1e-8)


squared = jl.System(lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1], holonomic={"rod": lambda q, l: q @ q - l**2})


def drift_and_error(stabilisation):
    """The pendulum of IFToMM's benchmark A01, let go from the horizontal, over 50 s, against the elliptic function.

    By diffrax's scheme of order 5, whose drift is large enough to be compared.
    """
    ts, p = jnp.linspace(0, 50, 501), {"m": 1.0, "g": 9.81, "l": 1.0}
    motion = jl.simulate(
        squared, jnp.array([-1.0, 0.0]), jnp.zeros(2), ts, p, stabilisation=stabilisation, solver=diffrax.Tsit5(), rtol=1e-6, atol=1e-6
    )
    sn, cn, dn, _ = ellipj(np.sqrt(9.81) * np.asarray(ts), 0.5)
    theta = 2 * np.arcsin(np.sqrt(0.5) * cn / dn)
    drift = np.max(np.abs(np.hypot(*motion.q.T) - 1))
    return drift, np.max(np.abs(motion.q - np.stack([-np.sin(theta), -np.cos(theta)], axis=1)))


def test_projection_holds_what_drifts_without_it():
    projected, fed_back, nothing = map(
        drift_and_error, (jl.stabilisation.Projection(), jl.stabilisation.Baumgarte(20.0, 20.0), jl.stabilisation.NoStabilisation())
    )
    assert projected[0] < 1e-15 and projected[1] < 2e-3
    assert nothing[0] > 1e-3 and nothing[1] > 1e-2
    assert fed_back[0] < 1e-3 * nothing[0] and fed_back[1] < 0.3 * nothing[1]


@pytest.mark.slow
@pytest.mark.parametrize("solver", [diffrax.Dopri5(), diffrax.Bosh3(), diffrax.Heun(), diffrax.Kvaerno5(), diffrax.Kvaerno3()])
def test_other_solvers(solver):
    ts, p = jnp.linspace(0, 1, 11), pendulum.params
    motion = jl.simulate(pendulum.cartesian, *pendulum.cartesian_state(1.0, 0.0, 1.0), ts, p, solver=solver, rtol=1e-6, atol=1e-8)
    k = np.sin(0.5)
    sn, cn, dn, _ = ellipj(np.sqrt(9.81) * np.asarray(ts), k**2)
    np.testing.assert_allclose(motion.q["x"], np.sin(2 * np.arcsin(k * cn / dn)), atol=3e-4)
    np.testing.assert_allclose(np.hypot(motion.q["x"], motion.q["y"]), 1, atol=1e-14)


@pytest.mark.slow
def test_start_is_put_on_the_constraints_and_the_card_says_so():
    ts, p = jnp.linspace(0, 1, 11), pendulum.params
    motion = jl.simulate(pendulum.cartesian, {"x": 0.0, "y": -1.1}, {"x": 0.5, "y": 0.3}, ts, p)
    np.testing.assert_allclose([motion.q["y"][0], motion.qdot["y"][0]], [-1, 0], atol=1e-14)
    np.testing.assert_allclose(motion.stats["start_moved"], 0.3, rtol=1e-12)  # the velocity 0.3 along the rod
    card = repr(motion)
    for expected in ("11 samples", "x, y", "rod", "start moved by 0.3", "successful"):
        assert expected in card


def test_consistent_state_is_the_nearest_in_the_metric_of_the_masses():
    """Two masses on a line a distance 1 apart: the heavy one moves three times less."""
    system = jl.System(lambda qdot: 0.5 * (3 * qdot[0] ** 2 + qdot[1] ** 2), holonomic=lambda q: q[1] - q[0] - 1)
    q, v = jl.consistent_state(system, jnp.array([0.0, 2.0]), jnp.array([0.0, 4.0]))
    np.testing.assert_allclose(q, [0.25, 1.25], rtol=1e-14)
    np.testing.assert_allclose(v, [1.0, 1.0], rtol=1e-14)
    q, v = jl.consistent_state(system, jnp.array([0.0, 2.0]), jnp.array([0.0, 4.0]), fixed=(0,))
    np.testing.assert_allclose([*q, *v], [0.0, 1.0, 0.0, 0.0], atol=1e-14)
    q, v = jl.consistent_state(pendulum.polar, {"r": 1.3, "phi": 0.2}, {"r": 0.1, "phi": 0.4}, pendulum.params, fixed=("phi",))
    np.testing.assert_allclose([q["r"], q["phi"], v["r"], v["phi"]], [1.0, 0.2, 0.0, 0.4], atol=1e-14)


@pytest.mark.slow
def test_consistent_state_far_from_a_curved_constraint():
    """Nearest point of a circle: l q/|q|, whose derivatives are known in closed form, at first and second order."""
    system = jl.System(lambda qdot: 0.5 * qdot @ qdot, holonomic=lambda q, l: q @ q - l**2)
    on = lambda q, l: jl.consistent_state(system, q, jnp.zeros(2), {"l": l})[0]
    exact = lambda q, l: l * q / jnp.sqrt(q @ q)
    q = jnp.array([2.0, 1.0])
    np.testing.assert_allclose(on(q, 1.0), exact(q, 1.0), rtol=1e-13)
    for derivative in (jax.jacfwd, jax.jacrev):
        for argument in (0, 1):
            np.testing.assert_allclose(derivative(on, argument)(q, 1.0), derivative(exact, argument)(q, 1.0), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(jax.hessian(on)(q, 1.0), jax.hessian(exact)(q, 1.0), rtol=1e-8, atol=1e-9)


def test_a_second_motion_traces_nothing(monkeypatch):
    traces = []
    check = solution_map.check
    monkeypatch.setattr(solution_map, "check", lambda *args: traces.append(1) or check(*args))
    energy = lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2  # a system no other test has compiled
    ts = np.linspace(0, 1, 7)
    run = lambda c, x, ts: jl.simulate(jl.System(energy), x, 0.0, ts, {"c": c})
    first = run(4.0, 1.0, ts)
    assert len(traces) == 1
    second = run(5.0, 2, ts + 1)
    run(np.float64(4.0), jnp.array(1.0), list(ts))
    assert len(traces) == 1
    np.testing.assert_allclose([first.q[-1], second.q[-1]], [np.cos(2), 2 * np.cos(np.sqrt(5))], atol=1e-7)


@pytest.mark.slow
def test_vmap_equals_the_loop():
    rng = np.random.default_rng(5)
    b = jnp.asarray(rng.uniform(1000, 6000, 100))
    ts = jnp.linspace(0, 2, 21)
    last = lambda b: jax.tree.map(lambda x: x[-1], jl.simulate(vehicle.system, vehicle.q0, vehicle.qdot0, ts, {**vehicle.params, "b": b}).q)
    together, one_by_one = jax.vmap(last)(b), [last(x) for x in b]
    for name in vehicle.q0:
        np.testing.assert_allclose(together[name], [each[name] for each in one_by_one], rtol=1e-10, atol=1e-12)


@pytest.mark.slow
def test_a_batch_is_printed_as_one():
    ts = jnp.linspace(0, 1, 5)
    run = lambda x: jl.simulate(pendulum.cartesian, *pendulum.cartesian_state(x, 0.0, 1.0), ts, pendulum.params)
    assert "3 motions of 5 samples" in repr(jax.vmap(run)(jnp.array([0.1, 0.2, 0.3])))


@pytest.mark.slow
def test_single_precision_works_and_warns_once(single_precision):
    scales._warn_of_single_precision.cache_clear()
    ts, p = jnp.linspace(0, 2, 21), pendulum.params
    with pytest.warns(UserWarning, match="single precision") as caught:
        for _ in range(2):
            motion = jl.simulate(pendulum.cartesian, *pendulum.cartesian_state(1.0, 0.0, 1.0), ts, p)
    assert len([w for w in caught if "single precision" in str(w.message)]) == 1
    assert motion.q["x"].dtype == jnp.float32 and motion.succeeded
    k = np.sin(0.5)
    sn, cn, dn, _ = ellipj(np.sqrt(9.81) * np.asarray(ts), k**2)
    np.testing.assert_allclose(motion.q["x"], np.sin(2 * np.arcsin(k * cn / dn)), atol=2e-3)
    np.testing.assert_allclose(np.hypot(motion.q["x"], motion.q["y"]), 1, atol=1e-6)


@pytest.mark.slow
def test_coordinates_of_every_kind():
    from typing import NamedTuple

    class Point(NamedTuple):
        x: jax.Array
        y: jax.Array

    ts = jnp.linspace(0, 1, 5)
    exact = np.cos(2 * np.asarray(ts))
    for q0, energy in [
        (1.0, lambda q, qdot: 0.5 * qdot**2 - 2 * q**2),
        (1, lambda q, qdot: 0.5 * qdot**2 - 2 * q**2),
        (np.array([1.0, 1.0]), lambda q, qdot: 0.5 * qdot @ qdot - 2 * q @ q),
        ([1, 1.0], lambda q, qdot: 0.5 * qdot @ qdot - 2 * q @ q),
        (
            {"a": 1.0, "b": np.ones((2, 2))},
            lambda q, qdot: 0.5 * qdot["a"] ** 2 - 2 * q["a"] ** 2 + jnp.sum(0.5 * qdot["b"] ** 2 - 2 * q["b"] ** 2),
        ),
        (Point(1.0, 1.0), lambda q, qdot: 0.5 * (qdot.x**2 + qdot.y**2) - 2 * (q.x**2 + q.y**2)),
    ]:
        zero = jax.tree.map(lambda x: 0 * x, q0)
        motion = jl.simulate(jl.System(energy), q0, zero, ts)
        for leaf in jax.tree.leaves(motion.q):
            np.testing.assert_allclose(leaf.reshape(5, -1), exact[:, None] * np.ones(leaf.reshape(5, -1).shape), atol=1e-7)
    assert isinstance(motion.q, Point)


@pytest.mark.fast
def test_functions_of_every_kind_get_what_they_name():
    class Damper:
        def __init__(self, b):
            self.b = b

        def __call__(self, qdot):
            return 0.5 * self.b * qdot**2

    def lagrangian(qdot, q, /, params, *, scale=2.0):
        return scale * (0.5 * params["m"] * qdot**2 - 0.5 * params["c"] * q**2)

    p = {"m": 2.0, "c": 8.0}
    expected = {None: -4.0, "partial": -4.25, "object": -4.25, "jit": -4.25}
    for kind, damper in [
        (None, None),
        ("partial", functools.partial(lambda qdot, b: 0.5 * b * qdot**2, b=2.0)),
        ("object", Damper(2.0)),
        ("jit", jax.jit(lambda qdot, b=2.0: 0.5 * b * qdot**2)),
    ]:
        found = jl.acceleration(jl.System(lagrangian, dissipation=damper), 1.0, 0.5, p).qddot
        np.testing.assert_allclose(found, expected[kind], rtol=1e-14)
    doubled = jl.acceleration(jl.System(lagrangian, dissipation=Damper(2.0)), 1.0, 0.5, {**p, "scale": 1.0}).qddot
    np.testing.assert_allclose(doubled, -4.5, rtol=1e-14)


@pytest.mark.slow
def test_a_network_in_params():
    import equinox as eqx

    potential = eqx.nn.MLP(1, "scalar", 8, 1, activation=jax.nn.tanh, key=jax.random.key(0))
    system = jl.System(lambda q, qdot, net: 0.5 * qdot**2 - net(q[None]))
    force = jl.acceleration(system, 0.3, 0.0, {"net": potential}).qddot
    np.testing.assert_allclose(force, -jax.grad(lambda q: potential(q[None]))(0.3), rtol=1e-12)
    end = lambda net: jl.simulate(system, 0.3, 0.0, jnp.linspace(0, 1, 3), {"net": net}).q[-1]
    slope = eqx.filter_grad(end)(potential)
    bumped = lambda h: end(eqx.tree_at(lambda n: n.layers[1].weight, potential, potential.layers[1].weight.at[0, 2].add(h)))
    np.testing.assert_allclose(slope.layers[1].weight[0, 2], (bumped(1e-4) - bumped(-1e-4)) / 2e-4, rtol=1e-5)


def test_systems_are_compared_by_their_functions():
    make = lambda: jl.System(pendulum.polar_lagrangian, holonomic={"rod": pendulum.polar_rod})
    assert make() == make() == pendulum.polar and hash(make()) == hash(pendulum.polar)
    assert make() != pendulum.cartesian
    with pytest.raises(AttributeError):
        make().lagrangian = ()
    assert repr(pendulum.polar) == "System(lagrangian; holonomic: rod)"


def test_reasons_of_failure_travel_through_diffrax():
    """Its own reasons have the same numbers in both enumerations, ours are beyond them."""
    for name in diffrax.RESULTS._name_to_item:
        assert from_diffrax(diffrax.RESULTS._name_to_item[name])._value == RESULTS._name_to_item[name]._value
        assert reason_of(from_diffrax(diffrax.RESULTS._name_to_item[name])) == diffrax.RESULTS[diffrax.RESULTS._name_to_item[name]]
    for reason in (RESULTS.no_friction, RESULTS.chattering, RESULTS.negative_bound, RESULTS.undefined):
        assert under_diffrax(reason) != diffrax.RESULTS.successful
        assert reason_of(from_diffrax(under_diffrax(reason))) == RESULTS[reason]
