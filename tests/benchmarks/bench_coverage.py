"""Do 95 % intervals contain the true value in 95 % of cases when the noise is correlated?

A damped oscillator, c and b fitted to 200 recordings for each correlation; and a pendulum in Cartesian coordinates whose rod is a
constraint, its length l and damping b fitted to as many (seeds 0 to 199). Then the corners: few samples, one or two sensors of unknown
noise, times at random, 400 recordings each. Last, regressions with dry friction that is unlike in both directions, 400 recordings of each
machine. Run:

python tests/benchmarks/bench_coverage.py
"""

import argparse
import itertools
import time

import jax
import jax.numpy as jnp
import numpy as np
from bench_recordings import SYSTEM as DRIVE
from bench_recordings import drive
from scipy import integrate, linalg, signal

import jaxlag as jl

jax.config.update("jax_enable_x64", True)

SYSTEM = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2)
TRUE, START, FREE = {"c": 4.0, "b": 0.3}, {"c": 3.0, "b": 0.6}, ("c", "b")
TIMES, SIGMA = np.linspace(0.0, 10.0, 1000), 0.02
RHOS = (0.0, 0.8, 0.95, 0.99)


def position(ts, c, b):
    """x(t) from rest at 1, in closed form."""
    w = np.sqrt(c - b**2 / 4)
    return np.exp(-b / 2 * ts) * (np.cos(w * ts) + b / (2 * w) * np.sin(w * ts))


def noise(rho, seed):
    """r_t = ρ r_{t−1} + e_t with standard deviation SIGMA, in its stationary state."""
    e = np.random.default_rng(seed).standard_normal(len(TIMES) + 3000)
    return SIGMA * signal.lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], e)[3000:]


def deviations(rho, model=position, true=TRUE):
    """First-order standard deviations of the estimates: assuming white noise, and with the true covariance."""
    theta, h = np.array(list(true.values())), 1e-5
    J = np.stack([(model(TIMES, *(theta + d)) - model(TIMES, *(theta - d))) / (2 * h) for d in h * np.eye(2)], axis=-1)
    J = J.reshape(len(TIMES), -1, 2)  # of each channel, whose noise is independent
    P = SIGMA * np.linalg.inv(np.einsum("tci,tcj->ij", J, J))
    R = linalg.toeplitz(rho ** np.arange(len(TIMES)))
    return np.sqrt(np.diag(P) * SIGMA), np.sqrt(np.diag(P @ np.einsum("sci,st,tcj->ij", J, R, J, optimize=True) @ P))


def fits_of(rho, seeds, **more):
    """One fit of each recording, all in one batch."""
    clean = position(TIMES, **TRUE)
    records = [jl.Experiment(TIMES, clean + noise(rho, seed), 1.0, 0.0, **more) for seed in range(seeds)]
    return jl.fit_each(SYSTEM, records, START, free=FREE)


def of_the_rod(q, l):
    """The rod has the length l."""
    return q @ q - l**2


PENDULUM = jl.System(
    lambda q, qdot: 0.5 * qdot @ qdot - 9.81 * q[1],
    dissipation=lambda qdot, b: 0.5 * b * qdot @ qdot,
    holonomic={"rod": of_the_rod},
)
PENDULUM_TRUE, PENDULUM_START = {"l": 1.0, "b": 0.15}, {"l": 1.0, "b": 0.3}
ANGLE = 1.2  # at the start


def bob(ts, l, b):
    """x and y of the bob from rest at the angle, (T, 2), by SciPy in the angle; m = 1."""
    rates = lambda t, s: [s[1], -9.81 / l * np.sin(s[0]) - b * s[1]]
    phi = integrate.solve_ivp(rates, (0, ts[-1]), [ANGLE, 0.0], "DOP853", ts, rtol=1e-11, atol=1e-12).y[0]
    return l * np.stack([np.sin(phi), -np.cos(phi)], axis=1)


def constrained_fits_of(rho, seeds):
    """One fit of each recording of the pendulum, the length of the rod and its damping free, all in one batch."""
    clean = bob(TIMES, **PENDULUM_TRUE)
    start = np.array([np.sin(ANGLE), -np.cos(ANGLE)]), np.zeros(2)
    two = lambda seed: np.stack([noise(rho, 2 * seed), noise(rho, 2 * seed + 1)], axis=1)
    records = [jl.Experiment(TIMES, clean + two(seed), *start) for seed in range(seeds)]
    return jl.fit_each(PENDULUM, records, PENDULUM_START, free=("l", "b"))


