"""A motion that is called successful satisfies what it promises; one that is not says its own reason, and when."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._motion.results import reason_of

TS = np.linspace(0, 1, 11)
UNDEFINED = "the functions of the system must return finite numbers"
CONTRADICTORY = "the constraints are not satisfied there: they contradict each other"
LOCKED = "the constraints leave no way to continue"


def kinetic(qdot):
    return 0.5 * qdot @ qdot


# Linear constraints A q = ½ b max(t − s, 0)² between coordinates of any inertia under any load: G q̈ = b has a closed form

linear = jl.System(
    lambda q, qdot, M, f: 0.5 * qdot @ M @ qdot + f @ q, holonomic=lambda t, q, A, b, s: A @ q - 0.5 * b * jnp.maximum(t - s, 0.0) ** 2
)
N, ROWS = 5, 3


def rows(seed, kind, e):
    """Two rows and a third that follows from them, nearly follows, or contradicts them, by e."""
    rng = np.random.default_rng(seed)
    root, A, b, share = rng.normal(size=(N, N)), rng.normal(size=(ROWS, N)), rng.normal(size=ROWS), rng.normal(size=2)
    A[2], b[2] = share @ A[:2] + (e * A[2] if kind == "near" else 0), share @ b[:2] + (e if kind == "against" else e * b[2])
    order, units = rng.permutation(ROWS), 10.0 ** rng.uniform(-2, 2, ROWS)
    return {"M": root @ root.T + 0.1 * np.eye(N), "f": rng.normal(size=N), "A": units[:, None] * A[order], "b": units * b[order], "s": 0.0}


def exact(params, rank):
    """q̈ in fifty digits, by as many of the rows as are not the others'."""
    with mpmath.workdps(50):
        M, f, A, b = (mpmath.matrix(np.asarray(params[name]).tolist()) for name in ("M", "f", "A", "b"))
        A, b = A[:rank, :], b[:rank]
        mobility, free = M**-1 * A.T, mpmath.lu_solve(M, f)
        return np.array([float(x) for x in free + mobility * mpmath.lu_solve(A * mobility, b - A * free)])


accelerations = jax.jit(jax.vmap(lambda p: jl.acceleration(linear, jnp.zeros(N), jnp.zeros(N), p, t=1.0).qddot))
KINDS = (
    [("near", e) for e in (0.1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)]
    + [("same", 0.0)]
    + [("against", e) for e in (1.0, 1e-2, 1e-3)]
)


@pytest.mark.parametrize("kind, e", KINDS)
def test_random_constraints_are_satisfied_or_refused(kind, e):
    """Against the exact solution; what rounding of the rows themselves makes of it grows as 1/e."""
    cases = [rows(seed, kind, e) for seed in range(30)]
    found = np.asarray(accelerations(jax.tree.map(lambda *leaves: jnp.stack(leaves), *cases)))
    refused = np.isnan(found).any(axis=1)
    if kind == "against":
        assert refused.all()
        return
    assert refused.mean() <= (0.2 if e == 1e-9 else 0.1 if kind == "near" else 0)
    for qddot, case in zip(found[~refused], np.array(cases)[~refused], strict=True):
        expected = exact(case, ROWS if kind == "near" else 2)
        rounding = 1e-11 / (e or 1)
        np.testing.assert_allclose(qddot, expected, rtol=0, atol=rounding * (1 + np.max(np.abs(expected))))


