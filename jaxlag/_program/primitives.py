"""The primitives of JAX by what is known of each: the one table that readers of programs look into."""

TABLE = """
jit pjit closed_call core_call remat remat2 checkpoint: call
custom_jvp_call custom_vjp_call custom_vjp_call_jaxpr: call_with_rule
cond scan while: control_flow
custom_linear_solve cholesky lu lu_pivots_to_permutation qr eigh svd triangular_solve tridiagonal_solve: linear_algebra

add add_any: elementwise sum linear increasing overflows
sub: elementwise sum linear overflows
neg: elementwise linear decreasing overflows
stop_gradient: elementwise linear increasing unchanged
copy: movement linear increasing unchanged
mul: elementwise overflows
div: elementwise integral overflows
pow: elementwise overflows
integer_pow: power overflows
square: power overflows zero_unsigned
convert_element_type: power unchanged

abs: elementwise nonsmooth modulus chooses at_zero overflows zero_unsigned
sign: elementwise nonsmooth modulus chooses at_zero steps increasing
max min: elementwise nonsmooth modulus chooses at_equality increasing
select_n: elementwise nonsmooth modulus
clamp: elementwise nonsmooth chooses at_bounds increasing
floor ceil: elementwise nonsmooth chooses at_integers steps increasing
round: elementwise nonsmooth chooses at_halves steps increasing
rem: elementwise integral nonsmooth chooses at_multiples
sqrt: elementwise modulus increasing
gt lt: elementwise nonsmooth modulus order at_equality steps strict
ge le: elementwise nonsmooth modulus order at_equality steps
eq: elementwise nonsmooth equality steps
ne: elementwise nonsmooth equality steps strict
is_finite: elementwise steps
and or: elementwise integral logical increasing
not: elementwise integral logical decreasing
xor: elementwise integral

exp exp2: elementwise increasing zero_unsigned
expm1 log log1p acosh: elementwise increasing
cbrt sinh asin asinh atanh: elementwise increasing odd
tanh atan erf: elementwise increasing odd sigmoid
logistic: elementwise increasing sigmoid zero_unsigned
sin tan: elementwise odd
cos cosh: elementwise even zero_unsigned
rsqrt acos erfc: elementwise decreasing
atan2 erf_inv lgamma digamma: elementwise

reshape squeeze broadcast_in_dim transpose rev slice: movement linear increasing
concatenate pad split stack tile unstack: movement increasing
optimization_barrier: movement linear increasing unchanged
dynamic_slice gather: movement lookup
dynamic_update_slice scatter: movement

reduce_sum: reduction sum linear increasing overflows
reduce_prod: reduction overflows
reduce_max reduce_min: reduction chooses increasing
reduce_and reduce_or: reduction logical increasing
argmax argmin: reduction chooses
sort: chooses
cumsum: running sum increasing overflows
cummax cummin: running increasing
cumprod cumlogsumexp: running
dot_general: sum overflows
"""


def _with(*properties: str) -> frozenset[str]:
    """The primitives that have one of these properties."""
    rows = [row.split(":") for row in TABLE.splitlines() if row]
    return frozenset(name for names, known in rows for name in names.split() if not set(properties).isdisjoint(known.split()))


KNOWN = frozenset(name for row in TABLE.splitlines() for name in row.split(":")[0].split())
CALLS = _with("call")  # of a program, and nothing else
ANY_CALL = _with("call", "call_with_rule")  # also with a derivative rule
CALLS_WITH_DERIVATIVE_RULE = _with("call_with_rule")
CONTROL_FLOW = _with("control_flow")
LINEAR_ALGEBRA = _with("linear_algebra")

ELEMENTWISE = _with("elementwise")  # of any number of operands of one shape
POWERS = _with("power")  # element by element, by a parameter
MOVEMENTS = _with("movement")  # each element of the result is one of an operand
LOOKUPS = _with("lookup")  # what stands behind the first operand are places
REDUCTIONS = _with("reduction")  # over axes
RUNNING = _with("running")  # along an axis

SUMS = _with("sum")  # of terms, which may cancel
UNCHANGED = _with("unchanged")  # but for the dtype
LINEAR = _with("linear")  # in all operands together, of whatever values
ODD, EVEN = _with("odd"), _with("even")  # not abs: there the derivative at 0 would change its sign
INCREASING, DECREASING = _with("increasing"), _with("decreasing")  # with all operands
OVERFLOWS = _with("overflows")  # of integers, which wrap around
INTEGRAL = _with("integral")  # of integers something else than of real numbers
LOGICAL = _with("logical")  # on other integers neither increasing nor decreasing
ZERO_UNSIGNED = _with("zero_unsigned")  # a zero of either sign gives the same

NONSMOOTH = _with("nonsmooth")
CHOOSING = _with("chooses")  # by value
STEPS = _with("steps")  # constant between jumps
JUMPS = STEPS | _with("at_multiples")
BENDS = _with("at_equality", "at_bounds") - STEPS
EDGES = {name: edge for edge in ("at_zero", "at_equality", "at_bounds", "at_integers", "at_halves", "at_multiples") for name in _with(edge)}
MODULI = _with("modulus")  # in terms of |s| and the sign of s
SIGMOIDS = _with("sigmoid")
EQUALITIES = _with("equality")  # true or false at points alone
STRICT = _with("strict")  # comparisons that are false for x and x
ORDER = {name: 1 if name.startswith("g") else -1 for name in _with("order")}  # whether x > y or x < y
NAMES_IN_NUMPY = {"max": "maximum", "min": "minimum", "clamp": "clip", "rem": "remainder", "reduce_max": "max", "reduce_min": "min"}
# The operands of whose zeros the sign decides about the result.
SIGN_OF_ZERO = {"div": (1,), "rsqrt": (0,), "pow": (0,), "atan2": (0, 1), "nextafter": (0, 1), "bitcast_convert_type": (0,)}
