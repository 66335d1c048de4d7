"""The fit of the vehicle's b, c and k, first in a fresh process and then again, compared with SciPy on hand-derived equations.

python tests/benchmarks/bench_fit.py
"""

import json
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

REPEATS = 3
FIT = """
import json, time
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import jaxlag as jl
from jaxlag.examples import vehicle
ts, y, phi, xdot = np.loadtxt(vehicle.recording, delimiter=",", skiprows=1).T
record = jl.Experiment(ts, {"y": y, "phi": phi, "xdot": xdot}, vehicle.q0, vehicle.qdot0, observe=vehicle.observe)
guess = vehicle.params | {"b": 6000.0, "c": 20000.0, "k": 0.3}
times = []
for _ in range(8):
    begin = time.perf_counter()
    fit = jl.fit(vehicle.system, record, guess, free=("b", "c", "k"))
    times.append(time.perf_counter() - begin)
print(json.dumps({"first": times[0], "again": sorted(times[1:])[3], "steps": fit.steps, "b": float(fit.estimates["b"])}))
"""


def by_jaxlag() -> dict[str, float]:
    """Medians over fresh processes."""
    runs = [
        json.loads(subprocess.run([sys.executable, "-c", FIT], capture_output=True, text=True, check=True).stdout) for _ in range(REPEATS)
    ]
    return {key: statistics.median(run[key] for run in runs) for key in runs[0]}


def by_scipy() -> tuple[float, float]:
    """Time and b of `curve_fit` over `solve_ivp`."""
    from scipy.optimize import curve_fit

    sys.path.insert(0, str(Path(__file__).parents[1] / "data"))
    import make_drive

    from jaxlag.examples import vehicle

    ts, y, phi, xdot = np.loadtxt(vehicle.recording, delimiter=",", skiprows=1).T

    def model(_, *values):
        make_drive.b, make_drive.c, make_drive.k = values
        motion = make_drive.motion(ts)
        return np.concatenate([motion[1], motion[2], motion[3]])

    begin = time.perf_counter()
    found, _ = curve_fit(model, ts, np.concatenate([y, phi, xdot]), p0=[6000.0, 20000.0, 0.3], epsfcn=1e-8)
    return time.perf_counter() - begin, found[0]


def main() -> None:
    """Prints the table."""
    ours = by_jaxlag()
    seconds, b = by_scipy()
    print(f"first fit, compilation included  {ours['first']:8.2f} s")
    print(f"again, {ours['steps']:.0f} steps                   {ours['again']:8.3f} s   b = {ours['b']:.1f}")
    print(f"SciPy, hand-derived equations    {seconds:8.2f} s   b = {b:.1f}   {seconds / ours['again']:.0f} times as slow")


if __name__ == "__main__":
    main()
