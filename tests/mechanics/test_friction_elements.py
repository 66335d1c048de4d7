"""Dry friction is recognised however D is written: against closed forms and NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag import dissipation
from jaxlag._mechanics.friction_elements import find_elements
from jaxlag._model.flat import bind
from jaxlag._motion.formulation import Formulation
from jaxlag._motion.integrate import SolverOptions

T = lambda qdot: 0.5 * jnp.sum(qdot**2)
POINTS = np.array([[1.0, 0.0], [0.0, 2.0], [3.0, 4.0]])


def read(D, v, params):
    """The force −∂D/∂q̇ with ‖s‖ in place of each u, the bounds at rest, and the slip velocities; None where D is smooth."""

    @jax.jit
    def found(v, params):
        flat = bind(jl.System(T, dissipation=D), v, params)
        flat_v, rest = jnp.ravel(v), (jnp.zeros(()), jnp.zeros(v.size), jnp.zeros(v.size), jnp.zeros(0))
        elements = find_elements(flat)
        if elements is None:
            return None
        (lifted,) = elements.potentials.values()
        slip = lambda v: elements.slip(*rest[:2], v)
        force = -jax.grad(lambda v: lifted(*rest[:2], v, rest[3], elements.norms(slip(v))))(flat_v)
        bounds = jax.grad(lifted, argnums=4)(*rest, jnp.zeros(elements.size))
        return force.reshape(v.shape), bounds, slip(flat_v)

    return found(jnp.asarray(v, float), params)


def rowwise(points):
    return jnp.linalg.norm(points, axis=1)


@jax.jit
def hypot(x, y):  # a user's own function, which is no norm
    return x * y


THREE_POINTS = {
    "norm, axis": lambda qdot, k: jnp.sum(k * rowwise(qdot)),
    "vmap of speed": lambda qdot, k: k * jnp.sum(jax.vmap(dissipation.speed)(qdot)),
    "vmap of norm": lambda qdot, k: k * jnp.sum(jax.vmap(jnp.linalg.norm)(qdot)),
    "hypot": lambda qdot, k: k * jnp.sum(jnp.hypot(qdot[:, 0], qdot[:, 1])),
    "a loop": lambda qdot, k: k * sum(dissipation.speed(v) for v in qdot),
    "einsum": lambda qdot, k: k * jnp.sum(jnp.sqrt(jnp.einsum("ij,ij->i", qdot, qdot))),
    "einsum, weighted": lambda qdot, k: k / 3 * jnp.sum(jnp.sqrt(jnp.einsum("ij,ij,j->i", qdot, qdot, 9 * jnp.ones(2)))),
    "root of a sum": lambda qdot, k: k * jnp.sum(jnp.sqrt(jnp.sum(qdot**2, axis=1))),
    "a factor in the root": lambda qdot, k: k / jnp.sqrt(2.0) * jnp.sum(jnp.sqrt(2 * (qdot[:, 0] ** 2 + qdot[:, 1] ** 2))),
    "a parameter in the root": lambda qdot, k: jnp.sum(jnp.sqrt(k**2 * qdot[:, 0] ** 2 + k**2 * qdot[:, 1] ** 2)),
    "a diagonal": lambda qdot, k: k * jnp.sum(jnp.sqrt(jnp.diag(qdot @ qdot.T))),
    "stack": lambda qdot, k: k * jnp.sum(jnp.linalg.norm(jnp.stack([qdot[:, 0], qdot[:, 1]]), axis=0)),
    "concatenate": lambda qdot, k: jnp.sum(jnp.concatenate([k * rowwise(qdot[:1]), k * rowwise(qdot[1:])])),
    "scan": lambda qdot, k: jax.lax.scan(lambda D, v: (D + k * jnp.linalg.norm(v), None), 0.0, qdot)[0],
    "fori_loop": lambda qdot, k: jax.lax.fori_loop(0, 3, lambda i, D: D + k * jnp.linalg.norm(qdot[i]), 0.0),
    "map": lambda qdot, k: k * jnp.sum(jax.lax.map(dissipation.speed, qdot)),
    "half a power": lambda qdot, k: k * jnp.sum(jnp.sum(qdot**2, axis=1) ** 0.5),
    "a matrix": lambda qdot, k: k * jnp.sum(rowwise((jnp.roll(jnp.eye(6), 2, 0) @ qdot.ravel()).reshape(3, 2))),
    "zero at rest": lambda qdot, k: (
        k * jnp.sum(jax.vmap(lambda v: jnp.where(v @ v > 0, jnp.sqrt(jnp.where(v @ v > 0, v @ v, 1)), 0))(qdot))
    ),
    "a sign": lambda qdot, k: k * jnp.sum(-jnp.linalg.norm(-qdot, axis=1) * -1),
    "a branch": lambda q, qdot, k: jax.lax.cond(q[0, 0] > -1, lambda v: k * jnp.sum(rowwise(v)), lambda v: 0.0, qdot),
}


@pytest.mark.parametrize("D", THREE_POINTS.values(), ids=THREE_POINTS)
def test_three_sliding_points(D):
    """Each has a force of its own, −k s/‖s‖; written on arrays, they were taken for one point in six dimensions, or refused."""
    force, bounds, slip = read(D, POINTS, {"k": 0.7})
    np.testing.assert_allclose(force, -0.7 * POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True), rtol=1e-14)
    rows = np.asarray(slip).reshape(3, 2)
    np.testing.assert_allclose(
        np.asarray(bounds) * np.linalg.norm(rows, axis=1), 0.7 * np.linalg.norm(POINTS, axis=1)[order(rows)], rtol=1e-14
    )


def order(rows):
    """Which of the points each of some vectors is along."""
    return np.argmax(np.abs(rows @ (POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)).T), axis=1)


@pytest.mark.slow
def test_points_rest_and_slide_each_for_itself():
    load = np.array([[0.5, 0.5], [0.3, -0.9], [3.0, 0.0]])
    system = jl.System(T, dissipation=THREE_POINTS["norm, axis"], force=lambda load: load)
    at = lambda v, k: jl.acceleration(system, np.zeros((3, 2)), v, {"k": k, "load": load}).qddot
    np.testing.assert_allclose(at(np.zeros((3, 2)), 1.0), [[0, 0], [0, 0], [2, 0]], atol=1e-14)
    np.testing.assert_allclose(at(POINTS, 1.0), load - POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True), rtol=1e-14)
    slope = jax.jacfwd(at, argnums=1)(jnp.zeros((3, 2)), 1.0)
    np.testing.assert_allclose(slope, [[0, 0], [0, 0], [-1, 0]], atol=1e-14)


@pytest.mark.parametrize("seed", range(8))
def test_random_friction_against_numpy(seed):
    """Points of one to three dimensions, moving as A q̇ + b, with bounds of their own, written in a style drawn by lot."""
    rng = np.random.default_rng(seed)
    n, points, size = rng.integers(1, 6), rng.integers(1, 5), rng.integers(1, 4)
    A, b, F = rng.normal(size=(points, size, n)), rng.normal(size=(points, size)), rng.uniform(0.1, 2, points)
    drag, v = rng.uniform(0, 1), rng.normal(size=n)
    styles = [
        lambda s, F: jnp.sum(F * jnp.linalg.norm(s, axis=1)),
        lambda s, F: F @ jax.vmap(dissipation.speed)(s),
        lambda s, F: jnp.sum(jnp.sqrt(jnp.einsum("i,ij,ij->i", F**2, s, s))),
        lambda s, F: sum(jnp.sqrt(F[i] * F[i] * (s[i] @ s[i])) for i in range(len(s))),
        lambda s, F: jax.lax.fori_loop(0, len(s), lambda i, D: D + F[i] * jnp.sum(s[i] ** 2) ** 0.5, 0.0),
    ]
    style = styles[rng.integers(len(styles))]
    D = lambda qdot, F: style(A @ qdot + b, F) + drag * jnp.sum(jnp.linalg.norm(A @ qdot + b, axis=1) ** 3)
    force, bounds, slip = read(D, v, {"F": F})
    s = A @ v + b
    speed = np.linalg.norm(s, axis=1)
    expected = -np.einsum("i,ij,ijk->k", F / speed + 3 * drag * speed, s, A)
    np.testing.assert_allclose(force, expected, rtol=1e-12)
    assert len(bounds) == points and len(slip) == points * size


@jax.custom_jvp
def own_abs(v):
    return jnp.abs(v)


own_abs.defjvp(lambda v, dv: (jnp.abs(v[0]), jnp.sign(v[0]) * dv[0]))

ONE_POINT = {
    "v sign(v)": (lambda qdot, F: F * qdot * jnp.sign(qdot), 1, 1),
    "sign of a difference": (lambda qdot, F: F * (jnp.sign(2 * qdot) * qdot), 1, 1),
    "a product of vectors": (lambda qdot, F: F * jnp.stack([qdot, 1.0]) @ jnp.stack([jnp.sign(qdot), 0.0]), 1, 1),
    "max(v, -v)": (lambda qdot, F: F * jnp.maximum(qdot, -qdot), 1, 1),
    "min(v, -v)": (lambda qdot, F: -F * jnp.minimum(qdot, -qdot), 1, 1),
    "two relu": (lambda qdot, F: F * (jax.nn.relu(qdot) + jax.nn.relu(-qdot)), 1, 1),
    "one relu": (lambda qdot, F: F * jax.nn.relu(qdot), 1, 0),
    "two unlike relu": (lambda qdot, F: F * jax.nn.relu(qdot) + 2 * F * jax.nn.relu(-qdot), 1, 2),
    "a selected coefficient": (lambda qdot, F: jnp.where(qdot > 0, 3 * F, 1.5) * jnp.abs(qdot), 3, 1.5 / 0.7),
    "a selected slope": (lambda qdot, F: jnp.where(qdot > 0, F * qdot, -2 * F * qdot), 1, 2),
    "a selected sign": (lambda qdot, F: F * jnp.where(qdot >= 0, 1.0, -1.0) * qdot, 1, 1),
    "comparisons": (lambda qdot, F: (qdot > 0) * F * qdot - (qdot < 0) * 2 * F * qdot, 1, 2),
    "half a power": (lambda qdot, F: F * (qdot**2) ** 0.5, 1, 1),
    "the first power": (lambda qdot, F: F * jnp.abs(qdot) ** 1.0, 1, 1),
    "hypot with 0": (lambda qdot, F: F * jnp.hypot(qdot, 0.0), 1, 1),
    "scan": (lambda qdot, F: jax.lax.scan(lambda D, x: (D + F * jnp.abs(qdot) / 3, None), 0.0, jnp.arange(3))[0], 1, 1),
    "cond": (lambda q, qdot, F: jax.lax.cond(q > -1, lambda v: F * jnp.abs(v), lambda v: 0 * v, qdot), 1, 1),
    "a derivative of its own": (lambda qdot, F: F * own_abs(qdot), 1, 1),
    "stribeck of a maximum": (lambda qdot, F: dissipation.stribeck(jnp.maximum(qdot, -qdot), F, F, 0.1), 1, 1),
}


@pytest.mark.parametrize("D, forwards, backwards", ONE_POINT.values(), ids=ONE_POINT)
def test_one_sliding_point(D, forwards, backwards):
    """The bound of stick and slip is half the jump of the force; the mean of both sides is a force like any other."""
    for v, expected in ((0.7, -forwards), (-0.4, backwards)):
        force, bounds, slip = read(D, v, {"F": 0.7})
        np.testing.assert_allclose(force, 0.7 * expected, rtol=1e-14, atol=1e-15)
        np.testing.assert_allclose(bounds, 0.7 * (forwards + backwards) / 2, rtol=1e-14)
        np.testing.assert_allclose(np.abs(slip), abs(v), rtol=1e-15)


def _larger(v):  # √(1 + (1 + v)²) + |1 + v|: which of two forms to take, and no friction
    return jnp.sqrt(1 + (1 + v) ** 2) + jnp.where(1 + v > 0, 1 + v, -(1 + v))


SMOOTH = {
    "cube": lambda qdot, F: F * jnp.abs(qdot) ** 3,
    "drag of points": lambda qdot, F: F * jnp.sum(jnp.linalg.norm(jnp.array([[qdot, 1 * qdot], [qdot, 2 * qdot]]), axis=1) ** 3),
    "unlike dampers": lambda qdot, F, w: jnp.where(qdot > 0, w, F) * qdot**2,
    "one-sided damper": lambda qdot, F: F * jax.nn.relu(qdot) ** 2,
    "Huber": lambda qdot, F, w: F * jnp.where(jnp.abs(qdot) < w, qdot**2 / (2 * w), jnp.abs(qdot) - w / 2),
    "regularised": lambda qdot, F, w: F * jnp.sqrt(qdot**2 + w**2),
    "an exponent": lambda qdot, F, p: F * jnp.abs(qdot) ** p,
    "power law": lambda qdot, F, p: dissipation.power_law(qdot, F, p),
    "log cosh": lambda qdot, F, w: F * w * jnp.log(jnp.cosh(qdot / w)),
    "a stable form of two": lambda qdot, F: F * jnp.where(1 + qdot > 0, qdot**2 / _larger(qdot), _larger(qdot)),
    "a name": lambda qdot, F: F * hypot(qdot, qdot),
    "no velocity": lambda q, qdot, F: F * jnp.abs(q) * qdot**2,
}


@pytest.mark.fast
@pytest.mark.parametrize("D", SMOOTH.values(), ids=SMOOTH)
def test_what_is_smooth_stays_smooth(D):
    assert read(D, 0.7, {"F": 0.7, "w": 0.1, "p": 1.8}) is None


@pytest.mark.fast
@pytest.mark.parametrize("beside", [jnp.exp, jnp.tanh])
def test_a_sign_beside_the_absolute_value_that_is_not_read_is_refused(beside):
    """The bound at rest would be that of a sign of zero, which is neither side's."""
    with pytest.raises(ValueError, match="`dissipation` must depend on the sign of a slip velocity in a recognised way"):
        read(lambda qdot, F: F * beside(2 + jnp.sign(qdot)) * jnp.abs(qdot), 0.7, {"F": 0.7})


