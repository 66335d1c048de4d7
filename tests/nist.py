"""NIST's reference problems of nonlinear regression, as formulas of x and parameters, and as what a sensor sees of a body at rest.

Data, certified values and starts: nist_strd.json (NIST/ITL StRD, in the public domain).
"""

import functools
import json
import pathlib

import jax.numpy as jnp
import numpy as np

import jaxlag as jl

PROBLEMS = json.loads((pathlib.Path(__file__).parent / "data" / "nist_strd.json").read_text())["problems"]
MODELS = {
    "Misra1a": lambda x, b1, b2: b1 * (1 - jnp.exp(-b2 * x)),
    "Misra1b": lambda x, b1, b2: b1 * (1 - (1 + b2 * x / 2) ** -2),
    "Misra1c": lambda x, b1, b2: b1 * (1 - (1 + 2 * b2 * x) ** -0.5),
    "Misra1d": lambda x, b1, b2: b1 * b2 * x / (1 + b2 * x),
    "Lanczos1": lambda x, b1, b2, b3, b4, b5, b6: b1 * jnp.exp(-b2 * x) + b3 * jnp.exp(-b4 * x) + b5 * jnp.exp(-b6 * x),
    "BoxBOD": lambda x, b1, b2: b1 * (1 - jnp.exp(-b2 * x)),
    "MGH09": lambda x, b1, b2, b3, b4: b1 * (x**2 + x * b2) / (x**2 + x * b3 + b4),
    "MGH17": lambda x, b1, b2, b3, b4, b5: b1 + b2 * jnp.exp(-x * b4) + b3 * jnp.exp(-x * b5),
    "Bennett5": lambda x, b1, b2, b3: b1 * (b2 + x) ** (-1 / b3),
    "Rat42": lambda x, b1, b2, b3: b1 / (1 + jnp.exp(b2 - b3 * x)),
    "Rat43": lambda x, b1, b2, b3, b4: b1 / (1 + jnp.exp(b2 - b3 * x)) ** (1 / b4),
    "Thurber": lambda x, b1, b2, b3, b4, b5, b6, b7: (b1 + b2 * x + b3 * x**2 + b4 * x**3) / (1 + b5 * x + b6 * x**2 + b7 * x**3),
    "Eckerle4": lambda x, b1, b2, b3: b1 / b2 * jnp.exp(-((x - b3) ** 2) / b2**2 / 2),
}
MODELS["Lanczos3"] = MODELS["Lanczos1"]
STATE = jl.System(lambda qdot: 0.5 * qdot**2)


@functools.cache  # so that it is compiled once
def sensor(name):
    """What is seen at the times 0, 1, 2, …: the formula at x, as a function that asks for its parameters by name."""
    names, scope = parameters(name), {"model": MODELS[name], "jnp": jnp}
    exec(f"def observe(t, x, {', '.join(names)}): return model(x[jnp.round(t).astype(int)], {', '.join(names)})", scope)
    return scope["observe"]


def parameters(name):
    """b1, b2, …"""
    return tuple(f"b{i + 1}" for i in range(len(PROBLEMS[name]["certified"])))


def fitted(name, number, **how):
    """The fit from the start of this number, 0 or 1."""
    problem, names = PROBLEMS[name], parameters(name)
    record = jl.Experiment(np.arange(len(problem["x"])) * 1.0, problem["y"], 0.0, 0.0, observe=sensor(name))
    params = {"x": np.array(problem["x"])} | dict(zip(names, problem["starts"][number], strict=True))
    return jl.fit(STATE, record, params, free=names, tolerance=1e-6, **how)
