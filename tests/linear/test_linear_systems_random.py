"""Random linear systems under random linear constraints, in wild units: spectra, responses and derivatives against descriptor systems.

    M q̈ + (C + G) q̇ + (K + N) q = Jᵀλ + Wᵀμ + B u,   J q = 0,   W q̇ + V q = 0

with gyroscopic and circulatory forces, rows of J and W some of which follow from others, and units that differ by powers of ten. What is
expected comes from E ẋ = F x + H u, x = (q, q̇, λ, μ), with independent rows alone and in one unit, by SciPy's QZ algorithm and NumPy.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal
from scipy.linalg import eig
from spectra import assert_same_spectrum, paired

import jaxlag as jl

N = 4  # coordinates
DECADES = 6  # units are powers of ten up to this, either way


class Descriptor(NamedTuple):
    """The matrices, and which rows of J and W are independent."""

    M: np.ndarray
    C: np.ndarray
    K: np.ndarray
    B: np.ndarray
    J: np.ndarray
    W: np.ndarray
    V: np.ndarray
    own: tuple[int, int]  # how many of the first rows of J and W


def lagrangian(q, qdot, M, K):
    return 0.5 * qdot @ M @ qdot - 0.5 * q @ K @ q


def other_forces(q, qdot, u, C, N, B):
    return B @ u - C @ qdot - N @ q


SYSTEM = jl.System(
    lagrangian,
    force={"others": other_forces},
    holonomic={"J": lambda q, J: J @ q},
    nonholonomic={"W": lambda q, qdot, W, V: W @ qdot + V @ q},
)


def drawn(seed) -> Descriptor:
    """Everything full; one row in J or in W, or in both, and one more in each that follows from what is there."""
    draw = np.random.default_rng(seed)
    full = lambda *shape: draw.normal(size=shape)
    positive = lambda X: X @ X.T / N + np.eye(N)
    skew = lambda X: X - X.T
    h, w = [(1, 1), (2, 0), (0, 2), (1, 0), (0, 1), (0, 0)][seed % 6]
    J, W, V = full(h, N), full(w, N), full(w, N)
    J = np.vstack([J, full(1, h) @ J])
    mix, of_J = full(1, w), full(1, h)
    W, V = np.vstack([W, mix @ W + of_J @ J[:h]]), np.vstack([V, mix @ V])
    C, K = 0.3 * positive(full(N, N)) + 0.5 * skew(full(N, N)), 5 * positive(full(N, N)) + 0.3 * skew(full(N, N))
    return Descriptor(positive(full(N, N)), C, K, full(N, 2), J, W, V, (h, w))


def in_units(of: Descriptor, seed):
    """As params, each coordinate in a unit of its own, each constraint too."""
    draw = np.random.default_rng(1000 + seed)
    power = lambda n: 10.0 ** draw.uniform(-DECADES, DECADES, n)
    s, rows_J, rows_W = power(N), power(len(of.J))[:, None], power(len(of.W))[:, None]
    both = np.outer(s, s)
    K = of.K * both
    params = {"M": of.M * both, "K": (K + K.T) / 2, "N": (K - K.T) / 2, "C": of.C * both, "B": of.B * s[:, None], "u": np.zeros(2)}
    return params | {"J": of.J * (rows_J * s), "W": of.W * (rows_W * s), "V": of.V * (rows_W * s)}, s


def linearised(params):
    return jl.linearise(SYSTEM, np.zeros(N), params=params, inputs=("u",))


def pencil(of: Descriptor):
    """E, F and H with independent rows."""
    J, W, V = of.J[: of.own[0]], of.W[: of.own[1]], of.V[: of.own[1]]
    rows, I, none = np.vstack([J, W]), np.eye(N), np.zeros
    m = len(rows)
    E = np.block([[I, none((N, N + m))], [none((N, N)), of.M, none((N, m))], [none((m, 2 * N + m))]])
    F = np.block([[none((N, N)), I, none((N, m))], [-of.K, -of.C, rows.T], [np.vstack([J, V]), np.vstack([0 * J, W]), none((m, m))]])
    return E, F, np.vstack([none((N, 2)), of.B, none((m, 2))])


def on_the_constraints(of: Descriptor):
    """ẋ = A x + H u of x = (q, q̇), by the accelerations that keep the constraints."""
    J, W, V = of.J[: of.own[0]], of.W[: of.own[1]], of.V[: of.own[1]]
    rows = np.vstack([J, W])
    m = len(rows)
    saddle = np.block([[of.M, -rows.T], [rows, np.zeros((m, m))]])
    given = np.block([[-of.K, -of.C], [np.zeros((m, N)), np.vstack([0 * J, -V])]])
    A = np.vstack([np.eye(N, 2 * N, N), np.linalg.solve(saddle, given)[:N]])
    return A, np.vstack([np.zeros((N, 2)), np.linalg.solve(saddle, np.vstack([of.B, np.zeros((m, 2))]))[:N]])


def finite_eigenvalues(of: Descriptor):
    """Those of the pencil, of which the others are infinite; with J q = 0 and its rate."""
    E, F, _ = pencil(of)
    h, w = of.own
    found = eig(F, E, right=False)
    return found[np.argsort(np.where(np.isfinite(found), np.abs(found), np.inf))][: 2 * (N - h) - w]


OMEGA = np.array([0.3, 1.0, 3.0, 20.0])
TIMES = np.linspace(0.0, 2.0, 21)
SEEDS = [0, 1, 2, 3]


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_a_random_system(seed):
    """Eigenvalues, frequency and step response; these are told in the units of the coordinates."""
    of = drawn(seed)
    params, s = in_units(of, seed)
    linear = linearised(params)
    expected = finite_eigenvalues(of)
    assert_same_spectrum(linear.eigenvalues, expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())
    E, F, H = pencil(of)
    response = np.stack([np.linalg.solve(1j * w * E - F, H)[:N] for w in OMEGA])
    found = np.asarray(linear.frequency_response(OMEGA)) * s[:, None]
    np.testing.assert_allclose(found, response, rtol=0, atol=1e-9 * np.abs(response).max())
    A, B = on_the_constraints(of)
    for j in (0, 1):
        _, step = signal.step(signal.StateSpace(A, B[:, [j]], np.eye(N, 2 * N), np.zeros((N, 1))), T=TIMES)
        found = np.asarray(linear.step_response(TIMES))[:, :, j] * s
        np.testing.assert_allclose(found, step, rtol=0, atol=1e-9 * np.abs(step).max())


DIFFERENCES = 1e-6  # of fourth order with steps of 1e-4, of eigenvalues good to 1e-13


def changed(x):
    """Stiffness and damping by a factor, and the direction of a constraint, of a system with independent rows alone."""
    of = drawn(0)
    h, w = of.own
    J = of.J[:h] + x[2] * np.eye(h, N)
    return of._replace(K=of.K * (1 + x[0]), C=of.C * (1 + x[1]), J=J, W=of.W[:w], V=of.V[:w])


@pytest.mark.slow
def test_derivatives_of_random_eigenvalues():
    """Of all of them, forward, and in reverse of a sum over them; at two places at once by `vmap`; against differences of the pencil's."""
    places, h = np.array([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1]]), 1e-4
    eigenvalues = lambda x: linearised(in_units(changed(x), 0)[0]).eigenvalues
    found = jax.vmap(jax.jacfwd(lambda x: jnp.stack([eigenvalues(x).real, eigenvalues(x).imag])))(places)
    slopes = jax.vmap(jax.grad(lambda x: jnp.sum(1 / (2 - eigenvalues(x))).real))(places)
    for place, derivatives, slope in zip(places, np.asarray(found), slopes, strict=True):
        here = np.asarray(eigenvalues(place))
        for i, step in enumerate(np.eye(3)):
            at = lambda t, place=place, step=step, here=here: paired(here, finite_eigenvalues(changed(place + t * step)))
            by_differences = lambda of, at=at: (8 * (of(at(h)) - of(at(-h))) - (of(at(2 * h)) - of(at(-2 * h)))) / (12 * h)
            expected = by_differences(lambda values: values)
            error = derivatives[0, :, i] + 1j * derivatives[1, :, i] - expected
            assert np.abs(error).max() < DIFFERENCES * np.abs(expected).max()
            np.testing.assert_allclose(slope[i], by_differences(lambda values: np.sum(1 / (2 - values)).real), rtol=DIFFERENCES)
