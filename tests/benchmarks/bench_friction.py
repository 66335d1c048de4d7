"""Exact dry friction, compared with its regularised form at the same error, and its compile time.

A chain of 20 blocks slides on the floor until it rests; the error is the largest difference of the final positions from a motion with
exact friction at rtol 1e-11. Then a pendulum with joint friction, in its angle and in Cartesian coordinates, where the friction is either
given or proportional to the rod's force: first and further calls, of a motion and of its derivative with respect to the initial state.
Run: python tests/benchmarks/bench_friction.py
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from timing import Row, medians, once, record

import jaxlag as jl

jax.config.update("jax_enable_x64", True)


def energy(q, qdot, c):
    return 0.5 * qdot @ qdot - 0.5 * c * jnp.sum(jnp.diff(q) ** 2) - 0.5 * c * q[0] ** 2


chain = jl.System(energy, dissipation={"floor": lambda qdot, F: F * jnp.sum(jnp.abs(qdot))})
START = np.zeros(20), np.r_[np.zeros(19), 3.0]


def sweep(q, qdot):
    return jnp.abs(q[0] * qdot[1] - q[1] * qdot[0])


def on_a_rod(friction):
    lagrangian = lambda q, qdot: 0.5 * qdot @ qdot - 9.81 * q[1]
    return jl.System(lagrangian, holonomic={"rod": lambda q: q @ q - 1.0}, dissipation={"joint": friction})


by_angle = jl.System(lambda q, qdot: 0.5 * qdot**2 + 9.81 * jnp.cos(q), dissipation={"joint": lambda qdot: 0.1 * jnp.abs(qdot)})
START_ON_ROD = np.array([0.6, -0.8])
PENDULA = {
    "friction in an angle": (by_angle, np.array(1.0)),
    "friction on a rod": (on_a_rod(lambda q, qdot: 0.1 * sweep(q, qdot)), START_ON_ROD),
    "friction by the force of the rod": (
        on_a_rod(lambda q, qdot, multipliers: 0.1 * jnp.abs(multipliers["rod"]) * sweep(q, qdot)),
        START_ON_ROD,
    ),
}


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
    record("friction", pendula())


def pendula():
    """Tables of the pendula: first and further calls of the motion and of its derivative."""
    tables: dict[str, list[Row]] = {}
    for name, (system, start) in PENDULA.items():
        motion = jax.jit(lambda q, system=system: jl.simulate(system, q, 0 * q, np.linspace(0, 2, 101)).q)
        derivative = jax.jit(lambda q, motion=motion: jax.jacfwd(motion)(q))
        actions = {"motion": lambda: motion(start), "derivative": lambda: derivative(start)}  # noqa: B023
        first = {task: once(action) for task, action in actions.items()}
        then = medians(actions, rounds=7)
        for task in actions:
            tables.setdefault(f"first {task}", []).append(Row(name, seconds=first[task]))
            tables.setdefault(f"{task} again", []).append(Row(name, seconds=then[task]))
    return tables.items()


if __name__ == "__main__":
    main()
