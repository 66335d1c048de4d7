"""The same fit on one device and on eight, in processes of their own."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

FIT = """
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import pytest
import oscillator as osc
import jaxlag as jl
records = [osc.record(seed, osc.TIMES[: 60 - seed], unknown=("qdot0",)) for seed in range(11)]
found = jl.fit(osc.SYSTEM, records, osc.START, free=("c", "b"))
each = jl.fit_each(osc.SYSTEM, records, osc.START, free=("c", "b"))
times = found.problem.batches[0].ts  # on the host where there is one device
devices = len(times.sharding.device_set) if isinstance(times, jax.Array) else 1
values = [found.estimates["c"], found.estimates["b"], found.standard_errors["c"], *(u["qdot0"] for u in found.unknowns)]
print(devices, *map(repr, map(float, [*values, *(f.estimates["c"] for f in each)])))
"""


def fitted(devices):
    environment = os.environ | {"XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}", "PYTHONPATH": str(Path(__file__).parent)}
    run = subprocess.run([sys.executable, "-c", FIT], capture_output=True, text=True, env=environment, cwd=Path(__file__).parent.parent)
    assert run.returncode == 0, run.stderr[-2000:]
    used, *values = map(float, run.stdout.split())
    assert used == devices
    return values


@pytest.mark.slow
def test_a_fit_on_eight_devices_is_the_fit_on_one():
    """Eleven experiments of different lengths: the last devices have nothing of their own."""
    np.testing.assert_allclose(fitted(8), fitted(1), rtol=1e-6, atol=1e-9)
