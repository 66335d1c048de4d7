"""The return map of a motion: from its state at a section to the state at the next passage, or from one period of a force to the next."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Complex, Float, PyTree

from .._mechanics.friction_treatment import Regularised, StickSlip
from .._model.event import Event, Every
from .._model.injection import call
from .._model.system import System
from .._motion.simulate import simulate
from .._motion.step_size import SHARE
from .._program.jit import compiled
from .eigenvalues import eigen
from .newton import differentiable_root, is_nothing, least_change

ITERATIONS = 30
SECTION = "the section"  # its name among the events of the system
LATER = 0.382  # of a period: a second start, from which the motion is checked to return, too
MANY = 1000  # last digits of the clock: their effect is visible against the errors of the integration
OF_SLOPES = 10  # errors of the integration in a derivative, below which an entry of the state returns whatever it is
BY_STEPS = 10  # last digits: the error of a motion if each of some hundred steps errs by one


class Setting(NamedTuple):
    """Settings of the search: the section, the entries of the state that return, the computation of motions, and after how many passages
    through the section, or periods of the force, the state returns.
    """

    section: Event | Every
    returning: tuple[int, ...]
    friction: StickSlip | Regularised
    solver: Any  # of diffrax, or None
    max_steps: int
    turns: int = 1

    def of_motions(self) -> dict[str, Any]:
        """The settings that are arguments of `simulate`."""
        return {"friction": self.friction, "solver": self.solver, "max_steps": self.max_steps}


class Given(NamedTuple):
    """The numbers from which the search starts."""

    start: dict[str, PyTree]  # q, qdot and states
    params: PyTree
    t: Float[Array, ""]
    longest: Float[Array, ""]
    tolerances: tuple[Array, Array | None]


class Orbit(NamedTuple):
    """The state at the section, with entries of the guess where they do not return; the period; the change of the state in one period; the
    eigenvalues of the return map. Whether the guess passed through the section twice, whether the motion returns, and whether it does so
    from any start time; and the residual of the return.
    """

    start: dict[str, PyTree]
    period: Float[Array, ""]
    change: dict[str, PyTree]
    multipliers: Complex[Array, " k"]
    passes: Bool[Array, ""]
    returns: Bool[Array, ""]
    always: Bool[Array, ""]
    left: Float[Array, " k"]


class Frame(NamedTuple):
    """Numbers of the return map: the given ones, the state at a passage, the time to the next, and the time limit for a third."""

    given: Given
    first: Float[Array, " s"]
    usual: Float[Array, ""]
    longest: Float[Array, ""]


@compiled
def orbit_near(system: System, setting: Setting, given: Given) -> Orbit:
    """The periodic motion that Newton's method finds from a guess, differentiable by the implicit function theorem."""
    guess, unravel = ravel_pytree(given.start)
    of, is_forced = np.array(setting.returning, int), isinstance(setting.section, Every)
    usual = forced_period(setting, given) if is_forced else jnp.zeros(())
    first = (guess, usual, usual) if is_forced else _first_passage(system, setting, given)
    frame = Frame(given, *jax.lax.stop_gradient(first))

    def returned(frame, w, t):
        """The state at the next passage, and the time until then."""
        return passage(system, setting, frame, unravel(frame.first.at[of].set(w)), t)

    def residual(frame, w):
        return returned(frame, w, frame.given.t)[0][of] - w

    scales = jax.lax.stop_gradient(scales_of(frame)[of])
    near = _newton(lambda w: residual(jax.lax.stop_gradient(frame), w), frame.first[of], given.tolerances[0], scales)
    w = differentiable_root(residual, frame, near, scales)

    def at(t):
        """The return from another start time, and its Jacobian."""

        def of_w(w):
            after, time = returned(frame, w, t)
            return after[of], (after, time)

        slope, (after, time) = jax.jacfwd(of_w, has_aux=True)(w)
        return after, time, slope

    later = given.t + (1 if is_forced else LATER) * frame.usual
    starts = jnp.stack([given.t, later, later + MANY * jnp.finfo(later.dtype).eps * jnp.abs(later)])
    ends, times, slopes = jax.lax.map(at, starts)
    left = ends[:, of] - w[None]
    of_clock = BY_STEPS * jnp.abs(left[2] - left[1]) / MANY  # a late clock gives the phase of a force to few digits
    sizes = jnp.abs(slopes[0] - jnp.eye(w.size)) @ jnp.maximum(jnp.abs(w), scales)
    of_motion = given.tolerances[0] * jnp.maximum(jnp.abs(w), SHARE * scales)  # all that is left where every motion returns
    finds = [is_nothing(jnp.maximum(jnp.abs(off) - of_clock - of_motion, 0), sizes) for off in left[:2]]
    values, here = eigen(slopes[0]).values[::-1], frame.first.at[of].set(w)
    checks = jnp.all(jnp.isfinite(frame.first)), *finds
    return Orbit(unravel(here), times[0], unravel(ends[0] - here), values, *jax.lax.stop_gradient((*checks, left[0])))


