"""How an equilibrium depends on a parameter: buckling, snap-through, pull-in, and where rest begins to flutter."""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, PyTree

from .._linear.equilibrium import equilibrium
from .._linear.linearise import linearise
from .._linear.matrices import Choice, matrices
from .._linear.not_differentiated import without_derivative
from .._model.numbers import count, number
from .._model.state_values import given_states, sampled
from .._model.system import System
from .._model.validation import coordinates, parameters, without_contacts
from .._program.jit import is_concrete
from .._program.jit import values as known_values
from .arclength import Correct, Corrected, Point, bounded
from .critical import FOLD, crossing
from .curve import ENDS, NOTHING, Curve, along_parameter, beside, joined, known_of, place_of, refuse_outside
from .orbits import ORDINARY, with_value
from .rests import Rested, RestNumbers, rest_near, rest_start, rest_told
from .special_points import BRANCH, Special, folds_and_branches, located, with_special_points

FLUTTER = "flutter"
GROWS = 1e-9  # of the largest eigenvalue: a real part beyond rounding


class SpecialEquilibrium(eqx.Module):
    """Where an equilibrium changes its character: `kind`, the `value` of the parameter, `q`, `states` and `multipliers` there.

    Kinds: "fold", where the curve turns back (snap-through, pull-in); "branch point", where another curve crosses (buckling); "flutter"
    (Hopf), where a pair of eigenvalues crosses the imaginary axis. `index`: its number among the points of the curve.
    """

    kind: str = eqx.field(static=True)
    value: Float[Array, ""]
    q: PyTree
    states: dict[str, PyTree]
    multipliers: dict[str, PyTree]
    index: int = eqx.field(static=True)
    _z: Array


class Asked(NamedTuple):
    """What is asked of a curve: the parameter, between which values, and the most points."""

    over: str
    bounds: tuple[float, float]
    steps: int


class EquilibriumCurve(eqx.Module):
    """Equilibria over a parameter, as `equilibrium_curve` returns them: points along a curve that may turn back.

    - `over`, `values` (n): the parameter, and its value at each point.
    - `q`, `states`, `multipliers`: structured as for `equilibrium`, with the points as first axis.
    - `eigenvalues` (n, d): of the motion near each; `is_stable` (n): whether no deviation grows.
    - `special`: where equilibria change, as `SpecialEquilibrium`s, in the order of the points.
    - `ends`: why the curve ends at its first and its last point. `system`: what rests.
    """

    over: str = eqx.field(static=True)
    values: Float[Array, " n"]
    q: PyTree
    states: dict[str, PyTree]
    multipliers: dict[str, PyTree]
    eigenvalues: Complex[Array, "n d"]
    special: tuple[SpecialEquilibrium, ...]
    ends: tuple[str, str] = eqx.field(static=True)
    system: System = eqx.field(static=True)
    _numbers: RestNumbers
    _asked: Asked = eqx.field(static=True)

    if TYPE_CHECKING:  # put here by `jaxlag.plot`
        plot: ClassVar[Callable[..., Any]]

    @property
    def is_stable(self) -> Bool[Array, " n"]:
        """Whether no small deviation grows exponentially."""
        size = jnp.max(jnp.abs(self.eigenvalues), axis=1, initial=0.0)
        return jnp.max(self.eigenvalues.real, axis=1, initial=-jnp.inf) <= GROWS * size

    def __len__(self) -> int:
        return self.values.shape[0]

    def branch(self, i: int, *, values: Any = None, steps: int | None = None) -> "EquilibriumCurve":
        """The other curve through special point `i`. `values`, `steps`: as for `equilibrium_curve`; those of this curve, if not given.

        **Raises:** `ValueError` at another special point, or where no other curve is found.
        """
        point = self.special[i]
        if point.kind != BRANCH:
            raise ValueError(f"`branch({i})` must be of a branch point, but that is a {point.kind}. Choose one of those.")
        bounds = self._asked.bounds if values is None else bounded(values)
        steps = self._asked.steps if steps is None else count(steps, "`steps`", cure="Give e.g. 400.")
        curve = RestCurve(self.system, Asked(self.over, bounds, steps), self._numbers)
        z = np.asarray(jax.lax.stop_gradient(point._z))
        sides = curve.across(z, crossing(curve(z, along_parameter(z), curve.scale_at(z), 0).J * curve.scale_at(z)), sides=2)
        if not sides:
            raise ValueError(f"`branch({i})` must find another curve, but Newton's method finds none. Widen `values`.")
        return _shown(curve, *beside(sides))

    def __repr__(self) -> str:
        head = f"EquilibriumCurve of {len(self)} equilibria over {self.over}"
        if not is_concrete(self):
            return f"{head} (traced)"
        stable = np.asarray(self.is_stable)
        rows = [f"from {float(self.values[0]):.6g} ({self.ends[0]}) to {float(self.values[-1]):.6g} ({self.ends[1]})"]
        rows += [f"{int(stable.sum())} of them stable" if stable.any() else "none of them stable"]
        rows += [f"{point.kind} at {self.over} = {float(point.value):.8g}" for point in self.special]
        return "\n".join([head, *(f"  {row}" for row in rows)])


