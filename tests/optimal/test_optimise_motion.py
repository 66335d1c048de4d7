"""Best motions against closed forms, one machine in two forms, other software's numbers, and differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, optimize

import jaxlag as jl

block = jl.System(lambda qdot, m: 0.5 * m * qdot**2, force=lambda u: u)
REST = (0.0, 0.0)


def effort(u):
    return u**2


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e5])
@pytest.mark.parametrize("second", [1.0, 1e-3])
def test_a_block_with_the_least_effort(unit, second):
    """1 kg over 1 m in 1 s: u = 6 − 12 t, and ∫u² dt = 12; in any units, and late."""
    best = jl.optimise_motion(
        block, REST, (unit, 0.0), {"m": 1.0}, duration=second, control={"u": None}, cost=effort, nodes=4, t=7e3 * second, starts=1
    )
    np.testing.assert_allclose(best.cost, 12.0 * unit**2 / second**3, rtol=1e-9)
    share = (np.asarray(best.ts) - 7e3 * second) / second
    np.testing.assert_allclose(best.u["u"], (6.0 - 12.0 * share) * unit / second**2, rtol=1e-6, atol=1e-6 * unit / second**2)
    assert best.check() < 1e-9 and best.deviation < 1e-9
    assert "cost 12" in str(best) or unit != 1 or second != 1


@pytest.mark.slow
def test_derivatives_of_the_least_effort():
    """J = 12 m² s²/T³, by mass, way and time, forwards and backwards, also where the block is to stay where it is."""

    def J(m, way, T):
        return jl.optimise_motion(block, REST, (way, 0.0), {"m": m}, duration=T, control={"u": None}, cost=effort, nodes=4, starts=1).cost

    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(derivative(J, argnums=(0, 1, 2))(2.0, 0.5, 1.5), np.array([12.0, 48.0, -24.0]) / 1.5**3, rtol=1e-8)
        np.testing.assert_allclose(derivative(J, argnums=(0, 1, 2))(2.0, 0.0, 1.5), 0.0, atol=1e-9)


@pytest.mark.parametrize(("m", "s"), [(1.0, 1.0), (1e-9, 1e9), (1e9, 1e-9)])
def test_derivatives_by_numbers_that_are_zero_in_any_units(m, s):
    """Of ∫(m ẍ + b ẋ + c x)² dt, with b = c = 0: 12 m² d²/T³ by m, −2 m ∫ẋ² dt = −12 m d²/(5 T) by c, and nothing by b."""
    system = jl.System(
        lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2, force=lambda u: u, dissipation=lambda qdot, b: 0.5 * b * qdot**2
    )
    d, T = 0.7, 1.3

    def J(mass, c, b):
        params = {"m": mass, "c": c / s**2, "b": b / s}
        bounds = (-30.0 * m / s**2, 30.0 * m / s**2)
        best = jl.optimise_motion(
            system, REST, (d * m, 0.0), params, duration=T * s, control={"u": bounds}, cost=effort, nodes=4, starts=1, refinements=0
        )
        return best.cost / (m**2 / s**3)

    for derivative in (jax.grad, jax.jacfwd):
        found = derivative(J, argnums=(0, 1, 2))(1.2, 0.0, 0.0)
        np.testing.assert_allclose(found, [24 * 1.2 * d**2 / T**3, -12 * 1.2 * d**2 / (5 * T), 0.0], rtol=1e-7, atol=1e-9)


def test_the_least_time_with_a_limited_force():
    """2 s, full force one way and the other; dT/dm = T/(2 m), dT/dF = −T/(2 F)."""

    def T(m, F):
        return jl.optimise_motion(
            block, REST, (1.0, 0.0), {"m": m}, duration=(0.1, 10.0), control={"u": (-F, F)}, nodes=10, starts=1
        ).duration

    best = jl.optimise_motion(block, REST, (1.0, 0.0), {"m": 1.0}, duration=(0.1, 10.0), control={"u": (-1.0, 1.0)}, nodes=10, starts=1)
    np.testing.assert_allclose(best.duration, 2.0, rtol=1e-7)
    inner = np.abs(np.asarray(best.ts) - 1.0) > 1e-6
    np.testing.assert_allclose(np.asarray(best.u["u"])[inner], np.where(np.asarray(best.ts) < 1.0, 1.0, -1.0)[inner], atol=1e-4)
    np.testing.assert_allclose(jax.grad(T, argnums=(0, 1))(1.0, 1.0), [1.0, -1.0], rtol=1e-6)


def test_limits_of_the_motion():
    """With |v| ≤ 1.2 the block of least effort runs at that speed between two parabolas; the end is cut off by no more than the limit."""
    within = {"speed": (lambda qdot: qdot, -1.2, 1.2)}
    best = jl.optimise_motion(
        block, REST, (1.0, 0.0), {"m": 1.0}, duration=1.0, control={"u": None}, cost=effort, within=within, nodes=40, starts=1
    )
    # u falls linearly to zero within a, runs on, and again: v = 1.2 (1 − (1 − t/a)²), 1 = 1.2 (1 − 2a/3), J = 2 ∫(2.4/a)² (1 − t/a)² dt
    a = 1.5 * (1 - 1 / 1.2)
    np.testing.assert_allclose(best.cost, 2 * (2.4 / a) ** 2 * a / 3, rtol=1e-5)
    assert np.max(best.limited["speed"]) <= 1.2 * (1 + 1e-8)


def test_waypoints_a_free_end_and_an_end_like_the_start():
    """By way of 1 at half time to wherever it likes, then nothing pushes; and an oscillator chosen so that it needs no force."""
    best = jl.optimise_motion(
        block,
        REST,
        (None, None),
        {"m": 1.0},
        duration=2.0,
        control={"u": None},
        cost=effort,
        waypoints={0.5: (1.0, None)},
        nodes=8,
        starts=1,
    )
    np.testing.assert_allclose(best.cost, 3.0, rtol=1e-9)  # ∫u² with u = 3 (1 − t)
    np.testing.assert_allclose(np.asarray(best.u["u"])[np.asarray(best.ts) > 1], 0.0, atol=1e-7)
    spring = jl.System(lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2, force=lambda u: u)
    best = jl.optimise_motion(
        spring,
        (0.0, None),
        None,
        {"m": 1.0, "c": 3.0},
        duration=1.0,
        control={"u": (-20, 20)},
        cost=effort,
        periodic=True,
        waypoints={0.25: (1.0, None)},
        over={"c": (1.0, 100.0)},
        nodes=12,
    )
    np.testing.assert_allclose(best.params["c"], 4 * np.pi**2, rtol=1e-5)  # resonance
    np.testing.assert_allclose(best.cost, 0.0, atol=1e-9)
    np.testing.assert_allclose([best.q[-1], best.qdot[-1]], [best.q[0], best.qdot[0]], atol=1e-9)


@pytest.mark.slow
def test_the_brachistochrone():
    """A bead whose path a force turns that does no work: the cycloid of Johann Bernoulli, whose direction turns evenly."""
    bead = jl.System(lambda q, qdot, g: 0.5 * qdot @ qdot - g * q[1], force=lambda qdot, u: u * jnp.array([-qdot[1], qdot[0]]))
    start, end = (jnp.zeros(2), jnp.zeros(2)), (jnp.array([1.0, -1.0]), None)
    best = jl.optimise_motion(bead, start, end, {"g": 9.81}, duration=(0.2, 2.0), control={"u": (-10, 10)}, nodes=40, starts=1)
    angle = optimize.brentq(lambda a: (a - np.sin(a)) / (1 - np.cos(a)) - 1, 0.1, 6)
    radius = 1 / (1 - np.cos(angle))
    np.testing.assert_allclose(best.duration, angle * np.sqrt(radius / 9.81), rtol=1e-6)
    turned = np.sqrt(9.81 / radius) * np.asarray(best.ts)
    cycloid = radius * np.stack([turned - np.sin(turned), np.cos(turned) - 1], axis=1)
    np.testing.assert_allclose(best.q, cycloid, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("end", "steps"), [pytest.param(0.5 * np.pi, 12, marks=pytest.mark.slow), (np.pi, 20)])
def test_a_pendulum_in_two_forms(end, steps):
    """From hanging to the side, and up to where it stands, in φ and in x, y with a rod: J and λ agree to 1e-8, and J with SciPy's. That the
    end is x = l sin π, rounding of zero, says nothing about how far x goes on the way.
    """
    params, m, l, g = {"m": 0.7, "l": 0.4, "g": 9.81}, 0.7, 0.4, 9.81
    by_angle = jl.System(lambda q, qdot, m, l, g: 0.5 * m * l**2 * qdot**2 + m * g * l * jnp.cos(q), force=lambda u: u)
    in_x_y = jl.System(
        lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1],
        force=lambda q, u, l: u * jnp.array([-q[1], q[0]]) / l**2,
        holonomic={"rod": lambda q, l: jnp.hypot(q[0], q[1]) - l},
    )
    at = lambda phi: (jnp.array([l * np.sin(phi), -l * np.cos(phi)]), jnp.zeros(2))
    turn = {"duration": 1.0, "control": {"u": None}, "cost": effort, "starts": 1, "refinements": 0, "nodes": 80}
    one = jl.optimise_motion(by_angle, (0.0, 0.0), (end, 0.0), params, **turn)
    other = jl.optimise_motion(in_x_y, at(0.0), at(end), params, **turn)
    np.testing.assert_allclose(other.cost, one.cost, rtol=1e-8)
    pull = m * (l * np.asarray(one.qdot) ** 2 + g * np.cos(one.q))  # of the rod, by Newton's law along it
    np.testing.assert_allclose(-other.multipliers["rod"], pull, atol=1e-8 * np.max(np.abs(pull)))
    assert other.check() < 1e-9 and int(other.steps) <= steps  # to the side 44 without corrections of steps along which the rod bends

    def costates(t, y):  # of H = u² + p ω + r (u − m g l sin φ)/(m l²), whose u is −r/(2 m l²)
        phi, omega, p, r = y
        u = -r / (2 * m * l**2)
        return np.vstack([omega, (u - m * g * l * np.sin(phi)) / (m * l**2), r * g / l * np.cos(phi), -p])

    ends = lambda a, b: np.array([a[0], a[1], b[0] - end, b[1]])
    t, phi = np.linspace(0, 1, 81), np.interp(np.linspace(0, 1, 81), one.ts, one.q)
    start = np.vstack([phi, np.gradient(phi, t), 0 * t, -2 * m * l**2 * np.interp(t, one.ts, one.u["u"])])
    found = integrate.solve_bvp(costates, ends, t, start, tol=1e-10, max_nodes=50000)
    s = np.linspace(0, 1, 4001)
    np.testing.assert_allclose(one.cost, integrate.simpson((found.sol(s)[3] / (2 * m * l**2)) ** 2, x=s), rtol=1e-8)


@pytest.mark.slow
def test_a_pendulum_in_any_units():
    """From hanging to standing, x from rounding to rounding, by an input without bounds: cost and derivative, with lengths and the clock
    by 1e9 and 1e-9.
    """
    in_x_y = jl.System(
        lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1],
        force=lambda q, u, l: u * jnp.array([-q[1], q[0]]) / l**2,
        holonomic={"rod": lambda q, l: jnp.hypot(q[0], q[1]) - l},
    )
    found = []
    for m, s in ((1.0, 1.0), (1e-9, 1e9), (1e9, 1e-9)):

        def cost(mass, m=m, s=s):
            at = lambda phi: (0.4 * m * jnp.array([np.sin(phi), -np.cos(phi)]), jnp.zeros(2))
            params = {"m": mass, "l": 0.4 * m, "g": 9.81 * m / s**2}
            given = {"duration": s, "control": {"u": None}, "cost": effort, "starts": 1, "refinements": 0}
            return jl.optimise_motion(in_x_y, at(0.0), at(np.pi), params, **given).cost / (m**4 / s**3)

        found.append(jax.value_and_grad(cost)(0.7))
    np.testing.assert_allclose(found[0][1], 2 * found[0][0] / 0.7, rtol=1e-6)  # J ~ m²
    np.testing.assert_allclose(found[1:], [found[0]] * 2, rtol=1e-8)


@pytest.mark.parametrize("l", [1.0, 1e-6])
def test_what_leaps_is_no_motion(l):
    """A bead on one of two rails: no motion leads to the other, though points of collocation satisfy all equations with none in between."""
    bead = jl.System(lambda qdot: 0.5 * qdot @ qdot, force=lambda u: jnp.array([u, 0.0]), holonomic={"rails": lambda q: q[1] ** 2 - l**2})
    start, end = (jnp.array([0.0, -l]), jnp.zeros(2)), (jnp.array([l, l]), jnp.zeros(2))
    across = {"duration": 1.0, "control": {"u": None}, "cost": effort, "nodes": 6}
    with pytest.raises(ValueError, match=r"coordinates leap from point to point.*`start` and `end`.*Give more `nodes`, or a `guess`"):
        jl.optimise_motion(bead, start, end, **across)
    best = jl.optimise_motion(bead, start, end, **across, throw=False)
    assert not best.converged and "leap" in str(best)
    along = jl.optimise_motion(bead, start, (jnp.array([l, -l]), jnp.zeros(2)), **across)
    np.testing.assert_allclose(along.cost, 12 * l**2, rtol=1e-8)


# Kelly, SIAM Review 59 (2017) 849-904, section 6: masses of cart and pole, length; 1 m in 2 s, a force of at most 20 N, a track of 2 m
KELLY = {"m1": 1.0, "m2": 0.3, "l": 0.5, "g": 9.81}


def cart_energy(q, qdot, m1, m2, l, g):
    turning = m2 * l * jnp.cos(q["phi"]) * qdot["x"] * qdot["phi"] + 0.5 * m2 * l**2 * qdot["phi"] ** 2
    return 0.5 * (m1 + m2) * qdot["x"] ** 2 + turning + m2 * g * l * jnp.cos(q["phi"])


cart = jl.System(cart_energy, force={"motor": lambda u: {"x": u}})
in_x_y = jl.System(
    lambda q, qdot, m1, m2, g: 0.5 * m1 * qdot["x"] ** 2 + 0.5 * m2 * qdot["p"] @ qdot["p"] - m2 * g * q["p"][1],
    force={"motor": lambda u: {"x": u}},
    holonomic={"rod": lambda q, l: (q["p"][0] - q["x"]) ** 2 + q["p"][1] ** 2 - l**2},
)
HANGS, STANDS = {"x": 0.0, "phi": 0.0}, {"x": 1.0, "phi": np.pi}
IN_X_Y = (
    ({"x": 0.0, "p": jnp.array([0.0, -0.5])}, {"x": 0.0, "p": jnp.zeros(2)}),
    ({"x": 1.0, "p": jnp.array([1.0, 0.5])}, {"x": 0.0, "p": jnp.zeros(2)}),
)
SWING = {"duration": 2.0, "control": {"u": (-20, 20)}, "cost": effort}


@pytest.mark.slow
def test_a_cart_pole_swings_up():
    """Kelly's problem, from his straight guess, and from others, of which one is better; in φ and in x, y with a rod."""
    stand = {"x": 0.0, "phi": 0.0}
    straight = jl.optimise_motion(cart, (HANGS, stand), (STANDS, stand), KELLY, **SWING, starts=1, nodes=40, refinements=0)
    np.testing.assert_allclose(straight.cost, 58.8077, rtol=1e-5)  # as CasADi and IPOPT have it, see `tests/benchmarks/bench_optimal.py`
    best = jl.optimise_motion(cart, (HANGS, stand), (STANDS, stand), KELLY, **SWING)
    assert best.cost <= straight.cost * (1 + 1e-6) and max(best.check(), straight.check()) < 1e-6
    with_rod = jl.optimise_motion(in_x_y, *IN_X_Y, KELLY, **SWING, starts=1, nodes=40, refinements=0)
    np.testing.assert_allclose(with_rod.cost, straight.cost, rtol=1e-8)
    assert with_rod.check() < 2e-6
    # the rod pulls with m₂ (l φ̇² − ẍ sin φ + g cos φ), and λ is that over 2 l; both costs are flat in u, which is thus known less well
    one, other = straight.simulate(rtol=1e-10), with_rod.simulate(rtol=1e-10)
    phi, phidot, a = one.q["phi"], one.qdot["phi"], one.qddot["x"]
    pull = 0.3 * (0.5 * phidot**2 - a * jnp.sin(phi) + 9.81 * jnp.cos(phi))
    for found in (other, with_rod):
        np.testing.assert_allclose(-2 * 0.5 * found.multipliers["rod"], pull, atol=3e-4 * float(np.max(pull)))


