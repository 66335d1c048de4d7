"""One acceleration of a pendulum of n links, for one state and for 1024 states at once: how the cost grows with n.

jaxlag starts from L. The hand-written candidates are array code with the same linear solve and, for few links, scalar code with
an explicit Cholesky factorisation. Run: python tests/benchmarks/bench_pendulum.py [most links]
"""

import functools
import sys

import jax
import jax.numpy as jnp
import numpy as np
from timing import compared, record, skipped

import jaxlag as jl

jax.config.update("jax_enable_x64", True)
G, BATCH, SCALAR, MJX = 9.81, 1024, 8, 4  # most links for scalar code and MJX: beyond, one compiles and the other runs too slowly


def lagrangian(q, qdot):
    """Links of length 1 m with 1 kg at their ends, angles from the vertical."""
    vx, vy = jnp.cumsum(jnp.cos(q) * qdot), jnp.cumsum(jnp.sin(q) * qdot)
    return 0.5 * jnp.sum(vx**2 + vy**2) + G * jnp.sum(jnp.cumsum(jnp.cos(q)))


system = jl.System(lagrangian)


def by_jaxlag(q, v):
    return jl.acceleration(system, q, v).qddot


def by_arrays(q, v):
    """M_ij = m_ij cos(φ_i − φ_j), f_i = −Σ_j m_ij sin(φ_i − φ_j) φ̇_j² − m_ii g sin φ_i, m_ij the mass hung on both i and j."""
    n = q.size
    m = n - np.maximum(*np.indices((n, n))).astype(float)
    c, s = jnp.cos(q), jnp.sin(q)
    M = m * (jnp.outer(c, c) + jnp.outer(s, s))
    f = c * (m @ (s * v**2)) - s * (m @ (c * v**2)) - np.diag(m) * G * s
    return jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(M), True), f)


def by_scalars(q, v):
    """The same, entry by entry, with the square-root-free Cholesky factorisation."""
    n = q.size
    c, s, w = [jnp.cos(x) for x in q], [jnp.sin(x) for x in q], [x**2 for x in v]
    m = lambda i, j: float(n - max(i, j))
    A = [[m(i, j) * (c[i] * c[j] + s[i] * s[j]) for j in range(i + 1)] for i in range(n)]
    f = [sum(m(i, j) * (c[i] * s[j] - s[i] * c[j]) * w[j] for j in range(n)) - m(i, i) * G * s[i] for i in range(n)]
    return jnp.stack(solved(A, f))


def solved(A, f):
    """A⁻¹f by A = L D Lᵀ, from the lower triangle."""
    n, L, d = len(f), [[0.0] * len(f) for _ in f], []
    for j in range(n):
        d.append(A[j][j] - sum(L[j][k] ** 2 * d[k] for k in range(j)))
        for i in range(j + 1, n):
            L[i][j] = (A[i][j] - sum(L[i][k] * L[j][k] * d[k] for k in range(j))) / d[j]
    y = []
    for i in range(n):
        y.append(f[i] - sum(L[i][k] * y[k] for k in range(i)))
    x = [y_i / d_i for y_i, d_i in zip(y, d, strict=True)]
    for i in reversed(range(n)):
        x[i] = x[i] - sum(L[k][i] * x[k] for k in range(i + 1, n))
    return x


def mujoco_model(n):
    """The same chain in MuJoCo: hinges, point masses with negligible rotational inertia, no contacts."""
    import mujoco

    body = '<body pos="0 0 {z}"><joint type="hinge" axis="0 -1 0"/><inertial pos="0 0 -1" mass="1" diaginertia="1e-9 1e-9 1e-9"/>'
    links = "".join(body.format(z=-1 if i else 0) for i in range(n)) + "</body>" * n
    option = f'<option gravity="0 0 -{G}"><flag contact="disable" constraint="disable"/></option>'
    return mujoco.MjModel.from_xml_string(f"<mujoco>{option}<worldbody>{links}</worldbody></mujoco>")


def relative(x):
    """Joint angles from the angles to the vertical."""
    return np.diff(x, prepend=0.0, axis=-1)


def by_mujoco(q, v):
    """`mj_forward` in C, state by state; a single state repeatedly."""
    import mujoco

    model = mujoco_model(q.shape[-1])
    data = mujoco.MjData(model)
    states = list(zip(*(np.atleast_2d(relative(x)) for x in (q, v)), strict=True))

    def run():
        out = []
        for data.qpos[:], data.qvel[:] in states:
            for _ in range(turns(q)):
                mujoco.mj_forward(model, data)
            out.append(np.cumsum(data.qacc))
        return np.array(out).reshape(q.shape)

    return run


def by_mjx(n):
    """MuJoCo in JAX."""
    from mujoco import mjx

    model = mjx.put_model(mujoco_model(n))
    blank = mjx.make_data(model)
    joint = lambda x: jnp.diff(x, prepend=0.0)
    return lambda q, v: jnp.cumsum(mjx.forward(model, blank.replace(qpos=joint(q), qvel=joint(v))).qacc)


def turns(q):
    """How often a single state is evaluated within one call, so that the overhead of the call does not count."""
    return 256 if q.ndim == 1 else 1


def compiled(f, q, v):
    """f at one state, or at each of a batch; a single state in a loop in which each evaluation depends on the previous one."""
    if q.ndim == 2:
        return functools.partial(jax.jit(jax.vmap(f)), q, v)
    again = lambda q, v: jax.lax.fori_loop(1, turns(q), lambda _, a: f(q + 1e-9 * a, v), f(q, v))
    return functools.partial(jax.jit(again), q, v)


def candidates(n, q, v):
    """The candidates for n links, and the reasons why others are missing."""
    written = {"jaxlag": by_jaxlag, "array code by hand": by_arrays} | ({"scalar code by hand": by_scalars} if n <= SCALAR else {})
    peers = {"MuJoCo": lambda: by_mujoco(np.asarray(q), np.asarray(v))}
    if n <= MJX:
        peers["MJX"] = lambda: compiled(by_mjx(n), q, v)
    runs, missing = {name: compiled(f, q, v) for name, f in written.items()}, {}
    for name, peer in peers.items():
        try:
            runs[name] = peer()
        except ImportError as error:
            missing[name] = str(error)
    return runs, missing


def table(n, batch):
    """Times for n links; all candidates must give the same accelerations."""
    q, v = (jnp.asarray(x) for x in np.random.default_rng(n).uniform(-1.0, 1.0, (2, *batch, n)))
    runs, missing = candidates(n, q, v)
    rows, expected = compared(runs), np.asarray(runs["array code by hand"]())
    for row in rows:
        np.testing.assert_allclose(runs[row.name](), expected, rtol=0, atol=1e-4 * n * np.max(np.abs(expected)), err_msg=row.name)
        row.seconds /= turns(q)
    return rows + skipped(missing)


def main(most=128):
    sizes = [n for n in (1, 2, 4, 8, 16, 32, 64, 128) if n <= most]
    batches = {"one state": (), f"{BATCH} states": (BATCH,)}
    record("acceleration of a pendulum", ((f"{n} links, {which}", table(n, batch)) for n in sizes for which, batch in batches.items()))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
