"""Radau's points, and derivatives of polynomials through them and the start of an interval."""

import math
from typing import Any

import numpy as np


def points(stages: int) -> np.ndarray:
    """c of Radau IIA, between 0 and 1, the last one 1.

    **Source:** Hairer & Wanner, Solving Ordinary Differential Equations II, section IV.5.
    """
    x = np.polynomial.Polynomial([0, 1])
    of = x ** (stages - 1) * (x - 1) ** stages
    return np.sort(of.deriv(stages - 1).roots().real)


def derivatives(c: np.ndarray) -> np.ndarray:
    """D, (s, s + 1): the slope at c of the polynomial through its values at 0 and at c."""
    at = np.concatenate([[0.0], c])
    slopes = [np.polynomial.Polynomial.fromroots(np.delete(at, j)) / np.prod(at[j] - np.delete(at, j)) for j in range(at.size)]
    return np.stack([p.deriv()(c) for p in slopes], axis=1)


def weights(c: np.ndarray) -> np.ndarray:
    """b, (s,): of the integral from 0 to 1 by values at c."""
    return np.linalg.solve(np.vander(c, increasing=True).T, 1 / np.arange(1, c.size + 1))


def interpolation(c: np.ndarray, at: Any) -> list[Any]:
    """How much each value at c counts for the polynomial through them, elsewhere."""
    return [math.prod((at - c[k]) / (c[j] - c[k]) for k in range(c.size) if k != j) for j in range(c.size)]
