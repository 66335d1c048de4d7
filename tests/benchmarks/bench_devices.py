"""One core against all: 1024 vehicles by `simulate_many`, in fresh processes with one device and with one device per core.

Run: python tests/benchmarks/bench_devices.py [processes]
"""

import json
import os
import statistics
import subprocess
import sys

from timing import Row, record

TIMED = """
import jax, json, statistics
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", {devices})
import jax.numpy as jnp
import numpy as np
import jaxlag as jl
from jaxlag.examples import vehicle
from timing import medians
ts, params = jnp.linspace(0, 20, 101), vehicle.params
spread = 1 + 0.2 * np.random.default_rng(0).random((3, 1024))
start = vehicle.q0, vehicle.qdot0, ts
how = dict(over=("b", "c", "k"), rtol=1e-5, atol=1e-7)
run = jax.jit(lambda x: jl.simulate_many(vehicle.system, *start, params | {{n: x[i] * params[n] for i, n in enumerate("bck")}}, **how).q)
many = jnp.asarray(spread)
print(json.dumps(medians({{"": lambda: run(many)}})[""]))
"""


def seconds(devices):
    """Median run time, measured in one process."""
    script = TIMED.format(devices=devices)
    here = os.path.dirname(os.path.abspath(__file__))
    done = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True, cwd=here)
    return json.loads(done.stdout.splitlines()[-1])


def main():
    processes, cores = int(sys.argv[1]) if len(sys.argv) > 1 else 3, os.cpu_count() or 1
    taken: dict[int, list[float]] = {cores: [], 1: []}
    for _ in range(processes):
        for devices, times in taken.items():
            times.append(seconds(devices))
    all_, one = (statistics.median(times) for times in taken.values())
    rows = [Row(f"{cores} devices, one per core", seconds=all_, ratio=1.0), Row("one device", seconds=one, ratio=one / all_)]
    record("devices", [("1024 parameter sets", rows)])


if __name__ == "__main__":
    main()
