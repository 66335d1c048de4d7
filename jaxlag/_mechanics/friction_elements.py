"""Elements of dry friction: the nonsmooth terms of dissipation functions, found in D as it is written.

A term like μN|s| or μN‖s‖, with a slip velocity s(t, q, q̇), is read as D(u) with u = ‖s‖: its program is followed node by node
(`_program.velocity_degrees`, `_program.absolute_values`), and evaluated on arrays with u in place of each modulus. ∂D/∂u at s = 0 is the
bound of the friction force. Where that is zero whatever the state and the parameters, as of k|v|³, D is smooth; where it depends on
them, it may be zero at times.
"""

import itertools
from collections.abc import Callable, Container, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Jaxpr
from jaxtyping import Array, Float

from .._model.flat import Flat, bound_from, read_once
from .._model.reading import Source
from .._model.system import role
from .._program.absolute_values import Moduli
from .._program.constants import is_numeric
from .._program.expressions import Node, TooLong, is_number, objects
from .._program.jit import is_concrete
from .._program.polynomials import Modulus, moduli_in
from .._program.sparsity import sparsity_pattern
from .._program.substitution import evaluate_with_replacements, polynomial_values, source_equations
from .._program.velocity_degrees import Path, VelocityDegrees
from .._program.walker import constants_as_inputs
from .massless import SEVERAL, first_order, plastic, with_masses

MOST_NODES = 100_000  # of a program that is searched: a second or two
NUMBERS = 10  # of the arguments of a term, the first that is a number of the system and not of its state


class FrictionElements(NamedTuple):
    """The nonsmooth terms of all dissipation functions of a system: e elements, whose slip velocities make r rows."""

    slip: Callable[..., Float[Array, " r"]]  # s(t, q, v)
    potentials: dict[str, Callable[..., Float[Array, ""]]]  # D of each term (t, q, v, λ, u), with u of length e
    element_of_row: np.ndarray
    rows_of_term: dict[str, np.ndarray]  # of each nonsmooth term
    near_rest: Array | float = 0.0  # per element, the slip of several rows below which it keeps its direction
    massless: np.ndarray = np.array(-1)  # of each row the coordinate without inertia that only this friction resists, or −1
    is_quasistatic: np.ndarray = np.array(False)  # of each element, whether forces decide its slip, for want of inertia
    free: Array | None = None  # at one state, the projector onto the slips that constraints leave to each element (`constrained_slip`)
    straight: Array | np.ndarray = np.array(False)  # per element of several rows, whether that is a line, which passes through rest
    driven: Array | np.ndarray = np.array(False)  # per element, whether constraints drive its slip, so that it cannot rest

    @property
    def size(self) -> int:
        """How many elements there are."""
        return int(self.element_of_row.max(initial=-1)) + 1

    @property
    def is_vector(self) -> np.ndarray:
        """Which elements have more than one row."""
        return np.bincount(self.element_of_row) > 1

    @property
    def are_shared(self) -> bool:
        """Whether elements of several rows may hold a load together."""
        return self.size > 1 and bool(np.any(self.is_vector))

    def sums(self, rows: Float[Array, " r"]) -> Float[Array, " e"]:
        """Of each element's rows."""
        return jnp.sum(jnp.where(self.element_of_row == np.arange(self.size)[:, None], rows[None], 0), axis=1)

    def norms(self, rows: Float[Array, " r"]) -> Float[Array, " e"]:
        """Of each element's rows, with a zero derivative at zero."""
        squared = self.sums(rows**2)
        return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1)), 0)

    @property
    def own_rows(self) -> dict[str, np.ndarray]:
        """The rows of each term; rows that several terms share belong to the first of them."""
        own, seen = {}, np.zeros(0, int)
        for name, rows in self.rows_of_term.items():
            own[name] = np.setdiff1d(rows, seen)
            seen = np.union1d(seen, rows)
        return own


class _Recognised(NamedTuple):
    """The terms of D that are not smooth, with the moduli that bound their friction forces; and each modulus with the first of them that
    has it.
    """

    terms: dict[str, "_Term"]
    of_term: dict[str, list[Modulus]]
    first: dict[Modulus, str]


