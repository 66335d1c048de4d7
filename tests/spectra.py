"""Spectra, compared without regard to their order."""

import numpy as np
from scipy.optimize import linear_sum_assignment


def paired(found, expected):
    """The expected eigenvalues in the order of those that were found, so that the largest distance of a pair is small."""
    found, expected = np.asarray(found, complex), np.asarray(expected, complex)
    assert found.shape == expected.shape, f"{found.size} eigenvalues, but {expected.size} expected"
    return expected[linear_sum_assignment(np.abs(found[:, None] - expected) ** 2)[1]]


def assert_same_spectrum(found, expected, rtol=1e-9, atol=0.0):
    """`atol` is for those that are zero: rounding, or its root where an eigenvalue of zero has no second eigenvector."""
    np.testing.assert_allclose(found, paired(found, expected), rtol=rtol, atol=atol)
