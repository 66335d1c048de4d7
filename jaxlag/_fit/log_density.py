"""The logarithm of the posterior density of parameters, as a function that samplers take."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._model.system import System
from .._motion.results import RESULTS
from .experiment import Experiment
from .fit import absolute, checked_problem, fit
from .measurement import Test
from .noise import Channels
from .parameters import Free
from .posterior import Posterior, sampled
from .problem import LeastSquaresProblem, linearise
from .residuals import linearise_batch, predict_batch

STEP = 0.1  # of a deviation, over which slopes are compared
LEAST = 1e-3  # curvature, in units of Fisher's information
NEAR_BOUND = 1e-3  # of the width between two bounds, by which a start is off them at least


class Unbounded(NamedTuple):
    """Parameters θ as a function of numbers w without bounds, which are zero at the start."""

    start: Any  # all arrays (p,)
    scale: Any
    lower: Any
    upper: Any

    @classmethod
    def of(cls, free: Free, theta: Any) -> "Unbounded":
        """Near θ, which is moved off its bounds a little."""
        lower, upper = np.asarray(free.lower), np.asarray(free.upper)
        scale = np.where(theta == 0, 1, np.abs(theta))
        both = np.isfinite(lower) & np.isfinite(upper)
        little = NEAR_BOUND * np.where(both, upper - lower, scale)
        start = np.clip(theta, lower + little, upper - little)
        return cls(start, scale, lower, upper)

    def theta(self, w: Array) -> tuple[Array, Array]:
        """θ, and Σ log |dθ/dw|."""
        below, above = jnp.isfinite(self.lower), jnp.isfinite(self.upper)
        both, one = below & above, below ^ above
        a, b = jnp.where(below, self.lower, 0), jnp.where(above, self.upper, 0)
        bound = jnp.where(below, a, b)
        away = jnp.where(one, self.start - bound, 1) * jnp.exp(jnp.where(one, w, 0))
        share = (self.start - a) / jnp.where(both, b - a, 1)
        share = jnp.where(both, share, 0.5)
        logit = jnp.log(share) - jnp.log1p(-share) + jnp.where(both, w, 0)
        inside = a + (b - a) * jax.nn.sigmoid(logit)
        theta = jnp.where(both, inside, jnp.where(one, bound + away, self.start + self.scale * w))
        of_both = jnp.log(jnp.where(both, b - a, 1)) + jax.nn.log_sigmoid(logit) + jax.nn.log_sigmoid(-logit)
        slopes = jnp.where(both, of_both, jnp.where(one, jnp.log(jnp.abs(away)), jnp.log(self.scale)))
        return theta, jnp.sum(slopes)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Places:
    """What one channel of the recordings has measured, batch by batch and in order: where it stands among the flat values of these
    `batches`; the time since the one before, infinite for the first of a recording; and sigma, one where it is unknown.
    """

    batches: tuple[int, ...] = dataclasses.field(metadata={"static": True})
    places: tuple[Any, ...]
    measured: Any
    since: Any
    sigma: Any

    def of(self, flat: Sequence[Any]) -> list[Any]:
        """Its numbers among all, for each batch."""
        return [flat[k][at] for k, at in zip(self.batches, self.places, strict=True)]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class LogDensity:
    r"""θ ↦ log p(θ | z) up to a constant, over numbers without bounds, as `log_density` returns it: what blackjax, numpyro and nutpie take.

    - `density(u)`: a number; −∞, and never NaN, where there is no motion. Differentiable; `jit` and `vmap` as any function of JAX.
    - `names`: of the n entries of u: parameters, unknown numbers of experiments, and where noise is unknown `log sigma` of each channel,
      and `log tau`.
    - `start`: where it is largest. `metric`: its curvature there, (n, n), the inverse of a covariance.
    - `to_params(u)`: all parameters. `problem`, `unbounded`, `channels`: what is fitted, the parameters as functions of u, and what each
      channel has measured; `unknown_noise`, `coloured`: whether sigma and τ are among u.

    ```python
    import jax, jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    density = jl.log_density(oscillator, jl.Experiment(ts, jnp.cos(2.0 * ts), 1.0, 0.0, sigma=0.1), {"c": 3.0}, free=("c",))
    jax.value_and_grad(density)(density.start)
    ```
    """

    problem: LeastSquaresProblem
    unbounded: Unbounded
    channels: tuple[Places, ...]
    start: Float[Array | np.ndarray, " n"]
    metric: Float[Array | np.ndarray, "n n"]
    names: tuple[str, ...] = dataclasses.field(metadata={"static": True})
    unknown_noise: bool = dataclasses.field(metadata={"static": True})
    coloured: bool = dataclasses.field(metadata={"static": True})

    def __call__(self, u: Any) -> Array:
        """log p."""
        w, z, log_sigma, log_tau = self._split(jnp.asarray(u))
        theta, volume = self.unbounded.theta(w)
        free = self.problem.free
        x = jnp.concatenate([(theta - free.start) / free.scale, z])
        *flat, fine = _predicted(self.problem, x)
        total = volume - jnp.sum(free.prior_residual(x[: free.size]) ** 2) / 2
        for test in self.problem.tests:  # of modes and responses
            total = total - jnp.sum(test.evaluated(self.problem.model.system, free.insert(theta))[0] ** 2) / 2
        for i, of in enumerate(self.channels):
            seen = jnp.concatenate(of.of(flat))
            r = (of.measured - jnp.where(fine, seen, of.measured)) / of.sigma
            follows = jnp.isfinite(of.since)
            decay = jnp.where(follows, jnp.exp(-jnp.where(follows, of.since, 0) / jnp.exp(log_tau[i])), 0) if self.coloured else 0.0
            total = total + _normal(r, log_sigma[i], decay) - jnp.sum(jnp.log(of.sigma))
        return jnp.where(fine & jnp.isfinite(total), total, -jnp.inf)

    def to_params(self, u: Any) -> PyTree:
        """All parameters.

        **Arguments:** `u`, as of the density. **Returns:** a tree structured like `params`.
        """
        theta, _ = self.unbounded.theta(self._split(jnp.asarray(u))[0])
        return self.problem.free.insert(theta)

    def sample(self, key: Array, draws: int = 1000, *, chains: int = 4, warmup: int = 500) -> Posterior:
        r"""Draws from the posterior by the No-U-Turn sampler of blackjax (extra `bayes`), in coordinates in which `metric` is one.

        **Arguments:** `key`, a `jax.random.key`; `draws` of each of the `chains`, after `warmup` steps that find the length of a step.

        **Returns:** a `Posterior`.

        **Raises:** `ImportError` without blackjax.

        **Source:** Hoffman & Gelman, J. Machine Learning Research 15 (2014) 1593-1623.
        """
        return sampled(self, key, draws, chains, warmup)

    def _split(self, u: Array) -> tuple[Array, Array, Array, Array]:
        p, count = self.problem.free.size, len(self.channels)
        ends = np.cumsum([p, self.problem.size - p, count * self.unknown_noise])
        w, z, log_sigma, log_tau = jnp.split(u, ends)
        return w, z, log_sigma if self.unknown_noise else jnp.zeros(count, u.dtype), log_tau

    def __repr__(self) -> str:
        return f"LogDensity of {', '.join(self.names)}"


def log_density(
    system: System,
    experiments: Experiment | Test | Sequence[Experiment | Test],
    params: PyTree,
    *,
    free: str | Sequence[str],
    bounds: Mapping[str, Any] | None = None,
    priors: Mapping[str, Any] | None = None,
    coloured: bool = False,
    **numerics: Any,
) -> LogDensity:
    r"""What is believed of parameters after a measurement, as a function for samplers.

    $$ \log p(\theta \mid z) = -\sum_i \Big(\tfrac12 \frac{(z_i - h_i(\theta))^2}{\sigma^2} + \log\sigma\Big)
       - \sum_j \tfrac12 \frac{(\theta_j - m_j)^2}{\varsigma_j^2} + \text{const}, \qquad a < \theta < b $$

    in numbers u without bounds: θ = a + |θ₀ − a| eᵘ beside one bound, θ₀ + |θ₀| u where there is none, and the logistic function between
    two; the density is that of u. Where sigma is not given, that of each channel is unknown, with a prior 1/σ. With `coloured`, noise of a
    channel is correlated as e^(−Δt/τ), and log τ is unknown, too: an Ornstein-Uhlenbeck process, which takes any times.

    **Arguments:** as for `fit`, which finds the start; priors are flat within `bounds` where `priors` give no (mean, standard deviation).
    Unknown numbers of experiments are among u: a start on constraints moves along them. `coloured`: whether noise is correlated in time.
    `**numerics`: passed on to `simulate`. Any consistent units.

    **Returns:** a `LogDensity`; `density.sample(key)` draws from it.

    **Raises:** as `fit`.

    **Source:** Gelman et al., Bayesian Data Analysis, 3rd ed., sections 2.8, 3.2 and 12.4; Gardiner, Handbook of Stochastic Methods,
    section 4.4.4.

    ```python
    import jax, jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    record = jl.Experiment(ts, jnp.cos(2.0 * ts), 1.0, 0.0, sigma=0.1)
    density = jl.log_density(oscillator, record, {"c": 3.0}, free=("c",), priors={"c": (3.5, 1.0)})
    density(density.start + 0.01)
    ```
    """
    found = fit(system, experiments, params, free=free, bounds=bounds, priors=priors, **numerics)
    problem, _ = checked_problem(system, found.experiments, found.params, free, bounds, priors, None, True, numerics)
    free_now = problem.free
    unbounded = Unbounded.of(free_now, np.asarray(free_now.start))
    known = absolute(found.experiments)
    by_name = Channels.of(problem)
    channels = tuple(_places(problem, by_name, name, known) for name in by_name.places)
    w, z = np.zeros(free_now.size), np.zeros(problem.size - free_now.size)
    x = np.concatenate([(unbounded.start - np.asarray(free_now.start)) / np.asarray(free_now.scale), z])
    flat = [np.asarray(part) for part in _predicted(problem, jnp.asarray(x))[:-1]]
    spread, tau = _noise(channels, flat)
    noise = [*([] if known else np.log(spread)), *(np.log(tau) if coloured else [])]
    start = np.concatenate([w, z, noise])
    names = [*free_now.entries, *(f"unknown {i}" for i in range(z.size))]
    of_noise = [*([] if known else ["log sigma"]), *(["log tau"] if coloured else [])]
    names += [f"{kind} of {name}" if len(channels) > 1 else kind for kind in of_noise for name in by_name.places]
    density = LogDensity(problem, unbounded, channels, start, np.eye(start.size), tuple(names), not known, coloured)
    return _at_its_top(dataclasses.replace(density, metric=_information(density, x, spread if not known else np.ones(len(channels)))))


def _at_its_top(density: LogDensity) -> LogDensity:
    """With the start where the density is largest, and its curvature there as the metric, by differences over a tenth of a deviation."""
    from scipy import optimize  # SciPy is a dependency of JAX; imported here because that takes a while

    root = jnp.asarray(_root(density.metric))
    value_and_slope = jax.jit(jax.value_and_grad(lambda v, density, root: -density(density.start + root @ v)))

    def at(v):
        value, slope = value_and_slope(jnp.asarray(v), density, root)
        return (float(value), np.asarray(slope)) if np.isfinite(value) else (np.inf, np.zeros(v.size))

    n = len(density.start)
    top = optimize.minimize(at, np.zeros(n), jac=True, method="L-BFGS-B", options={"maxiter": 100}).x
    curvature = np.stack([(at(top + h)[1] - at(top - h)[1]) / (2 * STEP) for h in STEP * np.eye(n)])
    values, vectors = np.linalg.eigh((curvature + curvature.T) / 2)
    values = np.clip(np.where(np.isfinite(values), values, 1), LEAST, 1 / LEAST)
    inverse = np.linalg.inv(np.asarray(root))
    metric = inverse.T @ (vectors * values) @ vectors.T @ inverse
    return dataclasses.replace(density, start=np.asarray(density.start + np.asarray(root) @ top), metric=metric)


def _root(metric: Any) -> np.ndarray:
    """R with R Rᵀ = metric⁻¹."""
    return np.linalg.inv(np.linalg.cholesky(np.asarray(metric))).T


def _normal(r: Array, log_sigma: Array, decay: Any) -> Array:
    """log p of residuals of this deviation, each of which follows the one before by a factor."""
    before = jnp.concatenate([jnp.zeros(1, r.dtype), r[:-1]])
    rest = jnp.sqrt(jnp.maximum(1 - jnp.asarray(decay) ** 2, jnp.finfo(r.dtype).eps))
    new = (r - decay * before) / rest
    return -jnp.sum(new**2) / 2 * jnp.exp(-2 * log_sigma) - r.size * log_sigma - jnp.sum(jnp.log(rest) + jnp.zeros_like(r))


def _places(problem: LeastSquaresProblem, channels: Channels, name: str, known: bool) -> Places:
    """Of the recordings, one after the other."""
    batches, places, measured, since, sigma = [], [], [], [], []
    for k, at in channels.places[name]:
        of = problem.batches[k]
        rows = at // of.flat(of.values).shape[1]
        times = _times(of, at)
        gaps = np.diff(times, prepend=-np.inf)
        gaps[np.flatnonzero(np.diff(rows, prepend=-1))] = np.inf
        batches.append(k)
        places.append(at)
        measured.append(np.asarray(of.flat(of.values)).ravel()[at])
        sigma.append(np.asarray(of.flat(of.sigma)).ravel()[at] if known else np.ones(at.size))
        since.append(gaps)
    return Places(tuple(batches), tuple(places), *(np.concatenate(x) for x in (measured, since, sigma)))


def _times(of: Any, at: np.ndarray) -> np.ndarray:
    """Of some of the flat values of a batch, when they were measured."""
    ts = np.asarray(of.ts)[: len(of.members)]
    leaves = jax.tree.leaves(of.values)
    flat = [np.repeat(ts, int(np.prod(leaf.shape[2:])), axis=1) if leaf.shape[1] == ts.shape[1] else np.asarray(leaf) for leaf in leaves]
    return np.concatenate([part.reshape(len(ts), -1) for part in flat], axis=1).ravel()[at]


def _noise(channels: tuple[Places, ...], flat: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Of each channel the deviation of its residuals, over sigma, and the time over which they are alike, one sample at least."""
    sizes, times = [], []
    for of in channels:
        seen = np.concatenate(of.of(flat))
        r = (of.measured - seen) / of.sigma
        after = np.isfinite(of.since[1:])
        alike = np.sum((r[1:] * r[:-1])[after]) / max(np.sum(r[:-1][after] ** 2), np.finfo(float).tiny)
        step = np.median(of.since[np.isfinite(of.since)]) if np.any(np.isfinite(of.since)) else 1.0
        sizes.append(np.sqrt(np.mean(r**2)) or 1.0)
        times.append(-step / np.log(np.clip(alike, 0.05, 0.99)))
    return np.array(sizes), np.array(times)


