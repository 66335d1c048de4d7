"""Bad input gets a sentence with the cure."""

import collections
import dataclasses
import json
import math
import subprocess
import sys
import types
from collections.abc import Mapping
from typing import Any

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
    "constant L": (lambda: run(jl.System(lambda qdot: 1)), "`lagrangian` must give every direction inertia"),
    "L in a list": (lambda: run(jl.System(lambda qdot: [0.5 * qdot**2])), "`lagrangian` must return a real scalar, but returned a list"),
    "vector-valued D": (lambda: run(jl.System(energy, dissipation={"oil": lambda qdot: jnp.stack([qdot, qdot])})), "`dissipation` 'oil' must return a real scalar"),
    "g of a wrong kind": (lambda: run(jl.System(energy, holonomic=lambda q: q > 0)), "`holonomic` must return real numbers, but returned an array of shape .* and dtype bool"),
    "g without residuals": (lambda: run(jl.System(energy, holonomic={"rod": lambda q: {}})), r"`holonomic` 'rod' must return residuals, but returned a dict: \{\}"),
    "g that returns nothing": (lambda: run(jl.System(energy, holonomic={"rod": lambda q: None})), "`holonomic` 'rod' must return real numbers, but returned nothing"),
    "force of a wrong shape": (lambda: run(jl.System(energy, force=lambda: jnp.ones(3))), r"`force` must be real and of shape \(\), but is an array of shape \(3,\)"),
    "force on an unknown coordinate": (lambda: run(jl.System(lambda q, qdot: 0.5 * qdot["x"] ** 2, force=lambda: {"z": 1.0}), {"x": 0.0}, {"x": 0.0}), r"`force` must be shaped like q, but returned an entry \['z'\]"),
    "force that returns nothing": (lambda: run(jl.System(energy, force=lambda: None)), "`force` must return real numbers, but returned nothing"),
    "complex q0": (lambda: run(q0=1j), "`q0` must be real, but has dtype complex"),
    "boolean qdot0": (lambda: run(qdot0=True), "`qdot0` must be real, but has dtype bool"),
    "text in q0": (lambda: run(q0={"x": "left"}), r"`q0\['x'\]` must be a real number or array, but is a str"),
    "nothing in q0": (lambda: run(q0={"x": None}, qdot0={"x": 0.0}), r"`q0\['x'\]` must be a real number or array, but is a NoneType"),
    "no coordinates": (lambda: run(q0={}, qdot0={}), "`q0` must hold at least one coordinate"),
    "a sample of a motion for q0": (lambda: jl.simulate(jl.System(energy), run()[-1], TS + 1.0, {"c": 4.0}), r"`q0` must be coordinates, but is of class Instant, which holds them. Pass its parts, .*simulate\(system, last.q, last.qdot, ts, params"),
    "a name of no coordinate": (lambda: jl.consistent_state(jl.System(energy), {"a": 0.0, "b": 0.0}, {"a": 0.0, "b": 0.0}, fixed="ab"), "`fixed` must name coordinates of q, but holds 'ab'"),
    "mismatched structures": (lambda: run(q0={"x": 1.0}, qdot0={"y": 0.0}), "`qdot0` must be structured like `q0`"),
    "mismatched shapes": (lambda: run(q0=np.ones(2), qdot0=np.ones(3)), r"`qdot0` must have the shape of `q0`, \(2,\), but has \(3,\)"),
    "unknown argument name": (lambda: run(jl.System(lambda q, qdto, c: 0.5 * qdto**2)), "`lagrangian` must name arguments that exist, but it names 'qdto'. There are t, q, qdot, params; the entries of params: c. Did you mean 'qdot'"),
    "misspelt coordinate in q0": (lambda: run(jl.System(lambda q, qdot: 0.5 * qdot["theta"] ** 2), {"teta": 0.0}, {"teta": 0.0}), "`lagrangian` must ask for entries that exist, but asks for 'theta'. q has teta; params has c. Did you mean 'teta'?"),
    "entry of params that is not there": (lambda: run(jl.System(energy, dissipation={"oil": lambda qdot, params: params["b"] * qdot**2})), "`dissipation` 'oil' must ask for entries that exist, but asks for 'b'. params has c. Add 'b' to q or params"),
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
    "constraints of one name": (lambda: jl.System(energy, holonomic={"a": lambda q: q}, nonholonomic={"a": lambda qdot: qdot}), "terms must have different names, but two are called 'a'"),
    "fixed coordinate that is none": (lambda: jl.consistent_state(pendulum.polar, {"r": 1.0, "phi": 0.0}, {"r": 0.0, "phi": 0.0}, pendulum.params, fixed=("psi",)), r"`fixed` must name coordinates of q, but holds 'psi'. The coordinates are \['phi', 'r'\]"),
    "consistent state that is impossible": (lambda: jl.consistent_state(jl.System(energy, holonomic=lambda q: q**2 + 1.0), 1.0, 0.0, {"c": 1.0}), "none was found"),
}  # fmt: skip


