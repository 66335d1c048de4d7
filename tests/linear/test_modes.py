"""Natural frequencies, damping ratios and shapes against closed forms, SciPy and NumPy; their derivatives against differences."""

import functools

import jax
import jax.numpy as jnp
import linear_by_hand as by_hand
import numpy as np
import pytest
from linear_by_hand import FULL, REST, UNDAMPED, central
from scipy.linalg import eigh
from scipy.special import eval_laguerre, jn_zeros, roots_laguerre
from spectra import assert_same_spectrum

import jaxlag as jl
from jaxlag.examples import pendulum, vehicle

PUBLISHED_LAGUERRE = [0.322547689619392, 1.745761101158347, 4.536620296921128, 9.395070912301133]  # N = 4: Abramowitz & Stegun, table 25.9
SINGLE = {"m": 0.7, "l": 0.4, "g": 9.81}


# N equal pendulums, one below the other: ω² l/g are the zeros of the Laguerre polynomial L_N


def nodes(q, l):
    """Points of the pendulums, (N, 2), from the uppermost down; x to the right, y upwards."""
    return jnp.cumsum(l * jnp.stack([jnp.sin(q), -jnp.cos(q)], axis=1), axis=0)


def in_angles(t, q, qdot, params, m, l, g):
    return 0.5 * m * jnp.sum(jl.rate(nodes)(t, q, qdot, params) ** 2) - m * g * jnp.sum(nodes(q, l)[:, 1])


def in_points(q, qdot, m, g):
    return 0.5 * m * jnp.sum(qdot**2) - m * g * jnp.sum(q[:, 1])


def rods(q, l):
    parts = jnp.diff(q, axis=0, prepend=jnp.zeros((1, 2)))
    return jnp.sqrt(jnp.sum(parts**2, axis=1)) - l


ANGLES, RODS = jl.System(in_angles), jl.System(in_points, holonomic={"rods": rods})
HANGING = {
    "angles": lambda N: (ANGLES, np.zeros(N)),
    "rods": lambda N: (RODS, np.stack([np.zeros(N), -SINGLE["l"] * np.arange(1.0, N + 1)], axis=1)),
}
SIZES = [2, 4, 8, pytest.param(20, marks=pytest.mark.slow), pytest.param(50, marks=pytest.mark.slow)]


@functools.cache
def hanging(kind, N):
    return jl.linearise(*HANGING[kind](N), params=SINGLE).modes()


@pytest.mark.slow
@pytest.mark.parametrize("N", SIZES)
@pytest.mark.parametrize("kind", HANGING)
def test_pendulums_below_each_other(kind, N):
    """In their angles, and as points that rods hold."""
    zeros = roots_laguerre(N)[0] if N != 4 else PUBLISHED_LAGUERRE
    modes = hanging(kind, N)
    np.testing.assert_allclose(modes.angular_frequency**2 * SINGLE["l"] / SINGLE["g"], zeros, rtol=1e-9)
    np.testing.assert_array_equal(np.real(modes.eigenvalues), 0)
    np.testing.assert_array_equal(modes.damping_ratio, 0)


@pytest.mark.parametrize("kind, N", [("angles", 4), ("rods", 4)])
def test_shapes_of_pendulums_below_each_other(kind, N):
    """The deflection of the mass with k others below it is L_k(ω² l/g); no rod has more tension than at rest."""
    zeros, modes = roots_laguerre(N)[0], hanging(kind, N)
    shapes = np.asarray(modes.shapes)
    assert shapes.dtype == float  # undamped: real
    x = np.cumsum(SINGLE["l"] * shapes, axis=1) if kind == "angles" else shapes[..., 0]
    expected = np.array([[eval_laguerre(N - 1 - i, z) for i in range(N)] for z in zeros])
    np.testing.assert_allclose(x / x[:, -1:], expected / expected[:, -1:], rtol=1e-8, atol=1e-8)
    if kind == "rods":
        np.testing.assert_allclose(shapes[..., 1], 0, atol=1e-12)
        np.testing.assert_allclose(modes.multipliers["rods"], np.zeros((N, N)), atol=1e-9)


@pytest.mark.parametrize("k", [0, 1])
def test_a_rope_is_the_limit_of_many_pendulums(k):
    """j₀,ₖ/2 √(g/L), from which N masses differ by 1/(4N) of it."""
    limit = lambda N: jn_zeros(0, k + 1)[k] / 2 * np.sqrt(SINGLE["g"] / (N * SINGLE["l"]))
    error = {N: hanging("angles", N).angular_frequency[k] / limit(N) - 1 for N in (4, 8)}
    for N in error:
        np.testing.assert_allclose(error[N], -1 / (4 * N), rtol=0, atol=0.5 * (k + 1) ** 2 / N**2)


