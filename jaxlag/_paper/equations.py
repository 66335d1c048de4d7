"""The equations of motion on paper: what is simulated, as formulas, derivation, programs. SymPy is imported when they are asked for."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from .._model.system import System
from .._program.scalar_graph import filled

STYLES = ("second kind", "first kind")
LONGEST = 150  # operations of a solution that is still shown


def to_sympy(function: Callable, *arguments: PyTree) -> PyTree:
    r"""A function of arrays as a formula: its program, evaluated on SymPy expressions entry by entry.

    $$ f(x_1, x_2, \dots) \;\mapsto\; \text{one expression for each entry of what } f \text{ returns} $$

    Known is what a Lagrangian is made of: arithmetic, elementary functions, abs, sign, min, max, where, indexing, reductions, products,
    loops of known length, small solves, determinants and norms, and derivatives of all these. A float is written as the simple fraction
    (of 1, of π, or under a root) to which it is the nearest float: 0.5 is 1/2, and 1/3 is 1/3. Other floats stay floats.

    **Arguments:**

    - `function`: a plain JAX function, jitted or not.
    - `arguments`: what it takes, with SymPy expressions in place of numbers: pytrees of expressions and numbers, lists of them (a
      vector) and arrays of them. Symbols stand for real numbers; make them with `real=True`.

    **Returns:** what the function returns, an expression for each scalar and a NumPy array of expressions for each array.

    **Raises:** `NotImplementedError`, which names the operation and the line where it stands, for one that has no formula;
    `TypeError` where an argument is neither an expression nor a number; `ImportError` without SymPy.

    **Source:** the program is JAX's jaxpr: Frostig, Johnson & Leary, Compiling machine learning programs via high-level tracing (2018).

    ```python
    import jax
    import jax.numpy as jnp
    import jaxlag as jl
    import sympy
    m, l, phi, omega = sympy.symbols("m l phi omega", real=True)
    lagrangian = lambda phi, omega, m, l: 0.5 * m * (l * omega) ** 2 + m * l * jnp.cos(phi)
    jl.to_sympy(lagrangian, phi, omega, m, l)  # l**2*m*omega**2/2 + l*m*cos(phi)
    jl.to_sympy(jax.grad(lagrangian, argnums=1), phi, omega, m, l)  # l**2*m*omega
    ```
    """
    _require_sympy("to_sympy")
    from .to_sympy import formulas

    is_leaf = lambda node: isinstance(node, list) or hasattr(node, "applyfunc")
    out = formulas(function, *jax.tree.map(_expressions, arguments, is_leaf=is_leaf))
    return jax.tree.map(lambda array: array if array.shape else array[()], out)


def _require_sympy(what: str) -> None:
    try:
        import sympy  # noqa: F401
    except ImportError as error:
        raise ImportError(f"`{what}` must have SymPy, but it cannot be imported. Install `jaxlag[symbolic]`.") from error


def _expressions(argument: Any) -> np.ndarray:
    """An expression, a number, or a list, a matrix or an array of them."""
    array = np.asarray(argument.tolist() if hasattr(argument, "applyfunc") else argument)
    is_fine = all(hasattr(x, "free_symbols") or isinstance(x, (int, float, np.generic)) for x in array.flat)
    if not (is_fine and array.dtype.kind in "Obiuf"):
        raise TypeError(f"`arguments` must hold expressions and numbers, but hold {argument!r}. Make symbols by `sympy.Symbol`.")
    return array


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Equations:
    r"""The equations of motion of a system on paper, as `equations` gives them. `print` shows them, a notebook typesets them.

    $$ M\ddot q = f + G^T\lambda, \qquad G\ddot q = -\gamma $$

    `t`, `q`, `qdot`, `qddot` and `params` are the symbols; `L`, `D` (all terms together), `Q`, `g` and `a` what was stated, and `M`, `f`,
    `G` and `gamma` what follows, in these symbols; `motion` the equations of motion, one `sympy.Eq` for each coordinate. In the second
    kind, coordinates in `eliminated` are expressed by those that are left, and `g` and `G` are those of the constraints that are left.

    ```python
    import jaxlag as jl
    from jaxlag.examples import pendulum
    on_paper = jl.equations(pendulum.polar, {"r", "phi"}, {"m", "l", "g"})
    print(on_paper)
    on_paper.multipliers["rod"]  # −m l φ̇² − m g cos φ
    ```
    """

    style: str
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
    eliminated: dict
    _inside: "_Inside"

    @property
    def accelerations(self) -> PyTree:
        """Formulas of q̈, structured like q; the symbol itself where its formula would be too long to be read."""
        inside = self._inside
        formulas = iter([inside.tidy(formula.xreplace(inside.solution)) for formula in inside.qddot])
        return jax.tree.map(lambda symbols: _arranged(symbols.shape, formulas), inside.structure)

    @property
    def multipliers(self) -> dict[str, PyTree]:
        """Formulas of λ by the constraint's name, structured like g or a; the symbol itself where there is none to be read."""
        inside = self._inside
        formulas = [inside.solution.get(symbol, symbol) for symbol in inside.multipliers]
        return jax.tree.map(lambda rows: _arranged(rows.shape, (formulas[row] for row in rows.flat)), inside.rows)

    def derivation(self) -> "Derivation":
        """The steps as on paper: ∂L/∂q̇, d/dt ∂L/∂q̇, ∂L/∂q, ∂D/∂q̇ and Q for each coordinate in order, and its equation of motion."""
        return Derivation(self)

    def __repr__(self) -> str:
        from .printers import Unicode

        return _lines(self._sections(Unicode(self._inside.notation)))

    def latex(self) -> str:
        """LaTeX of what `print` shows: an `aligned` environment (amsmath)."""
        from .printers import Latex

        return _aligned(self._sections(Latex(self._inside.notation)))

    def _repr_latex_(self) -> str:
        return f"$${self.latex()}$$"

    def to_python(self) -> str:
        """The text of `acceleration(t, q, qdot, params)`, which returns q̈ and λ as arrays and needs NumPy alone.

        `q` and `qdot` hold the coordinates of `Equations.q` in their order; `params` is structured as it was for `equations`.
        """
        from .codegen import to_python

        return to_python(self._program())

    def to_c(self) -> str:
        """The text of `void acceleration(t, q, qdot, params, qddot, multipliers)` in C99; a comment lists the entries in their order."""
        from .codegen import to_c

        return to_c(self._program())

    def _program(self) -> Any:
        from .codegen import Program

        inside = self._inside
        return Program(self.t, self.q, self.qdot, self.qddot, inside.paths, inside.multipliers, inside.residuals, inside.solution)

    def _sections(self, write: Any) -> Iterator[list[tuple[str, str]]]:
        """Coordinates eliminated; equations of motion and constraints; what they are solved for where there are multipliers."""
        inside = self._inside
        equal = lambda left, right: (write.doprint(left), write.doprint(right))
        yield [equal(x, formula) for x, formula in self.eliminated.items()]
        yield [*(equal(e.lhs, e.rhs) for e in self.motion), *((write.doprint(residual), "0") for residual in (*self.g, *self.a))]
        if inside.multipliers:
            solution = [(x, inside.solution[x]) for x in (*self.qddot, *inside.multipliers) if x in inside.solution]
            yield [equal(x, formula) for x, formula in solution if formula.count_ops() < LONGEST]


