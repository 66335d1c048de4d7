"""A linear drive recorded at 1 kHz under its digital controller, with dry friction that sticks: what motions and identification cost.

Motions and Jacobians stand beside Runge and Kutta's scheme by hand, in `lax.scan`, which knows nothing of friction that sticks.

The data come from NumPy's exact piecewise solution (tests/data/make_linear_drive.py). Run:

python tests/benchmarks/bench_recordings.py
"""

import functools
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxlag as jl

sys.path.insert(0, str(Path(__file__).parents[1] / "data"))
import make_linear_drive as drive

jax.config.update("jax_enable_x64", True)

SYSTEM = jl.System(
    lambda qdot, M: 0.5 * M * qdot**2,
    dissipation=lambda qdot, Fv, Fc: 0.5 * Fv * qdot**2 + Fc * jnp.abs(qdot),
    force=lambda t, u, offset: drive.K * u(t) - offset,
)


def pd(t, q, control, goal):
    """The controller of the drive, which sees q as it is."""
    rate = (q - control["seen"]) / drive.STEP
    return {"u": jnp.clip(drive.KV * (drive.KP * (goal(t) - q) - rate), -drive.LIMIT, drive.LIMIT), "seen": q}


IN_THE_LOOP = jl.System(
    SYSTEM.lagrangian[0][1],
    dissipation=SYSTEM.dissipation[0][1],
    force=lambda control, offset: drive.K * control["u"] - offset,
    states={"control": jl.Sampled(pd, every=drive.STEP, start={"u": 0.0, "seen": 0.0})},
)


def regression(ts, q, u) -> None:
    """Prints the time and the errors of `regress`."""
    record = jl.Experiment(ts, q, 0.0, 0.0, params={"u": jl.Signal(ts, u)})
    for call in ("first call", "again"):
        begin = time.perf_counter()
        found = jl.regress(SYSTEM, record, dict.fromkeys(drive.TRUE, np.nan), free=tuple(drive.TRUE))
        print(f"regress, {call}: {time.perf_counter() - begin:.2f} s")
    print(found)
    for name, true in drive.TRUE.items():
        print(f"  {name:6} off by {100 * abs(float(found.estimates[name]) / true - 1):.1e} %")


def by_hand(x, ts, u, F=True):
    """q̇ and q at the samples, by the scheme of order 4."""
    M, Fv, Fc, offset = x

    def rate(y, u):
        return jnp.array([y[1], (drive.K * u - offset - Fv * y[1] - F * Fc * jnp.sign(y[1])) / M])

    def step(y, given):
        u, h = given
        a = rate(y, u)
        b = rate(y + h / 2 * a, u)
        c = rate(y + h / 2 * b, u)
        y = y + h / 6 * (a + 2 * b + 2 * c + rate(y + h * c, u))
        return y, y

    return jax.lax.scan(step, jnp.zeros(2), (u[:-1], jnp.diff(ts)))[1]


def median(run, count=7) -> float:
    """Milliseconds of a call, once compiled."""
    jax.block_until_ready(run())
    times = []
    for _ in range(count):
        begin = time.perf_counter()
        jax.block_until_ready(run())
        times.append(1e3 * (time.perf_counter() - begin))
    return float(np.median(times))


def costs(motion, x) -> str:
    """Of a motion as a function of four parameters, and of its Jacobian."""
    value, jacobian = jax.jit(motion), jax.jit(jax.jacfwd(motion))
    return f"{median(lambda: value(x)):.1f} ms, with its Jacobian {median(lambda: jacobian(x), 3):.0f} ms"


def motions(ts, u) -> None:
    """Prints what motions cost."""
    x, signal = jnp.array(list(drive.TRUE.values())), jl.Signal(ts, u)
    smooth = jl.System(
        lambda qdot, M: 0.5 * M * qdot**2,
        dissipation=lambda qdot, Fv: 0.5 * Fv * qdot**2,
        force=lambda t, u, offset: drive.K * u(t) - offset,
    )

    def simulated(system, solver):
        params = lambda x: dict(zip(drive.TRUE, x, strict=True)) | {"u": signal}
        return lambda x: jl.simulate(system, 0.0, 0.0, ts, params(x), solver=solver, throw=False).q

    for name, system, F in (("without friction", smooth, False), ("with dry friction", SYSTEM, True)):
        for solver in (jl.Dop853(), jl.Dopri5()):
            print(f"{name}, {type(solver).__name__}: {costs(simulated(system, solver), x)}")
        print(f"{name}, by hand: {costs(functools.partial(by_hand, ts=ts, u=u, F=F), x)}")


