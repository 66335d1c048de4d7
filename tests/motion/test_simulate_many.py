"""Many motions at once are the motions one by one, whatever differs between them, and so are their gradients."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag.examples import pendulum

OSCILLATOR = jl.System(lambda q, qdot, m, c: 0.5 * m * qdot**2 - 0.5 * c * q**2, dissipation={"damper": lambda qdot, b: 0.5 * b * qdot**2})
TS = jnp.linspace(0, 3, 7)
DRAW = np.random.default_rng(0).uniform


def exact(t, x0, m, c, b):
    """Damped oscillation from rest."""
    delta, w = b / (2 * m), np.sqrt(c / m - (b / (2 * m)) ** 2)
    return x0 * np.exp(-delta * t) * (np.cos(w * t) + delta / w * np.sin(w * t))


def test_parameters_and_starts_that_differ():
    """150 members: two groups that are full and one that is not; against the closed form."""
    c, x0, b = DRAW(5, 50, 150), DRAW(-2, 2, 150), DRAW(0, 1, 150)
    found = jl.simulate_many(OSCILLATOR, x0, jnp.zeros(150), TS, {"m": 2.0, "c": c, "b": b}, over=("q0", "qdot0", "c", "b"))
    assert found.q.shape == found.qddot.shape == (150, 7) and bool(jnp.all(found.succeeded))
    np.testing.assert_allclose(found.q, exact(np.asarray(TS), x0[:, None], 2.0, c[:, None], b[:, None]), atol=1e-7)


def test_derivatives_in_the_times_are_velocities():
    c, x0 = jnp.array([1.0, 4.0, 9.0]), jnp.array([1.0, -0.5, 2.0])
    run = lambda longer: jl.simulate_many(OSCILLATOR, x0, 0 * x0, longer * TS, {"m": 2.0, "c": c, "b": 0.3}, over=("q0", "qdot0", "c"))
    np.testing.assert_allclose(jax.jacfwd(lambda longer: run(longer).q)(1.0), run(1.0).qdot * TS[None], atol=1e-10)


CARTESIAN = {"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 0.0}


def rods(lengths, g, end, common=None):
    """Where pendulums are at the end, and the forces in their rods."""
    ts, params = end * jnp.linspace(0, 1, 4), pendulum.params | {"g": g, "l": lengths}
    found = jl.simulate_many(pendulum.cartesian, *CARTESIAN, ts, params, over=("l",), common_steps=common, rtol=1e-10)
    return jnp.concatenate([found.q["x"][:, -1], found.multipliers["rod"][:, -1] / 10])


AT = jnp.array([0.8, 1.0, 1.3]), 9.81, 1.0


@pytest.mark.slow
def test_constraints_and_steps():
    """Rods of different lengths, each start projected, as one by one."""

    def alone(l):
        found = jl.simulate(pendulum.cartesian, *CARTESIAN, jnp.linspace(0, 1, 4), pendulum.params | {"l": l}, rtol=1e-10)
        return found.q["x"][-1], found.multipliers["rod"][-1] / 10

    one_by_one = np.transpose([alone(l) for l in AT[0]]).ravel()
    for common in (True, False):
        np.testing.assert_allclose(rods(*AT, common=common), one_by_one, rtol=1e-7)


@pytest.mark.slow
def test_gradients():
    """In what differs, in what is shared and in the times, by central differences; forward and reverse."""
    weights = jnp.arange(1.0, 7.0)
    value = jax.jit(lambda *at: weights @ rods(*at))
    gradients = jax.jit(jax.grad(value, (0, 1, 2)))(*AT)
    direction, h = (jnp.array([0.3, -0.2, 0.5]), 0.7, -0.4), 1e-4
    moved = lambda s: value(*(x + s * d for x, d in zip(AT, direction, strict=True)))
    along = sum(jnp.sum(g * d) for g, d in zip(gradients, direction, strict=True))
    np.testing.assert_allclose(along, (moved(h) - moved(-h)) / (2 * h), rtol=1e-6)
    np.testing.assert_allclose(jax.jvp(value, AT, direction)[1], along, rtol=1e-9)


@pytest.mark.slow
def test_dry_friction_takes_steps_of_its_own():
    """Blocks of different friction stop at v₀²/2μg, each at its own time."""
    block = jl.System(lambda qdot: 0.5 * qdot**2, dissipation=lambda qdot, mu: mu * 9.81 * jnp.abs(qdot))
    mu = jnp.array([0.1, 0.2, 0.5])
    found = jl.simulate_many(block, 0.0, 2.0, jnp.linspace(0, 3, 4), {"mu": mu}, over=("mu",))
    np.testing.assert_allclose(found.q[:, -1], 4 / (2 * mu * 9.81), rtol=1e-8)
    with pytest.raises(ValueError, match="Leave it out"):
        jl.simulate_many(block, 0.0, 2.0, TS, {"mu": mu}, over=("mu",), common_steps=True)


@pytest.mark.parametrize(
    "over, common_steps, message",
    [
        (("k",), None, "`over` must name q0, qdot0 or entries of params, but holds 'k'"),
        ("bc", None, "`over` must name q0, qdot0 or entries of params, but holds 'bc'"),
        ((), None, "`over` must name what differs between members, but is empty"),
        (("b", "c"), None, r"first axes are b: \[\(3,\)\], c: \[\(\)\]"),
    ],
)
def test_bad_input(over, common_steps, message):
    with pytest.raises(ValueError, match=message):
        jl.simulate_many(OSCILLATOR, 1.0, 0.0, TS, {"m": 2.0, "c": 3.0, "b": jnp.ones(3)}, over=over, common_steps=common_steps)


@pytest.mark.slow
def test_a_failure_is_raised_with_its_reason():
    with pytest.raises(ValueError, match="must be finite"):
        jl.simulate_many(OSCILLATOR, 1.0, 0.0, TS, {"m": 2.0, "c": jnp.array([3.0, np.nan]), "b": 0.1}, over=("c",))


ON_EIGHT = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import jaxlag as jl
oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
c = jnp.linspace(1, 4, 13)
end = lambda c: jl.simulate_many(oscillator, 1.0, 0.0, jnp.linspace(0, 3, 4), {"c": c}, over=("c",)).q[:, -1]
found = end(c)
print(jax.device_count(), float(jnp.max(jnp.abs(found - jnp.cos(3 * jnp.sqrt(c))))))
slopes = jax.jit(jax.grad(lambda c: jnp.sum(end(c))))(c)
print(float(jnp.max(jnp.abs(slopes + 1.5 * jnp.sin(3 * jnp.sqrt(c)) / jnp.sqrt(c)))))
"""


@pytest.mark.slow
def test_on_eight_devices():
    """Thirteen members on eight devices, against cos √c t, and the gradient."""
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=8"}
    run = subprocess.run([sys.executable, "-c", ON_EIGHT], capture_output=True, text=True, env=environment)
    assert run.returncode == 0, run.stderr[-2000:]
    devices, off, slopes_off = run.stdout.split()
    assert devices == "8" and float(off) < 1e-7 and float(slopes_off) < 1e-6
