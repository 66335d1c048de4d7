"""Motions of many lengths share a few programs, and are what each would be by itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._motion.padding import padded_size

CART = jl.System(lambda qdot: 0.5 * qdot**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2, force=lambda t, u: u(t))


def recording(length, interpolation):
    ts = np.linspace(0.0, 2.0, length)
    return ts, jl.Signal(ts[:-3], np.sin(3 * ts[:-3]), interpolation)  # the input ends before the motion does


def motion(length, interpolation, b=0.3, **options):
    ts, u = recording(length, interpolation)
    return jl.simulate(CART, 0.0, 1.0, ts, {"b": b, "u": u}, **options)


def test_sizes():
    sizes = np.array([padded_size(n) for n in range(2, 5000)])
    assert np.all(sizes >= np.arange(2, 5000)) and np.all(sizes[16:] <= 9 / 8 * np.arange(18, 5000)) and np.all(np.diff(sizes) >= 0)
    assert len(set(sizes[400 - 2 : 801 - 2])) <= 10
    np.testing.assert_array_equal(sizes[:15], np.arange(2, 17))


@pytest.mark.slow
@pytest.mark.parametrize("interpolation", [jl.interpolation.ZeroOrderHold(), jl.interpolation.Linear(), jl.interpolation.Cubic()])
def test_a_motion_is_that_without_padding(interpolation):
    """Compared with the program that is compiled for its own length within `jit`, in all that a motion shows."""
    over_knots = isinstance(interpolation, jl.interpolation.Cubic)  # u‴ jumps within steps, whose error rounding moves
    exactly = 1e-11 if over_knots else 1e-12
    padded = motion(37, interpolation, works=True)
    plain = jax.jit(lambda b: motion(37, interpolation, b, works=True))(0.3)
    assert len(padded) == 37 and padded.provenance.params["u"].ts.shape == (34,)
    assert jax.tree.structure(padded) == jax.tree.structure(plain)
    for found, expected in zip(jax.tree.leaves(padded), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(found, expected, rtol=exactly, atol=exactly)
    np.testing.assert_allclose(padded.at(1.234).q, plain.at(1.234).q, rtol=exactly)
    np.testing.assert_allclose(padded.balance(), 0, atol=3e-7 if over_knots else 1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("derivative, tolerance", [(jax.grad, 1e-8), (jax.jacfwd, 1e-8), (jax.hessian, 1e-12)])
def test_its_derivatives_are_those_without_padding(derivative, tolerance):
    """The second at a tolerance for which the kinks of the input do not show."""
    work = lambda b: jnp.sum(motion(37, jl.interpolation.Linear(), b, rtol=tolerance).qddot ** 2)
    np.testing.assert_allclose(derivative(work)(0.3), jax.jit(derivative(work))(0.3), rtol=1e-8)


@pytest.mark.slow
def test_many_lengths_compile_few_programs(lowered):
    """The motions of a loop over recordings; what cuts them to length is compiled for each, in hundredths of a second."""
    ends = [float(motion(length, jl.interpolation.Linear()).q[-1]) for length in range(101, 129)]
    sizes = {(padded_size(length), padded_size(length - 3)) for length in range(101, 129)}  # of the samples, and of the input
    assert 1 <= sum(count for name, count in lowered.items() if "_trajectory" in str(name)) <= len(sizes) <= 8
    np.testing.assert_allclose(ends, ends[0], rtol=1e-2)
