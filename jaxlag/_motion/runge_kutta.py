"""Explicit Runge–Kutta schemes for small systems: one short loop over the stages, and dense output of high order."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .tableaux import DOP853, DOPRI5, Tableau

LARGE = 128  # entries, above which a product by a library is faster than a sum of the compiler's own


class Polynomial(dfx.AbstractLocalInterpolation):
    """Dense output y₀ + s (F₁ + (1 − s) (F₂ + s (F₃ + (1 − s) (F₄ + …)))), s = (t − t₀)/(t₁ − t₀); k holds h ẏ₀, h ẏ₁, F₄, …

    Source: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, section II.6.
    """

    t0: Any
    t1: Any
    y0: PyTree
    y1: PyTree
    k: PyTree

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            return jax.tree.map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        length = self.t1 - self.t0
        s = jnp.where(length == 0, 0, (t0 - self.t0) / jnp.where(length == 0, 1, length))

        def at_s(y0, y1, k):
            change, (begin, end, *higher) = y1 - y0, k
            terms, sum_ = [change, begin - change, 2 * change - begin - end, *higher], 0.0
            for power in reversed(range(len(terms))):
                sum_ = (sum_ + terms[power]) * (1 - s if power % 2 else s)
            return y0 + sum_

        return jax.tree.map(at_s, self.y0, self.y1, self.k)


class ExplicitRungeKutta(dfx.AbstractAdaptiveSolver):
    """An explicit Runge–Kutta scheme; the derivative at the end of a step is that at the start of the next."""

    tableau: ClassVar[Tableau]
    reverse: bool = eqx.field(static=True, default=True, kw_only=True)  # whether reverse mode may go through the loop over the stages
    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar = Polynomial

    def order(self, terms):
        return self.tableau.order

    def init(self, terms, t0, t1, y0, args):
        return terms.vf(t0, y0, args)

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        scheme, h = self.tableau, terms.contr(t0, t1)
        changes = lambda weights, f: jax.tree.map(lambda f: terms.prod(weighted(weights, f), h), f)

        def stage(f, row):
            i, c, weights = row
            t = jnp.where(c == 1, t1, t0 + c * (t1 - t0))  # not rounded beyond t1, where an input may jump
            new = terms.vf(t, jax.tree.map(jnp.add, y0, changes(weights, f)), args)
            return jax.tree.map(lambda f, new: with_row(f, new, i), f, new), None

        # One loop, so that the equations are compiled once. What is not there yet counts as nothing.
        size, rows = len(scheme.c), self.stages(jnp.result_type(*jax.tree.leaves(y0)))
        if made_jump is not False and self.reverse:
            solver_state = jax.lax.cond(made_jump, lambda: terms.vf(t0, y0, args), lambda: solver_state)
        first = jax.tree.map(lambda x: jnp.concatenate([x[None], jnp.zeros((size - 1, *x.shape), x.dtype)]), solver_state)
        if made_jump is False or self.reverse:
            f, _ = jax.lax.scan(stage, first, jax.tree.map(lambda x: x[1:], rows))
        else:
            at = lambda i: jax.tree.map(lambda x: jnp.asarray(x)[i], rows)
            f = jax.lax.fori_loop(jnp.where(made_jump, 0, 1), size, lambda i, f: stage(f, at(i))[0], first)
        return (*self.finished(y0, f, lambda change: terms.prod(change, h)), dfx.RESULTS.successful)

    def stages(self, dtype: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of each stage its number, its time from 0 to 1, and the weights of the stages before it."""
        scheme, size = self.tableau, len(self.tableau.c)
        return np.arange(size), np.array(scheme.c, dtype), as_rows([[], *scheme.a], size, dtype)

    def finished(self, y0: PyTree, f: PyTree, over_step: Callable) -> tuple[PyTree, PyTree, dict[str, Any], PyTree]:
        """What a step has come to with the stages f, of rates which the step makes changes of: y1, its error, the dense output, ẏ1."""
        scheme = self.tableau
        size, last, estimates = len(scheme.c), scheme.stages - 1, len(scheme.errors)
        rows = [*scheme.errors, scheme.a[last - 1], *np.eye(size)[[0, last]], *scheme.dense]
        weights = as_rows(rows, size, jnp.result_type(*jax.tree.leaves(y0)))
        every = jax.tree.map(lambda f: over_step(weighted(weights, f)), f)
        held = jax.lax.stop_gradient if self.reverse else lambda x: x  # its derivative is the error of a variation, in forward mode
        error = jax.tree.map(lambda every: combined(*held(every[:estimates])), every)
        y1 = jax.tree.map(lambda y0, every: y0 + every[estimates], y0, every)
        series = jax.tree.map(lambda every: every[estimates + 1 :], every)
        return y1, error, {"y0": y0, "y1": y1, "k": series}, jax.tree.map(lambda f: f[last], f)


