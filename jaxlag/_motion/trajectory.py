"""A motion at sample times: its states, forces, energies and works."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._mechanics.friction_elements import find_elements
from .._mechanics.power import energy_exchange
from .._model.flat import StatesAt, bind
from .._program.jit import compiled, is_concrete
from .card import card
from .export import arrays_of, frame_of, outline, write_arrays
from .interpolation import Moving, between, jumps
from .moments import ContactState, EventState, FrictionState, Instant, Interpolated, with_counts
from .provenance import Provenance, Recorded
from .results import RESULTS, names_of

COUNTED = ("transitions", "time_stuck")  # entries of `stats` that have the samples as first axis, counted from the start


class Trajectory(eqx.Module):
    """A motion at sample times: each field has the samples as its first axis; of many motions, the members.

    `len(motion)` is the number of samples, `motion[-1]` the last one (an `Instant`), `motion[100:200]` and `motion[motion.ts > 1]` are
    motions again, which start at the first sample they keep: works count from there. For many motions (`simulate_many`, `vmap`),
    `motions[3]` is one of them. `motion.at(ts)` is the motion between the samples. `motion.plot()` and `motion.animate(points)` draw it,
    with all that `plot.motion` and `plot.animate` take.

    - `ts`: the times; `q`, `qdot`, `qddot`: structured like q0; `multipliers`: λ by the constraint's name; `states`: by name.
    - `result`: `RESULTS.successful`, or the reason of failure; samples that were not reached are NaN.
    - `friction`: by the name of the dissipation term, the `force` on its slip velocities and whether they are `sticking`.
    - `contacts`: by the name of the unilateral constraint, whether it is `closed`, its `impacts`, when it `changed`, its `impulse`s.
    - `events`: by name, when they happened, `ts`, the `q`, `qdot` and `states` just before, and their `count` at each sample.
    - `works`: what `work()` returns, where the motion was computed with `works=True`.
    - `stats`: `num_steps`, `num_accepted_steps`, `num_rejected_steps`; `start_moved`, how far the initial state was projected;
      `reached`, the time to which the motion was computed. With dry friction, at each sample and since the start: `transitions`, how
      often slip velocities changed between sliding and sticking or reversed; `time_stuck`, for how long each of them has stuck.
    - `provenance`: the system, params and treatment of friction that the motion was computed from.
    """

    ts: Float[Array, "*members T"]
    q: PyTree
    qdot: PyTree
    qddot: PyTree
    multipliers: dict[str, PyTree]
    result: RESULTS
    stats: dict[str, Any]
    works: dict[str, Float[Array, "*members T"]] | None
    friction: dict[str, FrictionState]
    provenance: Provenance | Recorded
    states: dict[str, PyTree] = dataclasses.field(default_factory=dict)
    contacts: dict[str, ContactState] = dataclasses.field(default_factory=dict)
    events: dict[str, EventState] = dataclasses.field(default_factory=dict)

    if TYPE_CHECKING:  # put here by `jaxlag.plot`
        plot: ClassVar[Callable[..., Any]]
        animate: ClassVar[Callable[..., Any]]

    @property
    def succeeded(self) -> Any:
        """Whether the motion was computed to its end."""
        return self.result == RESULTS.successful

    def energy(self) -> Float[Array, " T"]:
        """The energy h = q̇ · ∂L/∂q̇ − L at the samples; T + V where L = T − V with T quadratic in q̇."""
        return energies(self)[0]

    def work(self) -> dict[str, Float[Array, " T"]]:
        """Work since the start of each dissipation term, force and constraint by its name, of explicit time in L (`"time"`), and of the
        projection (`"projection"`). Integrated along with the motion: needs `simulate(..., works=True)`.
        """
        if self.works is None:
            raise ValueError(
                "the motion must be computed with its works, but was computed without. Ask for them with `simulate(..., works=True)`."
            )
        return self.works

    def balance(self) -> Float[Array, " T"]:
        """Residual of the energy balance, ΔE − ΣW, as a fraction of the energy exchanged: the largest q̇ · ∂L/∂q̇ and all works; or of the
        rounding of the energy, if that is more, as of a machine that friction holds.
        """
        energy, exchanged = energies(self)
        works = jnp.stack(list(self.work().values()))
        scale = jnp.nanmax(jnp.abs(exchanged)) + jnp.nansum(jnp.nanmax(jnp.abs(works), axis=1))
        scale = jnp.maximum(scale, jnp.finfo(energy.dtype).eps * jnp.nanmax(jnp.abs(energy)))
        return (energy - energy[0] - jnp.sum(works, axis=0)) / jnp.where(scale > 0, scale, 1)

    def slip(self) -> dict[str, Float[Array, "..."]]:
        """The slip velocities of each dissipation term with dry friction, shaped like `friction[name].force`."""
        return self.provenance.slip if isinstance(self.provenance, Recorded) else _slips(self)

    def pulling(self) -> dict[str, PyTree]:
        """For each constraint that is `one_sided`, by name, the samples at which λ < 0: there it would have to pull, and the contact would
        have opened. Values below the rounding of the largest |λ| count as zero. If redundant rows share a load, λ is the solution of least
        norm.
        """
        axis = self.ts.ndim - 1

        def below(x):
            return x < -(jnp.finfo(x.dtype).eps ** 0.5) * jnp.nanmax(jnp.abs(x), axis=axis, keepdims=True)

        return {name: jax.tree.map(below, self.multipliers[name]) for name in self.provenance.one_sided}

    def __len__(self) -> int:
        return self.ts.shape[0]

    def __getitem__(self, which: Any) -> Any:
        kind = None if isinstance(which, slice) else which.dtype if hasattr(which, "dtype") else np.asarray(which).dtype
        holds = lambda kinds: kind is not None and jnp.issubdtype(kind, kinds)
        is_one = holds(jnp.integer) and np.ndim(which) == 0
        if is_one and is_concrete(which) and not -len(self) <= which < len(self):
            raise IndexError(f"`motion[{which}]` must be there, but there are {len(self)} {'members' if self.ts.ndim > 1 else 'samples'}.")
        chosen = functools.partial(jax.tree.map, lambda x: x[which])
        if self.ts.ndim > 1:
            return chosen(self)
        if is_one:
            return Instant(*chosen((self.ts, self.q, self.qdot, self.qddot, self.multipliers, self.states)))
        is_forward = isinstance(which, slice) and (which.step is None or which.step > 0)
        if not (is_forward or (holds(jnp.bool_) and np.shape(which) == self.ts.shape)):
            raise TypeError(
                f"`motion[...]` must be asked for a sample, a slice forward in time or a mask of the samples, but is for {which!r}. "
                "Write e.g. `motion[-1]`, `motion[100:200]`, `motion[motion.ts > 1]`."
            )
        if not self.ts[which].size:
            raise ValueError(f"`motion[...]` must keep at least one sample, but keeps none of the {len(self)}.")
        since = lambda count: chosen(count) - chosen(count)[:1]
        counts = {name: since(count) if name in COUNTED else count for name, count in self.stats.items()}
        works = None if self.works is None else jax.tree.map(since, self.works)
        provenance = self.provenance
        if isinstance(provenance, Recorded):
            provenance = dataclasses.replace(provenance, energies=chosen(provenance.energies), slip=chosen(provenance.slip))
        events = with_counts(self.events, {name: chosen(event.count) for name, event in self.events.items()})
        *motion, states = chosen((self.ts, self.q, self.qdot, self.qddot, self.multipliers, self.states))
        return Trajectory(*motion, self.result, counts, works, chosen(self.friction), provenance, states, chosen(self.contacts), events)

    def at(self, ts: Any) -> Interpolated:
        r"""The motion at other times, one or an array of them, interpolated between the samples by their q, q̇ and q̈.

        $$ |\delta q| \le \frac{h^6}{46080}\,|q^{(6)}|, \qquad |\delta\dot q| \le \frac{h^4}{384}\,|q^{(5)}|, \qquad
           |\delta\ddot q| \le \frac{\sqrt3\,h^3}{216}\,|q^{(5)}| $$

        where h is the distance of the samples and the motion is smooth; if friction changes or an input jumps between two samples, δq is of
        the order of h² times the jump of q̈. Nothing is interpolated across an impact, or an event that changes the state: on either side
        of it the motion is extrapolated from the nearest sample by q, q̇ and q̈, δq ≤ h³/6 |q⁽³⁾|, exact in free flight. Between the first
        and the last of several in one interval it is NaN. `q_error` and `qdot_error` are estimates for all cases. λ is not interpolated: it
        follows from the state by `acceleration`. Differentiable, also in `ts`.

        **Raises:** `ValueError` if a time lies outside the motion (under `jit` the state there is NaN), for many motions at once, and
        if there are less than two samples.

        **Source:** Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, section II.6.
        """
        if self.ts.ndim > 1 or len(self) < 2:
            what = f"{len(self)} motions" if self.ts.ndim > 1 else "one sample"
            raise ValueError(
                f"`at` must interpolate between the samples of one motion, but has {what}. Take one with several, e.g. `motions[0].at(ts)`."
            )
        ts = jnp.asarray(ts, self.ts.dtype)
        if is_concrete(ts, self.ts):
            (first, last), rounding = np.asarray(self.ts)[[0, -1]], 4 * np.finfo(ts.dtype).eps * np.max(np.abs(self.ts))
            outside = np.ravel(ts)[(np.ravel(ts) < first - rounding) | (np.ravel(ts) > last + rounding)]
            if outside.size:
                raise ValueError(
                    f"`ts` must lie within the motion, from {first:g} to {last:g}, but holds {outside[0]:g}. Simulate further."
                )
        shaped = lambda tree: jax.tree.map(lambda x: x.reshape(*ts.shape, *x.shape[1:]), tree)
        return Interpolated(ts, *map(shaped, _between(self, jnp.ravel(ts))))

    def to_dict(self) -> dict[str, np.ndarray]:
        """All samples as NumPy arrays by flat names: "t", "q.x", "qdot.x", "qddot.x", "multipliers.rod", "states.z",
        "friction.brake.force", "friction.brake.sticking", "contacts.floor.closed", "events.click.count", "works.brake"; "q" where q is one
        array.
        """
        states = dict(q=self.q, qdot=self.qdot, qddot=self.qddot, multipliers=self.multipliers, states=self.states)
        events = {name: {"count": event.count} for name, event in self.events.items()}
        return arrays_of(t=self.ts, **states, friction=self.friction, contacts=self.contacts, events=events, works=self.works)

    def to_dataframe(self, frame: Callable | None = None) -> Any:
        """A table with a row for each sample and the columns of `to_dict`, "r[0]", "r[1]", … of an array; `jl.Experiment.from_dataframe`
        reads it.

        **Arguments:** `frame`: the class of data frames: `pandas.DataFrame`, `polars.DataFrame`. Default: that of pandas if it is
        installed, otherwise that of polars.

        **Raises:** `ValueError` for many motions at once, `ImportError` if there is neither pandas nor polars.
        """
        if self.ts.ndim > 1:
            raise ValueError(f"`to_dataframe` must be of one motion, but there are {len(self)}. Take one of them, e.g. `motions[0]`.")
        entry = lambda name, at: f"{name}[{', '.join(map(str, at))}]" if at else name
        arrays = self.to_dict().items()
        return frame_of({entry(name, at): x[:, *at] for name, x in arrays for at in np.ndindex(x.shape[1:])}, frame)

    def save(self, file: str | Path) -> None:
        """Writes the motion, with its energies and slip velocities, to `file` in the format of NumPy (.npz).

        `jl.load` reads it as a `Trajectory` again, without the functions of the system, which a pickle would need.

        The numbers of params are kept. Structures become dicts and lists; a NamedTuple becomes the dict of its fields.
        """
        each = lambda function: functools.reduce(lambda f, _: jax.vmap(f), self.ts.shape[1:], function)
        of = self.provenance
        recorded = Recorded(each(energies)(self), each(Trajectory.slip)(self), of.params, of.one_sided, of.friction, of.units)
        numbers = jax.tree.map(lambda leaf: leaf if eqx.is_array(leaf) else None, recorded.params)
        energy = dict(zip(("h", "turned"), recorded.energies, strict=True))
        more = arrays_of(stats=self.stats, energy=energy, slip=recorded.slip, params=numbers)
        happened = {name: dict(ts=event.ts, q=event.q, qdot=event.qdot, states=event.states) for name, event in self.events.items()}
        more |= arrays_of(happened=happened)
        trees = dict(q=self.q, multipliers=self.multipliers, states=self.states, params=numbers, happened=happened)
        write_arrays(
            file,
            "Trajectory",
            self.to_dict() | more | {"result": names_of(self.result)},
            outlines={name: outline(tree, arrays_of(**{name: tree})) for name, tree in trees.items()},
            audit=self.works is not None,  # the name in files
            one_sided=recorded.one_sided,
            units=recorded.units,
            friction={type(recorded.friction).__name__: dataclasses.asdict(recorded.friction)},
        )

    def _vectors(self):
        return [_ravelled(tree) for tree in (self.q, self.qdot)]

    def _flat(self, at):
        """The system over flat vectors, at (states, t, q, v)."""
        return bind(self.provenance.system, jax.tree.map(lambda leaf: leaf[0], self.q), self.provenance.params, StatesAt(*at))

    def _first(self):
        """The states, t, q and v at the first sample."""
        return jax.tree.map(lambda x: x[0], (self.states, self.ts, *self._vectors()))

    def __repr__(self) -> str:
        return card(self)


@compiled  # so that parameters are unknown, as they were in the motion: a friction of 0 is one, too
def _slips(motion: Trajectory) -> dict[str, Float[Array, "..."]]:
    def elements_at(states, *state):
        return find_elements(motion._flat((states, *state)))

    elements = elements_at(*motion._first()) if motion.friction else None
    if elements is None:
        return {}
    slip = jax.vmap(lambda *at: elements_at(*at).slip(*at[1:]))(motion.states, motion.ts, *motion._vectors())
    return {name: slip[:, rows].reshape(motion.friction[name].force.shape) for name, rows in elements.rows_of_term.items()}


def energies(motion: Trajectory) -> tuple[Float[Array, " T"], Float[Array, " T"]]:
    """The energy h and q̇ · ∂L/∂q̇ at the samples."""
    return motion.provenance.energies if isinstance(motion.provenance, Recorded) else _energies(motion)


def of_samples(t: Trajectory) -> PyTree:
    """All of a motion that has the samples as its first axis."""
    counts = [count for name, count in t.stats.items() if name in COUNTED], [event.count for event in t.events.values()]
    return t.ts, t.q, t.qdot, t.qddot, t.multipliers, t.works, t.friction, t.states, t.contacts, counts


def _ravelled(tree):
    return jax.vmap(lambda leaf: ravel_pytree(leaf)[0])(tree)


@compiled
def _energies(motion):
    return jax.vmap(lambda *at: energy_exchange(motion._flat(at), *at[1:]))(motion.states, motion.ts, *motion._vectors())


@compiled
def _between(motion, at):
    unravelled = jax.vmap(ravel_pytree(jax.tree.map(lambda leaf: leaf[0], motion.q))[1])
    system = None if isinstance(motion.provenance, Recorded) else motion.provenance.system
    changing = [event for name, event in motion.events.items() if system is None or dict(system.events)[name].then is not None]
    of_motion = Moving(*map(_ravelled, (motion.q, motion.qdot, motion.qddot)))
    found, error = between(motion.ts, of_motion, at, jumps(motion.ts, motion.contacts.values(), changing))
    return [unravelled(x) for x in (*found, error.q, error.v)]
