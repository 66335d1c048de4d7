"""Linear equations on paper: against SymPy's derivatives by hand, closed forms and published spectra; what they refuse, and why."""

import re
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
import sympy
from jax import lax
from sympy import Abs, cos, sin, symbols

import jaxlag as jl
from jaxlag import dissipation, plot
from jaxlag.examples import pendulum, vehicle

matplotlib.use("Agg")
ROUNDING = 1e-12  # relative, of sums of some ten products


def is_zero(formula):
    return sympy.simplify(formula) == 0


def numbers(*matrices, **given):
    """Matrices with random numbers for their symbols, in the order of names; and these numbers."""
    draw = np.random.default_rng(0).uniform
    names = sorted({symbol.name for matrix in matrices for symbol in matrix.free_symbols})
    point = {name: given.get(name, draw(0.5, 2.0)) for name in names}
    value = lambda matrix: np.array(matrix.subs({x: point[x.name] for x in matrix.free_symbols}), float)
    return [value(matrix) for matrix in matrices], point


def frequencies(e, **given):
    """Natural angular frequencies squared of an undamped system, and the numbers that were inserted."""
    (M, K), point = numbers(e.mass, e.stiffness, **given)
    return np.sort(np.linalg.eigvals(np.linalg.solve(M, K)).real), point


# The lecture, word for word.

STILL = {"phi": 0, "y": "l - M*g/(2*c)", "M0": "k*r*v*abs(v)"}
ALL_PARTS = dict.fromkeys(("x", "y", "phi", "x2", "x3", "y2", "y3", "phi2", "phi3"), 0.0)


@pytest.fixture(scope="module")
def swing():
    return jl.equations(pendulum.polar, {"r", "phi"}, {"m", "l", "g"}, linearised_at={"phi": 0})


@pytest.fixture(scope="module")
def car():
    return jl.equations(vehicle.system, vehicle.q0, vehicle.params, linearised_at=STILL)


@pytest.mark.fast
def test_the_pendulum_is_written_as_in_a_lecture(swing):
    assert str(swing) == "φ = 0\n\nδr = 0\n\nm l² δφ̈ + m g l δφ = 0\nω₀² = g/l"
    assert swing.latex() == (
        "\\begin{aligned}\n"
        r"\varphi &= 0 \\" + "\n"
        r"\delta r &= 0 \\" + "\n"
        r"m l^{2} \delta \ddot{\varphi} + m g l \delta \varphi &= 0 \\" + "\n"
        r"\omega_{0}^{2} &= \frac{g}{l}" + "\n"
        "\\end{aligned}"
    )
    assert swing._repr_latex_() == f"$${swing.latex()}$$"
    m, l, g = (swing.params[name] for name in "mlg")
    assert sympy.Matrix([[m * l**2]]) == swing.mass and sympy.Matrix([[m * g * l]]) == swing.stiffness
    phi, r = symbols("phi r", real=True)
    assert swing.at[phi] == 0 and swing.at[r] == l and [x.name for x in swing.q] == ["δphi"]


def test_it_can_be_drawn(swing):
    ax = plot.equations(swing)
    ax.figure.canvas.draw()  # mathtext reads the LaTeX when it draws
    assert r"m l^{2} \delta \ddot{\varphi} + m g l \delta \varphi = 0" in [text.get_text().strip(" $") for text in ax.texts]
    matplotlib.pyplot.close("all")


@pytest.mark.fast
def test_the_vehicle_falls_into_three_oscillators(car):
    assert str(car) == (
        "φ = 0\ny = l − M g/(2 c)\nM₀ = r k v |v|\n\n"
        "Θₛ δφ̈ + 2 a² b δφ̇ + 2 a² c δφ = 0\nω₀² = 2 a² c/Θₛ\nζ = a² b/(Θₛ ω₀)\n\n"
        "(M + 2 m + 2 Θᵣ/r²) δẍ + 2 k |v| δẋ = 0\n\n"
        "M δÿ + 2 b δẏ + 2 c δy = 0\nω₀² = 2 c/M\nζ = b/(M ω₀)"
    )
    assert car.blocks == tuple((x,) for x in car.q) and not any(car.gyroscopic) and not any(car.circulatory)


WAYS = [(vehicle.system, vehicle.q0), (vehicle.substituted, vehicle.q0), (vehicle.first_kind, ALL_PARTS)]


