"""`jax.jit` for pytrees with static leaves, and compiler options that save a third of the compile time.

On a CPU, XLA compiles each kernel with MLIR, which takes long. With its older emitters, programs compile a third faster and run as fast,
except in batches (tests/benchmarks/bench_emitters.py). Programs called from Python get these options; within a user's own `jit` the
choice is the user's: the environment variable XLA_FLAGS="--xla_cpu_use_fusion_emitters=false".
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

OLD_EMITTERS = {"xla_cpu_use_fusion_emitters": False}


def jitted(function: Callable, **options: Any) -> Callable:
    """`jax.jit` that traces arrays and treats all other leaves as static.

    `equinox.filter_jit` does that too, but keeps its arguments alive in a cache of JAX that `jax.clear_caches` does not clear.
    """

    def on_leaves(arrays, static):
        leaves, structure = static
        merged = [array if leaf is None else leaf for array, leaf in zip(arrays, leaves, strict=True)]
        given, named = jax.tree.unflatten(structure, merged)
        return function(*given, **named)

    on_leaves.__name__ = getattr(function, "__name__", "on_leaves")  # the name of the program
    program = jax.jit(on_leaves, static_argnums=1, **options)

    @functools.wraps(function)
    def call(*given, **named):
        leaves, structure = jax.tree.flatten((given, named))
        is_array = [isinstance(leaf, (jax.Array, np.ndarray)) for leaf in leaves]
        arrays = [leaf if traced else None for leaf, traced in zip(leaves, is_array, strict=True)]
        static = tuple(None if traced else leaf for leaf, traced in zip(leaves, is_array, strict=True))
        return program(arrays, (static, structure))

    return call


def compiled(function: Callable) -> Callable:
    """`jitted`, with compiler options of its own where Python calls the program, not another program."""
    within = jitted(function)

    @functools.wraps(function)
    def call(*given, **named):
        return (_jitted_with_options(function) if _is_called_by_python(given, named) else within)(*given, **named)

    return call


def _is_called_by_python(*given) -> bool:
    """Whether the call is not being traced: under `jit` even what is computed from numbers is traced."""
    return jax.default_backend() == "cpu" and is_concrete(given, jnp.zeros(()))


@functools.cache
def _jitted_with_options(function):
    return jitted(function, compiler_options=_options())


@functools.cache
def _options() -> dict[str, bool]:
    """The options that this version of XLA knows: it refuses those that it does not."""
    try:
        jax.jit(lambda: 0, compiler_options=OLD_EMITTERS)()
    except jax.errors.JaxRuntimeError:
        return {}
    return OLD_EMITTERS


def is_concrete(*trees: PyTree) -> bool:
    """Whether the values are known, so that Python may look at them; under `jit` and `vmap` they are not."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))
