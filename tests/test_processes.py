"""The same calls in two processes of two devices each, joined by JAX's own engine on the loopback address, and in one process."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import oscillator as osc
import pytest

import jaxlag as jl

pytestmark = pytest.mark.slow  # three processes compile motions and fits: 40 s of CPU
LONGEST = 240.0  # s, then both processes are ended
STIFFNESS = np.linspace(1.0, 4.0, 10)  # padded to twelve on four devices
JOIN = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_cpu_collectives_implementation", "gloo")
jax.distributed.initialize(f"127.0.0.1:{sys.argv[2]}", num_processes=2, process_id=int(sys.argv[1]), initialization_timeout=60)
import json
import numpy as np
import test_processes
assert jax.device_count() == 4 and jax.local_device_count() == 2
print(json.dumps([test_processes.computed(), test_processes.refused()]))
"""


def positions(stiffness):
    """Of undamped oscillators after 3 s."""
    motions = jl.simulate_many(osc.SYSTEM, 1.0, 0.0, np.linspace(0.0, 3.0, 4), osc.TRUE | {"b": 0.0, "c": stiffness}, over=("c",))
    return motions.q[:, -1]


def computed():
    """Motions, their derivatives, a fit over seven recordings, and seven fits: as lists of numbers."""
    records = [osc.record(seed, osc.TIMES[: 60 - seed], unknown=("qdot0",)) for seed in range(7)]
    found = jl.fit(osc.SYSTEM, records, osc.START, free=("c", "b"))
    each = jl.fit_each(osc.SYSTEM, records, osc.START, free=("c", "b"))
    return {
        "positions": np.asarray(positions(STIFFNESS)).tolist(),
        "gradient": np.asarray(jax.grad(lambda c: jnp.sum(positions(c)))(jnp.asarray(STIFFNESS))).tolist(),
        "fit": [*map(float, found.estimates.values()), *map(float, found.standard_errors.values())],
        "starts": [float(unknown["qdot0"]) for unknown in found.unknowns],
        "each": [float(one.estimates["c"]) for one in each],
    }


def refused():
    """What is said where processes are given different numbers."""
    try:
        positions(STIFFNESS + jax.process_index())
    except ValueError as error:
        return str(error)


def in_two_processes():
    """What each of them prints; both are ended where they take too long, or one of them fails."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "PYTHONPATH": _path()}
    both = [_started([sys.executable, "-c", JOIN, str(number), port], environment) for number in range(2)]
    try:
        printed = [process.communicate(timeout=LONGEST) for process in both]
    finally:
        for process in both:
            process.kill()
    assert [process.returncode for process in both] == [0, 0], [errors[-1000:] for _, errors in printed]
    return [json.loads(out.splitlines()[-1]) for out, _ in printed]


def _started(command, environment):
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, env=environment, cwd=Path(__file__).parent.parent, **pipes)


def _path():
    return os.pathsep.join([str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])])


def test_two_processes_compute_what_one_does():
    """Each process has the whole result; x(3) = cos(3 √c), and its derivative −3 sin(3 √c)/(2 √c)."""
    (first, said), (second, said_too) = in_two_processes()
    assert first == second
    assert said == said_too
    assert said.startswith("`params` must be the same in every process, but differs.")
    w = np.sqrt(STIFFNESS)
    np.testing.assert_allclose(first["positions"], np.cos(3 * w), atol=1e-6)
    np.testing.assert_allclose(first["gradient"], -3 * np.sin(3 * w) / (2 * w), atol=1e-5)
    alone = computed()
    for name in ("fit", "starts", "each"):
        np.testing.assert_allclose(first[name], alone[name], rtol=1e-6, atol=1e-9, err_msg=name)