@pytest.mark.parametrize("system, q", WAYS, ids=["reduced", "substituted", "first kind"])
def test_three_ways_to_the_vehicle_have_its_closed_forms(system, q):
    e = jl.equations(system, q, vehicle.params, positive=("a", "b", "c", "M", "Theta_s"), linearised_at=STILL)
    p, (phi, x, y) = e.params, e.q
    assert is_zero(e.omega_squared[phi] - 2 * p["c"] * p["a"] ** 2 / p["Theta_s"]) and is_zero(e.omega_squared[y] - 2 * p["c"] / p["M"])
    assert is_zero(e.damping_ratio[phi] - p["a"] * p["b"] / sympy.sqrt(2 * p["c"] * p["Theta_s"]))
    assert is_zero(e.damping_ratio[y] - p["b"] / sympy.sqrt(2 * p["c"] * p["M"])) and x not in e.omega_squared
    assert is_zero(e.mass[1, 1] - p["M"] - 2 * p["m"] - 2 * p["Theta_r"] / p["r"] ** 2) and is_zero(
        e.damping[1, 1] - 2 * p["k"] * Abs(p["v"])
    )
    if system is vehicle.first_kind:
        by_name = {x.name: formula for x, formula in e.eliminated.items()}
        assert is_zero(by_name["δphi2"] + x / p["r"]) and is_zero(by_name["δy3"] - y - p["a"] * phi) and len(by_name) == 6


# SymPy, by hand.


class Case(NamedTuple):
    """A system; the same L, D and Q in SymPy over q, v and the symbols of the parameters; and the state, in both languages."""

    system: jl.System
    names: str
    params: str
    at: Any
    by_hand: Any  # (q, v, p) -> L, D, Q
    state: Any  # p -> q, v, and parameters that are given with them
    inputs: str = ""


def derived(case):
    """M, P, R and B: the derivatives of d/dt ∂L/∂q̇ − ∂L/∂q + ∂D/∂q̇ − Q by q̈, q̇, q and the inputs, at the state."""
    names = case.names.split()
    q, v, a = (symbols([name + dots for name in names], real=True) for dots in ("", "dot", "ddot"))
    p = {name: sympy.Symbol(name, real=True) for name in case.params.split()}
    L, D, Q = case.by_hand(q, v, p)
    rate = lambda f: sum(f.diff(x) * w + f.diff(w) * b for x, w, b in zip(q, v, a, strict=True))
    rows = sympy.Matrix([rate(L.diff(w)) - L.diff(x) + sympy.diff(D, w) - F for x, w, F in zip(q, v, Q, strict=True)])
    u = [p[name] for name in case.inputs.split()]
    q_at, v_at, also = case.state(p)
    at = dict(zip((*q, *v, *a), (*q_at, *v_at, *[0] * len(q)), strict=True)) | also
    return [rows.subs(at)] + [rows.jacobian(x).subs(at) for x in (a, v, q)] + [-rows.jacobian(x).subs(at) for x in [u] if u]


def cart_and_pole(q, qdot, M, m, l, g):
    x, theta = qdot["x"], q["theta"]
    speed = (x + l * jnp.cos(theta) * qdot["theta"]) ** 2 + (l * jnp.sin(theta) * qdot["theta"]) ** 2
    return 0.5 * M * x**2 + 0.5 * m * speed - m * g * l * jnp.cos(theta)


def cart_by_hand(q, v, p):
    (theta, _), (omega, x) = q, v
    M, m, l, g, b, F = (p[name] for name in ("M", "m", "l", "g", "b", "F"))
    speed = (x + l * cos(theta) * omega) ** 2 + (l * sin(theta) * omega) ** 2
    return M * x**2 / 2 + m * speed / 2 - m * g * l * cos(theta), b * x**2 / 2, [0, F]


def top(q, qdot, A, C, m, g, l):
    spin, tilt = qdot["psi"] + qdot["phi"] * jnp.cos(q["theta"]), qdot["theta"] ** 2 + (qdot["phi"] * jnp.sin(q["theta"])) ** 2
    return 0.5 * A * tilt + 0.5 * C * spin**2 - m * g * l * jnp.cos(q["theta"])


def top_by_hand(q, v, p):
    (_, _, theta), (phi, psi, nod) = q, v
    spin, tilt = psi + phi * cos(theta), nod**2 + (phi * sin(theta)) ** 2
    return p["A"] * tilt / 2 + p["C"] * spin**2 / 2 - p["m"] * p["g"] * p["l"] * cos(theta), sympy.Integer(0), [0, 0, 0]


def steady_top(p):
    Omega, theta = symbols("Omega theta_0", real=True)
    spin = p["m"] * p["g"] * p["l"] / (p["C"] * Omega) + (p["A"] - p["C"]) / p["C"] * Omega * cos(theta)
    return (0, 0, theta), (Omega, spin, 0), {}


def elastic_pendulum(q, qdot, m, c, l, g):
    return 0.5 * m * (qdot["r"] ** 2 + (q["r"] * qdot["phi"]) ** 2) + m * g * q["r"] * jnp.cos(q["phi"]) - 0.5 * c * (q["r"] - l) ** 2


def elastic_by_hand(q, v, p):
    (phi, r), (omega, radial) = q, v
    L = p["m"] * (radial**2 + (r * omega) ** 2) / 2 + p["m"] * p["g"] * r * cos(phi) - p["c"] * (r - p["l"]) ** 2 / 2
    return L, p["b"] * radial**4 / 4 + p["b"] * radial**2 / 2, [0, 0]


