"""Equations of motion as programs that do not need this package: NumPy, C."""

import keyword
import pathlib
import re
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import sympy
from sympy import Expr, Matrix, Symbol
from sympy.printing.c import C99CodePrinter, reserved_words
from sympy.printing.codeprinter import CodePrinter, PrintMethodNotImplementedError
from sympy.printing.numpy import NumPyPrinter

from .._mechanics.massless import underdetermined
from .derivative import derivative
from .identifiers import identifier, in_ascii


class Program(NamedTuple):
    """The contents of a program: q̈ and λ, which make the residuals zero, from formulas if each has one."""

    t: Symbol
    q: tuple[Symbol, ...]
    qdot: tuple[Symbol, ...]
    qddot: tuple[Symbol, ...]
    params: list[tuple[Symbol, str]]  # each with its path in Python
    multipliers: tuple[Symbol, ...]
    residuals: tuple[Expr, ...]
    solution: dict[Symbol, Expr]

    @property
    def unknowns(self) -> tuple[Symbol, ...]:
        """The accelerations, then the multipliers: z."""
        return (*self.qddot, *self.multipliers)

    def formulas(self) -> list[Expr] | None:
        """Formulas for z; None if an unknown has none."""
        return [self.solution[x] for x in self.unknowns] if all(x in self.solution for x in self.unknowns) else None

    def system(self) -> tuple[Matrix, Matrix]:
        """A and b of A z = b."""
        A = Matrix([[derivative(residual, x) for x in self.unknowns] for residual in self.residuals])
        if not A.free_symbols.isdisjoint(self.unknowns):
            raise ValueError(
                "`force` and `dissipation` must be linear in the multipliers for a program to solve for them, but they are not. "
                "Say which multipliers are `positive`, or eliminate coordinates (`multipliers=False`)."
            )
        n = len(self.qddot)
        undecided = np.flatnonzero(underdetermined(np.array(A.applyfunc(lambda entry: int(entry != 0)), bool))[:n])
        if undecided.size:
            raise ValueError(
                "a program must be of a system whose accelerations follow from its equations of motion, but that of "
                f"{', '.join(self.q[i].name for i in undecided)} does not: without inertia, its velocity follows from D. "
                "Give it a mass, or write a program of the first-order equation that is printed."
            )
        at_zero = dict.fromkeys(self.unknowns, sympy.Integer(0))
        return A, Matrix([-residual.xreplace(at_zero) for residual in self.residuals])


OWN_NAMES = re.findall(r"\w+", "t q qdot params qddot multipliers acceleration matrix right size solution solve numpy math functools")
RESERVED_IN_PYTHON = frozenset((*keyword.kwlist, *OWN_NAMES))
C_FUNCTIONS = re.findall(
    r"\w+", "fabs fmax fmin pow sqrt exp log sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh erf erfc floor ceil"
)
RESERVED_IN_C = frozenset((*reserved_words, *OWN_NAMES, *C_FUNCTIONS))


LEAST_NORM = """# in units of each coordinate and each row in which inertias and the largest entries of rows are 1
units, mass = numpy.ones(len(matrix)), numpy.abs(numpy.diag(matrix)[:{n}])
units[:{n}][mass > 0] = mass[mass > 0] ** -0.5
size = numpy.abs(matrix[{n}:, :{n}] * units[:{n}]).max(axis=1)
units[{n}:][size > 0] = 1 / size[size > 0]
u, size, v = numpy.linalg.svd(units[:, None] * matrix * units)
there = size > 1e-12 * size[0]
solution = units * (v[there].T @ ((u.T @ (units * right))[there] / size[there]))
# constraints may be redundant: then the multipliers are those of least norm
free = units[{n}:, None] * v[~there, {n}:].T
solution[{n}:] -= free @ numpy.linalg.lstsq(free, solution[{n}:], rcond=None)[0]"""


