"""Mass matrices of many coordinates that need no n × n numbers: sparse ones, and those of chains, full as they are.

Positions of a chain in joint angles are running sums, x = Σ l sin φ. Between the sums the kinetic energy is sparse
(`_program.running_sums`), and M x = f is solved link by link (`_program.recursive_elimination`), however many links each angle moves.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float

from .._program.chain_ordering import ChainOrdering, chain_ordering
from .._program.recursive_elimination import Factors, by_factor, by_root, factor
from .._program.running_sums import RunningSum, lifted
from .._program.sparse_jacobian import jacobian
from .._program.sparse_matrix import SparseMatrix

MOST_FULL = 2000  # coordinates, of which M may be needed with all its numbers


class StructuredInertia(lx.AbstractLinearOperator):
    """M by the slopes of L and of the summands between its running sums."""

    slopes: SparseMatrix
    sums: tuple[RunningSum, ...] = eqx.field(static=True)

    @property
    def ordering(self) -> ChainOrdering:
        """The order of its elimination."""
        found = chain_ordering(self.slopes.pattern, self.sums)
        assert found is not None  # or it would be a full matrix
        return found

    @property
    def size(self) -> int:
        """How many coordinates there are."""
        return self.slopes.shape[1] - sum(s.size for s in self.sums)

    def mv(self, vector: Float[Array, "n *k"]) -> Float[Array, "n *k"]:  # noqa: F821
        """M x, also column by column: velocities from the start of the sums to their end, momenta back."""
        own, *steps = self.slopes.row_blocks((self.slopes.shape[1], *(s.size for s in self.sums)))
        ends = np.cumsum([self.size, *(s.size for s in self.sums)])
        z = jnp.concatenate([vector, jnp.zeros((ends[-1] - ends[0], *vector.shape[1:]), vector.dtype)])
        for kind, step, start, end in zip(self.sums, steps, ends[:-1], ends[1:], strict=True):
            z = z.at[start:end].set(kind.summed(step @ z))
        p = own @ z
        for kind, step, start, end in reversed([*zip(self.sums, steps, ends[:-1], ends[1:], strict=True)]):
            p = p + step.T @ kind.summed(p[start:end], transposed=True)
        return p[: self.size]

    def as_matrix(self) -> Float[Array, "n n"]:
        """With all its numbers."""
        return self.mv(jnp.eye(self.size, dtype=self.slopes.values.dtype))

    def transpose(self) -> "StructuredInertia":
        """Itself: it is symmetric."""
        return self

    def in_structure(self) -> jax.ShapeDtypeStruct:
        """That of a vector."""
        return jax.ShapeDtypeStruct((self.size,), self.slopes.values.dtype)

    def out_structure(self) -> jax.ShapeDtypeStruct:
        """That of a vector."""
        return self.in_structure()


@lx.is_symmetric.register(StructuredInertia)
def _is_symmetric(M: StructuredInertia) -> bool:
    return True


def structured_inertia(lagrangian: Callable, v: Float[Array, " n"]) -> lx.AbstractLinearOperator:
    """∂²L/∂q̇² of many coordinates; diagonal, or with all its numbers, where that is what it is."""
    found = lifted(lagrangian, v)
    if found is not None and chain_ordering(found.slopes.pattern, found.sums) is not None:
        return StructuredInertia(found.slopes, found.sums)
    _, M = jacobian(jax.grad(lagrangian), v)
    if not isinstance(M, SparseMatrix):
        return M
    return StructuredInertia(M, ()) if chain_ordering(M.pattern, ()) is not None else lx.MatrixLinearOperator(M.as_matrix())


def factorised(M: StructuredInertia) -> Factors:
    """The articulated inertias."""
    return factor(M.ordering, M.slopes.values)


def is_positive(M: StructuredInertia, factors: Factors) -> Bool[Array, ""]:
    """Whether no pivot is mere rounding, some n eps of what it was."""
    return factors.pivot > 10 * M.size * jnp.finfo(factors.pivot.dtype).eps


def by_inertia(M: StructuredInertia, factors: Factors) -> Callable:
    """B ↦ M⁻¹B; its derivative is one more such solve, never that of the factors."""
    solve = lambda _, B: by_factor(M.ordering, factors, B)
    return lambda B: jax.lax.custom_linear_solve(M.mv, B, solve, symmetric=True) if B.shape[1] else B


def root_of_inverse(M: StructuredInertia, factors: Factors) -> Callable:
    """B ↦ R⁻ᵀB where M = Rᵀ R."""
    return lambda B: by_root(M.ordering, factors, B).reshape(M.ordering.at.size, B.shape[1])