def column(q, qdot, m, l, k):
    """Ziegler's: masses 2m and m, two springs."""
    at = lambda a: l * qdot[a] * jnp.stack([-jnp.sin(q[a]), jnp.cos(q[a])])
    lower, upper = at("alpha"), at("alpha") + at("beta")
    return m * lower @ lower + 0.5 * m * upper @ upper - 0.5 * k * (q["alpha"] ** 2 + (q["beta"] - q["alpha"]) ** 2)


def column_by_hand(q, v, p):
    (a, b), (va, vb) = q, v
    speed = va**2 + vb**2 + 2 * va * vb * cos(a - b)
    L = p["m"] * p["l"] ** 2 * (va**2 + speed / 2) - p["k"] * (a**2 + (b - a) ** 2) / 2
    return L, p["d"] * (va**2 + (vb - va) ** 2) / 2, [p["P"] * p["l"] * sin(a - b), 0]


tip = lambda q, l: l * jnp.stack([jnp.cos(q["alpha"]) + jnp.cos(q["beta"]), jnp.sin(q["alpha"]) + jnp.sin(q["beta"])])
follower = jl.virtual_work(tip, lambda q, P: -P * jnp.stack([jnp.cos(q["beta"]), jnp.sin(q["beta"])]))
joints = lambda qdot, d: 0.5 * d * (qdot["alpha"] ** 2 + (qdot["beta"] - qdot["alpha"]) ** 2)
ziegler = jl.System(column, dissipation=joints, force=follower)
cart = jl.System(cart_and_pole, dissipation=lambda qdot, b: 0.5 * b * qdot["x"] ** 2, force=lambda F: {"x": F})
rubber = jl.System(elastic_pendulum, dissipation=lambda qdot, b: 0.5 * b * qdot["r"] ** 2 + 0.25 * b * qdot["r"] ** 4)
spinning = {"phi": "Omega", "psi": "m*g*l/(C*Omega) + (A - C)/C*Omega*cos(theta_0)"}
CASES = {
    "a pole upright on a cart": Case(
        cart, "theta x", "M m l g b F", {"theta": 0, "F": 0}, cart_by_hand, lambda p: ((0, 0), (0, 0), {p["F"]: 0}), "F"
    ),
    "a pole hanging from a cart": Case(
        cart, "theta x", "M m l g b F", {"theta": np.pi, "F": 0}, cart_by_hand, lambda p: ((sympy.pi, 0), (0, 0), {p["F"]: 0}), "F"
    ),
    "a top in steady precession": Case(
        jl.System(top), "phi psi theta", "A C m g l", ({"theta": "theta_0"}, spinning), top_by_hand, steady_top
    ),
    "an elastic pendulum": Case(
        rubber,
        "phi r",
        "m c l g b",
        {"phi": 0, "r": "l + m*g/c"},
        elastic_by_hand,
        lambda p: ((0, p["l"] + p["m"] * p["g"] / p["c"]), (0, 0), {}),
    ),
    "a column under a follower load": Case(
        ziegler, "alpha beta", "m l k d P", {"alpha": 0, "beta": 0}, column_by_hand, lambda p: ((0, 0), (0, 0), {})
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_the_matrices_are_those_by_hand(name):
    case = CASES[name]
    e = jl.equations(case.system, set(case.names.split()), set(case.params.split()), linearised_at=case.at, inputs=case.inputs.split())
    assert [x.name for x in e.q] == ["δ" + x for x in case.names.split()]
    balance, *wanted = derived(case)
    assert is_zero(balance.norm())  # by hand it is an equilibrium, too
    for sign, part in ((1, e.damping), (-1, e.gyroscopic), (1, e.stiffness), (-1, e.circulatory)):
        assert part == sign * part.T
    on_paper = [e.mass, e.damping + e.gyroscopic, e.stiffness + e.circulatory, e.input_matrix][: len(wanted)]
    got, point = numbers(*on_paper, *wanted)
    for have, want in zip(got[: len(wanted)], got[len(wanted) :], strict=True):
        np.testing.assert_allclose(have, want, rtol=0, atol=ROUNDING * np.abs(want).max(initial=1))
    assert [x.name for x in e.inputs] == [f"δ{u}" for u in case.inputs.split()] and (not case.inputs or "= δF" in str(e))


# Closed forms.


def rods(n):
    """n mass points in Cartesian coordinates, each held by a rod to the one above."""
    height = lambda q, qdot, m, g: sum(0.5 * m * (qdot[f"x{i}"] ** 2 + qdot[f"y{i}"] ** 2) - m * g * q[f"y{i}"] for i in range(1, n + 1))
    at = lambda q, i: jnp.stack([q[f"x{i}"], q[f"y{i}"]]) if i else jnp.zeros(2)
    rod = lambda i: lambda q, l: jnp.sum((at(q, i) - at(q, i - 1)) ** 2) - l**2
    return jl.System(height, holonomic={f"rod {i}": rod(i) for i in range(1, n + 1)}), {f"{x}{i}" for x in "xy" for i in range(1, n + 1)}


@pytest.mark.parametrize("n", [2, 4])
def test_hanging_rods_have_the_zeros_of_laguerres_polynomial(n):
    """ω² l/g, from tensions alone: no potential is curved in Cartesian coordinates."""
    system, q = rods(n)
    hanging = {f"x{i}": 0 for i in range(1, n + 1)} | {f"y{i}": f"-{i}*l" for i in range(1, n + 1)}
    e = jl.equations(system, q, {"m", "l", "g"}, linearised_at=hanging)
    squares, point = frequencies(e, m=1.0)
    np.testing.assert_allclose(squares * point["l"] / point["g"], np.polynomial.laguerre.lagroots([0] * n + [1]), rtol=1e-10)
    assert set(e.eliminated.values()) == {0} and {x.name for x in e.eliminated} == {f"δy{i}" for i in range(1, n + 1)}


def test_a_chain_of_springs_has_its_frequencies():
    """ω = 2 √(k/m) sin(j π/(2 (N + 1)))."""
    stretch = lambda q: jnp.diff(jnp.concatenate([jnp.zeros(1), q, jnp.zeros(1)]))
    chain = jl.System(lambda q, qdot, m, k: 0.5 * m * qdot @ qdot - 0.5 * k * stretch(q) @ stretch(q))
    e = jl.equations(chain, ["x_1", "x_2", "x_3"], {"m", "k"}, linearised_at=[0, 0, 0])
    squares, point = frequencies(e)
    wanted = 4 * point["k"] / point["m"] * np.sin(np.arange(1, 4) * np.pi / 8) ** 2
    np.testing.assert_allclose(squares, wanted, rtol=1e-12)
    assert "m δẍ₂ − k δx₁ + 2 k δx₂ − k δx₃ = 0" in str(e) and e.blocks == (e.q,) and not e.omega_squared


@pytest.fixture(scope="module")
def rotor():
    """A disc on a massless shaft, tilting by α and β, at spin Ω."""

    def lagrangian(q, qdot, A, C, k):
        spin = qdot["psi"] + qdot["beta"] * jnp.sin(q["alpha"])
        turning = A * (qdot["alpha"] ** 2 + (qdot["beta"] * jnp.cos(q["alpha"])) ** 2) + C * spin**2
        return 0.5 * turning - 0.5 * k * (q["alpha"] ** 2 + q["beta"] ** 2)

    at = {"alpha": 0, "beta": 0}, {"psi": "Omega"}
    return jl.equations(jl.System(lagrangian), {"alpha", "beta", "psi"}, {"A", "C", "k"}, linearised_at=at)


def test_a_rotor_has_its_gyroscopic_pair(rotor):
    """A ω² ∓ C Ω ω − k = 0: forward and backward whirl."""
    assert str(rotor).split("\n\n")[1:] == ["A δα̈ − C Ω δβ̇ + k δα = 0\nA δβ̈ + C Ω δα̇ + k δβ = 0", "C δψ̈ = 0"]
    assert not any(rotor.damping) and [len(block) for block in rotor.blocks] == [2, 1]
    (M, G, K), p = numbers(rotor.mass[:2, :2], rotor.gyroscopic[:2, :2], rotor.stiffness[:2, :2], C=3.0)
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, G)]])
    half = 3.0 * p["Omega"] / (2 * p["A"])
    root = np.sqrt(half**2 + p["k"] / p["A"])
    np.testing.assert_allclose(
        np.sort(np.linalg.eigvals(A).imag), np.sort([root + half, root - half, half - root, -half - root]), rtol=1e-12
    )


