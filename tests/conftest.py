"""Tests run in double precision, without implicit broadcasting of ranks, and with every shape annotation checked.

They are compiled with the flag that README recommends for a CPU, in two thirds of the time; `program/test_jit` compares with the default.
"""

import os

import jax
import jaxlib
import pytest
from jaxtyping import install_import_hook

if tuple(map(int, jaxlib.__version__.split(".")[:2])) <= (0, 10):  # an unknown flag would end the process
    os.environ["XLA_FLAGS"] = f"--xla_cpu_use_fusion_emitters=false {os.environ.get('XLA_FLAGS', '')}"

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

with install_import_hook("jaxlag", "beartype.beartype"):
    import jaxlag  # noqa: F401


@pytest.fixture(autouse=True, scope="module")
def fresh_caches():
    """Releases what a file has compiled: each program holds memory maps, of which a process may have only some 65 000."""
    yield
    jax.clear_caches()


@pytest.fixture
def single_precision():
    jax.config.update("jax_enable_x64", False)
    yield
    jax.config.update("jax_enable_x64", True)
