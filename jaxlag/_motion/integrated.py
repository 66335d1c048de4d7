"""A motion from node to node: what its loop reads is packed into one vector, so that a CPU runs it as one kernel."""

import functools

import diffrax as dfx
import jax
import jax.numpy as jnp
from equinox.internal import while_loop

from .._model.signal import nonsmooth_signals
from .._program.whole_kernel import in_whole_kernel
from .event_record import has_stopped, most
from .interval_inputs import Inputs, Record, Recorded, packed
from .interval_loop import IntervalLoop, Moving, Numbers, Resumed, Steps
from .results import number_of, numbered


def integrated(
    equations,
    solver,
    max_steps,
    meter,
    y0,
    origin,
    args,
    ts,
    tolerances,
    directions=(),
    *,
    variations=0,
    reverse=False,
    dense=False,
    resumed=None,
):
    """States at the samples and behind events; and, not differentiated, the reason it ended, counts, and the `last` time and state; of a
    motion that is `resumed`, what it may be resumed with in its turn.

    `origin` is the time of the start. With `directions` of (params, origin), for each order, the states and y0 have their variations as
    last axes. `reverse`: whether reverse mode goes through the loop; `dense`: whether there are no nodes but samples.
    """
    params, args = args.params, args._replace(params=None)
    start = jax.lax.stop_gradient(ts[0])
    periods = equations.periods(params)
    following = tuple(Record.of(signal).following(start, periods).astype(int) for signal in nonsmooth_signals(params))
    following = (*following, *[jnp.array(1)] * len(periods))  # the first updates are in y0
    moving = _moving(equations, params, directions, reverse)
    recorded = Recorded.of(equations.elsewhere, params, tuple(of_params for of_params, _ in directions))
    along = tuple(zip(recorded.directions, (of_origin for _, of_origin in directions), strict=True))
    large = [ts, *(array for signal in recorded.signals.values() for array in (signal.ts, signal.values))]
    numbers = Numbers((recorded.params, origin), args, tolerances, along)
    at_start = ts <= start  # the first, which may be repeated, as a delay has it
    # A number comes first that is not NaN, as the kernel asks for.
    given, unpack, rows = packed((start, (y0, following, at_start.sum(), numbers, resumed)), large)

    def started(given):
        ts, *columns = rows(given)
        of = {k: (*columns[2 * i : 2 * i + 2], s.interpolation) for i, (k, s) in enumerate(recorded.signals.items())}
        loop = IntervalLoop(
            equations, solver, max_steps, meter, ts, lambda params: Inputs(of, equations.elsewhere, params), moving, variations, dense
        )
        return functools.partial(loop.run, *unpack(given)[1])

    length = ts.size + most(equations).sum()
    there = jnp.concatenate([at_start, jnp.zeros(length - ts.size, bool)])
    saved = jnp.where(there.reshape(-1, *[1] * y0.ndim), y0[None], jnp.inf)
    if reverse:
        write = lambda saved, i, y, wanted: saved.at[i].set(y, pred=wanted)
        checkpointed = functools.partial(while_loop, max_steps=max_steps, buffers=lambda carry: carry[2], kind="checkpointed")
        moving, steps, ys = started(given)(saved, write, checkpointed)
        return _results(equations, ys, _end(moving, steps, resumed), ts, max_steps)

    like = y0[(0,) * (y0.ndim - len(directions))], y0, *[jnp.zeros((), int)] * 4, resumed
    space, unpack_end, _ = packed(like, [])

    def run(given, saved):
        write = functools.partial(_written, length, y0.size)
        moving, steps, saved = started(given)(saved, write, jax.lax.while_loop)
        end = packed(_end(moving, steps, resumed), [])[0].astype(saved.dtype)
        return jax.lax.dynamic_update_slice_in_dim(saved, end, length * y0.size, 0)

    found = in_whole_kernel(run)(given, jnp.concatenate([saved.ravel(), 0 * space]))
    return _results(equations, found[: saved.size].reshape(saved.shape), unpack_end(found[saved.size :]), ts, max_steps)


def _moving(equations, params, directions, reverse) -> tuple[bool, ...]:
    """Which jumps, of signals and then of sampled states, move with what is varied."""
    varied = [[jax.tree.leaves((s.ts, s.delay)) for s in nonsmooth_signals(of_params)] for of_params, _ in directions]
    jumps = [signal.interpolation.jumps for signal in nonsmooth_signals(params)]
    of_signals = [jumps[k] and (reverse or any(of_order[k] for of_order in varied)) for k in range(len(jumps))]
    shifted = any(of_origin is not None for _, of_origin in directions)
    return (*of_signals, *((reverse or shifted or (varies and bool(directions))) for varies in equations.varying_periods))


def _end(moving: Moving, steps: Steps, resumed: Resumed | None):
    """What is of interest of the last state: t, y, the number of the result, counts of steps, the next sample; what it is resumed with."""
    counts = (jnp.asarray(x, int) for x in (number_of(steps.result), steps.accepted, steps.rejected, steps.sample))
    if resumed is not None:
        of_motion = lambda x, like: x[(..., *[0] * (x.ndim - like.ndim))]
        resumed = Resumed(steps.length, jax.tree.map(of_motion, steps.control, resumed.control), jnp.array(True))
    return moving.t, moving.y, *counts, resumed


def _written(length, width, saved, i, y, wanted):
    """The vector of all samples with y as the i-th, where that is wanted."""
    at = jnp.minimum(i, length - 1) * width
    y = jnp.where(wanted, y.ravel(), jax.lax.dynamic_slice_in_dim(saved, at, width))
    return jax.lax.dynamic_update_slice_in_dim(saved, y, at, 0)


def _results(equations, ys, end, ts, max_steps):
    t, y, number, accepted, rejected, sample, resumed = end
    alone = lambda x: x[(..., *[0] * t.ndim)]  # without its variations
    last = alone(t), alone(y)
    t, stopped = last[0], has_stopped(equations, last[1])
    repeated = (jnp.arange(ts.size) >= sample) & ((ts == t) | stopped)  # the last time, as padding has it
    repeated = jnp.concatenate([repeated, jnp.zeros(len(ys) - ts.size, bool)])
    ys = jnp.where(repeated.reshape(-1, *[1] * y.ndim), y, ys)
    result = numbered(number)
    unfinished = (result == dfx.RESULTS.successful) & ~stopped & (ts[-1] > t) & (accepted + rejected >= max_steps)
    result = dfx.RESULTS.where(unfinished, dfx.RESULTS.max_steps_reached, result)
    stats = {"num_steps": accepted + rejected, "num_accepted_steps": accepted, "num_rejected_steps": rejected}
    return ys, (result, stats | jax.lax.stop_gradient({"last": last} | ({"resumed": resumed} if resumed else {})))
