"""Learnt potentials: what is built in holds for any weights, and what is left open is learnt."""

import functools
import re
import warnings
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import make_stribeck
import numpy as np
import optax
import pytest
from jax.flatten_util import ravel_pytree
from scipy.optimize import isotonic_regression

import jaxlag as jl
from jaxlag._motion.derivative_rule import FORWARD_LIMIT
from jaxlag.examples import stribeck
from jaxlag.learnt import ConvexDissipation, ConvexPotential, PassiveDissipation, Potential

DISSIPATIONS = (ConvexDissipation, PassiveDissipation)
CLASSES = (*DISSIPATIONS, Potential, ConvexPotential)
SCALE = {"phi": 0.2, "x": 1.5}
SIZES = (0.3, 3.0, 30.0, 3000.0)  # of random weights, from tame to absurd
eps = jnp.finfo(float).eps

every_class = pytest.mark.parametrize("cls", CLASSES)
every_dissipation = pytest.mark.parametrize("cls", DISSIPATIONS)


class States(NamedTuple):
    x: jax.Array
    D: jax.Array
    slope: jax.Array
    hessian: jax.Array
    half_way: jax.Array  # D(x/2)
    chord: jax.Array  # the mean of D(x) and of D at another x
    sag: jax.Array  # D at the midpoint between them


@functools.cache
def random_states(cls):
    """400 networks with random weights of all sizes, at 25 random velocities each."""

    def draw(key, size, x):
        net = cls(SCALE, power=2.0, key=key)
        flat, unravel = ravel_pytree(net)
        net = unravel(size * jax.random.normal(key, flat.shape))
        D = lambda x: net(dict(zip(SCALE, x, strict=True)))

        def at(x, y):
            D_x, half_way, D_y, sag = jax.vmap(D)(jnp.stack([x, x / 2, y, (x + y) / 2]))
            return States(x, D_x, jax.grad(D)(x), jax.hessian(D)(x), half_way, (D_x + D_y) / 2, sag)

        return jax.vmap(at)(x, jnp.roll(x, 1, axis=0))

    keys = jax.random.split(jax.random.key(0), 401)
    x = 10 ** jax.random.uniform(keys[0], (400, 25, 1), minval=-6, maxval=2) * jax.random.normal(keys[0], (400, 25, 2))
    states = jax.jit(jax.vmap(draw))(keys[1:], jnp.tile(jnp.array(SIZES), 100), x)
    return jax.tree.map(lambda out: out.reshape(-1, *out.shape[2:]), states)


@pytest.mark.slow
@every_dissipation
def test_ten_thousand_random_states_are_passive_and_finite(cls):
    at = random_states(cls)
    assert at.D.size == 10_000 and all(jnp.all(jnp.isfinite(leaf)) for leaf in at)
    power, rounding = jnp.sum(at.x * at.slope, axis=1), 1e3 * eps * (jnp.sum(jnp.abs(at.x * at.slope), axis=1) + at.D)
    assert jnp.all(at.D >= 0) and jnp.all(power >= -rounding) and jnp.mean(power > 0) > 0.99
    assert jnp.all(at.half_way <= at.D * (1 + 1e3 * eps))  # D grows on every ray