def find_elements(flat: Flat) -> FrictionElements | None:
    """The nonsmooth terms of D, or None where D is smooth."""
    if not flat.dissipations:
        return None
    terms, nonsmooth, first = flat.source.stated.read_programs(_recognised)
    if not first:
        return None
    sizes, numbers = [len(u.of) for u in first], flat.source.numbers
    starts = dict(zip(first, np.cumsum([0, *sizes]), strict=False))
    index = {u: i for i, u in enumerate(first)}

    def slip(t, q, v):
        state = numbers, (t, q, v, jnp.zeros(flat.rows, v.dtype))
        return jnp.concatenate([terms[name].slip(*state, [u for u in first if first[u] == name]) for name in nonsmooth])

    def potential(name):
        if name not in nonsmooth:
            return lambda t, q, v, multipliers, u: flat.dissipations[name](t, q, v, multipliers[: flat.rows])
        mine, term = np.asarray([index[u] for u in nonsmooth[name]]), terms[name]
        return lambda t, q, v, multipliers, u: term.reparameterised(numbers, (t, q, v, multipliers[: flat.rows]), nonsmooth[name], u[mine])

    rows_of = lambda moduli: np.concatenate([starts[u] + np.arange(len(u.of)) for u in moduli])
    rows_of_term = {name: rows_of(moduli) for name, moduli in nonsmooth.items()}
    potentials, of_row = {name: potential(name) for name in flat.dissipations}, np.repeat(np.arange(len(first)), sizes)
    elements = FrictionElements(slip, potentials, of_row, rows_of_term)
    if not flat.massless:
        return elements
    massless, quasistatic = read_once(flat, _without_inertia, stated=True)
    return elements._replace(massless=massless, is_quasistatic=quasistatic)


def without_friction(flat: Flat) -> FrictionElements:
    """No elements: of a system whose D is smooth."""

    def smooth(D):
        return lambda t, q, v, multipliers, u: D(t, q, v, multipliers[: flat.rows])

    none = np.zeros(0, int)
    potentials = {name: smooth(D) for name, D in flat.dissipations.items()}
    return FrictionElements(lambda t, q, v: jnp.zeros(0, v.dtype), potentials, none, {}, massless=none - 1, is_quasistatic=none > 0)


def _recognised(source: Source) -> tuple[_Recognised, bool]:
    """What is found in D; and whether its programs hold for all numbers, and not for those that functions close over while they change."""
    numbers, (t, q, v) = source.shapes
    multipliers = jax.eval_shape(lambda numbers: jnp.zeros(bound_from(source.with_numbers(numbers)).rows, q.dtype), numbers)
    structure, terms = VelocityDegrees(MOST_NODES), {}
    for name, _ in source.system.dissipation:
        D = lambda numbers, *state, name=name: bound_from(source.with_numbers(numbers)).dissipations[name](*state)
        terms[name] = _Term.read(structure, D, (t, q, v, multipliers), numbers)
    moduli = {name: term.nonsmooth(role("dissipation", name)) for name, term in terms.items() if term.moduli}
    nonsmooth = {name: of for name, of in moduli.items() if of}
    first: dict[Modulus, str] = {}
    for name, of in nonsmooth.items():
        first |= {u: name for u in of if u not in first}
    found = _Recognised({name: terms[name] for name in nonsmooth}, nonsmooth, first)
    return found, all(is_concrete(term.consts) for term in found.terms.values())


def _without_inertia(flat: Flat, t, q, v) -> tuple[np.ndarray, np.ndarray]:
    """What elements know of coordinates without inertia: which one each row alone resists, and whether forces decide the slip."""
    elements = find_elements(flat._replace(massless=()))
    assert elements is not None  # asked where there are some
    slipping = lambda D: lambda t, q, v, multipliers: D(t, q, v, multipliers, elements.sums(elements.slip(t, q, v)))
    sliding = flat._replace(dissipations={name: slipping(D) for name, D in elements.potentials.items()})
    rows, coordinates, decided = plastic(sliding, elements.slip, t, q, v)
    if np.any(elements.is_vector[elements.element_of_row[rows]]):
        raise ValueError(SEVERAL)
    massless, light = np.full(elements.element_of_row.size, -1), np.union1d(decided, coordinates).astype(int)
    massless[rows] = coordinates
    slips = sparsity_pattern(lambda dv: jax.jvp(lambda v: elements.slip(t, q, v), (v,), (dv,))[1], v)[:, light]
    return massless, np.isin(np.arange(elements.size), elements.element_of_row[np.any(slips, axis=1)])


def light_coordinates(flat: Flat) -> np.ndarray:
    """Coordinates without inertia whose motion dissipation decides: first-order ones, and those that stick and slip."""
    elements = find_elements(flat) if flat.massless else None
    sticking = np.zeros(0, int) if elements is None else elements.massless[elements.massless >= 0]
    return np.union1d(first_order(flat).coordinates, sticking).astype(int)


