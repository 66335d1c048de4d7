"""Do 95 % intervals contain the true value in 95 % of cases when the noise is correlated?

A damped oscillator, c and b fitted to 200 recordings for each correlation. Run:

python tests/benchmarks/bench_coverage.py
"""

import argparse
import time

import jax
import numpy as np
from scipy import linalg, signal

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


def deviations(rho):
    """First-order standard deviations of the estimates: assuming white noise, and with the true covariance."""
    theta, h = np.array(list(TRUE.values())), 1e-5
    J = np.stack([(position(TIMES, *(theta + d)) - position(TIMES, *(theta - d))) / (2 * h) for d in h * np.eye(2)], axis=1)
    P = SIGMA * np.linalg.inv(J.T @ J)
    R = linalg.toeplitz(rho ** np.arange(len(TIMES)))
    return np.sqrt(np.diag(P) * SIGMA), np.sqrt(np.diag(P @ J.T @ R @ J @ P))


def fits_of(rho, seeds, **more):
    """One fit of each recording, all in one batch."""
    clean = position(TIMES, **TRUE)
    records = [jl.Experiment(TIMES, clean + noise(rho, seed), 1.0, 0.0, **more) for seed in range(seeds)]
    return jl.fit_each(SYSTEM, records, START, free=FREE)


def coverage(fits):
    """The fraction of intervals that contain the true value, for each parameter."""
    return {n: np.mean([f.interval(n).lower < TRUE[n] < f.interval(n).upper for f in fits]) for n in FREE}


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=200)
    seeds = parser.parse_args().seeds
    print(f"{'rho':>5} {'':3} {'inside':>7} {'as if white':>12} {'error / true':>13} {'white / true':>13} {'samples':>8} {'seconds':>8}")
    for rho in RHOS:
        begin = time.perf_counter()
        fits = fits_of(rho, seeds)
        seconds = time.perf_counter() - begin
        white, true = deviations(rho)
        held = coverage(fits)
        over = np.median([f.correlated for f in fits])
        for i, name in enumerate(FREE):
            errors = np.array([float(f.standard_errors[name]) for f in fits])
            off = np.abs([float(f.estimates[name]) - TRUE[name] for f in fits])
            naive = np.mean(off < 1.96 * errors / np.array([f.inflation[f.names.index(name)] for f in fits]))
            print(
                f"{rho:5.2f} {name:3} {100 * held[name]:5.1f} % {100 * naive:10.1f} % {np.median(errors) / true[i]:13.2f} "
                f"{white[i] / true[i]:13.2f} {over:8.0f} {seconds:8.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
