"""Formulas as a line of text: ½ m l² φ̇²."""

import unicodedata
from typing import ClassVar

import sympy
from sympy import Expr, Mul, Rational, Symbol
from sympy.functions.elementary.trigonometric import TrigonometricFunction
from sympy.printing.pretty.pretty_symbology import greek_unicode, sub
from sympy.printing.str import StrPrinter

from .textbook_printer import NUMBERS, Textbook, split_name


class Unicode(Textbook, StrPrinter):
    """Formulas as Unicode text."""

    minus = "−"
    FRACTIONS: ClassVar = {
        Rational(*pair): sign for *pair, sign in ((1, 2, "½"), (1, 3, "⅓"), (2, 3, "⅔"), (1, 4, "¼"), (3, 4, "¾"), (1, 8, "⅛"))
    }
    SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
    NAMES: ClassVar = {"asin": "arcsin", "acos": "arccos", "atan": "arctan", "log": "ln", "Max": "max", "Min": "min", "ceiling": "ceil"}

    def fraction(self, above, below, is_followed):
        """(g/l) sin φ, or ½ if such a character exists."""
        whole = Mul(*above, *(1 / factor for factor in below)) if all(x.is_Rational for x in (*above, *below)) else None
        if whole in self.FRACTIONS:
            return self.FRACTIONS[whole]
        up, down = (" ".join(map(self.factor, factors)) for factors in (above, below))
        if _needs_no_brackets(above[-1].as_base_exp()[0]):
            up = self.bracketed(up)  # sin φ/r would be read as the sine of φ/r
        text = f"{up}/{self.bracketed(down) if len(below) > 1 else down}"
        return self.bracketed(text) if is_followed else text

    def bracketed(self, text):
        """The text in round brackets."""
        return f"({text})"

    def power(self, base, exponent):
        """x², x^(3/2)."""
        if exponent.is_Integer:
            return base + str(exponent).translate(self.SUPERSCRIPTS)
        return f"{base}^{self._print(exponent) if exponent.is_Symbol else self.bracketed(self._print(exponent))}"

    def letter(self, name, dots):
        """ẍ₂, Θₛ; the dots of a word follow it: wheel˙."""
        letter, below = split_name(name)
        letter = "pi" if name in NUMBERS else greek_unicode.get(letter, letter)
        if len(letter) > 1:
            return self.letter(name, 0) + ["", "˙", "¨"][dots] if dots else letter + self._subscript(below)
        return unicodedata.normalize("NFC", letter + ["", "\u0307", "\u0308"][dots]) + self._subscript(below)

    def _subscript(self, below):
        has_characters = all(character in sub for part in below for character in part) and all(len(p) == 1 or p.isdigit() for p in below)
        return "".join(sub[character] for part in below for character in part) if has_characters else f"_{','.join(below)}"

    def _print_root(self, base):
        return f"√{self._print(base) if base.is_Symbol or base.is_Integer else self.bracketed(self._print(base))}"

    def _print_Abs(self, formula):
        return f"|{self._print(formula.args[0])}|"

    def _print_Function(self, formula, power=""):
        name = self.NAMES.get(formula.func.__name__, formula.func.__name__)
        arguments = ", ".join(map(self._print, formula.args))
        return f"{name}{power} {arguments}" if _needs_no_brackets(formula) else f"{name}{power}({arguments})"

    _print_LatticeOp = _print_Function

    def _print_Pow(self, formula):
        base, exponent = formula.as_base_exp()
        if isinstance(base, TrigonometricFunction) and exponent.is_Integer and exponent > 0:
            return self._print_Function(base, self.power("", exponent))
        return super()._print_Pow(formula)

    def _print_Pi(self, formula):
        return "π"

    def _print_Piecewise(self, formula):
        when = lambda condition: "otherwise" if condition is sympy.true else f"if {self._print(condition)}"
        return "; ".join(f"{self._print(case)} {when(condition)}" for case, condition in formula.args)

    def after(self, symbol: Symbol) -> str:
        """u⁺."""
        return f"{self._print(symbol)}⁺"

    def before(self, symbol: Symbol) -> str:
        """u⁻."""
        return f"{self._print(symbol)}⁻"

    def partial(self, name: str, symbol: Symbol) -> str:
        """∂L/∂φ̇."""
        return f"∂{name}/∂{self._print(symbol)}"

    def time_derivative(self, text: str) -> str:
        """d/dt ∂L/∂φ̇."""
        return f"d/dt {text}"

    def with_index(self, name: str, symbol: Symbol) -> str:
        """Q_φ."""
        return f"{name}_{self._print(symbol)}"

    def reaction(self, symbol: Symbol) -> str:
        """(Gᵀλ)_φ."""
        return f"(Gᵀλ)_{self._print(symbol)}"


def _needs_no_brackets(formula: Expr) -> bool:
    """Whether a formula is a function that is written without brackets: sin φ."""
    return isinstance(formula, TrigonometricFunction) and formula.args[0].is_Symbol
