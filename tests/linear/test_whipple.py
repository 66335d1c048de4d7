"""The Whipple bicycle against its benchmark: published digits, and the linearised equations of the paper in NumPy.

Meijaard, Papadopoulos, Ruina & Schwab, Linearized dynamics equations for the balance and steer of a bicycle: a benchmark and review,
Proc. R. Soc. A 463 (2007) 1955-1982: eigenvalues in table 2, equations in appendix A.
"""

import functools

import jax
import numpy as np
import pytest
from scipy.optimize import brentq
from spectra import assert_same_spectrum

import jaxlag as jl
from jaxlag.examples import bicycle

PUBLISHED = {
    0.0: [-3.13164324790656, 3.13164324790656, -5.53094371765393, 5.53094371765393],
    5.0: [-14.0783896927982, -0.32286642900409, *(-0.77534188219585 + 4.46486771378823j * np.array([1, -1]))],
    10.0: [-24.62459635017404, 0.16105338653172, *(-3.72016840437287 + 10.90681139476287j * np.array([1, -1]))],
}
WEAVE, CAPSIZE = 4.29238253634111, 6.02426201538837
DUST = 1e-6  # of the six eigenvalues that are zero: a Jordan block of two (x and v) turns rounding into its root
NAMES = tuple(name for name in bicycle.params if name != "v")
STEP = {name: 1e-3 * abs(value) for name, value in bicycle.params.items()}  # of differences, together with half of it


def by_hand(p):
    """M, C₁, K₀ and K₂ of appendix A: M q̈ + v C₁ q̇ + (g K₀ + v² K₂) q = 0 for roll and steer."""
    w, c, lambda_, m_R, m_B, m_H, m_F = (p[name] for name in ("w", "c", "lambda_", "m_R", "m_B", "m_H", "m_F"))
    r_R, r_F, x_B, z_B, x_H, z_H = (p[name] for name in ("r_R", "r_F", "x_B", "z_B", "x_H", "z_H"))
    s, k = np.sin(lambda_), np.cos(lambda_)
    m_T = m_R + m_B + m_H + m_F
    x_T, z_T = (x_B * m_B + x_H * m_H + w * m_F) / m_T, (-r_R * m_R + z_B * m_B + z_H * m_H - r_F * m_F) / m_T
    T_xx = p["I_Rxx"] + p["I_Bxx"] + p["I_Hxx"] + p["I_Fxx"] + m_R * r_R**2 + m_B * z_B**2 + m_H * z_H**2 + m_F * r_F**2
    T_xz = p["I_Bxz"] + p["I_Hxz"] - m_B * x_B * z_B - m_H * x_H * z_H + m_F * w * r_F
    T_zz = p["I_Rxx"] + p["I_Bzz"] + p["I_Hzz"] + p["I_Fxx"] + m_B * x_B**2 + m_H * x_H**2 + m_F * w**2
    m_A = m_H + m_F
    x_A, z_A = (x_H * m_H + w * m_F) / m_A, (z_H * m_H - r_F * m_F) / m_A
    A_xx = p["I_Hxx"] + p["I_Fxx"] + m_H * (z_H - z_A) ** 2 + m_F * (r_F + z_A) ** 2
    A_xz = p["I_Hxz"] - m_H * (x_H - x_A) * (z_H - z_A) + m_F * (w - x_A) * (r_F + z_A)
    A_zz = p["I_Hzz"] + p["I_Fxx"] + m_H * (x_H - x_A) ** 2 + m_F * (w - x_A) ** 2
    u_A = (x_A - w - c) * k - z_A * s
    A_ll = m_A * u_A**2 + A_xx * s**2 + 2 * A_xz * s * k + A_zz * k**2
    A_lx, A_lz = -m_A * u_A * z_A + A_xx * s + A_xz * k, m_A * u_A * x_A + A_xz * s + A_zz * k
    mu, S_R, S_F = c / w * k, p["I_Ryy"] / r_R, p["I_Fyy"] / r_F
    S_T, S_A = S_R + S_F, m_A * u_A + mu * m_T * x_T
    M = [[T_xx, A_lx + mu * T_xz], [A_lx + mu * T_xz, A_ll + 2 * mu * A_lz + mu**2 * T_zz]]
    K0 = [[m_T * z_T, -S_A], [-S_A, -S_A * s]]
    K2 = [[0, (S_T - m_T * z_T) / w * k], [0, (S_A + S_F * s) / w * k]]
    C1 = [[0, mu * S_T + S_F * k + T_xz / w * k - mu * m_T * z_T], [-(mu * S_T + S_F * k), A_lz / w * k + mu * (S_A + T_zz / w * k)]]
    return tuple(np.array(matrix) for matrix in (M, C1, K0, K2))


