"""Contacts of several gaps, as one array: each gap is a contact of its own, with the same law."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag import rigid

G = 9.81


def balls(restitution, law=None):
    """Balls that fall side by side onto one floor."""
    contact = jl.Contact(lambda q: q["y"], restitution=restitution, **({} if law is None else {"law": law}))
    return jl.System(lambda q, qdot, m, g: jnp.sum(0.5 * m * qdot["y"] ** 2 - m * g * q["y"]), unilateral={"floor": contact})


@pytest.mark.slow
@pytest.mark.parametrize("metre", [1.0, 1e-6])
@pytest.mark.parametrize("law", [jl.NewtonRestitution(), jl.PoissonRestitution()])
def test_each_gap_has_its_restitution(law, metre):
    """Balls from heights h bounce to e² h, at √(2h/g)(1 + e)."""
    e, h, g = np.array([0.2, 0.5, 0.8]), np.array([1.0, 0.7, 0.4]) * metre, G * metre
    system, params = balls(lambda e: e, law), {"m": np.full(3, 2.0), "g": g, "e": e}
    apex = np.sqrt(2 * h / g) * (1 + e)

    def heights(e):
        ts = jnp.concatenate([jnp.zeros(1), jnp.sort(apex)])
        return jl.simulate(system, {"y": h}, {"y": 0 * h}, ts, params | {"e": e})

    motion = heights(e)
    at_apex = motion.q["y"][1 + np.argsort(np.argsort(apex)), np.arange(3)]
    np.testing.assert_allclose(at_apex, e**2 * h, rtol=1e-8)
    assert motion.contacts["floor"].impacts.shape == (4, 3)
    np.testing.assert_allclose(motion.contacts["floor"].changed[-1, :], np.sqrt(2 * h / g), rtol=1e-8)
    np.testing.assert_allclose(motion.contacts["floor"].impulse[-1, :], 2 * (1 + e) * np.sqrt(2 * h * g), rtol=1e-8)
    slope = jax.jacfwd(lambda e: heights(e).q["y"][-1])(jnp.asarray(e))
    since = np.max(apex) - np.sqrt(2 * h / g)
    np.testing.assert_allclose(slope, np.diag(np.sqrt(2 * h * g) * since), atol=1e-7 * metre)


def body(array):
    """A rod in the plane that falls flat onto the floor at an angle, with friction at both of its ends."""
    ends = np.array([-0.3, 0.3])
    at = lambda q: q["x"] + ends * jnp.cos(q["phi"]), lambda q: q["y"] + ends * jnp.sin(q["phi"])

    def rubbing(q, qdot, multipliers, mu):
        slip = jax.jvp(at[0], (q,), (qdot,))[1]
        pushes = multipliers["ends"] if array else jnp.stack([multipliers["left"], multipliers["right"]])
        return mu * jnp.sum(pushes * jnp.abs(slip))

    each = {name: jl.Contact(lambda q, i=i: at[1](q)[i], restitution=lambda e: e) for i, name in enumerate(("left", "right"))}
    return jl.System(
        lambda q, qdot, m, J, g: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2) + 0.5 * J * qdot["phi"] ** 2 - m * g * q["y"],
        dissipation={"rub": rubbing},
        unilateral={"ends": jl.Contact(at[1], restitution=lambda e: e)} if array else each,
    )


START = {"x": 0.0, "y": 0.4, "phi": 0.3}, {"x": 0.8, "y": 0.0, "phi": 0.0}
PARAMS = {"m": 1.3, "J": 0.05, "g": G, "mu": 0.3, "e": 0.3}


@pytest.fixture(scope="module")
def motions():
    ts = jnp.linspace(0, 0.6, 13)
    return [jl.simulate(body(array), *START, ts, PARAMS) for array in (True, False)]


def test_an_array_is_as_many_contacts(motions):
    """The same motion, forces and impacts as of contacts by name."""
    one, two = motions
    for name in START[0]:
        np.testing.assert_allclose(one.q[name], two.q[name], atol=1e-9)
        np.testing.assert_allclose(one.qddot[name], two.qddot[name], atol=1e-7)
    of = lambda field: np.stack([getattr(two.contacts[name], field) for name in ("left", "right")], axis=-1)
    for field in ("closed", "impacts", "changed", "impulse"):
        np.testing.assert_allclose(getattr(one.contacts["ends"], field), of(field), atol=1e-8)
    forces = np.stack([two.multipliers[name] for name in ("left", "right")], axis=-1)
    np.testing.assert_allclose(one.multipliers["ends"], forces, atol=1e-7)
    assert np.max(of("impacts")) >= 2 and np.any(of("closed"))  # there is something to compare


@pytest.mark.slow
def test_derivatives_are_those_of_as_many_contacts():
    """Along restitution and friction, behind several impacts; forward and reverse."""
    ts = jnp.linspace(0, 0.35, 3)
    given = jnp.array([0.3, 0.3])

    def end(system):
        return lambda x: jl.simulate(system, *START, ts, PARAMS | {"e": x[0], "mu": x[1]}).q["phi"][-1]

    found = [jax.grad(end(body(array)))(given) for array in (True, False)]
    np.testing.assert_allclose(*found, rtol=1e-6)
    np.testing.assert_allclose(jax.jacfwd(end(body(True)))(given), found[1], rtol=1e-6)


def test_what_is_shown(motions, tmp_path):
    """The card counts impacts of all gaps; files, pictures and `at` know their axes."""
    pytest.importorskip("matplotlib")
    from jaxlag import plot

    motion, _ = motions
    text = str(motion)
    assert f"{int(motion.contacts['ends'].impacts[-1].sum())} impacts of 2 gaps" in text
    motion.save(tmp_path / "motion.npz")
    again = jl.load(tmp_path / "motion.npz")
    np.testing.assert_array_equal(again.contacts["ends"].impacts, motion.contacts["ends"].impacts)
    assert np.isfinite(motion.at(0.05).q["y"])
    plot.forces(motion)


def test_events_of_an_array():
    """An event that names the contact happens at the impact of any of its gaps."""
    system = jl.System(
        lambda q, qdot, g: jnp.sum(0.5 * qdot["y"] ** 2 - g * q["y"]),
        unilateral={"floor": jl.Contact(lambda q: q["y"], restitution=0.5)},
        events={"click": jl.Event("floor")},
    )
    h = np.array([0.5, 1.0])
    motion = jl.simulate(system, {"y": h}, {"y": 0 * h}, jnp.linspace(0, 0.6, 4), {"g": G})
    happened = motion.events["click"].ts[np.isfinite(motion.events["click"].ts)]
    np.testing.assert_allclose(happened, np.sqrt(2 * h / G), rtol=1e-8)


def test_examined_and_on_paper():
    """`examine` says how many are closed, and `equations` numbers the gaps."""
    pytest.importorskip("sympy")
    system = balls(0.5)
    params = {"m": np.ones(3), "g": G}
    found = jl.examine(system, {"y": np.array([0.0, 1.0, 0.0])}, {"y": np.zeros(3)}, params)
    np.testing.assert_array_equal(found.contacts["floor"], [True, False, True])
    assert "2 of 3 gaps closed" in str(found) and found.rows == 2
    on_paper = jl.equations(system, {"y": np.zeros(3)}, params)
    assert list(on_paper.contacts) == ["floor_1", "floor_2", "floor_3"]
    np.testing.assert_array_equal([str(gap) for gap in on_paper.contacts.values()], ["y_1", "y_2", "y_3"])


def test_many_at_once():
    """A batch of motions has the gaps last."""
    system, h = balls(lambda e: e), np.array([0.5, 1.0])
    ts, params = jnp.linspace(0, 0.5, 3), {"m": np.ones(2), "g": G, "e": jnp.array([0.5, 0.6, 0.7])}
    many = jl.simulate_many(system, {"y": h}, {"y": 0 * h}, ts, params, over=("e",))
    assert many.contacts["floor"].impacts.shape == (3, 3, 2)
    np.testing.assert_allclose(many.contacts["floor"].impacts[:, -1], [[1, 1]] * 3)


SLOPE, MASS = 0.2, 0.37


def cube_on_a_slope(metre=1.0, second=1.0):
    """Friction at all eight corners, at rest at first: how far it has moved, in metres, at a time T (s), for μ and gravity by a factor."""
    side, g = 0.1 * metre, G * metre / second**2
    turned = lambda q: rigid.quaternion(q["p"])
    plane = rigid.frame((0.0, 0.0, 0.0), rigid.rotation_y(SLOPE))
    touch = rigid.box_plane(lambda q: rigid.frame(q["x"], turned(q)), np.full(3, side), plane)
    body = rigid.kinetic_energy(MASS, rigid.inertia.box(MASS, side, side, side), lambda q: q["x"], turned)

    def rubbing(q, qdot, multipliers, mu):
        return mu * jnp.sum(multipliers["corners"] * jnp.linalg.norm(touch.slip(q, qdot), axis=1))

    cube = jl.System(
        lambda q, qdot, g: body(q, qdot) - MASS * g * q["x"][2],
        dissipation={"rub": rubbing},
        holonomic={"unit": lambda q: rigid.unit(q["p"])},
        unilateral={"corners": touch.gap},
    )
    q0 = {"p": np.array(rigid.to_quaternion(plane.axes)), "x": side / 2 * np.array(plane.axes[:, 2])}
    still = {"p": np.zeros(4), "x": np.zeros(3)}

    def moved(T, mu, gravity=1.0):
        motion = jl.simulate(cube, q0, still, jnp.array([0.0, T / 2, T]) * second, {"g": gravity * g, "mu": mu})
        return (motion.q["x"] - q0["x"][None]) / metre, motion

    return moved, np.array(plane.axes[:, 0])


@pytest.mark.slow
def test_a_cube_on_a_slope():
    """Below the angle of friction it rests for 100 s without creep, above it slides at g (sin α − μ cos α)."""
    moved, downhill = cube_on_a_slope()
    away, motion = moved(100.0, 0.3)
    assert np.max(np.abs(away)) < 1e-16
    np.testing.assert_array_equal(motion.contacts["corners"].closed[-1], [True, False] * 4)
    np.testing.assert_allclose(motion.multipliers["corners"][-1].sum(), MASS * G * np.cos(SLOPE), rtol=1e-12)
    away, motion = moved(0.5, 0.1)
    rate = G * (np.sin(SLOPE) - 0.1 * np.cos(SLOPE))
    np.testing.assert_allclose(away, np.outer(0.5 * rate * np.array(motion.ts) ** 2, downhill), atol=1e-10)


@pytest.mark.slow
def test_derivatives_of_a_cube_on_a_slope():
    """In micrometres and kiloseconds: by friction and gravity, also without friction, and none where it rests."""
    moved, downhill = cube_on_a_slope(1e-6, 1e3)
    slopes = jax.jit(jax.jacfwd(lambda x: moved(0.5, *x)[0][-1] @ downhill))
    half, s, c = 0.5 * G * 0.5**2, np.sin(SLOPE), np.cos(SLOPE)
    for mu in (0.1, 0.0):
        np.testing.assert_allclose(slopes(jnp.array([mu, 1.0])), [-half * c, half * (s - mu * c)], rtol=1e-8)
    np.testing.assert_allclose(slopes(jnp.array([0.3, 1.0])), 0, atol=1e-16)
