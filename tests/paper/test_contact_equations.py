"""Contacts on paper, against equations written by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy

import jaxlag as jl


def ball(q, qdot, m, g):
    return 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2) - m * g * q["y"]


def rub(qdot, multipliers, mu):
    return mu * multipliers["floor"] * jnp.abs(qdot["x"])


floor = jl.Contact(lambda q, r: q["y"] - r, restitution=lambda e: e)
wall = jl.Contact(lambda q: q["x"], 0.5, jl.PoissonRestitution())
in_a_corner = jl.System(ball, dissipation=rub, unilateral={"floor": floor, "wall": wall})


def test_a_ball_in_a_corner():
    """Friction by the force of the floor; Newton's law at the floor, Poisson's at the wall."""
    on_paper = jl.equations(in_a_corner, {"x", "y"}, {"m", "g", "mu", "r", "e"})
    assert (
        repr(on_paper)
        == """\
m ẍ + μ λ_floor sign(ẋ) = λ_wall
m ÿ + m g = λ_floor

g_floor = y − r
g_floor ≥ 0
λ_floor ≥ 0
g_floor λ_floor = 0
ġ_floor⁺ = −e ġ_floor⁻

g_wall = x
g_wall ≥ 0
λ_wall ≥ 0
g_wall λ_wall = 0
Λ_wall⁺ = ½ Λ_wall⁻

ẍ = λ_wall/m − (μ/m) λ_floor sign(ẋ)
ÿ = λ_floor/m − g"""
    )
    x, y, xdot, m, g, mu, r, of_floor, of_wall = sympy.symbols("x y xdot m g mu r lambda_floor lambda_wall", real=True)
    assert sympy.simplify(on_paper.accelerations["x"] - (of_wall - mu * of_floor * sympy.sign(xdot)) / m) == 0
    assert on_paper.contacts == {"floor": y - r, "wall": x} and len(on_paper.g) == 0 and on_paper.with_multipliers
    assert sympy.Matrix([[0, 1], [1, 0]]) == on_paper.G
    latex = on_paper.latex()
    for line in (r"g_{\mathrm{floor}} &\ge 0", r"\dot{g}_{\mathrm{floor}}^{+} &= -e \dot{g}_{\mathrm{floor}}^{-}"):
        assert line in latex


@pytest.mark.parametrize(
    ("restitution", "said"),
    [(0.0, "ġ_stop⁺ = 0"), (1.0, "ġ_stop⁺ = −ġ_stop⁻"), (0.25, "ġ_stop⁺ = −¼ ġ_stop⁻"), (lambda a, b: a + b, "ġ_stop⁺ = (−a − b) ġ_stop⁻")],
    ids=["none", "all", "a quarter", "a sum"],
)
def test_restitution(restitution, said):
    mass = jl.System(lambda q, qdot, m: 0.5 * m * qdot**2, unilateral={"stop": jl.Contact(lambda q, l: l - q, restitution)})
    printed = repr(jl.equations(mass, "x", {"m", "l", "a", "b"}))
    assert printed.startswith("m ẍ = −λ\n\ng_stop = l − x\n") and said in printed.splitlines()


CORNERS = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])


def corners(q, a):
    """The corners of a square, (4, 2)."""
    c, s = jnp.cos(q["phi"]), jnp.sin(q["phi"])
    return jnp.stack([q["x"], q["y"]])[None] + a * jnp.asarray(1.0 * CORNERS) @ jnp.array([[c, s], [-s, c]])


def test_a_block_that_rubs_on_its_corners():
    """Of four corners as one contact: the forces at each, against SymPy's derivatives of where the corners are."""

    def rubbing(q, qdot, multipliers, mu, a):
        _, velocities = jax.jvp(lambda q: corners(q, a), (q,), (qdot,))
        return mu * jnp.sum(multipliers["table"] * jnp.abs(velocities[:, 0]))

    block = jl.System(
        lambda q, qdot, m, k, g: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2 + k**2 * qdot["phi"] ** 2) - m * g * q["y"],
        dissipation=rubbing,
        unilateral={"table": lambda q, a: corners(q, a)[:, 1]},
    )
    params = {"m": 0.37, "k": 0.041, "g": 9810.0, "a": 50.0, "mu": 0.18}
    on_paper = jl.equations(block, {"x", "y", "phi"}, set(params))
    x, y, phi, xdot, phidot, a = sympy.symbols("x y phi xdot phidot a", real=True)
    loads = sympy.symbols("lambda_table_1:5", real=True)
    force = sympy.zeros(3, 1)
    for (u, v), load in zip(CORNERS.tolist(), loads, strict=True):
        place = sympy.Matrix([x + a * (u * sympy.cos(phi) - v * sympy.sin(phi)), y + a * (u * sympy.sin(phi) + v * sympy.cos(phi))])
        jacobian = place.jacobian([phi, x, y])
        slip = (jacobian[0, :] * sympy.Matrix([phidot, xdot, 0]))[0]
        force += load * (jacobian[1, :].T - sympy.Symbol("mu", real=True) * sympy.sign(slip) * jacobian[0, :].T)
        assert sympy.expand_trig(sympy.expand(on_paper.contacts[f"table_{loads.index(load) + 1}"] - place[1])) == 0
    mass = sympy.Matrix([params["m"] * params["k"] ** 2, params["m"], params["m"]])
    for random in np.random.default_rng(3).normal(size=(20, 4)):
        state = {"phi": random[0], "xdot": 1e3 * random[1], "phidot": 30 * random[2]}
        state |= {str(load): 5 + value for load, value in zip(loads, np.roll(random, 1), strict=True)}
        numbers = {sympy.Symbol(name, real=True): value for name, value in (state | params).items()}
        expected = [*(force.subs(numbers).evalf() + sympy.Matrix([0, 0, -params["m"] * params["g"]]))]
        for name, inertia, of in zip(("phi", "x", "y"), mass, expected, strict=True):
            found = on_paper.accelerations[name].subs(numbers).evalf()
            np.testing.assert_allclose(float(found * inertia), float(of), rtol=1e-12, atol=1e-9)


def test_contacts_beside_constraints():
    """A bead on a circle that a table supports: the force of the circle is found, that of the table is given."""
    bead = jl.System(
        lambda q, qdot, m, g: 0.5 * m * (qdot["x"] ** 2 + qdot["y"] ** 2) - m * g * q["y"],
        holonomic={"circle": lambda q, l: (q["x"] ** 2 + q["y"] ** 2 - l**2) / 2},
        unilateral={"table": lambda q, h: q["y"] + h},
    )
    on_paper = jl.equations(bead, {"x", "y"}, {"m", "g", "l", "h"})
    x, y, xdot, ydot, m, g, of_table = sympy.symbols("x y xdot ydot m g lambda_table", real=True)
    expected = -(m * (xdot**2 + ydot**2) + y * (of_table - m * g)) / (x**2 + y**2)
    assert sympy.simplify(on_paper.multipliers["circle"] - expected) == 0
    assert on_paper.multipliers["table"] == of_table and len(on_paper.g) == 1


def test_what_is_refused():
    on_paper = jl.equations(in_a_corner, {"x", "y"}, {"m", "g", "mu", "r", "e"})
    for program in (on_paper.to_python, on_paper.to_c):
        with pytest.raises(ValueError, match="without contacts that open and close"):
            program()
    with pytest.raises(ValueError, match="no contacts that open and close in `equations` with `linearised_at`"):
        jl.equations(in_a_corner, {"x", "y"}, {"m", "g", "mu", "r", "e"}, linearised_at={"x": 0, "y": "r"})
