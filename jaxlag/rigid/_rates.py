"""The angular velocity of a rotation matrix, from the program that makes it; for a product, factor by factor."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jax.interpreters import partial_eval
from jaxtyping import Array, Float

from ._vectors import check_rotation, floating, known

PRODUCT = (((1,), (0,)), ((), ()))  # the dimensions that A B sums over
UNCHANGED = ("convert_element_type", "copy", "optimization_barrier")
ABOUT = tuple(f"jaxlag.rigid._about_{axis}" for axis in "xyz")  # the kit's rotations about one axis
FORMULAS: dict[str, Callable] = {}  # of the kit's rotations, by names that no other function has


def turning(formula: Callable) -> Callable[[Callable], Callable]:
    """Decorator of a function that makes a rotation matrix of arrays: ω, in the axes of the body, is formula(arrays, their rates)."""

    def named(matrix: Callable) -> Callable:
        matrix.__name__ = f"jaxlag.rigid.{matrix.__name__}"
        FORMULAS[matrix.__name__] = formula
        return jax.jit(matrix)

    return named


def body_rate(rotation: Callable, q: Any, qdot: Any) -> Float[Array, "3"]:
    """Angular velocity, in its own axes, of a body whose rotation matrix is R(q)."""
    ((_, omega),) = rates(lambda q: [(jnp.zeros(0), rotation(q))], q, qdot, AngularVelocities.body)
    return omega


def rates(frames: Callable, q: Any, qdot: Any, *wanted: Callable) -> list[tuple[Array, Any]]:
    r"""Velocities of the origins and angular velocities of the axes of frames that one program makes from q.

    $$ \omega_{AB} = B^T \omega_A + \omega_B, \qquad \omega_{A^T} = -A\,\omega_A, \qquad [\omega]_\times = R^T\dot R $$

    The last differentiates R: for a product as a whole, it would make a mass matrix ten times as long. `wanted` gives, for each frame, the
    method of `AngularVelocities` whose result accompanies the velocity of the origin.

    **Source:** Murray, Li & Sastry, A Mathematical Introduction to Robotic Manipulation, proposition 2.15.
    """
    (leaves, structure), tangents = jax.tree.flatten(jax.tree.map(floating, q)), jax.tree.leaves(jax.tree.map(floating, qdot))

    def program(*leaves: Any) -> list:
        return [(x, check_rotation(R, "`rotation` of a body")) for x, R in frames(jax.tree.unflatten(structure, leaves))]

    if known(leaves) is not None:
        program(*leaves)  # which checks its numbers
    factors = _Factors(jax.make_jaxpr(program)(*leaves))
    places, matrices = factors.closed.jaxpr.outvars[::2], factors.closed.jaxpr.outvars[1::2]
    of = AngularVelocities(factors)
    omegas = [axes(of, R) for axes, R in zip(wanted, matrices, strict=True)]
    found = jax.jvp(lambda *leaves: factors.evaluated([*of.numbers, *places], leaves), tuple(leaves), tuple(tangents))
    of.numbers.update(zip(of.numbers, zip(*found, strict=True), strict=False))
    return [(v, omega()) for v, omega in zip(found[1][len(of.numbers) :], omegas, strict=True)]


class _Factors:
    """The factors of which a program makes rotation matrices."""

    def __init__(self, closed: Any):
        self.closed = closed
        self.made_by = {variable: equation for equation in closed.jaxpr.eqns for variable in equation.outvars}
        self.constants = dict(zip(closed.jaxpr.constvars, closed.consts, strict=True))
        self.moving = set(closed.jaxpr.invars)
        for equation in closed.jaxpr.eqns:
            if any(not isinstance(x, core.Literal) and x in self.moving for x in equation.invars):
                self.moving.update(equation.outvars)

    def evaluated(self, variables: Any, leaves: Any) -> list:
        """The arrays of some variables, and nothing else."""
        jaxpr, _ = partial_eval.dce_jaxpr(self.closed.jaxpr.replace(outvars=list(variables)), [True] * len(variables), instantiate=True)
        return core.jaxpr_as_fun(core.ClosedJaxpr(jaxpr, self.closed.consts))(*leaves)

    def is_rotation(self, R: Any) -> bool:
        """Whether an array is certainly a rotation matrix."""
        if R in self.constants:
            seen = known(self.constants[R])
            return seen is not None and np.allclose(seen.T @ seen, np.eye(3), rtol=0, atol=1e-6) and bool(np.linalg.det(seen) > 0)
        kind, of = self.made(R)
        return kind in FORMULAS or (kind in (*UNCHANGED, "transpose", "product") and all(map(self.is_rotation, of)))

    def made(self, R: Any) -> tuple[str, list]:
        """The operation that makes an array, and its operands."""
        if R not in self.made_by:
            return "", []
        equation = self.made_by[R]
        name, of = equation.primitive.name, equation.invars
        if name in ("jit", "pjit"):
            return equation.params["name"], of
        is_product = name == "dot_general" and _tuples(equation.params["dimension_numbers"]) == PRODUCT
        return "product" if is_product and all(x.aval.shape == (3, 3) for x in of) else name, of


def _once(formula: Callable) -> Callable:
    """Decorator of a method that returns a function without arguments: made once for each set of arguments, and evaluated once."""

    @functools.wraps(formula)
    def made(self: Any, *given: Any) -> Callable:
        key = formula.__name__, *given
        if key not in self.made:
            self.made[key] = functools.cache(formula(self, *given))
        return self.made[key]

    return made


class AngularVelocities:
    """Angular velocities of the rotation matrices of a program, as functions without arguments of the arrays that they request from it."""

    def __init__(self, factors: _Factors):
        self.factors = factors
        self.numbers: dict[Any, Any] = {}  # by variable: the value and its rate, once they are known
        self.made: dict[tuple, Callable] = {}

    def number(self, x: Any) -> Callable[[], tuple[Array, Array]]:
        """An array that the program makes, and its rate."""
        if isinstance(x, core.Literal):
            number = jnp.asarray(x.val)
            return lambda: (number, jnp.zeros_like(number))
        self.numbers[x] = None
        return lambda: self.numbers[x]

    @_once
    def body(self, R: Any) -> Callable[[], Float[Array, "3"]]:
        """ω of a rotation matrix, in the axes that are its columns."""
        if R not in self.factors.moving:  # the unit matrix, made of truth values, has no derivative
            return lambda: jnp.zeros(3, R.aval.dtype)
        kind, of = self.factors.made(R)
        if kind in UNCHANGED:
            return self.body(*of)
        if kind == "transpose":
            A, omega = self.number(*of), self.body(*of)
            return lambda: -A()[0] @ omega()
        if kind == "product" and any(map(self.factors.is_rotation, of)):  # then the other factor is one too
            (first, second), B = map(self.body, of), self.number(of[1])
            return lambda: B()[0].T @ first() + second()
        if kind in FORMULAS:
            numbers = list(map(self.number, of))
            return lambda: FORMULAS[kind](*zip(*(x() for x in numbers), strict=True))
        whole = self.number(R)
        return lambda: _vector(whole()[0].T @ whole()[1])

    @_once
    def world(self, R: Any) -> Callable[[], Float[Array, "3"]]:
        """ω in the axes of space, independent of the last rotation if that is about an axis of the body: ω_A + A ω_B."""
        if R not in self.factors.moving:
            return self.body(R)
        kind, of = self.factors.made(R)
        if kind == "product" and any(map(self.factors.is_rotation, of)):
            (first, second), A = map(self.world, of), self.number(of[0])
            return lambda: first() + A()[0] @ second()
        if kind in ABOUT:
            return self.body(R)
        axes, omega = self.number(R), self.body(R)
        return lambda: axes()[0] @ omega()

    @_once
    def unspun(self, R: Any, axis: int) -> Callable[[], Float[Array, "3"]]:
        """ω in the axes before the last rotation if that is about an axis of the body: ω_A + ω_B. Otherwise in the axes of the body."""
        kind, of = self.factors.made(R)
        if kind == "product" and self.factors.made(of[1])[0] == ABOUT[axis]:
            first, second = map(self.body, of)
            return lambda: first() + second()
        return self.body(R)


def _vector(W: Array) -> Float[Array, "3"]:
    """The vector of a matrix [w]×."""
    return 0.5 * jnp.stack([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]])


def _tuples(nested: Any) -> Any:
    return tuple(map(_tuples, nested)) if isinstance(nested, (list, tuple)) else nested
