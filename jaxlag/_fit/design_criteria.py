"""What makes one experiment better than another: numbers made of the information that it gives."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._model.paths import is_within, listed


@dataclasses.dataclass(frozen=True)
class Criterion:
    """What is asked of the information about parameters."""


@dataclasses.dataclass(frozen=True)
class DOptimal(Criterion):
    r"""The smallest volume of the region in which the parameters are believed to be, whatever their units.

    $$ \min\; -\log\det F $$

    **Source:** Atkinson, Donev & Tobias, Optimum Experimental Designs, with SAS (2007), section 10.1.

    ```python
    import jaxlag as jl
    jl.DOptimal()  # the default of `design`
    ```
    """


@dataclasses.dataclass(frozen=True)
class AOptimal(Criterion):
    r"""The smallest sum of squares of the relative standard errors.

    $$ \min\; \log \sum_j \left(\frac{\mathrm{se}(\theta_j)}{\theta_j}\right)^2 = \log \mathrm{tr}\, F^{-1} $$

    A parameter that is zero counts in units of its error before the design.

    **Source:** Atkinson, Donev & Tobias, Optimum Experimental Designs, with SAS (2007), section 10.1.

    ```python
    import jaxlag as jl
    jl.AOptimal()
    ```
    """


@dataclasses.dataclass(frozen=True)
class EOptimal(Criterion):
    r"""The smallest error of the worst-determined combination of relative parameters.

    $$ \min\; \log \lambda_{\max}(F^{-1}) $$

    Where two eigenvalues meet this has an edge; it is rounded at first, and less and less.

    **Source:** Atkinson, Donev & Tobias, Optimum Experimental Designs, with SAS (2007), section 10.1.

    ```python
    import jaxlag as jl
    jl.EOptimal()
    ```
    """


@dataclasses.dataclass(frozen=True)
class Along(Criterion):
    r"""The smallest relative error of one parameter, or of a few, whatever becomes of the others.

    $$ \min\; \log \sum_{j \in \text{names}} \left(\frac{\mathrm{se}(\theta_j)}{\theta_j}\right)^2 $$

    **Arguments:** `names`: of `free`, one or several. **Raises:** `ValueError`, in `design`, if one is not free.

    **Source:** Atkinson, Donev & Tobias, Optimum Experimental Designs, with SAS (2007), sections 10.2 and 10.3.

    ```python
    import jaxlag as jl
    jl.Along("F")
    ```
    """

    names: str | Sequence[str]


@dataclasses.dataclass(frozen=True, eq=False)
class OverSamples(Criterion):
    """A criterion at several values of the parameters together; `samples`: by name of an entry of `params`, (K, ...)."""

    samples: Mapping[str, Any]
    criterion: Criterion = DOptimal()

    def __post_init__(self):
        if not isinstance(self.samples, Mapping) or len({len(np.atleast_1d(x)) for x in self.samples.values()}) != 1:
            raise ValueError('`samples` must have a row for each sample, as many of each entry, but have not. Write `{"b": [0.1, 0.2]}`.')


@dataclasses.dataclass(frozen=True, eq=False)
class Average(OverSamples):
    r"""A criterion on the average over what the parameters may be, where a guess of them is not to be trusted.

    $$ \min\; \frac{1}{K} \sum_k \psi(F(\theta_k)) $$

    **Arguments:** `samples`: by name of an entry of `params` an array with K as its first axis, such as draws from a prior or a posterior;
    what they leave out has its value in `params`. `criterion`: ψ. **Raises:** `ValueError` if the samples differ in number.

    **Source:** Chaloner & Verdinelli, Statistical Science 10 (1995) 273-304, section 4 (pseudo-Bayesian design).

    ```python
    import jaxlag as jl
    jl.Average({"b": [0.05, 0.1, 0.2]}, jl.Along("b"))
    ```
    """


@dataclasses.dataclass(frozen=True, eq=False)
class Worst(OverSamples):
    r"""A criterion in the worst of several cases that the parameters may be.

    $$ \min\; \max_k \psi(F(\theta_k)) $$

    **Arguments:** `samples`, `criterion`: as of `Average`. **Raises:** `ValueError` if the samples differ in number.

    **Source:** Pronzato & Walter, Mathematical Biosciences 89 (1988) 161-176 (maximin design).

    ```python
    import jaxlag as jl
    jl.Worst({"b": [0.05, 0.1, 0.2]})
    ```
    """


def is_sharp(criterion: Criterion) -> bool:
    """Whether its cost has edges, which are rounded at first: at equal eigenvalues, and where two samples are equally bad."""
    return isinstance(criterion, (EOptimal, Worst)) or (isinstance(criterion, Average) and is_sharp(criterion.criterion))


def total(
    criterion: Criterion, informations: Sequence[tuple[np.ndarray, np.ndarray]], names: Sequence[str], sharpness: float
) -> tuple[float, np.ndarray]:
    """The cost, and its derivatives by what the information of each sample is differentiated by: F (p, p) and dF (p, p, m), of parameters
    in units of their values; edges are rounded to 1/`sharpness`.
    """
    of_each = criterion.criterion if isinstance(criterion, OverSamples) else criterion
    pairs = [_cost(of_each, F, names, sharpness) for F, _ in informations]
    costs = np.array([cost for cost, _ in pairs])
    slopes = np.stack([np.einsum("ij,ijm->m", slope, dF) for (_, slope), (_, dF) in zip(pairs, informations, strict=True)])
    if isinstance(criterion, Worst):
        largest, weights = _largest(costs, sharpness)
        return largest, weights @ slopes
    return float(np.mean(costs)), np.mean(slopes, axis=0)


def _cost(criterion: Criterion, F: np.ndarray, names: Sequence[str], sharpness: float) -> tuple[float, np.ndarray]:
    """That of one sample, and its derivative by F."""
    if isinstance(criterion, DOptimal):
        return -float(np.linalg.slogdet(F)[1]), -np.linalg.inv(F)
    if isinstance(criterion, AOptimal):
        return _of_part(np.linalg.inv(F), np.ones(len(F)))
    if isinstance(criterion, EOptimal):
        values, vectors = np.linalg.eigh(F)
        largest, weights = _largest(-np.log(values), sharpness)
        return largest, -(vectors * (weights / values)) @ vectors.T
    assert isinstance(criterion, Along)
    wanted = listed(criterion.names)
    for name in wanted:
        if not any(is_within(entry, name) for entry in names):
            raise ValueError(f"`Along` must name free parameters, but names {name!r}. Free are {', '.join(names)}.")
    return _of_part(np.linalg.inv(F), np.array([float(any(is_within(entry, name) for name in wanted)) for entry in names]))


def _of_part(C: np.ndarray, chosen: np.ndarray) -> tuple[float, np.ndarray]:
    """log of the sum of chosen variances, and its derivative by C⁻¹."""
    sum_of = float(chosen @ np.diag(C))
    return np.log(sum_of), -(C * chosen) @ C / sum_of


def _largest(x: np.ndarray, sharpness: float) -> tuple[float, np.ndarray]:
    """log Σ exp(k x)/k, and its derivatives."""
    powers = np.exp(sharpness * (x - np.max(x)))
    return float(np.max(x) + np.log(np.sum(powers)) / sharpness), powers / np.sum(powers)