SENSORS = {"a": 0.02, "b": 0.1}  # standard deviations


def both(q):
    """Two sensors of one motion."""
    return dict.fromkeys(SENSORS, q)


def in_the_corners(samples, sensors, at_random, rho=0.0, seeds=400):
    """One fit of each recording, all in one batch; noise that decays as a process of Ornstein and Uhlenbeck, by ρ a mean interval."""
    records, length = [], 5.0 if samples < 10 else 10.0
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        ts = np.r_[0.0, np.sort(random.uniform(0.0, length, samples - 1))] if at_random else np.linspace(0.0, length, samples)
        keeps = rho ** (np.diff(ts) * samples / length) if rho else np.zeros(samples - 1)
        seen = {}
        for name in list(SENSORS)[:sensors]:
            e = random.standard_normal(samples)
            for i, keep in enumerate(keeps):
                e[i + 1] = keep * e[i] + np.sqrt(1 - keep**2) * e[i + 1]
            seen[name] = position(ts, **TRUE) + SENSORS[name] * e
        records.append(jl.Experiment(ts, seen if sensors == 2 else seen["a"], 1.0, 0.0, observe=both if sensors == 2 else None))
    return jl.fit_each(SYSTEM, records, START, free=FREE)


WITH_FRICTION = jl.System(
    lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2,
    dissipation=lambda qdot, b, Fc: 0.5 * b * qdot**2 + Fc * jnp.abs(qdot),
    force=lambda t, u, offset: u(t) - offset,
)
RUBBED, AHEAD, BACK = {"m": 2.0, "c": 8.0, "b": 0.6, "Fc": 1.0, "offset": 0.3}, 1.3, 0.7  # Fc ± offset
COULOMB = {"forth": {"Fv": 200.0, "Fc": 22.0}, "back": {"Fv": 200.0, "Fc": 18.5}, "ripple": 0.0, "presliding": 1e-7}
OF_COULOMB = {"M": 95.0, "Fv": 200.0, "Fc": (22.0 + 18.5) / 2, "offset": drive.TRUE["offset"] + (22.0 - 18.5) / 2}


def with_noise(ts, q, u, sizes, seed):
    """A recording with white noise of the position and of the force, or the command."""
    e, f = np.random.default_rng(seed).standard_normal((2, ts.size))
    return jl.Experiment(ts, q + sizes[0] * e, 0.0, 0.0, params={"u": jl.Signal(ts, u + sizes[1] * f)})


def rubbed(seeds, samples=1000, interval=0.01, steps=50):
    """Oscillators from rest under three waves of random phases, force held from sample to sample, and friction in an implicit step of
    its own, by which it sticks, too (Moreau, 1988); each with the true parameters.
    """
    ts, h, m = np.arange(samples) * interval, interval / steps, RUBBED["m"]
    phases = np.random.default_rng(0).uniform(0, 2 * np.pi, (seeds, 3))
    u = np.sin(2 * np.pi * np.array([0.2, 0.45, 0.8]) * ts[:, None, None] + phases) @ np.array([5.0, 4.0, 3.0])
    q, v, seen = np.zeros(seeds), np.zeros(seeds), np.empty((samples, seeds))
    for k in range(samples):
        seen[k] = q
        for _ in range(steps):
            free = v + h / m * (u[k] - RUBBED["c"] * (q + h * v / 2) - RUBBED["b"] * v)
            after = np.sign(free) * np.maximum(np.abs(free) - np.where(free > 0, AHEAD, BACK) * h / m, 0)
            q, v = q + h * (v + after) / 2, after
    return [(with_noise(ts, seen[:, seed], u[:, seed], (1e-3, 0.05), seed), RUBBED) for seed in range(seeds)]


def drives(seeds, true=None, samples=5000, **how):
    """Drives led along strokes of their own; with the true parameters, or those by least squares in the true motion."""
    paths = []
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        goals = np.where(np.arange(12) % 2, 0.0, random.uniform(0.03, 0.1, 12))
        paths.append(drive.strokes(goals, random.uniform(0.05, 0.25, 12), samples, begin=100))
    ts, q, v, u, a = drive.worn(np.stack(paths, axis=1), **how)
    record = lambda seed: with_noise(ts, q[:, seed], u[:, seed], (2e-6, 0.02), seed)
    return [(record(seed), true or drive.inverse_dynamics(v[:, seed], u[:, seed], a[:, seed])) for seed in range(seeds)]


