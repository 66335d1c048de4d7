"""A linear drive recorded at 1 kHz under its digital controller, with dry friction that sticks: what identification costs and gives.

The data come from NumPy's exact piecewise solution (tests/data/make_linear_drive.py). Run:

python tests/benchmarks/bench_recordings.py
"""

import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxlag as jl

sys.path.insert(0, str(Path(__file__).parents[1] / "data"))
import make_linear_drive as drive

jax.config.update("jax_enable_x64", True)

SYSTEM = jl.System(
    lambda qdot, M: 0.5 * M * qdot**2,
    dissipation=lambda qdot, Fv, Fc: 0.5 * Fv * qdot**2 + Fc * jnp.abs(qdot),
    force=lambda t, u, offset: drive.K * u(t) - offset,
)


def regression(ts, q, u) -> None:
    """Prints the time and the errors of `regress`."""
    record = jl.Experiment(ts, q, 0.0, 0.0, params={"u": jl.Signal(ts, u)})
    for call in ("first call", "again"):
        begin = time.perf_counter()
        found = jl.regress(SYSTEM, record, dict.fromkeys(drive.TRUE, np.nan), free=tuple(drive.TRUE))
        print(f"regress, {call}: {time.perf_counter() - begin:.2f} s")
    print(found)
    for name, true in drive.TRUE.items():
        print(f"  {name:6} off by {100 * abs(float(found.estimates[name]) / true - 1):.1e} %")


def main() -> None:
    """Prints all."""
    ts, q, _, u = drive.recording()
    regression(ts, q, u)


if __name__ == "__main__":
    main()