def test_friction_that_is_off_at_times_is_friction():
    """At the numbers that it was judged at once, between 0.5 and 1.5, each of these is zero: −3 came out at rest, where 0 is right."""
    system = jl.System(
        lambda qdot: 0.5 * (qdot["a"] ** 2 + qdot["b"] ** 2 + qdot["c"] ** 2),
        dissipation={
            "clock": lambda t, qdot: jnp.where(t > 2, 3, 0) * jnp.abs(qdot["a"]),
            "mode": lambda mode, qdot: jnp.where(mode == 2, 3, 0) * jnp.abs(qdot["b"]),
            "normal force": lambda N, qdot: jnp.maximum(N - 2, 0) * jnp.abs(qdot["c"]),
        },
        force=lambda: {"a": 1.0 * jnp.ones(()), "b": 1.0 * jnp.ones(()), "c": 1.0 * jnp.ones(())},
    )
    rest = dict.fromkeys("abc", 0.0)
    at = lambda t, mode, N: list(jl.acceleration(system, rest, rest, {"mode": mode, "N": N}, t=t).qddot.values())
    np.testing.assert_allclose(at(3.0, 2, 5.0), [0, 0, 0], atol=1e-14)
    np.testing.assert_allclose(at(1.0, 1, 1.0), [1, 1, 1], atol=1e-14)
    np.testing.assert_allclose(at(3.0, 2, 2.5), [0, 0, 0.5], atol=1e-14)


