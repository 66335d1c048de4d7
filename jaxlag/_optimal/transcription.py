r"""Lagrange's equations along a motion as equations of a chain of intervals, by collocation at Radau's points.

    M q̈ = f + Gᵀλ,    q̇ = v + (∂g/∂q)ᵀμ,    g = 0,    ψ = 0        at each point

q and v are polynomials over an interval, through their values at its points and at its start; their slopes there are q̇ and q̈. Constraints
hold with their derivatives (Gear, Gupta and Leimkuhler), where μ is nothing but what is left of rounding and discretisation.

Source: Hairer & Wanner, Solving Ordinary Differential Equations II, sections VI.1, VII.4 and VII.5 (of order 5 with three points); Betts,
Practical Methods for Optimal Control, 2nd ed., chapter 4.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._mechanics.lagrange import imbalance, velocity_residual
from .._model.flat import Flat, bind
from .._model.injection import call
from .._model.system import System
from .block_system import Shape
from .chain import Chain
from .input import Held, is_called
from .radau import derivatives, interpolation, points, weights

STAGES = 5  # points of an interval: order 9; a swing-up is off by 2e-9 with 40 intervals of 5 points, by 2e-4 with 3


class Limit(NamedTuple):
    """What a function of the motion may be."""

    name: str
    function: Callable


class Setting(NamedTuple):
    """What is asked, without numbers: functions, names and sizes."""

    system: System
    cost: Callable
    end_cost: Callable | None
    limits: tuple[Limit, ...]
    controls: tuple[tuple[str, tuple[int, ...]], ...]  # with their shapes
    over: tuple[int, ...]  # which leaves of the parameters are to be chosen
    is_signal: bool  # whether functions of the system call `u(t)`
    intervals: int
    is_free: bool  # whether the duration is to be found
    multipliers: int  # m, of all constraints
    positions: int  # h, of the holonomic ones
    limited: tuple[int, ...]  # how many numbers each limit has
    chosen: int  # how many numbers these are
    steps: int  # of the search
    is_guessed: bool  # whether a motion was given to begin with
    starts: int  # searches, otherwise

    @property
    def inputs_of(self) -> tuple[int, ...]:
        """How many numbers each control is."""
        return tuple(int(np.prod(shape)) for _, shape in self.controls)

    @property
    def inputs(self) -> int:
        """How many numbers all controls are."""
        return sum(self.inputs_of)


class Task(NamedTuple):
    """The numbers of what is asked: where the motion goes through, NaN where it is free, and bounds."""

    like: PyTree  # coordinates
    params: PyTree
    t: Float[Array | np.ndarray, ""]
    duration: Float[Array | np.ndarray, ""]  # as guessed, where it is free
    durations: Float[Array | np.ndarray, "2"]
    start: Float[Array | np.ndarray, " x"]
    nodes: Float[Array | np.ndarray, "N x"]  # at the end of each interval
    returns: Float[Array | np.ndarray, " x"]  # one, where the end is the start
    inputs: tuple[Float[Array | np.ndarray, " u"], Float[Array | np.ndarray, " u"]]
    limits: tuple[Float[Array | np.ndarray, " l"], Float[Array | np.ndarray, " l"]]
    chosen: tuple[Float[Array | np.ndarray, " p"], Float[Array | np.ndarray, " p"]]  # bounds of the parameters


class Sizes(NamedTuple):
    """What a number of one is of each kind of unknown, and of each kind of equation."""

    q: Float[Array, " n"]
    v: Float[Array, " n"]
    u: Float[Array, " u"]
    multipliers: Float[Array, " m"]
    drift: Float[Array, " h"]
    limits: Float[Array, " l"]
    chosen: Float[Array, " p"]
    cost: Float[Array, ""]
    balance: Float[Array, " n"]
    position: Float[Array, " h"]
    velocity: Float[Array, " m"]


class Path(NamedTuple):
    """Unknowns in their units: at all points of all intervals (N, s, ...), at the start, and of the whole."""

    u: Float[Array, "N s u"]
    multipliers: Float[Array, "N s m"]
    drift: Float[Array, "N s h"]
    slack: Float[Array, "N s l"]
    q: Float[Array, "N s n"]
    v: Float[Array, "N s n"]
    start: Float[Array, " x"]
    duration: Float[Array, ""]
    chosen: Float[Array, " p"]


class Moment(NamedTuple):
    """One point of a motion."""

    t: Any
    q: Any
    v: Any
    a: Any
    multipliers: Any
    u: Any


class Local(NamedTuple):
    """What is known of a motion at a point of collocation: the slope of q, what is left of rounding, slacks, h and the parameters."""

    at: Moment
    slopes: Array
    drift: Array
    slack: Array
    h: Any
    params: Any


def wide(size: Array, like: Array) -> Array:
    """With axes of one before its own, as many as another array has."""
    return jnp.reshape(size, (1,) * (jnp.ndim(like) - jnp.ndim(size)) + jnp.shape(size))


def per_root(masses: Array) -> Array:
    """1/√m of masses, and one of what has none: what makes rows of forces comparable, whatever their units."""
    return 1 / jnp.sqrt(jnp.where(masses > 0, masses, 1))


class Transcription:
    """The problem of `Setting` and `Task` as a `Chain`, in numbers of about one."""

    def __init__(self, setting: Setting, n: int):
        self.setting, self.n = setting, n
        self.c = points(STAGES)
        self.D, self.b = derivatives(self.c), weights(self.c)
        s, self.x = setting, 2 * n
        self.widths = s.inputs, s.multipliers, s.positions, sum(s.limited), n, n  # of what a point has
        self.shape = Shape(s.intervals, STAGES * sum(self.widths), self.x, self.x + s.is_free + s.chosen)

    # between unknowns and motions

    def own(self, sizes: Sizes) -> Array:
        """What a number of one is of all that a point has."""
        return jnp.concatenate([sizes.u, sizes.multipliers, sizes.drift, sizes.limits, sizes.q, sizes.v])

    def taken_apart(self, x: Array, sizes: Sizes, task: Task) -> Path:
        """Unknowns by kind and in their units."""
        block, border = self.shape.split(x)
        block = block.reshape(self.shape.intervals, STAGES, -1)
        block = block * wide(self.own(sizes), block)
        start, rest = border[: self.x] * jnp.concatenate([sizes.q, sizes.v]), border[self.x :]
        duration = rest[0] * task.duration if self.setting.is_free else task.duration
        chosen = rest[self.setting.is_free :] * sizes.chosen
        u, multipliers, drift, slack, q, v = jnp.split(block, np.cumsum(self.widths)[:-1], axis=-1)
        return Path(u, multipliers, drift, slack, q, v, start, duration, chosen)

    def put_together(self, path: Path, sizes: Sizes, task: Task) -> Array:
        """The inverse."""
        block = jnp.concatenate(path[:6], axis=-1)
        block = block / wide(self.own(sizes), block)
        duration = [path.duration[None] / task.duration] if self.setting.is_free else []
        return jnp.concatenate([block.ravel(), path.start / jnp.concatenate([sizes.q, sizes.v]), *duration, path.chosen / sizes.chosen])

    # the mechanics at one point

    def params(self, task: Task, chosen: Array) -> PyTree:
        """With those that are chosen."""
        leaves, structure = jax.tree.flatten(task.params)
        begin = 0
        for i in self.setting.over:
            size, like = leaves[i].size, leaves[i]
            leaves[i] = jnp.reshape(chosen[begin : begin + size], like.shape).astype(like.dtype)
            begin += size
        return jax.tree.unflatten(structure, leaves)

    def controls(self, u: Array) -> dict[str, Array]:
        """By name."""
        found, begin = {}, 0
        for name, shape in self.setting.controls:
            size = int(np.prod(shape))
            found[name] = u[begin : begin + size].reshape(shape)
            begin += size
        return found

    def flat(self, task: Task, params: PyTree, u: Array) -> Flat:
        """The system with these inputs."""
        held = {name: Held(value) if self.setting.is_signal else value for name, value in self.controls(u).items()}
        return bind(self.setting.system, task.like, params | held)

    def rows(self, task: Task, params: PyTree, at: Moment) -> tuple[Array, Array, Array]:
        """M q̈ − f − Gᵀλ, g, ψ."""
        flat = self.flat(task, params, at.u)
        left, _ = imbalance(flat, at.t, at.q, at.v, at.a, at.multipliers)
        return left, flat.holonomic(at.t, at.q), velocity_residual(flat, at.t, at.q, at.v)

    def carried(self, task: Task, params: PyTree, at: Moment, drift: Array) -> Array:
        """(∂g/∂q)ᵀμ."""
        if not self.setting.positions:
            return jnp.zeros_like(at.q)
        flat = self.flat(task, params, at.u)
        return jax.vjp(lambda q: flat.holonomic(at.t, q), at.q)[1](drift)[0]

    def said(self, function: Callable, label: str, task: Task, params: PyTree, at: Moment) -> Any:
        """What a function says at a point."""
        flat = self.flat(task, params, at.u)
        state = {"t": at.t, "q": flat.unravel(at.q), "qdot": flat.unravel(at.v), "qddot": flat.unravel(at.a)}
        state["multipliers"], inputs = flat.unravel_multipliers(at.multipliers), self.controls(at.u)
        try:
            return call(function, label, params | inputs, **state)
        except TypeError as error:
            if not is_called(error):
                raise
            return call(function, label, params | {name: Held(value) for name, value in inputs.items()}, **state)

    def costs(self, function: Callable, label: str, task: Task, params: PyTree, at: Moment) -> Array:
        """What a cost says, one number."""
        x = jnp.asarray(self.said(function, label, task, params, at))
        if x.shape:
            raise ValueError(f"{label} must return one number, but returns shape {x.shape}. Sum it up.")
        return x

    def limited(self, task: Task, params: PyTree, at: Moment) -> Array:
        """What all limits say."""
        found = [jnp.ravel(self.said(limit.function, f"`within[{limit.name!r}]`", task, params, at)) for limit in self.setting.limits]
        return jnp.concatenate([*found, jnp.zeros(0, at.q.dtype)])

    # the chain

    def local(self, w: Array, k: Any, i: Any, sizes: Sizes, task: Task) -> Local:
        """What point i of interval k depends on, by kind and in its units."""
        s, state = self.setting, jnp.concatenate([sizes.q, sizes.v])
        own, changes, whole = jnp.split(w, [sum(self.widths), sum(self.widths) + self.x])
        u, multipliers, drift, slack, q, v = jnp.split(own * self.own(sizes), np.cumsum(self.widths)[:-1])
        h = (whole[0] if s.is_free else 1) * task.duration / s.intervals
        slopes, params = changes * state / h, self.params(task, whole[s.is_free :] * sizes.chosen)
        at = Moment(task.t + h * (k + jnp.asarray(self.c)[i]), q, v, slopes[self.n :], multipliers, u)
        return Local(at, slopes[: self.n], drift, slack, h, params)

    def equations(self, w: Array, k: Any, i: Any, sizes: Sizes, task: Task) -> tuple[Array, Array]:
        """The share of a point in the cost, and its equations, over their sizes."""
        at, slopes, drift, slack, h, params = self.local(w, k, i, sizes, task)
        balance, position, velocity = self.rows(task, params, at)
        cost = h * jnp.asarray(self.b)[i] * self.costs(self.setting.cost, "`cost`", task, params, at)
        equations = [
            balance / sizes.balance / self.setting.intervals,
            (slopes - at.v - self.carried(task, params, at, drift)) / sizes.v / self.setting.intervals,
            position / sizes.position,
            velocity / sizes.velocity,
            (self.limited(task, params, at) - slack) / sizes.limits,
        ]
        return cost / sizes.cost, jnp.concatenate(equations)

    def end(self, w: Array, sizes: Sizes, task: Task) -> Array:
        """What is to be paid at the end, at the last point."""
        if self.setting.end_cost is None:
            return jnp.zeros((), w.dtype)
        of = self.local(w, self.setting.intervals - 1, STAGES - 1, sizes, task)
        return self.costs(self.setting.end_cost, "`end_cost`", task, of.params, of.at) / sizes.cost

    def met(self, z: Array, k: Any, sizes: Sizes, task: Task) -> Array:
        """The linear equations of interval k: the states that it must meet, over their sizes."""
        state = jnp.concatenate([sizes.q, sizes.v])
        start, last = z[self.x + self.shape.block :][: self.x], z[self.shape.block : self.x + self.shape.block]
        off = lambda x, target: jnp.where(jnp.isfinite(target), x - jnp.where(jnp.isfinite(target), target, 0) / state, 0)
        again = jnp.where(k == self.setting.intervals - 1, task.returns * (last - start), 0)
        return jnp.concatenate([off(last, jnp.asarray(task.nodes)[k]), jnp.where(k == 0, off(start, task.start), 0), again])

    def chain(self, sizes: Sizes, task: Task) -> Chain:
        """The problem."""
        everywhere = lambda bound: jnp.broadcast_to(bound, (self.setting.intervals, STAGES, bound.size))
        ends = []
        for i, infinite in enumerate((-jnp.inf, jnp.inf)):
            like = self.taken_apart(jnp.full(self.shape.intervals * self.shape.block + self.shape.border, infinite), sizes, task)
            like = like._replace(u=everywhere(task.inputs[i]), slack=everywhere(task.limits[i]))
            like = like._replace(duration=task.durations[i], chosen=task.chosen[i])
            ends.append(self.put_together(like, sizes, task))
        nothing, k = jnp.zeros(self.shape.local, sizes.q.dtype), jnp.arange(self.setting.intervals)
        met = lambda k: (jax.jacfwd(lambda z: self.met(z, k, sizes, task))(nothing), -self.met(nothing, k, sizes, task))
        return Chain(self.shape, self.D, self.equations, *jax.vmap(met)(k), self.end, (sizes, task), *ends)

    # motions

    def moments(self, path: Path, task: Task) -> Moment:
        """All points of collocation, (N, s)."""
        N = self.setting.intervals
        times = task.t + path.duration / N * (np.arange(N)[:, None] + self.c)
        return Moment(times, path.q, path.v, self._slopes(path)[..., self.n :], path.multipliers, path.u)

    def _slopes(self, path: Path) -> Array:
        """Those of q and v, (N, s, x)."""
        states = jnp.concatenate([path.q, path.v], axis=-1)
        before = jnp.concatenate([path.start[None], states[:-1, -1]])
        values = jnp.concatenate([before[:, None], states], axis=1)
        return jnp.einsum("ij,kjx->kix", self.D, values) * self.setting.intervals / path.duration

    def leap(self, path: Path, sizes: Sizes) -> Array:
        """How far q̇ is from v at most, over its size: what keeps holonomic constraints makes up for rounding and discretisation alone."""
        off = self._slopes(path)[..., : self.n] - path.v
        return jnp.max(jnp.abs(off) / wide(sizes.v, off))

    def with_start(self, path: Path, task: Task) -> Moment:
        """The start, and all points of collocation one after the other."""
        at = self.moments(path, task)
        back = jnp.asarray(interpolation(self.c, 0.0))
        first = jax.tree.map(lambda x: jnp.tensordot(back, x[0], axes=1), at)
        first = first._replace(t=task.t, q=path.start[: self.n], v=path.start[self.n :], u=jnp.clip(first.u, *task.inputs))
        return jax.tree.map(
            lambda first, rest: jnp.concatenate([first[None], rest.reshape(STAGES * len(rest), *rest.shape[2:])]), first, at
        )

    def reach(self, task: Task, path: Path) -> tuple[Array, Array]:
        """How far inputs and forces move each coordinate in the time: until the force that its own change makes holds it, if one does; and
        its mass.
        """
        params, zero = self.params(task, path.chosen), jnp.zeros(self.n, path.q.dtype)

        def one(at):
            balance = lambda a, q: self.rows(task, params, at._replace(a=a, q=q))[0]
            M, stiffness = jax.jacfwd(balance, argnums=(0, 1))(zero, at.q)
            size = per_root(jnp.diagonal(M))
            inverse = jnp.outer(size, size) * jnp.linalg.pinv(M * jnp.outer(size, size))
            slowest = 1 / path.duration**2
            moved = jnp.abs(inverse @ balance(zero, at.q)) / jnp.maximum(jnp.abs(jnp.diagonal(inverse @ stiffness)), slowest)
            return moved, jnp.diagonal(M)

        ends = [jnp.where(jnp.isfinite(end), end, 1) for end in task.inputs]
        at = jax.tree.map(lambda x: x[:, -1], self.moments(path, task)._replace(multipliers=0 * path.multipliers))
        of_each = [jax.vmap(one)(at._replace(u=jnp.broadcast_to(wide(end, at.u), at.u.shape))) for end in (*ends, 0 * ends[0])]
        moved, masses = (jnp.max(jnp.nan_to_num(jnp.stack(x)), axis=(0, 1)) for x in zip(*of_each, strict=True))
        return moved, masses

    # sizes

    def sizes(self, task: Task, guess: Path, q: Array, v: Array) -> Sizes:
        """From a first guess: equations by the sum of their terms, forces and inputs by what they do to these."""
        s, params = self.setting, self.params(task, guess.chosen)
        of = jax.tree.map(lambda x: x[:, -1], (guess.q, guess.v, guess.u))
        times = task.t + guess.duration * jnp.arange(1, s.intervals + 1) / s.intervals
        a, change = v / guess.duration, jnp.max(jnp.abs(guess.q - wide(guess.start[: self.n], guess.q)), axis=(0, 1))
        zero = lambda size: jnp.zeros((s.intervals, size), q.dtype)
        at = Moment(times, of[0], of[1], zero(self.n), zero(s.multipliers), of[2])
        kinds = {"q": 0, "v": 0, "a": 0, "multipliers": 0, "u": 0}

        def slopes(at):
            by = lambda changed: self.rows(task, params, at._replace(**changed))
            return self.rows(task, params, at), jax.jacfwd(by)({name: getattr(at, name) for name in kinds})

        (left, _, _), (of_balance, of_position, of_velocity) = jax.vmap(slopes)(at)
        most = lambda x: jnp.max(jnp.abs(x), axis=0, initial=0.0)
        known = lambda x: jnp.where(jnp.isfinite(x) & (x > 0), x, 1)
        terms = most(left) + jnp.max(jnp.abs(of_balance["a"]) @ a, axis=0)
        terms = terms + jnp.max(jnp.abs(of_balance["q"]) @ change, axis=0) + jnp.max(jnp.abs(of_balance["v"]) @ v, axis=0)
        balance = known(terms)
        position = known(jnp.max(jnp.abs(of_position["q"]) @ q, axis=0, initial=0.0))
        velocity = known(jnp.max(jnp.abs(of_velocity["v"]) @ v, axis=0, initial=0.0))
        inverse = lambda parts: 1 / known(jnp.max(jnp.stack([most(jnp.max(x, axis=1, initial=0.0)) for x in parts]), axis=0))
        multipliers = self._held(of_balance, balance)
        balance = jnp.maximum(balance, jnp.max(jnp.abs(of_balance["multipliers"]) @ multipliers, axis=0))
        by_u = [jnp.abs(of_balance["u"]) / balance[None, :, None], jnp.abs(of_velocity["u"]) / velocity[None, :, None]]
        width = (task.inputs[1] - task.inputs[0]) / 2
        u = jnp.where(jnp.isfinite(width) & (width > 0), width, inverse([*by_u]))
        balance = jnp.maximum(balance, jnp.max(jnp.abs(of_balance["u"]) @ u, axis=0))
        drift = inverse([jnp.swapaxes(jnp.abs(of_position["q"]), 1, 2) / v[None, :, None]])
        limited = jax.vmap(lambda at: self.limited(task, params, at))(at)
        ends = jnp.stack([jnp.where(jnp.isfinite(end), jnp.abs(end), 0) for end in task.limits])
        ends = jnp.max(ends, axis=0, initial=0.0)
        limits = known(jnp.where(ends > 0, ends, most(limited)))
        cost = self._size_of_cost(task, params, at, a, u, guess.duration)
        chosen = known(jnp.abs(guess.chosen))
        return Sizes(q, v, u, multipliers, drift, limits, chosen, cost, balance, position, velocity)

    def _held(self, slopes, balance):
        """Multipliers that hold forces of these sizes, in the metric of the masses, at half of the points."""

        def one(M, G):
            size = per_root(jnp.diagonal(M))
            scaled = size[:, None] * G
            lengths = jnp.linalg.norm(scaled, axis=0)
            lengths = jnp.where(lengths > 0, lengths, 1)
            return jnp.abs(jnp.linalg.pinv(scaled / lengths[None])) @ (size * balance) / lengths

        if not self.setting.multipliers:
            return jnp.zeros(0, balance.dtype)
        size = jnp.median(jax.vmap(one)(slopes["a"], slopes["multipliers"]), axis=0)
        return jnp.where(jnp.isfinite(size) & (size > 0), size, 1)

    def _size_of_cost(self, task, params, at, a, u, duration):
        """What it comes to with inputs, speeds and accelerations of their sizes."""
        found = []
        for sign in (0.0, 1.0, -1.0):
            there = at._replace(u=at.u + sign * wide(u, at.u), a=at.a + sign * wide(a, at.a))
            found.append(jnp.abs(jax.vmap(lambda at: self.costs(self.setting.cost, "`cost`", task, params, at))(there)))
        size = duration * jnp.max(jnp.stack(found))
        if self.setting.end_cost is not None:
            size = size + jnp.max(jnp.abs(jax.vmap(lambda at: self.costs(self.setting.end_cost, "`end_cost`", task, params, at))(at)))
        return jnp.where(jnp.isfinite(size) & (size > 0), size, 1)