@pytest.mark.slow
@pytest.mark.parametrize(("kg", "m", "s"), [(1e-3, 1e3, 1.0), (1.0, 1e6, 1e3), (1e9, 1e-3, 1.0)])
def test_a_cart_pole_in_other_units(kg, m, s):
    """The same numbers of steps and the same motion in t and mm, in µm and ms, and in what nobody uses."""
    params = {"m1": 1.0 * kg, "m2": 0.3 * kg, "l": 0.5 * m, "g": 9.81 * m / s**2}
    N = kg * m / s**2
    ends = [jax.tree.map(lambda x, i=i: x * m / (s if i else 1), part) for pair in IN_X_Y for i, part in enumerate(pair)]
    swing = {"duration": 2.0 * s, "control": {"u": (-20 * N, 20 * N)}, "cost": effort, "refinements": 0}
    best = jl.optimise_motion(in_x_y, tuple(ends[:2]), tuple(ends[2:]), params, **swing)
    same = jl.optimise_motion(in_x_y, *IN_X_Y, KELLY, **SWING, refinements=0)
    np.testing.assert_allclose(best.cost, same.cost * N**2 * s, rtol=1e-6)
    assert abs(int(best.steps) - int(same.steps)) <= 3


@pytest.mark.slow
def test_a_crane_in_the_least_time():
    """10 m with 20 kN: full force, and a sway of which no one knows how large it will be. Numbers of a shooting by SciPy."""
    best = jl.optimise_motion(
        crane, (STILL, STILL), ({"x": 10.0, "phi": 0.0}, STILL), CRANE, duration=(2.0, 60.0), control={"u": (-20, 20)}
    )
    switches = switched(best)
    np.testing.assert_allclose(best.duration, switches[-1], rtol=1e-4)


