"""Regression: parameters from the equations of motion themselves in the weak form, without a simulation."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._model.system import System
from .._model.validation import without_contacts, without_events
from .base_parameters import nearby
from .experiment import Experiment, validate_inputs
from .identifiability import determined_by, rounding_of, undetermined
from .parameters import Free
from .rounding import plus_minus
from .smoothing_spline import without_delay
from .undetermined import on_undetermined
from .weak_form import Record
from .weak_regression import SLIDING, WeakFormProblem, best_estimate, half_widths, with_scatter


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Regression:
    """Parameters by regression on the equations of motion, as `regress` returns them; prints as a table.

    - `params`: all parameters, the free ones at their estimate: a start for `fit`. `estimates`: the free ones only, by name.
    - `standard_errors`: structured like `estimates`, in the same units; infinite where the measurements do not determine a parameter.
    - `names`: the p numbers, in flat order.
    - `linear`: whether the equations are linear in the free parameters, so that one step solved them.
    - `width`: of the windows, a time; `windows`: their number. `reversals`: whether dry friction reverses in some of them.
    - `remarks`: which combinations are determined of parameters that are not, with standard errors.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    record = jl.Experiment(ts, jnp.cos(2.0 * ts), q0=1.0, qdot0=0.0)
    found = jl.regress(oscillator, record, {"c": jnp.nan}, free=("c",))
    found.linear  # True
    ```
    """

    params: PyTree
    estimates: dict[str, PyTree]
    standard_errors: dict[str, PyTree]
    names: tuple[str, ...]
    linear: bool
    width: float
    windows: int
    reversals: bool
    remarks: list[str]

    def __repr__(self) -> str:
        kind = "linear, solved in one step" if self.linear else "nonlinear"
        values, errors = (
            np.concatenate([np.ravel(np.asarray(x)) for name in self.estimates for x in jax.tree.leaves(tree[name])])
            for tree in (self.estimates, self.standard_errors)
        )
        width = max(map(len, self.names))
        text = lambda v, e: plus_minus(v, e) if np.isfinite(e) else "not determined by these measurements"
        rows = [f"  {n:<{width}}  {text(v, e)}" for n, v, e in zip(self.names, values, errors, strict=True)]
        reversals = "; in some of them dry friction reverses" if self.reversals else ""
        return "\n".join(
            [
                f"Regression: {len(self.names)} parameters, {kind}; starting values for `fit`",
                *rows,
                *(f"  ! {remark}" for remark in self.remarks),
                f"  {self.windows} windows, {self.width:.3g} wide{reversals}",
            ]
        )


def regress(
    system: System,
    experiments: Experiment | Sequence[Experiment],
    params: PyTree,
    *,
    free: str | Sequence[str],
    bounds: Mapping[str, Any] | None = None,
    width: float | None = None,
) -> Regression:
    r"""Parameters by least squares in the equations of motion along the measured motion; needs no simulation and no starting values.

    $$ \int \dot\varphi_k\, P p \, dt + \int \varphi_k\, \big(\dot P p + P F\big) \, dt = 0, \qquad
       p = \frac{\partial L}{\partial \dot q}, \quad F = \frac{\partial L}{\partial q} - \frac{\partial D}{\partial \dot q} + Q, \quad
       P = 1 - G^T (G G^T)^+ G $$

    for test functions φ = (1 − s²)⁴ on overlapping windows, −1 ≤ s ≤ 1 (the weak form). Integration by parts has moved the time derivative
    from the momentum p to φ, so that no acceleration is needed and inputs need no filter: a `Signal` that is held is integrated exactly. P
    eliminates the unknown constraint forces, also nonholonomic ones. q and q̇ come from smoothing splines of all channels, including
    measured velocities and accelerations, which may jump where dry friction reverses or sticks; the means of the constraints over the
    windows are further residuals. If the equations are linear in the parameters, which is checked by differentiation, one step solves
    them. Each equation is weighted by the inverse of the size of its residuals. Windows in which dry friction may stick are left out;
    those in which it only reverses are used if that predicts all windows better.

    **Arguments:**

    - `experiments`: one `Experiment` or several, with T samples each; T may differ. An `unknown` start is not used; other unknowns of an
      experiment, and the delays of sensors, keep their value.
    - `params`: all parameters, as for `fit`; a free one that is NaN needs no starting value.
    - `free`, `bounds`: as for `fit`.
    - `width`: of the windows, a time. In narrow windows the noise of the motion biases the estimates; wide windows are few. The default is
      the width whose estimate predicts the windows of all widths best.

    Units are any consistent set.

    **Returns:** a `Regression`. Its standard errors come from the scatter of the windows, and of estimates from other widths that predict
    as well: they account for coloured noise and for forces that the model lacks, but not for a bias common to all. If noise is all that
    is wrong, estimates of `fit` are more accurate.

    **Raises:** `ValueError` if the system has further states, `free` names no parameter, the equations contain only ratios of the
    parameters, the sensors do not see the motion, or a delay is NaN; if `width` is not positive, or fits no window into the records.

    **Source:** Shinbrot, Trans. ASME 79 (1957) 582 (method of modulating functions); Messenger & Bortz, J. Comput. Phys. 443 (2021)
    110525 (weak form); Gautier & Khalil, IEEE Trans. Robot. Autom. 6 (1990) 368; Stone, J. R. Stat. Soc. B 36 (1974) 111 (choice by
    prediction); Newey & West, Econometrica 55 (1987) 703 (standard errors).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    record = jl.Experiment(ts, jnp.cos(2.0 * ts), q0=1.0, qdot0=0.0)
    jl.regress(oscillator, record, {"c": jnp.nan}, free=("c",)).estimates["c"]  # 4.0
    ```
    """
    if system.states:
        raise ValueError(
            f"`system` must be one whose forces follow from what is measured, but has states: {', '.join(dict(system.states))}. "
            "Put their recorded values into params as `Signal`s, in a system without these states, or use `fit`."
        )
    without_contacts(system, "`regress`")
    without_events(system, "`regress`")
    experiments, params = validate_inputs(experiments, params)
    if any(e.events for e in experiments):
        raise ValueError("`experiments` must be sampled motions, but one holds times of events. Leave its `events` out.")
    experiments = [without_delay(e, params) for e in experiments]
    given = Free.of(params, free, bounds)
    if given.size == 0:
        raise ValueError("`free` must name at least one entry of params, but is empty. Say which parameters to identify.")
    params = given.with_default_starts()
    records = [Record.of(system, e, params) for e in experiments]
    chosen, linear = _start(records, given, free, bounds)
    problem = WeakFormProblem.of(records, chosen, linear)
    found = best_estimate(problem, half_widths(records, width))
    if found is None:
        raise ValueError(
            "`experiments` must be long enough for windows on which the equations of motion are tested, as many as free parameters, and "
            "dry friction must slide there, but they are not. Give `width` a smaller time, free fewer parameters, or use `fit`."
        )
    theta, slope = chosen.theta(jnp.asarray(found.y)), np.asarray(chosen.slope(jnp.asarray(found.y)))
    errors = chosen.by_name(jnp.asarray(found.errors * slope))
    windows = 2 * found.half, found.windows, found.near_rest > SLIDING
    return Regression(chosen.insert(theta), chosen.by_name(theta), errors, chosen.entries, linear, *windows, _remarks(problem, found))


def _start(records, given, free, bounds):
    """The free parameters, and whether the equations are linear in them: then those that are not given start at zero, which has no unit."""
    for unbounded in (0.0, 1.0):
        params = given.with_default_starts(unbounded)
        linear = is_linear(records, Free.of(params, free))
        if linear:
            break
    return Free.of(params, free, bounds), linear


def is_linear(records, free):
    """Whether the Jacobian is the same at another point; refuses linear equations without a known term."""
    y = jnp.zeros(free.size)
    nothing = rounding_of(y.dtype)
    elsewhere = y + 0.37 * jnp.cos(1.0 + jnp.arange(y.size))
    here = [record.form.linearised(free, y) for record in records]
    if not all(np.all(np.isfinite(part)) for parts in here for part in parts):
        return False
    for record, (_, J) in zip(records, here, strict=True):
        if np.linalg.norm(J - record.form.linearised(free, elsewhere)[1]) > nothing * np.linalg.norm(J):
            return False
    to_zero = -np.asarray(free.theta(y) / free.slope(y))
    known = sum(_sizes(record, terms + J @ to_zero) for record, (terms, J) in zip(records, here, strict=True))
    of_free = lambda sizes: sum(_sizes(record, np.abs(J) @ sizes) for record, (_, J) in zip(records, here, strict=True))
    if np.all((known <= nothing * of_free(np.abs(to_zero))) | (of_free(np.ones(free.size)) == 0)):
        raise ValueError(
            f"`free` must leave a known term in the equations of motion, but every term has a factor out of {', '.join(free.names)}: "
            "only their ratios are determined. Fix one of them."
        )
    return True


def _remarks(problem, found):
    """Which parameters are not determined, and the estimates of the combinations that are."""
    if not found.null.size:
        return []
    free, J = problem.free, problem.jacobian(found.y, found)
    determined, idle = np.flatnonzero(np.isfinite(found.errors)), np.flatnonzero(np.linalg.norm(J, axis=0) == 0)
    known = undetermined(_points(problem, found), determined.tolist(), idle.tolist(), found.noise)
    estimates = [_estimate(free, combination, found) for combination in known.combinations]
    return on_undetermined(free.entries, known, estimates, {})


def _points(problem, found):
    """θ and the changes that do not show, at the estimate, then around it wherever the equations can be computed."""
    free, slope = problem.free, np.asarray(problem.free.slope(jnp.asarray(found.y)), float)
    theta = np.asarray(free.theta(jnp.asarray(found.y)), float)
    yield theta, slope[:, None] * found.null
    for near in nearby(theta, np.asarray(free.lower), np.asarray(free.upper)):
        J = problem.jacobian((near - np.asarray(free.start)) / np.asarray(free.scale), found)
        if np.all(np.isfinite(J)):
            yield near, slope[:, None] * determined_by(J, np.zeros((0, free.size)), hidden=found.null.shape[1]).null


def _estimate(free, combination, found):
    """Value and standard error of a combination, with its scatter between windows of different widths."""
    of = lambda one: combination.estimate(
        np.asarray(free.theta(one.y), float), one.covariance * np.outer(free.slope(one.y), free.slope(one.y))
    )
    value, error = of(found)
    return value, float(with_scatter(value, error, [of(one) for one in found.as_good]))


def _sizes(record, terms):
    """Of the terms of each equation along a record: momentum and force together, then the constraints."""
    momentum, force, constraints = (np.linalg.norm(part, axis=0) for part in record.parts(terms))
    return np.concatenate([momentum + force, constraints])
