"""Derivatives of a whole motion: one rule that serves forward and reverse mode, to any order."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .variational import jvp_along, pushforward, split_varying

# Up to this many perturbed numbers the Jacobian comes whole out of one vectorised forward pass; beyond it a tangent is
# pushed forward, or a cotangent pulled back, alone. The two cross near 100 (tests/benchmarks/bench_gradient.py).
FORWARD_LIMIT = 96


def differentiable(solve: Callable, pull_back: Callable, drift: Callable, push: Callable | None = None) -> Callable:
    """`solve(inputs, ts) -> (y, aux)` with a derivative rule that needs no setting and no choice of mode.

    The rule's tangent is J dx, with the Jacobian J from the same pass as the value: linear in dx, so that it can be
    transposed, and serves `grad` as well as `jvp`. Within the rule the function that returns value and Jacobian carries
    the same rule, built only when it is differentiated in its turn; so derivatives of every order follow.

    - `solve`: has forward-mode derivatives in `inputs`, a pytree. `aux` is not differentiated.
    - `pull_back`: the same function with reverse-mode derivatives, for many inputs.
    - `drift(inputs, ts, y)`: dy/dts, each sample to its own time.
    - `push(varying, constant, directions, ts)`: y, its derivatives along directions of what varies, and aux; by default what `solve` gives.
    """
    push = push or pushforward(solve)

    @eqx.filter_custom_jvp
    def motion(inputs, ts):
        return solve(inputs, ts)

    @motion.def_jvp
    def rule(primals, tangents):
        (inputs, ts), (d_inputs, d_ts) = primals, tangents
        varying, constant = split_varying(inputs, d_inputs)
        x, unravel = ravel_pytree(varying)
        dx = ravel_pytree(d_inputs)[0]
        of_x = lambda f: lambda x_and_still, *rest: f(eqx.combine(unravel(x_and_still[0]), x_and_still[1]), *rest)
        at_x = of_x(solve), of_x(pull_back), of_x(drift)
        change = None
        if x.size == 0:
            y, aux = motion(inputs, ts)
        elif x.size <= FORWARD_LIMIT:
            (y, J), aux = differentiable(*_with_jacobian(push, pushforward(pull_back), at_x[2], unravel))((x, constant), ts)
            change = jax.tree.map(lambda rows: rows @ dx, J)
        else:
            y, aux = motion(inputs, ts)
            change = _jacobian_product(at_x[0], at_x[1], (x, constant), ts, y, dx)
        if d_ts is not None:
            shift = jax.tree.map(lambda rate: jax.vmap(jnp.multiply)(rate, d_ts), drift(inputs, ts, y))
            change = shift if change is None else jax.tree.map(jnp.add, change, shift)
        return (y, aux), (change, jax.tree.map(lambda _: None, aux))

    return motion


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
            of_own = zip(jnp.split(e[x.size :], np.cumsum(sizes)[:-1]), flat, strict=True)
            own = [jnp.broadcast_to(part.reshape(*leaf.shape[:-1], 1), leaf.shape).astype(leaf.dtype) for part, leaf in of_own]
            return unravel(e[: x.size].astype(x.dtype)), jax.tree.unflatten(structure, own)

        joined = lambda leaves: jnp.concatenate([jnp.zeros((0, members), ts.dtype), *(leaf.reshape(-1, members) for leaf in leaves)])
        count = x.size + sum(sizes)
        change = None
        if count == 0:
            y, aux = motions(inputs, ts)
        else:
            directions = jax.vmap(direction, out_axes=-1)(jnp.eye(count, dtype=ts.dtype))
            y, J, aux = push(varying, constant, directions, ts)
            dx = jnp.broadcast_to(ravel_pytree(d_inputs[0])[0][:, None], (x.size, members))
            change = jnp.einsum("...mp,pm->...m", J, jnp.concatenate([dx, joined(jax.tree.leaves(d_inputs[1]))]))
        if d_ts is not None:
            shift = drift(inputs, ts, y) * d_ts[:, None, None]
            change = shift if change is None else change + shift
        return (y, aux), (change, jax.tree.map(lambda _: None, aux))

    return motions


def _with_jacobian(push, push_back, drift, unravel):
    """The three functions of `differentiable` for (y, ∂y/∂x) in place of y, where inputs = (x, constant)."""

    def both(push):
        def value_and_jacobian(inputs, ts):
            x, constant = inputs
            y, J, aux = push(unravel(x), constant, jax.vmap(unravel, out_axes=-1)(jnp.eye(x.size, dtype=x.dtype)), ts)
            return (y, J), aux

        return value_and_jacobian

    def drift_of_both(inputs, ts, y_and_J):
        (x, constant), (y, J) = inputs, y_and_J
        of_both = lambda both: (drift((both[0], constant), ts, both[1]), None)
        rate, change, _ = jvp_along(of_both, (x, y), (jnp.eye(x.size, dtype=x.dtype), J))
        return rate, change

    # A Jacobian of more columns than FORWARD_LIMIT never comes here, and solve has forward mode: it serves as both.
    return both(push), both(push_back), drift_of_both


def _jacobian_product(solve, pull_back, inputs, ts, y, dx):
    """J dx by one forward pass, whose transpose is one reverse pass.

    JAX takes a transpose from the user in `custom_linear_solve` alone: here a symmetric one whose "solution" of (a, b) is
    (Jᵀb, Ja). Of the two products the one that is not asked for is dropped by the compiler.
    """
    x, constant = inputs

    def products(_, z):
        a, b = z
        pushforward = jax.jvp(lambda x: solve((x, constant), ts)[0], (x,), (a,))[1]
        pulled = jax.vjp(lambda x: pull_back((x, constant), ts)[0], x)[1](b)[0]
        return pulled, pushforward

    def matrix(z):
        only_first = eqx.internal.nondifferentiable(x, msg=SECOND_ORDER)
        return z[0] + 0 * only_first, z[1]

    nothing = jax.tree.map(lambda leaf: jnp.zeros_like(leaf) + 0 * jnp.sum(dx), y)  # linear in dx, as JAX wants all of it
    return jax.lax.custom_linear_solve(matrix, (dx, nothing), products, symmetric=True)[1]


SECOND_ORDER = (
    f"second derivatives of a motion must be with respect to at most {FORWARD_LIMIT} numbers, but there are more. "
    "Differentiate twice with respect to fewer, or use Gauss–Newton, which needs first derivatives only."
)
