"""Combinations of parameters that are determined where the parameters are not: base parameters of robots, by the literature."""

import re

import jax.numpy as jnp
import numpy as np
import oscillator as osc
import pytest
from scipy.integrate import solve_ivp

import jaxlag as jl
from jaxlag._fit import identifiability
from jaxlag._fit.base_parameters import nearby
from jaxlag._fit.rounding import plus_minus
from jaxlag._fit.undetermined import on_undetermined

ARM = {"m1": 0.5, "a1": 0.12, "I1": 0.004, "m2": 0.3, "a2": 0.1, "I2": 0.002, "L1": 0.25}  # kg, m, kg m²
BASE = {  # Gautier & Khalil (1990), for two parallel axes: inertia and first moment of link 2 at its joint, its mass moves to link 1
    "m2 a2": lambda m2, a2, **_: m2 * a2,
    "I2 + m2 a2²": lambda I2, m2, a2, **_: I2 + m2 * a2**2,
    "m1 a1 + m2 L1": lambda m1, a1, m2, L1, **_: m1 * a1 + m2 * L1,
    "I1 + m1 a1² + m2 L1²": lambda I1, m1, a1, m2, L1, **_: I1 + m1 * a1**2 + m2 * L1**2,
    "m2 a2 L1": lambda m2, a2, L1, **_: m2 * a2 * L1,
}
TS = np.linspace(0.0, 2.0, 201)
TORQUES = {"Tu": 0.3 * np.sin(2.1 * TS) + 0.2 * np.sin(5.3 * TS), "Tw": 0.08 * np.sin(3.3 * TS + 1) + 0.05 * np.sin(7 * TS)}


def lagrangian(q, qdot, m1, a1, I1, m2, a2, I2, L1, g):
    kinetic = 0.5 * (I1 + m1 * a1**2 + m2 * L1**2) * qdot["u"] ** 2 + 0.5 * (I2 + m2 * a2**2) * qdot["w"] ** 2
    coupled = m2 * L1 * a2 * jnp.cos(q["u"] - q["w"]) * qdot["u"] * qdot["w"]
    return kinetic + coupled + g * ((m1 * a1 + m2 * L1) * jnp.cos(q["u"]) + m2 * a2 * jnp.cos(q["w"]))


DRIVEN = jl.System(lagrangian, force=lambda t, Tu, Tw: {"u": Tu(t), "w": Tw(t)})


def recorded(g, mass=1.0, length=1.0):
    """Angles of a driven double pendulum, by SciPy, with noise; and its parameters, where units are so many times as small."""
    m1, a1, I1, m2, a2, I2, L1 = ARM.values()
    c = m2 * L1 * a2

    def rate(t, s):
        u, w, du, dw = s
        M = [[I1 + m1 * a1**2 + m2 * L1**2, c * np.cos(u - w)], [c * np.cos(u - w), I2 + m2 * a2**2]]
        load = [-c * np.sin(u - w) * dw**2 - g * (m1 * a1 + m2 * L1) * np.sin(u), c * np.sin(u - w) * du**2 - g * m2 * a2 * np.sin(w)]
        return [du, dw, *np.linalg.solve(M, np.add(load, [np.interp(t, TS, torque) for torque in TORQUES.values()]))]

    angles = solve_ivp(rate, (0, 2), [0.5, -0.4, 0, 0], t_eval=TS, rtol=1e-10, atol=1e-12, max_step=0.01).y[:2]
    angles = angles + 1e-3 * np.random.default_rng(0).standard_normal(angles.shape)
    units = {"m": mass, "a": length, "I": mass * length**2, "L": length}
    truth = {name: value * units[name[0]] for name, value in ARM.items()}
    inputs = {n: jl.Signal(TS, mass * length**2 * torque, jl.interpolation.Linear()) for n, torque in TORQUES.items()}
    record = jl.Experiment(TS, dict(zip("uw", angles, strict=True)), {"u": 0.5, "w": -0.4}, {"u": 0.0, "w": 0.0})
    return record, truth | {"g": g * length} | inputs


def estimates_in(remark):
    """{formula: (value, error)} of a remark."""
    between = re.search("only (.*) (?:is|are) determined; ", remark)[1]
    found = [re.fullmatch(r"(.*) = (\S+) ± (\S+)", part) for part in re.split(r", | and ", between)]
    return {match[1]: (float(match[2]), float(match[3])) for match in found}


def check(remark, expected, truth, sharp=0.02):
    """The formulas, their values within three standard errors, which are small."""
    found = estimates_in(remark)
    assert {*found} == {*expected}, remark
    numbers = {name: truth[name] for name in ARM}
    for formula, (value, error) in found.items():
        assert abs(value - BASE[formula](**numbers)) < 3.5 * error < sharp * value, (formula, value, error)


ALL_BUT_COUPLING = [*BASE][:4]
WITHOUT_GRAVITY = ["m2 a2 L1", "I2 + m2 a2²", "I1 + m1 a1² + m2 L1²"]


