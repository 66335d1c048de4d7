"""The vehicle solved by jaxlag, by hand-written JAX, and by other packages: one `Solver` each.

motion(tolerance)                 states (1000, 6) at TS
sensitive(theta, tolerance)       states (1000, 6) and their derivatives (1000, 6, 3) in θ
many(tolerance)                   states (1024, 101, 6) at FEW for each row of SPREAD
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import dop853
import jax
import jax.numpy as jnp
import numpy as np
from vehicle_by_hand import FEW, SPREAD, START, THETA, TS, P, check, rates

import jaxlag as jl
from jaxlag.examples import vehicle


class Solver(NamedTuple):
    """The tasks of a candidate; None for those it cannot do."""

    motion: Callable[[float], Any]
    sensitive: Callable[[Any, float], Any] | None = None
    many: Callable[[float], Any] | None = None


def of_jax(motion, motions=None, static=()):
    """A `Solver` from `motion(theta, ts, tolerance)` in JAX, (samples, 6); derivatives by one vectorised forward pass."""

    def sensitive(theta, ts, tolerance):
        derivative = lambda e: jax.jvp(lambda theta: motion(theta, ts, tolerance), (theta,), (e,))
        return jax.vmap(derivative, out_axes=(None, -1))(jnp.eye(3))

    motions = motions or (lambda spread, ts, tolerance: jax.vmap(lambda theta: motion(theta, ts, tolerance))(spread))
    one, three, all_ = (jax.jit(f, static_argnums=static) for f in (motion, sensitive, motions))
    ts, few, theta, spread = (jnp.asarray(x) for x in (TS, FEW, THETA, SPREAD))
    return Solver(
        lambda tolerance: one(theta, ts, tolerance),
        lambda theta, tolerance: three(jnp.asarray(theta), ts, tolerance),
        lambda tolerance: all_(spread, few, tolerance),
    )


def jaxlag():
    """From L and D, within one compiled function."""
    return of_jax(lambda theta, ts, tolerance: stacked(*simulated(theta, ts, tolerance)), jaxlag_many, static=(2,))


def jaxlag_from_python():
    """As a user calls it, including the overhead of Python."""
    together = jax.jit(stacked)
    return Solver(lambda tolerance: together(*simulated(THETA, TS, tolerance)))


def simulated(theta, ts, tolerance):
    """q and q̇."""
    params = P | dict(zip("bck", theta, strict=True))
    found = jl.simulate(vehicle.system, vehicle.q0, vehicle.qdot0, ts, params, rtol=tolerance, atol=0.01 * tolerance)
    return found.q, found.qdot


def stacked(*parts):
    """(x, y, φ, ẋ, ẏ, φ̇) as the last axis."""
    return jnp.stack([part[name] for part in parts for name in ("x", "y", "phi")], axis=-1)


def jaxlag_many(spread, ts, tolerance):
    """By `simulate_many`."""
    params, numerics = P | dict(zip("bck", spread.T, strict=True)), {"rtol": tolerance, "atol": 0.01 * tolerance}
    found = jl.simulate_many(vehicle.system, vehicle.q0, vehicle.qdot0, ts, params, over=("b", "c", "k"), **numerics)
    return stacked(found.q, found.qdot)


def field(t, y, theta):
    """ẏ with the signature that diffrax expects."""
    return jnp.stack(rates(*y, *theta))


def by_diffrax(solver, theta, ts, tolerance, adjoint):
    """The equations derived by hand, integrated by diffrax."""
    how = {"saveat": dfx.SaveAt(ts=ts), "stepsize_controller": dfx.PIDController(tolerance, 0.01 * tolerance), "max_steps": 4096}
    term = dfx.ODETerm(field)
    return dfx.diffeqsolve(term, solver, ts[0], ts[-1], None, jnp.asarray(START), theta, adjoint=adjoint, **how).ys


def diffrax(solver):
    """Forward mode."""
    return of_jax(lambda theta, ts, tolerance: by_diffrax(solver, theta, ts, tolerance, dfx.ForwardMode()))


def lax():
    """DOP853 written directly in lax; the batch shares its steps."""
    start = jnp.asarray(START)

    def motion(theta, ts, tolerance):
        return dop853.motion(lambda y: field(None, y, theta), start, ts, tolerance).T

    def motions(spread, ts, tolerance):
        together = jnp.broadcast_to(start[:, None], (6, len(spread)))
        found = dop853.motion(lambda y: field(None, y, spread.T), together, ts, tolerance, max_steps=96)
        return jnp.moveaxis(found, 0, -1)

    return of_jax(motion, motions)


def heyoka():
    """Compiled Taylor series; variational equations; as many parameter sets at once as fit a vector register."""
    import heyoka as hy

    state, parameters = hy.make_vars("x", "y", "phi", "vx", "vy", "vphi"), [hy.par[i] for i in range(3)]
    equations = list(zip(state, rates(*state, *parameters), strict=True))
    variational = hy.var_ode_sys(equations, hy.var_args.params, order=1)
    described = {True: variational, False: equations}
    build = functools.cache(lambda what, tol: hy.taylor_adaptive(described[what], list(START), pars=list(THETA), tol=tol))
    width = hy.recommended_simd_size()
    grid = np.repeat(FEW[:, None], width, 1)
    wide = functools.cache(
        lambda tol: hy.taylor_adaptive_batch(equations, np.repeat(np.array(START)[:, None], width, 1), pars=np.zeros((3, width)), tol=tol)
    )

    def run(what, theta, tolerance):
        integrator = build(what, tolerance)
        integrator.time, integrator.pars[:] = 0.0, theta
        integrator.state[:] = 0.0
        integrator.state[:6] = START
        return integrator.propagate_grid(TS)[-1]

    def sensitive(theta, tolerance):
        out = run(True, theta, tolerance)
        return out[:, :6], out[:, 6:].reshape(-1, 6, 3)

    def many(tolerance):
        integrator, out = wide(tolerance), []
        for members in SPREAD.reshape(-1, width, 3):
            integrator.set_time(0.0)
            integrator.pars[:], integrator.state[:] = members.T, np.array(START)[:, None]
            out.append(integrator.propagate_grid(grid)[-1])
        return np.moveaxis(np.stack(out), -1, 1).reshape(len(SPREAD), len(FEW), 6)

    return Solver(lambda tolerance: run(False, THETA, tolerance), sensitive, many)


def casadi():
    """CVODES; derivatives by its forward sensitivities; the batch in two threads."""
    import casadi as ca

    y, p, theta = ca.SX.sym("y", 6), ca.SX.sym("p", 3), ca.MX.sym("theta", 3)
    ode = {"x": y, "p": p, "ode": ca.vertcat(*rates(*ca.vertsplit(y), *ca.vertsplit(p)))}

    @functools.cache
    def integrator(few, tolerance):
        return ca.integrator("F", "cvodes", ode, 0.0, list(FEW if few else TS), {"reltol": tolerance, "abstol": 0.01 * tolerance})

    @functools.cache
    def functions(tolerance):
        out = integrator(False, tolerance)(x0=ca.DM(START), p=theta)["xf"]
        many = integrator(True, tolerance).map(len(SPREAD), "thread", 2)
        return ca.Function("motion", [theta], [out]), ca.Function("sensitive", [theta], [out, ca.jacobian(ca.vec(out), theta)]), many

    def sensitive(theta, tolerance):
        out, J = functions(tolerance)[1](theta)
        return np.asarray(out).T, np.asarray(J).reshape(-1, 6, 3)

    def many(tolerance):
        found = functions(tolerance)[2](x0=np.repeat(np.array(START)[:, None], len(SPREAD), 1), p=SPREAD.T)["xf"]
        return np.asarray(found).T.reshape(len(SPREAD), len(FEW), 6)

    return Solver(lambda tolerance: np.asarray(functions(tolerance)[0](THETA)).T, sensitive, many)


def with_sensitivities():
    """ẏ and Ṡ = ∂f/∂y S + ∂f/∂θ by SymPy: the symbols (y, S by rows), θ, and the 24 expressions."""
    import sympy as sp

    y, theta, S = sp.symbols("y:6"), sp.symbols("b c k"), sp.Matrix(6, 3, sp.symbols("s:18"))
    f = sp.Matrix(rates(*y, *theta))
    return (*y, *S), theta, [*f, *(f.jacobian(y) * S + f.jacobian(theta))]


def numba():
    """DOP853 of numbalsoda, with symbolic sensitivities; the batch on all cores."""
    import numba as nb
    import sympy as sp

    try:
        import numbalsoda
    except ImportError as error:
        raise ImportError("numbalsoda is not installed: it is built with a Fortran compiler, then `pip install numbalsoda`") from error

    def compiled(size):
        y, theta, expressions = with_sensitivities()
        shared, reduced = sp.cse(expressions[:size])
        given = [f"{name} = u[{i}]" for i, name in enumerate(y[:size])] + [f"{name} = p[{i}]" for i, name in enumerate(theta)]
        lines = given + [f"{name} = {sp.pycode(e)}" for name, e in shared] + [f"du[{i}] = {sp.pycode(e)}" for i, e in enumerate(reduced)]
        namespace = {}
        exec("def f(t, u, du, p):\n    " + "\n    ".join(lines), namespace)
        return nb.cfunc(numbalsoda.lsoda_sig)(namespace["f"])

    functions = {size: compiled(size) for size in (6, 24)}
    address = functions[6].address

    def run(size, theta, tolerance):
        start = np.r_[START, np.zeros(size - 6)]
        return numbalsoda.dop853(functions[size].address, start, TS, data=np.array(theta), rtol=tolerance, atol=0.01 * tolerance)[0]

    def sensitive(theta, tolerance):
        out = run(24, theta, tolerance)
        return out[:, :6], out[:, 6:].reshape(-1, 6, 3)

    @nb.njit(parallel=True)
    def many(start, spread, ts, tolerance):
        out = np.empty((len(spread), len(ts), 6))
        for i in nb.prange(len(spread)):
            out[i] = numbalsoda.dop853(address, start, ts, data=spread[i], rtol=tolerance, atol=0.01 * tolerance)[0]
        return out

    return Solver(lambda tolerance: run(6, THETA, tolerance), sensitive, lambda tolerance: many(np.array(START), SPREAD, FEW, tolerance))


def derived_by_sympy():
    """ẏ from L and D: Lagrange's equations by SymPy; the symbols (y, θ) and the 6 expressions."""
    import sympy as sp

    y, theta = sp.symbols("x y phi vx vy vphi", real=True), sp.symbols("b c k", positive=True)
    q, v = y[:3], y[3:]
    params = P | dict(zip("bck", theta, strict=True))
    named = lambda f, **more: f(
        **{name: params[name] for name in f.__code__.co_varnames[: f.__code__.co_argcount] if name in params}, **more
    )
    at = {"q": dict(zip(("x", "y", "phi"), q, strict=True)), "qdot": dict(zip(("x", "y", "phi"), v, strict=True))}
    L = named(vehicle.lagrangian, **at)
    D = named(vehicle.dampers, qdot=at["qdot"]) + params["k"] * sp.Abs(v[0] + P["v"]) ** 3 / 3
    M = sp.hessian(L, v)
    f = sp.Matrix([sp.diff(L, a) - sp.diff(D, b) for a, b in zip(q, v, strict=True)]) + sp.Matrix([P["M0"] / P["r"], 0, 0])
    return y, theta, [*v, *M.LUsolve(f)]


def sympy():
    """SymPy's equations as NumPy functions, SciPy's DOP853."""
    import sympy as sp
    from scipy.integrate import solve_ivp

    y, theta, found = derived_by_sympy()
    plain = sp.lambdify((*y, *theta), found, "numpy", cse=True)
    check(plain)
    y24, theta24, f24 = with_sensitivities()
    augmented = sp.lambdify((*y24, *theta24), f24, "numpy", cse=True)

    def run(f, theta, ts, tolerance):
        start = np.r_[START, np.zeros(18 if f is augmented else 0)]
        field = lambda t, y: f(*y, *theta)
        return solve_ivp(field, (ts[0], ts[-1]), start, "DOP853", ts, rtol=tolerance, atol=0.01 * tolerance).y.T

    def sensitive(theta, tolerance):
        out = run(augmented, theta, TS, tolerance)
        return out[:, :6], out[:, 6:].reshape(-1, 6, 3)

    return Solver(lambda tolerance: run(plain, THETA, TS, tolerance), sensitive)