def eigenvalues_by_hand(p):
    M, C1, K0, K2 = by_hand(p)
    v = p["v"]
    below = -np.linalg.solve(M, np.hstack([p["g"] * K0 + v**2 * K2, v * C1]))
    return np.linalg.eigvals(np.vstack([np.eye(2, 4, 2), below]))


def critical_by_hand(p, at):
    """The speed near `at` where a real part is zero."""

    def real_part(v):
        eigenvalues = eigenvalues_by_hand(p | {"v": v})
        return eigenvalues[np.argmin(np.abs(eigenvalues.real))].real

    return brentq(real_part, at - 0.1, at + 0.1, xtol=1e-14, rtol=1e-15)


def slope(value, p, name):
    """dvalue/dname, by central differences extrapolated to a step of zero."""
    difference = lambda h: (value(p | {name: p[name] + h}) - value(p | {name: p[name] - h})) / (2 * h)
    return (4 * difference(STEP[name] / 2) - difference(STEP[name])) / 3


def test_the_equations_by_hand_are_those_of_the_paper():
    """Its equations (5.3) to (5.6), printed there with 15 digits."""
    M, C1, K0, K2 = by_hand(bicycle.params)
    np.testing.assert_allclose(M, [[80.81722, 2.31941332208709], [2.31941332208709, 0.29784188199686]], rtol=1e-13)
    np.testing.assert_allclose(K0, [[-80.95, -2.59951685249872], [-2.59951685249872, -0.80329488458618]], rtol=1e-13)
    np.testing.assert_allclose(K2, [[0, 76.59734589573222], [0, 2.65431523794604]], rtol=1e-13)
    np.testing.assert_allclose(C1, [[0, 33.86641391492494], [-0.85035641456978, 1.68540397397560]], rtol=1e-13)


@functools.cache
def linearised(v):
    p = bicycle.params | {"v": v}
    return jl.linearise(bicycle.system, *bicycle.state(v, p["r_R"], p["r_F"]), p)


@pytest.mark.slow
@pytest.mark.parametrize("v", PUBLISHED)
def test_the_published_eigenvalues(v):
    """Seven coordinates and three velocities are independent; four eigenvalues are not zero."""
    found = linearised(v)
    assert found.A.shape == (10, 10) and found.basis.shape == (18, 10)
    assert_same_spectrum(found.eigenvalues[-4:], PUBLISHED[v])
    np.testing.assert_allclose(found.eigenvalues[:6], 0, atol=DUST)


@pytest.mark.slow
def test_modes_at_a_speed_at_which_it_stays_upright():
    """Weave, capsize and castering; x, y and the rotations of the wheels stay where they are put. A changed heading or speed does not."""
    found = linearised(5.0)
    modes = found.modes()
    zero = np.asarray(modes.eigenvalues) == 0
    assert zero.sum() == 4 == len(found.A) - np.linalg.matrix_rank(found.A, 1e-9)
    capsize, weave, castering = np.flatnonzero(~zero)
    _, _, pair, _ = PUBLISHED[5.0]
    np.testing.assert_allclose(modes.angular_frequency[weave], abs(pair), rtol=1e-9)
    np.testing.assert_allclose(modes.frequency[weave], abs(pair) / (2 * np.pi), rtol=1e-9)
    np.testing.assert_allclose(modes.damping_ratio[weave], -pair.real / abs(pair), rtol=1e-9)
    np.testing.assert_allclose(modes.time_constant[capsize], 1 / 0.32286642900409, rtol=1e-9)
    np.testing.assert_allclose(modes.time_constant[castering], 1 / 14.0783896927982, rtol=1e-9)
    assert np.all(np.asarray(modes.stable)[~zero])


