"""NIST's reference problems of nonlinear regression from both starts: steps, seconds and digits, beside SciPy and lmfit.

Steps are evaluations of residuals: those of jaxlag come with an exact Jacobian, SciPy and lmfit have theirs by differences, whose
evaluations count too. Digits are −log₁₀ of the largest relative error of an estimate; 0 where a fit ended elsewhere. Times are
those of a second call. Run:

python tests/benchmarks/bench_nist.py
"""

import functools
import sys
import time
import warnings
from pathlib import Path

import jax
import lmfit
import numpy as np
from scipy import optimize

sys.path.insert(0, str(Path(__file__).parents[1]))
from nist import MODELS, PROBLEMS, fitted

jax.config.update("jax_enable_x64", True)


def by_jaxlag(name, number):
    """Estimates, steps, whether it calls itself converged."""
    found = fitted(name, number, max_steps=400)
    return [float(x) for x in found.estimates.values()], found.steps, found.converged


@functools.cache  # so that it is compiled once
def residuals_of(name):
    """By a compiled function of the parameters as a vector."""
    x, y = (np.array(PROBLEMS[name][key], float) for key in "xy")
    model = jax.jit(lambda theta: MODELS[name](x, *theta))
    return lambda theta: np.nan_to_num(np.asarray(model(np.asarray(theta, float))) - y, nan=1e8, posinf=1e8, neginf=-1e8)


def by_scipy(name, number):
    """`least_squares` by MINPACK, columns scaled."""
    found = optimize.least_squares(
        residuals_of(name), PROBLEMS[name]["starts"][number], method="lm", x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12, max_nfev=4000
    )
    return found.x, found.nfev, found.success


def by_lmfit(name, number):
    """`lmfit.minimize` with its defaults."""
    residuals, params = residuals_of(name), lmfit.Parameters()
    for i, start in enumerate(PROBLEMS[name]["starts"][number]):
        params.add(f"b{i + 1}", start)
    found = lmfit.minimize(lambda p: residuals(list(p.valuesdict().values())), params)
    return list(found.params.valuesdict().values()), found.nfev, found.success


def digits(name, estimates):
    """−log₁₀ of the largest relative error, 11 at most, as NIST prints eleven."""
    certified = np.array(PROBLEMS[name]["certified"])
    off = np.max(np.abs(np.asarray(estimates) / certified - 1))
    return float(np.clip(-np.log10(max(off, 1e-11)), 0, 11)) if np.isfinite(off) else 0.0


def main() -> None:
    """Prints all."""
    warnings.simplefilter("ignore")
    ways = {"jaxlag": by_jaxlag, "SciPy": by_scipy, "lmfit": by_lmfit}
    print(f"{'':12} {''.join(f'{way:^34}' for way in ways)}")
    print(f"{'':12} {'  steps  seconds  digits  success ' * len(ways)}")
    for name in MODELS:
        for number in (0, 1):
            row = f"{name:>9} {number + 1}  "
            for run in ways.values():
                run(name, number)
                begin = time.perf_counter()
                estimates, steps, success = run(name, number)
                row += f"{steps:7d} {time.perf_counter() - begin:8.3f} {digits(name, estimates):7.1f}  {'yes' if success else 'no':>7} "
            print(row, flush=True)


if __name__ == "__main__":
    main()
