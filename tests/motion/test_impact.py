"""Impacts of several contacts and with friction: against closed forms, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import jaxlag as jl

G = 9.81


spinning = jl.System(  # a solid sphere in a plane: x, y, the angle
    lambda q, qdot, m, r, g: 0.5 * m * (qdot[0] ** 2 + qdot[1] ** 2) + 0.2 * m * r**2 * qdot[2] ** 2 - m * g * q[1],
    dissipation={"rub": lambda qdot, multipliers, mu, r: mu * multipliers["floor"] * jnp.abs(qdot[0] + r * qdot[2])},
    unilateral={"floor": jl.Contact(lambda q, r: q[1] - r, restitution=lambda e: e)},
)
SPHERE = {"m": 0.4, "r": 0.11, "g": G, "mu": 0.2, "e": 0.7}


def after_the_bounce(v, spin, mu):
    """ẋ and the spin: slip all along, μ (1 + e) m v_n, or grip, 2/7 m s."""
    vn, slip = np.sqrt(2 * G), v + SPHERE["r"] * spin
    push = -jnp.sign(slip) * jnp.minimum(mu * 1.7 * SPHERE["m"] * vn, 2 / 7 * SPHERE["m"] * jnp.abs(slip))
    return jnp.stack([v + push / SPHERE["m"], spin + 2.5 * push / (SPHERE["m"] * SPHERE["r"])])


@pytest.mark.slow
@pytest.mark.parametrize(("v", "spin"), [(3.0, 0.0), (0.5, 0.0), (0.2, -30.0), (-2.0, 15.0)])
def test_a_ball_with_spin(v, spin):
    """Coulomb's friction takes the impulses for the forces: slip or grip within the impact, with the balance of energy."""

    def bounced(v, spin, mu):
        start = jnp.array([0.0, SPHERE["r"] + 1.0, 0.0]), jnp.stack([v, 0.0 * v, spin])
        return jl.simulate(spinning, *start, jnp.array([0.0, 0.5]), SPHERE | {"mu": mu}, works=True)

    found, at = lambda *given: bounced(*given).qdot[-1, ::2], tuple(map(jnp.asarray, (v, spin, 0.2)))
    np.testing.assert_allclose(found(*at), after_the_bounce(*at), rtol=1e-10)
    motion = bounced(*at)
    assert np.max(np.abs(motion.balance())) < 1e-10
    energies = 0.5 * SPHERE["m"] * 2 * G * (0.7**2 - 1)
    np.testing.assert_allclose(motion.work()["floor"][-1], energies, rtol=1e-9)
    expected = jax.jacfwd(after_the_bounce, (0, 1, 2))(*at)
    np.testing.assert_allclose(jax.jacfwd(found, (0, 1, 2))(*at), expected, atol=1e-9)
    np.testing.assert_allclose(jax.jacrev(found, 2)(*at), expected[2], atol=1e-9)


balls = jl.System(
    lambda qdot: 0.5 * (qdot @ qdot),
    unilateral={f"{i}": jl.Contact(lambda q, i=i: q[i + 1] - q[i] - 1.0, restitution=1.0) for i in range(4)},
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gaps", "after"), [((0, 0, 0), (-0.6, 0.4, 0.4, 0.4, 0.4)), ((1e-3, 2e-3, 1e-3), (0, 0, 0, 0, 1))], ids=["touching", "apart"]
)
def test_newtons_cradle(gaps, after):
    """Balls that touch are struck at once, and part from each other all alike, as Moreau's law has it; balls apart, one after the other."""
    q = jnp.concatenate([jnp.array([-1.0, 1.0]), 1.0 + jnp.cumsum(1.0 + jnp.array(gaps))])
    motion = jl.simulate(balls, q, jnp.zeros(5).at[0].set(1.0), jnp.array([0.0, 2.0]))
    np.testing.assert_allclose(motion.qdot[-1], after, atol=1e-12)


B, R = 0.25, np.hypot(0.25, 1.0)
ALPHA, P2 = np.arctan(0.25), 3 * G / (4 * R)


def corner(side):
    """Of a block, the gap under a corner and where it is."""
    gap = lambda q: q[1] - jnp.cos(q[2]) + side * B * jnp.sin(q[2])
    return gap, lambda q: q[0] + side * B * jnp.cos(q[2]) + jnp.sin(q[2])


def rubs(q, qdot, multipliers):
    slips = {name: jax.jvp(corner(side)[1], (q,), (qdot,))[1] for name, side in (("right", 1), ("left", -1))}
    return 5.0 * sum(multipliers[name] * jnp.abs(slip) for name, slip in slips.items())


