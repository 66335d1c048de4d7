"""A, B, C and D against algebra by hand and against SciPy; what is refused. Motions beside examples: `test_linearise_examples`."""

import functools

import jax
import jax.numpy as jnp
import linear_by_hand as by_hand
import numpy as np
import pytest
from linear_by_hand import FULL
from scipy import signal
from spectra import assert_same_spectrum

import jaxlag as jl
from jaxlag.examples import pendulum, vehicle

g = 9.81


# The matrices and their names


def test_the_names_of_states_and_the_basis():
    linear = jl.linearise(pendulum.cartesian, {"x": 0.0, "y": -1.0}, params=pendulum.params)
    assert linear.state_names == ("x", "x_dot")
    np.testing.assert_allclose(linear.basis, [[1, 0], [0, 0], [0, 1], [0, 0]], atol=1e-15)  # x, y, ẋ, ẏ
    np.testing.assert_allclose(linear.A, [[0, 1], [-g, 0]], rtol=1e-12)
    assert linear.output_names == ("x", "y") and linear.input_names == ()
    np.testing.assert_allclose(linear.C, [[1, 0], [0, 0]], atol=1e-15)


def test_the_preferred_coordinate_is_independent():
    angle, p = 0.3, pendulum.params
    q, qdot = pendulum.cartesian_state(angle, 0.0, p["l"])
    for name in "xy":
        linear = jl.linearise(pendulum.cartesian, q, qdot, p, independent=(name,), frozen=True)
        assert linear.state_names == (name, f"{name}_dot")
        tangent = {"x": [1, np.tan(angle)], "y": [1 / np.tan(angle), 1]}[name]
        np.testing.assert_allclose(linear.basis[:2, 0], tangent, rtol=1e-12)
    held = jl.linearise(pendulum.cartesian, {"x": 0.0, "y": -1.0}, params=p, independent=("y",))  # y cannot move at all
    assert held.state_names == ("x", "x_dot")