def _information(density: LogDensity, x: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Fisher's at the start, with 2 N of the logarithm of a sigma, and as much of that of a time."""
    problem = density.problem
    p, size = problem.free.size, len(density.start)
    metric = np.zeros((size, size))
    slopes = np.asarray(jax.jacfwd(lambda w: density.unbounded.theta(w)[0])(jnp.zeros(p))).diagonal() / np.asarray(problem.free.scale)
    for of, s in zip(density.channels, spread, strict=True):
        J = np.asarray(_jacobian(problem, jnp.asarray(x), of)) / (s * of.sigma)[:, None]
        J[:, :p] *= slopes
        metric[: problem.size, : problem.size] += J.T @ J
    residual = slopes * np.asarray(problem.free.scale / problem.free.prior_deviation)
    metric[:p, :p] += np.diag(residual**2)
    for test in linearise(problem, jnp.asarray(x)).tests:
        J = np.asarray(test.jacobian)[:, :p] * slopes
        metric[:p, :p] += J.T @ J
    counts = np.array([of.measured.size for of in density.channels])
    of_noise = np.tile(2.0 * counts, density.unknown_noise + density.coloured)
    metric[problem.size :, problem.size :] = np.diag(of_noise)
    scale = 1 / np.sqrt(np.where(np.diag(metric) > 0, np.diag(metric), 1))
    values, vectors = np.linalg.eigh(metric * np.outer(scale, scale))
    known = vectors * np.maximum(values, 1e-8)  # what nothing tells of
    return (known @ vectors.T) / np.outer(scale, scale)


@jax.custom_jvp
def _predicted(problem: LeastSquaresProblem, x: Array) -> tuple[Array, ...]:
    """What is predicted of all that was measured, flat for each batch; and last whether there are motions."""
    y, zs = problem.split(x)
    parts = [predict_batch(problem.model, problem.free, batch, y, z) for batch, z in zip(problem.batches, zs, strict=True)]
    return _flat(problem, parts)


def _flat(problem: LeastSquaresProblem, parts: Sequence[Any]) -> tuple[Array, ...]:
    fine = [jnp.all(part.result == RESULTS.successful) for part in parts]
    flat = []
    for batch, part in zip(problem.batches, parts, strict=True):
        leaves = [leaf.reshape(len(batch.members), -1) for leaf in jax.tree.leaves(part.channels)]
        flat.append(jnp.ravel(jnp.concatenate(leaves, axis=1)))
    return (*flat, jnp.all(jnp.stack([*fine, jnp.array(True)])))


@_predicted.defjvp
def _predicted_rule(primals: Any, tangents: Any) -> Any:
    (problem, x), (_, dx) = primals, tangents
    (y, zs), (dy, dzs) = problem.split(x), problem.split(dx)
    parts = [linearise_batch(problem.model, problem.free, batch, y, z) for batch, z in zip(problem.batches, zs, strict=True)]
    found, changes = _flat(problem, parts), []
    for part, dz in zip(parts, dzs, strict=True):
        J = jnp.where(jnp.isfinite(part.channels_jacobian), part.channels_jacobian, 0)
        dx_of_each = jnp.concatenate([jnp.broadcast_to(dy[None], (len(dz), dy.size)), dz], axis=1)
        changes.append(jnp.ravel(jnp.einsum("enx,ex->en", J, dx_of_each)))
    return found, (*changes, np.zeros((), jax.dtypes.float0))


def _jacobian(problem: LeastSquaresProblem, x: Array, of: Places) -> Array:
    """Of what a channel measured, by x."""
    return jnp.concatenate(of.of(jax.jacfwd(lambda x: _predicted(problem, x)[:-1])(x)))
