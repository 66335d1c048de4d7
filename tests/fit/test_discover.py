"""Which terms of L and D a recording shows: motions by SciPy from equations written by hand, with noise."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxlag as jl


def recorded(rates, starts, names, noise, seconds=10.0, count=501, seed=0):
    """Positions and velocities of motions from each start, with this noise."""
    rng, ts, n = np.random.default_rng(seed), np.linspace(0.0, seconds, count), len(names)
    records = []
    for start in np.atleast_2d(starts).astype(float):
        y = solve_ivp(rates, (0.0, seconds), start, t_eval=ts, rtol=1e-11, atol=1e-12, method="DOP853").y
        seen = y + noise * rng.standard_normal(y.shape)
        values = {name: seen[i] for i, name in enumerate(names)} | {f"rate of {name}": seen[n + i] for i, name in enumerate(names)}
        at = lambda part: dict(zip(names, map(float, part), strict=True))
        records.append(
            jl.Experiment(ts, values, at(start[:n]), at(start[n:]), observe=sensors(tuple(names)), sigma=noise, unknown=("q0", "qdot0"))
        )
    return records


@functools.cache
def sensors(names):
    """Of positions and velocities of the coordinates."""
    return lambda q, qdot: {name: q[name] for name in names} | {f"rate of {name}": qdot[name] for name in names}


def found_as(found, expected, within=0.02):
    """These terms and no others, with coefficients within 2 %."""
    assert {*found.chosen} == {*expected}, found
    for name, value in expected.items():
        np.testing.assert_allclose(float(found.params[name]), value, rtol=within)
    assert not found.groups


c, s = jnp.cos, jnp.sin
ROTATION = {"viscous": lambda qdot: 0.5 * qdot["a"] ** 2, "drag": lambda qdot: jnp.abs(qdot["a"]) ** 3 / 3}


@pytest.mark.parametrize("noise", [1e-3, 6e-2])
def test_a_pendulum(noise):
    bare = jl.System(lambda qdot: 0.5 * qdot["a"] ** 2)
    candidates = {
        "cos": lambda q: c(q["a"]),
        "sin": lambda q: s(q["a"]),
        "cos_squared": lambda q: c(q["a"]) ** 2,
        "product": lambda q: s(q["a"]) * c(q["a"]),
        "inertia_cos": lambda q, qdot: qdot["a"] ** 2 * c(q["a"]),
        "inertia_sin": lambda q, qdot: qdot["a"] ** 2 * s(q["a"]),
        "rate_cos": lambda q, qdot: qdot["a"] * c(q["a"]),
    }
    records = recorded(lambda t, y: [y[1], -9.81 * np.sin(y[0]) - 0.1 * y[1]], [[2.0, 0.0], [-1.0, 3.0]], ["a"], noise)
    found = jl.discover(bare, records, {}, lagrangian=candidates, dissipation=ROTATION)
    found_as(found, {"cos": 9.81, "viscous": 0.1})
    assert found.idle == ("rate_cos",)  # a total derivative by the time
    assert found.stability["cos"] == 1.0 and found.path[1][0] == ("cos",)
    assert "no influence on the motion: rate_cos" in repr(found)
    on_paper = jl.equations(found.system, {"a"}, set(found.params))
    assert "viscous" in str(on_paper) and "cos" in str(on_paper)
    found.fit.interval("viscous")


def test_a_pendulum_on_a_cart():
    """M + m = 1 is known; m l = 0.2, m l² = 0.1, m g l = 1.962."""

    def rates(t, y):
        M = np.array([[1.0, 0.2 * np.cos(y[1])], [0.2 * np.cos(y[1]), 0.1]])
        return [*y[2:], *np.linalg.solve(M, [0.2 * y[3] ** 2 * np.sin(y[1]), -1.962 * np.sin(y[1])])]

    bare = jl.System(lambda qdot: 0.5 * qdot["x"] ** 2 + 0.0 * qdot["a"])
    candidates = {
        "coupling": lambda q, qdot: qdot["x"] * qdot["a"] * c(q["a"]),
        "inertia": lambda qdot: 0.5 * qdot["a"] ** 2,
        "weight": lambda q: c(q["a"]),
        "sin": lambda q: s(q["a"]),
        "coupling_sin": lambda q, qdot: qdot["x"] * qdot["a"] * s(q["a"]),
        "coupling_constant": lambda qdot: qdot["x"] * qdot["a"],
        "inertia_cos": lambda q, qdot: qdot["a"] ** 2 * c(q["a"]),
        "spring": lambda q: -0.5 * q["x"] ** 2,
    }
    records = recorded(rates, [[0.0, 2.0, 0.0, 0.0], [0.1, -1.0, 0.2, 4.0]], ["x", "a"], 1e-2)
    found = jl.discover(bare, records, {}, lagrangian=candidates, dissipation=ROTATION)
    found_as(found, {"coupling": 0.2, "inertia": 0.1, "weight": 1.962})


def test_a_double_pendulum():
    """(m₁ + m₂) l₁² = 1 is known; l₁ = 1, l₂ = 0.8, m₂ = 0.4, g = 9.81."""
    inner, outer, both, g1, g2 = 1.0, 0.256, 0.32, 9.81, 3.1392

    def rates(t, y):
        d = y[0] - y[1]
        M = np.array([[inner, both * np.cos(d)], [both * np.cos(d), outer]])
        f = [-both * y[3] ** 2 * np.sin(d) - g1 * np.sin(y[0]), both * y[2] ** 2 * np.sin(d) - g2 * np.sin(y[1])]
        return [*y[2:], *np.linalg.solve(M, f)]

    bare = jl.System(lambda qdot: 0.5 * qdot["a"] ** 2 + 0.0 * qdot["b"])
    candidates = {
        "outer": lambda qdot: 0.5 * qdot["b"] ** 2,
        "both": lambda q, qdot: qdot["a"] * qdot["b"] * c(q["a"] - q["b"]),
        "weight_1": lambda q: c(q["a"]),
        "weight_2": lambda q: c(q["b"]),
        "both_sin": lambda q, qdot: qdot["a"] * qdot["b"] * s(q["a"] - q["b"]),
        "both_constant": lambda qdot: qdot["a"] * qdot["b"],
        "sin_1": lambda q: s(q["a"]),
        "sin_2": lambda q: s(q["b"]),
        "spring": lambda q: c(q["a"] - q["b"]),
        "outer_cos": lambda q, qdot: qdot["b"] ** 2 * c(q["b"]),
    }
    records = recorded(rates, [[1.0, 0.5, 0.0, 0.0], [-0.6, 1.2, 0.0, 1.0]], ["a", "b"], 1e-3, seconds=5.0)
    found = jl.discover(bare, records, {}, lagrangian=candidates)
    found_as(found, {"outer": outer, "both": both, "weight_1": g1, "weight_2": g2})


@pytest.mark.slow
def test_a_spherical_pendulum():
    def rates(t, y):
        a, _, u, w = y
        return [u, w, np.sin(a) * np.cos(a) * w**2 - 9.81 * np.sin(a), -2 * u * w * np.cos(a) / np.sin(a)]

    bare = jl.System(lambda qdot: 0.5 * qdot["a"] ** 2 + 0.0 * qdot["p"])
    candidates = {
        "around": lambda q, qdot: 0.5 * (s(q["a"]) * qdot["p"]) ** 2,
        "weight": lambda q: c(q["a"]),
        "around_constant": lambda qdot: 0.5 * qdot["p"] ** 2,
        "around_cos": lambda q, qdot: qdot["p"] ** 2 * c(q["a"]),
        "sin": lambda q: s(q["a"]),
        "coupling": lambda qdot: qdot["a"] * qdot["p"],
        "inertia_cos": lambda q, qdot: qdot["a"] ** 2 * c(q["a"]),
    }
    records = recorded(rates, [[1.0, 0.0, 0.0, 2.0], [0.7, 0.3, 1.0, 3.0]], ["a", "p"], 1e-2)
    found = jl.discover(bare, records, {}, lagrangian=candidates)
    found_as(found, {"around": 1.0, "weight": 9.81})


@pytest.mark.slow
def test_a_bob_on_a_rod_in_x_and_y():
    """In mm and t: weight and air, where the rod is a constraint; what is constant along it has no influence."""
    m, l, g, b = 2e-4, 300.0, 9810.0, 3e-4

    def rates(t, y):
        a, u = y
        return [u, -g / l * np.sin(a) - b / m * u]

    ts, rng = np.linspace(0.0, 6.0, 601), np.random.default_rng(1)
    a, u = solve_ivp(rates, (0.0, 6.0), [2.0, 0.0], t_eval=ts, rtol=1e-11, atol=1e-12).y
    seen = {"x": l * np.sin(a), "y": -l * np.cos(a)}
    q0 = {name: float(x[0]) for name, x in seen.items()}
    values = {name: x + 0.3 * rng.standard_normal(601) for name, x in seen.items()}
    record = jl.Experiment(ts, values, q0, {"x": 0.0, "y": 0.0}, sigma=0.3)
    kinetic = lambda qdot, m: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2)
    bare = jl.System(kinetic, holonomic={"rod": lambda q, l: jnp.hypot(q["x"], q["y"]) - l})
    potentials = {
        "up": lambda q: -q["y"],
        "aside": lambda q: -q["x"],
        "radius": lambda q: q["x"] ** 2 + q["y"] ** 2,
        "bowl": lambda q: -(q["y"] ** 2),
    }
    speed = lambda qdot: jnp.sqrt(qdot["x"] ** 2 + qdot["y"] ** 2 + 1e-12)
    losses = {"viscous": lambda qdot: 0.5 * speed(qdot) ** 2, "drag": lambda qdot: speed(qdot) ** 3 / 3}
    found = jl.discover(bare, record, {"m": m, "l": l}, lagrangian=potentials, dissipation=losses)
    found_as(found, {"up": m * g, "viscous": b})
    assert found.idle == ("radius",)


BEARING = {
    "dry": lambda qdot: jnp.abs(qdot["a"]),
    "viscous": lambda qdot: 0.5 * qdot["a"] ** 2,
    "drag": lambda qdot: jnp.abs(qdot["a"]) ** 3 / 3,
}
wheel = jl.System(lambda qdot, J: 0.5 * J * qdot["a"] ** 2, force=lambda t, torque: {"a": torque(t)})


def spun(torque, laws, speed, seconds, noise, J=2e-3, count=801, seed=2):
    """A wheel with these losses, and a record of its speed with this noise."""
    ts, rng = np.linspace(0.0, seconds, count), np.random.default_rng(seed)
    lost = lambda w: laws.get("dry", 0) * np.sign(w) + laws.get("viscous", 0) * w + laws.get("drag", 0) * np.abs(w) * w
    w = solve_ivp(lambda t, y: [(torque(t) - lost(y[0])) / J], (0.0, seconds), [speed], t_eval=ts, rtol=1e-10, atol=1e-12).y[0]
    sines = jl.Signal(ts, torque(ts), jl.interpolation.Cubic())
    seen = w + noise(w) * rng.standard_normal(count)
    return jl.Experiment(ts, {"w": seen}, {"a": 0.0}, {"a": speed}, observe=speed_of, sigma=float(noise(w)), params={"torque": sines})


def speed_of(qdot):
    return {"w": qdot["a"]}


@pytest.mark.slow
def test_three_losses_in_one_bearing():
    """At a ratio of signal to noise of 40 dB."""
    laws = {"dry": 0.02, "viscous": 4e-4, "drag": 2e-5}
    record = spun(lambda t: 0.06 + 0.05 * np.sin(0.7 * t), laws, 5.0, 20.0, lambda w: 0.01 * np.std(w))
    found = jl.discover(wheel, record, {"J": 2e-3}, dissipation=BEARING)
    found_as(found, laws, within=0.05)


@pytest.mark.slow
def test_laws_that_a_speed_cannot_tell_apart():
    """At 20 rad/s, hardly changing, every loss is a constant: one of them, and no one knows which."""
    record = spun(lambda t: 0.02 + 3e-4 * np.sin(2 * t), {"viscous": 1e-3}, 20.0, 10.0, lambda w: 1.0)
    found = jl.discover(wheel, record, {"J": 2e-3}, dissipation=BEARING)
    assert len(found.chosen) == 1 and len(found.groups) == 1
    assert {*found.groups[0]} == {"dry", "viscous", "drag"}
    assert "the recording does not tell which" in repr(found)


def test_nothing_is_there():
    bare = jl.System(lambda qdot: 0.5 * qdot["a"] ** 2 + 0.0, force=lambda q: {"a": -4.0 * q["a"]})
    records = recorded(lambda t, y: [y[1], -4.0 * y[0]], [[1.0, 0.0]], ["a"], 1e-2)
    found = jl.discover(bare, records, {}, dissipation=ROTATION)
    assert found.chosen == () and found.fit is None and "0 of 2 terms" in repr(found)


def test_wrong_use():
    bare = jl.System(lambda qdot: 0.5 * qdot["a"] ** 2)
    records = recorded(lambda t, y: [y[1], -4.0 * y[0]], [[1.0, 0.0]], ["a"], 1e-3)
    of = lambda **given: jl.discover(bare, records, given.pop("params", {}), **given)
    with pytest.raises(ValueError, match="must name candidates, but both are empty"):
        of()
    with pytest.raises(ValueError, match="'k' is none, or is taken"):
        of(params={"k": 1.0}, lagrangian={"k": lambda q: -0.5 * q["a"] ** 2})
    with pytest.raises(ValueError, match="'two words' is none"):
        of(lagrangian={"two words": lambda q: -0.5 * q["a"] ** 2})
    for width in (-1.0, 1e3, np.nan):
        with pytest.raises(ValueError, match="`width` must be (positive and at most the length of the longest record|finite)"):
            of(lagrangian={"spring": lambda q: -0.5 * q["a"] ** 2}, width=width)
    alike = {"sin": lambda q: s(q["a"]) ** 2, "cos": lambda q: c(q["a"]) ** 2, "spring": lambda q: -0.5 * q["a"] ** 2}
    with pytest.raises(ValueError, match="candidates must be independent, but sin, cos are not"):
        of(lagrangian=alike)
    with pytest.raises(ValueError, match="must leave a known term"):
        jl.discover(
            jl.System(lambda q, qdot: 0.0 * qdot["a"]),
            records,
            {},
            lagrangian={"inertia": lambda qdot: 0.5 * qdot["a"] ** 2, "spring": lambda q: -0.5 * q["a"] ** 2},
        )
