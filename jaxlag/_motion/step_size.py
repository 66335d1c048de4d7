"""Step size control without units: each component of the motion, and each of its variations, is compared with its own size.

    |eᵢ| ≤ rtol (max |yᵢ| of the step + share · Sᵢ) + Fᵢ h        Sᵢ = max |yᵢ| along the motion so far

A share of Sᵢ stands in the place of an absolute tolerance, which has a unit: 1e-10 m is little for a vehicle and everything for a
resonator. Fᵢ is what rounding, or a component that has hardly begun to move, errs by at any length of the step. A variation errs as the
motion does: the worst of them sets the step, for where the motion is at rest or straight, it says nothing of what its derivative needs.

Source: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, section II.4 (the step that fits the tolerances).
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._mechanics.augmented_inertia import by_weight
from .results import RESULTS, under_diffrax
from .scales import SHARE, reaching

FIRST_STEP = 1e-3  # of the motion; each step that is refused may be a fifth as long, each that is kept ten times
UNRESOLVED = 1e-4  # of its own scale, the error of what is rounding: a jump of a rate would err less in a step as short as FAR
FAR = 1e-4  # of the length tried before: six steps that were refused
BRIEF = 1e-6  # of the motion, the shortest step in which a late clock says less than the tolerance asks for
MARGIN = 1e3  # times its last error, what rounding may err by: so that it does not hold the next steps back
MARGIN_OF_ROUNDING = 64  # of what weighs most, by which all others are compared at least
ON_THE_WAY = 1e-2  # of its own scale, by which what is given as a function of the time may be off before it is projected
SHARE_OF_VARIATIONS = 0.1  # of theirs: they cross zero more often (a vehicle's three at rtol 1e-8: 106 steps, and 101 for the motion alone)


class Scale(NamedTuple):
    """Of each entry of y: the largest that it has been, the rate at which it errs whatever the length of the step, and how that may grow
    with this length; and the length with which steps have been tried lately.
    """

    size: Array
    noise: Array
    growth: Array
    first: Array


class StepControl(dfx.AbstractStepSizeController):
    """Steps by the error of each component relative to its own scale, or to `atol` where that is given.

    They shrink where they meet numbers that are not finite, and end there as `undefined`. Those that resume their length after one that
    was cut short at a node make the next one no shorter than was planned, and one that is rejected must stay above `smallest`. (Without
    this, two jumps a few units in the last place apart end the motion as singular.)
    """

    rtol: Any
    atol: Any  # of each controlled entry of y; None where all follow their own scale
    smallest: Any
    duration: Any
    coordinates: int = eqx.field(static=True)  # the first entries of y, whose velocities are the next
    variations: int = eqx.field(static=True)  # how many last axes of y hold variations
    resumes: bool = eqx.field(static=True)

    @classmethod
    def of(cls, tolerances, ts, equations: Any, variations: int = 0, resumes: bool = False) -> "StepControl":
        """For a motion from the first of `ts` to the last, whose y has this many last axes of variations."""
        first, last = ts
        smallest = 4 * jnp.finfo(first.dtype).eps * jnp.maximum(jnp.abs(first), jnp.abs(last))
        return cls(*tolerances, *jax.lax.stop_gradient((smallest, last - first)), equations.size, variations, resumes)

    def wrap(self, direction):
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        size = jnp.abs(jax.lax.stop_gradient(y0))
        planned = jnp.asarray(FIRST_STEP * self.duration, jnp.asarray(t0).dtype)
        _, state = self._by_error().init(terms, t0, t1, size[:1], planned, args, func, error_order)
        return t0 + planned, (Scale(size, *[jnp.zeros_like(size)] * 2, planned), planned, state)

    def adapt_step_size(self, t0, t1, y0, y1, args, error, error_order, state):
        scale, planned, inner = state
        finite = jnp.all(jnp.isfinite(y1)) & ~jnp.any(jnp.isnan(error))  # an infinite error is a step that was refused
        y1, h = jnp.where(finite, y1, y0), t1 - t0
        size = jnp.maximum(scale.size, jnp.abs(y1))
        reach = self._reach(size, args)
        allowed = self.allowed(jnp.maximum(jnp.abs(y0), jnp.abs(y1)), reach) + self._rounding(reach, args) + self._held(reach, args, h)
        allowed = allowed + self._of_the_clock(args) * jnp.abs(y1 - y0) / jnp.maximum(h, BRIEF * self.duration)
        first = jnp.maximum(scale.first, h)
        found = self._noise(scale.size, error, allowed, reach, h, first)
        growth = jnp.where(scale.growth > 0, scale.growth, found / jnp.where(h > 0, h, jnp.inf))
        noise = jnp.maximum(scale.noise, found)
        noise = jnp.where(self._is_motion(noise), noise, jnp.minimum(noise, MARGIN * growth * h))
        excess = _ratio(jnp.abs(error), allowed + noise * h)
        worst = jnp.where(finite, root_mean_square(excess), jnp.inf)
        none = jnp.zeros(1, y0.dtype)
        step = self._by_error().adapt_step_size(t0, t1, none, none, args, worst[None], error_order, inner)
        keep, t, end, made_jump, inner, result = step
        kept = Scale(size, *_followed(noise, growth, error, h, allowed), jnp.maximum(first / 2, h))
        scale = jax.tree.map(lambda new, old: jnp.where(keep, new, old), kept, Scale(scale.size, noise, growth, first))
        if self.resumes:
            planned = jnp.where(keep, jnp.maximum(end - t, planned), end - t)
            result = dfx.RESULTS.where(keep | (planned >= self.smallest), result, dfx.RESULTS.dt_min_reached)
            end = t + planned
        lost = (result == dfx.RESULTS.dt_min_reached) & ~finite
        result = dfx.RESULTS.where(lost, under_diffrax(RESULTS.undefined), result)
        return keep, t, end, made_jump, (scale, planned, inner), result

    def _reach(self, size, args):
        """The scale of each entry; that of a motion is at least a part of what friction drives, and rounding of what weighs most: what
        others have yet to move, as the far links of a chain, grows by any power of the time before.
        """
        reach, n = reaching(size, self.coordinates, self.duration), self.coordinates
        of_motion = reach[(..., *[0] * self.variations)]
        least = MARGIN_OF_ROUNDING * jnp.finfo(reach.dtype).eps * self._among_others(of_motion, args)
        reach = jnp.where(self._is_motion(reach), jnp.maximum(reach, least.reshape(*least.shape, *[1] * self.variations)), reach)
        if getattr(args, "scales", None) is None or args.scales.driven is None:
            return reach
        driven = args.scales.driven
        driven = jnp.concatenate([SHARE * self.duration * driven, driven, jnp.zeros(len(size) - 2 * n)]).astype(size.dtype)
        return jnp.where(self._is_motion(size), jnp.maximum(reach, driven.reshape(-1, *[1] * (size.ndim - 1))), reach)

    def _rounding(self, reach, args):
        """What a variation may err by where it changes no entry of y beyond its rounding: beside what it changes elsewhere, as in the links
        of a chain that it has yet to reach, and though its number changes by its own size.
        """
        if not self.variations:
            return 0.0
        eps, of_motion = jnp.finfo(reach.dtype).eps, reach[(..., *[0] * self.variations)]
        own = self._among_others(of_motion, args)
        faint = 1e2 * eps * own.reshape(*own.shape, *[1] * self.variations) * self._changes(reach, args)
        if shares := self._shares(args):
            blur = eps * functools.reduce(jnp.multiply.outer, shares, of_motion)
            faint = jnp.maximum(faint, jnp.where(reach < MARGIN * blur, blur, 0))
        return jnp.where(self._is_motion(reach), 0, faint)

    def _changes(self, reach, args):
        """Of the motion 1; of each variation, the share by which it changes an entry of the motion at most."""
        own = self._among_others(reach[(..., *[0] * self.variations)], args)
        own = own.reshape(*own.shape, *[1] * self.variations)
        most = jnp.max(_ratio_where(own > 0, reach, own), axis=0, keepdims=True)
        return jnp.where(self._is_motion(most), 1, most)

    def _among_others(self, reach, args):
        """The scale of the motion, where a coordinate has none of its own that of the others, by their masses."""
        units = None if getattr(args, "scales", None) is None else args.scales.units
        if units is None:
            return reach
        n, of = self.coordinates, lambda part: by_weight(units, part)
        return jnp.concatenate([of(reach[:n]), of(reach[n : 2 * n]), reach[2 * n :]])

    def _held(self, reach, args, h):
        """What the rounding of forces that constraints and friction hold moves in a step: where a motion rests, it is all that moves. Of
        what is given as a function of the time a step has but to be near enough that projection finds it.
        """
        if getattr(args, "scales", None) is None or args.scales.held is None:
            return 0.0
        changes, shares = self._changes(reach, args), self._shares(args)
        if shares:
            changes = jnp.maximum(changes, functools.reduce(jnp.multiply.outer, shares)[None])
        held = args.scales.held
        rate = held.reshape(*held.shape, *[1] * (reach.ndim - held.ndim)) * changes
        axis = lambda of, i: of.reshape(*of.shape[:-1], *[1] * i, -1, *[1] * (self.variations - 1 - i))
        for order, along in enumerate(args.scales.held_along):  # along the directions of others their numbers change by their shares
            if along is not None:
                others = [axis(of[None], i) for i, of in enumerate(shares) if i != order]
                rate = jnp.maximum(rate, functools.reduce(jnp.multiply, others, axis(along, order)))
        moved = 10 * jnp.finfo(reach.dtype).eps * rate * h
        moved = jnp.concatenate([moved * h, moved, jnp.zeros((len(reach) - 2 * len(moved), *moved.shape[1:]))]).astype(reach.dtype)
        if args.scales.given is None:
            return moved
        given = args.scales.given
        given = jnp.concatenate([given, given, jnp.zeros((len(reach) - 2 * len(given), *given.shape[1:]), bool)])
        return jnp.where(given.reshape(*given.shape, *[1] * (reach.ndim - given.ndim)), jnp.maximum(moved, ON_THE_WAY * reach), moved)

    def _of_the_clock(self, args):
        """What the times that functions see round more than those of the motion: y there is known to what it moves by meanwhile."""
        scales = getattr(args, "scales", None)
        return 0.0 if scales is None else scales.grain - scales.rounding

    def _shares(self, args):
        """Of the motion and each direction of its variations, the share by which it changes a number at most, where that is known."""
        shares = () if getattr(args, "scales", None) is None else args.scales.shares
        return shares if len(shares) == self.variations else ()

    def allowed(self, near, reach):
        """What of an error is allowed: of the motion, by `atol` where that is given; of variations, by their own scale."""
        is_motion = self._is_motion(near)
        own = np.where(is_motion, SHARE, SHARE_OF_VARIATIONS).astype(near.dtype) * reach * self.rtol
        if self.atol is not None:
            given = jnp.broadcast_to(of_entries(self.atol, own), near.shape).astype(near.dtype)
            own = jnp.where(is_motion & ~jnp.isnan(given), given, own)
        return self.rtol * near + own

    def _is_motion(self, like):
        """Which entries of y are the motion, and not its variations."""
        is_motion = np.zeros(like.shape[like.ndim - self.variations :], bool)
        is_motion[(0,) * self.variations] = True
        return np.broadcast_to(is_motion, like.shape)

    def _noise(self, size, error, allowed, reach, h, first):
        """The rate at which an entry errs, where shorter steps do not help.

        One that has moved before is rounding if it errs by its own size even in a step far shorter than was tried before. One that has not
        moved, or that errs by less than its size, is taken for that only where nothing of a motion is resolved: it may begin at a point.
        """
        point = jnp.finfo(h.dtype).eps ** (2 / 3) * self.duration + 10 * self.smallest
        is_rounding = (size > 0) & (jnp.abs(error) > UNRESOLVED * reach) & (h < FAR * first)
        unresolved = jnp.isfinite(error) & (jnp.abs(error) > allowed) & (is_rounding | (h < point))
        return jnp.where(unresolved, MARGIN * jnp.abs(error) / jnp.where(h > 0, h, jnp.inf), 0)

    def _by_error(self):
        """diffrax's control by a single error, of which 1 is allowed."""
        steps = dict(dtmin=None if self.resumes else self.smallest, force_dtmin=False)
        return dfx.PIDController(rtol=0.0, atol=1.0, norm=lambda error: jnp.max(jnp.abs(error)), **steps)


