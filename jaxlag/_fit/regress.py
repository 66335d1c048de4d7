"""Inverse-dynamics identification: parameters from the equations of motion themselves, without a simulation."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._mechanics.friction_terms import kinks_of
from .._mechanics.lagrange import applied_force, constraint_rows, inertia
from .._mechanics.saddle_point import pseudo_inverse
from .._model.system import System, bind
from .._program.jit import compiled
from .experiment import Experiment, measured, with_own
from .identifiability import determined_by
from .levenberg_marquardt import levenberg_marquardt
from .parameters import Free
from .result import plus_minus
from .smoothing_spline import smooth

ENDS = 0.03  # of the record at each end, where the derivatives of splines are poor
SLOW = 0.03  # of the largest slip velocity: below, friction may stick and is not known
ASIDE = 3  # samples beside those, where the acceleration jumps
ROUNDS = 3  # of weighing the equations by what they are off


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Regression:
    """Parameters by regression on the equations of motion; printed, a table.

    - `params`: all parameters, the free ones at their estimate: a start for `fit`. `estimates`: the free ones alone, by name.
    - `standard_errors`: like `estimates`; too small where the derivatives of the motion are uncertain. Infinite where undetermined.
    - `linear`: whether the equations are linear in the free parameters, so that one step solved them.
    - `names`: of the numbers in flat order.
    """

    params: PyTree
    estimates: dict[str, PyTree]
    standard_errors: dict[str, PyTree]
    names: tuple[str, ...]
    linear: bool

    def __repr__(self) -> str:
        how = "linear, solved in one step" if self.linear else "nonlinear"
        values, errors = (
            np.concatenate([np.ravel(np.asarray(x)) for name in self.estimates for x in jax.tree.leaves(tree[name])])
            for tree in (self.estimates, self.standard_errors)
        )
        width = max(map(len, self.names))
        spoken = lambda v, e: plus_minus(v, e) if np.isfinite(e) else "not determined by these measurements"
        rows = [f"  {n:<{width}}  {spoken(v, e)}" for n, v, e in zip(self.names, values, errors, strict=True)]
        return "\n".join([f"Regression: {len(self.names)} parameters, {how}; starting values for `fit`, biased by the noise", *rows])


def regress(
    system: System,
    experiments: Experiment | Sequence[Experiment],
    params: PyTree,
    *,
    free: Sequence[str],
    bounds: Mapping[str, Any] | None = None,
) -> Regression:
    r"""Parameters by least squares in the equations of motion, on the measured motion: no simulation, and no starting values needed.

    $$ \min_\theta \sum_i |w\,P (M \ddot q - f)|^2_{t_i} + |w\,g|^2_{t_i} + |w\,a|^2_{t_i}, \qquad P = 1 - G^T (G G^T)^+ G $$

    with splines through the measurements for q, q̇ and q̈; P takes the unknown constraint forces out. Where the equations are linear in
    the parameters, which differentiating them shows, one step solves them: the inverse-dynamics method of robotics (IDIM-LS). Rows are
    weighted by what they are off. Samples at the ends, and those where dry friction may stick, are left out.

    **Arguments:**

    - `experiments`, `params`, `free`, `bounds`: as for `fit`; free parameters that are NaN need no start. Parameters of the experiments'
      own are taken as they are, and starts that are `unknown` are not used.

    **Returns:** a `Regression`. Any consistent units. Its estimates are biased by noise in q̇ and q̈; `fit` is not.

    **Raises:** `ValueError` where nothing but ratios of the parameters is in the equations, or the sensors do not see the motion.

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
    params = Free.of(params, free, bounds).started()
    named, unbounded = Free.of(params, free, bounds), Free.of(params, free)
    if named.size == 0:
        raise ValueError("`free` must name at least one entry of params, but is empty. Say which parameters to identify.")
    equations = [_Equations.along(system, e, params) for e in experiments]
    weights = [piece.scaled(named) for piece in equations]
    y, linear = jnp.zeros(named.size), _is_linear(equations, unbounded)
    if linear:
        _refuse_homogeneous(equations, unbounded, weights)
    linear &= not np.any(np.isfinite(named.lower) | np.isfinite(named.upper))
    for _ in range(ROUNDS):
        y = (_solved if linear else _iterated)(equations, named, y, weights)
        weights = [piece.over(np.abs(piece.linearised(named, y)[0])) for piece in equations]
    r, J = (np.asarray(x) for x in _weighted(equations, named, y, weights))
    slope, known = np.asarray(named.slope(y)), determined_by(J, np.zeros((0, named.size)))
    spread = np.linalg.norm(r) / np.sqrt(max(int(np.count_nonzero(r)) - named.size, 1))
    errors = np.where(known.determined, spread * slope * np.sqrt(np.diag(known.covariance)), np.inf)
    theta = named.theta(y)
    return Regression(named.insert(theta), named.by_name(theta), named.by_name(jnp.asarray(errors)), named.entries, linear)


@eqx.filter_jit  # so that what is looked for is unknown, and a friction of 0 is one, too
def _slips(system, like, params, ts, q, v):
    """Slip velocities of dry friction along a record, where there is any."""
    kinks = kinks_of(bind(system, like, params), ts[0], q[0], v[0])
    return None if kinks is None else jax.vmap(kinks.slip)(ts, q, v)