block = jl.System(
    lambda q, qdot: 0.5 * (qdot[0] ** 2 + qdot[1] ** 2 + (R**2 / 3) * qdot[2] ** 2) - G * q[1],
    dissipation={"rub": rubs},
    unilateral={"right": corner(1)[0], "left": corner(-1)[0]},
)


@pytest.mark.slow
def test_a_rocking_block():
    """Housner: each impact leaves 1 − 1.5 sin²α of the rate; and the times between impacts by quadrature."""
    tilt = 0.1
    q0 = jnp.array([0.0, np.cos(tilt) + B * np.sin(tilt), tilt])
    ts = jnp.linspace(0, 2.8, 281)
    motion = jl.simulate(block, q0, jnp.zeros(3), ts, works=True, rtol=1e-9, atol=1e-11)

    def fall(amplitude):  # ∫ dφ/φ̇ with φ̇²/2 = p² (cos(α − φ₀) − cos(α − φ)), and φ = φ₀ − s²
        rate = lambda phi: np.sqrt(2 * P2 * (np.cos(ALPHA - amplitude) - np.cos(ALPHA - phi)))
        return quad(lambda s: 2 * s / rate(amplitude - s * s), 0, np.sqrt(amplitude), epsabs=1e-13)[0], rate(0.0)

    time, rate = fall(tilt)
    impacts, rates = [time], [rate]
    while time < 2.8:
        rate *= 1 - 1.5 * np.sin(ALPHA) ** 2
        half, _ = fall(ALPHA - np.arccos(np.cos(ALPHA) + rate**2 / (2 * P2)))
        time += 2 * half
        impacts.append(time)
        rates.append(rate)
    happened = sum(t < 2.8 for t in impacts)
    struck = [motion.contacts[name].impacts for name in ("left", "right")]
    assert happened >= 4
    np.testing.assert_array_equal(sum(struck), np.searchsorted(impacts, ts))
    latest = max(float(motion.contacts[name].changed[-1]) for name in ("left", "right"))
    np.testing.assert_allclose(latest, impacts[happened - 1], rtol=1e-7)
    assert np.max(np.abs(motion.balance())) < 1e-9


rod = jl.System(  # of length 2 and mass 1, on its lower end
    lambda q, qdot: 0.5 * (qdot[0] ** 2 + qdot[1] ** 2 + qdot[2] ** 2 / 3),
    dissipation={"rub": lambda q, qdot, multipliers, mu: mu * multipliers["floor"] * jnp.abs(qdot[0] + jnp.cos(q[2]) * qdot[2])},
    unilateral={"floor": jl.Contact(lambda q: q[1] - jnp.cos(q[2]), restitution=lambda e: e)},
)


@pytest.mark.slow
@pytest.mark.parametrize(("e", "gains"), [(0.99, True), (0.1, False)])
def test_kanes_paradox_is_named(e, gains):
    """A rod that grips within the impact, of which Newton's law would make more energy than there was."""
    phi, down = 0.7, 1.0
    nn, tt, nt = 1 + 3 * np.sin(phi) ** 2, 1 + 3 * np.cos(phi) ** 2, 3 * np.sin(phi) * np.cos(phi)
    slip = -nt * down / nn  # the one with the least energy for this approach
    inverse = np.linalg.inv([[nn, nt], [nt, tt]])
    before, after = np.array([-down, slip]), np.array([e * down, 0.0])
    assert (after @ inverse @ after > before @ inverse @ before) == gains
    start = jnp.array([0.0, np.cos(phi) + 1e-3, phi]), jnp.array([slip, -down, 0.0])
    motion = jl.simulate(rod, *start, jnp.array([0.0, 0.01]), {"mu": 3.0, "e": e}, throw=False)
    if gains:
        assert motion.result == jl.results.RESULTS.energy_gained
    else:
        velocity = np.array([motion.qdot[-1, 1] + np.sin(phi) * motion.qdot[-1, 2], motion.qdot[-1, 0] + np.cos(phi) * motion.qdot[-1, 2]])
        assert motion.succeeded
        np.testing.assert_allclose(velocity, after, atol=1e-2)  # it turns on, for 9 ms


