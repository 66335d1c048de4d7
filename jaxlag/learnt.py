"""Learnt potentials: a dissipation function D(q̇) or a potential V(q) that is a neural network, sound whatever its weights.

A network is an `equinox.Module` of arrays, so it lives in params: there it is differentiated, batched and fitted as any number is.

    system = jl.System(lagrangian, dissipation=lambda qdot, net: net(qdot))
    params = {"m": 2.0, "net": jl.learnt.PassiveDissipation(0.1, power=0.5, key=jax.random.key(0))}

What a dissipation function has to be is built in, not asked of the data:

    ConvexDissipation     D convex, D(0) = 0, ∂D(0) = 0   so  q̇ · ∂D/∂q̇ ≥ D ≥ 0
    PassiveDissipation    D grows on every ray from rest  so  q̇ · ∂D/∂q̇ ≥ 0, and D ≥ 0; the force may fall with the speed
    Potential             V any smooth bounded function
    ConvexPotential       V convex, with its minimum 0 at a given position

The promises rest on weights made positive by softplus and on σ(x) = ½(x + √(1 + x²)), convex and increasing (Barron, Squareplus,
arXiv:2112.11687): what σ has beyond its tangent is δ² over a positive number, zero and flat at δ = 0 to the last bit, where softplus
would leave a difference of equal numbers.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

Scale = Any  # positive numbers, structured like q: `_sizes` checks them, with a sentence


class ConvexDissipation(eqx.Module):
    r"""Convex dissipation function: the force never falls as the motion grows.

    $$ D(\dot q) = P\,\bigl(f(x) - f(0) - \nabla f(0)\cdot x\bigr), \qquad x = \dot q/\text{scale}, \qquad
       f = w\cdot z_K, \quad z_{k+1} = \sigma(W_k z_k + A_k x + b_k), \quad W_k, w \ge 0 $$

    f is convex, for sums with positive weights and the increasing convex σ keep convexity; D is what it has beyond its tangent at rest.
    So for any weights D(0) = 0, ∂D/∂q̇(0) = 0 and q̇ · ∂D/∂q̇ ≥ D ≥ 0: the term dissipates. The layers hand on value, linear part and
    remainder, and D is the remainder of the last: nothing is subtracted. Smooth; A and b are free, so it need not be even.

    **Arguments:**

    - `scale`: velocities at which the force bends most, positive, structured like q̇: a number for a scalar, else an array or a dict.
      One speed serves two decades around it.
    - `key`: of the first weights. `width`, `depth`: of the layers, and how many.
    - `power`: size of D, a force times a velocity.

    **Returns:** called as `net(qdot)`, a scalar. Any consistent units; `scale` and `power` are no parameters, they stay as given.

    **Raises:** `ValueError` where `scale`, `power`, `width` or `depth` is not positive, or `qdot` has another size than `scale`.

    **Source:** Amos, Xu & Kolter, Input Convex Neural Networks, ICML 2017, eq. 2. Peers: convex dissipation potentials from networks in
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
        self.scale, self.power = _sizes(scale), _positive("power", power)
        inlet_keys, weight_keys = jax.random.split(key, (2, _count("depth", depth)))
        self.inlets, self.biases = zip(*(_inlet(k, _count("width", width), len(self.scale)) for k in inlet_keys), strict=True)
        steepness = (1 + jnp.linalg.norm(A, axis=1) for A in self.inlets)
        *weights, self.outlet = map(_positive_weights, weight_keys, _shapes(width, depth), steepness)
        self.weights = tuple(weights)

    def __call__(self, qdot: PyTree) -> Float[Array, ""]:
        """D(q̇)."""
        return self.power * self._beyond_tangent(_relative(qdot, self.scale, "qdot"))

    def _beyond_tangent(self, x):
        """f(x) − f(0) − ∇f(0)·x, by the three parts of z = z(0) + ∇z(0)·x + remainder."""
        A, b = self.inlets[0], self.biases[0]
        at_rest, linear, beyond = _expanded(b, A @ x, jnp.zeros_like(b))
        for A, b, raw in zip(self.inlets[1:], self.biases[1:], self.weights, strict=True):
            W = jax.nn.softplus(raw)
            at_rest, linear, beyond = _expanded(W @ at_rest + b, W @ linear + A @ x, W @ beyond)
        return jax.nn.softplus(self.outlet) @ beyond


