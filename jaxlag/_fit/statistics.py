"""From the minimum of a problem to a `Fit`: one step for each group of its fields.

A new statistic on the card is a field of `Fit` (result.py), a line in a step here, and a line of the card (fit_card.py).
"""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from .arrow import transposed
from .autocorrelation import independent_samples
from .channels import channels_of
from .experiment import Experiment
from .experiment_statistics import deciding, ended_inputs, own_estimates, predictions_of, with_estimates
from .identifiability import correlation_of
from .levenberg_marquardt import CONVERGED, INTERRUPTED, KINKED, REASONS, STALLED, STEP_LIMIT, UNRELATED, Outcome
from .linear_test_statistics import channels_of_test, doubts, predicted_tests
from .measurement import in_given_order
from .minimum import Minimum
from .multiple_shooting import Segments
from .noise import freedom_of_channels, neg2_log_likelihood, noise_free, too_short
from .parameter_stability import different_halves
from .problem import LeastSquaresProblem
from .remarks import (
    NO_ERRORS,
    PARTNERS,
    UNEXPLAINED,
    UNRELATED_SIZE,
    doubt_of,
    on_bounds,
    on_exact,
    on_halves,
    on_inputs,
    on_misfit,
    on_no_freedom,
    on_too_short,
)
from .result import Fit
from .uncertainty import Uncertainty, uncertainty_of, undetermined_parameters
from .undetermined import on_undetermined

Fields = dict[str, Any]  # of a Fit, by name


def report(problem: LeastSquaresProblem, experiments: Sequence[Any], outcome: Outcome, segments: Segments) -> Fit:
    """The fit that the outcome of an iteration means."""
    minimum = Minimum.of(problem, experiments, outcome, segments)
    uncertainty = uncertainty_of(minimum)
    noise = _noise(minimum, uncertainty)
    scale = 1.0 if minimum.absolute and problem.model.loss is None else noise["sigma"]
    predictions = _predictions(minimum, uncertainty, scale)
    parameters = _parameters(minimum, uncertainty, scale)
    unknowns = noise["noise_free_count"] + noise["unknown_count"]
    is_noise = minimum.absolute and noise["sigma"] <= UNEXPLAINED
    doubt = doubt_of(parameters, minimum.theta, minimum.problem.free.start, predictions["channels"], is_noise)
    return Fit(
        problem=problem,
        x=minimum.x,
        **noise,
        **parameters,
        **_unknowns(minimum, uncertainty, scale),
        **predictions,
        **_end(minimum, doubt),
        remarks=[*_on_sigma(minimum), *_remarks(minimum, uncertainty, scale, noise["sigma"], predictions["channels"], unknowns)],
    )


def _noise(minimum: Minimum, uncertainty: Uncertainty) -> Fields:
    """How many measurements and unknowns there are, and how large the residuals are."""
    r, beside = np.append(minimum.measured, minimum.of_tests), minimum.problem.first_recorded
    unknown_count = minimum.x.size - uncertainty.known.null.shape[1] - len(np.asarray(minimum.found.gaps_jacobian))
    squares = np.sum(np.asarray(minimum.found.residuals)[: beside + minimum.flat.size] ** 2)
    exact = 0 if minimum.absolute else sum(noise_free(minimum.channels, minimum.residuals).values())
    sigma = _sigma(r, minimum.problem, max(minimum.measurements - exact - unknown_count, 0))
    priors = float(np.sum(np.asarray(minimum.found.residuals)[: minimum.size] ** 2))
    return {
        "noise_free_count": exact,
        "measurements": minimum.measurements,
        "unknown_count": unknown_count,
        "absolute": minimum.absolute,
        "sigma": sigma,
        "sigmas": _sigmas(minimum, sigma),
        "cost": float(squares / 2),
        **_likelihood(minimum, float(squares) - priors),
    }


def _likelihood(minimum, squares):
    """−2 ln L of the data, from the sum of squares of residuals over sigma; degrees of freedom where channels have sigmas of their own."""
    if minimum.absolute:
        return {"neg2_log_likelihood": squares}
    if minimum.problem.model.loss is not None or minimum.channels.is_one or minimum.found.jacobian is None:
        return {"neg2_log_likelihood": minimum.measurements * float(np.log(squares / minimum.measurements))}
    freedom = freedom_of_channels(minimum.problem, minimum.channels, minimum.found)
    return {"neg2_log_likelihood": neg2_log_likelihood(minimum.channels, minimum.residuals), "freedom_of_channels": freedom}


def _sigma(r, problem, freedom):
    """σ̂ in units of the given sigma; with a robust loss by Huber's formula."""
    if freedom == 0:
        return np.nan
    loss = problem.model.loss
    if loss is None:
        return float(np.sqrt(r @ r / freedom))
    s = float(problem.scale)
    influence = np.asarray(loss.influence(r / s))
    return float(s * np.sqrt(influence @ influence / freedom) / np.mean(np.abs(r / s) <= loss.delta))


def _sigmas(minimum, sigma):
    """For each experiment the sigma of each channel, estimated or given."""
    if minimum.absolute:
        mean = lambda z, s: np.sqrt(np.nanmean(np.where(np.isfinite(z), np.asarray(s) ** 2, np.nan), axis=0))
        return [jax.tree.map(mean, e.values, e.sigma) for e in minimum.experiments]
    firsts = [segments[0] for segments in minimum.segments_of_each]
    return [jax.tree.map(lambda s, row=row: sigma * np.asarray(s)[row, 0], minimum.problem.batches[k].sigma) for k, row, _ in firsts]


