"""Tests run in double precision, with strict ranks and every shape annotation checked."""

import jax
import pytest
from jaxtyping import install_import_hook

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
