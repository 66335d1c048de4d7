"""Whatever a function returns may be plain numbers: each slot with each kind of them, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

NUMBERS = {
    "float": 2.0,
    "integer": 2,
    "NumPy scalar": np.float32(2),
    "integer array": np.array(2),
    "JAX integer": jnp.asarray(2),
}
VECTORS = {
    "list": [2.0, -1.0],
    "tuple": (2, -1),
    "list of kinds": [np.float32(2), jnp.asarray(-1)],
    "integer array": np.array([2, -1]),
    "JAX integer array": jnp.asarray([2, -1]),
}
ONES, REST = jnp.ones(2), jnp.zeros(2)


def kinetic(qdot):
    return 0.5 * jnp.sum(qdot**2)


def each(make, kinds):
    """`make` of each kind, in one program, with what each has to be."""
    return jax.jit(lambda: {name: make(kind) for name, kind in kinds.items()})()


def accelerated(q, v, **terms):
    return jl.acceleration(jl.System(kinetic, **terms), q, v)


def all_equal(found, expected):
    for name, value in found.items():
        leaves = jax.tree.leaves(value)
        assert all(leaf.dtype == jnp.float64 for leaf in leaves), name
        np.testing.assert_allclose(np.concatenate([np.ravel(leaf) for leaf in leaves]), expected, atol=1e-14, err_msg=name)


@pytest.mark.fast
def test_energies():
    energies = lambda x: jl.System({"T": kinetic, "V": lambda: x}, dissipation=lambda: x)
    all_equal(each(lambda x: (jl.acceleration(energies(x), 1.0, 3.0).qddot, jl.energy(energies(x), 1.0, 3.0)), NUMBERS), [0.0, 4.5 - 2.0])


def test_forces():
    all_equal(each(lambda x: accelerated(1.0, 0.0, force=lambda: x).qddot, NUMBERS), 2.0)
    all_equal(each(lambda x: accelerated(ONES, REST, force=lambda: x).qddot, VECTORS), [2.0, -1.0])
    all_equal(each(lambda x: accelerated(ONES, REST, force=lambda q: [x, -q[1]]).qddot, NUMBERS), [2.0, -1.0])


def test_forces_on_named_coordinates():
    T = lambda qdot: 0.5 * qdot["s"] ** 2 + 0.5 * jnp.sum(qdot["x"] ** 2)
    q, v = {"s": 1.0, "x": ONES}, {"s": 0.0, "x": REST}
    found = lambda force: jl.acceleration(jl.System(T, force=force), q, v).qddot
    all_equal(each(lambda x: found(lambda: {"s": x, "x": 0.0}), NUMBERS), [2.0, 0.0, 0.0])
    all_equal(each(lambda x: found(lambda: {"x": x, "s": 0}), VECTORS), [0.0, 2.0, -1.0])
    all_equal(each(lambda x: found(lambda: {"x": x}), VECTORS), [0.0, 2.0, -1.0])


def test_constraints():
    """A bead that a force of 3 pushes along x: held there by λ = −3; the row of plain numbers holds nothing."""
    push = lambda: [3.0, 5]
    held = lambda x: accelerated(ONES, REST, force=push, holonomic=lambda q: [q[0] - 1, x])
    all_equal(each(lambda x: (held(0 * x).qddot, held(0 * x).multipliers["holonomic"][0]), NUMBERS), [0.0, 5.0, -3.0])
    rolling = lambda x: accelerated(ONES, REST, force=push, nonholonomic=lambda qdot: (x, qdot[0]))
    all_equal(each(lambda x: (rolling(x).qddot, rolling(x).multipliers["nonholonomic"][1]), NUMBERS), [0.0, 5.0, -3.0])


def test_points_and_efforts():
    """δW = F · δx of a point (q₀, 3): the second component does none."""
    working = lambda point, effort: accelerated(ONES, REST, force=jl.virtual_work(point, effort)).qddot
    for point in (lambda q: (q[0], 3), lambda q: [q[0], 3.0]):
        np.testing.assert_array_equal(working(point, (2, -1)), [2, 0])
        np.testing.assert_array_equal(jl.rate(point)(q=ONES, qdot=jnp.array([7.0, 1.0])), [7, 0])
    all_equal(each(lambda F: working(lambda q: (q[0], 3), lambda: F), VECTORS), [2.0, 0.0])
    all_equal(each(lambda F: working(lambda q: q[1], lambda: F), NUMBERS), [0.0, 2.0])
    all_equal(each(lambda x: working(lambda: x, lambda: 1), NUMBERS), [0.0, 0.0])
    wall = jl.System(kinetic, force=lambda: [4, 0], holonomic={"wall": lambda q: 2 * q[0] - 2})
    on_point = lambda x: jl.constraint_force(wall, ONES, REST, at=lambda q: (q[0], x))["wall"]
    all_equal(each(on_point, NUMBERS), [-4.0, 0.0])


def test_new_coordinates():
    """The pendulum from x and y: φ̈ = −(g/l) sin φ − (b/l) φ̇ + F cos φ/(m l)."""
    plane = jl.System(lambda q, qdot: 0.5 * qdot @ qdot - 9.81 * q[1], dissipation=lambda qdot: 0.25 * qdot @ qdot, force=lambda: (3, 0))
    for shape in (list, tuple):
        swung = jl.substitute(plane, lambda q, shape=shape: shape([2 * jnp.sin(q), -2 * jnp.cos(q)]))
        np.testing.assert_allclose(
            jl.acceleration(swung, 0.5, 0.4).qddot, -9.81 / 2 * np.sin(0.5) - 0.5 * 0.4 + 3 * np.cos(0.5) / 2, rtol=1e-14
        )
    along = each(lambda x: jl.acceleration(jl.substitute(plane, lambda q: [q, x]), 0.5, 0.0).qddot, NUMBERS)
    all_equal(along, 3.0)


def test_sensors_and_delays():
    ts = np.linspace(0, 2, 9)
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, force=lambda: 0)
    shown = {name: np.full(ts.size, 2.0) for name in NUMBERS}
    sensors = lambda q: {"x": [q, 1]} | NUMBERS
    values = {"x": [np.cos(2 * ts), np.ones(ts.size)]} | shown
    found = jl.fit(oscillator, jl.Experiment(ts, values, 1, 0, observe=sensors, delay=lambda: 0), {"c": 3}, free=("c",))
    np.testing.assert_allclose(found.estimates["c"], 4.0, rtol=1e-7)


def test_on_paper():
    system = jl.System(lambda qdot, m: 0.5 * m * (qdot[0] ** 2 + qdot[1] ** 2), force=lambda F: (F, 0), holonomic=lambda q: [q[1], 0])
    paper = jl.equations(system, ["x", "y"], {"m": "m", "F": "F"})
    assert "m ẍ = F\n" in str(paper)


def test_precision_is_that_of_the_coordinates():
    q, v = jnp.ones(2, jnp.float32), jnp.zeros(2, jnp.float32)
    system = jl.System({"T": kinetic, "V": lambda: 1}, force=lambda: [1, np.float64(2)], holonomic=lambda q: (q[0] - 1, 0.0))
    found = jl.acceleration(system, q, v)
    assert {leaf.dtype for leaf in jax.tree.leaves(found)} == {jnp.dtype(jnp.float32)}
    point = jl.constraint_force(system, q, v, at=lambda q: (q[0], 0))
    assert {leaf.dtype for leaf in jax.tree.leaves(point)} == {jnp.dtype(jnp.float32)}


@pytest.mark.parametrize("dtype", [np.float16, jnp.bfloat16, np.longdouble, np.int16])
def test_coordinates_of_a_precision_that_cannot_be_computed_in(dtype):
    """Half precision and long doubles are taken as Python's floats are."""
    found = jl.acceleration(jl.System(kinetic, force=lambda q, c: -c * q), np.ones(2, dtype), np.zeros(2, dtype), {"c": dtype(3)})
    assert found.qddot.dtype == jnp.float64
    np.testing.assert_array_equal(found.qddot, [-3, -3])


