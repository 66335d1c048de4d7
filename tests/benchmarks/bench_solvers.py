"""Work and precision: run time of a motion against its error, for the usual solvers, at tolerances from 1e-4 to 1e-12.

The lecture's vehicle over 20 s against its exact solution. Draws notebooks/work_precision.png.
Run: python tests/benchmarks/bench_solvers.py
"""

from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import vehicle_by_hand as by_hand
import vehicle_solvers as solvers
from timing import medians

import jaxlag as jl
from jaxlag import plot
from jaxlag.examples import vehicle

SOLVERS = {
    "jaxlag.Dop853": jl.Dop853(),
    "jaxlag.Dopri5": jl.Dopri5(),
    "diffrax.Tsit5": diffrax.Tsit5(),
    "diffrax.Dopri8": diffrax.Dopri8(),
    "diffrax.Kvaerno5": diffrax.Kvaerno5(),
}
TOLERANCES = 10.0 ** -np.arange(4, 13)


def motion(solver):
    """Coordinates and velocities as a compiled function of the tolerance."""

    def states(tolerance):
        how = dict(solver=solver, rtol=tolerance, atol=0.01 * tolerance)
        found = jl.simulate(vehicle.system, vehicle.q0, vehicle.qdot0, jnp.asarray(by_hand.TS), by_hand.P, **how)
        return solvers.stacked(found.q, found.qdot)

    return jax.jit(states)


def main():
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, ax = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    print("| solver | tolerance | error | time |\n|---|---|---|---|")
    for (name, solver), colour, marker in zip(SOLVERS.items(), plot.COLOURS, "os^vD", strict=False):
        run = motion(solver)
        errors = [float(np.max(np.abs(np.asarray(run(tol)) - by_hand.EXACT)[:, :3])) for tol in TOLERANCES]
        seconds = list(medians({tol: lambda tol=tol, run=run: run(tol) for tol in TOLERANCES}).values())
        for tol, error, second in zip(TOLERANCES, errors, seconds, strict=True):
            print(f"| {name} | {tol:.0e} | {error:.1e} | {1e3 * second:.3f} ms |")
        ax.loglog(errors, 1e3 * np.array(seconds), marker=marker, color=colour, label=name)
    ax.invert_xaxis()
    ax.set(xlabel="largest error of a coordinate (m, rad)", ylabel="time of a motion (ms)")
    ax.legend(frameon=False)
    figure.savefig(Path(__file__).parents[2] / "notebooks" / "work_precision.png", dpi=110)


if __name__ == "__main__":
    main()
