r"""A sum over intervals that have points of collocation, with equations, and its derivatives.

    f = Σ f_ki(w_ki) + e(w_Ns),    c_ki(w_ki) = 0,    L_k ζ_k = r_k,        w linear in ζ, and ζ in x

ζ is what an interval depends on, w what a point does: numbers of its own, how its state changes, and the border. So Jacobians and Hessians
are those of points, of few numbers each, and the matrix of an interval is put together of those of its points.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .block_system import Shape


class Chain(NamedTuple):
    """A problem, of intervals k that have points i, at which states have the changes D x: x is the state before, and those at the points.

    `point(w, k, i, *args)` is a cost and equations, of numbers of the point, which end with its state, of the changes there, and of the
    border after the start; L ζ = r are equations that are linear in what an interval depends on; `end(w, *args)` is a cost of the last
    point of all. All numbers have bounds.
    """

    shape: Shape
    D: np.ndarray
    point: Callable[..., tuple[Array, Array]]
    L: Float[Array, "N e l"]
    r: Float[Array, "N e"]
    end: Callable[..., Array]
    args: tuple[Any, ...]
    lower: Float[Array, " n"]
    upper: Float[Array, " n"]

    @property
    def own(self) -> int:
        """How many numbers a point has."""
        return self.shape.block // len(self.D)

    def places(self, x: Array) -> Float[Array, "N s d"]:
        """w of all points, linear in x."""
        N, state = self.shape.intervals, self.shape.state
        before, own, border = jnp.split(self.shape.gathered(x), [state, state + self.shape.block], axis=1)
        own = own.reshape(N, len(self.D), self.own)
        changes = self.D @ jnp.concatenate([before[:, None], own[..., self.own - state :]], axis=1)
        border = jnp.broadcast_to(border[:, None, state:], (N, len(self.D), self.shape.border - state))
        return jnp.concatenate([own, changes, border], axis=2)

    def gathered(self, of_points: Float[Array, "N s d"]) -> Float[Array, " n"]:
        """The transpose of `places`."""
        return jax.linear_transpose(self.places, self.lower)(of_points)[0]

    def at_points(self, function: Callable, *of_points: Array) -> Any:
        """function(..., k, i) at all points, of arrays (N, s, ...)."""
        k, i = jnp.arange(self.shape.intervals), jnp.arange(len(self.D))
        inner = jax.vmap(lambda k, i, *of: function(*of, k, i), (None, 0, *(0 for _ in of_points)))
        return jax.vmap(inner, (0, None, *(0 for _ in of_points)))(k, i, *of_points)

    def rows(self, of_points: Array, x: Array) -> Float[Array, "N m"]:
        """All equations of each interval."""
        linear = jnp.einsum("kel,kl->ke", self.L, self.shape.gathered(x)) - self.r
        return jnp.concatenate([of_points.reshape(len(linear), -1), linear], axis=1)

    def split(self, y: Array) -> tuple[Array, Array]:
        """What belongs to equations of points, (N, s, m), and to linear ones."""
        N, s = self.shape.intervals, len(self.D)
        count = y.shape[1] - self.L.shape[1]
        return y[:, :count].reshape(N, s, count // s), y[:, count:]

    def values(self, x: Array) -> tuple[Array, Array]:
        """f and c (N, m)."""
        w = self.places(x)
        f, c = self.at_points(lambda w, k, i: self.point(w, k, i, *self.args), w)
        return jnp.sum(f) + self.end(w[-1, -1], *self.args), self.rows(c, x)

    def stationary(self, x: Array, y: Array) -> tuple[Array, Array]:
        """∇f + Jᵀy (n,), and c."""
        (f, c), pull = jax.vjp(self.values, x)
        return pull((jnp.ones_like(f), y))[0], c

    def linearised(self, x: Array, y: Array) -> "Linearised":
        """At x, with the Hessian of f + y·c."""

        def one(w, y, k, i):
            def both(w):
                (f, c), pull = jax.vjp(lambda w: self.point(w, k, i, *self.args), w)
                return (f, c, pull((jnp.ones_like(f), y))[0]), (f, c)

            (df, J, H), (f, c) = jax.jacfwd(both, has_aux=True)(w)
            return f, c, df, J, (H + H.T) / 2

        w, end = self.places(x), lambda w: self.end(w, *self.args)
        f, c, df, J, H = self.at_points(one, w, self.split(y)[0])
        df, H = df.at[-1, -1].add(jax.grad(end)(w[-1, -1])), H.at[-1, -1].add(jax.hessian(end)(w[-1, -1]))
        return Linearised(self, jnp.sum(f) + end(w[-1, -1]), self.rows(c, x), self.gathered(df), J, H)

    def assembled(self, inner: Float[Array, "N s d d"]) -> Float[Array, "N l l"]:
        """The matrix of each interval, of those of its points."""
        (N, s), own, state, border = inner.shape[:2], self.own, self.shape.state, self.shape.border - self.shape.state
        rows = [inner[..., :own, :], jnp.pad(inner[..., own : own + state, :], ((0, 0), (0, 0), (own - state, 0), (0, 0)))]
        place = np.stack([np.eye(s, s + 1, 1), self.D])  # of a point among (before, points), and of its changes
        parts, sides = [], []
        for row in rows:
            parts += [row[..., :own], jnp.pad(row[..., own : own + state], ((0, 0), (0, 0), (0, 0), (own - state, 0)))]
            sides += [row[..., own + state :]]
        of_both = np.einsum("asi,bsj->absij", place, place).reshape(4, s, s + 1, s + 1)
        whole = jnp.einsum("asij,aksxy->kixjy", of_both, jnp.stack(parts)).reshape(N, (s + 1) * own, (s + 1) * own)
        side = jnp.einsum("asi,aksxy->kixy", place, jnp.stack(sides)).reshape(N, (s + 1) * own, border)
        corner = jnp.sum(inner[..., own + state :, own + state :], axis=1)
        whole, side = whole[:, own - state :, own - state :], jnp.pad(side[:, own - state :], ((0, 0), (0, 0), (state, 0)))
        corner = jnp.pad(corner, ((0, 0), (state, 0), (state, 0)))
        return jnp.block([[whole, side], [jnp.swapaxes(side, 1, 2), corner]])


class Linearised(NamedTuple):
    """A chain at a point: f, c, ∇f, and what the points have of the Jacobian J and the Hessian H."""

    chain: Chain
    f: Float[Array, ""]
    c: Float[Array, "N m"]
    gradient: Float[Array, " n"]
    J: Float[Array, "N s m d"]
    H: Float[Array, "N s d d"]

    def forwards(self, dx: Array) -> Array:
        """J dx."""
        own = jnp.einsum("ksmd,ksd->ksm", self.J, self.chain.places(dx))
        return self.chain._replace(r=jnp.zeros_like(self.chain.r)).rows(own, dx)

    def backwards(self, dy: Array) -> Array:
        """Jᵀ dy."""
        own, linear = self.chain.split(dy)
        of_linear = self.chain.shape.scattered(jnp.einsum("kel,ke->kl", self.chain.L, linear))
        return self.chain.gathered(jnp.einsum("ksmd,ksm->ksd", self.J, own)) + of_linear

    def curved(self, dx: Array) -> Array:
        """H dx."""
        return self.chain.gathered(jnp.einsum("ksde,kse->ksd", self.H, self.chain.places(dx)))

    def squares(self) -> Float[Array, "N s d d"]:
        """JᵀJ of each point."""
        return jnp.swapaxes(self.J, 2, 3) @ self.J

    def matrix(self, of_points: Float[Array, "N s d d"], weight: Any) -> Float[Array, "N l l"]:
        """Of each interval: what its points have, and of the linear equations weight LᵀL."""
        return self.chain.assembled(of_points) + weight * jnp.swapaxes(self.chain.L, 1, 2) @ self.chain.L