@pytest.mark.slow
def test_a_convex_network_is_convex_and_a_passive_one_need_not_be():
    at, free = random_states(ConvexDissipation), random_states(PassiveDissipation)
    curvature = jnp.linalg.eigvalsh(at.hessian)
    assert jnp.all(curvature[:, 0] >= -1e3 * eps * curvature[:, 1])
    assert jnp.all(jnp.sum(at.x * at.slope, axis=1) >= at.D * (1 - 1e3 * eps))
    assert jnp.all(at.sag <= at.chord * (1 + 1e3 * eps)) and jnp.mean(at.sag < 0.99 * at.chord) > 0.5
    assert jnp.mean(jnp.linalg.eigvalsh(free.hessian)[:, 0] < 0) > 0.1 and jnp.mean(free.sag > 1.01 * free.chord) > 0.05


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("make", [*DISSIPATIONS, lambda *a, power, **k: ConvexPotential(*a, energy=power, **k)])
def test_at_rest_value_and_slope_are_zero_to_the_last_bit(make, dtype):
    net = make({"a": jnp.ones(3), "b": 0.1}, power=7.0, key=jax.random.key(4))
    flat, unravel = ravel_pytree(net)
    weights = jnp.repeat(jnp.array(SIZES), 20)[:, None] * jax.random.normal(jax.random.key(5), (80, flat.size))
    rest = {"a": jnp.zeros(3, dtype), "b": jnp.zeros((), dtype)}

    def at_rest(weights):
        net = jax.tree.map(lambda w: w.astype(dtype), unravel(weights))
        return jax.value_and_grad(lambda v: net(v))(rest)

    for value in jax.tree.leaves(jax.jit(jax.vmap(at_rest))(weights)):
        assert value.dtype == dtype
        np.testing.assert_array_equal(value, 0.0)


@every_dissipation
def test_single_precision_loses_nothing_near_rest(cls):
    """Where a difference of equal numbers would leave rounding alone: the slope at 1e-8 of the scale, right to 1e-5."""
    net = cls(1.0, key=jax.random.key(6))
    v = jnp.concatenate([jnp.geomspace(-1e-8, -10.0, 50), jnp.geomspace(1e-8, 10.0, 50)])
    single = jax.tree.map(lambda x: x.astype("float32"), (net, v))
    np.testing.assert_allclose(stribeck.friction_of(*single), stribeck.friction_of(net, v), rtol=1e-5)


@every_class
def test_scale_and_structure(cls):
    """In units of scale every network is the same function, of a scalar, a vector, a dict."""
    size = {"power": 6.0} if cls in DISSIPATIONS else {"energy": 6.0}
    net, unit = cls(SCALE, key=jax.random.key(7), **size), cls({"phi": 1.0, "x": 1.0}, key=jax.random.key(7))
    state = {"x": 0.9, "phi": -0.3}
    np.testing.assert_allclose(net(state), 6 * unit(jnp.array([-1.5, 0.6])), rtol=1e-12)
    np.testing.assert_array_equal(net(state), net(jnp.array([-0.3, 0.9])))
    scalar = cls(0.5, key=jax.random.key(7))
    np.testing.assert_array_equal(scalar(0.2), scalar(jnp.array([0.2])))
    np.testing.assert_array_equal(jax.jit(lambda net, v: net(v))(scalar, 0.2).shape, ())
    assert all(eqx.is_inexact_array(leaf) for leaf in jax.tree.leaves(net))  # weights alone: scale and size are no parameters


def trained(net, v, force, steps=1500):
    """The network whose slope is `force` at the speeds `v`, in least squares, by Adam."""
    adam = optax.adam(optax.cosine_decay_schedule(5e-2, steps))
    loss = lambda net: jnp.mean((stribeck.friction_of(net, v) - force) ** 2)

    def step(carry, _):
        net, state = carry
        updates, state = adam.update(jax.grad(loss)(net), state)
        return (optax.apply_updates(net, updates), state), None

    return jax.jit(lambda net: jax.lax.scan(step, (net, adam.init(net)), length=steps)[0][0])(net)


def off(net, v, force):
    """Root mean square of what is wrong, relative to the force."""
    return float(jnp.linalg.norm(stribeck.friction_of(net, v) - force) / jnp.linalg.norm(force))


def nearest_that_rises(force):
    """The same of the best slope any convex D has at increasing speeds, by SciPy."""
    return np.linalg.norm(isotonic_regression(force).x - force) / np.linalg.norm(force)


V = jnp.concatenate([jnp.linspace(-0.42, -0.05, 100), jnp.linspace(-0.0495, 0.0495, 100), jnp.linspace(0.05, 0.42, 100)])


