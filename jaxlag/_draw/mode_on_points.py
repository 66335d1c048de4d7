"""Modes of a linear system as displacements of points of the mechanism."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._linear.modes import Modes
from .._model.injection import call
from .axes import Units, units_of

FAINT = "#C8C8C8"
SHARE = 0.1  # of the size of the mechanism: displacement of the point that moves most


@dataclasses.dataclass(frozen=True)
class ModesOnPoints:
    """Points at rest, (p, 2), and their displacements in each mode, Re(d e^{iφ}): d complex, (k, p, 2); zero for a mode that moves none.

    Displacements are of first order, and so independent of the coordinates of the system.
    """

    names: tuple[str, ...]
    rest: np.ndarray
    displacements: np.ndarray

    @classmethod
    def of(cls, modes: Modes, points: Mapping[str, Callable], links: tuple, amplitude: Any) -> "ModesOnPoints":
        """The points with a visible amplitude, or the given one: the displacement of the point that moves most."""
        if modes.origin is None:
            raise ValueError(
                "`modes` must be those near one state, which is known, but are those along a trajectory. Linearise at one of its states."
            )
        rest, by_state = _slopes(modes.origin, points)
        along = _along(modes)
        d = np.einsum("pcy,ky->kpc", by_state, along)
        largest = np.max(_reach(d), axis=1, initial=0.0)
        dust = np.finfo(rest.dtype).eps ** 0.75 * np.max(np.abs(by_state), initial=0.0) * np.max(np.abs(along), axis=1, initial=0.0)
        length = _amplitude(amplitude) if amplitude is not None else SHARE * _size(rest, links)
        moves = largest > dust
        return cls(tuple(points), rest, np.where(moves, length / np.where(moves, largest, 1), 0.0)[:, None, None] * d)

    def at(self, phases: np.ndarray) -> np.ndarray:
        """The points at phases of each mode, (k, P): (k, P, p, 2)."""
        return self.rest + np.real(self.displacements[:, None] * np.exp(1j * phases)[..., None, None])

    def extreme_phases(self) -> np.ndarray:
        """The phase of each mode at which all points together are farthest from rest."""
        return -0.5 * np.angle(np.sum(self.displacements**2, axis=(1, 2)))

    def by_name(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Positions by name of the points, which are the last axis but one."""
        return {name: x[..., i, :] for i, name in enumerate(self.names)}


def as_many(mode: Modes) -> Modes:
    """One mode as a batch of one."""
    many = jax.tree.map(lambda x: x[None], dataclasses.replace(mode, origin=None))
    return dataclasses.replace(many, origin=mode.origin)


def draw_at_rest(ax: Any, rest: Mapping[str, np.ndarray], links: tuple) -> None:
    """The mechanism at rest, faint."""
    position = lambda end: rest[end] if isinstance(end, str) else end
    for link in links:
        ax.plot(*zip(*map(position, link), strict=True), color=FAINT, linewidth=2.0, solid_capstyle="round", zorder=1)
    for x in rest.values():
        ax.plot(*x, "o", color=FAINT, markersize=5, zorder=1)


def units_of_modes(modes: Modes, units: Units) -> dict[str, str]:
    """The units that the system states, overridden by the given ones."""
    return units_of(() if modes.origin is None else modes.origin.units, units)


def titles(modes: Modes, units: Mapping[str, str]) -> list[str]:
    """Frequency and damping of each mode, or λ if it does not oscillate."""
    unit = units.get("t", "")
    per = f" 1/{unit}" if unit else ""
    lines = []
    for value, frequency, ratio in zip(*map(np.asarray, (modes.eigenvalues, modes.frequency, modes.damping_ratio)), strict=True):
        if value == 0:
            text = "λ = 0, stays where it is put"
        elif value.imag == 0:
            text = f"λ = {value.real:.4g}{per}"
        else:
            text = f"f₀ = {frequency:.4g}{' Hz' if unit == 's' else per}, ζ = {ratio:.3g}"
        lines.append(text.replace("-", "−"))
    return lines


def _along(modes):
    """q̂ and λ q̂ of each mode, (k, 2n), in the order of `ravel_pytree`."""
    q = np.asarray(jax.vmap(lambda shape: ravel_pytree(shape)[0])(modes.shapes)).astype(complex)
    values = np.asarray(modes.eigenvalues)
    return np.concatenate([q, np.where(np.isfinite(values), values, 0)[:, None] * q], axis=1)  # λ = −∞ for modes gone after one sample


def _positions(points, origin, q, qdot):
    """All points, (p, 2)."""
    found = []
    for name, point in points.items():
        x = ravel_pytree(call(point, f"`points` {name!r}", origin.params, t=origin.t, q=q, qdot=qdot))[0]
        if x.shape != (2,):
            raise ValueError(f"`points` {name!r} must return a position (x, y), but returned {x.size} numbers. Return two.")
        found.append(x)
    return jnp.stack(found)


def _slopes(origin, points):
    """The points at rest, and their derivatives with respect to q and q̇."""
    q, unravel = ravel_pytree(origin.q)
    state = jnp.concatenate([q, ravel_pytree(origin.qdot)[0]])
    position = lambda state: _positions(points, origin, *map(unravel, jnp.split(state, 2)))
    return tuple(map(np.asarray, jax.jit(lambda state: (position(state), jax.jacfwd(position)(state)))(state)))


def _reach(d):
    """The largest length of Re(d e^{iφ})."""
    return np.sqrt((np.sum(np.abs(d) ** 2, axis=-1) + np.abs(np.sum(d**2, axis=-1))) / 2)


def _size(rest, links):
    """The diagonal of the mechanism; 1 for a single point."""
    fixed = [np.asarray(end, float)[None] for link in links for end in link if not isinstance(end, str)]
    return np.linalg.norm(np.ptp(np.concatenate([rest, *fixed]), axis=0)) or 1.0


def _amplitude(given):
    if not (np.ndim(given) == 0 and np.isfinite(given) and given > 0):
        raise ValueError(f"`amplitude` must be a positive length, but is {given!r}. Give it in the units of the points, or leave it out.")
    return float(given)
