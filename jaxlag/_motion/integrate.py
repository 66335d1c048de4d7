"""Integration of the equations of motion by diffrax."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from .._mechanics.consistent_state import Consistent, has_inertia, nearest_state
from .._mechanics.contact import free, outside
from .._mechanics.friction_treatment import Regularised, StickSlip
from .._mechanics.projection import Baumgarte, NoStabilisation, Projection
from .._mechanics.surfaces import Located, NotLocated
from .._model.flat import Flat, StatesAt
from .._model.numbers import count
from .._model.signal import moves_smoothly, nonsmooth_signals
from .._program.single_kernel import in_one_kernel
from .evaluated_samples import rows_of
from .events import begun
from .first_order import EquationsOfMotion
from .formulation import Formulation
from .integrated import integrated
from .interval_loop import Resumed
from .loads import told_of_directions, told_of_loads
from .mode_changes import started, unstarted
from .one_evaluation_solver import OneEvaluationSolver, has_one_evaluation
from .progress import Bar
from .protocol import Arguments, FirstOrderSystem
from .results import RESULTS, from_diffrax
from .runge_kutta import Dop853, ExplicitRungeKutta, is_explicit
from .scales import Scales
from .search_for_start import Search
from .sparse_implicit import in_structure
from .step_size import StepControl, with_tolerances
from .stick_slip_solver import StickSlipSolver
from .variational import VariationalEquations, derived, varied_along, with_variations
from .witnesses import may_be_due
from .wrapped_solver import ProjectedSolver, SamplingAdjoint

CHOICES: dict[str, tuple[tuple[type, ...], str]] = {  # what may be chosen; the usual kinds first, since diffrax takes long to tell its own
    "solver": ((ExplicitRungeKutta, dfx.AbstractSolver), "`jaxlag.Dop853()` or `diffrax.Kvaerno5()`"),
    "stabilisation": (
        (Projection, Baumgarte, NoStabilisation),
        "`Projection()`, `Baumgarte()` or `NoStabilisation()`, of `jaxlag.stabilisation`",
    ),
    "friction": ((StickSlip, Regularised), "`StickSlip()` or `Regularised(width)`"),
    "surfaces": ((Located, NotLocated), "`Located()` or `NotLocated()`, of `jaxlag.surfaces`"),
    "adjoint": ((type(None), dfx.AbstractAdjoint), "`diffrax.RecursiveCheckpointAdjoint()`, or leave it out"),
}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class SolverOptions:
    """The choices of numerics, for which a program is compiled."""

    solver: dfx.AbstractSolver
    formulation: Formulation = dataclasses.field(metadata={"static": True})
    max_steps: int = dataclasses.field(metadata={"static": True})
    adjoint: dfx.AbstractAdjoint | None = None
    progress: bool = dataclasses.field(default=False, metadata={"static": True})

    @classmethod
    def of(cls, solver: Any, formulation: Formulation, max_steps: Any, adjoint: Any = None, progress: bool = False) -> "SolverOptions":
        """Checked, with the default solver where none is given."""
        solver = _default_solver() if solver is None else solver
        given_by_name = {"solver": solver, **formulation._asdict(), "adjoint": adjoint}
        for name in CHOICES:
            given = given_by_name[name]
            kinds, cure = CHOICES[name]
            if not isinstance(given, kinds):
                raise TypeError(f"`{name}` must be an object that makes the choice, but is {given!r}. Take e.g. {cure}.")
        if not isinstance(solver, dfx.AbstractAdaptiveSolver) or solver.term_structure is not dfx.AbstractTerm:
            raise TypeError(
                "`solver` must estimate its error and solve ẏ = f(t, y) as a whole, but "
                f"{type(solver).__name__} does not. Take e.g. {CHOICES['solver'][1]}."
            )
        count(max_steps, "`max_steps`", cure="The default is 100_000.")
        return cls(solver, formulation, max_steps, adjoint, progress)


@functools.cache
def _default_solver() -> dfx.AbstractSolver:
    return Dop853()


class Initial(NamedTuple):
    """y at the start, how far the start was moved, and the conditions that a motion needs, each with the reason of failure."""

    y: Array
    moved: Array
    conditions: tuple[tuple[Bool[Array, ""], Any], ...]


def initialised(
    equations: EquationsOfMotion, at: StatesAt, params, scales: Scales | None = None, search: Search = "all", begins: bool = False
) -> Initial:
    """The start, put on the constraints, and in its mode, unless the first step `begins` with that; `scales` are needed where there are
    events.
    """
    _, t0, q, v = at
    flat = equations.flat_at(params, at)
    nearest = _nearest(equations, flat, at, params, search)
    start = (unstarted if begins else started)(equations, at._replace(q=nearest.q, v=nearest.v), params)
    moved = jax.lax.stop_gradient(jnp.max(jnp.abs(jnp.concatenate([nearest.q - q, nearest.v - v]))))
    conditions = (
        *((period > 0, RESULTS.no_period) for period in equations.periods(params)),
        (start.has_mode, RESULTS.no_friction),
        (start.has_bounds, RESULTS.negative_bound),
        (start.is_outside, RESULTS.inside_obstacle),
        (start.dissipates, RESULTS.energy_gained),
        (start.impulsive, RESULTS.not_impulsive),
        (nearest.reached, RESULTS.impossible_start),
        (nearest.affine, RESULTS.not_affine),
        (nearest.determined, RESULTS.no_inertia),
        (nearest.defined, RESULTS.undefined),
    )
    y = start.y
    if equations.events and not begins:
        given = Arguments(params, scales)
        args = told_of_loads(equations, t0, y, given) if equations.elements else given
        y, consistent = begun(equations, t0, y, args)
        conditions = (*conditions, (consistent, RESULTS.no_friction))
    if equations.works:  # counted from behind an impact and events at the start
        y = equations.parts(y)._replace(works=jnp.zeros(len(equations.works), y.dtype)).y
    return Initial(y, moved, conditions)


def _nearest(equations: EquationsOfMotion, flat: Flat, at: StatesAt, params, search: Search) -> Consistent:
    """The start on the constraints; where it is that itself, only whether inertia is missing remains to be reported."""
    _, t0, q, v = at
    if search != "nothing":
        flat = free(flat)
        decides = not equations.elements  # with its mode friction does
        return nearest_state(flat, t0, outside(flat, t0, q, v), v, found=search == "derivative", decides=decides)
    yes = jnp.array(True)
    if equations.elements:  # what sticks would hold directions, too
        determined = has_inertia(flat, t0, q, v)
    else:
        determined = equations.accelerated(t0, equations.at_start(at, params), Arguments(params)).sound.determined
    return Consistent(q, v, reached=yes, determined=determined, affine=yes, defined=yes)


def with_status(ys, result, conditions, inputs) -> tuple[Array, RESULTS]:
    """States that were not reached as NaN; and the reason that the motion ended, the start or the input included."""
    *given, ts = inputs
    between = jnp.diff(ts, append=jnp.inf)  # of times; traced ones may repeat the first or the last, as padding does, others where served
    found = jnp.all(jnp.isfinite(ys[: ts.size]), axis=1) if ys.ndim > 1 else jnp.ones(ts.size, bool)  # a start alone has no samples
    known, served, apart, rising = jnp.all(jnp.stack([jnp.isfinite(ts), found, between != 0, between >= 0]), axis=1)  # one reduction
    numbers = [ts[:0], *(jnp.ravel(x) for x in jax.tree.leaves(given) if eqx.is_inexact_array(x))]
    finite = known & jnp.all(jnp.isfinite(jnp.concatenate(numbers)))
    ordered = rising & (served | (result != RESULTS.successful) | apart)
    conditions = (*conditions, (ordered, RESULTS.unordered), (finite, RESULTS.not_finite))
    for passed, reason in conditions:
        result = RESULTS.where(passed, result, reason)
    started = jnp.all(jnp.stack([passed for passed, _ in conditions]))
    return jnp.where(started & jnp.isfinite(ys), ys, jnp.nan), result


def states_at(
    equations: FirstOrderSystem,
    options: SolverOptions,
    adjoint: dfx.AbstractAdjoint,
    t0,
    y0,
    ts,
    args: Arguments,
    tolerances,
    begins: bool = False,
    rows: bool = False,
) -> tuple[Array, RESULTS, dict]:
    """States at the samples of a single motion, or `rows`, the reason it stopped, and, among the counts, the `last` time and state that it
    reached.

    By diffrax's own loop what has no nodes and is differentiated in reverse mode, or by an adjoint that the user has chosen.
    """
    reverse, nodes = not isinstance(adjoint, dfx.ForwardMode), has_nodes(equations, args.params)
    if nodes:
        _refuse_adjoint(options.adjoint)
    if nodes or not (reverse or options.adjoint):
        return in_one_loop(equations, options, t0, y0, ts, args, tolerances, reverse=reverse, begins=begins, rows=rows)
    return by_diffrax(equations, options, adjoint, t0, y0, ts, args, tolerances)


def begins_in_steps(equations: FirstOrderSystem, options: SolverOptions, params: PyTree, reverse: bool) -> bool:
    """Whether the first step finds the mode of friction and contact at the start, by the evaluation of all others: not where slip begins in
    a plane without contacts, whose direction turns with all that it depends on, nor where events may happen there.
    """
    if not isinstance(equations, EquationsOfMotion) or (options.adjoint and not has_nodes(equations, params)):
        return False
    one = has_one_evaluation(equations, options.solver, reverse)
    return one and bool(equations.rows == equations.elements or equations.contacts) and not may_be_due(equations)


def in_rows(equations: EquationsOfMotion, options: SolverOptions, params: PyTree, reverse: bool) -> bool:
    """Whether samples are between steps whose evaluation tells the friction there as well: they come as rows of `evaluated_samples`."""
    return not (options.adjoint or has_nodes(equations, params)) and has_one_evaluation(equations, options.solver, reverse)


def _refuse_adjoint(adjoint: dfx.AbstractAdjoint | None) -> None:
    """Refuses what the loop over intervals has no part for: its derivatives are of its own steps, in forward or in reverse mode."""
    if adjoint is None or isinstance(adjoint, dfx.ForwardMode) or getattr(adjoint, "checkpoints", 0) is None:
        return
    raise ValueError(
        "`adjoint` must be `diffrax.ForwardMode()` or `diffrax.RecursiveCheckpointAdjoint()` where steps end at contacts, events, updates "
        f"of states or nodes of signals, but is {adjoint!r}. Leave it out: derivatives of either mode are those of the steps."
    )


def by_diffrax(
    equations: FirstOrderSystem, options: SolverOptions, adjoint: dfx.AbstractAdjoint, t0, y0, ts, args: Arguments, tolerances
) -> tuple[Array, RESULTS, dict]:
    """The same by diffrax's own loop, also of a batch."""
    control = StepControl.of(tolerances, (ts[0], ts[-1]), equations, _variations(equations))
    args = told_of_loads(equations, t0, y0, args)
    alone = in_one_kernel if isinstance(adjoint, dfx.ForwardMode) else lambda function: function
    projected = alone(equations.projected) if equations.projection else None
    solution = dfx.diffeqsolve.__wrapped__(  # all is within a program already, and `equinox.filter_jit` would keep what it is given
        dfx.ODETerm(alone(equations.rates)),
        with_tolerances(_wrapped(options, equations, projected, adjoint, (t0, y0, args)), control, jnp.abs(y0)),
        t0,
        ts[-1],
        None,
        y0,
        args,
        saveat=dfx.SaveAt(t1=True),
        stepsize_controller=control,
        adjoint=SamplingAdjoint(adjoint, ts),
        max_steps=options.max_steps,
        throw=False,
        progress_meter=Meter() if options.progress else dfx.NoProgressMeter(),
    )
    (_, last_t), (ys, last_y) = solution.ts, solution.ys
    ys = ys if projected is None else jax.vmap(lambda t, y: projected(t, y, args))(ts, ys)
    stats = {key: solution.stats[key] for key in ("num_steps", "num_accepted_steps", "num_rejected_steps")}
    return ys, from_diffrax(solution.result), stats | {"last": jax.lax.stop_gradient((last_t[0], last_y[0]))}


