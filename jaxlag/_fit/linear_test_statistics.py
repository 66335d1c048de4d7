"""What tests of modes and frequency responses should have shown at the minimum, with errors, and how well they are predicted."""

import jax
import numpy as np
from jaxtyping import PyTree

from .._linear.linear_system import LinearSystem
from .channels import Channel, channel
from .experiment import Experiment
from .experiment_statistics import Predicted
from .frequency_response_test import FrequencyResponseTest
from .identifiability import Determined
from .linear_test import LinearTest, linear_at
from .measurement import Test, deviations
from .minimum import Minimum

UNDAMPED = 1e-6  # damping ratio that counts as none


def predicted_tests(minimum: Minimum, known: Determined) -> list[Predicted]:
    """For each test what is left of it, its predictions, and their standard errors over σ̂."""
    return [_predicted(part.test, found, known) for part, found in zip(minimum.problem.tests, minimum.found.tests, strict=True)]


def _predicted(test, found, known):
    predictions = jax.tree.map(np.asarray, found.predictions)
    return Predicted(jax.tree.map(np.subtract, test.values, predictions), predictions, deviations(test, found, known))


def channels_of_test(number: int, test: Test, near: LinearSystem | None, residuals: PyTree) -> list[Channel]:
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
    if not isinstance(part.test, LinearTest):
        return part.test.doubts(None)
    near = linear_at(part, system, params)
    if not np.all(np.isfinite(np.asarray(near.A))):
        return []
    excited = isinstance(part.test, FrequencyResponseTest) and not _is_damped(near)  # as by conjugates: the start tells
    return part.test.doubts(near) or (part.test.doubts(part.near) if excited else [])


def _is_damped(near):
    """Whether all modes that oscillate die away."""
    values = np.asarray(near.eigenvalues)
    return bool(np.all((values.real < -UNDAMPED * np.abs(values))[values.imag > 0]))
