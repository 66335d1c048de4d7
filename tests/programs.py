"""Random programs over the operations of `jax.lax`, and their rewritten form compared with the plain one.

python tests/programs.py FIRST LAST     compares the programs of these seeds and prints those that differ

Programs are not compiled, which would take most of the time: the plain one is run by JAX, equation by equation, and the rewritten one on
NumPy's scalars, with equations that stay whole run by JAX.
"""

import functools
import sys
from typing import NamedTuple

import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
from operations import OPERATIONS, SHAPES

from jaxlag._program import scalarise
from jaxlag._program.constants import FOLDABLE, folded
from jaxlag._program.expressions import TooLong, UnknownPrimitive, filled
from jaxlag._program.interpreter import Interpreter, traced
from jaxlag._program.primitives import ANY_CALL
from jaxlag._program.walker import called_program, primitive_names

SIZE = 3  # of x and of v
LIMIT = 5000
LARGE = 50.0  # larger numbers say little about what comes after
DTYPES = {"f": "float64", "g": "float32", "c": "complex128", "i": "int32", "u": "uint8", "b": "bool", "h": "bfloat16", "e": "float16"}


# The plain program, equation by equation.


def run_plain(program, *operands):
    """The outputs of a program, as JAX computes its equations one by one, with loops in Python.

    It has a walk of its own, for it is what the package's is compared with.
    """
    jaxpr, consts = getattr(program, "jaxpr", program), getattr(program, "consts", ())
    env = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *operands], strict=True))
    read = lambda atom: atom.val if hasattr(atom, "val") else env[atom]
    for equation in jaxpr.eqns:
        env |= dict(zip(equation.outvars, run_equation(equation, *map(read, equation.invars)), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _broadcast(p, x):
    x = np.expand_dims(x, [d for d in range(len(p["shape"])) if d not in p["broadcast_dimensions"]])
    return np.broadcast_to(x, p["shape"])


def _elementwise(**functions):
    return {name: lambda p, *operands, function=function: function(*operands) for name, function in functions.items()}


# Frequent equations, on arrays of many shapes, each of which JAX would compile; NumPy and JAX agree in double precision.
BY_NUMPY = {
    **_elementwise(add=np.add, add_any=np.add, sub=np.subtract, mul=np.multiply, div=np.divide, neg=np.negative, sin=np.sin, cos=np.cos),
    **_elementwise(exp=np.exp, log=np.log, sqrt=np.sqrt, tanh=np.tanh, square=np.square, abs=np.abs, sign=np.sign, copy=np.array),
    **_elementwise(gt=np.greater, lt=np.less, ge=np.greater_equal, le=np.less_equal, eq=np.equal, ne=np.not_equal),
    **_elementwise(select_n=lambda which, no, yes: np.where(which, yes, no), convert_element_type=lambda x: x),
    "reshape": lambda p, x: np.reshape(x if p["dimensions"] is None else np.transpose(x, p["dimensions"]), p["new_sizes"]),
    "squeeze": lambda p, x: np.squeeze(x, tuple(p["dimensions"])),
    "transpose": lambda p, x: x.transpose(p["permutation"]),
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda p, *xs: np.concatenate(xs, p["dimension"]),
    "reduce_sum": lambda p, x: np.sum(x, tuple(p["axes"])),
    "integer_pow": lambda p, x: x ** float(p["y"]),
}


def run_equation(equation, *operands):
    """The outputs of one equation."""
    name, p = equation.primitive.name, equation.params
    if name in ANY_CALL:
        return run_plain(called_program(equation), *operands)
    if name == "custom_linear_solve":
        lengths = p["const_lengths"]
        at = lengths.matvec + lengths.vecmat
        return run_plain(p["jaxprs"].solve, *operands[at : at + lengths.solve], *operands[sum(lengths) :])
    if name == "cond":
        return run_plain(p["branches"][min(max(int(operands[0]), 0), len(p["branches"]) - 1)], *operands[1:])
    if name == "while":
        i, j = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
        state = operands[j:]
        while np.any(goes_on := run_plain(p["cond_jaxpr"], *operands[:i], *state)[0]):  # in a batch, until the last one ends
            turned = run_plain(p["body_jaxpr"], *operands[i:j], *state)
            which = [np.reshape(goes_on, np.shape(goes_on) + (1,) * (np.ndim(new) - np.ndim(goes_on))) for new in turned]
            state = [np.where(*parts) for parts in zip(which, turned, state, strict=True)]
        return list(state)
    if name == "scan":
        i, j = p["num_consts"], p["num_consts"] + p["num_carry"]
        carry, rows = operands[i:j], {}
        for k in reversed(range(p["length"])) if p["reverse"] else range(p["length"]):
            outs = run_plain(p["jaxpr"], *operands[:i], *carry, *(np.asarray(x)[k] for x in operands[j:]))
            carry, rows[k] = outs[: p["num_carry"]], outs[p["num_carry"] :]
        return [*carry, *(np.stack(column) for column in zip(*(map(np.asarray, rows[k]) for k in sorted(rows)), strict=True))]
    given = [np.asarray(x, atom.aval.dtype) for x, atom in zip(operands, equation.invars, strict=True)]
    if name in BY_NUMPY and all(v.aval.dtype in (np.float64, np.bool_) for v in (*equation.invars, *equation.outvars)):
        with np.errstate(all="ignore"):
            return [np.asarray(BY_NUMPY[name](p, *given), equation.outvars[0].aval.dtype)]
    outs = equation.primitive.bind(*given, **p)
    return [np.asarray(out) for out in (outs if equation.primitive.multiple_results else [outs])]


# The rewritten program.


class NumPyAlgebra(type(scalarise.JAX_ALGEBRA)):
    """Scalars are those of NumPy, with the rules of production."""

    def function(self, primitive, params, dtype):
        return lambda *numbers: folded(primitive, params, dtype, *numbers)

    def block(self, equation):
        def whole(*arrays):
            given = arrays[-len(equation.invars) :]  # a linear solve passes its solution before them
            numbers = [np.array(x.tolist(), atom.aval.dtype).reshape(x.shape) for x, atom in zip(given, equation.invars, strict=True)]
            return [filled(x.shape, x.reshape(-1)) for x in map(np.asarray, run_equation(equation, *numbers))]

        return whole


def run_rewritten(closed, *operands):
    """The outputs of the rewritten program, and whether it differs from the plain one."""
    interpreter = Interpreter(NumPyAlgebra(), LIMIT)
    try:
        inputs, outputs = traced(closed, interpreter)
    except (TooLong, UnknownPrimitive):
        return run_plain(closed, *operands), False
    arrays = [*closed.consts, *operands]
    pairs = [(nodes, np.asarray(array)) for nodes, array in zip(inputs, arrays, strict=True) if nodes.dtype == object]
    given = {node: x for nodes, array in pairs for node, x in zip(nodes.flat, array.flat, strict=True)}
    with np.errstate(all="ignore"):
        found = interpreter.values(outputs, given)
    return [np.array(x.tolist(), v.aval.dtype).reshape(x.shape) for x, v in zip(found, closed.jaxpr.outvars, strict=True)], True


# Programs.


class Program(NamedTuple):
    """A function of two vectors: steps that each take values of earlier ones."""

    steps: tuple  # (name, function, where its operands stand)
    constants: tuple
    weights: np.ndarray

    def __call__(self, x, v):
        """The values of the last steps, as real numbers."""
        values = [x, v, *map(jnp.asarray, self.constants)]
        for _, function, places in self.steps:
            values += function(*(values[k] for k in places))
        return jnp.concatenate([jnp.ravel(real(value)) for value in values[-3:]])

    def scalar(self, x, v):
        """A weighted sum of them."""
        parts = self(x, v)
        return jnp.sum(parts * self.weights[: parts.size]) + jnp.sum(parts**2) / 8

    @property
    def names(self):
        """The names of its operations."""
        return [name for name, _, _ in self.steps]


def real(value):
    """A value as real numbers."""
    value = jnp.asarray(value)
    if jnp.iscomplexobj(value):
        value = jnp.stack([value.real, value.imag])
    return value.astype(float)


def random_program(seed, longest=60):
    """The program of a seed, with the numbers at which it is run."""
    rng = np.random.default_rng(seed)
    x, v = rng.uniform(-1.5, 1.5, SIZE), rng.uniform(-1.5, 1.5, SIZE)
    constants = [constant(rng, kind, SHAPES[rng.integers(len(SHAPES))]) for kind in rng.choice([*DTYPES, "f", "f", "f"], 3)]
    values, steps = [x, v, *constants], []
    real_only = rng.random() < 0.6  # one operation on other dtypes leaves the whole program plain
    length = 5 + int((longest - 4) * rng.random() ** 3)  # most are short, which shows as much in less time
    for _ in range(3 * length):
        if len(steps) == length:
            break
        at = int(rng.integers(len(OPERATIONS)))
        name, kinds, _ = OPERATIONS[at]
        if real_only and set(kinds) & set("che"):
            continue
        places = choose_operands(rng, kinds, values)
        if places is None:
            continue
        given = [values[k] for k in places]
        closed = operation(at, *(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in given))
        outs = run_plain(closed, *given)
        if real_only and any(o.dtype not in FOLDABLE for o in outs):
            continue
        if all(o.size <= 12 and is_moderate(o) for o in outs):
            steps.append((name, jax.extend.core.jaxpr_as_fun(closed), places))
            values += outs
    return Program(tuple(steps), tuple(constants), rng.uniform(0.5, 1.5, 200)), x, v


@functools.cache
def operation(at, *shapes):
    """One of the operations as a program, traced once."""
    return jax.make_jaxpr(OPERATIONS[at][2])(*shapes)


def constant(rng, kind, shape):
    """Numbers of a dtype, with zeros and equal ones among them."""
    numbers = rng.choice([0.0, 1.0, -1.0, 2.0, 0.5, *rng.uniform(-2, 2, 4)], shape)
    return np.asarray(numbers + 1j * rng.uniform(-1, 1, shape) if kind == "c" else np.abs(numbers) if kind == "u" else numbers).astype(
        jnp.dtype(DTYPES[kind])
    )


def choose_operands(rng, kinds, values):
    """The positions of operands of these kinds: a letter for the dtype, then one for the shape, where "s" is the same for all."""
    same, places = None, []
    for kind, shape in kinds.split(","):
        wanted = {"v": (3,), "m": (2, 3), "q": (3, 3), ".": (), "s": same}.get(shape)
        alike = [k for k, x in enumerate(values) if x.dtype == jnp.dtype(DTYPES[kind]) and wanted in (None, x.shape)]
        if not alike:
            return None
        places.append(int(rng.choice(alike[-6:] if rng.random() < 0.7 else alike)))
        same = values[places[-1]].shape if shape == "s" else same
    return tuple(places)


def is_moderate(array):
    return bool(np.all(np.isfinite(array.astype(complex))) and np.all(np.abs(array.astype(complex)) < LARGE))


# What is compared.


def energies(run):
    """Lagrange's terms of ½ v·v + a program, in plain JAX: ∂L/∂q, p, M, the force of Coriolis and centrifugal terms."""
    L = lambda x, v: 0.5 * v @ v + run.scalar(x, v)
    p = jax.grad(L, 1)
    return lambda x, v: [jax.grad(L)(x, v), p(x, v), jax.jacfwd(p, 1)(x, v), jax.jvp(lambda x: p(x, v), (x,), (v,))[1]]


FORMS = {
    "value": lambda run: lambda x, v: [run(x, v)],
    "batch": lambda run: lambda x, v: [jax.vmap(run)(jnp.stack([x, v]), jnp.stack([v, x]))],
    "gradient": lambda run: lambda x, v: jax.grad(run.scalar, (0, 1))(x, v),
    "Jacobian": lambda run: lambda x, v: [jax.jacfwd(run)(x, v)],
    "energies": energies,
    "curvature of a batch": lambda run: lambda x, v: [jax.vmap(jax.jacfwd(jax.grad(run.scalar)))(jnp.stack([x, v]), jnp.stack([v, x]))],
}


NO_DERIVATIVE = (
    "not implemented",
    "rule",
    "differentiat",
    "Reverse-mode",
    "forward-mode",
    "complex",
    "float0",
    "NYI",
    "gradient with respect to",
)


def jaxpr_of(function, *arguments):
    """The program of a function; None where JAX has no derivative of it, or needs the length of a loop."""
    try:
        closed = jax.make_jaxpr(function)(*arguments)
        return None if "custom_lin" in primitive_names(closed) else closed
    except (NotImplementedError, TypeError, ValueError) as error:
        if any(part in str(error) for part in NO_DERIVATIVE):
            return None
        raise


def differs(found, run, x, v, single):
    """The error with respect to the plain program, or 0 where it is no larger than that from a few roundings in the input."""
    expected = run(x, v)
    rounding = 1e-6 if single else 1e-14
    scale = 1 + max((np.max(np.abs(b)) for b in expected if np.size(b)), default=0)
    if not np.isfinite(scale):
        return 0.0
    error = max((np.max(np.abs(np.asarray(a) - b)) for a, b in zip(found, expected, strict=True) if np.size(b)), default=0)
    if error <= 1e4 * rounding * scale:
        return 0.0
    rng = np.random.default_rng(0)
    near = lambda z: z * (1 + rounding * rng.uniform(-1, 1, z.shape))
    spread = max(np.max(np.abs(a - b)) for _ in range(6) for a, b in zip(run(near(x), near(v)), expected, strict=True) if np.size(b))
    return 0.0 if error <= 1e3 * spread or not np.isfinite(spread) else float(error)


def compared(seed):
    """For the program of a seed in one of its forms: the form, whether it was rewritten, the error, the program."""
    run, x, v = random_program(seed)
    form = list(FORMS)[seed % len(FORMS)]
    closed = jaxpr_of(FORMS[form](run), x, v)
    if closed is None:
        form, closed = "value", jax.make_jaxpr(FORMS["value"](run))(x, v)
    single = "f32[" in str(closed)
    found, is_rewritten = run_rewritten(closed, x, v)
    error = differs(found, functools.partial(run_plain, closed), x, v, single)
    if is_rewritten and not error and seed % 8 == 0:  # derivatives of the rewritten program itself, as in production
        written_out, one = scalarise._as_scalar_code(FORMS[form](run), LIMIT), np.ones(SIZE)
        along = lambda f: lambda x, v: jax.jvp(f, (x, v), (one, -one))[1]
        closed = jaxpr_of(along(FORMS[form](run)), x, v)
        if closed is not None:
            slope = jaxpr_of(along(written_out), x, v)
            error = differs(run_plain(slope, x, v), functools.partial(run_plain, closed), x, v, single)
            form = f"slope of {form}"
    return form, is_rewritten, error, run


def main(first, last):
    """Prints the programs that differ, and how many were compared."""
    jax.config.update("jax_enable_x64", True)
    changed, operations, bad = 0, set(), 0
    for seed in range(first, last):
        try:
            form, is_rewritten, error, run = compared(seed)
        except Exception as problem:  # a hunt goes on
            print(f"seed {seed}: {type(problem).__name__}: {str(problem)[:300]}", flush=True)
            bad += 1
            continue
        changed += is_rewritten
        operations |= set(run.names)
        if error:
            bad += 1
            print(f"seed {seed}: {form} is off by {error:.3g}: {' '.join(run.names)}", flush=True)
        if (seed + 1) % 100 == 0:
            print(f"... {seed + 1 - first} programs, {changed} rewritten, {len(operations)} operations, {bad} bad", flush=True)
            if (seed + 1) % 20_000 == 0:
                jax.clear_caches()
    print(f"{last - first} programs, {changed} rewritten, {len(operations)} operations, {bad} bad")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