def with_all_masses(flat: Flat) -> Flat:
    """The system with masses, which nothing feels, where coordinates have none: for what moves a state by no more than rounding."""
    return with_masses(flat, light_coordinates(flat)) if flat.massless else flat


def unread_friction(flat: Flat, t, q, v, read: Container[str] | None = None) -> list[str]:
    """Dry friction that is not recognised as such, in words: forces that jump with a velocity; and for a motion that has failed, in which
    some terms were `read` as dry friction, what else in D may be nonsmooth.
    """
    state, structure, findings = (t, q, v, jnp.zeros(flat.rows, v.dtype)), VelocityDegrees(MOST_NODES), []
    for slot, terms in (("force", flat.forces), ("dissipation", flat.dissipations)):
        for name, function in terms.items():
            term = _Term.read(structure, lambda _, *state, function=function: function(*state), state)
            if term.moduli is None:
                continue
            if slot == "force" and term.moduli.jumps():
                findings.append(
                    f"{role(slot, name)} jumps with a velocity, as dry friction does, but sticking is not recognised in a force: "
                    "write it as `dissipation`, D = F * jnp.abs(v), whose force is -F * sign(v)"
                )
            elif slot == "force" or read is None or name in read:
                continue
            elif term.nonsmooth(role(slot, name)):
                findings.append(
                    f"{role(slot, name)} is dry friction for these parameters only, as |v|**p is for p = 1, which is not recognised: "
                    "write F * jnp.abs(v)"
                )
            elif term.moduli.is_unread():
                findings.append(
                    f"{role(slot, name)} depends on the sign or the root of a velocity in a way that is not recognised as dry friction: "
                    "if it is, write F * jnp.abs(v), or F * jnp.linalg.norm(v) of a vector"
                )
    return findings


