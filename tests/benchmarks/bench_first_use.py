"""First use: what a person waits for in fresh processes, each beside the same by hand with JAX and diffrax in the same run.

The vehicle: seconds until its first motion, gradient and fit, and then of each again; by hand with hand-derived equations, diffrax and
optimistix in their default settings (gradient in reverse mode; only the fit requires another adjoint); and, when all is compiled, its
motion called from Python beside the compiled one within `jax.jit`, and one acceleration. The pendulum of README's first
example, a point on a rod with the constraint |r| = l: its first motion, gradient and Hessian, its first motion with dry friction in the
joint and the gradient of that; by hand from its equations with the multiplier eliminated. The whole of that example with `keep_compiled`,
in a first process and in a second one. Models that change their modes, alone: motion and gradient, first and again. "import" is that of
the libraries named.
Run: python tests/benchmarks/bench_first_use.py [processes]
"""

import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

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
VEHICLE = {
    "jaxlag": TIMED.format(imports="import jaxlag as jl", actions=JAXLAG),
    "JAX + diffrax by hand": TIMED.format(imports="import jax, diffrax as dfx, optimistix as optx", actions=BY_HAND),
}

CALLED = """
import json, statistics, time
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import jaxlag as jl
ts = jnp.linspace(0, 20, 1000)
from jaxlag.examples import vehicle
state, params = (vehicle.q0, vehicle.qdot0), vehicle.params
by_python = lambda b: jl.simulate(vehicle.system, *state, ts, params | {"b": b}).q["y"]
compiled = jax.jit(by_python)
actions = {
    "compiled": lambda: compiled(3000.0),
    "called from Python": lambda: by_python(3000.0),
    "acceleration, called from Python": lambda: jl.acceleration(vehicle.system, *state, params).qddot,
}
taken = {name: [] for name in actions}
for turn in range(400):
    for name, action in actions.items():
        begin = time.perf_counter()
        jax.block_until_ready(action())
        taken[name].append(time.perf_counter() - begin)
print(json.dumps({name: statistics.median(seconds[20:]) for name, seconds in taken.items()}))
"""

FIRST = """
import json, resource, time
{imports}
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
ts = jnp.linspace(0, 10, 201)
{actions}
begin = time.perf_counter()
jax.block_until_ready(action())
print(json.dumps({{"seconds": time.perf_counter() - begin, "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}}))
"""
ROD = """
lagrangian = lambda q, qdot, m, g: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2) - m * g * q["y"]
air = lambda qdot, b: 0.5 * b * (qdot["x"] ** 2 + qdot["y"] ** 2)
rod = lambda q, l: jnp.hypot(q["x"], q["y"]) - l
joint = lambda q, qdot, F, l: F * jnp.abs(q["x"] * qdot["y"] - q["y"] * qdot["x"]) / l
start, params = ({"x": 1.5, "y": 0.0}, {"x": 0.0, "y": 0.0}), {"m": 2.0, "l": 1.5, "g": 9.81, "b": 0.1, "F": 2.0}
smooth = jl.System(lagrangian, dissipation={"air": air}, holonomic={"rod": rod})
dry = jl.System(lagrangian, dissipation={"joint": joint}, holonomic={"rod": rod})
x = lambda system, **changed: jl.simulate(system, *start, ts, params | changed).q["x"]
"""
ROD_BY_HAND = """
def field(t, s, p):
    m, l, g, b = p
    r, v = s[:2], s[2:]
    length = jnp.sqrt(r @ r)
    n, f = r / length, jnp.array([0.0, -m * g]) - b * v
    return jnp.concatenate([v, (f - (m * (v @ v - (n @ v) ** 2) / length + n @ f) * n) / m])
def x(l, b):
    start = jnp.stack([l, 0.0 * l, 0.0 * l, 0.0 * l])
    controller = dfx.PIDController(1e-8, 1e-10)
    return dfx.diffeqsolve(dfx.ODETerm(field), dfx.Tsit5(), 0.0, 10.0, None, start, (2.0, l, 9.81, b), saveat=dfx.SaveAt(ts=ts),
        stepsize_controller=controller, max_steps=100_000, **how).ys[:, 0]
"""
ACTIONS = {  # by jaxlag, and by hand; what both are asked to do
    "rod: motion": ("lambda: x(smooth)", "lambda: jax.jit(x)(1.5, 0.1)"),
    "rod: gradient": ("lambda: jax.grad(lambda l: x(smooth, l=l)[-1])(1.5)", "lambda: jax.jit(jax.grad(lambda l: x(l, 0.1)[-1]))(1.5)"),
    "rod: Hessian": (
        "lambda: jax.hessian(lambda p: x(smooth, l=p[0], b=p[1])[-1])(jnp.array([1.5, 0.1]))",
        "lambda: jax.jit(jax.jacfwd(jax.jacfwd(lambda p: x(p[0], p[1])[-1])))(jnp.array([1.5, 0.1]))",
    ),
    "rod with friction: motion": ("lambda: x(dry)", None),
    "rod with friction: gradient": ("lambda: jax.grad(lambda F: x(dry, F=F)[-1])(2.0)", None),
}


