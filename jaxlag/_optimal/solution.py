"""The best motion, as it was found."""

import dataclasses
import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree

from .._model.injection import declared_parameters
from .._model.system import System
from .._motion.simulate import simulate
from .._motion.trajectory import Trajectory
from .._program.jit import compiled, is_concrete
from .input import Piecewise
from .interior_point import CONVERGED, INFEASIBLE, LEAPING, STEP_LIMIT

REASONS = {
    CONVERGED: "a minimum",
    STEP_LIMIT: "`steps` were not enough. Allow more, give a nearer `guess`, or fewer `nodes` at first.",
    INFEASIBLE: "no motion satisfies all that is asked.",
    LEAPING: "coordinates leap from point to point, as no motion does: `start` and `end` may lie where constraints leave no way between "
    "them. Give more `nodes`, or a `guess` that goes all the way.",
}
NO_PROGRESS = "no step lowers the cost further, though the conditions of a minimum do not hold: look for a kink in `cost` or the system."
EXACT = 1e-10  # tolerance of the motion that checks it


@dataclasses.dataclass(frozen=True)
class Signalled:
    """A function of a system that takes values of inputs, as one that takes signals u(t)."""

    function: Callable
    names: tuple[str, ...]

    @property
    def __signature__(self) -> inspect.Signature:
        given = [p.replace(kind=p.KEYWORD_ONLY) for p in declared_parameters(self.function)]
        time = [] if any(p.name == "t" for p in given) else [inspect.Parameter("t", inspect.Parameter.KEYWORD_ONLY)]
        return inspect.Signature([*given, *time])

    def __call__(self, **given: Any) -> Any:
        """The function at the inputs' values."""
        wants = {p.name for p in declared_parameters(self.function)}
        at = {name: x(given["t"]) if name in self.names else x for name, x in given.items() if name in wants}
        return self.function(**at)


def with_signals(system: System, names: tuple[str, ...]) -> System:
    """The system whose functions take values of inputs by these names, driven by signals."""

    def changed(function: Callable) -> Callable:
        return Signalled(function, names) if {p.name for p in declared_parameters(function)} & set(names) else function

    return system.with_functions(changed)