@dataclasses.dataclass(frozen=True, eq=False)
class _Inside:
    """What `Equations` are made from: steps, residuals that q̈ and λ make zero, and how things are arranged and written."""

    steps: Any
    free: tuple  # accelerations that are left
    qddot: tuple  # those of all coordinates, by them
    multipliers: tuple  # of all constraints
    residuals: tuple
    structure: PyTree[np.ndarray]
    rows: dict[str, PyTree[np.ndarray]]
    paths: list
    tidy: Any
    notation: Any

    @functools.cached_property
    def solution(self) -> dict:
        """Those of q̈ and λ that have a formula short enough to be read."""
        from .linear_solve import solved

        return solved(self.residuals, (*self.free, *self.multipliers), self.tidy)


class Derivation:
    """The steps from L, D and Q to the equations of motion, as `Equations.derivation` gives them; to be printed, or typeset in a notebook.

    ```python
    import jaxlag as jl
    spring = jl.System(lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2)
    print(jl.equations(spring, "x", {"m", "c"}).derivation())
    ```
    """

    def __init__(self, equations: Equations):
        self._equations = equations

    def __repr__(self) -> str:
        from .printers import Unicode

        return _lines(self._sections(Unicode(self._equations._inside.notation)))

    def latex(self) -> str:
        """LaTeX of what `print` shows: an `aligned` environment (amsmath)."""
        from .printers import Latex

        return _aligned(self._sections(Latex(self._equations._inside.notation)))

    def _repr_latex_(self) -> str:
        return f"$${self.latex()}$$"

    def _sections(self, write: Any) -> Iterator[list[tuple[str, str]]]:
        e, text = self._equations, write.doprint
        steps, tidy = e._inside.steps, e._inside.tidy
        readable = lambda stated: min(stated, tidy(stated), key=lambda formula: formula.count_ops() * (1 if formula is stated else 2))
        yield [(text(x), text(formula)) for x, formula in e.eliminated.items()]
        yield [(name, text(readable(energy))) for name, energy in (("L", e.L), ("D", e.D)) if name == "L" or energy != 0]
        for i, (x, v) in enumerate(zip(e.q, e.qdot, strict=True)):
            lines = [
                (write.partial("L", v), steps.momentum[i]),
                (write.in_time(write.partial("L", v)), steps.inertia[i]),
                (write.partial("L", x), steps.slope[i]),
                *([(write.partial("D", v), steps.damping[i])] if e.D != 0 else []),
                *([(write.indexed("Q", x), e.Q[i])] if any(e.Q) else []),
                *([(write.reaction(x), steps.reaction[i])] if any(steps.reaction) else []),
                (text(e.motion[i].lhs), e.motion[i].rhs),
            ]
            yield [(left, text(right)) for left, right in lines]