def of_entries(atol: Array, like: Array) -> Array:
    """Absolute tolerances of the entries of y; NaN where none is given, as for states beside the coordinates that have one each."""
    if jnp.ndim(atol) == 0:
        return jnp.full((len(like), *[1] * (like.ndim - 1)), atol)
    return jnp.concatenate([atol, jnp.full(len(like) - len(atol), jnp.nan)]).reshape(-1, *[1] * (like.ndim - 1))


def root_mean_square(x: Array) -> Array:
    """Of the entries of y; of members and variations, the worst."""
    of_each = jnp.sqrt(jnp.mean(jax.lax.stop_gradient(x) ** 2, axis=0))
    return functools.reduce(lambda x, _: jnp.max(x, axis=-1), range(of_each.ndim), of_each)


def _followed(noise, growth, error, h, allowed):
    """The noise behind a step that was kept, and how it may grow: rounding stays, and what only began is forgotten.

    Rounding of a variation grows with the length of the step at most. What grows by itself is a step that is not stable, as where slip in
    a plane begins, and is not taken for rounding: the motion ends there, so that its derivative is infinite and no wrong number.
    """
    now = MARGIN * jnp.where(jnp.isfinite(error), jnp.abs(error), 0) / jnp.where(h > 0, h, jnp.inf)
    noise = jnp.where(noise > 0, jnp.clip(now, noise / 100, 100 * noise), 0)
    matters = noise * h > allowed / MARGIN
    return jnp.where(matters, noise, 0), jnp.where(matters, growth, 0)


