"""The lowest modes of many coordinates: against closed forms, all modes by dense matrices, and what must be refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse.linalg
from scipy.special import roots_laguerre

import jaxlag as jl

G = 9.81


def spring_chain(q, qdot, m, c):
    return 0.5 * m * qdot @ qdot - 0.5 * c * jnp.sum(jnp.diff(q, prepend=0.0, append=0.0) ** 2)


CHAIN = jl.System(spring_chain)
N = 300


def frequencies(count, c):
    """Of N masses of 1 between two walls."""
    return 2 * np.sqrt(c) * np.sin(np.arange(1, count + 1) * np.pi / (2 * N + 2))


@pytest.mark.slow
def test_a_chain_of_springs_and_its_derivatives():
    found = lambda c: jl.lowest_modes(CHAIN, jnp.zeros(N), {"m": 1.0, "c": c}, count=5)
    modes, there = found(4.0), frequencies(5, 4.0)
    np.testing.assert_allclose(modes.angular_frequency, there, rtol=1e-12)
    assert np.all(modes.stable) and not np.any(modes.repeated) and np.all(modes.damping_ratio == 0)
    shape = np.sin(np.pi * 2 * np.arange(1, N + 1) / (N + 1))
    np.testing.assert_allclose(np.abs(modes.shapes[1]), np.abs(shape) / np.max(np.abs(shape)), atol=1e-9)
    of = lambda c: found(c).angular_frequency
    np.testing.assert_allclose(jax.jvp(of, (4.0,), (1.0,))[1], there / 8, rtol=1e-10)
    np.testing.assert_allclose(jax.grad(lambda c: of(c) @ np.arange(5.0))(4.0), there @ np.arange(5.0) / 8, rtol=1e-10)


@pytest.mark.slow
def test_what_has_no_derivative_says_so():
    found = lambda c: jl.lowest_modes(CHAIN, jnp.zeros(N), {"m": 1.0, "c": c}, count=2)
    assert np.isnan(jax.grad(lambda c: found(c).shapes[0, 3])(4.0))
    assert np.isnan(jax.jacfwd(jax.grad(lambda c: found(c).angular_frequency[0]))(4.0))
    assert np.isnan(jax.grad(jax.grad(lambda c: found(c).angular_frequency[0]))(4.0))


def lengths(q, l):
    return jnp.sum(jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), q]), axis=0) ** 2, axis=1) - l**2


ROPE = jl.System(lambda q, qdot, m, g: 0.5 * m * jnp.sum(qdot**2) - m * g * jnp.sum(q[:, 1]), holonomic={"rods": lengths})


@pytest.mark.slow
@pytest.mark.parametrize("links", [pytest.param(100, marks=pytest.mark.slow), 500])
def test_a_hanging_rope_swings_as_laguerre_says(links):
    """ω² = g ξ/l with Lₙ(ξ) = 0 (Rouse–Laguerre); nothing depends on the mass, and all of it on √(g/l)."""
    hanging = np.stack([np.zeros(links), -np.arange(1.0, links + 1)], axis=1)
    params = {"m": 0.3, "g": G, "l": 0.5}
    at = jl.equilibrium(ROPE, 0.5 * hanging + 0.01 * np.sin(hanging), params)
    of = lambda params: jl.lowest_modes(ROPE, hanging * params["l"], params, count=8)
    found = jl.lowest_modes(ROPE, at, params, count=8)
    roots = roots_laguerre(links)[0][:8] if links < 200 else jnp.linalg.eigvalsh(_laguerre(links))[:8]
    expected = np.sqrt(G / 0.5 * roots)
    np.testing.assert_allclose(found.angular_frequency, expected, rtol=1e-9)
    np.testing.assert_allclose(np.asarray(found.shapes)[:, :, 1], 0, atol=1e-9)
    slope = jax.jacfwd(lambda p: of(p).angular_frequency)(params)
    np.testing.assert_allclose(slope["g"], expected / (2 * G), rtol=1e-8)
    np.testing.assert_allclose(slope["l"], -expected, rtol=1e-8)
    np.testing.assert_allclose(slope["m"], 0, atol=1e-8)


def _laguerre(n):
    """The Jacobi matrix of the polynomials: its eigenvalues are their zeros."""
    return np.diag(2.0 * np.arange(n) + 1) + np.diag(np.arange(1.0, n), 1) + np.diag(np.arange(1.0, n), -1)


K = 8


def net(q, qdot, m, c, g, turn):
    """Masses in space in a row, on springs; each is pulled aside as in a turning frame."""
    ends = jnp.concatenate([jnp.zeros((1, 3)), q, jnp.array([[K + 4.0, 0.0, 0.0]])])
    stretched = jnp.sqrt(jnp.sum(jnp.diff(ends, axis=0) ** 2, axis=1)) - 0.9
    coriolis = m * turn * jnp.sum(q[:, 1] * qdot[:, 2] - q[:, 2] * qdot[:, 1])
    return (
        0.5 * m * jnp.sum((1 + 0.1 * jnp.arange(K)[:, None]) * qdot**2)
        - 0.5 * c * stretched @ stretched
        - m * g * jnp.sum(q[:, 1])
        + coriolis
    )


def rubbing(qdot, b):
    return 0.5 * b * jnp.sum(jnp.diff(qdot, axis=0) ** 2) + 0.05 * b * jnp.sum(qdot[::2] ** 2)


SLIDES = {"slides": lambda q: q[::3, 0] * (1 + q[::3, 1]) - 1.1 - 3.2 * jnp.arange(3.0)}
STARTS = jnp.stack([jnp.arange(1.0, K + 1), jnp.full(K, 0.1), jnp.zeros(K)], axis=1)
PARAMS = {"m": 1.3, "c": 40.0, "g": 0.4, "turn": 0.0, "b": 0.0}
KINDS = {
    "undamped": (jl.System(net, holonomic=SLIDES), {}),
    "damped": (jl.System(net, dissipation=rubbing, holonomic=SLIDES), {"b": 0.3}),
    "turning": (jl.System(net, holonomic=SLIDES), {"turn": 0.7}),
    "turning and damped": (jl.System(net, dissipation=rubbing, holonomic=SLIDES), {"turn": 0.7, "b": 0.3}),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*(pytest.param(kind, marks=pytest.mark.slow) for kind in list(KINDS)[:3]), "turning and damped"])
def test_all_modes_by_dense_matrices_say_the_same(kind):
    """Eigenvalues, damping, shapes and constraint forces; and how eigenvalues follow params, through the state of rest too."""
    system, more = KINDS[kind]
    params = PARAMS | more
    rest = lambda p: jl.equilibrium(system, STARTS, p)
    few = lambda p: jl.lowest_modes(system, rest(p), p, count=6)
    every = lambda p: jl.linearise(system, rest(p), params=p).modes()
    found, there = few(params), every(params)
    np.testing.assert_allclose(found.eigenvalues, there.eigenvalues[:6], rtol=1e-8)
    np.testing.assert_allclose(found.damping_ratio, there.damping_ratio[:6], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found.shapes, there.shapes[:6], atol=1e-6)
    scale = np.max(np.abs(there.multipliers["slides"][:6]))
    np.testing.assert_allclose(found.multipliers["slides"] / scale, there.multipliers["slides"][:6] / scale, atol=1e-5)

    varied = {name: x for name, x in params.items() if x}
    slopes = jax.jacfwd(lambda p: few(params | p).eigenvalues)(varied)
    for name, x in varied.items():
        up, down = (every(params | {name: x * (1 + d)}).eigenvalues[:6] for d in (1e-4, -1e-4))
        np.testing.assert_allclose(slopes[name], (up - down) / (2e-4 * x), rtol=1e-5, atol=1e-7 * np.max(np.abs(slopes[name])))


@pytest.mark.slow
def test_derivatives_in_reverse():
    system, params = KINDS["damped"][0], PARAMS | KINDS["damped"][1]
    of = lambda p: jl.lowest_modes(system, jl.equilibrium(system, STARTS, p), p, count=6).eigenvalues.imag @ np.arange(1.0, 7)
    backwards, forwards = (derivative(of)(params) for derivative in (jax.grad, jax.jacfwd))
    for name in params:
        np.testing.assert_allclose(backwards[name], forwards[name], rtol=1e-9, atol=1e-12)


def string(q, qdot, m, c, s):
    """A string that swings in two directions, of different tension where s is not zero."""
    squares = jnp.sum(jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), q, jnp.zeros((1, 2))]), axis=0) ** 2, axis=0)
    return 0.5 * m * jnp.sum(qdot**2) - 0.5 * c * (squares[0] + (1 + s) * squares[1])


def test_pictures_take_them():
    modes = jl.lowest_modes(CHAIN, jnp.zeros(N), {"m": 1.0, "c": 4.0}, count=2)
    points = {f"{i}": lambda q, i=i: jnp.stack([jnp.full((), 1.0 * i, q.dtype), q[i]]) for i in range(0, N, 30)}
    assert len(np.ravel(jl.plot.mode_shapes(modes, points))) == 2
    assert jl.plot.animate(modes[1], points) is not None


@pytest.mark.slow
def test_repeated_modes():
    """Of two that are equal the mean is smooth: half of what one of them gains."""
    system, half = jl.System(string), N // 2
    found = lambda s: jl.lowest_modes(system, jnp.zeros((half, 2)), {"m": 1.0, "c": 4.0, "s": s}, count=4)
    there = 4 * np.sin(np.repeat([1, 2], 2) * np.pi / (2 * half + 2))
    modes = found(0.0)
    np.testing.assert_allclose(modes.angular_frequency, there, rtol=1e-11)
    assert np.all(modes.repeated)
    np.testing.assert_allclose(jax.jacfwd(lambda s: found(s).angular_frequency)(0.0), there / 4, rtol=1e-9)
    damped = jl.System(string, dissipation=lambda qdot, b: 0.5 * b * jnp.sum(qdot**2))
    of = lambda b: jl.lowest_modes(damped, jnp.zeros((half, 2)), {"m": 1.0, "c": 4.0, "s": 0.0, "b": b}, count=4)
    np.testing.assert_allclose(of(0.01).eigenvalues, -0.005 + 1j * np.sqrt(there**2 - 0.005**2), rtol=1e-9)
    assert np.all(of(0.01).repeated) and np.all(np.isnan(jax.jacfwd(lambda b: of(b).damping_ratio)(0.01)))


def test_a_free_body_needs_a_shift():
    """A row of masses on springs that nothing holds: it may go anywhere, as a whole."""
    free = jl.System(lambda q, qdot, m, c: 0.5 * m * qdot @ qdot - 0.5 * c * jnp.sum((jnp.diff(q) - 1) ** 2))
    start, params = jnp.arange(1.0 * N), {"m": 1.0, "c": 4.0}
    there = 4 * np.sin(np.arange(5) * np.pi / (2 * N))
    modes = jl.lowest_modes(free, start, params, count=5, shift=0.002)
    assert modes.eigenvalues[0] == 0
    np.testing.assert_allclose(modes.angular_frequency, there, rtol=1e-9)
    np.testing.assert_allclose(np.abs(modes.shapes[0]), 1, rtol=1e-9)
    for c in (4.0, 3.7):  # the second is singular within rounding only
        with pytest.raises(ValueError, match="`shift` must make"):
            jl.lowest_modes(free, start, params | {"c": c})


def test_what_falls_is_among_the_lowest():
    """Of rods on top of each other all swing the other way: λ² = g ξ/l, the largest first, and no shift is near it."""
    links = 12
    standing = np.stack([np.zeros(links), np.arange(1.0, links + 1)], axis=1)
    params = {"m": 1.0, "g": G, "l": 1.0}
    found = jl.lowest_modes(ROPE, standing, params, count=3)
    assert not np.any(found.stable)
    np.testing.assert_allclose(found.eigenvalues**2, G * roots_laguerre(links)[0][::-1][:3], rtol=1e-9)


def test_a_mode_that_the_search_left_out_is_found(monkeypatch):
    """By the inertia of the matrices: here the first search keeps the lowest one for itself."""
    search, calls = scipy.sparse.linalg.eigsh, []

    def forgetful(*given, **options):
        squares, vectors = search(*given, **options)
        calls.append(len(squares))
        kept = np.argsort(squares)[1:] if len(calls) == 1 else np.arange(len(squares))
        return squares[kept], vectors[:, kept]

    monkeypatch.setattr(scipy.sparse.linalg, "eigsh", forgetful)
    found = jl.lowest_modes(CHAIN, jnp.zeros(N), {"m": 1.0, "c": 4.0}, count=4)
    np.testing.assert_allclose(found.angular_frequency, frequencies(4, 4.0), rtol=1e-12)
    assert len(calls) == 2 and calls[1] > calls[0]


def test_in_single_precision(single_precision):
    modes = jl.lowest_modes(CHAIN, jnp.zeros(100), {"m": 1.0, "c": 4.0}, count=3)
    assert modes.angular_frequency.dtype == jnp.float32
    np.testing.assert_allclose(modes.angular_frequency, 4 * np.sin(np.arange(1, 4) * np.pi / 202), rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("b", [0.0, 0.05])
def test_constraints_that_follow_from_others(b):
    """Of a chain whose first two masses are held, one of them by three rows of several units; the forces on these are of least norm."""
    n, unit, c = 12, 1e6, 4.0
    rows = {
        "a": lambda q: unit * q[0],
        "b": lambda q: jnp.stack([2 * unit * q[0], q[1]]),
        "c": lambda q: q[0] / 3 + q[1] / 7,  # follows within rounding only
    }
    damped = None if b == 0 else lambda qdot, b: 0.5 * b * jnp.sum(qdot**2)
    system = jl.System(spring_chain, dissipation=damped, holonomic=rows)
    params = {"m": 1.0, "c": c, "b": b}
    modes = jl.lowest_modes(system, jnp.zeros(n), params, count=3)
    w = 2 * np.sqrt(c) * np.sin(np.arange(1, 4) * np.pi / (2 * (n - 2 + 1)))
    np.testing.assert_allclose(modes.eigenvalues, -b / 2 + 1j * np.sqrt(w**2 - b**2 / 4), rtol=1e-10)
    shapes = np.sin(np.outer(np.arange(1, 4), np.arange(1, n - 1)) * np.pi / (n - 1))
    found = np.asarray(modes.shapes)
    np.testing.assert_allclose(found[:, :2], 0, atol=1e-12)
    np.testing.assert_allclose(found[:, 2:] * shapes[:, :1] / found[:, 2:3], shapes, rtol=1e-9, atol=1e-11)
    G = np.array([[unit, 0], [2 * unit, 0], [0, 1], [1 / 3, 1 / 7]])
    for of in (modes, jl.linearise(system, jnp.zeros(n), params=params).modes()[:3]):
        third = np.asarray(of.shapes)[:, 2]
        force = np.stack([0 * third, -c * third])  # Gᵀλ = K x on the two
        multipliers = np.stack([of.multipliers["a"], *np.asarray(of.multipliers["b"]).T, of.multipliers["c"]])
        np.testing.assert_allclose(multipliers, G @ np.linalg.solve(G.T @ G, force), rtol=1e-6, atol=1e-12)


@pytest.mark.slow
def test_what_is_refused():
    params, start = {"m": 1.0, "c": 4.0}, jnp.zeros(20)
    of = lambda system=CHAIN, q=start, **options: jl.lowest_modes(system, q, params, **options)
    with pytest.raises(ValueError, match=r"at rest, but 'q\[3\]' is pushed by -8"):
        of(q=start.at[3].set(1.0))
    with pytest.raises(ValueError, match="half the degrees of freedom, 20, but is 10"):
        of(count=10)
    with pytest.raises(ValueError, match="`jit` or `vmap` hides"):
        jax.jit(lambda q: of(q=q).eigenvalues)(start)
    with pytest.raises(ValueError, match="`jit` or `vmap` hides"):
        jax.vmap(lambda q: of(q=q).eigenvalues)(start[None])
    with pytest.raises(ValueError, match="no dry friction"):
        of(jl.System(spring_chain, dissipation=lambda qdot: jnp.abs(qdot[0])))
    with pytest.raises(ValueError, match="no `nonholonomic`"):
        of(jl.System(spring_chain, nonholonomic=lambda qdot: qdot[0]))
    with pytest.raises(ValueError, match="no contacts"):
        of(jl.System(spring_chain, unilateral=lambda q: q[0]))
    nearly = {"a": lambda q: q[0], "b": lambda q: q[0] + 1e-6 * q[1]}
    with pytest.raises(ValueError, match="each constraint once"):
        of(jl.System(spring_chain, holonomic=nearly), count=3)
    np.testing.assert_allclose(of(jl.System(spring_chain, holonomic=lambda q: q[0]), count=2).shapes[:, 0], 0, atol=1e-12)
