"""Rest of chains of many rods and springs against their closed forms: the horizontal force is the same everywhere."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from program_size import largest_array_and_count
from scipy.optimize import brentq

import jaxlag as jl
from jaxlag._program.block_tridiagonal import factorised, positive_eigenvalues
from jaxlag._program.sparse_matrix import SparseMatrix, SparsityPattern

LINKS, GRAVITY = 100, 9.81


def joined(q, end):
    return jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), q, end[None]]), axis=0)


def weight(q, qdot, m, g):
    return 0.5 * m * jnp.sum(qdot**2) - m * g * jnp.sum(q[:, 1])


def springs(q, qdot, m, g, k, end):
    return weight(q, qdot, m, g) - 0.5 * k * jnp.sum((jnp.sqrt(jnp.sum(joined(q, end) ** 2, axis=1)) - 1) ** 2)


def rods(q, l, end):
    return jnp.sum(joined(q, end) ** 2, axis=1) - l**2


RODS = jl.System(weight, holonomic={"rods": rods})
SPRINGS = jl.System(springs)


def arc(n, span, sign=1):
    """Points of n links of length 1 that turn evenly from the first hook to the second."""
    turn = brentq(lambda b: np.sum(np.cos(np.linspace(-b, b, n))) - span, 0.1, 2.5)
    angles = np.linspace(-turn, turn, n)
    return np.cumsum(np.stack([np.cos(angles), sign * np.sin(angles)], axis=1), axis=0)[:-1]


def params_of(n, **others):
    return {"m": 1.3, "g": GRAVITY, "end": jnp.array([0.6 * n, 0.0])} | others


def horizontal_force(n, m, extent):
    """H such that links of the `extent(tension)` reach from hook to hook, and the vertical forces in the links."""
    vertical = m * GRAVITY * (np.arange(n) - (n - 1) / 2)
    reach = lambda H: np.sum(extent(np.hypot(H, vertical)) * H / np.hypot(H, vertical)) - 0.6 * n
    return brentq(reach, 1e-3 * n, 1e3 * n, xtol=1e-13, rtol=1e-14), vertical


def hanging(n, m, extent):
    H, vertical = horizontal_force(n, m, extent)
    tension = np.hypot(H, vertical)
    return np.cumsum((extent(tension) / tension)[:, None] * np.stack([np.full(n, H), vertical], axis=1), axis=0)[:-1]


def rods_at_rest(l, n=LINKS):
    return jl.equilibrium(RODS, arc(n, 0.6 * n), params_of(n, l=l))


@pytest.mark.slow
@pytest.mark.parametrize("sign, stability", [(1, "stable"), (-1, "unstable")])
def test_a_chain_between_two_hooks_and_the_arch_that_it_makes(sign, stability):
    at = jl.equilibrium(RODS, arc(LINKS, 0.6 * LINKS, sign), params_of(LINKS, l=1.0))
    expected = hanging(LINKS, 1.3, np.ones_like) * [1, sign]
    np.testing.assert_allclose(at.q, expected, atol=1e-10)
    links = np.diff(np.vstack([[0, 0], expected, [0.6 * LINKS, 0]]), axis=0)
    H, _ = horizontal_force(LINKS, 1.3, np.ones_like)
    np.testing.assert_allclose(2 * at.multipliers["rods"] * links[:, 0], -sign * H, rtol=1e-11)
    assert at.stability == stability and at.stiffness is None and at.undecided == ()


@pytest.mark.slow
def test_derivatives_of_the_sag():
    sag = lambda l: rods_at_rest(l).q[LINKS // 2, 1]
    expected = lambda l: hanging(LINKS, 1.3, lambda tension: np.full_like(tension, l))[LINKS // 2, 1]
    h = 1e-3
    differences = (8 * (expected(1 + h) - expected(1 - h)) - (expected(1 + 2 * h) - expected(1 - 2 * h))) / (12 * h)
    np.testing.assert_allclose([jax.jacfwd(sag)(1.0), jax.grad(sag)(1.0)], differences, rtol=1e-8)


@pytest.mark.slow
def test_under_transformations_twice_and_in_single_precision():
    lengths = jnp.array([1.0, 1.02])
    sag = lambda l: rods_at_rest(l).q[:, 1]
    expected = np.stack([hanging(LINKS, 1.3, lambda tension, l=l: np.full_like(tension, l))[:, 1] for l in lengths])
    np.testing.assert_allclose(jax.vmap(sag)(lengths), expected, atol=1e-10)
    np.testing.assert_allclose(jax.jit(sag)(1.0), expected[0], atol=1e-10)
    middle = [hanging(LINKS, 1.3, lambda tension, l=l: np.full_like(tension, l))[LINKS // 2, 1] for l in (0.999, 1.0, 1.001)]
    second = jax.jacfwd(jax.grad(lambda l: sag(l)[LINKS // 2]))(1.0)
    np.testing.assert_allclose(second, np.diff(middle, 2)[0] / 1e-6, rtol=1e-4)
    q, params = jax.tree.map(lambda x: np.asarray(x, np.float32), (arc(LINKS, 0.6 * LINKS), params_of(LINKS, l=1.0)))
    at = jl.equilibrium(RODS, q, params)
    assert at.q.dtype == np.float32
    np.testing.assert_allclose(at.q[:, 1], expected[0], atol=1e-3)


@pytest.mark.slow
def test_straight_at_an_angle_a_chain_swings_down():
    """Pulled to λ l = half the weight below each rod."""
    system = jl.System(weight, holonomic={"rods": lambda q: jnp.sum(jnp.diff(q, axis=0, prepend=0) ** 2, axis=1) - 1})
    start = np.arange(1, LINKS + 1)[:, None] * np.array([np.sin(0.5), -np.cos(0.5)])
    at = jl.equilibrium(system, start, {"m": 1.3, "g": GRAVITY})
    np.testing.assert_allclose(at.q, np.arange(1, LINKS + 1)[:, None] * [0.0, -1.0], atol=1e-10)
    np.testing.assert_allclose(2 * at.multipliers["rods"], -1.3 * GRAVITY * np.arange(LINKS, 0, -1), rtol=1e-11)
    assert at.stability == "stable"


@pytest.mark.slow
@pytest.mark.parametrize("stable", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_springs_that_are_not_stretched_yet(stable):
    """They have no stiffness across, so that Newton's method finds nothing and the potential leads the way."""
    k = 1e4
    at = jl.equilibrium(SPRINGS, arc(LINKS, 0.6 * LINKS), params_of(LINKS, k=k), stable=stable)
    np.testing.assert_allclose(at.q, hanging(LINKS, 1.3, lambda tension: 1 + tension / k), atol=1e-9)
    assert at.stability == "stable"


