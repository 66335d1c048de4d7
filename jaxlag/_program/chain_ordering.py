"""Numbers and running sums of them in a line of blocks, each coupled with the one before it alone: found from the pattern of entries."""

from typing import NamedTuple

import numpy as np
import scipy.sparse

from .registry import remembered
from .running_sums import RunningSum
from .sparse_matrix import SparsityPattern, elimination_order

MOST_IN_A_BLOCK = 40  # numbers and sums: beyond, a few hundred rows are solved faster as a full matrix


class ChainOrdering(NamedTuple):
    """How a quadratic form of x and its running sums is taken apart: fixed while tracing, by the pattern of its entries alone.

    `entry` holds for each block, and for each number of its matrices that differs from block to block, which entry it is, the last but
    one a 0, the last a 1. `slots` holds the matrices by numbers of these, with a 0 and a 1 behind them: H of what is in a block, and
    beside what is handed to it; sums by what is in the block, and by what is handed to it.
    """

    at: np.ndarray  # of each block the x, padded by their number
    back: np.ndarray  # of each x, where it is in there
    handed: np.ndarray  # which of the numbers of a block the next one needs
    entry: np.ndarray
    slots: tuple[np.ndarray, ...]


@remembered
def chain_ordering(pattern: SparsityPattern, sums: tuple[RunningSum, ...]) -> ChainOrdering | None:
    """The line of the slopes of a form in z = (x, w) and, below them, of the summands; None where blocks would be large, where a sum
    depends on what comes behind it, or where the form does not depend on an x at all.
    """
    n = pattern.shape[1] - sum(s.size for s in sums)
    rows, columns, number, of_sums = _entries(pattern, sums, n)
    squares = rows[~of_sums & (rows == columns)]
    if not np.all(np.isin(np.arange(n), np.append(squares, columns[of_sums]))):
        return None
    place = _places(rows, columns, of_sums, n, sums)
    apart = place[rows] - place[columns]
    if np.any(apart[of_sums] < 0):
        return None
    block = place // max(1, int(np.abs(apart).max()))
    at, slot, width = _slots(block, n)
    a = at.shape[1]
    if width > MOST_IN_A_BLOCK:
        return None
    zero, one = pattern.rows.size, pattern.rows.size + 1
    blocks = [np.full((len(at), height, width), zero) for height in (width, width, width - a, width - a)]
    blocks[0][:, range(a), range(a)] = np.where(at < n, zero, one)
    for kind in range(4):
        chosen = (of_sums == (kind > 1)) & (block[rows] - block[columns] == kind % 2)
        blocks[kind][block[rows[chosen]], slot[rows[chosen]] - a * (kind > 1), slot[columns[chosen]]] = number[chosen]
    handed = np.flatnonzero(np.any(np.concatenate(blocks[1::2], axis=1) != zero, axis=(0, 1)))
    handed = handed if handed.size else np.zeros(1, int)
    blocks[1::2] = [x[:, :, handed] for x in blocks[1::2]]
    for x in blocks[1::2]:  # nothing comes before the first
        x[0] = x[-1] if np.all(x[-1] >= zero) else np.where(np.all(x[1:] == one, axis=0), one, zero)
    return ChainOrdering(at, np.flatnonzero(at.ravel() < n)[np.argsort(at[at < n])], handed, *_numbers(blocks, zero))


def _entries(pattern: SparsityPattern, sums: tuple[RunningSum, ...], n: int) -> tuple[np.ndarray, ...]:
    """Of each entry the z that it is about, the z by which, its number, and whether it is one of a sum; the sum before each with a 1."""
    size, starts = pattern.shape[1], np.cumsum([n, *(s.size for s in sums)])
    before = np.concatenate([np.full(n, -1), *(np.where(s.before() < 0, -1, s.before() + k) for s, k in zip(sums, starts, strict=False))])
    carried = np.flatnonzero(before >= 0)
    rows = np.append(np.where(pattern.rows < size, pattern.rows, pattern.rows - size + n), carried)
    columns = np.append(pattern.columns, before[carried])
    number = np.append(np.arange(pattern.rows.size), np.full(carried.size, pattern.rows.size + 1))
    return rows, columns, number, np.append(pattern.rows >= size, np.ones(carried.size, bool))


def _places(rows, columns, of_sums, n: int, sums: tuple[RunningSum, ...]) -> np.ndarray:
    """Of a sum how many are before it; of an x that of the first sum it is in, or of what it is beside; of others by elimination."""
    size = n + sum(s.size for s in sums)
    place = np.concatenate([np.full(n, size), *(s.along() for s in sums)])
    for of in (of_sums, ~of_sums):
        known, near = np.where(place[rows] < size, place[rows], size), place.copy()
        np.minimum.at(near, columns[of], known[of])
        place = np.where(place < size, place, near)
    rest = np.flatnonzero(place == size)
    if rest.size:
        coupled = scipy.sparse.csr_matrix((np.ones(rows.size), (rows, columns)), (size, size))[rest][:, rest]
        place[rest[elimination_order(coupled)]] = np.arange(rest.size)
    return place


def _slots(block: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, int]:
    """The x in each block, padded by n; of each z its slot, the sums behind the x; and how many slots there are."""
    slot = np.empty(block.size, int)
    widths: list[int] = []
    for part in (np.arange(n), np.arange(n, block.size)):
        order = part[np.argsort(block[part], kind="stable")]
        count = np.bincount(block[part], minlength=block.max() + 1)
        slot[order] = np.arange(part.size) - np.repeat(np.cumsum(count) - count, count) + sum(widths)
        widths.append(int(count.max(initial=0)))
    at = np.full((block.max() + 1, widths[0]), n)
    at[block[:n], slot[:n]] = np.arange(n)
    return at, slot, sum(widths)


def _numbers(blocks: list[np.ndarray], zero: int) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """The numbers of matrices that are not 0, or 1, in all blocks, and each matrix by these."""
    whole = np.concatenate([x.reshape(len(x), -1) for x in blocks], axis=1)
    always = [np.all(whole == of, axis=0) for of in (zero, zero + 1)]
    differs = np.flatnonzero(~always[0] & ~always[1])
    slots = np.where(always[0], differs.size, differs.size + 1)
    slots[differs] = np.arange(differs.size)
    parts = np.split(slots, np.cumsum([x[0].size for x in blocks])[:-1])
    return whole[:, differs], tuple(part.reshape(x.shape[1:]) for part, x in zip(parts, blocks, strict=True))
