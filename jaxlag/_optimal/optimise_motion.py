"""The best motion from here to there."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._model.numbers import count, number
from .._model.system import System
from .._program.jit import compiled, is_concrete, values
from .boundary import boundary_of
from .guess import bent, guessed, sizes_of_states
from .input import Piecewise
from .interior_point import CONVERGED, INFEASIBLE, LAST, LEAPING, STEP_LIMIT, Found, best_of, minimum
from .sensitivity import differentiable
from .solution import OptimalMotion
from .statement import nodes_of, stated
from .transcription import STAGES, Path, Setting, Sizes, Task, Transcription

NEAR = 1e-3  # of its size, at which a bound stands against a motion
CORRECTIONS = 4  # of a step, where holonomic constraints bend: a rod that turns takes 6 steps with 80 intervals, for 44
LEAP = 0.1  # of its speed, by which a coordinate may move at another: beyond it, what keeps constraints carries it where no motion leads


def optimise_motion(
    system: System,
    start: Any,
    end: Any,
    params: PyTree = None,
    *,
    control: Mapping[str, Any],
    duration: Any,
    cost: Callable | None = None,
    end_cost: Callable | None = None,
    within: Mapping[str, Any] | None = None,
    waypoints: Mapping[float, Any] | None = None,
    periodic: bool | str | Sequence[str] = False,
    over: str | Sequence[str] | Mapping[str, Any] = (),
    nodes: int = 20,
    t: Any = 0.0,
    guess: Any = None,
    tolerance: float = 1e-6,
    refinements: int = 3,
    starts: int = 3,
    steps: int = 500,
    throw: bool = True,
) -> OptimalMotion:
    r"""The motion from here to there that costs least, with the input that makes it.

    $$ \min_{q, \dot q, \lambda, u} \int_{t_0}^{t_0 + T} c(t, q, \dot q, \ddot q, \lambda, u)\,dt + c_T
       \quad\text{such that}\quad M\ddot q = f(q, \dot q, u) + G^T\lambda,\quad g = 0,\quad a \le h \le b $$

    The equations of motion are those of the system, with constraint forces as unknowns, collocated at Radau's points (order 9), where
    limits hold, too, and not between them; an interior-point method finds a minimum near the guess, a straight way and some beside it if
    there is none. The motion found is simulated; where it is off by more than `tolerance`, the intervals are halved.

    Least time with an input that has no bound, or that the last moments do not depend on, may use errors of the polynomials: bound it.

    **Arguments:**

    - `start`, `end`: (q, q̇), structured as for `simulate`; None in place of a number, of q or of q̇ leaves them free.
    - `params`: as for `simulate`, without the controls.
    - `control`: by name the bounds (lower, upper) of an input, None where there is none; arrays for several numbers. Functions of the
      system, `cost` and `within` that take it by its name get its value; or they call it as a signal, `u(t)`.
    - `duration`: T; or (shortest, longest), where it is to be found.
    - `cost`: c by the argument rule, of `t, q, qdot, qddot, multipliers`, inputs and params; without it the duration. `end_cost`: of the
      state at the end.
    - `within`: limits (function, lower, upper) by name, kept at all points of collocation; functions as for `cost`.
    - `waypoints`: by the share of the duration, which is moved to the nearest node, a state as for `start`. `periodic`: whether the end is
      like the start, of all coordinates with their rates or of those named.
    - `over`: entries of `params` to be chosen, too; a mapping gives (lower, upper) to each.
    - `nodes`: how many intervals at first; `t`: the time at the start; `guess`: a `Trajectory` or an `OptimalMotion`, over whose time the
      motion is stretched.
    - `tolerance`: of `check()`, over the size of a coordinate; `refinements`: how often intervals are halved, at most. Under `jit`, `grad`
      and `vmap` the mesh stays as it is.
    - `starts`: how many searches there are, the first from a straight way, if no guess is given; the least cost counts.
    - `steps`: of the interior-point method; `throw`: whether to raise where it fails. Under `jit` and `vmap` look at `converged`.

    Any consistent units.

    **Returns:** an `OptimalMotion`. Its numbers are differentiable once in all numbers given, by the implicit function theorem.

    **Raises:** `ValueError` if there is no such motion near the guess, with the limits that stand against it, or if a control moves
    nothing, or for dry friction, contacts, events and further states, whose phases would have to be given.

    **Source:** Betts, Practical Methods for Optimal Control, 2nd ed., chapter 4; Kelly, SIAM Review 59 (2017) 849-904; Hairer & Wanner,
    Solving Ordinary Differential Equations II, section VII.4.

    ```python
    import jax
    import jaxlag as jl
    cart = jl.System(lambda qdot, m: 0.5 * m * qdot**2, force={"motor": lambda u: u})

    def effort(m):
        return jl.optimise_motion(
            cart, (0.0, 0.0), (1.0, 0.0), {"m": m}, duration=1.0, control={"u": (-20, 20)}, cost=lambda u: u**2
        ).cost

    effort(1.0), jax.grad(effort)(1.0)  # 12, 24
    ```
    """
    boundary = boundary_of(start, end, waypoints, periodic)
    given = {"control": control, "duration": duration, "cost": cost, "end_cost": end_cost, "within": within, "over": over}
    setting, task = stated(system, boundary, params, given | {"nodes": nodes, "t": t, "guess": guess, "steps": steps, "starts": starts})
    refinements = count(refinements, "`refinements`", least=0, cure="Give how often intervals are halved, or 0.")
    tolerance = float(number(tolerance, "`tolerance`", positive=True, cure="Give e.g. 1e-6."))
    found = _found(setting, task, guessed(setting, task, boundary, guess))
    known = values(found)  # where it is differentiated, too
    if throw and known is not None and not bool(known.converged):
        raise ValueError(_against(known))
    if not is_concrete(found):
        return found
    found = found.checked()
    for _ in range(refinements):
        if found.deviation <= tolerance or not bool(found.converged):
            break
        setting = setting._replace(intervals=2 * setting.intervals, is_guessed=True)
        task = task._replace(nodes=nodes_of(boundary, setting.intervals))
        finer = _found(setting, task, guessed(setting, task, boundary, found))
        if not bool(finer.converged):
            break
        found = finer.checked()
    return found


def split(x: Array, sizes: Sequence[int]) -> list[Array]:
    """The parts of a vector."""
    return jnp.split(x, np.cumsum(sizes)[:-1]) if sizes else []


@compiled
def _found(setting: Setting, task: Task, path: Path) -> OptimalMotion:
    """The minimum near a guess, as a motion."""
    n = task.start.size // 2
    of, fixed = Transcription(setting, n), jax.lax.stop_gradient
    q, v = sizes_of_states(of, fixed(task), fixed(path))
    paths = jax.tree.map(lambda x: x[None], fixed(path)) if setting.is_guessed else bent(of, fixed(task), fixed(path), q, setting.starts)
    sizes = fixed(of.sizes(fixed(task), jax.tree.map(lambda x: x[0], paths), q, v))
    chain, tolerance = of.chain(sizes, fixed(task)), float(jnp.finfo(task.start.dtype).eps) ** 0.7

    def from_one(path):
        at = of.moments(path, fixed(task))
        slack = jax.vmap(jax.vmap(lambda at: of.limited(fixed(task), of.params(fixed(task), path.chosen), at)))(at)
        start = of.put_together(path._replace(slack=slack), sizes, fixed(task))
        corrections = CORRECTIONS if setting.positions else 0
        found = minimum(chain, start, tolerance=tolerance, steps=setting.steps, corrections=corrections)
        leaps = of.leap(of.taken_apart(found.point.x, sizes, fixed(task)), sizes) > LEAP
        return found._replace(status=jnp.where(leaps & (found.status == CONVERGED), LEAPING, found.status))

    every = jax.lax.map(from_one, paths)
    found = jax.tree.map(lambda x: x[best_of(every)], every)
    args, others = eqx.partition((sizes, task), eqx.is_array)
    point = differentiable(lambda args: of.chain(*eqx.combine(args, others)), args, fixed(found.point), LAST * tolerance)
    whole = of.taken_apart(point.x, sizes, task)
    cost = of.chain(sizes, task).values(point.x)[0] * sizes.cost
    return _motion(of, whole, task, cost, found, sizes)


def _motion(of: Transcription, path: Path, task: Task, cost: Array, found: Found, sizes: Sizes) -> OptimalMotion:
    """The result in the user's structure."""
    setting, params = of.setting, of.params(task, path.chosen)
    at = of.with_start(path, task)
    flat = of.flat(task, params, at.u[0])
    tree = jax.vmap(flat.unravel)
    inputs = jax.vmap(of.controls)(at.u)
    signals = {name: Piecewise(task.t, path.duration, x[1:].reshape(setting.intervals, STAGES, *x.shape[1:])) for name, x in inputs.items()}
    said = {
        limit.name: jax.vmap(lambda at, limit=limit: of.said(limit.function, limit.name, task, params, at))(at) for limit in setting.limits
    }
    multipliers = jax.vmap(flat.unravel_multipliers)(at.multipliers)
    numbers = cost, path.duration, params, found.status, found.steps, found.violation, jnp.full_like(cost, jnp.nan), (sizes.q, sizes.v)
    names = [*(name for name, _ in setting.controls), *said]
    ends = [[*split(task.inputs[i], setting.inputs_of), *split(task.limits[i], setting.limited)] for i in range(2)]
    bounds = dict(zip(names, zip(*ends, strict=True), strict=True))
    of_motion = at.t, tree(at.q), tree(at.v), tree(at.a), multipliers, inputs, said, bounds, signals
    return OptimalMotion(*of_motion, *numbers, setting.system, setting.is_signal)


def _against(found: OptimalMotion) -> str:
    """Why there is no motion."""
    if not np.isfinite(found.violation):
        return "`guess` must lead where the system has finite forces, but does not: they are NaN on its way. Give another motion."
    if not np.isfinite(found.cost):
        return "`cost` must be finite, but is NaN on the way. Look for a root or a logarithm of what may be negative."
    if int(found.status) != INFEASIBLE:
        off = f" The equations are off by {float(found.violation):.2g} of their size." if int(found.status) == STEP_LIMIT else ""
        return f"no best motion was found: {found.reason}{off}"
    near = []
    for name, said in (found.u | found.limited).items():
        x, (low, high) = np.asarray(said).reshape(len(said), -1)[1:], map(np.asarray, found.bounds[name])
        near += [f"{name} (lower)"] if np.any(x - low <= NEAR * np.abs(low)) else []
        near += [f"{name} (upper)"] if np.any(high - x <= NEAR * np.abs(high)) else []
    what = (
        f"What stands against it: {', '.join(near)}. Widen it, or allow more time."
        if near
        else "Look at `start`, `end` and the constraints."
    )
    return f"no motion from `start` to `end` was found near the guess within the limits. {what} Another `guess` may find one."
