"""The equations on paper: against the lecture, SymPy's mechanics and the simulation; as text, pictures and programs."""

import contextlib
import ctypes
import importlib
import inspect
import json
import os
import pathlib
import pkgutil
import re
import shutil
import subprocess
import sys
from typing import NamedTuple
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
import sympy
from jax import lax
from sympy import Abs, cos, sin, symbols
from sympy.physics.mechanics import (
    KanesMethod,
    LagrangesMethod,
    Point,
    ReferenceFrame,
    RigidBody,
    dot,
    dynamicsymbols,
    find_dynamicsymbols,
    inertia,
)

import jaxlag as jl
from jaxlag import dissipation, examples, plot
from jaxlag._paper import linear_solve
from jaxlag.examples import pendulum, stribeck, vehicle

matplotlib.use("Agg")
ROUNDING = 1e-11  # what is asked for of 100 states; sums in another order differ by some 1e-15
NOTEBOOKS = pathlib.Path(__file__).parents[2] / "notebooks"


def is_zero(formula):
    return sympy.simplify(formula) == 0


# The lecture.


@pytest.fixture(scope="module")
def car():
    return jl.equations(vehicle.system, vehicle.q0, vehicle.params)


def lectured(e):
    """The lecture's three equations of the vehicle, each as what is zero."""
    p = e.params
    phi, x, y = symbols("phi x y", real=True)
    v, a = ({q: sympy.Symbol(q.name + dots, real=True) for q in (phi, x, y)} for dots in ("dot", "ddot"))
    wind = v[x] + p["v"]
    return (
        p["Theta_s"] * a[phi] + 2 * p["b"] * p["a"] ** 2 * v[phi] + 2 * p["c"] * p["a"] ** 2 * phi,
        (p["M"] + 2 * p["m"] + 2 * p["Theta_r"] / p["r"] ** 2) * a[x] + p["k"] * Abs(wind) * wind - p["M0"] / p["r"],
        p["M"] * a[y] + 2 * p["b"] * v[y] + 2 * p["c"] * (y - p["l"]) + p["M"] * p["g"],
    )


ALL_PARTS = dict.fromkeys(("x", "y", "phi", "x2", "x3", "y2", "y3", "phi2", "phi3"), 0.0)


@pytest.mark.fast
def test_the_vehicle_prints_the_lectures_equations(car):
    assert str(car) == (
        "Θₛ φ̈ + 2 a² b φ̇ + 2 a² c φ = 0\n(M + 2 m + 2 Θᵣ/r²) ẍ + k |ẋ + v| (ẋ + v) = M₀/r\nM ÿ + 2 b ẏ + 2 c (y − l) + M g = 0"
    )
    assert all(is_zero(e.lhs - e.rhs - by_hand) for e, by_hand in zip(car.motion, lectured(car), strict=True))


@pytest.mark.parametrize(
    "system, q", [(vehicle.substituted, vehicle.q0), (vehicle.first_kind, ALL_PARTS)], ids=["substituted", "eliminated"]
)
def test_the_other_ways_to_the_vehicle_lead_to_the_same_equations(system, q):
    e = jl.equations(system, q, vehicle.params)
    assert all(is_zero(e.lhs - e.rhs - by_hand) for e, by_hand in zip(e.motion, lectured(e), strict=True))
    if system is vehicle.first_kind:
        p, (phi, x, y), (phidot, _, ydot) = e.params, e.q, e.qdot
        assert is_zero(e.eliminated[sympy.Symbol("phi2", real=True)] + (x - p["a"]) / p["r"]) and len(e.eliminated) == 6
        strut = p["c"] * (y - p["a"] * phi - p["l"]) + p["b"] * (ydot - p["a"] * phidot)
        assert is_zero(e.multipliers["rear strut"] - strut)
        assert is_zero(e.accelerations["x3"] - e.accelerations["x"]) and is_zero(e.accelerations["phi3"] + e.accelerations["x"] / p["r"])


@pytest.mark.fast
def test_the_pendulum_has_the_lectures_acceleration_and_rod_force():
    e = jl.equations(pendulum.polar, {"r", "phi"}, {"m", "l", "g"})
    phidot, (phi,) = e.qdot[0], e.q
    m, l, g = (e.params[name] for name in "mlg")
    assert is_zero(e.accelerations["phi"] + g / l * sin(phi)) and e.accelerations["r"] == 0
    assert is_zero(e.multipliers["rod"] + m * l * phidot**2 + m * g * cos(phi))
    assert str(e) == "r = l\n\nm l² φ̈ + m g l sin φ = 0\n\nφ̈ = −(g/l) sin φ\nλ = −m l φ̇² − m g cos φ"
    full = jl.equations(pendulum.polar, {"r", "phi"}, {"m", "l", "g"}, multipliers=True)
    assert [symbol.name for symbol in full.q] == ["phi", "r"] and not full.eliminated
    assert sympy.Matrix([[0, 1]]) == full.G and full.gamma == sympy.Matrix([0]) and full.g == sympy.Matrix([full.q[1] - l])
    assert "m r̈ − m r φ̇² − m g cos φ = λ" in str(full)


def test_friction_that_depends_on_a_multiplier():
    rub = lambda qdot, multipliers, mu: mu * jnp.abs(multipliers["floor"]) * jnp.abs(qdot["x"])
    energy = lambda q, qdot, m, g: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2) - m * g * q["y"]
    block = jl.System(energy, dissipation=rub, holonomic={"floor": lambda q: q["y"]})
    e = jl.equations(block, {"x", "y"}, {"m", "g", "mu"}, positive=("m", "g"))
    (xdot,), p = e.qdot, e.params
    assert e.multipliers["floor"] == p["m"] * p["g"] and e.accelerations["x"] == -p["mu"] * p["g"] * sympy.sign(xdot)
    assert "m ẍ + μ |λ| sign(ẋ) = 0" in str(e)
    first = jl.equations(block, {"x", "y"}, {"m", "g", "mu"}, multipliers=True)
    assert first.multipliers["floor"] == p["m"].func("m", real=True) * sympy.Symbol("g", real=True)
    assert first.accelerations["y"] == 0


