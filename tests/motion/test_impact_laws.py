"""Impacts of random systems with more rows than velocities, in units far from one: the laws hold, by linear programs of SciPy's."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

import jaxlag as jl
from jaxlag._motion import integrate

EACH = 60
# Of the kinds of systems, how many velocities, contacts and directions of slip there are; the last of these has a bound of its own.
KINDS = {"a block under a block": (2, 1, 2), "between two floors": (3, 2, 3), "held by more than it has": (2, 2, 3)}


def system(contacts):
    """All that may take part, as rows of numbers: gaps w q, slips a q̇."""
    return jl.System(
        lambda qdot, m: 0.5 * qdot @ m @ qdot,
        dissipation=lambda qdot, multipliers, a, mu, F: (
            jnp.sum(mu * jnp.stack([multipliers[f"floor {i % contacts}"] * jnp.abs(a[i] @ qdot) for i in range(len(mu))]))
            + F * jnp.abs(a[-1] @ qdot)
        ),
        unilateral={f"floor {i}": jl.Contact(lambda q, w, i=i: w[i] @ q, lambda e: e) for i in range(contacts)},
    )


def numbers(rng, kind, units):
    """Of a system of this kind and the velocities before; those of every other system are halves, so that rows repeat each other."""
    n, contacts, slips = KINDS[kind]
    length, time, mass = units
    half = rng.integers(2)
    drawn = lambda *shape: np.round(2 * rng.normal(size=shape)) / 2 if half else rng.normal(size=shape)
    root = drawn(n, n) * (1 - half) + np.eye(n)
    numbers = {
        "m": mass * (root @ root.T),
        "w": drawn(contacts, n),
        "a": drawn(slips, n),
        "mu": rng.uniform(0.05, 0.6, slips - 1),
        "F": mass * length / time**2 * rng.uniform(0, 2),
        "e": rng.uniform(0, 0.9),
    }
    v = drawn(n)
    while not np.all(numbers["w"] @ v < -0.1) or np.any(np.sum(numbers["a"] ** 2, axis=1) == 0):
        v, numbers["w"], numbers["a"] = drawn(n), drawn(contacts, n), drawn(slips, n)
    return numbers, length / time * v


def choices(numbers, v, after=None):
    """Linear programs (equalities, inequalities ≥ 0) of q̇⁺, Λ and the impulses of friction: one for each choice of the contacts that are
    closed and of what sticks and slips. Of impacts that are the same, there may be many.
    """
    w, a, k = numbers["w"], numbers["a"][:-1], len(numbers["mu"])
    n, c = len(v), len(w)
    of = np.eye(n + c + k)
    velocities, impulses, frictions = of[:n], of[n : n + c], of[n + c :]
    returned = -numbers["e"] * (w @ v)
    bound = numbers["mu"][:, None] * impulses[np.arange(k) % c]
    equal = [(numbers["m"] @ velocities - w.T @ impulses - a.T @ frictions, numbers["m"] @ v)]
    equal += [] if after is None else [(velocities, after)]
    least = [(impulses, np.zeros(c)), (w @ velocities, returned), (bound - frictions, np.zeros(k)), (bound + frictions, np.zeros(k))]
    for closed, way in itertools.product(itertools.product((True, False), repeat=c), itertools.product((-1, 0, 1), repeat=k)):
        closed, way = np.array(closed), np.array(way)
        slips = way[:, None] * (a @ velocities), np.zeros(k)
        rests = (a @ velocities)[way == 0], np.zeros(np.sum(way == 0))
        slipping = (frictions + way[:, None] * bound)[way != 0], np.zeros(np.sum(way != 0))
        touching = np.concatenate([(w @ velocities)[closed], impulses[~closed]]), np.concatenate([returned[closed], 0 * returned[~closed]])
        yield [np.concatenate(x) for rows in ([*equal, rests, slipping, touching], [*least, slips]) for x in zip(*rows, strict=True)]


def by_laws(numbers, v, after=None):
    """Some q̇⁺ that the laws allow; of one that is given, whether they allow it, as far as roundings go."""
    little = 0 if after is None else 1e-7 * np.max(np.abs(v))
    for A, b, B, low in choices(numbers, v, after):
        size = A.shape[1]
        rows, sides = np.concatenate([A, -A, -B]), np.concatenate([b, -b, -low]) + little
        program = linprog(np.zeros(size), rows, sides, bounds=[(None, None)] * size, method="highs")
        if program.status == 0:
            return program.x[: len(v)]
    return None


@pytest.mark.slow
@pytest.mark.parametrize("units", [(1.0, 1.0, 1.0), (1e-6, 1e-3, 1e3)])
@pytest.mark.parametrize("kind", KINDS)
def test_the_laws_hold_in_loops_of_their_own(kind, units, monkeypatch):
    """As they do where motions are differentiated in reverse mode, and beside events."""
    monkeypatch.setattr(integrate, "has_one_evaluation", lambda *given: False)
    test_the_laws_hold(kind, units)


@pytest.mark.parametrize(
    ("kind", "units"),
    [
        ("a block under a block", (1e-6, 1e-3, 1e3)),
        pytest.param("held by more than it has", (1.0, 1.0, 1.0), marks=pytest.mark.slow),
        pytest.param("held by more than it has", (1e3, 1e-6, 1e-9), marks=pytest.mark.slow),
        pytest.param("between two floors", (1e-6, 1e-3, 1e3), marks=pytest.mark.slow),
    ],
)
def test_the_laws_hold(kind, units):
    """Of every impact; and one that is refused gains energy, or there is none."""
    _, contacts, _ = KINDS[kind]
    rng = np.random.default_rng(5)
    drawn = [numbers(rng, kind, units) for _ in range(EACH)]
    params = jax.tree.map(lambda *x: jnp.stack(x), *(params for params, _ in drawn))
    v = jnp.stack([v for _, v in drawn])
    struck = lambda v, params: jl.simulate(system(contacts), jnp.zeros_like(v), v, jnp.zeros(2), params, throw=False)
    found = jax.jit(jax.vmap(struck))(v, params)
    jax.clear_caches()
    unit, fine = units[0] / units[1], 0
    for i, (params, v) in enumerate(drawn):
        params, v, after = {**params, "m": params["m"] / units[2]}, v / unit, found.qdot[i, 0] / unit
        energy = lambda v, m=params["m"]: v @ m @ v
        if np.all(np.isfinite(after)):
            assert by_laws(params, v, after) is not None
            assert energy(after) <= energy(v) * (1 + 1e-6)
            fine += 1
        else:
            only = by_laws(params, v)
            assert only is None or energy(only) > energy(v)
    assert fine >= 0.9 * EACH