# Chains of springs


def chain(q, qdot, m, k):
    """Masses in a row between two walls."""
    return 0.5 * m * qdot @ qdot - 0.5 * k * jnp.sum(jnp.diff(q, prepend=0.0, append=0.0) ** 2)


def test_a_chain_of_springs_between_walls():
    N, m, k = 6, 0.3, 50.0
    modes = jl.linearise(jl.System(chain), np.zeros(N), params={"m": m, "k": k}).modes(normalise="mass")
    order = np.arange(1, N + 1)
    np.testing.assert_allclose(modes.angular_frequency, 2 * np.sqrt(k / m) * np.sin(order * np.pi / (2 * (N + 1))), rtol=1e-12)
    np.testing.assert_allclose(modes.frequency, modes.angular_frequency / (2 * np.pi), rtol=1e-15)
    expected = np.sqrt(2 / ((N + 1) * m)) * np.sin(np.outer(order, order) * np.pi / (N + 1))
    shapes = np.asarray(modes.shapes)
    np.testing.assert_allclose(shapes * np.sign(shapes[:, :1]), expected, rtol=0, atol=1e-12)


def test_a_train_that_moves_freely_has_a_mode_of_exactly_zero():
    """Three wagons: 0, √(k/m), √(3k/m)."""
    m, k = 0.3, 50.0
    train = jl.System(lambda q, qdot, m, k: 0.5 * m * qdot @ qdot - 0.5 * k * jnp.sum(jnp.diff(q) ** 2))
    modes = jl.linearise(train, np.zeros(3), params={"m": m, "k": k}).modes()
    frequencies = np.asarray(modes.angular_frequency)
    free = frequencies == 0
    assert np.all(np.asarray(modes.eigenvalues)[free] == 0) and free.sum() == 1
    np.testing.assert_allclose(frequencies[~free], np.sqrt([k / m, 3 * k / m]), rtol=1e-12)
    shift = np.asarray(modes.shapes)[0]
    np.testing.assert_allclose(shift / shift[0], np.ones(3), rtol=1e-9)