def equilibrium_curve(
    system: System,
    q: PyTree,
    params: PyTree = None,
    *,
    over: str,
    values: tuple[Any, Any],
    t: Any = 0.0,
    states: PyTree = None,
    steps: int = 400,
) -> EquilibriumCurve:
    r"""How an equilibrium depends on a parameter: the load that buckles a column, the voltage that pulls a plate in.

    $$ f(q, 0, \lambda; p) + G^T\lambda = 0, \qquad g(q; p) = 0, \qquad \dot z = 0 $$

    The curve of these points is followed by its arc length, so that it may turn back, from the equilibrium near `q` to both sides. Folds,
    branch points and the places where a pair of eigenvalues crosses the imaginary axis are located between its points. Dry friction is left
    out, as in the middle of the band in which it holds.

    **Arguments:**

    - `system`, `q`, `params`, `t`, `states`: as for `equilibrium`, at a value of the parameter between `values`.
    - `over`: the name of a number in params; `values`: (lower, upper), between which the curve is followed.
    - `steps`: how many points there are at most to either side.

    Any consistent units.

    **Returns:** an `EquilibriumCurve`; print it, draw it with `plot.equilibrium_curve`. Differentiable in `params`, to any order: a point
    moves across the curve, a fold with what makes it turn. The derivatives of eigenvalues, branch points and of places of flutter are NaN;
    those of `root_locus` are exact. Where constraints depend on each other, branch points are not found and folds have no derivative.

    **Raises:** `ValueError` if there is no equilibrium near `q`, `over` names no number, there are contacts or sampled states, or `params`
    are hidden by `jit` or one set of many under `vmap`.

    **Source:** Thompson & Hunt, A General Theory of Elastic Stability, chapters 3 to 5; Keller, Numerical solution of bifurcation and
    nonlinear eigenvalue problems (1977).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    arch = jl.System(  # two bars that lean against each other, with a load P on top
        lambda q, qdot, h, P: 0.5 * qdot**2 - (jnp.sqrt(1 + q**2) - jnp.sqrt(1 + h**2)) ** 2 - P * q
    )
    curve = jl.equilibrium_curve(arch, 0.3, {"h": 0.3, "P": 0.0}, over="P", values=(-0.05, 0.05))
    curve.special[0].value  # 0.00995, where it snaps through
    ```
    """
    without_contacts(system, "`equilibrium_curve`")
    if sampled(system):
        raise ValueError("`system` must have no sampled states, but has. Leave out what samples.")
    q = coordinates(q, "q")
    dtype = jax.tree.leaves(q)[0].dtype
    t, params = number(t, "`t`", dtype, cure="Pass one time."), parameters(params, q)
    asked = Asked(over, bounded(values), count(steps, "`steps`", cure="Give e.g. 400."))
    place = place_of(params, over)
    refuse_outside(known_values(jax.tree.leaves(params)[place]), asked.bounds, over)
    known, states = known_values(params), given_states(system, states, q)
    if known is not None:
        rest = equilibrium(system, q, known, t=t, states=states)
        q, states = rest.q, rest.states
    width = jnp.asarray(asked.bounds[1] - asked.bounds[0], dtype)
    curve = RestCurve(system, asked, RestNumbers(q, states, params, t, width))
    sides = curve.through(np.asarray(rest_start(system, place, curve.known)))
    if sides is None:
        raise ValueError(f"`q` must be near an equilibrium from which a curve over {over} leads, but none was found. Start elsewhere.")
    return _shown(curve, *joined(*sides))


