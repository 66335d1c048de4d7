"""Programs in a loop of one iteration: the same values and derivatives, and only where it pays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._program import single_kernel
from jaxlag._program.single_kernel import in_one_kernel

TS = jnp.linspace(0.0, 1.0, 11)


def long(t, y, args):
    """Some 600 operations on a few numbers."""
    for i in range(200):
        y = y + 1e-3 * jnp.sin(y + args[0] * i)
    return y * t


def loops(function, *given):
    return "while" in str(jax.make_jaxpr(function)(*given))


GIVEN = jnp.array(0.5), jnp.arange(4.0), (jnp.array(0.3), None)


def test_same_values_and_forward_derivatives():
    directions = jnp.array(1.0), jnp.array([1.0, -1.0, 2.0, 0.0])
    of = lambda f: jax.jvp(lambda t, y: f(t, y, GIVEN[2]), GIVEN[:2], directions)
    for found, expected in zip(of(jax.jit(in_one_kernel(long))), of(long), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-14)


def test_members_of_a_batch():
    ys = jnp.arange(12.0).reshape(3, 4)
    each = lambda f: jax.vmap(lambda t, y: f(t, y, GIVEN[2]))(jnp.arange(3.0), ys)
    np.testing.assert_allclose(each(in_one_kernel(long)), each(long), rtol=1e-14)


def test_nan_gives_nan_and_the_loop_ends():
    assert jnp.isnan(in_one_kernel(long)(jnp.array(jnp.nan), *GIVEN[1:])).all()


@pytest.mark.parametrize(
    "function, y, is_looped",
    [
        (long, jnp.arange(4.0), True),
        (lambda t, y, args: t * y, jnp.arange(4.0), False),
        (lambda t, y, args: t * y, jnp.arange(16.0), True),
        (long, jnp.arange(200.0), False),
    ],
    ids=["long", "short", "many rows", "too many numbers"],
)
def test_only_programs_that_gain_are_looped(function, y, is_looped):
    assert loops(in_one_kernel(function), GIVEN[0], y, GIVEN[2]) == is_looped


def test_nothing_changes_on_a_gpu(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert not loops(in_one_kernel(long), *GIVEN)


def links(n):
    """A pendulum of n links of 1 m and 1 kg, with damping in the joints."""

    def lagrangian(q, qdot):
        vx, vy = jnp.cumsum(jnp.cos(q) * qdot), jnp.cumsum(jnp.sin(q) * qdot)
        return 0.5 * jnp.sum(vx**2 + vy**2) + 9.81 * jnp.sum(jnp.cumsum(jnp.cos(q)))

    return jl.System(lagrangian, dissipation=lambda qdot, b: 0.5 * b * qdot @ qdot)


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 5])
def test_a_motion_and_its_derivatives_are_those_without_loops(monkeypatch, n):
    """Forward and reverse; the gradient of two links and the motion of five are among the looped programs."""
    motion = lambda b: jl.simulate(links(n), jnp.linspace(0.3, 0.8, n), jnp.zeros(n), TS, {"b": b}).q
    results = []
    for shortest in (single_kernel.MIN_OPERATIONS, 10**9):
        monkeypatch.setattr(single_kernel, "MIN_OPERATIONS", shortest)
        jax.clear_caches()
        program = jax.jit(lambda b: (motion(b), jax.jacfwd(motion)(b), jax.jacrev(lambda b: motion(b)[-1])(b)))
        results.append((program.lower(0.1).as_text().count("stablehlo.while"), program(0.1)))
    (looped, with_loops), (plain, without) = results
    assert looped > plain
    for found, expected in zip(with_loops, without, strict=True):  # rounding a start of five links otherwise changes up to 2e-9 of it
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-10 * np.abs(expected).max())
