"""Chains and nets of stiff springs by an implicit scheme: how time and memory grow with their number, beside SciPy by hand.

python tests/benchmarks/bench_stiff.py [most springs of a chain]

1 s of a chain, fixed at one end, from rest at an angle; 0.2 s of a net that hangs on two corners; k = 1e6, rtol 1e-5, atol 1e-7. By hand:
`solve_ivp` with the sparsity of the Jacobian stated. CPU time, the least of three calls, each size in a process of its own. And 1 s of a
rope of rods whose joints resist bending, stiffly, beside the explicit scheme.
"""

import subprocess
import sys
from time import process_time

CHAINS, NETS, ROPES = (128, 512, 1000, 4000), (20, 35, 50), (64, 256, 1000)
TITLES, WIDTHS = ("", "n", "jaxlag s", "Radau s", "BDF s", "ratio", "first s", "steps", "MB", "apart"), (6, 6, 10, 9, 8, 8, 9, 7, 7, 10)
STIFFNESS, DAMPING, GRAVITY = 1e6, 1e3, 9.81


def network(kind, n):
    """Where points rest, which of them are held, and the pairs that springs of unit length join."""
    import numpy as np

    if kind == "chain":
        angles = np.linspace(0.3, 1.2, n)
        place = np.cumsum(np.stack([np.sin(angles), -np.cos(angles)], axis=1), axis=0)
        pairs = np.stack([np.arange(n), np.arange(1, n + 1)])
        return np.vstack([np.zeros(2), place]), np.array([0]), pairs, 1.0
    number = np.arange(n * n).reshape(n, n)
    place = np.stack([*np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), np.zeros((n, n))], axis=2).reshape(-1, 3) * 1.0
    pairs = np.hstack([[number[1:].ravel(), number[:-1].ravel()], [number[:, 1:].ravel(), number[:, :-1].ravel()]])
    return place, np.array([0, n - 1]), pairs, 0.2


def jaxlag_run(kind, n):
    """The motion, ready to be called."""
    import diffrax
    import jax.numpy as jnp
    import numpy as np

    import jaxlag as jl

    place, held, (a, b), end = network(kind, n)
    free = np.delete(np.arange(len(place)), held)
    placed = lambda q: jnp.asarray(place).at[free].set(q)

    def lagrangian(q, qdot, k, g):
        points = placed(q)
        stretch = jnp.sqrt(jnp.sum((points[a] - points[b]) ** 2, axis=1)) - 1
        return 0.5 * jnp.sum(qdot**2) - 0.5 * k * jnp.sum(stretch**2) - g * jnp.sum(q[:, -1])

    def dampers(q, qdot, c):
        points, rates = placed(q), jnp.zeros(place.shape).at[free].set(qdot)
        s, w = points[a] - points[b], rates[a] - rates[b]
        return 0.5 * c * jnp.sum(jnp.sum(s * w, axis=1) ** 2 / jnp.sum(s**2, axis=1))

    system, q = jl.System(lagrangian, dissipation=dampers), place[free]
    params = {"k": STIFFNESS, "c": DAMPING, "g": GRAVITY}
    ts = np.linspace(0, end, 11)
    return lambda: jl.simulate(system, q, np.zeros_like(q), ts, params, solver=diffrax.Kvaerno5(), rtol=1e-5, atol=1e-7)


def scipy_run(kind, n, method):
    """The same by hand in NumPy."""
    import numpy as np
    from scipy.integrate import solve_ivp
    from scipy.sparse import bmat, coo_matrix, eye, kron

    place, held, (a, b), end = network(kind, n)
    free, d, points = np.delete(np.arange(len(place)), held), place.shape[1], len(place)
    join = coo_matrix((np.r_[np.ones(a.size), -np.ones(a.size)], (np.r_[: a.size, : a.size], np.r_[a, b])), (a.size, points)).tocsr()
    back = join.T.tocsr()

    def rates(t, y):
        q, v = y.reshape(2, -1, d)
        x, w = place.copy(), np.zeros_like(place)
        x[free], w[free] = q, v
        s, w = join @ x, join @ w
        length = np.sqrt(np.sum(s**2, axis=1))
        force = -(back @ (((STIFFNESS * (length - 1) + DAMPING * np.sum(s * w, axis=1) / length) / length)[:, None] * s))[free]
        force[:, -1] -= GRAVITY
        return np.concatenate([v.ravel(), force.ravel()])

    beside = kron(((abs(back) @ abs(join)) > 0).astype(float).tocsr()[free][:, free], np.ones((d, d)))
    places = bmat([[None, eye(free.size * d)], [beside, beside]])
    y0 = np.concatenate([place[free].ravel(), np.zeros(free.size * d)])
    return lambda: solve_ivp(rates, (0, end), y0, method, np.linspace(0, end, 11), rtol=1e-5, atol=1e-7, jac_sparsity=places)


