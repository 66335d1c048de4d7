"""Programs that Python calls, compiled in two thirds of the time.

On a CPU, XLA makes each of its kernels by a compiler of its own, which takes long; the emitters it had before make
programs that take a third less to compile and run as fast, but for batches (tests/benchmarks/bench_emitters.py).
Within a user's own `jit` that is the user's choice: the environment variable XLA_FLAGS="--xla_cpu_use_fusion_emitters=false".
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

QUICK = {"xla_cpu_use_fusion_emitters": False}


def jitted(function: Callable, **options: Any) -> Callable:
    """`jax.jit`, with arrays as what is traced and all else as what the program is made for.

    `equinox.filter_jit` does that too, but what it was called with stays alive in a cache of JAX that `jax.clear_caches` does not know.
    """

    def on_leaves(arrays, still):
        leaves, structure = still
        whole = [array if leaf is None else leaf for array, leaf in zip(arrays, leaves, strict=True)]
        given, named = jax.tree.unflatten(structure, whole)
        return function(*given, **named)

    on_leaves.__name__ = getattr(function, "__name__", "on_leaves")  # which is that of the program
    program = jax.jit(on_leaves, static_argnums=1, **options)

    @functools.wraps(function)
    def call(*given, **named):
        leaves, structure = jax.tree.flatten((given, named))
        is_array = [isinstance(leaf, (jax.Array, np.ndarray)) for leaf in leaves]
        arrays = [leaf if traced else None for leaf, traced in zip(leaves, is_array, strict=True)]
        still = tuple(None if traced else leaf for leaf, traced in zip(leaves, is_array, strict=True))
        return program(arrays, (still, structure))

    return call


def compiled(function: Callable) -> Callable:
    """`jitted`, with choices of its own for the compiler where Python calls the program, not another program."""
    within = jitted(function)

    @functools.wraps(function)
    def call(*given, **named):
        return (_quick(function) if _by_python(given, named) else within)(*given, **named)

    return call


def _by_python(*given) -> bool:
    """Whether nothing that is being traced calls: under `jit` even what is computed of numbers is traced."""
    return jax.default_backend() == "cpu" and is_concrete(given, jnp.zeros(()))


@functools.cache
def _quick(function):
    return jitted(function, compiler_options=_options())


@functools.cache
def _options() -> dict[str, bool]:
    """Those that this version of XLA knows; one that does not know an option refuses it."""
    try:
        jax.jit(lambda: 0, compiler_options=QUICK)()
    except jax.errors.JaxRuntimeError:
        return {}
    return QUICK


def is_concrete(*trees: PyTree) -> bool:
    """Whether the numbers are at hand, so that Python may look at them; under `jit` and `vmap` they are not."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))
