"""Stability over two parameters: against closed forms and SciPy's eigenvalues."""

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
import scipy.linalg

import jaxlag as jl
from jaxlag import plot

matplotlib.use("Agg")
import matplotlib.pyplot as plt

rod = jl.System(  # upright under a weight p, on a spring
    lambda q, qdot, c, p: 0.5 * qdot**2 - 0.5 * (c - p) * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2
)
ROD = {"c": 4.0, "p": 0.0, "b": 0.0}
column = jl.System(  # Ziegler's: masses 2m and m, rods of length l, springs k, a force P that follows the upper rod
    lambda q, qdot, k: (
        0.5 * (3 * qdot[0] ** 2 + 2 * jnp.cos(q[0] - q[1]) * qdot[0] * qdot[1] + qdot[1] ** 2) - 0.5 * k * (q[0] ** 2 + (q[1] - q[0]) ** 2)
    ),
    dissipation=lambda qdot, b: 0.5 * b * (qdot[0] ** 2 + (qdot[1] - qdot[0]) ** 2),
    force=lambda q, P: P * jnp.stack([jnp.sin(q[0] - q[1]), 0.0 * q[0]]),
)


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def test_a_rod_under_its_weight():
    """Growth −b/2 ± √(b²/4 − c + p): flutter with a negative b, divergence beyond p = c, a rounding of zero on both borders."""
    b, p = np.linspace(-1, 1, 9), np.linspace(0.0, 8.0, 9)
    found = jl.stability_map(rod, lambda: 0.0, params=ROD, over={"b": b, "p": p})
    root = np.sqrt((b[:, None] ** 2 / 4 - 4.0 + p[None]).astype(complex))
    values = -b[:, None] / 2 + root
    np.testing.assert_allclose(found.growth, values.real, atol=1e-12)
    np.testing.assert_allclose(found.frequency, values.imag, atol=1e-12)
    slow = values.real > 0
    np.testing.assert_array_equal(found.kind, np.where(slow, np.where(values.imag > 0, "flutter", "divergence"), "stable"))


@pytest.mark.slow
def test_zieglers_column():
    """Flutter beyond P = 7/2 − √2 without damping and 41/28 + b²/2 with it; and eigenvalues of the matrices by hand."""
    b, P = np.array([0.0, 1e-3, 0.1, 0.5]), np.array([1.4, 1.47, 1.6, 2.08, 2.09, 3.0])
    found = jl.stability_map(column, lambda: jnp.zeros(2), params={"k": 1.0, "b": 0.0, "P": 0.0}, over={"b": b, "P": P})
    limit = np.where(b == 0, 3.5 - np.sqrt(2), 41 / 28 + b**2 / 2)
    np.testing.assert_array_equal(found.kind, np.where(P[None] > limit[:, None], "flutter", "stable"))
    M, C = np.array([[3.0, 1.0], [1.0, 1.0]]), np.array([[2.0, -1.0], [-1.0, 1.0]])
    for i, j in np.ndindex(found.growth.shape):
        K = C - P[j] * np.array([[1.0, -1.0], [0.0, 0.0]])
        A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -b[i] * np.linalg.solve(M, C)]])
        growth = np.max(scipy.linalg.eigvals(A).real)
        np.testing.assert_allclose(found.growth[i, j], growth if growth > 1e-9 or b[i] else 0.0, atol=1e-9)


@pytest.mark.slow
def test_where_there_is_no_steady_state():
    """A spring that is stretched beyond its strongest pull: q of F = sin q, for F ≤ 1."""
    spring = jl.System(lambda q, qdot, F, m: 0.5 * m * qdot**2 + jnp.cos(q) + F * q)
    found = jl.stability_map(spring, 0.0, params={"F": 0.0, "m": 1.0}, over={"F": [0.0, 0.5, 0.9, 1.5], "m": [1.0, 2.0]})
    np.testing.assert_array_equal(np.isnan(found.growth), np.repeat([[False], [False], [False], [True]], 2, axis=1))
    assert set(found.missing) == {(3, 0), (3, 1)} and "equilibrium" in found.missing[3, 0] and "missing" in repr(found)
    np.testing.assert_allclose(found.frequency[:3], np.sqrt(np.sqrt(1 - np.array([0, 0.5, 0.9]) ** 2)[:, None] / np.array([[1.0, 2.0]])))


def test_its_picture():
    """The cells have the kinds of the points, and the thick line is where growth is zero."""
    b, p = np.linspace(-1, 1, 11), np.linspace(0.0, 8.0, 9)
    found = jl.stability_map(rod, lambda: 0.0, params=ROD, over={"b": b, "p": p})
    ax = plot.stability_map(found, units={"b": "N s/m"})
    mesh = ax.collections[0]
    kinds = np.array(["stable", "flutter", "divergence", "missing"])[np.asarray(mesh.get_array()).astype(int).reshape(9, 11)]
    np.testing.assert_array_equal(kinds, found.kind.T)
    assert ax.get_xlabel() == "b (N s/m)" and ax.get_ylabel() == "p"
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["stable", "flutter", "divergence"]
    border = np.concatenate([path.vertices for path in ax.collections[-1].get_paths()])
    on_growth = np.minimum(np.abs(border[:, 0]), np.abs(border[:, 1] - 4))
    assert np.max(on_growth) < 0.26 and np.ptp(border[:, 1]) > 3


@pytest.mark.parametrize(
    ("over", "said"),
    [({"b": [0.0, 1.0]}, "`over` must"), ({"b": [0.0, 1.0], "x": [0.0, 1.0]}, "x"), ({"b": [1.0, 0.0], "p": [0.0, 1.0]}, "increas")],
    ids=["one", "unknown", "falling"],
)
def test_clear_errors(over, said):
    with pytest.raises((ValueError, TypeError, KeyError), match=said):
        jl.stability_map(rod, lambda: 0.0, params=ROD, over=over)
