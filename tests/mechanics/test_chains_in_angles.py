"""Mass matrices of many coordinates: chains in angles, where they are full, and sparse ones, against dense ones by hand in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import eigvalsh_tridiagonal

import jaxlag as jl
from jaxlag._mechanics.structured_inertia import StructuredInertia, structured_inertia

RNG = np.random.default_rng(3)
GRAVITY = 9.81


def lagrangian(q, qdot, m, l, g):
    """Masses at the ends of links that turn by absolute angles from the vertical."""
    heights = -jnp.cumsum(l * jnp.cos(q))
    vx, vy = jnp.cumsum(l * jnp.cos(q) * qdot), jnp.cumsum(l * jnp.sin(q) * qdot)
    return jnp.sum(0.5 * m * (vx**2 + vy**2) - m * g * heights)


CHAIN = jl.System(lagrangian)


def state(n):
    given = {"m": RNG.uniform(0.5, 2.0, n), "l": RNG.uniform(0.8, 1.2, n), "g": GRAVITY}
    return RNG.uniform(-1, 1, n), RNG.normal(size=n), given


def by_hand(q, v, given):
    """M and f of the chain: m_ij l_i l_j cos(φ_i − φ_j) with m_ij the mass beyond both links."""
    m, l = given["m"], given["l"]
    beyond = np.cumsum(m[::-1])[::-1]
    i = np.arange(q.size)
    shared = beyond[np.maximum(i[:, None], i)] * np.outer(l, l)
    turn = q[:, None] - q
    return shared * np.cos(turn), -(shared * np.sin(turn)) @ v**2 - beyond * l * given["g"] * np.sin(q)


def close(found, expected, tolerance):
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())


@pytest.mark.parametrize("n", [80, 300])
def test_acceleration_of_a_chain(n):
    q, v, given = state(n)
    close(jl.acceleration(CHAIN, q, v, given).qddot, np.linalg.solve(*by_hand(q, v, given)), 1e-10)


def test_velocities_by_a_directional_derivative_and_several_chains_at_once():
    """The same chain, written with the places alone."""

    def from_places(q, qdot, m, l, g):
        places = lambda q: jnp.cumsum(l[:, None] * jnp.stack([jnp.sin(q), -jnp.cos(q)], axis=1), axis=0)
        x, v = jax.jvp(places, (q,), (qdot,))
        return jnp.sum(0.5 * m * jnp.sum(v**2, axis=1) - m * g * x[:, 1])

    system, (q, v, given) = jl.System(from_places), state(80)
    qs = np.stack([q, -0.5 * q, q[::-1]])
    found = jax.vmap(lambda q: jl.acceleration(system, q, v, given).qddot)(qs)
    for q, qddot in zip(qs, found, strict=True):
        close(qddot, np.linalg.solve(*by_hand(q, v, given)), 1e-10)


ONES = np.tril(np.ones((80, 80)))
PRODUCTS = {  # velocities of the masses, by what is made of the steps (links, 2) of each link
    "a triangle on the left": (lambda steps: ONES @ steps, True),
    "made within L": (lambda steps: jnp.tril(jnp.ones((80, 80))) @ steps, True),
    "on the right, transposed": (lambda steps: (steps.T @ ONES.T).T, True),
    "axes in another order": (lambda steps: jnp.einsum("ij,jk->ki", ONES, steps).T, True),
    "from the other end": (lambda steps: (ONES.T @ steps[::-1])[::-1], True),
    "not all of them ones": (lambda steps: (ONES * (1 + 1e-9 * np.eye(80))) @ steps, False),
    "one more": (lambda steps: (ONES + np.eye(80, k=7)) @ steps, False),
    "no triangle": (lambda steps: np.roll(ONES, 3, axis=0) @ steps, False),
}


@pytest.mark.parametrize("name", PRODUCTS)
def test_a_product_with_a_triangle_of_ones_is_a_running_sum(name):
    """And another product is not: compared with JAX's own second derivatives of L."""
    velocities, is_sum = PRODUCTS[name]

    def of_products(q, qdot, m, l, g):
        v = velocities(l[:, None] * jnp.stack([jnp.cos(q), jnp.sin(q)], axis=1) * qdot[:, None])
        return jnp.sum(0.5 * m * jnp.sum(v**2, axis=1)) + g * jnp.sum(jnp.cos(q))

    q, v, given = state(80)
    check_inertia(of_products, jnp.asarray(q), jnp.asarray(v), given, is_sum)


