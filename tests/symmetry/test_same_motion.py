"""The same motion asked for otherwise: cut and continued, at other samples, backwards, as one of many, in single precision, on a rod."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from generate import drawn
from machines import gyroscope, gyroscope_in_quaternions
from net import reference
from transform import in_units, inputs_of, plain

import jaxlag as jl
from jaxlag import rigid

CUT = 8


def posed(kind, seed=0, n=2):
    case = drawn(kind, n, seed)
    allowed = {name: np.max(x) for name, x in reference(case, "motion").allowed.items()}
    return in_units(case), inputs_of(case, plain(case)), allowed


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["smooth", "dry", pytest.param("contact", marks=pytest.mark.slow)])
def test_a_motion_cut_and_continued(kind):
    system, i, allowed = posed(kind)
    whole = jl.simulate(system, i.q, i.qdot, i.ts, i.params, works=True)
    cut = whole[CUT]
    rest = jl.simulate(system, cut.q, cut.qdot, i.ts[CUT:], i.params, works=True)
    for name, x, y in (("q", rest.q, whole.q), ("q̇", rest.qdot, whole.qdot), ("q̈", rest.qddot, whole.qddot)):
        np.testing.assert_allclose(x, y[CUT:], rtol=0, atol=2 * allowed[name])
    for name, work in whole.work().items():
        if f"W {name}" in allowed:
            np.testing.assert_allclose(rest.work()[name], work[CUT:] - work[CUT], rtol=0, atol=2 * allowed[f"W {name}"])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["smooth", "dry"])
def test_a_motion_at_fewer_samples(kind):
    system, i, allowed = posed(kind)
    whole = jl.simulate(system, i.q, i.qdot, i.ts, i.params, works=True)
    fewer = jl.simulate(system, i.q, i.qdot, i.ts[[0, 3, 16]], i.params, works=True)
    np.testing.assert_allclose(fewer.q, whole.q[np.array([0, 3, 16])], rtol=0, atol=2 * allowed["q"])
    if kind == "dry":
        np.testing.assert_array_equal(fewer.stats["transitions"], whole.stats["transitions"][np.array([0, 3, 16])])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_motion_backwards(seed):
    """Where nothing dissipates or drives, it comes back with the opposite velocity."""
    system, i, allowed = posed("smooth", seed)
    free = i.params | {name: 0.0 * np.asarray(i.params[name]) for name in ("C", "d", "b")}
    there = jl.simulate(system, i.q, i.qdot, i.ts, free, works=True)[-1]
    back = jl.simulate(system, there.q, -there.qdot, i.ts, free, works=True)[-1]
    np.testing.assert_allclose(back.q, i.q, rtol=0, atol=20 * allowed["q"])
    np.testing.assert_allclose(back.qdot, -i.qdot, rtol=0, atol=20 * allowed["q̇"])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["smooth", "dry"])
def test_a_motion_as_one_of_many(kind):
    system, i, allowed = posed(kind)
    alone = jl.simulate(system, i.q, i.qdot, i.ts, i.params)
    many = jl.simulate_many(system, i.q, i.qdot, i.ts, i.params | {"c": np.array([i.params["c"]])}, over=("c",))
    np.testing.assert_allclose(many.q[0], alone.q, rtol=0, atol=2 * allowed["q"])


@pytest.mark.parametrize(
    "kind", ["smooth", pytest.param("holonomic", marks=pytest.mark.slow), pytest.param("massless", marks=pytest.mark.slow)]
)
def test_an_acceleration_in_single_precision(kind, single_precision):
    jax.config.update("jax_enable_x64", True)
    system, i, _ = posed_at_once(kind)
    double = np.asarray(jl.acceleration(system, i.q, i.qdot, i.params).qddot)
    jax.config.update("jax_enable_x64", False)
    less = jax.tree.map(lambda x: np.asarray(x, np.float32), (i.q, i.qdot, i.params))
    single = np.asarray(jl.acceleration(system, *less).qddot)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, double, rtol=0, atol=1e2 * np.finfo(np.float32).eps * np.max(np.abs(double)))


def posed_at_once(kind):
    case = drawn(kind, 2, 0)
    return in_units(case), inputs_of(case, plain(case)), case


@pytest.mark.slow
def test_a_rod_in_its_angle_and_in_x_and_y():
    """Pendulum with air: the angle's model against the rod's, forward and in derivatives by its length."""
    angle = jl.System(
        lambda q, qdot, m, g, l: 0.5 * m * (l * qdot) ** 2 + m * g * l * jnp.cos(q),
        dissipation=lambda qdot, b, l: 0.5 * b * (l * qdot) ** 2,
    )
    rod = jl.System(
        lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1],
        dissipation=lambda qdot, b: 0.5 * b * qdot @ qdot,
        holonomic=lambda q, l: jnp.hypot(q[0], q[1]) - l,
    )
    ts, params = np.linspace(0, 5, 11), {"m": 2.0, "g": 9.81, "b": 0.1}
    on_circle = lambda phi, l: l * jnp.stack([jnp.sin(phi), -jnp.cos(phi)], axis=-1)
    by_angle = lambda l: on_circle(jl.simulate(angle, 1.0, 0.0, ts, params | {"l": l}).q, l)
    by_rod = lambda l: jl.simulate(rod, on_circle(1.0, l), jnp.zeros(2), ts, params | {"l": l}).q
    np.testing.assert_allclose(by_rod(1.5), by_angle(1.5), rtol=0, atol=1e-6)
    np.testing.assert_allclose(jax.jacfwd(by_rod)(1.5), jax.jacfwd(by_angle)(1.5), rtol=0, atol=1e-5)


@pytest.mark.slow
def test_a_gyroscope_in_angles_and_in_a_quaternion():
    """The axis of a top that spins fast, through its nods."""
    by_angles, by_numbers = (moved(make()) for make in (gyroscope, gyroscope_in_quaternions))
    expected = jax.vmap(lambda q: rigid.euler("zxz")(list(q)))(by_angles)[:, :, 2]
    np.testing.assert_allclose(jax.vmap(rigid.quaternion)(by_numbers)[:, :, 2], expected, rtol=0, atol=1e-8)


def moved(case):
    i = inputs_of(case, plain(case))
    return jl.simulate(in_units(case), i.q, i.qdot, i.ts, i.params, rtol=1e-10).q


def test_new_coordinates_by_substitution():
    """q = y + 0.3 sin y by `substitute`: the accelerations of the system in q."""
    system, i, case = posed_at_once("smooth")
    new = jl.substitute(system, place)
    y, v = np.array([0.4, -0.7]), np.array([1.1, 0.6])
    slope, bend = 1 + 0.3 * np.cos(y), -0.3 * np.sin(y)
    found = jl.acceleration(new, y, v, i.params).qddot
    expected = jl.acceleration(system, place(y), slope * v, i.params).qddot
    np.testing.assert_allclose(slope * found + bend * v**2, expected, rtol=1e-12, atol=1e-12)


def place(q):
    return q + 0.3 * jnp.sin(q)
