"""Where a private part of JAX is missing, results are the same."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._program import jit, whole_kernel

pytestmark = pytest.mark.fast

TS = np.linspace(0.0, 1.0, 11)


def motion(q0):
    """q = q₀ cos 2t, of a system made anew."""
    return jl.simulate(jl.System(lambda q, qdot: 0.5 * qdot**2 - 2.0 * q**2), q0, 0.0, TS).q


def test_without_a_way_to_write_programs_nothing_is_kept(compilation_cache, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "jax.experimental.serialize_executable", None)
    monkeypatch.delattr(jax.experimental, "serialize_executable", raising=False)  # where it was imported before
    jl.keep_compiled(tmp_path)
    np.testing.assert_allclose(motion(1.0), np.cos(2 * TS), atol=1e-7)
    assert not list(tmp_path.glob("jaxlag-*"))


def test_without_metadata_a_loop_runs_kernel_by_kernel(monkeypatch):
    monkeypatch.setattr(whole_kernel, "set_xla_metadata", None)
    np.testing.assert_allclose(motion(1.0), np.cos(2 * TS), atol=1e-7)


def test_without_the_members_of_a_batch_it_is_taken_as_unknown(monkeypatch):
    monkeypatch.setattr(jit, "_batch", lambda leaf: None)
    found = jax.vmap(motion)(jnp.array([1.0, 2.0]))
    np.testing.assert_allclose(found, np.outer([1.0, 2.0], np.cos(2 * TS)), atol=1e-7)
