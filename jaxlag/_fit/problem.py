"""The whole least-squares problem: all experiments, what is known beforehand, and pieces of motion that must join."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._motion.results import reason_of
from .._motion.simulate_many import of_each
from .._program.jit import compiled
from .experiment import Experiment
from .parameters import Free
from .residuals import Linearised, Model, Stack, linearised, members, side_by_side, stacked


class Links(eqx.Module):
    """Where one piece of a motion ends the next has to begin: c = Wᵀ (end − start) = 0, kept by an augmented Lagrangian.

    **Source:** Bock, Recent advances in parameter identification techniques for o.d.e. (1983); Nocedal & Wright, Numerical
    Optimization, section 17.3.
    """

    weight: Array
    dual: Array  # one for each row of c
    size: Array  # (2n,) of the state, typical
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)


class Rows(NamedTuple):
    """What a `Problem` says of its unknowns: all residuals and their Jacobian; the experiments apart; the gaps at links."""

    residuals: Any
    jacobian: Any
    of_stacks: tuple[Linearised, ...]
    gaps: Any
    gaps_jacobian: Any


class Problem(eqx.Module):
    """Residuals as a function of all unknowns, y of the free parameters and then z of each experiment, in one flat vector."""

    model: Model
    free: Free
    stacks: tuple[Stack, ...]
    scale: Array  # of the noise, in units of sigma, for losses that need it
    links: Links | None = None

    @classmethod
    def of(cls, model: Model, free: Free, experiments: Sequence[Experiment]) -> "Problem":
        """The problem at its start, y = z = 0."""
        return cls(model, free, stacked(model.system, free.params, experiments), jnp.ones((), free.start.dtype))

    @property
    def size(self) -> int:
        """The number of unknowns."""
        return self.free.size + sum(len(stack.members) * stack.unknowns for stack in self.stacks)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Of all unknowns."""
        lower, upper = self.free.bounds
        others = jnp.full(self.size - self.free.size, jnp.inf, lower.dtype)
        return jnp.concatenate([lower, -others]), jnp.concatenate([upper, others])

    def split(self, x: Array) -> tuple[Array, list[Array]]:
        """y, and for each stack z of its experiments."""
        sizes = [self.free.size, *(len(stack.members) * stack.unknowns for stack in self.stacks)]
        y, *zs = jnp.split(x, np.cumsum(sizes)[:-1])
        return y, [z.reshape(len(stack.members), stack.unknowns) for stack, z in zip(self.stacks, zs, strict=True)]

    def linearise(self, x: Array) -> Rows:
        """All residuals and their Jacobian."""
        y, zs = self.split(x)
        parts = tuple(linearised(self.model, self.free, stack, y, z, self.scale) for stack, z in zip(self.stacks, zs, strict=True))
        prior = jnp.zeros((self.free.size, self.size), x.dtype).at[:, : self.free.size].set(jnp.diag(self.free.slope(y) / self.free.spread))
        blocks = [(self.free.surprise(y), prior)]
        for k, part in enumerate(parts):
            blocks.append((part.residuals, self._over_all(k, np.arange(len(part.residuals)), part.jacobian)))
        gaps, gaps_J = jnp.zeros(0), jnp.zeros((0, self.size))
        if self.links is not None:
            gaps, gaps_J = self._gaps(parts)
            blocks.append((self.links.weight * (gaps + self.links.dual), self.links.weight * gaps_J))
        residuals, jacobians = zip(*((r.ravel(), J.reshape(-1, self.size)) for r, J in blocks), strict=True)
        return Rows(jnp.concatenate(residuals), jnp.concatenate(jacobians), parts, gaps, gaps_J)

    def cost(self, x: Array) -> Array:
        """Half the sum of squares, without its Jacobian: for a reverse pass."""
        y, zs = self.split(x)
        total = jnp.sum(self.free.surprise(y) ** 2)
        for stack, z in zip(self.stacks, zs, strict=True):
            total = total + jnp.sum(members(self.model, self.free, stack, y, z, self.scale).residuals ** 2)
        return total / 2

    def _over_all(self, k, members, J):
        """Rows of some experiments of stack k, over (y, z), as rows over all unknowns."""
        p = self.free.size
        wide = jnp.zeros((*J.shape[:2], self.size), J.dtype).at[:, :, :p].set(J[:, :, :p])
        at = np.arange(len(members))[:, None, None], np.arange(J.shape[1])[:, None], self.own_columns(k, members)[:, None]
        return wide.at[at].set(J[:, :, p:])

    def _gaps(self, parts):
        """c and its Jacobian; the links between one pair of stacks together."""
        place = {i: (k, row) for k, stack in enumerate(self.stacks) for row, i in enumerate(stack.members)}
        kinds: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for a, b in self.links.pairs:
            kinds.setdefault((place[a][0], place[b][0]), []).append((place[a][1], place[b][1]))
        gaps, jacobians = zip(*(self._gaps_between(parts, *kind, np.array(rows).T) for kind, rows in kinds.items()), strict=True)
        return jnp.concatenate(gaps), jnp.concatenate(jacobians)

    def _gaps_between(self, parts, a, b, rows):
        of_a, of_b = rows
        ends = self.links.size.size
        W = self.stacks[b].ways[of_b].swapaxes(1, 2) / self.links.size[None, None, :]
        gap = parts[a].ends[of_a, ends:] - parts[b].ends[of_b, :ends]
        end, start = W @ parts[a].ends_jacobian[of_a, ends:], W @ parts[b].ends_jacobian[of_b, :ends]
        J = self._over_all(a, of_a, end) - self._over_all(b, of_b, start)
        return jnp.einsum("lij,lj->li", W, gap).ravel(), J.reshape(-1, self.size)

    def own_columns(self, k: int, rows: np.ndarray) -> np.ndarray:
        """Where the own unknowns of some experiments of stack k are among all."""
        begin = self.free.size + sum(len(stack.members) * stack.unknowns for stack in self.stacks[:k])
        return begin + rows[:, None] * self.stacks[k].unknowns + np.arange(self.stacks[k].unknowns)


