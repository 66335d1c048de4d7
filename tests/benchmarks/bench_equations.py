"""Equations of motion on paper: this package against SymPy's LagrangesMethod, for a chain of n pendulums.

python tests/benchmarks/bench_equations.py [n ...]

Both start from the same energies: this package from array code, SymPy from sums of its dynamic symbols, whose construction is not timed.
Here: simplified equations of motion, mass matrix and forces, compared with the simulation. There: unsimplified equations, mass matrix and
forces. Each runs in a fresh process, whose imports are not timed. Their agreement is shown by numbers at a random state.
"""

import subprocess
import sys
import time

import numpy as np


def here(n):
    """Seconds, M and f at a state."""
    import sympy

    import jaxlag as jl
    from jaxlag._paper import equations  # noqa: F401 - with all that it imports

    system = jl.System(chain)
    start = time.perf_counter()
    e = jl.equations(system, np.zeros(n), {"m": np.ones(n), "l": np.ones(n), "g": 9.81})
    seconds = time.perf_counter() - start
    symbols = [*e.q, *e.qdot, *e.params["m"], *e.params["l"], e.params["g"]]
    return seconds, *(sympy.lambdify(symbols, part)(*state(n)) for part in (e.M, e.f))


def chain(q, qdot, m, l, g):
    """L of point masses on rods, angles from the vertical."""
    import jax.numpy as jnp

    vx, vy = jnp.cumsum(l * jnp.cos(q) * qdot), jnp.cumsum(l * jnp.sin(q) * qdot)
    return 0.5 * jnp.sum(m * (vx**2 + vy**2)) + g * jnp.sum(m * jnp.cumsum(l * jnp.cos(q)))


def there(n):
    """The same by SymPy."""
    import sympy
    from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols

    q = dynamicsymbols(f"q1:{n + 1}")
    qdot = [x.diff(dynamicsymbols._t) for x in q]
    m, l, g = sympy.symbols(f"m1:{n + 1}"), sympy.symbols(f"l1:{n + 1}"), sympy.Symbol("g")
    vx = vy = height = L = sympy.Integer(0)
    for k in range(n):
        vx, vy = vx + l[k] * sympy.cos(q[k]) * qdot[k], vy + l[k] * sympy.sin(q[k]) * qdot[k]
        height -= l[k] * sympy.cos(q[k])
        L += m[k] * (vx**2 + vy**2) / 2 - m[k] * g * height
    start = time.perf_counter()
    method = LagrangesMethod(L, q)
    method.form_lagranges_equations()
    M, f = method.mass_matrix, method.forcing
    seconds = time.perf_counter() - start
    plain = dict(zip(qdot, v := sympy.symbols(f"v1:{n + 1}"), strict=True))
    return seconds, *(sympy.lambdify([*q, *v, *m, *l, g], part.xreplace(plain))(*state(n)) for part in (M, f))


def state(n):
    """Coordinates, velocities, masses, lengths, gravity."""
    return np.append(np.random.default_rng(n).uniform(0.5, 1.5, 4 * n), 9.81)


def main(links):
    print(f"{'links':>5}{'here s':>10}{'SymPy s':>10}{'SymPy over here':>18}{'largest difference':>20}")
    for n in links:
        run = f"import bench_equations as b; r = b.{{}}({n}); print(r[0]); print([float(x) for p in r[1:] for x in p.flat])"
        found = []
        for who in ("here", "there"):
            out = subprocess.run([sys.executable, "-c", run.format(who)], capture_output=True, text=True, check=True, cwd=sys.path[0])
            seconds, numbers = out.stdout.splitlines()
            found.append((float(seconds), np.array(eval(numbers))))
        (mine, here_), (theirs, there_) = found
        print(f"{n:5d}{mine:10.2f}{theirs:10.2f}{theirs / mine:18.1f}{np.abs(here_ - there_).max():20.1e}", flush=True)


if __name__ == "__main__":
    main([int(n) for n in sys.argv[1:]] or [2, 6, 10])
