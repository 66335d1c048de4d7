"""The least-squares problem as a whole: all experiments, the priors, and the continuity of motions that are cut into segments."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._model.recorded import deviations
from .._motion.members import of_each
from .._motion.results import reason_of
from .._program.jit import compiled, numpy_for
from .arrow import Arrow, whole
from .experiment import Experiment
from .experiment_batch import ExperimentBatch, batches_of, map_batch
from .measurement import Evaluated, Prepared, Test
from .parameters import Free
from .residuals import Model, Predictions, linearise_batch, predict_batch, weighted

WIDE = 4e6  # numbers in a Jacobian, from which on zeros are left out of it
ASIDE = 0.01  # of a parameter, by which a start is moved


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Continuity:
    """Where one segment of a motion ends the next has to start: c = Wᵀ (end − start) = 0, enforced by an augmented Lagrangian.

    W is the tangent basis of the start of the next segment, over the typical size of the state.

    **Source:** Bock, Recent advances in parameter identification techniques for o.d.e. (1983); Nocedal & Wright, Numerical
    Optimization, section 17.3.
    """

    weight: Any
    dual: Any  # one for each entry of c
    size: Any  # (2n,), typical size of the state
    pairs: tuple[tuple[int, int], ...] = dataclasses.field(metadata={"static": True})  # of segments that follow each other


class Linearisation(NamedTuple):
    """A `LeastSquaresProblem` at one point: all residuals and their Jacobian, the same for each batch of experiments and each test, and
    the gaps c of segments.
    """

    residuals: Any
    jacobian: Any
    batches: tuple[Predictions, ...]
    gaps: Any
    gaps_jacobian: Any
    tests: tuple[Evaluated, ...] = ()


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class LeastSquaresProblem:
    """Residuals as a function of all unknowns x: y of the free parameters, then z of each experiment, in one flat vector."""

    model: Model
    free: Free
    batches: tuple[ExperimentBatch, ...]
    scale: Any  # of the noise, in units of sigma, for robust losses
    continuity: Continuity | None = None
    tests: tuple[Prepared, ...] = ()

    @classmethod
    def of(cls, model: Model, free: Free, recordings: Sequence[Experiment], tests: Sequence[Test] = ()) -> "LeastSquaresProblem":
        """The problem of these experiments; `params` are at x = 0."""
        prepared = tuple(test.prepared(model.system, free.params) for test in tests)
        batches = batches_of(model.system, free.params, recordings)
        return cls(model, free, batches, np.ones((), free.start.dtype), tests=prepared)

    @property
    def size(self) -> int:
        """The number of unknowns."""
        return self.free.size + sum(len(batch.members) * batch.unknowns for batch in self.batches)

    @property
    def first_recorded(self) -> int:
        """The number of residuals beside those of recordings, and before them: of the priors, then of the tests."""
        return self.free.size + sum(test.size for test in self.tests)

    @property
    def bounds(self) -> tuple[Any, Any]:
        """Lower and upper bounds of all unknowns."""
        lower, upper = self.free.bounds
        xnp, others = numpy_for(lower, upper), np.full(self.size - self.free.size, np.inf, lower.dtype)
        return xnp.concatenate([lower, -others]), xnp.concatenate([upper, others])

    @property
    def begin(self) -> np.ndarray:
        """Where to begin: at x = 0, or beside it where modes have one frequency there, which no derivative parts."""
        x = np.zeros(self.size, self.free.start.dtype)
        if any(part.test.is_singular(part.near) for part in self.tests):
            x[: self.free.size] = np.clip(ASIDE * np.cos(np.arange(self.free.size)), *self.free.bounds)
        return x

    @property
    def places(self) -> dict[int, tuple[int, int]]:
        """For each experiment its batch and its row in the batch."""
        return {i: (k, row) for k, batch in enumerate(self.batches) for row, i in enumerate(batch.members)}

    def own_columns(self, k: int, rows: np.ndarray) -> np.ndarray:
        """Indices in x of the own unknowns of some experiments of batch k, (experiments, unknowns)."""
        begin = self.free.size + sum(len(batch.members) * batch.unknowns for batch in self.batches[:k])
        return begin + rows[:, None] * self.batches[k].unknowns + np.arange(self.batches[k].unknowns)

    def split(self, x: Float[Array | np.ndarray, " x"]) -> tuple[Array, list[Array]]:
        """y, and for each batch z of its experiments."""
        sizes = [self.free.size, *(len(batch.members) * batch.unknowns for batch in self.batches)]
        y, *zs = jnp.split(x, np.cumsum(sizes)[:-1])
        return y, [z.reshape(len(batch.members), batch.unknowns) for batch, z in zip(self.batches, zs, strict=True)]

    def linearise(self, x: Float[Array | np.ndarray, " x"]) -> Linearisation:
        """All residuals and their Jacobian: those of the priors, of the tests, of the recordings, of the gaps."""
        y, zs = self.split(x)
        parts = [linearise_batch(self.model, self.free, batch, y, z) for batch, z in zip(self.batches, zs, strict=True)]
        return self.assembled(x, parts, tuple(test.linearised(self.model.system, self.free, y) for test in self.tests))

    def assembled(self, x: Any, predictions: Sequence[Predictions], tests: tuple[Evaluated, ...]) -> Linearisation:
        """The same, from what is predicted at x: with other weights it takes no motion."""
        y, _ = self.split(x)
        parts, blocks = self._weighted(predictions)
        slope = jnp.diag(self.free.slope(y) / self.free.prior_deviation)
        of_free = [(self.free.prior_residual(y), slope), *(test[:2] for test in tests)]
        first = jnp.concatenate([J for _, J in of_free])
        first = jnp.zeros((len(first), self.size), x.dtype).at[:, : self.free.size].set(first)
        gaps, gaps_J = jnp.zeros(0), jnp.zeros((0, self.size))
        last, last_J = gaps, gaps_J
        if self.continuity is not None:
            gaps, gaps_J = self._gaps(parts)
            last, last_J = self.continuity.weight * (gaps + self.continuity.dual), self.continuity.weight * gaps_J
        columns = tuple(self.columns(k) for k in range(len(parts)))
        jacobian = Arrow(first, blocks, columns, last_J)
        residuals = jnp.concatenate([*(r for r, _ in of_free), *(part.residuals.ravel() for part in parts), last])
        return Linearisation(residuals, jacobian if self._is_wide else whole(jacobian), parts, gaps, gaps_J, tests)

    @property
    def _is_wide(self):
        """Whether a Jacobian would have little but zeros in it, in too large a number."""
        rows = sum(leaf.size for batch in self.batches for leaf in jax.tree.leaves(batch.values))
        return rows * (self.size - self.free.size) > WIDE and sum(len(batch.members) for batch in self.batches) > 1

    def columns(self, k: int) -> np.ndarray:
        """Indices in x of what each experiment of batch k depends on, (experiments, p + unknowns)."""
        count = len(self.batches[k].members)
        return np.hstack([np.tile(np.arange(self.free.size), (count, 1)), self.own_columns(k, np.arange(count))])

    def cost(self, x: Float[Array | np.ndarray, " x"]) -> Array:
        """Half the sum of squares, without the Jacobian of the residuals: for reverse-mode differentiation."""
        y, zs = self.split(x)
        total = jnp.sum(self.free.prior_residual(y) ** 2)
        for test in self.tests:
            total = total + jnp.sum(test.evaluated(self.model.system, self.free.insert(self.free.theta(y)))[0] ** 2)
        for part in self._evaluated(y, zs):
            total = total + jnp.sum(part.residuals**2)
        return total / 2

    def _weighted(self, predictions):
        """Predictions of each batch with their residuals, and the Jacobians of these."""
        pairs = [weighted(self.model.loss, batch, part, self.scale) for batch, part in zip(self.batches, predictions, strict=True)]
        return tuple(part for part, _ in pairs), tuple(J for _, J in pairs)

    def _evaluated(self, y, zs):
        """Predictions and residuals of each batch, without Jacobians."""
        return self._weighted([predict_batch(self.model, self.free, batch, y, z) for batch, z in zip(self.batches, zs, strict=True)])[0]

    def _over_all_unknowns(self, k, rows, J):
        """Jacobians of some experiments of batch k with respect to (y, z), with a column for every unknown."""
        p = self.free.size
        wide = jnp.zeros((*J.shape[:2], self.size), J.dtype).at[:, :, :p].set(J[:, :, :p])
        at = np.arange(len(rows))[:, None, None], np.arange(J.shape[1])[:, None], self.own_columns(k, rows)[:, None]
        return wide.at[at].set(J[:, :, p:])

    def _gaps(self, parts):
        """c and its Jacobian; all pairs between the same two batches are computed together."""
        places = self.places
        kinds: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for a, b in self.continuity.pairs:
            (batch_a, row_a), (batch_b, row_b) = places[a], places[b]
            kinds.setdefault((batch_a, batch_b), []).append((row_a, row_b))
        gaps, jacobians = zip(*(self._gaps_between(parts, *kind, np.array(rows).T) for kind, rows in kinds.items()), strict=True)
        return jnp.concatenate(gaps), jnp.concatenate(jacobians)

    def _gaps_between(self, parts, a, b, rows):
        rows_a, rows_b = rows
        ends = self.continuity.size.size
        W = self.batches[b].tangent_basis[rows_b].swapaxes(1, 2) / self.continuity.size[None, None, :]
        gap = parts[a].ends[rows_a, ends:] - parts[b].ends[rows_b, :ends]
        end, start = W @ parts[a].ends_jacobian[rows_a, ends:], W @ parts[b].ends_jacobian[rows_b, :ends]
        J = self._over_all_unknowns(a, rows_a, end) - self._over_all_unknowns(b, rows_b, start)
        return jnp.einsum("lij,lj->li", W, gap).ravel(), J.reshape(-1, self.size)


def linearise(problem: LeastSquaresProblem, x: Float[Array | np.ndarray, " x"]) -> Linearisation:
    """`LeastSquaresProblem.linearise`, compiled; results of several devices are gathered."""
    found = _linearise(problem, x)
    return found if all(batch.mesh is None for batch in problem.batches) else jax.tree.map(np.asarray, found)


def held_by_jax(problem: LeastSquaresProblem) -> LeastSquaresProblem:
    """The same in arrays of JAX, for many calls: one of NumPy takes a program 2 µs, of which a problem has dozens."""
    return _held(problem) if all(batch.mesh is None for batch in problem.batches) else problem


@compiled
def _held(problem):
    return problem


@compiled
def _linearise(problem, x):
    return problem.linearise(x)


@compiled
def reweighted(problem: LeastSquaresProblem, x: Any, found: Linearisation) -> Linearisation:
    """A linearisation at x with the weights of this problem instead of those it was computed with: takes no motion."""
    return problem.assembled(x, found.batches, found.tests)


@compiled
def without_jacobian(problem: LeastSquaresProblem, x: Float[Array | np.ndarray, " x"]) -> Linearisation:
    """The residuals alone, where there are too many unknowns for a Jacobian."""
    y, zs = problem.split(x)
    parts = problem._evaluated(y, zs)
    params = problem.free.insert(problem.free.theta(y))
    tests = [test.evaluated(problem.model.system, params) for test in problem.tests]
    r = jnp.concatenate([problem.free.prior_residual(y), *(r for r, _ in tests), *(part.residuals.ravel() for part in parts)])
    evaluated = tuple(Evaluated(r, None, predictions) for r, predictions in tests)
    return Linearisation(r, None, parts, jnp.zeros(0), jnp.zeros((0, problem.size)), evaluated)


@compiled
def linearise_starts(problem: LeastSquaresProblem, xs: Float[Array, "starts x"]) -> Linearisation:
    """One problem at many points."""
    return of_each(problem.linearise, xs)


def linearise_each(problem: LeastSquaresProblem, xs: Float[Array, "experiments x"]) -> Linearisation:
    """Each experiment of a problem with one batch as a problem by itself; each may have a `scale` of its own."""
    found = _linearise_each(problem, xs)
    return found if problem.batches[0].mesh is None else jax.tree.map(np.asarray, found)


@compiled
def _linearise_each(problem, xs):
    (batch,) = problem.batches

    def of_one(e, x_and_scale, common):
        one = dataclasses.replace(jax.tree.map(lambda leaf: leaf[None] if eqx.is_array(leaf) else leaf, e), members=(0,), mesh=None)
        return dataclasses.replace(common, batches=(one,), scale=x_and_scale[-1]).linearise(x_and_scale[:-1])

    scales = jnp.broadcast_to(jnp.asarray(problem.scale, xs.dtype), len(xs))
    return map_batch(of_one, batch, jnp.concatenate([xs, scales[:, None]], axis=1), dataclasses.replace(problem, batches=()))


def size_of(problem: LeastSquaresProblem) -> float:
    """The norm of all that is measured, in units of its noise; infinite where there are tests, whose measurements are of another kind."""
    if problem.tests or not problem.batches:
        return np.inf
    return float(np.sqrt(sum(np.sum(part**2) for batch in problem.batches for part in sizes_of_each(batch))))


def sizes_of_each(batch: ExperimentBatch) -> list[np.ndarray]:
    """For each channel the norm of what each member has measured, in units of its noise."""
    leaves = zip(jax.tree.leaves(batch.values), jax.tree.leaves(batch.sigma), strict=True)
    scaled = (np.asarray(z) / np.asarray(s) for z, s in leaves)
    return [np.sqrt(np.nansum(part.reshape(len(part), -1)[: len(batch.members)] ** 2, axis=1)) for part in scaled]


def with_zero_values(model: Model, free: Free, experiment: Experiment, y: Any = 0.0) -> Experiment:
    """The experiment with measurements of zero and a sigma of one: its residuals are what its sensors see, and the times of as many events
    as happen with θ(y).
    """
    bare = {name: experiment.values[name] for name in experiment.events} or None  # how many there are
    bare = eqx.tree_at(lambda e: (e.values, e.sigma), experiment, (bare, None), is_leaf=lambda x: x is None)
    (batch,) = batches_of(model.system, free.params, [bare])
    one = jax.tree.map(lambda x: x[0] if eqx.is_array(x) else x, batch)
    of = lambda e: model.predicted(free.insert(free.theta(y)), e, jnp.zeros(batch.unknowns))[0]
    if experiment.events:
        zeros = jax.tree.map(lambda seen: jnp.where(jnp.isfinite(seen), 0, jnp.nan), eqx.filter_jit(of)(one))
    else:
        zeros = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), eqx.filter_eval_shape(of, one))
    return eqx.tree_at(lambda e: e.values, bare, zeros, is_leaf=lambda x: x is None)


def with_expected_zeros(model: Model, free: Free, experiment: Experiment) -> Experiment:
    """A planned experiment with zeros for values, and its own sigma; one that has values as it is."""
    if experiment.values is not None:
        return experiment
    zeros = with_zero_values(model, free, experiment).values
    return eqx.tree_at(lambda e: (e.values, e.sigma), experiment, (zeros, deviations(experiment.sigma, zeros)), is_leaf=lambda x: x is None)


class NoMotion(ValueError):
    """There is a start from which no motion can be computed."""


TOO_FEW = "fewer events happen than were measured, or what is observed is not finite."
NOT_STEADY = (
    "no steady state was found near which a test could be predicted, or a measured mode does not oscillate there, or what `predict` "
    "returns is not finite."
)


def failure_of(found: Linearisation) -> str | None:
    """Why a motion or a test could not be computed, or None."""
    if not all(np.all(np.isfinite(np.asarray(test.residuals))) for test in found.tests):
        return NOT_STEADY
    for part in found.batches:
        if not np.all(np.isfinite(np.asarray(part.residuals))):
            return reason_of(part.result) or TOO_FEW
    return None
