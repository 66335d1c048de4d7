"""Samples that a motion does not reach: a loss that counts them has no finite gradient, one that leaves them out has the right one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

TS = jnp.linspace(0, 5, 6)
oscillator = jl.System(lambda q, qdot, k: 0.5 * qdot**2 - 0.5 * k * q**2)
stopped = jl.System(lambda q, qdot, k: 0.5 * qdot**2 - 0.5 * k * q**2, events={"through": jl.Event(lambda q: q, stop=True)})


def one(k):
    """Ten steps take it past 4 s."""
    return jl.simulate(oscillator, 1.0, 0.0, TS, {"k": k}, max_steps=10, throw=False).q


def two(k):
    """With common steps, of which there are too few."""
    return jl.simulate_many(oscillator, jnp.array([1.0, 2.0]), 0.0, TS, {"k": k}, over=("q0",), max_steps=10, throw=False).q


def until_it_passes(k):
    """It ends there, and nothing is behind."""
    return jl.simulate(stopped, 1.0, 0.0, TS, {"k": k}, rtol=1e-10, atol=1e-10).q


@pytest.mark.slow
@pytest.mark.parametrize("motion", [one, two, until_it_passes])
def test_gradients_of_what_is_not_reached(motion):
    """Neither zero, which would say that nothing can be won, nor in the way of what is known."""
    k, h = 0.6, 1e-4

    def of_those_there(k):
        q = motion(k)
        return jnp.sum(jnp.where(jnp.isfinite(q), q, 0))

    of_all = lambda k: jnp.sum(motion(k))
    assert np.isnan(of_all(k)) and not np.isnan(of_those_there(k))
    for derivative in (jax.grad, jax.jacfwd):
        assert not np.isfinite(jax.jit(derivative(of_all))(k))
        difference = (of_those_there(k + h) - of_those_there(k - h)) / (2 * h)
        np.testing.assert_allclose(jax.jit(derivative(of_those_there))(k), difference, rtol=1e-5)


@pytest.mark.slow
def test_a_gradient_called_from_python_says_why():
    """As the motion itself does."""
    through = lambda k: jl.simulate(oscillator, 1.0, 0.0, TS, {"k": k}, max_steps=8).q[-1]
    with pytest.raises(RuntimeError, match="the motion must reach t = 5"):
        jax.grad(through)(0.6)


@pytest.mark.slow
def test_a_drag_that_has_no_derivative_at_rest():
    """|v|³ as (v²)^1.5: its second derivative at rest is 0/0 to JAX, its motion is not."""
    drag = jl.System(lambda q, qdot, k: 0.5 * qdot @ qdot - 0.5 * k * q @ q, dissipation={"drag": lambda qdot: 0.05 * (qdot @ qdot) ** 1.5})
    end = lambda k: jl.simulate(drag, jnp.ones(2), jnp.zeros(2), TS[:2], {"k": k}, throw=False).q[-1, 0]
    assert np.isfinite(end(4.0)) and not np.isfinite(jax.jit(jax.grad(end))(4.0))
