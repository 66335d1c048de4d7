"""Numbers written with as many digits as their errors leave."""

import numpy as np

LEAST, MOST = 1e-7, 1e7  # of an error and of a value, between which digits behind the point are written
DIGITS = 16  # of a double, at most


def plus_minus(value: float, error: float) -> str:
    """`value ± error` with two digits of the error."""
    if error == 0:
        return f"{value:.6g} ± 0"
    if error < LEAST or abs(value) >= MOST:
        return f"{rounded(value, error)} ± {error:.2g}"
    return f"{rounded(value, error)} ± {rounded(error, error)}"


def rounded(x: float, error: float) -> str:
    """`x` to the second digit of its error."""
    if error == 0 or not np.isfinite(error):
        return f"{x:.6g}"
    if error < LEAST or abs(x) >= MOST:
        digits = int(np.floor(np.log10(abs(x)))) - int(np.floor(np.log10(error))) + 2 if x else 2
        return f"{x:.{np.clip(digits, 2, DIGITS)}g}"
    digits = 1 - int(np.floor(np.log10(error)))
    return f"{round(x, digits) + 0.0:.{max(digits, 0)}f}"