def of_python(q):
    return np.sin(q)


def with_a_choice(q):
    return q if q > 0 else -q


def counting(q, n):
    return sum(q for _ in range(n))


@dataclasses.dataclass
class Spring:
    stiffness: float

    def __call__(self, q):
        return -self.stiffness * q


@dataclasses.dataclass(frozen=True)
class Held:
    stiffness: Any


class Plain:
    stiffness = 4.0


def sprung(params, **terms):
    """q̈ under a force −c q."""
    force = (lambda q, c: -c * q) if isinstance(params, Mapping) else (lambda q, params: -params.stiffness * q)
    return jl.acceleration(jl.System(lambda qdot: 0.5 * qdot**2, force=force, **terms), 2.0, 0.0, params).qddot


TRACED = "must be written in operations that JAX can trace, since it is differentiated and compiled, but line"
HERE = r"\d+ of .*test_validation\.py"
BORDER = {
    "NumPy's sine": (lambda: sprung({"c": 1.0}, holonomic={"rod": of_python}), rf"^`holonomic` 'rod' {TRACED} {HERE}, `return np.sin\(q\)`, is not. Write `jnp.sin` for `np.sin`"),
    "NumPy's sine in a lambda": (lambda: run(jl.System(lambda q, qdot: 0.5 * qdot**2 + np.cos(q))), rf"^`lagrangian` {TRACED} {HERE}.*Write `jnp.sin` for `np.sin`"),
    "a choice": (lambda: sprung({"c": 1.0}, dissipation=with_a_choice), rf"^`dissipation` {TRACED} {HERE}, `return q if q > 0 else -q`, is not. Write `jnp.where\(condition, a, b\)` for `if`"),
    "a mask": (lambda: jl.acceleration(jl.System(lambda q, qdot: qdot @ qdot + jnp.sum(q[q > 0])), VECTOR, VECTOR), rf"^`lagrangian` {TRACED} {HERE}.*Write `jnp.where"),
    "a count": (lambda: sprung({"c": 1.0, "n": 3}, dissipation=counting), rf"^`dissipation` {TRACED} {HERE}, `return sum\(q for _ in range\(n\)\)`, is not.*Keep an integer out of params: pass it as a default value"),
    "a size": (lambda: sprung({"c": 1.0, "n": 3}, dissipation=lambda n: jnp.sum(jnp.zeros(n))), rf"^`dissipation` {TRACED} {HERE}.*Keep an integer out"),
    "a range of JAX": (lambda: sprung({"c": 1.0, "n": 3}, dissipation=lambda n: jnp.sum(jnp.arange(n))), rf"^`dissipation` {TRACED} {HERE}.*Keep an integer out"),
    "an index": (lambda: sprung({"c": 1.0, "n": 1}, dissipation=lambda n: jnp.ones(3)[n]), rf"^`dissipation` {TRACED} {HERE}.*Keep an integer out"),
    "Python's sine": (lambda: jl.acceleration(jl.System(energy, force={"wind": lambda q: math.sin(q)}), 1.0, 0.0, {"c": 1.0}), rf"^`force` 'wind' {TRACED} {HERE}.*Write `jnp.sin` for `math.sin`"),
    "a point": (lambda: jl.acceleration(jl.System(energy, force=jl.virtual_work(of_python, 1.0)), 1.0, 0.0, {"c": 1.0}), rf"^`coordinate` {TRACED} {HERE}"),
    "a callable that changes": (lambda: jl.System(energy, force=Spring(4.0)), r"^`force` must be a hashable function, but is a Spring that cannot be hashed. Make it immutable, `@dataclass\(frozen=True\)`"),
    "a point that changes": (lambda: jl.rate(Spring(4.0)), "^`coordinate` must be a hashable function, but is a Spring"),
    "a point of work that changes": (lambda: jl.virtual_work(Spring(4.0), 1.0), "^`coordinate` must be a hashable function, but is a Spring"),
    "an effort that changes": (lambda: jl.virtual_work(energy, Spring(4.0)), "^`effort` must be a hashable function, but is a Spring"),
    "coordinates that change": (lambda: jl.substitute(jl.System(energy), Spring(4.0)), "^`coordinates` must be a hashable function, but is a Spring"),
    "a point of a reaction that changes": (lambda: jl.constraint_force(jl.System(energy, holonomic=lambda q: q), 0.0, 0.0, {"c": 1.0}, at=Spring(4.0)), "^`at` must be a hashable function, but is a Spring"),
    "an effort of text": (lambda: jl.virtual_work(energy, "2"), "^`effort` must be an array of real numbers, but is a str that is text"),
    "an effort of truth": (lambda: jl.virtual_work(energy, True), "^`effort` must be real, but has dtype bool"),
    "a traced effort": (lambda: jax.jit(lambda F: sprung({"c": F}) + jl.virtual_work(energy, F)(0.0, 1.0, 1.0, {}))(1.0), "^`effort` must be known when it is given, but is traced. Make it an entry of params"),
    "a rate without its time": (lambda: jl.rate(lambda t, q: t * q)(q=1.0, qdot=0.0), r"^a rate must be given t, q and qdot, but `t` is missing. Call it `rate\(x\)\(t, q, qdot, params\)`"),
    "a rate without velocity": (lambda: jl.rate(lambda q: q)(0.0, 1.0), "^a rate must be given t, q and qdot, but `qdot` is missing"),
    "a set": (lambda: sprung({"c": 4.0, "gears": {1, 2}}), r"^`params\['gears'\]` must be numbers in some order, but is a set, which has none. Write a list or a tuple"),
    "a dataclass": (lambda: sprung(dataclasses.make_dataclass("Parameters", ["stiffness"])(4.0)), r"^`params` must be numbers, arrays, or a pytree of them, but is a Parameters, whose numbers JAX cannot see. Register its class, `jax.tree_util.register_dataclass\(Parameters\)`"),
    "a frozen dataclass with arrays": (lambda: sprung(Held(VECTOR)), "^`params` must be numbers, arrays, or a pytree of them, but is a Held"),
    "an object": (lambda: sprung({"c": 4.0, "spring": Plain()}), r"^`params\['spring'\]` must be numbers, arrays, or a pytree of them, but is a Plain"),
    "a date in params": (lambda: sprung({"c": 4.0, "day": np.datetime64("2024-01-01")}), r"^`params\['day'\]` must be an array of real numbers, but is a datetime64 that is a date"),
    "a parameter of a NamedTuple": (lambda: jl.acceleration(jl.System(energy), 1.0, 0.0, collections.namedtuple("P", "c")(4.0)), r"it names 'c'.*params is not a mapping, so its parts have no names. Write `params.c`"),
    "a time of text": (lambda: jl.mass_matrix(jl.System(energy), 1.0, 0.0, {"c": 1.0}, t="0.1"), "^`t` must be an array of real numbers, but is a str that is text"),
    "a time of truth": (lambda: jl.energy(jl.System(energy), 1.0, 0.0, {"c": 1.0}, t=True), "^`t` must be real, but has dtype bool"),
    "several times": (lambda: jl.powers(jl.System(energy), 1.0, 0.0, {"c": 1.0}, t=np.ones(3)), r"^`t` must be one number, but has shape \(3,\). Pass one time, and use `jax.vmap`"),
    "a time that is NaN": (lambda: jl.acceleration(jl.System(energy), 1.0, 0.0, {"c": 1.0}, t=np.nan), "^`t` must be finite, but is nan"),
    "ts as text": (lambda: run(ts=["0", "1"]), "^`ts` must be an array of real numbers, but is a list that is text"),
    "ts as truth": (lambda: run(ts=[False, True]), "^`ts` must be real, but has dtype bool"),
    "ts as dates": (lambda: run(ts=np.array(["2024-01-01", "2024-01-02"], "datetime64[s]")), "^`ts` must be an array of real numbers, but is a ndarray that is a date. Count the time from a start"),
    "ts with a mask": (lambda: run(ts=np.ma.masked_array([0.0, 1.0, 2.0], [0, 1, 0])), "^`ts` must be finite, but has a NaN"),
    "ts and params swapped": (lambda: run(ts={"c": 4.0}, params=TS), "^`ts` must be a list of times, but is a dict. Pass `ts` before `params`"),
    "complex ts": (lambda: run(ts=[0.0, 1j]), "^`ts` must be real, but has dtype complex128"),
    "a signal's times as text": (lambda: jl.Signal(["0", "1"], [1.0, 2.0]), "^`ts` must be an array of real numbers, but is a list that is text"),
    "a signal's times as truth": (lambda: jl.Signal([False, True], [1.0, 2.0]), "^`ts` must be real, but has dtype bool"),
    "a signal over durations": (lambda: jl.Signal(np.array([0, 1], "timedelta64[s]"), [1.0, 2.0]), "^`ts` must be an array of real numbers, but is a ndarray that is a date"),
    "no iterations": (lambda: jl.stabilisation.Projection(iterations=0), "^`iterations` must be at least 1, but is 0"),
    "gains that are NaN": (lambda: jl.stabilisation.Baumgarte(np.nan), "^`alpha` must be finite, but is nan"),
    "negative gains": (lambda: jl.stabilisation.Baumgarte(1.0, -1.0), "^`beta` must be at least 0, but is -1"),
    "transitions below zero": (lambda: jl.StickSlip(max_transitions=-1), "^`max_transitions` must be at least 0, but is -1"),
    "no width": (lambda: jl.Regularised(0.0), "^`width` must be positive, but is 0"),
    "a width that is endless": (lambda: jl.Regularised(np.inf), "^`width` must be finite, but is inf"),
    "a negative rtol": (lambda: run(rtol=-1e-6), "^`rtol` must be at least 0, but is -1e-06. The default is 1e-08"),
    "an rtol that is NaN": (lambda: run(rtol=np.nan), "^`rtol` must be finite, but is nan"),
    "an atol of zero": (lambda: run(atol=0.0), "^`atol` must be positive, but is 0. Leave it out, and each coordinate"),
    "an atol for each": (lambda: run(atol=jnp.ones(2)), r"^`atol` must be a number, or one for each coordinate in a pytree like `q0`, but is"),
    "no steps": (lambda: run(max_steps=0), "^`max_steps` must be at least 1, but is 0"),
    "steps below zero": (lambda: run(max_steps=-5), "^`max_steps` must be at least 1, but is -5"),
}  # fmt: skip


