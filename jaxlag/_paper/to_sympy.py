"""Any function of arrays as a formula. SymPy is imported when one is asked for."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree


def to_sympy(function: Callable, *arguments: PyTree) -> PyTree:
    r"""A function of arrays as a formula: its program, evaluated entry by entry on SymPy expressions.

    $$ f(x_1, x_2, \dots) \;\mapsto\; \text{one expression for each entry of what } f \text{ returns} $$

    It handles what Lagrangians are made of: arithmetic, elementary functions, abs, sign, min, max, where, indexing, reductions, products,
    loops of known length, small linear solves, determinants and norms, and derivatives of all these. A float is written as the simple
    fraction (of 1, of π, or under a root) to which it is the nearest float: 0.5 is 1/2, and `1 / 3` is 1/3. Other floats stay floats.

    **Arguments:**

    - `function`: a JAX function, jitted or not.
    - `arguments`: its arguments, with SymPy expressions in place of numbers: pytrees of expressions and numbers, of lists of them (each a
      vector) and of arrays or SymPy matrices of them, of any shape. Symbols stand for real numbers; make them with `real=True`.

    **Returns:** what the function returns: an expression for each scalar, and a NumPy array of expressions, of the same shape, for each
    array.

    **Raises:** `NotImplementedError`, which names the operation and its line, if an operation has no formula; `TypeError` if an
    argument is neither an expression nor a number; `ImportError` without SymPy.

    **Source:** the program is JAX's jaxpr: Frostig, Johnson & Leary, Compiling machine learning programs via high-level tracing (2018).

    ```python
    import jax
    import jax.numpy as jnp
    import jaxlag as jl
    import sympy
    m, l, phi, omega = sympy.symbols("m l phi omega", real=True)
    lagrangian = lambda phi, omega, m, l: 0.5 * m * (l * omega) ** 2 + m * l * jnp.cos(phi)
    jl.to_sympy(lagrangian, phi, omega, m, l)  # l**2*m*omega**2/2 + l*m*cos(phi)
    jl.to_sympy(jax.grad(lagrangian, argnums=1), phi, omega, m, l)  # l**2*m*omega
    ```
    """
    require_sympy("to_sympy")
    from .formulas import formulas

    is_leaf = lambda node: isinstance(node, list) or hasattr(node, "applyfunc")
    out = formulas(function, *jax.tree.map(_expressions, arguments, is_leaf=is_leaf))
    return jax.tree.map(lambda array: array if array.shape else array[()], out)


def require_sympy(what: str) -> None:
    """Raises an error that names the extra if SymPy is missing."""
    try:
        import sympy  # noqa: F401
    except ImportError as error:
        raise ImportError(f"`{what}` must have SymPy, but it cannot be imported. Run `pip install sympy`.") from error


def _expressions(argument: Any) -> np.ndarray:
    """An expression, a number, or a list, a matrix or an array of them."""
    array = np.asarray(argument.tolist() if hasattr(argument, "applyfunc") else argument)
    are_formulas = all(hasattr(x, "free_symbols") or isinstance(x, (int, float, np.generic)) for x in array.flat)
    if not (are_formulas and array.dtype.kind in "Obiuf"):
        raise TypeError(f"`arguments` must hold expressions and numbers, but hold {argument!r}. Make symbols by `sympy.Symbol`.")
    return array
