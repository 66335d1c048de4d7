"""What is static about a system: read in its programs once for each program that is traced, whatever the numbers."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._program.jit import traced_program
from .._program.registry import Table
from .system import System

T = TypeVar("T")


class StatesAt(NamedTuple):
    """The further states by name, and the time and the state at which they have these values."""

    values: Mapping[str, PyTree]
    t: Any
    q: Float[Array, " n"]
    v: Float[Array, " n"]


class Source(NamedTuple):
    """What a system over flat vectors was bound from, and in which way it was varied since: by functions (flat, t, q, v) ↦ flat, which
    choose a mode for example, of which nothing but its shape is known.
    """

    system: System
    like: PyTree  # shapes of the coordinates
    params: PyTree
    states: StatesAt | None
    variants: tuple[Callable, ...] = ()

    @classmethod
    def of(cls, system: System, like: PyTree, params: PyTree, states: StatesAt | None) -> "Source":
        """Of coordinates structured `like` these."""
        like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), like)
        return cls(system, like, params, states if states and states.values else None)

    def with_variant(self, of: Callable) -> "Source":
        """Varied in one more way; twice in the same is once."""
        return self if of in self.variants else self._replace(variants=(*self.variants, of))

    @property
    def numbers(self) -> list[Any]:
        """Arrays among the leaves of params and states."""
        return [leaf for leaf in self._leaves()[0] if hasattr(leaf, "dtype")]

    @property
    def shapes(self) -> tuple[list[jax.ShapeDtypeStruct], tuple[jax.ShapeDtypeStruct, ...]]:
        """Shapes of the numbers, and of t, q, v."""
        of_q = jax.tree.leaves(self.like)
        size, dtype = sum(int(np.prod(x.shape)) for x in of_q), jnp.result_type(*(x.dtype for x in of_q))
        q = jax.ShapeDtypeStruct((size,), dtype)
        return [_shape(x) for x in self.numbers], (jax.ShapeDtypeStruct((), dtype), q, q)

    def with_numbers(self, numbers: Sequence[Any]) -> "Source":
        """With these numbers in place of its own."""
        given, (leaves, structure) = iter(numbers), self._leaves()
        params, states = structure.unflatten([next(given) if hasattr(leaf, "dtype") else leaf for leaf in leaves])
        return self._replace(params=params, states=states)

    @property
    def stated(self) -> "Source":
        """As the system was bound, before it was varied."""
        return self._replace(variants=())

    def read(self, question: Callable[..., T], bound: Callable[["Source"], Any]) -> T:
        """What `question(flat, t, q, v)` sees in programs of unknown numbers, with `flat` as `bound`, and varied: asked once for each
        system and form of its arguments.
        """

        def read(source):
            found: list[T] = []

            def reading(numbers, t, q, v):
                flat = bound(source.with_numbers(numbers))
                for of in source.variants:
                    flat = of(flat, t, q, v)
                found.append(question(flat, t, q, v))

            numbers, state = source.shapes
            jax.eval_shape(reading, numbers, *state)
            return found[0], True

        return self._once(question, read)

    def read_programs(self, read: Callable[["Source"], tuple[T, bool]]) -> T:
        """What `read(source)` finds in programs that it traces itself: once, if these are to be kept."""
        return self._once(read, read)

    def _once(self, question, read):
        leaves, structure = self._leaves()
        form = tuple(_shape(x) if hasattr(x, "dtype") else x for x in leaves)
        key = question, self.variants, structure, form, jax.tree.structure(self.like), tuple(jax.tree.leaves(self.like))
        now, known = _READ.get(self.system, (None, {}))
        if now != traced_program():
            known = {}
            _READ[self.system] = traced_program(), known
        if key in known:
            return known[key]
        found, holds = read(self)
        if holds:
            known[key] = found
        return found

    def _leaves(self):
        return jax.tree.flatten((self.params, self.states))


def _shape(x):
    return jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=bool(getattr(x, "weak_type", False)))


_READ = Table(weak=True)  # by system, for the program that is traced; there by question and form