@pytest.mark.fast
@pytest.mark.parametrize("case", BORDER)
def test_what_is_refused_at_the_border(case):
    action, sentence = BORDER[case]
    with pytest.raises((ValueError, TypeError), match=sentence):
        action()


def test_the_error_of_jax_stays_the_cause():
    with pytest.raises(TypeError) as error:
        jl.mass_matrix(jl.System(with_a_choice), 1.0, 0.0)
    assert isinstance(error.value.__cause__, jax.errors.TracerBoolConversionError)


OF_A_WRONG_TYPE = {
    'jl.simulate(system, 1.0, 0.0, [0, 1], solver="rk4")': "`solver` must be an object that makes the choice, but is 'rk4'. Take e.g. `jaxlag.Dop853()`",
    "jl.simulate(system, 1.0, 0.0, [0, 1], solver=jl.Dop853)": "`solver` must be an object that makes the choice, but is <class",
    "jl.simulate(system, 1.0, 0.0, [0, 1], solver=diffrax.Euler())": "`solver` must estimate its error and solve ẏ = f(t, y) as a whole, but Euler does not. Take e.g.",
    "jl.simulate(system, 1.0, 0.0, [0, 1], solver=diffrax.KenCarp4())": "`solver` must estimate its error and solve ẏ = f(t, y) as a whole, but KenCarp4 does not. Take e.g.",
    'jl.simulate(system, 1.0, 0.0, [0, 1], stabilisation="x")': "`stabilisation` must be an object that makes the choice, but is 'x'. Take e.g. `Projection()`",
    'jl.simulate(system, 1.0, 0.0, [0, 1], friction="x")': "`friction` must be an object that makes the choice, but is 'x'. Take e.g. `StickSlip()`",
    "jl.simulate(system, 1.0, 0.0, [0, 1], friction=None)": "`friction` must be an object that makes the choice, but is None",
    'jl.simulate(system, 1.0, 0.0, [0, 1], adjoint="x")': "`adjoint` must be an object that makes the choice, but is 'x'. Take e.g. `diffrax",
    "jl.simulate(system, 1.0, 0.0, [0, 1], max_steps=1e4)": "`max_steps` must be an integer, but is 10000.0. The default is 100_000.",
    'jl.simulate(system, 1.0, 0.0, [0, 1], rtol="1e-3")': "`rtol` must be an array of real numbers, but is a str that is text",
    'jl.simulate_many(system, jnp.ones(2), jnp.zeros(2), [0, 1], over=("q0", "qdot0"), solver="rk4")': "`solver` must be an object",
    'jl.Experiment([0, 1], [1.0, 2.0], 1.0, 0.0, delay="0.1")': "`delay` must be an array of real numbers, but is a str that is text",
    "jl.Experiment([0, 1], [1.0, 2.0], 1.0, 0.0, delay=np.ones(2))": "`delay` must be one number, but has shape (2,)",
    'jl.Experiment([0, 1], [1.0, 2.0], 1.0, 0.0, observe="x")': "`observe` must be a function, but is 'x'",
    "jl.Experiment([0, 1], [1.0, 2.0], 1.0, 0.0, params=[1.0])": "`params` of an experiment must be a mapping, but is a list",
    "jl.ModalTest([1.0], 0.0, sigma=0.1, params=[1.0])": "`params` of a test must be a mapping, but is a list",
    'jl.ModalTest([1.0], 0.0, sigma=0.1, observe="x")': "`observe` must be a function, but is 'x'",
    'jl.Regularised("x")': "`width` must be an array of real numbers, but is a str that is text",
    "jl.stabilisation.Projection(1.5)": "`iterations` must be an integer, but is 1.5",
    "jl.StickSlip(True)": "`max_transitions` must be an integer, but is True",
}  # fmt: skip
WITHOUT_HOOK = """
import json, sys
import diffrax, jax.numpy as jnp, numpy as np
import jaxlag as jl
system = jl.System(lambda qdot: 0.5 * qdot**2)
said = {}
for code in json.load(sys.stdin):
    try:
        eval(code)
    except (TypeError, ValueError) as error:
        said[code] = str(error)
print(json.dumps(said))
"""