class PassiveDissipation(eqx.Module):
    r"""Dissipation function that grows on every ray from rest, convex or not: the force may fall as the speed grows, as Stribeck's does.

    $$ D(\dot q) = P\,w\cdot z_K, \qquad z_1 = \mu(\beta_b(A x)), \qquad z_{k+1} = \mu(\rho_{b_k}(W_k z_k)), \qquad
       x = \dot q/\text{scale}, \quad W_k, w \ge 0 $$
    $$ \beta_b(\delta) = \sigma(b + \delta) - \sigma(b) - \sigma'(b)\,\delta, \qquad \rho_b(y) = \sigma(b + y) - \sigma(b), \qquad
       \mu(u) = u \text{ of one half}, \ u/\sqrt{1 + u^2} \text{ of the other} $$

    β grows along each ray from 0, and all that follows increases. So for any weights D(0) = 0, ∂D/∂q̇(0) = 0, D ≥ 0 and q̇ · ∂D/∂q̇ ≥ 0:
    the term dissipates. Each unit of the first layer is a known friction: β is a viscous force at small, and a dry one at large speed,
    whose sign the inlet smooths over a width of its own; bounded, β/√(1 + β²) is a force that rises and dies away, Stribeck's fall.

    A convex D cannot do it: of one speed, D'' ≥ 0 says that the force D' nowhere falls, and the best it can make of Stribeck's curve
    is to cut the peak off. Passivity asks less, v D' ≥ 0. The force is smooth through rest, so it creeps and never sticks; for what sticks
    add `dissipation.sliding`. Where the first b is 0, D is even; friction that depends on the direction is learnt with it.

    **Arguments, returns, raises:** as `ConvexDissipation`; `scale` is, for instance, Stribeck's velocity and `power` the friction force
    times it; `width` is at least 2. Any consistent units.

    **Source:** Runje & Shankaranarayana, Constrained Monotonic Neural Networks, ICML 2023 (increasing networks need bounded units
    beside convex ones); Armstrong-Hélouvry, Dupont & Canudas de Wit, Automatica 30 (1994) 1083-1138 (Stribeck's curve).

    ```python
    import jax
    import jaxlag as jl
    net = jl.learnt.PassiveDissipation(0.1, power=0.5, key=jax.random.key(0))
    slope = jax.grad(lambda v: net(v))  # of the network itself JAX takes no gradient, for it hashes what it differentiates
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
        self.scale, self.power = _sizes(scale), _positive("power", power)
        at_inlet, at_weights, at_biases = jax.random.split(key, 3)
        self.inlet, first = _inlet(at_inlet, _count("width", width, 2), len(self.scale))
        *weights, self.outlet = map(_positive_weights, jax.random.split(at_weights, _count("depth", depth)), _shapes(width, depth))
        self.biases = (first, *jax.random.normal(at_biases, (depth - 1, width)))
        self.weights = tuple(weights)

    def __call__(self, qdot: PyTree) -> Float[Array, ""]:
        """D(q̇)."""
        x = _relative(qdot, self.scale, "qdot")
        z = _half_bounded(_beyond(self.biases[0], self.inlet @ x))
        for raw, b in zip(self.weights, self.biases[1:], strict=True):
            z = _half_bounded(_rise(b, jax.nn.softplus(raw) @ z))
        return self.power * jax.nn.softplus(self.outlet) @ z


class Potential(eqx.Module):
    r"""Potential energy V(q) of any shape: several rest positions, hills, softening.

    $$ V(q) = E\,w\cdot z_K, \qquad z_{k+1} = \tanh(W_k z_k + b_k), \qquad z_0 = q/\text{scale} $$

    Its force conserves energy for any weights, and |V| ≤ E Σ|w|: what can be drawn from it is bounded. It does not hold a body back far
    out; add what does, `net(q) + 0.5 * c * q**2`. A constant in V does nothing, so there is none.

    **Arguments:** as `ConvexDissipation`, of `q`: `scale` positions over which the force changes, `energy` the size of V. An angle that
    turns over goes in as `[sin, cos]`.

    **Returns:** called as `net(q)`, a scalar. Any consistent units. **Raises:** as `ConvexDissipation`.

    **Source:** Hornik, Stinchcombe & White, Neural Networks 3 (1990) 551-560 (a network and its derivative approximate together).
    Peers that learn all of L or H: Cranmer et al., Lagrangian Neural Networks (2020); Greydanus et al., Hamiltonian Neural Networks (2019).

    ```python
    import jax
    import jaxlag as jl
    net = jl.learnt.Potential(0.1, energy=5.0, key=jax.random.key(0))
    system = jl.System(lambda q, qdot, m, net: 0.5 * m * qdot**2 - net(q))
    jl.acceleration(system, 0.05, 0.0, {"m": 2.0, "net": net}).qddot
    ```
    """

    layers: tuple[eqx.nn.Linear, ...]
    scale: tuple[float, ...] = eqx.field(static=True)
    energy: float = eqx.field(static=True)

    def __init__(self, scale: Scale, *, key: Array, width: int = 32, depth: int = 2, energy: float = 1.0):
        self.scale, self.energy = _sizes(scale), _positive("energy", energy)
        shape = (len(self.scale), "scalar", _count("width", width), _count("depth", depth))
        self.layers = eqx.nn.MLP(*shape, use_final_bias=False, key=key).layers  # without its activations, which are no arrays

    def __call__(self, q: PyTree) -> Float[Array, ""]:
        """V(q)."""
        *hidden, last = self.layers
        z = _relative(q, self.scale, "q")
        for layer in hidden:
            z = jnp.tanh(layer(z))
        return self.energy * last(z)


class ConvexPotential(eqx.Module):
    r"""Convex potential energy V(q) with its minimum 0 at a given rest position: a learnt spring.

    $$ V(q) = E\,\bigl(f(x) - f(0) - \nabla f(0)\cdot x\bigr), \qquad x = (q - \text{rest})/\text{scale} $$

    with the convex network f of `ConvexDissipation`. For any weights V ≥ 0, and the force −∂V/∂q is zero at rest and draws back to it:
    (q − rest) · ∂V/∂q ≥ V.

    **Arguments:** as `ConvexDissipation`, of `q`: `scale` the displacements at which the force bends most, `energy` the size of V; and
    `rest`, the rest position, structured like q (default 0).

    **Returns:** called as `net(q)`, a scalar. Any consistent units; `rest` is no parameter, it stays as given.

    **Raises:** as `ConvexDissipation`; `ValueError` where `rest` has another size than `scale`.

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
        self.network = ConvexDissipation(scale, key=key, width=width, depth=depth, power=_positive("energy", energy))
        self.rest = (0.0,) * len(self.network.scale) if rest is None else _numbers(rest)
        if len(self.rest) != len(self.network.scale):
            raise ValueError(
                f"`rest` must have the size of `scale`, {len(self.network.scale)}, but has {len(self.rest)}. Give both structured like q."
            )

    def __call__(self, q: PyTree) -> Float[Array, ""]:
        """V(q)."""
        network = self.network
        return network.power * network._beyond_tangent(_relative(q, network.scale, "q", self.rest))


