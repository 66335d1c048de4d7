"""What makes one experiment better than another: numbers made of the information that it gives."""

import abc
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from .._model.paths import is_within, listed


class Criterion(abc.ABC):
    """A cost of the information F (p, p) of parameters in units of their values; the smaller, the better."""

    @property
    def sharp(self) -> bool:
        """Whether the cost has edges, which are rounded at first."""
        return False

    @abc.abstractmethod
    def cost(self, F: Float[np.ndarray, "p p"], names: Sequence[str], sharpness: float) -> tuple[float, np.ndarray]:
        """The cost and its derivative by F; edges are rounded to 1/`sharpness`."""


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

    def cost(self, F: Float[np.ndarray, "p p"], names: Sequence[str], sharpness: float) -> tuple[float, np.ndarray]:
        """−log det F."""
        return -float(np.linalg.slogdet(F)[1]), -np.linalg.inv(F)


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

    def cost(self, F: Float[np.ndarray, "p p"], names: Sequence[str], sharpness: float) -> tuple[float, np.ndarray]:
        """log tr F⁻¹."""
        return _of_part(np.linalg.inv(F), np.ones(len(F)))


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

    @property
    def sharp(self) -> bool:
        """At equal eigenvalues."""
        return True

    def cost(self, F: Float[np.ndarray, "p p"], names: Sequence[str], sharpness: float) -> tuple[float, np.ndarray]:
        """log of the largest eigenvalue of F⁻¹."""
        values, vectors = np.linalg.eigh(F)
        largest, weights = _largest(-np.log(values), sharpness)
        return largest, -(vectors * (weights / values)) @ vectors.T


@dataclasses.dataclass(frozen=True)
class Along(Criterion):
    r"""The smallest relative error of one parameter, or of a few, whatever becomes of the others.

    $$ \min\; \log \sum_{j \in \text{names}} \left(\frac{\mathrm{se}(\theta_j)}{\theta_j}\right)^2 $$

    **Arguments:** `names`: of `free`, one or several.

    **Source:** Atkinson, Donev & Tobias, Optimum Experimental Designs, with SAS (2007), sections 10.2 and 10.3.

    ```python
    import jaxlag as jl
    jl.Along("F")
    ```
    """

    names: str | Sequence[str]

    def cost(self, F: Float[np.ndarray, "p p"], names: Sequence[str], sharpness: float) -> tuple[float, np.ndarray]:
        """log of the sum of some variances."""
        wanted = listed(self.names)
        for name in wanted:
            if not any(is_within(entry, name) for entry in names):
                raise ValueError(f"`Along` must name free parameters, but names {name!r}. Free are {', '.join(names)}.")
        chosen = np.array([float(any(is_within(entry, name) for name in wanted)) for entry in names])
        return _of_part(np.linalg.inv(F), chosen)


@dataclasses.dataclass(frozen=True, eq=False)
class OverSamples(Criterion):
    """A criterion at several values of the parameters together; `samples`: by name of an entry of `params`, (K, ...)."""

    samples: Mapping[str, Any]
    criterion: Criterion = DOptimal()

    def __post_init__(self):
        if not isinstance(self.samples, Mapping) or len({len(np.atleast_1d(x)) for x in self.samples.values()}) != 1:
            raise ValueError('`samples` must have a row for each sample, as many of each entry, but have not. Write `{"b": [0.1, 0.2]}`.')

    @abc.abstractmethod
    def together(self, costs: Float[np.ndarray, " K"], sharpness: float) -> tuple[float, np.ndarray]:
        """One cost of many, and its derivatives by them."""

    def cost(self, F: Float[np.ndarray, "p p"], names: Sequence[str], sharpness: float) -> tuple[float, np.ndarray]:
        """That of one sample."""
        return self.criterion.cost(F, names, sharpness)


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

    @property
    def sharp(self) -> bool:
        """As the criterion."""
        return self.criterion.sharp

    def together(self, costs: Float[np.ndarray, " K"], sharpness: float) -> tuple[float, np.ndarray]:
        """The mean."""
        return float(np.mean(costs)), np.full(len(costs), 1 / len(costs))


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

    @property
    def sharp(self) -> bool:
        """Where two cases are equally bad."""
        return True

    def together(self, costs: Float[np.ndarray, " K"], sharpness: float) -> tuple[float, np.ndarray]:
        """The largest, rounded."""
        return _largest(costs, sharpness)


def total(
    criterion: Criterion, informations: Sequence[tuple[np.ndarray, np.ndarray]], names: Sequence[str], sharpness: float
) -> tuple[float, np.ndarray]:
    """The cost, and its derivatives by what the information of each sample is differentiated by: F (p, p) and dF (p, p, m)."""
    costs, slopes = [], []
    for F, dF in informations:
        cost, slope = criterion.cost(F, names, sharpness)
        costs.append(cost)
        slopes.append(np.einsum("ij,ijm->m", slope, dF))
    if not isinstance(criterion, OverSamples):
        return costs[0], slopes[0]
    together, weights = criterion.together(np.array(costs), sharpness)
    return together, weights @ np.stack(slopes)


def _of_part(C: np.ndarray, chosen: np.ndarray) -> tuple[float, np.ndarray]:
    """log of the sum of chosen variances, and its derivative by C⁻¹."""
    sum_of = float(chosen @ np.diag(C))
    return np.log(sum_of), -(C * chosen) @ C / sum_of


def _largest(x: np.ndarray, sharpness: float) -> tuple[float, np.ndarray]:
    """log Σ exp(k x)/k, and its derivatives."""
    powers = np.exp(sharpness * (x - np.max(x)))
    return float(np.max(x) + np.log(np.sum(powers)) / sharpness), powers / np.sum(powers)