class RestCurve(Curve):
    """Points of a curve of equilibria."""

    def __init__(self, system: System, asked: Asked, numbers: RestNumbers):
        super().__init__(asked.bounds, asked.steps, jax.tree.leaves(numbers.q)[0].dtype)
        self.system, self.asked, self.numbers = system, asked, numbers
        known = known_of(numbers, "equilibrium_curve")
        self.place, self.known = place_of(numbers.params, asked.over), known
        near = linearise(system, self.known.q, params=self.known.params, t=self.known.t, states=self.known.states)
        self.choice = Choice((), None, near.coordinates.partition, 0)

    def near(self, z: np.ndarray, tangent: np.ndarray, scale: np.ndarray, turns: int, counted: bool) -> Corrected:
        """What Newton's method finds in a plane through z."""
        found = rest_near(self.system, self.place, self.known, self.plane(z, tangent, scale), jnp.asarray(turns))
        near = jax.tree.map(np.asarray, found)
        return Corrected(near.z, near.J, bool(near.done), int(near.turns), near.aside, ())

    def told(self, point: Point | Corrected, kind: str = ORDINARY, borders: Any = (NOTHING, NOTHING)) -> Rested:
        """What is told of a point, differentiable as one of this kind."""
        tangent = point.direction if isinstance(point, Point) else along_parameter(point.z)
        if is_concrete(self.numbers):
            kind, borders = ORDINARY, (NOTHING, NOTHING)
        return rest_told(self.system, self.place, kind, self.numbers, self.plane(point.z, tangent, point.scale, borders))

    def eigenvalues(self, point: Point | Corrected) -> np.ndarray:
        """Those of the motion near a point, in the order of their real parts, the greatest first."""
        rest = jax.lax.stop_gradient(self.told(point))
        params = with_value(self.known.params, self.place, rest.z[-1])
        still = jax.tree.map(jnp.zeros_like, rest.q)
        A = matrices(self.choice, self.system, self.known.t, rest.q, still, params, rest.states).rates.by_state
        values = np.linalg.eigvals(np.asarray(A)).astype(complex)
        return values[np.lexsort((values.imag, -values.real))]

    def changes(self, correct: Correct, here: Point, after: Point) -> Iterator[Special]:
        """The special points between two points."""
        yield from folds_and_branches(correct, here, after)
        growing = [self._growing(point) for point in (here, after)]
        counts = [int(np.sum(pairs > size)) for pairs, size in growing]
        if counts[0] != counts[1]:
            which = min(counts)
            found = located(correct, here, after, lambda point: float(self._growing(point)[0][which]))
            if found is not None:
                yield Special(FLUTTER, found, (NOTHING, NOTHING), ((), ()))

    def _growing(self, point: Point | Corrected) -> tuple[np.ndarray, float]:
        """The real parts of pairs of eigenvalues, the greatest first and the least possible beyond; and that which is beyond rounding."""
        values = self.eigenvalues(point)
        size = GROWS * float(np.max(np.abs(values), initial=0.0))
        pairs = np.sort(values.real[values.imag > size])[::-1]
        return np.concatenate([pairs, np.full(len(values) - len(pairs), -np.inf)]), size


def _shown(curve: RestCurve, runs: list[list[Point]], ends: tuple[str, str]) -> EquilibriumCurve:
    """The curve as it is returned."""
    points, found = with_special_points(curve, runs, curve.changes)
    moved = curve.numbers.params
    special = []
    for i, at in found.items():
        told = curve.told(at.at, FOLD if at.kind == FOLD else ORDINARY, at.borders)
        told = told if at.kind == FOLD else jax.tree.map(lambda x: without_derivative(x, moved), told)
        special.append(SpecialEquilibrium(at.kind, told.z[-1], told.q, told.states, told.multipliers, i, told.z))
    whole = jax.tree.map(lambda *x: jnp.stack(x), *[curve.told(point) for point in points])
    eigenvalues = without_derivative(jnp.asarray(np.stack([curve.eigenvalues(point) for point in points])), moved)
    shown = whole.z[:, -1], whole.q, whole.states, whole.multipliers, eigenvalues, tuple(special)
    why = ENDS[ends[0]], ENDS[ends[1]]
    return EquilibriumCurve(curve.asked.over, *shown, why, curve.system, curve.numbers, curve.asked)