def test_what_is_of_a_wrong_type_gets_a_sentence_without_the_types_checked():
    """In these tests annotations are checked before the body runs; users have sentences instead."""
    run = subprocess.run([sys.executable, "-c", WITHOUT_HOOK], input=json.dumps([*OF_A_WRONG_TYPE]), capture_output=True, text=True)
    said = json.loads(run.stdout.splitlines()[-1])
    for code, sentence in OF_A_WRONG_TYPE.items():
        assert said.get(code, "").startswith(sentence), (code, said.get(code))


@pytest.mark.parametrize(
    "params", [types.MappingProxyType({"c": 4.0}), collections.ChainMap({"c": 4.0}, {"k": 1.0}), collections.OrderedDict(c=4), collections.UserDict(c=np.float32(4))]
)  # fmt: skip
def test_any_mapping_is_params(params):
    assert sprung(params) == -8.0
    assert sprung({"c": 4.0, "more": {"deeper": params}}, dissipation=lambda more: 0.0 * more["deeper"]["c"]) == -8.0
    assert jax.grad(lambda c: sprung(types.MappingProxyType({"c": c})))(4.0) == -2.0
    named = type(params)({"c": "stiffness"})
    assert "stiffness q" in str(jl.equations(jl.System(energy), "q", named))


def test_dataclasses_as_params_and_in_a_system():
    """Registered, its numbers are parameters like others; frozen and without arrays, it is one constant."""
    registered = jax.tree_util.register_dataclass(dataclasses.make_dataclass("Registered", ["stiffness"]), ["stiffness"], [])
    assert jax.grad(lambda c: sprung(registered(c)))(4.0) == -2.0
    assert sprung(Held(4.0)) == -8.0
    system = jl.System(energy, force=Fixed(3.0))
    assert jl.acceleration(system, 2.0, 0.0, {"c": 1.0}).qddot == -8.0
    assert system == jl.System(energy, force=Fixed(3.0))


