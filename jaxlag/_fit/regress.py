"""Inverse-dynamics identification: parameters from the equations of motion themselves, without a simulation."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._mechanics.friction_elements import find_elements
from .._mechanics.lagrange import applied_force, constraint_rows, inertia
from .._mechanics.pseudo_inverse import pseudo_inverse
from .._model.flat import bind
from .._model.system import System
from .._program.jit import compiled
from .experiment import Experiment, measured, with_own
from .identifiability import determined_by
from .levenberg_marquardt import levenberg_marquardt
from .parameters import Free
from .rounding import plus_minus
from .smoothing_spline import smooth

ENDS = 0.03  # of the record at each end, left out because derivatives of splines are poor there
SLOW = 0.03  # of the largest slip velocity: below it, friction may stick, and its force is unknown
NEIGHBOURS = 3  # samples next to those, left out because the acceleration jumps there
ROUNDS = 3  # of weighting the equations by their residuals
LINEAR = 1e-9  # relative change of a Jacobian that counts as zero


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Regression:
    """Parameters by regression on the equations of motion, as `regress` returns them; prints as a table.

    - `params`: all parameters, the free ones at their estimate: a start for `fit`. `estimates`: the free ones only, by name.
    - `standard_errors`: structured like `estimates`, in the same units; too small where the derivatives of the motion are uncertain,
      infinite where the measurements do not determine a parameter.
    - `names`: of the p numbers, in flat order.
    - `linear`: whether the equations are linear in the free parameters, so that one step solved them.

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

    def __repr__(self) -> str:
        kind = "linear, solved in one step" if self.linear else "nonlinear"
        values, errors = (
            np.concatenate([np.ravel(np.asarray(x)) for name in self.estimates for x in jax.tree.leaves(tree[name])])
            for tree in (self.estimates, self.standard_errors)
        )
        width = max(map(len, self.names))
        text = lambda v, e: plus_minus(v, e) if np.isfinite(e) else "not determined by these measurements"
        rows = [f"  {n:<{width}}  {text(v, e)}" for n, v, e in zip(self.names, values, errors, strict=True)]
        return "\n".join([f"Regression: {len(self.names)} parameters, {kind}; starting values for `fit`, biased by noise", *rows])


