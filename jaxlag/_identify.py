"""Identification: parameters of a real machine from recordings of its motion, with standard errors."""

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ._arguments import call
from ._checks import is_concrete, is_vector, parameters, sample_times, state
from ._integrate import simulate
from ._results import reason_of
from ._system import System
from ._trajectory import Trajectory


class Experiment(eqx.Module):
    """A recording of the system's motion, and how it was measured.

    **Arguments:**

    - `ts`: the times of the samples, increasing; the start of the motion is at ts[0].
    - `values`: what was measured, any pytree of arrays with the samples as first axis, e.g. `{"y": ..., "phi": ...}`.
    - `q0`, `qdot0`: the state at ts[0], as for `simulate`.
    - `observe`: what the sensors see of one state, structured like one sample of `values`; it receives the arguments it names, of
      `t`, `q`, `qdot`, `qddot`, `multipliers`, `params` and the entries of `params`.
    - `sigma`: standard deviation of the noise, a number or a pytree like `values` with one for each channel or sample. Where it is
      left out, one common sigma is estimated from the residuals.

    Any consistent units. **Raises:** `ValueError` where times, values and sigma do not fit each other.

    **Source:** Ljung, System Identification, 2nd ed., section 7.2.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    ts = jnp.linspace(0.0, 1.0, 5)
    jl.Experiment(ts, {"position": jnp.cos(ts)}, q0=1.0, qdot0=0.0, observe=lambda q: {"position": q}, sigma=1e-3)
    ```
    """

    ts: Float[Array, " T"]
    values: PyTree[Float[Array, "T ..."]]
    q0: PyTree
    qdot0: PyTree
    sigma: PyTree | None
    observe: Callable = eqx.field(static=True)

    def __init__(self, ts: Any, values: PyTree, q0: PyTree, qdot0: PyTree, *, observe: Callable, sigma: PyTree | None = None):
        self.q0, self.qdot0 = state(q0, qdot0, ("q0", "qdot0"))
        dtype = jax.tree.leaves(self.q0)[0].dtype
        self.ts = sample_times(ts, dtype)
        self.values = jax.tree.map(lambda value: jnp.asarray(value, dtype), values, is_leaf=is_vector)
        self.observe = observe
        for path, value in jax.tree_util.tree_flatten_with_path(self.values)[0]:
            at = f"`values{jax.tree_util.keystr(path)}`"
            if value.shape[:1] != self.ts.shape:
                raise ValueError(
                    f"{at} must have one row for each of the {self.ts.size} times, but has shape {value.shape}. Put the samples first."
                )
            if is_concrete(value) and not np.all(np.isfinite(value)):
                raise ValueError(f"{at} must be finite, but has {int(np.sum(~np.isfinite(value)))} missing samples. Leave these times out.")
        self.sigma = None if sigma is None else _like_values(sigma, self.values)


def _like_values(sigma, values):
    try:
        sigma = jax.tree.map(lambda s, v: jax.tree.map(lambda v: jnp.broadcast_to(jnp.asarray(s, v.dtype), v.shape), v), sigma, values)
    except ValueError as error:
        raise ValueError(
            f"`sigma` must be a number or structured like `values`, but does not fit: {error}. Give one for each channel."
        ) from None
    if any(is_concrete(s) and not np.all(np.asarray(s) > 0) for s in jax.tree.leaves(sigma)):
        raise ValueError("`sigma` must be positive, but has an entry that is not. Give the standard deviation of the noise.")
    return sigma


