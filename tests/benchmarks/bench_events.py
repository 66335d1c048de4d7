"""Events: what watching for them costs, and what each of them costs, beside SciPy's events; a limit cycle and its derivative.

python tests/benchmarks/bench_events.py

An oscillator for a hundred seconds, and van der Pol's. Medians of 9 in one run; first calls, mostly compilation, apart.
"""

import time

import jax
import jax.numpy as jnp
from scipy.integrate import solve_ivp
from timing import medians

import jaxlag as jl

jax.config.update("jax_enable_x64", True)
TS = jnp.array([0.0, 100.0])


def oscillator(q, qdot, c):
    return 0.5 * qdot**2 - 0.5 * c * q**2 - 0.1 * q**4


SYSTEMS = {
    "no event": jl.System(oscillator),
    "one that never happens": jl.System(oscillator, events={"far": jl.Event(lambda q: q - 10.0)}),
    "64 turning points": jl.System(oscillator, events={"turn": jl.Event(lambda qdot: qdot)}),
}


def by_scipy():
    turning = lambda t, y: y[1]
    rates = lambda t, y: [y[1], -4 * y[0] - 0.4 * y[0] ** 3]
    return jnp.asarray(solve_ivp(rates, (0, 100), [0.0, 1.0], "DOP853", rtol=1e-8, atol=1e-10, events=turning).t_events[0])


def motions():
    """With and without events."""
    run = lambda system: lambda: jl.simulate(system, 0.0, 1.0, TS, {"c": 4.0}).q
    first = {name: _first(run(system)) for name, system in SYSTEMS.items()}
    seconds = medians({name: run(system) for name, system in SYSTEMS.items()} | {"64, by SciPy": by_scipy})
    for name, each in seconds.items():
        wait = f"   first {first[name]:.2f} s" if name in first else ""
        print(f"{name:<24}{1e3 * each:8.2f} ms, {each / seconds['no event']:5.2f} times{wait}")


def cycles():
    """A limit cycle, and its derivative."""
    top = jl.Event(lambda qdot: qdot, direction=jl.direction.Falling())
    system = jl.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2, force=lambda q, qdot, mu: mu * (1 - q**2) * qdot)
    period = lambda mu: jl.periodic(system, 1.0, 0.0, {"mu": mu}, section=top, longest=20.0).period
    for name, run in (("limit cycle", lambda: period(1.0)), ("its derivative", lambda: jax.grad(period)(1.0))):
        first = _first(run)
        print(f"{name:<24}{1e3 * medians({name: run})[name]:8.2f} ms                first {first:.2f} s")


def _first(run):
    start = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - start


if __name__ == "__main__":
    motions()
    cycles()
