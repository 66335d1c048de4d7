"""What XLA's two kinds of CPU kernel emitters cost: seconds to compile, and time of each further call.

By default XLA compiles each kernel separately (MLIR). Where Python calls a program of this package, `jaxlag._program.jit` selects the older
emitters; here both compile the same programs.
Run: python tests/benchmarks/bench_emitters.py
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
from bench_friction import PENDULA
from bench_pendulum import by_arrays, by_jaxlag
from timing import Row, medians, record

import jaxlag as jl
from jaxlag.examples import vehicle

TS = np.linspace(0, 20, 1000)
STATES = np.random.default_rng(0).uniform(-1, 1, (2, 1024, 8))


def ride(b):
    return jl.simulate(vehicle.system, vehicle.q0, vehicle.qdot0, TS, vehicle.params | {"b": b}, throw=False)


def rides(b):
    return jl.simulate_many(vehicle.system, vehicle.q0, vehicle.qdot0, TS, vehicle.params | {"b": b}, over=["b"], throw=False).q


def swing(name):
    system, q0 = PENDULA[name]
    return lambda q0: jl.simulate(system, q0, 0 * q0, np.linspace(0, 2, 101), throw=False), jnp.asarray(q0)


PROGRAMS = {
    "vehicle, motion": (ride, 3000.0),
    "vehicle, derivative": (jax.jacfwd(lambda b: ride(b).q), 3000.0),
    "vehicle, 1024 motions": (rides, np.linspace(2500.0, 3500.0, 1024)),
    "pendulum on a rod with friction": swing("friction on a rod"),
    "8 links, 1024 accelerations": (lambda states: jax.vmap(by_jaxlag)(*states), STATES),
    "the same by hand in arrays": (lambda states: jax.vmap(by_arrays)(*states), STATES),
}


def table(name):
    function, x = PROGRAMS[name]
    program, rows, runs = jax.jit(function).lower(x), [], {}
    for kind, new in (("older emitters", False), ("default", True)):
        begin = time.perf_counter()
        compiled = program.compile(compiler_options={"xla_cpu_use_fusion_emitters": new})
        rows.append(Row(kind, first=time.perf_counter() - begin, note="first: compilation only"))
        runs[kind] = lambda compiled=compiled: compiled(x)
    for row, seconds in zip(rows, medians(runs).values(), strict=True):
        row.seconds = seconds
        row.ratio = seconds / rows[0].seconds
    return rows


def main():
    record("emitters", ((name, table(name)) for name in PROGRAMS))


if __name__ == "__main__":
    main()