def _variations(equations: FirstOrderSystem) -> int:
    """How many last axes of y hold variations."""
    return 1 + _variations(equations.equations) if isinstance(equations, VariationalEquations) else 0


def _wrapped(options, equations, projected, adjoint, start, begins: bool = False):
    """The chosen solver, with what the equations ask for at the ends of its steps."""
    solver = in_structure(options.solver, equations, *start)
    if isinstance(adjoint, dfx.ForwardMode):
        if isinstance(solver, ExplicitRungeKutta):
            solver = dataclasses.replace(solver, reverse=False)
        elif isinstance(solver, dfx.AbstractRungeKutta) and solver.scan_kind is None:
            solver = dataclasses.replace(solver, scan_kind="lax")  # as diffrax does for a solver that is not wrapped
    if isinstance(equations, EquationsOfMotion) and equations.modes:
        if has_one_evaluation(equations, solver, not isinstance(adjoint, dfx.ForwardMode)):
            return OneEvaluationSolver(solver, projected, equations, reverse=False, begins=begins)
        return StickSlipSolver(solver, projected, equations, reverse=not isinstance(adjoint, dfx.ForwardMode))
    return ProjectedSolver(solver, projected, equations)


def has_nodes(equations: FirstOrderSystem, params: PyTree) -> bool:
    """Whether steps end where an input jumps or bends, or a state is updated."""
    return isinstance(equations, EquationsOfMotion) and bool(
        equations.contacts or equations.system.events or equations.sampled.size or nonsmooth_signals(params)
    )


