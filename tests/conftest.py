"""Tests run in double precision, with strict ranks and every shape annotation checked.

They are compiled as README advises for a CPU, in two thirds of the time; `program/test_jit` compares with the compiler's default.
"""

import os

import jax
import jaxlib
import pytest
from jaxtyping import install_import_hook

if tuple(map(int, jaxlib.__version__.split(".")[:2])) <= (0, 10):  # a flag that XLA does not know ends the process
    os.environ["XLA_FLAGS"] = f"--xla_cpu_use_fusion_emitters=false {os.environ.get('XLA_FLAGS', '')}"

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

with install_import_hook("jaxlag", "beartype.beartype"):
    import jaxlag  # noqa: F401


@pytest.fixture(autouse=True, scope="module")
def fresh_caches():
    """Lets go of what a file has compiled: each program holds memory maps, of which a process may have some 65 000 only."""
    yield
    jax.clear_caches()


@pytest.fixture
def single_precision():
    jax.config.update("jax_enable_x64", False)
    yield
    jax.config.update("jax_enable_x64", True)