@pytest.mark.slow
def test_a_convex_network_learns_dampers():
    linear_and_drag = 3.0 * V + 20.0 * V * jnp.abs(V)
    assert off(trained(ConvexDissipation(0.1, power=0.3, key=jax.random.key(0)), V, linear_and_drag), V, linear_and_drag) < 0.01
    bump_and_rebound = 5.0 * V + 3.0 * (jnp.hypot(V, 0.05) - 0.05)  # slope 2 one way, 8 the other
    assert off(trained(ConvexDissipation(0.1, power=0.3, key=jax.random.key(0)), V, bump_and_rebound), V, bump_and_rebound) < 0.01


@pytest.mark.slow
def test_the_passive_network_learns_stribecks_curve_and_no_convex_one_can():
    force = stribeck.true_friction(V)
    least = nearest_that_rises(force)
    assert least > 0.1
    convex, passive = (trained(cls(0.1, power=0.5, key=jax.random.key(0)), V, force) for cls in DISSIPATIONS)
    assert off(passive, V, force) < 0.01
    assert least <= off(convex, V, force) < 1.4 * least  # as far as it can get


def speed(net, ts, start=(0.0, 0.2), **numerics):
    """Of the example's axis."""
    motion = jl.simulate(stribeck.system, *start, ts, stribeck.params | {"net": net}, **numerics)
    assert not motion.friction  # none that sticks is read into a learnt D
    return motion.qdot


@pytest.mark.slow
def test_gradient_of_a_motion_with_respect_to_all_weights():
    """Reverse, by the transposed solve, and forward, against central differences."""
    net, ts = PassiveDissipation(0.1, power=0.5, width=9, key=jax.random.key(8)), jnp.linspace(0.0, 0.3, 4)
    flat, unravel = ravel_pytree(net)
    assert flat.size > FORWARD_LIMIT
    outcome = lambda net, rtol=1e-8, atol=1e-10: jnp.sum(jnp.cos(3 * ts) * speed(net, ts, rtol=rtol, atol=atol))
    along = jax.random.normal(jax.random.key(9), flat.shape)
    moved = lambda h: float(outcome(unravel(flat + h * along), 1e-11, 1e-13))
    expected = (8 * (moved(5e-3) - moved(-5e-3)) - moved(1e-2) + moved(-1e-2)) / 6e-2
    gradient, _ = ravel_pytree(jax.grad(outcome)(net))
    np.testing.assert_allclose(gradient @ along, expected, rtol=1e-7)
    np.testing.assert_allclose(jax.jvp(outcome, (net,), (unravel(along),))[1], expected, rtol=1e-7)


@pytest.mark.slow
def test_batches_of_networks_and_single_precision():
    ts = jnp.linspace(0.0, 0.3, 4)
    nets = jax.vmap(lambda key: ConvexDissipation(0.1, power=0.5, width=4, key=key))(jax.random.split(jax.random.key(10), 3))
    double = jax.vmap(lambda net: speed(net, ts))(nets)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it is said once that precision is single
        single = speed(jax.tree.map(lambda w: w[1].astype("float32"), nets), ts, jnp.array([0.0, 0.2], "float32"))
    assert single.dtype == "float32" and jnp.ptp(double[:, -1]) > 1e-2
    np.testing.assert_allclose(single, double[1], atol=1e-4)


@pytest.mark.slow
def test_a_potential_conserves_energy_and_is_bounded():
    net = Potential({"x": 0.3, "y": 0.5}, energy=4.0, key=jax.random.key(11))
    system = jl.System(lambda q, qdot, m, net: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2) - net(q))
    start = {"x": 0.1, "y": -0.2}, {"x": 0.3, "y": 0.4}
    motion = jl.simulate(system, *start, jnp.linspace(0, 2, 21), {"m": 2.0, "net": net}, rtol=1e-10, atol=1e-12)
    energy = motion.energy()
    assert jnp.ptp(jax.vmap(net)(motion.q)) > 1e-2
    np.testing.assert_allclose(energy, energy[0], atol=1e-8)
    far = jax.vmap(net)({"x": jnp.array([1e9, -1e9]), "y": jnp.array([-1e9, 1e9])})
    assert jnp.all(jnp.abs(far) <= 4.0 * jnp.sum(jnp.abs(net.layers[-1].weight)))