class _Term(NamedTuple):
    """One term of D and the moduli in it."""

    jaxpr: Jaxpr  # with what it closes over, and the numbers of the system, as arguments, which come first
    consts: list[Any]
    numbers: list[Any]  # of these and of the state the shapes count
    state: tuple
    moduli: Moduli | None
    fresh: dict[Path, list[list[tuple[int, Node]]]]
    branches: dict[Path, int]

    @classmethod
    def read(cls, structure: VelocityDegrees, D: Callable, state: tuple, numbers: Sequence[Any] = ()) -> "_Term":
        """Of D(numbers, *state)."""
        closed = jax.make_jaxpr(D)(numbers, *state)
        jaxpr, beside = constants_as_inputs(closed), (closed.consts, list(numbers), state)
        try:
            (result,) = _outputs(structure, jaxpr, *beside)
        except TooLong:
            return cls(jaxpr, *beside, None, {}, {})
        moduli = Moduli(structure, objects(result).flat)
        return cls(jaxpr, *beside, moduli, structure.new_nodes, structure.branches)

    def nonsmooth(self, spoken: str) -> list[Modulus]:
        """The moduli that bound a friction force; refuses those of what is not affine in q̇ or whose two sides are not both recognised."""
        assert self.moduli is not None
        candidates, left_over = sorted(self.moduli.used(), key=lambda u: u.of[0].index), self.moduli.unpaired_signs()
        found = []
        for modulus, (slope, moves, affine) in zip(candidates, self._slopes(candidates), strict=True):
            if is_number(slope) and slope == 0:
                continue
            signed = not left_over.isdisjoint(modulus.of)
            if modulus not in self.moduli.genuine and (moves or not affine or signed):
                continue  # a maximum or a selection, not of friction
            if not affine:
                raise ValueError(
                    f"{spoken} must be nonsmooth only in slip velocities that are affine in qdot, but one is not. "
                    "Take the absolute value or norm of a relative velocity itself."
                )
            if signed:
                raise ValueError(
                    f"{spoken} must depend on the sign of a slip velocity in a recognised way, but does so in another "
                    "besides its absolute value. Write the coefficient of each side out, D = jnp.where(v > 0, F1, F2) * jnp.abs(v)."
                )
            found.append(modulus)
        return found

    def _slopes(self, moduli: list[Modulus]) -> list[tuple[Any, bool, bool]]:
        """Of each modulus ∂D/∂u where it vanishes, as an entry or a number; whether that moves with q̇; whether s is affine in q̇."""
        if not moduli:
            return []
        u = jax.ShapeDtypeStruct((len(moduli),), self.state[2].dtype)

        def slopes(consts, numbers, state, u):
            slope = jax.grad(lambda u: self.reparameterised(numbers, state, moduli, u, consts))(u)
            return slope, self.slip(numbers, state, moduli, consts)

        closed = jax.make_jaxpr(slopes)(self.consts, self.numbers, self.state, u)
        structure = VelocityDegrees(10 * MOST_NODES)
        consts = [*closed.consts, *self.consts]
        slope, slip = _outputs(structure, constants_as_inputs(closed), consts, self.numbers, (*self.state, u))
        closed_over = [structure.unknown(c) for c in self.consts if not is_numeric(c)]
        constants = frozenset(x for array in (*closed_over, *_unknown(structure, self.numbers)) for x in array.flat)
        found, rows = [], iter(slip.flat)
        for x, du, modulus in zip(structure.unknown(u, len(self.state)), slope, moduli, strict=True):
            s = list(itertools.islice(rows, len(modulus.of)))
            at_rest = structure.with_zeros(du, [y for y in (x, *s) if isinstance(y, Node)], constants)
            found.append((at_rest, structure.degree(at_rest) > 0, all(structure.degree(y) == 1 for y in s)))
        return found

    def slip(self, numbers, state, moduli, consts=None):
        """Their slip velocities, one after the other."""
        rows = [row for modulus in moduli for row in self.moduli.components[modulus]]
        if not rows:
            return jnp.zeros(0, self.state[2].dtype)
        wanted = source_equations(rows, self.moduli.places)
        until = 1 + max(path[0] for path in wanted)
        _, seen = self._evaluated(numbers, state, consts, wanted, lambda path, outputs, seen: outputs, until)
        return polynomial_values(rows, self.moduli.places, seen)

    def reparameterised(self, numbers, state, moduli, u, consts=None):
        """D with u in place of these moduli."""
        found, places, all_rows = self.moduli.resolved, self.moduli.places, self.moduli.components
        planned = {
            path: outputs
            for path, outputs in self.fresh.items()
            if any(not moduli_in(found[x]).isdisjoint(moduli) for output in outputs for _, x in output if x in found)
        }
        forms = [found[x] for outputs in planned.values() for output in outputs for _, x in output if x in found]
        others = [modulus for form in forms for modulus in moduli_in(form) if modulus not in moduli]
        rows = [row for modulus in others for row in all_rows[modulus]]

        def replaced(path, outputs, seen):
            if path not in planned:
                return outputs
            return [replaced_in(array, pairs, seen) for array, pairs in zip(outputs, planned[path], strict=True)]

        def replaced_in(array, pairs, seen):
            pairs = [(k, found[x]) for k, x in pairs if x in found]
            if not pairs:
                return array
            at, polynomials = zip(*pairs, strict=True)
            smooth = list(dict.fromkeys(modulus for p in polynomials for modulus in moduli_in(p) if modulus not in moduli))
            sizes = [_norm(polynomial_values(all_rows[modulus], places, seen)) for modulus in smooth]
            whole = jnp.concatenate([u, jnp.stack(sizes)]) if smooth else u
            new = polynomial_values(polynomials, places, seen, (*moduli, *smooth), whole).astype(array.dtype)
            return new.reshape(array.shape) if len(at) == array.size else array.ravel().at[np.asarray(at)].set(new).reshape(array.shape)

        (D,), _ = self._evaluated(numbers, state, consts, {*planned, *source_equations([*forms, *rows], places)}, replaced)
        return D

    def _evaluated(self, numbers, state, consts, wanted, replaced, until=None):
        inputs = [*(self.consts if consts is None else consts), *numbers, *state]
        return evaluate_with_replacements(self.jaxpr, inputs, wanted, self.branches, replaced, until)


def _outputs(structure: VelocityDegrees, jaxpr: Jaxpr, consts: Sequence[Any], numbers: Sequence[Any], state: tuple) -> list[np.ndarray]:
    """The outputs of a program at an unknown state and for unknown numbers, with what is known of what it closes over.

    The velocities come first: what a slip velocity begins with has a positive sign.
    """
    structure.reset()
    ahead = [structure.unknown(x, i, int(i == 2)) for i, x in reversed([*enumerate(state)])][::-1]
    known = [structure.known(np.asarray(x)) if is_numeric(x) else structure.unknown(x) for x in consts]
    return structure.run(jaxpr, [*known, *_unknown(structure, numbers), *ahead])


def _unknown(structure: VelocityDegrees, numbers: Sequence[Any]) -> list[np.ndarray]:
    """Nodes of the numbers of a system, the same for all its terms."""
    return [structure.unknown(x, NUMBERS + i) for i, x in enumerate(numbers)]


def _norm(rows: Float[Array, " n"]) -> Float[Array, ""]:
    """With a zero derivative at zero."""
    squared = rows @ rows
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1)), 0)
