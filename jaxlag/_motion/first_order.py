"""The equations of motion as a first-order system, ready to be integrated.

    y = (q, q̇, work of each term, σ of each slip, which elements others hold at their bound, number of transitions, time stuck)

Works are present where they were asked for, the last four where D is nonsmooth.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .._mechanics.friction_elements import FrictionElements
from .._mechanics.power import energy_exchange, listed_powers
from .._mechanics.projection import Baumgarte, NoStabilisation, Projection
from .._mechanics.saddle_point import SaddlePoint, Sound, constrained_acceleration
from .._mechanics.stick_slip import (
    Mode,
    Regularised,
    StickSlip,
    first_mode,
    friction,
    friction_by_term,
    in_mode,
    redirected,
    select_mode,
    slip_of,
    sticking,
)
from .._model.flat import Flat, bind
from .._model.signal import broken_signals
from .._model.system import System
from .._program.jit import jitted
from .._program.scalarise import scalarised
from .interval_inputs import called_elsewhere, pieces_at, warn_of_delays
from .protocol import Arguments

PROJECTION = "projection"  # name of the work that projection does
NEGLIGIBLE = 1e7  # times the tolerance, compared with which a slip of a thousand tolerances is negligible


class Formulation(NamedTuple):
    """How the equations of motion are formulated: treatment of the constraints, treatment of dry friction, whether works are tracked."""

    stabilisation: Projection | Baumgarte | NoStabilisation = Projection()
    friction: StickSlip | Regularised = StickSlip()
    works: bool = False


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
    """y at the start; whether a friction mode is consistent with its forces; whether no bound is negative."""

    y: Float[Array, " y"]
    has_mode: Bool[Array, ""]
    has_bounds: Bool[Array, ""]


class Violation(NamedTuple):
    """How far a sample lies beyond the end of its friction mode, and the scale on which that is small; two per element."""

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


class Evidence(NamedTuple):
    """What tells whether a sample keeps the guarantees of a motion."""

    sound: Sound
    violation: Violation


@dataclasses.dataclass(frozen=True)
class EquationsOfMotion:
    """The `FirstOrderSystem` of one motion, and what locates the transitions of dry friction."""

    system: System
    like: tuple  # structure, shapes and dtype of q
    formulation: Formulation
    rows: int = 0  # slip velocities with dry friction
    elements: int = 0  # elements of dry friction
    elsewhere: frozenset[int] = frozenset()  # signals that are asked for at other times than the present

    @classmethod
    def of(cls, system: System, q0: PyTree, formulation: Formulation, params: PyTree, t, q, v) -> "EquationsOfMotion":
        """Looks for dry friction at the start, in shapes alone."""
        leaves, structure = jax.tree.flatten(q0)
        like = structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        elsewhere = (
            called_elsewhere(lambda params: _values(bind(system, q0, params), t, q, v), params) if broken_signals(params) else frozenset()
        )
        warn_of_delays(params, elsewhere)
        alone = cls(system, like, formulation, elsewhere=elsewhere)
        elements = formulation.friction.elements(alone.flat_at(t, params), t, q, v)
        return alone if elements is None else dataclasses.replace(alone, rows=elements.element_of_row.size, elements=elements.size)

    def flat(self, params: PyTree) -> Flat:
        """The system over flat vectors."""
        structure, shapes = self.like
        return bind(self.system, jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*shape) for shape in shapes]), params)

    def flat_at(self, t, params: PyTree) -> Flat:
        """The system over flat vectors at the time t: its inputs are looked up once."""
        return self.flat(pieces_at(params, self.elsewhere, t))

    def mode(self, t, q, v, sigma, args: Arguments) -> tuple[Flat, Flat, FrictionElements | None]:
        """The system, the system in the mode σ, and its elements of dry friction where there are any."""
        flat, treatment = self.flat_at(t, args.params), self.formulation.friction
        if not self.rows:
            return flat, treatment.smoothed(flat, t, q, v), None
        elements = treatment.elements(flat, t, q, v)
        assert elements is not None  # rows were counted from them
        if args.scales is not None and np.any(elements.is_vector):
            slow = slip_of(elements, t, q, v, jnp.full_like(v, args.scales.slow))
            elements = elements._replace(near_rest=jax.lax.stop_gradient(jnp.where(elements.is_vector, slow, 0)))
        return flat, in_mode(flat, elements, sigma), elements

    @property
    def works(self) -> tuple[str, ...]:
        """Names of the works that are integrated."""
        return (*self.system.terms, PROJECTION) if self.formulation.works else ()

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
        chosen = self.formulation.stabilisation.projection()
        if self.rows:
            return chosen or Projection()
        return chosen if self.system.constraints else None

    def start(self, t, q, v, params) -> Start:
        """y at the start, on the constraints already."""
        flat, _, elements = self.mode(t, q, v, jnp.zeros(self.rows, q.dtype), Arguments(params))
        works = jnp.zeros(len(self.works), q.dtype)
        if elements is None:
            return Start(jnp.concatenate([q, v, works]), jnp.array(True), jnp.array(True))
        mode = first_mode(flat, elements, t, q, v)
        y = jnp.concatenate([q, v, works, mode.sigma, mode.held.astype(q.dtype), jnp.zeros(1 + self.elements, q.dtype)])
        return Start(self.projected(t, y, Arguments(params)), mode.consistent, ~jnp.any(mode.bound < 0))

    def acceleration(self, mode: Flat, t, q, v) -> SaddlePoint:
        """q̈ and λ of the system in its mode."""
        feedback = self.formulation.stabilisation.feedback()
        return scalarised(lambda t, q, v: constrained_acceleration(mode, t, q, v, feedback))(t, q, v)

    def rates(self, t, y, args):
        """ẏ."""
        return _rates(self, t, y, args)

    def projected(self, t, y, args):
        """y, put back on the constraints."""
        return _projected(self, t, y, args)

    def error_norm(self, error):
        """The root mean square."""
        return root_mean_square(error)

    def margins(self, t, y, args):
        """Per element of dry friction, the margin of its mode, negative beyond its end; and then its bound."""
        return _margins(self, t, y, args)

    def changed(self, t, y, args, ended):
        """y in the mode that follows when those of the elements `ended` end; whether there is one; whether slip has come to rest."""
        return _changed(self, t, y, args, ended)

    def exhausted(self, y):
        """Whether there were more transitions than allowed."""
        return self.parts(y).transitions[0] > self.formulation.friction.max_transitions

    def sample(self, t, y, params, tolerances) -> tuple[Sample, Evidence]:
        """One sample, from y on the constraints."""
        rtol, atol = tolerances
        q, v, works, sigma, held, transitions, time_stuck = self.parts(y)
        flat, mode, elements = self.mode(t, q, v, sigma, Arguments(params))
        friction_states, counts, violation = {}, {}, Violation(jnp.zeros(0), jnp.zeros(0))
        if elements is None:
            qddot, multipliers, sound = self.acceleration(mode, t, q, v)
        else:
            found = friction(flat, elements, sigma, t, q, v, self.formulation.stabilisation.feedback())
            qddot, multipliers, sound = found.qddot, found.multipliers, Sound(jnp.array(True), jnp.array(True))
            friction_states = friction_by_term(elements, sigma, held > 0, t, q, v, found)
            stuck, load = sticking(elements, sigma), elements.norms(found.force)
            scale = jnp.where(stuck, jnp.abs(found.bound) + load, slip_of(elements, t, q, v, NEGLIGIBLE * (rtol * jnp.abs(v) + atol)))
            excess = jnp.where(held > 0, 0, -found.margin)
            violation = Violation(jnp.concatenate([excess, -found.bound]), jnp.concatenate([scale, jnp.abs(found.bound)]))
            counts = {"transitions": transitions[0], "time_stuck": time_stuck}
        named = dict(zip(self.works, works, strict=True)) if self.works else None
        unraveled = flat.unravel(q), flat.unravel(v), flat.unravel(qddot), flat.unravel_multipliers(multipliers)
        return Sample(*unraveled, named, friction_states, counts), Evidence(sound, jax.lax.stop_gradient(violation))


def _values(flat: Flat, t, q, v):
    """What all functions of a system return."""
    multipliers = jnp.zeros(flat.rows, v.dtype)
    given = [D(t, q, v, multipliers) for D in (*flat.dissipations.values(), *flat.forces.values())]
    return flat.lagrangian(t, q, v), flat.holonomic(t, q), flat.nonholonomic(t, q, v), given


@jitted  # so that diffrax's many calls trace it once
def _rates(equations: EquationsOfMotion, t, y, args):
    q, v, works, sigma, held, transitions, time_stuck = equations.parts(y)
    _, mode, elements = equations.mode(t, q, v, sigma, args)
    qddot = equations.acceleration(mode, t, q, v).x
    powers = listed_powers(mode, t, q, v) if equations.works else works
    stuck = time_stuck if elements is None else jnp.maximum(sticking(elements, sigma).astype(y.dtype), held)
    return jnp.concatenate([v, qddot, powers, 0 * sigma, 0 * held, 0 * transitions, stuck])


@jitted
def _margins(equations: EquationsOfMotion, t, y, args):
    q, v, _, sigma, held, *_ = equations.parts(y)
    flat, _, elements = equations.mode(t, q, v, sigma, args)
    assert elements is not None  # asked of systems with dry friction alone
    found = friction(flat, elements, sigma, t, q, v)
    return jnp.concatenate([jnp.where(held > 0, 1, found.margin), found.bound])


@jitted
def _changed(equations: EquationsOfMotion, t, y, args, ended):
    q, v, _, sigma, held, *_ = equations.parts(y)
    flat, _, elements = equations.mode(t, q, v, sigma, args)
    assert elements is not None
    stuck = sticking(elements, sigma) | (held > 0)
    slow = elements.norms(elements.slip(t, q, v)) <= slip_of(elements, t, q, v, args.scales.error(v))
    mode = select_mode(flat, elements, t, q, v, sigma, stuck | ended | slow, ended & stuck)
    y = in_other_mode(equations, elements, y, mode)
    return equations.projected(t, y, args), mode.consistent, jnp.all(~ended | stuck | slow)


def in_other_mode(equations: EquationsOfMotion, elements: FrictionElements, y, mode: Mode):
    """y with another mode, and its transitions counted: what begins or ceases to slip, or slips another way, where there is friction."""
    q, v, works, sigma, held, transitions, time_stuck = equations.parts(y)
    of = elements.element_of_row
    before, after = jnp.where((held > 0)[of], 0, sigma), jnp.where(mode.held[of], 0, mode.sigma)
    changes = jnp.sum((elements.norms(after - before) > 0.5) & (mode.bound != 0))
    return jnp.concatenate([q, v, works, mode.sigma, mode.held.astype(y.dtype), transitions + changes, time_stuck])


@jitted
def _projected(equations: EquationsOfMotion, t, y, args):
    q, v, works, sigma, held, *counts = equations.parts(y)
    _, mode, elements = equations.mode(t, q, v, sigma, args)
    assert equations.projection is not None  # asked where there is something to keep
    projection = equations.projection
    on_q, on_v = projection.project(mode, t, q, v)
    if equations.works:
        lift = energy_exchange(mode, t, on_q, on_v)[0] - energy_exchange(mode, t, q, v)[0]
        works = works.at[equations.works.index(PROJECTION)].add(lift)
    if elements is not None:
        sigma = jax.lax.stop_gradient(redirected(elements, sigma, held > 0, t, on_q, on_v))
    return jnp.concatenate([on_q, on_v, works, sigma, held, *counts])


def root_mean_square(x) -> Array:
    """Of each column; not differentiated, as the length of a step is not."""
    return jnp.sqrt(jnp.mean(jax.lax.stop_gradient(x) ** 2, axis=0))
