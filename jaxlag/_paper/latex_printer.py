"""Formulas in the part of LaTeX that Matplotlib's mathtext knows."""

import re
from typing import ClassVar

from sympy import Symbol
from sympy.functions.elementary.trigonometric import TrigonometricFunction
from sympy.printing.latex import LatexPrinter, translate

from .notation import Notation
from .textbook_printer import NUMBERS, Textbook, split_name


class Latex(Textbook, LatexPrinter):
    """Formulas as LaTeX."""

    deviation = r"\delta "
    LETTERS: ClassVar = {"phi": r"\varphi", "epsilon": r"\varepsilon"}

    def __init__(self, notation: Notation):
        super().__init__(notation, fold_func_brackets=True, inv_trig_style="full")

    def _needs_function_brackets(self, formula):
        return not formula.is_Symbol

    def _print_Float(self, number):
        significand, *power = super()._print_Float(number).split("e")
        return rf"{significand} \cdot 10^{{{int(power[0])}}}" if power else significand

    def fraction(self, above, below, is_followed):
        """A fraction, which needs no brackets."""
        up, down = (" ".join(map(self.factor, part)) if len(part) > 1 else self._print(part[0]) for part in (above, below))
        return rf"\frac{{{up}}}{{{down}}}"

    def bracketed(self, text):
        """Round brackets that grow with the text."""
        return rf"\left({text}\right)"

    def power(self, base, exponent):
        """x^{2}, x^{3/2}."""
        return f"{base}^{{{exponent if exponent.is_Rational else self._print(exponent)}}}"

    def letter(self, name, dots):
        r"""\ddot{x}_{2}, \Theta_{s}."""
        letter, below = split_name(name)
        letter = "pi" if name in NUMBERS else self.LETTERS.get(letter, translate(letter))
        letter = letter if len(letter) == 1 or letter.startswith("\\") else rf"\mathrm{{{letter}}}"
        is_word = lambda part: re.match(r"[^\W\d_]{2}", part) and translate(part) == part
        subscripts = [rf"\mathrm{{{part}}}" if is_word(part) else translate(part) for part in below]
        return ["{}", r"\dot{{{}}}", r"\ddot{{{}}}"][dots].format(letter) + (f"_{{{','.join(subscripts)}}}" if below else "")

    def _print_root(self, base):
        return rf"\sqrt{{{self._print(base)}}}"

    def _print_Pow(self, formula):
        base, exponent = formula.as_base_exp()
        if isinstance(base, TrigonometricFunction) and exponent.is_Integer and exponent > 0:
            return LatexPrinter._print_Pow(self, formula)
        return Textbook._print_Pow(self, formula)

    def after(self, symbol: Symbol) -> str:
        """u^{+}."""
        return f"{self._print(symbol)}^{{+}}"

    def before(self, symbol: Symbol) -> str:
        """u^{-}."""
        return f"{self._print(symbol)}^{{-}}"

    def partial(self, name: str, symbol: Symbol) -> str:
        r"""\partial L / \partial \dot\varphi."""
        return rf"\frac{{\partial {name}}}{{\partial {self._print(symbol)}}}"

    def time_derivative(self, text: str) -> str:
        r"""d/dt \partial L / \partial \dot\varphi."""
        return rf"\frac{{d}}{{dt}} {text}"

    def with_index(self, name: str, symbol: Symbol) -> str:
        r"""Q_{\varphi}."""
        return f"{name}_{{{self._print(symbol)}}}"

    def reaction(self, symbol: Symbol) -> str:
        r"""(G^T\lambda)_{\varphi}."""
        return rf"(G^{{T}} \lambda)_{{{self._print(symbol)}}}"
