"""First use: seconds until the vehicle's first motion, gradient and fit in fresh processes, and then of each again.

jaxlag as a user calls it, against hand-derived equations with diffrax and optimistix in their default settings (gradient
in reverse mode; only the fit requires another adjoint). "import" is that of the libraries named.
Run: python tests/benchmarks/bench_first_use.py [processes]
"""

import json
import statistics
import subprocess
import sys

from timing import Row, record

TIMED = """
import json, time
begin = time.perf_counter()
{imports}
done = {{"import": time.perf_counter() - begin}}
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
ts = jnp.linspace(0, 20, 1000)
{actions}
for name, action in (("motion", motion), ("gradient", gradient), ("fit", fit)):
    for turn in ("first", "second"):
        begin = time.perf_counter()
        jax.block_until_ready(action())
        done[turn + " " + name] = time.perf_counter() - begin
print(json.dumps(done))
"""
JAXLAG = """
from jaxlag.examples import vehicle
params = vehicle.params
states = lambda b: jl.simulate(vehicle.system, vehicle.q0, vehicle.qdot0, ts, params | {"b": b}).q["y"]
motion = lambda: states(3000.0)
slope = jax.jit(jax.grad(lambda b: jnp.sum(states(b))))
gradient = lambda: slope(3000.0)
def fit():
    measured = {"y": states(3000.0)}
    experiment = jl.Experiment(ts, measured, vehicle.q0, vehicle.qdot0)
    return jl.fit(vehicle.system, experiment, params | {"b": 4000.0, "c": 30000.0}, free=("b", "c")).x
"""
BY_HAND = """
MX, start = 1000 + 60 + 2 / 0.3**2, jnp.array([0.0, 0.55, 0.05, 0.0, 0.0, 0.0])
def field(t, s, theta):
    b, c = theta
    x, y, phi, vx, vy, vphi = s
    w = vx + 5
    pitch = -2 * 1.3**2 * (c * phi + b * vphi) / 1500
    return jnp.stack([vx, vy, vphi, (1000 - 0.6 * w * w) / MX, -9.81 - 2 * (c * (y - 0.5) + b * vy) / 1000, pitch])
def states(theta, **how):
    controller = dfx.PIDController(1e-8, 1e-10)
    return dfx.diffeqsolve(dfx.ODETerm(field), dfx.Tsit5(), 0.0, 20.0, None, start, theta, saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=controller, **how).ys[:, 1]
run = jax.jit(lambda b: states((b, 40000.0)))
motion = lambda: run(3000.0)
slope = jax.jit(jax.grad(lambda b: jnp.sum(states((b, 40000.0)))))
gradient = lambda: slope(3000.0)
guess = jnp.array([4000.0, 30000.0])
residual = lambda scaled, measured: states(guess * scaled, adjoint=dfx.ForwardMode()) - measured
solver = optx.LevenbergMarquardt(1e-6, 1e-6)
best = jax.jit(lambda measured: optx.least_squares(residual, solver, jnp.ones(2), measured, options={"jac": "fwd"}).value)
fit = lambda: best(run(3000.0))
"""
CODES = {
    "jaxlag": TIMED.format(imports="import jaxlag as jl", actions=JAXLAG),
    "JAX + diffrax by hand": TIMED.format(imports="import jax, diffrax as dfx, optimistix as optx", actions=BY_HAND),
}


def fresh(code):
    """The times that one new process reports."""
    return json.loads(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)


def main(processes=7):
    runs = {name: [] for name in CODES}
    for _ in range(processes):
        for name, code in CODES.items():
            runs[name].append(fresh(code))
    tables = {}
    for task in runs["jaxlag"][0]:
        rows = [Row(name, seconds=statistics.median(run[task] for run in of_name)) for name, of_name in runs.items()]
        for row in rows:
            row.ratio = row.seconds / rows[0].seconds
        tables[task] = rows
    record("first use", tables.items())


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
