"""The equations of motion and their derivation, printed, typeset, and written as programs."""

import dataclasses
import functools
import itertools
import math
import os
import pathlib
from collections.abc import Collection, Iterable, Iterator
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from .._program.expressions import filled

MOST_OPERATIONS = 150  # of a solution that is still shown

Section = list[tuple[str, ...]]  # left and right sides, and the relation between them if it is not equality


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Equations:
    r"""The equations of motion of a system on paper, as `equations` returns them. `print` shows them, a notebook typesets them.

    $$ M\ddot q = f + G^T\lambda, \qquad G\ddot q = -\gamma $$

    Formulas are SymPy expressions in the symbols below; n coordinates remain, and m constraints. Any consistent set of units.

    - `with_multipliers`: whether all multipliers were kept (Lagrange's equations of the first kind).
    - `t`: the symbol of time; `q`, `qdot`, `qddot`: those of the n coordinates and their derivatives, as tuples.
    - `params`: the symbols of the parameters, structured like `params`.
    - `L`, `D`, `Q` (n), `g`, `a`: the Lagrangian, the sum of all dissipation functions, the applied forces, and the holonomic and the
      nonholonomic constraints that remain, zero for each row.
    - `M` (n, n), `f` (n), `G` (m, n), `gamma` (m): the matrices and vectors of the equations above.
    - `motion`: the equations of motion, one `sympy.Eq` for each coordinate.
    - `rates`: the rates of the states of first order, by the symbol of ż; `updates`: those of the sampled states, by the symbol of u, None
      where an update has no formula.
    - `eliminated`: the coordinates that were eliminated, and their formulas in the remaining ones.
    - `contacts`: the gaps of contacts, by name, and by number where one has several, as "corners_1"; their rows of G follow those
      of g, as if all were closed.

    ```python
    import jaxlag as jl
    from jaxlag.examples import pendulum
    on_paper = jl.equations(pendulum.polar, {"r", "phi"}, {"m", "l", "g"})
    print(on_paper)
    on_paper.multipliers["rod"]  # −m l φ̇² − m g cos φ
    ```
    """

    with_multipliers: bool
    t: Any
    q: tuple
    qdot: tuple
    qddot: tuple
    params: PyTree
    L: Any
    D: Any
    Q: Any
    g: Any
    a: Any
    M: Any
    f: Any
    G: Any
    gamma: Any
    motion: tuple
    rates: dict
    updates: dict
    eliminated: dict
    contacts: dict
    _details: "Details"

    @property
    def accelerations(self) -> PyTree:
        """Formulas of q̈, structured like q; the symbol itself where its formula would be too long to read."""
        details = self._details
        formulas = iter([details.simplify(formula.xreplace(details.solution)) for formula in details.qddot])
        return jax.tree.map(lambda symbols: arranged(symbols.shape, formulas), details.structure)

    @property
    def multipliers(self) -> dict[str, PyTree]:
        """Formulas of λ by the constraint's name, structured like g or a; the symbol itself where its formula would be too long to read."""
        details = self._details
        formulas = [details.solution.get(symbol, symbol) for symbol in details.multipliers]
        return jax.tree.map(lambda rows: arranged(rows.shape, (formulas[row] for row in rows.flat)), details.multiplier_rows)

    def derivation(self) -> "Derivation":
        """The steps on paper: for each coordinate ∂L/∂q̇, d/dt ∂L/∂q̇, ∂L/∂q, ∂D/∂q̇ and Q, then its equation of motion."""
        return Derivation(self)

    def __repr__(self) -> str:
        from .unicode_printer import Unicode

        return lines(self._sections(Unicode(self._details.notation)))

    def latex(self) -> str:
        """LaTeX of what `print` shows: an `aligned` environment (amsmath)."""
        from .latex_printer import Latex

        return aligned(self._sections(Latex(self._details.notation)))

    def _repr_latex_(self) -> str:
        return f"$${self.latex()}$$"

    def to_python(self) -> str:
        """The source of `acceleration(t, q, qdot, params)`, which returns q̈ and λ as arrays and needs NumPy only.

        `q` and `qdot` (n) hold the coordinates in the order of `Equations.q`; `params` is structured as it was for `equations`.

        **Raises:** `ValueError` if there are further states or coordinates that D alone moves, NumPy lacks a function, or λ enters
        nonlinearly and has no formula.
        """
        from .codegen import to_python

        return to_python(self._program())

    def to_c(self) -> str:
        """The source of `void acceleration(t, q, qdot, params, qddot, multipliers)` in C99; a comment lists the entries in order.

        **Raises:** `ValueError` if there are further states or coordinates that D alone moves, C lacks a function, or λ enters
        nonlinearly and has no formula.
        """
        from .codegen import to_c

        return to_c(self._program())

    def to_fmu(
        self,
        path: str | os.PathLike[str],
        q0: PyTree,
        qdot0: PyTree,
        params: PyTree = None,
        *,
        inputs: str | Collection[str] = (),
        outputs: str | Collection[str] | None = None,
        name: str | None = None,
    ) -> pathlib.Path:
        """Writes a functional mock-up unit (FMI 3.0), as `jaxlag.to_fmu` does, of these equations in the remaining coordinates.

        Eliminated coordinates, their velocities and their accelerations are variables that follow from the others.

        **Arguments, returns, raises:** as for `to_fmu`, where `q0`, `qdot0` and `params` are structured as they were for `equations`;
        further states are refused here.

        **Source:** Modelica Association, Functional Mock-up Interface Specification 3.0 (2022).

        ```python
        import tempfile
        import jaxlag as jl
        from jaxlag.examples import pendulum
        on_paper = jl.equations(pendulum.polar, {"r", "phi"}, {"m", "l", "g"})
        with tempfile.TemporaryDirectory() as folder:
            on_paper.to_fmu(f"{folder}/pendulum.fmu", *pendulum.polar_state(0.5, 0.0, 1.0), pendulum.params)
        ```
        """
        from .fmu import export
        from .fmu_of_equations import exported_equations

        with jax.enable_x64(True):
            return export(exported_equations(self, q0, qdot0, params), path, inputs, outputs, name)

    def _program(self) -> Any:
        from .codegen import Program

        if self.contacts:
            raise ValueError(
                "a program must be of a system without contacts that open and close, but there are some. State those that stay closed as "
                "`holonomic`."
            )
        if self.rates or self.updates:
            raise ValueError("a program must be of a system without further states, but there are some. Write them as parameters.")
        details = self._details
        return Program(self.t, self.q, self.qdot, self.qddot, details.paths, details.multipliers, details.residuals, details.solution)

    def _sections(self, printer: Any) -> Iterator[Section]:
        """Eliminated coordinates; equations of motion and constraints; contact laws; and the solution if there are multipliers."""
        from .contact_laws import contact_lines

        details = self._details
        equal = lambda left, right: (printer.doprint(left), printer.doprint(right))
        yield [equal(x, formula) for x, formula in self.eliminated.items()]
        yield [*(equal(e.lhs, e.rhs) for e in self.motion), *((printer.doprint(residual), "0") for residual in (*self.g, *self.a))]
        updated = [(printer.after(u), printer.doprint(formula)) for u, formula in self.updates.items() if formula is not None]
        yield [*(equal(v, formula) for v, formula in self.rates.items()), *updated]
        for contact in details.contacts:
            yield list(contact_lines(contact, printer))
        if details.multipliers:
            solution = [(x, details.solution[x]) for x in (*self.qddot, *details.multipliers) if x in details.solution]
            yield [equal(x, formula) for x, formula in solution if formula.count_ops() < MOST_OPERATIONS]