def by_scan(q, qdot, m, l, g):
    """Kinetic and potential energy added up with the velocities, link by link."""

    def link(carry, given):
        (vx, vy, total), (q, w, m, l) = carry, given
        vx, vy = vx + l * jnp.cos(q) * w, vy + l * jnp.sin(q) * w
        return (vx, vy, total + 0.5 * m * (vx**2 + vy**2) + m * g * jnp.cos(q)), None

    return jax.lax.scan(link, (0.0, 0.0, 0.0), (q, qdot, m, l))[0][2]


def from_rows(q, qdot, m, l, g):
    """Velocities as the derivative of places, which are rows of a scan."""

    def link(at, given):
        q, l = given
        at = jax.jit(lambda at: at + l * jnp.stack([jnp.sin(q), -jnp.cos(q)]))(at)
        return at, at

    x, v = jax.jvp(lambda q: jax.lax.scan(link, jnp.array([0.0, 3.0]), (q, l))[1], (q,), (qdot,))
    return jnp.sum(0.5 * m * jnp.sum(v**2, axis=1) - m * g * x[:, 1])


def backwards(q, qdot, m, l, g):
    def link(v, given):
        q, w, l = given
        return (v := v + l * w * jnp.stack([jnp.cos(q), jnp.sin(q)])), v

    v = jax.lax.scan(link, jnp.zeros(2), (q, qdot, l), reverse=True)[1]
    return jnp.sum(0.5 * m * jnp.sum(v**2, axis=1)) + g * jnp.sum(jnp.cos(q))


def by_numbers(q, qdot, m, l, g):
    """A loop over the numbers of the links."""
    m, l = jnp.asarray(m), jnp.asarray(l)

    def link(k, carry):
        vx, vy, total = carry
        vx, vy = vx + l[k] * jnp.cos(q[k]) * qdot[k], vy - l[k] * jnp.sin(q[k]) * -qdot[k]
        return vx, vy, total + 0.5 * m[k] * (vx**2 + vy**2) + m[k] * g * jnp.cos(q[k])

    return jax.lax.fori_loop(0, 80, link, (0.0, 0.0, 0.0))[2]


def turned(q, qdot, m, l, g):
    """Angles relative to the link before: sums of sums."""

    def link(carry, given):
        (angle, rate, v, total), (q, w, m, l) = carry, given
        angle, rate = q + angle, rate + w
        step = l * rate * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        middle, v = v + step / 2, v + step
        return (angle, rate, v, total + 0.5 * m * jnp.sum(middle**2) + m * l**2 * rate**2 / 24 + g * jnp.cos(angle)), None

    return jax.lax.scan(link, (0.0, 0.0, jnp.zeros(2), 0.0), (q, qdot, m, l))[0][3]


def dying_away(q, qdot, m, l, g):
    """No sum: what comes from before counts less."""
    v = jax.lax.scan(lambda v, x: ((v := 0.9 * v + x), v), 0.0, l * jnp.cos(q) * qdot)[1]
    return jnp.sum(0.5 * m * (v**2 + qdot**2)) + g * jnp.sum(jnp.cos(q))


def on_one_another(q, qdot, m, l, g):
    """No sums: two that need each other."""
    turn = lambda c, x: ((c[0] + 0.1 * c[1] + x, c[1] - 0.1 * c[0]), c[1])
    v = jax.lax.scan(turn, (0.0, 0.0), l * jnp.cos(q) * qdot)[1]
    return jnp.sum(0.5 * m * (v**2 + qdot**2)) + g * jnp.sum(jnp.cos(q))


