"""The structure of a program, read with nothing known of its arguments: what its entries are made of, their degree in the velocities,
and where they stand.
"""

import math
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .interpreter import Reader, is_extended
from .rules import CALLS
from .scalar_graph import Algebra, Arrays, Entry, filled, is_number, objects

Path = tuple[int, ...]  # to an equation: its number in the program, that of the call within it, that of the equation in there, ...
Place = tuple[Path, int, int, float]  # the equation, its output, the entry therein, and the number it is to be multiplied by
OPENED = frozenset((*CALLS, "custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr", "scan", "cond"))
LINEAR = frozenset(("add", "sub", "add_any", "neg", "copy", "stop_gradient"))
ORDER = {"gt": 1, "ge": 1, "lt": -1, "le": -1}
NONLINEAR = 9
LARGE = 2_000  # a product of arrays with more multiplications is not followed entry by entry


class _Unknown(Algebra):
    """Nothing is known of an entry but what it is made of: enough to ask what it becomes where others vanish."""

    reader: "Structure"

    def function(self, primitive, params, dtype):
        return lambda *operands: self.reader.apply(primitive, params, dtype, *operands)


class Structure(Reader):
    """Reads programs for their structure. Of each entry it knows its degree in the velocities, and where it stands in the program."""

    def __init__(self, limit: int | float = math.inf):
        super().__init__(_Unknown(), limit)
        self.algebra.reader = self  # type: ignore[attr-defined]
        self.degrees: dict[Entry, int] = {}
        self.given: dict[int, tuple[Any, np.ndarray]] = {}
        self.blocks: dict[tuple, Arrays] = {}
        self.begin()

    def begin(self) -> None:
        """Forgets where entries stand: a program of its own follows."""
        self.path: list[int] = []
        self.sealed = 0
        self.places: dict[Entry, Place] = {}
        self.fresh: dict[Path, list[list[tuple[int, Entry]]]] = {}
        self.branches: dict[Path, int] = {}

    def unknown(self, array: Any, argument: int = -1, degree: int = 0) -> np.ndarray:
        """Entries for what comes from outside; the same for the same array, or for the same argument of a function."""
        key = id(array) if argument < 0 else argument  # q and q̇ may be the same array
        if key not in self.given:
            entries = filled(array.shape, [self.argument(array.dtype) for _ in range(array.size)])
            self.given[key] = array, entries
            self.degrees |= dict.fromkeys(entries.flat, degree)
        return self.given[key][1]

    def new(self, *what: Any) -> Entry:
        entry = super().new(*what)
        self.degrees[entry] = self._degree(entry)
        return entry

    def degree(self, x: Any) -> int:
        """The degree in the velocities: 0 does not depend on them, 1 is affine."""
        return self.degrees[x] if isinstance(x, Entry) else 0

    def _degree(self, entry) -> int:
        of = [self.degree(x) for x in entry.operands]
        if not any(of):
            return 0
        if entry.name in LINEAR or (entry.name == "convert_element_type" and jnp.issubdtype(entry.dtype, jnp.inexact)):
            return max(of)
        if entry.name == "mul":
            return min(sum(of), NONLINEAR)
        if entry.name in ("div", "select_n", "item"):
            apart = {"div": 1, "select_n": 0, "item": None}[entry.name]
            return max(of) if apart is None or of[apart] == 0 else NONLINEAR
        return NONLINEAR

    def inner(self, jaxpr: Any, inputs: Any) -> Arrays:
        if self.path:
            self.path[-1] += 1
        for i, array in enumerate(inputs):
            if not self.path and array.dtype == object:
                self._placed((-1,), i, array)
        self.path.append(-1)
        outputs = super().inner(jaxpr, inputs)
        self.path.pop()
        return outputs

    def equation(self, equation: Any, operands: Arrays) -> Arrays:
        name = equation.primitive.name
        self.path[-1] += 1
        here = tuple(self.path)
        self.path.append(-1)
        special = {"cond": self._branched, "dot_general": self._product}.get(name)
        results = special(equation, operands, here) if special else None
        if results is None and name in ("jit", "pjit") and equation.params["name"] == "hypot" and is_hypot(equation):
            root = lambda x, y: self.apply(lax.sqrt_p, {}, x.dtype, self.add(self.mul(x, x), self.mul(y, y)))
            results, name = [np.asarray(np.frompyfunc(root, 2, 1)(*map(objects, operands)), object)], "sqrt"
        if results is None:
            self.sealed += name not in OPENED
            results = super().equation(equation, operands)
            self.sealed -= name not in OPENED
        self.path.pop()
        if not self.sealed and name not in OPENED:
            before = {x for array in operands if array.dtype == object for x in array.flat}
            fresh = [[(k, x) for k, x in enumerate(a.flat) if isinstance(x, Entry) and x not in before] for a in map(objects, results)]
            if any(fresh):
                self.fresh[here] = fresh
            for i, array in enumerate(results):
                self._placed(here, i, array)
        return results

    def _placed(self, path, i, array):
        if array.dtype == object:
            for k, x in enumerate(array.flat):
                if isinstance(x, Entry):
                    self.places.setdefault(x, (path, i, k, 1.0))
                    number, entry = factored(x)
                    if entry is not x and number != 0:
                        self.places.setdefault(entry, (path, i, k, 1 / float(number)))

    def whole(self, equation: Any, operands: Arrays) -> Arrays:
        if all(x.dtype != object for x in operands) and not any(map(is_extended, [*equation.invars, *equation.outvars])):
            return super().whole(equation, operands)
        return self._block(equation, operands)

    def _block(self, equation, operands, degree=None) -> Arrays:
        """Outputs of which no more is known than what they depend on; the same for the same."""
        flat = [x for array in operands for x in objects(array).flat]
        key = (equation.primitive.name, str(equation.params), *(x if isinstance(x, Entry) else (x.dtype, str(x)) for x in flat))
        if key not in self.blocks:
            self.blocks[key] = self.block(lambda *_: [], operands, equation.outvars)
            if degree is not None:
                self.degrees |= {x: degree for array in self.blocks[key] for x in array.flat}
        return self.blocks[key]

    def _product(self, equation, operands, here):
        (x_sum, _), _ = equation.params["dimension_numbers"]
        x, _ = operands
        size = equation.outvars[0].aval.size * math.prod(x.shape[d] for d in x_sum)
        if size <= LARGE or all(operand.dtype != object for operand in operands):
            return None
        degree = sum(max(map(self.degree, operand.flat), default=0) for operand in operands)
        return self._block(equation, operands, min(degree, NONLINEAR))

    def _branched(self, equation, operands, here):
        """All branches where it is not known which: one of them is selected, as under `vmap`."""
        index, *operands = operands
        branches = equation.params["branches"]
        if index.dtype != object:
            self.branches[here] = min(max(int(index), 0), len(branches) - 1)
            return self.inner(branches[self.branches[here]], operands)
        cases = [[objects(x) for x in self.inner(branch, operands)] for branch in branches]
        which = index.item()
        select = lambda *of: self.apply(lax.select_n_p, {}, of[0].dtype, which, *of)
        return [np.asarray(np.frompyfunc(select, len(branches), 1)(*column), object) for column in zip(*cases, strict=True)]

    def where_zero(self, x: Any, zeros: Iterable[Entry], positive: frozenset[Entry]) -> Any:
        """What an entry becomes where others are zero. Of a power 0^p with an unknown p it is assumed that p > 0, and of a threshold
        among `positive`, with which a zero is compared, that it is what it says.
        """
        values: dict[Any, Any] = {entry: entry.dtype.type(0) for entry in zeros}
        for entry in self.below([x]):
            if entry not in values:
                operands = tuple(values.get(y, y) for y in entry.operands)
                changed = any(a is not b for a, b in zip(operands, entry.operands, strict=True))
                again = self.new if entry.name in ("block", "item") else None
                if changed and entry.name == "pow" and is_number(operands[0]) and operands[0] == 0:
                    values[entry] = entry.dtype.type(0)
                elif changed and entry.name in ORDER and any(is_number(y) and y == 0 for y in operands):
                    sizes = [y.dtype.type(np.sign(factored(y)[0])) if factored(y)[1] in positive else y for y in operands]
                    values[entry] = entry.function(*sizes)  # type: ignore[misc]
                elif changed:
                    rebuilt = again(entry.dtype, entry.name, entry.function, operands) if again else entry.function(*operands)  # type: ignore[misc]
                    values[entry] = rebuilt
        return values.get(x, x)

    def below(self, outputs: Iterable[Any]) -> list[Entry]:
        """All entries that some are made of, these included, each after those it needs."""
        found, waiting = set(), [x for x in outputs if isinstance(x, Entry)]
        while waiting:
            entry = waiting.pop()
            if entry not in found:
                found.add(entry)
                waiting += [x for x in entry.operands if isinstance(x, Entry)]
        return sorted(found, key=lambda entry: entry.place)


def factored(x: Any) -> tuple[Any, Any]:
    """A number and the entry it multiplies; None for a number alone."""
    if is_number(x):
        return x, None
    if x.name == "neg":
        number, entry = factored(x.operands[0])
        return -number, entry
    return x.operands if x.name == "mul" and is_number(x.operands[0]) else (1.0, x)


def is_hypot(equation: Any) -> bool:
    """Whether a compiled function of this name is that of JAX, and not one of the user's."""
    given = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype, weak_type=v.aval.weak_type) for v in equation.invars]
    own = jax.make_jaxpr(jnp.hypot)(*given).jaxpr.eqns
    return len(given) == 2 and len(own) == 1 and str(own[0].params["jaxpr"]) == str(equation.params["jaxpr"])