REGRESSIONS = {
    "oscillator": (WITH_FRICTION, rubbed),
    "drive": (DRIVE, lambda seeds: drives(seeds, OF_COULOMB, **COULOMB)),
    "worn drive": (DRIVE, drives),
}


def off_over_errors(case, seeds):
    """By how many standard errors each estimate of `regress` is off: by name, (seeds,)."""
    system, recorded = REGRESSIONS[case]
    off = {}
    for record, true in recorded(seeds):
        found = jl.regress(system, record, dict.fromkeys(true, np.nan), free=tuple(true))
        for name in true:
            off.setdefault(name, []).append(float((found.estimates[name] - true[name]) / found.standard_errors[name]))
    return {name: np.array(values) for name, values in off.items()}


def regressions(seeds=400) -> None:
    """Prints the table of the regressions."""
    print(f"{'regress':12} {'':6} {'inside':>8} {'rms of off/error':>17} {'mean':>6} {'seconds':>8}")
    for case in REGRESSIONS:
        begin = time.perf_counter()
        for name, off in off_over_errors(case, seeds).items():
            seconds, size = time.perf_counter() - begin, np.sqrt(np.mean(off**2))
            inside = f"{100 * np.mean(np.abs(off) < 1.96):6.1f} %"
            print(f"{case:12} {name:6} {inside} {size:17.2f} {np.mean(off):6.2f} {seconds:8.1f}", flush=True)


def coverage(fits, true=TRUE):
    """The fraction of intervals that contain the true value, for each parameter."""
    return {n: np.mean([f.interval(n).lower < true[n] < f.interval(n).upper for f in fits]) for n in true}


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=200)
    seeds = parser.parse_args().seeds
    columns = f"{'inside':>7} {'as if white':>12} {'error / true':>13} {'white / true':>13} {'samples':>8} {'halves':>12} {'seconds':>8}"
    print(f"{'rho':>5} {'':10} {'':3} {columns}")
    for rho, (title, fits_at, model, true) in itertools.product(RHOS, CASES):
        begin = time.perf_counter()
        fits = fits_at(rho, seeds)
        seconds = time.perf_counter() - begin
        white, exact = deviations(rho, model, true)
        held = coverage(fits, true)
        over = np.median([f.correlation_length for f in fits])
        said = np.mean([any("half of the record" in remark for remark in f.remarks) for f in fits])
        for i, name in enumerate(true):
            errors = np.array([float(f.standard_errors[name]) for f in fits])
            off = np.abs([float(f.estimates[name]) - true[name] for f in fits])
            naive = np.mean(off < 1.96 * errors / np.array([f.inflation[f.names.index(name)] for f in fits]))
            print(
                f"{rho:5.2f} {title:10} {name:3} {100 * held[name]:5.1f} % {100 * naive:10.1f} % {np.median(errors) / exact[i]:13.2f} "
                f"{white[i] / exact[i]:13.2f} {over:8.0f} {100 * said:10.1f} % {seconds:8.1f}",
                flush=True,
            )


def corners() -> None:
    """Prints the table of the corners."""
    print(f"{'samples':>8} {'sensors':>8} {'rho':>5} {'at random':>10} {'inside: c':>10} {'b':>7}")
    white = itertools.product((8, 20, 200), (1, 2), (0.0,), (False, True))
    coloured = itertools.product((200, 1000), (1,), (0.5, 0.8, 0.95), (False, True))
    for samples, sensors, rho, at_random in (*white, *coloured):
        held = coverage(in_the_corners(samples, sensors, at_random, rho))
        inside = f"{100 * held['c']:8.1f} % {100 * held['b']:5.1f} %"
        print(f"{samples:8d} {sensors:8d} {rho:5.2f} {at_random!s:>10} {inside}", flush=True)


CASES = (("oscillator", fits_of, position, TRUE), ("pendulum", constrained_fits_of, bob, PENDULUM_TRUE))


if __name__ == "__main__":
    main()
    corners()
    regressions()
