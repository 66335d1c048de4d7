"""Objects in words: where the words are equal, so is what they describe. A function is described by its code and all that this refers to.

What cannot be described for certain is refused: objects of unknown kinds, code that reads a file or changes what others refer to, a
function with a derivative rule of its own, and one that was described before and refers to something else now: of what was traced with it
a part may be left.
"""

import builtins
import dataclasses
import dis
import enum
import functools
import hashlib
import sys
import types
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np

from .registry import Table, remembered

PACKAGES = ("jax", "jaxlib", "jaxlag", "diffrax", "equinox", "optimistix", "lineax", "optax", "numpy", "jaxtyping")  # of known versions
OF_PYTHON = ("builtins", "math", "functools", "operator", "_operator", "dataclasses", "abc", "enum", "typing", "types", "collections")
KNOWN = (*PACKAGES, *OF_PYTHON)
PLAIN = (type(None), bool, int, float, complex, str, bytes, type(...))
CONTAINERS = (tuple, frozenset, list, dict, set)
UNCERTAIN = ("eval", "exec", "globals", "locals", "vars", "open", "input", "__import__", "id")  # builtin functions
MISSING = object()
MANY = 4096  # numbers of an array that may change: more take too long to be compared at each call
WRITTEN_IN_PYTHON = 1 << 9  # a flag of classes
DEPTH = 50  # of what refers to what
UNSAID = {  # members of a class that its objects do nothing with
    *("__module__", "__qualname__", "__doc__", "__dict__", "__weakref__", "__annotations__", "__match_args__", "__orig_bases__"),
    *("__dataclass_fields__", "__dataclass_params__", "__abstractmethods__", "_abc_impl", "__parameters__", "__firstlineno__"),
    *("__static_attributes__", "__annotate_func__", "__annotations_cache__", "__repr__"),
}


class NotDescribable(Exception):
    """There are no words for it that would tell it from everything else."""