@dataclasses.dataclass(frozen=True, eq=False)
class Details:
    """The data from which `Equations` are made."""

    steps: Any  # `derivation.Steps`: SymPy is not imported here
    free: tuple  # symbols of the accelerations that remain
    qddot: tuple  # formulas of all accelerations in terms of these
    multipliers: tuple  # symbols, of all constraints
    residuals: tuple  # zero for the right q̈ and λ
    structure: PyTree[np.ndarray]  # symbols like q
    multiplier_rows: dict[str, PyTree[np.ndarray]]  # the indices of each constraint's multipliers
    paths: list  # each parameter's symbol and its path in Python
    simplify: Any  # `simplify.Simplifier`
    notation: Any  # `notation.Notation`
    system: Any  # `System` from which they were derived
    contacts: tuple = ()  # of `derivation.ContactLaw`

    @functools.cached_property
    def solution(self) -> dict:
        """Formulas for q̈ and λ, if they are short enough to read."""
        from .linear_solve import solve_linear

        given = {contact.multiplier for contact in self.contacts}
        return solve_linear(self.residuals, (*self.free, *(x for x in self.multipliers if x not in given)), self.simplify)


class Derivation:
    """The steps from L, D and Q to the equations of motion. `print` shows them, a notebook typesets them.

    ```python
    import jaxlag as jl
    spring = jl.System(lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2)
    print(jl.equations(spring, "x", {"m", "c"}).derivation())
    ```
    """

    def __init__(self, equations: Equations):
        self._equations = equations

    def __repr__(self) -> str:
        from .unicode_printer import Unicode

        return lines(self._sections(Unicode(self._equations._details.notation)))

    def latex(self) -> str:
        """LaTeX of what `print` shows: an `aligned` environment (amsmath)."""
        from .latex_printer import Latex

        return aligned(self._sections(Latex(self._equations._details.notation)))

    def _repr_latex_(self) -> str:
        return f"$${self.latex()}$$"

    def _sections(self, printer: Any) -> Iterator[Section]:
        e, text = self._equations, printer.doprint
        steps, simplify = e._details.steps, e._details.simplify
        readable = lambda given: min(given, simplify(given), key=lambda formula: formula.count_ops() * (1 if formula is given else 2))
        yield [(text(x), text(formula)) for x, formula in e.eliminated.items()]
        yield [(name, text(readable(energy))) for name, energy in (("L", e.L), ("D", e.D)) if name == "L" or energy != 0]
        for i, (x, v) in enumerate(zip(e.q, e.qdot, strict=True)):
            lines = [
                (printer.partial("L", v), steps.momentum[i]),
                (printer.time_derivative(printer.partial("L", v)), steps.momentum_rate[i]),
                (printer.partial("L", x), steps.gradient[i]),
                *([(printer.partial("D", v), steps.damping[i])] if e.D != 0 else []),
                *([(printer.with_index("Q", x), e.Q[i])] if any(e.Q) else []),
                *([(printer.reaction(x), steps.reaction[i])] if any(steps.reaction) else []),
                (text(e.motion[i].lhs), e.motion[i].rhs),
            ]
            yield [(left, text(right)) for left, right in lines]


def arranged(shape: tuple, formulas: Iterable) -> Any:
    """The next formulas as an array of the given shape, or a single formula."""
    array = filled(shape, itertools.islice(formulas, math.prod(shape)))
    return array if shape else array[()]


def lines(sections: Iterable[Section]) -> str:
    """Sections as text, with an empty line between them."""
    written = lambda left, right, relation="=": f"{left} {relation} {right}"
    return "\n\n".join("\n".join(written(*line) for line in section) for section in sections if section)


def aligned(sections: Iterable[Section]) -> str:
    """Sections as an `aligned` environment of LaTeX."""
    signs = {"=": "=", "≥": r"\ge"}
    written = lambda left, right, relation="=": f"{left} &{signs[relation]} {right}"
    rows = [written(*line) for section in sections for line in section]
    return "\\begin{aligned}\n" + " \\\\\n".join(rows) + "\n\\end{aligned}"
