"""The schemes of Dormand and Prince: their numbers, their orders, and that they serve in diffrax as any other solver."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import DOP853, RK45

import jaxlag as jl

SCHEMES = [jl.Dopri5(), jl.Dop853()]
NAMES = ["Dopri5", "Dop853"]


def full(rows, width):
    return np.array([[*row, *[0.0] * (width - len(row))] for row in rows])


@pytest.mark.fast
def test_numbers_are_those_of_scipy():
    of_8 = jl.Dop853.tableau
    np.testing.assert_array_equal(full(of_8.a[:11], 12), DOP853.A[1:])
    np.testing.assert_array_equal(of_8.a[11], DOP853.B)
    np.testing.assert_array_equal(full(of_8.a[12:], 16), DOP853.A_EXTRA)
    np.testing.assert_array_equal(of_8.c, [*DOP853.C, 1.0, *DOP853.C_EXTRA])
    np.testing.assert_array_equal(of_8.errors, [DOP853.E5, DOP853.E3])
    np.testing.assert_array_equal(of_8.dense, DOP853.D)
    of_5 = jl.Dopri5.tableau
    np.testing.assert_allclose(full(of_5.a[:5], 5), RK45.A[1:], rtol=1e-15)
    np.testing.assert_allclose(of_5.a[5], RK45.B, rtol=1e-15)
    np.testing.assert_allclose(np.abs(of_5.errors[0]), np.abs(RK45.E), rtol=1e-14)


def pendulum(t, y, args):
    return jnp.stack([y[1], -jnp.sin(y[0]) + 0.1 * jnp.cos(t)])


def solved(solver, steps, ts, end=2.0):
    how = dict(saveat=diffrax.SaveAt(ts=ts), stepsize_controller=diffrax.ConstantStepSize())
    return diffrax.diffeqsolve(diffrax.ODETerm(pendulum), solver, 0.0, end, end / steps, jnp.array([1.0, 0.5]), **how).ys


@pytest.mark.slow
@pytest.mark.parametrize("solver, order, steps", [(jl.Dopri5(), 5, 8), (jl.Dop853(), 8, 4)], ids=NAMES)
def test_orders(solver, order, steps):
    """Halving the step divides the error at its end by 2^p, and within it by 2^p too, as the dense output is one order below."""
    ts = jnp.linspace(0.01, 2, 100)
    exact = solved(diffrax.Dopri8(), 2000, ts)
    coarse, fine = (np.abs(solved(solver, n, ts) - exact).max(1) for n in (steps, 2 * steps))
    assert np.log2(coarse[-1] / fine[-1]) == pytest.approx(order, abs=0.4)
    assert np.log2(coarse.max() / fine.max()) == pytest.approx(order, abs=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("solver", SCHEMES, ids=NAMES)
def test_all_of_diffrax_can_be_used(solver):
    """Pytrees, dense output, an event, reverse mode, and a jump of the right-hand side that is stepped on, against closed forms."""

    def decay(t, y, rate):
        return {"a": -rate * y["a"], "b": jnp.where(t < 0.5, 1.0, 3.0) * jnp.ones(2)}

    def run(rate):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(decay),
            solver,
            0.0,
            1.0,
            None,
            {"a": jnp.array(2.0), "b": jnp.zeros(2)},
            rate,
            saveat=diffrax.SaveAt(t1=True, dense=True),
            stepsize_controller=diffrax.ClipStepSizeController(diffrax.PIDController(1e-9, 1e-11), jump_ts=jnp.array([0.5])),
            event=diffrax.Event(lambda t, y, args, **_: y["a"] < 0.1),
            max_steps=256,
        )

    found = run(1.5)
    np.testing.assert_allclose(found.ys["a"], 2 * np.exp(-1.5), rtol=1e-8)
    np.testing.assert_allclose(found.ys["b"], 2.0 * np.ones((1, 2)), rtol=1e-12)  # 0.5 · 1 + 0.5 · 3
    np.testing.assert_allclose(found.evaluate(0.25)["a"], 2 * np.exp(-0.375), rtol=1e-7)
    assert run(6.0).result == diffrax.RESULTS.event_occurred
    np.testing.assert_allclose(jax.grad(lambda rate: run(rate).ys["a"][0])(1.5), -2 * np.exp(-1.5), rtol=1e-7)
