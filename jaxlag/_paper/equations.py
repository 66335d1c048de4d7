"""The equations of motion of a system, from the functions that are simulated. SymPy is imported when they are asked for."""

from collections.abc import Collection
from typing import Any, overload

import jax
from jaxtyping import PyTree

from .._model.system import System
from .._model.validation import without_contacts
from .linearised_result import LinearisedEquations
from .result import Details, Equations, arranged
from .to_sympy import require_sympy


@overload
def equations(
    system: System,
    q: PyTree,
    params: PyTree = None,
    *,
    multipliers: bool = False,
    positive: str | Collection[str] = (),
    linearised_at: None = None,
    inputs: str | Collection[str] = (),
) -> Equations: ...


@overload
def equations(
    system: System,
    q: PyTree,
    params: PyTree = None,
    *,
    multipliers: bool = False,
    positive: str | Collection[str] = (),
    linearised_at: object,
    inputs: str | Collection[str] = (),
) -> LinearisedEquations: ...


def equations(
    system: System,
    q: PyTree,
    params: PyTree = None,
    *,
    multipliers: bool = False,
    positive: str | Collection[str] = (),
    linearised_at: Any = None,
    inputs: str | Collection[str] = (),
) -> Equations | LinearisedEquations:
    r"""The equations of motion of a system on paper, from the same functions that are simulated.

    $$ \frac{d}{dt}\frac{\partial L}{\partial\dot q} - \frac{\partial L}{\partial q} + \frac{\partial D}{\partial\dot q} = Q + G^T\lambda $$

    L, D, Q, g and a are read as formulas (`to_sympy`), differentiated on paper and simplified as a person would; the result is then
    compared with `acceleration` at a random state.

    **Arguments:**

    - `system`: the system.
    - `q`, `params`: example values, or names in their place: a string for a number, a list of strings for a vector, a set of strings
      for a mapping of numbers. Symbols have the names of the entries: `Theta_s` is Θₛ, the velocity of `phi` is φ̇; entries of arrays are
      counted from 1. All symbols are real.
    - `multipliers`: `False` eliminates coordinates in which holonomic constraints are linear, and finds the multipliers of these
      constraints afterwards (Lagrange's equations of the second kind); `True` keeps all coordinates and all multipliers (of the first
      kind), as is always done with contacts.
    - `positive`: names of parameters, coordinates or multipliers to be taken as positive, so that √(l²) is l.
    - `linearised_at`: an equilibrium, as a tree like q of numbers, text or SymPy expressions, e.g. `{"phi": 0, "y": "l - m*g/c"}`; or a
      pair (q, q̇), a steady motion at these constant rates. A mapping may omit coordinates: constraints determine them, or they keep their
      symbols; and it may include parameters, such as a preload `"s": "m*g/c"`. Unknown names are new symbols.
    - `inputs`: with `linearised_at`, names of parameters u that change with time; their deviations appear on the right-hand side.

    Contacts follow the equations of motion: g ≥ 0, λ ≥ 0, g λ = 0, and ġ⁺ = −e ġ⁻ in an impact; q̈ and other λ are given by theirs. States
    follow in the same way: ż = rate, and u⁺ = update of a sampled one if that has a formula.

    **Returns:** `Equations`, whose multipliers have the sign of M q̈ = f + Gᵀλ. With `linearised_at`, `LinearisedEquations`:
    M δq̈ + (C + G) δq̇ + (K + N) δq = B δu in independent coordinates, compared with the derivatives of the simulation. Any consistent set
    of units.

    **Raises:** `ValueError` or `TypeError` if an argument or a function of the system is of the wrong kind, if two symbols would have
    the same name, or if the equations differ from the simulation, as they do if a function has a derivative rule that does not follow
    from its formula; if `linearised_at` is neither an equilibrium nor a steady motion (the message says what accelerates, and when it
    would be one), or has no linear equations of second order (nonholonomic constraints, a kink of friction); `NotImplementedError`, which
    names the line, if an operation has no formula; `ImportError` without SymPy.

    **Source:** Goldstein, Classical Mechanics, 3rd ed., sections 1.4, 1.5, 2.4 and 6.2.

    ```python
    import jaxlag as jl
    from jaxlag.examples import vehicle
    on_paper = jl.equations(vehicle.system, vehicle.q0, vehicle.params)
    print(on_paper)  # Θₛ φ̈ + 2 a² b φ̇ + 2 a² c φ = 0
    print(on_paper.derivation())
    still = {"phi": 0, "y": "l - M*g/(2*c)", "M0": "k*r*v*abs(v)"}
    print(jl.equations(vehicle.system, vehicle.q0, vehicle.params, linearised_at=still))  # ω₀² = 2 a² c/Θₛ
    ```
    """
    require_sympy("equations")
    if not isinstance(multipliers, bool):
        raise TypeError(
            f"`multipliers` must be True or False, but is {multipliers!r}. Use True for Lagrange's equations of the first kind."
        )
    if linearised_at is None and inputs:
        raise ValueError(f"`inputs` must come with `linearised_at`, but is {inputs!r} without it. Give the state, or leave it out.")
    from . import derivation, symbolic_system
    from .coordinate_elimination import eliminate_coordinates, reduce_system
    from .notation import Notation
    from .simplify import Simplifier
    from .symbol_tree import parameters_in_order, symbol_tree

    if linearised_at is not None and multipliers:
        raise ValueError("`multipliers` must be False with `linearised_at`, but is True. Linear equations are in independent coordinates.")
    positive = (positive,) if isinstance(positive, str) else tuple(positive)
    coordinates, constants = symbol_tree(q, "q", positive), symbol_tree(params, "params", positive)
    states = symbolic_system.States.of(system, coordinates, constants)
    full, multiplier_rows = symbolic_system.trace_system(system, coordinates, constants, states, positive)
    parameters = parameters_in_order(system, params, constants)
    simplify = Simplifier(full.qdot, parameters)
    steps = derivation.derive(full, simplify)
    symbolic_system.check_against_simulation(system, full, steps, coordinates, constants, states)
    if linearised_at is not None:
        from .linearised import linearised

        without_contacts(system, "`equations` with `linearised_at`")
        return linearised(system, full, steps, linearised_at, inputs, parameters, coordinates, constants, states)
    multipliers = multipliers or bool(full.contacts)
    eliminated = {} if multipliers else eliminate_coordinates(full, simplify)
    reduced, reduced_steps, qddot, reactions = reduce_system(full, steps, eliminated, simplify)
    details = Details(
        steps=reduced_steps,
        free=reduced.qddot,
        qddot=qddot,
        multipliers=full.multipliers,
        residuals=(*derivation.residuals(reduced, reduced_steps), *reactions),
        structure=coordinates.symbols,
        multiplier_rows=multiplier_rows,
        paths=constants.paths,
        simplify=simplify,
        notation=Notation(full, parameters),
        system=system,
        contacts=full.contacts,
    )
    holonomic = reduced.g[: len(reduced.g) - len(full.contacts), :]
    return Equations(
        with_multipliers=multipliers,
        **{name: getattr(reduced, name) for name in ("t", "q", "qdot", "qddot", "L", "D", "Q", "a")},
        g=holonomic,
        **{name: getattr(reduced_steps, name) for name in ("M", "f", "G", "gamma")},
        params=jax.tree.map(lambda symbols: arranged(symbols.shape, iter(symbols.flat)), constants.symbols),
        motion=derivation.equations_of_motion(reduced, reduced_steps, simplify),
        rates=dict(zip(reduced.zdot, map(simplify, reduced.rates), strict=True)),
        updates={u: formula and simplify(formula) for u, formula in zip(reduced.u, reduced.updates, strict=True)},
        eliminated=eliminated,
        contacts={contact.name: contact.formula for contact in full.contacts},
        _details=details,
    )