def regress(
    system: System,
    experiments: Experiment | Sequence[Experiment],
    params: PyTree,
    *,
    free: Sequence[str],
    bounds: Mapping[str, Any] | None = None,
) -> Regression:
    r"""Parameters by least squares in the equations of motion along the measured motion; needs no simulation and no starting values.

    $$ \min_\theta \sum_i |w\,P (M \ddot q - f)|^2_{t_i} + |w\,g|^2_{t_i} + |w\,a|^2_{t_i}, \qquad P = 1 - G^T (G G^T)^+ G $$

    with smoothing splines of the measurements for q, q̇ and q̈; g and a are the residuals of holonomic and nonholonomic constraints, and P
    eliminates the unknown constraint forces. Where the equations are linear in the parameters, which is checked by differentiation, one
    step solves them: the inverse-dynamics method of robotics (IDIM-LS). The weight w of an equation is one over the size of its
    residuals. Samples at the ends, and those where dry friction may stick, are left out.

    **Arguments:**

    - `experiments`: one `Experiment` or several, with T samples each; T may differ. An `unknown` start is not used, and other unknowns of
      an experiment keep their value.
    - `params`: all parameters, as for `fit`; a free one that is NaN needs no starting value.
    - `free`, `bounds`: as for `fit`.

    Units are any consistent set.

    **Returns:** a `Regression`. Noise in q̇ and q̈ biases its estimates; those of `fit` have no such bias.

    **Raises:** `ValueError` where `free` names no parameter, the equations contain only ratios of the parameters, the sensors do not see
    the motion, or they have a delay.

    **Source:** Gautier & Khalil, IEEE Trans. Robot. Autom. 6 (1990) 368; Janot, Vandanjon & Gautier, IEEE Trans. Control Syst.
    Technol. 22 (2014) 132, eq. 11.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    record = jl.Experiment(ts, jnp.cos(2.0 * ts), q0=1.0, qdot0=0.0)
    jl.regress(oscillator, record, {"c": jnp.nan}, free=("c",)).estimates["c"]  # 4.0
    ```
    """
    experiments, params = measured(experiments, params)
    params = Free.of(params, free, bounds).with_default_starts()
    chosen, unbounded = Free.of(params, free, bounds), Free.of(params, free)
    if chosen.size == 0:
        raise ValueError("`free` must name at least one entry of params, but is empty. Say which parameters to identify.")
    records = [_Record.of(system, e, params) for e in experiments]
    weights = [record.first_weights(chosen) for record in records]
    y, linear = jnp.zeros(chosen.size), _is_linear(records, unbounded)
    if linear:
        _refuse_homogeneous(records, unbounded, weights)
    linear &= not np.any(np.isfinite(chosen.lower) | np.isfinite(chosen.upper))
    for _ in range(ROUNDS):
        y = (_solve_linear if linear else _solve_nonlinear)(records, chosen, y, weights)
        weights = [record.weights(np.abs(record.linearised(chosen, y)[0])) for record in records]
    r, J = (np.asarray(x) for x in _weighted(records, chosen, y, weights))
    slope, known = np.asarray(chosen.slope(y)), determined_by(J, np.zeros((0, chosen.size)))
    sigma = np.linalg.norm(r) / np.sqrt(max(int(np.count_nonzero(r)) - chosen.size, 1))
    errors = np.where(known.determined, sigma * slope * np.sqrt(np.diag(known.covariance)), np.inf)
    theta = chosen.theta(y)
    return Regression(chosen.insert(theta), chosen.by_name(theta), chosen.by_name(jnp.asarray(errors)), chosen.entries, linear)


@eqx.filter_jit  # so that all parameters are traced: a friction coefficient of 0 is still friction
def _slips(system, like, params, ts, q, v):
    """Slip velocities of dry friction along a record, (T, slips); None where there is no dry friction."""
    elements = find_elements(bind(system, like, params), ts[0], q[0], v[0])
    return None if elements is None else jax.vmap(elements.slip)(ts, q, v)


class _Record(eqx.Module):
    """The equations of motion along a smoothed record; `used` (samples, equations) is zero where a sample is left out."""

    system: System = eqx.field(static=True)
    like: PyTree
    own: dict[str, Any]
    ts: Any
    motion: tuple
    used: Any

    @classmethod
    def of(cls, system, e, params):
        motion = smooth(e, params, between=True)
        ts = jnp.asarray(motion.ts)
        params = with_own(params, e.params)
        flat = bind(system, e.q0, params)
        used = np.abs(np.linspace(-1, 1, ts.size)) <= 1 - 2 * ENDS
        point = tuple(jnp.asarray(x) for x in (motion.q[0], motion.v[0]))
        arrays = jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, float) else x, params)
        slip = _slips(system, e.q0, arrays, ts, jnp.asarray(motion.q), jnp.asarray(motion.v))
        if slip is not None:
            slip = np.abs(np.asarray(slip))
            slides = np.all(slip > SLOW * np.max(slip[used], axis=0), axis=1)
            used &= np.convolve(~slides, np.ones(2 * NEIGHBOURS + 1), mode="same") < 0.5
        count = motion.q.shape[1] + _constraints(flat, e.ts[0], *point).size
        return cls(system, e.q0, e.params, ts, tuple(map(jnp.asarray, motion[1:])), used[:, None] * np.ones(count))

    def residuals(self, params, t, q, v, a):
        """P (M q̈ − f), g and a."""
        flat = bind(self.system, self.like, with_own(params, self.own))
        M, inertial = inertia(flat, t, q, v)
        _, G, _ = constraint_rows(flat, t, q, v)
        force = lambda multipliers: M.mv(a) - inertial - applied_force(flat, t, q, v, multipliers)
        to_multipliers = pseudo_inverse(G @ G.T) @ G if len(G) else G
        r = force(jnp.zeros(len(G), q.dtype))
        if flat.needs_multipliers:
            r = force(to_multipliers @ r)
        return jnp.concatenate([r - G.T @ (to_multipliers @ r), _constraints(flat, t, q, v)])

    def linearised(self, free, y):
        """Residuals of all equations and samples, flat, and their Jacobian."""
        return _linearised(self, free, y)

    def first_weights(self, free):
        """One over the size of the terms of each equation at the start: those with a parameter, and the others."""
        r, J = self.linearised(free, jnp.zeros(free.size))
        return self.weights(np.abs(np.asarray(r)) + np.linalg.norm(np.asarray(J), axis=1))

    def weights(self, sizes):
        """One over the root mean square of the sizes, for each equation."""
        used, sizes = self.used > 0, np.asarray(sizes).reshape(self.used.shape)
        rms = np.sqrt(np.sum(np.where(used, sizes, 0) ** 2, axis=0) / np.maximum(used.sum(axis=0), 1))
        return (used / np.maximum(rms, 1e-9 * np.max(rms, initial=1e-300))).ravel()