def linearise(problem: Problem, x: Array) -> Rows:
    """`Problem.linearise`, compiled; what several devices computed is brought together."""
    rows = _linearise(problem, x)
    return rows if all(stack.mesh is None for stack in problem.stacks) else jax.tree.map(np.asarray, rows)


@compiled
def _linearise(problem, x):
    return problem.linearise(x)


@compiled
def look(problem: Problem, x: Array) -> Rows:
    """The residuals alone, where there are too many unknowns for a Jacobian."""
    y, zs = problem.split(x)
    parts = []
    for stack, z in zip(problem.stacks, zs, strict=True):
        m = members(problem.model, problem.free, stack, y, z, problem.scale)
        parts.append(Linearised(m.residuals, None, m.ends, None, m.channels, m.result))
    r = jnp.concatenate([problem.free.surprise(y), *(part.residuals.ravel() for part in parts)])
    return Rows(r, None, tuple(parts), jnp.zeros(0), jnp.zeros((0, problem.size)))


@compiled
def linearise_starts(problem: Problem, xs: Array) -> Rows:
    """One problem at many places."""
    return of_each(problem.linearise, xs)


def linearise_each(problem: Problem, xs: Array) -> Rows:
    """Each experiment of a problem with one stack as a problem of its own."""
    rows = _linearise_each(problem, xs)
    return rows if problem.stacks[0].mesh is None else jax.tree.map(np.asarray, rows)


@compiled
def _linearise_each(problem, xs):
    (stack,) = problem.stacks

    def alone(e, x, common):
        one = dataclasses.replace(jax.tree.map(lambda leaf: leaf[None] if eqx.is_array(leaf) else leaf, e), members=(0,), mesh=None)
        return dataclasses.replace(common, stacks=(one,)).linearise(x)

    return side_by_side(alone, stack, xs, dataclasses.replace(problem, stacks=()))


def blank(model: Model, free: Free, experiment: Experiment) -> Experiment:
    """The experiment with zeros measured by sensors of unit noise: its residuals are what its sensors see."""
    bare = eqx.tree_at(lambda e: (e.values, e.sigma), experiment, (None, None), is_leaf=lambda x: x is None)
    (stack,) = stacked(model.system, free.params, [bare])
    one = jax.tree.map(lambda x: x[0] if eqx.is_array(x) else x, stack)
    seen = eqx.filter_eval_shape(lambda e: model.predicted(free.params, e, jnp.zeros(stack.unknowns))[0], one)
    zeros = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), seen)
    return eqx.tree_at(lambda e: e.values, bare, zeros, is_leaf=lambda x: x is None)


def failure_of(rows: Rows) -> str | None:
    """Why a motion could not be computed, if one could not."""
    for part in rows.of_stacks:
        if not np.all(np.isfinite(np.asarray(part.residuals))):
            return reason_of(part.result)
    return None
