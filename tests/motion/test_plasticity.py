"""Plastic elements in series and plastic hinges, by play operators and by collapse theory; elements identified from a loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxlag as jl

HARDENING = jl.System(
    lambda q, c, h: -0.5 * c * (q["x"] - jnp.sum(q["u"])) ** 2 - 0.5 * jnp.sum(h * q["u"] ** 2),
    dissipation={"sliders": lambda qdot, F: jnp.sum(F * jnp.abs(qdot["u"]))},
    holonomic={"drive": lambda t, q: q["x"] - 2 * jnp.sin(t)},
)
SERIES = {"c": 3.0, "h": np.array([0.7, 0.4]), "F": np.array([0.5, 0.9])}
TS = np.linspace(0, 8, 33)


def plays(p):
    """Two sliders with springs beside them, one behind the other: both feel the force σ, and uᵢ keeps |σ − hᵢuᵢ| ≤ Fᵢ."""
    u, forces, turns = np.zeros(2), [], list(np.pi * (np.arange(3) + 0.5))

    def moved(x):
        of = lambda f: np.clip(u, (f - p["F"]) / p["h"], (f + p["F"]) / p["h"])
        f = brentq(lambda f: f - p["c"] * (x - of(f).sum()), -20, 20, xtol=1e-14)
        return f, of(f)

    for t in TS:
        while turns and turns[0] < t:
            u = moved(2 * np.sin(turns.pop(0)))[1]
        forces.append(moved(2 * np.sin(t))[0])
    return np.array(forces)


def test_forces_of_sliders_in_series():
    """Against the play operators, where what one slider takes another feels."""
    motion = jl.simulate(HARDENING, {"x": 0.0, "u": np.zeros(2)}, {"x": 2.0, "u": np.zeros(2)}, TS, SERIES)
    np.testing.assert_allclose(motion.multipliers["drive"], plays(SERIES), rtol=0, atol=1e-10)


@pytest.mark.slow
def test_sliders_in_series():
    """Against the play operators, with the derivatives of the force by all parameters."""

    def run(p):
        motion = jl.simulate(HARDENING, {"x": 0.0, "u": np.zeros(2)}, {"x": 2.0, "u": np.zeros(2)}, TS, p)
        return motion.multipliers["drive"][-1], motion.multipliers["drive"]

    slope, force = jax.jit(jax.jacfwd(run, has_aux=True))(SERIES)
    np.testing.assert_allclose(force, plays(SERIES), rtol=0, atol=1e-10)
    h = 1e-6
    for name in SERIES:
        for i in np.ndindex(np.shape(SERIES[name])):
            step = np.zeros(np.shape(SERIES[name]))
            step[i] = h
            moved = [plays(SERIES | {name: SERIES[name] + s * step})[-1] for s in (1, -1)]
            np.testing.assert_allclose(np.asarray(slope[name])[i], (moved[0] - moved[1]) / (2 * h), rtol=1e-6, atol=1e-6)


L, EI, MP = 2.0, 50.0, 3.0


def beam(q, EI):
    """Of two cubic elements: clamped at the left, where a hinge may turn, loaded in the middle, with another hinge, pinned at the right.

    The elastic rotations, right of the middle and at the pin, are those of least energy.
    """
    l = L / 2
    K = (
        EI
        / l**3
        * np.array(
            [[12, 6 * l, -12, 6 * l], [6 * l, 4 * l**2, -6 * l, 2 * l**2], [-12, -6 * l, 12, -6 * l], [6 * l, 2 * l**2, -6 * l, 4 * l**2]]
        )
    )
    w, (a, c) = q["w"], q["hinges"]
    left = lambda x: jnp.stack([0.0 * w, a, w, x[0] - c])
    right = lambda x: jnp.stack([w, x[0], 0.0 * w, x[1]])
    energy = lambda x: 0.5 * left(x) @ K @ left(x) + 0.5 * right(x) @ K @ right(x)
    none = jnp.zeros(2)
    x = -jnp.linalg.solve(jax.hessian(energy)(none), jax.grad(energy)(none))
    return -energy(x)


@pytest.mark.slow
def test_plastic_hinges_of_a_propped_cantilever():
    """Neal, The Plastic Methods of Structural Analysis, section 2: a first hinge at 16 M/3L, collapse at 6 M/L, elastic unloading."""
    system = jl.System(
        beam, dissipation=lambda qdot, M: M * jnp.sum(jnp.abs(qdot["hinges"])), holonomic={"load": lambda t, q, W: q["w"] - W * jnp.sin(t)}
    )
    elastic, hinged = 7 * L**3 / 768 / EI, L**3 / 48 / EI
    first, collapse = 16 * MP / (3 * L), 6 * MP / L
    w1 = elastic * first
    w2 = w1 + hinged * (collapse - first)
    largest, ts = 2 * w2, np.linspace(0, 2.2, 23)
    zero = np.zeros(2)
    p = {"EI": EI, "M": MP, "W": largest}
    motion = jl.simulate(system, {"w": 0.0, "hinges": zero}, {"w": largest, "hinges": zero}, ts, p, works=True)
    w = largest * np.sin(ts)
    loading = np.interp(w, [0, w1, w2, largest], [0, first, collapse, collapse])
    exact = np.where(ts <= np.pi / 2, loading, collapse - (largest - w) / elastic)
    np.testing.assert_allclose(motion.multipliers["load"], exact, rtol=0, atol=1e-10)
    assert np.max(np.abs(motion.balance())) < 1e-7


@pytest.mark.slow
def test_a_slider_is_identified_from_a_measured_loop():
    """A spring beside a Jenkin element, from the force of two cycles by hand, with noise."""
    loop = jl.System(
        lambda q, k, c: -0.5 * k * q["x"] ** 2 - 0.5 * c * (q["x"] - q["z"]) ** 2,
        dissipation=lambda qdot, F: F * jnp.abs(qdot["z"]),
        holonomic={"drive": lambda t, q: q["x"] - jnp.sin(t)},
    )
    exact, ts, z, force = {"k": 0.4, "c": 2.0, "F": 0.7}, np.linspace(0, 12, 121), 0.0, []
    turns = list(np.pi * (np.arange(4) + 0.5))
    back = lambda x: x - np.clip(exact["c"] * (x - z), -exact["F"], exact["F"]) / exact["c"]
    for t in ts:
        while turns and turns[0] < t:
            z = back(np.sin(turns.pop(0)))
        force.append(exact["k"] * np.sin(t) + exact["c"] * (np.sin(t) - back(np.sin(t))))
    noisy = np.array(force) + 0.01 * np.random.default_rng(3).normal(size=ts.size)
    start = {"x": 0.0, "z": 0.0}, {"x": 1.0, "z": 0.0}
    record = jl.Experiment(ts, {"force": noisy}, *start, observe=lambda multipliers: {"force": multipliers["drive"]}, sigma=0.01)
    fit = jl.fit(loop, record, {"k": 0.6, "c": 1.2, "F": 0.4}, free=("k", "c", "F"))
    off = np.array([fit.params[name] - exact[name] for name in fit.names])
    assert fit.converged and off @ np.linalg.solve(fit.covariance, off) < 16  # χ² of three: one in a thousand is above
    assert all(fit.standard_errors[name] < 0.02 for name in exact)


IWAN = jl.System(
    lambda q, qdot, m, k, c: 0.5 * m * qdot["x"] ** 2 - 0.5 * k * q["x"] ** 2 - 0.5 * jnp.sum(c * (q["x"] - q["z"]) ** 2),
    dissipation=lambda qdot, F: jnp.sum(F * jnp.abs(qdot["z"])),
)


def by_phases(x, z, m, k, c, F, ts):
    """x(t) of a mass on a spring beside Jenkin elements, from rest, by SciPy from one change of its elements to the next."""
    v, side, t, found = 0.0, np.zeros(c.size), 0.0, []
    while t < ts[-1]:
        force = lambda x, side=side, z=z: -k * x - np.where(side == 0, c * (x - z), side * F).sum()
        stuck = np.flatnonzero(side == 0)
        yields = [lambda _, y, i=i, z=z: F[i] - np.sign(y[0] - z[i]) * c[i] * (y[0] - z[i]) for i in stuck]
        events = [lambda _, y: y[1], *yields]
        for event, direction in zip(events, [-np.sign(v or force(x)), *[-1] * len(yields)], strict=True):
            event.terminal, event.direction = True, direction
        within = np.unique(np.r_[ts[(ts >= t) & (ts <= ts[-1])], t])
        rates = lambda _, y, force=force: [y[1], force(y[0]) / m]
        run = solve_ivp(rates, (t, ts[-1]), [x, v], "DOP853", within, events=events, rtol=1e-12, atol=1e-14 * abs(F[0] / c[0]))
        found += [(t, x) for t, x in zip(run.t, run.y[0], strict=True) if t in ts]
        if run.status == 0:
            break
        hit = next(i for i, times in enumerate(run.t_events) if times.size)
        t, (x, v) = run.t_events[hit][0], run.y_events[hit][0]
        z = np.where(side == 0, z, x - side * F / c)
        if hit:
            side = np.where(np.arange(c.size) == stuck[hit - 1], np.sign(v), side)
        else:
            v, side = 0.0, np.zeros(c.size)
    return np.array([dict(found)[t] for t in ts])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("length", "mass", "time"),
    [
        pytest.param(1, 1, 1, id="one", marks=pytest.mark.slow),
        pytest.param(1e-9, 1e-15, 1e-6, id="nm"),
        pytest.param(1e3, 1e6, 1e9, id="km", marks=pytest.mark.slow),
    ],
)
def test_ten_jenkin_elements_against_phases_by_hand(length, mass, time):
    """Iwan's parallel model of a joint rings down, in some units, as does its derivative by all bounds."""
    c, F, ts, unit = np.linspace(0.5, 1.4, 10), np.linspace(0.05, 0.5, 10), np.linspace(0, 6, 13), mass / time**2
    back = lambda F: 0.8 - np.clip(c * 0.8, -F, F) / c  # friction lets a start return to its bound
    exact = lambda F: by_phases(0.8, back(F), 1.0, 2.0, c, F, ts)
    start, p = {"x": 0.8 * length, "z": np.zeros(10)}, {"m": mass, "k": 2 * unit, "c": unit * c}
    run = lambda F: jl.simulate(IWAN, start, {"x": 0.0, "z": np.zeros(10)}, time * ts, p | {"F": unit * length * F}).q["x"] / length
    np.testing.assert_allclose(run(F), exact(F), rtol=0, atol=1e-7)
    slope, h = jax.jit(jax.grad(lambda F: run(F)[-1]))(F), 1e-5
    for i in (0, 4, 9):
        ends = [exact(F + s * h * np.eye(10)[i])[-1] for s in (1, -1)]
        np.testing.assert_allclose(slope[i], (ends[0] - ends[1]) / (2 * h), rtol=1e-4, atol=1e-5)