def _squareplus(x):
    return 0.5 * (x + jnp.sqrt(1 + x**2))


def _beyond(c, d):
    """σ(c + d) − σ(c) − σ'(c) d ≥ 0, convex in d: with p = 1 + c(c + d) and m = √(1 + c²) √(1 + (c + d)²) it is ½(m − p)/√(1 + c²).

    And (m − p)(m + p) = d². Of the two forms the one that adds numbers of one sign.
    """
    root = jnp.sqrt(1 + c**2)
    p = 1 + c * (c + d)
    same_sign = p > 0
    both = root * jnp.sqrt(1 + (c + d) ** 2) + jnp.where(same_sign, p, -p)
    return 0.5 * jnp.where(same_sign, d**2 / both, both) / root


def _rise(c, y):
    """σ(c + y) − σ(c), increasing and convex in y; zero at y = 0 to the last bit."""
    return 0.5 * y * (1 + (2 * c + y) / (jnp.sqrt(1 + (c + y) ** 2) + jnp.sqrt(1 + c**2)))


def _expanded(c, linear, beyond):
    """σ(c + linear + beyond) as its value at c, its linear part and the remainder."""
    slope = 0.5 * (1 + c / jnp.sqrt(1 + c**2))
    return _squareplus(c), slope * linear, slope * beyond + _beyond(c, linear + beyond)


def _half_bounded(u):
    half = u.size // 2
    return jnp.concatenate([u[half:], u[:half] / jnp.sqrt(1 + u[:half] ** 2)])


def _inlet(key, width, n):
    """Weights and biases of a layer from x: directions of any sign, bends spread over two decades around the scale."""
    at_direction, at_size, at_bias = jax.random.split(key, 3)
    size = 10 ** jax.random.uniform(at_size, (width, 1), minval=-1, maxval=1)
    direction = jax.random.normal(at_direction, (width, n))
    return size * direction / jnp.linalg.norm(direction, axis=1, keepdims=True), jax.random.normal(at_bias, (width,))


def _shapes(width, depth):
    """Of the weights between `depth` layers, and of the outlet."""
    return [(width, width)] * (depth - 1) + [(width,)]


def _positive_weights(key, shape, steepness=1.0):
    """Raw weights, of which softplus takes about the mean of what comes in, each unit over its steepness."""
    mean = jnp.broadcast_to(1 / (shape[-1] * steepness), shape)
    return jnp.log(jnp.expm1(mean)) + 0.5 * jax.random.normal(key, shape)


def _numbers(tree):
    return tuple(float(number) for leaf in jax.tree.leaves(tree) for number in np.ravel(leaf))  # by NumPy, so that `jit` may go round it


def _sizes(scale):
    numbers = _numbers(scale)
    if not numbers or not all(0 < number < math.inf for number in numbers):
        raise ValueError(f"`scale` must be positive numbers, one for each coordinate, but is {scale}. Give the size of what goes in.")
    return numbers


def _positive(name, value):
    if not 0 < float(value) < math.inf:
        raise ValueError(f"`{name}` must be positive, but is {value}. Give the size of what comes out.")
    return float(value)


def _count(name, value, least=1):
    if value < least:
        raise ValueError(f"`{name}` must be at least {least}, but is {value}. A network needs layers and units.")
    return value


def _relative(x, scale, name, origin=None):
    """(x − origin) / scale, as a vector."""
    flat, _ = ravel_pytree(x)
    if flat.size != len(scale):
        raise ValueError(
            f"`{name}` must have the size of `scale`, {len(scale)}, but has {flat.size}. "
            f"Make the network with a scale structured like `{name}`."
        )
    flat = flat if jnp.issubdtype(flat.dtype, jnp.floating) else flat.astype(float)
    vector = lambda numbers: jnp.asarray(numbers, flat.dtype)
    return (flat if origin is None else flat - vector(origin)) / vector(scale)
