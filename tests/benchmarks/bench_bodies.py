"""A free body by a quaternion: jaxlag from its kinetic energy and |q|² = 1, beside the same equations by hand, and Euler's.

python tests/benchmarks/bench_bodies.py

By hand: Lagrange's equations of the first kind in (q, q̇), 4 EᵀΘE q̈ = −4 ĖᵀΘω + 2 q λ with q·q̈ = −q̇·q̇ in one solve, put back on the
constraint after each step; and Euler's equations in (q, ω), which have neither multiplier nor constraint. Each by diffrax with the same
tableau and tolerances, 30 s with a flip every few, 301 samples; first calls and medians of 9.
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from timing import compared, record

import jaxlag as jl
from jaxlag import rigid

jax.config.update("jax_enable_x64", True)
THETA, TS = np.array([1.0, 2.0, 2.5]), jnp.linspace(0.0, 30.0, 301)
OMEGA, Q0 = jnp.array([0.05, 2.0, 0.0]), jnp.array([1.0, 0.0, 0.0, 0.0])
QDOT0 = rigid.quaternion_rate(Q0, OMEGA)
body = lambda q, qdot, s: rigid.kinetic_energy(1.0, s * THETA, lambda q: jnp.zeros(3), rigid.quaternion)(q, qdot)
free = jl.System(body, holonomic=rigid.unit)


class Projected(jl.Dop853):
    """Steps that end on |q| = 1, q · q̇ = 0."""

    def step(self, *given, **named):
        y, *rest = super().step(*given, **named)
        q = y[:4] / jnp.linalg.norm(y[:4])
        return jnp.concatenate([q, y[4:] - q * (q @ y[4:])]), *rest


def in_rates(t, y, s):
    q, v = y[:4], y[4:]
    of = lambda q: jnp.stack(
        [jnp.stack(row) for row in ((-q[1], q[0], q[3], -q[2]), (-q[2], -q[3], q[0], q[1]), (-q[3], q[2], -q[1], q[0]))]
    )
    E, omega = of(q), 2 * of(q) @ v
    M = jnp.block([[4 * E.T @ ((s * THETA)[:, None] * E), 2 * q[:, None]], [2 * q[None], jnp.zeros((1, 1))]])
    f = jnp.concatenate([-4 * of(v).T @ (s * THETA * omega), -2 * (v @ v)[None]])
    return jnp.concatenate([v, jnp.linalg.solve(M, f)[:4]])


def of_euler(t, y, s):
    q, w = y[:4], y[4:]
    qdot = 0.5 * jnp.concatenate([-(q[1:] @ w)[None], q[0] * w + jnp.cross(q[1:], w)])
    return jnp.concatenate([qdot, jnp.cross(THETA * w, w) / THETA])


def by_hand(field, solver, start):
    control, save = dfx.PIDController(1e-8, 1e-10), dfx.SaveAt(ts=TS)

    @jax.jit
    def run(s):
        term, adjoint = dfx.ODETerm(field), dfx.ForwardMode()
        return dfx.diffeqsolve(term, solver, 0.0, 30.0, None, start, s, saveat=save, stepsize_controller=control, adjoint=adjoint).ys[:, :4]

    return run


def tables():
    runs = {
        "jaxlag": jax.jit(lambda s: jl.simulate(free, Q0, QDOT0, TS, {"s": s}).q),
        "the same equations by hand": by_hand(in_rates, Projected(), jnp.concatenate([Q0, QDOT0])),
        "Euler's equations by hand": by_hand(of_euler, jl.Dop853(), jnp.concatenate([Q0, OMEGA])),
    }
    rows = compared({name: lambda run=run: run(1.0) for name, run in runs.items()})
    reference = np.array(runs["Euler's equations by hand"](1.0))
    for row, run in zip(rows, runs.values(), strict=True):
        row.error = float(np.max(np.abs(np.array(run(1.0)) - reference)))
    yield "a free body by a quaternion, 30 s", rows


if __name__ == "__main__":
    record("bodies", tables())
