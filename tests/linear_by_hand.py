"""Linear systems whose matrices are entries of params, and the same in NumPy: the data of many tests of linearisation."""

import numpy as np

import jaxlag as jl


def lagrangian(q, qdot, M, K):
    return 0.5 * qdot @ M @ qdot - 0.5 * q @ K @ q


def dampers(qdot, C):
    return 0.5 * qdot @ C @ qdot


def push(q, qdot, G, N, u):
    """Gyroscopic and circulatory forces, neither of which has a potential, and forces from outside."""
    return u - G @ qdot - N @ q


SYSTEM = jl.System(lagrangian, dissipation={"dampers": dampers}, force={"push": push})
REST, NONE = np.zeros(3), np.zeros((3, 3))


def _random(seed, n=3):
    """M q̈ + (C + G) q̇ + (K + N) q = u with all of them full."""
    draw = np.random.default_rng(seed)

    def positive():
        X = draw.normal(size=(n, n))
        return X @ X.T / n + np.eye(n)

    def skew():
        X = draw.normal(size=(n, n))
        return X - X.T

    return {"M": positive(), "C": 0.2 * positive(), "G": 0.5 * skew(), "K": 10 * positive(), "N": 0.3 * skew(), "u": np.zeros(n)}


FULL = _random(1)
UNDAMPED = FULL | {"C": NONE, "G": NONE, "N": NONE}


def first_order(M, C, G, K, N, **_):
    """A of ẋ = A x, x = (q, q̇)."""
    n = len(M)
    return np.vstack([np.eye(n, 2 * n, n), -np.linalg.solve(M, np.hstack([K + N, C + G]))])


def linearised(params, **more):
    """By jaxlag, at rest."""
    return jl.linearise(SYSTEM, REST, params=params, **more)


def central(value, x, h=1e-5):
    """dvalue/dx at a number x, by differences extrapolated to a step of zero."""
    difference = lambda h: (value(x + h) - value(x - h)) / (2 * h)
    return (4 * difference(h / 2) - difference(h)) / 3