def on_a_cone(q, qdot, m, l, g):
    speed = qdot["alpha"] ** 2 + (jnp.sin(q["alpha"]) * qdot["psi"]) ** 2
    return 0.5 * m * l**2 * speed + m * g * l * jnp.cos(q["alpha"])


CONES = {
    "its angle": ({"alpha": "acos(g/(l*Omega**2))"}, {"psi": "Omega"}),
    "its rate": ({"alpha": "alpha_0"}, {"psi": sympy.sqrt(sympy.Symbol("g") / (sympy.Symbol("l") * cos(sympy.Symbol("alpha_0"))))}),
    "its gravity": ({"alpha": "alpha_0", "g": "l*Omega**2*cos(alpha_0)"}, {"psi": "Omega"}),
}


@pytest.mark.parametrize("given_by", CONES)
def test_a_conical_pendulum_swings_about_its_cone(given_by):
    """ω² = Ω² (1 + 3 cos² α), at constant angular momentum about the vertical."""
    angle, rate, length = 0.7, 1.9, 1.5
    e = jl.equations(jl.System(on_a_cone), {"alpha", "psi"}, {"m", "l", "g"}, positive=("m", "l", "g"), linearised_at=CONES[given_by])
    at = dict(alpha_0=angle, Omega=rate, l=length, g=length * rate**2 * np.cos(angle))
    (M, P, K), _ = numbers(e.mass, e.damping + e.gyroscopic, e.stiffness, **at)
    square = (K[0, 0] + P[0, 1] ** 2 / M[1, 1]) / M[0, 0]
    np.testing.assert_allclose(square, rate**2 * (1 + 3 * np.cos(angle) ** 2), rtol=1e-12)