def timed(run, times):
    """The first call, the least of others, the last result."""
    calls = []
    for _ in range(times + 1):
        start = process_time()
        result = run()
        calls.append(process_time() - start)
    return calls[0], min(calls[1:]), result


def line(kind, n):
    """One line of the table."""
    import resource

    import jax
    import numpy as np

    jax.config.update("jax_enable_x64", True)
    run = jaxlag_run(kind, n)
    first, each, found = timed(lambda: jax.block_until_ready(run()), 3)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    by_hand, off = {}, 0.0
    for method in ("Radau", "BDF"):
        _, by_hand[method], expected = timed(scipy_run(kind, n, method), 1)
        last = expected.y[: found.q[-1].size, -1]
        off = max(off, float(np.abs(np.ravel(found.q[-1]) - last).max()))
    ratio = each / min(by_hand.values())
    steps = int(found.stats["num_steps"])
    print(
        f"{kind:>6}{n:>6}{each:>10.3f}{by_hand['Radau']:>9.2f}{by_hand['BDF']:>8.2f}{ratio:>8.2f}{first:>9.1f}{steps:>7}{peak:>7.0f}{off:>10.1e}"
    )


def rope(n):
    """One line: a rope of n rods, by the implicit and by the explicit scheme."""
    import diffrax
    import jax
    import jax.numpy as jnp
    import numpy as np

    import jaxlag as jl

    jax.config.update("jax_enable_x64", True)
    joined = lambda x: jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), x]), axis=0)
    cross = lambda a, b: a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]

    def lagrangian(q, qdot, g, B):
        s = joined(q)
        return 0.5 * jnp.sum(qdot**2) - g * jnp.sum(q[:, 1]) - 0.5 * B * jnp.sum(cross(s[:-1], s[1:]) ** 2)

    def bending(q, qdot, c):
        s, w = joined(q), joined(qdot)
        return 0.5 * c * jnp.sum((cross(s[:-1], w[1:]) + cross(w[:-1], s[1:])) ** 2)

    rods = lambda q: jnp.sum(joined(q) ** 2, axis=1) - 1
    system = jl.System(lagrangian, dissipation={"bending": bending}, holonomic={"rods": rods})
    angles = np.linspace(0.3, 1.2, n)
    q = np.cumsum(np.stack([np.sin(angles), -np.cos(angles)], axis=1), axis=0)
    params, ts = {"g": GRAVITY, "B": STIFFNESS, "c": DAMPING}, np.linspace(0, 1, 11)
    runs = {}
    for solver in (diffrax.Kvaerno5(), jl.Dop853()):
        run = lambda solver=solver: jl.simulate(system, q, np.zeros_like(q), ts, params, solver=solver, rtol=1e-6, atol=1e-8)
        first, each, found = timed(lambda run=run: jax.block_until_ready(run()), 2)
        runs[type(solver).__name__] = each, first, found
    off = float(np.abs(runs["Kvaerno5"][2].q - runs["Dop853"][2].q).max())
    words = [
        f"{name} {each:.3f} s, {int(found.stats['num_steps'])} steps, the first {first:.1f} s"
        for name, (each, first, found) in runs.items()
    ]
    print(f"  rope{n:>6} rods: {'; '.join(words)}; apart {off:.1e}")


def main():
    if len(sys.argv) == 3 and sys.argv[1] == "rope":
        return rope(int(sys.argv[2]))
    if len(sys.argv) == 3:
        return line(sys.argv[1], int(sys.argv[2]))
    most = int(sys.argv[1]) if len(sys.argv) > 1 else CHAINS[-1]
    titles = zip(TITLES, WIDTHS, strict=True)
    print("".join(f"{title:>{width}}" for title, width in titles), flush=True)
    for kind, sizes in (("chain", CHAINS), ("net", NETS)):
        for n in sizes:
            if kind == "net" or n <= most:
                subprocess.run([sys.executable, __file__, kind, str(n)], check=True)
    for n in ROPES:
        subprocess.run([sys.executable, __file__, "rope", str(n)], check=True)


if __name__ == "__main__":
    main()