MODELS = {
    "a block with friction": """
system = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, dissipation=lambda qdot, F: F * jnp.abs(qdot))
start, params, varied = (1.0, 0.0), {"c": 10.0, "F": 1.2}, "F"
""",
    "two blocks with friction": """
system = jl.System(
    lambda q, qdot, c: 0.5 * qdot @ qdot - 0.5 * c * (q[0] ** 2 + (q[1] - q[0]) ** 2),
    dissipation=lambda qdot, F: F * (jnp.abs(qdot[0]) + 0.5 * jnp.abs(qdot[1] - qdot[0])),
)
start, params, varied = (jnp.array([1.0, 0.5]), jnp.zeros(2)), {"c": 10.0, "F": 0.6}, "F"
""",
    "a bouncing ball": """
system = jl.System(lambda q, qdot, g: 0.5 * qdot**2 - g * q, unilateral={"floor": jl.Contact(lambda q: q, 0.8)})
start, params, varied = (1.0, 0.0), {"g": 9.81}, "g"
""",
    "two contacts with friction": """
def corner(side):
    return lambda q: q["y"] + side * 0.5 * jnp.sin(q["a"]) - 0.1 * jnp.cos(q["a"])
def along(q, qdot):
    return jnp.abs(qdot["x"])
system = jl.System(
    lambda q, qdot, g: 0.5 * (qdot["x"] ** 2 + qdot["y"] ** 2 + 0.1 * qdot["a"] ** 2) - g * q["y"],
    dissipation={
        "rub left": lambda q, qdot, multipliers, mu: mu * multipliers["left"] * along(q, qdot),
        "rub right": lambda q, qdot, multipliers, mu: mu * multipliers["right"] * along(q, qdot),
    },
    unilateral={"left": jl.Contact(corner(-1), 0.5), "right": jl.Contact(corner(1), 0.5)},
)
start = {"x": 0.0, "y": 0.5, "a": 0.3}, {"x": 2.0, "y": 0.0, "a": 0.0}
params, varied = {"g": 9.81, "mu": 0.3}, "mu"
""",
    "ten Jenkin elements": """
system = jl.System(
    lambda q, qdot, k, c: 0.5 * qdot["x"] ** 2 - 0.5 * k * q["x"] ** 2 - 0.5 * jnp.sum(c * (q["x"] - q["z"]) ** 2),
    dissipation=lambda qdot, F: jnp.sum(F * jnp.abs(qdot["z"])),
)
start = {"x": 1.0, "z": jnp.zeros(10)}, {"x": 0.0, "z": jnp.zeros(10)}
params, varied = {"k": 1.0, "c": jnp.ones(10), "F": jnp.linspace(0.1, 0.3, 10)}, "k"
""",
}
OF_MODEL = """
ts = jnp.linspace(0, 3, 101)
moved = lambda value: jax.tree.leaves(jl.simulate(system, *start, ts, params | {varied: value}).q)[0]
slope = jax.jit(jax.grad(lambda value: jnp.sum(moved(value)[-1])))
motion, gradient, fit = lambda: moved(params[varied]), lambda: slope(params[varied]), lambda: 0.0
"""


