"""Which law it was: the terms of L and D, among candidates, that a recording shows."""

import dataclasses
import inspect
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._model.injection import check_function, declared_parameters
from .._model.system import System
from .._model.validation import without_contacts, without_events
from .best_subset import Blocks, Subset, as_good, best_subsets, exchangeable, stability
from .experiment import Experiment, validate_inputs
from .fit import fit
from .parameters import Free
from .problem import NoMotion
from .regress import is_linear
from .result import Fit
from .rounding import plus_minus
from .smoothing_spline import without_delay
from .weak_form import Record
from .weak_regression import WeakFormProblem, best_estimate, half_widths

BLOCKS = 20  # of equations, one after the other is left out
NO_FORCE = 1e-4  # of its momentum, what a term of L without influence on the equations leaves of numerical integration
DEPENDENT = 1e-7  # of their columns, what is left of terms that give the same equations
SURE = 2.0  # standard errors from zero, from which on a coefficient is there


@dataclasses.dataclass(frozen=True)
class Scaled:
    """A candidate term times its coefficient, an entry of `params` by the name of the term."""

    function: Callable
    name: str

    @property
    def __signature__(self) -> inspect.Signature:
        named = [p.replace(kind=p.KEYWORD_ONLY) for p in declared_parameters(self.function)]
        return inspect.Signature([*named, inspect.Parameter(self.name, inspect.Parameter.KEYWORD_ONLY)])

    def __call__(self, **given: Any) -> Any:
        """The coefficient times the term."""
        coefficient = given.pop(self.name)
        return coefficient * self.function(**given)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Discovery:
    """The law that a recording shows, as `discover` returns it; prints as a table.

    - `chosen`: names of the terms; `system`: with these terms beside its own; `params`: with their coefficients; `fit`: the `Fit` of these.
    - `groups`: names of candidates that predict as well in each other's place, of which only one was taken: the recording does not tell
      which it is.
    - `idle`: candidates of L that change no equation of motion, as total derivatives by the time do.
    - `path`: for each number of terms the best ones, and the share of all that is to be explained that they leave, of equations that were
      left out. `stability`: of each candidate the share of halves of the recording in which it is among the best.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    bare = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda q: -4.0 * q)
    laws = {"viscous": lambda qdot: 0.5 * qdot**2, "drag": lambda qdot: jnp.abs(qdot) ** 3 / 3}
    true = jl.System(lambda qdot: 0.5 * qdot**2, force=lambda q: -4.0 * q, dissipation=lambda qdot: 0.15 * qdot**2)
    ts = jnp.linspace(0.0, 10.0, 400)
    record = jl.Experiment(ts, jl.simulate(true, 1.0, 0.0, ts, {}).q, 1.0, 0.0, sigma=1e-4)
    jl.discover(bare, record, {}, dissipation=laws).chosen  # ('viscous',)
    ```
    """

    system: System
    params: PyTree
    chosen: tuple[str, ...]
    fit: Fit | None
    groups: tuple[tuple[str, ...], ...]
    idle: tuple[str, ...]
    path: tuple[tuple[tuple[str, ...], float], ...]
    stability: dict[str, float]

    def __repr__(self) -> str:
        width = max(map(len, self.stability), default=0)
        error = lambda name: float(np.asarray(self.fit.standard_errors[name])) if self.fit is not None else np.nan
        rows = [
            f"  {name:<{width}}  {plus_minus(float(self.params[name]), error(name))}   in {100 * self.stability[name]:.0f} % of halves"
            for name in self.chosen
        ]
        alike = [f"  ! {' or '.join(group)}: the recording does not tell which" for group in self.groups]
        idle = [f"  ! no influence on the motion: {', '.join(self.idle)}"] if self.idle else []
        rest = [name for name in self.stability if name not in self.chosen and name not in self.idle]
        return "\n".join(
            [
                f"Discovery: {len(self.chosen)} of {len(self.stability)} terms",
                *rows,
                f"  left out: {', '.join(rest) or 'none'}",
                *alike,
                *idle,
            ]
        )