def _ratio_where(there, above, below):
    return jnp.where(there, above / jnp.where(there, below, 1), 0)


def _ratio(error, allowed):
    tiny = jnp.finfo(error.dtype).tiny
    return jnp.where(error == 0, 0, error / jnp.maximum(allowed, tiny))


def with_tolerances(solver: Any, control: StepControl, size: Array) -> Any:
    """An implicit solver, with the tolerances of the steps for its equations, as diffrax has it; `size` is that of y so far.

    A library's factors of a matrix err by the largest component, so that those of a smaller scale are not asked for beyond its rounding.
    """
    inner = getattr(solver, "solver", solver)
    if not isinstance(inner, dfx.AbstractImplicitSolver):
        return solver
    names = [name for name in ("rtol", "atol", "norm") if not _is_given(getattr(inner.root_finder, name))]
    n, tiny = control.coordinates, jnp.finfo(size.dtype).tiny
    largest = jnp.concatenate([jnp.full_like(part, jnp.max(part, initial=0.0)) for part in jnp.split(size, [n, 2 * n])])
    atol = control.allowed(jnp.zeros_like(size), reaching(size, n, control.duration)) + 10 * jnp.finfo(size.dtype).eps * largest + tiny
    given = {"rtol": control.rtol, "atol": jax.lax.stop_gradient(atol), "norm": root_mean_square}
    root_finder = dataclasses.replace(inner.root_finder, **{name: given[name] for name in names})
    inner = dataclasses.replace(inner, root_finder=root_finder)
    return dataclasses.replace(solver, solver=inner) if hasattr(solver, "solver") else inner


def _is_given(tolerance):
    return callable(tolerance) or eqx.is_inexact_array_like(tolerance)
