"""A motion at sample times: its states, forces, energies and works."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from ._compiled import compiled, is_concrete
from ._friction import Regularised, StickSlip
from ._kinks import kinks_of
from ._power import energy_turnover
from ._results import RESULTS, reason_of
from ._system import Flat, System, bind, leaf_names


class Stated(eqx.Module):
    """The system and params of a motion, and how friction was taken. What is no array in params is kept aside, so that batches of
    motions are arrays alone.
    """

    numbers: list[Array]
    system: System = eqx.field(static=True)
    rest: tuple = eqx.field(static=True)
    friction: StickSlip | Regularised = eqx.field(static=True)

    @classmethod
    def of(cls, system: System, params: PyTree, friction: StickSlip | Regularised = StickSlip()) -> "Stated":
        leaves, structure = jax.tree.flatten(params)
        numbers = [leaf for leaf in leaves if eqx.is_array(leaf)]
        return cls(numbers, system, (structure, tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves)), friction)

    @property
    def params(self) -> PyTree:
        """The params, put together again."""
        structure, others = self.rest
        numbers = iter(self.numbers)
        return jax.tree.unflatten(structure, [next(numbers) if other is None else other for other in others])

    def flat(self, like: PyTree) -> Flat:
        return bind(self.system, like, self.params)


class Rubbing(eqx.Module):
    """Dry friction along a motion: the `force` on each slip velocity, also while it sticks, and whether it is `sticking`."""

    force: Float[Array, "..."]
    sticking: Bool[Array, "..."]


class Trajectory(eqx.Module):
    """A motion at sample times: each field has the samples as its first axis.

    - `ts`: the times; `q`, `qdot`, `qddot`: structured like q0; `multipliers`: λ by the constraint's name.
    - `result`: `RESULTS.successful`, or the reason of failure; samples that were not reached are NaN.
    - `friction`: by the name of the dissipation term, the `force` on its slip velocities and whether they are `sticking`.
    - `works`: what `work()` returns, where the motion was computed with `audit=True`.
    - `stats`: `num_steps`, `num_accepted_steps`, `num_rejected_steps`, and `start_moved`, how far the start was projected.
    """

    ts: Float[Array, " T"]
    q: PyTree
    qdot: PyTree
    qddot: PyTree
    multipliers: dict[str, PyTree]
    result: RESULTS
    stats: dict[str, Any]
    works: dict[str, Float[Array, " T"]] | None
    friction: dict[str, Rubbing]
    stated: Stated

    @property
    def succeeded(self) -> Any:
        """Whether the motion was computed to its end."""
        return self.result == RESULTS.successful

    def energy(self) -> Float[Array, " T"]:
        """The energy h = q̇ · ∂L/∂q̇ − L at the samples; T + V where L = T − V with T quadratic in q̇."""
        return energies(self)[0]

    def work(self) -> dict[str, Float[Array, " T"]]:
        """Work since the start of each dissipation term, force and constraint by its name, of explicit time in L (`"time"`), and of the
        projection (`"projection"`). Integrated along with the motion: needs `simulate(..., audit=True)`.
        """
        if self.works is None:
            raise ValueError(
                "the motion must be computed with its works, but was computed without. Ask for them by `simulate(..., audit=True)`."
            )
        return self.works

    def balance(self) -> Float[Array, " T"]:
        """Residual of the energy balance, ΔE − ΣW, as a fraction of the energy turned over: the largest q̇ · ∂L/∂q̇ and all works."""
        energy, turned = energies(self)
        works = jnp.stack(list(self.work().values()))
        scale = jnp.nanmax(jnp.abs(turned)) + jnp.nansum(jnp.nanmax(jnp.abs(works), axis=1))
        return (energy - energy[0] - jnp.sum(works, axis=0)) / jnp.where(scale > 0, scale, 1)

    def slip(self) -> dict[str, Float[Array, "..."]]:
        """The slip velocities of each dissipation term with dry friction, shaped like `friction[name].force`."""
        return _slips(self)

    def _vectors(self):
        return [jax.vmap(lambda leaf: ravel_pytree(leaf)[0])(tree) for tree in (self.q, self.qdot)]

    def _flat(self):
        return self.stated.flat(jax.tree.map(lambda leaf: leaf[0], self.q))

    def __repr__(self) -> str:
        if not is_concrete(self):
            return "Trajectory(traced)"
        batch = self.ts.shape[:-1]
        rows = [("coordinates", ", ".join(leaf_names(self.q)))]
        if self.multipliers:
            rows.append(("constraints", ", ".join(self.multipliers)))
        steps, rejected = (np.asarray(self.stats[key]) for key in ("num_steps", "num_rejected_steps"))
        rows.append(("steps", f"{steps.max()}, {rejected.max()} of them rejected" + (" (the most in the batch)" if batch else "")))
        if self.multipliers:
            rows.append(("start moved by", f"{np.max(self.stats['start_moved']):.2g}"))
        if self.friction:
            transitions, stuck = np.asarray(self.stats["transitions"])[..., -1], np.asarray(self.stats["time_stuck"])[..., -1, :]
            most = " (the most in the batch)" if batch else ""
            rows.append(("friction", f"{int(transitions.max())} transitions, stuck for {stuck.max():.4g}{most}"))
        if isinstance(self.stated.friction, Regularised):
            rows.append(("friction", f"made smooth below a slip velocity of {self.stated.friction.width:g}, where it creeps"))
        if self.works is not None:
            residual = self.balance() if not batch else jax.vmap(lambda motion: motion.balance())(self)
            rows.append(("energy balance", f"off by {np.nanmax(np.abs(residual)):.1e} of the energy turned over"))
        rows.append(("result", "successful" if np.all(self.succeeded) else reason_of(self.result)))
        of = f"{' × '.join(map(str, batch))} motions of " if batch else ""
        head = f"Trajectory: {of}{self.ts.shape[-1]} samples, t = {np.min(self.ts):g} … {np.max(self.ts):g}"
        return "\n".join([head, *(f"  {name:<15}{value}" for name, value in rows)])


@compiled  # so that parameters are unknown, as they were in the motion: a friction of 0 is one, too
def _slips(motion: Trajectory) -> dict[str, Float[Array, "..."]]:
    flat, (q, v) = motion._flat(), motion._vectors()
    kinks = kinks_of(flat, motion.ts[0], q[0], v[0]) if motion.friction else None
    if kinks is None:
        return {}
    slip = jax.vmap(kinks.slip)(motion.ts, q, v)
    return {name: slip[:, rows].reshape(motion.friction[name].force.shape) for name, rows in kinks.rows_of_term.items()}


@compiled
def energies(motion: Trajectory) -> tuple[Float[Array, " T"], Float[Array, " T"]]:
    """The energy h and q̇ · ∂L/∂q̇ at the samples."""
    return jax.vmap(functools.partial(energy_turnover, motion._flat()))(motion.ts, *motion._vectors())