@pytest.mark.slow
@pytest.mark.parametrize("size", [6, 10])
def test_a_net_that_is_not_stretched_yet(size):
    """It hangs on two corners; forces by hand balance, and no direction falls. So small a net is sparse by little."""
    k, m, number = 1e4, 1.3, np.arange(size**2).reshape(size, size)
    place = np.stack([*np.divmod(np.arange(size**2), size), np.zeros(size**2)], axis=1)
    a, b = np.hstack([[number[1:].ravel(), number[:-1].ravel()], [number[:, 1:].ravel(), number[:, :-1].ravel()]])
    free = np.delete(np.arange(size**2), [0, size - 1])

    def lagrangian(q, qdot, k, m, g):
        points = jnp.asarray(place).at[free].set(q)
        lengths = jnp.sqrt(jnp.sum((points[a] - points[b]) ** 2, axis=1))
        return 0.5 * m * jnp.sum(qdot**2) - 0.5 * k * jnp.sum((lengths - 1) ** 2) - m * g * jnp.sum(q[:, 2])

    at = jl.equilibrium(jl.System(lagrangian), place[free], {"k": k, "m": m, "g": GRAVITY})
    points, pulls = place.copy(), np.zeros_like(place)
    points[free] = at.q
    spans = points[a] - points[b]
    lengths = np.linalg.norm(spans, axis=1, keepdims=True)
    of_springs = k * (1 - 1 / lengths) * spans
    np.add.at(pulls, a, -of_springs)
    np.add.at(pulls, b, of_springs)
    np.testing.assert_allclose(pulls[free], np.tile([0, 0, m * GRAVITY], (free.size, 1)), atol=1e-7)
    assert at.stability == "stable"
    assert len(repr(at)) < 500 and f"({3 * free.size} in all)" in repr(at)