def test_a_planet_on_a_circle_oscillates_once_a_year():
    """Deviations from the circle r = R, θ̇ = Ω = √(μ/R³) have the frequency Ω."""
    kepler = jl.System(lambda q, qdot, m, mu: 0.5 * m * (qdot["r"] ** 2 + (q["r"] * qdot["theta"]) ** 2) + m * mu / q["r"])
    e = jl.equations(kepler, {"r", "theta"}, {"m", "mu"}, linearised_at=({"r": "R"}, {"theta": "sqrt(mu/R^3)"}))
    (M, G, K), p = numbers(e.mass, e.gyroscopic, e.stiffness)
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, G)]])
    assert np.abs(np.linalg.eigvals(A).imag).max() == pytest.approx(np.sqrt(p["mu"] / p["R"] ** 3), rel=1e-9)


def test_a_wheel_that_rolls_on_a_spring():
    """(J/r² + m) ω² = c; the force on its axle acts at the radius."""
    system = jl.System(
        lambda q, qdot, m, J, c: 0.5 * m * qdot["x"] ** 2 + 0.5 * J * qdot["phi"] ** 2 - 0.5 * c * q["x"] ** 2,
        holonomic=lambda q, r: q["x"] - r * q["phi"],
        force=lambda F: {"x": F},
    )
    e = jl.equations(system, {"x", "phi"}, {"m", "J", "c", "r", "F"}, linearised_at={"x": 0, "F": 0}, inputs="F")
    m, J, c, r = (e.params[name] for name in "mJcr")
    assert str(e).endswith("δx = r δφ\n\n(J + m r²) δφ̈ + c r² δφ = r δF\nω₀² = c r²/(J + m r²)")
    assert is_zero(e.omega_squared[e.q[0]] - c / (J / r**2 + m)) and e.input_matrix == sympy.Matrix([r])
    free = jl.System(
        lambda q, qdot, m, J: 0.5 * m * qdot["x"] ** 2 + 0.5 * J * qdot["phi"] ** 2, holonomic=lambda q, r: q["x"] - r * q["phi"]
    )
    rolling = jl.equations(free, {"x", "phi"}, {"m", "J", "r"}, linearised_at=({}, {"phi": "Omega"}))
    assert rolling.at[symbols("xdot", real=True)] == rolling.params["r"] * symbols("Omega", real=True)


def test_an_unstable_oscillator_has_a_negative_square_and_no_damping_ratio():
    damped = jl.System(
        lambda q, qdot, m, g, l: 0.5 * m * (l * qdot) ** 2 + m * g * l * jnp.cos(q), dissipation=lambda qdot, b: 0.5 * b * qdot**2
    )
    e = jl.equations(damped, "phi", {"m", "l", "g", "b"}, linearised_at="pi")
    assert str(e) == "φ = π\n\nm l² δφ̈ + b δφ̇ − m g l δφ = 0\nω₀² = −g/l" and not e.damping_ratio


def test_the_frequency_is_called_otherwise_where_a_parameter_has_its_name():
    spring = jl.System(lambda q, qdot, omega_0: 0.5 * qdot**2 - 0.5 * omega_0**2 * q**2)
    assert "ωₙ² = ω₀²" in str(jl.equations(spring, "x", {"omega_0"}, linearised_at=0))


def test_an_input_may_come_with_a_factor_of_time():
    driven = jl.System(
        lambda q, qdot, m, g, l: 0.5 * m * (l * qdot) ** 2 + m * g * l * jnp.cos(q), force=lambda t, F, w: F * jnp.cos(w * t)
    )
    e = jl.equations(driven, "phi", {"m", "l", "g", "F", "w"}, linearised_at={"phi": 0, "F": 0}, inputs=["F"])
    assert "m l² δφ̈ + m g l δφ = δF cos(w t)" in str(e)


# Forces with kinks.


def block(law, **kinds):
    """A mass on a spring, with a dissipation of its velocity."""
    return jl.System(lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2, dissipation=law, **kinds)


SMOOTH = {
    "|v| v at rest": (block(lambda qdot, k: dissipation.drag(qdot, k)), {"k"}, 0, "m δẍ + c δx = 0"),
    "|v|^(3/2) sign v at rest": (block(lambda qdot, k: dissipation.power_law(qdot, k, 1.5)), {"k"}, 0, "m δẍ + c δx = 0"),
    "a belt that slips": (
        block(lambda qdot, F, u: F * (jnp.abs(qdot - u) - 0.5 * (qdot - u) ** 2)),
        {"F", "u"},
        "F*(1 - u)/c",
        "m δẍ − F δẋ + c δx = 0",
    ),
    "a contact that is pressed": (
        jl.System(lambda q, qdot, m, c, g: 0.5 * m * qdot**2 - 0.5 * c * jnp.maximum(q, 0) ** 2 + m * g * q),
        {"g"},
        "m*g/c",
        "m δẍ + c δx = 0",
    ),
}


