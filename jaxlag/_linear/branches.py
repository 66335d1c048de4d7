"""Eigenvalue branches followed over a parameter, and their crossings of the imaginary axis."""

import functools
import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

FINER = 8  # steps between two values that a user asks for


class Spectrum(NamedTuple):
    """Eigenvalues at one value of the parameter, with eigenvectors as columns and the rounding error of each eigenvalue."""

    at: float
    values: np.ndarray
    vectors: np.ndarray
    rounding: np.ndarray

    def taken(self, order: np.ndarray) -> "Spectrum":
        """The spectrum in another order."""
        return Spectrum(self.at, self.values[order], self.vectors[:, order], self.rounding[order])

    def growing(self, least: np.ndarray) -> np.ndarray:
        """Mask of eigenvalues that grow by more than rounding and `least`; both of a conjugate pair or neither."""
        return self.values.real > np.maximum(least, self.rounding_of_pairs)

    @property
    def rounding_of_pairs(self) -> np.ndarray:
        """The rounding error of each eigenvalue or of its conjugate, whichever is larger."""
        if not self.values.size:
            return self.rounding
        other = np.argmin(np.abs(self.values[:, None].conj() - self.values[None, :]), axis=1)
        return np.maximum(self.rounding, self.rounding[other])


class Transition(NamedTuple):
    """The point at which an eigenvalue begins or ceases to grow, the spectrum just on the growing side, and its index there."""

    at: float
    which: int
    grows: bool  # beyond this value
    spectrum: Spectrum
    far: float  # the farther end of the step that contains it

    @property
    def eigenvalue(self) -> complex:
        """The eigenvalue that begins or ceases to grow."""
        return self.spectrum.values[self.which]


def continued(before: Spectrum, after: Spectrum) -> Spectrum:
    """The spectrum `after` in the order of `before`, matched by nearby eigenvalues and similar eigenvectors."""
    from scipy.optimize import linear_sum_assignment  # imported here because that takes a while

    size = max(np.max(np.abs(before.values), initial=0.0), np.finfo(float).tiny)
    alike = np.abs(_unit(before.vectors).conj().T @ _unit(after.vectors))
    moved = np.abs(before.values[:, None] - after.values[None, :]) / size
    _, order = linear_sum_assignment(moved + 0.1 * (1 - alike))
    return after.taken(order)


def finer(values: np.ndarray) -> list[float]:
    """The values and intermediate ones."""
    between = [np.linspace(*ends, FINER + 1)[1:] for ends in itertools.pairwise(values)]
    return [float(at) for at in np.concatenate([values[:1], *between])]


def _unit(vectors):
    return vectors / np.maximum(np.linalg.norm(vectors, axis=0), np.finfo(float).tiny)


def followed(spectrum_at: Callable[[float], Spectrum], values: np.ndarray) -> tuple[list[Spectrum], list[Transition]]:
    """The spectra at the values, with branches in one order throughout, and the transitions in between."""
    spectrum_at = functools.cache(spectrum_at)
    first, *others = finer(values)
    spectra = [spectrum_at(first)]
    transitions: list[Transition] = []
    for at in others:
        spectra.append(continued(spectra[-1], spectrum_at(at)))
        transitions += _transitions(spectrum_at, *spectra[-2:])
    return spectra[::FINER], transitions


def _transitions(spectrum_at: Callable, before: Spectrum, after: Spectrum) -> list[Transition]:
    """Transitions of all branches between two spectra, in order; one for each conjugate pair.

    The rounding bound of each branch is at least the bound at both ends: in between it flickers and would be crossed twice.
    """
    bound = np.maximum(before.rounding_of_pairs, after.rounding_of_pairs)
    changed = np.flatnonzero(before.growing(bound) != after.growing(bound))
    found = [of for which in changed if (of := _transition(spectrum_at, before, after, bound, int(which))) is not None]
    if len(found) < len(changed):  # branches that meet, as in flutter without damping, cannot be told apart: count them
        return list(_by_number(spectrum_at, before, after, bound))
    return sorted((of for of in found if of.eigenvalue.imag >= -bound[of.which]), key=lambda of: of.at)


def _by_number(spectrum_at: Callable, before: Spectrum, after: Spectrum, bound: np.ndarray) -> Iterator[Transition]:
    """Transitions in sequence, at each change in the number of growing eigenvalues."""
    count = lambda spectrum: np.sum(spectrum.growing(bound))
    ends = before.at, after.at
    while count(before) != count(after):
        low, high = before, after
        while (middle := (low.at + high.at) / 2) not in (low.at, high.at):
            between = continued(low, spectrum_at(middle))
            low, high = (between, high) if count(between) == count(before) else (low, between)
        grows = bool(count(high) > count(low))
        growing, other = (high, low) if grows else (low, high)
        crosses = growing.growing(bound) & ~other.growing(bound) & (growing.values.imag >= -bound)
        for which in np.flatnonzero(crosses):
            yield Transition(high.at, int(which), grows, growing, max(ends, key=lambda end: abs(end - high.at)))
        before = high


def _transition(spectrum_at: Callable, before: Spectrum, after: Spectrum, bound: np.ndarray, which: int) -> Transition | None:
    """The transition of one branch, by bisection along it; None if the branch was mistaken for another at the far end."""
    grows = lambda spectrum: bool(spectrum.growing(bound)[which])
    low, high = before, after
    while (middle := (low.at + high.at) / 2) not in (low.at, high.at):
        between = continued(low, spectrum_at(middle))
        low, high = (between, high) if grows(between) == grows(before) else (low, between)
    high = continued(low, high)
    if grows(high) == grows(before):
        return None
    far = max(before.at, after.at, key=lambda end: abs(end - high.at))
    return Transition(high.at, which, grows(high), high if grows(high) else low, far)