def test_along_a_trajectory_all_arrays_have_its_samples():
    """φ̈ = −(g/l) cos φ δφ."""
    angles = jl.System(lambda q, qdot, l: 0.5 * (l * qdot["phi"]) ** 2 + g * l * jnp.cos(q["phi"]))
    ts, l = np.linspace(0.0, 2.0, 9), 0.7
    motion = jl.simulate(angles, {"phi": 2.0}, {"phi": 0.5}, ts, {"l": l})
    linear = jl.linearise(angles, motion, params={"l": l})
    expected = np.zeros((9, 2, 2))
    expected[:, 0, 1], expected[:, 1, 0] = 1, -g / l * np.cos(motion.q["phi"])
    np.testing.assert_allclose(linear.A, expected, rtol=1e-12, atol=1e-12)
    assert linear.eigenvalues.shape == (9, 2)
    middle = jl.linearise(angles, {"phi": 2.0}, {"phi": 0.5}, {"l": l}, frozen=True)
    np.testing.assert_allclose(middle.A, expected[0], rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_along_a_trajectory_in_discrete_time_and_one_by_one_for_others():
    """A pendulum at its samples: exp(A T), with ω² = g cos φ/l of either sign; another package takes one of the systems."""
    angles = jl.System(lambda q, qdot, l: 0.5 * (l * qdot["phi"]) ** 2 + g * l * jnp.cos(q["phi"]))
    motion = jl.simulate(angles, {"phi": 2.0}, {"phi": 0.5}, np.linspace(0.0, 2.0, 9), {"l": 0.7})
    linear = jl.linearise(angles, motion, params={"l": 0.7}, inputs=["phi"])
    discrete = linear.discrete(0.05)
    expected = [signal.cont2discrete((A, B, C, D), 0.05) for A, B, C, D in zip(linear.A, linear.B, linear.C, linear.D, strict=True)]
    np.testing.assert_allclose(discrete.A, [A for A, *_ in expected], rtol=1e-12)
    np.testing.assert_allclose(discrete.B, [B for _, B, *_ in expected], rtol=1e-12)
    eigenvalues = [np.sort_complex(modes.eigenvalues) for modes in (discrete.modes(), linear.modes())]
    np.testing.assert_allclose(*eigenvalues, rtol=1e-9, atol=1e-9)
    with pytest.raises(ValueError, match="a response or state space is that of one linear system, but these are many"):
        discrete.to_scipy()


# Inputs: what can be moved

OSCILLATOR = {"m": 2.0, "b": 3.0, "c": 50.0}


def oscillator_terms():
    return {
        "lagrangian": lambda q, qdot, m, c: 0.5 * m * qdot["x"] ** 2 - 0.5 * c * q["x"] ** 2,
        "dissipation": lambda qdot, b: 0.5 * b * qdot["x"] ** 2,
    }


DRIVEN = jl.System(**oscillator_terms(), force={"motor": lambda u, K: {"x": K * u(0.0) if callable(u) else K * u}})
OMEGA = np.array([0.0, 0.5, 4.0, 5.0, 30.0])
S = 1j * OMEGA
OWN = OSCILLATOR["m"] * S**2 + OSCILLATOR["b"] * S + OSCILLATOR["c"]


@pytest.mark.parametrize(
    "name, gain",
    [("u", 1.7), ("K", 0.3), ("x", 1.0), ("motor", 1.7 * 0.3), ("c", -(1.7 * 0.3) / OSCILLATOR["c"]), ("b", 0.0), ("m", 0.0)],
)
def test_inputs_of_an_oscillator(name, gain):
    """u(t) and its gain, a force on the coordinate, the motor's force by 1 + w, and c, b, m, which change c x, b ẋ, m ẍ."""
    p = OSCILLATOR | {"K": 1.7, "u": 0.3}
    at = jl.equilibrium(DRIVEN, {"x": 0.0}, p)
    linear = jl.linearise(DRIVEN, at, params=p, inputs=(name,))
    np.testing.assert_allclose(linear.frequency_response(OMEGA)[:, 0, 0], gain / OWN, rtol=1e-10, atol=1e-13)
    np.testing.assert_array_equal(linear.D_rates, np.zeros((2, 1, 1)))


@pytest.mark.parametrize("interpolation", [jl.interpolation.ZeroOrderHold(), jl.interpolation.Linear(), jl.interpolation.Cubic()])
def test_a_signal_as_input(interpolation):
    """Its value moves, whatever lies between its samples."""
    system = jl.System(**oscillator_terms(), force=lambda t, u: {"x": u(t)})
    p = OSCILLATOR | {"u": jl.Signal([0.0, 1.0, 2.0, 3.0], np.zeros(4), interpolation)}
    linear = jl.linearise(system, {"x": 0.0}, params=p, inputs=("u",), t=1.5)
    np.testing.assert_allclose(linear.B, [[0], [1 / OSCILLATOR["m"]]], rtol=1e-12)


def carried(q, qdot, m, m0, c):
    """A mass on a spring above a base that is moved."""
    return 0.5 * m * qdot["x"] ** 2 + 0.5 * m0 * qdot["base"] ** 2 - 0.5 * c * (q["x"] - q["base"]) ** 2


def strut(qdot, b):
    return 0.5 * b * (qdot["x"] - qdot["base"]) ** 2


def seen(q, qdot, qddot, multipliers, m):
    return {"x": q["x"], "xdot": qdot["x"], "xddot": qddot["x"], "force": multipliers["support"], "base": q["base"]}


CARRIED = OSCILLATOR | {"m0": 0.7}
REST_CARRIED = {"x": 0.0, "base": 0.0}
TRANSMITTED = (OSCILLATOR["b"] * S + OSCILLATOR["c"]) / OWN  # x over the place of the base
EXPECTED = {
    "x": TRANSMITTED,
    "xdot": S * TRANSMITTED,
    "xddot": S**2 * TRANSMITTED,
    "force": CARRIED["m0"] * S**2 + OSCILLATOR["m"] * S**2 * TRANSMITTED,  # what moves both masses
    "base": 1 + 0 * S,
}
SUPPORTS = {
    "the constraint": (lambda q: q["base"], {}, "support"),
    "a number": (lambda q, h: q["base"] - h, {"h": 0.0}, "h"),
    "a cubic signal": (lambda t, q, h: q["base"] - h(t), {"h": jl.Signal(np.arange(4.0), np.zeros(4), jl.interpolation.Cubic())}, "h"),
}


@pytest.mark.parametrize("support, more, name", SUPPORTS.values(), ids=SUPPORTS)
def test_a_base_that_is_moved(support, more, name):
    """By its place: velocity and acceleration of the base count in the motion and in the force that moves it."""
    system = jl.System(carried, dissipation=strut, holonomic={"support": support})
    linear = jl.linearise(system, REST_CARRIED, params=CARRIED | more, inputs=(name,), outputs=seen, t=1.5)
    assert linear.A.shape == (2, 2) and sorted(linear.output_names) == sorted(EXPECTED)
    response = dict(zip(linear.output_names, np.asarray(linear.frequency_response(OMEGA))[:, :, 0].T, strict=True))
    for output, expected in EXPECTED.items():
        np.testing.assert_allclose(response[output], expected, rtol=1e-10, atol=1e-10, err_msg=output)


def test_a_belt_that_is_moved_by_its_speed():
    """A nonholonomic constraint, ẋ_base = u: once less integrated."""
    system = jl.System(carried, dissipation=strut, nonholonomic={"support": lambda qdot: qdot["base"]})
    linear = jl.linearise(system, REST_CARRIED, params=CARRIED, inputs=("support",), outputs=seen)
    response = dict(zip(linear.output_names, np.asarray(linear.frequency_response(OMEGA[1:]))[:, :, 0].T, strict=True))
    for output, expected in EXPECTED.items():
        np.testing.assert_allclose(response[output], expected[1:] / S[1:], rtol=1e-10, atol=1e-10, err_msg=output)


@pytest.mark.slow
def test_derivatives_of_a_frequency_response():
    """Of the size of x over the base at ω = 4, by b and c."""
    system = jl.System(carried, dissipation=strut, holonomic={"support": lambda q: q["base"]})

    def size(b, c):
        linear = jl.linearise(system, REST_CARRIED, params=CARRIED | {"b": b, "c": c}, inputs=("support",), outputs=lambda q: q["x"])
        return jnp.abs(linear.frequency_response(np.array([4.0]))[0, 0, 0])

    closed = lambda b, c: np.abs((4j * b + c) / (c - 16 * OSCILLATOR["m"] + 4j * b))
    b, c = OSCILLATOR["b"], OSCILLATOR["c"]
    np.testing.assert_allclose(size(b, c), closed(b, c), rtol=1e-12)
    found = jax.grad(size, argnums=(0, 1))(b, c)
    expected = by_hand.central(lambda b: closed(b, c), b, 1e-2), by_hand.central(lambda c: closed(b, c), c, 1e-2)
    np.testing.assert_allclose(found, expected, rtol=1e-8)


# Controllers that act at sample times

PLANT = {"m": 2.0, "b": 3.0}
GAINS = {"kp": 900.0, "kd": 40.0, "period": 0.01}


def sampled_pd(system_force=lambda u: u):
    pd = jl.Sampled(lambda q, qdot, kp, kd: -kp * q - kd * qdot, every=lambda period: period)
    return jl.System(lambda qdot, m: 0.5 * m * qdot**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2, force=system_force, states={"u": pd})


def held_plant(m, b, period):
    A, B = np.array([[0, 1], [0, -b / m]]), np.array([[0], [1 / m]])
    return signal.cont2discrete((A, B, np.eye(2), np.zeros((2, 1))), period)[:2]


@pytest.mark.slow
def test_a_controller_that_samples():
    """Eigenvalues of the plant with the held command, closed by the gains; the command itself has no memory."""
    Ad, Bd = held_plant(**PLANT, period=GAINS["period"])
    linear = jl.linearise(sampled_pd(), 0.0, params=PLANT | GAINS)
    assert linear.sample_time == GAINS["period"]
    closed = np.linalg.eigvals(Ad - Bd @ [[GAINS["kp"], GAINS["kd"]]])
    assert_same_spectrum(linear.eigenvalues, [*closed, 0.0], rtol=1e-10, atol=1e-12)
    modes = linear.modes()
    s = np.log(closed[np.imag(closed) > 0][0]) / GAINS["period"]
    shaking = np.imag(modes.eigenvalues) > 0
    np.testing.assert_allclose(np.asarray(modes.damping_ratio)[shaking], [-s.real / abs(s)], rtol=1e-9)
    np.testing.assert_allclose(np.asarray(modes.angular_frequency)[shaking], [abs(s)], rtol=1e-9)


@pytest.mark.slow
def test_a_controller_with_too_large_a_gain_is_unstable():
    """A pole on the circle at −1: where det(Ad − Bd K + 1) = 0, by SciPy."""
    Ad, Bd = held_plant(**PLANT, period=GAINS["period"])
    edge = np.linalg.det(Ad + np.eye(2)) / (np.linalg.det(Ad + np.eye(2)) - np.linalg.det(Ad + np.eye(2) - Bd @ [[0.0, 1.0]]))
    for ratio, stable in ((0.999, True), (1.001, False)):
        modes = jl.linearise(sampled_pd(), 0.0, params=PLANT | GAINS | {"kp": 0.0, "kd": ratio * edge}).modes()
        assert np.all(modes.stable) == stable


def test_periods_that_are_computed_in_two_ways_are_one():
    """0.1 · 0.1 is the next number but one after 0.01; u pushes, and w remembers the u before."""
    states = lambda every: {"u": jl.Sampled(lambda q: -q, every=0.01, start=0.0), "w": jl.Sampled(lambda u: u, every=every, start=0.0)}
    carts = [jl.System(lambda qdot: 0.5 * qdot**2, force=lambda u: u, states=states(every)) for every in (0.1 * 0.1, 0.01 * (1 + 1e-9))]
    near = jl.linearise(carts[0], 0.0)
    force, memory = [-1, 0, 0, 0], [0, 0, 1, 0]
    np.testing.assert_allclose(near.A, [[1 - 0.5e-4, 0.01, 0, 0], [-0.01, 1, 0, 0], force, memory], rtol=1e-12, atol=1e-15)
    with pytest.raises(ValueError, match="but has periods of 0.01, 0.01000000001"):
        jl.linearise(carts[1], 0.0)


@pytest.mark.slow
def test_along_a_motion_with_a_controller():
    """u⁺ = −9 sin q − 3 q̇, held by a unit mass: the row of u is −(9 cos q, 3, 0)."""
    controller = jl.Sampled(lambda q, qdot: -9.0 * jnp.sin(q) - 3.0 * qdot, every=0.1, start=0.0)
    cart = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda u: u, states={"u": controller})
    motion = jl.simulate(cart, 1.0, 0.0, np.linspace(0.0, 1.0, 6))
    linear, q = jl.linearise(cart, motion), np.asarray(motion.q)
    row = np.stack([-9 * np.cos(q), np.full(6, -3.0), np.zeros(6)], axis=1)
    held = np.array([[1, 0.1, 0], [0, 1, 0]]) + np.array([[0.005], [0.1]]) * row[:, None]
    np.testing.assert_allclose(linear.A, np.concatenate([held, row[:, None]], axis=1), rtol=1e-10, atol=1e-12)
    assert linear.modes().eigenvalues.shape == (6, 3)