@pytest.mark.slow
@pytest.mark.parametrize("kind, e", [("near", 1e-3), ("near", 1e-6), ("same", 0.0), ("against", 1.0), ("against", 1e-3)])
def test_random_constraints_are_kept_or_the_motion_fails(kind, e):
    """Exact, or a failure by name; where rows are nearly the same, a tenth is refused, as more is asked of them than of all else."""
    rest, moving = TS <= 0.35, np.where(TS > 0.35, TS - 0.35, 0)
    refused = 0
    for seed in range(20):
        case = rows(seed, kind, e)
        case |= {"s": 0.35, "f": 0 * case["f"]}
        motion = jl.simulate(linear, np.zeros(N), np.zeros(N), TS, case, throw=False)
        np.testing.assert_allclose(motion.q[rest], 0, rtol=0, atol=1e-12)
        if not motion.succeeded:
            refused += 1
            assert reason_of(motion.result).startswith(CONTRADICTORY) and 0.35 < motion.stats["reached"] < 0.45
            assert np.all(np.isnan(motion.q[~rest])) and np.all(np.isnan(motion.multipliers["holonomic"][~rest]))
        else:
            expected = exact(case, ROWS if kind == "near" else 2)
            np.testing.assert_allclose(motion.q, 0.5 * np.outer(moving**2, expected), rtol=0, atol=1e-9 / (e or 1) ** 0.5)
    assert refused == 20 if kind == "against" else refused <= (2 if e == 1e-6 else 0)


@pytest.mark.slow
def test_one_of_many_that_contradicts_itself_says_so():
    cases = [rows(7, "same", 0.0), rows(7, "against", 1.0)]
    many = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cases)
    motions = jl.simulate_many(linear, np.zeros(N), np.zeros(N), TS, many, over=("M", "f", "A", "b", "s"), throw=False)
    assert motions.succeeded.tolist() == [True, False] and reason_of(motions.result).startswith(CONTRADICTORY)


# A mechanism at the end of its reach: two bars of length 1, whose end is driven outwards; a crank by one constraint alone

two_bars = jl.System(
    lambda qdot: kinetic(qdot),
    holonomic=lambda t, q: jnp.stack([jnp.cos(q[0]) + jnp.cos(q[0] + q[1]) - (1.9 + 0.2 * t), jnp.sin(q[0]) + jnp.sin(q[0] + q[1])]),
)
crank = jl.System(lambda qdot: 0.5 * qdot**2, holonomic=lambda t, q: jnp.cos(q) - (0.5 + t))


@pytest.mark.slow
@pytest.mark.parametrize("system, q0", [(two_bars, np.array([0.3, -0.6])), (crank, 1.0)])
def test_a_mechanism_driven_beyond_its_reach(system, q0):
    """At t = 1/2 the end is as far away as it can be, and both reasons say so: which one, rounding decides in the last step."""
    reasons = rf"({LOCKED}: .*beyond its reach|{CONTRADICTORY}, .*more than the mechanism can reach)"
    with pytest.raises(RuntimeError, match=rf"stopped at t = 0\.(5 after 5|55 after 6) of 11 samples: {reasons}"):
        jl.simulate(system, q0, 0 * q0, TS)


@pytest.mark.slow
def test_a_crank_driven_beyond_its_reach():
    """cos q = ½ + t is followed up to t = ½, whoever asks; its derivative by a factor of the angle is that of arccos."""
    run = lambda a: jl.simulate(turned, 1.0, 0.0, TS, {"a": a}, throw=False).q
    np.testing.assert_allclose(run(1.0)[:5], np.arccos(0.5 + TS[:5]), rtol=1e-9)
    assert np.all(np.isnan(run(1.0)[6:]))
    np.testing.assert_allclose(jax.jacfwd(run)(1.0)[:5], -np.arccos(0.5 + TS[:5]), rtol=1e-7)


turned = jl.System(lambda qdot: 0.5 * qdot**2, holonomic=lambda t, q, a: jnp.cos(a * q) - (0.5 + t))


# Coordinates without inertia that velocities alone hold

ramp = {"a": 0.3, "b": 0.1, "x": 0.0}