@pytest.mark.slow
def test_a_limited_pull_in_the_rod():
    """λ ≥ −11 N/m in place of −13.8 costs more, and is kept."""
    within = {"pull": (lambda multipliers: multipliers["rod"], -11, None)}
    best = jl.optimise_motion(in_x_y, *IN_X_Y, KELLY, **SWING, within=within, nodes=40)
    assert np.min(best.multipliers["rod"]) > -11 * (1 + 1e-6) and 58 < best.cost < 80
    assert best.check() < 1e-5
    motion = best.simulate(rtol=1e-10)
    np.testing.assert_allclose(motion.q["p"], best.q["p"], atol=1e-5)


@pytest.mark.slow
def test_derivatives_of_a_swing_up():
    """By m₂ and l, against differences, on one mesh."""

    def J(m2, l):
        stand = {"x": 0.0, "phi": 0.0}
        params = KELLY | {"m2": m2, "l": l}
        return jl.optimise_motion(cart, (HANGS, stand), (STANDS, stand), params, **SWING, starts=1, refinements=0).cost

    h = 1e-4
    differences = [(J(0.3 + h, 0.5) - J(0.3 - h, 0.5)) / (2 * h), (J(0.3, 0.5 + h) - J(0.3, 0.5 - h)) / (2 * h)]
    np.testing.assert_allclose(jax.grad(J, argnums=(0, 1))(0.3, 0.5), differences, rtol=1e-6)
    np.testing.assert_allclose(jax.jacfwd(J, argnums=(0, 1))(0.3, 0.5), differences, rtol=1e-6)


