"""From the minimum to the answer: estimates, their errors, and what is left of the measurements."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._model.paths import is_within
from .._program.jit import compiled
from .autocorrelation import autoregression, coloured_information, reach
from .experiment import Experiment
from .identifiability import MANY, Determined, channels_of, correlation_of, determined_by, in_words
from .levenberg_marquardt import ASTRAY, CONVERGED, REASONS, Outcome
from .multiple_shooting import Pieces
from .problem import Problem, failure_of, linearise
from .result import Fit


def robust_scale(rows, problem):
    """The standard deviation of normal noise with these residuals, by their median: outliers do not move it."""
    r = np.concatenate([np.ravel(r)[np.isfinite(np.ravel(r))] for r in _weighted(problem, rows)])
    return jnp.asarray(1.4826 * np.median(np.abs(r)), problem.scale.dtype)


def _weighted(problem, rows):
    """(measured − predicted) / sigma for each stack, flat per experiment; NaN where nothing was measured."""
    for stack, part in zip(problem.stacks, rows.of_stacks, strict=True):
        count = len(stack.members)  # there may be copies behind them
        values, sigma = jax.tree.map(lambda x, count=count: np.asarray(x)[:count], (stack.values, stack.sigma))
        r = jax.tree.map(lambda z, p, s: (z - p) / s, values, part.channels, sigma)
        yield np.concatenate([np.reshape(leaf, (count, -1)) for leaf in jax.tree.leaves(r)], axis=1)


def report(problem: Problem, experiments: Sequence[Experiment], outcome: Outcome, whole: Pieces) -> Fit:
    """The answer that an outcome of the iteration means."""
    x, rows, free = np.asarray(outcome.best.y), outcome.best.rest, problem.free
    p, y = free.size, jnp.asarray(outcome.best.y[: free.size])
    theta, slope = map(np.asarray, _theta_and_slope(free, y))
    of_stacks = list(_weighted(problem, rows))
    weighted = np.concatenate([np.ravel(r) for r in of_stacks])
    there = np.isfinite(weighted)
    count, absolute = int(there.sum()), all(e.sigma is not None for e in experiments)

    gaps_J = np.asarray(rows.gaps_jacobian)
    inflation, correlated, held = np.ones(p), 0, []
    if rows.jacobian is None:
        known, remarks = Determined(np.full((x.size, x.size), np.nan), np.ones(x.size, bool), np.zeros((x.size, 0))), [NO_ERRORS]
    else:
        J = np.asarray(rows.jacobian)[: p + weighted.size].copy()
        if problem.model.loss is not None:
            J[p:] /= problem.model.loss.slope(np.where(there, weighted, 0) / problem.scale)[:, None]
        known = determined_by(J, gaps_J)
        remarks = _not_determined(problem, x, known, theta, slope, J) if np.any(known.null[:p]) else []
        allowing, correlated = _allowing_for_colour(problem, of_stacks, experiments, whole, J, known.covariance, absolute)
        then, before = (np.diag(c)[:p] for c in (allowing, known.covariance))
        inflation = np.sqrt(np.where(before > 0, then / np.where(before > 0, before, 1), 1))
        known = known._replace(covariance=allowing)
        r = np.nan_to_num(np.asarray(rows.residuals), posinf=0.0)  # of a motion that could not be computed
        held = list(_at_bounds(free, theta, r @ np.asarray(rows.jacobian)[:, :p]))
    unknown_count = x.size - known.null.shape[1] - len(gaps_J)
    sigma = _noise(weighted[there], problem, max(count - unknown_count, 0))
    scale = 1.0 if absolute and problem.model.loss is None else sigma

    covariance = known.covariance[:p, :p] * np.outer(slope, slope) * scale**2
    covariance[np.diag_indices(p)] = np.where(known.determined[:p], np.diag(covariance), np.inf)
    errors = np.sqrt(np.diag(covariance))
    first = [whole.of.index(i) for i in range(len(experiments))]
    own = [_own_of(problem, x, rows, k, e, known, scale) for k, e in zip(first, experiments, strict=True)]
    residuals, predictions, spreads = _whole(problem, rows, experiments, whole, known.covariance)
    channels = [c for k, (e, r) in enumerate(zip(experiments, residuals, strict=True)) for c in channels_of(k, e.values, r)]
    status, away = int(outcome.best.status), _off(problem, weighted[there])
    remarks += held
    remarks += _misfit(away, sigma if absolute else 1.0, channels, known_why=bool(held))
    if status == CONVERGED and away > AWAY:
        status = ASTRAY
    return Fit(
        experiments=tuple(_as_found(e, found) for e, (found, _) in zip(experiments, own, strict=True)),
        params=free.insert(jnp.asarray(theta)),
        estimates=free.by_name(jnp.asarray(theta)),
        standard_errors=free.by_name(jnp.asarray(errors)),
        covariance=covariance,
        correlation=correlation_of(covariance),
        unknowns=[found for found, _ in own],
        unknown_errors=[errors for _, errors in own],
        residuals=residuals,
        predictions=predictions,
        prediction_errors=[jax.tree.map(lambda spread: scale * spread, tree) for tree in spreads],
        channels=channels,
        sigma=sigma,
        cost=float(np.sum(np.asarray(rows.residuals)[: p + weighted.size] ** 2) / 2),
        names=free.entries,
        remarks=remarks,
        converged=status == CONVERGED,
        reason=REASONS[status],
        steps=outcome.steps,
        costs=outcome.costs,
        measurements=count,
        absolute=absolute,
        problem=problem,
        unknown_count=unknown_count,
        x=x,
        x_covariance=known.covariance,
        inflation=inflation,
        correlated=correlated,
    )


@compiled
def _theta_and_slope(free, y):
    return free.theta(y), free.slope(y)


UNEXPLAINED = 3.0  # residuals of so many times the noise are none
AWAY = 10.0  # and so many times as large as the measurements, they come from a motion that has nothing to do with them
WELL = 0.99  # R² of a channel from which on correlated residuals are told by the table alone
NO_ERRORS = "standard errors are not computed for so many parameters"


def _noise(r, problem, freedom):
    """σ̂ in units of the sigma given; with a robust loss by Huber's formula."""
    if freedom == 0:
        return np.nan
    loss = problem.model.loss
    if loss is None:
        return float(np.sqrt(r @ r / freedom))
    s = float(problem.scale)
    influence = np.asarray(loss.influence(r / s))
    return float(s * np.sqrt(influence @ influence / freedom) / np.mean(np.abs(r / s) <= loss.delta))


