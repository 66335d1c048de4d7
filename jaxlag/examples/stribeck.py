"""A drive axis whose friction curve is learnt from a recording of its speed, without a formula for the curve.

    m ẍ = u(t) − D'(ẋ),   u(t) = Σ A_i sin(2πt/T_i),   D a network: `jaxlag.learnt.PassiveDissipation`

The recording was made with Stribeck's curve, which falls from 5 N at low speed towards 3 N and then rises with the speed:

    F(v) = (F_c + (F_s − F_c) exp(−(v/v_s)²)) tanh(v/v_0) + b v

Two steps recover it. `from_accelerations` compares accelerations with differences of the measured speed (equation error), which is
cheap but mistakes the noise of v for motion: its result, the starting point, has a root mean square error of 1 % of the curve and at most
5 %, where the curve is steep. `recover` then fits the motion itself (output error): 0.6 % and 1.5 %, as good as the noise allows. No
convex D comes closer than 10.5 %, because its force cannot fall.

Source: Klein & Morelli, Aircraft System Identification, chapters 5 and 6 (equation error, output error); the curve: Armstrong-Hélouvry,
Dupont & Canudas de Wit, Automatica 30 (1994) 1083-1138.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxlag as jl


def lagrangian(qdot, m):
    """½mẋ²."""
    return 0.5 * m * qdot**2


def friction(qdot, net):
    """D, learnt from the data."""
    return net(qdot)


def drive(t, A, T):
    """The known force of the motor."""
    return A @ jnp.sin(2 * jnp.pi * t / T)


system = jl.System(lagrangian, dissipation={"friction": friction}, force={"drive": drive})

params = {
    "m": 2.0,  # kg
    "A": jnp.array([5.0, 2.5]),  # N
    "T": jnp.array([2.0, 0.7]),  # s
}
F_c, F_s, v_s, v_0, b = 3.0, 5.0, 0.1, 0.01, 2.0  # N, N, m/s, m/s, N s/m

# A recorded run: t, v with noise of 2e-3 m/s, made by SciPy (tests/data/make_stribeck.py).
recording = Path(__file__).with_name("stribeck_drive.csv")


def true_friction(v):
    """F(v), the curve to be recovered."""
    return (F_c + (F_s - F_c) * jnp.exp(-((v / v_s) ** 2))) * jnp.tanh(v / v_0) + b * v


@jax.jit
def friction_of(net, v):
    """D'(v) of a network, at many speeds."""
    return jax.vmap(jax.grad(lambda v: net(v)))(v)


def observe(qdot):
    """The measured channel: the speed."""
    return {"v": qdot}


def experiment():
    """The recording as an `Experiment`."""
    ts, v = np.loadtxt(recording, delimiter=",", skiprows=1, unpack=True)
    return jl.Experiment(ts, {"v": v}, q0=0.0, qdot0=0.0, observe=observe, sigma=2e-3)


def unlearnt(key):
    """The initial network: 48 weights."""
    return jl.learnt.PassiveDissipation(scale=0.1, power=0.5, width=16, depth=1, key=key)  # m/s, W


def from_accelerations(net, record, steps=1500):
    """The network that best explains the differences of the measured speed, found by Adam."""
    t, v = record.ts, record.values["v"]
    adam = optax.adam(optax.cosine_decay_schedule(2e-2, steps))

    def equation_error(net):
        rate = jax.vmap(lambda t, v: jl.acceleration(system, 0.0, v, params | {"net": net}, t=t).qddot)(t, v)
        return jnp.mean((jnp.diff(v) / jnp.diff(t) - 0.5 * (rate[1:] + rate[:-1])) ** 2)

    def step(carry, _):
        net, state = carry
        updates, state = adam.update(jax.grad(equation_error)(net), state)
        return (optax.apply_updates(net, updates), state), None

    return jax.jit(lambda net: jax.lax.scan(step, (net, adam.init(net)), length=steps)[0][0])(net)


def recover(net=None, **numerics):
    """The fit of the network to the recorded motion; `fit.params["net"]` is the network.

    After ten steps the residual is noise. The data determine the curve but not the individual weights, so the fit need not converge.
    """
    record = experiment()
    start = from_accelerations(unlearnt(jax.random.key(0)) if net is None else net, record)
    return jl.fit(system, record, params | {"net": start}, free=("net",), **({"rtol": 1e-6, "atol": 1e-8, "max_steps": 10} | numerics))