@pytest.mark.slow
def test_an_acrobot():
    """Two equal rods, moved by a moment at the elbow alone, hang and stand after 2 s (OptimTraj's parameters)."""
    l, m, g = 0.5, 1.0, 9.81

    def lagrangian(q, qdot):
        kinetic = m * l**2 * (qdot["a"] ** 2 + 0.5 * qdot["b"] ** 2 + jnp.cos(q["a"] - q["b"]) * qdot["a"] * qdot["b"])
        return kinetic + m * g * l * (2 * jnp.cos(q["a"]) + jnp.cos(q["b"]))

    acrobot = jl.System(lagrangian, force={"elbow": lambda u: {"a": -u, "b": u}})
    rest = {"a": 0.0, "b": 0.0}
    given = {"duration": 2.0, "control": {"u": (-20, 20)}, "cost": effort}
    problem = acrobot, (rest, rest), ({"a": np.pi, "b": np.pi}, rest), {}
    assert jl.optimise_motion(*problem, **given).check() < 1e-6
    best = jl.optimise_motion(*problem, **given, nodes=80)
    assert best.check() < 1e-6
    np.testing.assert_allclose(best.cost, 77.8514, rtol=1e-6)  # as IPOPT has it: `tests/benchmarks/bench_optimal.py`


@pytest.mark.slow
def test_a_slider_crank_and_its_closed_form():
    """A closed loop of two bars costs what the same machine costs in its one coordinate; a constraint twice changes nothing."""
    r, b, m, I = 0.1, 0.3, 0.8, 2e-3

    def place(phi):
        return r * jnp.cos(phi) + jnp.sqrt(b**2 - (r * jnp.sin(phi)) ** 2)

    alone = jl.System(lambda q, qdot: 0.5 * I * qdot**2 + 0.5 * m * (jax.grad(place)(q) * qdot) ** 2, force=lambda u: u)
    loop = {
        "along": lambda q: r * jnp.cos(q["phi"]) + b * jnp.cos(q["psi"]) - q["s"],
        "across": lambda q: r * jnp.sin(q["phi"]) - b * jnp.sin(q["psi"]),
    }
    bars = lambda twice: jl.System(
        lambda qdot: 0.5 * I * qdot["phi"] ** 2 + 0.5 * m * qdot["s"] ** 2 + 0.0 * qdot["psi"],
        force={"motor": lambda u: {"phi": u}},
        holonomic=loop | ({"again": loop["across"]} if twice else {}),
    )
    given = {"duration": 0.4, "control": {"u": None}, "cost": effort, "nodes": 16, "starts": 1}
    one = jl.optimise_motion(alone, (0.4, 0.0), (2.5, 0.0), {}, **given)

    def at(phi):
        psi = float(np.arcsin(r * np.sin(phi) / b))
        return {"phi": phi, "psi": psi, "s": float(place(phi))}, {"phi": 0.0, "psi": 0.0, "s": 0.0}

    for twice in (False, True):
        many = jl.optimise_motion(bars(twice), at(0.4), at(2.5), {}, **given)
        np.testing.assert_allclose(many.cost, one.cost, rtol=1e-8)
        assert many.check() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("m, s", [(1.0, 1.0), (1e-9, 1e9)])