@pytest.mark.parametrize("name", SMOOTH)
def test_beside_its_kinks_a_force_is_linear(name):
    system, more, at, text = SMOOTH[name]
    e = jl.equations(system, "x", {"m", "c"} | more, positive=("m", "c", *more), linearised_at=at)
    assert text in str(e).splitlines()


KINKS = {
    "dry friction": (
        block(lambda qdot, k: dissipation.sliding(qdot, k, 1.0)),
        "must be smooth at `linearised_at`, but −k sign(ẋ) − c x has a",
    ),
    "√|v|": (block(lambda qdot, k: dissipation.power_law(qdot, k, 0.5)), "all formulas are finite, but −k/(2 √ẋ) is not. Choose another"),
    "|x|": (
        jl.System(lambda q, qdot, m, c, k: 0.5 * m * qdot**2 - 0.5 * c * q**2 - k * q * jnp.abs(q) - k * jnp.abs(q)),
        "has a jump or a",
    ),
    "a contact that is touched": (
        jl.System(lambda q, qdot, m, c, k: 0.5 * m * qdot**2 - 0.5 * c * jnp.maximum(q, 0) ** 2 - 0.5 * k * q**2),
        "has a jump or a kink there, as dry friction at rest has. Choose a state beside it, or a smooth law.",
    ),
    "cases": (jl.System(lambda q, qdot, m, c, k: 0.5 * m * qdot**2 - jnp.where(q > 0, c, k) * q**2), "has a jump or a kink there"),
    "steps": (jl.System(lambda qdot, m: 0.5 * m * qdot**2, force=lambda q, c, k: -c * jnp.floor(q) - k * q), "has a jump or a kink there"),
}


@pytest.mark.parametrize("name", KINKS)
def test_at_a_kink_there_are_no_linear_equations(name):
    system, said = KINKS[name]
    with pytest.raises(ValueError, match=re.escape(said)):
        jl.equations(system, "x", {"m", "c", "k"}, linearised_at=0)


# The state.


class Plane(NamedTuple):
    x: float
    y: float


plane = jl.System(lambda q, qdot, c: sum(0.5 * jnp.sum(v**2) for v in jax.tree.leaves(qdot)) - 0.5 * c * sum(map(jnp.sum, squares(q))))
squares = lambda q: [(x - 1) ** 2 for x in jax.tree.leaves(q)]
STATES = [
    ({"x", "y"}, {"x": 1, "y": 1.0}),
    ({"x", "y"}, {"x": "1", sympy.Symbol("y"): sympy.Integer(1)}),
    ({"x", "y"}, ({"x": jnp.ones(()), "y": "c/c"}, {})),
    (["x", "y"], [1, "1"]),
    (["x", "y"], {"x": 1, "y": "x"}),
    (np.zeros(2), np.ones(2)),
    (np.zeros(2), 1),
    (np.zeros(2), ([1, 1], np.zeros(2))),
    (Plane(0.0, 0.0), Plane(1, 1)),
    (Plane(0.0, 0.0), {"x": 1, "y": 1}),
    ((0.0, 0.0), (1, 1)),
    ((0.0, 0.0), ((1, 1), (0, 0))),
    ({"wheel": {"phi": 0.0}, "s": 0.0}, {"wheel": {"phi": 1}, "s": 1}),
    ({"wheel": {"phi": 0.0}, "s": 0.0}, {"phi_wheel": 1, "s": 1}),
]


@pytest.mark.parametrize("q, at", STATES)
def test_a_state_is_given_in_many_ways(q, at):
    e = jl.equations(plane, q, {"c"}, linearised_at=at)
    assert [e.at[x] for x in e.at][:2] == [1, 1] and e.stiffness == e.params["c"] * sympy.eye(2)


@pytest.mark.slow
def test_what_is_left_out_keeps_its_symbol_or_follows_from_constraints():
    e = jl.equations(vehicle.first_kind, ALL_PARTS, vehicle.params, linearised_at=STILL)
    p, by_name = e.params, {symbol.name: formula for symbol, formula in e.at.items()}
    assert by_name["x"] == sympy.Symbol("x", real=True) and is_zero(by_name["phi3"] + (by_name["x"] + p["a"]) / p["r"])
    assert is_zero(by_name["y2"] - p["l"] + p["M"] * p["g"] / (2 * p["c"]))


def test_a_preload_is_a_condition_on_a_parameter():
    hung = jl.System(lambda q, qdot, m, c, s, g: 0.5 * m * qdot**2 - 0.5 * c * (q + s) ** 2 + m * g * q)
    said = (
        "`linearised_at` must be an equilibrium or a steady motion, but ẍ = g − c s/m there. It is one where c s − m g = 0. "
        "Give coordinates, rates, or parameters in the same mapping, for which this holds, and name in `positive` what is positive."
    )
    ask = lambda at: jl.equations(hung, "x", {"m", "c", "s", "g"}, linearised_at=at)
    with pytest.raises(ValueError, match=re.escape(said)):
        ask({"x": 0})
    assert str(ask({"x": 0, "s": "m*g/c"})) == "x = 0\ns = m g/c\n\nm δẍ + c δx = 0\nω₀² = c/m"
    assert str(ask({"x": "m*g/c - s"})) == "x = m g/c − s\n\nm δẍ + c δx = 0\nω₀² = c/m"


