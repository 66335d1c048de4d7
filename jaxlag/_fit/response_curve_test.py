"""Measured response curves of nonlinear machines."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._curves.curve import NOTHING
from .._curves.in_plane import Plane
from .._curves.measures import Measure, measures_of
from .._curves.orbits import HARMONICS, ORDINARY, WIDE, Family, Numbers, Telling, corrected, returned, told
from .._linear.periodic import FINER
from .._linear.return_map import Given, Setting, scales_of
from .._mechanics.friction_treatment import StickSlip
from .._model.event import Every
from .._model.numbers import count, numbers
from .._model.paths import entry_names, leaf_names
from .._model.state_values import given_states, start_values
from .._model.system import System
from .._model.validation import state
from .._motion.scales import tolerances_of
from .experiment import with_own
from .measurement import Prepared, Test, deviation_of

TURNS = 12  # of Newton's method, from a motion that has settled
SETTLED = 1e-3  # of its size: a change of the state in a period, from which on Newton's method finds the motion
MAX_STEPS = 100_000


class ResponseCurveTest(Test):
    r"""Steady vibrations that were measured at several values of a parameter: a sweep with a sine, step by step.

    $$ \hat A_i = A(p_i) + \sigma e_i, \qquad \hat\varphi_i = \varphi(p_i) + \sigma_\varphi e'_i, \qquad
       A = \tfrac12\left(\max_t f - \min_t f\right) \ \text{or}\ |c_n|, \quad \varphi = \arg c_n $$

    The sweep is repeated for all parameters that `fit` tries: from the motion at one value the machine settles for some periods at the
    next, on the branch on which the measured one was, too; Newton's method finds the periodic motion there. Friction that sticks, impacts
    and jumps at folds are part of it. Where the model jumps before the machine did, residuals jump, and a fit may stay there: start with
    too little damping rather than too much, so that its resonance reaches as far as was measured.

    **Arguments:**

    - `values`: (n,), the values of the parameter `over`, in the order of the sweep.
    - `amplitude`: (n,); `phase`: (n,), of f = |cₙ| cos(2π n t/T + φ), in rad. NaN marks what was not measured.
    - `q`, `qdot`: the motion at the start of the sweep, at t = 0, structured as for `simulate`; `states` as there.
    - `over`: the name of a number of params; `period`: of the motion, a function by the argument rule, e.g. `lambda w: 2 * jnp.pi / w`.
    - `of`: the sensor, a function by the argument rule, or the name of a coordinate; by default the only coordinate.
    - `harmonic`: n, where |cₙ| was measured; by default half the distance of extreme values, and the phase of c₁.
    - `sigma`, `phase_sigma`: standard deviations, numbers or (n,).
    - `settle`: periods, at most; `samples`: of a period, for harmonics. `params`: parameters of this test only, which override those of
      the fit.

    Any consistent units.

    **Raises:** `ValueError` or `TypeError` if shapes do not fit each other or an argument is of the wrong kind.

    **Source:** Nayfeh & Mook, Nonlinear Oscillations, section 4.1 (jumps in sweeps); Worden & Tomlinson, Nonlinearity in Structural
    Dynamics, section 3.2 (stepped sines).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(
        lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2,
        dissipation=lambda qdot, d: 0.5 * d * qdot**2,
        force=lambda t, w: jnp.cos(w * t),
    )
    w = jnp.array([0.5, 1.5, 2.5])
    amplitude = 1 / jnp.abs(4.0 - w**2 + 0.3j * w)  # of c = 4, d = 0.3
    test = jl.ResponseCurveTest(w, amplitude, 0.0, 0.0, over="w", period=lambda w: 2 * jnp.pi / w, sigma=1e-3)
    found = jl.fit(oscillator, test, {"c": 3.0, "d": 0.5, "w": 1.0}, free=("c", "d"))
    found.estimates["c"], found.estimates["d"]  # 4.0, 0.3
    ```
    """

    at: Float[Array | np.ndarray, " n"]
    start: dict[str, PyTree]
    over: str = eqx.field(static=True)
    period: Callable = eqx.field(static=True)
    _measure: Measure = eqx.field(static=True)
    harmonic: int | None = eqx.field(static=True)
    settle: int = eqx.field(static=True)
    samples: int = eqx.field(static=True)

    def __init__(
        self,
        values: Any,
        amplitude: Any,
        q: PyTree,
        qdot: PyTree,
        *,
        over: str,
        period: Any,
        sigma: Any,
        phase: Any = None,
        phase_sigma: Any = None,
        of: Callable | str | None = None,
        harmonic: int | None = None,
        settle: int = 30,
        samples: int = 256,
        states: PyTree = None,
        params: Mapping[str, Any] | None = None,
    ):
        self.at = np.asarray(numbers(values, "`values`"))
        if self.at.ndim != 1 or not self.at.size or not np.all(np.isfinite(self.at)):
            raise ValueError("`values` must be a list of finite numbers, but are not. Give the parameter's value for each measurement.")
        q, qdot = state(q, qdot)
        self.start = {"q": q, "qdot": qdot, "states": states}
        self.over, self._measure = over, _measure(of, q)
        if not callable(period):
            raise TypeError(f"`period` must be a function of params, but is {period!r}. Write e.g. `lambda w: 2 * jnp.pi / w`.")
        self.period = period
        self.harmonic = None if harmonic is None else count(harmonic, "`harmonic`", cure="Give 1 for the first.")
        if self.harmonic is not None and self.harmonic > HARMONICS:
            raise ValueError(f"`harmonic` must be at most {HARMONICS}, but is {harmonic}. Measure a lower one.")
        self.settle = count(settle, "`settle`", cure="Give some periods, e.g. 30.")
        self.samples = count(samples, "`samples`", least=32, cure="Give e.g. 256.")
        measured, deviations = {"amplitude": self._column(amplitude, "amplitude")}, {"amplitude": sigma}
        if (phase is None) != (phase_sigma is None):
            raise ValueError("`phase` and `phase_sigma` must come together, but one is missing. Give both, or none.")
        if phase is not None:
            measured["phase"], deviations["phase"] = self._column(phase, "phase"), phase_sigma
        self.values = measured
        try:
            self.sigma = {name: deviation_of(deviations[name], z) for name, z in measured.items()}
        except ValueError as error:
            label = "`sigma` and `phase_sigma` must be positive numbers, one for all values or one for each"
            raise ValueError(f"{label}, but are not: {error}. Give the standard deviations.") from None
        self.params = dict(params or {})

    def _column(self, given: Any, label: str) -> np.ndarray:
        column = np.asarray(numbers(given, f"`{label}`"))
        if column.shape != self.at.shape or np.any(np.isinf(column)) or np.all(np.isnan(column)):
            raise ValueError(
                f"`{label}` must be {self.at.size} finite numbers, one for each of `values`, but is not. Mark a missing one by NaN."
            )
        return column

    def prepared(self, system: System, params: PyTree) -> "Swept":
        """What a fit keeps of it, at the start `params`."""
        names = leaf_names(with_own(params, self.params), "params")
        if self.over not in names:
            raise ValueError(f"`over` must name one number of `params`, but is {self.over!r}. The entries are {', '.join(names)}.")
        return Swept(self, None)


def _measure(of: Any, q: PyTree) -> Measure:
    """The sensor."""
    names = entry_names(q, "q")
    if callable(of):
        return measures_of({"response": of}, q)[0]
    if of is None and len(names) == 1:
        return Measure(names[0], None, 0)
    if of not in names:
        raise ValueError(f"`of` must be a function, or name a coordinate, but is {of!r}. The coordinates are {', '.join(names)}.")
    return Measure(of, None, names.index(of))


class Swept(Prepared):
    """A sweep as a fit predicts it."""

    test: ResponseCurveTest

    def predictions(self, system: System, params: PyTree) -> PyTree:
        """The amplitude and the phase at each value, on the branch that the sweep follows; NaN where it does not settle."""
        test, fixed = self.test, jax.lax.stop_gradient
        params = with_own(params, test.params)
        q, qdot = test.start["q"], test.start["qdot"]
        zero = jnp.zeros((), jax.tree.leaves(q)[0].dtype)
        states = start_values(system, given_states(system, test.start["states"], q), zero, q, qdot, params)
        start = {"q": q, "qdot": qdot, "states": states}
        flat = ravel_pytree(start)[0]
        rtol, atol = tolerances_of(None, None, q)
        setting = Setting(Every(test.period), tuple(range(flat.size)), StickSlip(), None, MAX_STEPS)
        family = Family(system, setting, leaf_names(params, "params").index(test.over))
        values = jnp.asarray(test.at, flat.dtype)
        width = jnp.max(values) - jnp.min(values)
        width = jnp.where(width > 0, width, 1)
        moving = Numbers(Given(fixed(start), params, zero, zero, (FINER * rtol, atol)), zero, width)
        still = fixed(moving)
        along = jnp.zeros(flat.size + 1, flat.dtype).at[-1].set(1.0)

        def at(x, value):
            """The motion at the next value."""

            def period(carry):
                """One period of settling: the state, by how much it has changed in its units, these units, and how many there were."""
                x, *_, i = carry
                change, _, frame = returned(family, still, jnp.append(x, value))
                sizes = scales_of(frame)
                return x + change, jnp.max(jnp.abs(change) / sizes, initial=0.0), sizes, i + 1

            settles = lambda carry: (carry[1] > SETTLED) & (carry[3] < test.settle)
            start = x, jnp.full((), jnp.inf, x.dtype), jnp.ones_like(x), jnp.array(0)
            settled, _, sizes, _ = jax.lax.while_loop(settles, period, start)
            z, scale = jnp.append(settled, value), jnp.append(WIDE * sizes, width)
            plane = Plane(z, along, scale, (jnp.asarray(NOTHING), jnp.asarray(NOTHING)))
            near = corrected(family, still, plane, jnp.asarray(TURNS))
            found = told(family, Telling((test._measure,), test.samples, ORDINARY), moving, plane._replace(z=near.z)).measured[0]
            c = found.harmonics[test.harmonic or 1]
            amplitude = (found.highest - found.lowest) / 2 if test.harmonic is None else jnp.abs(c)
            known = lambda x: jnp.where(near.found, x, jnp.nan)
            return jnp.where(near.found, near.z[:-1], settled), (known(amplitude), known(jnp.angle(c)))

        _, (amplitude, phase) = jax.lax.scan(at, fixed(flat), values)
        if "phase" not in test.values:
            return {"amplitude": amplitude}
        measured = jnp.where(jnp.isfinite(test.values["phase"]), test.values["phase"], 0)
        return {"amplitude": amplitude, "phase": phase + 2 * jnp.pi * jnp.round((measured - fixed(phase)) / (2 * jnp.pi))}