@pytest.mark.slow
def test_a_ratchet_stops_by_the_friction_of_its_side():
    """D = F₁ relu(v) + F₂ relu(−v): x = v₀²/2F₁ forwards, −v₀²/2F₂ backwards; it holds a load between −F₁ and F₂."""
    ratchet = jl.System(
        T,
        dissipation=lambda qdot, F1, F2: F1 * jax.nn.relu(qdot) + F2 * jax.nn.relu(-qdot),
        force=lambda load: load,
    )
    end = lambda v0, F1, F2, load: jl.simulate(ratchet, 0.0, v0, [0.0, 20.0], {"F1": F1, "F2": F2, "load": load}).q[-1]
    np.testing.assert_allclose(end(2.0, 0.5, 2.0, 0.0), 4.0, rtol=1e-7)
    np.testing.assert_allclose(end(-2.0, 0.5, 2.0, 0.0), -1.0, rtol=1e-7)
    np.testing.assert_allclose(end(0.0, 0.5, 2.0, -1.9), 0.0, atol=1e-12)
    np.testing.assert_allclose(end(0.0, 0.5, 2.0, 0.7), 0.2 * 400 / 2, rtol=1e-7)
    np.testing.assert_allclose(jax.grad(end, argnums=1)(2.0, 0.5, 2.0, 0.0), -4 / (2 * 0.25), rtol=1e-5)


