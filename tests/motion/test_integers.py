"""Integers among the params are exact, whatever the precision of the motion."""

import jax
import numpy as np
import pytest

import jaxlag as jl

digit = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda n: (n % 10) / 2, states={"z": jl.Sampled(lambda z: z, every=0.25)})
noise = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda key: jax.random.normal(key), states={"z": jl.Sampled(lambda z: z, every=0.25)})


@pytest.mark.parametrize("kind, n", [(np.int32, 2**24 + 1), (np.int32, -(2**24) - 1), (np.uint32, 2**32 - 1)])
def test_integers_in_single_precision(kind, n):
    """q = Q/2 after a second."""
    motion = jl.simulate(digit, np.float32(0), np.float32(0), np.array([0, 1], np.float32), {"n": kind(n)})
    np.testing.assert_allclose(motion.q[-1], n % 10 / 4, rtol=1e-5)


def test_raw_keys_of_random_numbers():
    key = np.array([2**31 + 1, 2**32 - 3], np.uint32)
    motion = jl.simulate(noise, np.float32(0), np.float32(0), np.array([0, 1], np.float32), {"key": key})
    np.testing.assert_allclose(motion.q[-1], jax.random.normal(jax.numpy.asarray(key)) / 2, rtol=1e-5)