def test_a_four_bar_linkage_and_its_closed_form(m, s):
    """Crank, coupler and rocker with two closures cost what the linkage costs in the crank's angle alone (Freudenstein), in any units.

    Inertias are of 2e-4 to 2e-3, and a spring of much more than they need: forces of constraints are not of the crank's size.
    """
    a, b, c, d = (length * m for length in (0.08, 0.25, 0.2, 0.24))
    I, stiffness = np.array([2e-4, 1e-3, 2e-3]) * m**2, 3.0 * m**2 / s**2

    def others(phi):
        """Of coupler and rocker, the open linkage."""
        x, y = d - a * jnp.cos(phi), -a * jnp.sin(phi)
        r = jnp.hypot(x, y)
        psi = jnp.arctan2(y, x) + jnp.arccos((b**2 + r**2 - c**2) / (2 * b * r))
        return psi, jnp.arctan2(b * jnp.sin(psi) - y, b * jnp.cos(psi) - x)

    def lagrangian(angles, rates):
        return 0.5 * sum(I[i] * rates[i] ** 2 for i in range(3)) - 0.5 * stiffness * (angles[2] - 1.5) ** 2

    def of_crank(q, qdot):
        (psi, theta), rates = jax.jvp(others, (q,), (qdot,))
        return lagrangian((q, psi, theta), (qdot, *rates))

    alone = jl.System(of_crank, force=lambda u: u)
    linkage = jl.System(
        lambda q, qdot: lagrangian(*((x["phi"], x["psi"], x["theta"]) for x in (q, qdot))),
        force={"motor": lambda u: {"phi": u}},
        holonomic={
            "along": lambda q: a * jnp.cos(q["phi"]) + b * jnp.cos(q["psi"]) - c * jnp.cos(q["theta"]) - d,
            "across": lambda q: a * jnp.sin(q["phi"]) + b * jnp.sin(q["psi"]) - c * jnp.sin(q["theta"]),
        },
    )
    given = {"duration": 0.3 * s, "control": {"u": None}, "cost": effort, "nodes": 16, "starts": 1, "tolerance": 1e-7}
    one = jl.optimise_motion(alone, (0.3, 0.0), (3.0, 0.0), {}, **given)

    def at(phi):
        psi, theta = others(phi)
        return {"phi": phi, "psi": float(psi), "theta": float(theta)}, {"phi": 0.0, "psi": 0.0, "theta": 0.0}

    full = jl.optimise_motion(linkage, at(0.3), at(3.0), {}, **given)
    assert one.check() < 1e-6 and full.check() < 1e-6
    np.testing.assert_allclose(full.cost, one.cost, rtol=1e-6)
    np.testing.assert_allclose(full.q["phi"], one.simulate(full.ts, rtol=1e-10).q, atol=1e-5)