# SymPy's mechanics.


def by_lagrange(L, q, plain):
    """M and f of SymPy's LagrangesMethod in plain symbols."""
    method = LagrangesMethod(L, q)
    method.form_lagranges_equations()
    t = dynamicsymbols._t
    rules = dict(zip([x.diff(t) for x in q], plain[1], strict=True)) | dict(zip(q, plain[0], strict=True))
    return (part.subs(rules) for part in (method.mass_matrix, method.forcing))


def chain(q, qdot, m, l, g):
    vx, vy = jnp.cumsum(l * jnp.cos(q) * qdot), jnp.cumsum(l * jnp.sin(q) * qdot)
    return 0.5 * jnp.sum(m * (vx**2 + vy**2)) + g * jnp.sum(m * jnp.cumsum(l * jnp.cos(q)))


def test_a_double_pendulum_is_that_of_lagranges_method():
    e = jl.equations(jl.System(chain), ["phi_1", "phi_2"], {"m": ["m_1", "m_2"], "l": ["l_1", "l_2"], "g": "g"})
    (m1, m2), (l1, l2), g = e.params["m"], e.params["l"], e.params["g"]
    q1, q2 = q = dynamicsymbols("q1 q2")
    t = dynamicsymbols._t
    x1, y1 = l1 * sin(q1), -l1 * cos(q1)
    x2, y2 = x1 + l2 * sin(q2), y1 - l2 * cos(q2)
    L = m1 * (x1.diff(t) ** 2 + y1.diff(t) ** 2) / 2 + m2 * (x2.diff(t) ** 2 + y2.diff(t) ** 2) / 2 - m1 * g * y1 - m2 * g * y2
    M, f = by_lagrange(L, q, (e.q, e.qdot))
    assert all(is_zero(entry) for entry in (*(M - e.M), *(f - e.f)))
    assert str(e).splitlines()[0] == ("(m₁ + m₂) l₁² φ̈₁ + m₂ l₁ l₂ φ̈₂ cos(φ₁ − φ₂) + m₂ l₁ l₂ φ̇₂² sin(φ₁ − φ₂) + (m₁ + m₂) l₁ g sin φ₁ = 0")


def test_a_bead_on_a_rotating_hoop_is_that_of_lagranges_method():
    bead = jl.System(lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[2])
    hoop = lambda t, q, R, Omega: R * jnp.stack([jnp.sin(q) * jnp.cos(Omega * t), jnp.sin(q) * jnp.sin(Omega * t), -jnp.cos(q)])
    e = jl.equations(jl.substitute(bead, hoop), "theta", {"m", "g", "R", "Omega"})
    m, g, R, Omega = (e.params[name] for name in ("m", "g", "R", "Omega"))
    (q,), t = dynamicsymbols("q1:2"), dynamicsymbols._t
    at = [R * sin(q) * cos(Omega * t), R * sin(q) * sin(Omega * t), -R * cos(q)]
    M, f = by_lagrange(m * sum(x.diff(t) ** 2 for x in at) / 2 - m * g * at[2], [q], (e.q, e.qdot))
    assert is_zero(M[0] - e.M[0]) and is_zero(f[0] - e.f[0])
    assert not e.M.has(e.t) and not e.f.has(e.t) and "m R (g − R Ω² cos θ) sin θ" in str(e)


def rolling_disc():
    """Yaw ψ, lean θ from the vertical, spin φ and the centre x, y of a thin disc that rolls on the ground."""

    def lagrangian(q, qdot, m, r, g):
        spin, fall = qdot["phi"] + qdot["psi"] * jnp.sin(q["theta"]), r * jnp.sin(q["theta"]) * qdot["theta"]
        turning = qdot["theta"] ** 2 / 4 + spin**2 / 2 + (qdot["psi"] * jnp.cos(q["theta"])) ** 2 / 4
        return 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2 + fall**2 + r**2 * turning) - m * g * r * jnp.cos(q["theta"])

    def ground(q, qdot, r):
        c, s, spin = jnp.cos(q["psi"]), jnp.sin(q["psi"]), qdot["phi"] + qdot["psi"] * jnp.sin(q["theta"])
        fall = qdot["theta"] * jnp.cos(q["theta"])
        return {"x": qdot["x"] - r * (spin * c + fall * s), "y": qdot["y"] - r * (spin * s - fall * c)}

    return jl.System(lagrangian, nonholonomic={"ground": ground})