@pytest.mark.slow
def test_derivatives_by_the_sample_time():
    def radius(period):
        return jnp.max(jnp.abs(jl.linearise(sampled_pd(), 0.0, params=PLANT | GAINS | {"period": period}).eigenvalues))

    def expected(period):
        Ad, Bd = held_plant(**PLANT, period=period)
        return np.max(np.abs(np.linalg.eigvals(Ad - Bd @ [[GAINS["kp"], GAINS["kd"]]])))

    np.testing.assert_allclose(jax.grad(radius)(GAINS["period"]), by_hand.central(expected, GAINS["period"], 1e-4), rtol=1e-7)


# Responses of a system with full matrices, against SciPy


@functools.cache
def full():
    """From two forces to the first coordinate, its velocity and the acceleration of the third."""
    outputs = lambda q, qdot, qddot: jnp.stack([q[0], qdot[0], qddot[2]])
    return by_hand.linearised(FULL, inputs=("u[0]", "u[1]"), outputs=outputs)


@functools.cache
def full_in_scipy():
    A = by_hand.first_order(**FULL)
    B = np.vstack([np.zeros((3, 2)), np.linalg.solve(FULL["M"], np.eye(3, 2))])
    C, D = np.vstack([np.eye(1, 6), np.eye(1, 6, 3), A[5:]]), np.vstack([np.zeros((2, 2)), B[5:]])
    return signal.StateSpace(A, B, C, D)