def codes_of(task):
    """The programs that are compared at one task of the pendulum."""
    ours, by_hand = ACTIONS[task]
    codes = {"jaxlag": FIRST.format(imports="import jaxlag as jl", actions=f"{ROD}\naction = {ours}")}
    if by_hand:
        how = "how = dict(adjoint=dfx.ForwardMode())" if "Hessian" in task else "how = {}"
        codes["JAX + diffrax by hand"] = FIRST.format(imports="import diffrax as dfx", actions=f"{how}\n{ROD_BY_HAND}\naction = {by_hand}")
    return codes


def readme():
    """README's first example as one action."""
    text = (Path(__file__).parents[2] / "README.md").read_text()
    (example, *_) = re.findall(r"```python\n(.*?)```", text, re.S)
    source = f"import jaxlag as jl\njl.keep_compiled()\n{example}"
    return FIRST.format(imports="import contextlib, io", actions=f"source = {source!r}\n{RUN_QUIETLY}")


RUN_QUIETLY = """
def action():
    with contextlib.redirect_stdout(io.StringIO()):
        exec(source, {})
"""


def fresh(code, cache):
    """What one new process reports, with this folder for compiled programs."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")} | {"XDG_CACHE_HOME": cache}
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    return json.loads(run.stdout.splitlines()[-1])


def vehicle(processes):
    """Tables of the vehicle."""
    runs = {name: [] for name in VEHICLE}
    for _ in range(processes):
        for name, code in VEHICLE.items():
            with tempfile.TemporaryDirectory() as cache:
                runs[name].append(fresh(code, cache))
    for task in runs["jaxlag"][0]:
        yield f"vehicle: {task}", table({name: [run[task] for run in of_name] for name, of_name in runs.items()})


def models(processes):
    """Tables of models that change their modes."""
    for name, model in MODELS.items():
        code = TIMED.format(imports="import jaxlag as jl", actions=model + OF_MODEL)
        runs = []
        for _ in range(processes):
            with tempfile.TemporaryDirectory() as cache:
                runs.append(fresh(code, cache))
        yield name, table({task: [run[task] for run in runs] for task in runs[0] if "fit" not in task})


def called(processes):
    """Table of the vehicle's motion when everything is compiled: what Python adds to it, and one acceleration."""
    with tempfile.TemporaryDirectory() as cache:
        runs = [fresh(CALLED, cache) for _ in range(processes)]
    yield "vehicle: compiled, and called from Python", table({name: [run[name] for run in runs] for name in runs[0]})


def pendulum(processes):
    """Tables of the pendulum, with the peak memory of each process."""
    for task in ACTIONS:
        runs = {name: [] for name in codes_of(task)}
        for _ in range(processes):
            for name, code in codes_of(task).items():
                with tempfile.TemporaryDirectory() as cache:
                    runs[name].append(fresh(code, cache))
        rows = table({name: [run["seconds"] for run in of_name] for name, of_name in runs.items()})
        for row in rows:
            row.note = f"{statistics.median(run['peak'] for run in runs[row.name]) / 1e6:.2f} GB"
        yield task, rows


def example(processes):
    """Table of README's first example with `keep_compiled`: in a first process, and in a second one with what the first has kept."""
    taken = {"first process": [], "second process": []}
    for _ in range(processes):
        with tempfile.TemporaryDirectory() as cache:
            for name in taken:
                taken[name].append(fresh(readme(), cache)["seconds"])
    yield "README's first example", table(taken)


def table(taken):
    """Medians and their ratios."""
    rows = [Row(name, seconds=statistics.median(seconds)) for name, seconds in taken.items()]
    for row in rows:
        row.ratio = row.seconds / rows[0].seconds
    return rows


def main(processes=5):
    for tables in (example, pendulum, vehicle, models, called):
        record("first use", tables(processes))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
