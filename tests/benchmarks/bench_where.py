"""Where the time goes in a fit, in a first motion, and in many motions at once.

Run: python tests/benchmarks/bench_where.py
"""

import importlib
import json
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from bench_first_use import VEHICLE
from timing import medians, once

import jaxlag as jl
from jaxlag.examples import vehicle

jax.config.update("jax_enable_x64", True)
TS = np.linspace(0, 20, 1000)
LISTENER = """
import collections, json, time
import jax
spent = collections.Counter()
jax.monitoring.register_event_duration_secs_listener(lambda event, seconds, **_: spent.update({event.split("/")[-1]: seconds}))
"""


def of_a_fit(repeats=50):
    """Seconds spent in the parts of a repeated fit of b, c, k."""
    motion = jl.simulate(vehicle.system, vehicle.q0, vehicle.qdot0, TS, vehicle.params)
    experiment = jl.Experiment(TS, {"y": motion.q["y"], "x": motion.q["x"]}, vehicle.q0, vehicle.qdot0)
    start = vehicle.params | {"b": 4000.0, "c": 30000.0, "k": 0.8}
    fit = lambda: jl.fit(vehicle.system, experiment, start, free=("b", "c", "k"))
    fit()
    whole_fit, search = (importlib.import_module(f"jaxlag._fit.{name}") for name in ("fit", "minimise"))
    parts = {
        "setting up the problem": (whole_fit, "checked_problem"),
        "residuals with Jacobian": (search, "linearise"),
        "report": (whole_fit, "report"),
    }
    spent, calls, before = dict.fromkeys(parts, 0.0), dict.fromkeys(parts, 0), {part: getattr(*place) for part, place in parts.items()}

    def counted(part, function):
        def run(*given, **named):
            begin = time.perf_counter()
            out = jax.block_until_ready(function(*given, **named))
            spent[part] += time.perf_counter() - begin
            calls[part] += 1
            return out

        return run

    for part, place in parts.items():
        setattr(*place, counted(part, before[part]))
    begin = time.perf_counter()
    for _ in range(repeats):
        fit()
    whole = time.perf_counter() - begin
    for part, place in parts.items():
        setattr(*place, before[part])
    shares = {f"{part}, {calls[part] // repeats} times": seconds for part, seconds in spent.items()}
    shares["iterations and the rest"] = whole - sum(spent.values())
    return {part: seconds / repeats for part, seconds in shares.items()}


def of_a_first_motion(name, processes=5):
    """Seconds of the parts of a first motion in a fresh process, as reported by JAX; nested parts are counted in both."""
    code = VEHICLE[name].split("for name, action in")[0]
    ending = """
spent.clear()
jax.block_until_ready(motion())
print(json.dumps(spent))
"""
    runs = [
        json.loads(subprocess.run([sys.executable, "-c", LISTENER + code + ending], capture_output=True, text=True, check=True).stdout)
        for _ in range(processes)
    ]
    events = {"tracing": "jaxpr_trace_duration", "lowering": "jaxpr_to_mlir_module_duration", "compiling": "backend_compile_duration"}
    return {part: float(np.median([run[event] for run in runs])) for part, event in events.items()}


def of_many_motions():
    """Seconds of 1024 motions without intermediate samples, and what 1000 samples add."""
    b = jnp.linspace(2500.0, 3500.0, 1024)
    numerics = {"over": ["b"], "rtol": 1e-5, "atol": 1e-7, "throw": False}

    def ends(ts):
        run = jax.jit(
            lambda b: jl.simulate_many(vehicle.system, vehicle.q0, vehicle.qdot0, ts, vehicle.params | {"b": b}, **numerics).q["y"]
        )
        once(lambda: run(b))
        return lambda: run(b)

    alone, sampled = medians({"ends": ends(TS[[0, -1]]), "samples": ends(TS)}).values()
    return {"integration": alone, "1000 samples of each": sampled - alone}


def main():
    tables = {"a repeated fit": of_a_fit(), "1024 motions": of_many_motions()}
    tables |= {f"a first motion, {name}": of_a_first_motion(name) for name in VEHICLE}
    for title, parts in tables.items():
        whole = sum(parts.values())
        print(f"\n**{title}: {1e3 * whole:.3g} ms**\n")
        for part, seconds in parts.items():
            print(f"{part:<40}{1e3 * seconds:8.2f} ms {100 * seconds / whole:5.0f} %")


if __name__ == "__main__":
    main()
