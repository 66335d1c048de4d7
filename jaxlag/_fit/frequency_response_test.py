"""Measured frequency responses."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Float, PyTree

from .._linear.linear_system import LinearSystem
from .._linear.response import frequencies
from .._model.numbers import numbers
from .._model.paths import listed
from .linear_test import LinearTest

CERTAIN = 4.0  # standard deviations from which on a sign is not that of noise


class FrequencyResponseTest(LinearTest):
    r"""A measured frequency response, to be fitted alone or together with recordings in time.

    $$ \hat G_i = G(i\omega_i) + \sigma_i (e_i + i e'_i), \qquad \sigma = |\hat G| \sqrt{\frac{1 - \gamma^2}{2 n \gamma^2}} $$

    G is the response near an equilibrium or a steady motion, which is found again for all parameters that `fit` tries; e and e' are
    independent and have variance 1.

    **Arguments:**

    - `omega`: (w,), angular frequencies in rad/time.
    - `values`: complex, (w, outputs, inputs), of motions like exp(iωt); axes of length one may be omitted. NaN marks what was not measured.
    - `q`, `qdot`: a guess of the equilibrium, or where `qdot` is given, of the steady motion, structured as for `simulate`.
    - `inputs`: what was excited, by name or names as for `linearise`: a force on a coordinate, an entry of `params`, a moved constraint.
    - `observe`: the sensors, as for `Experiment`; by default all coordinates.
    - `sigma`: standard deviation of the real part and of the imaginary part, a number or structured like `values`; or, in its place,
    - `coherence`, `averages`: γ², between 0 and 1, structured like `values`, and the number n of independent averages behind it. If several
      inputs act at once, use `sigma`.
    - `params`: parameters of this test only, which override those of the fit: an added mass. `fixed`, `fixed_rates`: as for `steady`.

    Any consistent units.

    **Raises:** `ValueError` or `TypeError` if shapes do not fit each other, or neither sigma nor coherence is given, or both are.

    **Source:** Bendat & Piersol, Random Data, 4th ed., section 9.2 (errors of gain and phase); Pintelon & Schoukens, System Identification:
    A Frequency Domain Approach, 2nd ed., chapter 9.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2)
    omega = jnp.linspace(1.0, 10.0, 30)  # rad/s
    response = 1 / (80.0 - 2.0 * omega**2 + 1.5j * omega)  # of m = 2, c = 80, b = 1.5
    test = jl.FrequencyResponseTest(omega, response, 0.0, inputs=["q"], coherence=0.95, averages=50)
    found = jl.fit(oscillator, test, {"m": 2.0, "c": 60.0, "b": 0.5}, free=("m", "c", "b"))
    found.estimates["m"], found.estimates["c"], found.estimates["b"]  # 2.0, 80.0, 1.5
    ```
    """

    omega: Float[Array | np.ndarray, " w"]

    def __init__(
        self,
        omega: Any,
        values: Any,
        q: PyTree,
        qdot: PyTree = None,
        *,
        inputs: str | Sequence[str],
        observe: Callable | None = None,
        sigma: Any = None,
        coherence: Any = None,
        averages: Any = None,
        params: Mapping[str, Any] | None = None,
        fixed: Sequence[str] = (),
        fixed_rates: Sequence[str] = (),
    ):
        self.omega = np.asarray(frequencies(omega))
        values = np.asarray(values)
        if values.dtype.kind not in "fciu" or not 1 <= values.ndim <= 3 or len(values) != len(self.omega):
            raise ValueError(
                f"`values` must be numbers with a row for each of the {len(self.omega)} frequencies, but have shape {values.shape} "
                f"and dtype {values.dtype}. Pass a complex array (frequencies, outputs, inputs)."
            )
        values = np.where(np.isnan(values), np.nan, values) + 0j
        if np.any(np.isinf(values)) or np.all(np.isnan(values)):
            raise ValueError("`values` must be finite, but are infinite or missing throughout. Mark by NaN what was not measured.")
        if not listed(inputs):
            raise ValueError(f"`inputs` must name what was excited, but is {inputs!r}. Write e.g. `inputs=['x']` for a force on x.")
        deviations = _deviations(values, sigma, coherence, averages)
        super().__init__(values, deviations, q, qdot, params, observe, inputs, fixed, fixed_rates)

    def predicted(self, near: LinearSystem) -> PyTree:
        """The response of the linear system `near` at the frequencies of the test."""
        return near.frequency_response(self.omega).reshape(self.values.shape)

    def labels(self, near: LinearSystem) -> list[str]:
        """Names of the channels, output over input of the linear system `near`."""
        return [f"{output}/{given}" for output in near.output_names for given in near.input_names]

    def refuse_misfit(self, near: LinearSystem) -> None:
        """Raises if the linear system `near` has more or fewer outputs or inputs."""
        system, measured = (len(near.output_names), len(near.input_names)), self.values.shape[1:]
        without_ones = lambda shape: [size for size in shape if size != 1]
        if without_ones(system) != without_ones(measured):
            raise ValueError(
                f"`values` must have axes for {system[0]} outputs ({', '.join(near.output_names)}) and {system[1]} inputs "
                f"({', '.join(near.input_names)}), but have shape {self.values.shape}. Give `observe` what was measured."
            )

    def doubts(self, near: LinearSystem) -> list[str]:
        """Whether the imaginary parts have the opposite sign of those of the linear system `near`: then conjugates are nearer to them."""
        seen = np.where(np.isnan(self.values), 0, self.predicted(near)).imag / self.sigma
        measured = np.nan_to_num(self.values).imag / self.sigma
        if np.sum(seen * measured) >= -CERTAIN * np.linalg.norm(seen):
            return []
        return ["its values look like complex conjugates, as of another sign of time, exp(-iωt): pass `values.conj()`"]


def _deviations(values, sigma, coherence, averages):
    """Of the real and of the imaginary part of each value."""
    if (sigma is None) == (coherence is None):
        raise ValueError("`sigma` or `coherence` must say how exact the measurements are, one of both, but not so here. Give either.")
    if sigma is None:
        if averages is None or not (np.ndim(averages) == 0 and averages >= 1):
            raise ValueError(f"`averages` must be the number of averages behind `coherence`, but is {averages!r}. Pass e.g. `averages=50`.")
        square = _like(coherence, "coherence", values)
        if not np.all((square > 0) & (square < 1)):
            raise ValueError(
                "`coherence` must lie between 0 and 1, but has a value that does not; of a single average it is 1 whatever the noise. "
                "Set such `values` to NaN and their coherence to 0.5, or give `sigma`."
            )
        sigma = np.abs(values) * np.sqrt((1 - square) / (2 * averages * square))
        sigma = np.where(np.isnan(values), 1.0, sigma)
    sigma = _like(sigma, "sigma", values)
    if not np.all((sigma > 0) & np.isfinite(sigma)):
        raise ValueError("`sigma` must be positive and finite, but has an entry that is not. Give the standard deviation of either part.")
    return sigma


def _like(given, label, values):
    """Real numbers in the shape of the values, given for all of them or for the first axes."""
    array = np.asarray(numbers(given, f"`{label}`"))
    if array.shape != values.shape[: array.ndim]:
        raise ValueError(f"`{label}` must be a number or structured like `values`, {values.shape}, but has shape {array.shape}. Match it.")
    return np.broadcast_to(array.reshape(array.shape + (1,) * (values.ndim - array.ndim)), values.shape).copy()
