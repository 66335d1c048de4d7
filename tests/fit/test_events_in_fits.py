"""Times of events as measurements: a ball is identified from the sound of its impacts, as by its closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

G = 9.81
SIGMA = 1e-4
ball = jl.System(
    lambda q, qdot: 0.5 * qdot**2 - G * q,
    unilateral={"floor": jl.Contact(lambda q: q, restitution=lambda e: e)},
    events={"click": jl.Event("floor")},
)
TS = jnp.linspace(0.0, 3.0, 16)


def clicks(e, h, count=7):
    """√(2h/g) (1 + 2e + 2e² + …)."""
    k = jnp.arange(count)
    return jnp.sqrt(2 * h / G) * (2 * jnp.cumsum(e**k) - 1)


def recording(**more):
    heard = clicks(0.82, 0.7) + SIGMA * np.random.default_rng(1).standard_normal(7)
    heard = heard.at[3].set(jnp.nan)  # one was missed
    height = 0.7 + jnp.full(16, jnp.nan).at[0].set(0.002)
    return jl.Experiment(TS, {"q": height}, 0.65, 0.0, observe=lambda q: {"q": q}, events={"click": heard}, unknown=["q0"], **more), heard


@pytest.mark.slow
def test_restitution_from_the_sound_of_a_ball():
    """Estimates and standard errors are those of least squares on the closed form."""
    experiment, heard = recording(sigma={"q": 0.01, "click": SIGMA})
    found = jl.fit(ball, experiment, {"e": 0.8}, free=["e"])
    there = jnp.isfinite(heard)

    def weighted(x):
        r = jnp.where(there, (clicks(*x) - jnp.where(there, heard, 0)) / SIGMA, 0)
        return jnp.concatenate([r, (x[1:] - 0.702) / 0.01])

    x = jnp.array([0.8, 0.65])
    for _ in range(20):
        x = x - jnp.linalg.lstsq(jax.jacfwd(weighted)(x), weighted(x))[0]
    J = jax.jacfwd(weighted)(x)
    np.testing.assert_allclose(found.params["e"], x[0], rtol=1e-7)
    np.testing.assert_allclose(found.standard_errors["e"], jnp.sqrt(jnp.linalg.inv(J.T @ J)[0, 0]), rtol=1e-4)
    assert abs(found.params["e"] - 0.82) < 4 * found.standard_errors["e"]


@pytest.mark.slow
def test_nothing_but_clicks():
    """Restitution and height of a ball in a plane, by Gauss and Newton's method on the closed form; the place of the throw is known."""
    heard = clicks(0.83, 0.62) + 1e-3 * np.random.default_rng(0).standard_normal(7)
    thrown = jl.System(
        lambda q, qdot: 0.5 * (qdot["x"] ** 2 + qdot["y"] ** 2) - G * q["y"],
        unilateral={"floor": jl.Contact(lambda q: q["y"], restitution=lambda e: e)},
        events={"click": jl.Event("floor")},
    )
    start = {"x": 0.0, "y": 0.65}, {"x": 1.0, "y": 0.0}
    record = jl.Experiment(TS, None, *start, events={"click": heard}, unknown=("q0.y",), sigma={"click": 1e-3})
    found = jl.fit(thrown, record, {"e": 0.82}, free=("e",))
    x = jnp.array([0.82, 0.65])
    for _ in range(20):
        J = jax.jacfwd(lambda x: clicks(*x))(x)
        x = x + jnp.linalg.lstsq(J, heard - clicks(*x))[0]
    errors = 1e-3 * jnp.sqrt(jnp.diag(jnp.linalg.inv(J.T @ J)))
    np.testing.assert_allclose([found.params["e"], found.unknowns[0]["q0"]["y"]], x, rtol=1e-7)
    np.testing.assert_allclose([found.standard_errors["e"], found.unknown_errors[0]["q0"]["y"]], errors, rtol=1e-4)
    assert "q0.y" in repr(found) and "q0.x" not in repr(found)
    assert [row["name"] for row in found.to_dict()["parameters"]] == ["e", "experiment 0: q0.y"]


@pytest.mark.slow
def test_clear_errors():
    experiment, _ = recording(sigma=1e-3)
    with pytest.raises(ValueError, match="must name events of the system, but holds 'click'"):
        jl.fit(ball.with_events(None), experiment, {"e": 0.8}, free=["e"])
    with pytest.raises(ValueError, match="must have no events in `fit` with `segments`|must have no contacts"):
        jl.fit(ball, experiment, {"e": 0.8}, free=["e"], segments=2)
    with pytest.raises(ValueError, match="must have no events in `regress`"):
        counted = jl.System(lambda q, qdot, m: 0.5 * m * qdot**2, events={"zero": jl.Event(lambda q: q)})
        jl.regress(counted, jl.Experiment(TS, TS, 0.0, 1.0), {"m": 1.0}, free=["m"])
    with pytest.raises(ValueError, match="at most 16 times"):
        jl.Experiment(TS, {"q": TS}, {"q": 1.0}, {"q": 0.0}, events={"click": np.ones(17)})
    with pytest.raises(TypeError, match="must be a mapping of channels"):
        jl.Experiment(TS, TS, 1.0, 0.0, events={"click": np.ones(3)})
