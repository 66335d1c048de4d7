"""Inputs that excite a machine, against SciPy and by their spectra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

import jaxlag as jl


@pytest.mark.parametrize("harmonics", [1, 8, [1, 3, 7], np.array([2, 5])])
def test_a_multisine_has_its_harmonics_and_its_strength(harmonics):
    u = jl.Multisine(2e-3, harmonics, amplitude=30.0)
    ts = np.arange(64) * 2e-3 / 64
    spectrum = np.fft.rfft(np.asarray(jax.vmap(u)(ts))) / 64
    orders = np.arange(1, harmonics + 1) if isinstance(harmonics, int) else np.array(harmonics)
    np.testing.assert_allclose(2 * np.abs(spectrum[orders]), 30.0 * np.sqrt(2 / orders.size), rtol=1e-10)
    np.testing.assert_allclose(np.delete(np.abs(spectrum), orders), 0.0, atol=1e-10)
    np.testing.assert_allclose(spectrum[orders], (u.cosines - 1j * u.sines) / 2, atol=1e-10)


def test_its_peaks_are_low():
    """Schroeder's phases: below 1.8 of the root mean square, where phases of zero have √(2n)."""
    u = jl.Multisine(1.0, 31)
    assert np.max(np.abs(jax.vmap(u)(jnp.linspace(0.0, 1.0, 2000)))) < 1.8


def test_a_chirp():
    ts = np.linspace(0.0, 4.0, 200)
    expected = 3.0 * np.sin(2 * np.pi * (1.0 * ts + 1.5 * ts**2 / 8))
    found = jax.vmap(jl.Chirp(2 * np.pi, 5 * np.pi, 4.0, 3.0))(ts)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    shifted = jax.vmap(jl.Chirp(2 * np.pi, 5 * np.pi, 4.0))(ts)
    np.testing.assert_allclose(shifted, signal.chirp(ts, 1.0, 4.0, 2.5, phi=-90), atol=1e-10)


def test_motions_are_driven_by_them_and_differentiated():
    """A free mass under a sine moves by −A sin(ωt)/(mω²) + A t/(mω)."""
    mass = jl.System(lambda qdot, m: 0.5 * m * qdot**2, force=lambda t, u: u(t))
    ts, omega = jnp.linspace(0.0, 2.0, 9), 2 * np.pi / 0.5
    u = jl.Multisine(0.5, 1)
    end = lambda a, b: (
        jl.simulate(
            mass, 0.0, 0.0, ts, {"m": 2.0, "u": jax.tree.unflatten(jax.tree.structure(u), [jnp.array([a]), jnp.array([b])])}, rtol=1e-10
        ).q
    )
    expected = lambda a, b: (a * (1 - jnp.cos(omega * ts)) / omega**2 + b * (ts / omega - jnp.sin(omega * ts) / omega**2)) / 2.0
    np.testing.assert_allclose(end(0.0, 3.0), expected(0.0, 3.0), atol=1e-9)
    for i in range(2):
        np.testing.assert_allclose(jax.jacfwd(end, i)(0.0, 3.0), jax.jacfwd(expected, i)(0.0, 3.0), atol=1e-9)
        np.testing.assert_allclose(jax.jacrev(end, i)(0.0, 3.0), jax.jacfwd(expected, i)(0.0, 3.0), atol=1e-9)


def test_a_drive_is_written_for_the_machine_and_read_again(tmp_path):
    u = jl.Multisine(1.0, 3)
    ts = np.linspace(0.0, 1.0, 5)
    record = jl.Experiment(ts, {"x": np.array([1.0, np.nan, 3.0, 4.0, 5.0])}, {"x": 0.0}, {"x": 0.0}, params={"u": u, "m": 2.0})
    record.to_csv(tmp_path / "drive.csv")
    again = jl.Experiment.from_csv(tmp_path / "drive.csv", {"x": 0.0}, {"x": 0.0}, time="t", observe=lambda q: {"u": q["x"], "x": q["x"]})
    np.testing.assert_array_equal(again.values["x"], record.values["x"])
    np.testing.assert_array_equal(again.values["u"], jax.vmap(u)(jnp.asarray(ts)))
    fine = np.arange(0.0, 1.0, 1e-3)
    record.to_csv(tmp_path / "fine.csv", fine)
    names, *rows = (tmp_path / "fine.csv").read_text().splitlines()
    assert names == "t,u" and len(rows) == 1000
    assert float(rows[7].split(",")[1]) == float(u(jnp.asarray(fine[7])))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: jl.Multisine(0.0), "`period` must be positive"),
        (lambda: jl.Multisine(1.0, 0), "`harmonics` must be at least 1"),
        (lambda: jl.Multisine(1.0, [1, 1]), "`harmonics` must name each once"),
        (lambda: jl.Multisine(1.0, []), "`harmonics` must name each once, and one at least"),
        (lambda: jl.Chirp(1.0, 2.0, -1.0), "`duration` must be positive"),
    ],
)
def test_wrong_use(make, said):
    with pytest.raises(ValueError, match=said):
        make()
