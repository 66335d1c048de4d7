"""What `examine` says of systems of many coordinates: which term leaves no zeros to a solve."""

import jax.numpy as jnp
import pytest

import jaxlag as jl

N = 64
LINE = jnp.linspace(0.0, 1.0, N)


def examined(lagrangian, q=LINE, **terms):
    return jl.examine(jl.System(lagrangian, **terms), q, jnp.zeros_like(q))


def moving(q, qdot):
    """A row of masses, with springs between neighbours."""
    return 0.5 * jnp.sum(qdot**2) - 0.5 * jnp.sum(jnp.diff(q) ** 2)


@pytest.mark.slow
def test_neighbours_alone_are_sparse():
    """Entries by hand: a diagonal, three diagonals twice, and two in each row that joins neighbours."""
    found = examined(
        {"masses and springs": moving},
        dissipation={"dampers": lambda qdot: 0.5 * jnp.sum(jnp.diff(qdot) ** 2)},
        holonomic={"pairs": lambda q: q[1::2] - q[::2] - LINE[1]},
    )
    assert found.couplings == {
        ("∂²L/∂q̇²", "masses and springs"): (N, N**2),
        ("∂²L/∂q²", "masses and springs"): (3 * N - 2, N**2),
        ("∂²D/∂q̇²", "dampers"): (3 * N - 2, N**2),
        ("G", "pairs"): (N, N // 2 * N),
    }
    assert found.findings == ()
    assert f"  G                   {N} of {N**2 // 2} numbers, pairs\n" in repr(found)


@pytest.mark.slow
def test_terms_that_couple_all_are_named_with_the_cure():
    found = examined(
        {"alone": moving, "together": lambda q, qdot: 0.5 * jnp.mean(qdot) ** 2 - jnp.sum(q) ** 2},
        dissipation={"wind": lambda qdot: 0.5 * jnp.sum(qdot) ** 2},
        holonomic={"centre": lambda q: jnp.sum(q - LINE)},
    )
    sentences = [f for f in found.findings if "couples" in f]
    cure = (
        "write it as a sum of terms that touch a few coordinates each: positions, with rods as `holonomic` constraints, in place of "
        "joint angles of which positions are cumulative sums"
    )
    all_of = f"{N**2} of {N**2} numbers"
    assert sentences == [
        f"'together' couples the 64 coordinates (∂²L/∂q̇²: {all_of}), so that an acceleration takes time in proportion to n³: {cure}",
        f"'together' couples the 64 coordinates (∂²L/∂q²: {all_of}), so that implicit solvers and `linearise` take time in proportion to "
        f"n³: {cure}",
        f"'wind' couples the 64 coordinates (∂²D/∂q̇²: {all_of}), so that implicit solvers and `linearise` take time in proportion to "
        f"n³: {cure}",
        f"'centre' couples the 64 coordinates (G: {N} of {N} numbers), so that an acceleration takes time in proportion to n³: "
        "let each of its rows touch a few coordinates, as of rods between neighbours",
    ]


def test_few_coordinates_are_not_asked():
    assert examined(moving, LINE[:8]).couplings == {}


def test_a_program_that_is_too_long_to_be_read(monkeypatch):
    monkeypatch.setattr("jaxlag._program.sparsity.MAX_ENTRIES", 2 * N)  # a diagonal is shorter, three of them are not
    found = examined({"row": lambda q, qdot: moving(q, qdot)})
    assert found.couplings == {("∂²L/∂q̇²", "row"): (N, N**2), ("∂²L/∂q²", "row"): (None, N**2)}
    (sentence,) = found.findings
    assert sentence.startswith("'row' couples the 64 coordinates (∂²L/∂q²: its program is too long to be read), so that implicit solvers")
    assert "∂²L/∂q²             unread of 4096 numbers, row" in repr(found)
