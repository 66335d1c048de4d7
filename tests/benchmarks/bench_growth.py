"""Chains of rods between points: how time, compilation and memory grow with their number, beside the same by hand.

python tests/benchmarks/bench_growth.py [most links]

By hand: for the chain S has three diagonals, in one call of a tridiagonal solve; in angles, the articulated inertias link by link. Medians
of 30 calls, each length in a process of its own; 1 s of motion of 200 links and of 1000, each of unit length and mass; and its
gradient in the mass of each link; rest between two hooks, with the forces left; the lowest modes where it hangs. Beside the rods: the
same chain, at rest, as a tree of hinges in MuJoCo, which nests no more than 1024 bodies; without the forces in the hinges. Its
accelerations of the points are compared with those of the rods. And bodies in the plane, their centers of mass beside their joints, by
three coordinates each: beside SciPy's `splu` of the whole saddle point. And the chain in angles written link by link in a `scan`, and
one with a sixteenth of its links held, beside the whole saddle point in NumPy.
"""

import subprocess
import sys
from time import perf_counter

LENGTHS, MOTIONS, HINGES, HANGING, BODIES = (
    (64, 256, 1024, 4096, 10_000),
    (200, 1000),
    (64, 256, 1000),
    (64, 256, 1024),
    (64, 256, 1024, 4096),
)

ONCE = ("hinges", "rest", "modes", "bodies", "pinned")  # not for each way to write the chain


def chain(n):
    """L in arrays, and rods between neighbours."""
    import jax.numpy as jnp

    import jaxlag as jl

    def rods(q, l):
        return jnp.sum(jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), q]), axis=0) ** 2, axis=1) - l**2

    weight = lambda q, qdot, m, g: 0.5 * m * jnp.sum(qdot**2) - m * g * jnp.sum(q[:, 1])
    angles = jnp.linspace(0.3, 1.2, n)
    start = jnp.cumsum(jnp.stack([jnp.sin(angles), -jnp.cos(angles)], axis=1), axis=0)
    return jl.System(weight, holonomic={"rods": rods}), start, {"m": 1.0, "g": 9.81, "l": 1.0}


def by_hand(q, v, params):
    """Lagrange's equations of the first kind for this chain."""
    import jax.numpy as jnp
    from jax import lax

    m, g = params["m"], params["g"]
    nothing = jnp.zeros((1, 2))
    s, w = (jnp.diff(jnp.concatenate([nothing, x]), axis=0) for x in (q, v))
    inverse = jnp.concatenate([jnp.zeros(1), jnp.full(len(q), 1 / m)])
    on = 4 * jnp.sum(s**2, axis=1) * (inverse[1:] + inverse[:-1])
    beside = jnp.append(-4 * jnp.sum(s[1:] * s[:-1], axis=1) * inverse[1:-1], 0)
    falling = jnp.concatenate([nothing, jnp.tile(jnp.array([[0.0, -g]]), (len(q), 1))])
    right = -2 * jnp.sum(w**2, axis=1) - 2 * jnp.sum(s * jnp.diff(falling, axis=0), axis=1)
    multipliers = lax.linalg.tridiagonal_solve(jnp.roll(beside, 1), on, beside, right[:, None])[:, 0]
    pull = 2 * multipliers[:, None] * s
    return falling[1:] + (pull - jnp.concatenate([pull[1:], nothing])) / m, multipliers


def chain_in_angles(n):
    """The same chain, with running sums in L."""
    import jax.numpy as jnp

    import jaxlag as jl

    def lagrangian(q, qdot, m, g, l):
        vx, vy = jnp.cumsum(l * jnp.cos(q) * qdot), jnp.cumsum(l * jnp.sin(q) * qdot)
        return jnp.sum(0.5 * m * (vx**2 + vy**2) + m * g * jnp.cumsum(l * jnp.cos(q)))

    return jl.System(lagrangian), jnp.linspace(0.3, 1.2, n), {"m": 1.0, "g": 9.81, "l": 1.0}