@dataclasses.dataclass(frozen=True)
class Fixed:
    stiffness: float

    def __call__(self, q):
        return -self.stiffness * q


def test_arguments_by_position_keep_their_places():
    """What is left out by default keeps its place for the next."""
    force = lambda a=100.0, b=2.0, c=30.0, /: a + b + c
    found = jl.acceleration(jl.System(lambda qdot, /, m=1.0: 0.5 * m * qdot**2, force=force), 0.0, 0.0, {"b": 5.0})
    assert found.qddot == 135.0


def test_traced_times_that_decrease_are_a_result():
    oscillator = jl.System(energy)
    motion = jax.jit(lambda ts: jl.simulate(oscillator, 1.0, 0.0, ts, {"c": 4.0}))
    back = motion(jnp.array([0.0, 1.0, 0.5]))
    assert back.result == jl.results.RESULTS.unordered and not back.succeeded and np.all(np.isnan(back.q))
    assert "`ts` must increase, but a time is smaller than the one before it" in repr(back)
    assert motion(jnp.array([0.0, jnp.nan, 0.5])).result == jl.results.RESULTS.not_finite
    forth = motion(jnp.array([0.0, 0.5, 0.5]))  # as filling up makes them
    assert forth.succeeded
    np.testing.assert_allclose(forth.q, np.cos([0, 1, 1]), atol=1e-8)