RATES = np.array([0.0, 0.3, 1.0, 3.0, 10.0])
TIMES = np.linspace(0.0, 3.0, 61)


def expected_response(omega=RATES):
    A, B, C, D = (getattr(full_in_scipy(), name) for name in "ABCD")
    return np.stack([C @ np.linalg.solve(1j * w * np.eye(6) - A, B) + D for w in omega])


def test_the_matrices():
    for name in "ABCD":
        np.testing.assert_allclose(getattr(full(), name), getattr(full_in_scipy(), name), rtol=1e-11, atol=1e-11, err_msg=name)
    assert full().input_names == ("u[0]", "u[1]")


def test_the_frequency_response():
    np.testing.assert_allclose(full().frequency_response(RATES), expected_response(), rtol=1e-10, atol=1e-12)


def test_magnitude_and_phase():
    """The phase goes on where an angle would jump."""
    omega = np.geomspace(0.05, 50.0, 400)
    magnitude, phase = full().bode(omega)
    expected = expected_response(omega)
    np.testing.assert_allclose(magnitude, np.abs(expected), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * np.deg2rad(phase)), expected / np.abs(expected), rtol=0, atol=1e-9)
    assert np.abs(np.diff(phase, axis=0)).max() < 90


@pytest.mark.parametrize("kind", ["step", "impulse"])
def test_step_and_impulse_response(kind):
    found = getattr(full(), f"{kind}_response")(TIMES)
    assert found.shape == (TIMES.size, 3, 2)
    A, B, C, D = (getattr(full_in_scipy(), name) for name in "ABCD")
    for j in (0, 1):
        one = signal.StateSpace(A, B[:, j : j + 1], C, D[:, j : j + 1])
        _, expected = getattr(signal, kind)(one, T=TIMES)
        rows = slice(0, 2) if kind == "impulse" else slice(0, 3)  # an impulse at once is no number: the rest is compared
        np.testing.assert_allclose(np.asarray(found)[:, rows, j], expected[:, rows], rtol=0, atol=1e-9)


