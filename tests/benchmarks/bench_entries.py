"""One acceleration as array code and as scalar code: run time and compile time of the n-link pendulum and of the vehicle.

python tests/benchmarks/bench_entries.py [--limit 700] [--loop 10000] [n ...]

Each time is that of one of many dependent evaluations inside one compiled loop (median of 7 runs), which excludes the dispatch.
On a CPU, XLA runs each fused operation of a loop as a separate kernel, unless the loop is small: then the whole loop is one kernel,
provided that nothing in it calls a library. A flag sets what counts as small (default: less than 1024 bytes read and written per
iteration); both cases are measured, each in a fresh process.

    arrays      Lagrange's equations by automatic differentiation, unchanged
    scalars     the same, as scalar code
    hand array  M_ij = (n − max(i, j)) cos(q_i − q_j) written by hand as array code, with jnp.linalg.solve
    hand scalar the same in scalars, with a factorisation L D Lᵀ in scalars (n ≤ 8); for the vehicle its three equations
"""

import argparse
import os
import statistics
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxlag as jl
from jaxlag._mechanics.constrained_acceleration import constrained_acceleration
from jaxlag._model.flat import bind
from jaxlag._program.scalarise import scalarised
from jaxlag.examples import vehicle

GRAVITY = 9.81


def pendulum(q, qdot):
    """L of links of unit mass and length, angles from the vertical downwards."""
    vx, vy = jnp.cumsum(jnp.cos(q) * qdot), jnp.cumsum(jnp.sin(q) * qdot)
    return 0.5 * (vx @ vx + vy @ vy) + GRAVITY * jnp.sum(jnp.cumsum(jnp.cos(q)))


def by_hand_in_arrays(t, q, v, params):
    i = np.arange(q.size)
    links = (q.size - np.maximum(i[:, None], i)).astype(float)
    angle = q[:, None] - q[None, :]
    force = -(links * jnp.sin(angle)) @ v**2 - GRAVITY * (q.size - i) * jnp.sin(q)
    return jnp.linalg.solve(links * jnp.cos(angle), force)


def by_hand_in_scalars(t, q, v, params):
    n = q.size
    q, v = [q[i] for i in range(n)], [v[i] for i in range(n)]
    c, s, L, D = {}, {}, {}, {}
    for i in range(n):
        for j in range(i):
            c[i, j] = jnp.cos(q[i] - q[j])
            s[i, j] = jnp.sin(q[i] - q[j])
    x = []
    for i in range(n):
        force = -GRAVITY * (n - i) * jnp.sin(q[i])
        for j in range(n):
            if j != i:
                force += -(n - max(i, j)) * (s[i, j] if i > j else -s[j, i]) * v[j] ** 2
        x.append(force)
    for i in range(n):
        D[i] = float(n - i)
        for j in range(i):
            L[i, j] = (n - i) * c[i, j]
            for k in range(j):
                L[i, j] -= L[i, k] * D[k] * L[j, k]
            L[i, j] /= D[j]
            D[i] -= L[i, j] ** 2 * D[j]
    for i in range(n):
        for j in range(i):
            x[i] -= L[i, j] * x[j]
    for i in reversed(range(n)):
        x[i] /= D[i]
        for j in range(i + 1, n):
            x[i] -= L[j, i] * x[j]
    return jnp.stack(x)


def vehicle_by_hand(t, q, v, p):
    phi, x, y = 0, 1, 2
    heave = -2 * p["c"] * (q[y] - p["l"]) - 2 * p["b"] * v[y] - p["M"] * p["g"]
    pitch = -2 * p["a"] ** 2 * (p["c"] * q[phi] + p["b"] * v[phi])
    drag = p["k"] * jnp.abs(v[x] + p["v"]) * (v[x] + p["v"])
    ax = (p["M0"] / p["r"] - drag) / (p["M"] + 2 * p["m"] + 2 * p["Theta_r"] / p["r"] ** 2)
    return jnp.stack([pitch / p["Theta_s"], ax, heave / p["M"]])


def acceleration(system, like):
    like = jax.tree.map(jnp.asarray, like)
    return lambda t, q, v, params: constrained_acceleration(bind(system, like, params), t, q, v).x


def measured(function, n, params, loop):
    """Seconds of one evaluation and of compiling the loop, and the first value."""

    @jax.jit
    def many(q, v, params):
        def step(_, state):
            q, v = state
            return q + 1e-4 * v, v + 1e-4 * function(jnp.zeros(()), q, v, params)

        return jax.lax.fori_loop(0, loop, step, (q, v))

    rng = np.random.default_rng(n)
    q, v = jnp.asarray(rng.uniform(-0.5, 0.5, n)), jnp.asarray(rng.uniform(-0.5, 0.5, n))
    start = time.perf_counter()
    compiled = many.lower(q, v, params).compile()
    compiling = time.perf_counter() - start
    times = []
    for _ in range(8):  # the first is a warm-up
        start = time.perf_counter()
        jax.block_until_ready(compiled(q, v, params))
        times.append((time.perf_counter() - start) / loop)
    return statistics.median(times[1:]), compiling, np.asarray(jax.jit(function)(jnp.zeros(()), q, v, params))


def table(links, limit, loop):
    jax.config.update("jax_enable_x64", True)
    chain = jl.System(pendulum)
    cases = [(f"pendulum {n}", n, {}, acceleration(chain, np.zeros(n)), by_hand_in_arrays, by_hand_in_scalars) for n in links]
    params = jax.tree.map(jnp.asarray, vehicle.params)
    cases.append(("vehicle", 3, params, acceleration(vehicle.system, vehicle.q0), None, vehicle_by_hand))
    names = "".join(f"{name:>10}" for name in ("arrays", "scalars", "hand arr", "hand sc"))
    print(f"{'':<13}{'µs for one acceleration':>40}{'s to trace and compile':>40}{'scalars over':>26}")
    print(f"{'':<13}{names}{names}{'arrays':>12}{'hand arr':>10}{'hand sc':>10}")
    for name, n, params, function, arrays, scalars in cases:
        forms = [function, scalarised(function, **limit), arrays, scalars if n <= 8 else None]
        results = [form and measured(form, n, params, loop) for form in forms]
        for result in filter(None, results):
            np.testing.assert_allclose(result[2], results[0][2], rtol=1e-9, atol=1e-9)
        times = [f"{r[0] * 1e6:10.3f}" if r else f"{'':>10}" for r in results]
        compiling = [f"{r[1]:10.2f}" if r else f"{'':>10}" for r in results]
        ratios = [f"{results[1][0] / results[k][0]:10.2f}" if results[k] else f"{'':>10}" for k in (0, 2, 3)]
        print(f"{name:<13}" + "".join([*times, *compiling, "  ", *ratios]), flush=True)


def main():
    options = argparse.ArgumentParser()
    options.add_argument("links", nargs="*", type=int, default=[1, 2, 4, 8, 16])
    options.add_argument("--limit", type=int)
    options.add_argument("--loop", type=int, default=10_000)
    options.add_argument("--here", action="store_true", help="measure in this process")
    given = options.parse_args()
    if given.here:
        return table(given.links, {} if given.limit is None else {"limit": given.limit}, given.loop)
    for title, size in {"one kernel per operation": 0, "one kernel for the loop": 10**9}.items():
        print(f"\n{title}", flush=True)
        flags = f"--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold={size}"
        subprocess.run([sys.executable, __file__, "--here", *sys.argv[1:]], check=True, env=os.environ | {"XLA_FLAGS": flags})


if __name__ == "__main__":
    main()