def doubled(q, qdot, m, l, g):
    """No sum: c + (x + c/8)."""
    v = jax.lax.scan(lambda v, x: ((v := v + (x + v / 8)), v), 0.0, l * jnp.cos(q) * qdot / 1e3)[1]
    return jnp.sum(0.5 * m * (v**2 + qdot**2)) + g * jnp.sum(jnp.cos(q))


def ending_in(q, qdot, m, l, g):
    """Terms that are no sums themselves: quadratic in the rates."""
    v = jax.lax.scan(lambda v, x: ((v := v + x), v), 0.0, l * jnp.cos(q) * qdot + 1e-3 * qdot**2)[1]
    return jnp.sum(0.5 * m * v**2) + jnp.sum(qdot**2) + g * jnp.sum(jnp.cos(q))


def with_a_random_key(q, qdot, m, l, g):
    """A carry of which there are no zeros."""

    def link(carry, x):
        key, v = carry
        key, part = jax.random.split(key)
        return (key, v := v + x * jax.random.uniform(part)), v

    v = jax.lax.scan(link, (jax.random.key(0), 0.0), l * jnp.cos(q) * qdot)[1]
    return jnp.sum(0.5 * m * (v**2 + qdot**2)) + g * jnp.sum(jnp.cos(q))


def of_neighbours(q, qdot, m, l, g):
    """No sums: squares of differences, which do not change where all rates change alike."""
    d = jnp.diff(qdot.reshape(-1, 2), axis=0)
    return 0.5 * m[0] * jnp.sum(qdot**2) + jnp.cumsum(jnp.einsum("ij,ij->i", d, d))[-1] + g * jnp.sum(jnp.cos(q))


def of_neighbours_by_scan(q, qdot, m, l, g):
    d = jnp.diff(qdot.reshape(-1, 2), axis=0)
    total = jax.lax.scan(lambda total, d: ((total := total + d @ d), total), 0.0, d)[1][-1]
    return 0.5 * m[0] * jnp.sum(qdot**2) + total + g * jnp.sum(jnp.cos(q))


def counted(q, qdot, m, l, g):
    """A carry of whole numbers that follows the rates."""
    turn = lambda c, x: ((c[0] + jnp.where(x > 0, 1, 0), c[1] + x), c)
    count, v = jax.lax.scan(turn, (0, 0.0), l * jnp.cos(q) * qdot)[1]
    return jnp.sum(0.5 * m * v**2) + jnp.sum((1 + count) * qdot**2) + g * jnp.sum(jnp.cos(q))


def in_the_complex_plane(q, qdot, m, l, g):
    v = jax.jvp(lambda q: jnp.cumsum(l * jnp.exp(1j * q)), (q,), (qdot,))[1]
    return jnp.sum(0.5 * m * (v.real**2 + v.imag**2)) + g * jnp.sum(jnp.cos(q))


def one_or_the_other(q, qdot, m, l, g):
    """A choice of which one number decides for all."""
    v = jnp.where(qdot[0] > 0, jnp.cumsum(l * jnp.cos(q) * qdot), qdot)
    return jnp.sum(0.5 * m * v**2) + jnp.sum(qdot**2) + g * jnp.sum(jnp.cos(q))


def with_a_function_of_its_own(q, qdot, m, l, g):
    """Known rows, given to a function with a derivative rule."""

    def link(v, given):
        known, x = given
        return (v := v + jax.nn.relu(known) * x), v

    v = jax.lax.scan(link, 0.0, (np.linspace(-1.0, 1.0, q.size), l * jnp.cos(q) * qdot))[1]
    return jnp.sum(0.5 * m * (v**2 + qdot**2)) + g * jnp.sum(jnp.cos(q))


OTHERS = [of_neighbours, of_neighbours_by_scan, counted, in_the_complex_plane, one_or_the_other, with_a_function_of_its_own]


@pytest.mark.slow
@pytest.mark.parametrize("written", OTHERS)
def test_other_sums_and_other_numbers(written):
    """Whatever is seen in them."""
    q, v, given = state(80)
    check_inertia(written, jnp.asarray(q), jnp.asarray(v), given)