@pytest.mark.parametrize("per_time", [1.0, 1e6, 1e-6])
@pytest.mark.parametrize("sample_time", [None, 0.1])
@pytest.mark.parametrize("b", [0.0, 0.1])
def test_each_free_body_has_one_mode_of_zero_with_damping_too(per_time, sample_time, b):
    """Two trains of two wagons each, k/m = 2 and ζ = b/√(2 k m): two shapes at rest, of which A has four zeros."""
    trains = jl.System(
        lambda q, qdot, k: 0.5 * qdot @ qdot - 0.5 * k * ((q[0] - q[1]) ** 2 + (q[2] - q[3]) ** 2),
        dissipation=lambda qdot, b: 0.5 * b * ((qdot[0] - qdot[1]) ** 2 + (qdot[2] - qdot[3]) ** 2),
    )
    near = jl.linearise(trains, np.zeros(4), params={"k": 2 * per_time**2, "b": b * per_time})
    modes = (near if sample_time is None else near.discrete(sample_time / per_time)).modes()
    np.testing.assert_allclose(modes.angular_frequency / per_time, [0, 0, 2, 2], rtol=1e-9)
    np.testing.assert_array_equal(modes.angular_frequency[:2], 0)
    np.testing.assert_allclose(modes.damping_ratio, [0, 0, b / 2, b / 2], rtol=1e-9, atol=1e-12)
    rigid = np.real(modes.shapes[:2])
    assert np.linalg.matrix_rank(rigid) == 2
    np.testing.assert_allclose(rigid[:, ::2], rigid[:, 1::2], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_derivatives_of_a_damped_shape_that_stays_where_it_is_put():
    """A gear, q₀ = r q₁: (1, 1/r), and (r, 1)/√(1 + r²) of unit mass."""
    gear = jl.System(
        lambda q, qdot, r: 0.5 * qdot @ qdot - 0.5 * (q[0] - r * q[1]) ** 2, dissipation=lambda qdot, r: 0.05 * (qdot[0] - r * qdot[1]) ** 2
    )
    shape = lambda r, **scale: jl.linearise(gear, np.zeros(2), params={"r": r}).modes(**scale).shapes[0].real
    np.testing.assert_allclose(jax.jacrev(shape)(2.0), [0, -0.25], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(jax.jacfwd(jax.jacfwd(shape))(2.0), [0, 0.25], rtol=1e-12, atol=1e-15)
    of_unit_mass = jax.jacfwd(lambda r: shape(r, normalise="mass"))(2.0)
    np.testing.assert_allclose(of_unit_mass, [5**-1.5, -2 * 5**-1.5], rtol=1e-12)


def test_the_force_in_a_joint_of_a_mode():
    """A mass on a spring pulls another along by a rod, g = x₂ − x₁: m₂ ẍ₂ = λ."""
    m1, m2, c = 0.4, 0.6, 90.0
    coupled = jl.System(
        lambda q, qdot, m1, m2, c: 0.5 * m1 * qdot["x1"] ** 2 + 0.5 * m2 * qdot["x2"] ** 2 - 0.5 * c * q["x1"] ** 2,
        holonomic={"rod": lambda q: q["x2"] - q["x1"]},
    )
    linear = jl.linearise(coupled, {"x1": 0.0, "x2": 0.0}, params={"m1": m1, "m2": m2, "c": c})
    for normalise, size in (("mass", 1 / np.sqrt(m1 + m2)), ("largest", 1.0)):
        modes = linear.modes(normalise=normalise)
        w2 = c / (m1 + m2)
        np.testing.assert_allclose(modes.angular_frequency, [np.sqrt(w2)], rtol=1e-12)
        np.testing.assert_allclose(np.abs(modes.shapes["x1"]), [size], rtol=1e-12)
        np.testing.assert_allclose(modes.shapes["x2"], modes.shapes["x1"], rtol=1e-12)
        np.testing.assert_allclose(modes.multipliers["rod"], -m2 * w2 * np.asarray(modes.shapes["x2"]), rtol=1e-12)


# The lecture's vehicle: heave, pitch, and the speed that driving moment and wind settle


def driving():
    """The speed at which M₀/r = k (ẋ + v)², and the slope of the drag by ẋ, over the mass that x moves."""
    p = vehicle.params
    airspeed = np.sqrt(p["M0"] / (p["r"] * p["k"]))
    moved = p["M"] + 2 * (p["m"] + p["Theta_r"] / p["r"] ** 2)
    return airspeed - p["v"], -2 * p["k"] * airspeed / moved


def heave_and_pitch(M, Theta_s, a, b, c, **_):
    roots = lambda inertia, b, c: np.roots([inertia, 2 * b, 2 * c])
    return [*roots(M, b, c), *roots(Theta_s, b * a**2, c * a**2)]


def vehicle_at(system, q, speed):
    """At its steady drive; what moves with x is found with it."""
    still = jax.tree.map(jnp.zeros_like, q)
    moving = {name: value for name, value in (("x", speed), ("x2", speed), ("x3", speed)) if name in q}
    turning = {name: -speed / vehicle.params["r"] for name in ("phi2", "phi3") if name in q}
    return jl.linearise(system, q, still | moving | turning, vehicle.params)


@functools.cache
def vehicle_modes(kind):
    p, (speed, _) = vehicle.params, driving()
    y = p["l"] - p["M"] * p["g"] / (2 * p["c"])
    q = {"x": 0.0, "y": y, "phi": 0.0}
    if kind == "first_kind":
        q = vehicle.parts(q, p["r"], p["a"])
    return vehicle_at(getattr(vehicle, kind), jax.tree.map(jnp.asarray, q), speed)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["system", "substituted", "first_kind"])
def test_heave_pitch_and_drive_of_the_vehicle(kind):
    """M s² + 2b s + 2c, Θ s² + 2b a² s + 2c a², and s (m' s + 2k(ẋ + v)), also with nine coordinates and six constraints."""
    linear, (_, drag) = vehicle_modes(kind), driving()
    expected = [*heave_and_pitch(**vehicle.params), 0, drag]
    assert_same_spectrum(linear.eigenvalues, expected, rtol=1e-9, atol=1e-11)
    modes = linear.modes()
    pairs = [s for s in expected if np.imag(s) > 0]
    shaking = np.imag(modes.eigenvalues) > 0
    by_size = sorted(pairs, key=abs)
    np.testing.assert_allclose(np.asarray(modes.angular_frequency)[shaking], np.abs(by_size), rtol=1e-9)
    np.testing.assert_allclose(np.asarray(modes.damping_ratio)[shaking], [-s.real / abs(s) for s in by_size], rtol=1e-9)
    np.testing.assert_allclose(np.asarray(modes.time_constant)[shaking], [-1 / s.real for s in by_size], rtol=1e-9)


def test_the_second_order_form_of_the_vehicle():
    p, form = vehicle.params, vehicle_modes("system").second_order
    _, drag = driving()
    x = p["M"] + 2 * (p["m"] + p["Theta_r"] / p["r"] ** 2)
    order = [["x", "y", "phi"].index(name) for name in vehicle_modes("system").state_names[:3]]
    diagonal = lambda *values: np.diag(np.array(values)[order])
    np.testing.assert_allclose(form.mass, diagonal(x, p["M"], p["Theta_s"]), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(form.stiffness, diagonal(0, 2 * p["c"], 2 * p["c"] * p["a"] ** 2), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(form.damping, diagonal(-drag * x, 2 * p["b"], 2 * p["b"] * p["a"] ** 2), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(form.gyroscopic, np.zeros((3, 3)), atol=1e-9)
    np.testing.assert_allclose(form.circulatory, np.zeros((3, 3)), atol=1e-9)


# Spinning bodies: the tilting disc of a rotor, and the sleeping top, whose gravity is a negative spring


def tilting(q, qdot, A, C, k):
    """A body of revolution, tilted by α about x and then by β about its own y, and turned by φ about its axis; k (1 − cos of the tilt)."""
    spin = qdot["phi"] + qdot["alpha"] * jnp.sin(q["beta"])
    across = (qdot["alpha"] * jnp.cos(q["beta"])) ** 2 + qdot["beta"] ** 2
    return 0.5 * A * across + 0.5 * C * spin**2 - k * (1 - jnp.cos(q["alpha"]) * jnp.cos(q["beta"]))


TILTING = jl.System(tilting)
UPRIGHT = {"alpha": 0.0, "beta": 0.0, "phi": 0.0}
DISC = {"A": 0.02, "C": 0.035, "k": 400.0}
TOP = {"A": 0.02, "C": 0.035, "k": -1.3 * 9.81 * 0.05}  # −m g l
spinning = lambda Omega: {"alpha": 0.0, "beta": 0.0, "phi": Omega}


@pytest.mark.parametrize("Omega", [0.0, 50.0, 500.0])
def test_forward_and_backward_whirl_of_a_gyroscopic_disc(Omega):
    """A ω² ∓ CΩ ω − k = 0."""
    linear = jl.linearise(TILTING, UPRIGHT, spinning(Omega), DISC)
    half = DISC["C"] * Omega / (2 * DISC["A"])
    root = np.sqrt(half**2 + DISC["k"] / DISC["A"])
    whirl = [root - half, root + half]
    assert_same_spectrum(linear.eigenvalues, [0, 0, *(s * 1j * w for w in whirl for s in (1, -1))], atol=1e-9)
    modes = linear.modes()
    moving = np.asarray(modes.angular_frequency) > 0
    np.testing.assert_allclose(np.asarray(modes.angular_frequency)[moving], whirl, rtol=1e-10)
    np.testing.assert_allclose(np.asarray(modes.damping_ratio)[moving], 0, atol=1e-12)
    if Omega:  # a circle: the axis goes to (β, −α), forwards with Ω where β = −i α for e^{iωt}
        ratio = np.asarray(modes.shapes["beta"])[moving] / np.asarray(modes.shapes["alpha"])[moving]
        np.testing.assert_allclose(ratio, [1j, -1j], atol=1e-8)


def test_the_gyroscopic_matrix_of_a_disc():
    """A α̈ + CΩ β̇ + k α = 0, A β̈ − CΩ α̇ + k β = 0."""
    linear = jl.linearise(TILTING, UPRIGHT, spinning(50.0), DISC)
    A, C, k = DISC.values()
    at = [linear.state_names.index(name) for name in ("alpha", "beta", "phi")]
    form = jax.tree.map(lambda matrix: np.asarray(matrix)[np.ix_(at, at)], linear.second_order)
    np.testing.assert_allclose(form.mass, np.diag([A, A, C]), atol=1e-14)
    np.testing.assert_allclose(form.gyroscopic, C * 50 * np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 0]]), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(form.stiffness, np.diag([k, k, 0]), atol=1e-10)
    np.testing.assert_allclose(form.damping, np.zeros((3, 3)), atol=1e-12)
    np.testing.assert_allclose(form.circulatory, np.zeros((3, 3)), atol=1e-10)


@pytest.mark.parametrize("ratio", [0.8, 0.99, 1.01, 2.0])
def test_a_top_sleeps_if_it_spins_fast_enough(ratio):
    """C²n² > 4 A m g l; A ω² − C n ω + m g l = 0."""
    fall = -TOP["k"]
    n = ratio * 2 * np.sqrt(TOP["A"] * fall) / TOP["C"]
    modes = jl.linearise(TILTING, UPRIGHT, spinning(n), TOP).modes()
    expected = 1j * np.roots([TOP["A"], -TOP["C"] * n, fall])
    moving = np.abs(modes.eigenvalues) > 0
    found = np.asarray(modes.eigenvalues)[moving]
    assert_same_spectrum(found, np.where(expected.imag < 0, expected.conj(), expected), rtol=1e-8)
    assert np.any(found.real > 1e-3) == (ratio < 1)
    assert np.all(np.asarray(modes.stable)[moving]) == (ratio > 1)


# A disc that rolls upright: notebook 7


def spin(q, qdot):
    return qdot["phi"] + qdot["psi"] * jnp.sin(q["theta"])


def coin(q, qdot, m, r, g):
    fall = r * jnp.sin(q["theta"]) * qdot["theta"]
    turning = qdot["theta"] ** 2 / 4 + (qdot["psi"] * jnp.cos(q["theta"])) ** 2 / 4 + spin(q, qdot) ** 2 / 2
    return 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2 + fall**2 + r**2 * turning) - m * g * r * jnp.cos(q["theta"])


def ground(q, qdot, r):
    c, s, fall = jnp.cos(q["psi"]), jnp.sin(q["psi"]), qdot["theta"] * jnp.cos(q["theta"])
    forward, sideways = r * spin(q, qdot), r * fall
    return {"x": qdot["x"] - forward * c - sideways * s, "y": qdot["y"] - forward * s + sideways * c}


COIN = jl.System(coin, nonholonomic={"ground": ground})
FLAT = dict.fromkeys(("psi", "theta", "phi", "x", "y"), 0.0)
UNIT = {"m": 1.0, "r": 1.0, "g": 1.0, "w": 0.3}
rolling = lambda w, r: FLAT | {"phi": w, "x": r * w}
REFERENCE = {"critical_spin": 0.5773502691896257, "eigen_w0p3": 0.764198926981712}  # Neimark & Fufaev; w = 0.3, unit m, r and g


@pytest.mark.slow
@pytest.mark.parametrize("w", [0.3, 0.5, 0.65, 3.0])
def test_a_coin_rolls_upright_if_it_is_fast_enough(w):
    """λ² = 4g/(5r) − 12 ω²/5; five coordinates, three velocities, of which all but one pair is free."""
    linear = jl.linearise(COIN, FLAT, rolling(w, 1.0), UNIT)
    assert linear.A.shape == (8, 8)
    lean = np.emath.sqrt(0.8 - 2.4 * w**2)
    assert_same_spectrum(linear.eigenvalues, [lean, -lean, *np.zeros(6)], atol=1e-7)
    if w == 0.3:
        np.testing.assert_allclose(np.max(np.real(linear.eigenvalues)), REFERENCE["eigen_w0p3"], rtol=1e-9)
    assert linear.second_order is None


def test_the_critical_spin_of_a_coin():
    locus = jl.root_locus(COIN, FLAT, rolling, UNIT, over="w", values=np.array([0.3, 0.45, 0.6, 0.75]))
    (crossing,) = locus.crossings
    np.testing.assert_allclose(crossing.value, REFERENCE["critical_spin"], rtol=1e-8)
    assert (crossing.kind, crossing.direction) == ("divergence", "stabilises")


# Matrices at random


def test_undamped_modes_against_scipy():
    """Frequencies, and shapes with shapesᵀ M shapes = 1."""
    squares, vectors = eigh(UNDAMPED["K"], UNDAMPED["M"])
    modes = by_hand.linearised(UNDAMPED).modes(normalise="mass")
    shapes = np.asarray(modes.shapes)
    assert shapes.dtype == float
    np.testing.assert_allclose(modes.angular_frequency, np.sqrt(squares), rtol=1e-12)
    np.testing.assert_allclose(shapes @ UNDAMPED["M"] @ shapes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.abs(shapes), np.abs(vectors.T), rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.abs(shapes @ UNDAMPED["M"] @ vectors), np.eye(3), atol=1e-12)


def test_damped_modes_against_numpy():
    """With gyroscopic and circulatory forces: complex shapes."""
    A = by_hand.first_order(**FULL)
    values, vectors = np.linalg.eig(A)
    linear = by_hand.linearised(FULL)
    np.testing.assert_allclose(linear.A, A, rtol=1e-12, atol=1e-12)
    assert_same_spectrum(linear.eigenvalues, values, rtol=1e-11)
    assert np.all(np.diff(np.round(np.abs(linear.eigenvalues), 9)) >= 0)
    modes = linear.modes(normalise="largest")
    assert np.all(np.imag(modes.eigenvalues) > 0) and len(modes.eigenvalues) == 3
    for s, shape in zip(np.asarray(modes.eigenvalues), np.asarray(modes.shapes), strict=True):
        expected = vectors[:3, np.argmin(np.abs(values - s))]
        largest = np.argmax(np.abs(expected))
        np.testing.assert_allclose(shape, expected / expected[largest], rtol=0, atol=1e-10)
    np.testing.assert_allclose(modes.damping_ratio, -np.real(modes.eigenvalues) / np.abs(modes.eigenvalues), rtol=1e-12)


def test_the_parts_of_the_second_order_form():
    form = by_hand.linearised(FULL).second_order
    for name, key in (("mass", "M"), ("damping", "C"), ("gyroscopic", "G"), ("stiffness", "K"), ("circulatory", "N")):
        np.testing.assert_allclose(getattr(form, name), FULL[key], rtol=1e-11, atol=1e-11, err_msg=name)


# Derivatives: along one direction in all matrices at once

DIRECTION = {name: by_hand._random(7)[name] - FULL[name] for name in "MCGKN"}
moved = lambda params, s: params | {name: params[name] + s * DIRECTION[name] for name in DIRECTION}


def expected_shape(params, s, normalise):
    """The shape with the eigenvalue s, by NumPy: its largest entry 1, or, for undamped systems, shapeᵀ M shape = 1 (up to the sign)."""
    values, vectors = np.linalg.eig(by_hand.first_order(**params))
    shape = vectors[:3, np.argmin(np.abs(values - s))]
    shape = shape / shape[np.argmax(np.abs(shape))]
    return shape if normalise == "largest" else shape.real / np.sqrt(shape.real @ params["M"] @ shape.real)


def derivative_along(value, params):
    """d value/ds at s = 0, forwards and backwards, as flat arrays."""
    flat = lambda s: jnp.ravel(value(moved(params, s)))
    forwards = jax.jacfwd(flat)(0.0)
    parts = lambda s: jnp.concatenate([jnp.real(flat(s)), jnp.imag(flat(s))])
    backwards = jax.jacrev(parts)(0.0)
    np.testing.assert_allclose(jnp.concatenate([forwards.real, forwards.imag]), backwards, rtol=1e-9, atol=1e-10)
    return np.asarray(forwards)


@pytest.mark.slow
def test_derivatives_of_complex_eigenvalues():
    at = np.asarray(by_hand.linearised(FULL).eigenvalues)
    nearest = lambda s: np.array(
        [(values := np.linalg.eigvals(by_hand.first_order(**moved(FULL, s))))[np.argmin(np.abs(values - z))] for z in at]
    )
    found = derivative_along(lambda params: by_hand.linearised(params).eigenvalues, FULL)
    np.testing.assert_allclose(found, central(nearest, 0.0, 1e-3), rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize(
    "params, normalise", [(FULL, "largest"), (UNDAMPED, "largest"), (UNDAMPED, "mass")], ids=("damped", "largest", "mass")
)
def test_derivatives_of_shapes(params, normalise):
    direction = {name: x if params is FULL else 0 * x if name in "CGN" else x + x.T for name, x in DIRECTION.items()}
    at = lambda s: params | {name: params[name] + s * direction[name] for name in direction}
    modes = lambda s: by_hand.linearised(at(s)).modes(normalise=normalise)
    found, eigenvalues = jax.jacfwd(lambda s: modes(s).shapes)(0.0), np.asarray(modes(0.0).eigenvalues)
    shapes = np.asarray(modes(0.0).shapes)
    for i, z in enumerate(eigenvalues):
        sign = np.sign((shapes[i] / expected_shape(params, z, normalise))[0].real)
        expected = sign * central(lambda s: expected_shape(at(s), z, normalise), 0.0, 1e-3)  # noqa: B023
        np.testing.assert_allclose(found[i], expected, rtol=1e-6, atol=1e-8)


@pytest.mark.slow
def test_second_derivatives_of_eigenvalues():
    """Of √(g/l), by g and l."""
    at = lambda x: {"m": 1.0, "g": x[0], "l": x[1]}
    frequency = lambda x: jnp.max(jl.linearise(ANGLES, np.zeros(1), params=at(x)).eigenvalues.imag)
    g, l = 9.81, 0.4
    w = np.sqrt(g / l)
    expected = w * np.array([[-1 / (4 * g**2), -1 / (4 * g * l)], [-1 / (4 * g * l), 3 / (4 * l**2)]])
    np.testing.assert_allclose(jax.hessian(frequency)(jnp.array([g, l])), expected, rtol=1e-8)


def test_derivatives_beside_a_mode_that_moves_freely():
    """A damped pendulum on a cart that rolls: λ = 0 has one eigenvector for x and ẋ, and the others are as simple as ever."""
    cart = jl.System(
        lambda q, qdot, m, l, c: 0.5 * qdot["x"] ** 2 + 0.5 * m * (qdot["x"] + l * qdot["phi"]) ** 2 - 0.5 * c * q["phi"] ** 2,
        dissipation=lambda qdot, b: 0.5 * b * qdot["phi"] ** 2,
    )
    m, l, c, b = 0.5, 0.4, 2.0, 0.3
    found = jax.jacfwd(lambda l: jl.linearise(cart, {"x": 0.0, "phi": 0.0}, params={"m": m, "l": l, "c": c, "b": b}).eigenvalues)(l)
    roots = lambda l: np.sort_complex(np.roots([m * l**2 / (1 + m), b, c]))  # the pendulum with the reduced mass m/(1 + m)
    np.testing.assert_allclose(found[-2:], central(roots, l, 1e-3), rtol=1e-7)


@pytest.mark.slow
def test_repeated_eigenvalues_have_no_nan_in_their_derivatives():
    """Three equal oscillators: where all of them change together, each ±i√(k/m) changes by itself."""
    params = {"M": np.eye(3), "K": 4 * np.eye(3), **{name: by_hand.NONE for name in "CGN"}, "u": REST}
    frequencies = lambda k: by_hand.linearised(params | {"K": k * jnp.eye(3)}).modes().angular_frequency
    np.testing.assert_allclose(frequencies(4.0), [2, 2, 2], rtol=1e-12)
    np.testing.assert_allclose(jax.jacfwd(frequencies)(4.0), [0.25] * 3, rtol=1e-9)
    np.testing.assert_allclose(jax.grad(lambda k: jnp.sum(frequencies(k)))(4.0), 0.75, rtol=1e-9)
    modes = by_hand.linearised(params).modes(normalise="mass")
    assert np.all(modes.repeated) and not np.any(by_hand.linearised(UNDAMPED).modes().repeated)
    assert np.all(np.isfinite(jax.jacfwd(lambda k: by_hand.linearised(params | {"K": k * jnp.eye(3)}).modes().shapes)(4.0)))
    shapes = np.asarray(modes.shapes)
    np.testing.assert_allclose(shapes @ shapes.T, np.eye(3), atol=1e-12)


@pytest.mark.slow
def test_many_systems_at_once():
    stiffnesses = np.stack([UNDAMPED["K"] * s for s in (1.0, 2.0, 5.0)])
    found = jax.vmap(lambda K: by_hand.linearised(FULL | {"K": K}).eigenvalues)(stiffnesses)
    for K, eigenvalues in zip(stiffnesses, np.asarray(found), strict=True):
        assert_same_spectrum(eigenvalues, np.linalg.eigvals(by_hand.first_order(**FULL | {"K": K})), rtol=1e-11)
    modes = jax.vmap(lambda K: by_hand.linearised(UNDAMPED | {"K": K}).modes().angular_frequency)(stiffnesses)
    for K, frequencies in zip(stiffnesses, np.asarray(modes), strict=True):
        expected = np.repeat(np.sqrt(eigh(K, UNDAMPED["M"], eigvals_only=True)), 2)  # one entry for each eigenvalue
        np.testing.assert_allclose(frequencies, expected, rtol=1e-9)


@pytest.mark.slow
def test_many_pendulums_on_rods():
    lengths = np.array([0.3, 0.4, 0.9])
    at = lambda l: jl.linearise(pendulum.cartesian, {"x": 0.0, "y": -l}, params=pendulum.params | {"l": l}).eigenvalues
    found = np.asarray(jax.vmap(at)(lengths))
    np.testing.assert_allclose(np.abs(found), np.sqrt(9.81 / lengths)[:, None] * np.ones(2), rtol=1e-10)


@pytest.mark.slow
def test_under_jit_with_the_choice_of_coordinates():
    """What jit hides is taken from a linearisation before it."""
    down = lambda l: {"x": 0.0 * l, "y": -l}
    before = jl.linearise(pendulum.cartesian, down(1.0), params=pendulum.params)
    at = lambda l: jl.linearise(pendulum.cartesian, down(l), params=pendulum.params | {"l": l}, independent=before)
    found = jax.jit(lambda l: at(l).eigenvalues)
    for l in (0.5, 2.0):
        np.testing.assert_allclose(np.abs(found(l)), [np.sqrt(9.81 / l)] * 2, rtol=1e-10)


def test_the_printed_modes_are_a_table():
    text = str(vehicle_modes("system").modes())
    heave = np.sqrt(2 * vehicle.params["c"] / vehicle.params["M"])
    assert f"{heave:.4g}"[:4] in text and "Hz" in text


def test_normalisation_must_be_one_of_two():
    with pytest.raises(ValueError, match="`normalise` must be 'largest' or 'mass', but is 'size'"):
        by_hand.linearised(UNDAMPED).modes(normalise="size")


# Derivatives where nothing is damped: by what damps, turns or drives

TURNED = jl.System(
    lambda q, qdot, w: 0.5 * qdot @ qdot - 0.5 * (q[0] ** 2 + 4 * q[1] ** 2) + w * (q[0] * qdot[1] - q[1] * qdot[0]),
    dissipation=lambda qdot, b: 0.5 * b * (qdot[0] ** 2 + 3 * qdot[1] ** 2),
    force=lambda q, p: p * jnp.stack([q[1], -q[0]]),
)
NEITHER = {"w": 0.0, "b": 0.0, "p": 0.0}


def turned(**changed):
    return jl.linearise(TURNED, np.zeros(2), params=NEITHER | changed).modes()


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_damping_ratios_where_there_is_no_damping(derivative):
    """ζ = b/2mω."""
    np.testing.assert_allclose(derivative(lambda b: turned(b=b).damping_ratio)(0.0), [0.5, 0.75], rtol=1e-9)
    np.testing.assert_allclose(derivative(lambda b: turned(b=b).eigenvalues.real)(0.0), [-0.5, -1.5], rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name, expected", [("w", [-4 / 3, 8 / 3]), ("p", [1 / 3, -1 / 6])])
def test_second_derivatives_by_what_turns_an_undamped_system(name, expected):
    """Of λ⁴ + (5 + 4w²) λ² + 4 + p² = 0."""
    frequency = lambda x: turned(**{name: x}).angular_frequency
    np.testing.assert_allclose(jax.jacfwd(jax.jacfwd(frequency))(0.0), expected, rtol=1e-7)


@pytest.mark.slow
def test_shapes_of_an_undamped_system_are_real_and_move_with_what_drives_it():
    """q̂ = (1, x₂) with (ω² − 4) x₂ = p, at ω = 1."""
    assert turned().shapes.dtype == float
    np.testing.assert_allclose(jax.jacfwd(lambda p: turned(p=p).shapes)(0.0)[0], [0, -1 / 3], atol=1e-12)


@pytest.mark.slow
def test_derivatives_of_an_undamped_system_that_is_free_to_move():
    """Two masses and the spring between them: the modes under `grad` are those without it."""
    system = jl.System(lambda q, qdot, c: 0.5 * qdot @ qdot - 0.5 * c * (q[1] - q[0]) ** 2)
    frequency = lambda c: jl.linearise(system, np.zeros(2), params={"c": c}).modes().angular_frequency
    np.testing.assert_allclose(jax.jacfwd(frequency)(2.0), [0, 0.5], atol=1e-12)
    assert jax.grad(lambda c: frequency(c)[1])(2.0) == pytest.approx(0.5, rel=1e-12)


@pytest.mark.slow
def test_a_fit_of_damping_that_starts_without():
    """ζ = 0.05 measured: b = 2 m ω ζ = 0.4."""
    system = jl.System(lambda q, qdot: qdot**2 - 4 * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2)
    measured = jl.ModalTest([1 / np.pi], 0.0, damping_ratio=[0.05], sigma=1e-3, damping_sigma=1e-3)
    found = jl.fit(system, measured, {"b": 0.0}, free=("b",))
    assert found.params["b"] == pytest.approx(0.4, rel=1e-6)


def test_modes_are_a_sequence():
    modes = turned()
    assert [float(mode.angular_frequency) for mode in modes] == pytest.approx([1, 2])
    assert float(modes[-1].angular_frequency) == pytest.approx(2)
    with pytest.raises(IndexError, match="must be one of 2 modes"):
        modes[2]


@pytest.mark.slow
@pytest.mark.parametrize("transformed", [jax.jacfwd, jax.jacrev, lambda f: jax.jit(jax.jacfwd(f))])
def test_a_state_in_numbers_moves_with_its_constraints(transformed):
    """ω = √(g/l) of a pendulum that hangs at (0, −2): by the length of its rod."""
    ready = jl.linearise(RODS, np.array([[0.0, -2.0]]), params=SINGLE | {"l": 2.0})

    def frequency(l):
        linear = jl.linearise(RODS, np.array([[0.0, -2.0]]), params=SINGLE | {"l": l}, independent=ready)
        return jnp.max(jnp.abs(linear.eigenvalues))

    np.testing.assert_allclose(transformed(frequency)(2.0), -0.5 * np.sqrt(9.81 / 2.0) / 2.0, rtol=1e-9)


def test_modes_come_by_their_size_whether_they_swing_or_fall():
    """λ = ±2 of what falls stands behind λ = ±i of what swings, each with its shape."""
    system = jl.System(lambda q, qdot: 0.5 * qdot @ qdot - 0.5 * q[0] ** 2 + 2.0 * q[1] ** 2)
    modes = jl.linearise(system, jnp.zeros(2)).modes()
    np.testing.assert_allclose(modes.angular_frequency, [1.0, 2.0], rtol=1e-12)
    np.testing.assert_allclose(np.abs(modes.shapes), np.eye(2), atol=1e-12)
    np.testing.assert_array_equal(modes.stable, [True, False])