def test_transfer_zeros():
    """Of one force and one place: those of SciPy's numerator. Of two of each: where the matrix of the system is singular."""
    one = by_hand.linearised(FULL, inputs=("u[0]",), outputs=lambda q: q[0])
    A, B = full_in_scipy().A, full_in_scipy().B
    numerator, _ = signal.ss2tf(A, B[:, :1], np.eye(1, 6), np.zeros((1, 1)))
    assert_same_spectrum(one.transfer_zeros(), np.roots(np.where(np.abs(numerator[0]) > 1e-9, numerator[0], 0)), rtol=1e-7)
    two = by_hand.linearised(FULL, inputs=("u[0]", "u[1]"), outputs=lambda q: q[1:])
    free = np.asarray(two.transfer_zeros())
    for s in free:
        system = np.block([[A - s * np.eye(6), B], [np.eye(2, 6, 1), np.zeros((2, 2))]])
        assert np.linalg.svd(system, compute_uv=False)[-1] < 1e-9
    # with q₁ = q₂ = 0 and no force on the third coordinate, only q₀ moves: (M s² + (C + G) s + K + N)₂₀ = 0
    stiffness = lambda s: s**2 * FULL["M"] + s * (FULL["C"] + FULL["G"]) + FULL["K"] + FULL["N"]
    corner = lambda s: stiffness(s)[2, 0]
    coefficients = np.polyfit([0.0, 1.0, 2.0], [corner(0.0), corner(1.0), corner(2.0)], 2)
    assert_same_spectrum(free, np.roots(coefficients), rtol=1e-8)


