"""Which experiment next: the plan that determines parameters best, within limits."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, PyTree

from .._model.numbers import count as whole_number
from .._model.paths import is_within, leaf_names, listed
from .._model.system import System
from .design_criteria import Criterion, DOptimal
from .design_plan import Planned, entries_of
from .design_problem import DesignProblem, Sample, limits_of, samples_of
from .design_search import best, searched
from .experiment import Experiment
from .information import Information, information, planned
from .measurement import Test
from .parameters import Free
from .residuals import Model


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Design:
    """The plan that determines parameters best, as `design` returns it; prints as a table.

    - `experiments`: the plans to carry out, as many and in the order as they were given; `experiment`: the first.
    - `before`, `after`: the `Information` of the plans as they were given and as they are now, each with what is measured already.
    - `cost_before`, `cost`: of the criterion. `binding`: by name of a limit that holds the design back the time at which it does.
    - `converged`; `reason`: why the search ended, where it did not converge. `costs`: found from each of the starts.

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    oscillator = jl.System(lambda q, qdot, c: 0.5 * qdot**2 - 0.5 * c * q**2)
    plan = jl.Experiment(jnp.linspace(0.0, 3.0, 50), None, q0=1.0, qdot0=0.0, sigma=1e-3)
    best = jl.design(oscillator, plan, {"c": 4.0}, free="c", over="q0", bounds={"q0": (-2.0, 2.0)}, starts=1)
    best.experiment.q0  # 2.0
    ```
    """

    experiments: tuple[Any, ...]
    before: Information
    after: Information
    cost_before: float
    cost: float
    binding: dict[str, float]
    converged: bool
    reason: str | None
    costs: tuple[float, ...]

    @property
    def experiment(self) -> Any:
        """The first plan."""
        return self.experiments[0]

    def __repr__(self) -> str:
        rows = [["", "value", "± before", "± after"]]
        before, after = (np.sqrt(np.diag(of.covariance)) for of in (self.before, self.after))
        theta = np.concatenate([np.ravel(x) for part in self.after.estimates.values() for x in jax.tree.leaves(part)])
        shown = lambda error: f"{error:.2g}" if np.isfinite(error) else "not determined"
        for name, *numbers in zip(self.after.names, theta, before, after, strict=True):
            rows.append([name, f"{numbers[0]:.6g}", *map(shown, numbers[1:])])
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  " + "   ".join(x.ljust(width) for x, width in zip(row, widths, strict=True)).rstrip() for row in rows]
        binds = [f"  {name} binds" + (f" at t = {t:.4g}" if np.isfinite(t) else "") for name, t in self.binding.items()]
        return "\n".join(["Design: expected standard errors", *lines, *binds, *([] if self.converged else [f"  ! {self.reason}"])])


def design(
    system: System,
    plan: Experiment | Test | Sequence[Experiment | Test],
    params: PyTree,
    *,
    free: str | Sequence[str],
    over: str | Sequence[str],
    criterion: Any = DOptimal(),  # a `Criterion`
    within: Mapping[str, Any] | None = None,
    bounds: Mapping[str, Any] | None = None,
    priors: Mapping[str, Any] | None = None,
    given: Experiment | Test | Sequence[Experiment | Test] = (),
    count: int = 1,
    starts: int = 3,
    steps: int = 100,
    tolerance: float = 1e-8,
    key: Array | None = None,
    **numerics: Any,
) -> Design:
    r"""Chooses inputs, starts, sample times or places of sensors so that a later fit determines its parameters best.

    $$ \min_\xi\; \psi(F(\xi)), \qquad F(\xi) = \sum_i \frac{1}{\sigma_i^2} \left(\frac{\partial h_i}{\partial \theta}\right)^T
       \frac{\partial h_i}{\partial \theta}, \qquad a \le c(t, q, \dot q, \dots; \xi) \le b \;\text{for all } t $$

    The derivatives of F are second derivatives of the motion. The search is for a minimum near each start, of which the best is kept.
    Where friction changes its mode or events change their order F has edges: the search may stop at one, and further starts help.

    **Arguments:**

    - `plan`: an `Experiment` without values and with `sigma`, or several, which are chosen together; also a `FrequencyResponseTest` or a
      `Measurement`, whose values do not matter.
    - `params`: what is believed now; `free`: name or names of the p parameters that will be identified. `priors`: as for `fit`.
    - `over`: what is chosen, by name: entries of the plan's own `params` (a `Multisine`, the values of a `Signal`, a number) or of all
      `params`, `"q0"`, `"qdot0"` and parts of them, `"ts"` (all but the first, between the ends of the plan) and `"omega"` of a test.
    - `criterion`: `DOptimal()`, `AOptimal()`, `EOptimal()`, `Along(name)`, or one of these as an `Average` or `Worst` over samples.
    - `within`: limits, by any name (function, lower, upper). The function receives what it names, out of `t`, `q`, `qdot`, `qddot`,
      `multipliers`, `params`, the entries of `params` and the states of the system, and returns a number or an array; None is no limit.
      They hold along the whole motion, at and between samples. `bounds`: (lower, upper) of names in `over`.
    - `given`: what has been measured already. `count`: how many experiments like `plan` are made.
    - `starts`: how many searches, the first from the plan, others from beside it by the `key`; `steps`: of each search, at most;
      `tolerance`: of the cost, a logarithm, where a search ends.
    - `**numerics`: passed on to `simulate`.

    Units are any consistent set.

    **Returns:** a `Design`; `design.experiment` is the plan to carry out.

    **Raises:** `ValueError` if `over` names nothing, or what is free; if the plan has no sigma or no motion; if limits contradict each
    other, with their names.

    **Source:** Atkinson, Donev & Tobias, Optimum Experimental Designs, with SAS (2007), chapters 9, 10 and 17; Wilson, Schultz & Murphey,
    IEEE Trans. Robotics 30 (2014) 1484-1495; Kraft, DFVLR-FB 88-28 (1988).

    ```python
    import jax.numpy as jnp
    import jaxlag as jl
    cart = jl.System(lambda qdot, m: 0.5 * m * qdot**2, dissipation=lambda qdot, b: 0.5 * b * qdot**2, force=lambda t, u: u(t))
    plan = jl.Experiment(jnp.linspace(0.0, 5.0, 51), None, 0.0, 0.0, sigma=1e-3, params={"u": jl.Multisine(5.0, harmonics=3)})
    limits = {"force": (lambda t, u: u(t), -5.0, 5.0)}
    best = jl.design(cart, plan, {"m": 2.0, "b": 1.0}, free=("m", "b"), over="u", within=limits, starts=1)
    print(best)
    ```
    """
    plans, params = planned(plan, params)
    plans = plans * whole_number(count, "`count`", cure="Give how many experiments are made.")
    starts = whole_number(starts, "`starts`", cure="One is a search from the plan alone.")
    steps = whole_number(steps, "`steps`", cure="A hundred are plenty.")
    if not isinstance(criterion, Criterion):
        raise TypeError(f"`criterion` must be one of jaxlag's, but is {criterion!r}. Take e.g. `jl.DOptimal()`.")
    already = (given,) if isinstance(given, (Experiment, Test)) else tuple(given)
    about = {"free": free, "priors": priors} | numerics
    before = information(system, [*already, *plans], params, **about)
    wanted, over = Free.of(params, free, None, priors), listed(over)
    _check_over(over, wanted, plans, params)
    model, without_priors = Model.of(system, numerics), Free.of(params, free)
    parts = [Planned.of(model, without_priors, one, params, over, bounds or {}) for one in plans]
    samples = [_sample(system, wanted, one, already, about) for one in samples_of(criterion, params)]
    problem = DesignProblem.of(parts, samples, criterion, limits_of(within, parts))
    found = [searched(problem, y, steps, tolerance) for y in problem.starts(starts, jax.random.key(0) if key is None else key)]
    chosen = best(problem, found)
    experiments = tuple(part.measurement(*pair) for part, *pair in zip(problem.parts, plans, problem.split(chosen.y), strict=True))
    after = information(system, [*already, *experiments], params, **about)
    costs = tuple(one.cost for one in found)
    start = problem.cost(np.zeros(problem.size))[0]
    return Design(experiments, before, after, start, chosen.cost, problem.binding(chosen.y), chosen.reason is None, chosen.reason, costs)


def _sample(system: System, wanted: Free, params: PyTree, already: Sequence[Any], about: dict[str, Any]) -> Sample:
    """Parameters, and what priors and earlier measurements say about them."""
    scale = np.asarray(wanted.scale)
    F = np.diag((scale / np.asarray(wanted.prior_deviation)) ** 2)
    if already:
        F = F + information(system, already, params, **(about | {"priors": None})).matrix * np.outer(scale, scale)
    return Sample(dataclasses.replace(Free.of(params, wanted.names), scale=wanted.scale), F)


def _check_over(over: Sequence[str], free: Free, plans: Sequence[Any], params: PyTree) -> None:
    """Refuses names of nothing, and of what is free."""
    there = {name for one in plans for name in leaf_names(entries_of(one, params, over))}
    for name in over:
        if not any(is_within(leaf, name) for leaf in there):
            raise ValueError(
                f"`over` must name entries of the plan or of params, but holds {name!r}. There are {', '.join(sorted(there))}."
            )
        if any(name.split(".")[0].split("[")[0] == entry.split(".")[0].split("[")[0] for entry in free.entries):
            raise ValueError(f"`over` must name what the experimenter chooses, but {name!r} is part of what is free. Remove it from one.")
    if not over:
        raise ValueError("`over` must name what is chosen, but is empty. Name an input, `q0`, or `ts`.")