def test_a_rolling_disc_is_that_of_kanes_method():
    e = jl.equations(rolling_disc(), {"x", "y", "psi", "theta", "phi"}, {"m", "r", "g"})
    m, r, g = (e.params[name] for name in "mrg")
    q, u, t = dynamicsymbols("q1:4"), dynamicsymbols("u1:4"), dynamicsymbols._t
    N = ReferenceFrame("N")
    Y = N.orientnew("Y", "Axis", [q[0], N.z])
    lean = Y.orientnew("L", "Axis", [q[1], Y.x])
    R = lean.orientnew("R", "Axis", [q[2], lean.y])
    turning = R.ang_vel_in(N)
    R.set_ang_vel(N, u[0] * lean.x + u[1] * lean.y + u[2] * lean.z)
    contact = Point("C")
    contact.set_vel(N, 0)
    centre = contact.locatenew("D", r * lean.z)
    centre.v2pt_theory(contact, N, R)
    disc = RigidBody("disc", centre, R, m, (inertia(lean, m * r**2 / 4, m * r**2 / 2, m * r**2 / 4), centre))
    kane = KanesMethod(N, q, u, [dot(R.ang_vel_in(N) - turning, axis) for axis in lean])
    kane.kanes_equations([disc], [(centre, -m * g * N.z)])
    udot = dict(zip([speed.diff(t) for speed in u], kane.mass_matrix.LUsolve(kane.forcing), strict=True))
    qdot = kane.kindiffdict()
    psi, theta, phi = symbols("psi theta phi", real=True)
    v = symbols("psidot thetadot phidot", real=True)
    back = sympy.solve([qdot[x.diff(t)] - rate for x, rate in zip(q, v, strict=True)], u)
    for x, name in zip(q, ("psi", "theta", "phi"), strict=True):
        by_kane = (
            qdot[x.diff(t)].diff(t).xreplace(udot).xreplace(qdot).xreplace(back).xreplace(dict(zip(q, (psi, theta, phi), strict=True)))
        )
        assert not find_dynamicsymbols(by_kane) and is_zero(by_kane - e.accelerations[name])
    # Linearised about upright rolling: −2, not the −6 of constraints put into L as if they were holonomic.
    assert e.accelerations["psi"].diff(v[1]).subs(theta, 0) == -2 * v[2]
    assert is_zero(e.multipliers["ground"]["x"] - m * e.accelerations["x"])


# The simulation.


class Case(NamedTuple):
    system: jl.System
    q: object
    params: object


NETWORK = jl.learnt.PassiveDissipation(0.1, width=2, depth=1, power=0.5, key=jax.random.key(0))
EXAMPLES = {
    "vehicle.system": Case(vehicle.system, vehicle.q0, vehicle.params),
    "vehicle.substituted": Case(vehicle.substituted, vehicle.q0, vehicle.params),
    "vehicle.first_kind": Case(vehicle.first_kind, ALL_PARTS, vehicle.params),
    "pendulum.polar": Case(pendulum.polar, {"r": 1.0, "phi": 0.0}, pendulum.params),
    "pendulum.cartesian": Case(pendulum.cartesian, {"x": 1.0, "y": 0.0}, pendulum.params),
    "stribeck.system": Case(stribeck.system, 0.0, stribeck.params | {"net": NETWORK}),
}
MORE = {
    "five links": Case(jl.System(chain), np.zeros(5), {"m": np.linspace(1, 2, 5), "l": np.linspace(1, 0.5, 5), "g": 9.81}),
    "redundant rods": Case(
        jl.System(
            lambda q, qdot: 0.5 * jnp.sum(qdot**2) - 9.81 * jnp.sum(q[:, 1]),
            holonomic={"rods": lambda q: jnp.sum(q**2, 1) - 1, "again": lambda q: 3 * (q[0] @ q[0] - 1)},
        ),
        np.array([[0.6, 0.8], [1.0, 0.0]]),
        None,
    ),
    "rubbing": Case(
        jl.System(
            lambda q, qdot, m: 0.5 * m * qdot @ qdot - 0.5 * q @ q,
            dissipation=lambda qdot, mu: dissipation.sliding(qdot, mu, 1.0) + dissipation.power_law(qdot[0], 0.1, 1.5),
            force={"push": lambda t: jnp.stack([jnp.sin(t), 0.0])},
        ),
        [0.0, 0.0],
        {"m": 2.0, "mu": 0.3},
    ),
}


def test_every_example_is_in_the_table():
    """But for the bicycle of nine coordinates: its equations fill a book; `tests/linear/test_whipple` compares them with a paper."""
    modules = [importlib.import_module(f"jaxlag.examples.{module.name}") for module in pkgutil.iter_modules(examples.__path__)]
    there = {
        f"{module.__name__.split('.')[-1]}.{name}" for module in modules for name, x in vars(module).items() if isinstance(x, jl.System)
    }
    assert there - {"bicycle.system"} == set(EXAMPLES), (
        "each example is compared with its equations on paper: put its coordinates into EXAMPLES"
    )


def states(case, number):
    """t, q and q̇ at random, stacked, as flat arrays and structured."""
    flat, unravel = jax.flatten_util.ravel_pytree(jax.tree.map(jnp.asarray, case.q, is_leaf=lambda node: isinstance(node, list)))
    draw = np.random.default_rng(0).uniform
    t, q, v = draw(0, 1, number), draw(0.2, 1.0, (number, flat.size)), draw(-1.0, 1.0, (number, flat.size))
    return (t, q, v), (jnp.asarray(t), jax.vmap(unravel)(jnp.asarray(q)), jax.vmap(unravel)(jnp.asarray(v)))


def simulated(case, t, q, v):
    """q̈ and λ of many states, as arrays."""
    a = jax.jit(jax.vmap(lambda t, q, v: jl.acceleration(case.system, q, v, case.params, t=t)))(t, q, v)
    flat = lambda tree: [np.reshape(leaf, (len(t), -1)) for leaf in jax.tree.leaves(tree)]
    return np.hstack(flat(a.qddot)), np.hstack(
        [np.zeros((len(t), 0)), *(part for name in case.system.constraints for part in flat(a.multipliers[name]))]
    )


def compiled(text, tmp_path):
    """The C function as one of arrays."""
    cc = shutil.which("cc")
    if cc is None:
        pytest.skip("no C compiler `cc`")
    (tmp_path / "motion.c").write_text(text)
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-Wno-unused-variable", "-Wno-unused-parameter"]
    subprocess.run([cc, *strict, "-shared", "-fPIC", "motion.c", "-o", "motion.so", "-lm"], check=True, cwd=tmp_path)
    doubles = ctypes.POINTER(ctypes.c_double)
    function = ctypes.CDLL(str(tmp_path / "motion.so")).acceleration
    function.argtypes, function.restype = [ctypes.c_double, *[doubles] * 5], None

    def acceleration(t, q, v, params, n, m):
        arrays = [np.ascontiguousarray(part, float) for part in (q, v, params)] + [np.zeros(n), np.zeros(m + 1)]
        function(t, *(part.ctypes.data_as(doubles) for part in arrays))
        return arrays[-2], arrays[-1][:m]

    return acceleration


