"""Whether a state is on its constraints, and whether these can be solved, does not change with units."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._program.size_of_terms import size_of_terms

UNITS = [[1.0, 1.0], [1e9, 1e-9], [1e-9, 1e9], [1e-9, 1e-9], [1e9, 1e9]]


@pytest.mark.parametrize("length", [1.0, 1e-9, 1e9])
def test_terms_that_cancel(length):
    """Of y − l (1 − cos φ), of q·q − l², and of sums of counted parts: between one and a few times the largest."""
    functions = lambda q: jnp.stack([q[0] - length * (1 - jnp.cos(q[1])), q @ q - length**2, jnp.sum(q) - 3 * length])
    size = size_of_terms(functions, jnp.zeros(2))
    for found, largest in zip(size, [length, length**2, 3 * length], strict=True):
        assert 0.1 * largest < found < 10 * largest
    through_a_call = size_of_terms(jax.jit(lambda q: q[:1] * jnp.arange(1, 2) - length), jnp.full(2, length))
    assert 0.01 * length < through_a_call[0] < 10 * length
    np.testing.assert_array_equal(size_of_terms(lambda q: 2 * q, jnp.ones(3)), 0)


BENT = jl.System(
    lambda qdot, s: 0.5 * (qdot / s) @ (qdot / s),
    nonholonomic=lambda qdot, s, b: (1 - b) * (qdot[0] / s[0]) ** 2 + b * qdot[0] / s[0] - 0.7 * qdot[1] / s[1],
)


@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("speed", [0.7, 0.0])
def test_what_is_not_affine_is_seen(units, speed):
    """From rest too, where no velocity tells its unit; b = 1 makes it affine."""
    s, qdot = np.array(units), speed * np.array([1.0, speed])
    with pytest.raises(ValueError, match=r"affine in the velocity of: 'q\[0\]'"):
        jl.consistent_state(BENT, np.zeros(2), s * qdot, {"s": s, "b": 0.0})
    _, found = jl.consistent_state(BENT, np.zeros(2), s * qdot, {"s": s, "b": 1.0})
    x, y = found / s
    np.testing.assert_allclose(x, 0.7 * y, atol=1e-14)


DRIVES = {"one": lambda t, q, s: q - s * jnp.sin(t), "other": lambda t, q, s: q - 1.001 * s * jnp.sin(t)}


@pytest.mark.parametrize("length", [1.0, 1e-9, 1e9])
def test_what_contradicts_itself_is_seen(length):
    """Two drives of one coordinate that differ by a thousandth part."""
    system = jl.System(lambda qdot, s: 0.5 * (qdot / s) ** 2, holonomic=DRIVES)
    with pytest.raises(ValueError, match="none was found"):
        jl.consistent_state(system, 0.5 * length, 0.9 * length, {"s": length}, t=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("n", [3, 80])
def test_a_row_is_held_in_any_unit_or_refused(n):
    """q₁ = q₂ = … under forces 1, 2, …: all move with their mean. A row 1e-16 of others had no effect, without a word."""

    def links(q, unit):
        return jnp.diff(q).at[1].multiply(unit)

    chain = jl.System(lambda q, qdot: 0.5 * qdot @ qdot + q @ jnp.arange(1.0, n + 1), holonomic={"links": links})
    at = lambda unit: jl.acceleration(chain, jnp.zeros(n), jnp.zeros(n), {"unit": unit}).qddot
    for unit in (1e-14, 1e-9, 1e9, 1e14):
        np.testing.assert_allclose(at(unit), (n + 1) / 2, rtol=1e-9)
    off = lambda unit: jl.consistent_state(chain, jnp.zeros(n), jnp.arange(1.0, n + 1), {"unit": unit})[1]
    for unit in (1e-14, 1e14):
        np.testing.assert_allclose(off(unit), (n + 1) / 2, rtol=1e-9)
    for unit in (1e-18, 1e18):
        for question in (at, off):
            with pytest.raises(ValueError, match="lost in the rounding of another"):
                question(unit)


@pytest.mark.parametrize("length", [1.0, 1e-9, 1e9])
def test_what_is_held_altogether_rests(length):
    """(3, 4) on a circle and on a line: both velocities are none, and what is left of them is rounding."""
    held = jl.System(
        lambda qdot: 0.5 * qdot @ qdot, holonomic={"circle": lambda q, s: q @ q - 25 * s**2, "line": lambda q: 4 * q[0] - 3 * q[1]}
    )
    q, qdot = jl.consistent_state(held, length * np.array([3.1, 3.8]), length * np.array([1.0, -2.0]), {"s": length})
    np.testing.assert_allclose(q / length, [3.0, 4.0], rtol=1e-12)
    np.testing.assert_allclose(qdot / length, 0, atol=1e-12)


@pytest.mark.parametrize("length", [1.0, 1e-9, 1e9])
def test_a_state_far_from_what_is_stated_twice(length):
    """A circle by two equations, whose rows there differ as if they held both coordinates."""
    circle = lambda q, s: (q @ q) / s**2 - 25
    again = lambda q, s: circle(q, s) * (2 + jnp.cos(q[0] / s))
    stated = jl.System(lambda qdot: 0.5 * qdot @ qdot, holonomic={"circle": circle, "again": again})
    q, qdot = jl.consistent_state(stated, length * np.array([4.5, 6.0]), length * np.array([1.0, 0.0]), {"s": length})
    np.testing.assert_allclose(q / length, [3.0, 4.0], rtol=1e-12)
    np.testing.assert_allclose(qdot / length, [0.64, -0.48], rtol=1e-12)
