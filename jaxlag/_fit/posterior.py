"""Draws from a posterior, and what they say of parameters and motions."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._motion.members import of_each
from .._program.jit import compiled
from .experiment import Experiment
from .experiment_batch import map_batch
from .problem import LeastSquaresProblem, with_zero_values
from .result import Interval

Density = Any  # a `LogDensity`, which makes use of what is here
ACCEPTANCE = 0.8  # of the steps, for which their length is found
FEW = 1.01  # R̂, above which chains do not agree


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Posterior:
    r"""Draws of parameters, as `LogDensity.sample` returns them; prints as a table.

    - `names`: of the n numbers: parameters in their units, unknown numbers of experiments, sigma and τ of the noise. `draws`: of each its
      draws, (chains, draws), by name, as arviz takes them: `arviz.from_dict(posterior=posterior.draws)`. `unbounded`: u of all draws.
    - `r_hat`, `effective`: by name Gelman and Rubin's R̂, and the number of independent draws that are worth as much.
    - `divergences`: steps at which the sampler met a place where the density changes too fast for it.

    **Source:** Vehtari et al., Bayesian Analysis 16 (2021) 667-718.

    ```python
    import jax, jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    record = jl.Experiment(ts, jnp.cos(2.0 * ts), 1.0, 0.0, sigma=0.1)
    posterior = jl.log_density(oscillator, record, {"c": 3.0}, free=("c",)).sample(jax.random.key(0), 200, chains=2)
    posterior.interval("c").lower
    ```
    """

    density: Density
    unbounded: Float[np.ndarray, "chains draws n"]
    draws: dict[str, Float[np.ndarray, "chains draws"]]
    r_hat: dict[str, float]
    effective: dict[str, float]
    divergences: int

    @property
    def names(self) -> tuple[str, ...]:
        """Those of the draws."""
        return tuple(self.draws)

    def interval(self, name: str, level: float = 0.95) -> Interval:
        """The interval that holds a number with this probability, as much of it below as above.

        **Arguments:** `name`: one of `names`; `level`: between 0 and 1. **Returns:** an `Interval`. **Raises:** `ValueError` if there is no
        such name, or `level` is out of range.
        """
        if name not in self.draws:
            raise ValueError(f"`name` must be one of the draws, but is {name!r}. There are {', '.join(self.draws)}.")
        return Interval(*map(float, np.quantile(self.draws[name], _ends(level))))

    def bands(self, experiment: Experiment, of: Any = None, *, level: float = 0.95, count: int = 200) -> tuple[PyTree, PyTree, PyTree]:
        """What an experiment should show: the lower end, the median and the upper end of the predictions of its sensors, or of whatever is
        computed of the motion: coordinates, forces of constraints, friction, instants of sticking.

        **Arguments:** `experiment`: its start is taken as exact, and its `values` may be None. `of`: a function of the motion, a
        `Trajectory`, that returns a tree of arrays; without it what `observe` returns is predicted. `level`: of the band; `count`: of the
        draws that are used.

        **Returns:** three trees like the values of the experiment, or like what `of` returns; a motion that cannot be computed does not
        count. **Raises:** `ValueError` if `level` is out of range, `TypeError` if `of` is no function.

        ```python
        import jax, jax.numpy as jnp
        import jaxlag as jl
        oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
        ts = jnp.linspace(0.0, 3.0, 50)
        record = jl.Experiment(ts, jnp.cos(2.0 * ts), 1.0, 0.0, sigma=0.1)
        posterior = jl.log_density(oscillator, record, {"c": 3.0}, free=("c",)).sample(jax.random.key(0), 200, chains=2)
        lower, median, upper = posterior.bands(record, lambda motion: {"end": motion.q[-1], "fastest": jnp.max(jnp.abs(motion.qdot))})
        ```
        """
        ends = (_ends(level)[0], 0.5, _ends(level)[1])
        if not (of is None or callable(of)):
            raise TypeError(f"`of` must be a function of a motion, but is {of!r}. Give e.g. `lambda motion: motion.multipliers`.")
        every = self.unbounded.reshape(-1, self.unbounded.shape[-1])
        chosen = every[np.linspace(0, len(every) - 1, min(count, len(every))).astype(int)]
        seen = _predictions(self.density, jnp.asarray(chosen), experiment, of)
        return tuple(jax.tree.map(lambda x, q=q: jnp.nanquantile(x, q, axis=0), seen) for q in ends)  # type: ignore[return-value]

    def __repr__(self) -> str:
        rows = [["", "mean", "deviation", "95 %", "R̂", "effective"]]
        for name, x in self.draws.items():
            low, high = self.interval(name)
            numbers = f"{np.mean(x):.6g}", f"{np.std(x):.2g}", f"{low:.6g} … {high:.6g}"
            rows.append([name, *numbers, f"{self.r_hat[name]:.3f}", f"{self.effective[name]:.0f}"])
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  " + "   ".join(x.ljust(width) for x, width in zip(row, widths, strict=True)).rstrip() for row in rows]
        apart = [name for name, x in self.r_hat.items() if x > FEW]
        if apart:
            lines.append(f"  ! chains do not agree on {', '.join(apart)}: draw more")
        if self.divergences:
            lines.append(f"  ! {self.divergences} divergent steps: the density may be missed near kinks or bounds")
        chains, draws, _ = self.unbounded.shape
        return "\n".join([f"Posterior: {chains} chains of {draws} draws", *lines])


def _ends(level: float) -> tuple[float, float]:
    if not 0 < level < 1:
        raise ValueError(f"`level` must be between 0 and 1, but is {level}. Use e.g. 0.95.")
    return (1 - level) / 2, (1 + level) / 2


def sampled(density: Density, key: Array, draws: int, chains: int, warmup: int) -> Posterior:
    """Draws of some chains, each of which begins where the normal approximation of the density has it."""
    try:
        from blackjax import diagnostics
    except ImportError as error:
        raise ImportError("`sample` must have blackjax, but it cannot be imported. Install `jaxlag[bayes]`.") from error
    n = len(density.start)
    root = np.linalg.inv(np.linalg.cholesky(np.asarray(density.metric))).T  # u = start + root v, where v has a covariance of about one
    v, divergent = _chains(density, jnp.asarray(root), jax.random.split(key, chains), draws, warmup)
    u = np.asarray(density.start) + np.asarray(v) @ root.T
    shown = np.asarray(_shown(density, jnp.asarray(u.reshape(-1, n)))).reshape(chains, draws, n)
    names = [name.removeprefix("log ") for name in density.names]
    several = chains > 1

    def by_name(of: Callable) -> dict[str, float]:
        return dict(zip(names, map(float, np.ravel(np.asarray(of(shown)))) if several else [np.nan] * n, strict=True))

    of_each_name = {name: shown[:, :, i] for i, name in enumerate(names)}
    agreement = by_name(diagnostics.potential_scale_reduction), by_name(diagnostics.effective_sample_size)
    return Posterior(density, u, of_each_name, *agreement, int(np.sum(np.asarray(divergent))))


@compiled
def _chains(density: Density, root: Array, keys: Array, draws: int, warmup: int) -> tuple[Array, Array]:
    """v of each chain, and which steps diverged."""
    import blackjax

    def log_p(v):
        return density(jnp.asarray(density.start) + root @ v)

    n = root.shape[0]

    def chain(key):
        of_start, of_warmup, of_draws = jax.random.split(key, 3)
        first = jax.random.normal(of_start, (n,), root.dtype) / 2
        first = jnp.where(jnp.isfinite(log_p(first)), first, 0)
        adapt = blackjax.window_adaptation(blackjax.nuts, log_p, is_mass_matrix_diagonal=True, target_acceptance_rate=ACCEPTANCE)
        (state, settings), _ = adapt.run(of_warmup, first, num_steps=warmup)
        kernel = blackjax.nuts(log_p, **settings).step

        def step(state, key):
            state, info = kernel(key, state)
            return state, (state.position, info.is_divergent)

        return jax.lax.scan(step, state, jax.random.split(of_draws, draws))[1]

    return of_each(chain, keys)


@compiled
def _shown(density: Density, u: Array) -> Array:
    """Parameters, unknown numbers, sigma and τ of draws."""
    p, known = density.problem.free.size, density.problem.size

    def of_one(u):
        theta, _ = density.unbounded.theta(u[:p])
        return jnp.concatenate([theta, u[p:known], jnp.exp(u[known:])])

    return jax.vmap(of_one)(u)


def _predictions(density: Density, u: Array, experiment: Experiment, of: Callable | None) -> PyTree:
    """What is seen of an experiment at some draws."""
    problem = density.problem
    single = LeastSquaresProblem.of(problem.model, problem.free, [with_zero_values(problem.model, problem.free, experiment)])
    return _predicted_at(density, single, u, of)


@compiled
def _predicted_at(density: Density, single: Any, u: Array, of: Callable | None) -> PyTree:
    free, (batch,) = density.problem.free, single.batches

    def of_one(e, z, theta):
        seen, motion = single.model.predicted(free.insert(theta), e, z)
        seen = seen if of is None else jax.tree.map(jnp.asarray, of(motion))
        return jax.tree.map(lambda x: jnp.where(motion.succeeded, x.astype(u.dtype), jnp.nan), seen)

    def of_draw(u):
        theta, _ = density.unbounded.theta(u[: free.size])
        return jax.tree.map(lambda x: x[0], map_batch(of_one, batch, jnp.zeros((1, batch.unknowns), u.dtype), theta))

    return of_each(of_draw, u)
