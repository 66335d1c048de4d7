"""The same system stated by another program: another order, other coordinates, something beside it, constraints and energies otherwise.

A variant is another `Case` and the way back of what is asked of it; results that have no counterpart are left out.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from generate import Case, Term
from machines import MACHINES

import jaxlag as jl

Results = dict[str, np.ndarray]


class Variant(NamedTuple):
    """Another statement of a case, and its results as those of the case."""

    case: Case
    back: Callable[[Results], Results]


def _each_term(case: Case, change: Callable[[Term], Term]) -> Case:
    terms = {slot: {name: change(term) for name, term in named.items()} for slot, named in case.terms.items()}
    return case._replace(terms=terms, states={name: (change(term), *more) for name, (term, *more) in case.states.items()})


def _in_coordinates(place: Callable, rate: Callable) -> Callable[[Term], Term]:
    """Terms of q = place(y, p) and v = rate(y, ẏ, p)."""

    def changed(term):
        return Term(lambda t, q, v, p, **z: term.f(t, place(q, p), None if v is None else rate(q, v, p), p, **z), term.names)

    return changed


OF_COORDINATES = ("q", "q̇", "q̈", "Gᵀλ")


def _columns(which: np.ndarray) -> Callable[[Results], Results]:
    """Of what has the coordinates as its last axis, those of the case; derivatives by matrices of parameters are left out."""
    return lambda seen: {name: x[..., which] if name in OF_COORDINATES else x for name, x in seen.items() if not name.startswith("dq/")}


def reordered(case: Case) -> Variant:
    """Coordinates backwards, terms and parameters too."""
    back = lambda q, p: q[::-1]
    new = _each_term(case, _in_coordinates(back, lambda q, v, p: v[::-1]))
    forces = {name: Term(_backwards(term.f), term.names) for name, term in new.terms["force"].items()}
    turned = {slot: dict(reversed(named.items())) for slot, named in (new.terms | {"force": forces}).items()}
    params = dict(reversed(case.params.items()))
    return Variant(new._replace(terms=turned, params=params, q0=case.q0[::-1], qdot0=case.qdot0[::-1]), _columns(np.arange(case.n)[::-1]))


def _backwards(f: Callable) -> Callable:
    return lambda *args, **z: f(*args, **z)[::-1]


def beside(mass: float, stiffness: float, q0: float, first: bool) -> Callable[[Case], Variant]:
    """An oscillator that nothing couples to, before or behind the others."""

    def of(case: Case) -> Variant:
        own = np.arange(case.n) + first
        other = 0 if first else case.n
        new = _each_term(case, _in_coordinates(lambda q, p: q[own], lambda q, v, p: v[own]))
        energy = Term(lambda t, q, v, p: 0.5 * p["beside_m"] * v[other] ** 2 - 0.5 * p["beside_k"] * q[other] ** 2)
        terms = new.terms | {"lagrangian": new.terms["lagrangian"] | {"beside": energy}}
        terms["force"] = {name: Term(_widened(term.f, own, case.n + 1), term.names) for name, term in terms["force"].items()}
        put = lambda x, value: np.insert(np.asarray(x, float), other, value)
        params = case.params | {"beside_m": mass, "beside_k": stiffness}
        return Variant(new._replace(terms=terms, params=params, q0=put(case.q0, q0), qdot0=put(case.qdot0, 0.0)), _columns(own))

    return of


def _widened(f: Callable, own: np.ndarray, n: int) -> Callable:
    return lambda *args, **z: jnp.zeros(n).at[own].set(f(*args, **z))


def curved(case: Case) -> Variant:
    """q = y + 0.3 sin y, coordinate by coordinate; forces follow by virtual work."""
    place = lambda y, p: y + 0.3 * jnp.sin(y)
    slope = lambda y: 1 + 0.3 * np.cos(y)
    new = _each_term(case, _in_coordinates(place, lambda y, v, p: (1 + 0.3 * jnp.cos(y)) * v))
    forces = {name: Term(_by_virtual_work(term.f), term.names) for name, term in new.terms["force"].items()}
    y0 = np.array([_root(q) for q in case.q0])
    new = new._replace(terms=new.terms | {"force": forces}, q0=y0, qdot0=case.qdot0 / slope(y0))

    def back(seen):
        y, v = seen.get("q", y0), seen.get("q̇", y0 * 0 + case.qdot0 / slope(y0))
        found = {"q": y + 0.3 * np.sin(y), "q̇": slope(y) * v}
        if "q̈" in seen:
            found["q̈"] = slope(y) * seen["q̈"] - 0.3 * np.sin(y) * v**2
        if "Gᵀλ" in seen:
            found["Gᵀλ"] = seen["Gᵀλ"] / slope(y)
        return seen | {name: x for name, x in found.items() if name in seen}

    return Variant(new, back)


def _by_virtual_work(f: Callable) -> Callable:
    return lambda t, q, v, p, **z: (1 + 0.3 * jnp.cos(q)) * f(t, q, v, p, **z)


def _root(q):
    y = q
    for _ in range(50):
        y -= (y + 0.3 * np.sin(y) - q) / (1 + 0.3 * np.cos(y))
    return y


def turned(case: Case) -> Variant:
    """q = A y with a rotation A, a parameter."""
    A = np.linalg.qr(np.random.default_rng(case.n).normal(size=(case.n, case.n)))[0]
    new = _each_term(case, _in_coordinates(lambda y, p: p["A"] @ y, lambda y, v, p: p["A"] @ v))
    forces = {
        name: Term(lambda t, q, v, p, f=term.f, **z: p["A"].T @ f(t, q, v, p, **z), term.names) for name, term in new.terms["force"].items()
    }
    new = new._replace(terms=new.terms | {"force": forces}, params=case.params | {"A": A}, q0=A.T @ case.q0, qdot0=A.T @ case.qdot0)
    return Variant(new, lambda seen: {name: x @ A.T if name in OF_COORDINATES else x for name, x in seen.items()})


def _turned_back(f: Callable) -> Callable:
    return lambda t, q, v, p, **z: p["A"].T @ f(t, q, v, p, **z)


def _same(seen: Results) -> Results:
    return seen


def gauged(case: Case) -> Variant:
    """L plus the total time derivative of sin(k·q) + t q₀²."""
    first = next(iter(case.terms["lagrangian"].values())).f
    potential = lambda t, q, p: jnp.sin(p["k"] @ q) + t * q[0] ** 2

    def more(t, q, v, p):
        return first(t, q, v, p) + jax.jvp(lambda t, q: potential(t, q, p), (t, q), (jnp.ones_like(t), v))[1]

    left_out = lambda seen: {name: x for name, x in seen.items() if not name.startswith("W")}
    return Variant(case._replace(terms=case.terms | {"lagrangian": {"energy": Term(more)}}), left_out)


def as_force(case: Case) -> Variant:
    """The smooth part of D as the force −∂D/∂q̇."""
    dampers = case.terms["dissipation"]["dampers"].f
    others = {name: term for name, term in case.terms["dissipation"].items() if name != "dampers"}
    force = Term(lambda t, q, v, p: -jax.grad(dampers, argnums=2)(t, q, v, p))
    terms = case.terms | {"dissipation": others, "force": case.terms["force"] | {"dampers": force}}
    return Variant(case._replace(terms={slot: named for slot, named in terms.items() if named}), _same)


def cubed(case: Case) -> Variant:
    """g + g³ in place of g: the same condition with the same slope on it."""
    g = case.terms["holonomic"]["loop"].f
    return Variant(_with_loop(case, {"loop": Term(lambda t, q, v, p: g(t, q, v, p) + g(t, q, v, p) ** 3)}), _same)


def twice(case: Case) -> Variant:
    """A constraint stated twice: each copy has half of λ."""
    g = case.terms["holonomic"]["loop"]
    again = Term(lambda t, q, v, p: 1.0 * g.f(t, q, v, p))

    def back(seen):
        sums = {"λ loop": seen["λ loop"] + seen["λ again"]} if "λ loop" in seen else {}
        return {name: x for name, x in seen.items() if name != "λ again" and not name.startswith("W")} | sums

    return Variant(_with_loop(case, {"loop": g, "again": again}), back)


def components(case: Case) -> Variant:
    """Each component of a vector of constraints as a constraint with a name."""
    terms, names = dict(case.terms), {}
    for slot in (slot for slot in ("holonomic", "nonholonomic") if slot in case.terms):
        terms[slot] = {}
        for name, term in case.terms[slot].items():
            size = np.size(term.f(0.0, jnp.asarray(case.q0), jnp.asarray(case.qdot0), case.params))
            names[name] = [f"{name} {i}" for i in range(size)]
            terms[slot] |= {row: Term(_component(term.f, i), term.names) for i, row in enumerate(names[name])}

    def back(seen):
        others = {name: x for name, x in seen.items() if not name.startswith(("λ", "W"))}
        held = {name: rows for name, rows in names.items() if f"λ {rows[0]}" in seen}
        return others | {f"λ {name}": np.stack([seen[f"λ {row}"] for row in rows], -1) for name, rows in held.items()}

    return Variant(case._replace(terms=terms), back)


def _component(f: Callable, i: int) -> Callable:
    return lambda *args, **z: f(*args, **z)[i]


def _with_loop(case: Case, rows: dict[str, Term]) -> Case:
    return case._replace(terms=case.terms | {"holonomic": rows})


def as_vector(case: Case) -> Variant:
    """Friction on a line as that of a vector with two components."""
    along = lambda t, q, v, p: p["F"] * jl.dissipation.speed((p["r"] @ v) * jnp.array([0.6, 0.8]))
    terms = case.terms | {"dissipation": case.terms["dissipation"] | {"dry": Term(along)}}
    left_out = lambda seen: {name: x for name, x in seen.items() if not name.startswith(("friction", "sticking"))}
    return Variant(case._replace(terms=terms), left_out)


VARIANTS = {
    "reordered": reordered,
    "beside, heavy": beside(1e9, 1e9, 0.1, True),
    "beside, light": beside(1e-9, 1e-9, 0.1, False),
    "beside, fast": beside(1.0, 1e4, 1e-3, False),
    "beside, at rest": beside(1.0, 1.0, 0.0, True),
    "curved": curved,
    "turned": turned,
    "gauged": gauged,
    "as force": as_force,
    "cubed": cubed,
    "twice": twice,
    "as vector": as_vector,
    "components": components,
}


PROGRAMS: dict = {}


def variant(name: str, case: Case) -> Variant:
    """A variant of a case; all seeds share its programs."""
    new, back = VARIANTS[name](case)
    terms, states = PROGRAMS.setdefault((name, case.kind, case.n), (new.terms, new.states))
    return Variant(new._replace(terms=terms, states=states), back)


def applies(name: str, kind: str) -> bool:
    """Whether a kind can be stated so; of machines, those of which a constraint is a vector, by its components alone."""
    if name == "components" or kind in MACHINES:
        return name == "components" and kind in ("vehicle in parts", "bicycle", "coin", "four-bar linkage")
    if name in ("cubed", "twice"):
        return kind in ("holonomic", "dry loop", "held and rolling")
    if name == "as vector":
        return kind in ("dry", "dry loop")
    if name == "as force":
        return kind != "massless"
    if name in ("curved", "turned"):  # the velocities of what has no inertia are not those given
        return kind != "massless"
    return True