def row_of_springs(q, qdot, m, g, c):
    """Hung one below the other; q counts downwards."""
    return jnp.sum(0.5 * m * qdot**2 + m * g * q - 0.5 * c * (jnp.diff(q, prepend=0) - 1) ** 2)


@pytest.mark.slow
def test_a_row_of_springs_and_a_bead_without_anything():
    """Each is stretched by the weight below; the bead stays, and says so."""
    rng = np.random.default_rng(0)
    m, c = rng.uniform(0.5, 2.0, LINKS), rng.uniform(50.0, 100.0, LINKS)
    below = GRAVITY * np.cumsum(m[::-1])[::-1]
    system = jl.System(lambda q, qdot, m, g, c: row_of_springs(q["z"], qdot["z"], m, g, c) + 0.5 * qdot["bead"] ** 2)
    rest = lambda c: jl.equilibrium(system, {"z": np.arange(1.0, LINKS + 1), "bead": 3.0}, {"m": m, "g": GRAVITY, "c": c})
    at = rest(jnp.asarray(c))
    np.testing.assert_allclose(at.q["z"], np.cumsum(1 + below / c), rtol=1e-12)
    assert at.q["bead"] == 3 and at.undecided == ("bead",) and at.stability == "neutral"
    np.testing.assert_allclose(jax.grad(lambda c: rest(c).q["z"][-1])(jnp.asarray(c)), -below / c**2, rtol=1e-11)


@pytest.mark.slow
def test_without_a_hook_there_is_none():
    loose = jl.System(weight, holonomic={"rods": lambda q: jnp.sum(jnp.diff(q, axis=0) ** 2, axis=1) - 1})
    with pytest.raises(ValueError, match="`q` must be near an equilibrium, but none was found"):
        jl.equilibrium(loose, np.arange(250.0)[:, None] * [0.0, -1.0], {"m": 1.3, "g": GRAVITY})


@pytest.mark.slow
def test_free_springs_are_neutral():
    """A ring of springs that drifts as it likes: its J is singular, and the few coordinates are treated with all zeros; held, it is not."""
    n = 64
    ring = jl.System(lambda q, qdot, c: 0.5 * jnp.sum(qdot**2) - 0.5 * jnp.sum(jnp.diff(q) ** 2) - 0.5 * c * q[0] ** 2)
    for c, stability in ((0.0, "neutral"), (1e-3, "stable"), (-1e-3, "unstable")):
        assert jl.equilibrium(ring, 0.1 * np.sin(np.arange(n)), {"c": c}).stability == stability


@pytest.mark.slow
def test_forces_without_a_potential_are_said():
    n = 64
    system = jl.System(
        lambda q, qdot: jnp.sum(0.5 * qdot**2 - 0.5 * q**2 + q), force={"followers": lambda q: 0.3 * jnp.roll(q, 1).at[0].set(0)}
    )
    at = jl.equilibrium(system, np.zeros(n), {})
    expected = np.linalg.solve(np.eye(n) - 0.3 * np.eye(n, k=-1), np.ones(n))
    np.testing.assert_allclose(at.q, expected, rtol=1e-12)
    assert at.stability == "by the eigenvalues of `linearise`: its forces have no potential"


@pytest.mark.slow
@pytest.mark.parametrize("jit", [False, True])
def test_a_rod_given_twice_is_treated_with_all_zeros(jit):
    """J is singular: of the multipliers, those of least norm share the tension."""
    n = 33
    system = jl.System(weight, holonomic={"rods": rods, "again": lambda q, l: jnp.sum(q[0] ** 2) - l**2})
    rest = lambda l: jl.equilibrium(system, arc(n, 0.6 * n), params_of(n, l=l))
    at = (jax.jit(rest) if jit else rest)(1.0)
    np.testing.assert_allclose(at.q, hanging(n, 1.3, np.ones_like), atol=1e-9)
    np.testing.assert_allclose(at.multipliers["again"], at.multipliers["rods"][0], rtol=1e-8)


