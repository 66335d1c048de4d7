"""Systems with sampled states, in discrete time: from one update to the next."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._model.paths import entry_names
from .._model.state_values import period, sampled
from .._model.system import System
from .._program.jit import is_concrete
from .linear_system import LinearSystem
from .matrices import ByInputs
from .response import held

ROUNDING = 4  # units in the last place by which periods differ if they are computed in several ways


def between_updates(system: System, params: PyTree, states: PyTree, updates: ByInputs, open_loop: LinearSystem) -> LinearSystem:
    """x and the sampled states u, from just before an update to just before the next; other inputs w are held in between.

    u⁺ = Uₓ x + Uᵤ u + U_w w,  x⁺ = Φ x + Γᵤ u⁺ + Γ_w w;  outputs show x and u⁺. u are the last inputs of the open loop.

    Source: Åström & Wittenmark, Computer-Controlled Systems, 3rd ed., section 2.3.
    """
    names, T = entry_names(states), _common_period(system, params)
    loops = len(names)
    _refuse_rates(updates, open_loop, loops)
    U_x, own = updates.by_state, len(open_loop.input_names) - loops
    split = lambda matrix: (matrix[:, :own], matrix[:, own:])
    Phi, Gamma = held(open_loop.A, open_loop.B, T)
    (U_w, U_u), (Gamma_w, Gamma_u), (D_w, D_u) = split(updates.by_inputs[0]), split(Gamma), split(open_loop.D)
    wide = lambda matrix: jnp.concatenate([matrix, jnp.zeros((len(matrix), loops), matrix.dtype)], axis=1)
    return dataclasses.replace(
        open_loop,
        A=jnp.block([[Phi + Gamma_u @ U_x, Gamma_u @ U_u], [U_x, U_u]]),
        B=jnp.concatenate([Gamma_w + Gamma_u @ U_w, U_w]),
        C=jnp.concatenate([open_loop.C + D_u @ U_x, D_u @ U_u], axis=1),
        D=D_w + D_u @ U_w,
        D_rates=open_loop.D_rates[..., :own],
        basis=wide(open_loop.basis),
        constraint_forces=wide(open_loop.constraint_forces),
        sample_time=T,
        state_names=(*open_loop.state_names, *names),
        input_names=open_loop.input_names[:own],
    )


def _common_period(system: System, params: PyTree) -> Array:
    """The common period of all sampled states."""
    periods = [period(system, name, params) for name in sampled(system)]
    if not is_concrete(periods):
        return periods[0]
    known = np.stack([np.asarray(T) for T in periods])
    if np.ptp(known) > ROUNDING * np.finfo(known.dtype).eps * np.max(known):
        several = ", ".join(str(T) for T in np.unique(known))
        raise ValueError(
            f"`system` must update its sampled states all at once to be linearised, but has periods of {several}. "
            "Name these states in `inputs` to see the system between updates."
        )
    return periods[0]


def _refuse_rates(updates, open_loop, loops):
    """Raises if an update sees the velocity of an input that moves a constraint: held inputs jump."""
    rates = updates.by_inputs[1:, :, :-loops], open_loop.D_rates[..., -loops:]
    if is_concrete(rates) and any(np.any(np.asarray(x)) for x in rates):
        raise ValueError(
            "`inputs` must not move a constraint whose velocity sampled states see, but do: held between updates, they jump. "
            "Move it by a force."
        )
