"""A constrained double pendulum seen by cameras: masses, rod lengths and joint damping from its markers; a chaotic record in segments."""

import jax.numpy as jnp
import numpy as np
import oscillator as osc
import pytest
from scipy.integrate import solve_ivp

import jaxlag as jl
from jaxlag._fit import multiple_shooting
from jaxlag._fit.levenberg_marquardt import STALLED, Iterate, Outcome

TRUE = {"m2": 0.6, "l1": 0.5, "l2": 0.4, "b1": 0.02, "b2": 0.01}  # SI; the upper mass is 1
START = {"m2": 1.0, "l1": 0.6, "l2": 0.3, "b1": 0.05, "b2": 0.03}
NOISE = 0.005  # 1 % of the rods
LOOSE = {"rtol": 1e-7, "atol": 1e-9}


def rates(t, state, m2, l1, l2, b1, b2, g=9.81):
    """The double pendulum in absolute angles, by hand."""
    a, b, wa, wb = state
    cos, sin = np.cos(a - b), np.sin(a - b)
    M = np.array([[(1 + m2) * l1**2, m2 * l1 * l2 * cos], [m2 * l1 * l2 * cos, m2 * l2**2]])
    forces = [
        -m2 * l1 * l2 * sin * wb**2 - (1 + m2) * g * l1 * np.sin(a) - b1 * wa - b2 * (wa - wb),
        m2 * l1 * l2 * sin * wa**2 - m2 * g * l2 * np.sin(b) - b2 * (wb - wa),
    ]
    return [wa, wb, *np.linalg.solve(M, forces)]


def markers(end, samples, angle, seed):
    """Two markers with noise, a fifth of the samples missing."""
    ts = np.linspace(0, end, samples)
    start = [angle, 1.1 * angle, 0.3, -0.4]
    a, b, *_ = solve_ivp(rates, (0, end), start, "DOP853", ts, args=tuple(TRUE.values()), rtol=1e-11, atol=1e-12).y
    upper = TRUE["l1"] * np.stack([np.sin(a), -np.cos(a)], axis=1)
    lower = upper + TRUE["l2"] * np.stack([np.sin(b), -np.cos(b)], axis=1)
    rng = np.random.default_rng(seed)
    seen = {}
    for name, marker in (("upper", upper), ("lower", lower)):
        seen[name] = marker + NOISE * rng.standard_normal(marker.shape)
        seen[name][rng.random(marker.shape) < 0.2] = np.nan
    return ts, seen


def lagrangian(q, qdot, m2):
    kinetic = 0.5 * qdot["upper"] @ qdot["upper"] + 0.5 * m2 * qdot["lower"] @ qdot["lower"]
    return kinetic - 9.81 * (q["upper"][1] + m2 * q["lower"][1])


def turning(rod, rate):
    return (rod[0] * rate[1] - rod[1] * rate[0]) / (rod @ rod)


def joints(q, qdot, b1, b2):
    first = turning(q["upper"], qdot["upper"])
    second = turning(q["lower"] - q["upper"], qdot["lower"] - qdot["upper"])
    return 0.5 * b1 * first**2 + 0.5 * b2 * (second - first) ** 2


def along(q, l1, l2):
    rod = q["lower"] - q["upper"]
    return {"upper": q["upper"] @ q["upper"] - l1**2, "lower": rod @ rod - l2**2}


PENDULUM = jl.System(lagrangian, dissipation=joints, holonomic={"rods": along})


def record(*which):
    """The first samples that are complete are the guess of where it starts; nothing is known of its velocity."""
    ts, seen = markers(*which)
    guess = {name: z[np.flatnonzero(np.all(np.isfinite(z), axis=1))[0]] for name, z in seen.items()}
    rest = {name: np.zeros(2) for name in guess}
    return jl.Experiment(ts, seen, guess, rest, unknown=("q0", "qdot0"), sigma=NOISE)


@pytest.mark.slow
def test_a_double_pendulum_from_its_markers():
    """Started a fifth to a factor of three off. The start is found on the rods."""
    e = record(3.0, 150, 1.0, 1)
    found = jl.fit(PENDULUM, e, START, free=tuple(START), **LOOSE)
    assert found.converged and abs(found.sigma - 1) < 0.1
    for name, value in TRUE.items():
        assert abs(found.estimates[name] - value) < 3 * found.standard_errors[name], name
    q0 = found.unknowns[0]["q0"]
    np.testing.assert_allclose(jnp.linalg.norm(q0["upper"]), found.estimates["l1"], rtol=1e-10)
    ts, a0 = found.experiments[0].ts, 1.0
    true_start = TRUE["l1"] * np.array([np.sin(a0), -np.cos(a0)])
    assert np.all(np.abs(q0["upper"] - true_start) < 4 * found.unknown_errors[0]["q0"]["upper"])
    assert np.all(found.unknown_errors[0]["qdot0"]["lower"] > 0) and ts.size == 150


