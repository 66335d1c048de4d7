"""The one walk over a jaxpr, for values of any kind, and what jaxprs call: bodies, branches, the turns of a loop.

`walk` keeps the environment of variables, in which constants and inputs stand first. What the values are (arrays, expression nodes,
intervals, sums of matrix products, numbers of quantities) and what an equation does with them is left to the caller.
"""

import pathlib
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend import core
from jax.interpreters import partial_eval as pe

from .primitives import CALLS as CALLS

IN_JAX = str(pathlib.Path(jax.__file__).parent)


def walk(
    program: Any,
    inputs: Iterable[Any],
    evaluate: Callable[[Any, list[Any]], Iterable[Any]],
    constant: Callable[[Any], Any] = lambda value: value,
    literal: Callable[[Any], Any] | None = None,
    stop: int | None = None,
    opened: Container[str] = (),
) -> list[Any]:
    """The outputs of a jaxpr, closed or not, over values of any kind.

    **Arguments:** `evaluate(equation, operands)` gives the outputs of one equation; `constant(value)` turns what the program has of its own
    into values, and the numbers in its equations, unless `literal(atom)` does. The programs that `opened` primitives call are walked
    through. With `stop`, the equations from that number on are left out, and there are no outputs.
    """
    literal = literal or (lambda atom: constant(np.asarray(atom.val, atom.aval.dtype)))
    jaxpr, constants = getattr(program, "jaxpr", program), map(constant, getattr(program, "consts", ()))
    environment = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *inputs], strict=True))
    read = lambda atom: literal(atom) if isinstance(atom, core.Literal) else environment[atom]  # type: ignore[attr-defined]
    for equation in jaxpr.eqns[:stop]:
        operands = [read(atom) for atom in equation.invars]
        if equation.primitive.name in opened:
            outputs: Iterable[Any] = walk(called_program(equation), operands, evaluate, constant, literal, opened=opened)
        else:
            outputs = evaluate(equation, operands)
        environment.update(zip(equation.outvars, outputs, strict=True))
    return [read(atom) for atom in jaxpr.outvars] if stop is None else []


def constants_as_inputs(closed: Any) -> Any:
    """The jaxpr of a closed one, with its constants as inputs, which come first."""
    return closed.jaxpr.replace(constvars=[], invars=[*closed.jaxpr.constvars, *closed.jaxpr.invars])


def used_constants(closed: Any) -> tuple[Any, list[Any]]:
    """The same, with those constants alone that an output depends on; and these."""
    jaxpr, count = constants_as_inputs(without_unused(closed)), len(closed.consts)
    needed = [False] * count + [True] * (len(jaxpr.invars) - count)
    jaxpr, used = pe.dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars), instantiate=needed)
    return jaxpr, [x for x, is_used in zip(closed.consts, used, strict=False) if is_used]


def called_program(equation: Any) -> Any:
    """The program that an equation calls, closed."""
    p = equation.params
    program = p["jaxprs"].solve if "jaxprs" in p else next(p[name] for name in ("jaxpr", "call_jaxpr", "fun_jaxpr", "call") if name in p)
    return program if hasattr(program, "consts") else core.ClosedJaxpr(program, ())


def is_call_of(equation: Any, function: Callable) -> bool:
    """Whether a call is of this function of JAX, not of one of the user's with the same name."""
    given = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype, weak_type=v.aval.weak_type) for v in equation.invars]
    own = jax.make_jaxpr(function)(*given).jaxpr.eqns
    return len(own) == 1 and str(own[0].params["jaxpr"]) == str(equation.params.get("jaxpr"))


def called_name(equation: Any) -> str:
    """The name of the function that is called."""
    return str(equation.params.get("name") or called_program(equation).jaxpr.debug_info.func_name)


def name_in_jax(equation: Any) -> str | None:
    """The name of the function that is called if it is one of JAX itself, not one of the user's with the same name."""
    return called_name(equation).strip("_<>") if IN_JAX in called_program(equation).jaxpr.debug_info.func_src_info else None


