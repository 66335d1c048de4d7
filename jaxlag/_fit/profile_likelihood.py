"""Confidence intervals by profile likelihood."""

import jax.numpy as jnp
import numpy as np

from .arrow import without
from .levenberg_marquardt import levenberg_marquardt
from .problem import LeastSquaresProblem, linearise, size_of

FAR = 50  # times the linearised interval, within which an end is looked for


def profile_end(
    problem: LeastSquaresProblem,
    x: np.ndarray,
    i: int,
    *,
    side: int,
    quantile: float,
    sigma: float,
    inflation: float,
    deviation: float,
    freedom: int,
) -> float:
    r"""The end of the interval of parameter i on one `side` (−1 or 1): where the cost S, minimised over all other unknowns, has risen to

    $$ \sqrt{2 (S(\theta_i) - S(\hat\theta))} = t \, \sigma \cdot \text{inflation} $$

    The root is nearly linear in θ_i. `deviation`: of x_i over σ. An end that is not found within `FAR` times the linearised interval
    is the bound of the parameter, infinite where it has none; NaN is an end that was lost on the way.

    **Source:** Bates & Watts, Nonlinear Regression Analysis and Its Applications (1988), section 6.1.
    """
    from scipy import optimize

    free, kept = problem.free, np.delete(np.arange(x.size), i)
    others, least = x[kept], float(jnp.sum(linearise(problem, jnp.asarray(x)).residuals ** 2) / 2)
    unit, bounds = sigma * inflation, tuple(bound[kept] for bound in problem.bounds)

    def excess(away):
        nonlocal others
        fixed = jnp.asarray(x).at[i].add(away)

        def residuals(rest):
            found = linearise(problem, fixed.at[kept].set(rest))
            return found.residuals, without(found.jacobian, i), found

        if kept.size:
            limits = {"freedom": freedom, "max_steps": 50, "tolerance": 1e-4, "bounds": bounds, "size": size_of(problem)}
            best = levenberg_marquardt(residuals, jnp.asarray(others), **limits).best
            rise = float(jnp.sum(best.residuals**2) / 2) - least
            others = np.asarray(best.y) if np.isfinite(rise) else others
        else:
            rise = float(jnp.sum(linearise(problem, fixed).residuals ** 2) / 2) - least
        return min(np.sqrt(max(2 * rise, 0)) / unit, FAR * quantile) - quantile

    bound_of_theta = float((free.lower if side < 0 else free.upper)[i])
    first = side * quantile * sigma * deviation
    limit = float(problem.bounds[side > 0][i]) - x[i]
    inner, outer = 0.0, side * min(abs(first), abs(limit))  # outwards: from far away others would come to another minimum
    while (below := outer == 0 or excess(outer) <= 0) and abs(outer) < min(abs(limit), FAR * abs(first)):
        inner, outer = outer, side * min(2 * abs(outer), abs(limit))
    if below:
        return bound_of_theta
    found = optimize.root_scalar(excess, bracket=(inner, outer), method="brentq", rtol=1e-4)
    if not found.converged:
        return np.nan
    return float(free.theta(jnp.asarray(x).at[i].add(found.root)[: free.size])[i])
