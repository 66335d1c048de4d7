"""A loss function that limits the influence of outliers."""

import dataclasses
from typing import Any

import jax.numpy as jnp


@dataclasses.dataclass(frozen=True)
class Huber:
    r"""A loss with limited influence of outliers: quadratic up to `delta` standard deviations, linear beyond.

    $$ \rho(r) = \tfrac12 r^2 \ (|r| \le \delta), \qquad \rho(r) = \delta |r| - \tfrac12 \delta^2 \ (|r| > \delta) $$

    - `delta`: δ, in units of the standard deviation of the noise; dimensionless.

    **Source:** Huber, Ann. Math. Statist. 35 (1964) 73-101; δ = 1.345 has 95 % efficiency where the noise is normal.

    ```python
    import jaxlag as jl
    loss = jl.Huber(delta=1.345)
    float(loss.influence(10.0))  # 1.345
    ```
    """

    delta: float = 1.345

    def root(self, r: Any) -> Any:
        """√(2ρ) with the sign of `r`, so that half its square is the loss; any shape."""
        beyond = jnp.abs(r) > self.delta
        far = jnp.where(beyond, jnp.abs(r), self.delta)
        return jnp.where(beyond, jnp.sign(r) * jnp.sqrt(2 * self.delta * far - self.delta**2), r)

    def influence(self, r: Any) -> Any:
        """ψ = dρ/dr at `r`, any shape."""
        return jnp.clip(r, -self.delta, self.delta)

    def slope(self, r: Any) -> Any:
        """The derivative of `root` at `r`, any shape."""
        beyond = jnp.abs(r) > self.delta
        return jnp.where(beyond, self.delta / jnp.abs(self.root(jnp.where(beyond, r, self.delta))), 1)
