"""Velocities and forces of points, new coordinates, and the vehicle of the lecture three ways."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag.examples import vehicle

TS = jnp.linspace(0, 20, 201)
SHARP = {"solver": diffrax.Dopri8(), "rtol": 1e-11, "atol": 1e-12}
FULL = vehicle.parts(vehicle.q0, 0.3, 1.3)
REST = dict.fromkeys(FULL, 0.0)


@functools.cache
def motion(way):
    if way == "first_kind":
        return jl.simulate(vehicle.first_kind, FULL, REST, TS, vehicle.params, **SHARP)
    return jl.simulate(getattr(vehicle, way), vehicle.q0, vehicle.qdot0, TS, vehicle.params, **SHARP)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["substituted", "first_kind"])
def test_the_vehicle_three_ways_is_one_motion(way):
    reduced, other = motion("system"), motion(way)
    for name in ("x", "y", "phi"):
        np.testing.assert_allclose(other.q[name], reduced.q[name], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(other.qdot[name], reduced.qdot[name], rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_what_the_parts_of_the_vehicle_pass_to_each_other():
    """Newton–Euler, part by part, from the reduced motion: the forces on axles, struts and treads."""
    p, reduced = vehicle.params, motion("system")
    found = motion("first_kind").multipliers
    ax = reduced.qddot["x"]
    y3, v3 = reduced.q["y"] + p["a"] * reduced.q["phi"], reduced.qdot["y"] + p["a"] * reduced.qdot["phi"]
    # rolling g = φ₃ + x₃/r: Θ_r φ̈₃ = −M₀ + λ, φ̈₃ = −ẍ/r; the tread pushes the wheel forward by λ/r
    tread = p["M0"] - p["Theta_r"] * ax / p["r"]
    np.testing.assert_allclose(found["front rolling"], tread, rtol=1e-8)
    # axle g = x₃ − x − a: m ẍ₃ = λ + tread/r, so the body is pushed by −λ
    np.testing.assert_allclose(found["front axle"], p["m"] * ax - tread / p["r"], rtol=1e-8)
    # strut g = y₃ − y − aφ, massless: λ = c (y₃ − l) + b ẏ₃
    np.testing.assert_allclose(found["front strut"], p["c"] * (y3 - p["l"]) + p["b"] * v3, rtol=1e-7, atol=1e-6)
    rear = -p["Theta_r"] * ax / p["r"]
    np.testing.assert_allclose(found["rear rolling"], rear, rtol=1e-8)
    np.testing.assert_allclose(found["rear axle"], p["m"] * ax - rear / p["r"], rtol=1e-8)


@pytest.mark.slow
def test_the_three_vehicles_have_the_same_gradients():
    ts = jnp.linspace(0, 1, 5)

    def end(way, c, m, y):
        params = vehicle.params | {"c": c, "m": m}
        q0 = vehicle.q0 | {"y": y}
        start = (vehicle.parts(q0, 0.3, 1.3), REST) if way == "first_kind" else (q0, vehicle.qdot0)
        q = jl.simulate(getattr(vehicle, way), *start, ts, params).q
        return q["y"][-1] + q["x"][-1]

    expected = jax.grad(functools.partial(end, "system"), (0, 1, 2))(4e4, 30.0, 0.55)
    for way in ("substituted", "first_kind"):
        np.testing.assert_allclose(jax.grad(functools.partial(end, way), (0, 1, 2))(4e4, 30.0, 0.55), expected, rtol=1e-6, atol=1e-12)


def turning(t, q, r):
    """A point on an arm of length q on a turntable of radius r."""
    return r * jnp.stack([jnp.cos(t), jnp.sin(t)]) + q * jnp.stack([jnp.sin(2 * t), jnp.cos(q)])


@pytest.mark.fast
def test_rate_of_a_moving_point():
    t, q, v, r = 0.4, 0.7, -1.1, 2.0
    expected = [-r * np.sin(t) + v * np.sin(2 * t) + 2 * q * np.cos(2 * t), r * np.cos(t) + v * np.cos(q) - q * v * np.sin(q)]
    np.testing.assert_allclose(jl.rate(turning)(t, q, v, {"r": r}), expected, rtol=1e-14)
    for by_name in ({"r": r}, {"params": {"r": r}}, {"params": {"r": 0.0}, "r": r}):
        np.testing.assert_allclose(jl.rate(turning)(t=t, q=q, qdot=v, **by_name), expected, rtol=1e-14)
    with pytest.raises(TypeError, match="`params` must be a mapping where its entries are named, but is a tuple"):
        jl.rate(turning)(t, q, v, (1.0,), r=r)
    in_body = jax.jit(lambda v: jl.rate(turning)(t, q, v, {"r": r}))
    np.testing.assert_allclose(jax.jacfwd(in_body)(v), [np.sin(0.8), np.cos(q) - q * np.sin(q)], rtol=1e-13)


@pytest.mark.fast
def test_virtual_work_of_vectors_constants_and_several_forces():
    """A double pendulum's tip is pulled by a constant force, and its elbow turned by a moment that depends on the state."""
    tip = lambda q, l: l * jnp.stack([jnp.sin(q["a"]) + jnp.sin(q["b"]), -jnp.cos(q["a"]) - jnp.cos(q["b"])])
    elbow = lambda q: q["b"] - q["a"]
    system = jl.System(
        lambda qdot: 0.5 * qdot["a"] ** 2 + 0.5 * qdot["b"] ** 2,
        force={
            "pull": jl.virtual_work(tip, (2.0, -1.0)),
            "spring": jl.virtual_work(elbow, lambda t, q, c: -c * (q["b"] - q["a"]) * t),
        },
    )
    q, l, c, t = {"a": 0.3, "b": -0.8}, 1.5, 4.0, 0.5
    found = jl.acceleration(system, q, {"a": 0.0, "b": 0.0}, {"l": l, "c": c}, t=t).qddot
    moment = -c * (-1.1) * t
    np.testing.assert_allclose(found["a"], l * (2 * np.cos(0.3) - np.sin(0.3)) - moment, rtol=1e-14)
    np.testing.assert_allclose(found["b"], l * (2 * np.cos(-0.8) - np.sin(-0.8)) + moment, rtol=1e-14)
    powers = jl.powers(system, q, {"a": 1.0, "b": 2.0}, {"l": l, "c": c}, t=t)
    np.testing.assert_allclose(powers["spring"], moment * (2.0 - 1.0), rtol=1e-14)


