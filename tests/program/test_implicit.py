"""Derivatives that are not traced through a computation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlag._program.implicit import implicit_root, undifferentiated

pytestmark = pytest.mark.fast


def test_what_is_undifferentiated_is_constant_for_every_derivative():
    """By its arguments and by what it closes over; the sum's other part keeps its derivative, 2ax."""

    def f(a, x):
        fixed = undifferentiated(lambda x: jnp.sin(a * x) + a**2)
        return fixed(x) + a * x**2

    np.testing.assert_allclose(f(2.0, 3.0), np.sin(6.0) + 4 + 18, rtol=1e-15)
    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(derivative(f, (0, 1))(2.0, 3.0), (9.0, 12.0), rtol=1e-15)
    np.testing.assert_allclose(jax.hessian(f, 0)(2.0, 3.0), 0.0)
    np.testing.assert_allclose(jax.vmap(jax.grad(f), (None, 0))(2.0, jnp.arange(3.0)), [0.0, 1.0, 4.0])


def test_nothing_of_what_is_undifferentiated_is_in_the_program_of_a_derivative():
    """The derivative of the sine is a cosine, which the program then lacks."""
    text = lambda function: str(jax.make_jaxpr(jax.jacfwd(function))(1.0))
    assert " cos " in text(jnp.sin) and " cos " not in text(lambda x: undifferentiated(jnp.sin)(x) + x)


def test_a_root_has_its_derivatives_of_every_order():
    """w³ = a: w = a^(1/3), of w as it is found, without a derivative of its own."""
    residual = lambda a, w: w**3 - a
    change = lambda a, w, R: -R / (3 * w**2)

    def root(a):
        found = jax.lax.stop_gradient(jnp.cbrt(a))
        return implicit_root(residual, change, a, found[None])[0]

    derivatives, a = [root, jax.grad(root), jax.jacfwd(jax.grad(root)), jax.grad(jax.grad(jax.jacfwd(root)))], 2.0
    exact = [a ** (1 / 3), a ** (-2 / 3) / 3, -2 / 9 * a ** (-5 / 3), 10 / 27 * a ** (-8 / 3)]
    np.testing.assert_allclose([of_order(a) for of_order in derivatives], exact, rtol=1e-14)
