"""Dissipation functions that are neural networks: convex ones, and passive ones whose force may fall with the speed."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ._layers import (
    Scale,
    as_count,
    as_positive,
    as_scale,
    convex_remainder,
    expand,
    half_bounded,
    increase,
    input_layer,
    positive_weights,
    scaled,
    weight_shapes,
)


class ConvexDissipation(eqx.Module):
    r"""Convex dissipation function: the force never falls as the speed grows.

    $$ D(\dot q) = P\,\bigl(f(x) - f(0) - \nabla f(0)\cdot x\bigr), \qquad x = \dot q/\text{scale}, \qquad
       f = w\cdot z_K, \quad z_{k+1} = \sigma(W_k z_k + A_k x + b_k), \quad W_k, w \ge 0 $$

    with σ(x) = ½(x + √(1 + x²)). f is convex, because sums with positive weights and the increasing convex σ preserve convexity; D is f
    minus its tangent at rest. So for any weights D(0) = 0, ∂D/∂q̇(0) = 0 and q̇ · ∂D/∂q̇ ≥ D ≥ 0: the term dissipates. Each layer passes
    on value, linear part and remainder, and D is the remainder of the last one, so nothing cancels. D is smooth; A and b are free, so it
    need not be even.

    **Arguments:**

    - `scale`: velocities at which the slope of the force changes most, positive, structured like q̇: a number for a scalar, else an array
      or a dict. One value covers two decades around it.
    - `key`: random key of the initial weights.
    - `width`, `depth`: units per layer, and number of layers.
    - `power`: size of D, a force times a velocity.

    **Fields:** `inlets` (A), `biases` (b), `weights` and `outlet` (W and w before softplus) are fitted; `scale`, a tuple of numbers, and
    `power` are no parameters and stay as given.

    **Returns:** `net(qdot)` is a scalar. Any consistent units.

    **Raises:** `ValueError` if `scale`, `power`, `width` or `depth` is not positive, or if `qdot` differs in size from `scale`.

    **Source:** Amos, Xu & Kolter, Input Convex Neural Networks, ICML 2017, eq. 2. Related: convex dissipation potentials from networks in
    Huang, He, Chem & Reina, Variational Onsager Neural Networks, arXiv:2112.09085; input-convex layers for JAX in the library klax.

    ```python
    import jax
    import jaxlag as jl
    net = jl.learnt.ConvexDissipation(0.5, power=10.0, key=jax.random.key(0))
    system = jl.System(lambda qdot, m: 0.5 * m * qdot**2, dissipation=lambda qdot, net: net(qdot))
    jl.powers(system, 0.0, 0.3, {"m": 2.0, "net": net})["dissipation"]  # negative
    ```
    """

    inlets: tuple[Float[Array, "w n"], ...]
    biases: tuple[Float[Array, " w"], ...]
    weights: tuple[Float[Array, "w w"], ...]
    outlet: Float[Array, " w"]
    scale: tuple[float, ...] = eqx.field(static=True)
    power: float = eqx.field(static=True)

    def __init__(self, scale: Scale, *, key: Array, width: int = 16, depth: int = 2, power: float = 1.0):
        self.scale, self.power = as_scale(scale), as_positive("power", power)
        inlet_keys, weight_keys = jax.random.split(key, (2, as_count("depth", depth)))
        self.inlets, self.biases = zip(*(input_layer(k, as_count("width", width), len(self.scale)) for k in inlet_keys), strict=True)
        steepness = (1 + jnp.linalg.norm(A, axis=1) for A in self.inlets)
        *weights, self.outlet = map(positive_weights, weight_keys, weight_shapes(width, depth), steepness)
        self.weights = tuple(weights)

    def __call__(self, qdot: PyTree) -> Float[Array, ""]:
        """D(q̇)."""
        return self.power * self._beyond_tangent(scaled(qdot, self.scale, "qdot"))

    def _beyond_tangent(self, x):
        """f(x) − f(0) − ∇f(0)·x, from the three parts of z = z(0) + ∇z(0)·x + remainder."""
        A, b = self.inlets[0], self.biases[0]
        at_rest, linear, beyond = expand(b, A @ x, jnp.zeros_like(b))
        for A, b, raw in zip(self.inlets[1:], self.biases[1:], self.weights, strict=True):
            W = jax.nn.softplus(raw)
            at_rest, linear, beyond = expand(W @ at_rest + b, W @ linear + A @ x, W @ beyond)
        return jax.nn.softplus(self.outlet) @ beyond


class PassiveDissipation(eqx.Module):
    r"""Dissipation function that grows on every ray from rest, convex or not: the force may fall as the speed grows, as Stribeck's does.

    $$ D(\dot q) = P\,w\cdot z_K, \qquad z_1 = \mu(\beta_b(A x)), \qquad z_{k+1} = \mu(\rho_{b_k}(W_k z_k)), \qquad
       x = \dot q/\text{scale}, \quad W_k, w \ge 0 $$

    $$ \beta_b(\delta) = \sigma(b + \delta) - \sigma(b) - \sigma'(b)\,\delta, \qquad \rho_b(y) = \sigma(b + y) - \sigma(b), \qquad
       \mu(u) = u \text{ of one half}, \ u/\sqrt{1 + u^2} \text{ of the other} $$

    with σ(x) = ½(x + √(1 + x²)). β grows along each ray from 0, and everything that follows is increasing. So for any weights D(0) = 0,
    ∂D/∂q̇(0) = 0, D ≥ 0 and q̇ · ∂D/∂q̇ ≥ 0: the term dissipates. Each unit of the first layer is a familiar friction law: the force of β
    is viscous at low and dry at high speed, with a transition of adjustable width; that of the bounded β/√(1 + β²) rises and dies away,
    which is Stribeck's fall.

    A convex D cannot represent it: in one dimension D'' ≥ 0 means that the force D' nowhere falls, and the best fit to Stribeck's curve
    cuts off its peak. Passivity asks less: v D' ≥ 0. The force is smooth through rest, so a body creeps and never sticks; for sticking
    add `dissipation.sliding`. Where the first b is 0, D is even; a nonzero b lets friction depend on the direction.

    **Arguments:** `scale`, `key`, `width`, `depth` and `power` as for `ConvexDissipation`; `scale` is, for instance, Stribeck's velocity
    and `power` the friction force times it; `width` is at least 2.

    **Fields:** `inlet` (A), `biases` (b), `weights` and `outlet` (W and w before softplus) are fitted; `scale`, a tuple of numbers, and
    `power` are no parameters and stay as given.

    **Returns:** `net(qdot)` is a scalar. Any consistent units.

    **Raises:** as `ConvexDissipation`; `ValueError` if `width` is below 2.

    **Source:** Runje & Shankaranarayana, Constrained Monotonic Neural Networks, ICML 2023 (increasing networks need bounded units
    beside convex ones); Armstrong-Hélouvry, Dupont & Canudas de Wit, Automatica 30 (1994) 1083-1138 (Stribeck's curve).

    ```python
    import jax
    import jaxlag as jl
    net = jl.learnt.PassiveDissipation(0.1, power=0.5, key=jax.random.key(0))
    slope = jax.grad(lambda v: net(v))  # `jax.grad` hashes its function, and a network has no hash
    slope(0.0)  # 0.0, exactly
    slope(-0.2)  # negative: the force −∂D/∂q̇ is against the motion
    ```
    """

    inlet: Float[Array, "w n"]
    biases: tuple[Float[Array, " w"], ...]
    weights: tuple[Float[Array, "w w"], ...]
    outlet: Float[Array, " w"]
    scale: tuple[float, ...] = eqx.field(static=True)
    power: float = eqx.field(static=True)

    def __init__(self, scale: Scale, *, key: Array, width: int = 16, depth: int = 2, power: float = 1.0):
        self.scale, self.power = as_scale(scale), as_positive("power", power)
        at_inlet, at_weights, at_biases = jax.random.split(key, 3)
        self.inlet, first = input_layer(at_inlet, as_count("width", width, 2), len(self.scale))
        *weights, self.outlet = map(positive_weights, jax.random.split(at_weights, as_count("depth", depth)), weight_shapes(width, depth))
        self.biases = (first, *jax.random.normal(at_biases, (depth - 1, width)))
        self.weights = tuple(weights)

    def __call__(self, qdot: PyTree) -> Float[Array, ""]:
        """D(q̇)."""
        x = scaled(qdot, self.scale, "qdot")
        z = half_bounded(convex_remainder(self.biases[0], self.inlet @ x))
        for raw, b in zip(self.weights, self.biases[1:], strict=True):
            z = half_bounded(increase(b, jax.nn.softplus(raw) @ z))
        return self.power * jax.nn.softplus(self.outlet) @ z