@compiled
def _linearised(record, free, y):
    def residuals(y):
        params = free.insert(free.theta(y))
        return jax.vmap(lambda t, q, v, a: record.residuals(params, t, q, v, a))(record.ts, *record.motion).ravel()

    return residuals(y), jax.jacfwd(residuals)(y)


def _constraints(flat, t, q, v):
    """Residuals of the constraints on positions and velocities."""
    return jnp.concatenate([flat.holonomic(t, q), flat.nonholonomic(t, q, v)])


def _weighted(records, free, y, weights):
    """Weighted residuals of all records, and their Jacobian."""
    parts = [record.linearised(free, y) for record in records]
    rows = [(r * w, J * w[:, None]) for (r, J), w in zip(parts, weights, strict=True)]
    return tuple(jnp.concatenate(x) for x in zip(*rows, strict=True))


def _is_linear(records, free):
    """Whether the Jacobian is the same at another point."""
    y = jnp.zeros(free.size)
    elsewhere = y + 0.37 * jnp.cos(1.0 + jnp.arange(y.size))
    pairs = [(np.asarray(record.linearised(free, y)[1]), np.asarray(record.linearised(free, elsewhere)[1])) for record in records]
    return all(np.linalg.norm(here - there) <= LINEAR * np.linalg.norm(here) for here, there in pairs)


def _refuse_homogeneous(records, free, weights):
    """Refuses linear equations without a known term."""
    y = jnp.zeros(free.size)
    r, J = (np.asarray(x) for x in _weighted(records, free, y, weights))
    to_zero = -np.asarray(free.theta(y) / free.slope(y))
    if np.linalg.norm(r + J @ to_zero) <= LINEAR * np.linalg.norm(np.abs(J) @ np.abs(to_zero)):
        raise ValueError(
            f"`free` must leave a known term in the equations of motion, but every term has a factor out of {', '.join(free.names)}: "
            "only their ratios are determined. Fix one of them."
        )


def _solve_nonlinear(records, free, y, weights):
    linearise = lambda y: (*_weighted(records, free, y, weights), ())
    freedom = int(sum(np.count_nonzero(w) for w in weights))
    return levenberg_marquardt(linearise, y, freedom=freedom, max_steps=100, tolerance=1e-3, bounds=free.bounds).best.y


def _solve_linear(records, free, y, weights):
    """In one step; what is not determined keeps its value."""
    r, J = (np.asarray(x) for x in _weighted(records, free, y, weights))
    size = np.linalg.norm(J, axis=0)
    scale = np.where(size > 0, 1 / np.where(size > 0, size, 1), 0)
    return y + scale * np.linalg.lstsq(J * scale, -r, rcond=1e-9)[0]