@pytest.mark.slow
def test_a_fit_of_a_double_pendulum_names_its_base_parameters():
    """All of seven parameters are free; L₁ = m₂ a₂ L₁ / (m₂ a₂) is determined, and nothing is said about it twice."""
    record, truth = recorded(9.81)
    found = jl.fit(DRIVEN, record, truth | {name: 1.1 * truth[name] for name in ARM}, free=tuple(ARM))
    (remark,) = found.remarks
    check(remark, ALL_BUT_COUPLING, truth, 1e-3)
    assert remark.endswith("; m1, a1, I1, m2, a2 and I2 individually are not") and f"! {remark}" in repr(found)
    assert {name for name in ARM if np.isfinite(found.standard_errors[name])} == {"L1"}


@pytest.mark.parametrize("mass, length", [(1.0, 1.0), (1e-3, 1e3)], ids=["kg m", "t mm"])
def test_a_regression_of_a_double_pendulum_names_its_base_parameters(mass, length):
    record, truth = recorded(9.81, mass, length)
    found = jl.regress(DRIVEN, record, truth | {name: 1.1 * truth[name] for name in ARM}, free=tuple(ARM))
    (remark,) = found.remarks
    check(remark, ALL_BUT_COUPLING, truth)
    assert f"! {remark}" in repr(found) and np.isfinite(found.standard_errors["L1"])


def test_a_planar_arm_without_gravity():
    """First moments do not show: three base parameters are left, and none of seven parameters is determined."""
    record, truth = recorded(0.0)
    found = jl.regress(DRIVEN, record, truth | {name: 1.1 * truth[name] for name in ARM}, free=tuple(ARM))
    (remark,) = found.remarks
    check(remark, WITHOUT_GRAVITY, truth)
    assert all(np.isinf(found.standard_errors[name]) for name in ARM)


@pytest.mark.slow
def test_a_known_length_is_a_number_in_the_formula():
    record, truth = recorded(9.81)
    free = tuple(ARM)[:-1]
    found = jl.fit(DRIVEN, record, truth | {name: 1.1 * truth[name] for name in free}, free=free)
    (remark,) = found.remarks
    (value, error) = estimates_in(remark)["I1 + m1 a1² + 0.0625 m2"]
    assert {*estimates_in(remark)} == {"m2 a2", "m1 a1 + 1/4 m2", "I2 + m2 a2²", "I1 + m1 a1² + 0.0625 m2"}
    assert abs(value - BASE["I1 + m1 a1² + m2 L1²"](**ARM)) < 3.5 * error < 1e-3 * value


def test_what_is_determined_is_not_remarked():
    record, truth = recorded(9.81)
    free = ("m1", "I2", "L1")
    assert jl.regress(DRIVEN, record, truth | {name: 1.1 * truth[name] for name in free}, free=free).remarks == []


SPRINGS = jl.System(lambda q, qdot, m, c1, c2: 0.5 * m * qdot**2 - 0.5 * (c1 + c2) * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2)


@pytest.mark.slow
def test_the_sum_of_two_springs_has_the_error_of_one():
    one = jl.fit(osc.SYSTEM, osc.record(0), osc.START, free=("c", "b"))
    two = jl.fit(SPRINGS, osc.record(0), {"m": 1.0, "c1": 1.0, "c2": 2.0, "b": 0.6}, free=("c1", "c2", "b"))
    stiffness = plus_minus(float(one.estimates["c"]), float(one.standard_errors["c"]))
    assert two.remarks == [f"only c1 + c2 = {stiffness} is determined; c1 and c2 individually are not"]
    by_regression = jl.regress(SPRINGS, osc.record(0), {"m": 1.0, "c1": 1.0, "c2": 2.0, "b": 0.6}, free=("c1", "c2", "b"))
    c = jl.regress(osc.SYSTEM, osc.record(0), osc.START, free=("c", "b"))
    (said,) = by_regression.remarks
    value, error = estimates_in(said)["c1 + c2"]
    np.testing.assert_allclose([value, error], [c.estimates["c"], c.standard_errors["c"]], rtol=0.05)


# --- the algebra, in closed form


def gradients(functions, theta):
    """By complex steps."""
    return np.array([functions(*(theta + 1e-30j * theta * e)) for e in np.eye(theta.size)]).imag.T / (1e-30 * theta)


def undetermined(functions, theta, seen=None):
    """What is found where measurements determine these functions of the parameters."""

    def place(theta):
        G = gradients(functions, theta) * theta
        G = G / np.linalg.norm(G, axis=1, keepdims=True)
        return theta, np.linalg.svd(G)[2][np.linalg.matrix_rank(G, 1e-9) :].T * theta[:, None]

    def places():
        for near in (theta, *nearby(theta, np.full(theta.size, -np.inf), np.full(theta.size, np.inf))):
            if seen is not None:
                seen.append(near)
            yield place(near)

    alone = np.all(np.abs(place(theta)[1] / theta[:, None]) < 1e-9, axis=1)
    return identifiability.undetermined(places(), np.flatnonzero(alone).tolist())


