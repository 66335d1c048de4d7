"""Do 95 % intervals contain the true value in 95 % of cases when the noise is correlated?

A damped oscillator, c and b fitted to 200 recordings for each correlation; and a pendulum in Cartesian coordinates whose rod is a
constraint, its length l and damping b fitted to as many (seeds 0 to 199). Then the corners: few samples, one or two sensors of unknown
noise, times at random, 400 recordings each. Run:

python tests/benchmarks/bench_coverage.py
"""

import argparse
import itertools
import time

import jax
import numpy as np
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
        over = np.median([f.correlated for f in fits])
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