def chain_by_scan(n):
    """The same, written link by link."""
    import jax.numpy as jnp
    from jax import lax

    import jaxlag as jl

    def lagrangian(q, qdot, m, g, l):
        def link(carry, given):
            (vx, vy, down, total), (q, w, m) = carry, given
            vx, vy, down = vx + l * jnp.cos(q) * w, vy + l * jnp.sin(q) * w, down + l * jnp.cos(q)
            return (vx, vy, down, total + 0.5 * m * (vx**2 + vy**2) + m * g * down), None

        return lax.scan(link, (0.0, 0.0, 0.0, 0.0), (q, qdot, jnp.broadcast_to(m, q.shape)))[0][3]

    return jl.System(lagrangian), jnp.linspace(0.3, 1.2, n), {"m": 1.0, "g": 9.81, "l": 1.0}


def by_hand_in_angles(q, v, params):
    """q̈ by Featherstone's recursion: inertia and force of what hangs on each link, then the accelerations from the hook on."""
    import jax.numpy as jnp
    from jax import lax

    m, g, l = params["m"], params["g"], params["l"]
    zero = jnp.zeros(())
    given = l * jnp.cos(q), l * jnp.sin(q), -l * jnp.sin(q) * v**2, l * jnp.cos(q) * v**2

    def inwards(carry, link):
        (xx, xy, yy, fx, fy), (c, s, bx, by) = carry, link
        xx, yy, fy = xx + m, yy + m, fy - m * g
        fx, fy = fx - xx * bx - xy * by, fy - xy * bx - yy * by  # of what hangs on it, if the link turned evenly
        ux, uy = xx * c + xy * s, xy * c + yy * s
        d = 1 / (c * ux + s * uy)
        e = d * (c * fx + s * fy)
        return (xx - d * ux * ux, xy - d * ux * uy, yy - d * uy * uy, fx - e * ux, fy - e * uy), (d * ux, d * uy, e)

    def outwards(at, link):
        (x, y), ((c, s, bx, by), (ux, uy, e)) = at, link
        turn = e - ux * x - uy * y
        return (x + c * turn + bx, y + s * turn + by), turn

    _, inertias = lax.scan(inwards, (zero,) * 5, given, reverse=True)
    return lax.scan(outwards, (zero, zero), (given, inertias))[1], None


CHAINS = {"places": (chain, by_hand), "angles": (chain_in_angles, by_hand_in_angles), "scan": (chain_by_scan, by_hand_in_angles)}


def timed(function, *given, times=30):
    """The first call, and the median of others."""
    import jax
    import numpy as np

    calls = []
    for _ in range(times + 1):
        start = perf_counter()
        result = jax.block_until_ready(function(*given))
        calls.append(perf_counter() - start)
    return calls[0], float(np.median(calls[1:])), result


def accelerations(n, kind):
    """One line of the table."""
    import jax
    import numpy as np

    import jaxlag as jl

    make, of_hand = CHAINS[kind]
    system, q, params = make(n)
    given = q, 0.1 * q[::-1], params
    ours, hand = jax.jit(lambda *given: jl.acceleration(system, *given)), jax.jit(of_hand)
    (first, _, found), (first_by_hand, _, expected) = timed(ours, *given, times=1), timed(hand, *given, times=1)
    rounds = [(timed(ours, *given, times=30)[1], timed(hand, *given, times=30)[1]) for _ in range(10)]  # in turn: the machine is shared
    each, each_by_hand = np.median(rounds, axis=0)
    off = float(np.abs(found.qddot - expected[0]).max() / np.abs(expected[0]).max())
    times = f"{1e3 * each:>12.3f}{1e3 * each_by_hand:>12.3f}{each / each_by_hand:>8.2f}{first:>9.2f}{first_by_hand:>9.2f}"
    print(f"{n:>7} {kind}{times}{off:>11.1e}")


def hinged_in_mujoco(n, angles):
    """Points on massless links, each hinged to the one before; the angles of the links against the vertical."""
    import mujoco
    import numpy as np

    spec = mujoco.MjSpec()
    spec.option.gravity = [0, 0, -9.81]
    body = spec.worldbody
    for k in range(n):
        at = [float(k > 0), 0, 0]  # along the link, which lies along x where its angle is zero
        body = body.add_body(pos=at, mass=1.0, ipos=[1, 0, 0], inertia=[1e-9] * 3, explicitinertial=True)
        body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = np.diff(np.pi / 2 - angles, prepend=0)
    return model, data


