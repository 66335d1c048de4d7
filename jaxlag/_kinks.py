"""The kinks of dissipation functions, found in D as it is written.

A term like μN|s| or μN‖s‖, with a slip velocity s(t, q, q̇), is read as D(u) with u = ‖s‖: its jaxpr is evaluated with each abs and each
norm of a velocity at hand to be replaced. ∂D/∂u at u = 0 is the bound of the friction force; where it is zero, as of k|v|³, D is smooth.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal
from jaxtyping import Array, Float

from ._entries import evaluate, on_arrays
from ._folding import Algebra
from ._primitives import CALLS, body
from ._system import Flat, role


class Kinks(NamedTuple):
    """The kinks of all dissipation terms of a system: e elements, whose slip velocities make r rows."""

    slip: Callable[..., Float[Array, " r"]]  # s(t, q, v)
    lifted: dict[str, Callable[..., Float[Array, ""]]]  # D of each term (t, q, v, λ, u), with u of length e
    element_of_row: np.ndarray
    rows_of_term: dict[str, np.ndarray]  # of each term with kinks

    @property
    def elements(self) -> int:
        """How many elements there are."""
        return int(self.element_of_row.max(initial=-1)) + 1

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
    arguments = (t, q, v, jnp.zeros(flat.rows, v.dtype))
    numbers: dict[Any, int] = {}
    terms = {name: _Term(jax.make_jaxpr(D)(*arguments), numbers, role("dissipation", name)) for name, D in flat.dissipations.items()}
    groups: dict[int, _Group] = {}
    keys = {name: [key for key, group in term.groups(arguments).items() if term.has_kink(arguments, key)] for name, term in terms.items()}
    for name, term in terms.items():
        groups |= {key: group for key, group in term.groups(arguments).items() if key in keys[name]}
    if not groups:
        return None

    element_of_row: list[int] = []
    rows, elements = {}, {}
    for key, group in groups.items():
        first = element_of_row[-1] + 1 if element_of_row else 0
        mine = [first] * group.size if group.is_norm else range(first, first + group.size)
        rows[key] = np.arange(len(element_of_row), len(element_of_row) + group.size)
        element_of_row += mine
        elements[key] = first if group.is_norm else np.asarray(mine).reshape(np.shape(group.slip))

    def slip(t, q, v):
        found: dict[int, _Group] = {}
        for name, term in terms.items():
            if keys[name]:
                found |= term.groups((t, q, v, arguments[3]))
        return jnp.concatenate([jnp.ravel(found[key].slip) for key in groups])

    def lifted(name):
        def potential(t, q, v, multipliers, u):
            replaced = lambda key, _: u[elements[key]] if key in keys[name] else None
            return terms[name].evaluate((t, q, v, multipliers[: flat.rows]), replaced)

        return potential

    rows_of_term = {name: np.concatenate([rows[key] for key in keys[name]]) for name in terms if keys[name]}
    return Kinks(slip, {name: lifted(name) for name in terms}, np.asarray(element_of_row), rows_of_term)


class _Node(NamedTuple):
    """A value in the jaxpr of D; equal numbers say that it is the same quantity."""

    value: Any
    depends: bool  # on the velocity
    made_by: tuple[str, tuple["_Node", ...], dict] | None
    number: int


class _Group(NamedTuple):
    """The slip velocity in one abs (an element each entry) or one norm (one element)."""

    slip: Any
    is_norm: bool
    size: int


class _Term(NamedTuple):
    """One term of D. `numbers` is shared by all, so that a slip velocity that stands in several is one."""

    closed: ClosedJaxpr
    numbers: dict[Any, int]
    spoken: str

    def groups(self, arguments, consts=None) -> dict[int, _Group]:
        """Every abs and norm of a velocity, by the number of the quantity."""
        found: dict[int, _Group] = {}
        self.evaluate(arguments, lambda key, group: found.setdefault(key, group) and None, consts)
        return found

    def has_kink(self, arguments, key) -> bool:
        """Whether ∂D/∂u at u = 0 is anything but zero, judged at random numbers; refuses kinks of what is not affine in q̇."""
        rng = np.random.default_rng(0)
        drawn = jax.tree.map(lambda x: _drawn(rng, x), (list(self.closed.consts), arguments))

        def slope_and_bend(consts, arguments):
            t, q, v, multipliers = arguments
            slip = lambda v: self.groups((t, q, v, multipliers), consts)[key].slip
            group = self.groups(arguments, consts)[key]
            along = lambda v, w: jax.jvp(slip, (v,), (w,))[1]
            D = lambda u: self.evaluate(arguments, lambda k, _: u if k == key else None, consts)
            at_rest = jnp.zeros_like(group.slip[..., 0] if group.is_norm else group.slip)
            bend = jax.jvp(lambda v: along(v, v * 0 + 1), (v,), (_drawn(rng, v),))[1]
            return jax.grad(D)(at_rest), bend

        slope, bend = evaluate(jax.make_jaxpr(slope_and_bend)(*drawn), Algebra(), *jax.tree.leaves(drawn))
        if not np.any(slope != 0):
            return False
        if np.any(np.abs(bend) > 1e-9):
            raise ValueError(
                f"{self.spoken} must have its kinks in slip velocities that are affine in qdot, but one is not. "
                "Take the absolute value or norm of a relative velocity itself."
            )
        return True

    def evaluate(self, arguments, replaced: Callable[[int, _Group], Any], consts=None) -> Any:
        """D, with `replaced(number, group)` in place of each abs and norm of a velocity; None leaves it."""

        def node(value, depends, made_by, key):
            return _Node(value, depends, made_by, self.numbers.setdefault(key, len(self.numbers)))

        def run(jaxpr, env):
            read = lambda x: node(x.val, False, None, ("literal", repr(x.val))) if isinstance(x, Literal) else env[x]
            for eqn in jaxpr.eqns:
                env |= dict(zip(eqn.outvars, step(eqn, [read(x) for x in eqn.invars]), strict=True))
            return [read(x) for x in jaxpr.outvars]

        def step(eqn, ins):
            slip = _slip_in(eqn, ins)
            if slip is not None:
                of, is_norm = slip
                key = ("kink", is_norm, tuple(n.number for n in of))
                number = self.numbers.setdefault(key, len(self.numbers))
                value = jnp.concatenate([jnp.ravel(n.value) for n in of]) if is_norm else of[0].value
                value = replaced(number, _Group(value, is_norm, int(np.size(value))))
                if value is not None:
                    return [_Node(value, True, None, number)]
            if eqn.primitive.name in CALLS:
                inner = body(eqn)
                known = [node(c, False, None, ("const", id(c))) for c in inner.consts]
                return run(inner.jaxpr, dict(zip((*inner.jaxpr.constvars, *inner.jaxpr.invars), (*known, *ins), strict=True)))
            outs = on_arrays(eqn)(*(n.value for n in ins))
            made_by, depends = (eqn.primitive.name, tuple(ins), eqn.params), any(n.depends for n in ins)
            key = (eqn.primitive.name, tuple(n.number for n in ins), str(eqn.params))
            return [node(out, depends, made_by, (*key, i)) for i, out in enumerate(outs)]

        values = self.closed.consts if consts is None else consts
        known = [node(value, False, None, ("const", id(c))) for c, value in zip(self.closed.consts, values, strict=True)]
        given = [node(a, i == 2, None, ("argument", i)) for i, a in enumerate(arguments)]
        variables = (*self.closed.jaxpr.constvars, *self.closed.jaxpr.invars)
        return run(self.closed.jaxpr, dict(zip(variables, (*known, *given), strict=True)))[0].value


_CARRIED = {"reshape", "convert_element_type", "copy", "squeeze", "broadcast_in_dim"}


def _drawn(rng, x):
    if jnp.issubdtype(x.dtype, jnp.floating):
        return np.asarray(rng.uniform(0.5, 1.5, x.shape), x.dtype)
    return np.ones(x.shape, x.dtype)


def _slip_in(eqn, ins) -> tuple[tuple[_Node, ...], bool] | None:
    """The slip velocity whose absolute value (False) or norm (True) this equation takes, if it takes one."""
    name, called = eqn.primitive.name, eqn.params.get("name")
    if not any(n.depends for n in ins):
        return None
    if name == "abs":
        return (ins[0],), False
    if name == "custom_jvp_call" and _is_norm(eqn.params["call_jaxpr"].jaxpr):  # e.g. jaxlag.dissipation.speed
        return tuple(ins), True
    if name in ("jit", "pjit") and called == "hypot":
        return tuple(ins), True
    if name == "sqrt":
        squares = _squares(ins[0])
        return None if squares is None else (squares, True)
    return None


def _is_norm(jaxpr) -> bool:
    """Whether a function with a derivative rule of its own is a norm: a square root of squares, and nothing else."""
    names = [name for eqn in jaxpr.eqns for name in _primitives(eqn)]
    return names[-1:] == ["sqrt"] and set(names[:-1]) <= _CARRIED | {"mul", "square", "integer_pow", "reduce_sum", "dot_general", "add"}


def _primitives(eqn):
    if eqn.primitive.name not in CALLS:
        return [eqn.primitive.name]
    return [name for part in body(eqn).jaxpr.eqns for name in _primitives(part)]


def _squares(node: _Node) -> tuple[_Node, ...] | None:
    """The quantities whose squares add up to `node`, if it is such a sum."""
    if node.made_by is None:
        return None
    name, ins, params = node.made_by
    if name in _CARRIED or name == "reduce_sum":
        return _squares(ins[0])
    if name in ("add", "add_any"):
        left, right = (_squares(n) for n in ins)
        return None if left is None or right is None else left + right
    if name == "square" or (name == "integer_pow" and params["y"] == 2):
        return (ins[0],)
    if name in ("mul", "dot_general") and ins[0].number == ins[1].number:
        return (ins[0],)
    return None