def test_a_hundred_points():
    v = np.random.default_rng(0).normal(size=(100, 2))
    force, bounds, slip = read(THREE_POINTS["norm, axis"], v, {"k": np.linspace(1, 2, 100)})
    np.testing.assert_allclose(force, -np.linspace(1, 2, 100)[:, None] * v / np.linalg.norm(v, axis=1, keepdims=True), rtol=1e-14)
    np.testing.assert_array_equal(slip, v.ravel())
    np.testing.assert_allclose(bounds, np.linspace(1, 2, 100), rtol=1e-14)


spring = lambda q, qdot: 0.5 * qdot**2 - 2 * q**2
JUMPING = {
    "sign": lambda qdot, F: -F * jnp.sign(qdot),
    "steep": lambda qdot, F, k: -F * jnp.tanh(k * qdot),
    "a direction": lambda qdot, F: -F * qdot / jnp.abs(qdot),
    "a selection": lambda qdot, F: jnp.where(qdot > 0, -F, F),
}
GOING_ON = {
    "unlike dampers": lambda qdot, F: jnp.where(qdot > 0, -2 * F * qdot, -F * qdot),
    "a selection that meets": lambda qdot: jnp.where(qdot > 0, jnp.exp(qdot), 1.0),
    "a gentle slope": lambda qdot: -jnp.tanh(qdot),
    "drag": lambda qdot: -0.1 * qdot * jnp.abs(qdot),
    "of position": lambda q, F: -F * jnp.sign(q),
}


