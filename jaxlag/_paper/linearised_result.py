"""Linear equations of motion on paper, printed and typeset."""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

from jaxtyping import PyTree

from .result import Section, aligned, lines


class LinearDetails(NamedTuple):
    """The data with which `LinearisedEquations` are printed."""

    given: dict  # what the user said about the state
    omega: Any  # symbols of ω₀ and ζ
    zeta: Any
    simplify: Any  # `simplify.Simplifier`
    notation: Any  # `notation.Notation`


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class LinearisedEquations:
    r"""The equations of motion near an equilibrium or a steady motion, as `equations(..., linearised_at=...)` returns them. `print` shows
    them, a notebook typesets them.

    $$ M\,\delta\ddot q + (C + G)\,\delta\dot q + (K + N)\,\delta q = B\,\delta u $$

    Formulas are SymPy expressions; d independent deviations remain, and m inputs u. Uncoupled equations are printed separately, a single
    oscillator with its natural angular frequency ω₀² = K/M and its damping ratio ζ = C/(2 M ω₀). Any consistent set of units.

    - `q`, `qdot`, `qddot`: the symbols of the deviations and of their derivatives, `inputs`: those of δu, as tuples. Their names begin
      with δ.
    - `params`: the symbols of the parameters, structured like `params`.
    - `at`: the formulas of all coordinates and rates of the motion, and of the parameters that were given with them, by symbol.
    - `mass` M, `damping` C, `gyroscopic` G, `stiffness` K, `circulatory` N (d, d): M, C and K are symmetric, G and N antisymmetric.
    - `input_matrix` B (d, m).
    - `motion`: the equations of motion, one `sympy.Eq` for each of `q`.
    - `eliminated`: the deviations that constraints express by those of `q`, and their formulas.

    ```python
    import jaxlag as jl
    from jaxlag.examples import pendulum
    small = jl.equations(pendulum.polar, {"r", "phi"}, {"m", "l", "g"}, linearised_at={"phi": 0})
    print(small)
    small.stiffness  # Matrix([[g*l*m]])
    ```
    """

    q: tuple
    qdot: tuple
    qddot: tuple
    inputs: tuple
    params: PyTree
    at: dict
    mass: Any
    damping: Any
    gyroscopic: Any
    stiffness: Any
    circulatory: Any
    input_matrix: Any
    motion: tuple
    eliminated: dict
    _details: "LinearDetails"

    @functools.cached_property
    def blocks(self) -> tuple[tuple, ...]:
        """The symbols of `q`, those that are coupled together."""
        coupling = type(self.mass)(len(self.q), len(self.q), lambda *at: int(any(matrix[at] != 0 for matrix in self._matrices)))
        return tuple(tuple(self.q[i] for i in sorted(block)) for block in sorted(coupling.connected_components()))

    @functools.cached_property
    def omega_squared(self) -> dict:
        """ω₀² = K/M of each deviation that is coupled with no other and has a mass and a stiffness; negative where it is unstable."""
        single = ((block[0], self.q.index(block[0])) for block in self.blocks if len(block) == 1)
        return {x: self._shortest(self.stiffness[i, i] / self.mass[i, i]) for x, i in single if self.mass[i, i] * self.stiffness[i, i] != 0}

    def _shortest(self, ratio):
        """The formula, simplified or cancelled, whichever is shorter."""
        from sympy import count_ops, factor

        return min(self._details.simplify(ratio), factor(ratio), key=count_ops)

    @functools.cached_property
    def damping_ratio(self) -> dict:
        """ζ = C/(2 √(M K)) of each of these that is damped, where K/M has no minus sign."""
        from sympy import sqrt

        i = {x: self.q.index(x) for x, square in self.omega_squared.items() if not square.could_extract_minus_sign()}
        ratio = lambda i: self._shortest(self.damping[i, i] / (2 * sqrt(self._details.simplify(self.mass[i, i] * self.stiffness[i, i]))))
        return {x: ratio(i) for x, i in i.items() if self.damping[i, i] != 0}

    @property
    def _matrices(self) -> tuple:
        return self.mass, self.damping, self.gyroscopic, self.stiffness, self.circulatory

    def __repr__(self) -> str:
        from .unicode_printer import Unicode

        return lines(self._sections(Unicode(self._details.notation)))

    def latex(self) -> str:
        """LaTeX of what `print` shows: an `aligned` environment (amsmath)."""
        from .latex_printer import Latex

        return aligned(self._sections(Latex(self._details.notation)))

    def _repr_latex_(self) -> str:
        return f"$${self.latex()}$$"

    def _sections(self, printer: Any) -> Iterator[Section]:
        """The state; eliminated deviations; then each block, with its frequency and damping ratio."""
        omega, zeta = self._details.omega, self._details.zeta
        equal = lambda left, right: (printer.doprint(left), printer.doprint(right))
        yield [equal(x, formula) for x, formula in self._details.given.items()]
        yield [equal(x, formula) for x, formula in self.eliminated.items()]
        for block in self.blocks:
            section = [equal(e.lhs, e.rhs) for x, e in zip(self.q, self.motion, strict=True) if x in block]
            section += [equal(omega**2, self.omega_squared[x]) for x in block if x in self.omega_squared]
            ratio = lambda i: self._details.simplify(self.damping[i, i] / (2 * self.mass[i, i] * omega))  # without roots
            yield section + [equal(zeta, ratio(self.q.index(x))) for x in block if x in self.damping_ratio]
