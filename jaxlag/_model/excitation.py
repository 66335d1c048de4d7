"""Inputs that excite a machine: sums of sines, and sweeps."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .numbers import count, number


class Multisine(eqx.Module):
    r"""A sum of harmonics, an entry of `params` that is called as `u(t)`: it excites where one wants to know, and nowhere else.

    $$ u(t) = \sum_k a_k \cos\frac{2\pi k t}{T} + b_k \sin\frac{2\pi k t}{T} $$

    At first all harmonics are equally strong, with the phases −πj(j − 1)/n of the j-th of n, whose sum has no high peaks.

    **Arguments:**

    - `period`: T.
    - `harmonics`: how many, k = 1, 2, …; or a sequence of these k, such as the odd ones.
    - `amplitude`: the root mean square of u. Any consistent units.

    **Fields:** `cosines`, `sines`: a and b, (n,), what `design` and `fit` may free; `orders`: the k; `period`.

    **Returns:** when called with a time: u(t), a number.

    **Raises:** `ValueError` or `TypeError` if the period is not positive, or the harmonics are no positive integers.

    **Source:** Schroeder, IEEE Trans. Information Theory 16 (1970) 85-89; Pintelon & Schoukens, System Identification: A Frequency Domain
    Approach, 2nd ed., section 5.3.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    cart = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda t, u: u(t))
    jl.simulate(cart, 0.0, 0.0, jnp.linspace(0.0, 10.0, 101), {"u": jl.Multisine(10.0, harmonics=8, amplitude=2.0)})
    ```
    """

    cosines: Float[Array, " n"]
    sines: Float[Array, " n"]
    orders: tuple[int, ...] = eqx.field(static=True)
    period: float = eqx.field(static=True)

    def __init__(self, period: Any, harmonics: Any = 8, *, amplitude: Any = 1.0):
        self.period = float(number(period, "`period`", positive=True, cure="Give the time after which u repeats."))
        cure = "Give how many, or a list such as `[1, 3, 5]`."
        if isinstance(harmonics, (Sequence, np.ndarray)):
            self.orders = tuple(count(int(k) if isinstance(k, np.integer) else k, "`harmonics`", cure=cure) for k in harmonics)
        else:
            self.orders = tuple(range(1, count(harmonics, "`harmonics`", cure=cure) + 1))
        if len(set(self.orders)) != len(self.orders) or not self.orders:
            raise ValueError(f"`harmonics` must name each once, and one at least, but are {list(self.orders)}. {cure}")
        n = len(self.orders)
        j = np.arange(n)
        strength = number(amplitude, "`amplitude`", cure="Give the root mean square of u.") * np.sqrt(2 / n)
        self.cosines = jnp.asarray(strength * np.cos(np.pi * j * (j + 1) / n))
        self.sines = jnp.asarray(strength * np.sin(np.pi * j * (j + 1) / n))

    def __call__(self, t: ArrayLike) -> Float[Array, ""]:
        """u(t)."""
        t = jnp.asarray(t)
        angles = (2 * np.pi * np.array(self.orders) / self.period).astype(t.dtype) * t
        return jnp.sum(self.cosines * jnp.cos(angles) + self.sines * jnp.sin(angles))


class Chirp(eqx.Module):
    r"""A sine whose frequency rises or falls evenly, an entry of `params` that is called as `u(t)`.

    $$ u(t) = A \sin\Big(\omega_0 t + \frac{\omega_1 - \omega_0}{2 T} t^2\Big) $$

    **Arguments:** `start`, `end`: ω₀ and ω₁, angular frequencies at t = 0 and t = T; `duration`: T; `amplitude`: A. All of them are fields,
    and numbers that `design` and `fit` may free. Any consistent units.

    **Returns:** when called with a time: u(t), a number.

    **Raises:** `TypeError` if one is not a number; `ValueError` if the duration is not positive.

    **Source:** Pintelon & Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., section 5.3.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    cart = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda t, u: u(t))
    jl.simulate(cart, 0.0, 0.0, jnp.linspace(0.0, 10.0, 101), {"u": jl.Chirp(1.0, 20.0, 10.0)})
    ```
    """

    start: Float[Array, ""]
    end: Float[Array, ""]
    duration: Float[Array, ""]
    amplitude: Float[Array, ""]

    def __init__(self, start: Any, end: Any, duration: Any, amplitude: Any = 1.0):
        given = {"start": start, "end": end, "duration": duration, "amplitude": amplitude}
        self.start, self.end, self.duration, self.amplitude = (
            jnp.asarray(number(x, f"`{name}`", positive=name == "duration", cure="Give a real number.")) for name, x in given.items()
        )

    def __call__(self, t: ArrayLike) -> Float[Array, ""]:
        """u(t)."""
        t = jnp.asarray(t)
        return self.amplitude * jnp.sin(self.start * t + (self.end - self.start) * t**2 / (2 * self.duration))