SCANS = {function: True for function in (by_scan, from_rows, backwards, by_numbers, turned)}
SCANS |= {function: False for function in (dying_away, on_one_another, doubled, ending_in, with_a_random_key)}


@pytest.mark.slow
@pytest.mark.parametrize("written", SCANS)
def test_what_a_scan_adds_up_is_a_running_sum(written):
    """And what it makes otherwise of the turn before is not: compared with JAX's own second derivatives of L."""
    q, v, given = state(80)
    check_inertia(written, jnp.asarray(q), jnp.asarray(v), given, SCANS[written])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_random_scans(seed):
    """Carries that are made of one another at random, some of them sums: whatever is seen in them, M is that of JAX."""
    rng = np.random.default_rng(seed)
    size, n, order = 4, 80, rng.permutation(4)
    mixed = np.triu(rng.normal(size=(size, size)) * (rng.random((size, size)) < 0.4), 1)[order][:, order]
    mixed[tuple(rng.integers(size, size=2))] *= -1.0 if rng.random() < 0.7 else 0.0
    kept = np.where(rng.random(size) < 0.9, 1.0, 0.5)
    moved, reverse, start = rng.random(size) < 0.7, bool(rng.integers(2)), rng.normal(size=size)

    def random(q, qdot, m, l, g):
        def turn(carry, given):
            q, w, l = given
            new = []
            for k in range(size):
                own = l * jnp.cos(q + k) * (w if moved[k] else q)
                others = sum((mixed[j, k] * carry[j] for j in range(size) if mixed[j, k]), own)
                new.append((carry[k] if kept[k] == 1 else kept[k] * carry[k]) + others / n)
            return tuple(new), (new[0], carry[1] * 2)

        ends, rows = jax.lax.scan(turn, tuple(start), (q, qdot, l), reverse=reverse)
        return sum(jnp.sum(m * row**2) for row in rows) + sum(end**2 for end in ends) + jnp.sum(qdot**2) - g * jnp.sum(q**2)

    q, v, given = state(n)
    check_inertia(random, jnp.asarray(q), jnp.asarray(v), given)


def check_inertia(written, q, v, given, is_sum=None):
    """M against JAX's own, and the accelerations that follow; and, where that is known, whether M is kept by its running sums."""
    L = lambda q, v: written(q, v, **given)
    M = structured_inertia(lambda v: L(q, v), v)
    assert is_sum is None or (isinstance(M, StructuredInertia) and bool(M.sums)) == is_sum
    dense = jax.hessian(L, 1)(q, v)
    close(M.as_matrix(), dense, 1e-14)
    carried = jax.jvp(lambda q: jax.grad(L, 1)(q, v), (q,), (v,))[1]
    force = jax.grad(L)(q, v) - carried
    qddot = jl.acceleration(jl.System(written), q, v, given).qddot
    assert np.max(np.abs(dense @ qddot - force) / (np.abs(dense) @ np.abs(qddot) + np.abs(force))) < 1e-11


@pytest.mark.slow
def test_derivatives_in_each_mass_and_length():
    """d(uᵀq̈) by M⁻¹(df − dM q̈), the closed forms differentiated by complex steps; forward, reverse, and of second order."""
    q, v, given = state(80)
    u, along = RNG.normal(size=80), {"m": RNG.normal(size=80), "l": 0.1 * RNG.normal(size=80), "g": 0.3}
    moved = lambda h: {name: given[name] + h * along[name] for name in given}

    def value(h):
        M, f = by_hand(q + 0j, v, moved(h))
        return u @ np.linalg.solve(M, f)

    expected = np.imag(value(1e-30j)) / 1e-30
    bend = (np.imag(value(1e-4 + 1e-30j)) - np.imag(value(-1e-4 + 1e-30j))) / 2e-34
    ours = lambda given: u @ jl.acceleration(CHAIN, q, v, given).qddot
    gradient = jax.grad(ours)(given)
    np.testing.assert_allclose(sum(np.sum(gradient[name] * along[name]) for name in along), expected, rtol=1e-10)
    slope = lambda given: jax.jvp(ours, (given,), (along,))[1]
    np.testing.assert_allclose(jax.jvp(slope, (given,), (along,)), [expected, bend], rtol=1e-6)