def hinges(n, kind):
    """One line: MuJoCo's accelerations beside those of the rods, from rest."""
    try:
        import mujoco
    except ImportError:
        return print(f"{n:>7} hinges: skipped, since MuJoCo is not installed")
    import jax
    import jax.numpy as jnp
    import numpy as np

    import jaxlag as jl

    system, q, params = CHAINS[kind][0](n)
    _, of_rods, found = timed(jax.jit(lambda *given: jl.acceleration(system, *given)), q, jnp.zeros_like(q), params)
    angles = np.linspace(0.3, 1.2, n)
    model, data = hinged_in_mujoco(n, angles)
    _, of_hinges, _ = timed(lambda: mujoco.mj_forward(model, data))
    turning = -np.cumsum(data.qacc)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    off = np.abs(np.cumsum(turning, axis=0) - found.qddot).max() / np.abs(found.qddot).max()
    times = f"MuJoCo {1e3 * of_hinges:.3f} ms, rods {1e3 * of_rods:.3f} ms: {of_hinges / of_rods:.1f} times"
    print(f"{n:>7} hinges: {times}; difference {off:.0e}")


def motion(n, kind):
    """1 s from rest."""
    import resource

    import jax.numpy as jnp
    import numpy as np

    import jaxlag as jl

    system, q, params = CHAINS[kind][0](n)
    ts = np.linspace(0.0, 1.0, 11)
    run = lambda params: jl.simulate(system, q, jnp.zeros_like(q), ts, params, works=True)
    first, each, found = timed(run, params, times=5)
    balance = float(np.abs(found.balance()).max())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(f"{n:>7} links in {kind}, 1 s: {each:.3f} s, the first {first:.1f} s; balance {balance:.1e}; {peak:.0f} MB")


