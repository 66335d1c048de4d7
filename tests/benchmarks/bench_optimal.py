"""Best motions beside CasADi and opty, both with IPOPT: a cart-pole and an acrobot swing up, a double pendulum on a cart.

`optimise_motion` and CasADi collocate the same equations at the same five Radau points of each of 40 intervals, from the same straight
guess (one start, no refinement); IPOPT has its defaults but for the tolerance and no printing. Times of the first call, which builds and
compiles, and of later ones (medians, one beside the other); costs; how far the simulated motion is off, which is computed within the time
and which IPOPT does not compute: the ratio is said with this check and without.
opty collocates at midpoints, here of 200 intervals, whose costs are off by 2e-3 of themselves; it writes and compiles C.
Then three ways to solve the transcribed problem of the block with a limited force on 10 intervals: this package's interior-point method,
and SciPy's trust-constr and SLSQP with its derivatives.

pip install casadi opty    # opty needs cyipopt, which is built with coinor-libipopt-dev and liblapack-dev (Debian)
python tests/benchmarks/bench_optimal.py
"""

import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxlag as jl

jax.config.update("jax_enable_x64", True)
INTERVALS, STAGES, ROUNDS, G = 40, 5, 15, 9.81


def cart(xp, q, v):
    """Kelly's cart-pole: L by names of coordinates, with the functions of `xp`."""
    turning = 0.3 * 0.5 * xp.cos(q["phi"]) * v["x"] * v["phi"] + 0.5 * 0.3 * 0.25 * v["phi"] ** 2
    return 0.5 * 1.3 * v["x"] ** 2 + turning + 0.3 * G * 0.5 * xp.cos(q["phi"])


def acrobot(xp, q, v):
    kinetic = 0.25 * (v["a"] ** 2 + 0.5 * v["b"] ** 2 + xp.cos(q["a"] - q["b"]) * v["a"] * v["b"])
    return kinetic + 0.5 * G * (2 * xp.cos(q["a"]) + xp.cos(q["b"]))


def double(xp, q, v):
    """Two point masses on rods, on a cart."""
    vx1, vy1 = v["x"] + 0.5 * xp.cos(q["a"]) * v["a"], 0.5 * xp.sin(q["a"]) * v["a"]
    vx2, vy2 = vx1 + 0.5 * xp.cos(q["b"]) * v["b"], vy1 + 0.5 * xp.sin(q["b"]) * v["b"]
    height = -0.5 * xp.cos(q["a"]) * 2 - 0.5 * xp.cos(q["b"])
    return 0.5 * v["x"] ** 2 + 0.15 * (vx1**2 + vy1**2 + vx2**2 + vy2**2) - 0.3 * G * height


PROBLEMS = {  # L, forces on the coordinates of u, end, duration, the largest |u|
    "cart-pole": (cart, {"x": 1.0}, {"x": 1.0, "phi": np.pi}, 2.0, 20.0),
    "acrobot": (acrobot, {"a": -1.0, "b": 1.0}, {"a": np.pi, "b": np.pi}, 2.0, 20.0),
    "double pendulum on a cart": (double, {"x": 1.0}, {"x": 1.0, "a": np.pi, "b": np.pi}, 3.0, 40.0),
}


def effort(u):
    return u**2


def ours(L, push, end, T, most):
    """A call of `optimise_motion`."""
    system = jl.System(lambda q, qdot: L(jnp, q, qdot), force=lambda u: {name: c * u for name, c in push.items()})
    rest = dict.fromkeys(end, 0.0)
    given = {"duration": T, "control": {"u": (-most, most)}, "cost": effort, "nodes": INTERVALS, "starts": 1, "refinements": 0}
    return lambda: jax.block_until_ready(jl.optimise_motion(system, (rest, rest), (end, rest), {}, **given, throw=False))