def test_friction_in_a_force_is_named_in_the_check_up():
    findings = jl.examine(jl.System(spring, force=JUMPING | GOING_ON), 1.0, 0.5, {"F": 0.3, "k": 1e5}).findings
    named = [finding for finding in findings if "write it as `dissipation`, D = F * jnp.abs(v)" in finding]
    assert [finding.split("'")[1] for finding in named] == list(JUMPING)


@pytest.mark.slow
def test_failures_name_friction_that_was_not_read():
    run = lambda **terms: jl.simulate(jl.System(spring, **terms), 1.0, 0.0, [0.0, 20.0], {"F": 0.3, "p": 1.0}, max_steps=1000)
    with pytest.raises(RuntimeError, match=r"`force` jumps with a velocity.*write it as `dissipation`, D = F \* jnp.abs\(v\)"):
        run(force=JUMPING["sign"])
    with pytest.raises(RuntimeError, match=r"`dissipation` is dry friction for these parameters only.*write F \* jnp.abs\(v\)"):
        run(dissipation=SMOOTH["an exponent"])
    with pytest.raises(RuntimeError, match=r"`dissipation` depends on the sign or the root of a velocity.*write F \* jnp.abs\(v\)"):
        run(dissipation=lambda qdot, F: F * jnp.exp(jnp.sign(qdot)) * qdot)
    with pytest.raises(TypeError, match="`friction` must be an object that makes the choice, but is None"):
        SolverOptions.of(None, Formulation(friction=None), 1000)  # under the hook of these tests `simulate` is refused before


