"""Exact dry friction against its smooth form at the same error: a chain of 20 blocks that rub on the floor, run to rest.

The error is the largest difference of the final positions from a motion with exact friction at rtol 1e-11.
Run: python tests/benchmarks/bench_friction.py
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from timing import medians, once

import jaxlag as jl

jax.config.update("jax_enable_x64", True)


def energy(q, qdot, c):
    return 0.5 * qdot @ qdot - 0.5 * c * jnp.sum(jnp.diff(q) ** 2) - 0.5 * c * q[0] ** 2


chain = jl.System(energy, dissipation={"floor": lambda qdot, F: F * jnp.sum(jnp.abs(qdot))})
START = np.zeros(20), np.r_[np.zeros(19), 3.0]


def run(**how):
    return jl.simulate(chain, *START, [0.0, 60.0], {"c": 10.0, "F": 0.2}, throw=False, **how)


def timed(**how):
    action = lambda: run(**how)
    first = once(action)
    return action(), first, medians({"": action}, rounds=7)[""]


def main():
    reference = run(rtol=1e-11, atol=1e-13).q[-1]
    print(f"{'form':<34}{'error':>10}{'steps':>9}{'first s':>9}{'then ms':>9}")
    rows = [("StickSlip, rtol 1e-6", {"rtol": 1e-6, "atol": 1e-8}), ("StickSlip, rtol 1e-8", {"rtol": 1e-8, "atol": 1e-10})]
    for width in (1e-2, 1e-3, 1e-4):
        smooth = {"friction": jl.Regularised(width), "rtol": 1e-6, "atol": 1e-8, "max_steps": 2_000_000}
        rows.append((f"Regularised({width:g})", smooth))
    rows.append(("Regularised(0.0001), Kvaerno5", smooth | {"solver": diffrax.Kvaerno5()}))
    for name, how in rows:
        motion, first, then = timed(**how)
        error = float(jnp.max(jnp.abs(motion.q[-1] - reference)))
        print(f"{name:<34}{error:10.1e}{int(motion.stats['num_steps']):9d}{first:9.2f}{1e3 * then:9.1f}")


if __name__ == "__main__":
    main()
