"""What tests of modes and frequency responses should have shown at the minimum, with errors, and how well they are predicted."""

import jax
import numpy as np
from jaxtyping import PyTree

from .._linear.linear_system import LinearSystem
from .channels import Channel, channel
from .experiment import Experiment
from .experiment_statistics import Predicted
from .linear_test import LinearTest, deviations, linear_at
from .minimum import Minimum


def predicted_tests(minimum: Minimum, covariance: np.ndarray) -> list[Predicted]:
    """For each test what is left of it, its predictions, and their standard errors over σ̂."""
    p, pairs = minimum.size, zip(minimum.problem.tests, minimum.found.tests, strict=True)
    return [_predicted(part.test, found, covariance[:p, :p]) for part, found in pairs]


def _predicted(test, found, covariance):
    predictions = jax.tree.map(np.asarray, found.predictions)
    return Predicted(jax.tree.map(np.subtract, test.values, predictions), predictions, deviations(test, found, covariance))


def channels_of_test(number: int, test: LinearTest, near: LinearSystem, residuals: PyTree) -> list[Channel]:
    """How well each kind of number is predicted."""
    columns = lambda tree: np.concatenate([np.reshape(x, (len(x), -1)) for x in jax.tree.leaves(tree)], axis=1).T
    triples = zip(test.labels(near), columns(test.values), columns(residuals), strict=True)
    return [channel(number, *one, in_time=False) for one in triples]


def doubts(minimum: Minimum) -> list[str]:
    """What is in doubt about the tests among the experiments."""
    numbers = [i for i, e in enumerate(minimum.experiments) if not isinstance(e, Experiment)]
    params = minimum.problem.free.insert(minimum.theta)
    pairs = zip(numbers, minimum.problem.tests, strict=True)
    return [f"of experiment {i}, {doubt}" for i, part in pairs for doubt in _doubts(part, minimum.problem.model.system, params)]


def _doubts(part, system, params):
    near = linear_at(part, system, params)
    return part.test.doubts(near) if np.all(np.isfinite(np.asarray(near.A))) else []
