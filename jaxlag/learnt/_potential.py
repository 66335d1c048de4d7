"""Potential energies that are neural networks: of any shape, and convex ones."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ._dissipation import ConvexDissipation
from ._layers import Scale, as_count, as_positive, as_scale, flat_numbers, scaled


class Potential(eqx.Module):
    r"""Potential energy V(q) of any shape: several rest positions, hills, softening.

    $$ V(q) = E\,w\cdot z_K, \qquad z_{k+1} = \tanh(W_k z_k + b_k), \qquad z_0 = q/\text{scale} $$

    Its force conserves energy for any weights, and |V| ≤ E Σ|w|, so the energy that can be drawn from it is bounded. It does not pull a
    body back from far away; add a term that does, `net(q) + 0.5 * c * q**2`. A constant in V has no effect, so there is none.

    **Arguments:**

    - `scale`: distances over which the force changes, positive, structured like q. Pass an angle that makes full turns as `[sin, cos]`.
    - `key`, `width`, `depth`: as for `ConvexDissipation`.
    - `energy`: size of V.

    **Fields:** `layers` (W and b) are fitted; `scale`, a tuple of numbers, and `energy` are no parameters and stay as given.

    **Returns:** `net(q)` is a scalar. Any consistent units.

    **Raises:** `ValueError` if `scale`, `energy`, `width` or `depth` is not positive, or if `q` differs in size from `scale`.

    **Source:** Hornik, Stinchcombe & White, Neural Networks 3 (1990) 551-560 (a network and its derivative approximate together).
    Networks that learn all of L or H: Cranmer et al., Lagrangian Neural Networks (2020);
    Greydanus et al., Hamiltonian Neural Networks (2019).

    ```python
    import jax
    import jaxlag as jl
    net = jl.learnt.Potential(0.1, energy=5.0, key=jax.random.key(0))
    system = jl.System(lambda q, qdot, m, net: 0.5 * m * qdot**2 - net(q))
    jl.acceleration(system, 0.05, 0.0, {"m": 2.0, "net": net}).qddot  # −V'(0.05)/m
    ```
    """

    layers: tuple[eqx.nn.Linear, ...]
    scale: tuple[float, ...] = eqx.field(static=True)
    energy: float = eqx.field(static=True)

    def __init__(self, scale: Scale, *, key: Array, width: int = 32, depth: int = 2, energy: float = 1.0):
        self.scale, self.energy = as_scale(scale), as_positive("energy", energy)
        shape = (len(self.scale), "scalar", as_count("width", width), as_count("depth", depth))
        self.layers = eqx.nn.MLP(*shape, use_final_bias=False, key=key).layers  # without its activations, which are no arrays

    def __call__(self, q: PyTree) -> Float[Array, ""]:
        """V(q)."""
        *hidden, last = self.layers
        z = scaled(q, self.scale, "q")
        for layer in hidden:
            z = jnp.tanh(layer(z))
        return self.energy * last(z)


class ConvexPotential(eqx.Module):
    r"""Convex potential energy V(q) with its minimum 0 at a given rest position: a learnt spring.

    $$ V(q) = E\,\bigl(f(x) - f(0) - \nabla f(0)\cdot x\bigr), \qquad x = (q - \text{rest})/\text{scale} $$

    with the convex network f of `ConvexDissipation`. For any weights V ≥ 0; the force −∂V/∂q is zero at the rest position and points back
    to it: (q − rest) · ∂V/∂q ≥ V.

    **Arguments:**

    - `scale`: displacements at which the slope of the force changes most, positive, structured like q.
    - `key`, `width`, `depth`: as for `ConvexDissipation`.
    - `rest`: the rest position, structured like q. Default: 0.
    - `energy`: size of V.

    **Fields:** `network`, the convex network, is fitted; `rest`, a tuple of numbers, is no parameter and stays as given.

    **Returns:** `net(q)` is a scalar. Any consistent units.

    **Raises:** `ValueError` if `scale`, `energy`, `width` or `depth` is not positive, or if `rest` or `q` differs in size from
    `scale`.

    **Source:** as `ConvexDissipation`.

    ```python
    import jax
    import jaxlag as jl
    net = jl.learnt.ConvexPotential(0.1, rest=0.5, energy=5.0, key=jax.random.key(0))
    net(0.5), jax.grad(lambda q: net(q))(0.5)  # 0.0, 0.0
    ```
    """

    network: ConvexDissipation
    rest: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, scale: Scale, *, key: Array, rest: PyTree = None, width: int = 16, depth: int = 2, energy: float = 1.0):
        self.network = ConvexDissipation(scale, key=key, width=width, depth=depth, power=as_positive("energy", energy))
        self.rest = (0.0,) * len(self.network.scale) if rest is None else flat_numbers(rest)
        if len(self.rest) != len(self.network.scale):
            raise ValueError(
                f"`rest` must have the size of `scale`, {len(self.network.scale)}, but has {len(self.rest)}. Give both structured like q."
            )

    def __call__(self, q: PyTree) -> Float[Array, ""]:
        """V(q)."""
        network = self.network
        return network.power * network._beyond_tangent(scaled(q, network.scale, "q", self.rest))
