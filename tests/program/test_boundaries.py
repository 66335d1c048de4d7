"""Functions that pass through zero where a program jumps or bends."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlag._program.boundaries import boundaries

PLACES = np.array([0.0, 0.25, 0.5, 1.0])


def found(function, q, v=0.3):
    counts = lambda marks, bends: "q" in marks and "v" not in marks
    return boundaries(function, counts, (jnp.asarray(q), "q"), (jnp.asarray(v), "v"))


@jax.jit
def remainder(q, place):
    """One of a user's own that has the name of one of NumPy."""
    return jnp.maximum(q - place, 0.0)


@jax.jit
def searchsorted(q, place):
    return jnp.minimum(q, place)


@jax.jit
def hypot(q, place):
    return jnp.minimum(q, place)


CASES = {  # the zeros of what was found, in [-2.2, 2.2]
    "where": (lambda q, v: jnp.where(q > 0.2, v, 2 * v), [0.2]),
    "once": (lambda q, v: jnp.maximum(q - 0.2, 0) + jnp.where(q <= 0.2, v, 0) + jax.nn.relu(q - 0.2) + jnp.minimum(0.2, q), [0.2]),
    "cond": (lambda q, v: jax.lax.cond(q > -1, jnp.sin, jnp.cos, v), [-1]),
    "clip": (lambda q, v: jnp.clip(q, -1.0, 0.8), [-1, 0.8]),
    "modulus": (lambda q, v: jnp.abs(q - 0.3) + jnp.sign(q + 0.3), [-0.3, 0.3]),
    "floor": (lambda q, v: jnp.floor(q), [-2, -1, 0, 1, 2]),
    "round": (lambda q, v: jnp.round(q), [-1.5, -0.5, 0.5, 1.5]),
    "remainder": (lambda q, v: jnp.mod(q, 0.7), [-2.1, -1.4, -0.7, 0, 0.7, 1.4, 2.1]),
    "division": (lambda q, v: q // 0.7, [-2.1, -1.4, -0.7, 0, 0.7, 1.4, 2.1]),
    "index": (lambda q, v: jnp.asarray(PLACES)[(3 * q).astype(int)], np.arange(-6, 7) / 3),
    "table": (lambda q, v: jnp.interp(q, PLACES, PLACES**2), [0, 0.25, 0.5, 1, 0, 1]),
    "of arrays": (lambda q, v: jnp.sum(jnp.maximum(q - jnp.asarray(PLACES), 0)), PLACES),
    "of logic": (lambda q, v: jnp.where((q > 1) | ~(q > -1), v, 0), [-1, 1]),
    "smooth": (lambda q, v: jnp.hypot(q, v) + jax.nn.softplus(q) + jnp.where(q == 0, 0, q) + jnp.sinc(q), []),
    "of the same names": (lambda q, v: remainder(q, 0.3) + hypot(q, 0.7) + searchsorted(q, 1.3), [0.3, 0.7, 1.3]),
    "of a slope": (lambda q, v: jax.linearize(lambda q: jnp.fmod(q, 0.7) * q, q)[1](v), [-2.1, -1.4, -0.7, 0, 0.7, 1.4, 2.1]),
    "by others": (lambda q, v: jnp.maximum(q, v) + jnp.where(v > 0, q, 0), []),
}


@pytest.mark.parametrize("function, zeros", CASES.values(), ids=CASES)
def test_what_is_found_changes_its_sign_there_alone(function, zeros):
    q = np.linspace(-2.2, 2.2, 4401) + 3.3e-4
    values = np.array(jax.jit(jax.vmap(lambda q: found(function, q).values))(q))
    changes = [q[:-1][np.diff(np.sign(column)) != 0] for column in values.T]
    there = np.concatenate([*changes, np.zeros(0)])
    np.testing.assert_allclose(np.sort(there), np.sort(np.asarray(zeros, float)), atol=1.1e-3)


def test_it_is_differentiated():
    slopes = jax.jacfwd(lambda q: found(lambda q, v: jnp.interp(q, PLACES, PLACES) + jnp.maximum(q**2, 0.1), q).values)
    np.testing.assert_allclose(jnp.abs(slopes(0.25)), [1.0, 1.0, 1.0, 0.5])  # of a table ±1 at each place, and that at its ends


def test_what_jumps_itself_is_told_by_its_level():
    of = lambda q, v: jnp.where(jnp.mod(q, 0.7) < 0.3, jnp.maximum(q, 0), 0) + jnp.where(jnp.where(q > 0.1, q, -q) > 0.2, 1, 0)
    assert found(of, 0.5).levels == (0, 1, 0, 0, 1)


@pytest.mark.parametrize(
    "function",
    [
        lambda q, v: jnp.max(jnp.stack([q, 2 * q])),
        lambda q, v: jnp.sort(jnp.stack([q, 2 * q]))[1],
        lambda q, v: jax.lax.scan(lambda x, _: (jnp.maximum(x, q), None), 0.3, None, 3)[0],
        lambda q, v: jax.lax.scan(lambda x, _: (jnp.where(x > q, 2 * x, x), None), 0.3, None, 3)[0],
        lambda q, v: jax.lax.cond(q > 0, lambda: jnp.maximum(q, 0.3), lambda: q),
    ],
)
def test_what_is_not_known_is_told(function):
    (line,) = found(function, 0.5).unknown
    assert "test_boundaries.py" in line
