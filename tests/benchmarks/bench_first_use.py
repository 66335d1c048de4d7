"""First use: seconds in a fresh process until the vehicle's first motion and first gradient are there, and then each again.

Run: python tests/benchmarks/bench_first_use.py [processes]
"""

import json
import statistics
import subprocess
import sys

CODE = """
import json, time
begin = time.perf_counter()
import jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
import jaxlag as jl
from jaxlag.examples import vehicle
done = {"import": time.perf_counter() - begin}
ts = jnp.linspace(0, 20, 1000)
run = lambda b: jl.simulate(vehicle.system, vehicle.q0, vehicle.qdot0, ts, vehicle.params | {"b": b}).q["y"]
slope = jax.jit(jax.grad(lambda b: jnp.sum(run(b))))
for name, action in (("motion", run), ("gradient", slope)):
    for turn in ("first", "then"):
        begin = time.perf_counter()
        jax.block_until_ready(action(3000.0))
        done[f"{turn} {name}"] = time.perf_counter() - begin
print(json.dumps(done))
"""


def main(processes=5):
    runs = [
        json.loads(subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True).stdout)
        for _ in range(processes)
    ]
    print(f"medians of {processes} processes, s")
    for name in runs[0]:
        times = [run[name] for run in runs]
        print(f"  {name:<16}{statistics.median(times):8.4f}   ({min(times):.4f} … {max(times):.4f})")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