free = lambda qdot, m: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2)
slip = lambda q, qdot: qdot["x"] * jnp.sin(q["y"]) - qdot["y"]
WRONG = {
    "a pendulum anywhere": (pendulum.polar, {"r", "phi"}, "m l g", {}, "but φ̈ = −(g/l) sin φ there. It is one where m g l sin φ = 0."),
    "a push": (cart, {"x", "theta"}, "M m l g b F", {"theta": 0}, "but θ̈ = −F/(M l), ẍ = F/M there. It is one where F = 0."),
    "a wrong radius": (
        pendulum.polar,
        {"r", "phi"},
        "m l g",
        {"phi": 0, "r": 1},
        "satisfy the constraints, but with g = r − l, g is 1 − l",
    ),
    "|l| is not l": (
        pendulum.cartesian,
        {"x", "y"},
        "m l g",
        {"x": 0, "y": "-l"},
        "g is |l| − l there. Give all coordinates that it holds",
    ),
    "too fast": (pendulum.polar, {"r", "phi"}, "m l g", ({"phi": 0}, {"r": "v"}), "with g = r − l, dg/dt is v there"),
    "a slider": (
        jl.System(lambda qdot, m: 0.5 * m * (qdot["x"] ** 2 + qdot["phi"] ** 2), holonomic=lambda q: q["x"] - jnp.sin(q["phi"])),
        {"x", "phi"},
        "m",
        ({}, {"phi": "Omega"}),
        "must be a steady motion, but the constraints turn it: G q̈ = −Ω² sin φ. Choose coordinates whose rates are constant",
    ),
    "what moves": (plane, {"x", "y"}, "c", ({"x": 1, "y": "x"}, {"x": "v"}), "`linearised_at` must be constant, but y = x changes along"),
    "changing coefficients": (
        jl.System(lambda t, q, qdot, c, e: 0.5 * qdot["x"] ** 2 - 0.5 * c * (1 + e * jnp.cos(t)) * q["x"] ** 2),
        {"x"},
        "c e",
        {"x": 0},
        "must have constant coefficients, but one is c (e cos t + 1), which changes along the motion. Choose coordinates that turn",
    ),
    "the pole of polar coordinates": (
        jl.System(lambda q, qdot, m, c: 0.5 * m * (qdot["r"] ** 2 + (q["r"] * qdot["phi"]) ** 2) + c / q["r"]),
        {"r", "phi"},
        "m c",
        {"r": 0},
        "must be a state where all formulas are finite, but m r φ̇² − c/r² is not.",
    ),
    "equal rows": (
        jl.System(lambda qdot, m: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2), holonomic=lambda q: jnp.stack([q["x"], 2 * q["x"]])),
        {"x", "y"},
        "m",
        {},
        "the constraints must be independent at `linearised_at`, but only 1 of 2 rows are. Drop those that repeat others",
    ),
    "a branching": (
        jl.System(lambda qdot, m: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2), holonomic=lambda q: q["x"] ** 2 - q["y"] ** 2),
        {"x", "y"},
        "m",
        {"x": 0, "y": 0},
        "but only 0 of 1 rows are.",
    ),
    "nonholonomic": (
        jl.System(free, nonholonomic=slip),
        {"x", "y"},
        "m",
        {"y": 0},
        "must be linear of second order for `linearised_at`, but has nonholonomic constraints. Write those that can be integrated as",
    ),
    "an actuator": (
        jl.System(free, states={"F": jl.State(lambda F: -F)}, force=lambda F: {"x": F}),
        {"x", "y"},
        "m",
        {},
        "has further states that act on it. Write them as parameters; `linearise` does it with numbers.",
    ),
    "friction of a reaction": (
        jl.System(
            free,
            dissipation=lambda qdot, multipliers, mu: mu * multipliers["floor"] * qdot["x"] ** 2,
            holonomic={"floor": lambda q: q["y"]},
        ),
        {"x", "y"},
        "m mu",
        {},
        "has forces that depend on multipliers. Write them by coordinates",
    ),
    "no such name": (plane, {"x", "y"}, "c", {"z": 1}, "must name coordinates or parameters, but names 'z'. There are x, y, c."),
    "no rate of a parameter": (plane, {"x", "y"}, "c", ({"x": 1}, {"c": 1}), "but names 'c'. There are x, y."),
    "no formula": (
        plane,
        {"x", "y"},
        "c",
        {"x": "2 c"},
        "must hold numbers, formulas as text or SymPy expressions, but holds '2 c'. Write",
    ),
    "nothing": (plane, {"x", "y"}, "c", {"x": None}, "must hold numbers, formulas as text or SymPy expressions, but holds None."),
    "time": (plane, {"x", "y"}, "c", {"x": "t"}, "but 't' holds 't', which changes with time. Give rates as the second of a pair"),
    "itself": (plane, {"x", "y"}, "c", {"x": "y", "y": "x + 1"}, "must not express 'x' by itself, but does. Write it by other symbols."),
    "the wrong length": (plane, np.zeros(2), "c", [1, 1, 1], "structured like `q`, but an entry of shape (2,) is [1, 1, 1]. Name the"),
    "imaginary": (jl.System(free), {"x", "y"}, "m", {"x": "sqrt(-1 - m**2)"}, "must be real for some parameters, but no such were found."),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_state_without_linear_equations_is_refused(name):
    system, q, params, at, said = WRONG[name]
    with pytest.raises(ValueError, match=re.escape(said)):
        jl.equations(system, q, set(params.split()), linearised_at=at)


