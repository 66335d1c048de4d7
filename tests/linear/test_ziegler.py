"""Stability over a parameter: Ziegler's column, which damping destabilises, and other closed forms of flutter and divergence.

Ziegler, Die Stabilitätskriterien der Elastomechanik, Ingenieur-Archiv 20 (1952) 49-56; Herrmann & Jong, J. Applied Mechanics 32 (1965)
592-597: two rods of length l with masses 2m and m at their ends, springs k and dampers b in both joints, and a force P that follows the
upper rod.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from spectra import assert_same_spectrum

import jaxlag as jl

along = lambda angle: jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def tip(q, l):
    return l * (along(q["phi1"]) + along(q["phi2"]))


def column(t, q, qdot, params, m, l, k):
    lower = l**2 * qdot["phi1"] ** 2
    upper = jl.rate(tip)(t, q, qdot, params)
    return m * lower + 0.5 * m * upper @ upper - 0.5 * k * (q["phi1"] ** 2 + (q["phi2"] - q["phi1"]) ** 2)


def joints(qdot, b):
    return 0.5 * b * (qdot["phi1"] ** 2 + (qdot["phi2"] - qdot["phi1"]) ** 2)


follower = jl.virtual_work(tip, lambda q, P: -P * along(q["phi2"]))
ZIEGLER = jl.System(column, dissipation={"joints": joints}, force={"follower": follower})
straight = lambda: {"phi1": 0.0, "phi2": 0.0}
COLUMN = {"m": 0.5, "l": 0.8, "k": 30.0, "b": 0.0, "P": 0.0}
LOAD = COLUMN["k"] / COLUMN["l"]  # of the dimensionless P l/k = 1
TIME = np.sqrt(COLUMN["m"] * COLUMN["l"] ** 2 / COLUMN["k"])
BRACKET = LOAD * np.array([1.0, 1.3, 1.6, 1.9, 2.3])
dimensionless = lambda b, m=COLUMN["m"]: b / np.sqrt(COLUMN["k"] * m * COLUMN["l"] ** 2)


def ziegler(p, values=BRACKET):
    return jl.root_locus(ZIEGLER, straight, params=COLUMN | p, over="P", values=values)


def by_hand(P, b):
    """Roots of the characteristic polynomial 2s⁴ + 7εs³ + (7 − 2p + ε²)s² + 2εs + 1 in s √(m l²/k)."""
    e = dimensionless(b)
    return np.roots([2, 7 * e, 7 - 2 * P / LOAD + e**2, 2 * e, 1]) / TIME


@pytest.mark.parametrize("b", [0.0, 0.02, 0.7])
def test_the_eigenvalues_of_the_column(b):
    found = ziegler({"b": b})
    np.testing.assert_array_equal(found.values, BRACKET)
    for P, eigenvalues in zip(BRACKET, found.eigenvalues, strict=True):
        assert_same_spectrum(eigenvalues, by_hand(P, b), rtol=1e-7)


@functools.cache
def flutter(b):
    return ziegler({"b": b}).crossings


def test_flutter_without_damping():
    """P l/k = 7/2 − √2, where two frequencies meet, at ω² = k/(√2 m l²)."""
    (crossing,) = flutter(0.0)
    np.testing.assert_allclose(crossing.value, (3.5 - np.sqrt(2)) * LOAD, rtol=1e-9)
    np.testing.assert_allclose(crossing.frequency, 2**-0.25 / TIME, rtol=1e-4)  # of a double root, whose error is a root
    assert (crossing.kind, crossing.direction) == ("flutter", "destabilises")


@pytest.mark.parametrize("b", [1e-4, 0.01, 0.7])
def test_damping_destabilises(b):
    """P l/k = 41/28 + ε²/2, however small the damping, at ω² = 2k/(7 m l²)."""
    (crossing,) = flutter(b)
    shallow = 3e-13 / dimensionless(b)  # rounding of an eigenvalue over the slope of its real part
    np.testing.assert_allclose(crossing.value, (41 / 28 + dimensionless(b) ** 2 / 2) * LOAD, rtol=1e-9 + shallow)
    np.testing.assert_allclose(crossing.frequency, np.sqrt(2 / 7) / TIME, rtol=1e-8)
    assert (crossing.kind, crossing.direction) == ("flutter", "destabilises")


@pytest.mark.slow
def test_the_critical_load_by_the_damping_the_mass_and_the_spring():
    """P = 41k/(28 l) + b²/(2 m l³)."""
    b, m, l, k = 0.7, COLUMN["m"], COLUMN["l"], COLUMN["k"]
    load = lambda p: ziegler(p).crossings[0].value
    at = {"b": b, "m": m, "l": l, "k": k}
    expected = {
        "b": b / (m * l**3),
        "m": -(b**2) / (2 * m**2 * l**3),
        "l": -41 * k / (28 * l**2) - 3 * b**2 / (2 * m * l**4),
        "k": 41 / (28 * l),
    }
    found = jax.grad(load)(at)
    for name in at:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-7, err_msg=name)


@pytest.mark.slow
def test_the_critical_load_without_damping_by_mass_and_spring():
    """P = (7/2 − √2) k/l."""
    m, l, k = COLUMN["m"], COLUMN["l"], COLUMN["k"]
    found = jax.jacfwd(lambda p: ziegler(p).crossings[0].value)({"m": m, "l": l, "k": k})
    np.testing.assert_allclose(found["k"], (3.5 - np.sqrt(2)) / l, rtol=1e-7)
    np.testing.assert_allclose(found["l"], -(3.5 - np.sqrt(2)) * k / l**2, rtol=1e-7)
    np.testing.assert_allclose(found["m"], 0, atol=1e-6)


# Divergence: a rod on a spring under a dead load


def dead_load(q, qdot, m, l, k, P):
    return 0.5 * m * l**2 * qdot**2 - 0.5 * k * q**2 - P * l * jnp.cos(q)


ROD = jl.System(dead_load, dissipation=lambda qdot, b: 0.5 * b * qdot**2)
ROD_PARAMS = {"m": 0.5, "l": 0.8, "k": 30.0, "b": 0.4, "P": 0.0}


@pytest.mark.parametrize("b", [0.0, 0.4, 50.0])
def test_a_rod_under_a_dead_load_diverges(b):
    """m l² φ̈ + b φ̇ + (k − P l) φ = 0: at P = k/l, whatever the damping."""
    values = LOAD * np.array([0.2, 0.6, 0.9, 1.1, 1.4])
    found = jl.root_locus(ROD, 0.0, params=ROD_PARAMS | {"b": b}, over="P", values=values)
    m, l, k = (ROD_PARAMS[name] for name in "mlk")
    for P, eigenvalues in zip(values, found.eigenvalues, strict=True):
        assert_same_spectrum(eigenvalues, np.roots([m * l**2, b, k - P * l]), rtol=1e-9)
    (crossing,) = found.crossings
    np.testing.assert_allclose(crossing.value, LOAD, rtol=1e-9)
    assert (crossing.kind, crossing.direction, crossing.frequency) == ("divergence", "destabilises", 0)


# Branches


def pair(q, qdot, k1, k2):
    return 0.5 * (qdot["a"] ** 2 + qdot["b"] ** 2) - 0.5 * k1 * q["a"] ** 2 - 0.5 * k2 * q["b"] ** 2


@pytest.mark.slow
def test_branches_keep_their_column_where_frequencies_pass_each_other():
    """Two oscillators that know nothing of each other."""
    values = np.linspace(1.0, 9.0, 15)
    found = jl.root_locus(jl.System(pair), {"a": 0.0, "b": 0.0}, params={"k1": 1.0, "k2": 4.0}, over="k1", values=values)
    assert found.crossings == ()
    expected = [1j * np.sqrt(values), -1j * np.sqrt(values), 2j + 0 * values, -2j + 0 * values]
    columns = list(np.asarray(found.eigenvalues).T)
    for branch in expected:
        assert sum(np.allclose(column, branch, rtol=1e-9, atol=1e-9) for column in columns) == 1


def test_free_masses_have_no_branch_that_crosses():
    """All eigenvalues are zero, and stay so."""
    free = jl.System(lambda qdot, m: 0.5 * m * qdot @ qdot)
    found = jl.root_locus(free, jnp.zeros(2), params={"m": 1.0}, over="m", values=[1.0, 2.0])
    np.testing.assert_array_equal(found.eigenvalues, np.zeros((2, 4)))
    assert found.crossings == ()


@pytest.mark.slow
@pytest.mark.parametrize("per_time", [1.0, 1e6, 1e-6])
@pytest.mark.parametrize("k2", [1.0, 4.0])
def test_branches_that_cross_in_opposite_directions_are_both_seen(k2, per_time):
    """Of two oscillators with the dampings p and −p one steadies at p = 0 and the other begins to flutter; as many grow as before."""
    opposite = jl.System(pair, dissipation=lambda qdot, p: 0.5 * p * (qdot["a"] ** 2 - qdot["b"] ** 2))
    params = {"k1": per_time**2, "k2": k2 * per_time**2, "p": 0.0}
    values = per_time * np.array([-0.95, 1.0])
    found = jl.root_locus(opposite, {"a": 0.0, "b": 0.0}, params=params, over="p", values=values).crossings
    np.testing.assert_allclose([crossing.value for crossing in found], 0, atol=1e-14 * per_time)
    kinds = {(crossing.direction, round(crossing.frequency / per_time, 9), crossing.kind) for crossing in found}
    assert len(found) == 2 and kinds == {("stabilises", 1.0, "flutter"), ("destabilises", np.sqrt(k2), "flutter")}


def test_a_branch_of_equilibria_is_followed():
    """A bead on a hoop that turns: cos θ = g/(Ω² R), where δθ̈ = −Ω² sin²θ δθ; the guess is near the first of them."""
    hoop = jl.System(
        lambda q, qdot, m, R, g, Omega: 0.5 * m * R**2 * (qdot**2 + (Omega * jnp.sin(q)) ** 2) + m * g * R * jnp.cos(q),
        dissipation=lambda qdot, b: 0.5 * b * qdot**2,
    )
    p = {"m": 0.1, "R": 0.2, "g": 9.81, "b": 0.0, "Omega": 0.0}
    values = np.array([7.1, 7.5, 8.0, 9.0, 10.0])
    found = jl.root_locus(hoop, 0.3, params=p, over="Omega", values=values)
    tilt = np.arccos(p["g"] / (values**2 * p["R"]))
    for w, eigenvalues in zip(values * np.sin(tilt), found.eigenvalues, strict=True):
        assert_same_spectrum(eigenvalues, [1j * w, -1j * w], rtol=1e-9)


def test_what_is_varied_must_be_an_entry_of_params_and_increase():
    with pytest.raises(ValueError, match="`over` must name one number of `params`, but is 'Q'. The entries are P"):
        jl.root_locus(ZIEGLER, straight, params=COLUMN, over="Q", values=BRACKET)
    with pytest.raises(ValueError, match="`values` must be a list of at least two numbers that increase"):
        jl.root_locus(ZIEGLER, straight, params=COLUMN, over="P", values=BRACKET[::-1])


def test_eigenvalues_of_a_locus_have_no_silent_derivative():
    """They are numbers alone: a derivative of zero would be wrong."""

    def growth(k1, of):
        locus = jl.root_locus(jl.System(pair), lambda: {"a": 0.0, "b": 0.0}, params={"k1": k1, "k2": 4.0}, over="k2", values=[1.0, 2.0])
        return of(locus)

    assert np.isnan(jax.grad(lambda k1: growth(k1, lambda locus: locus.eigenvalues.imag.max()))(1.0))
    assert jax.grad(lambda k1: growth(k1, lambda locus: locus.values.sum()))(1.0) == 0