def test_a_convex_potential_has_its_minimum_at_rest():
    net = ConvexPotential({"x": 0.3, "y": 0.5}, rest={"x": 1.0, "y": -2.0}, energy=4.0, key=jax.random.key(12))
    away = jax.random.normal(jax.random.key(13), (500, 2))
    V, slope = jax.jit(jax.vmap(lambda away: jax.value_and_grad(lambda q: net(q))(jnp.array([1.0, -2.0]) + away)))(away)
    assert jnp.all(jnp.sum(away * slope, axis=1) >= V) and jnp.all(V > 0)
    np.testing.assert_array_equal(net({"x": 1.0, "y": -2.0}), 0.0)


@pytest.mark.parametrize(
    "make, said",
    [
        (
            lambda key: ConvexDissipation({"x": 1.0, "y": -1.0}, key=key),
            "`scale` must be positive numbers, one for each coordinate, but is",
        ),
        (lambda key: Potential({}, key=key), "`scale` must be positive numbers"),
        (lambda key: PassiveDissipation(1.0, power=0.0, key=key), "`power` must be positive, but is 0.0. Give the size of what comes out."),
        (lambda key: ConvexPotential(1.0, energy=-2.0, key=key), "`energy` must be positive, but is -2.0."),
        (lambda key: PassiveDissipation(1.0, width=1, key=key), "`width` must be at least 2, but is 1. A network needs layers and units."),
        (lambda key: ConvexDissipation(1.0, depth=0, key=key), "`depth` must be at least 1, but is 0."),
        (lambda key: ConvexPotential(1.0, rest=jnp.zeros(2), key=key), "`rest` must have the size of `scale`, 1, but has 2."),
        (lambda key: ConvexDissipation(1.0, key=key)(jnp.zeros(2)), "`qdot` must have the size of `scale`, 1, but has 2. Make the network"),
        (lambda key: Potential(jnp.ones(3), key=key)(0.0), "`q` must have the size of `scale`, 3, but has 1."),
        (lambda key: ConvexPotential(jnp.ones(3), key=key)(0.0), "`q` must have the size of `scale`, 3, but has 1."),
    ],
)
def test_unusable_sizes_are_refused(make, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        make(jax.random.key(0))


def test_the_shipped_recording_is_what_its_script_makes(tmp_path, monkeypatch):
    monkeypatch.setattr(make_stribeck, "FILE", tmp_path / "again.csv")
    make_stribeck.main()
    again, shipped = (np.loadtxt(file, delimiter=",", skiprows=1) for file in (tmp_path / "again.csv", stribeck.recording))
    np.testing.assert_allclose(again, shipped, atol=1.1e-6)
    np.testing.assert_allclose(stribeck.true_friction(V), make_stribeck.friction(np.asarray(V)), rtol=1e-12)


@pytest.mark.slow
def test_stribecks_curve_is_recovered_from_the_recording():
    record, v = stribeck.experiment(), jnp.linspace(-0.42, 0.42, 421)
    truth = stribeck.true_friction(v)
    assert jnp.min(record.values["v"]) < -0.4 and jnp.max(record.values["v"]) > 0.4  # the speeds that were visited
    fit = stribeck.recover(max_steps=4)
    found = fit.params["net"]
    assert off(found, v, truth) < 0.01 < 0.1 < nearest_that_rises(truth)
    np.testing.assert_allclose(stribeck.friction_of(found, v), truth, atol=0.03 * jnp.max(truth))
    sigma = jnp.std(fit.residuals[0]["v"])
    np.testing.assert_allclose(sigma, 2e-3, rtol=0.05)  # the motion is right to the noise
