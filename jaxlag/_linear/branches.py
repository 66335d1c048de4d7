"""Branches of eigenvalues followed over a parameter, and where they cross the imaginary axis."""

import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

FINER = 8  # steps between two values that a user asks for


class Spectrum(NamedTuple):
    """Eigenvalues at one value of the parameter, with eigenvectors as columns and what rounding does to each."""

    at: float
    values: np.ndarray
    vectors: np.ndarray
    rounding: np.ndarray

    def taken(self, order: np.ndarray) -> "Spectrum":
        """In another order."""
        return Spectrum(self.at, self.values[order], self.vectors[:, order], self.rounding[order])

    @property
    def signs(self) -> np.ndarray:
        """Of the real parts; 0 where rounding decides."""
        return np.where(np.abs(self.values.real) <= self.rounding, 0, np.sign(self.values.real)).astype(int)


class Transition(NamedTuple):
    """Where an eigenvalue begins or ceases to grow, with the spectrum just on the growing side, and which of it that is."""

    at: float
    which: int
    grows: bool  # beyond this value
    spectrum: Spectrum
    far: float  # the farther end of the step in which it lies

    @property
    def eigenvalue(self) -> complex:
        """The one that begins or ceases to grow."""
        return self.spectrum.values[self.which]


def continued(before: Spectrum, after: Spectrum) -> Spectrum:
    """The eigenvalues in the order of those before: near them, with eigenvectors that are alike."""
    from scipy.optimize import linear_sum_assignment  # imported here because that takes a while

    size = max(np.max(np.abs(before.values), initial=0.0), np.finfo(float).tiny)
    alike = np.abs(_unit(before.vectors).conj().T @ _unit(after.vectors))
    moved = np.abs(before.values[:, None] - after.values[None, :]) / size
    _, order = linear_sum_assignment(moved + 0.1 * (1 - alike))
    return after.taken(order)


def finer(values: np.ndarray) -> list[float]:
    """The values, and others between them."""
    between = [np.linspace(*ends, FINER + 1)[1:] for ends in itertools.pairwise(values)]
    return [float(at) for at in np.concatenate([values[:1], *between])]


def _unit(vectors):
    return vectors / np.maximum(np.linalg.norm(vectors, axis=0), np.finfo(float).tiny)


def followed(spectrum_at: Callable[[float], Spectrum], values: np.ndarray) -> tuple[list[Spectrum], list[Transition]]:
    """The spectra at the values, their branches in one order, and the transitions in between."""
    first, *others = finer(values)
    spectra = [spectrum_at(first)]
    transitions: list[Transition] = []
    for at in others:
        spectra.append(continued(spectra[-1], spectrum_at(at)))
        transitions += _transitions(spectrum_at, *spectra[-2:])
    return spectra[::FINER], transitions


def _transitions(spectrum_at: Callable, before: Spectrum, after: Spectrum) -> Iterator[Transition]:
    """Between two spectra, one after the other: each where the number of growing eigenvalues changes."""
    count = lambda spectrum: np.sum(spectrum.signs > 0)
    size = np.max(np.abs([before.values, after.values]), initial=0.0)
    ends = before.at, after.at
    while count(before) != count(after):
        low, high = before, after
        while (middle := (low.at + high.at) / 2) not in (low.at, high.at):
            between = spectrum_at(middle)
            low, high = (between, high) if count(between) == count(before) else (low, between)
        grows = bool(count(high) > count(low))
        growing = high if grows else low
        near = np.abs(growing.values.real) <= 1e-5 * size
        for which in np.flatnonzero((growing.signs > 0) & near & (growing.values.imag >= -growing.rounding)):
            yield Transition(high.at, int(which), grows, growing, max(ends, key=lambda end: abs(end - high.at)))
        before = high