@pytest.mark.slow
def test_a_rolling_disc():
    """A nonholonomic disc is steered to a place beside the start: it rolls all the way, and turns back to where it looked."""
    R = 0.2
    disc = jl.System(
        lambda qdot: 0.5 * (qdot["x"] ** 2 + qdot["y"] ** 2) + 0.5 * 0.02 * qdot["roll"] ** 2 + 0.5 * 0.01 * qdot["turn"] ** 2,
        force={"motors": lambda u: {"roll": u[0], "turn": u[1]}},
        nonholonomic={
            "x": lambda q, qdot: qdot["x"] - R * jnp.cos(q["turn"]) * qdot["roll"],
            "y": lambda q, qdot: qdot["y"] - R * jnp.sin(q["turn"]) * qdot["roll"],
        },
    )
    start = {"x": 0.0, "y": 0.0, "roll": 0.0, "turn": 0.0}
    end = {"x": 1.0, "y": 1.0, "roll": None, "turn": 0.0}
    both = (-np.full(2, 5.0), np.full(2, 5.0))
    best = jl.optimise_motion(disc, (start, start), (end, start), {}, duration=2.0, control={"u": both}, cost=lambda u: u @ u)
    assert best.check() < 1e-6
    slip = best.qdot["y"] - R * jnp.sin(best.q["turn"]) * best.qdot["roll"]
    np.testing.assert_allclose(slip, 0.0, atol=1e-9)
    np.testing.assert_allclose([best.q["x"][-1], best.q["y"][-1]], 1.0, atol=1e-9)