def _allowing_for_colour(problem, of_stacks, experiments, whole, J, covariance, absolute):
    """The covariance over σ² of all unknowns, or the sandwich about it where residuals are correlated; and over how many samples."""
    p, loss = problem.free.size, problem.model.loss
    if loss is not None:
        of_stacks = [np.asarray(loss.influence(r / problem.scale)) for r in of_stacks]
    begins = p + np.cumsum([0, *(r.size for r in of_stacks)])

    def of_experiment(members, rows_of):
        """Rows of its pieces, (samples, channels, ...)."""
        places = [(*_place(problem, j), n) for j, n in members]
        return np.concatenate([_by_time(problem.stacks[k], rows_of(k, row), n) for k, row, n in places])

    def slopes_of(k, row):
        begin = begins[k] + row * of_stacks[k].shape[1]
        return J[begin : begin + of_stacks[k].shape[1]].astype(float)

    series = [of_experiment(members, lambda k, row: of_stacks[k][row].astype(float)) for members in _members(whole, experiments)]
    reaches = [reach(autoregression(r[np.isfinite(r)]), len(r)) for rs in series for r in rs.T]
    if not any(reaches):
        return covariance, 0
    power = np.nanmean(np.concatenate([r.ravel() for r in series]) ** 2)
    middle = J[:p].T @ J[:p]
    for members, r in zip(_members(whole, experiments), series, strict=True):
        sizes = np.ones(r.shape[1]) if absolute else np.sqrt(np.nanmean(r**2, axis=0) / power)
        middle = middle + coloured_information(of_experiment(members, slopes_of), r, sizes)
    return covariance @ middle @ covariance, max(reaches)


