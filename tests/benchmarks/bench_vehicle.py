"""The lecture's vehicle over 20 s: one motion, value and gradient in b, c, k, their fit, and 1024 parameter sets.

jaxlag starts from L and D, all others from equations derived by hand. Each uses the loosest tolerance that keeps its error
within the bound; errors are relative to the exact solution.
Run: python tests/benchmarks/bench_vehicle.py
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import vehicle_by_hand as by_hand
import vehicle_solvers as solvers
from timing import compared, loosest, record, skipped
from vehicle_by_hand import AT_GUESS, EXACT, GUESS, OF_SPREAD, RECORD, SEEN, TS

import jaxlag as jl
from jaxlag.examples import vehicle

MOTION, GRADIENT, FIT, MANY = 1e-8, 1e-6, 1e-6, 1e-6  # bounds of the errors: coordinates in m and rad, relative, relative, coordinates
DIFFRAX = {"JAX + diffrax Dopri5": dfx.Dopri5, "JAX + diffrax Tsit5": dfx.Tsit5, "JAX + diffrax Dopri8": dfx.Dopri8}
PEERS = {
    "heyoka": solvers.heyoka,
    "numbalsoda DOP853": solvers.numba,
    "CasADi CVODES": solvers.casadi,
    "SymPy → NumPy + SciPy": solvers.sympy,
}


def candidates():
    """The solvers that are available, and the reasons why others are not."""
    found, missing = {"jaxlag": solvers.jaxlag()}, {}
    found |= {name: solvers.diffrax(solver()) for name, solver in DIFFRAX.items()} | {"DOP853 written out in lax": solvers.lax()}
    for name, peer in PEERS.items():
        try:
            found[name] = peer()
        except ImportError as error:
            missing[name] = str(error)
    return found, missing


def table(tasks, error, bound, starts, missing, rounds=9):
    """Rows of the tasks `run(tolerance)`, each at the loosest tolerance that keeps the error within the bound."""
    met = {name: loosest(run, error, bound, starts.get(name, 1e-5)) for name, run in tasks.items()}
    failed = {name: f"error {met[name].error:.1e} at any tolerance" for name in tasks if not met[name].error <= bound}
    runs = {name: lambda run=run, tol=met[name].tolerance: run(tol) for name, run in tasks.items() if name not in failed}
    return compared(runs, met, rounds) + skipped(missing | failed)


def motion(found, missing):
    """States at 1000 samples, with the error of the coordinates within the bound."""
    error = lambda states: np.max(np.abs(np.asarray(states) - EXACT)[:, :3])
    tasks = {name: solver.motion for name, solver in (found | {"jaxlag, called from Python": solvers.jaxlag_from_python()}).items()}
    return table(tasks, error, MOTION, {}, missing)


def gradient(found, missing, starts):
    """½ Σ (difference from a record)² at the guess, and its gradient; at the motion's tolerance or tighter."""
    tasks = {
        name: lambda tol, solver=solver: by_hand.loss_and_gradient(*map(np.asarray, solver.sensitive(GUESS, tol)))
        for name, solver in found.items()
    }
    tasks["jaxlag"] = in_one(jaxlag_states)
    reverse = dfx.RecursiveCheckpointAdjoint()
    for name, solver in DIFFRAX.items():
        run = lambda theta, tol, solver=solver: solvers.by_diffrax(solver(), theta, jnp.asarray(TS), tol, reverse)[:, SEEN]
        tasks[f"{name}, reverse mode"] = in_one(run)
        starts[f"{name}, reverse mode"] = starts[name]
    truth = by_hand.loss_and_gradient(*AT_GUESS)[1]
    return table(tasks, lambda out: np.max(np.abs(np.asarray(out[1]) / truth - 1)), GRADIENT, starts, missing)


def in_one(states):
    """`jax.value_and_grad` of the loss, compiled."""
    loss = lambda theta, tol: 0.5 * jnp.sum((states(theta, tol) - RECORD) ** 2)
    compiled = jax.jit(jax.value_and_grad(loss), static_argnums=1)
    theta = jnp.asarray(GUESS)
    return lambda tol: compiled(theta, tol)


def jaxlag_states(theta, tolerance):
    """The recorded channels, by jaxlag."""
    return solvers.stacked(*solvers.simulated(theta, jnp.asarray(TS), tolerance))[:, SEEN]


def fit(found, missing, starts):
    """b, c, k from the guess: jaxlag's `fit`, optimistix, and one Levenberg–Marquardt loop for all others."""
    tasks = {
        name: lambda tol, solver=solver: by_hand.fitted(lambda theta: map(np.asarray, solver.sensitive(theta, tol)))
        for name, solver in found.items()
    }
    tasks["jaxlag"], tasks["JAX + diffrax Tsit5 + optimistix"] = jaxlag_fit(), optimistix_fit()
    starts["JAX + diffrax Tsit5 + optimistix"] = starts["JAX + diffrax Tsit5"]
    truth = by_hand.exactly_fitted()
    return table(tasks, lambda theta: np.max(np.abs(np.asarray(theta) / truth - 1)), FIT, starts, missing)


def jaxlag_fit():
    """As a user calls it."""
    values = dict(zip(("y", "phi", "xdot"), RECORD.T, strict=True))
    experiment = jl.Experiment(TS, values, vehicle.q0, vehicle.qdot0, observe=vehicle.observe, sigma=1e-3)
    guess = vehicle.params | dict(zip("bck", GUESS, strict=True))

    def run(tol):
        estimates = jl.fit(vehicle.system, experiment, guess, free=("b", "c", "k"), rtol=tol, atol=0.01 * tol, tolerance=1e-6).estimates
        return np.array([float(estimates[name]) for name in "bck"])

    return run


def optimistix_fit():
    """Levenberg–Marquardt of optimistix over the hand-written motion, forward mode, parameters relative to the guess."""

    def residual(scaled, tol):
        states = solvers.by_diffrax(dfx.Tsit5(), GUESS * scaled, jnp.asarray(TS), tol, dfx.ForwardMode())
        return (states[:, SEEN] - RECORD) / 1e-3

    solver = optx.LevenbergMarquardt(rtol=1e-7, atol=1e-9)
    return jax.jit(lambda tol: GUESS * optx.least_squares(residual, solver, jnp.ones(3), tol, options={"jac": "fwd"}).value)


def many(found, missing):
    """1024 parameter sets, 101 samples each."""
    error = lambda states: np.max(np.abs(np.asarray(states) - OF_SPREAD)[..., :3])
    tasks = {name: solver.many for name, solver in found.items() if solver.many}
    return table(tasks, error, MANY, {}, missing, rounds=7)


def main():
    by_hand.check(by_hand.rates)
    found, missing = candidates()
    tables = {"one motion, error ≤ 1e-8": motion(found, missing)}
    starts = {row.name: row.tolerance for row in tables["one motion, error ≤ 1e-8"] if row.tolerance}
    tables["1024 parameter sets, error ≤ 1e-6"] = many(found, missing)
    tables["value and gradient in b, c, k"] = gradient(found, missing, starts)
    tables["fit of b, c, k"] = fit(found, missing, starts)
    record("vehicle", tables.items())


if __name__ == "__main__":
    main()
