"""Formulas as a person writes them."""

import pytest
import sympy
from sympy import Abs, cos, sin, sqrt, symbols

from jaxlag._paper.simplify import Simplifier

x, y = symbols("x y", real=True)
a, b, c, k, l, m, g = symbols("a b c k l m g", real=True)
u = x + a


@pytest.mark.parametrize(
    "formula, simplified",
    [
        (k * Abs(u) ** 2 * sympy.sign(u), k * Abs(u) * u),
        (sympy.diff(k * Abs(2 * x + 2 * a) ** 3, x), 48 * k * Abs(u) * u),
        (Abs(u) * sympy.sign(-u) + u * sympy.sign(u) + x / Abs(x), -u + Abs(u) + sympy.sign(x)),
        (Abs(x) ** (k + 1) * sympy.sign(x) / Abs(x), Abs(x) ** k * sympy.sign(x)),
        (Abs(c * x - c * y) * (c * x - c * y), c**2 * Abs(x - y) * (x - y) * sympy.sign(c)),
        (2 * c * y - 2 * c * l + m * g, 2 * c * (y - l) + m * g),
        (k * (x + l) + c * (y - l), k * (x + l) + c * (y - l)),
        (sin(x) ** 4 + 2 * sin(x) ** 2 * cos(x) ** 2 + cos(x) ** 4, 1),
        (m * sin(x) ** 2 * cos(y) ** 2 + m * sin(x) ** 2 * sin(y) ** 2 - m, -m * cos(x) ** 2),
        (a * sin(x) ** 2 + b * cos(x) ** 2, a * sin(x) ** 2 + b * cos(x) ** 2),
        (cos(x) * cos(y) + sin(x) * sin(y), cos(x - y)),
        (k * cos(x) * cos(y) - k * sin(x) * sin(y), k * cos(x + y)),
        (sin(x) * cos(y) - cos(x) * sin(y), sin(x - y)),
        (x**2 / sqrt(x**2 + y**2) + y**2 / sqrt(x**2 + y**2), sqrt(x**2 + y**2)),
        (k * (sqrt(x**2 + y**2) - l) * x / sqrt(x**2 + y**2), k * x * (1 - l / sqrt(x**2 + y**2))),
        (m * g * sin(x) / cos(x), m * g * sympy.tan(x)),
        (sqrt(x**2 * sin(y) ** 2 + x**2 * cos(y) ** 2), Abs(x)),
        (sympy.Piecewise((x * (x + 1) - x**2, x > 0), (0, True)), sympy.Piecewise((x, x > 0), (0, True))),
        (0.3 * x + 0.7 * x - y * 0, 1.0 * x),
    ],
)
def test_formulas_are_simplified_as_by_a_person(formula, simplified):
    got = Simplifier([], [a, b, c, k, l, m, g])(formula)
    assert got == simplified or (sympy.simplify(got - formula) == 0 and got.count_ops() <= sympy.sympify(simplified).count_ops()), got
