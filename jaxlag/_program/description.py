"""Objects and programs in words: where the words are equal, so is what they describe.

What cannot be described for certain is refused: objects of unknown kinds, and functions with a derivative rule of their own, whose rule
no program shows before it is differentiated.
"""

import dataclasses
import enum
import hashlib
import sys
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from jax.extend import core
from jax.extend.core import primitives

from .user_calls import Call

KNOWN = ("jax", "jaxlib", "jaxlag", "diffrax", "equinox", "optimistix", "lineax", "optax", "numpy", "jaxtyping", "builtins")
WITH_METHODS = ("jaxlag", "diffrax", "optimistix", "lineax", "optax")  # packages whose classes a user derives others from
PRIMITIVES = {x for x in vars(primitives).values() if isinstance(x, core.Primitive)}  # of JAX itself
PLAIN = (type(None), bool, int, float, complex, str, bytes, type(...), slice)


class NotDescribable(Exception):
    """There are no words for it that would tell it from everything else."""


class Words:
    """Words for objects, hashed as they come; and the objects that have an identity, in the order in which they were met."""

    def __init__(self) -> None:
        self.hash = hashlib.sha256()
        self.objects: list[Any] = []  # described by their parts
        self.functions: list[Callable] = []  # of the user, of which only the signature is described here
        self._places: dict[int, int] = {}

    def digest(self) -> str:
        """Of all words so far."""
        return self.hash.hexdigest()

    def say(self, *words: Any) -> None:
        """Adds words."""
        self.hash.update(repr(words).encode())

    def structure(self, structure: Any, within: bool = False) -> None:
        """A structure of a pytree, with what it holds beside its leaves. What stands `within` a solver has methods that are called, and has
        to be of a package, as has what is derived from one.
        """
        node = structure.node_data()
        if node is None:
            self.say("leaf" if structure.num_leaves else "none")
            return
        kind, static = node
        if not _is_known(kind) and (within or _is_derived(kind)):
            raise NotDescribable(f"methods of {kind!r}")
        self.say("node", _name(kind), structure.num_nodes)
        self.value(static)
        for child in structure.children():
            self.structure(child, within or _root(kind) in WITH_METHODS[1:])

    def value(self, x: Any) -> None:
        """A constant."""
        if isinstance(x, jax.core.Tracer):
            raise NotDescribable("a number that is traced")
        if isinstance(x, enum.Enum):
            self.say(_name(type(x)), x.name)
        elif type(x) in PLAIN:
            self.say(type(x).__name__, x)
        elif isinstance(x, (np.ndarray, np.generic, jax.Array)):
            array = np.asarray(x)
            self.say("array", str(array.dtype), array.shape, bool(getattr(x, "weak_type", False)), array.tobytes())
        elif isinstance(x, np.dtype):
            self.say("dtype", str(x))
        elif isinstance(x, (core.ClosedJaxpr, core.Jaxpr)):
            self.program(x)
        elif isinstance(x, jax.tree_util.PyTreeDef):
            self.structure(x)
        elif isinstance(x, jax.core.ShapedArray):
            self.say("shape", x.shape, str(x.dtype), x.weak_type)
        elif isinstance(x, type):
            self.say("class", _name(x))
        else:
            self._thing(x)

    def _thing(self, x):
        """What is made of parts, or a function."""
        if id(x) in self._places:
            self.say("again", self._places[id(x)])
            return
        self.say(_name(type(x)))
        if not isinstance(x, (dict, tuple, list, frozenset)):
            self._places[id(x)] = len(self.objects)
            self.objects.append(x)
        if isinstance(x, Mapping) and type(x) is dict:
            self._parts(list(x.items()))
        elif isinstance(x, (tuple, list)):
            self._parts(list(x))
        elif isinstance(x, (frozenset, set)):
            self._parts(sorted(x))
        elif _is_of_package(x):
            self.say(x.__module__, x.__qualname__)
        elif dataclasses.is_dataclass(x) and not callable(x) and not _is_derived(type(x)):
            self._parts([(field.name, getattr(x, field.name, None)) for field in dataclasses.fields(x)])
        elif type(x).__module__.split(".")[0] == "jax" and (not callable(x) or isinstance(x, jax.sharding.Mesh)) and "0x" not in repr(x):
            self.say(repr(x))  # parts of equations: shardings, meshes, dimensions
        elif callable(x):
            self._function(x)
        elif _is_known(type(x)) and getattr(x, "__dict__", None) == {}:  # a mark that is told by its class
            pass
        else:
            raise NotDescribable(repr(x))

    def _parts(self, parts):
        self.say(len(parts))
        for part in parts:
            self.value(part)

    def _function(self, function):
        """What is asked of a user's function by name: its arguments, and those of the functions it is composed of."""
        import inspect

        declared = inspect.signature(function).parameters.values()
        self.say("function", len(self.functions), [(p.name, str(p.kind), p.default is p.empty) for p in declared])
        self.functions.append(function)
        for part in getattr(function, "composed_of", ()):
            self.say("of", [(p.name, str(p.kind)) for p in inspect.signature(part).parameters.values()])

    def program(self, program: Any) -> None:
        """A program of JAX: its equations with their parameters, variables by the order in which they appear."""
        jaxpr = getattr(program, "jaxpr", program)
        names: dict[Any, int] = {}
        name = lambda v: names.setdefault(v, len(names))
        shape = lambda v: (str(v.aval), bool(getattr(v.aval, "weak_type", False)))
        if jaxpr.effects:
            raise NotDescribable(f"effects {jaxpr.effects}")
        self.say("program", [(name(v), shape(v)) for v in (*jaxpr.constvars, *jaxpr.invars)])
        for equation in jaxpr.eqns:
            if equation.primitive.name.startswith("custom_") and equation.primitive.name != "custom_linear_solve":
                raise NotDescribable(f"{equation.primitive.name}, which has a derivative rule of its own")
            if equation.primitive not in PRIMITIVES:
                raise NotDescribable(f"{equation.primitive.name}, which is not of JAX")
            self.say(equation.primitive.name, str(equation.ctx))
            for v in equation.invars:
                self.value(v.val) if isinstance(v, core.Literal) else self.say(name(v))
            for key, value in sorted(equation.params.items()):
                self.say(key)
                self.value(value)
            self.say([(name(v), shape(v)) for v in equation.outvars])
        for v in jaxpr.outvars:
            self.value(v.val) if isinstance(v, core.Literal) else self.say(name(v))
        for constant in getattr(program, "consts", ()):
            self.value(constant)
        if self.functions:
            raise NotDescribable(f"a program that calls {self.functions[-1]!r}")

    def answer(self, function: Callable, call: Call) -> None:
        """What a user's function returns for such arguments, as a program. Nothing of this may be a function in its turn."""
        shapes, filled = call.arguments()

        def returned(arrays):
            positional, by_name = filled(arrays)
            leaves, structure = jax.tree.flatten(function(*positional, **by_name))
            is_unknown = [isinstance(leaf, jax.Array) for leaf in leaves]
            self.value([None if unknown else leaf for leaf, unknown in zip(leaves, is_unknown, strict=True)])
            self.structure(structure)
            return [leaf for leaf, unknown in zip(leaves, is_unknown, strict=True) if unknown]

        self.program(jax.make_jaxpr(returned)(shapes))


def answer_of(function: Callable, call: Call) -> str | None:
    """The digest of what a function returns for such arguments; None where that has no certain description."""
    words = Words()
    try:
        words.answer(function, call)
    except Exception:  # a function may do anything with arguments of unknown numbers
        return None
    return words.digest()


def _name(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


def _root(x: Any) -> str:
    """The package that a class or function is of."""
    module = getattr(x, "__module__", None)
    return module.split(".")[0] if isinstance(module, str) else ""


def _is_known(x: Any) -> bool:
    """Whether it is a class or function of a package whose version is known."""
    return _root(x) in KNOWN


def _is_derived(kind: type) -> bool:
    """Whether it is a class of the user's that is derived from one of those packages."""
    return not _is_known(kind) and any(_root(base) in WITH_METHODS for base in kind.__mro__)


def _is_of_package(x: Any) -> bool:
    """Whether it is a function of a package whose version is known, found by its name."""
    name = getattr(x, "__qualname__", None)
    if not (_is_known(x) and isinstance(name, str)):
        return False
    found = sys.modules.get(x.__module__)
    for part in name.split("."):
        found = getattr(found, part, None)
    return found is x
