"""Bad states and controllers are refused in a sentence, at the latest when the system is first used."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

pytestmark = pytest.mark.fast
lag = lambda z, tau: -z / tau
hold = lambda u: 0.5 * u


def system(force=lambda z: z, **states):
    return jl.System(lambda qdot, m: 0.5 * m * qdot**2, force=force, states=states)


def use(system, **params):
    """One instant; the checks are those of a motion."""
    return jl.acceleration(system, 1.0, 0.0, {"m": 1.0, "tau": 0.1} | params)


def run(system, **params):
    return jl.simulate(system, 1.0, 0.0, [0.0, 1.0], {"m": 1.0, "tau": 0.1} | params)


def test_a_controller_needs_a_period():
    with pytest.raises(TypeError, match="every"):
        jl.Sampled(hold)


@pytest.mark.parametrize("every", [0.0, -1e-3, np.nan, np.inf])
def test_a_period_is_positive_and_finite(every):
    with pytest.raises(ValueError, match="`every` must be (positive|finite)"):
        run(system(force=lambda u: u, u=jl.Sampled(hold, every=every)))


@pytest.mark.parametrize("every", [0.0, -1e-3, np.nan])
def test_a_period_among_params_is_positive(every):
    with pytest.raises((ValueError, RuntimeError), match="`every`|`params` must be finite"):
        run(system(force=lambda u: u, u=jl.Sampled(hold, every=lambda T: T)), T=every)


@pytest.mark.parametrize("every", ["1 ms", None, [1e-3, 2e-3], 1j])
def test_a_period_is_one_number(every):
    with pytest.raises((TypeError, ValueError), match="every"):
        run(system(force=lambda u: u, u=jl.Sampled(hold, every=every)))


def test_a_period_among_params_is_one_number():
    with pytest.raises((TypeError, ValueError), match="every"):
        run(system(force=lambda u: u, u=jl.Sampled(hold, every=lambda T: T)), T=jnp.array([1e-3, 2e-3]))


@pytest.mark.parametrize("returned", [lambda u: jnp.ones(2) * u, lambda u: {"u": u}, lambda u: (u, u), lambda u: None, lambda u: "no"])
def test_an_update_returns_what_it_was_given(returned):
    with pytest.raises((TypeError, ValueError), match="`update` of .*'u'"):
        use(system(force=lambda u: u, u=jl.Sampled(returned, every=1e-3)))


@pytest.mark.parametrize("returned", [lambda z: {"a": z["a"]}, lambda z: {"a": z["a"], "b": jnp.zeros(3)}, lambda z: 0.0, lambda z: None])
def test_a_rate_returns_what_the_state_is(returned):
    with pytest.raises((TypeError, ValueError), match="`rate` of .*'z'"):
        use(system(force=lambda z: z["a"], z=jl.State(returned, start={"a": 1.0, "b": [1.0, 2.0]})))


@pytest.mark.parametrize("name", ["t", "q", "qdot", "qddot", "params", "multipliers"])
def test_a_name_that_stands_for_something_else(name):
    with pytest.raises(ValueError, match=f"{name!r}"):
        use(system(force=None, **{name: jl.State(lambda t: 1.0)}))


def test_a_name_that_is_a_parameter():
    with pytest.raises(ValueError, match="'z'"):
        use(system(z=jl.State(lag)), z=3.0)


def test_a_name_that_is_a_coordinate():
    both = jl.System(lambda qdot: 0.5 * qdot["z"] ** 2, states={"z": jl.State(lambda t: 1.0)})
    with pytest.raises(ValueError, match="'z'"):
        jl.acceleration(both, {"z": 1.0}, {"z": 0.0})


@pytest.mark.parametrize("given", [{"z": 3.0}, {"z": lag}, {"z": jl.State}, {3: 1.0}, [1.0], 2.0])
def test_states_are_states(given):
    with pytest.raises((TypeError, ValueError), match="`states`"):
        jl.System(lambda qdot: 0.5 * qdot**2, states=given)


@pytest.mark.parametrize("kind", ["State", "Sampled"])
def test_a_rate_or_update_is_a_function(kind):
    with pytest.raises(TypeError, match="rate" if kind == "State" else "update"):
        jl.State(3.0) if kind == "State" else jl.Sampled(3.0, every=1e-3)


@pytest.mark.parametrize("start", ["rest", {"a": "rest"}, 1j, None, {}])
def test_a_start_is_numbers(start):
    with pytest.raises((TypeError, ValueError), match="start"):
        use(system(force=lambda t: t, z=jl.State(lambda z: z, start=start)))


@pytest.mark.parametrize("start", [lambda q: "rest", lambda q: None])
def test_a_start_that_is_computed_is_numbers(start):
    with pytest.raises((TypeError, ValueError), match="start"):
        use(system(force=lambda t: t, z=jl.State(lambda z: z, start=start)))


def test_a_start_is_finite():
    with pytest.raises((ValueError, RuntimeError), match="start"):
        run(system(z=jl.State(lag, start=np.nan)))


@pytest.mark.parametrize("where", ["force", "rate", "start"])
def test_a_state_that_does_not_exist(where):
    """The message names those that there are."""
    wrong = {
        "force": lambda: system(force=lambda zz: zz, z=jl.State(lag)),
        "rate": lambda: system(z=jl.State(lambda zz: zz)),
        "start": lambda: system(z=jl.State(lag, start=lambda zz: zz)),
    }[where]()
    with pytest.raises((TypeError, ValueError), match=where) as caught:
        use(wrong)
    assert re.search(r"'zz'.*There are .*\bz\b" if where != "start" else "'zz'", str(caught.value))


def test_an_observation_of_a_state_that_does_not_exist():
    record = jl.Experiment([0.0, 1.0], [0.0, 0.1], 0.0, 0.0, observe=lambda zz: zz)
    with pytest.raises((TypeError, ValueError), match="`observe`.*zz"):
        jl.fit(system(z=jl.State(lag)), record, {"m": 1.0, "tau": 0.5}, free=("tau",))


def test_what_needs_a_record_of_the_states_is_refused():
    """Their values at the cuts of a recording, and in its equations, are not measured; a guess would give a wrong estimate."""
    record = jl.Experiment(np.linspace(0, 1, 9), np.linspace(0, 1, 9) ** 2, 0.0, 0.0, observe=lambda q: q)
    params, states = {"m": 1.0, "tau": 0.5}, system(z=jl.State(lag, start=1.0))
    with pytest.raises(ValueError, match="`segments` must .* states"):
        jl.fit(states, record, params, free=("m",), segments=2)
    with pytest.raises(ValueError, match="`system` must .* states"):
        jl.regress(states, record, params, free=("m",))


@pytest.mark.parametrize("states", [{"w": 1.0}, 3.0, {"z": {"a": 1.0}}, {"z": [1.0, 2.0]}, {"z": "on"}])
def test_states_given_at_one_instant_are_those_of_the_system(states):
    with pytest.raises((TypeError, ValueError), match="states"):
        jl.acceleration(system(z=jl.State(lag)), 1.0, 0.0, {"m": 1.0, "tau": 0.1}, states=states)


@pytest.mark.parametrize(
    "state", [lambda: jl.Sampled(lambda z: z, every=0.1), lambda: jl.State(lambda qdot: qdot)], ids=["jumps", "driven by q̇"]
)
def test_a_position_is_not_held_by_a_state_whose_acceleration_is_unknown(state):
    with pytest.raises(ValueError, match="`holonomic`"):
        jl.System(lambda qdot: 0.5 * qdot**2, holonomic=lambda q, z: q - z, states={"z": state()})


def test_a_traced_start_is_refused():
    """A system is compared by what it is made of, so numbers in it are known; a function of params may be traced."""
    with pytest.raises(TypeError, match="`start`"):
        jax.jit(lambda start: jl.State(lag, start=start).start)(1.0)


def test_a_system_with_states_is_compared_by_them():
    one, same, other = (jl.State(lag, start=start) for start in (1.0, 1.0, 2.0))
    energy = lambda qdot: 0.5 * qdot**2
    made = lambda z: jl.System(energy, states={"z": z})
    assert made(one) == made(same) and hash(made(one)) == hash(made(same)) and made(one) != made(other)
    assert "z" in repr(made(one))
