"""Response curves beside harmonic balance: Duffing's oscillator over a fold, and Den Hartog's with dry friction.

mousai walks from frequency to frequency (`hb_time`, SciPy's Newton-Krylov method) and cannot pass a fold; friction is smoothed by tanh for
it. Times of the first call and of later ones (medians), points, and the largest error of the amplitude: of Duffing's oscillator against
SciPy's motions of one period from states of the curve, of Den Hartog's against his closed form.

python tests/benchmarks/bench_curves.py
"""

import statistics
import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import jaxlag as jl

jax.config.update("jax_enable_x64", True)
ONCE = jl.Every(lambda w: 2 * jnp.pi / w)
SLIP = 1e-3  # speed at which smoothed friction is tanh 1 of its bound
duffing = jl.System(
    lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2 - 0.25 * q**4,
    dissipation=lambda qdot: 0.05 * qdot**2,
    force=lambda t, w: 0.3 * jnp.cos(w * t),
)
dry = jl.System(
    lambda q, qdot: 0.5 * qdot**2 - 0.5 * q**2,
    dissipation=lambda qdot: 0.3 * jnp.abs(qdot),
    force=lambda t, w: jnp.cos(w * t),
)


def timed(function, repeats=5):
    """Seconds of the first call, of later ones, and what it returns."""
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        found = function()
        times.append(time.perf_counter() - start)
    return times[0], statistics.median(times[1:]), found


def hartog(w):
    """Source: Den Hartog, Transactions ASME 53 (1931) APM-107."""
    V, U = 1 / (1 - w**2), np.sin(np.pi / w) / (w * (1 + np.cos(np.pi / w)))
    return np.sqrt(V**2 - (0.3 * U) ** 2)


def by_scipy(w, start):
    """Half the distance of the extremes of one period."""
    rates = lambda t, y: [y[1], 0.3 * np.cos(w * t) - 0.1 * y[1] - y[0] - y[0] ** 3]
    ts = np.linspace(0, 2 * np.pi / w, 20_001)
    q = solve_ivp(rates, (0, ts[-1]), start, "DOP853", rtol=1e-12, atol=1e-13, t_eval=ts).y[0]
    return (q.max() - q.min()) / 2


def balanced(acceleration, frequencies, start, harmonics):
    """Amplitudes by mousai, each from the motion before."""
    import mousai

    x, amplitudes = start, []
    for w in frequencies:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            _, x, *_ = mousai.hb_time(acceleration, x0=x, omega=w, eqform="second_order", num_harmonics=harmonics, f_tol=1e-9)
        fine = np.fft.irfft(np.fft.rfft(x[0]) * 4096 / x.shape[1], 4096)
        amplitudes.append((fine.max() - fine.min()) / 2)
    return np.array(amplitudes)


def of_duffing(x, v, params):
    return np.array([[0.3 * np.cos(params["omega"] * params["cur_time"]) - 0.1 * v - x - x**3]])


def of_dry(x, v, params):
    return np.array([[np.cos(params["omega"] * params["cur_time"]) - 0.3 * np.tanh(v / SLIP) - x]])


def main():
    smooth = jl.periodic(duffing, 0.4, 0.0, {"w": 0.5}, section=ONCE)
    first, later, curve = timed(lambda: jl.response_curve(smooth, over="w", values=(0.5, 2.5)))
    off = max(
        abs(by_scipy(float(curve.values[i]), [float(curve.q[i]), float(curve.qdot[i])]) / float(curve.amplitude["q"][i]) - 1)
        for i in range(0, len(curve), 10)
    )
    print(
        f"Duffing     jaxlag  first {first:5.1f} s, later {later:6.2f} s, {len(curve):3} points, {len(curve.special)} folds, off {off:.0e}"
    )
    slipping = jl.periodic(dry, -1.2, 0.65, {"w": 1.3}, section=ONCE)
    first, later, curve = timed(lambda: jl.response_curve(slipping, over="w", values=(1.1, 1.9)))
    off = np.max(np.abs(np.asarray(curve.amplitude["q"]) / hartog(np.asarray(curve.values)) - 1))
    print(f"Den Hartog  jaxlag  first {first:5.1f} s, later {later:6.2f} s, {len(curve):3} points, off {off:.0e}")
    try:
        import mousai  # noqa: F401
    except ImportError:
        print("mousai is not installed")
        return
    up = np.linspace(0.5, 1.7, 40)
    first, _, amplitudes = timed(lambda: balanced(of_duffing, up, np.zeros((1, 15)), 7), repeats=1)
    exact = [float(jl.response_curve(smooth, over="w", values=(0.5, 2.5)).at(float(w))[0].motion(4001).q.max()) for w in up[::13]]
    off = np.max(np.abs(amplitudes[::13] / exact - 1))
    print(f"Duffing     mousai  {first:5.1f} s, {len(up)} points below the fold, 7 harmonics, off {off:.0e}")
    down = np.linspace(1.9, 1.1, 17)
    for harmonics in (7, 15):
        m = 2 * harmonics + 1
        start = 0.4 * np.cos(2 * np.pi * np.arange(m) / m + np.pi)[None]
        try:
            first, _, amplitudes = timed(lambda h=harmonics, s=start: balanced(of_dry, down, s, h), repeats=1)
            off = f"off {np.max(np.abs(amplitudes / hartog(down) - 1)):.0e}"
        except Exception as error:
            first, off = np.nan, f"fails: {type(error).__name__}"
        print(f"Den Hartog  mousai  {first:5.1f} s, {len(down)} points, {harmonics} harmonics, {off}")


if __name__ == "__main__":
    main()