def casadis(L, push, end, T, most):
    """The same problem for IPOPT: a function that builds, and one that solves."""
    import casadi as ca

    names = list(end)
    n = len(names)
    q, v, a, u = ca.SX.sym("q", n), ca.SX.sym("v", n), ca.SX.sym("a", n), ca.SX.sym("u")
    lagrangian = L(ca, dict(zip(names, ca.vertsplit(q), strict=True)), dict(zip(names, ca.vertsplit(v), strict=True)))
    momentum = ca.gradient(lagrangian, v)
    balance = ca.jtimes(momentum, v, a) + ca.jtimes(momentum, q, v) - ca.gradient(lagrangian, q)
    balance -= ca.vertcat(*(push.get(name, 0.0) * u for name in names))
    left = ca.Function("left", [q, v, a, u], [balance])
    tau = np.append(0, ca.collocation_points(STAGES, "radau"))
    D, _, B = ca.collocation_coeff(tau[1:].tolist())
    D, B = np.array(D), np.array(B).ravel()
    h, goal = T / INTERVALS, np.array(list(end.values()))
    x = ca.SX.sym("start", 2 * n)
    unknowns, guess, low, high, equations, cost = [x], [np.zeros(2 * n)], [np.zeros(2 * n)], [np.zeros(2 * n)], [], 0
    for k in range(INTERVALS):
        X, U = ca.SX.sym(f"x{k}", 2 * n, STAGES), ca.SX.sym(f"u{k}", STAGES)
        slopes = ca.horzcat(x, X) @ D / h
        for i in range(STAGES):
            equations += [left(X[:n, i], X[n:, i], slopes[n:, i], U[i]), slopes[:n, i] - X[n:, i]]
            cost += h * B[i] * U[i] ** 2
            share = (k + tau[i + 1]) / INTERVALS
            is_end = k == INTERVALS - 1 and i == STAGES - 1
            ends = np.append(goal, np.zeros(n))
            unknowns += [X[:, i], U[i]]
            guess += [np.append(goal * share, goal / T), np.zeros(1)]
            low += [ends if is_end else np.full(2 * n, -np.inf), np.array([-most])]
            high += [ends if is_end else np.full(2 * n, np.inf), np.array([most])]
        x = X[:, -1]
    g = ca.vertcat(*equations)
    options = {"ipopt.tol": 4e-10, "ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes"}
    solver = ca.nlpsol("solver", "ipopt", {"x": ca.vertcat(*unknowns), "f": cost, "g": g}, options)
    given = {"x0": np.concatenate(guess), "lbx": np.concatenate(low), "ubx": np.concatenate(high), "lbg": 0, "ubg": 0}
    return lambda: (float(solver(**given)["f"]), solver.stats())


def optys(L, push, end, T, most, nodes=201):
    """The same problem for opty and IPOPT."""
    import sympy as sm
    from opty import Problem

    t, names = sm.Symbol("t"), list(end)
    q, v, u = [sm.Function(n)(t) for n in names], [sm.Function("v_" + n)(t) for n in names], sm.Function("u")(t)
    Q, V = sm.symbols([f"q_{n}" for n in names]), sm.symbols([f"v_{n}" for n in names])
    lagrangian = sm.sympify(L(sm, dict(zip(names, Q, strict=True)), dict(zip(names, V, strict=True))))
    along = dict(zip([*Q, *V], [*q, *v], strict=True))
    rows = [x.diff(t) - y for x, y in zip(q, v, strict=True)]
    for i, name in enumerate(names):
        momentum, force = lagrangian.diff(V[i]).subs(along), lagrangian.diff(Q[i]).subs(along)
        rows.append(momentum.diff(t) - force - push.get(name, 0) * u)
    h, k = T / (nodes - 1), 2 * len(names)
    goal = np.array([*end.values(), *[0.0] * len(names)])
    ends = [x.subs(t, 0.0) for x in (*q, *v)] + [x.subs(t, T) - value for x, value in zip((*q, *v), goal, strict=True)]
    cost = lambda free: h * np.sum(free[k * nodes :] ** 2)
    slope = lambda free: np.append(np.zeros(k * nodes), 2 * h * free[k * nodes :])
    given = {"instance_constraints": tuple(ends), "bounds": {u: (-most, most)}, "time_symbol": t, "integration_method": "midpoint"}
    problem = Problem(cost, slope, sm.Matrix(rows), (*q, *v), nodes, h, **given)
    for name, value in (("print_level", 0), ("sb", "yes"), ("tol", 4e-10)):
        problem.add_option(name, value)
    share = np.linspace(0, 1, nodes)
    guess = np.concatenate([np.outer(goal[: len(names)], share).ravel(), np.repeat(goal[: len(names)] / T, nodes), np.zeros(nodes)])
    return lambda: problem.solve(guess)[1]


def seconds(run, rounds):
    taken = []
    for _ in range(rounds):
        begin = time.perf_counter()
        run()
        taken.append(time.perf_counter() - begin)
    return statistics.median(taken)


def first(make):
    """The function made, what it says first, and how long both took."""
    begin = time.perf_counter()
    run = make()
    said = run()
    return run, said, time.perf_counter() - begin


