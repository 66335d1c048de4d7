"""The equations of motion as a first-order system, ready to be integrated.

    y = (q, q̇, work of each term, σ of each slip, which elements others hold at their bound, number of transitions, time stuck)

Works are there where they were asked for, the last four where D has kinks.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .._mechanics.friction_terms import Kinks, kinks_of
from .._mechanics.power import energy_turnover, listed_powers
from .._mechanics.projection import Baumgarte, NoStabilisation, Projection
from .._mechanics.saddle_point import Sound, constrained_acceleration
from .._mechanics.stick_slip import (
    Mode,
    Regularised,
    StickSlip,
    first_mode,
    friction,
    friction_by_term,
    in_mode,
    redirected,
    settle,
    slip_of,
    sticking,
)
from .._model.signal import least_spacing
from .._model.system import Flat, System, bind
from .._program.jit import jitted
from .._program.scalarise import scalarised

PROJECTION = "projection"  # how the work that projection does is named
SLIGHT = 1e7  # times the tolerance, beside which a slip of a thousand tolerances is little


class Parts(NamedTuple):
    """y, taken apart."""

    q: Float[Array, " n"]
    v: Float[Array, " n"]
    works: Float[Array, " w"]
    sigma: Float[Array, " r"]
    held: Float[Array, " e"]  # 1 or 0
    transitions: Float[Array, " 0|1"]
    time_stuck: Float[Array, " e"]


class Start(NamedTuple):
    """y at the start; whether a mode of friction agrees with its forces; whether no bound is negative."""

    y: Float[Array, " y"]
    has_mode: Bool[Array, ""]
    has_bounds: Bool[Array, ""]


class Beyond(NamedTuple):
    """By how much a sample is beyond the end of its mode of friction, and beside that what is little; twice per element."""

    excess: Float[Array, " m"]
    scale: Float[Array, " m"]


class Sample(NamedTuple):
    """One sample of a motion: what a `Trajectory` holds of it."""

    q: PyTree
    qdot: PyTree
    qddot: PyTree
    multipliers: dict[str, PyTree]
    works: dict[str, Array] | None
    friction: dict[str, tuple[Array, Array]]
    counts: dict[str, Array]
    sound: Sound
    beyond: Beyond


@dataclasses.dataclass(frozen=True)
class Equations:
    """ẏ and what else the integration asks for; `args` are (params, scales)."""

    system: System
    like: tuple  # structure, shapes and dtype of q
    stabilisation: Projection | Baumgarte | NoStabilisation
    friction: StickSlip | Regularised
    audit: bool
    rows: int  # of slip velocities with dry friction
    elements: int

    @classmethod
    def of(cls, system, q0, stabilisation, friction, audit, t, q, v, params) -> "Equations":
        """Looks for dry friction at the start, in shapes alone."""
        leaves, structure = jax.tree.flatten(q0)
        like = structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        equations = cls(system, like, stabilisation, friction, audit, 0, 0)
        kinks = kinks_of(equations.flat(params), t, q, v) if isinstance(friction, StickSlip) else None
        if kinks is None:
            return equations
        return dataclasses.replace(equations, rows=kinks.element_of_row.size, elements=kinks.elements)

    def flat(self, params) -> Flat:
        """The system over flat vectors."""
        structure, shapes = self.like
        return bind(self.system, jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*shape) for shape in shapes]), params)

    def mode(self, t, q, v, sigma, args) -> tuple[Flat, Flat, Kinks | None]:
        """The system, the system in the mode σ, and its kinks where there is dry friction."""
        params, scales = args
        flat = self.flat(params)
        if isinstance(self.friction, StickSlip) and self.rows == 0:
            return flat, flat, None
        kinks = kinks_of(flat, t, q, v)
        if isinstance(self.friction, Regularised):
            return flat, flat if kinks is None else self.friction.smooth(flat, kinks), None
        assert kinks is not None  # rows were counted from them
        if scales is not None and np.any(kinks.several):
            slow = slip_of(kinks, t, q, v, jnp.full_like(v, scales.slow))
            kinks = kinks._replace(near_rest=jax.lax.stop_gradient(jnp.where(kinks.several, slow, 0)))
        return flat, in_mode(flat, kinks, sigma), kinks

    @property
    def works(self) -> tuple[str, ...]:
        """Names of the works that are integrated."""
        return (*self.system.terms, PROJECTION) if self.audit else ()

    @property
    def size(self) -> int:
        """n, the number of coordinates."""
        return sum(int(np.prod(shape)) for shape, _ in self.like[1])

    def parts(self, y) -> Parts:
        """y, taken apart."""
        sizes = [self.size, self.size, len(self.works), self.rows, self.elements, min(self.elements, 1)]
        return Parts(*jnp.split(y, np.cumsum(sizes)))

    @property
    def projection(self) -> Projection | None:
        """What puts steps back on the constraints, and on s = 0 where friction sticks, if anything has to."""
        chosen = self.stabilisation if isinstance(self.stabilisation, Projection) else None
        if self.rows:
            return chosen or Projection()
        return chosen if self.system.constraints else None

    def start(self, t, q, v, params) -> Start:
        """y at the start, on the constraints already."""
        flat, _, kinks = self.mode(t, q, v, jnp.zeros(self.rows, q.dtype), (params, None))
        works = jnp.zeros(len(self.works), q.dtype)
        if kinks is None:
            return Start(jnp.concatenate([q, v, works]), jnp.array(True), jnp.array(True))
        mode = first_mode(flat, kinks, t, q, v)
        y = jnp.concatenate([q, v, works, mode.sigma, mode.held.astype(q.dtype), jnp.zeros(1 + self.elements, q.dtype)])
        return Start(self.kept(t, y, (params, None)), mode.consistent, ~jnp.any(mode.bound < 0))

    def rates(self, t, y, args):
        """ẏ."""
        return _rates(self, t, y, args)

    def kept(self, t, y, args):
        """y, put back on the constraints."""
        return _kept(self, t, y, args)

    def error_norm(self, error):
        """The size of an error."""
        return root_mean_square(error)

    def margins(self, t, y, args):
        """Per element of dry friction, how far its mode is from its end, negative beyond; and then its bound."""
        return _margins(self, t, y, args)

    def changed(self, t, y, args, ended):
        """y in the mode that follows where the modes of the elements `ended` have; whether there is one; whether slip has come to rest."""
        return _changed(self, t, y, args, ended)

    def exhausted(self, y):
        """Whether there were more transitions than allowed."""
        return self.parts(y).transitions[0] > self.friction.max_transitions

    def sample(self, t, y, params, tolerances) -> Sample:
        """One sample, from y on the constraints."""
        rtol, atol = tolerances
        q, v, works, sigma, held, transitions, time_stuck = self.parts(y)
        flat, _, kinks = self.mode(t, q, v, sigma, (params, None))
        rubbing, counts, beyond = {}, {}, Beyond(jnp.zeros(0), jnp.zeros(0))
        if kinks is None:
            qddot, multipliers, sound = _accelerated(self, t, y, (params, None))
        else:
            found = friction(flat, kinks, sigma, t, q, v, self.stabilisation.feedback())
            qddot, multipliers, sound = found.qddot, found.multipliers, Sound(jnp.array(True), jnp.array(True))
            rubbing = friction_by_term(kinks, sigma, held > 0, t, q, v, found)
            stuck, load = sticking(kinks, sigma), kinks.norms(found.force)
            scale = jnp.where(stuck, jnp.abs(found.bound) + load, slip_of(kinks, t, q, v, SLIGHT * (rtol * jnp.abs(v) + atol)))
            excess = jnp.where(held > 0, 0, -found.margin)
            beyond = Beyond(jnp.concatenate([excess, -found.bound]), jnp.concatenate([scale, jnp.abs(found.bound)]))
            counts = {"transitions": transitions[0], "time_stuck": time_stuck}
        named = dict(zip(self.works, works, strict=True)) if self.audit else None
        unraveled = flat.unravel(q), flat.unravel(v), flat.unravel(qddot), flat.unravel_multipliers(multipliers)
        return Sample(*unraveled, named, rubbing, counts, sound, jax.lax.stop_gradient(beyond))


@jitted  # so that diffrax's many calls trace it once
def _accelerated(equations: Equations, t, y, args):
    q, v, _, sigma, *_ = equations.parts(y)
    _, mode, _ = equations.mode(t, q, v, sigma, args)
    feedback = equations.stabilisation.feedback()
    return scalarised(lambda t, q, v: constrained_acceleration(mode, t, q, v, feedback))(t, q, v)


@jitted
def _rates(equations: Equations, t, y, args):
    q, v, works, sigma, held, transitions, time_stuck = equations.parts(y)
    _, mode, kinks = equations.mode(t, q, v, sigma, args)
    qddot = _accelerated(equations, t, y, args).x
    powers = listed_powers(mode, t, q, v) if equations.audit else works
    stuck = time_stuck if kinks is None else jnp.maximum(sticking(kinks, sigma).astype(y.dtype), held)
    return jnp.concatenate([v, qddot, powers, 0 * sigma, 0 * held, 0 * transitions, stuck])


@jitted
def _margins(equations: Equations, t, y, args):
    q, v, _, sigma, held, *_ = equations.parts(y)
    flat, _, kinks = equations.mode(t, q, v, sigma, args)
    assert kinks is not None  # asked of systems with dry friction alone
    found = friction(flat, kinks, sigma, t, q, v)
    return jnp.concatenate([jnp.where(held > 0, 1, found.margin), found.bound])


@jitted
def _changed(equations: Equations, t, y, args, ended):
    _, scales = args
    q, v, _, sigma, held, *_ = equations.parts(y)
    flat, _, kinks = equations.mode(t, q, v, sigma, args)
    assert kinks is not None
    stuck = sticking(kinks, sigma) | (held > 0)
    slow = kinks.norms(kinks.slip(t, q, v)) <= slip_of(kinks, t, q, v, scales.error(v))
    mode = settle(flat, kinks, t, q, v, sigma, stuck | ended | slow, ended & stuck)
    y = in_other_mode(equations, kinks, y, mode)
    return equations.kept(t, y, args), mode.consistent, jnp.all(~ended | stuck | slow)


def in_other_mode(equations: Equations, kinks: Kinks, y, mode: Mode):
    """y with another mode, and its transitions counted: what begins or ceases to slip, or slips another way, where there is friction."""
    q, v, works, sigma, held, transitions, time_stuck = equations.parts(y)
    of = kinks.element_of_row
    before, after = jnp.where((held > 0)[of], 0, sigma), jnp.where(mode.held[of], 0, mode.sigma)
    changes = jnp.sum((kinks.norms(after - before) > 0.5) & (mode.bound != 0))
    return jnp.concatenate([q, v, works, mode.sigma, mode.held.astype(y.dtype), transitions + changes, time_stuck])


@jitted
def _kept(equations: Equations, t, y, args):
    q, v, works, sigma, held, *counts = equations.parts(y)
    _, mode, kinks = equations.mode(t, q, v, sigma, args)
    assert equations.projection is not None  # asked where there is something to keep
    projection = equations.projection
    on_q, on_v = scalarised(lambda t, q, v: projection.project(mode, t, q, v))(t, q, v)
    if equations.audit:
        lift = energy_turnover(mode, t, on_q, on_v)[0] - energy_turnover(mode, t, q, v)[0]
        works = works.at[equations.works.index(PROJECTION)].add(lift)
    if kinks is not None:
        sigma = jax.lax.stop_gradient(redirected(kinks, sigma, held > 0, t, on_q, on_v))
    return jnp.concatenate([on_q, on_v, works, sigma, held, *counts])


def root_mean_square(x) -> Array:
    """Of each column; not differentiated, as the length of a step is not."""
    return jnp.sqrt(jnp.mean(jax.lax.stop_gradient(x) ** 2, axis=0))


class Scales(NamedTuple):
    """What counts as small in a motion: the tolerances, how long it is, how finely its inputs are given, the rounding of its times."""

    rtol: Any
    atol: Any
    duration: Any
    spacing: Any
    rounding: Any

    @classmethod
    def of(cls, tolerances, ts, params) -> "Scales":
        """Of a motion at the times `ts`."""
        end = jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1]))
        rtol, atol = tolerances
        found = cls(rtol, atol, ts[-1] - ts[0], least_spacing(params, ts.dtype), jnp.finfo(ts.dtype).eps * end)
        return jax.lax.stop_gradient(found)

    @property
    def slow(self) -> Array:
        """Of each velocity, what is so slow that the direction of a slip is not worth the many steps that it would take.

        Where elements begin to slide together, a velocity may be off by so much.
        """
        return 1e2 * self.atol

    def error(self, v) -> Array:
        """Of each velocity, what the integration may be off by: so little slip counts as rest where another element changes its mode."""
        return 10 * (self.rtol * jnp.abs(v) + self.atol)