def _by_time(stack, flat, samples):
    """Rows of one experiment, one channel after the other, as (samples, channels, ...)."""
    shapes = [leaf.shape[1:] for leaf in jax.tree.leaves(stack.values)]
    parts = np.split(flat, np.cumsum([int(np.prod(shape)) for shape in shapes])[:-1])
    by_time = [part.reshape(shape[0], -1, *flat.shape[1:]) for part, shape in zip(parts, shapes, strict=True)]
    return np.concatenate(by_time, axis=1)[:samples]


def _at_bounds(free, theta, slope):
    """Remarks on estimates that a bound holds back."""
    for name, value, downhill, *bounds in zip(free.entries, theta, -slope, np.asarray(free.lower), np.asarray(free.upper), strict=True):
        for bound, outwards in zip(bounds, (-downhill, downhill), strict=True):
            if value == bound and outwards > 0:
                yield f"{name} is at its bound {bound:g}, which the measurements would have it cross"


def _off(problem, weighted):
    """How many times as large as the measurements the residuals are."""
    squares = 0.0
    for stack in problem.stacks:
        for z, s in zip(jax.tree.leaves(stack.values), jax.tree.leaves(stack.sigma), strict=True):
            squares += float(np.nansum((np.asarray(z) / np.asarray(s))[: len(stack.members)] ** 2))
    return float(np.linalg.norm(weighted) / np.sqrt(squares)) if squares > 0 else 0.0


def _misfit(away, times_noise, channels, known_why):
    """Remarks on measurements that the model does not explain; what is known to be wrong already explains correlated residuals."""
    if away > AWAY:
        yield f"the residuals are {away:.2g} times as large as the measurements: look at the units, and start from other parameters"
    elif times_noise > UNEXPLAINED:
        yield (
            f"the model does not explain the measurements, off by {times_noise:.2g} times their noise: look for another start, "
            "`pieces=`, or what the model lacks; the errors above mean little"
        )
    elif not known_why:
        missed = [c for c in channels if c.correlated and c.r_squared < WELL]
        if missed:
            names = ", ".join(dict.fromkeys(c.name for c in missed[:MANY])) + (", …" if len(missed) > MANY else "")
            over = max(c.correlated for c in missed)
            yield f"the model misses something, or the sensors' noise is not white: residuals of {names} are correlated over {over} samples"


def _not_determined(problem, x, known, theta, slope, J):
    """In words; a second place tells whether it is a factor or a sum that does not show."""
    free, p = problem.free, problem.free.size
    nulls, thetas = [slope[:, None] * known.null[:p]], [theta]
    elsewhere = jnp.asarray(x).at[:p].add(0.1 * jnp.cos(jnp.arange(p)))
    rows = linearise(problem, elsewhere)
    if failure_of(rows) is None:
        there = determined_by(np.asarray(rows.jacobian)[: len(rows.residuals) - len(rows.gaps)], np.asarray(rows.gaps_jacobian))
        nulls.append(np.asarray(free.slope(elsewhere[:p]))[:, None] * there.null[:p])
        thetas.append(np.asarray(free.theta(elsewhere[:p])))
    return in_words(free.entries, theta, nulls, thetas, np.flatnonzero(~np.any(J[:, :p], axis=0)).tolist())


def _place(problem, i):
    return next((k, stack.members.index(i)) for k, stack in enumerate(problem.stacks) if i in stack.members)