@pytest.mark.slow
def test_a_coordinate_that_a_velocity_constraint_alone_holds():
    """b has no inertia and goes along with a; x is beside them, on a constraint of positions."""
    system = jl.System(
        lambda qdot: 0.5 * qdot["a"] ** 2 + 0.5 * qdot["x"] ** 2,
        nonholonomic=lambda qdot: qdot["a"] - 2 * qdot["b"],
        holonomic=lambda t, q: q["x"] - q["a"],
    )
    q, qdot = jl.consistent_state(system, ramp, {"a": 1.0, "b": 7.0, "x": 0.0})
    np.testing.assert_allclose([qdot["a"], qdot["b"], qdot["x"]], [0.5, 0.25, 0.5], rtol=1e-12)
    np.testing.assert_allclose([q["x"] - q["a"], q["a"] + q["x"]], [0, 0.3], atol=1e-12)
    motion = jl.simulate(system, q, qdot, TS)
    np.testing.assert_allclose(motion.q["b"], q["b"] + 0.25 * TS, rtol=1e-9)


@pytest.mark.slow
def test_a_coordinate_that_a_velocity_alone_holds_where_nothing_holds_positions():
    system = jl.System(lambda qdot: 0.5 * qdot["a"] ** 2, nonholonomic=lambda qdot: qdot["a"] - qdot["b"])
    start = {"a": 0.3, "b": 0.1}, {"a": 1.0, "b": 0.0}
    q, qdot = jl.consistent_state(system, *start)
    np.testing.assert_allclose([q["a"], q["b"], qdot["a"], qdot["b"]], [0.3, 0.1, 1, 1], rtol=1e-13)
    np.testing.assert_allclose(jl.simulate(system, *start, TS).q["b"], 0.1 + TS, rtol=1e-10)
    findings = jl.examine(system, *start).findings
    assert any("ties 'b', without inertia, to 'a', and its λ pushes these too" in finding for finding in findings)


# Every failure says its own reason