def discover(
    system: System,
    experiments: Experiment | Sequence[Experiment],
    params: PyTree,
    *,
    dissipation: Mapping[str, Callable] | None = None,
    lagrangian: Mapping[str, Callable] | None = None,
    passive: bool = True,
    width: float | None = None,
    **options: Any,
) -> Discovery:
    r"""Finds which of some candidate terms a machine has, and their coefficients.

    $$ L = L_0 + \sum_i c_i L_i, \qquad D = D_0 + \sum_j c_j D_j, \qquad c_j \ge 0 \text{ where passive} $$

    The equations of motion in the weak form, as of `regress`, are linear in c. All subsets of up to 14 candidates are tried (of more, what
    one exchange improves); of each number of terms the best is kept, and of these the smallest that predicts equations which were left
    out as well as the best does. `fit` then finds the coefficients from the motion itself, and leaves out terms that are zero within their
    errors.

    **Arguments:**

    - `system`: what is known: a Lagrangian with a term that nobody doubts, such as a known inertia, which fixes the factor by which all of
      L and D could be multiplied; dissipation, forces, constraints.
    - `experiments`: one `Experiment` or several; `params`: of what is known.
    - `dissipation`, `lagrangian`: candidates by name, functions D(q̇) and L(q, q̇) by the argument rule, with a coefficient of one. The
      coefficient of a term becomes an entry of `params` by its name.
    - `passive`: whether terms of D only dissipate. `width`: of the windows, as of `regress`.
    - `**options`: passed on to `fit`.

    Units are any consistent set.

    **Returns:** a `Discovery`, with which `equations`, `simulate` and `fit` go on. Candidates that predict as well in each other's place
    are groups, never winners: what is needed is a record that covers more.

    **Raises:** `ValueError` if there are no candidates, a name is taken, candidates are linearly dependent, or as `regress`.

    **Source:** Purnomo & Hayashibe, Scientific Reports 13 (2023) 6628 (sparse identification of Lagrangians); Messenger & Bortz, J.
    Comput. Phys. 443 (2021) 110525 (weak form); Hastie, Tibshirani & Friedman, The Elements of Statistical Learning, 2nd ed.,
    sections 3.3 and 7.10.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    bare = jl.System(lambda qdot: 0.5 * qdot**2)
    springs = {"linear": lambda q: -0.5 * q**2, "cubic": lambda q: -0.25 * q**4, "constant": lambda q: -q}
    true = jl.System(lambda q, qdot: 0.5 * qdot**2 - 2.0 * q**2 - 0.75 * q**4)
    ts = jnp.linspace(0.0, 10.0, 400)
    record = jl.Experiment(ts, jl.simulate(true, 1.0, 0.0, ts, {}).q, 1.0, 0.0, sigma=1e-4)
    print(jl.discover(bare, record, {}, lagrangian=springs))
    ```
    """
    candidates = {"lagrangian": dict(lagrangian or {}), "dissipation": dict(dissipation or {})}
    names = [name for terms in candidates.values() for name in terms]
    _check(system, names, candidates, params)
    experiments, params = validate_inputs(experiments, params)
    prepared = [without_delay(e, params) for e in experiments]
    terms = {slot: {name: Scaled(function, name) for name, function in given.items()} for slot, given in candidates.items()}
    whole, of_all = system.with_terms(**terms), params | {name: jnp.zeros(()) for name in names}
    free = Free.of(of_all, tuple(names), {name: (0.0, None) for name in candidates["dissipation"]} if passive else None)
    records = [Record.of(whole, e, of_all) for e in prepared]
    if not is_linear(records, free):
        raise ValueError("`lagrangian` and `dissipation` must be linear in their coefficients, but are not. Leave the coefficients out.")
    idle = _idle(records, free, terms["lagrangian"])
    kept = tuple(name for name in names if name not in idle)
    free = Free.of(of_all, kept, {name: (0.0, None) for name in candidates["dissipation"]} if passive else None)
    problem = WeakFormProblem.of(records, free, True)
    found = best_estimate(problem, half_widths(records, width))
    if found is None:
        raise ValueError("`experiments` must be long enough for windows on which the equations are tested, but are not. Record more.")
    blocks = Blocks(*map(np.stack, zip(*problem.blocks(found, BLOCKS), strict=True)))
    _refuse_dependent(blocks, kept)
    lower = np.asarray(free.lower)
    path = best_subsets(blocks, lower)

    def of_system(members: Collection[str]) -> System:
        return system.with_terms(**{slot: {name: term for name, term in given.items() if name in members} for slot, given in terms.items()})

    refit = _Refit(of_system, experiments, params, {name for name in candidates["dissipation"] if passive}, options)
    values, fitted = refit.first(as_good(path), kept)
    members, among = tuple(values), [i for i, name in enumerate(kept) if name in values]
    pairs = exchangeable(blocks, lower, among) if among else []
    alike = {i: [kept[i], *(kept[j] for one, j in pairs if one == i)] for i in among if any(one == i for one, _ in pairs)}
    shares = stability(blocks, lower, max(len(members), 1))
    return Discovery(
        of_system(members),
        params | values,
        members,
        fitted,
        tuple(map(tuple, alike.values())),
        idle,
        tuple((tuple(kept[i] for i in one.members), one.error / path[0].error) for one in path),
        {name: 0.0 for name in names} | dict(zip(kept, map(float, shares), strict=True)),
    )


