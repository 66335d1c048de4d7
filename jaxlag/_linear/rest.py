"""The equations of rest and of steady motion, and their solution."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._mechanics.augmented_inertia import unit_lengths, units_of_mass
from .._mechanics.contact import in_contact
from .._mechanics.friction_elements import FrictionElements, find_elements
from .._mechanics.lagrange import applied_force, constraint_rows, inertia, inertial_force
from .._mechanics.pseudo_inverse import FOLLOWS, SEEN
from .._mechanics.saddle_point import saddle_point
from .._mechanics.stick_slip import bounds, in_mode, slip_of, sticking
from .._model.flat import Flat, StatesAt, bind
from .._model.state_values import Layout, start_values
from .._model.system import System
from .._model.validation import checked
from .._program.jit import compiled
from .descent import minimum_near
from .newton import Root, differentiable_root, is_nothing, least_change, root_near, units_beside
from .rest_on_contacts import on_contacts, touched


class Search(NamedTuple):
    """Settings of a search: the `fixed` coordinates, the velocities to be found too, a minimum or any equilibrium, and whether dry friction
    holds.
    """

    fixed: tuple[int, ...] = ()
    running: tuple[int, ...] = ()
    stable: bool = False
    held: bool = False


class Slopes(NamedTuple):
    """M, and the Jacobian of the equations with respect to q."""

    M: Float[Array, "n n"]
    by_q: Float[Array, "r n"]


class Curvature(NamedTuple):
    """The second variation of the potential on the constraints if its eigenvalues are not computed: how many are certainly below zero and
    how many not certainly above, whether these counts are decisive, whether a potential exists, and the coordinates on which nothing
    depends.
    """

    falling: Int[Array, ""]
    not_rising: Int[Array, ""]
    certain: Bool[Array, ""]
    symmetric: Bool[Array, ""]
    undecided: Bool[Array, " n"]


class Rest(NamedTuple):
    """A steady state, and how it was found."""

    q: PyTree
    qdot: PyTree
    states: dict[str, PyTree]
    multipliers: dict[str, PyTree]
    friction: dict[str, tuple[Array, Array]]  # force and bound
    slips: Bool[Array, ""]  # whether any friction slips
    t: Array
    succeeded: Bool[Array, ""]
    uniform: Bool[Array, ""]  # whether the motion stays as it is
    left: Float[Array, " r"]  # residuals of the equations, relative to the size of their terms
    force: Float[Array, " n"]  # the residual forces
    slopes: Slopes | Curvature


class Unknowns(NamedTuple):
    """The unknowns: q and q̇ unless they are given, the states, λ, and the friction forces μ on slip velocities."""

    q: Float[Array, " a"]
    v: Float[Array, " b"]
    states: Float[Array, " c"]
    multipliers: Float[Array, " m"]
    friction: Float[Array, " r"]


class Given(NamedTuple):
    """The data on which a steady state depends; masks of the running velocities that stay as given, which are `open`, and of the contacts
    that are `closed`.
    """

    numbers: PyTree  # of params
    t: Float[Array | np.ndarray, ""]
    q: Float[Array, " n"]
    v: Float[Array, " n"]
    open: Bool[Array, " b"]
    closed: Bool[Array, " c"]


class Equations:
    """f + Gᵀλ = 0, g = 0, ψ = 0, ż = 0: the equations of a steady state as functions of the given data and the unknowns."""

    def __init__(self, search: Search, system: System, q: PyTree, params: PyTree, values: PyTree, at: Given, flat: Flat):
        self.search, self.system, self.like = search, system, Layout.of(q).shapes
        self.rest = eqx.partition(params, eqx.is_array)[1]
        self.unravel_states = ravel_pytree(values)[1]
        self.moving = np.setdiff1d(np.arange(at.q.size), search.fixed).astype(int)
        self.running = np.array(search.running, int)
        elements = find_elements(flat)
        self.friction_rows = elements.element_of_row.size if elements is not None and search.held else 0
        self.rows_of_bilateral = flat.rows_of_bilateral
        self.sizes = np.cumsum([self.moving.size, self.running.size, ravel_pytree(values)[0].size, flat.rows])

    def taken_apart(self, given: Given, w: Float[Array, " u"]) -> tuple[Flat, Float[Array, " n"], Float[Array, " n"], Unknowns]:
        """The system and its state at w."""
        of = Unknowns(*jnp.split(w, self.sizes))
        q, v = given.q.at[self.moving].set(of.q), given.v.at[self.running].set(of.v)
        at = StatesAt(self.unravel_states(of.states), given.t, q, v)
        return in_contact(bind(self.system, self.like, eqx.combine(given.numbers, self.rest), at), given.closed), q, v, of

    def __call__(self, given: Given, w: Float[Array, " u"]) -> Float[Array, " r"]:
        """The residual of the equations at w."""
        flat, q, v, of = self.taken_apart(given, w)
        g, (psi, _, _) = flat.holonomic(given.t, q), constraint_rows(flat, given.t, q, v)
        rates = ravel_pytree(flat.state_rates(given.t, q, v))[0]
        values, updates = self.unravel_states(of.states), flat.updates(given.t, q, v)
        changes = ravel_pytree([jax.tree.map(jnp.subtract, new, values[name]) for name, new in updates.items()])[0]
        kept = jnp.where(given.open, of.v - given.v[self.running], 0)
        return jnp.concatenate([self.force(flat, given, q, v, of), g, psi, rates, changes, kept]).astype(w.dtype)

    def force(self, flat: Flat, given: Given, q: Array, v: Array, of: Unknowns) -> Float[Array, " n"]:
        """f + Gᵀλ with dry friction where it slips; where it sticks, without it or with the force that it would have to hold."""
        t, held = given.t, 0.0
        elements = find_elements(flat)
        if elements is not None:
            sigma = directions_of_slip(elements, given)
            flat = flat._replace(dissipations=in_mode(flat, elements, sigma).dissipations)
            if self.friction_rows:
                holds = sticking(elements, sigma) & self.loaded(elements, given, q, v)
                holding = jnp.where(holds[elements.element_of_row], of.friction, 0)
                held = jax.vjp(lambda v: elements.slip(t, q, v), v)[1](holding)[0]
        _, G, _ = constraint_rows(flat, t, q, v)
        return inertial_force(flat, t, q, v) + applied_force(flat, t, q, v, of.multipliers) + G.T @ of.multipliers + held

    def loaded(self, elements: FrictionElements, given: Given, q: Array, v: Array) -> Bool[Array, " e"]:
        """Which elements of friction are not of contacts that are open alone."""
        if not given.closed.size:
            return jnp.ones(elements.size, bool)
        rows = self.rows_of_bilateral + np.arange(given.closed.size)
        pressed = jnp.ones(self.sizes[3] - self.sizes[2], v.dtype).at[rows].set(given.closed)
        return bounds(elements, directions_of_slip(elements, given), given.t, q, v, pressed) > 0

    def multipliers_at(self, given: Given, w: Float[Array, " u"], units: Float[Array, " n"]) -> Float[Array, " u"]:
        """w with the multipliers that best balance its forces."""
        flat, q, v, of = self.taken_apart(given, w)
        if not flat.rows:
            return w
        f, (_, G, _) = self.force(flat, given, q, v, of), constraint_rows(flat, given.t, q, v)
        sizes = jnp.max(jnp.abs(G) * units[None], axis=1, initial=0.0)
        of = of._replace(multipliers=least_change(G.T, -f, 1 / jnp.where(sizes > 0, sizes, 1)))
        return jax.lax.stop_gradient(jnp.concatenate(of))


def left_open(J: Float[Array, "r u"], which: np.ndarray) -> Bool[Array, " b"]:
    """Mask of these unknowns, in turn, that can have any value: J x = 0 then has a solution in which the unknown changes and the open ones
    before it do not. Units are such that rows and columns of J have the same size.
    """
    eps = jnp.finfo(J.dtype).eps
    for axis in (1, 0, 1, 0):
        size = jnp.max(jnp.abs(J), axis=axis, keepdims=True, initial=0.0)
        J = J / jnp.where(size > 0, size, 1)
    P = jnp.eye(J.shape[1], dtype=J.dtype) - jnp.linalg.pinv(J, rtol=eps**SEEN) @ J  # projects onto the solutions of J x = 0
    found = []
    for i in which:
        found.append(P[i, i] > eps**FOLLOWS)
        P = P - jnp.where(found[-1], jnp.outer(P[:, i], P[i]) / jnp.where(found[-1], P[i, i], 1), 0)
    return jnp.stack(found)


@compiled
def steady_state(search: Search, system: System, t: Any, q: PyTree, qdot: PyTree, params: PyTree, states: PyTree) -> Rest:
    """The steady state near a guess."""
    flat, t, q0, v0 = checked(system, t, q, qdot, params, states)
    values = start_values(system, states, t, q, qdot, params)
    given = Given(eqx.filter(params, eqx.is_array), t, q0, v0, jnp.zeros(len(search.running), bool), touched(flat, t, q0, v0))
    equations = Equations(search, system, q, params, values, given, flat)
    start = jax.lax.stop_gradient(q0)
    units = _units(inertia(flat, t, start, v0).as_matrix())
    if search.stable:
        V = lambda q: -flat.lagrangian(t, q, v0)
        within = units_beside(jax.hessian(V)(start), units)
        start = minimum_near(V, lambda q: flat.holonomic(t, q), start, equations.moving, jnp.where(within > 0, within, 1))
    nothing = jnp.zeros(flat.rows, q0.dtype), jnp.zeros(equations.friction_rows, q0.dtype)
    of = Unknowns(start[equations.moving], v0[equations.running], ravel_pytree(values)[0].astype(q0.dtype), *nothing)
    ease = jnp.ones(sum(x.size for x in of), q0.dtype).at[equations.sizes[2] :].set(1e8 if search.held else 1.0)  # q stays if it can
    guess = equations.multipliers_at(given, jnp.concatenate(of), units)
    if search.running:
        J = jax.jacfwd(equations, 1)(jax.lax.stop_gradient(given), guess)
        given = given._replace(open=left_open(J, equations.sizes[0] + np.arange(len(search.running))))
    known = jnp.zeros_like(ease).at[: equations.moving.size].set(units[equations.moving])
    near = lambda given, guess: root_near(equations, given, guess, known, units, int(equations.sizes[2]), ease)
    if flat.contacts:
        given, root = on_contacts(equations, given, guess, near, units)
    else:
        root = near(given, guess)
    return _described(equations, given, root._replace(w=differentiable_root(equations, given, root.w, root.units, units)))


def _units(M: Float[Array, "n n"]) -> Float[Array, " n"]:
    """Units of the coordinates in which the inertia of each is 1; 0 for coordinates without inertia, and 1 for all if none has any."""
    mass = jax.lax.stop_gradient(jnp.diagonal(M))
    return jnp.where(jnp.any(mass > 0), units_of_mass(mass), 1)


def _described(equations: Equations, given: Given, root: Root) -> Rest:
    """A steady state with everything that is reported about it."""
    flat, q, v, of = equations.taken_apart(given, root.w)
    t, (known, at_rest) = given.t, jax.lax.stop_gradient((given, root.w))
    R, M = equations(known, at_rest), inertia(flat, t, q, v).as_matrix()
    step = jax.lax.stop_gradient(_a_while(_units(M), jnp.maximum(jnp.abs(q), jnp.abs(given.q)), v))
    later = at_rest.at[: equations.moving.size].add(jax.lax.stop_gradient(step * v)[equations.moving])
    uniform = is_nothing(equations(known._replace(t=known.t + step, q=known.q + step * known.v), later), root.size)
    in_terms_of_q = lambda q: equations(known._replace(q=q), at_rest.at[: equations.moving.size].set(q[equations.moving]))
    multipliers = of.multipliers
    if flat.rows:  # multipliers of least norm, if rows are dependent
        _, G, _ = constraint_rows(flat, t, q, v)
        metric = lx.DiagonalLinearOperator(jax.lax.stop_gradient(unit_lengths(M, G)) ** -2)
        multipliers = saddle_point(metric, G, -(G.T @ multipliers), jnp.zeros_like(multipliers)).multipliers
    friction, holds, slips = _friction(equations, flat, given, q, v, of)
    succeeded = root.found & holds
    shown = lambda x: jnp.where(succeeded, x, jnp.nan)
    states = jax.tree.map(shown, equations.unravel_states(of.states))
    return Rest(
        flat.unravel(shown(q)),
        flat.unravel(shown(v)),
        states,
        flat.unravel_multipliers(shown(multipliers)),
        friction,
        slips,
        t,
        succeeded,
        uniform,
        R / jnp.where(root.size > 0, root.size, 1),
        R[: q.size],
        Slopes(M, jax.jacfwd(in_terms_of_q)(jax.lax.stop_gradient(q))),
    )


def _a_while(units: Array, q: Array, v: Array) -> Array:
    """A time in which a motion covers a fraction of its coordinates, in units of mass; if these are zero, a fraction of one such unit.

    The drive of a motion runs with it; at rest, t is the time at which forces are evaluated.
    """
    far, fast = (jnp.max(jnp.abs(x) / jnp.where(units > 0, units, jnp.inf)) for x in (q, v))
    return jnp.where(fast > 0, 0.1 * jnp.where(far > 0, far, 1) / jnp.where(fast > 0, fast, 1), 0)


def _friction(
    equations: Equations, flat: Flat, given: Given, q: Array, v: Array, of: Unknowns
) -> tuple[dict[str, tuple[Array, Array]], Bool[Array, ""], Bool[Array, ""]]:
    """The friction force and its bound for each dissipation term; whether all forces are within their bounds and oppose the slip; and
    whether anything slips.
    """
    t = given.t
    elements = find_elements(flat)
    if elements is None:
        return {}, jnp.array(True), jnp.array(False)
    sigma, slip, row = directions_of_slip(elements, given), elements.slip(t, q, v), elements.element_of_row
    stuck, extent = sticking(elements, sigma), elements.norms(jnp.where(sigma == 0, 0, slip))
    slope = lambda D: jax.grad(lambda u: D(t, q, v, of.multipliers, u))(extent)
    total = slope(lambda *state: sum(D(*state) for D in elements.potentials.values()))
    held = of.friction if equations.friction_rows else jnp.zeros(row.size)
    bounds = {name: slope(D)[row[elements.rows_of_term[name]]] for name, D in elements.potentials.items() if name in elements.rows_of_term}
    forces = {name: jnp.where(stuck[row[rows]], held[rows], -bounds[name] * sigma[rows]) for name, rows in elements.rows_of_term.items()}
    within = elements.norms(held) <= total * (1 + jnp.finfo(v.dtype).eps ** 0.5)
    holds = jnp.all(jnp.where(stuck, within, elements.sums(sigma * slip) > 0))
    return {name: (forces[name], bounds[name]) for name in bounds}, holds, ~jnp.all(stuck)


def directions_of_slip(elements: FrictionElements, given: Given) -> Float[Array, " r"]:
    """The slip direction in the rows of each element that slips in the guess, as on a running belt; 0 for elements at rest there."""
    t, q, v = jax.lax.stop_gradient((given.t, given.q, given.v))
    slip = elements.slip(t, q, v)
    size = elements.norms(slip)
    at_rest = size <= slip_of(elements, t, q, v, 1e2 * jnp.finfo(v.dtype).eps * jnp.abs(v))
    return jnp.where(at_rest[elements.element_of_row], 0, slip / jnp.where(at_rest, 1, size)[elements.element_of_row])
