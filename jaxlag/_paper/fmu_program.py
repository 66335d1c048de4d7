"""Functions of arrays as straight-line programs in C99."""

import itertools
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from .._program.expressions import Algebra, filled
from .._program.interpreter import evaluate

MOST_ENTRIES = 1000  # of a table that is looked up


class Scalar(NamedTuple):
    """A variable or a number in C, and which numbers of all arguments, one behind the other, it depends on."""

    text: str
    behind: frozenset[int] = frozenset()

    @property
    def is_zero(self) -> bool:
        """Whether it is known to be zero."""
        return self.text in ("0", "0.0", "(-0.0)")


class InC(Algebra):
    """Scalars are variables of a C program, whose lines are collected."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def number(self, x):
        """A number in C."""
        return Scalar(literal(x))

    def function(self, primitive, params, dtype):
        """A line for each operation; None where C has none."""
        name = primitive.name
        formula = OF_INTEGERS.get(name) if np.issubdtype(dtype, np.integer) else FORMULAS.get(name)
        if name == "round" and params["rounding_method"] != jax.lax.RoundingMethod.TO_NEAREST_EVEN:
            return None
        return formula and (lambda *operands: self.variable(dtype, formula, *operands))

    def block(self, equation):
        """What looks up a table: a part of an array from a place on that is not known, and the order by which the place is found."""
        name, dtype = equation.primitive.name, equation.outvars[0].aval.dtype
        if name in ("lt_to", "le_to"):  # differ from lt and le in NaN and in the sign of zero
            return lambda x, y: [
                filled(x.shape, [self.variable(dtype, FORMULAS[name[:2]], *pair) for pair in zip(x.flat, y.flat, strict=True)])
            ]
        if name == "dynamic_slice" and equation.invars[0].aval.size <= MOST_ENTRIES:
            return lambda table, *starts: [self._part(dtype, table, starts, equation.params["slice_sizes"])]
        return None

    def variable(self, dtype: Any, formula: Callable[..., str], *operands: Scalar) -> Scalar:
        """The variable of one operation."""
        name = f"s{len(self.lines)}"
        self.lines.append(f"const {TYPES[np.dtype(dtype).kind]} {name} = {formula(*(x.text for x in operands))};")
        return Scalar(name, frozenset().union(*(x.behind for x in operands)))

    def _part(self, dtype: Any, table: np.ndarray, starts: Sequence[np.ndarray], sizes: Sequence[int]) -> np.ndarray:
        """The part of a table of these sizes, from these places on: chosen among those that fit, axis by axis."""
        for axis, (start, size) in enumerate(zip(starts, sizes, strict=True)):
            fit = table.shape[axis] - size + 1
            if fit > 1:
                parts = [np.take(table, range(k, k + size), axis) for k in range(fit)]
                chosen = [
                    self.variable(dtype, _looked_up, start.item(), *cases) for cases in zip(*(part.flat for part in parts), strict=True)
                ]
                table = filled(parts[0].shape, chosen)
        return table


class Program(NamedTuple):
    """A straight-line program: its lines, and its outputs."""

    lines: list[str]
    outputs: list[Scalar]


def read(function: Callable, arguments: dict[str, int]) -> Program:
    """The program of a function of vectors: of each the name in C and the size. Its outputs are in one vector.

    **Raises:** `UnknownPrimitive`, which names the line, if it is not made of scalar operations that C has.
    """
    algebra, count = InC(), itertools.count()
    closed = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct((size,), np.float64) for size in arguments.values()))
    given = [filled((size,), [Scalar(f"{name}[{i}]", frozenset((next(count),))) for i in range(size)]) for name, size in arguments.items()]
    found = [x for array in evaluate(closed, algebra, *given) for x in array.flat]
    return Program(algebra.lines, [x if isinstance(x, Scalar) else algebra.number(x) for x in found])


def written(name: str, program: Program, arguments: Sequence[str]) -> str:
    """A C function of the program, which fills y."""
    lines = [*(f"(void){argument};" for argument in arguments), *program.lines]
    lines += [f"y[{i}] = {x.text};" for i, x in enumerate(program.outputs)] or ["(void)y;"]
    head = ", ".join(f"const double *{argument}" for argument in arguments)
    return "\n".join([f"static void {name}({head}, double *y)", "{", *(f"    {line}" for line in lines), "}", ""])


def literal(x: Any) -> str:
    """A number in C."""
    if isinstance(x, (bool, np.bool_)):
        return str(int(x))
    if isinstance(x, (int, np.integer)):
        return f"({int(x)})" if x < 0 else str(int(x))
    value = float(x)
    if not np.isfinite(value):
        return "NAN" if np.isnan(value) else "INFINITY" if value > 0 else "(-INFINITY)"
    return f"({value!r})" if value < 0 or np.signbit(value) else repr(value)


def _selected(which: str, *cases: str) -> str:
    *others, last = cases
    return "(" + "".join(f"{which} == {k} ? {case} : " for k, case in enumerate(others)) + f"{last})"


def _looked_up(place: str, *cases: str) -> str:
    """The case of a place; the first or the last where it is beyond."""
    *others, last = cases
    return "(" + "".join(f"{place} <= {k} ? {case} : " for k, case in enumerate(others)) + f"{last})"


def _call(name: str) -> Callable[..., str]:
    return lambda *operands: f"{name}({', '.join(operands)})"


def _between(sign: str) -> Callable[..., str]:
    return lambda x, y: f"{x} {sign} {y}"


TYPES = {"f": "double", "b": "int", "i": "long long", "u": "long long"}
FORMULAS: dict[str, Callable[..., str]] = {
    **{name: _between(sign) for name, sign in dict(add="+", add_any="+", sub="-", mul="*", div="/").items()},
    **{name: _between(sign) for name, sign in dict(eq="==", ne="!=", lt="<", le="<=", gt=">", ge=">=").items()},
    **{name: _between(sign) for name, sign in {"and": "&&", "or": "||", "xor": "!="}.items()},
    **{name: _call(name) for name in re.findall(r"\w+", "sqrt cbrt exp exp2 expm1 log log1p sin cos tan asin acos atan atan2")},
    **{name: _call(name) for name in re.findall(r"\w+", "sinh cosh tanh asinh acosh atanh pow erf erfc lgamma floor ceil")},
    **dict(abs=_call("fabs"), max=_call("fmax"), min=_call("fmin"), rem=_call("fmod"), round=_call("rint"), is_finite=_call("isfinite")),
    "not": lambda x: f"!{x}",
    "neg": lambda x: f"-{x}",
    "sign": lambda x: f"({x} > 0) - ({x} < 0)",
    "rsqrt": lambda x: f"1 / sqrt({x})",
    "logistic": lambda x: f"1 / (1 + exp(-{x}))",
    "clamp": lambda low, x, high: f"fmin(fmax({low}, {x}), {high})",
    "convert_element_type": lambda x: x,
    "stop_gradient": lambda x: x,
    "select_n": _selected,
}
OF_INTEGERS = {
    **{name: FORMULAS[name] for name in re.findall(r"\w+", "add add_any sub mul div neg sign select_n convert_element_type stop_gradient")},
    **dict(max=lambda x, y: f"{x} > {y} ? {x} : {y}", min=lambda x, y: f"{x} < {y} ? {x} : {y}"),
}
