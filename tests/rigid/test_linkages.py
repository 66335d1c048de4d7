"""Bennett's linkage: four hinges whose axes are neither parallel nor meet, of which too many conditions leave one freedom."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

import jaxlag as jl
from jaxlag import rigid

A, ALPHA, BETA = 0.3, 0.7, 1.3  # lengths and twists of two opposite bars; sin α/a = sin β/b
MASS, THETA = 0.5, np.array([1e-3, 2e-3, 2.5e-3])  # of each bar, about its middle
START, RATE = 1.0, 2.0


def bars(q, a, b, alpha, beta):
    """Ground and bar 1, bar 1 and coupler, ground and bar 3: each the seat of a hinge, and the bar that is turned in it."""
    ground = rigid.frame()
    first = ground.on(axes=rigid.rotation_z(q[0]))
    seat = first.on(a * jnp.array([1.0, 0.0, 0.0]), rigid.rotation_x(alpha))
    other = ground.on(-b * jnp.array([1.0, 0.0, 0.0]), rigid.rotation_x(-beta))
    return first, seat.on(axes=rigid.rotation_z(q[1])), other.on(axes=rigid.rotation_z(q[2]))


def closed(q, a, alpha, beta):
    """The fourth hinge, between coupler and bar 3: five conditions."""
    b = a * jnp.sin(beta) / jnp.sin(alpha)
    _, coupler, third = bars(q, a, b, alpha, beta)
    end = coupler.on(b * jnp.array([1.0, 0.0, 0.0]), rigid.rotation_x(beta))
    return rigid.revolute(end, third.on(-a * jnp.array([1.0, 0.0, 0.0]), rigid.rotation_x(-alpha)))


def energy(q, qdot, a, alpha, beta):
    b = a * jnp.sin(beta) / jnp.sin(alpha)
    of = lambda i, half: rigid.kinetic_energy(
        MASS,
        THETA,
        lambda q: bars(q, a, b, alpha, beta)[i].point(half * jnp.array([1.0, 0.0, 0.0])),
        lambda q: bars(q, a, b, alpha, beta)[i].axes,
    )(q, qdot)
    return of(0, a / 2) + of(1, b / 2) + of(2, -a / 2)


BENNETT = jl.System(energy, holonomic={"loop": closed})
PARAMS = {"a": A, "alpha": ALPHA, "beta": BETA}


def second(theta):
    """tan ½θ₁ tan ½θ₂ = sin ½(β + α)/sin ½(β − α). Bennett, Engineering 76 (1903) 777."""
    return 2 * np.arctan(np.sin((BETA + ALPHA) / 2) / np.sin((BETA - ALPHA) / 2) / np.tan(theta / 2))


def inertia_by_hand(theta, a):
    """2T/θ̇₁², from velocities by hand: dθ₂/dθ₁ = −sin θ₂/sin θ₁, and bar 3 turns like the coupler on bar 1."""
    b, turned = a * np.sin(BETA) / np.sin(ALPHA), second(theta)
    slope = -np.sin(turned) / np.sin(theta)
    c, s = np.cos(turned), np.sin(turned)
    to_coupler = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])  # from the axes of its seat
    omega = to_coupler @ np.array([0, np.sin(ALPHA), np.cos(ALPHA) + slope])
    v = to_coupler @ np.array([0, a * np.cos(ALPHA), -a * np.sin(ALPHA)]) + np.cross(omega, [b / 2, 0, 0])
    hinged = MASS * (a / 2) ** 2 + THETA[2]
    return hinged * (1 + slope**2) + MASS * v @ v + omega @ (THETA * omega)


def by_hand(t, a=A):
    """θ₁ at a time, where T stays: t = ∫ √(I(θ)/I(θ₀)) dθ/θ̇₀."""
    start = inertia_by_hand(START, a)
    passed = lambda theta: quad(lambda x: np.sqrt(inertia_by_hand(x, a) / start) / RATE, START, theta, epsabs=1e-12, epsrel=1e-12)[0]
    return brentq(lambda theta: passed(theta) - t, START, 5.0, xtol=1e-13)


def started():
    turned = second(START)
    slope = -np.sin(turned) / np.sin(START)
    return np.array([START, turned, turned]), RATE * np.array([1, slope, slope])


@pytest.mark.slow
def test_bennetts_linkage_moves_with_its_one_freedom():
    """Angles by Bennett's relation, time by quadrature; the derivative by a length, of bars that keep their masses, by differences."""
    ts, q0, qdot0 = np.linspace(0, 2, 11), *started()

    def run(a):
        q = jl.simulate(BENNETT, q0, qdot0, ts, PARAMS | {"a": a}, rtol=1e-10, atol=1e-12).q
        return q[-1, 0], q

    slope, q = jax.jit(jax.jacfwd(run, has_aux=True))(A)
    for t, (first, turned, third) in zip(ts, q, strict=True):
        np.testing.assert_allclose([turned, third], second(first), rtol=0, atol=1e-9)
        np.testing.assert_allclose(first, by_hand(t), rtol=0, atol=1e-8)
    assert q[-1, 0] > np.pi  # through the position where θ₂ changes its sign
    h = 1e-4
    np.testing.assert_allclose(slope, (by_hand(2, a=A + h) - by_hand(2, a=A - h)) / (2 * h), rtol=1e-6)


@pytest.mark.slow
def test_the_check_up_of_a_linkage_with_redundant_rows_has_no_false_alarm():
    """Beside its constraints no acceleration satisfies all rows, of which three are redundant: that was taken for an error."""
    found = jl.examine(BENNETT, *started(), PARAMS)
    assert (found.degrees_of_freedom, found.rows, found.rank, found.redundant) == (1, 5, 2, {"loop": 3})
    (finding,) = found.findings
    assert "3 of the rows follow from those before" in finding
