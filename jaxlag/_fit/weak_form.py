"""The equations of motion along a known motion, as what is integrated against test functions."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._mechanics.friction_elements import find_elements
from .._mechanics.lagrange import applied_force, constraint_rows, inertia, inertial_force
from .._mechanics.pseudo_inverse import pseudo_inverse
from .._model.flat import bind
from .._model.signal import jump_times
from .._model.system import System
from .._program.jit import compiled
from .experiment import Experiment, with_own
from .parameters import Free
from .smoothing_spline import smooth
from .windows import Windows

SLOW = 0.03  # of the largest slip velocity: below it, friction may stick, and its force is unknown
ENOUGH_NODES = 3000  # of a record; two or three in each interval: one is off by 2 % where an oscillation has nine samples a period


class WeakForm(eqx.Module):
    r"""The equations of motion of a record, before they are integrated.

    With a test function $\varphi(t)$ and $P = 1 - G^T (G G^T)^+ G$, which has no part along the constraint forces, integration by parts of
    $\int \varphi P (\dot p - F) dt = 0$, where p = ∂L/∂q̇ and F = ∂L/∂q − ∂D/∂q̇ + Q, gives

    $$ \int \dot\varphi\, P p \, dt + \int \varphi\, (\dot P p + P F) \, dt = 0 $$

    P depends on t and q alone, since constraints are affine in q̇: its rate needs no acceleration, and nothing is neglected. Coordinates
    are taken in units in which all move as fast, so that what P mixes has one unit, that of a power.
    """

    system: System = eqx.field(static=True)
    like: PyTree
    own: dict[str, Any]
    nodes: Any  # of the quadrature, (N,)
    motion: tuple  # q, v, a there
    units: Any  # of the coordinates: how fast each moves, (n,)

    def linearised(self, free: Free, y: Any) -> tuple[np.ndarray, np.ndarray]:
        """P p, Ṗ p + P F and the constraints at all nodes, (N, 2n + m), and their Jacobian, (N, 2n + m, p)."""
        terms, J = _linearised(self, free, y)
        return np.asarray(terms), np.asarray(J)

    def terms(self, params, t, q, v, a):
        """P p, Ṗ p + P F, then the residuals of the constraints."""
        flat = bind(self.system, self.like, with_own(params, self.own))
        p, force = (self.units * jax.grad(flat.lagrangian, argnums=i)(t, q, v) for i in (2, 1))
        applied = lambda multipliers: self.units * applied_force(flat, t, q, v, multipliers)
        rows = lambda t, q: constraint_rows(flat, t, q, v)[1] * self.units[None]
        G = rows(t, q)
        multipliers = jnp.zeros(len(G), q.dtype)
        if not len(G):
            return jnp.concatenate([p, force + applied(multipliers)])
        if flat.needs_multipliers:  # the only place where the acceleration is needed
            M, inertial = inertia(flat, t, q, v), inertial_force(flat, t, q, v)
            multipliers = pseudo_inverse(G @ G.T) @ (G @ (self.units * (M.mv(a) - inertial) - applied(multipliers)))

        def projected(t, q, x):
            G = rows(t, q)
            return x - G.T @ (pseudo_inverse(G @ G.T) @ (G @ x))

        Pp, rate = jax.jvp(lambda t, q: projected(t, q, p), (t, q), (jnp.ones_like(t), v))
        force = projected(t, q, force + applied(multipliers))
        return jnp.concatenate([Pp, rate + force, flat.holonomic(t, q), flat.nonholonomic(t, q, v)])


class Record(NamedTuple):
    """An experiment, smoothed, as the regression sees it: its weak form, and N nodes with weights of a quadrature."""

    form: WeakForm
    nodes: np.ndarray
    quadrature: np.ndarray
    moves: np.ndarray  # (N,), whether all dry friction slides there
    span: tuple[float, float]
    interval: float  # between samples, on average

    @classmethod
    def of(cls, system: System, e: Experiment, params: PyTree) -> "Record":
        """From the measurements."""
        own, ts = with_own(params, e.params), np.asarray(e.ts, float)
        nodes, quadrature = _quadrature(ts, jump_times(own, float))
        arrays = jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, float) else x, own)
        slips = lambda motion: np.asarray(_slips(system, e.q0, arrays, *(jnp.asarray(x, e.ts.dtype) for x in motion[:3])))
        smoothed = smooth(e, params, nodes, lambda motion: _kinks(nodes, slips(motion)))
        motion = tuple(jnp.asarray(x, e.ts.dtype) for x in smoothed[1:])
        speeds = np.sqrt(np.mean(np.asarray(motion[1]) ** 2, axis=0))
        units = jnp.asarray(np.where(speeds > 0, speeds, 1), e.ts.dtype)
        form = WeakForm(system, e.q0, e.params, jnp.asarray(nodes, e.ts.dtype), motion, units)
        moves = ~np.any(_is_slow(slips(smoothed)), axis=1)
        return cls(form, nodes, quadrature, moves, (ts[0], ts[-1]), (ts[-1] - ts[0]) / max(_most_samples(e) - 1, 1))

    def windows(self, half: float) -> Windows:
        """The windows of this half width along the record."""
        return Windows.along(self.nodes, self.quadrature, self.moves, self.span, half)

    def parts(self, terms: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What `WeakForm.terms` returns, or its Jacobian: of the momentum, of the forces and of the constraints."""
        n = self.form.motion[0].shape[1]
        return terms[:, :n], terms[:, n : 2 * n], terms[:, 2 * n :]


