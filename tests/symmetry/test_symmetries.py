"""Mechanics does not care how it is written down: random systems in other units, at other times, stated otherwise.

A few hundred of them here; `python tests/symmetry/run.py 10000` asks all questions of all kinds, and counts what does not follow.
"""

import numpy as np
import pytest
from generate import KINDS, drawn
from machines import MACHINES
from net import misses, variant_misses
from run import asked, case_of, moves_with
from transform import NUMBERS, drawn_units
from variants import VARIANTS, applies, variant


def assert_follows(question, kind, n=2, each=1, seeds=(0,), which=NUMBERS):
    """Of each transformation by numbers `each`, for the systems of `seeds`."""
    found = []
    for name in (name for name in which if moves_with(question, name)):
        for seed in seeds:
            case = case_of(kind, n, seed)
            for units in range(each):
                found += [
                    f"{name}, system {seed}, units {units}: {miss}" for miss in misses(case, drawn_units(case, units, name), question)[:1]
                ]
    assert not found, "\n".join(found)


def assert_follows_otherwise(question, name, kind, n=2, seeds=(0,)):
    """Stated by another program."""
    found = []
    for seed in seeds:
        case = case_of(kind, n, seed)
        found += [f"system {seed}: {miss}" for miss in variant_misses(case, variant(name, case), question)[:1]]
    assert not found, "\n".join(found)


def test_the_net_finds_what_does_not_follow():
    """A system that depends on its units: a spring that is hard beyond 1, in whatever unit."""
    case = drawn("smooth", 2, 0)
    wrong = case._replace(params=case.params | {"c": 1.01 * case.params["c"]})
    assert not misses(case, drawn_units(case, 0, "all"), "acceleration")
    right, other = (asked_of(case) for case in (case, wrong))
    assert np.max(np.abs(right - other)) > 1e-6


def asked_of(case):
    from questions import acceleration
    from transform import plain

    return acceleration(case, plain(case))["q̈"].back


# At one state


@pytest.mark.parametrize("kind", ["smooth", "planar", "held and rolling", "contact", "massless", "state"])
def test_accelerations(kind):
    assert_follows("acceleration", kind, each=2, seeds=(0, 1))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_accelerations_of_all_kinds(kind):
    assert_follows("acceleration", kind, 8 if kind in ("smooth", "dry") else 3, each=3, seeds=range(2))


@pytest.mark.parametrize("name", [name for name in VARIANTS if applies(name, "holonomic") and name != "as force"])
def test_accelerations_stated_otherwise(name):
    assert_follows_otherwise("acceleration", name, "holonomic", seeds=range(3))


def in_turn(kinds, each):
    """Some kinds for each statement, so that all kinds are met: the rest are asked by `run.py`."""
    able = {name: [kind for kind in kinds if applies(name, kind)] for name in VARIANTS}
    return [(name, able[name][(i + k) % len(able[name])]) for i, name in enumerate(able) for k in range(min(each, len(able[name])))]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind"),
    in_turn(["dry", "planar", "nonholonomic", "held and rolling", "contact", "massless", "state", "dry loop"], each=2),
)
def test_accelerations_of_all_kinds_stated_otherwise(name, kind):
    assert_follows_otherwise("acceleration", name, kind, 3, seeds=range(2))


@pytest.mark.parametrize("kind", ["redundant"])
def test_states_on_the_constraints(kind):
    assert_follows("consistent_state", kind, each=3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["holonomic", "nonholonomic", "held and rolling", "dry loop"])
def test_states_on_the_constraints_of_all_kinds(kind):
    assert_follows("consistent_state", kind, 3, each=3, seeds=range(3))


@pytest.mark.parametrize(
    "kind", ["smooth", pytest.param("redundant", marks=pytest.mark.slow), pytest.param("massless", marks=pytest.mark.slow)]
)
def test_examinations(kind):
    assert_follows("examine", kind, each=2)


QUICK = ("Cartesian pendulum", "belt")


@pytest.mark.parametrize("kind", [kind if kind in QUICK else pytest.param(kind, marks=pytest.mark.slow) for kind in MACHINES])
def test_accelerations_of_machines(kind):
    assert_follows("acceleration", kind, each=3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in MACHINES if applies("components", kind)])
def test_accelerations_of_machines_by_components(kind):
    assert_follows_otherwise("acceleration", "components", kind)


# In time


@pytest.mark.parametrize("kind", ["smooth", pytest.param("dry", marks=pytest.mark.slow)])
def test_motions(kind):
    assert_follows("motion", kind, each=2)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("smooth", "dry")])
def test_motions_of_all_kinds(kind):
    assert_follows("motion", kind, each=3)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), in_turn(["smooth", "dry", "holonomic"], each=1))
def test_motions_stated_otherwise(name, kind):
    assert_follows_otherwise("motion", name, kind, seeds=range(3))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["smooth", "dry", "planar", "holonomic", "contact", "massless", "controller"])
@pytest.mark.parametrize("question", ["gradient_forward", "gradient_reverse"])
def test_gradients(question, kind):
    assert_follows(question, kind, each=3)


# Near rest


@pytest.mark.parametrize(
    "kind", ["smooth", pytest.param("redundant", marks=pytest.mark.slow), pytest.param("massless", marks=pytest.mark.slow)]
)
def test_equilibria(kind):
    assert_follows("equilibrium", kind, each=3, seeds=(0, 1))


@pytest.mark.parametrize(
    "kind", ["smooth", pytest.param("redundant", marks=pytest.mark.slow), pytest.param("massless", marks=pytest.mark.slow)]
)
def test_linear_systems(kind):
    assert_follows("linear", kind, each=3, seeds=(0, 1))


@pytest.mark.slow
@pytest.mark.parametrize("question", ["locus", "periodic"])
@pytest.mark.parametrize("kind", ["smooth", "holonomic", "state"])
def test_loci_and_cycles(question, kind):
    if not asked(question, kind):
        pytest.skip("is not asked")
    assert_follows(question, kind, each=2)


# Identification


@pytest.mark.slow
@pytest.mark.parametrize("question", ["fit", "regress", "compare"])
@pytest.mark.parametrize("kind", ["smooth", "holonomic"])
def test_identification(question, kind):
    if not asked(question, kind):
        pytest.skip("is not asked")
    assert_follows(question, kind, each=2)
