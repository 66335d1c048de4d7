"""Where reverse mode overtakes a single forward pass: value and gradient of a motion with p parameters, both ways.

Four oscillators whose stiffnesses are mixtures of p parameters. The crossover sets FORWARD_LIMIT in jaxlag/_motion/derivative_rule.py.
Run: python tests/benchmarks/bench_gradient.py
"""

import jax
import jax.numpy as jnp
from timing import medians, once

import jaxlag as jl
from jaxlag._motion import derivative_rule

jax.config.update("jax_enable_x64", True)
oscillators = jl.System(lambda q, qdot, c, mix: 0.5 * qdot @ qdot - 0.5 * (4 + mix @ c) @ q**2)
TS = jnp.linspace(0, 5, 100)


def seconds(p, limit):
    """Seconds of compilation, and of one evaluation (median)."""
    derivative_rule.FORWARD_LIMIT = limit
    jax.clear_caches()
    q0 = jnp.ones(4)
    spread = jnp.linspace(0.5, 1.5, 4 * p).reshape(4, p) / p
    loss = lambda c: jnp.sum(jl.simulate(oscillators, q0, jnp.zeros(4), TS, {"c": c, "mix": spread}, rtol=1e-6, atol=1e-8).q ** 2)
    gradient = jax.jit(jax.value_and_grad(loss))
    action = lambda: gradient(jnp.ones(p))
    return once(action), medians({"": action})[""]


def main():
    print(f"{'parameters':>10}{'forward ms':>12}{'reverse ms':>12}{'ratio':>8}{'first s':>10}{'first s':>9}")
    for p in (4, 16, 32, 64, 128, 256):
        (first, forward), (other, reverse) = seconds(p, 10_000), seconds(p, 0)
        print(f"{p:10d}{1e3 * forward:12.2f}{1e3 * reverse:12.2f}{forward / reverse:8.2f}{first:10.2f}{other:9.2f}")


if __name__ == "__main__":
    main()
