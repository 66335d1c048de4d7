"""Where the search begins: straight from start to end, or about a given motion; and how large its numbers are."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._mechanics.lagrange import position_residual
from .._program.jit import compiled
from .boundary import Boundary
from .radau import points
from .solution import OptimalMotion
from .transcription import STAGES, Path, Setting, Task, Transcription, per_root

WAYS, BEND = 8, 0.5  # of how many, bent by this part of their size, the smoothest are taken
ROUNDING = 0.75  # power of ε: a coordinate goes nowhere that goes through less than this part of another, in the metric of the masses
PROJECTIONS = 20  # of Newton's steps onto the constraints


@compiled
def guessed(setting: Setting, task: Task, boundary: Boundary, guess: Any) -> Path:
    """Unknowns along a straight way, or along a given motion."""
    N, m, h, dtype = setting.intervals, setting.multipliers, setting.positions, task.start.dtype
    shares = ((np.arange(N)[:, None] + points(STAGES)) / N).ravel()
    whole = lambda x: x.reshape(N, STAGES, -1)
    low, high = task.inputs
    middle = jnp.where(jnp.isfinite(low) & jnp.isfinite(high), (low + high) / 2, jnp.clip(0.0, low, high))
    u, multipliers = jnp.broadcast_to(middle, (N * STAGES, low.size)), jnp.zeros((N * STAGES, m), dtype)
    duration = task.duration
    if guess is None:
        q, slopes = boundary.guess(shares)
        v, (first, slope) = slopes / duration, boundary.guess(np.zeros(1))
        start = jnp.concatenate([first[0], slope[0] / duration])
    else:
        ts = jnp.asarray(guess.ts)
        at = (ts - ts[0]) / (ts[-1] - ts[0])
        on = lambda tree: jnp.stack([jnp.interp(jnp.asarray(shares), at, x) for x in list(_columns(tree, ts.size).T)], axis=-1)
        q, v, start = on(guess.q), on(guess.qdot), jnp.concatenate([_columns(tree, ts.size)[0] for tree in (guess.q, guess.qdot)])
        if isinstance(guess, OptimalMotion):
            u, multipliers, duration = on(guess.u), on(guess.multipliers) if m else multipliers, guess.duration
    start = jnp.where(jnp.isfinite(task.start), task.start, start)
    every = jax.tree.leaves(task.params)
    chosen = jnp.concatenate([jnp.zeros(0, dtype), *(jnp.ravel(jnp.asarray(every[i])) for i in setting.over)])
    path = Path(
        whole(u),
        whole(multipliers),
        jnp.zeros((N, STAGES, h), dtype),
        jnp.zeros((N, STAGES, 0), dtype),
        whole(q),
        whole(v),
        start,
        duration,
        jnp.asarray(chosen),
    )
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), path)


def _columns(tree: PyTree, count: int) -> Array:
    """Samples of all numbers, (T, ...), as ravel_pytree has them."""
    return jnp.concatenate([jnp.reshape(jnp.asarray(leaf), (count, -1)) for leaf in jax.tree.leaves(tree)], axis=1)


def sizes_of_states(of: Transcription, task: Task, path: Path) -> tuple[Array, Array]:
    """Of each coordinate and rate: what it goes through; where it goes nowhere, what its forces make of it in the time."""
    largest = lambda x: jnp.max(jnp.abs(x).reshape(-1, of.n), axis=0)
    given = jnp.concatenate([task.start[None], task.nodes])
    given = jnp.where(jnp.isfinite(given), jnp.abs(given), 0)
    q = jnp.maximum(largest(path.q), jnp.max(given[:, : of.n], axis=0))
    v = jnp.maximum(largest(path.v), jnp.max(given[:, of.n :], axis=0))
    reach, masses = of.reach(task, path)
    roots = jnp.sqrt(jnp.maximum(masses, 0))
    most = jnp.max(roots * q)
    goes = (q > 0) & (roots * q >= jnp.finfo(q.dtype).eps ** ROUNDING * most * (masses > 0))
    # An input without bounds has no size of its own: what it moves goes as far as the others, in the metric of the masses.
    as_others = jnp.where((most > 0) & (masses > 0), most / jnp.where(masses > 0, roots, 1), jnp.inf)
    bounded = jnp.all(jnp.isfinite(jnp.stack(task.inputs)))
    by_forces = jnp.minimum(jnp.maximum(v * path.duration, reach), as_others)
    q = jnp.where(goes, q, jnp.where(bounded | jnp.isinf(as_others), by_forces, as_others))
    q = jnp.where(q > 0, q, 1)
    return q, jnp.maximum(v, q / path.duration)


def bent(of: Transcription, task: Task, path: Path, size: Float[Array, " n"], starts: int) -> Path:
    """Ways beside a straight one, moved onto the holonomic constraints, the smoothest first: a straight one may pass where they are
    singular, as through the pivot of a pendulum.
    """
    at = of.moments(path, task)
    shares = ((at.t - task.t) / path.duration).ravel()
    q = path.q.reshape(shares.size, of.n)
    count = starts if not of.setting.positions else max(WAYS, 2 * starts)
    sides = np.array([[0.0] * of.n, *np.random.default_rng(0).uniform(-1, 1, (count - 1, of.n))])
    found = q[None] + BEND * jnp.sin(jnp.pi * shares)[None, :, None] * sides[:, None] * size[None, None]
    params = of.params(task, path.chosen)

    def projected(t, q, u):
        flat = of.flat(task, params, u)

        def step(_, q):
            g, G = position_residual(flat, t, q)
            G = G * size[None]
            lengths = jnp.linalg.norm(G, axis=1)
            lengths = jnp.where(lengths > 0, lengths, 1)
            return q - size * (jnp.linalg.pinv(G / lengths[:, None]) @ (g / lengths))

        return jax.lax.fori_loop(0, PROJECTIONS, step, q)

    start = jnp.broadcast_to(path.start[: of.n], (count, 1, of.n))
    if of.setting.positions:
        found = jax.vmap(jax.vmap(projected), (None, 0, None))(at.t.ravel(), found, path.u.reshape(shares.size, of.setting.inputs))
        jumps = jnp.max(jnp.abs(jnp.diff(jnp.concatenate([start, found], axis=1), axis=1)) / size[None, None], axis=(1, 2))
        found = found[jnp.argsort(jnp.where(jnp.isfinite(jumps), jumps, jnp.inf))[:starts]]
    times = path.duration * jnp.concatenate([jnp.zeros(1, q.dtype), shares])
    v = jnp.asarray(jnp.gradient(jnp.concatenate([start[:starts], found], axis=1), times, axis=1))[:, 1:]
    many = jax.tree.map(lambda x: jnp.broadcast_to(x, (starts, *x.shape)), path)
    many = many._replace(q=found.reshape(many.q.shape), v=v.reshape(many.v.shape))
    return jax.vmap(lambda path: balanced(of, task, path))(many)


def balanced(of: Transcription, task: Task, path: Path) -> Path:
    """The path with the constraint forces that carry it best, by least squares of its equations of motion."""
    if not of.setting.multipliers:
        return path
    at, params = of.moments(path, task), of.params(task, path.chosen)

    def forces(at):
        left = lambda a, multipliers: of.rows(task, params, at._replace(a=a, multipliers=multipliers))[0]
        zero = jnp.zeros_like(at.multipliers)
        M, slopes = jax.jacfwd(left, argnums=(0, 1))(at.a, zero)
        size = per_root(jnp.diagonal(M))
        slopes = size[:, None] * slopes
        lengths = jnp.linalg.norm(slopes, axis=0)
        lengths = jnp.where(lengths > 0, lengths, 1)
        return -jnp.linalg.pinv(slopes / lengths[None]) @ (size * left(at.a, zero)) / lengths

    return path._replace(multipliers=jax.vmap(jax.vmap(forces))(at))