def is_explicit(solver: dfx.AbstractSolver) -> bool:
    """Whether a solver solves no equations for its stages."""
    return isinstance(solver, (ExplicitRungeKutta, dfx.AbstractERK))


def as_rows(rows, size, dtype) -> np.ndarray:
    """Weights as an array, each row with zeros up to `size`."""
    return np.array([[*row, *[0.0] * (size - len(row))] for row in rows], dtype)


def with_row(f, new, i):
    """f with the row i replaced; few numbers by a choice, as the derivative of an update in place is a scatter, a call of its own."""
    if f.size > LARGE * len(f):
        return jax.lax.dynamic_update_index_in_dim(f, new, i, 0)
    return jnp.where((np.arange(len(f)) == i).reshape(-1, *[1] * new.ndim), new[None], f)


def weighted(weights, f):
    """Σ wᵢ fᵢ, for one row of weights or several.

    A reduction, or a product: a sum of slices XLA would fuse into what uses it, and compute anew for each use.
    """
    if f.size > LARGE * len(f):
        return jnp.tensordot(weights, f, 1, precision=jax.lax.Precision.HIGHEST)
    weights = weights.reshape(*weights.shape, *[1] * (f.ndim - 1))
    return jnp.sum(weights * f.reshape(*[1] * (weights.ndim - f.ndim), *f.shape), axis=weights.ndim - f.ndim)


@jax.custom_jvp
def combined(error, lower=None):
    """The estimate of an error; of higher order with one of lower beside it, e |e| / √(e² + ℓ²/100), entry by entry.

    Its derivative is the same estimate for a variation, and not that of the formula, which is zero where the motion is at rest.
    """
    if lower is None:
        return error
    size = jnp.sqrt(error**2 + 0.01 * lower**2)
    return jnp.where(size > 0, error * jnp.abs(error) / jnp.where(size > 0, size, 1), 0)


@combined.defjvp
def _combined_jvp(primals, tangents):
    return combined(*primals), combined(*tangents)


class Dopri5(ExplicitRungeKutta):
    r"""Dormand and Prince's scheme of order 5, with dense output of order 4.

    $$ y_1 = y_0 + h \sum_i b_i f_i, \qquad f_i = f\Bigl(t_0 + c_i h,\; y_0 + h \sum_{j<i} a_{ij} f_j\Bigr) $$

    For `simulate(solver=...)`, and for any `diffrax.diffeqsolve`; the state is any pytree.

    **Arguments:** `reverse`: whether reverse mode may go through a step in which an input jumps. `simulate` chooses by itself.

    **Raises:** nothing; `simulate` reports a failure of the integration as the result of the motion.

    **Source:** Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, table II.5.2 and section II.6.

    ```python
    import jaxlag as jl
    fall = jl.System(lambda q, qdot: 0.5 * qdot**2 - 9.81 * q)
    jl.simulate(fall, 0.0, 0.0, [0.0, 1.0], solver=jl.Dopri5()).q[-1]  # −9.81/2 = −4.905
    ```
    """

    tableau: ClassVar = DOPRI5


class Dop853(ExplicitRungeKutta):
    r"""Dormand and Prince's scheme of order 8, its errors of orders 5 and 3, with dense output of order 7.

    $$ y_1 = y_0 + h \sum_i b_i f_i, \qquad f_i = f\Bigl(t_0 + c_i h,\; y_0 + h \sum_{j<i} a_{ij} f_j\Bigr) $$

    For `simulate(solver=...)`, and for any `diffrax.diffeqsolve`; the state is any pytree.

    **Arguments:** `reverse`: whether reverse mode may go through a step in which an input jumps. `simulate` chooses by itself.

    **Raises:** nothing; `simulate` reports a failure of the integration as the result of the motion.

    **Source:** Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, section II.10.

    ```python
    import jaxlag as jl
    fall = jl.System(lambda q, qdot: 0.5 * qdot**2 - 9.81 * q)
    jl.simulate(fall, 0.0, 0.0, [0.0, 1.0], solver=jl.Dop853()).q[-1]  # −9.81/2 = −4.905
    ```
    """

    tableau: ClassVar = DOP853