def _own_of(problem, x, rows, i, e, known, scale):
    """The unknowns of an experiment's own, and their standard errors, by name."""
    if not e.unknown:
        return {}, {}
    k, row = _place(problem, i)
    stack, part, p = problem.stacks[k], rows.of_stacks[k], problem.free.size
    at = p + sum(len(s.members) * s.unknowns for s in problem.stacks[:k]) + row * stack.unknowns
    z, columns = x[at : at + stack.unknowns], np.r_[0:p, at : at + stack.unknowns]

    def errors(J):
        variance = np.einsum("ij,jk,ik->i", J, known.covariance[np.ix_(columns, columns)], J)
        loose = np.any(np.abs(J @ known.null[columns]) > 1e-6 * np.max(np.abs(J), initial=1e-300), axis=1)
        return np.where(loose, np.inf, scale * np.sqrt(np.maximum(variance, 0)))

    one = jax.tree.map(lambda leaf: leaf[row] if eqx.is_array(leaf) else leaf, stack)
    own, unravel_own = ravel_pytree({name: one.started(jnp.asarray(z))[2][name] for name in stack.own})
    own_J = jax.jacfwd(lambda z: ravel_pytree({name: one.started(z)[2][name] for name in stack.own})[0])(jnp.asarray(z))
    values, spreads = unravel_own(own), unravel_own(jnp.asarray(errors(np.hstack([np.zeros((own.size, p)), own_J]))))

    unravel = ravel_pytree((e.q0, e.qdot0))[1]
    half = rows.of_stacks[k].ends.shape[1] // 2
    start = unravel(jnp.asarray(part.ends[row, :half]))
    if part.ends_jacobian is None:
        start_errors = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), start)
    else:
        start_errors = unravel(jnp.asarray(errors(np.asarray(part.ends_jacobian[row, :half]))))
    for which, value, error in zip(("q0", "qdot0"), start, start_errors, strict=True):
        if any(is_within(name, which) for name in e.unknown):
            values[which], spreads[which] = value, error
    return values, spreads


def _as_found(e, own):
    """The experiment with its estimates put in."""
    params = e.params | {name: value for name, value in own.items() if name in e.params}
    return eqx.tree_at(lambda e: (e.q0, e.qdot0, e.params), e, (own.get("q0", e.q0), own.get("qdot0", e.qdot0), params))


def _members(whole, experiments):
    """For each experiment its pieces, and how many samples are each one's own."""
    samples = whole.samples or [e.ts.size for e in experiments]
    of_each = list(enumerate(zip(whole.of, samples, strict=True)))
    return [[(j, n) for j, (of, n) in of_each if of == i] for i in range(len(experiments))]


def _whole(problem, rows, experiments, whole, covariance):
    """Residuals, predictions and their standard errors over σ̂ of each experiment, its pieces put together."""
    residuals, predictions, spreads = [], [], []
    together = lambda parts: jax.tree.map(lambda *pieces: np.concatenate(pieces), *parts)
    for e, of_one in zip(experiments, _members(whole, experiments), strict=True):
        seen, spread = [], []
        for j, n in of_one:
            k, row = _place(problem, j)
            cut = lambda tree, n=n: jax.tree.map(lambda x: x[:n], tree)
            seen.append(cut(jax.tree.map(lambda x, row=row: np.asarray(x)[row], rows.of_stacks[k].channels)))
            spread.append(cut(_spread(problem, rows, k, row, covariance)))
        predictions.append(together(seen))
        spreads.append(together(spread))
        residuals.append(jax.tree.map(lambda z, p: np.asarray(z) - p, e.values, predictions[-1]))
    return residuals, predictions, spreads


def _spread(problem, rows, k, row, covariance):
    """√(J cov Jᵀ) of what the sensors of one experiment should see; NaN where nothing was measured, for there J is not at hand."""
    stack, part, loss = problem.stacks[k], rows.of_stacks[k], problem.model.loss
    values, sigma, seen = (jax.tree.map(lambda x: np.asarray(x)[row], tree) for tree in (stack.values, stack.sigma, part.channels))
    if part.jacobian is None:
        return jax.tree.map(lambda z: np.full(z.shape, np.nan), values)
    flat = lambda tree: np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])
    columns = np.r_[0 : problem.free.size, problem.own_columns(k, np.array([row]))[0]]
    J = np.asarray(part.jacobian)[row] * flat(sigma)[:, None]
    if loss is not None:
        weighted = np.nan_to_num((flat(values) - flat(seen)) / flat(sigma))
        J = J / np.asarray(loss.slope(weighted / problem.scale))[:, None]
    spread = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", J, covariance[np.ix_(columns, columns)], J), 0))
    there = np.where(np.isfinite(flat(values)), spread, np.nan)
    leaves, structure = jax.tree.flatten(values)
    parts = np.split(there, np.cumsum([leaf.size for leaf in leaves])[:-1])
    return jax.tree.unflatten(structure, [part.reshape(leaf.shape) for part, leaf in zip(parts, leaves, strict=True)])
