"""Friction and restitution from tosses: a square prism that tumbles about its axis and comes to rest, seen by a camera. Synthetic."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

CORNERS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])


def corners(q, a):
    """Their places, (4, 2)."""
    c, s = jnp.cos(q["phi"]), jnp.sin(q["phi"])
    return jnp.stack([q["x"] + a * (CORNERS[:, 0] * c - CORNERS[:, 1] * s), q["y"] + a * (CORNERS[:, 0] * s + CORNERS[:, 1] * c)], axis=1)


def rubbing(q, qdot, multipliers, mu, a):
    slip = jax.jvp(lambda q: corners(q, a), (q,), (qdot,))[1][:, 0]
    return mu * jnp.sum(multipliers["corners"] * jnp.abs(slip))


def energy(q, qdot, m, k, g):
    return 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2 + k**2 * qdot["phi"] ** 2) - m * g * q["y"]


prism = jl.System(
    energy,
    dissipation={"rubbing": rubbing},
    unilateral={"corners": jl.Contact(lambda q, a: corners(q, a)[:, 1], restitution=lambda e: e)},
)
TRUTH = {"m": 0.37, "k": 0.1 / np.sqrt(6), "g": 9.81, "a": 0.05, "mu": 0.18, "e": 0.125}  # m, kg, s; μ and e of Pfrommer et al., CoRL 2020


def thrown(rng, metre):
    """A start above the table, with spin, that of ContactNets' cube in scale."""
    q0 = {"x": 0.0, "y": metre * rng.uniform(0.1, 0.14), "phi": rng.uniform(0, 2 * np.pi)}
    return q0, {"x": metre * rng.uniform(-1, 1), "y": metre * rng.uniform(-0.5, 0.5), "phi": rng.uniform(-10, 10)}


def recorded(count, seed, metre=1.0, **options):
    """What a camera sees of some tosses, to 0.2 mm and 4 mrad."""
    rng, ts = np.random.default_rng(seed), jnp.linspace(0.0, 0.3, 31)
    params = TRUTH | {name: metre * TRUTH[name] for name in ("k", "g", "a")}
    sigma = {"x": 2e-4 * metre, "y": 2e-4 * metre, "phi": 4e-3}
    records, impacts = [], []
    for _ in range(count):
        start = thrown(rng, metre)
        motion = jl.simulate(prism, *start, ts, params)
        impacts.append(int(motion.contacts["corners"].impacts[-1].sum()))
        values = {name: np.asarray(motion.q[name]) + s * rng.normal(size=ts.size) for name, s in sigma.items()}
        records.append(jl.Experiment(ts, values, *start, sigma=sigma, **options))
    return records, params, impacts


@pytest.mark.slow
def test_friction_and_restitution_of_twenty_tosses():
    """From numbers that are twice as large, though that is another number of impacts: within 2σ and 5 %."""
    records, params, impacts = recorded(20, seed=1)
    assert max(impacts) >= 8 and sum(impacts) > 60
    found = jl.fit(prism, records, params | {"mu": 0.3, "e": 0.3}, free=("mu", "e"))
    assert found.converged
    for name in ("mu", "e"):
        off = found.estimates[name] - TRUTH[name]
        assert abs(off) < 0.05 * TRUTH[name] and abs(off) < 2 * found.standard_errors[name] + 1e-12


@pytest.mark.slow
def test_with_inertia_and_unknown_starts_in_other_units():
    """In micrometres, the radius of gyration as well, and positions and velocities at the start of each toss."""
    records, params, _ = recorded(4, seed=2, metre=1e6, unknown=("q0", "qdot0"))
    found = jl.fit(prism, records, params | {"mu": 0.25, "e": 0.2, "k": 1.1 * params["k"]}, free=("mu", "e", "k"))
    assert found.converged
    for name in ("mu", "e", "k"):
        off = found.estimates[name] - params[name]
        assert abs(off) < 0.05 * params[name] and abs(off) < 3 * found.standard_errors[name]
