"""Measurements of any kind, and how a fit predicts them."""

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._model.injection import call, check_function
from .._model.numbers import numbers
from .._model.system import System
from .channels import channel_names
from .experiment import Experiment, with_own
from .identifiability import Determined
from .parameters import Free


class Test(eqx.Module):
    """What was measured, by whatever means: `values`, real or complex, and `sigma` of each, of complex ones that of either part."""

    values: PyTree
    sigma: PyTree
    params: dict[str, Any]

    @property
    def measurements(self) -> int:
        """How many real numbers were measured."""
        return sum(int(np.sum(np.isfinite(z))) * (2 if np.iscomplexobj(z) else 1) for z in jax.tree.leaves(self.values))

    @abc.abstractmethod
    def prepared(self, system: System, params: PyTree) -> "Prepared":
        """What a fit keeps of it, at the start `params`."""

    def labels(self, near: Any) -> list[str]:
        """A name for each channel, for what belongs together of `values`; `near`: of a linear test, its linear system."""
        return channel_names(self.values)

    def is_singular(self, near: Any) -> bool:
        """Whether predictions have no derivatives at the linear system `near`; of no other test."""
        return False

    def doubts(self, near: Any) -> list[str]:
        """What is in doubt about how measured and predicted values belong together; `near`: of a linear test, its linear system."""
        return []


class Measurement(Test):
    r"""Numbers that were measured and that a function of the parameters predicts: a weight, a deflection, a period, a cost.

    $$ z_i = h_i(\theta) + \sigma_i e_i, \qquad e_i \text{ independent, of variance 1} $$

    Fitted alone, or together with recordings and tests, whose weighted squares are added.

    **Arguments:**

    - `values`: the measurements z, a number, (k,), or a pytree of these, e.g. `{"weight": 19.6, "deflection": [0.010, 0.021]}`. NaN is a
      missing one.
    - `predict`: the function h, which returns what `values` holds. It receives the arguments it names, out of `params` and the entries of
      `params`, and may call `equilibrium`, `simulate` or any function that JAX can differentiate.
    - `sigma`: σ, a number, or structured like `values`.
    - `params`: parameters of this measurement only, which override those of the fit.

    Any consistent units.

    **Raises:** `ValueError` or `TypeError` if `values` are no numbers, `sigma` does not fit them, or `predict` is no function.

    **Source:** Seber & Wild, Nonlinear Regression (1989), section 2.1.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    swing = jl.Experiment(ts, jnp.cos(2.0 * ts), q0=1.0, qdot0=0.0, sigma=1e-3)  # tells c/m alone
    hung = jl.Measurement({"deflection": [0.5, 1.0]}, lambda c: {"deflection": jnp.array([4.0, 8.0]) / c}, sigma=0.01)  # by 4 and 8 N
    found = jl.fit(oscillator, [swing, hung], {"m": 1.5, "c": 6.0}, free=("m", "c"))
    found.estimates["m"], found.estimates["c"]  # 2.0, 8.0
    ```
    """

    predict: Callable = eqx.field(static=True)

    def __init__(self, values: PyTree, predict: Callable, *, sigma: Any, params: Mapping[str, Any] | None = None):
        self.values = jax.tree.map(lambda z: _column(z, "`values`"), values, is_leaf=_is_list)
        check_function(predict, "`predict`")
        self.predict = predict
        of_each = lambda s, part: jax.tree.map(lambda z: deviation_of(s, z), part)
        try:
            self.sigma = jax.tree.map(of_each, sigma, self.values, is_leaf=_is_list)
        except ValueError as error:
            raise ValueError(f"`sigma` must be a number or structured like `values`, but is not: {error}. Give one for each.") from None
        self.params = dict(params or {})

    def prepared(self, system: System, params: PyTree) -> "Prepared":
        """What a fit keeps of it, at the start `params`."""
        return Predicted(self, None)


def _is_list(node):
    return isinstance(node, list)


def _column(z, label):
    z = np.atleast_1d(np.asarray(numbers(z, label)))
    if z.ndim != 1 or not z.size or np.any(np.isinf(z)) or np.all(np.isnan(z)):
        raise ValueError(f"{label} must be finite numbers or lists of them, but are not. Give one for each thing that was measured.")
    return z


def deviation_of(s: Any, z: np.ndarray) -> np.ndarray:
    """The standard deviation of each value, given for all or for each."""
    s = np.asarray(numbers(s, "`sigma`"))
    if s.shape not in ((), z.shape) or not np.all((s > 0) & np.isfinite(s)):
        raise ValueError(f"{s} for {z.size} values")
    return np.broadcast_to(s, z.shape).copy()


