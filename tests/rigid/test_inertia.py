"""Moments of inertia against integrals over the bodies, and bodies of ten numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlag import rigid

pytestmark = pytest.mark.fast
inertia = rigid.inertia
U, W = np.polynomial.legendre.leggauss(8)
S, WS = (U + 1) / 2, W / 2  # from 0 to 1
ANGLES = np.linspace(0, 2 * np.pi, 16, endpoint=False)


def moments(m, points, weights):
    """Of masses at points."""
    x, y, z = points
    w = m * weights / np.sum(weights)
    return [np.sum(w * (y**2 + z**2)), np.sum(w * (x**2 + z**2)), np.sum(w * (x**2 + y**2))]


def box(a, b, c):
    x, y, z = np.meshgrid(U * a / 2, U * b / 2, U * c / 2)
    return (x, y, z), np.prod(np.meshgrid(W, W, W), axis=0)


def tube(R, r, h):
    radius, angle, z = np.meshgrid(r + S * (R - r), ANGLES, U * h / 2)
    return (radius * np.cos(angle), radius * np.sin(angle), z), radius * np.prod(np.meshgrid(WS, np.ones(16), W), axis=0)


def shell(R, r, scale=(1.0, 1.0, 1.0)):
    radius, angle, u = np.meshgrid(r + S * (R - r), ANGLES, U)
    across = radius * np.sqrt(1 - u**2)
    points = (across * np.cos(angle), across * np.sin(angle), radius * u)
    return [s * x for s, x in zip(scale, points, strict=True)], radius**2 * np.prod(np.meshgrid(WS, np.ones(16), W), axis=0)


CASES = {
    "box": (inertia.box, (0.3, 0.5, 0.2), box(0.3, 0.5, 0.2)),
    "cylinder": (inertia.cylinder, (0.3, 0.7), tube(0.3, 0.0, 0.7)),
    "tube": (inertia.hollow_cylinder, (0.3, 0.2, 0.7), tube(0.3, 0.2, 0.7)),
    "ball": (inertia.sphere, (0.3,), shell(0.3, 0.0)),
    "hollow ball": (inertia.hollow_sphere, (0.3, 0.25), shell(0.3, 0.25)),
    "ellipsoid": (inertia.ellipsoid, (0.3, 0.5, 0.2), shell(1.0, 0.0, (0.3, 0.5, 0.2))),
}


@pytest.mark.parametrize("case", CASES)
def test_formulas(case):
    formula, lengths, (points, weights) = CASES[case]
    np.testing.assert_allclose(formula(1.7, *lengths), moments(1.7, points, weights), rtol=1e-13)


def test_thin_bodies():
    """Rod, hoop and thin shell."""
    np.testing.assert_allclose(inertia.cylinder(12.0, 0.0, 1.0), [1.0, 1.0, 0.0])
    np.testing.assert_allclose(inertia.hollow_cylinder(2.0, 1.0, 1.0, 0.0), [1.0, 1.0, 2.0])
    np.testing.assert_allclose(inertia.hollow_sphere(3.0, 1.0, 1.0), 3 * [2.0], rtol=1e-15)


def test_steiner_and_turned_parts_are_those_of_their_points():
    rng = np.random.default_rng(3)
    points, masses = rng.normal(size=(7, 3)), rng.uniform(1, 2, 7)
    tensor = lambda x: sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(masses, x, strict=True))
    centre = masses @ points / masses.sum()
    R = np.array(rigid.rotation_vector(rng.normal(size=3)))
    np.testing.assert_allclose(inertia.steiner(tensor(points - centre), masses.sum(), centre), tensor(points), rtol=1e-13)
    np.testing.assert_allclose(inertia.rotated(tensor(points), R), tensor(points @ R.T), rtol=1e-12)
    moments, axes = inertia.principal_axes(tensor(points))
    np.testing.assert_allclose(axes @ jnp.diag(moments) @ axes.T, tensor(points), rtol=1e-12)
    np.testing.assert_allclose(jnp.linalg.det(axes), 1.0, rtol=1e-13)


def test_ten_free_numbers_are_a_body_and_back():
    """Whatever they are, the pseudo-inertia is positive: no moment exceeds the sum of the others; and they are made again of the body."""
    for x in np.random.default_rng(4).normal(size=(200, 10)):
        body = inertia.physical(x)
        least, middle, most = np.linalg.eigvalsh(body.Theta)
        assert body.m > 0 and least > 0 and most < least + middle
        np.testing.assert_allclose(inertia.log_cholesky(*body), x, rtol=1e-9, atol=1e-9)
    J = jax.jacfwd(lambda x: jnp.concatenate([jnp.ravel(part) for part in inertia.physical(x)]))(jnp.array(x))
    assert np.linalg.matrix_rank(J) == 10


def test_the_pseudo_inertia_of_masses_at_points():
    """Σ = Σᵢ mᵢ xᵢ xᵢᵀ, factorised: of as many points as a body needs to be solid."""
    rng = np.random.default_rng(5)
    points, masses = rng.normal(size=(6, 3)), rng.uniform(1, 2, 6)
    m, c = masses.sum(), masses @ points / masses.sum()
    Theta = sum(w * (r @ r * np.eye(3) - np.outer(r, r)) for w, r in zip(masses, points - c, strict=True))
    alpha, d1, d2, d3, s12, s23, s13, *t = np.array(inertia.log_cholesky(m, c, Theta))
    rows = [[np.exp(d1), s12, s13, t[0]], [0, np.exp(d2), s23, t[1]], [0, 0, np.exp(d3), t[2]], [0, 0, 0, 1]]
    factor = np.exp(alpha) * np.array(rows)
    lifted = np.concatenate([points, np.ones((6, 1))], axis=1)
    np.testing.assert_allclose(factor @ factor.T, lifted.T @ (masses[:, None] * lifted), rtol=1e-12, atol=1e-13)
