"""The angular velocity of a rotation matrix, from the program that makes it: of a product, factor by factor."""

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
FORMULAS: dict[str, Callable] = {}  # of the kit's rotations, by names that no other function has


def turning(formula: Callable) -> Callable[[Callable], Callable]:
    """For a rotation matrix of some arrays: its ω, in the axes of the body, is formula(arrays, their rates)."""

    def named(matrix: Callable) -> Callable:
        matrix.__name__ = f"jaxlag.rigid.{matrix.__name__}"
        FORMULAS[matrix.__name__] = formula
        return jax.jit(matrix)

    return named


def body_rate(rotation: Callable, q: Any, qdot: Any) -> Float[Array, "3"]:
    """Angular velocity, in its own axes, of a body whose rotation matrix is R(q)."""
    ((_, omega),) = body_rates(lambda q: [(jnp.zeros(0), rotation(q))], q, qdot)
    return omega


def body_rates(frames: Callable, q: Any, qdot: Any) -> list[tuple[Array, Float[Array, "3"]]]:
    r"""Velocities of places and angular velocities of axes, each in its own axes, of frames that one program makes of q.

    $$ \omega_{AB} = B^T \omega_A + \omega_B, \qquad \omega_{A^T} = -A\,\omega_A, \qquad [\omega]_\times = R^T\dot R $$

    The last by differentiating R: of a product as a whole it would make a mass matrix ten times as long.

    **Source:** Murray, Li & Sastry, A Mathematical Introduction to Robotic Manipulation, proposition 2.15.
    """
    (leaves, structure), rates = jax.tree.flatten(jax.tree.map(floating, q)), jax.tree.leaves(jax.tree.map(floating, qdot))

    def program(*leaves: Any) -> list:
        return [(x, check_rotation(R, "`rotation` of a body")) for x, R in frames(jax.tree.unflatten(structure, leaves))]

    if known(leaves) is not None:
        program(*leaves)  # which looks at its numbers
    factors = _Factors(jax.make_jaxpr(program)(*leaves))
    places, matrices = factors.closed.jaxpr.outvars[::2], factors.closed.jaxpr.outvars[1::2]
    needed = _Needed()
    jax.eval_shape(lambda: _Rates(factors, needed, needed).of_all(matrices))
    values, rates = jax.jvp(lambda *leaves: factors.evaluated([*needed, *places], leaves), tuple(leaves), tuple(rates))
    omegas = _Rates(factors, *(dict(zip(needed, x, strict=False)) for x in (values, rates))).of_all(matrices)
    return list(zip(rates[len(needed) :], omegas, strict=True))


class _Needed(dict):
    """Takes down which arrays of a program are asked for."""

    def __missing__(self, variable: Any) -> Array:
        return self.setdefault(variable, jnp.zeros(variable.aval.shape, variable.aval.dtype))


class _Factors:
    """What a program makes rotation matrices of."""

    def __init__(self, closed: Any):
        self.closed = closed
        self.made_by = {variable: equation for equation in closed.jaxpr.eqns for variable in equation.outvars}
        self.constants = dict(zip(closed.jaxpr.constvars, closed.consts, strict=True))

    def evaluated(self, variables: Any, leaves: Any) -> list:
        """The arrays of some variables, and nothing else."""
        jaxpr, _ = partial_eval.dce_jaxpr(self.closed.jaxpr.replace(outvars=list(variables)), [True] * len(variables), instantiate=True)
        return core.jaxpr_as_fun(core.ClosedJaxpr(jaxpr, self.closed.consts))(*leaves)

    def is_rotation(self, R: Any) -> bool:
        """Whether an array is a rotation matrix for certain."""
        if R in self.constants:
            seen = known(self.constants[R])
            return seen is not None and np.allclose(seen.T @ seen, np.eye(3), rtol=0, atol=1e-6) and bool(np.linalg.det(seen) > 0)
        kind, of = self.made(R)
        return kind in FORMULAS or (kind in (*UNCHANGED, "transpose", "product") and all(map(self.is_rotation, of)))

    def made(self, R: Any) -> tuple[str, list]:
        """By what an array is made, and of which."""
        if R not in self.made_by:
            return "", []
        equation = self.made_by[R]
        name, of = equation.primitive.name, equation.invars
        if name in ("jit", "pjit"):
            return equation.params["name"], of
        is_product = name == "dot_general" and _tuples(equation.params["dimension_numbers"]) == PRODUCT
        return "product" if is_product and all(x.aval.shape == (3, 3) for x in of) else name, of


class _Rates:
    """Angular velocities of the rotation matrices of a program, each worked out once."""

    def __init__(self, factors: _Factors, values: Any, rates: Any):
        self.factors, self.values, self.rates = factors, values, rates
        self.known: dict[Any, Array] = {}

    def of_all(self, matrices: Any) -> list[Float[Array, "3"]]:
        return list(map(self.of, matrices))

    def of(self, R: Any) -> Float[Array, "3"]:
        """ω of an array that is a rotation matrix."""
        if R not in self.known:
            self.known[R] = self._from_factors(R)
        return self.known[R]

    def _from_factors(self, R: Any) -> Float[Array, "3"]:
        kind, of = self.factors.made(R)
        if kind in UNCHANGED:
            return self.of(*of)
        if kind == "transpose":
            return -self.values[of[0]] @ self.of(*of)
        if kind == "product" and any(map(self.factors.is_rotation, of)):  # then the other factor is one too
            A, B = of
            return self.values[B].T @ self.of(A) + self.of(B)
        if kind in FORMULAS:
            return FORMULAS[kind](*zip(*map(self._number, of), strict=True))
        W = self.values[R].T @ self.rates[R]
        return 0.5 * jnp.stack([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]])

    def _number(self, x: Any) -> tuple[Array, Array]:
        """An array that a rotation is made of, and its rate."""
        if not isinstance(x, core.Literal):
            return jnp.asarray(self.values[x]), jnp.asarray(self.rates[x])
        number = jnp.asarray(x.val)
        return number, jnp.zeros_like(number)


def _tuples(nested: Any) -> Any:
    return tuple(map(_tuples, nested)) if isinstance(nested, (list, tuple)) else nested