@pytest.mark.slow
def test_the_pecking_woodpecker():
    """Glocker's toy, linearised: the impacts of one cycle, and how far it falls in it.

    Numbers and times to three digits: Ch. Glocker, Dynamik von Starrkörpersystemen mit Reibung und Stössen (1995), as reproduced by time
    stepping.
    """
    c, r0, rM, hM, lM, lG, hS, lS = 0.0056, 0.0025, 0.0031, 0.0058, 0.010, 0.015, 0.02, 0.0201
    mM, mS, JM, JS = 0.0003, 0.0045, 5e-9, 7e-7

    def lagrangian(q, qdot):
        (y, sleeve, bird), (v, a, b) = q, qdot
        kinetic = mM * v**2 + mS * (v + lM * a + lG * b) ** 2 + JM * a**2 + JS * b**2
        return 0.5 * kinetic - G * (mM * y + mS * (y + lM * sleeve + lG * bird)) - 0.5 * c * (sleeve - bird) ** 2

    def rub(qdot, multipliers):
        v, a, b = qdot
        beak, sleeve = jnp.abs(v + lM * a + (lG - lS) * b), jnp.abs(v + rM * a)
        return 0.3 * (multipliers["beak"] * beak + (multipliers["lower"] + multipliers["upper"]) * sleeve)

    toy = jl.System(
        lagrangian,
        dissipation={"rub": rub},
        unilateral={
            "beak": jl.Contact(lambda q: (lM + lG - lS - r0) - hS * q[2], restitution=0.5),
            "lower": lambda q: (rM - r0) + hM * q[1],
            "upper": lambda q: (rM - r0) - hM * q[1],
        },
    )
    ts = jnp.linspace(0, 0.3, 3001)
    motion = jl.simulate(toy, jnp.array([0.0, -0.1036, -0.2788]), jnp.array([-0.3411, 0.0, -7.4583]), ts, works=True)

    def moments(name):  # of its impacts
        contact = motion.contacts[name]
        return np.asarray(contact.changed)[np.flatnonzero(np.diff(contact.impacts)) + 1]

    np.testing.assert_allclose(moments("upper")[:2], [0.0779, 0.0816], atol=1e-3)
    np.testing.assert_allclose(moments("lower")[:2], [0.1188, 0.1215], atol=1e-3)
    (first, second), peck = moments("beak"), np.flatnonzero(np.diff(motion.contacts["beak"].impacts))[0]
    np.testing.assert_allclose(first, 0.0810, atol=1e-3)
    np.testing.assert_allclose(motion.qdot[peck : peck + 2, 2], [16.9, -8.5], atol=0.1)
    np.testing.assert_allclose(second - first, 0.146, atol=1e-3)
    fallen = np.interp([first, second], ts, motion.q[:, 0])
    np.testing.assert_allclose(fallen[0] - fallen[1], 19.5e-3, atol=0.2e-3)
    assert np.max(np.abs(motion.balance())) < 1e-8


@pytest.mark.slow
def test_derivatives_by_a_restitution_at_its_bounds():
    """From a wall at e v, by both laws and in any unit of length: dq/de = v (t − t_hit) = 2 at 0 and at 1 too, and 0 beyond them."""
    for law in (jl.NewtonRestitution(), jl.PoissonRestitution()):
        wall = jl.System(lambda qdot: 0.5 * qdot**2, unilateral={"wall": jl.Contact(lambda q: q, restitution=lambda e: e, law=law)})
        at = jax.value_and_grad(
            lambda e, unit, wall=wall: jl.simulate(wall, unit, -2 * unit, np.linspace(0, 1.5, 4), {"e": e}).q[-1] / unit
        )
        for unit in (1.0, 1e9, 1e-9):
            for e, there, slope in ((0.0, 0.0, 2.0), (1.0, 2.0, 2.0), (0.5, 1.0, 2.0), (1.2, 2.0, 0.0)):
                np.testing.assert_allclose(at(e, unit), [there, slope], rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_derivatives_by_a_restitution_at_its_bounds_with_friction():
    """The impulse (1 + e) 2 takes a quarter of it from the velocity along the wall."""
    wall = jl.System(
        lambda qdot: 0.5 * (qdot["x"] ** 2 + qdot["y"] ** 2),
        unilateral={"wall": jl.Contact(lambda q: q["x"], restitution=lambda e: e)},
        dissipation=lambda qdot, multipliers, mu: mu * jnp.abs(multipliers["wall"]) * jnp.abs(qdot["y"]),
    )

    def ends(e):
        last = jl.simulate(wall, {"x": 1.0, "y": 0.0}, {"x": -2.0, "y": 3.0}, np.linspace(0, 1.5, 4), {"e": e, "mu": 0.25})[-1]
        return (both := jnp.stack([last.q["x"], last.q["y"]])), both

    for e in (0.0, 1.0):
        slope, value = jax.jacfwd(ends, has_aux=True)(e)
        np.testing.assert_allclose(value, [2 * e, 3 * 1.5 - (1 + e) * 0.5], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(slope, [2, -0.5], rtol=1e-8)