def gradient(n, kind):
    """Where the last link is after 1 s, by the mass of each."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    import jaxlag as jl

    system, q, params = CHAINS[kind][0](n)
    if kind == "places":
        weight = lambda q, qdot, m, g: jnp.sum(0.5 * m * jnp.sum(qdot**2, axis=1) - m * g * q[:, 1])
        system = jl.System(weight, holonomic=dict(system.holonomic))
    ts = np.linspace(0.0, 1.0, 11)
    end = lambda m: jnp.ravel(jl.simulate(system, q, jnp.zeros_like(q), ts, params | {"m": m}).q[-1, -1])[0]
    _, each, _ = timed(end, jnp.ones(n), times=5)
    first, reverse, _ = timed(jax.jit(jax.grad(end)), jnp.ones(n), times=5)
    print(
        f"{n:>7} links in {kind}, gradient in {n} masses: {reverse:.3f} s, {reverse / each:.1f} times the motion, the first {first:.1f} s"
    )


def rest(n, kind):
    """Between two hooks 0.6 n apart, from an arc; beside the closed form: tangents in arithmetic progression."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from scipy.optimize import brentq

    import jaxlag as jl

    hook = jnp.array([[0.6 * n, 0.0]])
    joined = lambda q: jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), q, hook]), axis=0)
    weight = lambda q, qdot, m, g: 0.5 * m * jnp.sum(qdot**2) - m * g * jnp.sum(q[:, 1])
    system = jl.System(weight, holonomic={"rods": lambda q, l: jnp.sum(joined(q) ** 2, axis=1) - l**2})
    turn = brentq(lambda b: np.sum(np.cos(np.linspace(-b, b, n))) - 0.6 * n, 0.1, 2.5)
    angles = np.linspace(-turn, turn, n)
    start = np.cumsum(np.stack([np.cos(angles), np.sin(angles)], axis=1), axis=0)[:-1]
    params = {"m": 1.0, "g": 9.81, "l": 1.0}
    first, each, found = timed(lambda params: jl.equilibrium(system, start, params), params, times=5)
    pull = 2 * found.multipliers["rods"][:, None] * joined(found.q)
    left = float(np.abs(np.diff(pull, axis=0) + np.array([0, params["m"] * params["g"]])).max())
    in_turn = np.arange(n) - (n - 1) / 2
    slope = brentq(lambda a: np.sum(1 / np.hypot(1, a * in_turn)) - 0.6 * n, 1e-6, 10.0, xtol=1e-15)
    expected = np.cumsum(slope * in_turn / np.hypot(1, slope * in_turn))[:-1]
    off = float(np.abs(found.q[:, 1] - expected).max())
    sag = lambda l: jl.equilibrium(system, start, params | {"l": l}).q[n // 2, 1]
    _, gradient, _ = timed(jax.grad(sag), 1.0, times=5)
    print(
        f"{n:>7} links at rest: {1e3 * each:.1f} ms, the first {first:.1f} s, with derivative {1e3 * gradient:.1f} ms; "
        f"forces left {left:.1e}, difference {off:.1e}, {found.stability}"
    )


def modes(n, kind):
    """The ten lowest of the chain where it hangs; beside ARPACK on matrices written by hand, across, where alone it swings."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    import scipy.sparse as sparse
    from scipy.sparse.linalg import eigsh

    import jaxlag as jl

    system, _, params = chain(n)
    hanging = jnp.stack([jnp.zeros(n), -jnp.arange(1.0, n + 1)], axis=1)
    first, each, found = timed(lambda params: jl.lowest_modes(system, hanging, params), params, times=5)
    slope = jax.grad(lambda params: jnp.sum(jl.lowest_modes(system, hanging * params["l"], params).frequency))
    _, gradient, _ = timed(slope, params, times=5)

    def by_hand(params):
        pull = params["g"] * np.arange(n, 0.0, -1) / params["l"]
        return eigsh(sparse.diags([pull + np.append(pull[1:], 0), -pull[1:], -pull[1:]], [0, 1, -1], format="csc"), 10, sigma=0.0)[0]

    _, hand, squares = timed(by_hand, params, times=5)
    off = float(np.max(np.abs(found.angular_frequency / np.sqrt(np.sort(squares)) - 1)))
    print(
        f"{n:>7} links, ten lowest modes: {each:.3f} s, the first {first:.1f} s, with derivatives {gradient:.3f} s; "
        f"ARPACK by hand {hand:.3f} s, difference {off:.1e}"
    )


def bodies(n, kind):
    """Accelerations and forces in the joints of a chain of rigid bodies."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    import scipy.sparse as sparse
    from scipy.sparse.linalg import splu

    import jaxlag as jl

    m, J, e, l, g = 1.0, 0.1, 0.3, 1.0, 9.81
    across, along = (lambda phi: jnp.stack([-jnp.sin(phi), jnp.cos(phi)], 1)), (lambda phi: jnp.stack([jnp.cos(phi), jnp.sin(phi)], 1))

    def lagrangian(q, qdot):
        velocity = qdot["r"] + e * qdot["phi"][:, None] * across(q["phi"])
        height = q["r"][:, 1] + e * jnp.sin(q["phi"])
        return 0.5 * m * jnp.sum(velocity**2) + 0.5 * J * jnp.sum(qdot["phi"] ** 2) - m * g * jnp.sum(height)

    joints = lambda q: q["r"] - jnp.concatenate([jnp.zeros((1, 2)), (q["r"] + l * along(q["phi"]))[:-1]])
    system = jl.System(lagrangian, holonomic={"joints": joints})
    phi = 0.3 * np.sin(np.arange(n))
    q = {"r": jnp.asarray(np.cumsum(l * along(phi), 0) - l * along(phi)), "phi": jnp.asarray(phi)}
    turning = {"r": jnp.zeros((n, 2)), "phi": jnp.cos(jnp.arange(n))}
    first, each, found = timed(jax.jit(lambda q, v: jl.acceleration(system, q, v)), q, turning)

    i, three = np.arange(n), lambda k: 3 * np.arange(n) + k  # x, y and φ of a body together
    ones = np.ones(n)
    rows = np.concatenate([three(0), three(1), three(2), three(0), three(2), three(1), three(2)])
    columns = np.concatenate([three(0), three(1), three(2), three(2), three(0), three(2), three(1)])
    at, beside = (2 * i[1:], 2 * i[1:] + 1), (three(0), three(1), three(2))
    of_rows = np.concatenate([2 * i, 2 * i + 1, *at, *at])
    of_columns = np.concatenate([*beside[:2], beside[0][:-1], beside[1][:-1], beside[2][:-1], beside[2][:-1]])

    def by_hand(phi, omega):
        s, c = np.sin(phi), np.cos(phi)
        M = sparse.csc_matrix(
            (np.concatenate([m * ones, m * ones, (J + m * e**2) * ones, *[-m * e * s] * 2, *[m * e * c] * 2]), (rows, columns))
        )
        slopes = [ones, ones, -ones[1:], -ones[1:], l * s[:-1], -l * c[:-1]]
        G = sparse.csc_matrix((np.concatenate(slopes), (of_rows, of_columns)), (2 * n, 3 * n))
        f = np.stack([m * e * c * omega**2, m * e * s * omega**2 - m * g, -m * g * e * c], 1).ravel()
        gamma = np.stack([l * c * omega**2, l * s * omega**2], 1)
        wanted = -np.concatenate([np.zeros((1, 2)), gamma[:-1]]).ravel()
        whole = sparse.bmat([[M, -G.T], [G, None]], format="csc")
        return splu(whole).solve(np.concatenate([f, wanted]))

    _, hand, expected = timed(by_hand, phi, np.cos(i))
    off = float(np.abs(found.qddot["phi"] - expected[: 3 * n].reshape(n, 3)[:, 2]).max() / np.abs(expected[: 3 * n]).max())
    print(f"{n:>7} bodies{1e3 * each:>12.3f}{1e3 * hand:>12.3f}{each / hand:>8.2f}{first:>9.2f}{'':>9}{off:>11.1e}")


def pinned(n, kind):
    """Accelerations of the chain in angles with some links held at a height; beside the same by all numbers of M in NumPy."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    import jaxlag as jl

    system, q, params = chain_in_angles(n)
    held = np.linspace(n // 20, n - 1, n // 16).astype(int)
    heights = lambda q, l: jnp.cumsum(l * jnp.cos(q))[held]
    there = np.asarray(heights(q, params["l"]))
    system = jl.System(dict(system.lagrangian), holonomic={"pins": lambda q, l: heights(q, l) - there})
    first, each, found = timed(jax.jit(lambda q, v: jl.acceleration(system, q, v, params)), q, 0.1 * q[::-1])
    beyond, before = np.arange(n, 0.0, -1), np.tril(np.ones((n, n)))[held]

    def by_hand(q, v):
        shared = np.minimum(beyond[:, None], beyond)
        turn = q[:, None] - q
        f = -(shared * np.sin(turn)) @ v**2 - params["g"] * beyond * np.sin(q)
        G, wanted = -before * np.sin(q), before @ (np.cos(q) * v**2)
        whole = np.block([[shared * np.cos(turn), -G.T], [G, np.zeros((held.size, held.size))]])
        return np.linalg.solve(whole, np.concatenate([f, wanted]))

    _, hand, expected = timed(by_hand, np.asarray(q), np.asarray(0.1 * q[::-1]), times=10)
    off = float(np.abs(found.qddot - expected[:n]).max() / np.abs(expected[:n]).max())
    print(f"{n:>7} pinned{1e3 * each:>12.3f}{1e3 * hand:>12.3f}{each / hand:>8.2f}{first:>9.2f}{'':>9}{off:>11.1e}")


def main():
    if len(sys.argv) == 4:
        import jax

        jax.config.update("jax_enable_x64", True)
        kinds = {"acceleration": accelerations, "hinges": hinges, "motion": motion, "gradient": gradient, "rest": rest}
        kinds |= {"modes": modes, "bodies": bodies, "pinned": pinned}
        return kinds[sys.argv[1]](int(sys.argv[2]), sys.argv[3])
    most = int(sys.argv[1]) if len(sys.argv) > 1 else LENGTHS[-1]
    print(f"{'links':>14}{'jaxlag ms':>12}{'by hand ms':>12}{'ratio':>8}{'first s':>9}{'by hand':>9}{'difference':>11}", flush=True)
    parts = {"acceleration": LENGTHS, "hinges": HINGES, "motion": MOTIONS, "gradient": MOTIONS[:1], "rest": HANGING}
    parts |= {"modes": HANGING, "bodies": BODIES, "pinned": HANGING[1:]}
    for kind, lengths in parts.items():
        for n in lengths:
            for coordinates in () if n > most else ("places",) if kind in ONCE else CHAINS:
                subprocess.run([sys.executable, __file__, kind, str(n), coordinates], check=True)


if __name__ == "__main__":
    main()
