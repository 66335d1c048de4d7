"""Curves of equilibria against closed forms: snap-through, buckling, pull-in, flutter; with constraints, in small units."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

arch = jl.System(  # two bars that lean against each other
    lambda q, qdot, k, l, h, P: 0.5 * qdot**2 - k * (jnp.sqrt(l**2 + q**2) - jnp.sqrt(l**2 + h**2)) ** 2 - P * q
)


def snaps(k, l, h):
    """The load at which the arch snaps: dP/dq = 0 at √(l² + q²)³ = l² √(l² + h²)."""
    root = (l**2 * np.sqrt(l**2 + h**2)) ** (1 / 3)
    q = np.sqrt(root**2 - l**2)
    return 2 * k * (np.sqrt(l**2 + h**2) - root) * q / root, q


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e3])
def test_snap_through(unit):
    """Both folds, where they are, and what the height does to them, in metres, in micrometres and in kilometres; all points in balance."""
    given = {"k": 2.0, "l": unit, "h": 0.3 * unit, "P": 0.0}
    curve = jl.equilibrium_curve(arch, 0.29 * unit, given, over="P", values=(-0.1 * unit, 0.1 * unit))
    expected, q = snaps(2.0, unit, 0.3 * unit)
    assert [point.kind for point in curve.special] == ["fold", "fold"]
    np.testing.assert_allclose([point.value for point in curve.special], [expected, -expected], rtol=1e-9)
    np.testing.assert_allclose([point.q for point in curve.special], [q, -q], rtol=1e-6)
    lengths = np.sqrt(unit**2 + np.asarray(curve.q) ** 2)
    balance = 4 * (np.sqrt(1.09) * unit - lengths) * np.asarray(curve.q) / lengths
    np.testing.assert_allclose(balance, curve.values, atol=1e-9 * unit)
    away = np.abs(np.abs(curve.q) - q) > 1e-6 * unit
    np.testing.assert_array_equal(np.asarray(curve.is_stable)[away], np.abs(np.asarray(curve.q))[away] > q)
    assert curve.ends == ("an end of `values` is reached",) * 2


@pytest.mark.slow
def test_derivatives_of_a_fold():
    """By the height, forward and reverse, of the load and of where it is; twice."""
    given = {"k": 2.0, "l": 1.0, "P": 0.0}
    fold = lambda h: jl.equilibrium_curve(arch, 0.29, {**given, "h": h}, over="P", values=(-0.1, 0.1)).special[0]
    exact = lambda h: np.array(snaps(2.0, 1.0, h))
    expected = (exact(0.3 + 1e-5) - exact(0.3 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.jacfwd(lambda h: jnp.stack([fold(h).value, fold(h).q]))(0.3), expected, rtol=1e-7)
    np.testing.assert_allclose(jax.grad(lambda h: fold(h).value)(0.3), expected[0], rtol=1e-7)
    second = (exact(0.301) - 2 * exact(0.3) + exact(0.299))[0] / 1e-6
    np.testing.assert_allclose(jax.grad(jax.grad(lambda h: fold(h).value))(0.3), second, rtol=1e-4)


bead = jl.System(  # on a hoop that rotates with W
    lambda q, qdot, W, g: 0.5 * (qdot**2 + (W * jnp.sin(q)) ** 2) + g * jnp.cos(q), dissipation=lambda qdot: 0.05 * qdot**2
)


def test_a_branch_that_crosses():
    """The bottom becomes unstable at W² = g, where cos q = g/W² branches off to both sides."""
    bottom = jl.equilibrium_curve(bead, 0.0, {"W": 1.0, "g": 9.81}, over="W", values=(0.5, 6.0))
    assert [point.kind for point in bottom.special] == ["branch point"]
    np.testing.assert_allclose(bottom.special[0].value, np.sqrt(9.81), rtol=1e-9)
    np.testing.assert_array_equal(np.asarray(bottom.is_stable)[np.asarray(bottom.values) > 3.14], False)
    beside = bottom.branch(0)
    np.testing.assert_allclose(np.cos(beside.q), 9.81 / np.asarray(beside.values) ** 2, atol=1e-9)
    np.testing.assert_allclose([beside.q[0], beside.q[-1]], np.array([-1, 1]) * np.sign(beside.q[-1]) * np.arccos(9.81 / 36), rtol=1e-9)
    assert bool(jnp.all(beside.is_stable)) and beside.special == ()
    with pytest.raises(ValueError, match="`branch.* but that is a fold"):
        arched = jl.equilibrium_curve(arch, 0.29, {"k": 2.0, "l": 1.0, "h": 0.3, "P": 0.0}, over="P", values=(-0.1, 0.1))
        arched.branch(0)


def test_a_branch_point_has_no_derivative_rather_than_a_wrong_one():
    value = lambda g: jl.equilibrium_curve(bead, 0.0, {"W": 1.0, "g": g}, over="W", values=(0.5, 6.0)).special[0].value
    assert np.isnan(jax.grad(value)(9.81))


def test_pull_in():
    """A plate on a spring above another at voltage V: it is pulled in at a third of the gap, V² = 8 c d³/(27 ε A); in micrometres."""
    plate = jl.System(lambda q, qdot, m, c, eps, d, V: 0.5 * m * qdot**2 - 0.5 * c * q**2 + 0.5 * eps * V**2 / (d - q))
    c, eps, d = 3.0, 8.0e-3, 2.0
    limit = np.sqrt(8 * c * d**3 / (27 * eps))
    curve = jl.equilibrium_curve(plate, 0.01, {"m": 1.0, "c": c, "eps": eps, "d": d, "V": 1.0}, over="V", values=(0.5, 60.0))
    fold = curve.special[0]
    np.testing.assert_allclose([fold.value, fold.q], [limit, d / 3], rtol=1e-7)


@pytest.mark.slow
def test_with_constraints():
    """The arch in x, y with bars of variable length as coordinates: the same folds; λ balances the load."""

    def lagrangian(q, qdot, k, s0, P):
        return 0.5 * (qdot["y"] ** 2 + qdot["s"] ** 2) - k * (q["s"] - s0) ** 2 - P * q["y"]

    bars = jl.System(lagrangian, holonomic={"bar": lambda q: q["s"] ** 2 - 1 - q["y"] ** 2})
    given = {"k": 2.0, "s0": np.sqrt(1.09), "P": 0.0}
    curve = jl.equilibrium_curve(bars, {"y": 0.29, "s": 1.04}, given, over="P", values=(-0.1, 0.1))
    expected, _ = snaps(2.0, 1.0, 0.3)
    np.testing.assert_allclose([point.value for point in curve.special], [expected, -expected], rtol=1e-9)
    s, force = np.asarray(curve.q["s"]), np.asarray(curve.multipliers["bar"])
    np.testing.assert_allclose(2 * s * force, 4 * (s - np.sqrt(1.09)), atol=1e-9)


def test_flutter():
    """Ziegler's column with a following force and dampers: the same as `root_locus` finds, which is tested against his closed form."""

    def lagrangian(q, qdot, c):
        first, second = qdot["a"], qdot["b"]
        kinetic = 0.5 * (3 * first**2 + second**2 + 2 * jnp.cos(q["a"] - q["b"]) * first * second)
        return kinetic - 0.5 * c * (q["a"] ** 2 + (q["b"] - q["a"]) ** 2)

    column = jl.System(
        lagrangian,
        dissipation=lambda qdot, d: 0.5 * d * (qdot["a"] ** 2 + (qdot["b"] - qdot["a"]) ** 2),
        force={"follower": lambda q, P: {"a": P * jnp.sin(q["a"] - q["b"]), "b": 0.0}},
    )
    given = {"c": 1.0, "d": 0.3, "P": 0.5}
    curve = jl.equilibrium_curve(column, {"a": 0.0, "b": 0.0}, given, over="P", values=(0.0, 4.0))
    locus = jl.root_locus(column, {"a": 0.0, "b": 0.0}, params=given, over="P", values=jnp.linspace(0.0, 4.0, 41))
    crossing = next(c for c in locus.crossings if c.kind == "flutter")
    flutter = next(point for point in curve.special if point.kind == "flutter")
    np.testing.assert_allclose(flutter.value, crossing.value, rtol=1e-9)
    assert "flutter at P" in repr(curve)


