"""Random mechanical systems: what they are made of is their kind, their numbers are drawn.

A system of n coordinates, of which each term is a function f(t, q, v, p) of the flat q and v and of the parameters p, a dict of numbers:

    L = ½ vᵀ M v + ½ (w·v)² sin²(k·q) − ½ qᵀ K q − c (1 − cos(k·q)),   D = ½ vᵀ C v + d Σ|v|³,   Q = b sin ωt

and what its kind adds. All numbers are of order one: these are the units in which the result is known; `transform` takes others.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxlag as jl

TIMES = np.arange(17) / 4.0  # s, of which each is exact beside 2e9


class Term(NamedTuple):
    """A function f(t, q, v, p), or f(t, q, v, p, more) where it names what else it receives: `multipliers` or a state."""

    f: Callable
    names: tuple[str, ...] = ()


class Case(NamedTuple):
    """A system, a state on its constraints, times, and parameters; `terms` by the slot of `System` and by name.

    `states`: by name, the rate, the period (0 where it is continuous) and the start. `restitution`: the name of a parameter.
    """

    kind: str
    terms: dict[str, dict[str, Term]]
    q0: Any
    qdot0: Any
    params: dict[str, Any]
    states: Mapping[str, tuple[Term, float, float]] = MappingProxyType({})
    restitution: str | None = None
    ts: Any = TIMES

    @property
    def n(self) -> int:
        """The number of coordinates."""
        return len(self.q0)


# The common part


def lagrangian(t, q, v, p):
    inertia = 0.5 * v @ p["M"] @ v + 0.5 * (p["w"] @ v) ** 2 * jnp.sin(p["k"] @ q) ** 2
    return inertia - 0.5 * q @ p["K"] @ q - p["c"] * (1 - jnp.cos(p["k"] @ q))


def without_inertia(t, q, v, p):
    """The last coordinate has none."""
    moving = v[:-1]
    inertia = 0.5 * moving @ p["M"][:-1, :-1] @ moving
    return inertia - 0.5 * q @ p["K"] @ q - p["c"] * (1 - jnp.cos(p["k"] @ q))


def dampers(t, q, v, p):
    return 0.5 * v @ p["C"] @ v + p["d"] * jnp.sum(jnp.abs(v) ** 3)


def drive(t, q, v, p):
    return p["b"] * jnp.sin(p["omega"] * t)


# What kinds add


def dry(t, q, v, p):
    return p["F"] * jnp.abs(p["r"] @ v)


def planar(t, q, v, p):
    return p["F"] * jl.dissipation.speed(p["R"] @ v)


def loop(t, q, v, p):
    return p["j"] @ q + p["e"] * jnp.sin(p["k"] @ q) ** 2


def loop_again(t, q, v, p):
    """The same condition, another equation."""
    g = loop(t, q, v, p)
    return g * (2 + jnp.cos(q[0]))


def blade(t, q, v, p):
    return (p["i"] + p["w"] * jnp.sin(p["k"] @ q)) @ v


def floor(t, q, v, p):
    return q[0] + p["h"]


def lag(t, q, v, p, z):
    return (p["w"] @ q - z) / p["lag"]


def controller(t, q, v, p, u):
    return -p["gain"] * (p["w"] @ v) + 0.2 * u


def by_state(t, q, v, p, z):
    return -p["w"] * z


def by_controller(t, q, v, p, u):
    return p["w"] * u


def by_signal(t, q, v, p):
    return p["w"] * p["input"](t)


BASE = {
    "lagrangian": {"energy": Term(lagrangian)},
    "dissipation": {"dampers": Term(dampers)},
    "force": {"drive": Term(drive)},
}


def _with(**more):
    return {slot: {**BASE.get(slot, {}), **more.get(slot, {})} for slot in {**BASE, **more}}


KINDS = {
    "smooth": BASE,
    "dry": _with(dissipation={"dry": Term(dry)}),
    "planar": _with(dissipation={"planar": Term(planar)}),
    "holonomic": _with(holonomic={"loop": Term(loop)}),
    "redundant": _with(holonomic={"loop": Term(loop), "again": Term(loop_again)}),
    "nonholonomic": _with(nonholonomic={"blade": Term(blade)}),
    "held and rolling": _with(holonomic={"loop": Term(loop)}, nonholonomic={"blade": Term(blade)}),
    "contact": _with(unilateral={"floor": Term(floor)}),
    "massless": BASE | {"lagrangian": {"energy": Term(without_inertia)}},
    "state": _with(force={"by_state": Term(by_state, ("z",))}),
    "controller": _with(force={"by_controller": Term(by_controller, ("u",))}),
    "signal": _with(force={"by_signal": Term(by_signal)}),
    "ramp": _with(force={"by_signal": Term(by_signal)}),
    "dry loop": _with(dissipation={"dry": Term(dry)}, holonomic={"loop": Term(loop)}),
}
STATES = {"state": {"z": (Term(lag, ("z",)), 0.0, 0.0)}, "controller": {"u": (Term(controller, ("u",)), 0.25, 0.0)}}
AT_REST = {"smooth", "holonomic", "redundant", "nonholonomic", "held and rolling", "massless", "state"}  # where linearised


def _positive(draw, n):
    A = draw.normal(size=(n, n))
    return A @ A.T / n + np.eye(n)


def drawn(kind: str, n: int, seed: int) -> Case:
    """A system of a kind with n coordinates; all seeds share its programs."""
    draw = np.random.default_rng([seed, n, *kind.encode()])
    params = {"M": _positive(draw, n), "K": 4 * _positive(draw, n), "C": 0.05 * _positive(draw, n), "d": 0.02}
    params |= {"w": draw.normal(size=n), "k": draw.normal(size=n) / np.sqrt(n), "c": draw.uniform(0, 2)}
    params |= {"b": draw.normal(size=n), "omega": draw.uniform(0.5, 3)}
    q0, v0, kinds = 0.3 * draw.normal(size=n), draw.normal(size=n), KINDS[kind]
    if "dissipation" in kinds and "dry" in kinds["dissipation"]:
        params |= {"F": draw.uniform(0.3, 1), "r": draw.normal(size=n)}
    if kind == "planar":
        params |= {"F": draw.uniform(0.2, 0.5), "R": draw.normal(size=(2, n))}
    rows = []
    if "holonomic" in kinds:
        params |= {"j": draw.normal(size=n), "e": 0.3}
        q0, rows = np.zeros(n), [params["j"]]
    if "nonholonomic" in kinds:
        params["i"] = draw.normal(size=n)
        q0, rows = np.zeros(n), [*rows, params["i"]]
    if rows:
        v0 = v0 - np.linalg.pinv(np.array(rows)) @ (np.array(rows) @ v0)
    if kind == "contact":
        params |= {"h": 0.2, "restitution": draw.uniform(0.3, 0.9)}
        q0[0] = abs(q0[0])
    if kind == "massless":
        params["C"] = params["C"] + 0.5 * np.diag(np.arange(n) == n - 1)
    if kind == "state":
        params["lag"] = draw.uniform(0.1, 1)
    if kind == "controller":
        params["gain"] = draw.uniform(0.5, 1)
    if kind in ("signal", "ramp"):
        how = jl.interpolation.ZeroOrderHold() if kind == "signal" else jl.interpolation.Linear()
        params["input"] = jl.Signal(np.arange(9) / 2.0, draw.normal(size=9), how)
    return Case(kind, kinds, q0, v0, params, STATES.get(kind, MappingProxyType({})), "restitution" if kind == "contact" else None)