def test_derivatives_pass():
    force = lambda F: [F, 0]
    accelerated_by = lambda F: jl.acceleration(jl.System(kinetic, force=force), ONES, REST, {"F": F}).qddot
    np.testing.assert_array_equal(jax.jacfwd(accelerated_by)(2.0), [1, 0])
    np.testing.assert_array_equal(jax.vmap(accelerated_by)(jnp.arange(3.0)), [[0, 0], [1, 0], [2, 0]])


REFUSED = {
    "truth": True,
    "complex number": 1j,
    "nothing": None,
    "text": "1",
    "truths": np.array([True, False]),
    "complex array": jnp.ones(2) * 1j,
}
SAID = {"truth": "a bool: True", "complex number": "a complex: 1j", "nothing": "nothing", "text": "a str: '1'"}
SLOTS = {
    "`lagrangian`": lambda x: accelerate(jl.System(lambda: x)),
    "`dissipation` 'oil'": lambda x: accelerate(jl.System(kinetic, dissipation={"oil": lambda: x})),
    "`force`": lambda x: accelerate(jl.System(kinetic, force=lambda: x)),
    "`holonomic`": lambda x: accelerate(jl.System(kinetic, holonomic=lambda: x)),
    "`nonholonomic`": lambda x: accelerate(jl.System(kinetic, nonholonomic=lambda: x)),
    "`coordinate`": lambda x: accelerate(jl.System(kinetic, force=jl.virtual_work(lambda: x, 1.0))),
    "`effort`": lambda x: accelerate(jl.System(kinetic, force=jl.virtual_work(lambda q: q, lambda: x))),
    "`coordinates`": lambda x: accelerate(jl.substitute(jl.System(kinetic), lambda: x)),
    "a position map": lambda x: jl.constraint_force(jl.System(kinetic, holonomic=lambda q: q), ONES, REST, at=lambda: x),
}


