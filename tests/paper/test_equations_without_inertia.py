"""Equations of first order on paper, of coordinates without inertia: as printed, and their velocities against the simulation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy

import jaxlag as jl


def springs(q, E, c):
    return -0.5 * E * q["x"] ** 2 - 0.5 * c * (q["x"] - q["z"]) ** 2


def dashpot(qdot, b):
    return 0.5 * b * qdot["z"] ** 2


LOAD, GRIP = {"load": lambda F: {"x": F}}, {"grip": lambda q, x0: q["x"] - x0}
MAXWELL = jl.System(lambda q, c: springs(q, 0.0, c), dissipation=dashpot, force=LOAD)
KELVIN_VOIGT = jl.System(lambda q, E: -0.5 * E * q["x"] ** 2, dissipation=lambda qdot, b: 0.5 * b * qdot["x"] ** 2, force=LOAD)
ZENER = jl.System(springs, dissipation=dashpot, force=LOAD)
HELD = jl.System(springs, dissipation=dashpot, holonomic=GRIP)
SLIDER = jl.System(
    lambda q, c: springs(q, 0.0, c),
    dissipation=lambda qdot, b, F: F * jnp.abs(qdot["z"]) + 0.5 * b * qdot["z"] ** 2,
    holonomic=GRIP,
)
NAMES = {"E", "c", "b", "F", "x0"}


@pytest.mark.parametrize(
    ("system", "coordinates", "lines"),
    [
        (MAXWELL, {"x", "z"}, ["−c (z − x) = F", "b ż − c (x − z) = 0"]),
        (KELVIN_VOIGT, {"x"}, ["b ẋ + E x = F"]),
        (ZENER, {"x", "z"}, ["E x − c (z − x) = F", "b ż − c (x − z) = 0"]),
        (HELD, {"x", "z"}, ["x = x₀", "", "b ż + c (z − x₀) = 0", "", "λ = (E + c) x₀ − c z"]),
        (SLIDER, {"x", "z"}, ["x = x₀", "", "b ż + F sign(ż) + c (z − x₀) = 0", "", "λ = −c (z − x₀)"]),
    ],
    ids=["Maxwell", "Kelvin-Voigt", "Zener", "Zener, held", "a slider beside a dashpot"],
)
def test_as_in_a_textbook(system, coordinates, lines):
    assert str(jl.equations(system, coordinates, NAMES)).splitlines() == lines


@pytest.mark.slow
def test_velocities_and_forces_of_a_held_solid_equal_the_simulation():
    on_paper = jl.equations(HELD, {"x", "z"}, NAMES, multipliers=True)
    (rate,) = (v for v in on_paper.qdot if v.name == "zdot")
    row = next(equation for equation in on_paper.motion if equation.has(rate))
    formulas = [sympy.solve(row, rate)[0], on_paper.multipliers["grip"]]
    written = sympy.lambdify([on_paper.q, [on_paper.params[name] for name in sorted(NAMES)]], formulas)
    draw = np.random.default_rng(0).uniform(0.5, 2.0, (20, 6))
    solve = jax.vmap(lambda q, p: (jl.consistent_state(HELD, q, {"x": 0.0, "z": 0.0}, p), jl.acceleration(HELD, q, q, p)))
    q, p = {"x": draw[:, 1], "z": draw[:, 0]}, {"x0": draw[:, 1]} | dict(zip(("E", "c", "b", "F"), draw.T[2:], strict=True))
    (_, velocity), found = solve(q, p)
    for i in range(20):
        order = [float(q[x.name][i]) for x in on_paper.q], [float(p[name][i]) for name in sorted(NAMES)]
        np.testing.assert_allclose([velocity["z"][i], found.multipliers["grip"][i]], written(*order), rtol=1e-12)