def test_shown():
    import matplotlib as mpl
    import matplotlib.pyplot

    mpl.use("Agg")
    bottom = jl.equilibrium_curve(bead, 0.0, {"W": 1.0, "g": 9.81}, over="W", values=(0.5, 6.0))
    ax = bottom.plot()
    bottom.branch(0).plot(ax=ax)
    styles = [line.get_linestyle() for line in ax.get_lines() if len(line.get_xdata()) > 2]
    assert styles == ["-", "--", "-"]
    assert {text.get_text() for text in ax.get_legend().get_texts()} == {"branch point", "unstable"}
    with pytest.raises(ValueError, match="`of` must name"):
        bottom.plot(of="x")
    mpl.pyplot.close(ax.figure)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"over": "v"}, "`over` must name"),
        ({"values": (2, 1)}, "`values` must be two"),
        ({"values": (2.0, 3.0)}, "`values` must lie around"),
    ],
)
def test_wrong_arguments(change, said):
    with pytest.raises(ValueError, match=said):
        jl.equilibrium_curve(bead, 0.0, {"W": 1.0, "g": 9.81}, **({"over": "W", "values": (0.5, 6.0)} | change))


def test_what_is_not_known_or_not_for_it_is_refused():
    curve = lambda g: jl.equilibrium_curve(bead, 0.0, {"W": 1.0, "g": g}, over="W", values=(0.5, 6.0)).values
    with pytest.raises(ValueError, match="`params` must be known"):
        jax.jit(curve)(9.81)
    touching = jl.System(lambda q, qdot, g: 0.5 * qdot**2 - g * q, unilateral={"floor": jl.Contact(lambda q: q)})
    with pytest.raises(ValueError, match="no contacts"):
        jl.equilibrium_curve(touching, 0.0, {"g": 9.81}, over="g", values=(1.0, 10.0))


@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e9])
def test_from_zero_in_any_units(unit):
    """From the unstable top between the bars, where the coordinate and the load are zero: the same points."""
    given = {"k": 2.0, "l": unit, "h": 0.3 * unit, "P": 0.0}
    curve = jl.equilibrium_curve(arch, 0.0, given, over="P", values=(-0.01 * unit, 0.1 * unit))
    np.testing.assert_allclose([point.value for point in curve.special], [snaps(2.0, unit, 0.3 * unit)[0]], rtol=1e-9)
