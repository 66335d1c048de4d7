"""Mass, centre and inertia of a body identified from its recorded motion, as ten numbers of which each set is a body."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import jaxlag as jl
from jaxlag import rigid

M, C, DOWN = 1.3, np.array([0.05, -0.03, -0.15]), np.array([0.0, 0.0, -9.81])
AXES = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
THETA = AXES @ np.diag([0.010, 0.024, 0.030]) @ AXES.T
MARKS = np.array([[0.3, 0.0, 0.0], [0.0, 0.3, 0.0]])  # on the body
EULER = rigid.euler("xyz")
ANGLES, OMEGA = np.array([0.9, 0.4, -0.3]), np.array([1.0, 1.5, 4.0])
TS = np.linspace(0, 2, 41)
SPAN = 0.4  # m, from scale to scale along x
SIGMA = {"marks": 3e-4, "scales": 1e-4}  # m, kg


def recorded():
    """Euler's equations about the ball joint, by SciPy: the places of two marks."""
    about_joint = THETA + M * (C @ C * np.eye(3) - np.outer(C, C))

    def rate(t, y):
        q, w = np.split(y, [4])
        weight = M * Rotation.from_quat(q).as_matrix().T @ DOWN
        turned = np.linalg.solve(about_joint, np.cross(C, weight) - np.cross(w, about_joint @ w))
        return np.r_[0.5 * (q[3] * w + np.cross(q[:3], w)), -0.5 * q[:3] @ w, turned]

    start = np.r_[Rotation.from_euler("XYZ", ANGLES).as_quat(), OMEGA]
    q = solve_ivp(rate, (0, TS[-1]), start, "DOP853", t_eval=TS, rtol=1e-11, atol=1e-12).y[:4].T
    return Rotation.from_quat(q).as_matrix() @ MARKS.T


def lagrangian(q, qdot, body):
    m, c, Theta = rigid.inertia.physical(body)
    position = lambda q: EULER(q) @ c
    return rigid.kinetic_energy(m, Theta, position, EULER)(q, qdot) + m * DOWN @ position(q)


def seen(q, body):
    m, c, _ = rigid.inertia.physical(body)
    return {"marks": EULER(q) @ MARKS.T, "scales": m * (0.5 + c[0] / SPAN * np.array([1.0, -1.0]))}


@pytest.mark.slow
def test_the_inertia_of_a_tumbling_body_is_identified():
    """On a ball joint, and once laid on two scales. The guess is a ball half as heavy again, with its centre elsewhere.

    Of 20 recordings the squares of the errors in units of the covariance add up to χ² with 10 degrees of freedom each.
    """
    clean, rng, count = recorded(), np.random.default_rng(8), 20
    J = np.array([rigid.angular_velocity(EULER)(ANGLES, e) for e in np.eye(3)]).T
    experiments = []
    for _ in range(count):
        scales = np.full((TS.size, 2), np.nan)
        scales[0] = M * (0.5 + C[0] / SPAN * np.array([1.0, -1.0])) + SIGMA["scales"] * rng.normal(size=2)
        values = {"marks": clean + SIGMA["marks"] * rng.normal(size=clean.shape), "scales": scales}
        experiments.append(jl.Experiment(TS, values, ANGLES, np.linalg.solve(J, OMEGA), observe=seen, sigma=SIGMA))
    guess = {"body": rigid.inertia.log_cholesky(2.0, [0.0, 0.0, -0.1], [0.04, 0.04, 0.04])}
    fits = jl.fit_each(jl.System(lagrangian), experiments, guess, free=("body",))

    exact, chi2 = np.asarray(rigid.inertia.log_cholesky(M, C, THETA)), 0.0
    for fit in fits:
        assert fit.converged and np.all(np.isfinite(fit.standard_errors["body"]))
        off = np.asarray(fit.params["body"]) - exact
        chi2 += off @ np.linalg.solve(fit.covariance, off)
        m, _, Theta = rigid.inertia.physical(fit.params["body"])
        least, middle, most = np.linalg.eigvalsh(Theta)
        assert abs(m - M) < 0.05 and least > 0 and most < least + middle
        np.testing.assert_allclose(Theta, THETA, rtol=0, atol=4e-3)
    assert abs(chi2 - 10 * count) < 4 * np.sqrt(20 * count)
