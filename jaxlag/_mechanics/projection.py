"""Stabilisation of the constraints: projection of positions and velocities, feedback, or nothing."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float

from .._model.flat import Flat
from .._model.numbers import count, number
from .._program.scalarise import scalarised
from .._program.sparse_jacobian import jacobian
from .augmented_inertia import augmented
from .lagrange import inertia, position_rows, velocity_residual, velocity_rows
from .massless import inertial_part, with_first_order_rates, without_inertia
from .saddle_point import reach_of, saddle_point_beside
from .sliders import with_sliders_returned


@dataclasses.dataclass(frozen=True)
class Projection:
    """Puts positions and velocities back on the constraints after each step, and at each sample.

    Newton's steps of  min ½ δqᵀM δq  with  g(t, q + δq) = 0,  then  min ½ δvᵀM δv  with  ψ(t, q, v + δv) = 0:
    the nearest state in the metric of M, so that nothing moves without need.

    **Arguments:** `iterations`: Newton steps for the position, each of which squares the residual.

    **Raises:** `TypeError` or `ValueError` if `iterations` is not a whole number of 1 or more.

    **Source:** Hairer, Lubich & Wanner, Geometric Numerical Integration, section IV.4; Eich, SIAM J. Numer. Anal. 30 (1993).

    ```python
    import jaxlag as jl
    jl.stabilisation.Projection(iterations=3)
    ```
    """

    iterations: int = 2

    def __post_init__(self):
        count(self.iterations, "`iterations`", cure="Two nearly always suffice.")

    def projection(self) -> "Projection":
        """Itself: states are put back on the constraints."""
        return self

    def feedback(self) -> None:
        """None: the accelerations remain unchanged."""

    def project(
        self, flat: Flat, t: Any, q: Float[Array, " n"], v: Float[Array, " n"], *, found: bool = False, of_velocities: bool = True
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """The state on the constraints that is nearest to this one, which is near already; or has its positions `found` on them. Without
        those `of_velocities`, these stay as they are.
        """
        part, light = inertial_part(flat, t, q, v), without_inertia(flat)
        M = inertia(part, t, q, v)  # at the start serves throughout: corrections are small

        @scalarised
        def newton(t, q, M):
            if flat.holonomic_names:
                g, G = position_rows(flat, t, q)
                q = q + saddle_point_beside(light, M, G, jnp.zeros_like(q), -g, reach_of(q)).x
            return q if flat.sliders is None else with_sliders_returned(flat, t, q)

        @scalarised
        def on_velocities(t, q, v, M):
            psi, G, _ = velocity_rows(part, t, q, v)
            dv = saddle_point_beside(light, M, G, jnp.zeros_like(v), -psi, reach_of(v)).x
            return with_first_order_rates(flat, t, q, corrected(v, dv)).v

        if (flat.holonomic_names or flat.sliders is not None) and not found:
            metric = metric_of_positions(part, M, t, q, v) if flat.holonomic_names else M
            q, _ = jax.lax.scan(lambda q, _: (newton(t, q, metric), None), q, length=self.iterations)
        return q, on_velocities(t, q, v, M) if of_velocities else v


def corrected(v: Float[Array, " n"], dv: Float[Array, " n"]) -> Float[Array, " n"]:
    """v + dv, and zero where that is only rounding: what comes to rest is at rest."""
    left = v + dv
    nothing = jnp.abs(left) <= 4 * jnp.finfo(v.dtype).eps * jnp.abs(v)
    return jnp.where(nothing, left - jax.lax.stop_gradient(left), left)


def metric_of_positions(flat: Flat, M: lx.AbstractLinearOperator, t, q, v) -> lx.AbstractLinearOperator:
    """M, with a weight on what nonholonomic constraints forbid: they may be all that holds a coordinate without inertia."""
    psi, G = jacobian(lambda v: flat.nonholonomic(t, q, v), v)
    return lx.MatrixLinearOperator(augmented(M.as_matrix(), G.as_matrix())[0]) if psi.size else M


@dataclasses.dataclass(frozen=True)
class Baumgarte:
    """Feeds the residuals back into the accelerations:  ψ̇ + 2α ψ + β² g = 0  (ψ̇ + 2α a = 0 for nonholonomic a).

    **Arguments:** `alpha`, `beta`: in 1/time; α = β is critical damping. Large values make the equations stiff.

    **Raises:** `TypeError` or `ValueError` if one of them is not a number of 0 or more.

    **Source:** Baumgarte, Comput. Methods Appl. Mech. Eng. 1 (1972) 1-16.

    ```python
    import jaxlag as jl
    jl.stabilisation.Baumgarte(alpha=20.0, beta=20.0)
    ```
    """

    alpha: float = 10.0
    beta: float = 10.0

    def __post_init__(self):
        for name in ("alpha", "beta"):
            gain = number(getattr(self, name), f"`{name}`", least=0.0, cure="Use some tenths of 1/(time of a step).")
            object.__setattr__(self, name, float(gain))

    def projection(self) -> None:
        """None: states are not projected."""

    def feedback(self) -> Callable:
        """2α ψ + β² g, added to γ."""

        def residual(flat, t, q, v):
            g, psi = flat.holonomic(t, q), velocity_residual(flat, t, q, v)
            return 2 * self.alpha * psi + self.beta**2 * jnp.concatenate([g, jnp.zeros(psi.size - g.size, g.dtype)])

        return residual


@dataclasses.dataclass(frozen=True)
class NoStabilisation:
    """Enforces the constraints on the accelerations alone, G q̈ = −γ: the residual grows with time, and so does the error it causes.

    ```python
    import jaxlag as jl
    jl.stabilisation.NoStabilisation()
    ```
    """

    def projection(self) -> None:
        """None: states are not projected."""

    def feedback(self) -> None:
        """None: the accelerations remain unchanged."""