def _most_samples(e):
    """Of all channels."""
    return max(int(np.sum(np.any(np.isfinite(np.reshape(z, (len(z), -1))), axis=1))) for z in jax.tree.leaves(e.values))


def _quadrature(ts, jumps):
    """Nodes and weights of Gauss and Legendre for the intervals between samples and jumps, within which inputs are smooth."""
    edges = np.unique(ts if jumps is None else np.concatenate([ts, np.clip(np.asarray(jumps), ts[0], ts[-1])]))
    x, w = np.polynomial.legendre.leggauss(int(np.clip(np.ceil(ENOUGH_NODES / edges.size), 2, 3)))
    half = np.diff(edges)[:, None] / 2
    return (edges[:-1, None] + half * (1 + x)).ravel(), (half * w).ravel()


def _is_slow(slip):
    """Whether each slip velocity is so close to zero that friction may stick, (N, slips)."""
    speed = np.abs(slip)
    return speed <= SLOW * np.max(speed, axis=0, initial=0.0)


def _kinks(ts, slip):
    """The times at which dry friction reverses, begins to stick and ends to: where slip velocities beside a slow stretch extrapolate to
    zero, or where they pass through it from one moment to the next.
    """
    if not slip.size:
        return np.zeros(0)
    with np.errstate(divide="ignore", invalid="ignore"):  # of nodes at one time
        rates, slow = np.gradient(slip, ts, axis=0), _is_slow(slip)
    at = np.concatenate([~slow[:-1] & slow[1:], np.zeros_like(slow[:1])]) | np.concatenate([np.zeros_like(slow[:1]), slow[:-1] & ~slow[1:]])
    at[:-1] |= ~slow[:-1] & ~slow[1:] & (slip[:-1] * slip[1:] < 0)
    i, j = np.nonzero(at & np.isfinite(rates) & (rates != 0))
    return np.unique(np.clip(ts[i] - slip[i, j] / rates[i, j], ts[0], ts[-1]))


@eqx.filter_jit  # so that all parameters are traced: a friction coefficient of 0 is still friction
def _slips(system, like, params, ts, q, v):
    """Slip velocities of dry friction along a record, (T, slips)."""
    elements = find_elements(bind(system, like, params))
    return jnp.zeros((ts.size, 0)) if elements is None else jax.vmap(elements.slip)(ts, q, v)


@compiled
def _linearised(form, free, y):
    def terms(y):
        params = free.insert(free.theta(y))
        return jax.vmap(lambda t, q, v, a: form.terms(params, t, q, v, a))(form.nodes, *form.motion)

    return terms(y), jax.jacfwd(terms)(y)