free = {"a": 0.0, "b": 0.0}
FAILURES = {
    "NaN in L at the start": (jl.System(lambda q, qdot: 0.5 * qdot**2 - jnp.sqrt(q)), -1.0, 0.0, rf"stopped at t = 0 .*{UNDEFINED}"),
    "NaN in M": (jl.System(lambda q, qdot: 0.5 * jnp.sqrt(q) * qdot**2), -1.0, 0.0, rf"stopped at t = 0 .*{UNDEFINED}"),
    "NaN in g": (jl.System(lambda qdot: 0.5 * qdot**2, holonomic=lambda q: jnp.sqrt(q - 1)), 0.0, 0.0, rf"stopped at t = 0 .*{UNDEFINED}"),
    "NaN on the way": (
        jl.System(lambda qdot: 0.5 * qdot**2, force=lambda t: jnp.sqrt(0.55 - t)),
        0.0,
        0.0,
        rf"stopped at t = 0\.55 after 6 of 11 samples: {UNDEFINED}",
    ),
    "not affine": (
        jl.System(kinetic, nonholonomic=lambda qdot: qdot[0] + qdot[1] ** 2 - 2),
        np.zeros(2),
        np.ones(2),
        r"`nonholonomic` must be affine in qdot.* not affine in the velocity of: 'q\[1\]'",
    ),
    "no inertia": (jl.System(lambda qdot: 0.5 * qdot["a"] ** 2), free, free, "every direction inertia.* unconstrained here: 'b'"),
    "no state": (jl.System(lambda qdot: 0.5 * qdot**2, holonomic=lambda q: q**2 + 1), 0.5, 0.0, "must be satisfied by some state"),
    "NaN in q0": (crank, np.nan, 0.0, "`q0`, `qdot0`, `ts` and `params` must be finite"),
    "NaN in qdot0": (crank, 1.0, np.nan, "`q0`, `qdot0`, `ts` and `params` must be finite"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", FAILURES)
def test_every_failure_says_its_own_reason(case):
    system, q0, qdot0, sentence = FAILURES[case]
    with pytest.raises((RuntimeError, ValueError), match=sentence):
        jl.simulate(system, q0, qdot0, TS)


AT_STATE = [jl.acceleration, jl.constraint_force, jl.consistent_state, jl.mass_matrix, jl.momentum, jl.energy, jl.powers, jl.examine]


@pytest.mark.parametrize("function", [*AT_STATE, jl.constraint_jacobian, jl.constraint_residual])
@pytest.mark.parametrize("place", ["q", "qdot", "params"])
def test_no_function_makes_numbers_of_nan(function, place):
    """A NaN goes in: an error by name, or nothing but NaN of what depends on it."""
    system = jl.System(
        lambda q, qdot, m: 0.5 * m * q @ q * qdot @ qdot,
        dissipation=lambda qdot, m: m * qdot @ qdot,
        holonomic=lambda q, m: m * (q @ q - 1),
    )
    given = {"q": np.array([1.0, 0.0]), "qdot": np.array([0.0, 1.0]), "params": {"m": 1.0}}
    given[place] = {"m": np.nan} if place == "params" else given[place] * np.nan
    try:
        out = function(system, *given.values())
    except ValueError as error:
        assert "must" in str(error)
        return
    independent = {("qdot", jl.mass_matrix), ("qdot", jl.constraint_jacobian)}
    assert (place, function) in independent or any(np.any(np.isnan(leaf)) for leaf in jax.tree.leaves(out))


UNUSED = jl.System(lambda q, qdot, m, k: 0.5 * m * qdot**2 - 0.0 * k * q)  # for numbers; in IEEE arithmetic 0·NaN is NaN


@pytest.mark.parametrize("function", [*AT_STATE, jl.linearise, jl.equilibrium])
def test_a_parameter_that_is_nan_is_refused_where_its_factor_is_zero(function):
    with pytest.raises(ValueError, match=r"`params\['k'\]` must be known, but is NaN. Give it a value."):
        function(UNUSED, 1.0, *(() if function is jl.equilibrium else (0.0,)), {"m": 1.0, "k": np.nan})


@pytest.mark.slow
def test_a_parameter_that_is_nan_gives_nan_within_a_program():
    qddot = lambda k: jl.acceleration(UNUSED, 1.0, 0.0, {"m": 1.0, "k": k}).qddot
    A = lambda k: jl.linearise(UNUSED, 1.0, 0.0, {"m": 1.0, "k": k}).A
    np.testing.assert_array_equal(jax.vmap(qddot)(np.array([1.0, np.nan])), [0.0, np.nan])
    assert np.isnan(jax.jit(qddot)(np.nan)) and np.all(np.isnan(jax.jit(A)(np.nan)))
    with pytest.raises(ValueError, match="must be known, but is NaN"):
        jax.grad(qddot)(np.nan)


@pytest.mark.slow
def test_maps_over_a_parameter_that_is_not_known_yet():
    """A root locus and a map give it its values; what they do not give must be known."""
    oscillator = jl.System(lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2)
    given = {"m": 1.0, "c": 4.0, "b": np.nan}
    assert jl.root_locus(oscillator, 0.0, params=given, over="b", values=[0.1, 0.2]).crossings == ()
    for call in (jl.root_locus, lambda *args, over, values, **more: jl.stability_map(*args, over={"c": values, "m": values}, **more)):
        with pytest.raises(ValueError, match=r"`params\['b'\]` must be known"):
            call(oscillator, 0.0, params=given, over="c", values=[1.0, 2.0])


@pytest.mark.slow
def test_a_sample_that_is_no_number_is_no_success():
    """Steps that end at no jump pass by a moment at which the rod has no length; a sample does not."""
    length = lambda t: 1.0 + jnp.where(jnp.abs(t - 0.5) < 1e-9, jnp.nan, 0.0)
    rod = jl.System(lambda q, qdot: kinetic(qdot) - 9.81 * q[1], holonomic=lambda t, q: jnp.hypot(*q) - length(t))
    swing = lambda ts: jl.simulate(rod, np.array([1.0, 0.0]), np.zeros(2), ts, surfaces=jl.surfaces.NotLocated(), throw=False)
    assert swing(np.linspace(0, 1, 20)).result == jl.results.RESULTS.successful  # none of which is at the moment
    motion = swing(np.linspace(0, 1, 21))
    assert motion.result == jl.results.RESULTS.undefined and motion.stats["reached"] == 0.5
    assert np.all(np.isfinite(motion.q[:10])) and np.all(np.isnan(motion.q[10:]))
