"""What `examine` counts does not depend on units: closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e6, 1e9])
def test_rows_and_inertias_in_any_unit(unit):
    """x ± 1e-6 y are two rows, as the solver has them, in whatever unit; a rotor of 1e-9 beside a mass of 1e5 is not without inertia."""

    def kinetic(qdot, s):
        return 0.5 * qdot["x"] ** 2 + 0.5 * (qdot["y"] / s) ** 2 + 0.5e5 * (qdot["z"] / s) ** 2 + 0.5e-9 * qdot["phi"] ** 2

    rows = {name: lambda q, s, sign=sign: q["x"] + sign * 1e-6 * q["y"] / s for name, sign in (("plus", 1), ("minus", -1))}
    springs = lambda q, qdot, s: kinetic(qdot, s) - 0.5 * ((q["y"] / s) ** 2 + 4e5 * (q["z"] / s) ** 2 + 9e-9 * q["phi"] ** 2)
    system = jl.System(springs, holonomic=rows)
    nothing = dict.fromkeys(("x", "y", "z", "phi"), 0.0)
    found = jl.examine(system, nothing, nothing, {"s": unit})
    assert (found.rank, found.redundant, found.degrees_of_freedom) == (2, {}, 2)
    assert not [finding for finding in found.findings if "inertia" in finding]


@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e9])
def test_what_has_no_inertia_is_named_in_any_unit(unit):
    system = jl.System(lambda q, qdot, s: 0.5 * (qdot["x"] / s + qdot["y"]) ** 2 - 0.5 * q["z"] ** 2 + 0.5 * (qdot["z"] / s) ** 2)
    nothing = {"x": 0.0, "y": 0.0, "z": 0.0}
    (finding,) = (of for of in jl.examine(system, nothing, nothing, {"s": unit}).findings if "inertia" in of)
    assert "'x', 'y';" in finding and "'z'" not in finding


DEFLECTED = {
    name: jl.System(
        lambda q, qdot, s: 0.5 * 2.0 * (qdot["x"] ** 2 + (s * qdot["y"]) ** 2) - 2.0 * 9.81 * s * q["y"],
        holonomic={"rod": lambda q, s: jnp.hypot(q["x"], s * q["y"]) - 1.5} | again,
    )
    for name, again in (("once", {}), ("twice", {"again": lambda q, s: q["x"] ** 2 + (s * q["y"]) ** 2 - 2.25}))
}


@pytest.mark.parametrize("stated", DEFLECTED)
@pytest.mark.parametrize("s", [1e-6, 1.0, 37.0, 1e5])
def test_time_constants_of_a_deflected_pendulum_in_mixed_units(stated, s):
    """A point on a rod at rest at 1 rad, y in a unit of its own: 1/√(g cos 1 / l). A part of what leaves the rod, as it is curved, was
    counted: 0.649 for 0.532.
    """
    q, v = {"x": 1.5 * np.sin(1.0), "y": -1.5 * np.cos(1.0) / s}, {"x": 0.0, "y": 0.0}
    found = jl.examine(DEFLECTED[stated], q, v, {"s": s})
    np.testing.assert_allclose(found.time_constants, 1 / np.sqrt(9.81 * np.cos(1.0) / 1.5), rtol=1e-7)