def test_the_spectrum_of_outputs_under_noise():
    """H S Hᴴ; with one density for all, of two independent inputs, and with a matrix for each frequency."""
    H = expected_response()
    draw = np.random.default_rng(2)
    roots = draw.normal(size=(RATES.size, 2, 2)) + 1j * draw.normal(size=(RATES.size, 2, 2))
    hermitian = roots @ np.conj(np.swapaxes(roots, 1, 2))
    for density, S in ((np.diag([2.0, 0.5]), np.diag([2.0, 0.5])), (hermitian, hermitian)):
        expected = H @ S @ np.conj(np.swapaxes(H, 1, 2))
        np.testing.assert_allclose(full().power_spectrum(RATES, density), expected, rtol=1e-9, atol=1e-11)


def test_an_oscillator_under_white_noise_has_the_variance_of_the_textbook():
    """∫ S/(2π) dω = S₀/(2 b c) over all frequencies, positive and negative."""
    p = OSCILLATOR | {"K": 1.0, "u": 0.0}
    linear = jl.linearise(DRIVEN, {"x": 0.0}, params=p, inputs=("u",))
    omega = 5 * np.tan(np.linspace(0, np.pi / 2, 20002)[:-1])  # to infinity, almost
    spectrum = np.real(linear.power_spectrum(omega, np.array([[0.3]])))[:, 0, 0]
    variance = 2 * np.trapezoid(spectrum, omega) / (2 * np.pi)
    np.testing.assert_allclose(variance, 0.3 / (2 * p["b"] * p["c"]), rtol=1e-6)


def test_in_steps_of_a_sample_time():
    """As SciPy with a held input."""
    discrete = full().discrete(0.07)
    expected = signal.cont2discrete(tuple(getattr(full_in_scipy(), name) for name in "ABCD"), 0.07)
    for name, matrix in zip("ABCD", expected, strict=False):
        np.testing.assert_allclose(getattr(discrete, name), matrix, rtol=1e-10, atol=1e-11, err_msg=name)
    assert discrete.sample_time == 0.07
    assert_same_spectrum(discrete.modes().eigenvalues, full().modes().eigenvalues, rtol=1e-8)
    Ad, Bd, Cd, Dd, _ = expected
    response = [Cd @ np.linalg.solve(np.exp(0.07j * w) * np.eye(6) - Ad, Bd) + Dd for w in RATES]
    np.testing.assert_allclose(discrete.frequency_response(RATES), response, rtol=1e-9, atol=1e-11)


def test_as_a_system_of_scipy():
    found = full().to_scipy()
    assert isinstance(found, signal.StateSpace)
    for name in "ABCD":
        np.testing.assert_array_equal(getattr(found, name), getattr(full(), name))
    assert full().discrete(0.07).to_scipy().dt == 0.07


def test_as_a_system_of_control():
    """The same poles and responses, also in discrete time, and with the names."""
    control = pytest.importorskip("control")
    found, discrete = full().to_control(), full().discrete(0.07)
    assert isinstance(found, control.StateSpace) and found.isctime()
    assert tuple(found.state_labels) == full().state_names and tuple(found.input_labels) == full().input_names
    assert tuple(found.output_labels) == full().output_names
    np.testing.assert_allclose(np.moveaxis(found(1j * RATES), -1, 0), expected_response(), rtol=1e-9, atol=1e-12)
    assert_same_spectrum(full().eigenvalues, found.poles(), rtol=1e-10)
    assert discrete.to_control().dt == 0.07
    np.testing.assert_allclose(
        np.moveaxis(discrete.to_control()(np.exp(0.07j * RATES)), -1, 0), discrete.frequency_response(RATES), rtol=1e-9, atol=1e-12
    )
    assert_same_spectrum(discrete.eigenvalues, discrete.to_control().poles(), rtol=1e-10)


# Dry friction


def sledge(q, qdot, m1, m2, c):
    """A sledge on the ground, and a mass that a spring joins to it."""
    return 0.5 * m1 * qdot["sledge"] ** 2 + 0.5 * m2 * qdot["mass"] ** 2 - 0.5 * c * (q["mass"] - q["sledge"]) ** 2


SLEDGE = jl.System(sledge, dissipation={"ground": lambda qdot, F, belt: F * jnp.abs(qdot["sledge"] - belt)})
SLEDGE_PARAMS = {"m1": 0.4, "m2": 0.6, "c": 90.0, "F": 5.0, "belt": 0.0}
SLEDGE_REST = {"sledge": 0.0, "mass": 0.03}