@pytest.mark.parametrize("case", WRONG)
def test_validation_gets_a_sentence_with_the_cure(case):
    action, sentence = WRONG[case]
    with pytest.raises((ValueError, TypeError), match=sentence):
        action()


def test_a_system_that_holds_arrays_is_refused():
    import equinox as eqx

    network = eqx.nn.MLP(1, "scalar", 2, 1, key=jax.random.key(0))
    with pytest.raises(
        TypeError, match="`lagrangian` must be a hashable function, but is a MLP that cannot be hashed. Put its arrays into params"
    ):
        jl.System(network)


def test_out_of_steps():
    with pytest.raises(
        RuntimeError, match="must reach t = 1, but stopped at t = 0.011 after 1 of 5 samples: The maximum number of solver steps"
    ):
        run(max_steps=2)
    motion = run(max_steps=2, throw=False)
    assert not motion.succeeded and motion.result == jl.results.RESULTS.max_steps_reached
    assert motion.q[0] == 1.0 and np.all(np.isnan(motion.q[1:]))
    assert "The maximum number of solver steps was reached" in repr(motion)
    some = run(max_steps=12, throw=False, ts=np.linspace(0, 10, 101))
    reached = int(np.sum(np.isfinite(some.q)))
    assert 2 < reached < 101
    np.testing.assert_allclose(some.q[:reached], np.cos(2 * np.asarray(some.ts[:reached])), atol=1e-7)


