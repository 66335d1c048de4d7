"""How well each channel of a recording is predicted."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from .._model.paths import entry_names
from .autocorrelation import autoregression, correlation_length, whiteness


class Channel(NamedTuple):
    r"""How well one scalar channel of an experiment is predicted; an entry of `Fit.channels` and `Validation.channels`.

    $$ R^2 = 1 - \frac{|z - \hat z|^2}{|z - \bar z|^2}, \qquad \text{fit} = 100 \left(1 - \frac{|z - \hat z|}{|z - \bar z|}\right) $$

    - `experiment`: the number of the experiment; `name`: of the channel, e.g. `"y"`, `"force[1]"`; `samples`: how many were measured.
    - `fit_percent`: the fit in percent; `r_squared`: R².
    - `rms`: root mean square of the residuals, in the unit of the channel.
    - `whiteness`: the p-value of the Ljung–Box test that residuals are independent; small where the model misses something. NaN for modes
      and frequency responses.
    - `correlation_length`: the number of samples over which the residuals are correlated, 0 if they are white.

    **Source:** Ljung, System Identification, 2nd ed., sections 16.4 and 16.6; Ljung & Box, Biometrika 65 (1978) 297.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    ts = jnp.linspace(0.0, 3.0, 50)
    fit = jl.fit(oscillator, jl.Experiment(ts, jnp.cos(2.0 * ts), 1.0, 0.0), {"c": 3.0}, free=("c",))
    fit.channels[0].samples  # 50
    ```
    """

    experiment: int
    name: str
    samples: int
    fit_percent: float
    r_squared: float
    rms: float
    whiteness: float
    correlation_length: int


def channels_of(number: int, values: PyTree, residuals: PyTree) -> list[Channel]:
    """Each scalar channel of an experiment, in flat order."""
    columns = lambda tree: [z for leaf in jax.tree.leaves(tree) for z in np.reshape(np.asarray(leaf), (len(leaf), -1)).T]
    return [channel(number, *one) for one in zip(channel_names(values), columns(values), columns(residuals), strict=True)]


def channel_names(values: PyTree) -> list[str]:
    """The names of the scalar channels, in flat order."""
    return [name or "z" for name in entry_names(jax.tree.map(lambda leaf: np.zeros(np.shape(leaf)[1:]), values))]


def channel(number: int, name: str, z: np.ndarray, r: np.ndarray, *, in_time: bool = True) -> Channel:
    """A channel of the measurements z, real or complex, and their residuals r, which may be correlated where they are of one record."""
    there = np.isfinite(z) & np.isfinite(r)
    z, r = z[there], r[there]
    around_mean, off = np.linalg.norm(z - np.mean(z)) if z.size else np.nan, np.linalg.norm(r)
    part = off / around_mean if around_mean > 0 else np.nan
    white, correlated = (whiteness(r), correlation_length(autoregression(r), z.size)) if in_time else (np.nan, 0)
    fit, r_squared, rms = float(100 * (1 - part)), float(1 - part**2), float(off / np.sqrt(max(z.size, 1)))
    return Channel(number, name, z.size, fit, r_squared, rms, white, correlated)