def test_inputs_and_multipliers_must_fit():
    ask = lambda **options: jl.equations(plane, {"x", "y"}, {"c"}, **options)
    with pytest.raises(TypeError, match="`linearised_at` must be structured like `q`, but holds 1. Name the coordinates in a mapping."):
        ask(linearised_at=1)
    with pytest.raises(ValueError, match="`inputs` must name parameters, but names 'F'. There are c."):
        ask(linearised_at={"x": 1, "y": 1}, inputs="F")
    with pytest.raises(ValueError, match="`inputs` must come with `linearised_at`, but is 'c' without it. Give the state"):
        ask(inputs="c")
    with pytest.raises(ValueError, match="`multipliers` must be False with `linearised_at`, but is True. Linear equations are in"):
        ask(linearised_at={"x": 1, "y": 1}, multipliers=True)
    held = jl.System(free, holonomic=lambda q, l: q["x"] - l)
    with pytest.raises(
        ValueError, match="but of `inputs` l moves a constraint or a mass. Name those of forces and potentials; `linearise`"
    ):
        jl.equations(held, {"x", "y"}, {"m", "l"}, linearised_at={}, inputs="l")


@jax.custom_jvp
def parabola(x):
    return x**2


parabola.defjvp(lambda primals, tangents: (primals[0] ** 2, 2 * lax.stop_gradient(primals[0]) * tangents[0]))


def test_derivatives_that_differ_from_those_of_the_simulation_are_refused():
    """The force is right, its derivative in the simulation is not: on paper nobody sees `stop_gradient`."""
    system = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - c * parabola(q))
    assert str(jl.equations(system, "x", {"c"})) == "ẍ + 2 c x = 0"
    with pytest.raises(ValueError, match="the linear equations must agree with the simulation, but K differs: .*Write functions with a"):
        jl.equations(system, "x", {"c"}, linearised_at=0)


SPRING = lambda q, qdot, m, g, c, l0: (
    0.5 * m * (qdot["r"] ** 2 + (q["r"] * qdot["phi"]) ** 2) + m * g * q["r"] * jnp.cos(q["phi"]) - 0.5 * c * (q["r"] - l0) ** 2
)


def test_drag_has_no_linear_part_at_rest():
    """A spring pendulum in air: the slopes of |v| v are 0/0 as formulas, and were refused; now they have their limit, 0."""
    air = lambda q, qdot, k: dissipation.drag(jnp.stack([qdot["r"], q["r"] * qdot["phi"]]), k)
    names = {"r", "phi"}, {"m", "g", "c", "l0", "k"}
    found = jl.equations(jl.System(SPRING, dissipation=air), *names, linearised_at={"phi": 0, "r": "l0 + m*g/c"})
    m, g, c, l0 = (next(x for x in found.stiffness.free_symbols | found.mass.free_symbols if x.name == n) for n in ("m", "g", "c", "l0"))
    squares = {x.name: value for x, value in found.omega_squared.items()}
    assert is_zero(squares["δphi"] - g / (l0 + m * g / c)) and is_zero(squares["δr"] - c / m) and found.damping.is_zero_matrix
    assert sympy.count_ops(squares["δphi"]) <= 6  # it was g (l₀ + m g/c) over the square written out
    dry = lambda q, qdot, k: k * dissipation.speed(jnp.stack([qdot["r"], q["r"] * qdot["phi"]]))  # a kink has none
    with pytest.raises(ValueError, match="linearised_at"):
        jl.equations(jl.System(SPRING, dissipation=dry), *names, linearised_at={"phi": 0, "r": "l0 + m*g/c"})


def test_a_refusal_leaves_free_what_was_given_wrongly():
    """At r = l₀ "m g = 0" was asked for, which is true and no help."""
    names = {"r", "phi"}, {"m", "g", "c", "l0"}
    with pytest.raises(ValueError, match=re.escape("It is one where m g cos φ − c (r − l₀) = 0.")):
        jl.equations(jl.System(SPRING), *names, linearised_at={"phi": 0, "r": "l0"})