def scales_of(frame: Frame) -> Float[Array, " s"]:
    """`sizes_of`, and 1 where these are zero."""
    sizes = sizes_of(frame)
    return jnp.where(sizes > 0, sizes, 1)


def sizes_of(frame: Frame) -> Float[Array, " s"]:
    """The size of each entry of the state over a period: if the entry is zero at the section, it follows from its rate or integral."""
    n, period = ravel_pytree(frame.given.start["q"])[0].size, frame.usual
    q, v, states = jnp.split(jnp.abs(frame.first), [n, 2 * n])
    return jnp.concatenate([q + period * v, v + q / period, states])


def _newton(residual: Callable, w: Float[Array, " k"], rtol: Array, scale: Float[Array, " k"]) -> Float[Array, " k"]:
    """The root near w. The last step is as small as the errors of the integration."""

    def turn(carry):
        w, _, i = carry
        both = lambda w: (found := residual(w), found)
        slope, left = jax.jacfwd(both, has_aux=True)(w)
        shares = jnp.abs(slope) * scale[None, :] / scale[:, None]
        step = -least_change(jnp.where(shares > OF_SLOPES * rtol, slope, 0), left, scale)
        return w + step, jnp.all(jnp.abs(step) <= rtol * jnp.maximum(jnp.abs(w), SHARE * scale)), i + 1

    def going_on(carry):
        w, done, i = carry
        return ~done & (i < ITERATIONS) & jnp.all(jnp.isfinite(w))

    return jax.lax.while_loop(going_on, turn, (w, jnp.array(False), jnp.array(0)))[0]


def _motion(system, setting, given, start, t, longest):
    """The motion from a state for some time, and its passages through the section."""
    events = dict(system.events)
    if isinstance(setting.section, Event):
        events[SECTION] = setting.section
    of = dict(events=events, rtol=given.tolerances[0], atol=given.tolerances[1], throw=False)
    times = jnp.stack([t, t + longest])
    return simulate(system, start["q"], start["qdot"], times, given.params, states=start["states"], **setting.of_motions(), **of)


def _state(q, qdot, states, i):
    """The flat state at sample i."""
    return ravel_pytree(jax.tree.map(lambda x: x[i], {"q": q, "qdot": qdot, "states": states}))[0]


def _first_passage(system, setting, given):
    """The state at the second passage of the motion from the guess, the time since the first, and the time within which a third is sought.

    A guess that lies in the section and stays near it for a while passes through it more than once by rounding: these passages count as
    one.
    """
    passages = _motion(system, setting, given, given.start, given.t, given.longest).events[SECTION]
    since = passages.ts - passages.ts[0]
    later = since > jnp.finfo(since.dtype).eps ** 0.5 * given.longest
    i = jnp.argmax(later)
    known = lambda x: jnp.where(jnp.any(later), x, jnp.nan)
    usual = known(since[i])
    return known(_state(passages.q, passages.qdot, passages.states, i)), usual, 1.9 * usual


def forced_period(setting, given):
    """The time after which the force has repeated itself so often as the state takes to return."""
    period = setting.section.period
    once = jnp.asarray(call(period, "`period` of `section`", given.params) if callable(period) else period, given.t.dtype)
    return setting.turns * once


def passage(system: System, setting: Setting, frame: Frame, start: dict[str, PyTree], t: Any) -> tuple[Array, Array]:
    """The state when it returns, after periods of the force or at a passage after the present one; and the time until then."""
    if isinstance(setting.section, Every):
        period = forced_period(setting, frame.given)
        motion = _motion(system, setting, frame.given, start, t, period)
        return _state(motion.q, motion.qdot, motion.states, -1), period
    passages = _motion(system, setting, frame.given, start, t, frame.longest).events[SECTION]
    later = passages.ts - t > (1 - 0.5 / setting.turns) * frame.usual
    i = jnp.argmax(later)
    known = lambda x: jnp.where(jnp.any(later), x, jnp.nan)
    return known(_state(passages.q, passages.qdot, passages.states, i)), known(passages.ts[i] - t)
