"""FMUs of the vehicle, of a pendulum on a rod and of a bicycle, run by FMPy: errors and times, beside `simulate`.

python tests/benchmarks/bench_fmu.py [vehicle] [rod] [bicycle]

Model exchange by CVode; co-simulation at the sample times, and in steps of a millisecond, which FMPy takes one by one in Python. Errors
are the largest differences of coordinates from `simulate` at a tolerance of 1e-10.
"""

import sys
import tempfile
import time
from pathlib import Path

import fmpy
import jax
import numpy as np
from fmpy.fmi3 import FMU3Slave
from timing import medians, once

import jaxlag as jl
from jaxlag.examples import bicycle, pendulum, vehicle

jax.config.update("jax_enable_x64", True)

END, SAMPLES = 5.0, 101


def cases():
    """System, q, q̇ and parameters by name."""
    p = bicycle.params
    q, qdot = bicycle.state(p["v"], p["r_R"], p["r_F"])
    return {
        "vehicle": (vehicle.system, vehicle.q0, vehicle.qdot0, vehicle.params),
        "rod": (pendulum.cartesian, *pendulum.cartesian_state(1.0, 0.0, 1.0), pendulum.params),
        "bicycle": (bicycle.system, q, qdot | {"roll": 0.3}, p),
    }


def of_fmpy(folder, kind):
    """The solution at the sample times by FMPy."""
    return lambda: fmpy.simulate_fmu(
        folder, fmi_type=kind, stop_time=END, output_interval=END / (SAMPLES - 1), relative_tolerance=1e-9, record_events=False
    )


def by_milliseconds(folder, names):
    """The same from a master that steps at a millisecond."""
    description = fmpy.read_model_description(folder)
    references = [v.valueReference for name in names for v in description.modelVariables if v.name == name]
    interface = dict(guid=description.guid, unzipDirectory=folder, modelIdentifier=description.coSimulation.modelIdentifier)

    def run():
        unit = FMU3Slave(instanceName="unit", **interface)
        unit.instantiate()
        unit.enterInitializationMode()
        unit.exitInitializationMode()
        found, steps = [unit.getFloat64(references)], round(END / 1e-3)
        for k in range(steps):
            unit.doStep(k * 1e-3, 1e-3)
            if (k + 1) % (steps // (SAMPLES - 1)) == 0:
                found.append(unit.getFloat64(references))
        unit.freeInstance()
        return dict(zip(names, np.transpose(found), strict=True))

    return run


def table(name, system, q, qdot, params):
    """Prints the rows of a system."""
    ts = np.linspace(0.0, END, SAMPLES)
    simulate = lambda rtol: jl.simulate(system, q, qdot, ts, params, rtol=rtol).q
    compiled, exact = once(lambda: simulate(1e-8)), simulate(1e-10)
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        path = jl.to_fmu(system, Path(folder, f"{name}.fmu"), q, qdot, params)
        wrote = time.perf_counter() - begin
        unpacked = fmpy.extract(str(path), str(Path(folder, name)))
        runs = {
            "simulate, rtol 1e-8": lambda: simulate(1e-8),
            "model exchange, CVode": of_fmpy(unpacked, "ModelExchange"),
            "co-simulation": of_fmpy(unpacked, "CoSimulation"),
            "co-simulation, 5000 steps of 1 ms": by_milliseconds(unpacked, list(exact)),
        }
        errors = {what: max(float(np.abs(run()[x] - np.asarray(exact[x])).max()) for x in exact) for what, run in runs.items()}
        for what, seconds in medians(runs, rounds=5).items():
            first = compiled if what.startswith("simulate") else wrote
            print(f"{name:10} {what:34} {errors[what]:9.1e} {1e3 * seconds:10.2f} {first:8.1f}")


if __name__ == "__main__":
    print(f"{'':10} {'':34} {'error':>9} {'time / ms':>10}   compiled, or written in / s")
    for chosen in sys.argv[1:] or cases():
        table(chosen, *cases()[chosen])