@pytest.mark.parametrize("off, end", [(False, np.cos(2 * 5.0)), (True, 0.05)])
def test_a_switch_among_the_parameters(off, end):
    """A bare AssertionError came out where it was False. On: each half-swing loses 2F/c, until |x| ≤ F/c."""
    system = jl.System(spring, dissipation=lambda qdot, off: jnp.where(off, 0.3, 0.0) * jnp.abs(qdot))
    motion = jl.simulate(system, 1.0, 0.0, [0.0, 5.0, 20.0], {"off": off}, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(motion.q[1 if not off else 2], end, atol=1e-7)


OTHER_NUMBERS = {  # factors of one
    "complex": lambda q: jnp.real((1 + 0j * jnp.sum(q)) ** 2),
    "half precision": lambda q: (1 + 0 * jnp.sum(q).astype(jnp.float16)).astype(q.dtype),
    "a key of random numbers": lambda q: 1 + 0 * jax.random.normal(jax.random.key(1)),
}


@pytest.mark.parametrize("name", OTHER_NUMBERS)
def test_other_numbers_beside_dry_friction_are_left_to_jax(name):
    force, bounds, slip = read(lambda q, qdot, F: OTHER_NUMBERS[name](q) * F * jnp.sum(jnp.abs(qdot)), np.array([2.0, -1.0]), {"F": 0.3})
    np.testing.assert_allclose(force, [-0.3, 0.3])
    np.testing.assert_allclose(bounds, [0.3, 0.3])


@pytest.mark.slow
def test_a_motion_with_friction_beside_other_numbers():
    """An oscillator of stiffness 4 is released at 1: each half-swing loses 2F/c, and after the seventh it rests at 14 F/c − 1."""
    factor = lambda q, key: OTHER_NUMBERS["complex"](q) * OTHER_NUMBERS["half precision"](q) * (1 + 0 * jax.random.normal(key))
    system = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2 * q**2, dissipation=lambda q, qdot, F, key: factor(q, key) * F * jnp.abs(qdot))
    rest = lambda F: jl.simulate(system, 1.0, 0.0, [0.0, 20.0], {"F": F, "key": jax.random.key(1)}).q[-1]
    np.testing.assert_allclose(jax.value_and_grad(rest)(0.3), [0.05, 3.5], rtol=1e-6)


@pytest.mark.slow
def test_dry_friction_in_complex_numbers_is_named():
    system = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2 * q**2, dissipation=lambda qdot: 0.3 * jnp.abs(qdot + 0j))
    with pytest.raises(RuntimeError, match="is not recognised as dry friction: if it is, write"):
        jl.simulate(system, 1.0, 0.0, [0.0, 20.0], max_steps=3000)


@pytest.mark.parametrize("q", [0.3, -5e-3, 1e-9])
def test_a_bound_in_proportion_to_a_distance_however_small(q):
    wedge = jl.System(lambda qdot: 0.5 * 2.0 * qdot @ qdot, dissipation=lambda q, qdot: 3.0 * jnp.abs(q[0]) * jnp.abs(qdot[1]))
    found = jl.acceleration(wedge, jnp.array([q, 0.0]), jnp.array([0.0, -0.7])).qddot
    np.testing.assert_allclose(found, [0.0, 1.5 * abs(q)], rtol=1e-14)
