"""Bounds of polynomial paths, of their rates and of theirs, beside what is seen at many times."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._motion.path_bounds import DEGREE, PathBounds


@pytest.mark.parametrize(("scale", "start"), [(1.0, 0.0), (1e-9, 1e6), (1e6, -1e-3)])
def test_paths_and_rates_lie_within_their_bounds(scale, start):
    """Also far from zero, beside which a step is small; and bounds are no wider than they have to be where parts are short."""
    rng, share = np.random.default_rng(3), np.linspace(0, 1, 400)

    @jax.jit
    def bounds(coefficients, offset, between, part):
        path = lambda share: offset + jnp.sum(coefficients * share ** np.arange(DEGREE + 1)[:, None], axis=0)
        return PathBounds.of(path, *between).between(*part)

    short = 0
    for k in range(200):
        coefficients = scale * rng.normal(size=(DEGREE + 1, 3)) * rng.integers(2, size=(DEGREE + 1, 3))
        length, offset = 10.0 ** rng.uniform(-4, 3), scale * 10.0 ** rng.uniform(-1, 3)
        (low, high) = np.sort(rng.uniform(size=2)) if k % 4 else (0.0, 1.0)
        between = np.array([start, start + length])
        length = between[1] - between[0]
        part = between[0] + length * np.array([low, high])
        at = (part[0] - between[0]) / length + share * (part[1] - part[0]) / length
        y = [offset + np.polynomial.polynomial.polyval(at, column) for column in coefficients.T]
        rates = [np.polynomial.polynomial.polyval(at, np.polynomial.polynomial.polyder(column)) / length for column in coefficients.T]
        second = [
            np.polynomial.polynomial.polyval(at, np.polynomial.polynomial.polyder(column, 2)) / length**2 for column in coefficients.T
        ]
        of_y, of_rates, of_curvature = jax.tree.map(np.asarray, bounds(coefficients, offset, between, part))
        sizes = np.sum(np.abs(coefficients), axis=0)
        span = length * (high - low)
        of_both = (rates, of_rates, 1e-8 * sizes / span), (second, of_curvature, 1e-7 * sizes / span**2)
        for seen, (least, most), rounding in ((y, of_y, 0.0), *of_both):
            seen = np.array(seen).T
            assert np.all(seen >= least - rounding - 1e-15 * offset)
            assert np.all(seen <= most + rounding + 1e-15 * offset)
        if high - low < 0.05:
            short += 1
            spread = np.ptp(np.array(y), axis=1)
            assert np.all(of_y[1] - of_y[0] <= 1.5 * spread + 40 * (high - low) ** 2 * sizes + 1e-9 * sizes)
    assert short > 5


SOLVERS = {
    **{name: getattr(dfx, name)() for name in ("Heun", "Bosh3", "Tsit5", "Dopri5", "Dopri8")},
    **{name: getattr(dfx, name)(root_finder=dfx.VeryChord(1e-10, 1e-10)) for name in ("Kvaerno3", "Kvaerno4", "Kvaerno5")},
    "Dop853": jl.Dop853(),
}


@pytest.mark.parametrize("name", SOLVERS)
def test_the_path_of_every_solver_is_known_by_its_values_at_the_nodes(name):
    """Its dense output is a polynomial of no higher degree: the bounds of parts with no length are its values."""
    solver = SOLVERS[name]
    term = dfx.ODETerm(lambda t, y, _: jnp.stack([y[1], -4 * jnp.sin(y[0]) + jnp.cos(3 * t), y[0] * y[1]]))
    y0, none, step = jnp.array([1.0, 0.5, -0.3]), None, (jnp.array(0.0), jnp.array(0.8))
    with jax.numpy_rank_promotion("allow"):  # as diffrax has it
        state = solver.init(term, *step, y0, none)
        *_, dense, _, _ = solver.step(term, *step, y0, none, state, made_jump=False)
    path = solver.interpolation_cls(t0=0.0, t1=1.0, **dense).evaluate
    for share in np.linspace(0.013, 0.977, 23):
        (low, high), *_ = PathBounds.of(path, jnp.array(0.0), jnp.array(1.0)).between(share, share)
        np.testing.assert_allclose([low, high], [path(share)] * 2, atol=1e-12)
