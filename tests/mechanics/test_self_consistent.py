"""Forces that depend on the multipliers that they bring about: closed forms, roots by SciPy and NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import jaxlag as jl

REST = {"x": 0.0, "y": 0.0}


def lagrangian(q, qdot, s):
    """Unit masses x and y under g = 10, in units s of x, y and of mass."""
    return s[2] * (0.5 * ((s[0] * qdot["x"]) ** 2 + (s[1] * qdot["y"]) ** 2) - 10 * s[1] * q["y"])


def together(q, s):
    return s[3] * (s[1] * q["y"] - s[0] * q["x"])


def power(multipliers, s, b, p):
    """b λᵖ on x, in these units."""
    return {"x": s[0] * s[2] * b * (multipliers["rail"] * s[3] / s[2]) ** p}


RAIL = jl.System(lagrangian, holonomic={"rail": together}, force=power)
ONE = np.ones(4)


@pytest.mark.parametrize("s", [ONE, np.array([1e9, 1e-9, 1.0, 1e6]), np.array([1e-9, 1e9, 1e9, 1e-6])])
def test_a_cube_of_the_multiplier_in_any_units(s):
    """−λ³ − λ = −10 + λ; three steps of Newton's method, from λ = 0, left λ at 2.40 for 1.85."""
    root = brentq(lambda x: x**3 + 2 * x - 10, 0, 5, xtol=1e-15)
    found = jl.acceleration(RAIL, REST, REST, {"s": s, "b": -1.0, "p": 3.0})
    np.testing.assert_allclose(found.multipliers["rail"] * s[3] / s[2], root, rtol=1e-14)
    np.testing.assert_allclose(found.qddot["x"] * s[0], root - 10, rtol=1e-14)


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_its_derivatives(derivative):
    """Of λ by b, where b λ³ − 2 λ + 10 = 0: by hand, to second order."""
    slope = derivative(lambda b: jl.acceleration(RAIL, REST, REST, {"s": ONE, "b": b, "p": 3.0}).multipliers["rail"])
    l = brentq(lambda x: x**3 + 2 * x - 10, 0, 5, xtol=1e-15)
    first = l**3 / (2 + 3 * l**2)
    np.testing.assert_allclose(slope(-1.0), first, rtol=1e-12)
    h, at = 1e-4, lambda b: brentq(lambda x: b * x**3 - 2 * x + 10, 0, 5, xtol=1e-15)
    second = (at(-1 + h) - 2 * at(-1.0) + at(-1 - h)) / h**2
    np.testing.assert_allclose(jax.jacfwd(slope)(-1.0), second, rtol=1e-5)


@pytest.mark.slow
def test_a_square_has_two_multipliers_or_none():
    """b λ² − 2 λ + 10 = 0: the root that grows out of that at b = 0; beyond b = 0.1 none, which is said."""
    for b in (-0.05, 0.05, 0.0999):
        found = jl.acceleration(RAIL, REST, REST, {"s": ONE, "b": b, "p": 2.0}).multipliers["rail"]
        np.testing.assert_allclose(found, min(np.roots([b, -2, 10]), key=abs), rtol=1e-12)
    params = {"s": ONE, "b": 0.1001, "p": 2.0}
    with pytest.raises(ValueError, match="multipliers that agree with the forces they bring about"):
        jl.acceleration(RAIL, REST, REST, params)
    with pytest.raises(RuntimeError, match="multipliers that agree with the forces they bring about"):
        jl.simulate(RAIL, REST, REST, np.linspace(0, 1, 3), params)


def test_others_are_said():
    said = jl.examine(RAIL, REST, REST, {"s": ONE, "b": 0.05, "p": 2.0}).findings
    assert any("more than one set" in of and "5.858" in of and "34.14" in of for of in said)
    assert not any("more than one set" in of for of in jl.examine(RAIL, REST, REST, {"s": ONE, "b": -1.0, "p": 3.0}).findings)


def test_dissipation_by_the_square_of_a_multiplier():
    """A block that is pressed upon a plane: ẍ = −μ N² sign(v), N = 10, and N does not depend on it."""
    block = jl.System(
        lambda q, qdot: 0.5 * qdot @ qdot - 10 * q[1],
        dissipation=lambda qdot, multipliers, mu: mu * multipliers["plane"] ** 2 * jnp.sqrt(qdot[0] ** 2 + 1e-12),
        holonomic={"plane": lambda q: q[1]},
    )
    found = jl.acceleration(block, jnp.zeros(2), jnp.array([1.0, 0.0]), {"mu": 0.3})
    np.testing.assert_allclose([found.qddot[0], found.multipliers["plane"]], [-30, 10], rtol=1e-11)