def crane_energy(q, qdot, M, m, l, g):
    load = qdot["x"] ** 2 + 2 * l * jnp.cos(q["phi"]) * qdot["x"] * qdot["phi"] + l**2 * qdot["phi"] ** 2
    return 0.5 * M * qdot["x"] ** 2 + 0.5 * m * load + m * g * l * jnp.cos(q["phi"])


crane = jl.System(crane_energy, force={"drive": lambda u: {"x": u}})
CRANE, STILL = {"M": 2.0, "m": 8.0, "l": 6.0, "g": 9.81}, {"x": 0.0, "phi": 0.0}


def switched(best):
    """Times of three switches and of the end, from those of a motion, so that SciPy's integration arrives at rest."""
    M, m, l, g = CRANE.values()

    def law(t, s, u):
        _, phi, v, w = s
        mass = np.array([[M + m, m * l * np.cos(phi)], [m * l * np.cos(phi), m * l**2]])
        a = np.linalg.solve(mass, [u + m * l * w**2 * np.sin(phi), -m * g * l * np.sin(phi)])
        return [v, w, *a]

    def missed(spans):
        state = np.zeros(4)
        for span, u in zip(spans, (20.0, -20.0, 20.0, -20.0), strict=True):
            state = integrate.solve_ivp(law, (0.0, span), state, args=(u,), rtol=1e-10, atol=1e-12).y[:, -1]
        return state - [10.0, 0.0, 0.0, 0.0]

    u, ts = np.asarray(best.u["u"]), np.asarray(best.ts)
    sign = np.sign(u)
    changes = [0.5 * (ts[i] + ts[i + 1]) for i in np.flatnonzero(np.diff(sign))]
    guess = np.diff([0.0, changes[0], 0.5 * sum(changes[:: len(changes) - 1]), changes[-1], float(best.duration)])
    return np.cumsum(optimize.fsolve(missed, guess, xtol=1e-12))


def test_a_system_that_calls_its_input_and_a_guess():
    """`u(t)` in the system, a motion as the guess, and the result as the input of a simulation."""
    called = jl.System(lambda qdot, m: 0.5 * m * qdot**2, force=lambda t, u: u(t))
    given = {"duration": 1.0, "control": {"u": None}, "cost": effort, "nodes": 4}
    guess = jl.simulate(called, 0.0, 0.5, np.linspace(0.0, 3.0, 7), {"m": 1.0, "u": jl.Multisine(1.0, amplitude=0.0)})
    for way in (guess, jl.optimise_motion(called, REST, (1.0, 0.0), {"m": 1.0}, **given)):
        best = jl.optimise_motion(called, REST, (1.0, 0.0), {"m": 1.0}, guess=way, **given)
        np.testing.assert_allclose(best.cost, 12.0, rtol=1e-9)
    called_cost = jl.optimise_motion(called, REST, (1.0, 0.0), {"m": 1.0}, **(given | {"cost": lambda t, u: u(t) ** 2}))
    np.testing.assert_allclose(called_cost.cost, 12.0, rtol=1e-9)
    motion = jl.simulate(called, *REST, np.linspace(0.0, 1.0, 5), {"m": 1.0, **best.signals})
    t = np.linspace(0.0, 1.0, 5)
    np.testing.assert_allclose(motion.q, 3 * t**2 - 2 * t**3, atol=1e-7)
    np.testing.assert_allclose(best.simulate(t).q, motion.q, atol=1e-9)


@pytest.mark.slow
def test_a_coordinate_without_inertia():
    """A damper and a spring alone: ∫u² is least on sinh(c t/b)/sinh(c T/b), by quadrature."""
    c, b = 3.0, 2.0
    dashpot = jl.System(lambda q, qdot: -0.5 * c * q**2 + 0.0 * qdot, dissipation=lambda qdot: 0.5 * b * qdot**2, force=lambda u: u)
    best = jl.optimise_motion(dashpot, (0.0, None), (1.0, None), {}, duration=1.0, control={"u": None}, cost=effort, nodes=6, starts=1)
    u = lambda t: c * (np.cosh(c / b * t) + np.sinh(c / b * t)) / np.sinh(c / b)
    np.testing.assert_allclose(best.cost, integrate.quad(lambda t: u(t) ** 2, 0.0, 1.0)[0], rtol=1e-9)