NOTEBOOK_SYSTEMS = {  # by notebook and name: its coordinates
    **{f"01_dissipation_functions.{name}": {"x"} for name in ("sliding", "linear", "drag")},
    "02_vehicle.system": {"x", "y", "phi"},
    "03_constraint_forces.system": {"r", "phi"},
    "03_constraint_forces.free": {"r", "phi"},
    "04_identify_b_c_k.system": {"x", "y", "phi"},
    "05_closed_loops.four_bar": {"alpha", "beta", "gamma"},
    "05_closed_loops.slider_crank": {"alpha", "beta", "s"},
    "05_closed_loops.platform": {"x", "y", "psi"},
    "06_dry_friction.block": {"x"},
    "06_dry_friction.oscillator": {"x"},
    "07_rolling.system": {"psi", "theta", "phi", "x", "y"},
    "08_learn_a_dissipation_function.system": None,  # one number
    "09_many_at_once.system": {"x1", "x2"},
    "10_swinging_pendulum.viscous, air, dry": None,
    "12_comfort_and_grip.vehicle": {"y": 0.0, "phi": 0.0, "wheels": np.zeros(2)},
    "14_damping_that_destabilises.column": {"phi1", "phi2"},
    "17_gyroscope.gyroscope": {"psi", "theta", "phi"},
    "17_gyroscope.racket": {"p": np.zeros(4)},
    "17_gyroscope.wheel": {"x", "y", "z", "psi", "theta", "phi"},
    "23_bearing.rotor": None,
    "23_bearing.pendulum": None,
    "25_hammering_gap.gears": None,
}
RECORDED = {  # driven by a signal without a formula, or by an input that is searched for
    "11_driven_pendulum.pendulum",
    "19_gear_friction.winch",
    "22_experiment.carriage",
    "24_swing_up.cart",
}
IN_CELLS_THAT_SIMULATE = {"19_gear_friction.driven"}  # `test_gears`
WITH_CONTACTS = {  # `test_contact_equations`
    *(f"15_bouncing_rocking_pecking.{name}" for name in ("ball", "block", "woodpecker")),
    *(f"20_backlash.{name}" for name in ("drive", "servo")),
    "21_tosses.block",
}
WITHOUT_INERTIA = {f"16_viscoelastic.{name}" for name in ("mount", "iwan")}  # `test_equations_without_inertia`
OF_A_THOUSAND = {f"18_whip_and_net.{name}" for name in ("rope", "net")}  # whose equations nobody would read
FROM_EXAMPLES = {"13_bicycle"}  # defines no system of its own
SOLVED_BY_NUMBERS = {
    "05_closed_loops.four_bar",
    "05_closed_loops.platform",
    "17_gyroscope.racket",
}  # for their formulas one would wait for minutes

BY_NUMBERS = {"vehicle.first_kind by numbers": "vehicle.first_kind", "pendulum.cartesian by numbers": "pendulum.cartesian"}