@pytest.mark.slow
def test_everything_free_leaves_the_common_factor_of_masses_and_damping():
    """Cameras see no forces."""
    weighed = jl.System(
        lambda q, qdot, m1, m2: lagrangian(q, qdot, m2) + (m1 - 1) * (0.5 * qdot["upper"] @ qdot["upper"] - 9.81 * q["upper"][1]),
        dissipation=joints,
        holonomic={"rods": along},
    )
    e = record(3.0, 150, 1.0, 1)
    plan = jl.information(weighed, e, TRUE | {"m1": 1.0}, free=("m1", "m2", "b1", "b2"), **LOOSE)
    assert all(np.isinf(plan.standard_errors[name]) for name in ("m1", "m2", "b1", "b2"))
    known = jl.information(weighed, e, TRUE | {"m1": 1.0}, free=("m2", "b1", "b2"), **LOOSE)
    assert all(np.isfinite(known.standard_errors[name]) for name in ("m2", "b1", "b2"))


@pytest.mark.slow
def test_gaps_that_the_integration_leaves_end_the_rounds():
    """With loose tolerances no weight closes the gaps: the last that helped is kept, and the estimates are those of SciPy's motion."""
    ts = np.linspace(0, 50, 500)
    swing = lambda t, s: [s[1], -9.81 * np.sin(s[0]) - 0.05 * s[1]]
    angle = solve_ivp(swing, (0, 50), [2.5, 0], t_eval=ts, rtol=1e-11, atol=1e-12).y[0]
    pendulum = jl.System(lambda q, qdot, g: 0.5 * qdot**2 + g * jnp.cos(q), dissipation=lambda qdot, b: 0.5 * b * qdot**2)
    for seed, start in ((0, 8.0), (2, 8.1), (3, 8.0), (3, 8.1)):  # where the steps of the motion change, the cost jumps: that is no kink
        e = jl.Experiment(ts, angle + 0.01 * np.random.default_rng(seed).standard_normal(500), 2.5, 0.0)
        found = jl.fit(pendulum, e, {"g": start, "b": 0.1}, free=("g", "b"), segments=20, rtol=1e-3, atol=1e-4)
        assert found.converged and abs(found.costs[-1] / found.cost - 1) < 0.02  # the gaps contribute next to nothing
        for name, value in {"g": 9.81, "b": 0.05}.items():
            assert abs(found.estimates[name] - value) < 3 * found.standard_errors[name], name


@pytest.mark.slow
def test_gaps_that_do_not_close_are_reported(monkeypatch):
    """An iteration that goes nowhere."""

    def stuck(linearise, x, **_):
        r, J, found = linearise(x)
        nothing = jnp.zeros(0)
        return Outcome(Iterate(x, r, J, found, float(r @ r) / 2, *[nothing] * 6, np.asarray(STALLED)), 1, np.ones(1))

    monkeypatch.setattr(multiple_shooting, "levenberg_marquardt", stuck)
    found = jl.fit(osc.SYSTEM, osc.record(0), osc.START, free=("c", "b"), segments=3)
    assert not found.converged and "the segments do not join" in found.reason and found.steps < 10


@pytest.mark.slow
def test_a_chaotic_record_in_segments():
    """20 s with overturning: single shooting from the given start loses the motion; 40 segments find it, and the gaps close."""
    e = record(20.0, 1000, 2.2, 1)
    found = jl.fit(PENDULUM, e, START, free=tuple(START), segments=40, max_steps=150, **LOOSE)
    assert found.converged and abs(found.sigma - 1) < 0.05
    for name, value in TRUE.items():
        assert abs(found.estimates[name] - value) < 4 * found.standard_errors[name], name
        assert found.standard_errors[name] < 0.02 * value
    single = jl.fit(PENDULUM, e, START, free=tuple(START), max_steps=30, **LOOSE)
    assert single.sigma > 5  # nowhere near the noise


def test_there_is_at_least_one():
    with pytest.raises(ValueError, match="`segments` must be at least 1, but is 0"):
        jl.fit(osc.SYSTEM, osc.record(0), osc.START, free=("c", "b"), segments=0)
    with pytest.raises(ValueError, match="`count` must be at least 2, but is 1"):
        jl.MultiStart(1)