def in_one_loop(
    equations: FirstOrderSystem,
    options: SolverOptions,
    t0,
    y0,
    ts,
    args: Arguments,
    tolerances,
    *,
    directions=(),
    reverse=False,
    begins=False,
    rows=False,
    resumed: Resumed | None = None,
) -> tuple[Array, RESULTS, dict]:
    """States at the samples, or `rows`, as `states_at`, with their variations along directions of (params, t0) for each order.

    A motion that is `resumed` has been told of its loads.
    """
    adjoint = dfx.RecursiveCheckpointAdjoint() if reverse else dfx.ForwardMode()
    meter, dense = Meter() if options.progress else dfx.NoProgressMeter(), not (has_nodes(equations, args.params) or resumed)
    back = in_one_kernel(equations.projected) if dense else equations.projected
    solver = _wrapped(options, equations, back if equations.projection else None, adjoint, (t0, y0, args), begins)
    at_start = y0[(..., *[0] * len(directions))]
    if resumed is None:
        args = told_of_loads(equations, t0, at_start, args, begins)
    args = told_of_directions(equations, t0, at_start, args, directions)
    numbers = y0, t0, args, ts, tolerances
    kind = {"variations": _variations(equations), "reverse": reverse, "dense": dense, "resumed": resumed}
    ys, (result, stats) = integrated(equations, solver, options.max_steps, meter, *numbers, directions, **kind)
    of_params = tuple(of_params for of_params, _ in directions)
    if rows:
        ys, last_y = rows_of(solver.equations, ts, ys, stats["last"], args._replace(scales=None), of_params)
        stats = stats | {"last": jax.lax.stop_gradient((stats["last"][0], last_y))}
    elif dense and equations.projection:
        back = lambda y, given: (equations.projected(given[1], y, args._replace(params=given[0])), None)
        projected = varied_along(back, [(of_one, None) for of_one in of_params])
        ys = jax.vmap(lambda t, y: projected(y, (args.params, t))[0])(ts, ys)
    return ys, from_diffrax(result), stats


