"""Whether a result follows a transformation."""

from typing import NamedTuple

import numpy as np
from generate import Case
from questions import QUESTIONS
from transform import Units, plain
from variants import Variant

TIGHT = {"rtol": 1e-11, "atol": 1e-13}
NEARBY = [{"rtol": 1e-8 * share} for share in (1.0, 0.7, 0.8, 1.25, 1.4)]
IN_A_FRAME = [{"rtol": 1e-8 * share} for share in (0.5, 0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.4, 1.6, 2.0)]  # errors there range over more
BY_CHANCE = 5  # times the largest error of those nearby: where a step ends beside a kink is chance, and errors of one system range over 100
INTEGRATED = {"motion", "gradient_forward", "gradient_reverse"}
FLOOR = {"motion": 1e-7, "gradient_forward": 1e-6, "gradient_reverse": 1e-6, "periodic": 1e-6, "linear": 1e-7, "locus": 1e-7}
ROUNDING = 1e-9  # of what is computed without integration: some 1e6 eps, for matrices of condition 1e3 in their own units
OTHER_STEPS = 3  # times more is allowed where other coordinates make other steps of the same tolerance
OF_RATES = {"q̇": 3.0, "q̈": 10.0}  # ω and ω² of the stiffest: by them an error of q comes back in its rates
SMALL = 1e-2  # what is smaller is compared with this: numbers are of order one in the units of a case


class Miss(NamedTuple):
    """How a result does not follow: what, by how much, and how much is allowed; or what was raised."""

    what: str
    off: float
    allowed: float
    text: str = ""

    def __str__(self) -> str:
        return self.text or f"{self.what} off by {self.off:.2g} ({self.allowed:.2g} allowed)"


class Reference(NamedTuple):
    """Results in the units of the case, and how far they may be off."""

    results: dict[str, np.ndarray]
    allowed: dict[str, np.ndarray]


KNOWN: dict = {}


def reference(case: Case, question: str) -> Reference:
    """Those in the units of the case; of motions those of tight tolerances, and the errors of those about the default."""
    key = id(case), question
    if key not in KNOWN:
        ask, u = QUESTIONS[question], plain(case)
        nearby = [ask(case, u, **rtol) for rtol in NEARBY] if question in INTEGRATED else [ask(case, u)]
        seen = nearby[0]
        tight = {name: x.back for name, x in (ask(case, u, **TIGHT) if question in INTEGRATED else seen).items()}
        floor, allowed = FLOOR.get(question, ROUNDING), {}
        for name, x in tight.items():
            error = max(np.max(np.abs(results[name].back - x), initial=0.0, where=~np.isnan(x)) for results in nearby)
            allowed[name] = BY_CHANCE * error + floor * max(SMALL, np.max(np.abs(x), initial=0.0, where=~np.isnan(x)))
            if np.asarray(seen[name].value).dtype.kind in "ib":
                allowed[name] = 0.0
            if seen[name].within is not None:
                allowed[name] = seen[name].within
        for name in (name for name in tight if question in INTEGRATED and name.startswith("state ") and allowed[name]):
            allowed[name] = max(allowed[name], allowed.get("q", 0.0))  # its rate is that of coordinates, and so is what it errs by
        KNOWN[key] = case, Reference(tight, allowed)
    return KNOWN[key][1]


def inherent(case: Case, u: Units) -> float:
    """What is lost where the numbers themselves are large beside what changes: the clock's rounding, and offsets of coordinates."""
    span = float(case.ts[-1] - case.ts[0])
    late = 1e2 * np.finfo(float).eps * abs(u.start) / (u.time * span)
    beside = np.max(np.abs(u.shift) + np.abs(u.drift) * span, initial=0.0)
    return late + 1e-7 * beside


def misses(case: Case, u: Units, question: str) -> list[Miss]:
    """What does not follow."""
    known = reference(case, question)
    try:
        seen = {name: x.back for name, x in QUESTIONS[question](case, u).items()}
    except Exception as error:
        return [Miss("raised", np.inf, 0.0, f"{type(error).__name__}: {str(error)[:150]}")]
    more = inherent(case, u) if question in INTEGRATED | {"periodic"} else 1e-12 * np.max(np.abs(u.shift), initial=0.0)
    found = _compared(known, seen, more)
    return _beyond_chance(case, u, question, known, found) if found and question in INTEGRATED and np.any(u.drift) else found


def _beyond_chance(case: Case, u: Units, question: str, known: Reference, found: list[Miss]) -> list[Miss]:
    """What does not follow in a frame that moves by more than tolerances err there: the motion by others about its own is as far off, and
    that by a thousandth of them comes a hundred times nearer.
    """

    def off(**settings) -> dict[str, float]:
        seen = {name: x.back for name, x in QUESTIONS[question](case, u, **settings).items()}
        return {miss.what: np.max(np.abs(seen[miss.what] - known.results[miss.what])) for miss in found}

    tight, nearby = off(**TIGHT), [off(**rtol) for rtol in IN_A_FRAME]
    usual = {miss.what: max(errors[miss.what] for errors in nearby) for miss in found}
    nearer = {name: max(known.allowed[name], error / 100) for name, error in usual.items()}
    return [miss for miss in found if miss.off > BY_CHANCE * usual[miss.what] or tight[miss.what] > nearer[miss.what]]


def variant_misses(case: Case, variant: Variant, question: str) -> list[Miss]:
    """What does not follow where the system is stated otherwise."""
    known = reference(case, question)
    try:
        seen = QUESTIONS[question](variant.case, plain(variant.case))
        return _compared(known, variant.back({name: x.back for name, x in seen.items()}), 0.0, OTHER_STEPS)
    except Exception as error:
        return [Miss("raised", np.inf, 0.0, f"{type(error).__name__}: {str(error)[:150]}")]


def _compared(known: Reference, seen: dict[str, np.ndarray], more: float, slack: float = 1.0) -> list[Miss]:
    found = []
    for name, right in known.results.items():
        if name not in seen:  # which depends on the frame, as works do
            continue
        got = seen[name]
        same = got.shape == right.shape and np.array_equal(np.isnan(got), np.isnan(right))  # NaN is an answer, where nothing is left to ask
        off = np.max(np.abs(got - right), initial=0.0, where=~np.isnan(right)) if same else np.inf
        beside = OF_RATES.get(name, 1.0) * more * max(1.0, np.max(np.abs(right), initial=0.0, where=~np.isnan(right)))
        allowed = slack * known.allowed[name] + (beside if known.allowed[name] else 0.0)
        if not off <= allowed:
            found.append(Miss(name, float(off), float(allowed)))
    return sorted(found, key=lambda miss: -miss.off / max(miss.allowed, 1e-300))
