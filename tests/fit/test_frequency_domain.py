"""Identification from natural frequencies, damping ratios and frequency responses, which NumPy and SciPy make and fit by themselves."""

import inspect  # `unwrap`: without the hook of these tests, which refuses wrong types before

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import least_squares

import jaxlag as jl


def lagrangian(q, qdot, m, k):
    return 0.5 * jnp.sum(m * qdot**2) - 0.5 * jnp.sum(k * jnp.diff(q, prepend=0.0) ** 2)


def dampers(qdot, c):
    return 0.5 * jnp.sum(c * jnp.diff(qdot, prepend=0.0) ** 2)


CHAIN, REST = jl.System(lagrangian, dissipation={"dampers": dampers}), np.zeros(3)
TRUTH = {"m": np.array([1.0, 1.5, 2.0]), "k": np.array([400.0, 300.0, 200.0]), "c": np.array([0.5, 0.3, 0.2])}  # kg, N/m, N s/m
GUESS = TRUTH | {"k": np.array([560.0, 200.0, 290.0]), "c": np.array([0.3, 0.5, 0.3])}
OMEGA = np.linspace(3.0, 40.0, 25)  # rad/s


def by_hand(k, c, m=TRUTH["m"]):
    """A of the chain, M, C and K."""
    joined = lambda a: np.array([[a[0] + a[1], -a[1], 0], [-a[1], a[1] + a[2], -a[2]], [0, -a[2], a[2]]])
    M, C, K = np.diag(m), joined(c), joined(k)
    return np.block([[np.zeros((3, 3)), np.eye(3)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]]), M, C, K


def modes(x, m=TRUTH["m"]):
    """Frequencies in Hz, damping ratios and shapes at x = (k, c)."""
    values, vectors = np.linalg.eig(by_hand(x[:3], x[3:], m)[0])
    upper = np.flatnonzero(values.imag > 0)
    upper = upper[np.argsort(abs(values[upper]))]
    return abs(values[upper]) / (2 * np.pi), -values[upper].real / abs(values[upper]), vectors[:3, upper].T


def response(x):
    """To a force on the first mass."""
    _, M, C, K = by_hand(x[:3], x[3:])
    return np.array([np.linalg.inv(K - w**2 * M + 1j * w * C)[:, :1] for w in OMEGA])


EXACT = np.append(TRUTH["k"], TRUTH["c"])
F, ZETA, SHAPES = modes(EXACT)
OF_F, OF_ZETA = 1e-3 * F, np.array([0.02, 0.03, 0.01]) * ZETA


def modal_test(seed, order=(0, 1, 2), noise=1.0, **more):
    """As measured, its modes in some order; shapes of any complex scale, off by some percent."""
    e = noise * np.random.default_rng(seed).standard_normal((4, 3))
    shapes = (
        (SHAPES + 0.05 * (e[2:4, :1].T @ np.array([[1, 1j]]).T) * np.abs(SHAPES)) * np.exp(1j * np.arange(3))[:, None] * [[2], [1], [5]]
    )
    rows = list(order)
    return jl.ModalTest(
        (F + OF_F * e[0])[rows],
        REST,
        sigma=OF_F[rows],
        damping_ratio=(ZETA + OF_ZETA * e[1])[rows],
        damping_sigma=OF_ZETA[rows],
        shapes=shapes[rows],
        **more,
    )


def response_test(seed, noise=1.0):
    """As measured, with the sigma that coherence means; a frequency is missing."""
    G, draw = response(EXACT), np.random.default_rng(seed)
    sigma = abs(G) * np.sqrt((1 - 0.99) / (2 * 40 * 0.99))
    measured = G + noise * sigma * (draw.standard_normal(G.shape) + 1j * draw.standard_normal(G.shape))
    measured[7] = np.nan
    return jl.FrequencyResponseTest(OMEGA, measured, REST, inputs=["q[0]"], sigma=sigma), measured, sigma


