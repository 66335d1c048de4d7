"""Experiments: recordings of a motion with noise and missing samples, and what is known about them."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._model.injection import check_function
from .._model.paths import entry_names, is_within, labels, listed
from .._model.recorded import delays, deviations, measured_values, with_events
from .._model.tables import of_frame, of_text, scaled, write_text
from .._model.validation import parameters, sample_times, state
from .._program.jit import is_concrete


class Experiment(eqx.Module):
    r"""A recording of the system's motion, and how it was measured.

    $$ z_i = h(t_i, q, \dot q, \ddot q, \lambda) + \sigma_i e_i, \qquad e_i \text{ independent, of variance 1} $$

    **Arguments:**

    - `ts`: (T,), the times of the samples, in order, with any intervals; the motion starts at ts[0]. What was measured again at one time
      may stand beside it as another sample of the same time.
    - `values`: the measurements z, any pytree of arrays (T, ...), e.g. `{"y": ..., "phi": ...}`. NaN is a missing sample. None for an
      experiment that is only planned (`jaxlag.information`), or of which only `events` were recorded.
    - `q0`, `qdot0`: the state at ts[0], structured as for `simulate`; where it is unknown, a guess.
    - `observe`: the sensors h: a function that returns one sample, structured like one row of `values`. It receives the arguments it names,
      out of `t`, `q`, `qdot`, `qddot`, `multipliers`, `params`, the entries of `params` and the states of the system; gains and offsets of
      sensors are parameters like any others. Default: the coordinates named in `values`, or q as a whole. Use one function for all
      experiments of a kind: they then run as a batch, whereas each new function is compiled again.
    - `sigma`: σ, the standard deviation of the noise: a number, or a pytree like `values` with one for each channel or sample. By
      default, one for each channel is estimated from the residuals.
    - `params`: parameters of this experiment only, which override those of the fit: a payload, a measured input (`Signal`).
    - `unknown`: what is to be estimated for this experiment alone: `"q0"`, `"qdot0"`, coordinates of them (`"qdot0.x"`), or entries of its
      own `params`. An unknown start moves within the constraints.
    - `delay`: the time by which the sensors lag behind the motion: a number, or a function of parameters, for all channels but `events`;
      or by channel, `{"laser": lambda lag: lag}`, where the others have none. Until it has passed, they show the state at ts[0]; `events`
      are heard so much later.
    - `events`: by the name of an event of the system, the times at which it was observed, in order, such as clicks in a sound recording,
      between ts[0] and ts[-1]; NaN for one that was missed. Each is a further channel, with its own `sigma`; `values` must then be a
      mapping, or None. A motion with fewer events cannot be fitted.

    Units are any consistent set.

    **Raises:** `ValueError` or `TypeError` if times, values and sigma are not real numbers or do not fit each other, an event lies outside
    the record, the start is not finite, `observe` is missing though `values` does not name coordinates, or `unknown` names something else.

    **Source:** Ljung, System Identification, 2nd ed., section 7.2.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    ts = jnp.linspace(0.0, 1.0, 5)
    jl.Experiment(ts, {"position": jnp.cos(ts)}, q0=1.0, qdot0=0.0, observe=lambda q: {"position": q}, sigma=1e-3)
    ```
    """

    ts: Float[Array | np.ndarray, " T"]
    values: PyTree
    q0: PyTree
    qdot0: PyTree
    sigma: PyTree | None
    params: dict[str, Any]
    observe: Callable = eqx.field(static=True)
    unknown: tuple[str, ...] = eqx.field(static=True)
    delay: Callable | float | tuple[tuple[str, Any], ...] | None = eqx.field(static=True)  # pairs, where it is by channel
    events: tuple[str, ...] = eqx.field(static=True)  # channels of `values` that are times of events, (K,)

    def __init__(
        self,
        ts: Any,
        values: PyTree,
        q0: PyTree,
        qdot0: PyTree,
        *,
        observe: Callable | None = None,
        sigma: PyTree | None = None,
        params: Mapping[str, Any] | None = None,
        unknown: Sequence[str] = (),
        delay: Callable | float | Mapping[str, Any] | None = None,
        events: Mapping[str, Any] | None = None,
    ):
        self.q0, self.qdot0 = state(q0, qdot0, ("q0", "qdot0"))
        for which, tree in (("q0", self.q0), ("qdot0", self.qdot0)):
            if is_concrete(tree) and not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(tree)):
                raise ValueError(f"`{which}` must be finite, but has a missing value. Give a guess, and name it in `unknown`.")
        dtype = jax.tree.leaves(self.q0)[0].dtype
        self.ts = sample_times(ts, dtype, repeated=True)
        values = {} if values is None and events else measured_values(values, self.ts, dtype)
        self.values = with_events(values, events, self.ts, dtype, late=delay if isinstance(delay, Mapping) else ())
        self.sigma = None if sigma is None else deviations(sigma, self.values)
        self.events = tuple(events or ())
        self.observe = Coordinates.named_by(values, self.q0) if observe is None else observe
        if params is not None and not isinstance(params, Mapping):
            raise TypeError(f"`params` of an experiment must be a mapping, but is a {type(params).__name__}. Name its entries in a dict.")
        self.params = dict(parameters(params or {}, self.q0))
        check_function(self.observe, "`observe`")
        self.unknown = listed(unknown)
        self.delay = delays(delay, self.values)
        for name in self.unknown:
            self._check_unknown(name)

    def _check_unknown(self, name):
        known = [*start_entries(self), *self.params]
        if not (name in self.params or any(is_within(entry, name) for entry in start_entries(self))):
            raise ValueError(
                f"`unknown` must name q0, qdot0, entries of them or of the experiment's own params, but holds {name!r}. "
                f"There are q0, qdot0, {', '.join(known)}."
            )

    @classmethod
    def from_csv(
        cls,
        file: str | Path | Sequence[str | Path],
        q0: PyTree,
        qdot0: PyTree,
        *,
        time: str | tuple[str, float],
        columns: Any = None,
        from_zero: bool = False,
        delimiter: str | None = None,
        decimal: str | None = None,
        encoding: str = "utf-8-sig",
        **more: Any,
    ) -> Any:
        """An experiment from a text file with a table, whose first line names the columns; an empty cell is a missing sample.

        **Arguments:**

        - `file`: its path, or a list of paths, of which a list of experiments is made.
        - `time`: the column of times: its name, or (name, factor), `("time_ms", 1e-3)`. Dates, by ISO 8601 or as 28.11.2026, become
          seconds from the first one.
        - `columns`: those to use: names, or a mapping from channels to names or (name, factor): `{"x": ("laser_mm", 1e-3)}`. Default: all.
        - `from_zero`: whether times count from the first sample, as those of a Unix clock should.
        - `delimiter`: between the cells; by default a tab, a semicolon or a comma, whichever the first line holds. `decimal`: "." or ",";
          by default commas are points, unless they separate the cells. `encoding`: of the text. A second line of units is skipped.
        - `q0`, `qdot0`, `**more`: as for `Experiment`.

        **Returns:** an `Experiment` with `values` by channel, each of shape (T,); or a list of them.

        **Raises:** `ValueError` if a column does not exist, a cell is not a number, or a column has two decimal marks.

        ```python
        import jaxlag as jl
        from jaxlag.examples import vehicle
        record = jl.Experiment.from_csv(vehicle.recording, vehicle.q0, vehicle.qdot0, time="t", columns={"y": ("y", 1e3)})  # y in mm
        len(record.ts)  # 1000
        ```
        """
        if not isinstance(file, (str, Path)):
            how = {"time": time, "columns": columns, "from_zero": from_zero, "delimiter": delimiter, "decimal": decimal}
            return [cls.from_csv(one, q0, qdot0, **how, encoding=encoding, **more) for one in file]
        name = time if isinstance(time, str) else time[0]
        ts, values = scaled(*of_text(file, name, delimiter, decimal, encoding), time, columns, from_zero)
        return cls(ts, values, q0, qdot0, **more)

    @classmethod
    def from_dataframe(
        cls, frame: Any, q0: PyTree, qdot0: PyTree, *, time: Any, columns: Any = None, from_zero: bool = False, **more: Any
    ) -> "Experiment":
        """An experiment from a data frame.

        **Arguments:** `frame`: of pandas, polars, or any class with `columns` and `frame[name].to_numpy()`; `q0`, `qdot0`, `time`,
        `columns`, `from_zero` and `**more` as for `from_csv`.

        **Returns:** an `Experiment` with `values` by channel, each of shape (T,). **Raises:** `ValueError` if a column does not exist.
        """
        ts, values = scaled(*of_frame(frame), time, columns, from_zero)
        return cls(ts, values, q0, qdot0, **more)

    def to_csv(self, file: str | Path, ts: Any = None) -> None:
        """Writes a table: the column `t`, one for each entry of `params` that is a function of time, such as the input that a machine is to
        be driven with, and one for each measured channel.

        **Arguments:** `file`: a path. `ts`: the times of the rows, (T,), by default those of the samples; at others nothing was measured.

        **Raises:** `ValueError` if the times are not numbers in order.

        ```python
        import jax.numpy as jnp
        import jaxlag as jl
        plan = jl.Experiment([0.0, 1.0], None, 0.0, 0.0, sigma=1e-3, params={"u": jl.Multisine(2.0, harmonics=3)})
        plan.to_csv("drive.csv", jnp.arange(0.0, 1.0, 1e-3))  # columns t and u, at 1 kHz
        ```
        """
        times = np.asarray(self.ts if ts is None else sample_times(ts, self.ts.dtype, repeated=True))
        columns = {"t": times}
        for name, entry in self.params.items():
            if callable(entry):
                course = np.asarray(jax.vmap(entry)(times))
                columns |= dict(zip(labels(name, course.shape[1:]), course.reshape(len(times), -1).T, strict=True))
        of_rows = [] if ts is not None else jax.tree_util.tree_flatten_with_path(self.values)[0]
        for path, z in of_rows:
            channel = jax.tree_util.keystr(path, simple=True, separator=".") or "value"
            if channel not in self.events:
                columns |= dict(zip(labels(channel, z.shape[1:]), np.reshape(z, (len(times), -1)).T, strict=True))
        write_text(file, columns)


def validate_inputs(
    experiments: Any, params: PyTree, *, planned: bool = False, tests: tuple[type, ...] = ()
) -> tuple[tuple[Any, ...], PyTree]:
    """One experiment or several as a tuple, and `params` as arrays, both checked; `tests`: classes of what may stand among them."""
    kinds = (Experiment, *tests)
    experiments = (experiments,) if isinstance(experiments, eqx.Module) else tuple(experiments)
    if not experiments or not all(isinstance(e, kinds) for e in experiments):
        also = " Tests by modes or frequency responses are for `fit` and `information`." if not tests else ""
        raise ValueError(f"`experiments` must be an `Experiment` or a list of them, but is not. Make one with `jl.Experiment(...)`.{also}")
    for i, e in enumerate(experiments):
        if e.values is None and not planned:
            raise ValueError(f"`experiments` must have been measured, but number {i} has no values. Use `information` to plan one.")
    if params is None or (jax.tree_util.all_leaves([params]) and not isinstance(params, Mapping)):
        raise ValueError(f"`params` must have entries that `free` can name, but is a {type(params).__name__}. Use a dict.")
    starts = [getattr(e, "q0", getattr(e, "q", None)) for e in experiments]
    params = parameters(params, next((start for start in starts if start is not None), np.zeros(())))
    for e in experiments:
        with_own(params, e.params)
    return experiments, params


def with_own(params: PyTree, own: Mapping[str, Any]) -> PyTree:
    """The parameters of the fit, overridden by those of the experiment."""
    if not own:
        return params
    if not isinstance(params, Mapping):
        raise ValueError(
            f"`params` must be a mapping where an experiment has params of its own that override them, but is a {type(params).__name__}. "
            "Use a dict; the present params may be one of its entries."
        )
    return {**params, **own}


class Coordinates(eqx.Module):
    """Returns the coordinates that the channels are named after."""

    names: tuple[str, ...] | None = eqx.field(static=True)

    @classmethod
    def named_by(cls, values: PyTree, q0: PyTree, label: str = "values") -> "Coordinates":
        """Those of q0 that `values` is structured like."""
        if isinstance(values, Mapping) and (not values or (isinstance(q0, Mapping) and set(values) <= set(q0))):
            return cls(tuple(values))
        structure: Any = jax.tree.structure(values)
        if values is None or structure == jax.tree.structure(q0):
            return cls(None)
        channel = next(iter(values), "x") if isinstance(values, Mapping) else "x"
        entry = f"q[{next(iter(q0))!r}]" if isinstance(q0, Mapping) and q0 else "q"
        example = f'lambda q: {{"{channel}": {entry}}}' if isinstance(values, Mapping) else f"lambda q: {entry}"
        raise ValueError(
            f"`observe` must say what the sensors see, but was left out, and `{label}` does not name coordinates of q. "
            f"Write e.g. `observe={example}`."
        )

    def __call__(self, q):
        return q if self.names is None else {name: q[name] for name in self.names}


def start_entries(experiment: Experiment) -> tuple[str, ...]:
    """Names of the entries of the flat (q0, qdot0)."""
    return tuple(
        which if name == "" else f"{which}{'' if name.startswith('[') else '.'}{name}"
        for which, tree in (("q0", experiment.q0), ("qdot0", experiment.qdot0))
        for name in entry_names(tree)
    )