class Evaluated(NamedTuple):
    """A test at given parameters: (predicted − measured)/sigma in real numbers, 0 where nothing was measured; Jacobian; predictions."""

    residuals: Any
    jacobian: Any
    predictions: PyTree


class Prepared(eqx.Module):
    """A measurement as a fit predicts it; `near`: of a linear test, its linear system at the start."""

    test: Test
    near: Any

    @property
    def size(self) -> int:
        """The number of residuals."""
        return sum(np.size(z) * (2 if np.iscomplexobj(z) else 1) for z in jax.tree.leaves(self.test.values))

    @abc.abstractmethod
    def predictions(self, system: System, params: PyTree) -> PyTree:
        """What should have been measured."""

    def evaluated(self, system: System, params: PyTree) -> tuple[Float[Array, " k"], PyTree]:
        """Residuals, infinite where there is no prediction, and predictions."""
        predictions = self.predictions(system, params)
        weighted = jax.tree.map(_weighted, predictions, self.test.values, self.test.sigma)
        r = jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(weighted)])
        return jnp.where(jnp.all(jnp.isfinite(r)), r, jnp.inf), predictions

    def linearised(self, system: System, free: Free, y: Any) -> Evaluated:
        """With the Jacobian with respect to y of the free parameters."""

        def residuals(y):
            r, predictions = self.evaluated(system, free.insert(free.theta(y)))
            return r, (r, predictions)

        J, (r, predictions) = jax.jacfwd(residuals, has_aux=True)(y)
        finite = jnp.all(jnp.isfinite(r)) & jnp.all(jnp.isfinite(J))
        return Evaluated(jnp.where(finite, r, jnp.inf), jnp.where(finite, J, 0), predictions)


class Predicted(Prepared):
    """What is predicted by a function of the parameters."""

    test: Measurement

    def predictions(self, system: System, params: PyTree) -> PyTree:
        """What should have been measured."""
        found = call(self.test.predict, "`predict`", with_own(params, self.test.params))
        there, expected = str(jax.tree.structure(found)), str(jax.tree.structure(self.test.values))
        found = jax.tree.map(jnp.atleast_1d, found)
        if there != expected or any(x.shape != z.shape for x, z in zip(*map(jax.tree.leaves, (found, self.test.values)), strict=True)):
            raise ValueError(f"`predict` must return what `values` holds, {expected}, but returns {there}, or other lengths. Match both.")
        return found


def _weighted(predicted, measured, sigma):
    there = jnp.isfinite(measured)
    r = jnp.where(there, (predicted - jnp.where(there, measured, 0)) / sigma, 0)
    return parts(r)


def parts(x: Any) -> Any:
    """Real numbers; of complex ones both parts, as a last axis."""
    return jnp.stack([x.real, x.imag], axis=-1) if jnp.iscomplexobj(x) else x


def deviations(test: Test, found: Evaluated, known: Determined) -> PyTree:
    """√(J cov Jᵀ) of the predictions; of complex ones those of both parts, as a complex number. NaN where nothing was measured."""
    if found.jacobian is None:
        return jax.tree.map(lambda z: np.full(z.shape, np.nan), test.values)
    J = np.asarray(found.jacobian)
    rows = known.deviations(J, np.arange(J.shape[1]))
    leaves, structure = jax.tree.flatten(test.values)
    ends = np.cumsum([z.size * (2 if np.iscomplexobj(z) else 1) for z in leaves])
    of_each = zip(np.split(rows, ends[:-1]), leaves, jax.tree.leaves(test.sigma), strict=True)
    return jax.tree.unflatten(structure, [_of_values(*one) for one in of_each])


def _of_values(rows, z, sigma):
    own = rows.reshape((*z.shape, 2)) @ [1, 1j] if np.iscomplexobj(z) else rows
    return np.where(np.isfinite(z), own * sigma, np.nan)


def split_by_kind(experiments: Sequence[Any]) -> tuple[tuple[Experiment, ...], tuple[Test, ...]]:
    """The recordings in time, and the tests."""
    recordings = tuple(e for e in experiments if isinstance(e, Experiment))
    return recordings, tuple(e for e in experiments if not isinstance(e, Experiment))


def in_given_order(experiments: Sequence[Any], of_recordings: Sequence[Any], of_tests: Sequence[Any]) -> list[Any]:
    """What there is of recordings and of tests, in the order of the experiments."""
    recordings, tests = iter(of_recordings), iter(of_tests)
    return [next(recordings if isinstance(e, Experiment) else tests) for e in experiments]