def test_in_single_precision():
    with jax.enable_x64(False):
        best = jl.optimise_motion(
            block, REST, (1.0, 0.0), {"m": 1.0}, duration=(0.1, 10.0), control={"u": (-1, 1)}, nodes=4, starts=1, refinements=0
        )
    assert best.cost.dtype == best.u["u"].dtype == np.float32
    np.testing.assert_allclose(best.duration, 2.0, rtol=1e-3)


@pytest.mark.slow
def test_in_a_batch_and_under_jit():
    J = lambda m: (
        jl.optimise_motion(block, REST, (1.0, 0.0), {"m": m}, duration=1.0, control={"u": (-30, 30)}, cost=effort, nodes=4, starts=1).cost
    )
    np.testing.assert_allclose(jax.jit(jax.vmap(J))(jnp.array([1.0, 2.0])), [12.0, 48.0], rtol=1e-8)
    weak = lambda F: jl.optimise_motion(block, REST, (1.0, 0.0), {"m": 1.0}, duration=1.0, control={"u": (-F, F)}, nodes=4, starts=1)
    np.testing.assert_array_equal(jax.vmap(lambda F: weak(F).converged)(jnp.array([1.0, 6.0])), [False, True])


def test_wrong_use():
    of = lambda **given: jl.optimise_motion(block, REST, (1.0, 0.0), {"m": 1.0}, **({"duration": 1.0, "control": {"u": (-20, 20)}} | given))
    with pytest.raises(ValueError, match=r"What stands against it: u \(lower\), u \(upper\). Widen it, or allow more time"):
        of(control={"u": (-1, 1)}, nodes=4)
    with pytest.raises(ValueError, match=r"What stands against it: u \(lower\), u \(upper\)"):
        jax.grad(lambda F: of(control={"u": (-F, F)}, nodes=4).cost)(1.0)
    with pytest.raises(ValueError, match=r"What stands against it: .*speed \(upper\)"):
        of(within={"speed": (lambda qdot: qdot, -0.5, 0.5)}, nodes=4)
    idle = jl.System(lambda qdot, m: 0.5 * m * qdot**2, force=lambda u, w: u + 0.0 * w)
    with pytest.raises(ValueError, match="`control` must move the system, but 'w' changes none"):
        jl.optimise_motion(idle, REST, (1.0, 0.0), {"m": 1.0}, duration=1.0, control={"u": None, "w": None})
    with pytest.raises(ValueError, match="must have a smooth dissipation"):
        rubbed = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda u: u, dissipation=lambda qdot: jnp.abs(qdot))
        jl.optimise_motion(rubbed, REST, (1.0, 0.0), {}, duration=1.0, control={"u": None})
    with pytest.raises(ValueError, match="must have no contacts"):
        touching = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda u: u, unilateral={"floor": lambda q: q})
        jl.optimise_motion(touching, REST, (1.0, 0.0), {}, duration=1.0, control={"u": None})
    with pytest.raises(ValueError, match="must have one structure, but have x and q"):
        jl.optimise_motion(block, ({"x": 0.0}, 0.0), (1.0, 0.0), {"m": 1.0}, duration=1.0, control={"u": None})
    for given, words in [
        ({"duration": (2.0, 1.0)}, "`duration` must be in order"),
        ({"control": {"u": (1, -1)}}, r"`control\['u'\]` must be in order"),
        ({"control": {}}, "`control` must name inputs"),
        ({"control": {"m": None}}, "`control` must have names of its own"),
        ({"within": {"speed": 3.0}}, r"`within\['speed'\]` must be \(function, lower, upper\)"),
        ({"over": "k"}, "`over` must name entries of `params`, but holds 'k'. There are m"),
        ({"waypoints": {1.5: (0.5, None)}}, "`waypoints` must be at shares of the duration"),
        ({"periodic": "phi"}, "`periodic` must name coordinates, but holds 'phi'. There are q"),
        ({"tolerance": 0.0}, "`tolerance` must be positive"),
        ({"cost": lambda u: jnp.stack([u, u])}, r"`cost` must return one number, but returns shape \(2,\)"),
        ({"cost": lambda u: jnp.sqrt(u)}, "`cost` must be finite, but is NaN on the way"),
        ({"waypoints": {0.5: (0.5, None), 0.51: (0.6, None)}}, "`nodes` must be enough for all `waypoints`"),
    ]:
        with pytest.raises(ValueError, match=words):
            of(**given)
    with pytest.raises(TypeError, match="`guess` must be a motion, but is of class float"):
        of(guess=3.0)
    with pytest.raises(TypeError, match=r"`start` must be \(q, qdot\)"):
        jl.optimise_motion(block, 0.0, (1.0, 0.0), {"m": 1.0}, duration=1.0, control={"u": None})
