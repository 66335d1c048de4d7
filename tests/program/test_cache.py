"""JAX's persistent cache: a second process compiles nothing that the first one did. A program with a callback would not be cached."""

import os
import subprocess
import sys

CODE = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import jaxlag as jl
counts = {}
jax.monitoring.register_event_listener(lambda event, **_: counts.update({event: counts.get(event, 0) + 1}))

def lagrangian(q, qdot, c):
    return 0.5 * qdot**2 - 0.5 * c * q**2

def end(c):
    return jl.simulate(jl.System(lagrangian), 1.0, 0.0, jnp.linspace(0, 1, 5), {"c": c}).q[-1]

print(end(4.0), jax.jit(jax.grad(end))(4.0))
print(*(counts.get(f"/jax/compilation_cache/cache_{kind}", 0) for kind in ("hits", "misses")))
"""


def test_a_second_process_compiles_nothing(tmp_path):
    everything = {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0", "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1"}
    environment = os.environ | everything | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
    runs = [subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, env=environment) for _ in range(2)]
    assert all(run.returncode == 0 for run in runs), runs[-1].stderr[-2000:]
    (values, counts), (values_again, counts_again) = (run.stdout.splitlines() for run in runs)
    hits, misses = map(int, counts_again.split())
    assert values == values_again and int(counts.split()[1]) > 0
    assert misses == 0 and hits > 0