def _parameters(minimum: Minimum, uncertainty: Uncertainty, scale: float) -> Fields:
    """Estimates of the free parameters, and their errors."""
    free, p, known = minimum.problem.free, minimum.size, uncertainty.known
    covariance = _covariance(minimum, known, scale)
    covariance[np.diag_indices(p)] = np.where(known.determined[:p], np.diag(covariance), np.inf)
    theta = minimum.theta
    return {
        "names": free.entries,
        "params": free.insert(theta),
        "estimates": free.by_name(theta),
        "standard_errors": free.by_name(np.sqrt(np.diag(covariance))),
        "covariance": covariance,
        "correlation": correlation_of(covariance),
        "known": known,
        "inflation": uncertainty.inflation,
        "correlation_length": uncertainty.correlation_length,
    }


def _covariance(minimum, known, scale):
    """Of the parameters, among the directions that are determined."""
    p = minimum.size
    return known.covariance[:p, :p] * np.outer(minimum.slope, minimum.slope) * scale**2


def _unknowns(minimum: Minimum, uncertainty: Uncertainty, scale: float) -> Fields:
    """Estimates of the experiments' own unknowns, and their errors."""
    of_tests: list[tuple[dict[str, Any], dict[str, Any]]] = [({}, {}) for _ in minimum.problem.tests]
    own = in_given_order(minimum.experiments, own_estimates(minimum, uncertainty.known, scale), of_tests)
    return {
        "experiments": tuple(with_estimates(e, estimates) for e, (estimates, _) in zip(minimum.experiments, own, strict=True)),
        "unknowns": [estimates for estimates, _ in own],
        "unknown_errors": [errors for _, errors in own],
    }


def _predictions(minimum: Minimum, uncertainty: Uncertainty, scale: float) -> Fields:
    """What each experiment should have shown, and how well each channel is predicted."""
    known = uncertainty.known
    found = in_given_order(minimum.experiments, predictions_of(minimum, known), predicted_tests(minimum, known))
    nears = iter(part.near for part in minimum.problem.tests)
    of_each = lambda k, e, one: (
        channels_of(k, e.values, one.residuals) if isinstance(e, Experiment) else channels_of_test(k, e, next(nears), one.residuals)
    )
    return {
        "predictions": [one.predictions for one in found],
        "residuals": [one.residuals for one in found],
        "prediction_errors": [jax.tree.map(lambda deviation: scale * deviation, one.deviations) for one in found],
        "channels": [row for k, (e, one) in enumerate(zip(minimum.experiments, found, strict=True)) for row in of_each(k, e, one)],
    }


def _remarks(minimum, uncertainty, scale, sigma, channels, unknowns):
    """What the reader of the card should know."""
    free, p = minimum.problem.free, minimum.size
    remarks, at_bounds = [], []
    if uncertainty.jacobian is None:
        remarks = [NO_ERRORS]
    else:
        remarks = _on_parameters(minimum, uncertainty, scale)
        r = np.nan_to_num(np.asarray(minimum.found.residuals), posinf=0.0)  # of a motion that could not be computed
        at_bounds = list(on_bounds(free, minimum.theta, np.asarray(transposed(minimum.found.jacobian, r))[:p]))
    times_noise = sigma if minimum.absolute else 1.0
    independent = independent_samples(minimum.measurements, uncertainty.correlation_length)
    unfinished = int(minimum.outcome.best.status) in (STEP_LIMIT, INTERRUPTED)  # halves are compared at a minimum
    different = None if unfinished else different_halves(minimum, uncertainty)
    halves = on_halves(free.entries, different, len(minimum.recordings))
    misfit = on_misfit(minimum.relative_size, times_noise, independent, halves, channels, bool(at_bounds), bool(minimum.recordings))
    return [
        *remarks,
        *on_no_freedom(minimum.measurements, unknowns),
        *at_bounds,
        *doubts(minimum),
        *on_inputs(ended_inputs(minimum.recordings, free.params)),
        *misfit,
    ]


def _on_parameters(minimum, uncertainty, scale):
    """What is not determined, and the estimates of the combinations that are."""
    found = undetermined_parameters(minimum, uncertainty)
    if found is None:
        return []
    covariance = _covariance(minimum, uncertainty.known, scale)
    estimates = [combination.estimate(minimum.theta, covariance) for combination in found.combinations]
    return on_undetermined(minimum.problem.free.entries, found, estimates, deciding(minimum) if found.idle else {})


def _on_sigma(minimum):
    if minimum.absolute:
        return []
    exact = noise_free(minimum.channels, minimum.residuals)
    return [*on_too_short(too_short(minimum.problem, minimum.channels)), *on_exact(exact)]


def _end(minimum: Minimum, doubt: str) -> Fields:
    """How the iteration ended; where it did at what is hardly a fit, the `doubt` is the reason."""
    outcome = minimum.outcome
    status = int(outcome.best.status)
    if status in (CONVERGED, STEP_LIMIT) and minimum.relative_size > UNRELATED_SIZE:
        status = UNRELATED
    reason = (
        doubt
        if status in (CONVERGED, STALLED, KINKED) and doubt
        else PARTNERS
        if status == KINKED and not minimum.recordings
        else REASONS[status]
    )
    return {"converged": status == CONVERGED and not doubt, "reason": reason, "steps": outcome.steps, "costs": outcome.costs}