class OptimalMotion(eqx.Module):
    r"""The best motion that `optimise_motion` found; prints as a table.

    - `ts`: the start and all points of collocation, (T,); `q`, `qdot`, `qddot`, `multipliers`: structured as of a `Trajectory`, with T
      samples; `u`: the inputs by name; `limited`: what the functions of `within` say, by name;
      `bounds`: (lower, upper) of both.
    - `signals`: the inputs as functions u(t), polynomials between `nodes`.
    - `cost`, `duration`; `params`: with those that were chosen.
    - `status`: 0 where the conditions of a minimum hold to rounding; `reason` says it in words. `steps` of the interior-point method;
      `violation`: the largest of the equations that is left, over its size. `deviation`: what `check()` found; NaN under `jit`.
    - `sizes` of q and of q̇, in which deviations are counted; `system`; `is_signal`: whether its functions call their inputs, `u(t)`.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    block = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda u: u)
    best = jl.optimise_motion(block, (0.0, 0.0), (1.0, 0.0), {}, duration=1.0, control={"u": None}, cost=lambda u: u**2)
    best.cost  # 12.0
    best.check() < 1e-9  # how far the simulated motion is off
    ```
    """

    ts: Float[Array, " T"]
    q: PyTree
    qdot: PyTree
    qddot: PyTree
    multipliers: dict[str, PyTree]
    u: dict[str, Array]
    limited: dict[str, Array]
    bounds: dict[str, tuple[Array, Array]]
    signals: dict[str, Piecewise]
    cost: Float[Array, ""]
    duration: Float[Array, ""]
    params: PyTree
    status: Int[Array, ""]
    steps: Int[Array, ""]
    violation: Float[Array, ""]
    deviation: Any
    sizes: tuple[Array, Array]  # of q and of q̇
    system: System = eqx.field(static=True)
    is_signal: bool = eqx.field(static=True)

    if TYPE_CHECKING:  # put here by `jaxlag.plot`
        plot: ClassVar[Callable[..., Any]]

    @property
    def converged(self) -> Any:
        """Whether the conditions of a minimum hold."""
        return self.status == CONVERGED

    @property
    def reason(self) -> str:
        """How the search ended, in words."""
        return REASONS.get(int(self.status), NO_PROGRESS)

    @property
    def nodes(self) -> Array:
        """Times between which inputs and states are polynomials."""
        return self.ts[:: next(iter(self.signals.values())).values.shape[1]]

    def simulate(self, ts: Any = None, **numerics: Any) -> Trajectory:
        """The motion under the inputs that were found, by `simulate`.

        **Arguments:** `ts`: sample times; without them the points of collocation. `**numerics`: passed on to `simulate`.

        **Returns:** a `Trajectory`, to plot and to animate. **Raises:** as `simulate`.
        """
        q0, qdot0 = jax.tree.map(lambda x: x[0], (self.q, self.qdot))
        system = self.system if self.is_signal else with_signals(self.system, tuple(self.signals))
        ts = self.ts if ts is None else ts
        return simulate(system, q0, qdot0, ts, {**self.params, **self.signals}, **numerics)

    def check(self) -> float:
        """How far the motion is off that `simulate` computes with the inputs that were found.

        **Returns:** the largest difference of a coordinate or a rate at a node, over its size; NaN where the motion fails.
        """
        return float(_deviation(self)) if is_concrete(self) else jnp.nan

    def checked(self) -> "OptimalMotion":
        """The same with its `deviation`."""
        return dataclasses.replace(self, deviation=self.check())

    def __repr__(self) -> str:
        if not is_concrete(self):
            return "OptimalMotion(traced)"
        rows = [f"cost {float(self.cost):.9g} in {float(self.duration):.6g}, {len(self.nodes) - 1} intervals, {int(self.steps)} steps"]
        for name, x in self.u.items():
            rows.append(f"{name}: from {np.min(x):.6g} to {np.max(x):.6g}")
        for name, tree in self.multipliers.items():
            x = ravel_pytree(tree)[0]
            rows.append(f"λ of {name}: from {np.min(x):.6g} to {np.max(x):.6g}")
        if np.isfinite(self.deviation):
            rows.append(f"simulated, it is off by {float(self.deviation):.1e} of its size")
        if not bool(self.converged):
            rows.append(f"! {self.reason}")
        return "\n".join(["OptimalMotion", *(f"  {row}" for row in rows)])


@compiled
def _deviation(best: OptimalMotion) -> Array:
    """Interval by interval, each from where the simulated motion is."""
    system = best.system if best.is_signal else with_signals(best.system, tuple(best.signals))
    stages = next(iter(best.signals.values())).values.shape[1]
    planned = jax.tree.map(lambda x: x[::stages], (best.ts, best.q, best.qdot))
    flat = lambda *state: ravel_pytree(state)[0]

    def off_after(state, of):
        t, duration, pieces, (_, q, v) = of
        here = {name: Piecewise(t, duration, values[None]) for name, values in pieces.items()}
        ts = jnp.stack([t, t + duration])
        motion = simulate(system, *state, ts, {**best.params, **here}, rtol=EXACT, throw=False)
        state = jax.tree.map(lambda x: x[-1], (motion.q, motion.qdot))
        return state, jnp.max(jnp.abs(flat(*state) - flat(q, v)) / jnp.concatenate(best.sizes))

    start, ends = jax.tree.map(lambda x: x[0], planned[1:]), jax.tree.map(lambda x: x[1:], planned)
    pieces = {name: signal.values for name, signal in best.signals.items()}
    _, off = jax.lax.scan(off_after, start, (planned[0][:-1], jnp.diff(planned[0]), pieces, ends))
    return jnp.max(off)  # NaN where one is
