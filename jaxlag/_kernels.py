"""A loop as one kernel of a CPU.

XLA runs each fused operation of a loop as a kernel of its own, and between small kernels more time passes than in them. What moves
less than 1 kB a turn it compiles whole; here a longer loop asks for the same, where it has nothing in it that needs a library.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend import core
from jax.interpreters import ad, batching, mlir

from ._folding import ELEMENTWISE

# What becomes neither a library call nor a scatter, a sort or a random draw, which no kernel can hold.
PLAIN = frozenset(ELEMENTWISE) | frozenset(
    """
    add_any and argmax argmin broadcast_in_dim clamp concatenate cond convert_element_type copy copy_p cumlogsumexp cummax cummin
    cumprod cumsum custom_jvp_call custom_linear_solve dynamic_slice dynamic_update_slice expand_dims gather integer_pow
    iota jit maybe_set nextafter nonbatchable nondifferentiable_backward optimization_barrier pad pjit reduce_and reduce_max
    reduce_min reduce_or reduce_prod reduce_sum remat reshape rev scan select_if_vmap slice split square squeeze stack tile transpose
    unstack unvmap_all unvmap_any unvmap_max while
    """.split()  # noqa: SIM905
)


def in_one_kernel(function: Callable[[], Any]) -> Any:
    """What `function` returns; on a CPU, if it can be, computed by one kernel."""
    closed, shapes, static = eqx.filter_make_jaxpr(function)()
    jaxpr: Any = closed.jaxpr.replace(constvars=[], invars=closed.jaxpr.constvars)
    outputs = jax.jit(core.jaxpr_as_fun(core.ClosedJaxpr(jaxpr, ())))(*closed.consts)
    if is_plain(jaxpr):
        outputs = _marked(outputs)
    return eqx.combine(jax.tree.unflatten(jax.tree.structure(shapes), outputs), static)


def is_plain(jaxpr: Any) -> bool:
    """Whether a kernel can hold it and its derivatives."""
    jaxpr = getattr(jaxpr, "jaxpr", jaxpr)
    return not jaxpr.effects and all(map(_is_plain, jaxpr.eqns))


def _is_plain(equation) -> bool:
    if equation.primitive.name not in PLAIN:
        return False
    if equation.primitive.name == "custom_jvp_call":
        shapes = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in equation.invars if not isinstance(v, core.Literal)]
        del shapes
    inner = [x for x in jax.tree.leaves(list(equation.params.values()), is_leaf=_is_jaxpr) if _is_jaxpr(x)]
    return all(map(is_plain, inner))


def _is_jaxpr(x) -> bool:
    return isinstance(x, (core.Jaxpr, core.ClosedJaxpr))


def _marked(outputs: list) -> list:
    """The outputs of a call that is to be one kernel."""
    is_count = [jax.numpy.issubdtype(x.dtype, jax.numpy.integer) for x in outputs]
    order = sorted(range(len(outputs)), key=lambda i: not is_count[i])
    marked = dict(zip(order, mark_p.bind(*(outputs[i] for i in order), counts=sum(is_count)), strict=True))
    return [marked[i] for i in range(len(outputs))]


# The identity, which on a CPU marks the call that its operands come from, integers first. Where these are batched, writing at them is
# scattering: then there is no mark. Values and tangents go through it together, so that it is there where either is asked for.
mark_p = core.Primitive("mark_as_kernel")
mark_p.multiple_results = True


def _batched(operands, dims, *, counts):
    alike = all(dim is None for dim in dims[:counts])
    return (mark_p.bind(*operands, counts=counts) if alike else list(operands)), list(dims)


def _pushed(primals, tangents, *, counts):
    moving = [i for i, tangent in enumerate(tangents) if type(tangent) is not ad.Zero]
    outputs = mark_p.bind(*primals, *(tangents[i] for i in moving), counts=counts)
    given = dict(zip(moving, outputs[len(primals) :], strict=True))
    return outputs[: len(primals)], [given.get(i, tangent) for i, tangent in enumerate(tangents)]


def _attached(*operands, counts):
    marked = [set_xla_metadata(x, xla_cpu_small_call="true", inlineable="false") for x in operands[:counts]]
    return [*marked, *operands[counts:]]


mark_p.def_impl(lambda *operands, counts: list(operands))
mark_p.def_abstract_eval(lambda *operands, counts: list(operands))
batching.primitive_batchers[mark_p] = _batched
ad.primitive_jvps[mark_p] = _pushed
mlir.register_lowering(mark_p, mlir.lower_fun(_attached), platform="cpu", cacheable=False)
mlir.register_lowering(mark_p, lambda _, *operands, counts: operands)