def test_an_effort_unlike_its_point_is_refused():
    force = jl.virtual_work(lambda q: jnp.stack([q, q]), 3.0)
    with pytest.raises(ValueError, match=r"`effort` must be structured like its `coordinate`, \(2,\), but is \(\)"):
        jl.acceleration(jl.System(lambda qdot: 0.5 * qdot**2, force=force), 0.0, 0.0)


def test_the_names_of_an_effort_are_checked_like_any():
    force = jl.virtual_work(lambda q: q, lambda F0: F0)
    with pytest.raises(TypeError, match="`effort` must name arguments that exist, but it names 'F0'"):
        jl.acceleration(jl.System(lambda qdot: 0.5 * qdot**2, force=force), 0.0, 0.0, {"F": 1.0})


def test_a_force_that_depends_on_a_reaction_does_virtual_work():
    """Friction μ|λ| of the floor on a block, as a force on its position."""
    system = jl.System(
        lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1],
        force=jl.virtual_work(lambda q: q[0], lambda multipliers, mu: -mu * multipliers["floor"]),
        holonomic={"floor": lambda q: q[1]},
    )
    found = jl.acceleration(system, jnp.zeros(2), jnp.array([1.0, 0.0]), {"m": 2.0, "g": 9.81, "mu": 0.25})
    np.testing.assert_allclose(found.qddot, [-0.25 * 9.81, 0.0], rtol=1e-13, atol=1e-13)


@pytest.mark.fast
def test_substitute_with_time_in_the_map():
    """A bead on a wire that turns with Ω: r̈ = Ω² r − g sin Ωt, and L has explicit time."""
    plane = jl.System(
        lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1],
        dissipation={"oil": lambda qdot, b: 0.5 * b * qdot @ qdot},
        force={"wind": lambda F: jnp.stack([F, 0 * F])},
    )
    wire = jl.substitute(plane, lambda t, q, Omega: q * jnp.stack([jnp.cos(Omega * t), jnp.sin(Omega * t)]))
    t, r, v = 0.6, 1.2, -0.4
    p = {"m": 2.0, "g": 9.81, "b": 0.3, "Omega": 1.7, "F": 5.0}
    w = 1.7
    expected = w**2 * r - 9.81 * np.sin(w * t) - 0.3 / 2 * v + 5.0 * np.cos(w * t) / 2
    np.testing.assert_allclose(jl.acceleration(wire, r, v, p, t=t).qddot, expected, rtol=1e-13)


