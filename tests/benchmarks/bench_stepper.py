"""One step at a time: 10⁵ steps of 1 ms of a `stepper` in `lax.scan`, beside as many motions of `simulate` from state to state.

python tests/benchmarks/bench_stepper.py

Medians of 5 in one run, in µs a step; the first call, mostly compilation, apart.
"""

import jax
import jax.numpy as jnp
from timing import medians, once

import jaxlag as jl

jax.config.update("jax_enable_x64", True)
COUNT, DT = 100_000, 1e-3


def oscillator(q, qdot, c):
    return 0.5 * qdot**2 - 0.5 * c * q**2


CASES = {
    "smooth": (jl.System(oscillator), {"c": 4.0}),
    "friction": (jl.System(oscillator, dissipation=lambda qdot, F: F * jnp.abs(qdot)), {"c": 10.0, "F": 1.2e-3}),
    "a force that jumps": (jl.System(oscillator, force=lambda u: u), {"c": 4.0}),
    "friction, a force that jumps": (
        jl.System(oscillator, dissipation=lambda qdot, F: F * jnp.abs(qdot), force=lambda u: u),
        {"c": 10.0, "F": 1.2e-3},
    ),
}


def ways(system, params):
    """The last q, by each way."""
    inputs = {"u": 0.0} if system.force else {}
    given = lambda k: {name: 1e-3 * jnp.sin(0.1 * k) for name in inputs}

    @jax.jit
    def by_stepper(params):
        stepper = jl.stepper(system, DT, params, inputs=inputs)
        step = lambda state, k: (stepper(state, given(k)), None)
        return jax.lax.scan(step, stepper.start(1.0, 0.0), jnp.arange(COUNT))[0].q

    @jax.jit
    def by_simulate(params):
        def step(state, k):
            motion = jl.simulate(system, *state, jnp.array([0.0, DT]), params | given(k), throw=False)
            return (motion.q[-1], motion.qdot[-1]), None

        return jax.lax.scan(step, (jnp.array(1.0), jnp.array(0.0)), jnp.arange(COUNT))[0][0]

    return {"stepper": lambda: by_stepper(params), "simulate, step by step": lambda: by_simulate(params)}


def main():
    for name, case in CASES.items():
        runs = ways(*case)
        first = {way: once(run) for way, run in runs.items()}
        for way, seconds in medians(runs, rounds=5).items():
            print(f"{name:<30}{way:<24}{1e6 * seconds / COUNT:8.2f} µs   first {first[way]:.2f} s", flush=True)


if __name__ == "__main__":
    main()
