"""The lecture's vehicle: equations derived by hand, their exact solution, and the tasks of the benchmarks.

    M_x ẍ = M₀/r − k w²,   M_x = M + 2m + 2Θ_r/r²,   w = ẋ + v
    M ÿ = −M g − 2c(y − l) − 2b ẏ
    Θ_s φ̈ = −2a²(c φ + b φ̇)

State (x, y, φ, ẋ, ẏ, φ̇); θ = (b, c, k). The vehicle drives forwards against the wind, so w > 0 and |w| = w.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

import jaxlag as jl
from jaxlag.examples import vehicle

jax.config.update("jax_enable_x64", True)

P = vehicle.params
MX = P["M"] + 2 * P["m"] + 2 * P["Theta_r"] / P["r"] ** 2
THRUST, MASS, PITCH, ARM, LENGTH, WIND, G = P["M0"] / P["r"], P["M"], P["Theta_s"], P["a"], P["l"], P["v"], P["g"]
START = (0.0, 0.55, 0.05, 0.0, 0.0, 0.0)
THETA = np.array([P["b"], P["c"], P["k"]])
TS = np.linspace(0.0, 20.0, 1000)
FEW = np.linspace(0.0, 20.0, 101)  # samples of each of many motions
SEEN = (1, 2, 3)  # y, φ, ẋ are recorded
GUESS = THETA * np.array([1.3, 0.75, 0.6])
SPREAD = THETA * np.random.default_rng(0).uniform(0.8, 1.2, (1024, 3))


def rates(x, y, phi, vx, vy, vphi, b, c, k):
    """ẏ, for numbers or symbols of any kind."""
    w = vx + WIND
    drive = (THRUST - k * w * w) / MX
    heave = -G - 2.0 * (c * (y - LENGTH) + b * vy) / MASS
    pitch = -2.0 * ARM**2 * (c * phi + b * vphi) / PITCH
    return vx, vy, vphi, drive, heave, pitch


def exact(theta, ts):
    """The closed form, (samples, 6): a tanh for the speed, damped oscillations for heave and pitch."""
    b, c, k = theta
    terminal = jnp.sqrt(THRUST / k)
    rate, offset = k * terminal / MX, jnp.arctanh(WIND / terminal)
    u = rate * ts + offset
    log_cosh = lambda u: jnp.logaddexp(u, -u)
    x = MX / k * (log_cosh(u) - log_cosh(offset)) - WIND * ts
    rest = LENGTH - MASS * G / (2 * c)
    y, vy = oscillation(START[1] - rest, b / MASS, 2 * c / MASS, ts)
    phi, vphi = oscillation(START[2], ARM**2 * b / PITCH, 2 * ARM**2 * c / PITCH, ts)
    return jnp.stack([x, rest + y, phi, terminal * jnp.tanh(u) - WIND, vy, vphi], axis=-1)


def oscillation(amplitude, decay, square, ts):
    """s̈ + 2δṡ + ω₀²s = 0 from rest."""
    omega = jnp.sqrt(square - decay**2)
    envelope, sine, cosine = amplitude * jnp.exp(-decay * ts), jnp.sin(omega * ts), jnp.cos(omega * ts)
    return envelope * (cosine + decay / omega * sine), -envelope * square / omega * sine


EXACT = np.asarray(exact(THETA, TS))
AT_GUESS = np.asarray(exact(GUESS, TS)), np.asarray(jax.jacfwd(exact)(GUESS, TS))
OF_SPREAD = np.asarray(jax.vmap(exact, (0, None))(SPREAD, FEW))
RECORD = EXACT[:, SEEN] + 1e-3 * np.random.default_rng(1).standard_normal((TS.size, 3))


def loss_and_gradient(states, sensitivities):
    """½ Σ (difference from the record)², and its gradient with respect to θ, from the states and their derivatives."""
    residual, J = states[:, SEEN] - RECORD, sensitivities[:, SEEN]
    return 0.5 * np.sum(residual**2), np.einsum("ij,ijp->p", residual, J)


def fitted(sensitive, steps=30):
    """Levenberg–Marquardt with scaled parameters; stops when a step changes them by less than 1e-7."""
    theta, damping = GUESS, 1e-3
    assess = lambda theta: (lambda y, S: ((y[:, SEEN] - RECORD).ravel(), S[:, SEEN].reshape(-1, 3) * GUESS))(*sensitive(theta))
    residual, J = assess(theta)
    for _ in range(steps):
        A = J.T @ J
        step = -np.linalg.solve(A + damping * np.diag(np.diag(A)), J.T @ residual)
        trial = theta + GUESS * step
        if np.max(np.abs(step)) < 1e-7:
            return trial
        new_residual, new_J = assess(trial)
        better = new_residual @ new_residual < residual @ residual
        damping *= 0.1 if better else 10.0
        if better:
            theta, residual, J = trial, new_residual, new_J
    return theta


def exactly_fitted():
    """The fit by the closed form."""
    solution = jax.jit(lambda theta: (exact(theta, TS), jax.jacfwd(exact)(theta, TS)))
    return fitted(lambda theta: map(np.asarray, solution(theta)))


def check(derived, count=20):
    """Asserts that `derived(*state, *theta)` are the rates that jaxlag finds, at random states."""
    for state in np.random.default_rng(2).uniform(-1.0, 1.0, (count, 6)):
        q, qdot = dict(zip(("x", "y", "phi"), state[:3], strict=True)), dict(zip(("x", "y", "phi"), state[3:], strict=True))
        found = jl.acceleration(vehicle.system, q, qdot, P).qddot
        expected = [*state[3:], *(float(found[name]) for name in ("x", "y", "phi"))]
        assert all(math.isclose(float(a), float(b), rel_tol=1e-10) for a, b in zip(derived(*state, *THETA), expected, strict=True))