def fitted(ts, q, u) -> None:
    """Prints the time and the errors of `fit` from twice the truth."""
    record = jl.Experiment(ts, q, 0.0, 0.0, params={"u": jl.Signal(ts, u)})
    twice = {name: 2 * true for name, true in drive.TRUE.items()}
    for call in ("first call", "again"):
        begin = time.perf_counter()
        found = jl.fit(SYSTEM, record, twice, free=tuple(drive.TRUE), solver=jl.Dopri5())
        print(f"fit, {call}: {time.perf_counter() - begin:.2f} s")
    print(found)


def in_the_loop() -> None:
    """Prints the same of the loop simulated closed: motion, `fit` from twice the truth, and its errors by the quantum of the position."""
    for quantum in (1e-6, 1e-7):
        ts, q, *_ = drive.recording(quantum)
        goal = {"goal": jl.Signal(ts, drive.path())}
        if quantum == drive.QUANTUM:
            for solver in (jl.Dop853(), jl.Dopri5()):
                simulated = lambda x, solver=solver, goal=goal, ts=ts: (
                    jl.simulate(IN_THE_LOOP, 0.0, 0.0, ts, dict(zip(drive.TRUE, x, strict=True)) | goal, solver=solver, throw=False).q
                )
                print(f"closed loop with dry friction, {type(solver).__name__}: {costs(simulated, jnp.array(list(drive.TRUE.values())))}")
        record = jl.Experiment(ts, q, 0.0, 0.0, params=goal)
        for call in ("first call", "again"):
            begin = time.perf_counter()
            twice = {name: 2 * true for name, true in drive.TRUE.items()}
            found = jl.fit(IN_THE_LOOP, record, twice, free=tuple(drive.TRUE), solver=jl.Dopri5())
            print(f"fit in the closed loop, {call}: {time.perf_counter() - begin:.2f} s")
        print(found)
        for name, true in drive.TRUE.items():
            print(f"  {name:6} off by {100 * abs(float(found.estimates[name]) / true - 1):.2f} % with a quantum of {quantum:g} m")


def several_logs() -> None:
    """Prints what fits of one log to sixteen cost, in the closed loop: their clock is off by 3e-8 s, the start at rest is unknown."""
    logs = []
    for i in range(16):
        ts, q, *_ = drive.recording(1e-6 * (1 + 0.1 * i))
        clock = (ts + 3e-8 * np.sin(np.arange(ts.size)))[:6000]
        goal = {"goal": jl.Signal(clock, drive.path()[:6000])}
        logs.append(jl.Experiment(clock, q[:6000], 0.0, 0.0, params=goal, unknown=("q0", "qdot0")))
    twice = {name: 2 * true for name, true in drive.TRUE.items()}
    for count in (1, 4, 16):
        run = functools.partial(jl.fit, IN_THE_LOOP, logs[:count], twice, free=tuple(drive.TRUE), solver=jl.Dopri5())
        found, times = run(), []
        for _ in range(3):
            begin = time.perf_counter()
            run()
            times.append(time.perf_counter() - begin)
        worst = max(abs(float(found.estimates[n]) - true) / float(found.standard_errors[n]) for n, true in drive.TRUE.items())
        print(f"fit of {count} logs of six seconds: {np.median(times):.2f} s, {found.steps} steps, within {worst:.1f} standard errors")


def main() -> None:
    """Prints all."""
    several_logs()
    ts, q, _, u = drive.recording()
    motions(ts, u)
    regression(ts, q, u)
    fitted(ts, q, u)
    in_the_loop()


if __name__ == "__main__":
    main()