def accelerate(system):
    return jl.acceleration(system, ONES, REST)


@pytest.mark.fast
@pytest.mark.parametrize("slot", SLOTS)
@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_no_real_number_is_refused(slot, kind):
    with pytest.raises(TypeError, match=f"^{slot} must return real numbers, but returned {SAID.get(kind, 'an array of shape')}"):
        SLOTS[slot](REFUSED[kind])


OF_ANOTHER_SHAPE = {
    "a number for a vector": (lambda: 1.5, r"`force` must be real and of shape \(2,\), but is the number 1.5\. Return one entry"),
    "an array of zeros": (lambda: jnp.zeros(()), r"`force` must be real and of shape \(2,\), but is an array of shape \(\)"),
    "too long a list": (lambda: [1, 2, 3], r"`force` must be real and of shape \(2,\), but has 3 entries"),
    "too short a tuple": (lambda: (1,), r"`force` must be real and of shape \(2,\), but has 1 entries"),
    "a list of vectors": (
        lambda: [ONES, ONES],
        r"`force` must be real and of shape \(2,\), but is of 2 entries with an array of shape \(2,\)",
    ),
    "nothing at all": (lambda q: {}, r"`force` must be real and of shape \(2,\), but nothing was returned"),
    "names": (lambda: {"x": 1.0}, r"`force` must be real and of shape \(2,\), but is of 1 entries with the number 1"),
}


@pytest.mark.fast
@pytest.mark.parametrize("case", OF_ANOTHER_SHAPE)
def test_a_force_of_another_shape_is_refused(case):
    force, said = OF_ANOTHER_SHAPE[case]
    with pytest.raises(ValueError, match=said):
        accelerate(jl.System(kinetic, force=force))


def test_a_plain_zero_is_zeros_of_any_shape():
    for zero in (0, 0.0, np.float32(0)):
        np.testing.assert_array_equal(accelerate(jl.System(kinetic, force=lambda zero=zero: zero)).qddot, [0, 0])


@pytest.mark.fast
@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd, lambda f: jax.jit(jax.grad(f))], ids=["grad", "jacfwd", "jit of grad"])
@pytest.mark.parametrize("slot", ["force", "update"])
def test_a_function_that_closes_over_what_is_differentiated_is_refused_by_name(slot, derivative):
    """It ended in errors of JAX on compiler options and on loops; the value alone was right."""

    def end(net):
        policy = lambda q, qdot: net["weights"] @ jnp.array([q, qdot])
        if slot == "force":
            system = jl.System(kinetic, force=policy)
        else:
            system = jl.System(kinetic, force=lambda u: u, states={"u": jl.Sampled(policy, every=0.1, start=0.0)})
        return jl.simulate(system, 1.0, 0.0, [0.0, 1.0]).q[-1]

    with pytest.raises(ValueError, match="closes over 'net', which is being differentiated. Make 'net' an entry of params"):
        derivative(end)({"weights": jnp.array([-1.0, -0.5])})
