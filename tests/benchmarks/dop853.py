"""The Runge–Kutta scheme DOP853 written directly in `lax`, stage by stage: a lower bound on the cost of a compiled motion.

The state is an array of coordinates, or of coordinates × members for a batch that shares its steps.
Source: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, section II.10.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate._ivp import dop853_coefficients as scheme

STAGES = scheme.N_STAGES


def motion(rates, start, ts, tolerance, max_steps=192):
    """The states at `ts`, samples last. Step sizes are chosen from values only and are not differentiated."""
    # A barrier against fusion: the compiler would recompute a stage for each stage that uses it.
    rates = lambda y, rates=rates: jax.lax.optimization_barrier(rates(y))
    end, buffers = ts[-1], (jnp.full(max_steps, jnp.inf), jnp.ones(max_steps), jnp.zeros((max_steps, 8, *start.shape)))

    def step(carry):
        i, t, h, y, k, (begins, sizes, series) = carry
        h = jnp.minimum(h, end - t)
        K = stages(rates, y, k, h)
        after = y + h * weighted(scheme.B, K)
        K.append(rates(after))
        error = jax.lax.stop_gradient(error_norm(K, y, after, h, tolerance))
        good = error <= 1
        K = further(rates, y, K, h)
        buffers = begins.at[i].set(t), sizes.at[i].set(h), series.at[i].set(dense(y, after, K, h))
        grown = h * jnp.clip(0.9 * error ** (-1 / 8), 0.2, 10.0)
        return i + good, jnp.where(good, t + h, t), grown, jnp.where(good, after, y), jnp.where(good, K[STAGES], k), buffers

    first = 0.02 * (tolerance / 1e-8) ** (1 / 8)
    unfinished = lambda carry: (carry[1] < end) & (carry[0] < max_steps)
    count, *_, (begins, sizes, series) = jax.lax.while_loop(unfinished, step, (0, ts[0], first, start, rates(start), buffers))
    begins = jnp.where(jnp.arange(max_steps) < count, begins, jnp.inf)
    return sampled(begins, sizes, series, ts)


def weighted(weights, K):
    """Σ wᵢ kᵢ."""
    return sum(float(w) * k for w, k in zip(weights, K, strict=False) if w != 0)


def stages(rates, y, k, h):
    """k₁ … k₁₂."""
    K = [k]
    for i in range(1, STAGES):
        K.append(rates(y + h * weighted(scheme.A[i], K)))
    return K


def further(rates, y, K, h):
    """The three more stages that the dense output needs."""
    for i in range(STAGES + 1, scheme.N_STAGES_EXTENDED):
        K = [*K, rates(y + h * weighted(scheme.A[i], K))]
    return K


def error_norm(K, y, after, h, tolerance):
    """Hairer's combination of the embedded estimates of orders 5 and 3, relative to the tolerance (atol is a hundredth of rtol)."""
    scale = tolerance * (0.01 + jnp.maximum(jnp.abs(y), jnp.abs(after)))
    squares = lambda weights: jnp.sum((h * weighted(weights, K) / scale) ** 2, axis=0)
    fifth, third = squares(scheme.E5), squares(scheme.E3)
    return jnp.max(fifth / jnp.sqrt(jnp.maximum((fifth + 0.01 * third) * len(y), 1e-300)))


def dense(y, after, K, h):
    """y and the seven coefficients of the interpolation of 7th order."""
    change, begin, end = after - y, h * K[0], h * K[STAGES]
    return jnp.stack([y, change, begin - change, 2 * change - begin - end, *(h * weighted(row, K) for row in np.asarray(scheme.D))])


def sampled(begins, sizes, series, ts):
    """All samples in one go."""
    i = jnp.searchsorted(begins, ts, side="right") - 1
    s = (ts - begins[i]) / sizes[i]
    of_sample = jnp.moveaxis(series[i], 0, -1)
    out = jnp.zeros_like(of_sample[0])
    for power, coefficient in enumerate(of_sample[:0:-1]):
        out = (out + coefficient) * (s if power % 2 == 0 else 1 - s)
    return out + of_sample[0]
