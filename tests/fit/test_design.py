"""The experiment that determines parameters best: against closed forms, against SciPy, and by fits of many noisy repeats."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

import jaxlag as jl

oscillator = jl.System(
    lambda q, qdot, m, k: 0.5 * m * qdot**2 - 0.5 * k * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2, force=lambda t, u: u(t)
)
driven = jl.System(lambda q, qdot, k: 0.5 * qdot**2 - 0.5 * k * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2)
cart = jl.System(lambda qdot, m: 0.5 * m * qdot**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2, force=lambda t, u: u(t))


def at_one_frequency(unit=1.0):
    """An oscillator of k = 1, b = 0.2 in a `unit` of time; a sensor of any resolution."""
    return jl.FrequencyResponseTest([0.9 / unit], [1.0 + 0j], 0.0, inputs=["q"], sigma=0.1 * unit**2), {"k": 1 / unit**2, "b": 0.2 / unit}


@pytest.mark.parametrize("unit", [1.0, 1e-4])
@pytest.mark.parametrize(("free", "best"), [(("k",), np.sqrt(0.98)), (("b",), 0.995000063), (("k", "b"), 0.992485992)])
def test_one_frequency(free, best, unit):
    """1/(k − ω² + ibω): |∂/∂k| is largest at √(k − b²/2); for b and for both, roots of polynomials."""
    test, params = at_one_frequency(unit)
    found = jl.design(driven, test, params, free=free, over="omega", starts=1, tolerance=1e-14)
    assert found.converged and not found.binding
    np.testing.assert_allclose(found.experiment.omega * unit, [best], rtol=1e-6)
    assert found.cost < found.cost_before
    for name in free:
        assert found.after.standard_errors[name] < found.before.standard_errors[name]


def information_of_response(omega, k=1.0, b=0.2):
    """Of (k, b) relative to their values, with sigma = 0.1."""
    G = 1 / (k - omega**2 + 1j * b * omega)
    J = np.array([-(G**2) * k, -(G**2) * 1j * omega * b]) / 0.1
    return np.real(J.conj()[:, None] * J[None, :])


@pytest.mark.parametrize(
    ("criterion", "cost"),
    [
        (jl.AOptimal(), lambda F: np.trace(np.linalg.inv(F))),
        (jl.EOptimal(), lambda F: -np.linalg.eigvalsh(F)[0]),
        (jl.Along("k"), lambda F: np.linalg.inv(F)[0, 0]),
    ],
    ids=["A", "E", "along k"],
)
def test_other_criteria_at_one_frequency(criterion, cost):
    test, params = at_one_frequency()
    found = jl.design(driven, test, params, free=("k", "b"), over="omega", criterion=criterion, starts=1, tolerance=1e-14)
    best = optimize.minimize_scalar(lambda omega: cost(information_of_response(omega)), (0.8, 1.0), tol=1e-14).x
    np.testing.assert_allclose(found.experiment.omega, [best], rtol=1e-6)


@pytest.mark.parametrize(("together", "kind"), [(np.mean, jl.Average), (np.max, jl.Worst)])
def test_what_is_believed_is_uncertain(together, kind):
    """The mean, and the worst, of D-optimality at three values of k."""
    test, params = at_one_frequency()
    ks = np.array([0.8, 1.0, 1.3])
    found = jl.design(driven, test, params, free=("k", "b"), over="omega", criterion=kind({"k": ks}), starts=3, tolerance=1e-12)
    relative = lambda omega, k: information_of_response(omega, k) / np.outer([k, 1.0], [k, 1.0])
    cost = lambda omega: together([-np.linalg.slogdet(relative(omega, k))[1] for k in ks])
    grid = np.linspace(0.5, 1.5, 2001)
    best = grid[np.argmin([cost(omega) for omega in grid])]
    best = optimize.minimize_scalar(cost, (best - 1e-3, best, best + 1e-3), tol=1e-12).x
    np.testing.assert_allclose(found.cost, cost(best), atol=1e-7)
    np.testing.assert_allclose(found.experiment.omega, [best], rtol=1e-4)


def decay(v0, b, m, times):
    return v0 * jnp.exp(-b * times / m)


@pytest.mark.parametrize("second", [1.0, 1e-6])
def test_box_and_lucas(second):
    """v₀ exp(−bt/m) at two times: one at the start, and one m/b after it."""
    plan = jl.Measurement(np.zeros(2), decay, sigma=0.01, params={"times": second * np.array([1.0, 5.0])})
    params = {"v0": 3.0, "b": 0.5 / second, "m": 1.0}
    found = jl.design(cart, plan, params, free=("v0", "b"), over="times", bounds={"times": (0.0, 20.0 * second)}, starts=1, tolerance=1e-14)
    np.testing.assert_allclose(np.sort(found.experiment.params["times"]) / second, [0.0, 2.0], atol=1e-6)
    assert any(name.startswith("bound of times") for name in found.binding)


@pytest.mark.slow
def test_sample_times_of_a_motion_whose_start_is_unknown():
    """b alone matters, and v₀ is unknown: of two samples the later one is 1.278 m/b after the first."""
    plan = jl.Experiment(
        [0.0, 0.3, 3.0, 20.0],
        np.array([np.nan, 0.0, 0.0, np.nan]),
        0.0,
        1.0,
        observe=lambda qdot: qdot,
        sigma=0.01,
        unknown=("qdot0",),
        params={"u": jl.Signal([0.0, 1.0], [0.0, 0.0])},
    )
    found = jl.design(cart, plan, {"m": 1.0, "b": 0.5}, free=("b",), over="ts", starts=1, tolerance=1e-12, rtol=1e-10, atol=1e-12)
    variance = lambda x: (1 + np.exp(-2 * x)) / (x * np.exp(-x)) ** 2  # the first at zero, x = b t/m of the second
    best = optimize.minimize_scalar(variance, (1.0, 1.5), tol=1e-12).x
    np.testing.assert_allclose(found.experiment.ts[1:3], [0.0, best / 0.5], atol=1e-4)
    assert found.experiment.ts[0] == 0.0 and np.all(np.diff(found.experiment.ts) >= 0)


@pytest.mark.parametrize(
    ("criterion", "cost"),
    [
        (jl.DOptimal(), lambda F: -np.linalg.slogdet(F)[1]),
        (jl.AOptimal(), lambda F: np.log(np.trace(np.linalg.inv(F)))),
        (jl.EOptimal(), lambda F: -np.log(np.linalg.eigvalsh(F)[0])),
    ],
    ids="DAE",
)
@pytest.mark.parametrize("points", [3, 5])
def test_polynomials(points, criterion, cost):
    """Where to measure a + bx + cx² between −1 and 1: as good as the best of forty searches by SciPy."""
    powers = lambda x: x[:, None] ** np.arange(3)
    plan = jl.Measurement(
        np.zeros(points), lambda a, b, c, x: a + b * x + c * x**2, sigma=1.0, params={"x": np.linspace(-0.7, 0.8, points)}
    )
    params = {"a": 1.0, "b": 1.0, "c": 1.0}
    found = jl.design(
        cart, plan, params, free=("a", "b", "c"), over="x", criterion=criterion, bounds={"x": (-1.0, 1.0)}, starts=10, tolerance=1e-12
    )
    rng = np.random.default_rng(0)
    of = lambda x: min(cost(powers(np.clip(x, -1, 1)).T @ powers(np.clip(x, -1, 1))), 1e3)
    searches = [
        optimize.minimize(of, rng.uniform(-1, 1, points), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12, "maxiter": 4000})
        for _ in range(40)
    ]
    np.testing.assert_allclose(found.cost, min(one.fun for one in searches), atol=2e-5 if isinstance(criterion, jl.EOptimal) else 1e-6)
    assert len(found.costs) == 10 and min(found.costs) == found.cost


LIMITS = {"force": (lambda t, u: u(t), -5.0, 5.0), "speed": (lambda qdot: qdot, -1.0, 1.0)}


def pushed(second=1.0, harmonics=4):
    u = jl.Multisine(10.0 * second, harmonics=harmonics)
    return jl.Experiment(second * jnp.linspace(0.0, 10.0, 51), None, 0.0, 0.0, sigma=1e-3, params={"u": u})


def test_limits_hold_between_samples():
    """From rest, with an input that is too weak at first; the motion is looked at a hundred times more often than it is sampled."""
    found = jl.design(cart, pushed(), {"m": 2.0, "b": 1.0}, free=("m", "b"), over=("u", "qdot0"), within=LIMITS, starts=1)
    assert found.converged and {"speed (lower)", "speed (upper)"} <= {*found.binding}
    best = found.experiment
    ts = jnp.linspace(0.0, 10.0, 5001)
    motion = jl.simulate(cart, best.q0, best.qdot0, ts, {"m": 2.0, "b": 1.0} | best.params, rtol=1e-10, atol=1e-12)
    assert 1 - 1e-4 < np.max(np.abs(motion.qdot)) < 1 + 1e-6
    assert np.max(np.abs(jax.vmap(best.params["u"])(ts))) < 5 * (1 + 1e-6)
    assert found.cost < found.cost_before - 3
    assert "± before" in repr(found) and "speed (upper) binds at t" in repr(found)


def test_an_experiment_beside_those_that_were_made():
    """Where k is known well, what is left to find is b."""
    test, params = at_one_frequency()
    sure = jl.Measurement(1.0, lambda k: k, sigma=1e-7)
    found = jl.design(driven, test, params, free=("k", "b"), over="omega", given=sure, starts=1, tolerance=1e-14)
    np.testing.assert_allclose(found.experiment.omega, [0.995000063], rtol=1e-5)
    believed = jl.design(driven, test, params, free=("k", "b"), over="omega", priors={"k": (1.0, 1e-7)}, starts=1, tolerance=1e-14)
    np.testing.assert_allclose(believed.experiment.omega, found.experiment.omega, rtol=1e-6)


def test_two_experiments_are_chosen_together():
    """As SciPy chooses two frequencies at once."""
    test, params = at_one_frequency()
    found = jl.design(driven, test, params, free=("k", "b"), over="omega", count=2, starts=4, tolerance=1e-13)
    cost = lambda omega: -np.linalg.slogdet(sum(map(information_of_response, omega)))[1]
    best = min((optimize.minimize(cost, x, tol=1e-14) for x in ([0.9, 1.1], [0.99, 1.0], [0.8, 0.95])), key=lambda one: one.fun)
    np.testing.assert_allclose(found.cost, best.fun, atol=1e-8)
    assert len(found.experiments) == 2
    np.testing.assert_allclose(np.sort([one.omega[0] for one in found.experiments]), np.sort(best.x), rtol=1e-4)


@pytest.mark.slow
def test_a_start_on_a_constraint_and_the_force_of_a_rod():
    """A pendulum in x and y, whose rod carries no more than 1.5 of its weights: the start stays on the circle."""
    m, g, l = 0.2, 9810.0, 300.0  # kg, mm/s², mm
    pendulum = jl.System(
        lambda q, qdot, m, g: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2) - m * g * q["y"],
        holonomic={"rod": lambda q, l: jnp.hypot(q["x"], q["y"]) - l},
    )
    start = {"x": l * np.sin(0.1), "y": -l * np.cos(0.1)}
    plan = jl.Experiment(jnp.linspace(0.0, 1.0, 21), None, start, {"x": 0.0, "y": 0.0}, sigma=1.0)
    pull = lambda multipliers, m, g: multipliers["rod"] / (m * g)
    params = {"m": m, "g": g, "l": l}
    limits = {"rod": (pull, -1.5, 1.5), "below": (lambda q: q["y"], None, 0.0)}
    found = jl.design(pendulum, plan, params, free=("g", "l"), over="q0", within=limits, starts=1)
    assert found.converged and len(found.binding) == 1
    q0 = found.experiment.q0
    np.testing.assert_allclose(np.hypot(q0["x"], q0["y"]), l, rtol=1e-12)
    # released at rest, the rod carries m g (3 − 2 cos φ₀) at the bottom
    np.testing.assert_allclose(3 + 2 * q0["y"] / l, 1.5, atol=2e-6)


@pytest.mark.slow
def test_derivatives_of_the_cost_with_dry_friction():
    """By all that is chosen, against differences; from rest, in mm."""
    from jaxlag._fit.design_plan import Planned
    from jaxlag._fit.design_problem import DesignProblem, Sample
    from jaxlag._fit.information import planned
    from jaxlag._fit.parameters import Free
    from jaxlag._fit.residuals import Model

    block = jl.System(lambda qdot, m: 0.5 * m * qdot**2, dissipation=lambda qdot, F: F * jnp.abs(qdot), force=lambda t, u: u(t))
    plan = jl.Experiment(jnp.linspace(0.0, 2.0, 11), None, 0.0, 0.0, sigma=1.0, params={"u": jl.Chirp(6.0, 9.0, 2.0, 4e3)})
    (plan,), params = planned(plan, {"m": 2.0, "F": 1.5e3})
    free = Free.of(params, ("m", "F"))
    numerics = {"rtol": 1e-10, "atol": 1e-10}
    part = Planned.of(Model.of(block, numerics), free, plan, params, ("u", "qdot0"), {})
    problem = DesignProblem.of([part], [Sample(free, np.zeros((2, 2)))], jl.DOptimal(), ())
    y = np.array([0.1, -0.2, 0.05, 0.3, 0.0])
    cost, slope = problem.cost(y)
    h = 1e-5
    differences = [(problem.cost(y + e)[0] - problem.cost(y - e)[0]) / (2 * h) for e in h * np.eye(5)]
    np.testing.assert_allclose(slope, differences, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_what_is_predicted_is_what_scatters_with_dry_friction():
    friction = {"dry": lambda qdot, F: F * jnp.abs(qdot), "viscous": lambda qdot, b: 0.5 * b * qdot**2}
    rough = jl.System(lambda q, qdot, m, k: 0.5 * m * qdot**2 - 0.5 * k * q**2, dissipation=friction, force=lambda t, u: u(t))
    u = jl.Multisine(4.0, harmonics=5, amplitude=20.0)
    plan = jl.Experiment(jnp.linspace(0.0, 4.0, 81), None, 0.0, 0.0, sigma=1e-2, params={"u": u})
    params, free = {"m": 0.002, "k": 0.5, "F": 5.0, "b": 0.005}, ("m", "k", "F", "b")  # t, N/mm, N, N s/mm
    found = jl.design(rough, plan, params, free=free, over="u", within={"force": (lambda t, u: u(t), -50.0, 50.0)}, starts=1)
    repeats = jl.recover(rough, found.experiment, params, free=free, repeats=200)
    errors = np.array([found.after.standard_errors[name] for name in free])
    np.testing.assert_allclose(repeats.predicted, errors, rtol=1e-6)
    np.testing.assert_allclose(repeats.scatter, errors, rtol=0.15)
    assert not repeats.failures and np.all(np.abs(repeats.bias) < 4 * repeats.bias_error)
    before = np.array([found.before.standard_errors[name] for name in free])
    assert np.all(errors < before)


@pytest.mark.slow
def test_a_double_pendulum_on_a_driven_cart():
    """The least eigenvalue of the information rises by more than 10³ from a weak input, as that of Wilson, Schultz & Murphey (2014)."""

    def energy(q, qdot, m1, m2, l1, l2, g):
        a, b = q["a"], q["b"]
        v1 = qdot["x"] + l1 * qdot["a"] * jnp.cos(a), l1 * qdot["a"] * jnp.sin(a)
        v2 = v1[0] + l2 * qdot["b"] * jnp.cos(b), v1[1] + l2 * qdot["b"] * jnp.sin(b)
        kinetic = 0.5 * qdot["x"] ** 2 + 0.5 * m1 * (v1[0] ** 2 + v1[1] ** 2) + 0.5 * m2 * (v2[0] ** 2 + v2[1] ** 2)
        return kinetic + m1 * g * l1 * jnp.cos(a) + m2 * g * (l1 * jnp.cos(a) + l2 * jnp.cos(b))

    damping = lambda qdot, c: 0.5 * c * (qdot["a"] ** 2 + (qdot["b"] - qdot["a"]) ** 2)
    system = jl.System(energy, force=lambda t, u: {"x": u(t)}, dissipation=damping)
    rest = dict.fromkeys(("x", "a", "b"), 0.0)
    u = jl.Multisine(5.0, harmonics=5, amplitude=0.02)
    plan = jl.Experiment(
        jnp.linspace(0.0, 5.0, 101), None, rest, rest, sigma=1e-2, params={"u": u}, observe=lambda q: {"a": q["a"], "b": q["b"]}
    )
    params, free = {"m1": 0.085, "m2": 0.06, "l1": 0.3, "l2": 0.25, "c": 1e-3, "g": 9.81}, ("m1", "m2", "l1", "l2", "c")
    limits = {"force": (lambda t, u: u(t), -5.0, 5.0), "rail": (lambda q: q["x"], -0.5, 0.5)}
    found = jl.design(system, plan, params, free=free, over="u", criterion=jl.EOptimal(), within=limits, starts=1, steps=12)
    values = np.array([params[name] for name in free])
    least = lambda of: np.linalg.eigvalsh(of.matrix * np.outer(values, values))[0]
    assert least(found.after) > 1e3 * least(found.before)


def test_wrong_use():
    plan, params = pushed(), {"m": 2.0, "b": 1.0}
    of = lambda **changed: jl.design(cart, plan, params, **({"free": ("m", "b"), "over": "u", "starts": 1} | changed))
    with pytest.raises(ValueError, match="`free` must name"):
        of(free="F")
    with pytest.raises(ValueError, match="`over` must name entries of the plan or of params, but holds 'w'. There are .*u.cosines"):
        of(over="w")
    with pytest.raises(ValueError, match="'b' is part of what is free"):
        of(over="b")
    with pytest.raises(ValueError, match="`over` must name what is chosen, but is empty"):
        of(over=())
    with pytest.raises(TypeError, match="`criterion` must be one of jaxlag's"):
        of(criterion="D")
    with pytest.raises(ValueError, match="`Along` must name free parameters, but names 'k'"):
        of(criterion=jl.Along("k"))
    with pytest.raises(ValueError, match="`samples` must have a row for each sample"):
        jl.Average({"m": [1.0, 2.0], "b": [1.0]})
    with pytest.raises(ValueError, match=r"`within\['force'\]` must be \(function, lower, upper\)"):
        of(within={"force": lambda t: t})
    with pytest.raises(ValueError, match=r"`within\['force'\]` must be in order"):
        of(within={"force": (lambda t, u: u(t), 1.0, -1.0)})
    with pytest.raises(ValueError, match="has no `sigma`"):
        jl.design(cart, jl.Experiment(plan.ts, None, 0.0, 0.0, params=plan.params), params, free="b", over="u")
    with pytest.raises(ValueError, match="`within` must limit motions"):
        jl.design(driven, at_one_frequency()[0], {"k": 1.0, "b": 0.2}, free="b", over="omega", within=LIMITS)
    with pytest.raises(ValueError, match="`params` must not have an entry 'q0'"):
        jl.design(cart, plan, params | {"q0": 1.0}, free="b", over=("q0",))


def test_limits_that_contradict_each_other_are_named():
    limits = LIMITS | {"there": (lambda t, q: q * (t > 4.0) + (t <= 4.0), 0.9, None), "back": (lambda t, q: q * (t > 3.0), None, 0.1)}
    with pytest.raises(ValueError, match=r"'there \(lower\)' and 'back \(upper\)' contradict each other"):
        jl.design(cart, pushed(), {"m": 2.0, "b": 1.0}, free=("m", "b"), over="u", within=limits, starts=1)


def test_a_plan_without_a_motion():
    falls = jl.System(lambda qdot, m: 0.5 * m * qdot**2, force=lambda q, F: F * q**2)
    plan = jl.Experiment(jnp.linspace(0.0, 10.0, 11), None, 1.0, 1.0, sigma=1e-3)
    with pytest.raises(ValueError, match="`params` must give a motion, but it ended with"):
        jl.design(falls, plan, {"m": 1.0, "F": 10.0}, free="F", over="q0", starts=1)