def to_python(program: Program) -> str:
    """The source of a NumPy function."""
    writer = _Writer(program, NumPyPrinter({"strict": True}), RESERVED_IN_PYTHON, identifier)
    names = lambda symbols: ", ".join(writer.names[symbol] for symbol in symbols)
    array = lambda formulas: f"numpy.array([{', '.join(formulas)}], float)"
    body = [f"{names(part)}{',' * (len(part) == 1)} = {given}" for part, given in ((program.q, "q"), (program.qdot, "qdot"))]
    body += [f"{writer.names[symbol]} = params{path}" for symbol, path in program.params]
    body += [f"{name} = {formula}" for name, formula in writer.shared]
    n = len(program.q)
    if writer.z:
        body += [f"return {array(writer.z[:n])}, {array(writer.z[n:])}"]
    else:
        rows = [f"    [{', '.join(row)}]," for row in writer.A]
        body += ["matrix = numpy.array([", *rows, "], float)", f"right = {array(writer.b)}"]
        body += LEAST_NORM.format(n=n).splitlines() if program.multipliers else ["solution = numpy.linalg.solve(matrix, right)"]
        body += [f"return solution[:{n}], solution[{n}:]"]
    needed = [f"import {module}" for module in ("functools", "math") if any(f"{module}." in line for line in body)]
    head = [*needed, *[""] * bool(needed), "import numpy", "", "", "def acceleration(t, q, qdot, params):"]
    doc = f'"""Accelerations of {names(program.q)}, and the multipliers {names(program.multipliers) or "(none)"}."""'
    return "\n".join([*head, *(f"    {line}" for line in (doc, *body)), ""])


def to_c(program: Program) -> str:
    """The source of a function in C99."""
    spelt = lambda name: identifier(in_ascii(name))
    writer = _Writer(program, C99CodePrinter({"strict": True, "math_macros": {}}), RESERVED_IN_C, spelt)
    given = [("q", program.q), ("qdot", program.qdot), ("params", tuple(symbol for symbol, _ in program.params))]
    body = [f"const double {writer.names[symbol]} = {part}[{i}];" for part, symbols in given for i, symbol in enumerate(symbols)]
    body += [f"const double {name} = {formula};" for name, formula in writer.shared]
    n, size = len(program.q), len(program.unknowns)
    targets = [f"qddot[{i}]" if i < n else f"multipliers[{i - n}]" for i in range(size)]
    z = writer.z or [f"solution[{i}]" for i in range(size)]
    if not writer.z:
        rows = ", ".join(f"{{{', '.join(row)}}}" for row in writer.A)
        body += [f"double matrix[{size}][{size}] = {{{rows}}}, right[{size}] = {{{', '.join(writer.b)}}}, solution[{size}];"]
        body += [f"solve({size}, {n}, matrix, right, solution);"]
    body += [f"{target} = {formula};" for target, formula in zip(targets, z, strict=True)]
    order = [*given, ("multipliers", program.multipliers)]
    comment = "; ".join(f"{part}: {', '.join(writer.names[symbol] for symbol in symbols)}" for part, symbols in order if symbols)
    head = "void acceleration(double t, const double *q, const double *qdot, const double *params, double *qddot, double *multipliers)"
    return "\n".join(
        ["#include <math.h>", "", *([] if writer.z else [SOLVE]), f"/* {comment} */", head, "{", *(f"    {line}" for line in body), "}", ""]
    )


class _Writer:
    """Formulas in a programming language: names of the symbols, common subexpressions, and z, or A and b, in terms of these."""

    def __init__(self, program: Program, printer: CodePrinter, reserved: frozenset[str], spelt: Callable[[str], str]):
        self.printer = printer
        self.names: dict[Symbol, str] = {program.t: "t"}
        for symbol in (*program.q, *program.qdot, *(symbol for symbol, _ in program.params), *program.multipliers):
            name = spelt(symbol.name)
            while name in reserved or name in self.names.values():
                name += "_"
            self.names[symbol] = name
        z = program.formulas()
        A, b = program.system() if z is None else (Matrix(0, 0, []), Matrix(0, 1, []))
        renamed = {symbol: Symbol(name, real=True) for symbol, name in self.names.items()} | CONSTANTS
        formulas = [formula.xreplace(renamed) for formula in (*(z or []), *A, *b)]
        fresh = (symbol for symbol in sympy.numbered_symbols("s", real=True) if symbol.name not in self.names.values())
        shared, final = sympy.cse(formulas, symbols=fresh, order="none")
        self.shared = [(symbol.name, self._print(formula)) for symbol, formula in shared]
        printed = list(map(self._print, final))
        columns = len(program.unknowns)
        self.z = printed if z is not None else []
        self.A = [printed[i * columns : (i + 1) * columns] for i in range(A.rows)]
        self.b = printed[A.rows * columns :] if z is None else []

    def _print(self, formula: Expr) -> str:
        try:
            return self.printer.doprint(formula)
        except PrintMethodNotImplementedError as error:
            unknown = str(error).splitlines()[0].split()[-1]
            raise ValueError(
                f"a program must use functions that its language has, but has {unknown}. Write the system with others."
            ) from None


CONSTANTS = {constant: sympy.Float(constant, 17) for constant in (sympy.pi, sympy.E)}
SOLVE = (pathlib.Path(__file__).parent / "c" / "solve.c").read_text()