AGAIN = jl.System(weight, holonomic={"rods": rods, "again": lambda q, l, end: rods(q, l, end)[3:40]})


@pytest.mark.slow
def test_many_rods_given_twice():
    """More than are treated with all zeros: each of two equal rows has half the tension. Derivatives as of the chain without them."""
    n = 250
    rest = lambda system, l: jl.equilibrium(system, arc(n, 0.6 * n), params_of(n, l=l))
    at, plain = rest(AGAIN, 1.0), rest(RODS, 1.0)
    np.testing.assert_allclose(at.q, hanging(n, 1.3, np.ones_like), atol=1e-9)
    shared = at.multipliers["rods"].at[3:40].add(at.multipliers["again"])
    np.testing.assert_allclose(shared, plain.multipliers["rods"], rtol=1e-9)
    np.testing.assert_allclose(at.multipliers["again"], at.multipliers["rods"][3:40], rtol=1e-9)
    assert at.stability.startswith("not judged")
    seen = lambda system: lambda l: jnp.append(rest(system, l).q[n // 2], rest(system, l).multipliers["rods"][50])
    expected = jax.jacfwd(seen(RODS))(1.0)
    for way in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(way(seen(AGAIN))(1.0), expected, rtol=1e-7)
    of_half = jax.jacfwd(lambda l: rest(AGAIN, l).multipliers["again"][0])(1.0)
    np.testing.assert_allclose(2 * of_half, jax.jacfwd(lambda l: rest(RODS, l).multipliers["rods"][3])(1.0), rtol=1e-7)


WITHOUT_A_HOOK = {
    "rods": lambda q: jnp.sum(jnp.diff(q, axis=0) ** 2, axis=1) - 1,
    "again": lambda q: jnp.sum(jnp.diff(q, axis=0) ** 2, axis=1)[:9] - 1,
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "holonomic",
    [
        pytest.param({"rods": rods, "longer": lambda q, l, end: rods(q, 1.01 * l, end)[:40]}, id="that contradict each other"),
        pytest.param(WITHOUT_A_HOOK, id="without a hook", marks=pytest.mark.slow),
    ],
)
def test_rods_given_twice_that_find_no_rest(holonomic):
    with pytest.raises(ValueError, match="`q` must be near an equilibrium, but none was found"):
        jl.equilibrium(jl.System(weight, holonomic=holonomic), arc(250, 150.0), params_of(250, l=1.0))


def biggest_and_count(n):
    """Of the program that looks for rest."""
    return largest_array_and_count(jax.make_jaxpr(lambda l: rods_at_rest(l, n).q)(1.0))


@pytest.mark.slow
def test_a_thousand_rods_without_an_array_of_all_by_all():
    n = 1000
    at = rods_at_rest(1.0, n)
    np.testing.assert_allclose(at.q, hanging(n, 1.3, np.ones_like), atol=1e-8)
    assert at.stability == "stable"
    of_few, of_many = biggest_and_count(250), biggest_and_count(n)
    assert of_many[0] < 4.5 * of_few[0] < (3 * n) ** 2 / 16
    assert of_many[1] == of_few[1]


def test_signs_of_pivots_are_those_of_eigenvalues():
    """Of a saddle point with rows that come last, against NumPy."""
    rng = np.random.default_rng(3)
    n, m = 30, 12
    dense = np.zeros((n + m, n + m))
    dense[:n, :n] = np.diag(rng.normal(size=n)) + np.diag(rng.normal(size=n - 1), 1)
    for row in range(m):
        dense[[2 * row, 2 * row + 1, 2 * row + 3], n + row] = rng.normal(size=3)
    dense = dense + dense.T
    places = SparsityPattern.of(dense + np.eye(n + m) != 0, n)
    A = SparseMatrix(jnp.asarray(dense[places.rows, places.columns]), places)
    count, sound = positive_eigenvalues(A, factorised(A))
    assert sound and count == np.sum(np.linalg.eigvalsh(dense) > 0)
