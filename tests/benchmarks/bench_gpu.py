"""A GPU beside the CPU of the same machine: batches of motions and their derivatives, in a process for each.

First calls compile; the difference is the largest between the results of both, in parts of the largest number. Without a GPU it says so
and ends. Run: python tests/benchmarks/bench_gpu.py [tasks]
"""

import functools
import os
import pathlib
import subprocess
import sys
import tempfile
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np


class Task(NamedTuple):
    """Motions of many systems, from a vector of as many numbers."""

    of: Callable[[Any], Any]
    members: int


def tasks() -> dict[str, Task]:
    """All of them, by name; JAX is imported here, with the backend that the environment names."""
    import jax
    import jax.numpy as jnp

    import jaxlag as jl
    from jaxlag.examples import vehicle

    jax.config.update("jax_enable_x64", True)
    ts = np.linspace(0.0, 5.0, 51)
    slider = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, dissipation=lambda qdot, F: F * jnp.abs(qdot))
    ball = jl.System(lambda q, qdot, g: 0.5 * qdot**2 - g * q, unilateral={"floor": jl.Contact(lambda q: q, restitution=0.8)})
    rod = jl.System(
        lambda q, qdot, g: 0.5 * qdot @ qdot - g * q[1],
        holonomic={"rod": lambda q, l: q @ q - l**2},
        dissipation=lambda qdot, b: 0.5 * b * qdot @ qdot,
    )
    ride = lambda k: jl.simulate(vehicle.system, vehicle.q0, vehicle.qdot0, ts, vehicle.params | {"k": k * vehicle.params["k"]}).q
    swing = lambda l: jl.simulate(rod, l * jnp.array([0.6, -0.8]), jnp.zeros(2), ts, {"g": 9.81, "l": l, "b": 0.1}).q
    stick = lambda F: jl.simulate(slider, 1.0, 0.0, ts, {"c": 10.0, "F": F}).q
    bounce = lambda g: jl.simulate(ball, 1.0, 0.0, ts, {"g": 9.81 * g}).q
    total = lambda motion, x: jnp.sum(jax.flatten_util.ravel_pytree(motion(x))[0] ** 2)
    return {
        "vehicle": Task(ride, 16384),
        "pendulum on a rod": Task(swing, 16384),
        "its gradient": Task(jax.grad(functools.partial(total, swing)), 4096),
        "dry friction": Task(stick, 16384),
        "bouncing ball": Task(bounce, 16384),
        "derivative of dry friction": Task(jax.jacfwd(stick), 4096),
    }


def measure(folder: str, names: list[str]) -> None:
    """Times each task in this process, and keeps the results in a folder."""
    import jax
    from timing import medians, once

    device = jax.devices()[0]
    print(f"{device.platform}: {device.device_kind}, jax {jax.__version__}", flush=True)
    for name, (of, members) in tasks().items():
        if names and name not in names:
            continue
        many = jax.jit(jax.vmap(of))
        given = 0.5 + np.random.default_rng(0).random(members)
        run = functools.partial(many, given)
        first = once(run)
        np.save(f"{folder}/{name} {device.platform}.npy", jax.flatten_util.ravel_pytree(run())[0])
        seconds = medians({"": run}, rounds=3)[""]
        print(f"  {name:28} {members:6} members: first call {first:7.1f} s, then {1e3 * seconds:9.1f} ms", flush=True)


def main() -> None:
    """A process for the GPU, one for the CPU, and the differences."""
    names, here = sys.argv[1:], pathlib.Path(__file__)
    with tempfile.TemporaryDirectory() as folder:
        for platform in ("cuda", "cpu"):
            script = f"import sys; sys.path.insert(0, {str(here.parent)!r}); import bench_gpu; bench_gpu.measure({folder!r}, {names!r})"
            done = subprocess.run([sys.executable, "-c", script], env=os.environ | {"JAX_PLATFORMS": platform}, check=False)
            if done.returncode and platform == "cuda":
                raise SystemExit("no GPU that JAX can use")
        for by_gpu in sorted(pathlib.Path(folder).glob("* gpu.npy")):
            name = by_gpu.name.removesuffix(" gpu.npy")
            one, other = np.load(by_gpu), np.load(by_gpu.with_name(f"{name} cpu.npy"))
            print(f"  {name:28} differs by {np.max(np.abs(one - other)) / np.max(np.abs(other)):.1e}")


if __name__ == "__main__":
    main()
