"""Roots of many equations, each of a few unknowns: Newton's method with a sparse matrix from a few directional derivatives."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Bool, Float

from .._program.expressions import TooLong
from .._program.implicit import implicit_root
from .._program.shifted_factors import GROWTH
from .._program.size_of_terms import size_of_terms
from .._program.sparse_jacobian import entries
from .._program.sparse_matrix import SparseMatrix, SparsityPattern, colors
from .._program.sparse_newton import linear_solution, newton_factors, refined, square_pattern
from .._program.sparsity import dependence
from .newton import Residual, Root, newton, root_of_size, without_rounding

BY_VALUES = 2  # least sparsity that pays: the dense search needs all singular values, at twenty times the cost of factors


@dataclasses.dataclass(frozen=True, eq=False)
class SparseEquations:
    """R(args, w) = 0 with as many equations as unknowns, and the places of J = ∂R/∂w; `alone`: 1 for unknowns on which no equation depends
    and whose equation depends on none, which stay as they are.
    """

    residual: Residual
    pattern: SparsityPattern
    alone: np.ndarray

    @classmethod
    def of(cls, residual: Residual, args: Any, w: Float[Array, " u"], last: int) -> "SparseEquations | None":
        """The equations, or None if a dense matrix serves better; unknowns from `last` on are multipliers."""
        try:
            pattern = dependence(lambda w: residual(args, w), w)
        except TooLong:
            return None
        coupled = (np.diff(pattern.indptr) > 0) | (np.diff(scipy.sparse.csc_matrix(pattern).indptr) > 0)
        places = square_pattern(pattern, last, BY_VALUES)
        return None if places is None else cls(residual, places, (~coupled).astype(float))

    def jacobian(self, args: Any, w: Float[Array, " u"]) -> SparseMatrix:
        """J, with zeros for unknowns that are alone."""
        _, push = jax.linearize(lambda w: self.residual(args, w), w)
        pattern = self.pattern.to_scipy()
        return SparseMatrix(entries(push, colors(pattern), pattern, w).values, self.pattern)

    def oriented(self, R: Float[Array, " u"]) -> Float[Array, " u"]:
        """R with the forces reversed, which turns J = [−K Gᵀ; G 0] into [K −Gᵀ; G 0]."""
        return jnp.where(np.arange(R.size) < self.pattern.last, -R, R)

    def matrix(self, J: SparseMatrix) -> SparseMatrix:
        """J, oriented, with ones for unknowns that are alone."""
        turned = SparseMatrix(jnp.where(J.pattern.rows < J.pattern.last, -J.values, J.values), J.pattern)
        return turned.plus_diagonal(jnp.asarray(self.alone, J.values.dtype))

    def change(self, args: Any, w: Float[Array, " u"], R: Float[Array, " u"]) -> Float[Array, " u"]:
        """−J⁻¹ R, to be differentiated."""
        _, push = jax.linearize(lambda w: self.residual(args, w), w)
        return linear_solution(lambda x: self.oriented(push(x)) + jnp.asarray(self.alone, x.dtype) * x, self.pattern, -self.oriented(R))

    def differentiable_root(self, args: Any, w: Float[Array, " u"]) -> Float[Array, " u"]:
        """w as the function of args that R(args, w) = 0 defines."""
        return implicit_root(self.residual, self.change, args, w)


def sparse_root_near(equations: SparseEquations, args: Any, guess: Float[Array, " u"], units: Float[Array, " u"]) -> Root:
    """The root that Newton's method finds from a guess; found only if it is the only one nearby, except for multipliers of rows that depend
    on each other. `units` as for `root_near`.
    """
    fixed = jax.lax.stop_gradient(args)

    def changes(w):
        A = equations.matrix(equations.jacobian(fixed, w))
        factors = newton_factors(A)
        return lambda w: refined(A.__matmul__, A.pattern, factors, -equations.oriented(equations.residual(fixed, w)))

    units = sparse_units_beside(equations.jacobian(fixed, guess), units)
    w, reach = newton(changes, jax.lax.stop_gradient(guess), units, equations.pattern.last or 0)
    J = equations.jacobian(fixed, w)
    residual = lambda w: equations.residual(fixed, w)
    root = root_of_size(residual(w), J, size_of_terms(residual, w), w, reach)
    return root._replace(found=root.found & is_regular(equations.matrix(J)))


def sparse_units_beside(J: SparseMatrix, units: Float[Array, " u"]) -> Float[Array, " u"]:
    """`units_beside` for a sparse matrix: multipliers take their units from what they hold."""
    (m, n), rows, columns = J.shape, J.pattern.rows, J.pattern.columns
    size = jnp.abs(without_rounding(J.values, units[rows], units[columns]))
    known = jnp.maximum(jax.ops.segment_max(size * units[columns], rows, m, indices_are_sorted=True), 0)[rows]
    ties = (size > 0) & (known > 0)
    found = jax.ops.segment_min(jnp.where(ties, known / jnp.where(ties, size, 1), jnp.inf), columns, n)
    return jnp.where((units > 0) | ~jnp.isfinite(found), units, found)


def is_regular(A: SparseMatrix) -> Bool[Array, ""]:
    """Whether A⁻¹ maps random numbers to none that are huge, and solves the equations; if rows of multipliers depend on each other, the
    random numbers are forces alone.
    """
    size, eps, factors = abs(A), jnp.finfo(A.values.dtype).eps, newton_factors(A)
    signs = jnp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], A.shape[0]), A.values.dtype)
    b = signs * (size @ jnp.ones_like(signs))
    b = jnp.where(factors.regular | (np.arange(b.size) < A.pattern.last), b, 0)
    x = refined(A.__matmul__, A.pattern, factors, b)
    return jnp.all(jnp.abs(x) < eps**-GROWTH) & jnp.all(jnp.abs(A @ x - b) <= eps**0.5 * (size @ jnp.abs(x)))
