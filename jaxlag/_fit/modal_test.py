"""Measured natural frequencies and damping ratios."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._linear.linear_system import LinearSystem
from .._linear.modes import damping_ratios, of_first_order
from .._model.numbers import numbers
from .._model.paths import entry_names
from .._model.validation import coordinates
from .experiment import Coordinates
from .linear_test import LinearTest

DOUBTFUL = 0.5  # modal assurance below which two shapes are hardly those of one mode


class ModalTest(LinearTest):
    r"""Natural frequencies and damping ratios from a modal test, to be fitted alone or together with recordings in time.

    $$ f_i = \frac{|\lambda_i|}{2\pi} + \sigma_i e_i, \qquad
       \zeta_i = -\frac{\mathrm{Re}\,\lambda_i}{|\lambda_i|} + \varsigma_i e'_i, \qquad
       \mathrm{MAC}(\varphi, \psi) = \frac{|\varphi^H \psi|^2}{\varphi^H\varphi\;\psi^H\psi} $$

    λ are the eigenvalues near an equilibrium or a steady motion, which is found again for all parameters that `fit` tries.

    **Arguments:**

    - `frequency`: (k,), natural frequencies f (of the undamped oscillation) of k modes in 1/time, in Hz where times are in s.
    - `q`, `qdot`: a guess of the equilibrium, or where `qdot` is given, of the steady motion, structured as for `simulate`.
    - `sigma`: their standard deviation in 1/time, a number or (k,); if the report states none, the resolution of its spectra.
    - `damping_ratio`, `damping_sigma`: ζ, (k,), and its standard deviation, a number or (k,).
    - `shapes`: what the sensors see of each mode: a pytree like the one that `observe` returns, with the modes as first axis; real or
      complex, of any scale. Each is paired with the predicted mode of the most similar shape, by the modal assurance criterion MAC; sensors
      should have one unit. Shapes only pair modes: they are no measurements. Without shapes, modes are paired in ascending order, the first
      with the lowest that oscillates. A fit that would begin where modes have one frequency begins 1 % beside it.
    - `observe`: the sensors, as for `Experiment`; by default the coordinates named in `shapes`.
    - `params`: parameters of this test only, which override those of the fit: an added mass. `fixed`, `fixed_rates`: as for `steady`.

    Frequencies and damping ratios that were not measured are NaN. Any consistent units. As fields, `values` and `sigma` hold both kinds by
    name; `inputs` is empty.

    **Raises:** `ValueError` or `TypeError` if lengths differ, a sigma is missing, or shapes are of a single number.

    **Source:** Ewins, Modal Testing, 2nd ed., chapter 5; Allemang & Brown, Proc. 1st Int. Modal Analysis Conf. (1982) 110 (MAC).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2)
    test = jl.ModalTest([1.0], 0.0, sigma=0.001, damping_ratio=[0.05], damping_sigma=0.002)
    found = jl.fit(oscillator, test, {"m": 2.0, "c": 60.0, "b": 0.5}, free=("c", "b"))
    found.estimates["c"]  # m (2π f)² = 78.96
    found.estimates["b"]  # 2 ζ √(m c) = 1.257
    ```
    """

    shapes: PyTree

    def __init__(
        self,
        frequency: Any,
        q: PyTree,
        qdot: PyTree = None,
        *,
        sigma: Any = None,
        damping_ratio: Any = None,
        damping_sigma: Any = None,
        shapes: PyTree = None,
        observe: Callable | None = None,
        params: Mapping[str, Any] | None = None,
        fixed: Sequence[str] = (),
        fixed_rates: Sequence[str] = (),
    ):
        values, sigmas = {"frequency": _each_mode(frequency, "frequency")}, {}
        count = len(values["frequency"])
        sigmas["frequency"] = _deviation(sigma, "sigma", count)
        if damping_ratio is not None:
            values["damping_ratio"] = _each_mode(damping_ratio, "damping_ratio", count)
            sigmas["damping_ratio"] = _deviation(damping_sigma, "damping_sigma", count)
        if np.any(values["frequency"] <= 0):
            raise ValueError("`frequency` must be positive, but holds one that is not. Leave out modes that do not oscillate.")
        self.shapes = None if shapes is None else jax.tree.map(np.asarray, shapes, is_leaf=_is_table)
        if shapes is not None:
            _check_shapes(self.shapes, count)
            observe = observe or Coordinates.named_by(self.shapes, coordinates(q, "q"), "shapes")
        super().__init__(values, sigmas, q, qdot, params, observe, (), fixed, fixed_rates)

    def predicted(self, near: LinearSystem) -> PyTree:
        """Frequencies and damping ratios of the linear system `near`, for the measured modes; NaN for one that does not oscillate."""
        values, _, _ = self.paired(near)
        found = {"frequency": jnp.abs(values) / (2 * jnp.pi), "damping_ratio": damping_ratios(values)}
        return {name: found[name] for name in self.values}

    def paired(self, near: LinearSystem) -> tuple[Array, Float[Array, " k"], Float[Array, " k"]]:
        """For each measured mode the paired eigenvalue of the system `near`, the agreement of the two shapes, and the best of any pair."""
        found = of_first_order(near.A, near.sample_time)
        oscillates, count = found.values.imag > 0, len(self.values["frequency"])
        if self.shapes is None:
            order = jnp.argsort(jnp.where(oscillates, jax.lax.stop_gradient(jnp.abs(found.values)), jnp.inf))[:count]
            chosen, agreement = order, jnp.ones((count, len(found.values)))
        else:
            seen = jax.lax.stop_gradient(near.C @ found.vectors)
            agreement = jnp.where(oscillates[None, :], assurance(_rows(self.shapes), seen.T), -1.0)
            chosen = one_to_one(agreement)
        values = jnp.where(oscillates, found.values, jnp.nan)[chosen]
        return values, jnp.take_along_axis(agreement, chosen[:, None], axis=1)[:, 0], jnp.max(agreement, axis=1)

    def refuse_misfit(self, near: LinearSystem) -> None:
        """Raises if fewer modes of the linear system `near` oscillate, or if its outputs differ."""
        count, there = len(self.values["frequency"]), int(np.sum(np.asarray(near.eigenvalues).imag > 0))
        if count > there:
            raise ValueError(f"`frequency` must be of modes that the system has, but {count} are given and {there} oscillate. Give fewer.")
        if self.shapes is not None:
            names = entry_names(jax.tree.map(lambda x: x[0], self.shapes), "y")
            if names != near.output_names:
                seen = ", ".join(near.output_names)
                raise ValueError(
                    f"`shapes` must hold what `observe` returns, {seen}, but holds {', '.join(names)}. Give both the same names."
                )

    def is_singular(self, near: LinearSystem) -> bool:
        """Whether modes of the linear system `near` have one frequency: only its mean over them has a derivative."""
        found = of_first_order(near.A, near.sample_time)
        return bool(np.any(np.asarray(found.repeated & (found.values.imag > 0))))

    def doubts(self, near: LinearSystem) -> list[str]:
        """Modes that may have been paired with the wrong ones of the linear system `near`."""
        _, agreement, most = map(np.asarray, self.paired(near))
        return [
            f"its mode {i} may be paired with the wrong one: the shapes agree by {own:.2f} (modal assurance criterion)"
            + (f", and by {best:.2f} with another" if best > own else "")
            for i, (own, best) in enumerate(zip(agreement, most, strict=True))
            if own < DOUBTFUL or best > own
        ]


def assurance(shapes: Any, others: Any) -> Float[Array, "k d"]:
    """The modal assurance criterion of each of some shapes with each of others; rows."""
    norms = lambda x: jnp.sum(jnp.abs(x) ** 2, axis=1)
    product = jnp.outer(norms(shapes), norms(others))
    return jnp.abs(jnp.conj(shapes) @ others.T) ** 2 / jnp.where(product > 0, product, 1)


def one_to_one(agreement: Float[Array, "k d"]) -> Array:
    """For each row a column of its own, the pairs of the largest entries first."""

    def turn(_, carry):
        left, chosen = carry
        i, j = jnp.divmod(jnp.argmax(left), left.shape[1])
        return left.at[i].set(-jnp.inf).at[:, j].set(-jnp.inf), chosen.at[i].set(j)

    return jax.lax.fori_loop(0, len(agreement), turn, (agreement, jnp.zeros(len(agreement), int)))[1]


def _is_table(node):
    """Whether lists of numbers stand for an array."""
    return isinstance(node, list) and not any(hasattr(entry, "shape") for entry in node)


def _rows(shapes):
    """One row for each mode, as a linear system has its outputs."""
    return jnp.concatenate([jnp.reshape(leaf, (len(leaf), -1)) for leaf in jax.tree.leaves(shapes)], axis=1)


def _check_shapes(shapes, count):
    for leaf in jax.tree.leaves(shapes):
        if leaf.shape[:1] != (count,) or leaf.dtype.kind not in "fciu" or not np.all(np.isfinite(leaf)):
            raise ValueError(f"`shapes` must hold finite numbers for each of the {count} modes, but does not. Put the modes first.")
    rows = np.asarray(_rows(shapes))
    if rows.shape[1] < 2 or not np.all(np.any(rows, axis=1)):
        raise ValueError("`shapes` must tell modes apart, but are of one sensor alone, or one is zero. Leave them out: modes go in order.")


def _each_mode(given, label, count=None):
    values = np.asarray(numbers(given, f"`{label}`"))
    if values.ndim != 1 or (count is not None and len(values) != count) or not len(values):
        expected = "each mode" if count is None else f"each of the {count} modes"
        raise ValueError(f"`{label}` must have one number for {expected}, but has shape {values.shape}. NaN stands for an unknown one.")
    if np.any(np.isinf(values)) or np.all(np.isnan(values)):
        raise ValueError(f"`{label}` must be finite, but is infinite or missing throughout. Mark by NaN what was not measured.")
    return values


def _deviation(given, label, count):
    if given is None:
        raise ValueError(
            f"`{label}` must say how exact the measurements are, but is missing. "
            "Give their standard deviation; if the report states none, the resolution of its spectra, 1/(duration of a record)."
        )
    sigma = np.asarray(numbers(given, f"`{label}`"))
    if sigma.shape not in ((), (count,)) or not np.all((sigma > 0) & np.isfinite(sigma)):
        raise ValueError(f"`{label}` must be positive, one number or one for each of {count} modes, but is {given}. Give deviations.")
    return np.broadcast_to(sigma, (count,)).copy()
