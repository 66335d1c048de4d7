"""Points of mass 1 kg joined by rods, in Cartesian coordinates, with equations derived by hand.

g_k = ½(|r_k|² − l_k²),   r = D x − anchors,   D the incidence matrix
S λ = −(|ṙ_k|² + r_k · D g),   S = (D Dᵀ) ∘ (r rᵀ),   ẍ = g + Dᵀ(λ r)
"""

import dataclasses
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

import jaxlag as jl

jax.config.update("jax_enable_x64", True)


@dataclasses.dataclass(eq=False)
class Rods:
    """A mechanism, its start and its duration."""

    D: np.ndarray
    anchors: np.ndarray
    x0: np.ndarray
    v0: np.ndarray
    duration: float

    @property
    def ts(self):
        return np.linspace(0.0, self.duration, 101)

    @property
    def gravity(self):
        return np.r_[np.zeros(self.x0.shape[1] - 1), -9.81]

    @property
    def squares(self):
        return np.sum((self.D @ self.x0 - self.anchors) ** 2, axis=1)

    @cached_property
    def system(self):
        """The same for jaxlag, from L and g."""
        lagrangian = lambda q, qdot: 0.5 * jnp.sum(qdot**2) + jnp.sum(q @ self.gravity)
        return jl.System(lagrangian, holonomic={"rods": self.residual})

    def residual(self, q):
        """g."""
        return 0.5 * (jnp.sum((self.D @ q - self.anchors) ** 2, axis=1) - self.squares)

    def acceleration(self, x, v):
        """ẍ by the Schur complement and its dense Cholesky factorisation."""
        D, g = self.D, self.gravity
        r, u = D @ x - self.anchors, D @ v
        S = (D @ D.T) * (r @ r.T)
        right = -jnp.sum(u**2, axis=1) - r @ g * np.sum(D, axis=1)
        multipliers = jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(S), True), right)
        return g + D.T @ (multipliers[:, None] * r)

    def check(self):
        """Asserts that jaxlag finds the same accelerations, at random states near the start."""
        for x, v in np.random.default_rng(0).uniform(-0.01, 0.01, (3, 2, *self.x0.shape)):
            x = x / len(x) + self.x0
            found = jl.acceleration(self.system, jnp.asarray(x), jnp.asarray(v)).qddot
            np.testing.assert_allclose(found, self.acceleration(x, v), rtol=1e-7, atol=1e-7)


def spherical_pendulum():
    """Length 1 m, from 0.8 rad with a push sideways, over 100 s."""
    x0 = np.array([[np.sin(0.8), 0.0, -np.cos(0.8)]])
    return Rods(np.eye(1), np.zeros((1, 3)), x0, np.array([[0.0, 1.5, 0.0]]), 100.0)


def four_bar():
    """Crank of 1 m, coupler of 2 m, rocker of 2 m, base of 2.5 m, over 10 s."""
    crank, base = np.array([0.0, 1.0]), np.array([2.5, 0.0])
    along, apart = (base - crank) / 2, np.sqrt(4 - np.sum((base - crank) ** 2) / 4)
    rocker = crank + along + apart * np.array([-along[1], along[0]]) / np.linalg.norm(along)
    D, anchors = np.array([[1.0, 0.0], [-1.0, 1.0], [0.0, 1.0]]), np.array([[0.0, 0.0], [0.0, 0.0], base])
    return Rods(D, anchors, np.stack([crank, rocker]), np.zeros((2, 2)), 10.0)


def chain(n):
    """n rods that make 1 m, let go straight at 0.5 rad to the vertical, over 2 s."""
    D = np.eye(n) - np.eye(n, k=-1)
    x0 = np.outer(np.arange(1, n + 1) / n, [np.sin(0.5), -np.cos(0.5)])
    return Rods(D, np.zeros((n, 2)), x0, np.zeros((n, 2)), 2.0)
