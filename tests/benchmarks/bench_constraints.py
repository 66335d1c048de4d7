"""Work and precision of constrained motions: a spherical pendulum, a four-bar, chains of rods in Cartesian coordinates.

Time against the largest error of a coordinate, and the largest |g|. The hand-written equations are integrated without
projection. References: SciPy's DOP853 at 1e-13, in angles for the spherical pendulum.
Run: python tests/benchmarks/bench_constraints.py [spherical four-bar 4 16 64]
"""

import sys

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from rods_by_hand import chain, four_bar, spherical_pendulum
from scipy.integrate import solve_ivp
from timing import compared, record

import jaxlag as jl

TOLERANCES = (1e-5, 1e-7, 1e-9)
MECHANISMS = {"spherical": spherical_pendulum, "four-bar": four_bar} | {str(n): lambda n=n: chain(n) for n in (4, 16, 64)}


def by_jaxlag(rods, solver, tolerance):
    """With its defaults, that is with projection."""
    how = {"solver": solver, "rtol": tolerance, "atol": 0.01 * tolerance}
    return jax.jit(lambda x0: jl.simulate(rods.system, x0, rods.v0, rods.ts, throw=False, **how).q)


def by_hand(rods, solver, tolerance):
    """diffrax, without projection."""
    field = lambda t, y, _: (y[1], rods.acceleration(*y))
    how = {"saveat": dfx.SaveAt(ts=rods.ts), "stepsize_controller": dfx.PIDController(tolerance, 0.01 * tolerance), "max_steps": 100_000}
    start = lambda x0: (x0, jnp.asarray(rods.v0))
    return jax.jit(lambda x0: dfx.diffeqsolve(dfx.ODETerm(field), solver, 0.0, rods.duration, None, start(x0), **how).ys[0])


def reference(name, rods):
    """The motion, accurate to about 1e-11."""
    if name == "spherical":
        return in_angles(rods)
    shape, acceleration = rods.x0.shape, jax.jit(rods.acceleration)
    split = lambda y: (y[: y.size // 2].reshape(shape), y[y.size // 2 :].reshape(shape))
    field = lambda t, y: np.r_[y[y.size // 2 :], np.ravel(acceleration(*split(y)))]
    start = np.r_[rods.x0.ravel(), rods.v0.ravel()]
    y = solve_ivp(field, (0, rods.duration), start, "DOP853", rods.ts, rtol=1e-13, atol=1e-13).y
    return y[: start.size // 2].T.reshape(-1, *shape)


def in_angles(rods):
    """θ̈ = sin θ cos θ φ̇² − g sin θ,  φ̇ = p/sin²θ."""
    (x, _, z), (_, push, _) = rods.x0[0], rods.v0[0]
    p = x * push
    field = lambda t, y: [y[1], p**2 * np.cos(y[0]) / np.sin(y[0]) ** 3 - 9.81 * np.sin(y[0]), p / np.sin(y[0]) ** 2]
    y = solve_ivp(field, (0, rods.duration), [np.arctan2(x, -z), 0.0, 0.0], "DOP853", rods.ts, rtol=1e-13, atol=1e-13).y
    s, c = np.sin(y[0]), np.cos(y[0])
    return np.stack([s * np.cos(y[2]), s * np.sin(y[2]), -c], axis=-1)[:, None]


def table(name):
    """jaxlag with its default solver and Dopri8, hand-written equations with Dopri5 and Dopri8, at each tolerance."""
    rods = MECHANISMS[name]()
    rods.check()
    methods = {
        "jaxlag": (by_jaxlag, None),
        "jaxlag, Dopri8": (by_jaxlag, dfx.Dopri8()),
        "JAX + diffrax Dopri5": (by_hand, dfx.Dopri5()),
        "JAX + diffrax Dopri8": (by_hand, dfx.Dopri8()),
    }
    x0, runs = jnp.asarray(rods.x0), {}
    for tolerance in TOLERANCES:
        for method, (make, solver) in methods.items():
            runs[f"{method}, {tolerance:.0e}"] = lambda run=make(rods, solver, tolerance): run(x0)
    rows, truth = compared(runs, rounds=7), reference(name, rods)
    for row in rows:
        q = runs[row.name]()
        row.error, row.drift = float(jnp.max(jnp.abs(q - truth))), float(jnp.max(jnp.abs(jax.vmap(rods.residual)(q))))
    return rows


def main(*names):
    record("constraints", ((f"{name} rods" if name.isdigit() else name, table(name)) for name in names or MECHANISMS))


if __name__ == "__main__":
    main(*sys.argv[1:])
