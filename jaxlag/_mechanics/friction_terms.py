"""The kinks of dissipation functions, found in D as it is written.

A term like μN|s| or μN‖s‖, with a slip velocity s(t, q, q̇), is read as D(u) with u = ‖s‖: its program is followed entry by entry
(`_program.dependence`, `_program.absolute_values`), and evaluated on arrays with u in place of each modulus. ∂D/∂u at s = 0 is the
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

from .._model.system import Flat, role
from .._program.absolute_values import Moduli
from .._program.dependence import Path, Structure
from .._program.polynomials import Modulus, moduli_in
from .._program.scalar_graph import Entry, TooLong, is_number, objects
from .._program.substitution import evaluated, sources, values

LIMIT = 100_000  # entries of a program that is searched: a second or two


class Kinks(NamedTuple):
    """The kinks of all dissipation terms of a system: e elements, whose slip velocities make r rows."""

    slip: Callable[..., Float[Array, " r"]]  # s(t, q, v)
    lifted: dict[str, Callable[..., Float[Array, ""]]]  # D of each term (t, q, v, λ, u), with u of length e
    element_of_row: np.ndarray
    rows_of_term: dict[str, np.ndarray]  # of each term with kinks
    near_rest: Array | float = 0.0  # of a slip of several rows, how slow it is where it keeps its direction; per element

    @property
    def elements(self) -> int:
        """How many elements there are."""
        return int(self.element_of_row.max(initial=-1)) + 1

    @property
    def several(self) -> np.ndarray:
        """Which elements have more than one row."""
        return np.bincount(self.element_of_row) > 1

    @property
    def are_shared(self) -> bool:
        """Whether elements of several rows may hold a load together."""
        return self.elements > 1 and bool(np.any(self.several))

    def sums(self, rows: Float[Array, " r"]) -> Float[Array, " e"]:
        """Of each element's rows."""
        return jnp.zeros(self.elements, rows.dtype).at[self.element_of_row].add(rows)

    def norms(self, rows: Float[Array, " r"]) -> Float[Array, " e"]:
        """Of each element's rows, with a zero derivative at zero."""
        squared = self.sums(rows**2)
        return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1)), 0)

    @property
    def own_rows(self) -> dict[str, np.ndarray]:
        """The rows of each term, those that stand in several with the first alone."""
        own, seen = {}, np.zeros(0, int)
        for name, rows in self.rows_of_term.items():
            own[name] = np.setdiff1d(rows, seen)
            seen = np.union1d(seen, rows)
        return own


def kinks_of(flat: Flat, t, q, v) -> Kinks | None:
    """The kinks of D, or None where D is smooth. Shapes alone count of t, q and v."""
    state = (t, q, v, jnp.zeros(flat.rows, v.dtype))
    structure = Structure(LIMIT)
    terms = {name: _Term.read(structure, D, state) for name, D in flat.dissipations.items()}
    kinks = {name: term.kinks(role("dissipation", name)) for name, term in terms.items() if term.moduli}
    first: dict[Modulus, str] = {}
    for name, moduli in kinks.items():
        first |= {u: name for u in moduli if u not in first}
    if not first:
        return None

    sizes = [len(u.of) for u in first]
    starts = dict(zip(first, np.cumsum([0, *sizes]), strict=False))
    elements = {u: i for i, u in enumerate(first)}

    def slip(t, q, v):
        return jnp.concatenate([terms[name].slip((t, q, v, state[3]), [u for u in first if first[u] == name]) for name in kinks])

    def lifted(name):
        if not kinks.get(name):
            return lambda t, q, v, multipliers, u: flat.dissipations[name](t, q, v, multipliers[: flat.rows])
        mine = np.asarray([elements[u] for u in kinks[name]])
        return lambda t, q, v, multipliers, u: terms[name].lifted((t, q, v, multipliers[: flat.rows]), kinks[name], u[mine])

    rows_of_term = {name: np.concatenate([starts[u] + np.arange(len(u.of)) for u in moduli]) for name, moduli in kinks.items() if moduli}
    return Kinks(slip, {name: lifted(name) for name in terms}, np.repeat(np.arange(len(first)), sizes), rows_of_term)


def unread_friction(flat: Flat, t, q, v, read: Container[str] | None = None) -> list[str]:
    """What of dry friction is not read as such, in words: forces that jump with a velocity; and of a motion that has failed, in which
    it was `read` in some terms, what else of D may be a kink.
    """
    state, structure = (t, q, v, jnp.zeros(flat.rows, v.dtype)), Structure(LIMIT)
    findings = []
    for slot, terms in (("force", flat.forces), ("dissipation", flat.dissipations)):
        for name, function in terms.items():
            term = _Term.read(structure, function, state)
            if term.moduli is None:
                continue
            if slot == "force" and term.moduli.jumps():
                findings.append(
                    f"{role(slot, name)} jumps with a velocity, as dry friction does, but sticking is not found in a force: "
                    "write it as `dissipation`, D = F * jnp.abs(v), whose force is -F * sign(v)"
                )
            elif slot == "force" or read is None or name in read:
                continue
            elif term.kinks(role(slot, name)):
                findings.append(
                    f"{role(slot, name)} is dry friction for these parameters alone, as |v|**p is for p = 1, which is not looked for: "
                    "write F * jnp.abs(v)"
                )
            elif term.moduli.unresolved:
                findings.append(
                    f"{role(slot, name)} depends on the sign or the root of a velocity in a way that is not read as dry friction: "
                    "if it is, write F * jnp.abs(v), or F * jnp.linalg.norm(v) of a vector"
                )
    return findings


