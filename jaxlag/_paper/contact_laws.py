"""Contacts on paper: the complementarity of gap and force, and the law of impacts."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from sympy import Symbol

from .._model.contact import PoissonRestitution
from .._model.injection import call
from .._model.system import System
from .._program.expressions import filled
from .derivation import ContactLaw
from .formulas import formulas
from .symbol_tree import SymbolTree


def contact_laws(
    system: System, shapes: Mapping[str, tuple[int, ...]], gaps: list[Any], multipliers: list[Symbol], params: SymbolTree
) -> tuple[ContactLaw, ...]:
    """The contact laws of a system, from its gaps as formulas and the symbols of its contact forces; of several gaps by number."""
    found = []
    places = [(name, i, place) for name, shape in shapes.items() for i, place in enumerate(np.ndindex(shape))]
    of_name, laws = dict(system.restitution), dict(system.laws)
    for (name, i, place), formula, multiplier in zip(places, gaps, multipliers, strict=True):
        named, given = f"{name}_{i + 1}" if math.prod(shapes[name]) > 1 else name, of_name[name]
        gap, rate = (Symbol(f"{letter}_{named}", real=True) for letter in ("g", "gdot"))

        def restitution(speed, numbers, given=given, name=name, place=place):
            if callable(given):
                given = call(given, f"`restitution` of {name!r}", eqx.combine(numbers, params.rest), speed=speed)
            return jnp.broadcast_to(jnp.asarray(given, float), shapes[name])[place]

        e = formulas(restitution, filled((), [-rate]), params.symbols)[()]
        found.append(ContactLaw(named, gap, rate, formula, multiplier, e, isinstance(laws[name], PoissonRestitution)))
    return tuple(found)


def contact_lines(contact: ContactLaw, printer: Any) -> Iterator[tuple[str, ...]]:
    """Left and right sides and the relation between them: g ≥ 0, λ ≥ 0, g λ = 0; and ġ⁺ = −e ġ⁻ in an impact, or Λ⁺ = e Λ⁻ for the impulses
    of expansion and compression.
    """
    text, e = printer.doprint, contact.restitution
    yield text(contact.gap), text(contact.formula)
    yield text(contact.gap), "0", "≥"
    yield text(contact.multiplier), "0", "≥"
    yield f"{text(contact.gap)} {text(contact.multiplier)}", "0"
    impulse = Symbol(contact.multiplier.name.replace("lambda", "Lambda"), real=True)
    symbol, factor = (impulse, e) if contact.by_impulse else (contact.rate, -e)
    shown = f"({text(factor)}) " if e.is_Add else f"{text(factor)} " if e != 1 else text(factor).rstrip("1")
    yield printer.after(symbol), "0" if e == 0 else shown + printer.before(symbol)