def branch_index(index: Any, params: dict) -> int:
    """The number of the branch that a `cond` takes."""
    return min(max(int(index), 0), len(params["branches"]) - 1)


def columns_of_branches(params: dict, operands: Sequence[Any], run: Callable[[Any, Any], Any]) -> Iterator[tuple]:
    """For each output of a `cond` what the branches make of it, by run(branch, operands)."""
    return zip(*(run(branch, operands) for branch in params["branches"]), strict=True)


def parts_of_scan(params: dict) -> tuple[int, int]:
    """Where in the inputs of a `scan` its carries begin, behind what is constant, and where its rows do; JAX 0.10 and 0.11."""
    if "num_consts" in params:
        return params["num_consts"], params["num_consts"] + params["num_carry"]
    constants, carries, _ = (len(list(part)) for part in params["ft_in"].unpack())
    return constants, constants + carries


def unrolled_scan(
    params: dict, operands: Sequence[Any], turn: Callable[[list[Any]], Any], row: Callable[[Any, int], Any] = lambda x, k: x[k]
) -> tuple[list[Any], list[tuple]]:
    """The last carry of a `scan`, and the columns of its rows, in the order in which they are stacked: turn(inputs) once for each row."""
    i, j = parts_of_scan(params)
    carry, rows = list(operands[i:j]), {}
    for k in reversed(range(params["length"])) if params["reverse"] else range(params["length"]):
        outputs = turn([*operands[:i], *carry, *(row(x, k) for x in operands[j:])])
        carry, rows[k] = outputs[: j - i], outputs[j - i :]
    return carry, list(zip(*(rows[k] for k in sorted(rows)), strict=True))


def primitive_names(program: Any) -> Iterator[str]:
    """The names of all primitives in a program or a list of equations, those of the programs they call included."""
    for equation in program if isinstance(program, list) else getattr(program, "jaxpr", program).eqns:
        yield equation.primitive.name
        for part in programs_within(equation):
            yield from primitive_names(part)


def programs_within(equation: Any) -> list[Any]:
    """The programs that an equation calls."""
    parts = [part for value in equation.params.values() for part in (value if isinstance(value, (tuple, list)) else [value])]
    return [part for part in parts if hasattr(part, "eqns") or hasattr(part, "jaxpr")]


def count_equations(program: Any) -> int:
    """The number of equations, those of the programs it calls included."""
    return sum(1 for _ in primitive_names(program))


def used_arguments(function: Callable, *arguments: Any) -> Any:
    """Which numbers of its arguments any operation of the program of a function uses: structured like the arguments, of truth values."""
    jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    _, used = pe.dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    return jax.tree.unflatten(jax.tree.structure(arguments), used)


def without_unused(closed: Any) -> Any:
    """A closed program without the operations, and the operands of branches and loops, that no output depends on."""
    jaxpr = closed.jaxpr
    if any(equation.primitive.name == "while" for equation in jaxpr.eqns):  # JAX itself leaves those of a loop that ends by itself
        jaxpr = jaxpr.replace(eqns=[_with_used_constants(e) if e.primitive.name == "while" else e for e in jaxpr.eqns])
    jaxpr, _ = pe.dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars), instantiate=True)
    return closed.replace(jaxpr=jaxpr)


def _with_used_constants(loop: Any) -> Any:
    """A loop with those constants alone that its condition and its body use."""
    parts, operands, constants = [], list(loop.invars), []
    for name, count in (("cond_jaxpr", "cond_nconsts"), ("body_jaxpr", "body_nconsts")):
        number, program = loop.params[count], without_unused(loop.params[name])
        jaxpr, used = pe.dce_jaxpr(
            program.jaxpr, [True] * len(program.jaxpr.outvars), instantiate=[False] * number + [True] * len(loop.outvars)
        )
        parts.append((name, program.replace(jaxpr=jaxpr), count, sum(used[:number])))
        constants += [x for x, is_used in zip(operands[:number], used, strict=False) if is_used]
        operands = operands[number:]
    params = loop.params | {key: value for name, program, count, number in parts for key, value in ((name, program), (count, number))}
    return loop.replace(invars=[*constants, *operands], params=params)