class _Term(NamedTuple):
    """One term of D and what there is of moduli in it."""

    jaxpr: Jaxpr  # with what it closes over as arguments, which come first
    consts: list[Any]
    state: tuple
    moduli: Moduli | None
    fresh: dict[Path, list[list[tuple[int, Entry]]]]
    branches: dict[Path, int]

    @classmethod
    def read(cls, structure: Structure, D: Callable, state: tuple) -> "_Term":
        closed = jax.make_jaxpr(D)(*state)
        jaxpr = closed.jaxpr.replace(constvars=[], invars=[*closed.jaxpr.constvars, *closed.jaxpr.invars])
        try:
            (result,) = _entries(structure, jaxpr, closed.consts, state)
        except TooLong:
            return cls(jaxpr, closed.consts, state, None, {}, {})
        moduli = Moduli(structure, objects(result).flat)
        return cls(jaxpr, closed.consts, state, moduli, structure.fresh, structure.branches)

    def kinks(self, spoken: str) -> list[Modulus]:
        """Those that bound a friction force; refuses kinks of what is not affine in q̇, or has an unlike force on both sides unread."""
        assert self.moduli is not None
        candidates, left_over = sorted(self.moduli.used(), key=lambda u: u.of[0].place), self.moduli.left_over()
        found = []
        for modulus, (slope, moves, affine) in zip(candidates, self._slopes(candidates), strict=True):
            if is_number(slope) and slope == 0:
                continue
            signed = not left_over.isdisjoint(modulus.of)
            if modulus not in self.moduli.hard and (moves or not affine or signed):
                continue  # a maximum or a selection, not of friction
            if not affine:
                raise ValueError(
                    f"{spoken} must have its kinks in slip velocities that are affine in qdot, but one is not. "
                    "Take the absolute value or norm of a relative velocity itself."
                )
            if signed:
                raise ValueError(
                    f"{spoken} must depend on the sign of a slip velocity in a way that is read, but beside its absolute value there is "
                    "another. Write the coefficient of each side out, D = jnp.where(v > 0, F1, F2) * jnp.abs(v)."
                )
            found.append(modulus)
        return found

    def _slopes(self, moduli: list[Modulus]) -> list[tuple[Any, bool, bool]]:
        """Of each modulus ∂D/∂u where it vanishes, as an entry or a number; whether that moves with q̇; whether s is affine in q̇."""
        if not moduli:
            return []
        u = jnp.zeros(len(moduli), self.state[2].dtype)

        def slopes(consts, state, u):
            return jax.grad(lambda u: self.lifted(state, moduli, u, consts))(u), self.slip(state, moduli, consts)

        closed = jax.make_jaxpr(slopes)(self.consts, self.state, u)
        jaxpr = closed.jaxpr.replace(constvars=[], invars=[*closed.jaxpr.constvars, *closed.jaxpr.invars])
        structure = Structure(10 * LIMIT)
        slope, slip = _entries(structure, jaxpr, [*closed.consts, *self.consts], (*self.state, u))
        constants = frozenset(x for c in self.consts if not _is_known(c) for x in structure.unknown(c).flat)
        found, rows = [], iter(slip.flat)
        for x, du, modulus in zip(structure.unknown(u, len(self.state)), slope, moduli, strict=True):
            s = list(itertools.islice(rows, len(modulus.of)))
            at_rest = structure.where_zero(du, [y for y in (x, *s) if isinstance(y, Entry)], constants)
            found.append((at_rest, structure.degree(at_rest) > 0, all(structure.degree(y) == 1 for y in s)))
        return found

    def slip(self, state, moduli, consts=None):
        """Their slip velocities, one after the other."""
        rows = [row for modulus in moduli for row in self.moduli.rows[modulus]]
        if not rows:
            return jnp.zeros(0, self.state[2].dtype)
        wanted = sources(rows, self.moduli.places)
        until = 1 + max(path[0] for path in wanted)
        _, seen = self._evaluated(state, consts, wanted, lambda path, outputs, seen: outputs, until)
        return values(rows, self.moduli.places, seen)

    def lifted(self, state, moduli, u, consts=None):
        """D with u in place of these moduli."""
        found, places, all_rows = self.moduli.found, self.moduli.places, self.moduli.rows
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
            sizes = [_norm(values(all_rows[modulus], places, seen)) for modulus in smooth]
            whole = jnp.concatenate([u, jnp.stack(sizes)]) if smooth else u
            new = values(polynomials, places, seen, (*moduli, *smooth), whole).astype(array.dtype)
            return new.reshape(array.shape) if len(at) == array.size else array.ravel().at[np.asarray(at)].set(new).reshape(array.shape)

        (D,), _ = self._evaluated(state, consts, {*planned, *sources([*forms, *rows], places)}, replaced)
        return D

    def _evaluated(self, state, consts, wanted, replaced, until=None):
        inputs = [*(self.consts if consts is None else consts), *state]
        return evaluated(self.jaxpr, inputs, wanted, self.branches, replaced, until)


def _entries(structure: Structure, jaxpr: Jaxpr, consts: Sequence[Any], state: tuple) -> list[np.ndarray]:
    """The outputs of a program at an unknown state, with what is known of what it closes over."""
    structure.begin()
    known = [structure.known(np.asarray(x)) if _is_known(x) else structure.unknown(x) for x in consts]
    return structure.inner(jaxpr, [*known, *(structure.unknown(x, i, int(i == 2)) for i, x in enumerate(state))])


def _is_known(x: Any) -> bool:
    return not isinstance(x, jax.core.Tracer) and isinstance(x, (np.ndarray, np.generic, jax.Array, int, float))


def _norm(rows: Float[Array, " n"]) -> Float[Array, ""]:
    """With a zero derivative at zero."""
    squared = rows @ rows
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1)), 0)