def formulas(names, functions, theta):
    found = undetermined(functions, theta)
    remarks = on_undetermined(names, found, [(np.nan, np.nan)] * len(found.combinations), {})
    return [re.sub("only (.*) (?:is|are) determined; .*", r"\1", remark) for remark in remarks]


THREE_LINKS = ("m1", "a1", "I1", "m2", "a2", "I2", "m3", "a3", "I3", "L1", "L2")


def three_links(m1, a1, I1, m2, a2, I2, m3, a3, I3, L1, L2):
    inertias = [I1 + m1 * a1**2 + (m2 + m3) * L1**2, I2 + m2 * a2**2 + m3 * L2**2, I3 + m3 * a3**2]
    return [*inertias, m1 * a1 + (m2 + m3) * L1, m2 * a2 + m3 * L2, m3 * a3, L1, L2]


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e-9])
@pytest.mark.slow
def test_three_links_in_any_unit(unit):
    """Gautier & Khalil: the mass of each link is added to the inertia and the first moment of the one before."""
    theta = np.random.default_rng(1).uniform(0.3, 2.0, 11) * np.array([1, unit, unit**2] * 3 + [unit] * 2)
    (found,) = formulas(THREE_LINKS, three_links, theta)
    moments = "m3 a3, m2 a2 + m3 L2, I3 + m3 a3², m1 a1 + m2 L1 + m3 L1"
    assert found == f"{moments}, I2 + m2 a2² + m3 L2² and I1 + m1 a1² + m2 L1² + m3 L1²"


@pytest.mark.parametrize(
    "functions, expected",
    [
        (lambda a, b, c, d: [a + b / 3, c * d], ["a + 1/3 b", "c d"]),
        (lambda a, b, c, d: [a / b, c + 2 * d], ["a/b", "c + 2 d"]),
        (lambda a, b, c, d: [a * b**2 / 12 + c + d], ["a b² + 12 c + 12 d"]),
        (lambda a, b, c, d: [a * b - c * d], ["a b - c d"]),
        (lambda a, b, c, d: [a * b + 9.81 * c + d], ["d + a b + 9.81 c"]),
        (lambda a, b, c, d: [np.exp(a * b + c), d * c], ["c d and c + a b"]),
        (lambda a, b, c, d: [a**3 / c, d**2 * b**3], ["a/c^(1/3)", "b d^(2/3)"]),
    ],
)
def test_formulas(functions, expected):
    """Independent groups have a sentence each."""
    assert formulas(tuple("abcd"), functions, np.array([2.0, 0.7, 1.3, 0.9])) == expected


@pytest.mark.parametrize("inertia", [0.5, 1e-4])
def test_small_terms_are_not_lost(inertia):
    """I is a ten thousandth of m a²; approximations by other polynomials are as good as that."""
    theta = np.array([inertia * 0.7 * 0.3**2, 0.7, 0.3])
    assert formulas(tuple("Ima"), lambda inertia, m, a: [inertia + m * a**2, m * a], theta) == ["m a and I + m a²"]


def test_what_is_no_polynomial_is_a_direction():
    """The ratio of two sums; and few points are asked for where that suffices."""
    names, theta = tuple("abcd"), np.array([2.0, 0.7, 1.3, 0.9])
    (said,) = formulas(names, lambda a, b, c, d: [(a + b) / (c + d), a + np.sin(b)], theta)
    assert said.startswith("a, b, c and d are not determined individually")
    seen = []
    undetermined(lambda a, b, c, d: [a + b, c + d, a + c], theta, seen=seen)
    assert len(seen) <= 8


@pytest.mark.parametrize("seed", range(12))
def test_random_polynomials_span_the_same_gradients(seed):
    """Polynomials with random monomials, composed with functions that hide them."""
    rng = np.random.default_rng(seed)
    p, count = 6, int(rng.integers(2, 5))
    degrees, terms = rng.integers(1, 4, count), rng.integers(1, 4, count)
    exponents = [rng.multinomial(d, np.ones(p) / p, size=n) for d, n in zip(degrees, terms, strict=True)]
    mixing = rng.standard_normal((count, count)) + 3 * np.eye(count)

    def functions(*theta):
        base = mixing @ np.array([np.sum(np.prod(np.array(theta) ** e, axis=1)) for e in exponents])
        return np.tanh(0.02 * base) + 0.1 * base

    theta = rng.uniform(0.5, 1.5, p)
    found = undetermined(functions, theta)
    G = gradients(functions, theta)
    joint = sorted(i for group in found.groups for i in group.joint)
    for combination in found.combinations:  # none is wrong
        g = combination.gradient(theta)
        assert np.linalg.norm(g - G.T @ np.linalg.lstsq(G.T, g)[0]) < 1e-8 * np.linalg.norm(g), combination
    for group in found.groups:  # and none is missing
        if group.combinations:
            assert len(group.combinations) == len(group.joint) - group.directions.shape[1]
    complete = [group for group in found.groups if group.combinations or group.directions.shape[1] == len(group.joint)]
    assert len(complete) == len(found.groups), (joint, exponents)
