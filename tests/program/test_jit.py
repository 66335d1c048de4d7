"""Programs called from Python are compiled with the older CPU emitters: the same numbers, and a JAX without them works as well."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._program import jit
from jaxlag.examples import vehicle

TS = np.linspace(0, 2, 41)
rod = jl.System(
    lambda q, qdot: 0.5 * qdot @ qdot - 9.81 * q[1],
    holonomic={"rod": lambda q: q @ q - 1.0},
    dissipation={"joint": lambda q, qdot: 0.3 * jnp.abs(q[0] * qdot[1] - q[1] * qdot[0])},
)


def ride(b):
    motion = jl.simulate(vehicle.system, vehicle.q0, vehicle.qdot0, TS, vehicle.params | {"b": b})
    return jnp.concatenate([motion.q["y"], motion.qddot["phi"]])


def swing(x):
    motion = jl.simulate(rod, jnp.stack([jnp.sin(x), -jnp.cos(x)]), jnp.zeros(2), TS)
    return jnp.concatenate([motion.q[:, 0], motion.multipliers["rod"], motion.friction["joint"].force])


@pytest.mark.slow
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="the option is for CPUs")
@pytest.mark.parametrize("function, x", [(ride, 3000.0), (swing, 0.7), (jax.jacfwd(ride), 3000.0)], ids=["ride", "swing", "slope"])
def test_both_emitters_give_the_same_at_each_level(function, x):
    program = jax.jit(function).lower(x)
    by = lambda on, level: program.compile(compiler_options={"xla_cpu_use_fusion_emitters": on, "xla_backend_optimization_level": level})(x)
    default = by(True, 3)
    for other in (by(False, 3), by(False, 1)):
        np.testing.assert_allclose(other, default, rtol=0, atol=1e-9 * np.max(np.abs(default)))


@pytest.mark.parametrize("known", [True, False])
def test_it_may_be_called_from_anywhere(known, monkeypatch):
    """From Python, under transformations, within other programs, and where XLA does not know the options."""
    if not known:
        monkeypatch.setattr(jit, "OLD_EMITTERS", {"xla_cpu_no_such_option": False})
    for cached in (jit._program_with_options, jit.options):
        cached.cache_clear()
    traced = []

    def power(x, of):
        traced.append(of)
        return x**3 if of == "cube" else x**2

    program = jit.compiled(power)
    x = jnp.arange(3.0)
    np.testing.assert_array_equal(program(x, of="cube"), x**3)
    np.testing.assert_array_equal(program(x, of="cube"), x**3)
    assert len(traced) == 1  # compiled once
    np.testing.assert_array_equal(jax.vmap(lambda x: program(x, "cube"))(x), x**3)
    np.testing.assert_array_equal(jax.jit(lambda: program(x, "square"))(), x**2)
    np.testing.assert_array_equal(jax.vmap(jax.grad(lambda x: program(x, "cube")))(x), 3 * x**2)
    assert jax.grad(lambda y: y * program(2.0, "cube"))(1.0) == 8.0
    assert jax.eval_shape(lambda: program(x, "square")).shape == (3,)
    for cached in (jit._program_with_options, jit.options):
        cached.cache_clear()


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="the option is for CPUs")
def test_the_options_reach_the_compiler_only_in_calls_from_python(monkeypatch):
    """XLA refuses an option that it does not know."""
    monkeypatch.setattr(jit, "options", lambda: {"xla_cpu_no_such_option": False})
    program = jit.compiled(lambda x: 2 * x)
    with pytest.raises(jax.errors.JaxRuntimeError, match="xla_cpu_no_such_option"):
        program(1.0)
    assert jax.jit(program)(1.0) == 2.0


@pytest.mark.slow
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="the option is for CPUs")
@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd, jax.hessian, jax.vmap])
def test_derivatives_from_python_have_the_options(derivative, monkeypatch):
    """What stands within another program must not: JAX refuses it."""
    asked, with_options = [], jit._program_with_options
    monkeypatch.setattr(jit, "_program_with_options", lambda function: asked.append(function.__name__) or with_options(function))
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    end = lambda c: jl.simulate(oscillator, 1.0, 0.0, TS, {"c": c}).q[-1]
    c = jnp.array([4.0, 5.0]) if derivative is jax.vmap else 4.0
    found = derivative(end)(c)
    assert asked and set(asked) <= {"solved", "_trajectory"}
    asked.clear()
    np.testing.assert_allclose(found, jax.jit(derivative(end))(c), rtol=1e-9)
    assert not asked


WITHIN_JIT = """
import sys
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
import jaxlag as jl

L = lambda q, qdot: 0.5 * qdot @ qdot + 0.3 * qdot[0] * qdot[1] - 0.5 * (q[0] - q[1]) ** 2
blocks = jl.System(L, dissipation=lambda qdot, F: F * jnp.sum(jnp.abs(qdot)), force=lambda t, A: jnp.array([1.0, 0.0]) * A * jnp.sin(t))
motion = lambda A: jl.simulate(blocks, np.zeros(2), np.zeros(2), np.linspace(0, 3, 11), {"A": A, "F": 1.0}).q[-1]
print(*motion(3.0), *jax.jit(motion)(3.0))
"""


@pytest.mark.slow
def test_within_the_users_own_jit_a_motion_ends():
    """Two blocks that may stick, and a load of the time: with XLA's defaults, one kernel of the watch of a step ran without end."""
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    said = subprocess.run([sys.executable, "-c", WITHIN_JIT], env=environment, capture_output=True, text=True, timeout=600, check=True)
    alone, within = np.reshape([float(x) for x in said.stdout.split()], (2, 2))
    np.testing.assert_allclose(within, alone, rtol=1e-9)


@pytest.mark.slow
def test_within_the_users_own_jit_everything_may_be_known():
    """A motion of nothing but constants."""
    motion = lambda: jl.simulate(vehicle.system, vehicle.q0, vehicle.qdot0, TS, vehicle.params).q["y"]
    np.testing.assert_allclose(jax.jit(motion)(), motion(), rtol=1e-12)