class Words:
    """Words for objects, hashed as they come; the objects that have an identity, in the order in which they were met; and for each thing
    that may change whether it is `unchanged`.
    """

    def __init__(self, within: tuple[Any, ...] = ()) -> None:
        self.hash = hashlib.sha256()
        self.objects: list[Any] = []  # described by their parts
        self.unchanged: list[Callable[[], bool]] = []
        self._within = within  # what of the user's is being described
        self._places: dict[int, int] = {}
        self._frozen = False  # whether an object that may not change is being described

    def digest(self) -> str:
        """Of all words so far."""
        return self.hash.hexdigest()

    def say(self, *words: Any) -> None:
        """Adds words."""
        self.hash.update(repr(words).encode())

    def structure(self, structure: Any) -> None:
        """A structure of a pytree, with what it holds beside its leaves."""
        node = structure.node_data()
        if node is None:
            self.say("leaf" if structure.num_leaves else "none")
            return
        kind, static = node
        self.say("node", structure.num_nodes)
        self.value(kind)
        self.value(static)
        for child in structure.children():
            self.structure(child)

    def value(self, x: Any) -> None:
        """A constant."""
        if isinstance(x, jax.core.Tracer):
            raise NotDescribable("a number that is traced")
        if isinstance(x, enum.Enum):
            self.value(type(x))
            self.say(x.name)
        elif type(x) in PLAIN:
            self.say(type(x).__name__, x)
        elif isinstance(x, (np.ndarray, np.generic, jax.Array)):
            self._array(x)
        elif isinstance(x, np.dtype):
            self.say("dtype", str(x))
        elif isinstance(x, slice):
            self.value((x.start, x.stop, x.step))
        elif isinstance(x, jax.tree_util.PyTreeDef):
            self.structure(x)
        elif isinstance(x, jax.core.ShapedArray):
            self.say("shape", x.shape, str(x.dtype), x.weak_type)
        elif isinstance(x, types.CodeType):
            self._code(x)
        elif isinstance(x, types.ModuleType):
            if not _is_known(x) or x.__name__.startswith("numpy.random"):
                raise NotDescribable(f"{x.__name__}, which may change")
            self.say("module", x.__name__)
        elif id(x) in self._places:
            self.say("again", self._places[id(x)])
        elif type(x) in CONTAINERS:
            self._container(x)
        else:
            self._places[id(x)] = len(self.objects)
            self.objects.append(x)
            self._object(x)

    def _array(self, x):
        may_change = not isinstance(x, (np.generic, jax.Array))
        if may_change and (self._frozen or type(x) is not np.ndarray or x.size > MANY or x.dtype == object):
            raise NotDescribable("numbers that may change")
        array = np.asarray(x)
        content = array.tobytes()
        self.say("array", may_change, type(x).__name__, str(array.dtype), array.shape, bool(getattr(x, "weak_type", False)), content)
        if may_change:
            self.unchanged.append(lambda: x.tobytes() == content)

    def _container(self, x):
        self.say("container", type(x).__name__, len(x))
        if type(x) in (list, dict, set):
            if self._frozen:
                raise NotDescribable("a container that may change")
            self._may_change(x)
        try:
            for part in x.items() if type(x) is dict else sorted(x) if isinstance(x, (frozenset, set)) else x:
                self.value(part)
        except TypeError as error:  # no order
            raise NotDescribable(str(error)) from error

    def _may_change(self, x):
        """A container, or the namespace of a class."""
        parts = lambda: [*x, *x.values()] if isinstance(x, Mapping) else list(x)
        before = parts()
        self.unchanged.append(lambda: len(now := parts()) == len(before) and all(map(_is, now, before)))

    def _object(self, x):
        """What is told by its name, or made of parts."""
        if isinstance(x, type):
            self._class(x)
        elif _is_found_by_name(x):
            self.say(x.__module__, x.__qualname__)
        elif isinstance(x, types.FunctionType):
            self.say("function")
            self._of_the_user(x, Words._function)
        elif isinstance(x, types.MethodType):
            self.say("method")
            self.value(x.__func__)
            self.value(x.__self__)
        elif type(x) is functools.partial:
            self.say("partial")
            for part in (x.func, x.args, tuple(sorted(x.keywords.items()))):
                self.value(part)
        elif _is_known(type(x)) or isinstance(x, tuple):
            self.value(type(x))
            self._parts(x)
        elif isinstance(x, eqx.Module) or (dataclasses.is_dataclass(x) and type(x).__dataclass_params__.frozen):
            self._of_the_user(x, Words._frozen_parts)
        else:
            raise NotDescribable(repr(x))

    def _frozen_parts(self, x):
        self._frozen = True
        self.value(type(x))
        self._parts(x)

    def _parts(self, x):
        if isinstance(x, tuple):
            self.value(tuple(x))
        elif dataclasses.is_dataclass(x):
            for field in dataclasses.fields(x):
                self.say(field.name)
                self.value(getattr(x, field.name, None))
        elif _root(type(x)) in (*PACKAGES, "dataclasses") and getattr(x, "__dict__", None) == {}:  # a mark, told by its class
            pass
        elif _root(type(x)) == "jax" and (not callable(x) or isinstance(x, jax.sharding.Mesh)) and "0x" not in repr(x):
            self.say(repr(x))  # shardings, meshes, dimensions
        else:
            raise NotDescribable(repr(x))

    def _class(self, kind):
        """A class by its name, or the user's by its members that are called."""
        self.say("class", kind.__module__, kind.__qualname__)
        if _is_known(kind):
            if kind.__flags__ & WRITTEN_IN_PYTHON and _by_name(kind) is not kind:
                raise NotDescribable(f"{kind!r}, which its name does not tell")
            return
        self.value(type(kind))
        self.value(kind.__bases__)
        self._may_change(vars(kind))
        for name, member in sorted(vars(kind).items()):
            if name in UNSAID or isinstance(member, (types.MemberDescriptorType, types.GetSetDescriptorType)):
                continue
            self.say(name, type(member).__name__)
            is_function = isinstance(member, types.FunctionType)
            inner = [] if is_function else [getattr(member, key) for key in ("fget", "method", "__func__") if hasattr(member, key)]
            self.value(inner[0] if inner else member)

    def _of_the_user(self, x, parts):
        """A function or an object of the user's. One is refused that was made of, or referred to, something else when it was met before."""
        for i, around in enumerate(self._within):
            if around is x:
                self.say("itself", i)
                return
        if len(self._within) > DEPTH:
            raise NotDescribable("functions that call functions that call functions")
        own = Words((*self._within, x))
        own._frozen = self._frozen
        parts(own, x)
        if not self._within and _DESCRIBED.setdefault(x, own.digest()) != own.digest():
            _DESCRIBED[x] = "changed"
            raise NotDescribable(f"{x!r}, which refers to something else than before")
        self.say(own.digest())
        self.unchanged += own.unchanged

    def _function(self, function):
        """By its code and all that this refers to."""
        self.value(function.__code__)
        self.value(function.__defaults__)
        self.value(tuple(sorted((function.__kwdefaults__ or {}).items())))
        for name, x in sorted(vars(function).items()):
            self.say(name)
            self.value(x)
        self._closure(function)
        self._globals(function)
        code, defaults = function.__code__, function.__defaults__
        self.unchanged.append(lambda: function.__code__ is code and function.__defaults__ is defaults)

    def _closure(self, function):
        for cell in function.__closure__ or ():
            if (x := _content(cell)) is MISSING:
                raise NotDescribable("a name without a value")
            self.value(x)
            self.unchanged.append(lambda cell=cell, x=x: _content(cell) is x)

    def _globals(self, function):
        scope = function.__globals__
        for name in _names(function.__code__):
            self.say(name)
            if name in scope:
                x = scope[name]
                self.value(x)
                self.unchanged.append(lambda name=name, x=x: scope.get(name) is x)
            elif not hasattr(builtins, name) or name in UNCERTAIN:
                raise NotDescribable(f"{name}, which may be anything")
            else:
                self.unchanged.append(lambda name=name: name not in scope)

    def _code(self, code):
        """But for its place in a file."""
        variables = code.co_varnames, code.co_freevars, code.co_cellvars, code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount
        self.say("code", code.co_code, code.co_names, variables, code.co_flags, getattr(code, "co_exceptiontable", b""))
        for x in code.co_consts:
            self.value(x)