class Fit(eqx.Module):
    """Identified parameters with their quality; printed, a table.

    - `experiments`: what was fitted. `params`: all parameters, the free ones at their estimate. `estimates`: the free ones alone.
    - `standard_errors`: like `estimates`; infinite where the measurements do not determine a parameter.
    - `covariance`, `correlation`: in the flat order of `estimates`, whose entries `names` names.
    - `residuals`: measured minus predicted, per experiment, structured like its values. `sigma`: estimated noise, in
      units of the sigma given, which is 1 where none was.
    - `converged`, `steps`, `cost` (half the sum of squares), `predictions`: the fitted motions as `Trajectory`.
    """

    experiments: tuple[Experiment, ...]
    params: PyTree
    estimates: dict[str, Array]
    standard_errors: dict[str, Array]
    covariance: Float[Array, "p p"]
    correlation: Float[Array, "p p"]
    residuals: list[PyTree]
    predictions: list[Trajectory]
    sigma: Float[Array, ""]
    cost: Float[Array, ""]
    names: tuple[str, ...] = eqx.field(static=True)
    converged: bool = eqx.field(static=True)
    steps: int = eqx.field(static=True)

    def __repr__(self) -> str:
        count = sum(leaf.size for leaf in jax.tree.leaves(self.residuals))
        outcome = "converged" if self.converged else "not converged"
        values, errors = (np.asarray(ravel_pytree(tree)[0]) for tree in (self.estimates, self.standard_errors))
        parameters = f"{len(self.names)} parameter{'s' if len(self.names) > 1 else ''}"
        rows = [f"Fit: {parameters}, {count} measurements, {outcome} after {self.steps} steps"]
        width = max(map(len, self.names))
        for name, value, error in zip(self.names, values, errors, strict=True):
            if np.isfinite(error):
                rows.append(f"  {name:<{width}}  {plus_minus(value, error)}")
            else:
                rows.append(f"  {name:<{width}}  not determined by these measurements")
        strong = [
            f"{self.names[i]}, {self.names[j]}: {self.correlation[i, j]:+.2f}"
            for i in range(len(values))
            for j in range(i)
            if abs(self.correlation[i, j]) > 0.5
        ]
        if strong:
            rows.append(f"  correlation  {'; '.join(strong)}")
        rows.append(f"  residual sigma  {self.sigma:.4g}")
        return "\n".join(rows)


def plus_minus(value: float, error: float) -> str:
    """`value ± error` with two digits of the error."""
    if error == 0:
        return f"{value:.6g} ± 0"
    digits = 1 - int(np.floor(np.log10(error)))
    if digits > 8 or (value and abs(value) >= 1e7):
        return f"{value:.8g} ± {error:.2g}"
    return f"{round(value, digits):.{max(digits, 0)}f} ± {round(error, digits):.{max(digits, 0)}f}"


def fit(
    system: System,
    experiments: Experiment | Sequence[Experiment],
    params: Mapping[str, Any],
    *,
    free: Sequence[str],
    max_steps: int = 100,
    tolerance: float = 1e-6,
    progress: bool = False,
    **numerics: Any,
) -> Fit:
    r"""Identifies parameters from recorded motions, by weighted least squares over the whole motion.

    $$ \min_\theta \tfrac12 \sum_i \left(\frac{z_i - h(t_i, q(t_i; \theta), \dot q(t_i; \theta))}{\sigma_i}\right)^2,
       \qquad \mathrm{cov}\,\hat\theta = \hat\sigma^2 (J^T J)^{-1} $$

    Levenberg–Marquardt with exact Jacobians, in parameters scaled by their starting values. σ̂² is the residual sum of squares
    over the degrees of freedom where `sigma` was left out of the experiments, and 1 where it was given.

    **Arguments:**

    - `experiments`: one `Experiment` or several.
    - `params`: a mapping with all parameters; those in `free` are starting values.
    - `free`: names of the entries of `params` to be identified.
    - `max_steps`, `tolerance`: the iteration ends when a step changes cost and scaled parameters by less than `tolerance`.
    - `progress`: prints a line with step and cost while it runs, on standard error.
    - `**numerics`: handed on to `simulate`: `solver`, `rtol`, `atol`, `stabilisation`.

    **Returns:** a `Fit`. Any consistent units.

    **Raises:** `ValueError` where `free` names no parameter, `observe` does not fit the measurements, or the motion at the start
    cannot be computed.

    **Source:** Ljung, System Identification, 2nd ed., sections 7.2 and 9.4; Nocedal & Wright, Numerical Optimization, section 10.3.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    record = jl.Experiment(ts, jnp.cos(2.0 * ts), q0=1.0, qdot0=0.0, observe=lambda q: q)
    jl.fit(oscillator, record, {"c": 3.0}, free=("c",)).estimates["c"]  # 4.0
    ```
    """
    experiments = (experiments,) if isinstance(experiments, Experiment) else tuple(experiments)
    params = parameters(params, experiments[0].q0)
    start = _free_entries(params, free)
    residuals = _Residuals(system, tuple(sorted(numerics.items())))
    args = (experiments, params, start)
    _check_observations(residuals, jax.tree.map(jnp.zeros_like, start), args)
    solver = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance, norm=optx.max_norm)
    y, steps, converged = _iterate(solver, residuals, jax.tree.map(jnp.zeros_like, start), args, max_steps, progress)
    return _report(residuals, y, args, steps, converged)


