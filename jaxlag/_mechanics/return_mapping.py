"""Return mapping: where dry friction alone resists a coordinate without inertia, a force beyond its bound moves it at once.

    |h(q)| ≤ F:  what is beyond goes to h = ±F, as the elements of plasticity do
Source: Simo & Hughes, Computational Inelasticity, section 1.4.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._model.flat import Flat
from .friction_elements import FrictionElements
from .lagrange import smooth_force
from .projection import Projection
from .sliders import are_apart
from .stick_slip import bounds, in_mode


def returned(flat: Flat, elements: FrictionElements, t, q, v) -> Float[Array, " n"]:
    """q, with the coordinates that friction cannot hold moved until it does: all that are beyond, and then those that this puts beyond."""
    rows = np.flatnonzero(elements.massless >= 0)
    if not rows.size:
        return q
    of, coordinates, nothing = (
        elements.element_of_row[rows],
        elements.massless[rows],
        jnp.zeros(flat.rows + elements.massless.size, v.dtype),
    )

    def turn(_, carry):
        q, sigma = carry
        resting = jnp.zeros_like(sigma)
        slope = jax.jacfwd(elements.slip, argnums=2)(t, q, v)[rows, coordinates]
        force = smooth_force(in_mode(flat, elements, resting), t, q, jnp.zeros_like(v))[coordinates] / slope
        beyond = jnp.abs(force) > (1 + 1e2 * jnp.finfo(v.dtype).eps) * bounds(elements, resting, t, q, v, nothing)[of]
        sigma = sigma.at[rows].set(jnp.where(beyond & (sigma[rows] == 0), jnp.sign(force), sigma[rows]))
        return Projection(iterations=4).project(in_mode(flat, elements, sigma), t, q, v, of_velocities=False)[0], sigma

    carry = q, jnp.zeros(elements.massless.size, v.dtype)
    if are_apart(in_mode(flat, elements, carry[1])):
        return turn(0, carry)[0]
    return jax.lax.fori_loop(0, rows.size + 1, turn, carry)[0]