@pytest.mark.slow
def test_shapes_keep_to_the_equations_by_hand():
    """Roll and steer of each mode, and the yaw that the rolling wheels make of the steer: ψ̇ = (v δ + c δ̇) cos λ/w."""
    v, p = 5.0, bicycle.params
    M, C1, K0, K2 = by_hand(p)
    modes = linearised(v).modes()
    for i in np.flatnonzero(np.asarray(modes.eigenvalues) != 0):
        s, shape = complex(modes.eigenvalues[i]), {name: complex(x[i]) for name, x in modes.shapes.items()}
        moved = np.array([shape["roll"], shape["steer"]])
        terms = np.stack([s**2 * M @ moved, s * v * C1 @ moved, p["g"] * K0 @ moved, v**2 * K2 @ moved])
        np.testing.assert_allclose(terms.sum(0), 0, atol=1e-9 * np.abs(terms).max())
        turned = (v + s * p["c"]) * shape["steer"] * np.cos(p["lambda_"]) / p["w"]
        np.testing.assert_allclose(s * shape["yaw"], turned, rtol=1e-9)
        np.testing.assert_allclose(s * shape["y"], v * shape["yaw"] + s * p["r_R"] * shape["roll"], rtol=1e-8)


@pytest.mark.slow
def test_derivatives_of_the_eigenvalues():
    """Of the four that are not zero, by trail, tilt, speed and a moment of inertia."""
    names = ("c", "lambda_", "v", "I_Fyy")

    def eigenvalues(part):
        p = bicycle.params | part
        return jl.linearise(bicycle.system, *bicycle.state(p["v"], p["r_R"], p["r_F"]), p).eigenvalues

    part = {name: bicycle.params[name] for name in names}
    at, found = eigenvalues(part), jax.jacfwd(eigenvalues)(part)
    for name in names:
        aligned = lambda p: np.array([min(eigenvalues_by_hand(p), key=lambda s: abs(s - z)) for z in np.asarray(at)[-4:]])
        np.testing.assert_allclose(found[name][-4:], slope(aligned, bicycle.params, name), rtol=1e-6, err_msg=name)
        assert np.all(np.isfinite(found[name]))


def locus(p=bicycle.params, values=(3.5, 4.0, 4.5, 5.0, 5.5, 6.0, 6.5)):
    return jl.root_locus(bicycle.system, bicycle.upright, bicycle.rolling, p, over="v", values=np.array(values))


@functools.cache
def crossings():
    return locus().crossings


@pytest.mark.slow
def test_weave_and_capsize_speed():
    weave, capsize = crossings()
    np.testing.assert_allclose([weave.value, capsize.value], [WEAVE, CAPSIZE], rtol=0, atol=1e-8)
    assert (weave.kind, weave.direction) == ("flutter", "stabilises")
    assert (capsize.kind, capsize.direction) == ("divergence", "destabilises")
    expected = eigenvalues_by_hand(bicycle.params | {"v": WEAVE})
    np.testing.assert_allclose(weave.frequency, np.abs(expected[np.argmin(np.abs(expected.real))].imag), rtol=1e-8)
    assert capsize.frequency == 0


@pytest.mark.slow
def test_the_locus_from_rest_to_a_fast_ride():
    """All eigenvalues at each speed; from 1 to 10 m/s weave, capsize and castering are each one branch."""
    values = np.linspace(0.0, 10.0, 21)
    found = locus(values=values)
    for v, eigenvalues in zip(values, np.asarray(found.eigenvalues), strict=True):
        assert_same_spectrum(eigenvalues, [*eigenvalues_by_hand(bicycle.params | {"v": v}), *np.zeros(6)], atol=DUST)
    np.testing.assert_allclose([crossing.value for crossing in found.crossings], [WEAVE, CAPSIZE], rtol=0, atol=1e-8)
    ridden = np.asarray(found.eigenvalues)[values >= 1]
    for column in ridden.T:
        weave = np.abs(column.imag) > 1e-3
        assert weave.all() or not weave.any()
    castering = [column for column in ridden.T if column[-1].real < -20]
    assert len(castering) == 1 and np.all(np.diff(castering[0].real) < 0)


@pytest.mark.slow
def test_the_weave_speed_by_every_parameter():
    """A trail that is longer by 0.01 m makes it 0.115 m/s higher, for instance."""
    found = jax.jacfwd(lambda p: locus(p).crossings[0].value)(bicycle.params)
    assert found["v"] == 0  # it is what is varied
    value = lambda p: critical_by_hand(p, WEAVE)
    for name in NAMES:
        np.testing.assert_allclose(found[name], slope(value, bicycle.params, name), rtol=1e-6, atol=1e-8, err_msg=name)