def main():
    print(f"{'':44}{'first s':>9}{'then s':>9}{'steps':>7}{'cost':>14}   off when simulated")
    for name, problem in PROBLEMS.items():
        run, best, first_of_ours = first(lambda problem=problem: ours(*problem))
        solve, (cost, stats), first_of_casadi = first(lambda problem=problem: casadis(*problem))
        solve_midpoints, info, first_of_opty = first(lambda problem=problem: optys(*problem))
        rounds = [[seconds(one, 1) for one in (run, solve, solve_midpoints, best.check)] for _ in range(ROUNDS)]
        again, peer, other, _ = (statistics.median(times) for times in zip(*rounds, strict=True))
        ratio, alone = (statistics.median((a - part * check) / b for a, b, _, check in rounds) for part in (0, 1))
        numbers = f"{first_of_ours:9.1f}{again:9.4f}{int(best.steps):7}{float(best.cost):14.7f}   {best.check():.1e}"
        print(f"{name + ', jaxlag':44}{numbers}   {ratio:.2f} of CasADi's time, {alone:.2f} without check", flush=True)
        ended = "" if stats["success"] else f"   {stats['return_status']}"
        print(f"{name + ', CasADi + IPOPT':44}{first_of_casadi:9.1f}{peer:9.4f}{stats['iter_count']:7}{cost:14.7f}{ended}", flush=True)
        print(f"{name + ', opty + IPOPT':44}{first_of_opty:9.1f}{other:9.4f}{'':7}{info['obj_val']:14.7f}", flush=True)
    of_solvers()


def of_solvers():
    """The block in 1 s with a limited force, on 10 intervals: what is transcribed, solved in three ways."""
    from scipy import optimize

    from jaxlag._optimal import interior_point
    from jaxlag._optimal.boundary import boundary_of
    from jaxlag._optimal.guess import guessed, sizes_of_states
    from jaxlag._optimal.statement import stated
    from jaxlag._optimal.transcription import Transcription

    block, boundary = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda u: u), boundary_of((0.0, 0.0), (1.0, 0.0), None, False)
    given = {"control": {"u": (-5.0, 5.0)}, "duration": 1.0, "cost": effort, "end_cost": None, "within": None, "over": (), "nodes": 10}
    setting, task = stated(block, boundary, {}, given | {"t": 0.0, "guess": None, "steps": 500, "starts": 1})
    of, path = Transcription(setting, 1), guessed(setting, task, boundary, None)
    sizes = of.sizes(task, path, *sizes_of_states(of, task, path))
    chain, start = of.chain(sizes, task), of.put_together(path, sizes, task)
    solve = jax.jit(lambda x: interior_point.minimum(chain, x, tolerance=1e-9, steps=500).f)
    value, slope = jax.jit(lambda x: chain.values(x)[0]), jax.jit(jax.grad(lambda x: chain.values(x)[0]))
    equations = lambda x: jnp.ravel(chain.values(x)[1])
    said = np.flatnonzero(np.any(np.asarray(jax.jacrev(equations)(start)) != 0, axis=1))  # others are 0 = 0
    c, dc = jax.jit(lambda x: equations(x)[said]), jax.jit(jax.jacrev(lambda x: equations(x)[said]))
    bounds = optimize.Bounds(np.asarray(chain.lower), np.asarray(chain.upper))
    zero = optimize.NonlinearConstraint(lambda x: np.asarray(c(x)), 0, 0, jac=lambda x: np.asarray(dc(x)))
    print(f"\n{'block, |u| ≤ 5: the solver alone':44}{'run s':>9}{'cost':>14}")
    alone, cost = seconds(lambda: solve(start).block_until_ready(), 5), float(solve(start) * sizes.cost)
    print(f"{'interior point, block tridiagonal':44}{alone:9.4f}{cost:14.9f}")
    for method, options in (("SLSQP", {"ftol": 1e-12, "maxiter": 500}), ("trust-constr", {"gtol": 1e-9, "maxiter": 3000})):
        run = lambda method=method, options=options: optimize.minimize(
            lambda x: float(value(x)),
            np.asarray(start),
            jac=lambda x: np.asarray(slope(x)),
            bounds=bounds,
            constraints=zero,
            method=method,
            options=options,
        )
        run()
        begin = time.perf_counter()
        found = run()
        taken, cost = time.perf_counter() - begin, float(found.fun * sizes.cost)
        print(f"{'SciPy ' + method:44}{taken:9.4f}{cost:14.9f}   {found.message}", flush=True)


if __name__ == "__main__":
    main()
