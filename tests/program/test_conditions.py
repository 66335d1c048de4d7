"""Loops end alike for each member of a batch."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from program_size import equations_of

import jaxlag as jl
from jaxlag import dissipation
from jaxlag._program.conditions import halved, repeated

SHARES = jnp.array([1.0, 0.3, 1e-3, 1e-9])


@pytest.mark.fast
def test_the_largest_part_that_is_good():
    """Of each member of a batch its own; where none is good, the last that was tried."""
    part, found = jax.vmap(lambda share: halved(lambda part: part <= share, 1e-6, share.dtype))(SHARES)
    np.testing.assert_array_equal(part, [1.0, 0.25, 2.0**-10, 2.0**-20])
    np.testing.assert_array_equal(found, [True, True, True, False])


@pytest.mark.fast
def test_a_loop_turns_once_where_it_begins():
    doubled = lambda x, begins: repeated(lambda x: 2 * x, x, lambda x: x < 1, begins)
    np.testing.assert_array_equal(jax.vmap(doubled)(SHARES, jnp.array([True, True, True, False])), [2.0, 1.2, 1.024, 1e-9])


def hoop():
    """Newton's method for λ in the looks along a step: at rtol = 1e-10 it never came to an end, where rounding decides what is nearer."""
    system = jl.System(
        lambda qdot: 0.5 * qdot @ qdot,
        dissipation={"rub": lambda qdot, multipliers, mu: mu * jnp.abs(multipliers["hoop"]) * dissipation.speed(qdot)},
        holonomic={"hoop": lambda q, R: jnp.sqrt(q @ q) - R},
    )
    return jl.simulate(system, [2.0, 0.0], [0.0, 3.0], np.linspace(0, 3, 31), {"R": 2.0, "mu": 0.3}).q


def ball():
    system = jl.System(
        lambda q, qdot: 0.5 * qdot @ qdot - 9.81 * q[1],
        dissipation={"rub": lambda qdot, multipliers: 0.3 * multipliers["floor"] * jnp.abs(qdot[0])},
        unilateral={"floor": jl.Contact(lambda q: q[1], restitution=0.5)},
        events={"far": jl.Event(lambda q: q[0] - 2)},
    )
    return jl.simulate(system, [0.0, 1.0], [1.0, 0.0], np.linspace(0, 3, 31)).q


def links(q, qdot):
    return 0.5 * qdot @ qdot - 0.5 * jnp.sum(jnp.diff(q, prepend=0) ** 2) - 9.81 * jnp.sum(jnp.cos(q))


def stiff_chain():
    return jl.simulate(jl.System(links), jnp.zeros(80), jnp.zeros(80), np.linspace(0, 1, 5), solver=diffrax.Kvaerno5()).q


def rest():
    return jl.equilibrium(jl.System(links), 0.1 * jnp.ones(2), stable=True)


def rest_of_many():
    return jl.equilibrium(jl.System(links), 0.1 * jnp.ones(80), stable=True)


def held():
    bead = jl.System(lambda q, qdot: 0.5 * qdot @ qdot - 9.81 * q[1], holonomic={"hoop": lambda q: q @ q - 1})
    return jl.equilibrium(bead, [0.6, 0.8], stable=True)


EXACT = {"broadcast_in_dim", "concatenate", "convert_element_type", "dynamic_slice", "gather", "jit", "max", "min", "pjit", "reduce_max"}
EXACT |= {"abs", "neg", "reduce_min", "reshape", "select_n", "slice", "split", "squeeze", "stop_gradient", "transpose"}


@pytest.mark.slow
@pytest.mark.parametrize("function", [hoop, ball, stiff_chain, rest, rest_of_many, held])
def test_what_ends_a_loop_is_compared_not_computed(function):
    """XLA compiles the condition of a loop of a batch twice, with roundings of their own: one may say that it goes on, the other that no
    member does.
    """
    loops = [e for e in equations_of(jax.make_jaxpr(function)()) if e.primitive.name == "while"]
    assert loops
    for loop in loops:
        for e in equations_of(loop.params["cond_jaxpr"]):
            computes = any(jnp.issubdtype(v.aval.dtype, jnp.inexact) for v in e.outvars) and e.primitive.name not in EXACT
            assert not computes, e
