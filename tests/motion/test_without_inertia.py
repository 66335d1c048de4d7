"""Motions with coordinates without inertia: viscoelastic and overdamped ones by closed forms, hysteresis by return mapping."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

import jaxlag as jl

SHARP = {"rtol": 1e-11, "atol": 1e-12}

# A mass on a Maxwell element: spring and dashpot in series, with the node z between them


def stretched(q, c):
    return -0.5 * c * (q["x"] - q["z"]) ** 2


MAXWELL = jl.System(
    {"mass": lambda qdot, m: 0.5 * m * qdot["x"] ** 2, "spring": stretched}, dissipation=lambda qdot, b: 0.5 * b * qdot["z"] ** 2
)
Q0, V0, P = {"x": 1.0, "z": 0.2}, {"x": 0.3, "z": 0.0}, {"m": 2.0, "c": 3.0, "b": 0.7}
TS = np.linspace(0, 5, 41)


def rates(m, c, b):
    """ẏ = A y of y = (x, ẋ, z)."""
    return np.array([[0, 1, 0], [-c / m, 0, c / m], [c / b, 0, -c / b]])


def by_hand(p):
    return np.array([expm(rates(**p) * t) @ [1.0, 0.3, 0.2] for t in TS]).T


@pytest.mark.slow
def test_maxwell_element():
    motion = jl.simulate(MAXWELL, Q0, V0, TS, P, works=True, **SHARP)
    x, v, z = by_hand(P)
    for found, exact in ((motion.q["x"], x), (motion.qdot["x"], v), (motion.q["z"], z), (motion.qdot["z"], 3 / 0.7 * (x - z))):
        np.testing.assert_allclose(found, exact, rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.qddot["z"], 3 / 0.7 * (v - 3 / 0.7 * (x - z)), rtol=0, atol=1e-8)
    assert np.max(np.abs(motion.balance())) < 1e-9


def end(p, **more):
    motion = jl.simulate(MAXWELL, Q0, V0, TS, p, **SHARP, **more)
    return jnp.stack([motion.q["x"][-1], motion.qdot["z"][-1]])


@pytest.mark.slow
def test_gradients_of_the_maxwell_element():
    def exact(p):
        x, _, z = by_hand(p)
        return np.array([x[-1], p["c"] / p["b"] * (x[-1] - z[-1])])

    forward, reverse, second = jax.jacfwd(end)(P), jax.jacrev(end)(P), jax.jacfwd(jax.jacfwd(end))(P)
    h = 1e-4
    moved = lambda name, s: exact(P | {name: P[name] + s * h})
    for name in P:
        want = (8 * (moved(name, 1) - moved(name, -1)) - (moved(name, 2) - moved(name, -2))) / (12 * h)
        np.testing.assert_allclose(forward[name], want, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(reverse[name], want, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(second[name][name], (moved(name, 1) - 2 * exact(P) + moved(name, -1)) / h**2, rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_redundant_rows_beside_a_maxwell_element():
    """A mass of two halves, tied by two rows that say the same: λ of least norm, and together half of the spring's force."""
    tied = jl.System(
        lambda q, qdot, m, c: 0.25 * m * (qdot["x"] ** 2 + qdot["y"] ** 2) + stretched(q, c),
        dissipation=lambda qdot, b: 0.5 * b * qdot["z"] ** 2,
        holonomic={"tie": lambda q: q["x"] - q["y"], "twice": lambda q: 2 * q["x"] - 2 * q["y"]},
    )
    motion = jl.simulate(tied, Q0 | {"y": 1.0}, V0 | {"y": 0.3}, TS, P, **SHARP)
    x, _, z = by_hand(P)
    np.testing.assert_allclose(motion.q["x"], x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.q["z"], z, rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.multipliers["tie"], 1.5 * (x - z) / 5, rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.multipliers["twice"], 2 * motion.multipliers["tie"], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_many_maxwell_elements():
    b = np.array([0.5, 0.7, 0.9])
    motions = jl.simulate_many(MAXWELL, Q0, V0, TS, P | {"b": b}, over=("b",), **SHARP)
    for i, b_i in enumerate(b):
        x, _, z = by_hand(P | {"b": b_i})
        np.testing.assert_allclose(motions.q["x"][i], x, rtol=0, atol=1e-9)
        np.testing.assert_allclose(motions.qdot["z"][i], 3 / b_i * (x - z), rtol=0, atol=1e-8)


@pytest.mark.slow
def test_a_maxwell_element_is_identified():
    noise = np.random.default_rng(1).normal(size=TS.size) * 1e-3
    experiment = jl.Experiment(TS, {"x": by_hand(P)[0] + noise}, q0=Q0, qdot0=V0, observe=lambda q: {"x": q["x"]})
    fit = jl.fit(MAXWELL, experiment, P | {"c": 2.5, "b": 1.0}, free=("c", "b"))
    for name in ("c", "b"):
        assert abs(fit.params[name] - P[name]) < 3 * fit.standard_errors[name] < 0.1


@pytest.mark.slow
def test_linearised_printed_examined():
    linear = jl.linearise(MAXWELL, {"x": 0.0, "z": 0.0}, params=P)
    assert linear.state_names == ("x", "z", "x_dot")
    np.testing.assert_allclose(np.sort(linear.eigenvalues), np.sort(np.linalg.eigvals(rates(**P))), rtol=1e-10, atol=1e-12)
    assert str(jl.equations(MAXWELL, Q0, P)).splitlines()[1] == "b ż − c (x − z) = 0"
    found = jl.examine(MAXWELL, Q0, V0, P)
    assert found.without_inertia == ("z",) and found.findings == () and found.smallest_inertia == 2.0


def test_the_limit_of_a_small_mass():
    """With a mass ε on the node the motion differs in proportion to ε, behind the first instants."""
    heavy = jl.System(
        {"masses": lambda qdot, m, eps: 0.5 * m * qdot["x"] ** 2 + 0.5 * eps * qdot["z"] ** 2, "spring": stretched},
        dissipation=lambda qdot, b: 0.5 * b * qdot["z"] ** 2,
    )
    off = [jl.simulate(heavy, Q0, V0, TS, P | {"eps": eps}, **SHARP).q["x"][-1] - by_hand(P)[0, -1] for eps in (1e-3, 1e-4)]
    np.testing.assert_allclose(off[0] / off[1], 10, rtol=0.02)


# Solids and circuits, with a driven end


@pytest.mark.slow
def test_standard_linear_solid_relaxes_and_creeps():
    """Spring E beside a Maxwell element (c, b): the force after a jump of strain, and the strain under a load."""
    relaxing = jl.System(
        lambda q, E, c: -0.5 * E * q["x"] ** 2 + stretched(q, c),
        dissipation=lambda qdot, b: 0.5 * b * qdot["z"] ** 2,
        holonomic={"grip": lambda q, x0: q["x"] - x0},
    )
    p = {"E": 2.0, "c": 3.0, "b": 0.7, "x0": 0.5}
    motion = jl.simulate(relaxing, {"x": 0.5, "z": 0.0}, {"x": 0.0, "z": 0.0}, TS, p, **SHARP)
    np.testing.assert_allclose(motion.multipliers["grip"], 0.5 * (2 + 3 * np.exp(-TS * 3 / 0.7)), rtol=0, atol=1e-10)

    creeping = jl.System(
        lambda q, E, c: -0.5 * E * q["x"] ** 2 + stretched(q, c) + 1.5 * q["x"],
        dissipation=lambda qdot, b, a: 0.5 * b * qdot["z"] ** 2 + 0.5 * a * qdot["x"] ** 2,
    )
    motion = jl.simulate(creeping, {"x": 0.0, "z": 0.0}, {"x": 0.0, "z": 0.0}, TS, p | {"a": 2.0}, **SHARP)
    A = np.array([[-(2 + 3) / 2, 3 / 2], [3 / 0.7, -3 / 0.7]])
    rest = np.linalg.solve(A, [-1.5 / 2, 0])
    exact = np.array([rest - expm(A * t) @ rest for t in TS])
    np.testing.assert_allclose(motion.q["x"], exact[:, 0], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_ladder_of_resistors_with_capacitors_and_coils():
    """Charges of meshes, L = ½ Σ Lᵢ q̇ᵢ² − Σ qᵢ²/2C − …, D = ½ Σ R (q̇ᵢ − q̇ᵢ₊₁)²: some meshes have a coil, some have none."""
    coils, caps, R = np.array([0.3, 0.0, 0.0, 0.2]), np.array([1.0, 0.5, 2.0, 0.8]), np.array([1.0, 2.0, 0.5, 1.5, 0.7])
    bearing = np.flatnonzero(coils)
    ladder = jl.System(
        lambda q, qdot, caps: 0.5 * jnp.sum(coils[bearing] * qdot[bearing] ** 2) - 0.5 * jnp.sum(q**2 / caps) + q[0],
        dissipation=lambda qdot, R: 0.5 * jnp.sum(R * jnp.diff(jnp.concatenate([jnp.zeros(1), qdot, jnp.zeros(1)])) ** 2),
    )
    motion = jl.simulate(ladder, np.zeros(4), np.zeros(4), TS, {"caps": caps, "R": R}, **SHARP)
    D = np.diff(np.vstack([np.zeros(4), np.eye(4), np.zeros(4)]), axis=0)
    K, without = D.T @ np.diag(R) @ D, [1, 2]

    def rate(y):
        q, i = y[:4], np.zeros(4)
        i[bearing] = y[4:]
        force = np.eye(4)[0] - q / caps
        i[without] = np.linalg.solve(K[np.ix_(without, without)], (force - K @ i)[without])
        return np.r_[i, ((force - K @ i) / np.where(coils > 0, coils, 1))[bearing]]

    A = np.array([rate(e) - rate(np.zeros(6)) for e in np.eye(6)]).T
    rest = -np.linalg.solve(A, rate(np.zeros(6)))
    exact = np.array([rest - expm(A * t) @ rest for t in TS])
    np.testing.assert_allclose(motion.q, exact[:, :4], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_rouse_modes_of_an_overdamped_chain():
    """100 beads: the mode p decays with the rate 4 k/ζ sin²(p π/2n). de Gennes, Scaling Concepts in Polymer Physics, section VI.1."""
    n, k, zeta = 100, 30.0, 1.2
    chain = jl.System(lambda q, k: -0.5 * k * jnp.sum(jnp.diff(q) ** 2), dissipation=lambda qdot, zeta: 0.5 * zeta * jnp.sum(qdot**2))
    modes = [np.cos(np.pi * p * (np.arange(n) + 0.5) / n) for p in (1, 3, 40)]
    ts = np.linspace(0, 2, 5)
    motion = jl.simulate(chain, sum(modes), np.zeros(n), ts, {"k": k, "zeta": zeta}, rtol=1e-11, atol=1e-13)
    decays = [np.exp(-4 * k / zeta * np.sin(p * np.pi / (2 * n)) ** 2 * ts) for p in (1, 3, 40)]
    np.testing.assert_allclose(motion.q, sum(map(np.outer, decays, modes)), rtol=0, atol=1e-9)
    assert chain and motion.multipliers == {}


@pytest.mark.slow
def test_a_dashpot_of_drag_comes_to_rest_in_finite_time():
    """c z = k ż²: √z falls at the rate ½ √(c/k), and stays at zero."""
    drag = jl.System(lambda q, c: -0.5 * c * q**2, dissipation=lambda qdot, k: k * jnp.abs(qdot) ** 3 / 3)
    ts = np.linspace(0, 2.2, 23)
    motion = jl.simulate(drag, 1.0, 0.0, ts, {"c": 1.0, "k": 1.0})
    np.testing.assert_allclose(motion.q, np.maximum(1 - ts / 2, 0) ** 2, rtol=0, atol=1e-8)
    np.testing.assert_allclose(motion.qdot[:20], -np.maximum(1 - ts / 2, 0)[:20], rtol=0, atol=1e-7)


@pytest.mark.slow
def test_a_rod_to_a_node_that_dashpots_hold():
    """A mass that hangs by a rod on a node without inertia: its small motions, by hand, and energy."""
    rod = jl.System(
        lambda q, qdot, m: 0.5 * m * qdot["x"] @ qdot["x"] - 9.81 * m * q["x"][1] - 50.0 * q["z"] @ q["z"],
        dissipation=lambda qdot, b: 0.5 * b * qdot["z"] @ qdot["z"],
        holonomic={"rod": lambda q: (q["x"] - q["z"]) @ (q["x"] - q["z"]) - 1.0},
    )
    p, still = {"m": 2.0, "b": 0.7}, jnp.zeros(2)
    rest = jl.equilibrium(rod, {"x": jnp.array([0.0, -1.2]), "z": jnp.array([0.0, -0.2])}, p)
    tension = 2 * 9.81
    sideways = [[0, 1, 0], [-tension / 2, 0, tension / 2], [tension / 0.7, 0, -(100 + tension) / 0.7]]
    exact = np.concatenate([np.linalg.eigvals(sideways), np.roots([2, 0.7, 100])])
    np.testing.assert_allclose(np.sort_complex(jl.linearise(rod, rest, params=p).eigenvalues), np.sort_complex(exact), rtol=1e-9)
    motion = jl.simulate(rod, {"x": jnp.array([1.0, 0.0]), "z": still}, {"x": still, "z": still}, TS, p, works=True, rtol=1e-10)
    assert np.max(np.abs(motion.balance())) < 1e-8 * 2 * 9.81
    assert np.max(np.abs(jl.constraint_residual(rod, rest.q, rest.qdot, p).position["rod"])) < 1e-12


# Hysteresis: dry friction without inertia

N = 10
IWAN = jl.System(
    lambda q, c: -0.5 * jnp.sum(c * (q["x"] - q["z"]) ** 2),
    dissipation={"sliders": lambda qdot, F: jnp.sum(F * jnp.abs(qdot["z"]))},
    holonomic={"drive": lambda t, q: q["x"] - path(t)},
)
IWAN_P = {"c": np.linspace(1, 3, N), "F": np.array([0.2, 0.35, 0.5, 0.65, 0.8, 0.95, 1.1, 1.3, 1.6, 9.0])}  # the last one never slips
IWAN_TS = np.linspace(0, 16, 161)


def path(t):
    return jnp.sin(t) * (1 + 0.3 * jnp.sin(0.37 * t))


def return_mapping(p):
    """Force, z, and heat at the times, from turning point to turning point of the path."""
    slope = jax.grad(path)
    grid = np.linspace(0, 16, 3201)
    d = np.asarray(jax.vmap(slope)(grid))
    turns = [brentq(slope, grid[i], grid[i + 1], xtol=1e-15) for i in np.flatnonzero(d[:-1] * d[1:] < 0)]
    z, forces, nodes, heat, now, before = np.zeros(N), [], [], [], list(turns), 0.0
    back = lambda x: x - np.clip(p["c"] * (x - z), -p["F"], p["F"]) / p["c"]
    for t in IWAN_TS:
        while now and now[0] < t:
            left, z = z, back(float(path(now.pop(0))))
            before += p["F"] @ np.abs(z - left)
        x = float(path(t))
        nodes.append(back(x))
        forces.append(np.sum(p["c"] * (x - nodes[-1])))
        heat.append(before + p["F"] @ np.abs(nodes[-1] - z))
    return np.array(forces), np.array(nodes), np.array(heat)


def loop(p, **more):
    return jl.simulate(IWAN, {"x": 0.0, "z": jnp.zeros(N)}, {"x": 1.0, "z": jnp.zeros(N)}, IWAN_TS, p, **more)


@pytest.mark.slow
def test_iwan_against_return_mapping():
    motion, (force, z, heat) = loop(IWAN_P, works=True, **SHARP), return_mapping(IWAN_P)
    np.testing.assert_allclose(motion.multipliers["drive"], force, rtol=0, atol=1e-10)
    np.testing.assert_allclose(motion.q["z"], z, rtol=0, atol=1e-10)
    assert np.all(motion.q["z"][:, -1] == 0) and np.all(motion.friction["sliders"].sticking[:, -1])
    np.testing.assert_allclose(-motion.work()["sliders"], heat, rtol=0, atol=1e-8 * heat[-1])
    assert np.max(np.abs(motion.balance())) < 1e-8


@pytest.mark.slow
def test_gradients_of_iwan():
    """From both sides, at samples away from transitions."""
    at = np.array([37, 90, 133])
    forward = jax.jacfwd(lambda p: loop(p).multipliers["drive"][at])(IWAN_P)
    h = 1e-6
    for name in ("c", "F"):
        for i in range(N):
            moved = [return_mapping(IWAN_P | {name: IWAN_P[name] + s * h * np.eye(N)[i]})[0][at] for s in (1, -1)]
            np.testing.assert_allclose(forward[name][:, i], (moved[0] - moved[1]) / (2 * h), rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_a_sprung_mass_with_a_jenkin_element_against_phases_by_hand():
    """x'' = −k x − c (x − z): phases of sticking and slipping, each a harmonic motion, from event to event."""
    system = jl.System(
        lambda q, qdot, m, k: 0.5 * m * qdot["x"] ** 2 - 0.5 * k * q["x"] ** 2 - 4.0 * (q["x"] - q["z"]) ** 2,
        dissipation=lambda qdot, F: F * jnp.abs(qdot["z"]),
    )
    p, ts = {"m": 1.0, "k": 2.0, "F": 0.6}, np.linspace(0, 12, 121)

    def exact(k, F, m=1.0, c=8.0):
        x, v, z, now, stuck, sigma, found = 2.0, 0.0, 2.0 - F / c, 0.0, True, 0, []
        while now < ts[-1]:
            stiff, rest = (k + c, c * z / (k + c)) if stuck else (k, -F * sigma / k)
            w = np.sqrt(stiff / m)
            at = lambda s, x=x, v=v, w=w, rest=rest: rest + (x - rest) * np.cos(w * s) + v / w * np.sin(w * s)
            rate = lambda s, x=x, v=v, w=w, rest=rest: -w * (x - rest) * np.sin(w * s) + v * np.cos(w * s)
            end = (lambda s, z=z, at=at: F - abs(c * (at(s) - z))) if stuck else (lambda s, sigma=sigma, rate=rate: sigma * rate(s))
            grid = np.linspace(1e-6, 6, 60001)
            below = np.flatnonzero([end(s) < 0 for s in grid])
            last = brentq(end, grid[below[0] - 1] if below[0] else 0.0, grid[below[0]], xtol=1e-15) if below.size else np.inf
            for t in ts[(ts >= now) & (ts < now + last)]:
                found.append((at(t - now), z if stuck else at(t - now) - sigma * F / c))
            if not np.isfinite(last):
                break
            x, v, now = at(last), rate(last), now + last
            z, sigma, stuck = (z, np.sign(c * (x - z)), False) if stuck else (x - sigma * F / c, 0, True)
        return np.transpose(found)

    run = lambda p: jl.simulate(system, {"x": 2.0, "z": 0.0}, {"x": 0.0, "z": 0.0}, ts, p, rtol=1e-10, atol=1e-12)
    motion, (x, z) = run(p), exact(2.0, 0.6)
    np.testing.assert_allclose(motion.q["x"], x, rtol=0, atol=1e-8)  # the start is put on the yield limit: z = 1.925
    np.testing.assert_allclose(motion.q["z"], z, rtol=0, atol=1e-8)
    slope, h = jax.jacrev(lambda p: run(p).q["x"][-1])(p), 1e-5
    for name, moved in (("k", lambda s: exact(2.0 + s, 0.6)), ("F", lambda s: exact(2.0, 0.6 + s))):
        np.testing.assert_allclose(slope[name], (moved(h)[0, -1] - moved(-h)[0, -1]) / (2 * h), rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_masing_rule():
    """Unloading from the largest force is the curve of first loading, twice as large: f(x) = f₀ − 2 g((x₀ − x)/2)."""
    p = IWAN_P
    first = lambda x: np.sum(np.clip(p["c"] * x, -p["F"], p["F"]))
    slow = jl.System(IWAN.lagrangian[0][1], dissipation=dict(IWAN.dissipation), holonomic={"drive": lambda t, q: q["x"] - jnp.sin(t)})
    ts = np.linspace(0, 4.5, 46)
    motion = jl.simulate(slow, {"x": 0.0, "z": np.zeros(N)}, {"x": 1.0, "z": np.zeros(N)}, ts, p)
    for t, force in zip(ts, motion.multipliers["drive"], strict=True):
        want = first(np.sin(t)) if t <= np.pi / 2 else first(1.0) - 2 * first((1 - np.sin(t)) / 2)
        assert abs(force - want) < 1e-10


@pytest.mark.slow
def test_friction_beside_a_dashpot():
    """D = F|ż| + ½ b ż² (Bingham): ż = (|f| − F)₊ sign f / b, f = c (u(t) − z), by a Gauss-Legendre quadrature between the transitions."""
    bingham = jl.System(
        lambda q, c: stretched(q, c),
        dissipation=lambda qdot, F, b: F * jnp.abs(qdot["z"]) + 0.5 * b * qdot["z"] ** 2,
        holonomic={"drive": lambda t, q: q["x"] - 1.5 * t},
    )
    p = {"c": 3.0, "F": 1.0, "b": 0.4}
    motion = jl.simulate(bingham, {"x": 0.0, "z": 0.0}, {"x": 1.5, "z": 0.0}, TS, p, **SHARP)
    begins = 1 / (3 * 1.5)  # then  b ż = c (1.5 t − z) − F
    late = np.maximum(TS - begins, 0)
    lag = 1.5 * 0.4 / 3
    exact = 1.5 * late - lag * (1 - np.exp(-late * 3 / 0.4))
    np.testing.assert_allclose(motion.q["z"], exact, rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.qdot["z"][begins < TS], 1.5 * (1 - np.exp(-late[begins < TS] * 3 / 0.4)), rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["implicit", "single"])
def test_other_solvers_and_precisions(solver):
    if solver == "implicit":  # stiff: the dashpot gives way at once
        motion = jl.simulate(MAXWELL, Q0, V0, TS, P | {"b": 1e-5}, solver=diffrax.Kvaerno5(), rtol=1e-8)
        x, _, _ = by_hand(P | {"b": 1e-5})
        np.testing.assert_allclose(motion.q["x"], x, rtol=0, atol=1e-6)
    else:
        single = lambda tree: jax.tree.map(np.float32, tree)
        motion = jl.simulate(MAXWELL, single(Q0), single(V0), TS.astype(np.float32), single(P))
        np.testing.assert_allclose(motion.q["x"], by_hand(P)[0], rtol=0, atol=2e-4)


@pytest.mark.slow
def test_a_slider_under_steps_and_ramps_of_its_load():
    """|f(t) − c z| ≤ F: z goes at once as far as it has to, under a load that jumps; and along with one that bends."""
    slider = jl.System(lambda q, c: -0.5 * c * q**2, dissipation=lambda qdot, F: F * jnp.abs(qdot), force=lambda t, f: f(t))
    nodes, load = np.arange(6.0), np.array([0.5, 3.0, -2.0, 1.0, 1.5, -0.2])
    ts = np.linspace(0, 5, 41)

    def run(interpolation):
        return jl.simulate(slider, 0.0, 0.0, ts, {"c": 2.0, "F": 1.0, "f": jl.Signal(nodes, load, interpolation)}).q

    def exact(load):
        z, found = 0.0, []
        for f in load:
            z = (f - np.clip(f - 2 * z, -1, 1)) / 2
            found.append(z)
        return np.array(found)

    np.testing.assert_allclose(run(jl.interpolation.ZeroOrderHold())[4::8], exact(load)[:5], rtol=0, atol=1e-12)
    np.testing.assert_allclose(run(jl.interpolation.Linear()), exact(np.interp(ts, nodes, load)), rtol=0, atol=1e-12)


# Beside contact, events and states


def phases(rate, y, ends, event, change):
    """States at the times by SciPy, with `change` of y at each zero of `event` that it falls through."""
    event.terminal, event.direction = True, -1
    found, t, impacts = {}, ends[0], 0
    while t < ends[-1]:
        part = solve_ivp(rate, (t, ends[-1]), y, "DOP853", events=event, rtol=1e-12, atol=1e-13, dense_output=True)
        found |= {s: part.sol(s) for s in ends[(ends >= t) & (ends <= part.t[-1])]}
        t, y = part.t[-1], part.y[:, -1].copy()
        if part.status == 1:
            y, impacts = change(y), impacts + 1
    return np.array([found[s] for s in ends]).T, impacts


@pytest.mark.slow
def test_a_mass_on_a_damped_leg_bounces():
    leg = jl.System(
        lambda q, qdot, m, c: 0.5 * m * qdot["x"] ** 2 - 9.81 * m * q["x"] - 0.5 * c * (q["x"] - 1 - q["z"]) ** 2,
        dissipation=lambda qdot, b: 0.5 * b * qdot["z"] ** 2,
        unilateral={"floor": jl.Contact(lambda q: q["x"] - 0.8, restitution=0.8)},
    )
    ts = np.linspace(0, 1.5, 31)
    motion = jl.simulate(leg, {"x": 1.0, "z": 0.0}, {"x": 0.0, "z": 0.0}, ts, {"m": 1.0, "c": 30.0, "b": 2.0}, works=True, **SHARP)

    def rate(t, y):
        stretch = y[0] - 1 - y[2]
        return [y[1], -9.81 - 30 * stretch, 15 * stretch]

    exact, impacts = phases(rate, [1.0, 0, 0], ts, lambda t, y: y[0] - 0.8, lambda y: np.array([0.8, -0.8 * y[1], y[2]]))
    assert motion.contacts["floor"].impacts[-1] == impacts > 3
    np.testing.assert_allclose(motion.q["x"], exact[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.q["z"], exact[2], rtol=0, atol=1e-9)
    assert np.max(np.abs(motion.balance())) < 1e-9


@pytest.mark.slow
def test_events_and_states_see_the_velocity_that_dissipation_decides():
    system = jl.System(
        dict(MAXWELL.lagrangian),
        dissipation=dict(MAXWELL.dissipation),
        force={"brake": lambda w: {"x": -w}},
        states={"w": jl.State(lambda qdot, w: qdot["z"] - w)},
        events={"turn": jl.Event(lambda qdot: qdot["z"], most=4)},
    )
    motion = jl.simulate(system, Q0, V0, TS, P, **SHARP)
    stretch = lambda t, y: y[0] - y[2]
    rate = lambda t, y: [y[1], (-3 * (y[0] - y[2]) - y[3]) / 2, 3 / 0.7 * (y[0] - y[2]), 3 / 0.7 * (y[0] - y[2]) - y[3]]
    exact = solve_ivp(rate, (0, 5), [1, 0.3, 0.2, 0], "DOP853", t_eval=TS, events=stretch, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(motion.q["x"], exact.y[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.states["w"], exact.y[3], rtol=0, atol=1e-9)
    found = motion.events["turn"].ts
    np.testing.assert_allclose(found[np.isfinite(found)], exact.t_events[0], rtol=0, atol=1e-9)