@pytest.mark.slow
def test_what_sticks_is_held():
    """Below the bound, c·0.03 = 2.7 < 5: with the sledge held, the mass alone oscillates about it."""
    linear = jl.linearise(SLEDGE, {"sledge": 0.0, "mass": 0.0}, params=SLEDGE_PARAMS)
    assert sorted(linear.state_names) == ["mass", "mass_dot", "sledge"]
    w = np.sqrt(SLEDGE_PARAMS["c"] / SLEDGE_PARAMS["m2"])
    assert_same_spectrum(linear.eigenvalues, [0, 1j * w, -1j * w], rtol=1e-10, atol=1e-12)


@pytest.mark.slow
def test_what_slips_keeps_its_force():
    """On a belt that is faster, with a spring to the wall: an undamped oscillator about x = F/c."""
    system = jl.System(
        lambda q, qdot, m, c: 0.5 * m * qdot["x"] ** 2 - 0.5 * c * q["x"] ** 2,
        dissipation={"belt": lambda qdot, F, belt: F * jnp.abs(qdot["x"] - belt)},
    )
    p = {"m": 0.4, "c": 90.0, "F": 5.0, "belt": 0.3}
    at = jl.equilibrium(system, {"x": 0.0}, p)
    np.testing.assert_allclose(at.q["x"], p["F"] / p["c"], rtol=1e-12)
    np.testing.assert_allclose(at.friction["belt"], [[p["F"]], [p["F"]]], rtol=1e-12)
    assert at.stability == "by the eigenvalues of `linearise`: friction slips"
    linear = jl.linearise(system, at, params=p, inputs=("F",))
    w = np.sqrt(p["c"] / p["m"])
    assert_same_spectrum(linear.eigenvalues, [1j * w, -1j * w], rtol=1e-10)
    np.testing.assert_allclose(linear.B, [[0], [1 / p["m"]]], rtol=1e-12)


# What is refused

ANGLE = jl.System(lambda q, qdot, l: 0.5 * (l * qdot["phi"]) ** 2 + g * l * jnp.cos(q["phi"]))


def test_a_state_that_accelerates_is_refused():
    """φ̈ = −g/l sin φ."""
    with pytest.raises(ValueError, match=r"must be a steady state, but 'phi.*by -4\.905.*`equilibrium`.*frozen=True"):
        jl.linearise(ANGLE, {"phi": np.pi / 6}, params={"l": 1.0})
    jl.linearise(ANGLE, {"phi": np.pi / 6}, params={"l": 1.0}, frozen=True)


def test_a_motion_along_which_the_matrices_change_is_refused():
    """Uniform, but with a stiffness that grows with x."""
    system = jl.System(lambda q, qdot: 0.5 * qdot["x"] ** 2 + 0.5 * qdot["y"] ** 2 - 0.5 * q["x"] * q["y"] ** 2)
    with pytest.raises(ValueError, match="changes.*frozen=True|frozen=True"):
        jl.linearise(system, {"x": 1.0, "y": 0.0}, {"x": 2.0, "y": 0.0})


def test_a_state_off_its_constraints_is_refused():
    with pytest.raises(ValueError, match="must satisfy the constraints, but .*`consistent_state`"):
        jl.linearise(pendulum.cartesian, {"x": 0.0, "y": -1.2}, params=pendulum.params)


def test_an_input_that_names_nothing_is_refused():
    with pytest.raises(ValueError, match="`inputs` must name what can be moved, but 'M1' names nothing. There are .*M0"):
        jl.linearise(vehicle.system, vehicle.q0, params=vehicle.params, inputs=("M1",), frozen=True)


def test_a_coordinate_that_is_not_there_cannot_be_independent():
    with pytest.raises(ValueError, match="`independent` must name coordinates, but holds 'z'"):
        jl.linearise(pendulum.cartesian, {"x": 0.0, "y": -1.0}, params=pendulum.params, independent=("z",))


@pytest.mark.parametrize("omega", [[-1.0, 2.0], [np.nan]])
def test_frequencies_below_zero_are_refused(omega):
    with pytest.raises(ValueError, match="`omega` must hold frequencies of 0 or more"):
        full().frequency_response(np.array(omega))