def test_substitute_keeps_names_and_constraints():
    """Constraints of both kinds pulled back to polar coordinates."""
    plane = jl.System(
        lambda qdot: 0.5 * qdot @ qdot,
        holonomic={"circle": lambda q, l: q @ q - l**2},
        nonholonomic={"skate": lambda q, qdot: qdot[0] * q[1] - qdot[1] * q[0]},
    )
    polar = jl.substitute(plane, lambda q: q["r"] * jnp.stack([jnp.cos(q["phi"]), jnp.sin(q["phi"])]))
    assert polar.constraints == ("circle", "skate")
    found = jl.constraint_jacobian(polar, {"r": 2.0, "phi": 0.3}, {"r": 0.0, "phi": 0.0}, {"l": 2.0})  # columns phi, r
    np.testing.assert_allclose(found, [[0, 4], [-4, 0]], atol=1e-14)
    assert jl.substitute(plane, pickled_map) == jl.substitute(plane, pickled_map)
    assert hash(jl.substitute(plane, pickled_map)) == hash(jl.substitute(plane, pickled_map))


def pickled_map(q):
    return q


@pytest.mark.slow
def test_a_reaction_as_a_force_on_a_point():
    """A rod hinged at its end: the hinge force by Newton, F = m(a − g), for a rigid body in x, y of the centre and φ."""
    hinge = lambda q, L: jnp.stack([q["x"] - L / 2 * jnp.cos(q["phi"]), q["y"] - L / 2 * jnp.sin(q["phi"])])
    rod = jl.System(
        lambda q, qdot, m, L, g: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2 + L**2 / 12 * qdot["phi"] ** 2) - m * g * q["y"],
        holonomic={"hinge": hinge},
    )
    p = {"m": 2.0, "L": 1.2, "g": 9.81}
    phi, w = 0.4, 1.5
    q = {"x": 0.6 * np.cos(phi), "y": 0.6 * np.sin(phi), "phi": phi}
    v = {"x": -0.6 * np.sin(phi) * w, "y": 0.6 * np.cos(phi) * w, "phi": w}
    alpha = -1.5 * 9.81 / 1.2 * np.cos(phi)  # m L²/3 φ̈ = −m g L/2 cos φ
    centre = 0.6 * np.array([-alpha * np.sin(phi) - w**2 * np.cos(phi), alpha * np.cos(phi) - w**2 * np.sin(phi)])
    expected = 2.0 * (centre + np.array([0, 9.81]))
    np.testing.assert_allclose(jl.constraint_force(rod, q, v, p, at=hinge)["hinge"], expected, rtol=1e-12)
    generalized = jl.constraint_force(rod, q, v, p)["hinge"]
    np.testing.assert_allclose([generalized["x"], generalized["y"]], expected, rtol=1e-12)
    elsewhere = jl.constraint_force(rod, q, v, p, at=lambda q: jnp.stack([q["x"], q["y"]]))["hinge"]
    assert np.all(np.isnan(elsewhere))  # at the centre it would take a moment too


WINCH = jl.State(lambda z, u, tau: (u - z) / tau, start=lambda z0: z0)
WINCH_PARAMS = {"m": 2.0, "g": 9.81, "u": 3.0, "tau": 0.5, "z0": 1.5}


def hanging(q, z):
    return z * jnp.stack([jnp.sin(q), -jnp.cos(q)])


def by_rate(t, q, qdot, z, params, states, m, g):
    v = jl.rate(hanging)(t, q, qdot, params, states)
    return 0.5 * m * v @ v - m * g * hanging(q, z)[1]


def test_positions_that_depend_on_a_state_move_with_it():
    """A rope of length z: φ̈ = −(2 ż φ̇ + g sin φ)/z, for coordinates pulled back and for the velocity of a point."""
    mass = jl.System(lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1], states={"z": WINCH})
    for system in (jl.substitute(mass, hanging), jl.System(by_rate, states={"z": WINCH})):
        found = jl.acceleration(system, 0.3, 0.7, WINCH_PARAMS).qddot
        np.testing.assert_allclose(found, -(2 * (3.0 - 1.5) / 0.5 * 0.7 + 9.81 * np.sin(0.3)) / 1.5, rtol=1e-12)


def test_the_effort_of_a_virtual_work_may_be_a_state():
    push = jl.virtual_work(lambda q: 2 * q, lambda z: z)
    system = jl.System(lambda qdot, m: 0.5 * m * qdot**2, force=push, states={"z": WINCH})
    np.testing.assert_allclose(jl.acceleration(system, 0.0, 0.0, WINCH_PARAMS).qddot, 2 * 1.5 / 2.0, rtol=1e-13)
    np.testing.assert_allclose(jl.acceleration(system, 0.0, 0.0, WINCH_PARAMS, states={"z": 0.4}).qddot, 0.4, rtol=1e-13)
