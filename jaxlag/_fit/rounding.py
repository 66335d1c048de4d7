"""Numbers written with as many digits as their errors leave."""

import numpy as np


def plus_minus(value: float, error: float) -> str:
    """`value ± error` with two digits of the error."""
    if error > 1e3 * abs(value):
        return f"{value:.3g} ± {error:.2g}"
    if error == 0:
        return f"{value:.6g} ± 0"
    if error < 1e-7 or abs(value) >= 1e7:
        return f"{value:.8g} ± {error:.2g}"
    return f"{rounded(value, error)} ± {rounded(error, error)}"


def rounded(x: float, error: float) -> str:
    """`x` to the second digit of its error; six digits where the error is too small for that."""
    if error < 1e-7:
        return f"{x:.6g}"
    digits = 1 - int(np.floor(np.log10(error)))
    return f"{round(x, digits) + 0.0:.{max(digits, 0)}f}"
