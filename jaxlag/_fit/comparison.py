"""Comparison of models of the same data."""

import dataclasses
from collections.abc import Mapping

import jax
import numpy as np

from .result import Fit


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Models of the same data, as `compare` returns them; prints as a table.

    - `names`: the models, best first by Schwarz's criterion.
    - `aic`, `bic`: by name, the differences from the smallest value of each criterion; dimensionless.
    - `parameters`: by name, the number of unknowns.
    - `correlation_length`: the number of samples over which the residuals of the best model are correlated, 0 if they are white. Both
      criteria assume independent residuals, and otherwise overstate the evidence.
    - `unconverged`: names of the models whose fits have not converged, which may be better than they look.
    - `priors`: by name of a model, the numbers on which its fit had priors; they are no part of the likelihood.

    ```python
    import jaxlag as jl
    table = jl.results.Comparison(("a", "b"), {"a": 0.0, "b": 9.0}, {"a": 0.0, "b": 7.0}, {"a": 1, "b": 2}, 0)
    table.names[0]  # a
    ```
    """

    names: tuple[str, ...]
    aic: dict[str, float]
    bic: dict[str, float]
    parameters: dict[str, int]
    correlation_length: int
    unconverged: tuple[str, ...] = ()
    priors: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)

    def __repr__(self) -> str:
        width = max(map(len, self.names))
        rows = [
            f"  {name:<{width}}  {self.parameters[name]:3d} parameters   ΔAIC {self.aic[name]:10.2f}   ΔBIC {self.bic[name]:10.2f}"
            for name in self.names
        ]
        best, second = self.names[:2]
        strength = next(word for limit, word in EVIDENCE if self.bic[second] >= limit)
        if {best, second} & set(self.unconverged):
            strength = "none, until both fits have converged"
        evidence = [f"  evidence for {best!r} against {second!r}: {strength}"]
        if self.correlation_length:
            evidence.append(f"  ! overstated: residuals of {best!r} are correlated over {self.correlation_length} samples")
        evidence += [f"  ! the fit of {name!r} has not converged: the model may be better than it looks" for name in self.unconverged]
        evidence += [f"  {name!r} had priors on {', '.join(numbers)}; only data count here" for name, numbers in self.priors.items()]
        return "\n".join(["Comparison: smaller is better", *rows, *evidence])


DATA = "ts", "values", "sigma"
EVIDENCE = ((10, "very strong"), (6, "strong"), (2, "positive"), (0, "not worth more than a bare mention"))  # by ΔBIC


def compare(fits: Mapping[str, Fit]) -> Comparison:
    r"""Compares models of the same data by their misfit and number of parameters: does the machine really have a damper?

    $$ \mathrm{AIC} = -2 \ln L + 2 p, \qquad \mathrm{BIC} = -2 \ln L + p \ln N $$

    with the likelihood L of the data alone, p unknowns and N measurements; all dimensionless.

    **Arguments:** `fits`: at least two, by name, of the same measurements. **Returns:** a `Comparison`.

    **Raises:** `ValueError` if there are fewer than two fits, or they are of different data.

    **Source:** Burnham & Anderson, Model Selection and Multimodel Inference (2002), section 2.2; the words for ΔBIC: Kass & Raftery,
    J. Am. Stat. Assoc. 90 (1995) 773.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    record = jl.Experiment(ts, jnp.cos(2.0 * ts) + 0.01 * jnp.sin(999.0 * ts), q0=1.0, qdot0=0.0)
    params = {"c": 3.0, "b": 0.0}
    fits = {"undamped": jl.fit(oscillator, record, params, free=("c",)), "damped": jl.fit(oscillator, record, params, free=("c", "b"))}
    jl.compare(fits).names[0]  # undamped
    ```
    """
    if len(fits) < 2:
        raise ValueError(f"`fits` must be at least two, but there are {len(fits)}. Fit another model to the same data.")
    if len({(f.measurements, f.absolute, _fingerprint(f)) for f in fits.values()}) > 1:
        raise ValueError("`fits` must be of the same measurements with the same sigma and loss, but differ. Fit all models to one set.")
    names = tuple(sorted(fits, key=lambda name: fits[name].bic))
    least = {which: min(getattr(f, which) for f in fits.values()) for which in ("aic", "bic")}
    above = lambda which: {name: getattr(fits[name], which) - least[which] for name in names}
    counts, unconverged = {name: fits[name].unknown_count for name in names}, tuple(name for name in names if not fits[name].converged)
    known = lambda f: [n for n, s in zip(f.names, np.asarray(f.problem.free.prior_deviation), strict=True) if np.isfinite(s)]
    priors = {name: tuple(known(fits[name])) for name in names if known(fits[name])}
    return Comparison(names, above("aic"), above("bic"), counts, fits[names[0]].correlation_length, unconverged, priors)


def _fingerprint(f):
    """Numbers that are equal for fits of the same data."""
    numbers = [
        np.asarray(leaf).tobytes()
        for e in f.experiments
        for which in ("ts", "values", "sigma")
        for leaf in jax.tree.leaves(getattr(e, which, None))
    ]
    return hash(tuple(numbers)), f.problem.model.loss