def code_of(notebook):
    """The code cells of a notebook."""
    cells = json.loads((NOTEBOOKS / f"{notebook}.ipynb").read_text())["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def of_notebook(name):
    """A system that a notebook defines; cells that simulate, fit or draw are not run."""
    notebook, system = name.split(".")
    names: dict = {}
    with mock.patch.dict(os.environ), contextlib.chdir(NOTEBOOKS):  # tables are read from beside it
        for source in code_of(notebook):
            if not re.search(r"simulate\(|fit\(|subplots\(", source):
                exec(source, names)
            if system in names.get("systems", names):
                break
    q, params = NOTEBOOK_SYSTEMS[name], names["params"]
    small = {"net": NETWORK} if "net" in params else {}
    q = 0.0 if q is None else q if isinstance(q, dict) else dict.fromkeys(sorted(q), 0.0)
    return Case(names.get("systems", names)[system], q, params | small)


def test_every_system_of_a_notebook_is_in_the_table():
    notebooks = [file.stem for file in NOTEBOOKS.glob("*.ipynb")]
    there = {
        f"{notebook}.{name}"
        for notebook in notebooks
        for source in code_of(notebook)
        for name in re.findall(r"(\w+) = jl\.System\(", source)
    }
    table = set(NOTEBOOK_SYSTEMS) | RECORDED | IN_CELLS_THAT_SIMULATE | WITH_CONTACTS | WITHOUT_INERTIA | OF_A_THOUSAND
    assert there <= table and {name.split(".")[0] for name in table} | FROM_EXAMPLES == set(notebooks)


@pytest.mark.parametrize(
    "name", [*EXAMPLES, *BY_NUMBERS, *(pytest.param(name, marks=pytest.mark.slow) for name in (*NOTEBOOK_SYSTEMS, *MORE))]
)
def test_formulas_and_programs_equal_the_simulation_at_random_states(name, tmp_path, monkeypatch):
    name, by_numbers = BY_NUMBERS.get(name, name), name in BY_NUMBERS or name in SOLVED_BY_NUMBERS
    if by_numbers:
        monkeypatch.setattr(linear_solve, "MOST_TERMS", 0)
    case = (EXAMPLES | MORE)[name] if name in EXAMPLES | MORE else of_notebook(name)
    e = jl.equations(case.system, case.q, case.params, multipliers=True)
    plain, structured = states(case, 100)
    qddot, multipliers = simulated(case, *structured)
    numbers = np.concatenate([np.zeros(0), *(np.ravel(leaf) for leaf in jax.tree.leaves(case.params))])
    program: dict = {}
    exec(e.to_python(), program)
    in_c = compiled(e.to_c(), tmp_path)
    ways = {"NumPy": program["acceleration"], "C": lambda t, q, v, _: in_c(t, q, v, numbers, qddot.shape[1], multipliers.shape[1])}
    if name not in MORE and not by_numbers:  # all short enough to have formulas
        parameters = [symbol for array in jax.tree.leaves(e.params) for symbol in np.ravel(array)]
        reactions = [x for name in case.system.constraints for part in jax.tree.leaves(e.multipliers[name]) for x in np.ravel(part)]
        accelerations = [x for part in jax.tree.leaves(e.accelerations) for x in np.ravel(part)]
        lambdified = sympy.lambdify([e.t, e.q, e.qdot, parameters], [accelerations, reactions])
        ways["formulas"] = lambda t, q, v, _: lambdified(t, q, v, numbers)
    for way, function in ways.items():
        got = [function(*state, case.params) for state in zip(*plain, strict=True)]
        for want, part in ((qddot, 0), (multipliers, 1)):
            have = np.array([g[part] for g in got]).reshape(want.shape)
            np.testing.assert_allclose(have, want, rtol=ROUNDING, atol=ROUNDING, err_msg=way)


def test_programs_solve_in_any_units(tmp_path, monkeypatch):
    """A rod pendulum of any mass and size, its rod given twice: q̈ = −g e_y − (v² − g y)/l² q, each half of the force."""
    monkeypatch.setattr(linear_solve, "MOST_TERMS", 0)
    rods = {name: lambda q, l: q @ q - l**2 for name in ("rod", "the same")}
    system = jl.System(lambda q, qdot, m, g: 0.5 * m * qdot @ qdot - m * g * q[1], holonomic=rods)
    e = jl.equations(system, np.array([0.6, -0.8]), {"g": 9.81, "l": 1.0, "m": 1.0}, multipliers=True)
    program: dict = {}
    exec(e.to_python(), program)
    in_c = compiled(e.to_c(), tmp_path)
    for m, l in ((1.0, 1.0), (1e-9, 1.0), (1e-14, 1e-3), (1e-20, 1e4), (1e12, 1e-6)):
        q, v, numbers = l * np.array([0.6, -0.8]), l * np.array([0.8, 0.6]), [9.81, l, m]
        pull = -(v @ v - 9.81 * q[1]) / l**2
        expected = [*(pull * q - [0.0, 9.81]), *[m * pull / 4] * 2]
        for found in (program["acceleration"](0.0, q, v, dict(zip("glm", numbers, strict=True))), in_c(0.0, q, v, numbers, 2, 2)):
            np.testing.assert_allclose(np.concatenate(found), expected, rtol=1e-11)


@pytest.mark.parametrize("name", ["vehicle.first_kind", "pendulum.polar"])
def test_the_second_kind_equals_the_simulation_on_the_constraints(name):
    case = EXAMPLES[name]
    e = jl.equations(case.system, case.q, case.params)
    program: dict = {}
    exec(e.to_python(), program)
    names, params = sorted(case.q), {e.params[name]: sympy.Float(value) for name, value in case.params.items()}
    draw = np.random.default_rng(1).uniform
    rows = []
    for _ in range(20):
        free = dict(zip((*e.q, *e.qdot), draw(0.2, 1.0, 2 * len(e.q)), strict=True))
        rate = lambda h: sum((h.diff(q) * v for q, v in zip(e.q, e.qdot, strict=True)), start=sympy.Integer(0))
        all_q = [e.eliminated.get(sympy.Symbol(name, real=True), sympy.Symbol(name, real=True)) for name in names]
        q, v = ([float(h.xreplace(params).xreplace(free)) for h in part] for part in (all_q, [rate(h) for h in all_q]))
        rows.append((q, v, *program["acceleration"](0.0, [free[x] for x in e.q], [free[x] for x in e.qdot], case.params)))
    q, v, qddot, multipliers = map(np.array, zip(*rows, strict=True))
    structured = [{name: jnp.asarray(part[:, i]) for i, name in enumerate(names)} for part in (q, v)]
    want, reactions = simulated(case, jnp.zeros(20), *structured)
    kept = [names.index(x.name) for x in e.q]
    np.testing.assert_allclose(qddot, want[:, kept], rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_allclose(multipliers, reactions, rtol=ROUNDING, atol=ROUNDING * np.abs(reactions).max())


# Text, pictures, programs.


def test_the_derivation_shows_every_step():
    damped = jl.System(
        lambda q, qdot, m, l, g: 0.5 * m * (l * qdot["phi"]) ** 2 + m * g * l * jnp.cos(q["phi"]),
        dissipation=lambda qdot, b: 0.5 * b * qdot["phi"] ** 2,
        force=lambda M0: {"phi": M0},
    )
    derivation = jl.equations(damped, {"phi"}, {"m", "l", "g", "b", "M0"}).derivation()
    assert str(derivation).splitlines() == [
        "L = ½ m l² φ̇² + m l g cos φ",
        "D = ½ b φ̇²",
        "",
        "∂L/∂φ̇ = m l² φ̇",
        "d/dt ∂L/∂φ̇ = m l² φ̈",
        "∂L/∂φ = −m l g sin φ",
        "∂D/∂φ̇ = b φ̇",
        "Q_φ = M₀",
        "m l² φ̈ + b φ̇ + m l g sin φ = M₀",
    ]
    assert r"\frac{d}{dt} \frac{\partial L}{\partial \dot{\varphi}} &= m l^{2} \ddot{\varphi} \\" in derivation.latex()
    assert derivation._repr_latex_() == f"$${derivation.latex()}$$"
    rolling = str(jl.equations(pendulum.cartesian, {"x", "y"}, {"m", "l", "g"}).derivation())
    assert "(Gᵀλ)_x = λ x/√(x² + y²)" in rolling


def test_latex_is_what_a_report_takes(car):
    assert car.latex() == (
        "\\begin{aligned}\n"
        r"\Theta_{s} \ddot{\varphi} + 2 a^{2} b \dot{\varphi} + 2 a^{2} c \varphi &= 0 \\" + "\n"
        r"\left(M + 2 m + \frac{2 \Theta_{r}}{r^{2}}\right) \ddot{x} "
        r"+ k \left|{\dot{x} + v}\right| \left(\dot{x} + v\right) &= \frac{M_{0}}{r} \\" + "\n"
        r"M \ddot{y} + 2 b \dot{y} + 2 c \left(y - l\right) + M g &= 0" + "\n"
        "\\end{aligned}"
    )
    assert car._repr_latex_() == f"$${car.latex()}$$"


NOTATION = [
    ("x1", "Omega_2", lambda q, p: p * q**2, "Ω₂ x₁²", r"\Omega_{2} x_{1}^{2}"),
    (
        "phi",
        "k",
        lambda q, p: k_(p) / 2 * jnp.sin(q / 2) ** 2,
        "½ k sin²(½ φ)",
        r"\frac{1}{2} k \sin^{2}{\left(\frac{1}{2} \varphi \right)}",
    ),
    ("x", "c", lambda q, p: c_(p) * jnp.sqrt(q**2 + 1) ** 3, "c (x² + 1)^(3/2)", r"c \left(x^{2} + 1\right)^{3/2}"),
    (
        "x",
        "c",
        lambda q, p: 9.81 * p * jnp.exp(-q) + 6.674e-11 * q,
        "6.674e-11 x + 9.81 c exp(−x)",
        r"6.674 \cdot 10^{-11} x + 9.81 c e^{-x}",
    ),
    ("x", "F_max", lambda q, p: p * jnp.where(q > 0, q, 0), "F_max (x if x > 0; 0 otherwise)", r"F_{\mathrm{max}} \left(\begin{cases}"),
    ("x", "p", lambda q, p: p * jnp.abs(q) ** 3 + jnp.arctan(q), "arctan(x) + p |x|³", r"\arctan {x} + p \left|{x}\right|^{3}"),
    ("x", "n", lambda q, p: jnp.abs(q) ** p / p, "|x|^n/n", r"\frac{\left|{x}\right|^{n}}{n}"),
    (
        "phi",
        "k",
        lambda q, p: jnp.cos(q) * p / (q - 1) + jnp.sin(q),
        "sin φ + (k cos φ)/(φ − 1)",
        r"\sin {\varphi} + \frac{k \cos {\varphi}}{\varphi - 1}",
    ),
]
k_ = c_ = lambda p: p


@pytest.mark.parametrize("q, p, potential, text, tex", NOTATION, ids=[case[3] for case in NOTATION])
def test_notation(q, p, potential, text, tex):
    system = jl.System(lambda q, qdot, p: 0.5 * qdot**2 + potential(q, p))
    derivation = jl.equations(system, q, {"p": p}).derivation()
    assert text in str(derivation).splitlines()[0], str(derivation).splitlines()[0]
    assert tex in derivation.latex().splitlines()[1], derivation.latex().splitlines()[1]


def test_the_dots_of_a_word_are_not_those_of_a_letter():
    """In Unicode behind the word, in LaTeX above all of it."""
    system = jl.System(lambda qdot: 0.5 * (qdot["wheel"] ** 2 + qdot["wheel_speed"] ** 2 + qdot["theta_rod"] ** 2 + qdot["x1"] ** 2))
    e = jl.equations(system, {"wheel", "wheel_speed", "theta_rod", "x1"})
    assert str(e).splitlines() == ["θ̈_rod = 0", "wheel¨ = 0", "wheel_speed¨ = 0", "ẍ₁ = 0"]
    assert "∂L/∂wheel_speed˙ = wheel_speed˙" in str(e.derivation()).splitlines()
    assert r"\ddot{\mathrm{wheel}}_{\mathrm{speed}} &= 0" in e.latex() and r"\ddot{\theta}_{\mathrm{rod}}" in e.latex()


def test_what_is_solved_for_has_a_sine_where_a_person_writes_one():
    """The symmetric top, whose precession is A φ̈ sin²θ = …: once it was (cos θ − 1) (cos θ + 1)."""

    def top(q, qdot, A, C, m, g, l):
        spin = qdot["psi"] + qdot["phi"] * jnp.cos(q["theta"])
        tilt = qdot["theta"] ** 2 + (qdot["phi"] * jnp.sin(q["theta"])) ** 2
        return 0.5 * A * tilt + 0.5 * C * spin**2 - m * g * l * jnp.cos(q["theta"])

    e = jl.equations(jl.System(top), {"theta", "phi", "psi"}, {"A", "C", "m", "g", "l"})
    A, C, theta, phidot, psidot, thetadot = (sympy.Symbol(n, real=True) for n in ("A", "C", "theta", "phidot", "psidot", "thetadot"))
    by_hand = thetadot * (C * psidot - (2 * A - C) * phidot * cos(theta)) / (A * sin(theta))
    assert is_zero(e.accelerations["phi"] - by_hand) and not e.accelerations["phi"].has(cos(theta) - 1, cos(theta) + 1)


def test_a_table_is_differentiated_and_programmed(tmp_path):
    """A spring of characteristic F(x) by `jnp.interp`, in the force and in a potential whose slope it is."""
    xs, energies = jnp.array([-1.0, 0.0, 2.0]), jnp.array([3.0, 0.0, 1.0])
    e = jl.equations(jl.System(lambda q, qdot, m: 0.5 * m * qdot**2 - jnp.interp(q, xs, energies)), "x", {"m"})
    assert str(e) == "m ẍ + (0 if x < −1; −3 if x < 0; ½ if x < 2; 0 otherwise) = 0"
    program: dict = {}
    exec(e.to_python(), program)
    in_c = compiled(e.to_c(), tmp_path)
    for x, slope in ((-2.0, 0.0), (-0.5, -3.0), (1.0, 0.5), (3.0, 0.0)):
        assert program["acceleration"](0.0, [x], [0.0], {"m": 2.0})[0][0] == in_c(0.0, [x], [0.0], [2.0], 1, 0)[0][0] == -slope / 2


def test_equations_can_be_drawn(car):
    ax = plot.equations(car)
    ax.figure.canvas.draw()  # mathtext reads the LaTeX when it draws
    assert [text.get_text().strip() for text in ax.texts][2] == r"$M \ddot{y} + 2 b \dot{y} + 2 c \left(y - l\right) + M g = 0$"
    own = ax.figure.add_axes((0, 0, 1, 1))
    assert plot.equations(car, ax=own) is own
    matplotlib.pyplot.close("all")


def test_programs_give_names_that_their_language_allows(tmp_path):
    system = jl.System(
        lambda q, qdot, params: 0.5 * params["lambda"] * qdot**2 - params["sin"] * jnp.cos(q) - params["a b"] * params["double"] * q
    )
    params = {"lambda": 2.0, "sin": 3.0, "a b": 0.5, "double": 4.0}
    e = jl.equations(system, "if", params)
    program: dict = {}
    exec(e.to_python(), program)
    in_c = compiled(e.to_c(), tmp_path)
    want = (3.0 * np.sin(0.4) - 0.5 * 4.0) / 2.0
    np.testing.assert_allclose(program["acceleration"](0.0, [0.4], [0.0], params)[0], [want], rtol=1e-14)
    np.testing.assert_allclose(in_c(0.0, [0.4], [0.0], [0.5, 4.0, 2.0, 3.0], 1, 0)[0], [want], rtol=1e-14)


def test_programs_spell_names_that_are_no_identifiers(tmp_path):
    """A digit first, signs, letters that C does not have, and two names that become one."""
    params = {"1k": 2.0, "k^2": 3.0, "k_2": 0.5, "k²": 4.0, "φ": 0.7, "pi": 1.3}

    def lagrangian(q, qdot, params):
        a, b, c, d, phi, pi = (params[name] for name in ("1k", "k^2", "k_2", "k²", "φ", "pi"))
        return 0.5 * pi * qdot**2 - 0.5 * (a + 2 * b + 3 * c + 5 * d + 7 * phi) * q**2

    e = jl.equations(jl.System(lagrangian), "α", params)
    program: dict = {}
    exec(e.to_python(), program)
    assert e.to_c().isascii()
    want = -(2 + 2 * 3 + 3 * 0.5 + 5 * 4 + 7 * 0.7) * 0.4 / 1.3
    np.testing.assert_allclose(program["acceleration"](0.0, [0.4], [0.0], params)[0], [want], rtol=1e-14)
    in_order = [params[name] for name in sorted(params)]
    np.testing.assert_allclose(compiled(e.to_c(), tmp_path)(0.0, [0.4], [0.0], in_order, 1, 0)[0], [want], rtol=1e-14)


@pytest.mark.parametrize("name", ["pi", "π"])
def test_a_parameter_that_is_called_pi_is_not_read_as_the_number(name):
    system = jl.System(lambda q, qdot, params: 0.5 * params[name] * qdot**2 - 0.5 * jnp.pi * q**2 - params["pi_1"] * q)
    e = jl.equations(system, "x", {name: 1.0, "pi_1": 2.0})
    assert str(e) == "pi ẍ + π x + π₁ = 0"
    assert e.latex().splitlines()[1] == r"\mathrm{pi} \ddot{x} + \pi x + \pi_{1} &= 0"


@jax.custom_jvp
def square(v):
    return v**2


square.defjvp(lambda primals, tangents: (square(*primals), jnp.where(primals[0] < 0, 6, 2) * primals[0] * tangents[0]))


@pytest.mark.parametrize("of", ["q", "qdot"])
def test_a_rule_that_differs_below_zero_is_seen(of):
    """Only there is the derivative that of 3 v²; on paper it is 2 v everywhere."""
    spring, damper = (square if name == of else (lambda v: v**2) for name in ("q", "qdot"))
    system = jl.System(lambda q, qdot, m: 0.5 * m * qdot**2 - spring(q), dissipation=lambda qdot: damper(qdot))
    with pytest.raises(ValueError, match="the equations must agree with the simulation, but f differs"):
        jl.equations(system, "x", {"m": 1.0})


def test_programs_say_what_they_cannot_do():
    digamma = jl.equations(jl.System(lambda q, qdot: 0.5 * qdot**2 + lax.digamma(q)), "x")
    for write in (digamma.to_python, digamma.to_c):
        with pytest.raises(
            ValueError, match="a program must use functions that its language has, but has polygamma. Write the system with others."
        ):
            write()
    rub = lambda qdot, multipliers: jnp.abs(multipliers["rod"]) * qdot[0]
    rod = jl.System(lambda q, qdot: 0.5 * qdot @ qdot - q[1], dissipation=rub, holonomic={"rod": lambda q: q @ q - 1})
    with pytest.raises(ValueError, match="must be linear in the multipliers for a program to solve for them, but they are not"):
        jl.equations(rod, ["x", "y"]).to_python()
    node = lambda q: -0.5 * q["x"] ** 2 - 0.5 * (q["x"] - q["z"]) ** 2  # its rate is z's equation; z̈ is in none
    solid = jl.System(node, dissipation=lambda qdot: 0.5 * qdot["z"] ** 2, holonomic={"grip": lambda q: q["x"] - 1})
    for kept in (False, True):
        on_paper = jl.equations(solid, {"x", "z"}, multipliers=kept)
        for write in (on_paper.to_python, on_paper.to_c):
            with pytest.raises(ValueError, match="accelerations follow from its equations of motion, but that of z does not"):
                write()


# Names and refusals.


class Plane(NamedTuple):
    x: float
    y: float


def test_symbols_are_called_like_the_entries():
    free = lambda q, qdot: sum(0.5 * jnp.sum(v**2) for v in jax.tree.leaves(qdot))
    called = lambda q: [symbol.name for symbol in jl.equations(jl.System(free), q).q]
    assert called(0.0) == ["q"] and called("phi") == ["phi"] and called(np.zeros(2)) == ["q_1", "q_2"] and called([0, 1]) == ["q_1", "q_2"]
    assert called(["alpha", "beta"]) == ["alpha", "beta"] and called({"y", "x"}) == ["x", "y"] and called(Plane(0.0, 0.0)) == ["x", "y"]
    assert called({"wheel": {"phi": 0.0}, "s": (1.0, 2.0)}) == ["s_1", "s_2", "phi_wheel"]
    assert called({"R": np.zeros((2, 2))}) == ["R_11", "R_12", "R_21", "R_22"] and called({"x": "xi"}) == ["xi"]
    assert [v.name for v in jl.equations(jl.System(free), {"x_1": 0.0, "phi2": 0.0}).qddot] == ["phiddot2", "xddot_1"]


def test_parameters_may_be_a_network():
    net = eqx.nn.MLP("scalar", "scalar", 2, 1, activation=jnp.tanh, key=jax.random.key(0))
    e = jl.equations(jl.System(lambda q, qdot, net: 0.5 * qdot**2 - net(q)), "x", {"net": net})
    first, last = e.params["net"].layers
    layer = lambda layer, inputs: list(layer.weight @ inputs + layer.bias)
    (potential,) = layer(last, np.array([sympy.tanh(z) for z in layer(first, np.array([e.q[0]]))]))
    assert is_zero(e.accelerations + potential.diff(e.q[0]))


def test_positive_names_are_taken_as_positive():
    system = jl.System(lambda q, qdot, m, l: 0.5 * m * qdot**2 - jnp.sqrt(l**2) * q)
    assert jl.equations(system, "x", {"m", "l"}, positive="l").f[0] == sympy.Symbol("l", positive=True) * -1
    assert jl.equations(system, "x", {"m", "l"}).f[0] == -Abs(sympy.Symbol("l", real=True))
    with pytest.raises(
        ValueError, match="`positive` must name entries of q or params, or multipliers, but holds 'k'. There are t, x, xdot"
    ):
        jl.equations(system, "x", {"m", "l"}, positive=("k",))


@jax.custom_jvp
def doubled_slope(v):
    return jnp.sin(v)


doubled_slope.defjvp(lambda primals, tangents: (doubled_slope(*primals), 2 * jnp.cos(primals[0]) * tangents[0]))


@pytest.mark.parametrize("potential", [doubled_slope, lambda q: lax.stop_gradient(q) * q], ids=["own rule", "stop_gradient"])
def test_equations_that_differ_from_the_simulation_are_refused(potential):
    system = jl.System(lambda q, qdot: 0.5 * qdot**2 - potential(q))
    with pytest.raises(
        ValueError, match="the equations must agree with the simulation, but f differs: .*Write functions with a derivative rule"
    ):
        jl.equations(system, "x")


def test_example_values_may_be_zero():
    system = jl.System(lambda q, qdot, m, l: 0.5 * m * qdot**2 - m * jnp.log(q / l))
    e = jl.equations(system, 0.0, {"m": 0.0, "l": 0.0})
    assert e.accelerations == -1 / e.q[0]


def test_what_cannot_be_written_is_refused():
    system = jl.System(lambda q, qdot, x: 0.5 * x * qdot["x"] ** 2)
    with pytest.raises(
        ValueError, match="names must differ on paper, but two entries are called 'x'. Hand over names for `q` or `params`."
    ):
        jl.equations(system, {"x": 0.0}, {"x": 1.0})
    assert jl.equations(system, {"x": "s"}, {"x": 1.0}).M[0] == symbols("x", real=True)
    with pytest.raises(ValueError, match="`lagrangian` must return a real scalar"):
        jl.equations(jl.System(lambda qdot: qdot), np.zeros(2))
    with pytest.raises(TypeError, match="must be a real number or array"):
        jl.equations(system, {"x": jnp.sin}, {"x": 1.0})


@pytest.mark.fast
def test_without_sympy_the_rest_works_and_the_extra_is_named():
    code = """
        import sys
        sys.modules["sympy"] = None
        import jaxlag as jl
        system = jl.System(lambda q, qdot: 0.5 * qdot**2 - q)
        assert float(jl.acceleration(system, 0.0, 0.0).qddot) == -1.0
        for ask in (lambda: jl.equations(system, 0.0), lambda: jl.to_sympy(abs, 1.0)):
            try:
                ask()
            except ImportError as error:
                print(error)
    """
    run = subprocess.run([sys.executable, "-c", re.sub("^ {8}", "", code, flags=re.M)], capture_output=True, text=True)
    said = "`{}` must have SymPy, but it cannot be imported. Run `pip install sympy`."
    assert run.stdout.splitlines() == [said.format("equations"), said.format("to_sympy")], run.stderr


def test_importing_the_package_does_not_import_sympy():
    run = subprocess.run([sys.executable, "-c", "import sys, jaxlag; sys.exit('sympy' in sys.modules)"])
    assert run.returncode == 0


def test_multipliers_is_a_switch():
    equations = inspect.unwrap(jl.equations)  # without the hook of these tests, which refuses it before
    with pytest.raises(TypeError, match="`multipliers` must be True or False, but is 'first kind'"):
        equations(examples.vehicle.system, examples.vehicle.q0, examples.vehicle.params, multipliers="first kind")