_DESCRIBED = Table(weak=True)  # of each function and object of the user's its words when it was met first


@remembered
def _names(code: types.CodeType) -> tuple[str, ...]:
    """Global names that code refers to."""
    found = set()
    for instruction in dis.get_instructions(code):
        name = instruction.argval
        if instruction.opname in ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS"):
            found.add(name)
        elif instruction.opname in ("STORE_GLOBAL", "DELETE_GLOBAL") or (
            instruction.opname == "IMPORT_NAME" and name.split(".")[0] not in KNOWN
        ):
            raise NotDescribable(f"code that has to do with {name}")
    if found & {"np", "numpy", "onp"} and "random" in code.co_names:
        raise NotDescribable("random numbers")
    within = [_names(x) for x in code.co_consts if isinstance(x, types.CodeType)]
    return tuple(sorted(found.union(*within)))


def _content(cell):
    """What a function closes over."""
    try:
        return cell.cell_contents
    except ValueError:
        return MISSING


def _is(a, b):
    return a is b


def _root(x: Any) -> str:
    """The package that a class or function says that it is of, or a module is."""
    name = x.__name__ if isinstance(x, types.ModuleType) else getattr(x, "__module__", None)
    return name.split(".")[0] if isinstance(name, str) else ""


def _is_known(x: Any) -> bool:
    """Whether its version is known."""
    return _root(x) in KNOWN


def _by_name(x: Any) -> Any:
    """What stands under the name of a class or function in its module."""
    found: Any = sys.modules.get(x.__module__)
    for part in x.__qualname__.split("."):
        found = getattr(found, part, None)
    return found


def _is_found_by_name(x: Any) -> bool:
    """Whether it is a function of a package whose version is known, found by its name."""
    return _is_known(x) and isinstance(getattr(x, "__qualname__", None), str) and _by_name(x) is x
