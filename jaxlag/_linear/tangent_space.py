"""Independent coordinates and velocities, and how the dependent ones follow from them near a state on the constraints."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .._mechanics.pseudo_inverse import CLEAR, NOISE


class Partition(NamedTuple):
    """The independent coordinates and velocities, the `dependent` ones, and the `rows` of the constraints that determine these."""

    positions: tuple[int, ...]
    velocities: tuple[int, ...]
    dependent_positions: tuple[int, ...]
    dependent_velocities: tuple[int, ...]
    position_rows: tuple[int, ...]  # of ∂g/∂q
    velocity_rows: tuple[int, ...]  # of G


def partition(G: np.ndarray, positions: int, preferred: Sequence[int] = ()) -> Partition:
    """Coordinate partitioning: Gaussian elimination with complete pivoting of the rows of G, the first of which hold positions.

    Coordinates `preferred` as independent become dependent last. Rows that follow from others are left out.

    Source: Wehage & Haug, J. Mechanical Design 104 (1982) 247-255.
    """
    n = G.shape[1]
    size = np.max(np.abs(G), axis=1, keepdims=True, initial=0.0)
    left = G / np.where(size > 0, size, 1)
    at_last = np.isin(np.arange(n), list(preferred))
    pivots: list[tuple[int, int]] = []
    counts = []
    for rows in (np.arange(len(G)) < positions, np.ones(len(G), bool)):
        for among in (~at_last, at_last):
            while (pivot := _pivot(left, rows, among, pivots)) is not None:
                row, column = pivot
                pivots.append(pivot)
                factors = left[:, column] / left[row, column]
                factors[[i for i, _ in pivots]] = 0
                left = left - np.outer(factors, left[row])
        counts.append(len(pivots))
    of_positions = pivots[: counts[0]]
    free = lambda taken: tuple(i for i in range(n) if i not in {column for _, column in taken})
    split = lambda taken: (tuple(column for _, column in taken), tuple(row for row, _ in taken))
    dependent, rows_of = split(of_positions)
    dependent_v, rows_v = split(pivots)
    return Partition(free(of_positions), free(pivots), dependent, dependent_v, rows_of, rows_v)


def _pivot(left, rows, among, taken):
    """The largest entry of the remaining rows and columns; None if these are zero to rounding."""
    rows = rows.copy()
    rows[[i for i, _ in taken]] = False
    columns = among.copy()
    columns[[j for _, j in taken]] = False
    if not (rows.any() and columns.any()):
        return None
    size = np.abs(np.where(np.outer(rows, columns), left, 0))
    row, column = np.unravel_index(np.argmax(size), size.shape)
    eps = np.finfo(left.dtype).eps
    if size[row, column] <= eps**NOISE:
        return None
    if size[row, column] <= eps**CLEAR and not np.any(np.abs(left[row]) > eps**CLEAR):
        raise ValueError(SINGULAR)
    return (int(row), int(column)) if size[row, column] > eps**CLEAR else None


SINGULAR = (
    "`q` must be a regular position to linearise there, but rows of the constraints nearly depend on each other: how many coordinates are "
    "independent is in question. Move q away from the singular position, or leave out what is redundant."
)