def by_scipy(residuals, start=None):
    """Estimates and standard errors of a weighted least-squares problem; in x = (k, c) of the chain, where no start is given."""
    start = np.append(GUESS["k"], GUESS["c"]) if start is None else start
    scaled = lambda y: residuals(start * y)
    found = least_squares(scaled, np.ones(len(start)), jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    steps = 1e-5 * np.eye(len(start))
    J = np.stack([(scaled(found.x + h) - scaled(found.x - h)) / 2e-5 for h in steps], axis=1)
    return start * found.x, start * np.sqrt(np.diag(np.linalg.inv(J.T @ J)))


def of_modes(test):
    measured, order = test.values, np.argsort(test.values["frequency"])

    def residuals(x):
        f, zeta, _ = modes(x)
        return np.append(
            ((f - measured["frequency"][order]) / test.sigma["frequency"][order]),
            (zeta - measured["damping_ratio"][order]) / test.sigma["damping_ratio"][order],
        )

    return residuals


def of_response(measured, sigma):
    there = np.isfinite(measured)

    def residuals(x):
        r = ((response(x) - measured) / sigma)[there]
        return np.append(r.real, r.imag)

    return residuals


def assert_same(fit, expected):
    estimates, errors = expected
    np.testing.assert_allclose(np.append(fit.estimates["k"], fit.estimates["c"]), estimates, rtol=1e-5)
    np.testing.assert_allclose(np.append(fit.standard_errors["k"], fit.standard_errors["c"]), errors, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_exact_modes_in_any_order_give_the_truth_back(order):
    heavier = TRUTH["m"] + [0.0, 0.0, 1.0]  # without it, several chains have the same frequencies and damping ratios
    f, zeta, shapes = modes(EXACT, heavier)
    again = jl.ModalTest(f, REST, sigma=OF_F, damping_ratio=zeta, damping_sigma=OF_ZETA, shapes=shapes, params={"m": heavier})
    fit = jl.fit(CHAIN, [modal_test(0, order, noise=0.0), again], GUESS, free=("k", "c"), tolerance=1e-9)
    assert fit.converged and not fit.remarks
    np.testing.assert_allclose(np.append(fit.estimates["k"], fit.estimates["c"]), EXACT, rtol=1e-7)
    np.testing.assert_allclose(fit.predictions[0]["frequency"], F[list(order)], rtol=1e-10)


@pytest.mark.slow
def test_estimates_and_errors_from_modes_are_those_of_scipy():
    first, second = modal_test(1, (1, 2, 0)), modal_test(2, (2, 1, 0))
    fit = jl.fit(CHAIN, [first, second], GUESS, free=("k", "c"), tolerance=1e-8)
    assert_same(fit, by_scipy(lambda x: np.append(of_modes(first)(x), of_modes(second)(x))))
    assert fit.measurements == 12 and fit.freedom == 6 and fit.absolute
    r = np.append(of_modes(first)(np.append(*fit.estimates.values())), of_modes(second)(np.append(*fit.estimates.values())))
    np.testing.assert_allclose([fit.cost, fit.sigma], [r @ r / 2, np.sqrt(r @ r / 6)], rtol=1e-6)


@pytest.mark.slow
def test_estimates_and_errors_from_a_frequency_response_are_those_of_scipy():
    test, measured, sigma = response_test(3)
    fit = jl.fit(CHAIN, test, GUESS, free=("k", "c"), tolerance=1e-8)
    assert_same(fit, by_scipy(of_response(measured, sigma)))
    assert fit.measurements == 2 * 24 * 3
    at = np.append(fit.estimates["k"], fit.estimates["c"])
    np.testing.assert_allclose(fit.residuals[0], measured - response(at), rtol=1e-6)
    errors = fit.prediction_errors[0]
    slope = np.stack([(response(at * (1 + h)) - response(at * (1 - h))) / 2e-6 for h in 1e-6 * np.eye(6)], axis=-1) / at
    expected = [np.sqrt(np.einsum("wpmi,ij,wpmj->wpm", part, fit.covariance, part)) for part in (slope.real, slope.imag)]
    there = np.isfinite(measured)
    np.testing.assert_allclose(errors.real[there], expected[0][there], rtol=1e-4)
    np.testing.assert_allclose(errors.imag[there], expected[1][there], rtol=1e-4)
    assert np.all(np.isnan(errors[7]))


@pytest.mark.slow
def test_information_is_that_of_fisher():
    found = jl.information(CHAIN, modal_test(0, noise=0.0), TRUTH, free=("k", "c"))
    scaled = of_modes(modal_test(0, noise=0.0))
    J = np.stack([(scaled(EXACT * (1 + h)) - scaled(EXACT * (1 - h))) / 2e-6 for h in 1e-6 * np.eye(6)], axis=1) / EXACT
    np.testing.assert_allclose(found.matrix, J.T @ J, rtol=1e-6, atol=1e-9 * np.max(np.abs(J.T @ J)))


def test_what_coherence_says_of_the_scatter_of_a_measured_response():
    draw, n, trials, G, square = np.random.default_rng(7), 50, 20_000, 0.3 - 0.4j, 0.8
    normal = lambda: draw.standard_normal((trials, n)) + 1j * draw.standard_normal((trials, n))
    x = normal()
    y = G * x + abs(G) * np.sqrt((1 - square) / square) * normal()
    measured = np.sum(x.conj() * y, axis=1) / np.sum(abs(x) ** 2, axis=1)
    test = jl.FrequencyResponseTest([1.0], [G], 0.0, inputs=["q"], coherence=square, averages=n)
    np.testing.assert_allclose([np.std(measured.real), np.std(measured.imag)], test.sigma[0], rtol=0.03)  # formula: of large n


@pytest.mark.slow
def test_a_mode_that_looks_like_none_is_in_doubt():
    test = modal_test(0, noise=0.0)
    same = jl.ModalTest(F, REST, sigma=OF_F, damping_ratio=ZETA, damping_sigma=OF_ZETA, shapes=test.shapes[[0, 0, 2]])
    fit = jl.fit(CHAIN, same, TRUTH, free=("k", "c"))
    assert len(fit.remarks) == 2 and "is left over that could contradict" in fit.remarks[0]
    assert "of experiment 0, its mode 1 may be paired with the wrong one: the shapes agree by 0." in fit.remarks[1]
    assert "and by 1.00 with another" in fit.remarks[1]


REVERSED = pytest.param([[0.0, 1.0], [1.0, 0.0]], [1, 0], marks=pytest.mark.slow)


@pytest.mark.parametrize(("shapes", "order"), [(None, [1, 0]), ([[1.0, 0.0], [0.0, 1.0]], [0, 1]), REVERSED])
def test_equal_stiffnesses_at_the_start(shapes, order):
    """Where both modes have one frequency, its mean alone has a derivative. k = (2π f)²; shapes say which mass belongs to which."""
    pair = jl.System(lambda q, qdot, k: 0.5 * qdot @ qdot - 0.5 * jnp.sum(k * q**2))
    more = {} if shapes is None else {"shapes": np.array(shapes), "observe": lambda q: q}
    found = jl.fit(pair, jl.ModalTest([1.0, 1.01], np.zeros(2), sigma=1e-3, **more), {"k": np.array([40.0, 40.0])}, free="k")
    expected = (2 * np.pi * np.array([1.0, 1.01])) ** 2
    assert found.converged
    np.testing.assert_allclose(found.estimates["k"], expected[order], rtol=1e-9)
    np.testing.assert_allclose(found.standard_errors["k"], 2e-3 * (expected / [1.0, 1.01])[order], rtol=1e-6)


@pytest.mark.slow
def test_predictions_of_another_test():
    fit = jl.fit(CHAIN, modal_test(1), GUESS, free=("k", "c"))
    test, measured, _ = response_test(8)
    found = jl.validate(fit, test)
    at = np.append(fit.estimates["k"], fit.estimates["c"])
    np.testing.assert_allclose(found.prediction.values, response(at), rtol=1e-8)
    np.testing.assert_allclose(found.residuals, measured - response(at), rtol=1e-6)
    assert [c.name for c in found.channels] == ["q[0]/q[0]", "q[1]/q[0]", "q[2]/q[0]"] and isinstance(
        found.prediction.motion, jl.results.LinearSystem
    )
    lower, upper = fit.band(0)
    assert np.all(lower["frequency"] < upper["frequency"])


# One coordinate: closed forms


def sagging(q, qdot, m, c, k, g):
    return 0.5 * m * qdot**2 - 0.5 * c * q**2 - 0.25 * k * q**4 + m * g * q


def damper(qdot, b):
    return 0.5 * b * qdot**2


SPRING = jl.System(sagging, dissipation={"damper": damper})
HARDENING = {"m": 2.0, "c": 80.0, "k": 500.0, "g": 9.81, "b": 1.5}


@pytest.mark.slow
def test_equilibrium_moves_with_the_parameters():
    m, c, k, g, _ = HARDENING.values()
    y = next(x.real for x in np.roots([k, 0, c, -m * g]) if abs(x.imag) < 1e-12)
    stiffness = c + 3 * k * y**2
    f = np.sqrt(stiffness / m) / (2 * np.pi)
    by = {"c": 1 + 6 * k * y * -y / stiffness, "k": 3 * y**2 + 6 * k * y * -(y**3) / stiffness}  # of the stiffness
    test = jl.ModalTest([f], 0.1, sigma=0.01)
    for name, slope in by.items():
        found = jl.information(SPRING, test, HARDENING, free=(name,))
        np.testing.assert_allclose(found.matrix, [[(f * slope / (2 * stiffness) / 0.01) ** 2]], rtol=1e-8)


@pytest.mark.slow
def test_an_added_mass_tells_mass_from_stiffness():
    bare, loaded = 1.3, 1.1  # Hz; f² = c/(4π² m)
    tests = [jl.ModalTest([bare], 0.0, sigma=1e-3), jl.ModalTest([loaded], 0.0, sigma=1e-3, params={"g": 0.0, "extra": 0.5})]
    system = jl.System(lambda q, qdot, m, extra, c: 0.5 * (m + extra) * qdot**2 - 0.5 * c * q**2)
    fit = jl.fit(system, tests, {"m": 2.0, "extra": 0.0, "c": 50.0}, free=("m", "c"), tolerance=1e-9)
    m = 0.5 * loaded**2 / (bare**2 - loaded**2)
    np.testing.assert_allclose([fit.estimates["m"], fit.estimates["c"]], [m, m * (2 * np.pi * bare) ** 2], rtol=1e-7)


@pytest.mark.slow
def test_a_steady_motion_is_found_for_every_parameter():
    pendulum = jl.System(  # conical: cos θ = g/(l Ω²), and ω² = Ω² (1 + 3 cos² θ)
        lambda q, qdot, l, g: 0.5 * l**2 * (qdot["theta"] ** 2 + (jnp.sin(q["theta"]) * qdot["phi"]) ** 2) + g * l * jnp.cos(q["theta"])
    )
    f = 1.1
    start = {"theta": 0.9, "phi": 0.0}, {"theta": 0.0, "phi": 4.0}
    test = jl.ModalTest([f], *start, sigma=1e-3, fixed_rates=["phi"])
    fit = jl.fit(pendulum, test, {"l": 1.0, "g": 7.0}, free=("g",), tolerance=1e-9)
    np.testing.assert_allclose(fit.estimates["g"], 16 * np.sqrt(((2 * np.pi * f / 4) ** 2 - 1) / 3), rtol=1e-7)


@pytest.mark.slow
def test_a_response_to_a_moved_base_with_a_constraint():
    rod = jl.System(
        lambda q, qdot, g: 0.5 * qdot @ qdot - g * q[1],
        dissipation={"air": lambda qdot, b: 0.5 * b * qdot @ qdot},
        holonomic={"rod": lambda q, base, l: (q[0] - base) ** 2 + q[1] ** 2 - l**2},
    )
    l, b, g, omega = 0.8, 0.3, 9.81, np.linspace(1.0, 8.0, 12)
    G = (g / l) / (g / l - omega**2 + 1j * omega * b)  # of x by the base: ẍ + b ẋ + (g/l)(x − base) = 0
    near = np.array([0.1, -1.0])
    test = jl.FrequencyResponseTest(omega, G, near, inputs=["base"], observe=lambda q: q[0], sigma=1e-3 * np.abs(G))
    fit = jl.fit(rod, test, {"g": g, "base": 0.0, "l": 1.2, "b": 0.6}, free=("l", "b"))
    np.testing.assert_allclose([fit.estimates["l"], fit.estimates["b"]], [l, b], rtol=1e-7)


# Beside a recording in time: ÿ + b ẏ + c y = 0, released at 1

LINEAR = HARDENING | {"m": 1.0, "k": 0.0, "g": 0.0}
TIMES, W = np.linspace(0.0, 3.0, 41), np.linspace(2.0, 12.0, 20)
START = np.array([50.0, 2.5])
released = lambda x: np.array([expm(np.array([[0, 1], [-x[0], -x[1]]]) * t)[0, 0] for t in TIMES])
pushed = lambda x: 1 / (x[0] - W**2 + 1j * W * x[1])


def measured_in_three_ways():
    """A test of the mode, a recording and a test of the response, and their residuals at x = (c, b)."""
    draw, x = np.random.default_rng(6), (80.0, 1.5)
    f, zeta = np.sqrt(x[0]) / (2 * np.pi) * 1.002, x[1] / (2 * np.sqrt(x[0])) * 0.97
    z = released(x) + 0.02 * draw.standard_normal(41)
    G = pushed(x) + 5e-4 * (draw.standard_normal(20) + 1j * draw.standard_normal(20))
    experiments = [
        jl.ModalTest([f], 0.0, sigma=2e-3, damping_ratio=[zeta], damping_sigma=1e-3),
        jl.Experiment(TIMES, z, 1.0, 0.0, sigma=0.02),
        jl.FrequencyResponseTest(W, G, 0.0, inputs=["q"], sigma=5e-4),
    ]

    def residuals(x):
        of_mode = [(np.sqrt(x[0]) / (2 * np.pi) - f) / 2e-3, (x[1] / (2 * np.sqrt(x[0])) - zeta) / 1e-3]
        of_response = (pushed(x) - G) / 5e-4
        return np.concatenate([of_mode, (released(x) - z) / 0.02, of_response.real, of_response.imag])

    return experiments, residuals


@pytest.mark.slow
def test_beside_a_recording_all_count_by_their_sigmas():
    experiments, residuals = measured_in_three_ways()
    estimates, errors = by_scipy(residuals, START)
    for segments in (1, 2):
        numerics = {"tolerance": 1e-8, "rtol": 1e-11, "atol": 1e-13, "segments": segments}
        fit = jl.fit(SPRING, experiments, LINEAR | dict(zip("cb", START, strict=True)), free=("c", "b"), **numerics)
        np.testing.assert_allclose([fit.estimates["c"], fit.estimates["b"]], estimates, rtol=1e-5)
        np.testing.assert_allclose([fit.standard_errors["c"], fit.standard_errors["b"]], errors, rtol=1e-4)
        r = residuals(estimates)
        np.testing.assert_allclose([fit.cost, fit.sigma], [r @ r / 2, np.sqrt(r @ r / (83 - 2))], rtol=1e-6)
        assert fit.measurements == 2 + 41 + 40 and fit.unknowns == [{}, {}, {}]
        assert [(c.experiment, c.name) for c in fit.channels] == [(0, "damping_ratio"), (0, "frequency"), (1, "z"), (2, "q/q")]
        assert [bool(np.isfinite(c.whiteness)) for c in fit.channels] == [False, False, True, False]
        at = fit.estimates["c"], fit.estimates["b"]
        np.testing.assert_allclose(fit.residuals[1], experiments[1].values - released(at), atol=1e-7)
        np.testing.assert_allclose(fit.residuals[2], experiments[2].values - pushed(at), atol=1e-12)


@pytest.mark.slow
def test_many_starts_an_optimiser_and_a_profile_go_through_tests():
    optax = pytest.importorskip("optax")
    test, residuals = measured_in_three_ways()[0][2], lambda x: np.ravel([*(lambda r: (r.real, r.imag))((pushed(x) - test.values) / 5e-4)])
    estimates, errors = by_scipy(residuals, START)
    for options in ({"start": jl.MultiStart(3)}, {"method": optax.adam(0.05), "max_steps": 1000}, {}):
        fit = jl.fit(SPRING, test, LINEAR | dict(zip("cb", START, strict=True)), free=("c", "b"), **options)
        np.testing.assert_allclose([fit.estimates["c"], fit.estimates["b"]], estimates, rtol=1e-4)
    profiled, linear = fit.interval("b", profile=True), fit.interval("b")
    np.testing.assert_allclose(profiled, linear, atol=0.05 * errors[1])
    alone = jl.compare({"both": fit, "stiffness alone": jl.fit(SPRING, test, LINEAR, free=("c",))})
    assert sorted(alone.parameters.values()) == [1, 2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("free", "bounds"),
    [(("c",), None), (("c", "b"), {"b": (0, None)}), (("c", "b"), {"b": (0.2, None)}), (("c", "b"), None)],
)
def test_the_other_sign_of_time_is_said(free, bounds):
    """A compliance in mm/N; without a bound conjugates would mean a negative damping, with one none."""
    omega = np.linspace(1.0, 12.0, 40)
    G = 1e3 / (80.0 - 2.0 * omega**2 + 1.5j * omega)
    G[3] = np.nan
    draw = np.random.default_rng(0)
    G = G + 0.2 * (draw.standard_normal(40) + 1j * draw.standard_normal(40))
    start = {"m": 2.0, "c": 110.0, "k": 0.0, "g": 0.0, "b": 1.5 if free == ("c",) else 1.0}
    for values, is_said in ((G, False), (G.conj(), True)):
        test = jl.FrequencyResponseTest(omega, values, 0.0, inputs=["q"], observe=lambda q: 1e3 * q, sigma=0.2)
        found = jl.fit(SPRING, test, start, free=free, bounds=bounds)
        assert any("look like complex conjugates" in remark and "`values.conj()`" in remark for remark in found.remarks) == is_said


# What is refused

OSCILLATION = {"frequency": [1.0, 2.0], "q": np.zeros(2), "sigma": 0.01}
RESPONSE = {"omega": [1.0, 2.0], "values": [1.0, 1j], "q": 0.0, "inputs": ["q"]}


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"frequency": 1.0}, "`frequency` must have one number for each mode, but has shape"),
        ({"frequency": [1.0, -2.0]}, "`frequency` must be positive"),
        ({"frequency": [np.nan, np.nan]}, "`frequency` must be finite, but is infinite or missing throughout"),
        ({"sigma": None}, "`sigma` must say how exact the measurements are, but is missing"),
        ({"sigma": [0.1, 0.0]}, "`sigma` must be positive, one number or one for each of 2 modes"),
        ({"damping_ratio": [0.1]}, r"`damping_ratio` must have one number for each of the 2 modes, but has shape \(1,\)"),
        ({"damping_ratio": [0.1, 0.2]}, "`damping_sigma` must say how exact"),
        ({"shapes": np.ones((3, 2))}, "`shapes` must hold finite numbers for each of the 2 modes"),
        ({"shapes": np.ones((2, 1)), "observe": lambda q: q[:1]}, "`shapes` must tell modes apart, but are of one sensor alone"),
        ({"shapes": {"a": np.ones((2, 2))}}, "`observe` must say what the sensors see, but was left out, and `shapes` does not name"),
    ],
)
def test_a_wrong_modal_test_is_refused(wrong, said):
    with pytest.raises((ValueError, TypeError), match=said):
        jl.ModalTest(**(OSCILLATION | wrong))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"values": [1.0]}, "`values` must be numbers with a row for each of the 2 frequencies, but have shape"),
        ({"values": ["a", "b"]}, "`values` must be numbers with a row"),
        ({"values": [np.nan, np.nan]}, "`values` must be finite, but are infinite or missing throughout"),
        ({"omega": [-1.0, 2.0]}, "`omega` must hold frequencies of 0 or more"),
        ({"inputs": []}, r"`inputs` must name what was excited, but is \[\]"),
        ({"sigma": None}, "`sigma` or `coherence` must say how exact"),
        ({"sigma": 1.0, "coherence": 0.9}, "`sigma` or `coherence` must say how exact"),
        ({"sigma": 0.0}, "`sigma` must be positive and finite"),
        ({"sigma": [1.0, 1.0, 1.0]}, r"`sigma` must be a number or structured like `values`, \(2,\), but has shape \(3,\)"),
        ({"coherence": 0.9}, "`averages` must be the number of averages behind `coherence`, but is None"),
        ({"coherence": 1.0, "averages": 10}, "`coherence` must lie between 0 and 1"),
    ],
)
def test_a_wrong_frequency_response_is_refused(wrong, said):
    given = RESPONSE | {"sigma": 0.1} | wrong
    if "coherence" in wrong and "sigma" not in wrong:
        given["sigma"] = None
    with pytest.raises((ValueError, TypeError), match=said):
        jl.FrequencyResponseTest(**given)


