"""`jax.jit` for pytrees with static leaves, and compiler options that save a third of the compile time.

On a CPU, XLA compiles each kernel with MLIR, which takes long. With its older emitters, programs compile a third faster and run as fast,
except in batches (tests/benchmarks/bench_emitters.py). Programs called from Python get these options; within a user's own `jit` the
choice is the user's: the environment variable XLA_FLAGS="--xla_cpu_use_fusion_emitters=false".
"""

import functools
import threading
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import get_opaque_trace_state
from jaxtyping import PyTree

from .kept_programs import KEPT
from .registry import remembered
from .static import Static

OLD_EMITTERS = {"xla_cpu_use_fusion_emitters": False}
with jax.ensure_compile_time_eval():
    NOTHING_TRACED = get_opaque_trace_state()


def jitted(function: Callable, **options: Any) -> Callable:
    """`jax.jit` that traces arrays and treats all other leaves as static.

    `equinox.filter_jit` does that too, but keeps its arguments alive in a cache of JAX that `jax.clear_caches` does not clear.
    """
    program = _program(function, **options)

    @functools.wraps(function)
    def call(*given, **named):
        return program(*_split(given, named))

    return call


def compiled(function: Callable) -> Callable:
    """`jitted`, with compiler options of its own where Python calls the program, not another program."""
    within = _program(function)

    @functools.wraps(function)
    def call(*given, **named):
        arrays, static = _split(given, named)
        if not is_called_by_python(arrays):
            return within(arrays, static)
        program = _program_with_options(function)
        if KEPT.folder is None or _has_tracers(arrays):
            return program(arrays, static)
        return KEPT.called(program, call, arrays, static)

    return call


class _Traced(threading.local):
    """Counts the programs that are traced, those within others not."""

    depth, number = 0, 0

    def __enter__(self) -> None:
        self.number += not self.depth
        self.depth += 1

    def __exit__(self, *_: object) -> None:
        self.depth -= 1


_TRACED = _Traced()


def traced_program() -> tuple[int, int]:
    """Which program is being traced, or was last: what functions close over may have changed when the next one is."""
    return threading.get_ident(), _TRACED.number


def _program(function, **options):
    """The compiled `function(arrays, static)`."""

    def on_leaves(arrays, static):
        merged = [array if leaf is None else leaf for array, leaf in zip(arrays, static.leaves, strict=True)]
        given, named = jax.tree.unflatten(static.structure, merged)
        with _TRACED:
            returned = function(*given, **named)
        static.was_traced()
        return returned

    on_leaves.__name__ = getattr(function, "__name__", "on_leaves")  # the name of the program
    return jax.jit(on_leaves, static_argnums=1, **options)


def _split(given, named):
    """The arrays among the leaves, and what is static: the other leaves and the structure. Each has None where the other has a leaf."""
    leaves, structure = jax.tree.flatten((given, named))
    is_array = [isinstance(leaf, (np.ndarray, jax.Array, np.number)) for leaf in leaves]
    arrays = [leaf if traced else None for leaf, traced in zip(leaves, is_array, strict=True)]
    static = tuple([None if traced else leaf for leaf, traced in zip(leaves, is_array, strict=True)])
    return arrays, Static.of(static, structure)


def is_called_by_python(arrays: Iterable[Any] = ()) -> bool:
    """Whether the call is not being traced: under `jit` even what is computed from nothing is traced, under an eager `vmap` it is not."""
    leaves = list(arrays) if get_opaque_trace_state() == NOTHING_TRACED else [_nothing(), *arrays]
    return jax.default_backend() == "cpu" and (not _has_tracers(leaves) or all(map(_is_known, leaves)))


def _has_tracers(leaves):
    return any(issubclass(kind, jax.core.Tracer) for kind in {*map(type, leaves)})


def _is_known(leaf):
    """Whether it is a value, or a batch of values."""
    while (batch := _batch(leaf)) is not None:
        leaf, _ = batch
    return not isinstance(leaf, jax.core.Tracer)


def _batch(leaf):
    """The values of a batch under an eager `vmap`, and the axis of its members. None for anything else, and for all where JAX has these
    attributes no longer: then batches are compiled without options, and not looked at.
    """
    is_batch = isinstance(leaf, jax.core.Tracer) and hasattr(leaf, "batch_dim") and hasattr(leaf, "val")
    return (leaf.val, leaf.batch_dim) if is_batch else None


@jax.jit
def _nothing():
    return 0


@remembered
def _program_with_options(function):
    return _program(function, compiler_options=options())


@functools.cache
def options() -> dict[str, bool]:
    """Those for programs that Python calls on a CPU, as far as this version of XLA knows them: it refuses others."""
    if jax.default_backend() != "cpu":
        return {}
    try:
        jax.jit(lambda: 0, compiler_options=OLD_EMITTERS)()
    except jax.errors.JaxRuntimeError:
        return {}
    return OLD_EMITTERS


def numpy_for(*trees: PyTree) -> Any:
    """The module to compute these in: NumPy where the values are known, at a hundredth of the time that JAX takes for a small array."""
    return np if is_concrete(*trees) else jnp


def seen(tree: PyTree) -> PyTree | None:
    """The values as Python may look at them: of what is differentiated its value, of a batch the first; None where `jit` hides them."""
    return _looked_at(tree, _seen)


def values(tree: PyTree) -> PyTree | None:
    """The values as Python may look at them, of what is differentiated too; None where `jit` hides them, or there is a batch of them."""
    return _looked_at(tree, lambda leaf: jax.lax.stop_gradient(leaf) if isinstance(leaf, jax.core.Tracer) else leaf)


def _looked_at(tree, look):
    leaves, structure = jax.tree.flatten(tree)
    leaves = [look(leaf) for leaf in leaves]
    return None if _has_tracers(leaves) else jax.tree.unflatten(structure, leaves)


def _seen(leaf):
    leaf = jax.lax.stop_gradient(leaf)
    while (batch := _batch(leaf)) is not None:
        values, axis = batch
        leaf = jax.lax.stop_gradient(values if axis is None else jnp.take(values, 0, axis=axis))
    return leaf


def is_concrete(*trees: PyTree) -> bool:
    """Whether the values are known, so that Python may look at them; under `jit` and `vmap` they are not."""
    return not _has_tracers(jax.tree.leaves(trees))
