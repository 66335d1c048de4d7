"""Bad input gets a sentence with the cure."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag.examples import pendulum

TS = np.linspace(0, 1, 5)


def energy(q, qdot, c):
    return 0.5 * qdot**2 - 0.5 * c * q**2


def run(system=None, q0=1.0, qdot0=0.0, ts=TS, params={"c": 4.0}, **numerics):  # noqa: B006
    return jl.simulate(system or jl.System(energy), q0, qdot0, ts, params, **numerics)


VECTOR = np.ones(2)
WRONG = {
    "vector-valued L": (lambda: run(jl.System(lambda qdot: 0.5 * qdot**2), VECTOR, VECTOR), r"`lagrangian` must return a real scalar, but returned an array of shape \(2,\).*forget to sum"),
    "integer L": (lambda: run(jl.System(lambda qdot: 1)), "`lagrangian` must return a real scalar, but"),
    "vector-valued D": (lambda: run(jl.System(energy, dissipation={"oil": lambda qdot: jnp.stack([qdot, qdot])})), "`dissipation` 'oil' must return a real scalar"),
    "g of a wrong kind": (lambda: run(jl.System(energy, holonomic=lambda q: q > 0)), "`holonomic` must return real floating-point residuals, but"),
    "g that returns nothing": (lambda: run(jl.System(energy, holonomic={"rod": lambda q: None})), "`holonomic` 'rod' must return real floating-point residuals, but returned nothing"),
    "force of a wrong shape": (lambda: run(jl.System(energy, force=lambda: jnp.ones(3))), r"`force` must be real and of shape \(\), but is an array of shape \(3,\)"),
    "force on an unknown coordinate": (lambda: run(jl.System(lambda q, qdot: 0.5 * qdot["x"] ** 2, force=lambda: {"z": 1.0}), {"x": 0.0}, {"x": 0.0}), r"`force` must be shaped like q, but returned an entry \['z'\]"),
    "force that returns nothing": (lambda: run(jl.System(energy, force=lambda: None)), "`force` must be shaped like q, but returned nothing"),
    "complex q0": (lambda: run(q0=1j), "`q0` must be real, but has dtype complex"),
    "boolean qdot0": (lambda: run(qdot0=True), "`qdot0` must be real, but has dtype bool"),
    "text in q0": (lambda: run(q0={"x": "left"}), r"`q0\['x'\]` must be a real number or array, but is a str"),
    "nothing in q0": (lambda: run(q0={"x": None}, qdot0={"x": 0.0}), r"`q0\['x'\]` must be a real number or array, but is a NoneType"),
    "no coordinates": (lambda: run(q0={}, qdot0={}), "`q0` must hold at least one coordinate"),
    "mismatched structures": (lambda: run(q0={"x": 1.0}, qdot0={"y": 0.0}), "`qdot0` must be structured like `q0`"),
    "mismatched shapes": (lambda: run(q0=np.ones(2), qdot0=np.ones(3)), r"`qdot0` must have the shape of `q0`, \(2,\), but has \(3,\)"),
    "unknown argument name": (lambda: run(jl.System(lambda q, qdto, c: 0.5 * qdto**2)), "`lagrangian` must name arguments that exist, but it names 'qdto'. There are t, q, qdot, params; the entries of params: c. Did you mean 'qdot'"),
    "misspelt coordinate in q0": (lambda: run(jl.System(lambda q, qdot: 0.5 * qdot["theta"] ** 2), {"teta": 0.0}, {"teta": 0.0}), "`lagrangian` must ask for entries that exist, but asks for 'theta'. q has teta; params has c. Did you mean 'teta'?"),
    "entry of params that is not there": (lambda: run(jl.System(energy, dissipation={"oil": lambda qdot, params: params["b"] * qdot**2})), "`dissipation` 'oil' must ask for entries that exist, but asks for 'b'. params has c. Add 'b' where it belongs"),
    "missing parameter": (lambda: run(params={"b": 1.0}), "it names 'c'. There are .*; the entries of params: b. Add 'c' to params"),
    "no params": (lambda: run(params=None), "it names 'c'.*params was not given"),
    "velocity in g": (lambda: run(jl.System(energy, holonomic=lambda q, qdot: q)), "`holonomic` must name arguments that exist, but it names 'qdot'"),
    "variadic function": (lambda: run(jl.System(lambda *args: 1.0)), r"a function must name each of its arguments, but .* takes `\*args`"),
    "function without a signature": (lambda: run(jl.System(type)), "a function must show the names of its arguments"),
    "hidden entry": (lambda: run(params={"c": 1.0, "q": 2.0}), "`params` must not have an entry named 'q'"),
    "ts that goes back": (lambda: run(ts=[0, 1, 0.5]), r"`ts` must increase, but ts\[1\] = 1 is followed by ts\[2\] = 0.5"),
    "one time": (lambda: run(ts=[0.0]), r"`ts` must be a list of at least two times, but has shape \(1,\)"),
    "NaN in q0": (lambda: run(q0=np.nan), "`q0`, `qdot0`, `ts` and `params` must be finite"),
    "NaN in params": (lambda: run(params={"c": np.nan}), "`q0`, `qdot0`, `ts` and `params` must be finite"),
    "no inertia": (lambda: run(jl.System(lambda q, qdot: 0.5 * (qdot["x"] + qdot["y"]) ** 2), {"x": 0.0, "y": 0.0}, {"x": 0.0, "y": 0.0}), "`lagrangian` must give every direction inertia that no constraint holds"),
    "impossible constraints": (lambda: run(jl.System(energy, holonomic={"a": lambda q: q**2 + 1.0})), "must be satisfied by some state near the start, but none was found"),
    "contradicting constraints": (lambda: run(jl.System(energy, holonomic={"a": lambda q: q - 1.0, "b": lambda q: q - 2.0})), "must be satisfied by some state near the start"),
    "no function": (lambda: jl.System(energy, dissipation=0.5), "`dissipation` must be a function or a mapping from names to functions, but it holds 0.5"),
    "no lagrangian": (lambda: jl.System(None), r"`lagrangian` must be a function L\(q, qdot\)"),
    "constraints of one name": (lambda: jl.System(energy, holonomic={"a": lambda q: q}, nonholonomic={"a": lambda qdot: qdot}), "terms must be named differently, but two are called 'a'"),
    "fixed coordinate that is none": (lambda: jl.consistent_state(pendulum.polar, {"r": 1.0, "phi": 0.0}, {"r": 0.0, "phi": 0.0}, pendulum.params, fixed=("psi",)), r"`fixed` must name coordinates of q, but holds 'psi'. The coordinates are \['phi', 'r'\]"),
    "consistent state that is impossible": (lambda: jl.consistent_state(jl.System(energy, holonomic=lambda q: q**2 + 1.0), 1.0, 0.0, {"c": 1.0}), "none was found"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_bad_input_gets_a_sentence_with_the_cure(case):
    action, sentence = WRONG[case]
    with pytest.raises((ValueError, TypeError), match=sentence):
        action()


def test_a_system_that_holds_arrays_is_refused():
    import equinox as eqx

    network = eqx.nn.MLP(1, "scalar", 2, 1, key=jax.random.key(0))
    with pytest.raises(TypeError, match="`lagrangian` must hold hashable functions.*Put its arrays into params"):
        jl.System(network)


def test_out_of_steps():
    with pytest.raises(RuntimeError, match="must reach t = 1, but stopped after 1 of 5 samples: The maximum number of solver steps"):
        run(max_steps=2)
    motion = run(max_steps=2, throw=False)
    assert not motion.succeeded and motion.result == jl.RESULTS.max_steps_reached
    assert motion.q[0] == 1.0 and np.all(np.isnan(motion.q[1:]))
    assert "The maximum number of solver steps was reached" in repr(motion)
    some = run(max_steps=12, throw=False, ts=np.linspace(0, 10, 101))
    reached = int(np.sum(np.isfinite(some.q)))
    assert 2 < reached < 101
    np.testing.assert_allclose(some.q[:reached], np.cos(2 * np.asarray(some.ts[:reached])), atol=1e-7)


def test_a_motion_that_runs_away():
    """q̈ = 2q³ from q = 1, q̇ = 1 is 1/(1 − t): infinite at t = 1."""
    blown = jl.System(lambda q, qdot: 0.5 * qdot**2 + 0.5 * q**4)
    with pytest.raises(RuntimeError, match="must reach t = 2, but stopped after [23] of 5 samples"):
        jl.simulate(blown, 1.0, 1.0, np.linspace(0, 2, 5), max_steps=2000)


def test_under_jit_a_failure_is_a_result():
    motion = jax.jit(lambda c: run(params={"c": c}))(jnp.nan)
    assert motion.result == jl.RESULTS.not_finite and np.all(np.isnan(motion.q))
    stopped = jax.vmap(lambda c: run(params={"c": c}, max_steps=8, ts=np.linspace(0, 3, 4)))(jnp.array([1e-3, 1e3]))
    assert list(np.asarray(stopped.succeeded)) == [True, False]
    with pytest.raises(ValueError, match="must be finite"):
        jax.grad(lambda c: run(params={"c": c}).q[-1])(jnp.nan)


EXPERIMENT = {
    "values without a row a time": (lambda: jl.Experiment(TS, np.ones(4), 1.0, 0.0, observe=lambda q: q), r"`values` must have one row for each of the 5 times, but has shape \(4,\)"),
    "sigma of zero": (lambda: jl.Experiment(TS, np.ones(5), 1.0, 0.0, observe=lambda q: q, sigma=0.0), "`sigma` must be positive"),
    "sigma of a wrong kind": (lambda: jl.Experiment(TS, {"y": np.ones(5)}, 1.0, 0.0, observe=lambda q: q, sigma={"z": 1.0}), "`sigma` must be a number or structured like `values`"),
    "times that go back": (lambda: jl.Experiment(TS[::-1], np.ones(5), 1.0, 0.0, observe=lambda q: q), "`ts` must increase"),
}  # fmt: skip


@pytest.mark.parametrize("case", EXPERIMENT)
def test_bad_experiments(case):
    action, sentence = EXPERIMENT[case]
    with pytest.raises((ValueError, TypeError), match=sentence):
        action()


GOOD = {"values": np.ones(5), "observe": lambda q: q}
FITS = {
    "unknown free name": ({}, {"free": ("k",)}, "`free` must name entries of params, but holds 'k'. There are c"),
    "nothing free": ({}, {"free": ()}, "`free` must name at least one entry"),
    "free as text": ({}, {"free": "c"}, "`free` must be a list of names, but is the string 'c'"),
    "observe of a wrong structure": ({"observe": lambda q: {"y": q}}, {"free": ("c",)}, "`observe` of experiment 0 must return what `values` holds"),
    "observe of a wrong shape": ({"observe": lambda q: jnp.stack([q, q])}, {"free": ("c",)}, r"`observe` of experiment 0 must return real numbers of shape \(\)"),
    "observe of a wrong kind": ({"observe": lambda q: q > 0}, {"free": ("c",)}, "`observe` of experiment 0 must return real numbers.*dtype bool"),
    "observe that names nothing there is": ({"observe": lambda x: x}, {"free": ("c",)}, "`observe` must name arguments that exist, but it names 'x'"),
}  # fmt: skip


@pytest.mark.parametrize("case", FITS)
def test_bad_fits(case):
    experiment, how, sentence = FITS[case]
    experiment = {**GOOD, **experiment}
    record = jl.Experiment(TS, experiment["values"], 1.0, 0.0, observe=experiment["observe"])
    with pytest.raises((ValueError, TypeError), match=sentence):
        jl.fit(jl.System(energy), record, {"c": 4.0}, **how)