class Variations(NamedTuple):
    """The equations of a motion with its variations of some order; and how y at the start follows from the inputs, with what else of
    the start is of interest.
    """

    equations: FirstOrderSystem
    initial: Callable
    directions: tuple = ()  # of (params, own), for each order

    def along(self, directions: Any, of_params: Any, dt0: Array | None, arguments: Callable) -> "Variations":
        """With variations along more directions of the inputs, of which `of_params` are those of (params, own), and dt0 that of t0.

        `arguments(inputs)` are t0 and the `Arguments` of the motion alone.
        """

        def initial(inputs):
            (y0, dy0), aux = derived(self.initial, directions)(inputs)
            if dt0 is not None:  # a start that is later lies further back at t0
                t0, args = arguments(inputs)
                dy0 = dy0 - jnp.multiply.outer(self.equations.rates(t0, y0, args._replace(directions=self.directions)), dt0)
            return with_variations(y0, dy0), aux

        return Variations(VariationalEquations(self.equations), initial, (*self.directions, of_params))


def is_variational(equations: FirstOrderSystem, options: SolverOptions, varying_params, params) -> bool:
    """Whether the derivative of the motion is that of the variational equations: no mode, jump or implicit stage within a step."""
    smooth = not has_nodes(equations, params) and moves_smoothly(varying_params, params)
    return not equations.modes and is_explicit(options.solver) and smooth


class Meter(dfx.TextProgressMeter):
    """diffrax's meter, which counts inside the compiled loop, with our progress bar in place of its printing."""

    @staticmethod
    def _init_bar():
        return Bar()

    @staticmethod
    def _step_bar(bar, progress):
        bar(float(progress))

    @staticmethod
    def _close_bar(bar):
        bar.end()
