"""Which of many terms of a linear model are there: best subsets, judged by blocks of equations that were left out."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

EXHAUSTIVE = 14  # candidates, up to which all subsets are tried; beyond, what one change improves
NEGLIGIBLE = 1e-5  # of all that is to be explained: a term that explains less is not there
CLEARLY = 2.0  # times the square error of another, that of a subset which is worse
RESAMPLES = 100
AT_ONCE = 20000  # subsets


class Blocks(NamedTuple):
    """Normal equations of B blocks of equations r + J c: JᵀJ, Jᵀr and rᵀr."""

    JJ: Float[np.ndarray, "B p p"]
    Jr: Float[np.ndarray, "B p"]
    rr: Float[np.ndarray, " B"]

    @property
    def whole(self) -> tuple[np.ndarray, np.ndarray]:
        """JᵀJ and Jᵀr of all blocks."""
        return np.sum(self.JJ, axis=0), np.sum(self.Jr, axis=0)

    def left_out(self, subsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of subsets (S, k) the coefficients (S, k), and the square error of each block as predicted from all others, (S, B)."""
        at, cross = (subsets[:, :, None], subsets[:, None, :]), self.whole
        coefficients = _solved(cross[0][at], cross[1][subsets])
        errors = []
        for JJ, Jr, rr in zip(self.JJ, self.Jr, self.rr, strict=True):
            c = _solved((cross[0] - JJ)[at], (cross[1] - Jr)[subsets])
            errors.append(rr + 2 * np.sum(c * Jr[subsets], axis=1) + np.einsum("si,sij,sj->s", c, JJ[at], c))
        return coefficients, np.stack(errors, axis=1)


class Subset(NamedTuple):
    """Some of the candidates, their coefficients, and the square error of each block that is left out."""

    members: tuple[int, ...]
    coefficients: np.ndarray
    errors: np.ndarray

    @property
    def error(self) -> float:
        """Of all blocks."""
        return float(np.sum(self.errors))

    def is_as_good_as(self, other: "Subset", all_of_it: float, deviations: float = 1.0) -> bool:
        """Whether its error is no larger than chance makes it, within so many standard deviations, or by next to nothing. Where one block
        has all of the difference, its deviation is as large; so no error is as good as one of half its size.
        """
        worse = self.errors - other.errors
        chance = np.std(worse, ddof=1) * np.sqrt(len(worse))
        by_chance = np.sum(worse) <= deviations * chance and self.error <= CLEARLY * other.error
        return bool(by_chance or np.sum(worse) <= NEGLIGIBLE * all_of_it)


def best_subsets(blocks: Blocks, lower: Float[np.ndarray, " p"]) -> list[Subset]:
    """The best of each size, from none to all, whose coefficients are not below `lower`.

    **Source:** Hastie, Tibshirani & Friedman, The Elements of Statistical Learning, 2nd ed., sections 3.3.1 and 7.10.1.
    """
    p = len(lower)
    found = [Subset((), np.zeros(0), blocks.rr)]
    for size in range(1, p + 1):
        if p <= EXHAUSTIVE:
            subsets = np.array(list(itertools.combinations(range(p), size)))
        else:
            subsets = _near([one.members for one in found[-2:]], size, p)
        best = None
        for part in np.array_split(subsets, -(-len(subsets) // AT_ONCE)):
            coefficients, errors = blocks.left_out(part)
            total = np.where(
                np.all(coefficients >= lower[part], axis=1) & np.all(np.isfinite(errors), axis=1), np.sum(errors, axis=1), np.inf
            )
            i = int(np.argmin(total))
            if np.isfinite(total[i]) and (best is None or total[i] < best.error):
                best = Subset(tuple(map(int, part[i])), coefficients[i], errors[i])
        if best is not None:
            found.append(best)
    return found


def as_good(found: list[Subset]) -> list[Subset]:
    """Those that predict as well as the best, the smallest first.

    **Source:** Breiman et al., Classification and Regression Trees (1984), section 3.4.3 (the rule of one standard error).
    """
    all_of_it = found[0].error
    best = min(found, key=lambda one: one.error)
    return [one for one in sorted(found, key=lambda one: len(one.members)) if one.is_as_good_as(best, all_of_it)]


def exchangeable(blocks: Blocks, lower: np.ndarray, chosen: Sequence[int]) -> list[tuple[int, int]]:
    """Pairs of a member and another candidate in whose place it predicts as well."""

    def of(members: Sequence[int]) -> Subset:
        coefficients, errors = blocks.left_out(np.array(members)[None])
        return Subset(tuple(members), coefficients[0], errors[0])

    pairs, here = [], of(chosen)
    for i, j in itertools.product(chosen, sorted(set(range(len(lower))) - set(chosen))):
        other = of(sorted({*chosen} - {i} | {j}))
        if np.all(other.coefficients >= lower[list(other.members)]) and other.is_as_good_as(here, float(np.sum(blocks.rr)), 2.0):
            pairs.append((i, j))
    return pairs


def stability(blocks: Blocks, lower: np.ndarray, size: int) -> np.ndarray:
    """Of each candidate the share of random halves of the blocks whose best subset of this size has it.

    **Source:** Meinshausen & Bühlmann, J. R. Stat. Soc. B 72 (2010) 417.
    """
    rng, count, shares = np.random.default_rng(0), len(blocks.rr), np.zeros(len(lower))
    subsets = np.array(list(itertools.combinations(range(len(lower)), size))) if len(lower) <= EXHAUSTIVE else None
    for _ in range(RESAMPLES):
        half = rng.permutation(count)[: max(count // 2, 1)]
        JJ, Jr = np.sum(blocks.JJ[half], axis=0), np.sum(blocks.Jr[half], axis=0)
        if subsets is None:
            return np.full(len(lower), np.nan)
        c = _solved(JJ[subsets[:, :, None], subsets[:, None, :]], Jr[subsets])
        gain = np.where(np.all(c >= lower[subsets], axis=1), np.sum(c * Jr[subsets], axis=1), np.inf)
        shares[subsets[np.argmin(gain)]] += 1
    return shares / RESAMPLES


def _near(found: list[tuple[int, ...]], size: int, p: int) -> np.ndarray:
    """Subsets of a size that one more member, and then one exchange, make of smaller ones."""
    grown = {tuple(sorted({*one, j})) for one in found for j in range(p) if j not in one and len(one) == size - 1}
    swapped = {tuple(sorted({*one} - {i} | {j})) for one in grown for i in one for j in range(p) if j not in one}
    return np.array(sorted(grown | swapped))


def _solved(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """−A⁻¹b of many normal equations, scaled."""
    size = np.sqrt(np.einsum("sii->si", A))
    size = np.where(size > 0, size, 1)
    scaled = A / (size[:, :, None] * size[:, None, :])
    k = A.shape[-1]
    return -np.linalg.solve(scaled + 1e-13 * np.eye(k), (b / size)[..., None])[..., 0] / size
