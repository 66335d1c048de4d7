"""Makes jaxlag/examples/vehicle_drive.csv: a recorded drive of the lecture's vehicle, by SciPy alone.

The equations of motion are those derived by hand in the lecture,

    (M + 2m + 2Θ_r/r²) ẍ + k|ẋ+v|(ẋ+v) = M₀/r
    M ÿ + M g + 2c(y − l) + 2b ẏ = 0
    Θ_s φ̈ + 2c a² φ + 2b a² φ̇ = 0

and nothing of jaxlag enters. Noise: normal, standard deviation 1e-3 (m, rad, m/s), seed 0. Run: python tests/data/make_drive.py
"""

import pathlib

import numpy as np
from scipy.integrate import solve_ivp

M, m, Theta_s, Theta_r, r, a = 1000.0, 30.0, 1500.0, 1.0, 0.3, 1.3
c, b, k, rest, v, M0, g = 40000.0, 3000.0, 0.6, 0.5, 5.0, 300.0, 9.81
FILE = pathlib.Path(__file__).parents[2] / "jaxlag" / "examples" / "vehicle_drive.csv"


def motion(ts):
    def rates(t, s):
        x, y, phi, vx, vy, w = s
        ax = (M0 / r - k * abs(vx + v) * (vx + v)) / (M + 2 * m + 2 * Theta_r / r**2)
        ay = -g - (2 * c * (y - rest) + 2 * b * vy) / M
        return [vx, vy, w, ax, ay, -(2 * c * a**2 * phi + 2 * b * a**2 * w) / Theta_s]

    return solve_ivp(rates, (ts[0], ts[-1]), [0, 0.55, 0.05, 0, 0, 0], method="DOP853", t_eval=ts, rtol=1e-12, atol=1e-13).y


def main():
    ts = np.linspace(0, 20, 1000)
    x, y, phi, vx, vy, w = motion(ts)
    noise = 1e-3 * np.random.default_rng(0).standard_normal((3, ts.size))
    table = np.column_stack([ts, y + noise[0], phi + noise[1], vx + noise[2]])
    np.savetxt(FILE, table, delimiter=",", header="t,y,phi,xdot", comments="", fmt=["%.9f", "%.6f", "%.6f", "%.6f"])


if __name__ == "__main__":
    main()