class _Residuals(eqx.Module):
    """(predicted − measured) / σ as a function of the scaled free parameters; compared by its fields, so it compiles once."""

    system: System = eqx.field(static=True)
    numerics: tuple[tuple[str, Any], ...] = eqx.field(static=True)

    def __call__(self, y, args):
        experiments, _, _ = args
        predictions = [self.predicted(y, args, i)[0] for i in range(len(experiments))]
        return [
            jax.tree.map(lambda p, v, s: (p - v) / s, prediction, e.values, _sigma(e))
            for prediction, e in zip(predictions, experiments, strict=True)
        ], None

    def predicted(self, y, args, i):
        experiments, params, start = args
        e = experiments[i]
        params = dict(params) | jax.tree.map(_unscaled, start, y)
        motion = simulate(self.system, e.q0, e.qdot0, e.ts, params, **{"throw": False, **dict(self.numerics)})

        def seen(t, q, qdot, qddot, multipliers):
            return call(e.observe, "`observe`", params, t=t, q=q, qdot=qdot, qddot=qddot, multipliers=multipliers)

        return jax.vmap(seen)(motion.ts, motion.q, motion.qdot, motion.qddot, motion.multipliers), motion


def _sigma(experiment):
    return experiment.sigma if experiment.sigma is not None else jax.tree.map(jnp.ones_like, experiment.values)


def _scale(start):
    return jnp.where(start == 0, 1, jnp.abs(start))


def _unscaled(start, y):
    return start + _scale(start) * y


def _free_entries(params, free):
    if isinstance(free, str):
        raise ValueError(f"`free` must be a list of names, but is the string {free!r}. Write `free=({free!r},)`.")
    if not isinstance(params, Mapping):
        raise ValueError(f"`params` must be a mapping, so that `free` can name its entries, but is a {type(params).__name__}. Use a dict.")
    for name in free:
        if name not in params:
            raise ValueError(f"`free` must name entries of params, but holds {name!r}. There are {', '.join(sorted(params))}.")
    if not free:
        raise ValueError("`free` must name at least one entry of params, but is empty. Say which parameters to identify.")
    return {name: jax.tree.map(jnp.asarray, params[name]) for name in free}


def _check_observations(residuals, y, args):
    for i, e in enumerate(args[0]):
        seen = eqx.filter_eval_shape(lambda y, args, i=i: residuals.predicted(y, args, i)[0], y, args)
        of = f" of experiment {i}" if len(args[0]) > 1 else ""
        if jax.tree.structure(seen) != jax.tree.structure(e.values):
            raise ValueError(
                f"`observe`{of} must return what `values` holds, {jax.tree.structure(e.values)}, but returns {jax.tree.structure(seen)}. "
                "Give both the same names."
            )
        for (path, s), v in zip(jax.tree_util.tree_flatten_with_path(seen)[0], jax.tree.leaves(e.values), strict=True):
            if s.shape != v.shape or not jnp.issubdtype(s.dtype, jnp.floating):
                raise ValueError(
                    f"`observe`{of} must return real numbers of shape {v.shape[1:]} for `values{jax.tree_util.keystr(path)}`, "
                    f"but returns shape {s.shape[1:]} and dtype {s.dtype}. Compare what was measured with what is seen."
                )


