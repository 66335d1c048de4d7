"""Derivatives of a whole motion: one rule that serves forward and reverse mode, to any order."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._program.conditions import everywhere, zeros_like
from .._program.jit import compiled, jitted
from .unreached import rows_reached, with_unreached
from .variational import derived, pushforward, split_varying

# Up to this many perturbed numbers the Jacobian comes whole out of one vectorised forward pass; beyond it a tangent is
# pushed forward, or a cotangent pulled back, alone. The two cross near 100 (tests/benchmarks/bench_gradient.py).
FORWARD_LIMIT = 96


@runtime_checkable
class DifferentiableMap(Protocol):
    """A map (inputs, ts) ↦ (y, aux), and what its derivative rule asks of it. `inputs` is a pytree; `aux` is not differentiated."""

    def solve(self, inputs: Any, ts: Any) -> tuple[Any, Any]:
        """y and aux, with forward-mode derivatives in `inputs`."""

    def pull_back(self, inputs: Any, ts: Any) -> tuple[Any, Any]:
        """The same with reverse-mode derivatives, for many inputs."""

    def push(self, inputs: Any, directions: tuple, ts: Any) -> tuple[Any, Any]:
        """y and its derivatives along directions, ((y, dy), aux), for directions of two orders (((y, dy), (y, dy)'), aux) and so on.

        Directions are the last axis of the leaves of `inputs`, and None where these are constant.
        """

    def drift(self, inputs: Any, ts: Any, y: Any) -> Any:
        """dy/dts, each sample to its own time."""


def differentiable(of: DifferentiableMap) -> Callable:
    """`of.solve` with a derivative rule that needs no setting and no choice of mode.

    The rule's tangent is J dx, with the Jacobian J from the same pass as the value: linear in dx, so that it can be
    transposed, and serves `grad` as well as `jvp`. Within the rule the function that returns value and Jacobian carries
    the same rule, built only when it is differentiated in its turn; so derivatives of every order follow.
    Each function is a program of its own where Python asks for it, so that it is compiled with the options of such programs.
    """

    @eqx.filter_custom_jvp
    def solution(inputs, ts):
        return solved(of, inputs, ts)

    @solution.def_jvp
    def rule(primals, tangents):
        (inputs, ts), (d_inputs, d_ts) = primals, tangents
        varying, constant = split_varying(inputs, d_inputs)
        size = sum(jnp.size(leaf) for leaf in jax.tree.leaves(varying))
        change = None
        if size == 0:
            y, aux = solution(inputs, ts)
        elif size <= FORWARD_LIMIT:
            (y, J), aux = differentiable(WithJacobian(of))((varying, constant), ts)
            change = _product(J, y, ravel_pytree(d_inputs)[0])
        else:
            y, aux = solution(inputs, ts)
            dx = ravel_pytree(d_inputs)[0]
            change = with_unreached(_jacobian_product(of, varying, constant, ts, y, dx), y, dx)
        if d_ts is not None:
            shift = jax.tree.map(lambda rate: _shift(rate, d_ts), drifted(of, inputs, ts, y))
            change = with_unreached(shift if change is None else jax.tree.map(jnp.add, change, shift), y, d_ts)
        return (y, aux), (change, jax.tree.map(lambda _: None, aux))

    return solution


def _shift(rate, d_ts):
    """The change of samples with their times; what is not of samples, the times of events, has no rate."""
    return jax.vmap(jnp.multiply)(rate, d_ts) if len(rate) == len(d_ts) else rate


@jitted  # one program for all parts of y; its transpose is one, too
def _product(J: Any, y: Any, dx: Any) -> Any:
    return with_unreached(jax.tree.map(lambda rows, y: rows_reached(rows, y) @ dx, J, y), y, dx)


@compiled
def solved(of: DifferentiableMap, inputs: Any, ts: Any) -> tuple[Any, Any]:
    """y and aux."""
    return of.solve(inputs, ts)


@compiled
def drifted(of: DifferentiableMap, inputs: Any, ts: Any, y: Any) -> Any:
    """dy/dts."""
    return of.drift(inputs, ts, y)


class WithJacobian(eqx.Module):
    """The map (varying, constant), ts ↦ ((y, J), aux), with J = ∂y/∂varying: itself a `DifferentiableMap`."""

    of: Any

    def solve(self, inputs, ts):
        """y and J in one forward pass."""
        return self.push(inputs, (), ts)

    def pull_back(self, inputs, ts):
        """The same with reverse mode. A Jacobian of more columns than FORWARD_LIMIT never comes here."""
        return pushforward(self.of.pull_back)(eqx.combine(*inputs), (unit_directions(inputs[0]),), ts)

    def push(self, inputs, directions, ts):
        """The same and its derivatives: of the one map along directions of more orders, not of a map that is differentiated already."""
        every = unit_directions(inputs[0]), *(eqx.combine(*of_order) for of_order in directions)
        return self.of.push(eqx.combine(*inputs), every, ts)

    def drift(self, inputs, ts, y_and_J):
        """The rates of y, and their Jacobian."""
        (varying, constant), (y, J) = inputs, y_and_J
        of_both = lambda both: (self.of.drift(both[0], ts, both[1]), None)
        return derived(of_both, (unit_directions(varying), J))((eqx.combine(varying, constant), y))[0]


def unit_directions(varying: Any) -> Any:
    """One direction for each number of what varies, as last axis of its leaves."""
    x, unravel = ravel_pytree(varying)
    return jax.vmap(unravel, out_axes=-1)(jnp.eye(x.size, dtype=x.dtype))


def differentiable_batch(solve: Callable, drift: Callable, push: Callable) -> Callable:
    """The same for a batch of independent members: `solve((common, own), ts) -> (y, aux)`.

    Leaves of `own`, and y, have the members as their last axis: one pass along e perturbs that number of every member, and gives each
    of them its own derivative.
    """

    @eqx.filter_custom_jvp
    def motions(inputs, ts):
        return solve(inputs, ts)

    @motions.def_jvp
    def rule(primals, tangents):
        (inputs, ts), (d_inputs, d_ts) = primals, tangents
        varying, constant = split_varying(inputs, d_inputs)
        x, unravel = ravel_pytree(varying[0])
        flat, structure = jax.tree.flatten(varying[1])
        sizes = [leaf[..., 0].size for leaf in flat]
        members = jax.tree.leaves(inputs[1])[0].shape[-1]

        def direction(e):
            of_own = zip(jnp.split(e[x.size :], np.cumsum(sizes))[:-1], flat, strict=True)  # behind the last is nothing
            own = [jnp.broadcast_to(part.reshape(*leaf.shape[:-1], 1), leaf.shape).astype(leaf.dtype) for part, leaf in of_own]
            return unravel(e[: x.size].astype(x.dtype)), jax.tree.unflatten(structure, own)

        joined = lambda leaves: jnp.concatenate([jnp.zeros((0, members), ts.dtype), *(leaf.reshape(-1, members) for leaf in leaves)])
        count = x.size + sum(sizes)
        change = None
        if count == 0:
            y, aux = motions(inputs, ts)
        else:
            directions = jax.vmap(direction, out_axes=-1)(jnp.eye(count, dtype=ts.dtype))
            (y, J), aux = push(inputs, directions, ts)
            dx = jnp.broadcast_to(ravel_pytree(d_inputs[0])[0][:, None], (x.size, members))
            dx = jnp.concatenate([dx, joined(jax.tree.leaves(d_inputs[1]))])
            change = with_unreached(jnp.einsum("...mp,pm->...m", rows_reached(J, y), dx), y, dx)
        if d_ts is not None:
            shift = drift(inputs, ts, y) * d_ts[:, None, None]
            change = with_unreached(shift if change is None else change + shift, y, d_ts)
        return (y, aux), (change, jax.tree.map(lambda _: None, aux))

    return motions


def _jacobian_product(of, varying, constant, ts, y, dx):
    """J dx by one forward pass, whose transpose is one reverse pass.

    JAX takes a transpose from the user in `custom_linear_solve` alone: here a symmetric one whose "solution" of (a, b) is
    (Jᵀb, Ja). Of the two products the one that is not asked for is dropped by the compiler, or costs nothing, as that of zeros.
    """
    x = ravel_pytree(varying)[0]
    constant, ts = jax.tree.map(lambda leaf: jnp.asarray(leaf) if isinstance(leaf, np.ndarray) else leaf, (constant, ts))

    def products(_, z):
        a, b = z
        return pulled(of, varying, constant, ts, b), pushed(of, varying, constant, ts, a)

    def matrix(z):
        only_first = eqx.internal.nondifferentiable(x, msg=SECOND_ORDER)
        return z[0] + 0 * only_first, z[1]

    nothing = jax.tree.map(lambda leaf: jnp.zeros_like(leaf) + 0 * jnp.sum(dx), y)  # linear in dx, as JAX wants all of it
    return jax.lax.custom_linear_solve(matrix, (dx, nothing), products, symmetric=True)[1]


@compiled
def pushed(of: DifferentiableMap, varying: Any, constant: Any, ts: Any, dx: Any) -> Any:
    """J dx, in steps that fit it."""
    unravel = ravel_pytree(varying)[1]

    def product(dx):
        direction = jax.tree.map(lambda leaf: leaf[..., None], unravel(dx))
        (_, dy), _ = of.push(eqx.combine(varying, constant), (direction,), ts)
        return jax.tree.map(lambda leaf: leaf[..., 0], dy)

    return _unless_zero(product, dx)


@compiled
def pulled(of: DifferentiableMap, varying: Any, constant: Any, ts: Any, dy: Any) -> Any:
    """Jᵀ dy."""
    x, unravel = ravel_pytree(varying)
    solve = lambda x: of.pull_back(eqx.combine(unravel(x), constant), ts)[0]
    return _unless_zero(lambda dy: jax.vjp(solve, x)[1](dy)[0], dy)


def _unless_zero(of_vector, vector):
    """A product of the Jacobian and a vector; where that is zero, without a motion."""
    like = jax.eval_shape(of_vector, vector)
    nothing = lambda _: zeros_like(like)
    is_zero = everywhere(jnp.all(jnp.array([jnp.all(leaf == 0) for leaf in jax.tree.leaves(vector)])))
    return jax.lax.cond(is_zero, nothing, of_vector, vector)


SECOND_ORDER = (
    f"second derivatives of a motion must be with respect to at most {FORWARD_LIMIT} numbers, but there are more. "
    "Differentiate twice with respect to fewer, or use Gauss–Newton, which needs first derivatives only."
)