@dataclasses.dataclass(frozen=True)
class _Refit:
    """How chosen terms are fitted to the motion."""

    of_system: Callable[[Collection[str]], System]
    experiments: Sequence[Experiment]
    params: dict[str, Any]
    positive: Collection[str]
    options: dict[str, Any]

    def first(self, subsets: Sequence[Subset], names: Sequence[str]) -> tuple[dict[str, Any], Fit | None]:
        """Of the first subset whose motions can be computed the coefficients that are not zero within their errors, and their fit."""
        for i, subset in enumerate(subsets):
            try:
                return self.of({names[j]: jnp.asarray(c) for j, c in zip(subset.members, subset.coefficients, strict=True)})
            except NoMotion:
                if i == len(subsets) - 1:
                    raise
        raise AssertionError

    def of(self, values: dict[str, Any]) -> tuple[dict[str, Any], Fit | None]:
        """From these coefficients."""
        while values:
            bounds = {name: (0.0, None) for name in values if name in self.positive}
            system, params = self.of_system(values), self.params | values
            found = fit(system, self.experiments, params, free=tuple(values), bounds=bounds, **self.options)
            ratio = {name: abs(float(found.estimates[name])) / float(found.standard_errors[name]) for name in values}
            weakest = min(ratio, key=lambda name: ratio[name])
            if ratio[weakest] >= SURE:
                return dict(found.estimates), found
            values = {name: found.estimates[name] for name in values if name != weakest}
        return {}, None


def _idle(records: Sequence[Record], free: Free, terms: Mapping[str, Callable]) -> tuple[str, ...]:
    """Names of terms that change no equation: what the momentum and the force of one of L contribute cancels in every window, or is
    taken by constraints.
    """
    alone = System(lambda: 0.0, force=None).with_terms(terms) if terms else None
    left, parts = np.zeros(free.size), np.zeros(free.size)
    for record in records:
        windows = record.windows((record.span[1] - record.span[0]) / 10)
        momentum, force, constraints = record.parts(record.form.linearised(free, jnp.zeros(free.size))[1])
        left += np.sum(windows.integrals(momentum, force, constraints) ** 2, axis=(0, 1))
        if alone is not None:
            form = dataclasses.replace(record.form, system=alone)
            momentum, force, constraints = record.parts(form.linearised(free, jnp.zeros(free.size))[1])
            for pair in ((momentum, 0 * force), (0 * momentum, force)):
                parts += np.sum(windows.integrals(*pair, constraints) ** 2, axis=(0, 1))
    return tuple(name for name, a, b in zip(free.names, left, parts, strict=True) if a <= NO_FORCE**2 * b or a == 0)


def _refuse_dependent(blocks: Blocks, names: Sequence[str]) -> None:
    JJ = blocks.whole[0]
    size = np.sqrt(np.diag(JJ))
    values, vectors = np.linalg.eigh(JJ / np.outer(size, size))
    if values.size and values[0] < DEPENDENT**2 * values[-1] * len(values):
        alike = [name for name, x in zip(names, vectors[:, 0], strict=True) if abs(x) > 0.05]
        raise ValueError(
            f"candidates must be independent, but {', '.join(alike)} are not: one is a sum of the others, on this recording at least. "
            "Leave one out, or record a wider range of motions."
        )


def _check(system: System, names: Sequence[str], candidates: Mapping[str, Mapping[str, Callable]], params: PyTree) -> None:
    if not names:
        raise ValueError("`dissipation` or `lagrangian` must name candidates, but both are empty. Give functions by name.")
    if not isinstance(params, Mapping):
        raise ValueError("`params` must be a mapping, to which coefficients are added by name, but is not. Use a dict.")
    for name in names:
        if name in params or names.count(name) > 1 or not name.isidentifier():
            raise ValueError(f"candidates must have names of their own, as variables have, but {name!r} is none, or is taken. Rename it.")
    for slot, terms in candidates.items():
        for name, function in terms.items():
            check_function(function, f"`{slot}[{name!r}]`")
    if system.states:
        raise ValueError(f"`system` must have no states, but has {', '.join(dict(system.states))}. Put what was recorded into `Signal`s.")
    without_contacts(system, "`discover`")
    without_events(system, "`discover`")
