"""Makes jaxlag/examples/stribeck_drive.csv: a recorded run of a drive axis with Stribeck friction, by SciPy alone.

    m v̇ = u(t) − F(v),   F(v) = (F_c + (F_s − F_c) exp(−(v/v_s)²)) tanh(v/v_0) + b v,   u(t) = Σ A_i sin(2πt/T_i)

and nothing of jaxlag enters. Noise: normal, standard deviation 2e-3 m/s, seed 0. Run: python tests/data/make_stribeck.py
"""

import pathlib

import numpy as np
from scipy.integrate import solve_ivp

m, F_c, F_s, v_s, v_0, b = 2.0, 3.0, 5.0, 0.1, 0.01, 2.0
A, T = np.array([5.0, 2.5]), np.array([2.0, 0.7])
FILE = pathlib.Path(__file__).parents[2] / "jaxlag" / "examples" / "stribeck_drive.csv"


def friction(v):
    return (F_c + (F_s - F_c) * np.exp(-((v / v_s) ** 2))) * np.tanh(v / v_0) + b * v


def speed(ts):
    rate = lambda t, v: (A @ np.sin(2 * np.pi * t / T) - friction(v)) / m
    return solve_ivp(rate, (ts[0], ts[-1]), [0.0], method="DOP853", t_eval=ts, rtol=1e-11, atol=1e-12).y[0]


def main():
    ts = np.linspace(0, 10, 1001)
    v = speed(ts) + 2e-3 * np.random.default_rng(0).standard_normal(ts.size)
    np.savetxt(FILE, np.column_stack([ts, v]), delimiter=",", header="t,v", comments="", fmt=["%.2f", "%.6f"])


if __name__ == "__main__":
    main()