def test_the_response_of_what_moves_freely_is_infinite_at_zero():
    free = jl.linearise(jl.System(lambda qdot: 0.5 * qdot**2), 0.0, inputs=("q",))
    with pytest.raises(ValueError, match="`omega` must not hold an undamped eigenvalue, but does at 0"):
        free.frequency_response(np.array([1.0, 0.0]))
    np.testing.assert_allclose(free.frequency_response(np.array([2.0])), [[[-0.25]]], rtol=1e-12)


def test_under_jit_the_choice_of_coordinates_must_be_given():
    at = lambda l: jl.linearise(pendulum.cartesian, {"x": 0.0 * l, "y": -l}, params=pendulum.params | {"l": l}).A
    with pytest.raises(ValueError, match="`independent` must be a `LinearSystem` under `jit`"):
        jax.jit(at)(1.0)


@pytest.mark.slow
def test_single_precision():
    with jax.enable_x64(False):
        linear = jl.linearise(pendulum.cartesian, {"x": np.float32(0), "y": np.float32(-1)}, params=pendulum.params)
        assert linear.A.dtype == jnp.float32
        np.testing.assert_allclose(linear.modes().angular_frequency, [np.sqrt(g)], rtol=1e-5)


@pytest.mark.slow
def test_inputs_that_move_a_constraint_are_refused_along_a_trajectory():
    bob = jl.System(lambda q, qdot: 0.5 * qdot @ qdot - 9.81 * q[1], holonomic={"rod": lambda q: jnp.sqrt(q @ q) - 1.0})
    motion = jl.simulate(bob, [0.6, -0.8], [0.0, 0.0], np.linspace(0, 0.1, 3))
    assert jl.linearise(bob, motion, inputs=["q[0]"]).B.shape == (3, 2, 1)
    with pytest.raises(ValueError, match="`inputs` must not move a constraint along a trajectory"):
        jl.linearise(bob, motion, inputs=["rod"])


# Where functions bend


BENDING = {
    "maximum": (lambda q, qdot, a: 0.5 * qdot**2 - 0.5 * q**2 - 2 * jnp.maximum(q - a, 0.0) ** 2, 1.0),
    "where": (lambda q, qdot, a: 0.5 * qdot**2 - 0.5 * q**2 - 2 * jnp.where(q > a, (q - a) ** 2, 0.0), 1.0),
    "at zero": (lambda q, qdot, a: 0.5 * qdot**2 - 0.5 * q**2 - 2 * jnp.maximum(q, 0.0) ** 2, 0.0),
    "jumps": (lambda q, qdot, a: 0.5 * qdot**2 - jnp.abs(q - a), 1.0),
    "two": (lambda q, qdot, a: 0.5 * jnp.sum(qdot**2) - 0.5 * jnp.sum(q**2) - 2 * jnp.maximum(q[0] - q[1] - a, 0.0) ** 2, [1.5, 0.5]),
}


@pytest.mark.parametrize("unit", [1.0, 1e-9])
@pytest.mark.parametrize("kind", BENDING)
def test_a_state_where_a_function_bends_is_refused(kind, unit):
    """The motion is another one on either side, to which the state may be moved by as little as there is."""
    energy, at = BENDING[kind]
    system, params = jl.System(energy), {"a": 1.0 * unit}
    with pytest.raises(ValueError, match="on one side of what bends or jumps, but `(maximum|where|abs)` of `lagrangian`"):
        jl.linearise(system, np.array(at) * unit, params=params, frozen=True)
    if kind in ("maximum", "where"):
        for side, stiffness in ((1, 5.0), (-1, 1.0)):
            near = jl.linearise(system, unit * (1 + 1e-12 * side), params=params, frozen=True)
            np.testing.assert_allclose(near.A[1, 0], -stiffness)


def test_what_is_smooth_is_not_refused_for_how_it_is_written():
    system = jl.System(lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2 - 2 * jnp.abs(q) ** 3)
    np.testing.assert_allclose(jl.linearise(system, 0.0).A, [[0, 1], [-1, 0]])
