"""What depends on what in programs of arrays, against the places where Jacobians at random points are not zero."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlag._program.expressions import TooLong
from jaxlag._program.sparsity import array_by_array as dependence

N = 12
FIRST, SECOND = np.array([0, 3, 3, 7, 11]), np.array([1, 5, 4, 2, 0])
DIFFERENCES = np.eye(N - 1, N, 1) - np.eye(N - 1, N)
WEIGHTS = jnp.asarray(np.random.default_rng(5).normal(size=(4, 3)))
EXACT = {  # whose every dependence is one at a random point
    "arithmetic": lambda x: jnp.sin(x) * x**2 + jnp.maximum(x, 0.3) / (2 + x),
    "neighbours": lambda x: jnp.diff(x) ** 2,
    "ring": lambda x: (x - jnp.roll(x, 1)) * jnp.roll(x, 2),
    "points": lambda x: jnp.sum(jnp.diff(x.reshape(4, 3), axis=0) ** 2, axis=1),
    "gathered": lambda x: jnp.sum((x.reshape(4, 3)[np.array([0, 2, 1])] - x.reshape(4, 3)[np.array([3, 3, 0])]) ** 2, axis=1),
    "single numbers": lambda x: jnp.stack([x[0] * x[3], x[2] + x[-1], 2 * x[5]]),
    "energy by its gradient": jax.grad(lambda x: jnp.sum((x[FIRST] - x[SECOND]) ** 4)),
    "gradient of slices": jax.grad(lambda x: jnp.sum(x[1:] ** 2 * x[:-1] ** 3) + jnp.prod(x[2:5])),
    "gradient of a reshaped array": jax.grad(lambda x: jnp.sum(jnp.cos(jnp.diff(x.reshape(3, 4), axis=1)) * x.reshape(3, 4)[:, :1])),
    "known matrix": lambda x: (DIFFERENCES @ x) ** 2,
    "blocks": lambda x: jnp.einsum("kij,kj->ki", jnp.ones((3, 2, 4)), x.reshape(3, 4)).ravel() * 2,
    "product of two": lambda x: (x[:4].reshape(2, 2) @ x[4:8].reshape(2, 2)).ravel(),
    "cumulative": lambda x: jnp.cumsum(x**2),
    "cumulative backwards": lambda x: jax.lax.cumsum(x.reshape(3, 4), axis=1, reverse=True).ravel(),
    "maxima": lambda x: jnp.sum(x.reshape(3, 4) ** 2, axis=0),
    "vmap": lambda x: jax.vmap(lambda a, b: a @ b * b)(x.reshape(6, 2)[:3], x.reshape(6, 2)[3:]).ravel(),
    "dynamic slices": lambda x: jax.lax.dynamic_update_slice(x, x[:3] ** 2, (4,)),
    "padded": lambda x: jnp.pad(x[3:6], (2, 1)) * jnp.arange(6.0),
    "set": lambda x: x.at[np.array([1, 5])].set(x[:2] * x[2:4]),
    "added": lambda x: jnp.zeros(6).at[np.array([0, 2, 2, 5])].add(x[:4] ** 2),
    "added at the nearest place": lambda x: jnp.zeros(4).at[np.array([0, 9])].add(x[:2] ** 2, mode="clip"),
    "outside": lambda x: x.at[np.array([1, 99])].set(x[:2] * x[3], mode="drop") * x.at[2 * np.arange(N)].get(mode="fill", fill_value=1),
    "along an axis": lambda x: (jnp.take_along_axis(x.reshape(3, 4), np.array([[1], [0], [3]]), axis=1) * x[:3, None]).ravel(),
    "rows added": lambda x: jnp.zeros((4, 3)).at[np.array([1, 3])].add(x[:6].reshape(2, 3) ** 2).ravel(),
    "selected": lambda x: jnp.where(np.arange(N) % 3 == 0, x, x[::-1] ** 2),
    "scan": lambda x: jax.lax.scan(lambda c, x: (c + x[0] ** 2, c * x[1]), x[0], x[1:11].reshape(5, 2))[1],
    "scan of rows": lambda x: jax.lax.scan(lambda c, x: (x, c * x), x[0], x[1:])[1],
    "map": lambda x: jax.lax.map(lambda x: jnp.sum(x**2), x.reshape(4, 3)),
    "jit": jax.jit(lambda x: jnp.concatenate([x[:2] * x[2:4], jnp.square(x[5:])])),
    "own derivative": lambda x: jax.nn.silu(x[2:]) * x[:-2],
    "norms": lambda x: jnp.linalg.norm(x.reshape(4, 3), axis=1),
    "tile": lambda x: jnp.tile(x[:3], 2) * x[3:9],
    "constants": lambda x: jnp.append(x[:2] ** 2, 3.0),
    "derivative along itself": lambda x: jax.jvp(lambda x: jnp.diff(x) ** 3, (x,), (x,))[1],
}
WIDER = {  # where some are missed or depend on the numbers: all that are there have to be found
    "sort": jnp.sort,
    "solve": lambda x: jnp.linalg.solve(jnp.diag(x[:3]) + 1.0, x[3:6]),
    "cond": lambda x: jax.lax.cond(x[0] > 0, lambda: x[1:4] ** 2, lambda: x[4:7]),
    "while": lambda x: jax.lax.fori_loop(0, 3, lambda i, y: y * x[0], x[:2]),
    "unknown place": lambda x: x[jnp.argmax(x)] * x[:3],
    "minimum of all": lambda x: x - jnp.min(x),
    "weights": lambda x: (WEIGHTS @ x[:3]) * x[3],
    "fft": lambda x: jnp.fft.fft(x).real,
    "searched": lambda x: jnp.interp(x[:3], jnp.arange(4.0), x[3:7]),
}


def not_zero(function, x):
    return np.asarray(jax.jacrev(function)(x)).reshape(-1, N) != 0


@pytest.mark.parametrize("name", EXACT)
def test_all_and_no_others(name):
    function = EXACT[name]
    found = dependence(function, jnp.zeros(N)).toarray()
    expected = sum(not_zero(function, jnp.asarray(np.random.default_rng(i).normal(size=N))) for i in range(4)) > 0
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("name", WIDER)
def test_none_is_missed(name):
    function = WIDER[name]
    found = dependence(function, jnp.zeros(N)).toarray()
    for i in range(4):
        assert not np.any(not_zero(function, jnp.asarray(np.random.default_rng(i).normal(size=N))) & ~found)


def test_under_jit_with_arguments_beside():
    """What is traced beside x has no known numbers, and is no dependence."""
    found = []

    @jax.jit
    def function(x, matrix, stiffness):
        found.append(dependence(lambda x: matrix @ x[:3] + stiffness * jnp.diff(x)[:4], x).toarray())
        return x

    function(jnp.zeros(N), WEIGHTS, 2.0)
    expected = (np.eye(4, N, 1) + np.eye(4, N) > 0) | (np.arange(N) < 3)
    np.testing.assert_array_equal(found[0], expected)


def test_length_is_that_of_the_program_and_not_of_its_arrays():
    """A net of 300 × 300 knots: 720 000 entries by rules for some forty equations."""

    def rods(x):
        x = x.reshape(300, 300, 3)
        return jnp.concatenate([jnp.sum(jnp.diff(x, axis=axis) ** 2, axis=2).ravel() for axis in (0, 1)])

    found = dependence(rods, jax.ShapeDtypeStruct((270_000,), float))
    assert found.shape == (2 * 300 * 299, 270_000) and found.nnz == 6 * 2 * 300 * 299


@pytest.mark.parametrize("function", [lambda x: jnp.outer(x, x), lambda x: jax.lax.scan(lambda c, _: (c, c), x[0], length=6000)[1]])
def test_too_much_is_said(function):
    with pytest.raises(TooLong):
        dependence(function, jnp.zeros(3000))