@eqx.filter_jit
def _start(solver, residuals, y, args):
    shape, aux = eqx.filter_eval_shape(residuals, y, args)
    return solver.init(residuals, y, args, {}, shape, aux, frozenset())


@eqx.filter_jit
def _step(solver, residuals, y, args, state):
    y, state, _ = solver.step(residuals, y, args, {}, state, frozenset())
    done, result = solver.terminate(residuals, y, args, {}, state, frozenset())
    return y, state, done, result == optx.RESULTS.successful


def _iterate(solver, residuals, y, args, max_steps, progress):
    """The steps of the solver, driven from Python so that it can say how it gets on."""
    state = _start(solver, residuals, y, args)
    for step in range(1, max_steps + 1):
        y, state, done, well = _step(solver, residuals, y, args, state)
        if progress:
            print(f"\rstep {step:3d}   cost {float(state.f_info.as_min()):.6g}", end="", file=sys.stderr, flush=True)
        if done:
            break
    if progress:
        print(file=sys.stderr)
    return y, step, bool(done) and bool(well)


@eqx.filter_jit
def _final(residuals, y, args):
    flat, unravel = ravel_pytree(y)
    flattened = lambda flat: ravel_pytree(residuals(unravel(flat), args)[0])[0]
    r, J = flattened(flat), jax.jacfwd(flattened)(flat)
    motions = [residuals.predicted(y, args, i)[1] for i in range(len(args[0]))]
    left = [jax.tree.map(lambda r, s: -r * s, r, _sigma(e)) for r, e in zip(residuals(y, args)[0], args[0], strict=True)]
    return r, J, motions, left


def _report(residuals, y, args, steps, converged):
    experiments, params, start = args
    r, J, motions, left = _final(residuals, y, args)
    for motion in motions:
        if not motion.succeeded:
            raise ValueError(
                f"the fitted motion must be computable, but ended with: {reason_of(motion.result)} Start from other parameters."
            )
    estimates = jax.tree.map(_unscaled, start, y)
    scale, unravel = ravel_pytree(jax.tree.map(_scale, start))
    freedom = r.size - scale.size
    spread = jnp.sqrt(r @ r / freedom) if freedom > 0 else jnp.asarray(jnp.nan)
    absolute = all(e.sigma is not None for e in experiments)
    covariance = _inverse_information(J) * jnp.outer(scale, scale) * (1.0 if absolute else spread**2)
    errors = jnp.sqrt(jnp.diagonal(covariance))
    return Fit(
        experiments=experiments,
        params=dict(params) | estimates,
        estimates=estimates,
        standard_errors=unravel(errors),
        covariance=covariance,
        correlation=covariance / jnp.outer(errors, errors),
        residuals=left,
        predictions=motions,
        sigma=spread,
        cost=r @ r / 2,
        names=_entry_names(estimates),
        converged=converged,
        steps=steps,
    )


def _inverse_information(J):
    """(JᵀJ)⁻¹, with infinite variance for what J does not determine."""
    size = jnp.linalg.norm(J, axis=0)
    scale = jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 1)
    _, s, Vt = jnp.linalg.svd(J * scale[None, :], full_matrices=False)
    weak = s <= s[0] * 1e3 * jnp.finfo(J.dtype).eps * J.shape[1]
    inverse = Vt.T @ (jnp.where(weak, 0, 1 / jnp.where(weak, 1, s) ** 2)[:, None] * Vt)
    undetermined = jnp.any(weak[:, None] & (jnp.abs(Vt) > 1e-3), axis=0) | (size == 0)
    return inverse * jnp.outer(scale, scale) + jnp.diag(jnp.where(undetermined, jnp.inf, 0))


def _entry_names(tree):
    names = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        names += [name] if leaf.ndim == 0 else [f"{name}[{', '.join(map(str, i))}]" for i in np.ndindex(leaf.shape)]
    return tuple(names)