def _arranged(shape: tuple, formulas: Iterable) -> Any:
    array = filled(shape, itertools.islice(formulas, math.prod(shape)))
    return array if shape else array[()]


def _lines(sections: Iterable[list[tuple[str, str]]]) -> str:
    return "\n\n".join("\n".join(f"{left} = {right}" for left, right in section) for section in sections if section)


def _aligned(sections: Iterable[list[tuple[str, str]]]) -> str:
    rows = [f"{left} &= {right}" for section in sections for left, right in section]
    return "\\begin{aligned}\n" + " \\\\\n".join(rows) + "\n\\end{aligned}"


def equations(
    system: System, q: PyTree, params: PyTree = None, *, style: str = "second kind", positive: str | Collection[str] = ()
) -> Equations:
    r"""The equations of motion of a system on paper, from the same functions that are simulated.

    $$ \frac{d}{dt}\frac{\partial L}{\partial\dot q} - \frac{\partial L}{\partial q} + \frac{\partial D}{\partial\dot q} = Q + G^T\lambda $$

    L, D, Q, g and a are read as formulas (`to_sympy`), differentiated on paper and tidied up as by a person; before they are handed over,
    they are compared at a random state with what `acceleration` computes.

    **Arguments:**

    - `q`, `params`: example values, or names in their place: a string for a number, a list of strings for a vector, a set of strings
      for a mapping of numbers. Symbols are called like the entries: `Theta_s` is Θₛ, the velocity of `phi` is φ̇; entries of arrays are
      counted from 1. They are real.
    - `style`: `"second kind"` expresses coordinates by others where holonomic constraints are linear in them, and finds the multipliers
      of these afterwards; `"first kind"` keeps all coordinates and all multipliers.
    - `positive`: names of parameters, coordinates or multipliers that are taken as positive, so that √(l²) is l.

    **Returns:** `Equations`. The multipliers' sign is that of M q̈ = f + Gᵀλ. Any consistent units.

    **Raises:** `ValueError` or `TypeError` where an argument or a function of the system is of the wrong kind, where two symbols would have
    one name, or where the equations differ from the simulation, as they do where a function has a derivative rule that is none of its
    formula; `NotImplementedError`, which names the line, where an operation has no formula; `ImportError` without SymPy.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., sections 1.4, 1.5 and 2.4.

    ```python
    import jaxlag as jl
    from jaxlag.examples import vehicle
    on_paper = jl.equations(vehicle.system, vehicle.q0, vehicle.params)
    print(on_paper)  # Θₛ φ̈ + 2 a² b φ̇ + 2 a² c φ = 0 and two more
    print(on_paper.derivation())
    ```
    """
    _require_sympy("equations")
    from . import derivation, symbolic_system
    from .printers import Notation
    from .simplify import Tidy

    if style not in STYLES:
        raise ValueError(f'`style` must be "second kind" or "first kind", but is {style!r}. Say which form of Lagrange\'s equations.')
    positive = (positive,) if isinstance(positive, str) else tuple(positive)
    coordinates, constants = symbolic_system.named(q, "q", positive), symbolic_system.named(params, "params", positive)
    stated, rows = symbolic_system.stated(system, coordinates, constants, positive)
    parameters = symbolic_system.in_order(system, params, constants)
    tidy = Tidy(stated.qdot, parameters)
    steps = derivation.derived(stated, tidy)
    symbolic_system.check_against_simulation(system, stated, steps, coordinates, constants)
    eliminated = derivation.eliminated(stated, tidy) if style == "second kind" else {}
    own, own_steps, qddot, reactions = derivation.reduced(stated, steps, eliminated, tidy)
    inside = _Inside(
        steps=own_steps,
        free=own.qddot,
        qddot=qddot,
        multipliers=stated.multipliers,
        residuals=(*derivation.residuals(own, own_steps), *reactions),
        structure=coordinates.symbols,
        rows=rows,
        paths=constants.paths,
        tidy=tidy,
        notation=Notation(stated, parameters),
    )
    own_parts = {name: getattr(own, name) for name in ("t", "q", "qdot", "qddot", "L", "D", "Q", "g", "a")}
    matrices = {name: getattr(own_steps, name) for name in ("M", "f", "G", "gamma")}
    return Equations(
        style=style,
        **own_parts,
        **matrices,
        params=jax.tree.map(lambda symbols: _arranged(symbols.shape, iter(symbols.flat)), constants.symbols),
        motion=derivation.motion(own, own_steps, tidy),
        eliminated=eliminated,
        _inside=inside,
    )