def numbers_in(program):
    """The sizes of all arrays of a program, and how many equations there are."""
    sizes, count = [0], 0
    for equation in program.eqns:
        sizes += [getattr(v.aval, "size", 0) for v in (*equation.invars, *equation.outvars)]
        count += 1
        for value in equation.params.values():
            for part in value if isinstance(value, (tuple, list)) else [value]:
                if hasattr(part, "eqns") or hasattr(part, "jaxpr"):
                    within = numbers_in(getattr(part, "jaxpr", part))
                    sizes, count = [*sizes, within[0]], count + within[1]
    return max(sizes), count


def test_no_matrix_of_all_coordinates():
    programs = {}
    for n in (256, 2000, 4096):
        program = jax.make_jaxpr(lambda q, v, given: jl.acceleration(CHAIN, q, v, given))(*state(n))
        largest, programs[n] = numbers_in(program.jaxpr)
        assert largest <= 40 * n
        assert max(np.size(x) for x in program.consts) <= 40 * n if program.consts else True
    assert programs[256] == programs[2000] == programs[4096]


def test_single_precision():
    q, v, given = state(80)
    single = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)
    found = jl.acceleration(CHAIN, *single((q, v, given))).qddot
    assert found.dtype == jnp.float32
    close(found, np.linalg.solve(*by_hand(q, v, given)), 1e-3)


def laguerre_mode(n, root):
    """Links 1 to n of the mode: differences Dₖ₊₁ = (k Dₖ − ξ Lₖ)/(k + 1) of Lₖ(ξ), which is how far mass k from below swings."""
    differences, value, difference = [], 1.0, 0.0
    for k in range(n):
        difference = (k * difference - root * value) / (k + 1)
        value += difference
        differences.append(difference)
    return np.array(differences[::-1])


def test_a_hanging_chain_swings_as_laguerre_says():
    """Near rest each mode of 500 links has ω² = g ξ/l with Lₙ(ξ) = 0, ξ by the three terms of its recursion."""
    n = 500
    given = {"m": np.ones(n), "l": np.ones(n), "g": GRAVITY}
    roots = eigvalsh_tridiagonal(2.0 * np.arange(n) + 1, np.arange(1.0, n), select="i", select_range=(0, 4))
    turned = jax.jit(lambda q: jax.jvp(lambda q: jl.acceleration(CHAIN, q, jnp.zeros(n), given).qddot, (jnp.zeros(n),), (q,))[1])
    for root in roots:
        mode = laguerre_mode(n, root)
        close(-turned(mode), GRAVITY * root * mode, 1e-8)


def rods(q, qdot, m, l):
    """Uniform rods, turned against one another, on a sledge."""
    angle, rate = jnp.cumsum(q["turn"]), jnp.cumsum(q["turn"] * 0 + qdot["turn"])
    vx, vy = l * jnp.cos(angle) * rate, l * jnp.sin(angle) * rate
    x, y = qdot["x"] + jnp.cumsum(vx) - vx / 2, jnp.cumsum(vy) - vy / 2
    return 0.5 * m * jnp.sum(x**2 + y**2 + l**2 * rate**2 / 12) + 2.0 * qdot["x"] ** 2


@pytest.mark.slow
def test_rods_on_a_sledge_turned_against_one_another():
    """M = JᵀJ of velocities by hand. Relative angles make it badly conditioned, so M q̈ is compared with the force, to rounding."""
    n = 70
    q, v = {"turn": RNG.uniform(-0.2, 0.2, n), "x": 0.3}, {"turn": np.zeros(n), "x": 0.0}
    pull = RNG.normal(size=n + 1)
    system = jl.System(rods, force=lambda: {"turn": pull[:n], "x": pull[n]})
    found = jl.acceleration(system, q, v, {"m": 1.3, "l": 0.7}).qddot
    angle, C = np.cumsum(q["turn"]), np.tril(np.ones((n, n)))
    half = C - np.eye(n) / 2
    sledge = np.eye(1, n + 1, n)
    J = [half @ np.diag(0.7 * f(angle)) @ C for f in (np.cos, np.sin)]
    vx, vy = np.hstack([J[0], np.ones((n, 1))]), np.hstack([J[1], np.zeros((n, 1))])
    turning = np.hstack([0.7 * C, np.zeros((n, 1))])
    M = 1.3 * (vx.T @ vx + vy.T @ vy + turning.T @ turning / 12) + 4.0 * sledge.T @ sledge
    qddot = np.append(found["turn"], found["x"])
    assert np.max(np.abs(M @ qddot - pull) / (np.abs(M) @ np.abs(qddot))) < 1e-14