class _Equations(eqx.Module):
    """The equations of motion along a smoothed record; `used` of samples × rows is zero where a sample is left out."""

    system: System = eqx.field(static=True)
    like: PyTree
    own: dict[str, Any]
    ts: Any
    motion: tuple
    used: Any

    @classmethod
    def along(cls, system, e, params):
        motion = smooth(e, params, between=True)
        ts = jnp.asarray(motion.ts)
        every = with_own(params, e.params)
        flat = bind(system, e.q0, every)
        used = np.abs(np.linspace(-1, 1, ts.size)) <= 1 - 2 * ENDS
        point = tuple(jnp.asarray(x) for x in (motion.q[0], motion.v[0]))
        unknown = jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, float) else x, every)
        slip = _slips(system, e.q0, unknown, ts, jnp.asarray(motion.q), jnp.asarray(motion.v))
        if slip is not None:
            slip = np.abs(np.asarray(slip))
            slides = np.all(slip > SLOW * np.max(slip[used], axis=0), axis=1)
            used &= np.convolve(~slides, np.ones(2 * ASIDE + 1), mode="same") < 0.5
        rows = motion.q.shape[1] + _extra(flat, e.ts[0], *point).size
        return cls(system, e.q0, e.params, ts, tuple(map(jnp.asarray, motion[1:])), used[:, None] * np.ones(rows))

    def rows(self, params, t, q, v, a):
        """P (M q̈ − f), g and a."""
        flat = bind(self.system, self.like, with_own(params, self.own))
        M, inertial = inertia(flat, t, q, v)
        _, G, _ = constraint_rows(flat, t, q, v)
        force = lambda multipliers: M.mv(a) - inertial - applied_force(flat, t, q, v, multipliers)
        spread = pseudo_inverse(G @ G.T) @ G if len(G) else G
        off = force(jnp.zeros(len(G), q.dtype))
        if flat.needs_multipliers:
            off = force(spread @ off)
        return jnp.concatenate([off - G.T @ (spread @ off), _extra(flat, t, q, v)])

    def linearised(self, free, y):
        """All rows, flat, and their Jacobian."""
        return _linearised(self, free, y)

    def scaled(self, free):
        """Weights by the size of what is added up in a row at the start: its Jacobian, and what no parameter changes."""
        r, J = self.linearised(free, jnp.zeros(free.size))
        return self.over(np.abs(np.asarray(r)) + np.linalg.norm(np.asarray(J), axis=1))

    def over(self, off):
        """Weights by the root mean square of each kind of row."""
        used, off = self.used > 0, np.asarray(off).reshape(self.used.shape)
        rms = np.sqrt(np.sum(np.where(used, off, 0) ** 2, axis=0) / np.maximum(used.sum(axis=0), 1))
        return (used / np.maximum(rms, 1e-9 * np.max(rms, initial=1e-300))).ravel()


@compiled
def _linearised(equations, free, y):
    def all_rows(y):
        params = free.insert(free.theta(y))
        return jax.vmap(lambda t, q, v, a: equations.rows(params, t, q, v, a))(equations.ts, *equations.motion).ravel()

    return all_rows(y), jax.jacfwd(all_rows)(y)


def _extra(flat, t, q, v):
    return jnp.concatenate([flat.holonomic(t, q), flat.nonholonomic(t, q, v)])


def _weighted(equations, named, y, weights):
    """All rows and their Jacobian, weighted."""
    parts = [piece.linearised(named, y) for piece in equations]
    rows = [(r * w, J * w[:, None]) for (r, J), w in zip(parts, weights, strict=True)]
    return tuple(jnp.concatenate(x) for x in zip(*rows, strict=True))


def _is_linear(equations, named):
    """Whether the Jacobian is the same elsewhere."""
    y = jnp.zeros(named.size)
    elsewhere = y + 0.37 * jnp.cos(1.0 + jnp.arange(y.size))
    pairs = [(np.asarray(piece.linearised(named, y)[1]), np.asarray(piece.linearised(named, elsewhere)[1])) for piece in equations]
    return all(np.linalg.norm(here - there) <= 1e-9 * np.linalg.norm(here) for here, there in pairs)


def _iterated(equations, named, y, weights):
    seen = lambda y: (*_weighted(equations, named, y, weights), ())
    freedom = int(sum(np.count_nonzero(w) for w in weights))
    return levenberg_marquardt(seen, y, freedom=freedom, max_steps=100, tolerance=1e-3, bounds=named.bounds).best.y


def _refuse_homogeneous(equations, named, weights):
    """Refuses linear equations without a known term."""
    y = jnp.zeros(named.size)
    r, J = (np.asarray(x) for x in _weighted(equations, named, y, weights))
    to_zero = -np.asarray(named.theta(y) / named.slope(y))
    if np.linalg.norm(r + J @ to_zero) <= 1e-9 * np.linalg.norm(np.abs(J) @ np.abs(to_zero)):
        raise ValueError(
            f"`free` must leave something known in the equations of motion, but every term has a factor out of {', '.join(named.names)}: "
            "only their ratios are determined. Hold one of them."
        )


def _solved(equations, named, y, weights):
    """In one step; what is not determined stays where it is."""
    r, J = (np.asarray(x) for x in _weighted(equations, named, y, weights))
    size = np.linalg.norm(J, axis=0)
    scale = np.where(size > 0, 1 / np.where(size > 0, size, 1), 0)
    return y + scale * np.linalg.lstsq(J * scale, -r, rcond=1e-9)[0]