ONE = jl.ModalTest([1.0], 0.0, sigma=0.01)
RECORD = jl.Experiment(TIMES, np.cos(TIMES), 0.0, 0.0, sigma=0.1)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (
            lambda: inspect.unwrap(jl.fit_each)(SPRING, [RECORD, ONE], HARDENING, free=("c",)),
            "`experiments` must be recordings in time, to be fitted in a",
        ),
        (
            lambda: inspect.unwrap(jl.regress)(SPRING, ONE, HARDENING, free=("c",)),
            "Tests by modes or frequency responses are for `fit` and `information`",
        ),
        (lambda: jl.fit(SPRING, ONE, HARDENING, free=("c",), start=jl.Regress()), "`start` must be None where modes or frequency"),
        (lambda: jl.fit(SPRING, ONE, HARDENING, free=("c",), loss=jl.Huber()), "`loss` must be None where modes or frequency"),
        (lambda: jl.fit(SPRING, ONE, HARDENING, free=("c",), segments=2), "`segments` must be 1 where nothing was recorded in time"),
        (lambda: jl.fit(SPRING, ONE, HARDENING | {"c": np.nan}, free=("c",)), "each free entry where modes or frequency .* 'c' is NaN"),
        (lambda: jl.fit(SPRING, ONE, HARDENING, free=("c", "k")), "there are 2 unknowns and 1 measurements"),
        (
            lambda: jl.fit(SPRING, [jl.Experiment(TIMES, np.cos(TIMES), 0.0, 0.0), ONE], HARDENING, free=("c",)),
            "`experiments` must all have a `sigma` or none",
        ),
        (
            lambda: jl.fit(SPRING, jl.ModalTest([1.0, 2.0], 0.0, sigma=0.01), HARDENING, free=("c",)),
            "`frequency` must be of modes that the system has, but 2 are given and 1 oscillate",
        ),
        (
            lambda: jl.fit(CHAIN, jl.ModalTest(F, REST, sigma=0.01, shapes={"a": SHAPES}, observe=lambda q: q), TRUTH, free=("k",)),
            r"`shapes` must hold what `observe` returns, y\[0\], y\[1\], y\[2\], but holds a\[0\]",
        ),
        (
            lambda: jl.fit(SPRING, jl.FrequencyResponseTest([1.0], [[1.0, 2.0]], 0.0, inputs=["q"], sigma=0.1), HARDENING, free=("c",)),
            r"`values` must have axes for 1 outputs \(q\) and 1 inputs \(q\), but have shape \(1, 2\)",
        ),
        (lambda: jl.fit(SPRING, ONE, HARDENING | {"c": -1e4, "k": 0.0}, free=("c",)), "2 are given|1 are given and 0 oscillate"),
    ],
)
def test_what_cannot_be_fitted_is_refused(call, said):
    with pytest.raises(ValueError, match=said):
        call()


@pytest.mark.slow
def test_a_picture_is_of_recordings_alone():
    fit = jl.fit(SPRING, ONE, HARDENING, free=("c",))
    with pytest.raises(ValueError, match="`number` must be that of a recording or of a sweep, but number 0 is a ModalTest"):
        jl.plot.fit(fit)
    assert "residual sigma" in str(fit) and "nan %" not in str(fit)
    assert fit.to_dict()["channels"][0]["name"] == "frequency"