@pytest.mark.slow
@pytest.mark.parametrize("pins, lightest", [(1, 1.0), (20, 1.0), (20, 0.0)])
def test_a_chain_held_at_some_links(pins, lightest):
    """Two rows of all angles before it for each; M, G and the forces by hand. Among many pins, two links are held that have no mass."""
    q, v, given = state(80)
    given["m"][-2:] *= lightest
    held_at = np.array([79]) if pins == 1 else np.append(np.arange(3, 76, 4), 79)
    ends = lambda q, l: jnp.stack([jnp.cumsum(l * jnp.sin(q))[held_at], -jnp.cumsum(l * jnp.cos(q))[held_at]])
    held = jl.System(lagrangian, holonomic={"pins": ends})
    M, f = by_hand(q, v, given)
    before, l = np.tril(np.ones((80, 80)))[held_at], given["l"]
    G = np.vstack([before * l * np.cos(q), before * l * np.sin(q)])
    gamma = np.concatenate([before @ (-l * np.sin(q) * v**2), before @ (l * np.cos(q) * v**2)])
    rows = len(G)
    x = np.linalg.solve(np.block([[M, -G.T], [G, np.zeros((rows, rows))]]), np.append(f, -gamma))
    found = jl.acceleration(held, q, v, given)
    close(found.qddot, x[:80], 1e-8)
    close(found.multipliers["pins"].ravel(), x[80:], 1e-8)
    h = 1e-6
    ours = lambda g: jnp.sum(jl.acceleration(held, q, v, given | {"g": g}).multipliers["pins"])
    expected = (ours(GRAVITY + h) - ours(GRAVITY - h)) / (2 * h)
    np.testing.assert_allclose([jax.grad(ours)(GRAVITY), jax.jacfwd(ours)(GRAVITY)], expected, rtol=1e-5)


@pytest.mark.parametrize("n", [90])
def test_a_bar_of_finite_elements(n):
    """Consistent masses: M has three diagonals, a grounded bar in a chain of linear elements."""
    energy = lambda q, qdot, m: jnp.sum(m / 6 * (qdot[1:] ** 2 + qdot[1:] * qdot[:-1] + qdot[:-1] ** 2)) - jnp.sum(jnp.diff(q) ** 2)
    m, q, v = RNG.uniform(0.5, 2, n - 1), RNG.normal(size=n), RNG.normal(size=n)
    M = np.zeros((n, n))
    for k, each in enumerate(m):
        M[k : k + 2, k : k + 2] += each / 6 * np.array([[2, 1], [1, 2]])
    force = np.append(2 * np.diff(q), 0) - np.append(0, 2 * np.diff(q))
    close(jl.acceleration(jl.System(energy), q, v, {"m": m}).qddot, np.linalg.solve(M, force), 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("n", [80, 5000])
def test_a_mass_below_zero_is_refused(n):
    """Of thousands, too: there XLA's minimum on a CPU leaves out NaN."""
    q, v, given = state(n)
    given["m"][n // 2] = -10.0 * n
    with pytest.raises(ValueError, match="must give every direction inertia"):
        jl.acceleration(CHAIN, q, v, given)


@pytest.mark.slow
def test_a_chain_without_mass_at_its_end_is_refused():
    q, v, given = state(80)
    with pytest.raises(ValueError, match="must give every direction inertia"):
        jl.acceleration(CHAIN, q, v, given | {"m": np.append(given["m"][:-1], 0.0)})
