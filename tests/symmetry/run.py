"""Thousands of transformed systems by hand: `python tests/symmetry/run.py 10000`, with counts of failures.

python tests/symmetry/run.py 500 --questions acceleration motion --kinds smooth dry --sizes 2 3 --which length clock
"""

import argparse
import collections
import itertools
import sys
import time
import warnings

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

from generate import AT_REST, KINDS, Case, drawn  # noqa: E402
from machines import MACHINES  # noqa: E402
from net import misses, variant_misses  # noqa: E402
from questions import QUESTIONS  # noqa: E402
from transform import NUMBERS, drawn_units  # noqa: E402
from variants import VARIANTS, applies, variant  # noqa: E402


def case_of(kind: str, n: int, seed: int) -> Case:
    """A random system with n coordinates, or a machine, of which there is one."""
    return MADE.setdefault(kind, MACHINES[kind]()) if kind in MACHINES else drawn(kind, n, seed)


MADE: dict[str, Case] = {}


def asked(question: str, kind: str) -> bool:
    """Whether a question makes sense of a kind."""
    if kind in MACHINES:
        return question in ("acceleration", "motion", "gradient_forward", "gradient_reverse", "examine")
    if question in ("equilibrium", "linear", "locus"):
        return kind in AT_REST
    if question in ("fit", "regress", "compare"):
        return kind in ("smooth", "dry", "holonomic", "state") if question != "regress" else kind in ("smooth", "holonomic", "nonholonomic")
    if question == "periodic":
        return kind in ("smooth", "dry", "state")
    if question == "consistent_state":
        return kind in ("holonomic", "redundant", "nonholonomic", "held and rolling", "dry loop")
    return True


def moves_with(question: str, which: str) -> bool:
    """Whether a question can be asked in a frame that moves: what rests in one does not in the other; and whether it has channels."""
    if which == "channels":
        return question in ("fit", "regress", "compare")
    return which != "frame" or question in ("acceleration", "consistent_state", "motion", "gradient_forward", "gradient_reverse", "fit")


def numbers(question, kind, n, count, args):
    """Each system in other units, as (transformation, which system, which units, what does not follow)."""
    which = [name for name in args.which if name in NUMBERS and moves_with(question, name)]
    seeds = 1 if kind in MACHINES else min(args.systems, -(-count // max(1, len(which))))
    cases = [case_of(kind, n, seed) for seed in range(seeds)]
    for i in range(count if which else 0):
        name, system = which[i % len(which)], i // len(which) % len(cases)
        units = args.seed * 100_000 + i
        yield name, f"system {system} units {units}", misses(cases[system], drawn_units(cases[system], units, name), question)


def programs(question, kind, n, args):
    """Each system stated otherwise."""
    if question not in ("acceleration", "motion"):
        return
    for name in (name for name in args.which if name in VARIANTS and applies(name, kind)):
        for system in range(1 if kind in MACHINES else min(args.systems, 3)):
            case = case_of(kind, n, system)
            yield name, f"system {system}", variant_misses(case, variant(name, case), question)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int)
    parser.add_argument("--questions", nargs="+", default=list(QUESTIONS))
    parser.add_argument("--kinds", nargs="+", default=[*KINDS, *MACHINES])
    parser.add_argument("--which", nargs="+", default=[*NUMBERS, *VARIANTS])
    parser.add_argument("--sizes", nargs="+", type=int, default=[2, 3, 5, 8])
    parser.add_argument("--systems", type=int, default=8, help="how many of a kind, each compiled; three at most are stated otherwise")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=np.inf, help="after which no other kind is begun")
    parser.add_argument("--verbose", action="store_true")
    args = parser.parse_args()
    warnings.filterwarnings("ignore", message=".*must be made once")  # each kind of system is made anew for each statement
    sizes = lambda kind: [len(case_of(kind, 0, 0).q0)] if kind in MACHINES else args.sizes
    pairs = [(q, k, n) for q in args.questions for k in args.kinds for n in sizes(k) if asked(q, k)]
    count = -(-args.count // len(pairs))
    total, failed, shown, begin = collections.Counter(), collections.Counter(), set(), time.perf_counter()
    for question, kind, n in pairs:
        jax.clear_caches()  # thousands of programs in one process exceed what a system maps
        if time.perf_counter() - begin > 60 * args.minutes:
            print(f"not asked: {question} {kind} n = {n}")
            continue
        try:
            for name, which, found in itertools.chain(numbers(question, kind, n, count, args), programs(question, kind, n, args)):
                total[question, name] += 1
                failed[question, name] += bool(found)
                if found and (args.verbose or (question, name, kind) not in shown):
                    print(f"{question:18} {name:16} {kind:16} n = {n} {which}: {found[0]}", flush=True)
                    shown.add((question, name, kind))
        except Exception as error:
            print(f"NO REFERENCE {question} {kind} n = {n}: {type(error).__name__}: {str(error)[:300]}", flush=True)
    print(f"\n{sum(failed.values())} of {sum(total.values())} do not follow; {time.perf_counter() - begin:.0f} s\n")
    for name in args.which:
        of = [f"{question} {failed[question, name]} of {total[question, name]}" for question in args.questions if total[question, name]]
        print(f"{name:16} " + ", ".join(of))
    return bool(failed.total())


if __name__ == "__main__":
    sys.exit(main())