def test_a_motion_that_runs_away():
    """q̈ = 2q³ from q = 1, q̇ = 1 is 1/(1 − t): infinite at t = 1."""
    blown = jl.System(lambda q, qdot: 0.5 * qdot**2 + 0.5 * q**4)
    with pytest.raises(RuntimeError, match="must reach t = 2, but stopped at t = 1 after [23] of 5 samples"):
        jl.simulate(blown, 1.0, 1.0, np.linspace(0, 2, 5), max_steps=2000)


@pytest.mark.slow
def test_under_jit_a_failure_is_a_result():
    motion = jax.jit(lambda c: run(params={"c": c}))(jnp.nan)
    assert motion.result == jl.results.RESULTS.not_finite and np.all(np.isnan(motion.q))
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


@pytest.mark.fast
@pytest.mark.parametrize("case", EXPERIMENT)
def test_bad_experiments(case):
    action, sentence = EXPERIMENT[case]
    with pytest.raises((ValueError, TypeError), match=sentence):
        action()


GOOD = {"values": np.ones(5), "observe": lambda q: q}
FITS = {
    "unknown free name": ({}, {"free": ("k",)}, "`free` must name entries of params, but holds 'k'. There are c"),
    "nothing free": ({}, {"free": ()}, "`free` must name at least one entry"),
    "observe of a wrong structure": ({"observe": lambda q: {"y": q}}, {"free": ("c",)}, "`observe` of experiment 0 must return what `values` holds"),
    "observe of a wrong shape": ({"observe": lambda q: jnp.stack([q, q])}, {"free": ("c",)}, r"`observe` of experiment 0 must return real numbers of shape \(\)"),
    "observe of a wrong kind": ({"observe": lambda q: q > 0}, {"free": ("c",)}, "`observe` must return real numbers, but returned an array .* dtype bool"),
    "observe that names nothing there is": ({"observe": lambda x: x}, {"free": ("c",)}, "`observe` must name arguments that exist, but it names 'x'"),
}  # fmt: skip


@pytest.mark.fast
@pytest.mark.parametrize("case", FITS)
def test_bad_fits(case):
    experiment, how, sentence = FITS[case]
    experiment = {**GOOD, **experiment}
    record = jl.Experiment(TS, experiment["values"], 1.0, 0.0, observe=experiment["observe"])
    with pytest.raises((ValueError, TypeError), match=sentence):
        jl.fit(jl.System(energy), record, {"c": 4.0}, **how)


def test_traced_times_that_repeat_are_served_or_a_result():
    """The same time twice, in the middle: the same state twice, or a reason; never NaN that counts as success."""
    bouncing = jl.System(energy, unilateral={"stop": jl.Contact(lambda q: 1.5 - q)})
    for system in (jl.System(energy), bouncing):
        motion = jax.jit(lambda ts, system=system: jl.simulate(system, 1.0, 0.0, ts, {"c": 4.0}))(jnp.array([0.0, 0.5, 0.5, 1.0]))
        assert motion.succeeded == np.all(np.isfinite(motion.q)) and motion.succeeded | (motion.result == jl.results.RESULTS.unordered)
        if motion.succeeded:
            np.testing.assert_allclose(motion.q, np.cos([0, 1, 1, 2]), atol=1e-8)
