"""A pre-flight check of a system at one state: findings in words, with the cure."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._model.flat import Flat, rows_by_name
from .._model.paths import entry_names, leaf_names
from .._model.state_values import given_states
from .._model.system import System
from .._model.validation import at_state, checked, coordinates, state
from .._program.scalarise import scalarised
from . import findings
from .augmented_inertia import augmented, by_weight, unit_lengths
from .constrained_acceleration import constrained_acceleration, other_multipliers
from .contact import in_contact, in_current_mode
from .couplings import MATRICES, NOT_READ, couplings, uses_all_numbers
from .friction_elements import light_coordinates, unread_friction
from .lagrange import applied_force, constraint_rows, inertia, position_residual, velocity_residual
from .massless import with_first_order_rates, with_masses
from .pseudo_inverse import CLEAR, SEEN
from .singular_directions import Failure, is_defined, not_affine_in, tangent_basis
from .surfaces import Surface, surfaces


@dataclasses.dataclass(frozen=True)
class Examination:
    """The findings of `examine`; prints as a report.

    - `coordinates`, `states`: their names. `degrees_of_freedom`: n − rank G.
    - `rows`, `rank`: of G. `redundant`: by constraint, the number of rows that depend on earlier rows.
    - `off_position`, `off_velocity`: the largest residual of each constraint, in its own units.
    - `smallest_inertia`: the least eigenvalue of M on the motions that the constraints allow.
    - `dissipated`: the least of q̇·∂D/∂q̇ near the state, a power, by term.
    - `time_constants`: 1/|eigenvalue| of the linearised motion, the fastest and the slowest, with the further states held.
    - `findings`: sentences with the cure. `contacts`: which are closed, by name, of several gaps an array. `without_inertia`:
      coordinates whose velocity is decided by dissipation alone; they count as degrees of freedom.
    - `couplings`: from 64 coordinates on, by matrix and term, e.g. ("G", "rods"): how many entries may be nonzero (None if the program is
      too long to be read), and out of how many. The matrices: ∂²L/∂q̇², ∂²L/∂q², ∂²D/∂q̇², and rows of G.
    - `surfaces`: where functions jump or bend by the position, the time or a state: of each the `function`, `what` chooses, the `line`, and
      whether it is `located`, so that steps end there.
    """

    coordinates: tuple[str, ...]
    degrees_of_freedom: int
    rank: int
    rows: int
    redundant: dict[str, int]
    off_position: dict[str, float]
    off_velocity: dict[str, float]
    smallest_inertia: float
    dissipated: dict[str, float]
    time_constants: tuple[float, float]
    findings: tuple[str, ...]
    states: tuple[str, ...] = ()
    contacts: dict[str, bool | np.ndarray] = dataclasses.field(default_factory=dict)
    without_inertia: tuple[str, ...] = ()
    couplings: dict[tuple[str, str], tuple[int | None, int]] = dataclasses.field(default_factory=dict)
    surfaces: tuple[Surface, ...] = ()

    def __repr__(self) -> str:
        fastest, slowest = self.time_constants
        rows = [
            ("coordinates", ", ".join(self.coordinates)),
            *([("states", ", ".join(self.states))] if self.states else []),
            *((f"contact {name!r}", _which_are_closed(closed)) for name, closed in self.contacts.items()),
            *([("without inertia", ", ".join(self.without_inertia))] if self.without_inertia else []),
            ("degrees of freedom", str(self.degrees_of_freedom)),
            ("constraint rows", f"{self.rows}, of rank {self.rank}"),
            ("smallest inertia", f"{self.smallest_inertia:.3g}"),
            ("time constants", f"{fastest:.3g} … {slowest:.3g}"),
            *((matrix, f"{_counted(entries)} of {size} numbers, {name}") for (matrix, name), (entries, size) in self.couplings.items()),
        ]
        located = [surface for surface in self.surfaces if surface.located]
        rows += [("steps end at", f"`{of.what}` of {of.function}, {of.line}") for of in located]
        lines = [f"  {name:<20}{value}" for name, value in rows]
        return "\n".join(["Examination", *lines, *(f"  - {finding}" for finding in self.findings or ("no issues found",))])


def examine(system: System, q: PyTree, qdot: PyTree, params: PyTree = None, *, t: Any = 0.0, states: PyTree = None) -> Examination:
    r"""A pre-flight check of a system at one state: rank, redundancy, inertia, dissipation, stiffness, in numbers and in words.

    $$ \text{degrees of freedom} = n - \mathrm{rank}\,G, \qquad N^T M N > 0, \qquad \dot q\cdot\frac{\partial D}{\partial\dot q} \ge 0,
       \qquad \tau = 1/|\lambda_i| \text{ of the linearised motion} $$

    N spans the null space of G: the motions that the constraints allow. All matrices are dense here, even those that simulation solves as
    sparse ones: 1000 coordinates take half a minute and a gigabyte.

    **Arguments:** as `acceleration`. Any consistent units.

    **Returns:** an `Examination`; print it.

    **Raises:** `TypeError` or `ValueError` if an argument or a function of the system is of the wrong kind, or returns numbers
    that are not finite at this state.

    **Source:** Hairer & Wanner, Solving Ordinary Differential Equations II, sections IV.1 (stiffness) and VII.1.

    ```python
    import jaxlag as jl
    from jaxlag.examples import vehicle
    print(jl.examine(vehicle.system, vehicle.q0, vehicle.qdot0, vehicle.params))
    ```
    """
    found = jax.tree.map(np.asarray, at_state(_measure, system, q, qdot, params, t, states))
    if not is_defined(found):
        raise ValueError(Failure.undefined.value)
    q = coordinates(q, "q")
    eps = float(jnp.finfo(found["M"].dtype).eps)
    G, M = found["G"], found["M"]
    rows = {name: found["rows"][name] for name in system.constraints}  # in the order of the rows of G
    units = found["units"]
    blurred = 10 * max((distance for of in found["distances"].values() for distance in of.values()), default=0.0)
    least = min(max(blurred, eps**SEEN), eps**CLEAR)  # beside the constraints, rows that follow from others differ by as much
    N = tangent_basis(G * units, eps, least)
    rank = G.shape[1] - N.shape[1]
    inertia_on_N = _inertias(M, G, units[:, None] * N, eps, least)
    smallest = float(inertia_on_N[0]) if inertia_on_N.size else float("inf")
    contacts = {name: np.asarray(closed) if np.ndim(closed) else bool(closed) for name, closed in found["closed"].items()}
    held = {name: of[np.ravel(contacts.get(name, np.ones(len(of), bool)))] for name, of in rows.items()}
    redundant = _redundant_rows(G * units, held, eps, least)
    largest = lambda named: {name: float(np.max(np.abs(value), initial=0.0)) for name, value in named.items()}
    constants = _time_constants(found, N, units) if np.all(np.isfinite(found["A"])) else (float("nan"), float("nan"))
    numbers = {
        "coordinates": leaf_names(q),
        "degrees_of_freedom": N.shape[1],
        "rank": rank,
        "rows": sum(map(len, held.values())),
        "redundant": redundant,
        "off_position": largest(found["position"]),
        "off_velocity": largest(found["velocity"]),
        "smallest_inertia": smallest,
        "dissipated": {name: float(np.min(value)) for name, value in found["dissipated"].items()},
        "time_constants": constants,
    }
    defect = _largest_defect(found["defects"], rank == G.shape[0], eps)
    names = entry_names(q, "q")
    coupled = dict(sorted(found["couplings"].items(), key=lambda of: MATRICES.index(of[0][0])))
    chosen = surfaces(system, *state(q, qdot), params, t, given_states(system, states, q))
    found_out = [
        *findings.without_inertia(names, M, G, units),
        *findings.nearly_without_inertia(names, M, G),
        *findings.not_affine(names, found["not_affine_in"]),
        *findings.pushing(names, M, G, rows, units, system),
        *findings.of_numbers(numbers, found["distances"], defect, found["M"].dtype),
        *findings.pulling(system, found["multipliers"]),
        *findings.not_unique(found["multipliers"], found["other_multipliers"]),
        *findings.coupling_all(coupled, found["uses_all_numbers"], len(names)),
        *_unread_friction(system, q, qdot, params, t, states),
        *findings.bending([surface for surface in chosen if not surface.located], bool(system.events)),
    ]
    light = tuple(names[i] for i in np.flatnonzero(found["light"]))
    states = tuple(name for name, _ in system.states)
    counts = {of: (None if c.entries == NOT_READ else int(c.entries), int(c.size)) for of, c in coupled.items()}
    numbers |= {"states": states, "contacts": contacts, "without_inertia": light, "couplings": counts, "surfaces": tuple(chosen)}
    return Examination(findings=tuple(found_out), **numbers)


def _which_are_closed(closed: bool | np.ndarray) -> str:
    if not np.ndim(closed):
        return "closed" if closed else "open"
    return f"{np.sum(closed)} of {np.size(closed)} gaps closed"


def _largest_defect(defects, is_regular, eps):
    """Of the equations and of the rows, as `_defects` has them at each state; where rows contradict each other, of neither."""
    share = lambda off, size: off / np.where(size > 0, size, 1)
    in_equations, in_rows = share(defects[:, 0], defects[:, 1]), share(defects[:, 2], defects[:, 3])
    if is_regular:
        return max(np.max(in_equations), np.max(in_rows))
    return np.max(in_equations[in_rows <= eps**0.5], initial=0.0)


def _counted(entries):
    return "unread" if entries is None else str(entries)


def _unread_friction(system, q, qdot, params, t, states):
    """Dry friction that is written in a way that is not recognised."""
    q, qdot = state(q, qdot)
    t = jnp.asarray(t, jax.tree.leaves(q)[0].dtype)
    return unread_friction(*checked(system, t, q, qdot, params, given_states(system, states, q)))


def _measure(flat: Flat, t, q, v):
    """Everything that needs derivatives, in one compiled program."""
    mode = in_current_mode(flat, t, q, v)
    closed = mode.closed if flat.contacts else jnp.zeros(0, bool)
    flat = in_contact(flat, closed)
    _, G, _ = constraint_rows(flat, t, q, v)
    light = light_coordinates(flat)
    M = inertia(with_masses(flat, light) if light.size else flat, t, q, v).as_matrix()
    units = unit_lengths(M, G)
    beside = jnp.linspace(-0.1, 0.1, q.size, dtype=q.dtype)
    around = jnp.stack([jnp.zeros_like(beside), beside, -beside[::-1]])
    unless_zero = lambda x, other: jnp.where(x == 0, other, x)
    aside = lambda x, near: x + near * unless_zero(jnp.abs(x), unless_zero(by_weight(units, jnp.abs(x)), units))
    multipliers, defects = jax.vmap(lambda near: _defects(mode, t, aside(q, near), aside(v, near)))(around)
    multipliers = multipliers[0]

    def rates(y):
        q, v = jnp.split(y, 2)
        return jnp.concatenate([with_first_order_rates(mode, t, q, v).v, constrained_acceleration(mode, t, q, v).x])

    speed = jnp.max(jnp.abs(v / units))  # in the metric of M
    size = 0.1 * jnp.where(speed > 0, speed, 1) * units
    near = v[None] + size[None] * jax.random.normal(jax.random.key(0), (64, v.size), v.dtype)
    fed = {name: jax.vmap(lambda v, D=D: v @ jax.grad(D, argnums=2)(t, q, v, multipliers))(near) for name, D in flat.dissipations.items()}
    search = flat.needs_multipliers and not flat.massless
    other = other_multipliers(mode, t, q, v, multipliers) if search else jnp.zeros((0, multipliers.size), v.dtype)
    g, _ = position_residual(flat, t, q)
    split = rows_by_name(flat)
    psi, _, _ = constraint_rows(flat, t, q, v)
    return {
        "couplings": couplings(flat, t, q, v),
        "uses_all_numbers": uses_all_numbers(flat, t, q, v),
        "M": M,
        "units": units,
        "light": jnp.isin(jnp.arange(q.size), light),
        "closed": flat.by_contact(closed),
        "G": G,
        "A": jax.jacfwd(rates)(jnp.concatenate([q, v])),
        "not_affine_in": not_affine_in(flat, t, q, v),
        "rows": {name: jnp.asarray(rows) for name, rows in split.items()},
        "position": {name: g[split[name]] for name in flat.holonomic_names},
        "velocity": {name: psi[rows] for name, rows in split.items()},
        "distances": {
            "position": {name: _distance(g[split[name]], G[split[name]], q, units) for name in flat.holonomic_names},
            "velocity": {name: _distance(psi[rows], G[rows], v, units) for name, rows in split.items()},
        },
        "dissipated": fed,
        "multipliers": {name: multipliers[rows] for name, rows in split.items()},
        "other_multipliers": {name: other[:, rows] for name, rows in split.items()},
        "defects": defects,
    }


def _defects(mode, t, q, v):
    """λ; and how far q̈ and λ, computed by the rewritten program, are from the equations as JAX alone differentiates them.

    Of M q̈ − f − Gᵀλ and of G q̈ + γ: what is left, and with the largest term; zeros where inertia is missing, and where no q̈ satisfies
    all rows, as beside the constraints of a linkage with redundant ones.
    """
    v = with_first_order_rates(mode, t, q, v).v
    qddot, multipliers, sound = scalarised(lambda t, q, v: constrained_acceleration(mode, t, q, v))(t, q, v)
    one, L, psi = jnp.ones_like(t), mode.lagrangian, lambda t, q, v: velocity_residual(mode, t, q, v)
    _, rate = jax.jvp(jax.grad(L, argnums=2), (t, q, v), (one, v, qddot))
    _, gamma = jax.jvp(lambda t, q: psi(t, q, v), (t, q), (one, v))
    G = jax.jacfwd(psi, argnums=2)(t, q, v)
    terms = rate, -jax.grad(L, argnums=1)(t, q, v), -applied_force(mode, t, q, v, multipliers), -G.T @ multipliers
    largest = lambda *terms: jnp.max(jnp.abs(jnp.concatenate(terms)), initial=0)
    M = jax.hessian(L, argnums=2)(t, q, v)
    units = unit_lengths(M, G)
    terms = [units * term for term in terms]
    in_equations = largest(sum(terms)), largest(*terms)
    A, _ = augmented(M, G)
    moved = units * (jnp.abs(jnp.linalg.inv(A * jnp.outer(units, units))) @ sum(map(jnp.abs, terms)))  # by each force alone
    length = jnp.linalg.norm(G * units[None], axis=1)
    of_rows = lambda x: x / jnp.where(length > 0, length, 1)
    in_rows = largest(of_rows(G @ qddot + gamma)), largest(of_rows(jnp.abs(G) @ moved), of_rows(gamma))
    return multipliers, jnp.where(
        sound.determined & sound.satisfied & jnp.all(jnp.isfinite(qddot)), jnp.stack([*in_equations, *in_rows]), 0
    )


def _distance(residual, G, x, units):
    """The largest distance of x from what rows ask for, relative to the size of x, both in the metric of M."""
    length = jnp.linalg.norm(G * units[None], axis=1)
    each, size = jnp.abs(residual) / jnp.where(length > 0, length, 1), jnp.max(jnp.abs(x / units))
    return jnp.max(each / jnp.where(size > 0, size, 1), initial=0.0)


def _inertias(M, G, allowed, eps, least):
    """The eigenvalues of M on the motions `allowed`, in the units given."""
    N = tangent_basis(G, eps, least)
    N = N if N.shape == allowed.shape else np.linalg.qr(allowed)[0]
    return np.linalg.eigvalsh(N.T @ M @ N) if N.shape[1] else np.zeros(0)


def _redundant_rows(G, rows, eps, least):
    """How many rows of each constraint depend on rows before them."""
    redundant, before = {}, np.zeros((0, G.shape[1]))
    allowed = lambda G: tangent_basis(G, eps, least).shape[1]
    for name, indices in rows.items():
        of_name = np.concatenate([before, G[indices]])
        dependent = len(indices) - (allowed(before) - allowed(of_name))
        if dependent:
            redundant[name] = dependent
        before = of_name
    return redundant


def _time_constants(found, N, units):
    """1/|λ| of the nonzero eigenvalues of the motion linearised on the constraints, the fastest and the slowest.

    What leaves the constraints, since they are curved, is taken away in the metric of M, as their forces do.
    """
    both = np.concatenate([units, units])  # of positions and of velocities
    metric = N.T @ (found["M"] * np.outer(units, units))
    has_inertia = N.shape[1] and np.linalg.cond(metric @ N) < 1 / np.sqrt(np.finfo(N.dtype).eps)
    along = np.linalg.solve(metric @ N, metric) if has_inertia else N.T
    reduced = np.kron(np.eye(2), along) @ (found["A"] * both / both[:, None]) @ np.kron(np.eye(2), N)
    sizes = np.abs(np.linalg.eigvals(reduced))
    sizes = sizes[sizes > 1e-7 * np.max(sizes, initial=0.0)]  # a double eigenvalue 0 is some √eps of the largest, after rounding
    return (1 / np.max(sizes), 1 / np.min(sizes)) if sizes.size else (float("inf"), float("inf"))
