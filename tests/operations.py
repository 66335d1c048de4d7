"""The operations of `jax.lax` that random programs (`programs.py`) are made of, by the names that JAX's documentation lists.

Each is (name, kinds of operands, function). A kind is a letter for the dtype (f, g: double and single precision, c: complex, h, e: half
precision, i, u: integers, b: bool) and one for the shape (s: the same for all, a: any, v: (3,), m: (2, 3), q: (3, 3), .: a scalar).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

SHAPES = ((), (3,), (2, 3), (3, 3))
ONE = np.array([1])


def on(kinds, **functions):
    """Operations with the same kinds of operands."""
    return [(name.rstrip("_"), kinds, function) for name, function in functions.items()]


def several(names, kinds):
    """Operations of `jax.lax`, each with operands of several kinds."""
    return [(name, each, getattr(lax, name)) for name in names.split() for each in kinds.split()]


def gathered(x, indices, mode=None):
    how = lax.GatherDimensionNumbers(offset_dims=(1,), collapsed_slice_dims=(0,), start_index_map=(0,))
    return lax.gather(x, np.asarray(indices)[:, None], how, (1, 2), mode=mode)


def scattering(function, places=(2, 0, 2), **more):
    how = lax.ScatterDimensionNumbers(update_window_dims=(), inserted_window_dims=(0,), scatter_dims_to_operand_dims=(0,))
    return lambda x, y: function(x, np.array(places)[:, None], y, how, **more)


@jax.custom_jvp
def doubled_slope(x):
    """sin with twice its derivative, so that a lost rule shows."""
    return jnp.sin(x)


doubled_slope.defjvp(lambda primals, tangents: (doubled_slope(primals[0]), 2 * jnp.cos(primals[0]) * tangents[0]))


@jax.custom_vjp
def tripled_slope(x):
    return jnp.sin(x)


tripled_slope.defvjp(lambda x: (jnp.sin(x), x), lambda x, ct: (3 * jnp.cos(x) * ct,))


def positive(a):
    """A symmetric matrix that is positive definite."""
    return a @ a.T + jnp.eye(3, dtype=a.dtype)


def held(a, b):
    A = positive(a)
    factor = jnp.linalg.cholesky(lax.stop_gradient(A))
    return lax.custom_linear_solve(lambda y: A @ y, b, lambda _, b: jax.scipy.linalg.cho_solve((factor, True), b), symmetric=True)


def root(x):
    """The root of y + y³ = x by Newton's method, differentiated implicitly."""
    newton_step = lambda f: lambda _, y: y - f(y) / (1 + 3 * y**2)
    solve = lambda f, y: lax.fori_loop(0, 30, newton_step(f), y)
    return lax.custom_root(lambda y: y + y**3 - x, jnp.zeros_like(x), solve, lambda g, y: y / g(jnp.ones_like(y)))


def doubling(x):
    """A loop whose length depends on the numbers."""
    return lax.while_loop(lambda s: jnp.sum(jnp.abs(s)) < 5, lambda s: 2 * s + 0.125, x)


SAME = "fs,fs fs,fs gs,gs cs,cs hs,hs es,es"
WHOLE = "is,is us,us"
EVERY = "fa fa ga ca ha ea ia"
REAL = "fa fa ga ha ea"

OPERATIONS = [
    # element-wise
    *several("sin cos tan tanh exp log1p expm1 sqrt rsqrt log sinh cosh asinh atan logistic square", "fa fa ga ca ha ea"),
    *several("asin acos acosh atanh", "fa ga ca"),
    *several("cbrt exp2 floor ceil round sign abs erf erfc erf_inv lgamma digamma bessel_i0e bessel_i1e reciprocal", "fa fa ga"),
    *several("neg abs sign square", "ia ha ea ca fa"),
    *several("neg square", "ua"),
    *several("population_count clz bitwise_not", "ia ua"),
    *several("bitwise_not", "ba"),
    *several("is_finite", REAL),
    *several("stop_gradient", EVERY),
    *several("add sub mul", f"{SAME} {WHOLE}"),
    *several("add sub mul div", "fs,fs fs,fs fs,fs fs,fs gs,gs"),
    *several("div", f"{SAME} is,is us,us"),
    *several("rem max min", "fs,fs gs,gs hs,hs is,is us,us"),
    *several("pow atan2 nextafter", "fs,fs gs,gs"),
    *several("eq ne lt le gt ge", "fs,fs gs,gs is,is us,us hs,hs"),
    *several("eq ne", "cs,cs bs,bs"),
    *several("bitwise_and bitwise_or bitwise_xor", "is,is us,us bs,bs"),
    *several("shift_left shift_right_logical shift_right_arithmetic", "is,is us,us"),
    *several("mulhi", "is,is us,us") * hasattr(lax, "mulhi"),
    *several("igamma igammac igamma_grad_a random_gamma_grad zeta polygamma", "fs,fs"),
    *several("betainc", "fs,fs,fs"),
    *several("clamp", "fs,fs,fs gs,gs,gs is,is,is hs,hs,hs"),
    *several("select", "bs,fs,fs bs,gs,gs bs,is,is bs,cs,cs"),
    *several("select_n", "bs,fs,fs is,fs,fs,fs is,is,is bs,us,us bs,bs,bs"),
    *several("complex", "fs,fs"),
    *several("conj real imag abs", "ca"),
    *several("optimization_barrier", "fa"),
    *on("fa", integer_pow=lambda x: lax.integer_pow(x, 3), pow_=lambda x: lax.pow(x, 2.0), convert_element_type=lambda x: x.astype(int)),
    *on("fa", integer_pow=lambda x: x**-2, pow_=lambda x: lax.pow(jnp.abs(x), 0.5), bitwise_not=lambda x: ~(x > 0.5)),
    *on("ga", integer_pow=lambda x: x**5, convert_element_type=lambda x: x.astype(jnp.float64)),
    *on("ca", integer_pow=lambda x: lax.integer_pow(x, -2), real=lambda x: lax.real(x * lax.conj(x))),
    *on("ia", integer_pow=lambda x: lax.integer_pow(x, 3), convert_element_type=lambda x: x.astype(float)),
    *on(
        "ia", convert_element_type=lambda x: x.astype(jnp.uint8), bitcast_convert_type=lambda x: lax.bitcast_convert_type(x, jnp.uint32) % 9
    ),
    *on("ua", convert_element_type=lambda x: x.astype(jnp.int8).astype(float), integer_pow=lambda x: lax.integer_pow(x, 7)),
    *on("ba", convert_element_type=lambda x: x.astype(float)),
    *on("fa", convert_element_type=lambda x: x.astype(jnp.float32), reduce_precision=lambda x: lax.reduce_precision(x, 8, 10)),
    *on(
        "fa",
        convert_element_type=lambda x: (3 * x).astype(jnp.int32),
        round_=lambda x: lax.round(3 * x, lax.RoundingMethod.TO_NEAREST_EVEN),
    ),
    *on("fa", convert_element_type=lambda x: x.astype(jnp.bfloat16), full_like=lambda x: lax.full_like(x, 2.0) * x),
    *on("fa", convert_element_type=lambda x: x.astype(jnp.float16), bitcast_convert_type=lambda x: jnp.copysign(1.5, x)),
    *on("ha", convert_element_type=lambda x: x.astype(float)),
    *on("ea", convert_element_type=lambda x: x.astype(float)),
    *on(
        "fa",
        complex_=lambda x: lax.complex(x, 2 * x),
        stop_gradient=lambda x: x * lax.stop_gradient(x),
        clamp=lambda x: lax.clamp(-0.5, x, 0.5),
    ),
    *on("fa", mul=lambda x: -2 * x, sub=lambda x: 1 - x, add=lambda x: x + 0, div=lambda x: x / 4 - x / 3, neg=lambda x: x - x / 2),
    *on("fs,fs", sub=lambda x, y: (x - y) * (y - x), add=lambda x, y: 3 * x - 2 * (x + y), div=lambda x, y: (-x) / (2 + y * y)),
    *on("fs,fs", rsqrt=lambda x, y: (x / jnp.sqrt(1 + y * y)) * (y / jnp.sqrt(1 + y * y)), atan2=lambda x, y: lax.atan2(x - y, y - 2)),
    *on(
        "fs,fs",
        max_=jnp.logaddexp,
        sqrt=jnp.hypot,
        select=lambda x, y: jnp.where(x > y, x * y, 2 * y),
        abs_=lambda x, y: jnp.abs(x - y) * y,
    ),
    # moving
    *on("fv", broadcast=lambda x: lax.broadcast(x, (2,)), broadcast_in_dim=lambda x: lax.broadcast_in_dim(x, (2, 3), (1,))),
    *on(
        "fv",
        rev=lambda x: lax.rev(x, (0,)),
        slice_=lambda x: lax.slice(x, (0,), (3,), (2,))[:1] * x,
        expand_dims=lambda x: lax.expand_dims(x, (0,)),
    ),
    *on("iv", rev=lambda x: lax.rev(x, (0,)), concatenate=lambda x: lax.concatenate([x[1:], x[:1]], 0)),
    *on("cv", rev=lambda x: lax.rev(x, (0,)), concatenate=lambda x: lax.concatenate([x[1:], x[:1]], 0)),
    *on("fv", concatenate=lambda x: lax.concatenate([x[1:], x[:1]], 0), pad=lambda x: lax.pad(x, 0.5, ((-1, 2, 0),))),
    *on(
        "fv",
        pad=lambda x: lax.pad(x, 0.0, ((0, 0, 1),))[1:4],
        split=lambda x: lax.split(x, (1, 2))[0] * x,
        tile=lambda x: lax.tile(x, (2,))[2:5],
    ),
    *on("fv", dynamic_slice=lambda x: lax.dynamic_slice(x, (5,), (1,)) * x, slice_in_dim=lambda x: lax.slice_in_dim(x, -2, None).sum() * x),
    *on(
        "fv", dynamic_slice_in_dim=lambda x: lax.dynamic_slice_in_dim(x, 1, 2).sum() + x, index_in_dim=lambda x: lax.index_in_dim(x, 1) - x
    ),
    *on(
        "fv",
        dynamic_index_in_dim=lambda x: lax.dynamic_index_in_dim(x, -1) * x,
        index_take=lambda x: lax.index_take(x, (ONE,), (0,)).sum() * x,
    ),
    *on("fv,fv", dynamic_update_slice=lambda x, y: lax.dynamic_update_slice(x, y[:2], (1,)), select=lambda x, y: jnp.where(y > 0, x, 0.5)),
    *on("fv,fv", dynamic_update_slice_in_dim=lambda x, y: lax.dynamic_update_slice_in_dim(x, y[:1], 2, 0)),
    *on("fv,fv", dynamic_update_index_in_dim=lambda x, y: lax.dynamic_update_index_in_dim(x, y[0], 1, 0)),
    *on("fv,iv", gather=lambda x, k: x[k], dynamic_slice=lambda x, k: lax.dynamic_slice(x, (k[0],), (1,)) - x),
    *on(
        "fv,iv",
        scatter=lambda x, k: x.at[k].set(0.25),
        scatter_add=lambda x, k: x.at[k].add(x),
        dynamic_index_in_dim=lambda x, k: x[k[1]] * x,
    ),
    *on(
        "fm",
        transpose=lambda x: lax.transpose(x, (1, 0)) @ x,
        reshape=lambda x: lax.reshape(x, (3, 2)) @ x,
        collapse=lambda x: lax.collapse(x, 0)[1:4],
    ),
    *on("fm", squeeze=lambda x: lax.squeeze(x[:1], (0,)), gather=lambda x: gathered(x, [1, 0])[0, :1] * x, rev=lambda x: x[::-1, ::-1]),
    *on(
        "fm",
        gather=lambda x: gathered(x, [9, 1], "clip")[:, :1] * x,
        split=lambda x: lax.split(x, (1, 1)),
        iota=lambda x: x + lax.iota(float, 3),
    ),
    *on(
        "fm", gather=lambda x: gathered(x, [9, 1], "fill")[1, 0] * x, broadcasted_iota=lambda x: x + lax.broadcasted_iota(float, (2, 3), 1)
    ),
    *on("gm", transpose=lambda x: x.T @ x, reshape=lambda x: lax.reshape(x, (6,))[1:4]),
    *on(
        "fv,fv",
        scatter=scattering(lax.scatter),
        scatter_add=scattering(lax.scatter_add),
        scatter_mul=scattering(lax.scatter_mul, (2, 0, 1), unique_indices=True),
    ),
    *on("fv,fv", scatter_min=scattering(lax.scatter_min), scatter_max=scattering(lax.scatter_max), scatter_sub=scattering(lax.scatter_sub)),
    *on("iv,iv", scatter=scattering(lax.scatter), scatter_add=scattering(lax.scatter_add), scatter_mul=scattering(lax.scatter_mul)),
    *on("cv,cv", scatter=scattering(lax.scatter), scatter_add=scattering(lax.scatter_add)),
    *on("fv", scatter_apply=lambda x: lax.stop_gradient(x).at[np.array([1, 2])].apply(jnp.sin) * x),
    *on("fv,fv", stack=lambda x, y: jnp.stack([x, y]), unstack=lambda x, y: jnp.unstack(jnp.stack([x, y], 1))),
    *on("f.", broadcast_to_rank=lambda x: lax.broadcast_to_rank(x, 1) * np.ones(3), full=lambda x: lax.full((3,), 2.0) * x),
    # reductions
    *on(
        "fm",
        reduce_sum=lambda x: lax.reduce_sum(x, (0,)),
        reduce_prod=lambda x: lax.reduce_prod(x, (1,)),
        reduce_max=lambda x: lax.reduce_max(x, (0,)),
    ),
    *on(
        "fm",
        reduce_min=lambda x: lax.reduce_min(x, (1,)),
        reduce_and=lambda x: lax.reduce_and(x > 0, (0,)),
        reduce_or=lambda x: lax.reduce_or(x > 0, (0,)),
    ),
    *on("fm", reduce_max=lambda x: lax.reduce_max(x, (0, 1)), reduce_xor=lambda x: lax.reduce_xor(x > 0, (0,))),
    *on(
        "fv",
        reduce_max=lambda x: jnp.max(lax.clamp(-0.25, x, 0.25)),
        reduce_min=lambda x: jnp.min(jnp.abs(x)) * x,
        cummax=lambda x: lax.cummax(lax.clamp(-0.3, x, 0.3)),
    ),
    *on(
        "iv",
        reduce_sum=lambda x: lax.reduce_sum(x, (0,)),
        reduce_prod=jnp.prod,
        reduce_max=jnp.max,
        reduce_and=lambda x: lax.reduce_and(x, (0,)),
    ),
    *on(
        "uv",
        reduce_sum=lambda x: lax.reduce_sum(x, (0,)),
        reduce_or=lambda x: lax.reduce_or(x, (0,)),
        cumsum=lax.cumsum,
        cumprod=lax.cumprod,
    ),
    *on("cv", reduce_sum=lambda x: lax.reduce_sum(x, (0,)), reduce_prod=jnp.prod, cumsum=lax.cumsum),
    *on("gv", reduce_sum=jnp.sum, cumsum=lax.cumsum, reduce_prod=jnp.prod),
    *on("hv", reduce_sum=jnp.sum, cumsum=lax.cumsum),
    *on("fv", cumsum=lax.cumsum, cumprod=lambda x: lax.cumprod(x, reverse=True), cummin=lax.cummin, cumlogsumexp=lax.cumlogsumexp),
    *on(
        "fv",
        argmax=lambda x: lax.argmax(x, 0, jnp.int32),
        argmin=lambda x: lax.argmin(x, 0, jnp.int32),
        top_k=lambda x: lax.top_k(x, 2)[0].sum() * x,
    ),
    *on(
        "fv", sort=lax.sort, sort_key_val=lambda x: lax.sort_key_val(x, 2 * x[::-1]), approx_max_k=lambda x: lax.approx_max_k(x, 2)[0].sum()
    ),
    *on("fv", approx_min_k=lambda x: lax.approx_min_k(x, 2)[0].sum(), reduce=lambda x: lax.reduce(x, np.float64(0), lax.add, (0,)) * x),
    *on("iv", sort=lax.sort, argmax=lambda x: lax.argmax(x, 0, jnp.int32)),
    *on(
        "fv",
        reduce_window=lambda x: lax.reduce_window(x, -np.inf, lax.max, (2,), (1,), "SAME"),
        associative_scan=lambda x: lax.associative_scan(jnp.multiply, x),
    ),
    *on(
        "fv",
        reduce_window=lambda x: lax.reduce_window(x, 0.0, lax.add, (2,), (1,), "SAME"),
        associative_scan=lambda x: lax.associative_scan(jnp.add, x),
    ),
    *on("fm,fm", dot_general=lambda x, y: lax.dot_general(x, y, (((0,), (0,)), ((), ()))), dot=lambda x, y: lax.dot(x, y.T) @ x),
    *on(
        "fm,fm",
        dot_general=lambda x, y: lax.dot_general(x, y, (((1,), (1,)), ((0,), (0,)))),
        batch_matmul=lambda x, y: lax.batch_matmul(x[None], y.T[None])[0] @ x,
    ),
    *on(
        "fq,fv",
        dot=lax.dot,
        dot_general=lambda x, y: y @ x,
        triangular_solve=lambda a, b: jax.scipy.linalg.solve_triangular(positive(a), b, trans=1),
    ),
    *on("gv,gv", dot_general=lambda x, y: lax.dot_general(x, y, (((0,), (0,)), ((), ())), preferred_element_type=jnp.float64)),
    *on("cq,cv", dot=lax.dot, dot_general=lambda x, y: lax.conj(y) @ x),
    *on("iv,iv", dot=lax.dot),
    *on("fv,fv", dot_general=jnp.outer, conv=lambda x, y: lax.conv(x[None, None], y[None, None], (1,), "SAME")[0, 0]),
    *on("fv,fv", conv_general_dilated=lambda x, y: lax.conv_general_dilated(x[None, None], y[None, None], (1,), [(1, 1)])[0, 0]),
    *on(
        "fv,fv",
        conv_with_general_padding=lambda x, y: lax.conv_with_general_padding(x[None, None], y[None, None], (1,), [(1, 1)], None, None)[
            0, 0
        ],
    ),
    *on("fv,fv", conv_transpose=lambda x, y: lax.conv_transpose(x[None, :, None], y[:, None, None], (1,), "SAME")[0, :, 0]),
    *on("fv", conv_general_dilated_patches=lambda x: lax.conv_general_dilated_patches(x[None, None], (2,), (1,), "SAME")[0, 1]),
    *on(
        "fv,fv",
        conv_general_dilated_local=lambda x, y: lax.conv_general_dilated_local(
            x[None, None], jnp.broadcast_to(y[:2, None], (1, 2, 3)), (1,), [(0, 1)], (2,)
        )[0, 0],
    ),
    *on("fm,fq", ragged_dot=lambda x, y: lax.ragged_dot(x, y[None], np.array([2]))),
    # linear algebra
    *on(
        "fq",
        cholesky=lambda a: lax.linalg.cholesky(positive(a)),
        lu=lambda a: lax.linalg.lu(positive(a))[0],
        det=jnp.linalg.det,
        inv=lambda a: jnp.linalg.inv(positive(a)),
    ),
    *on(
        "fq",
        eigh=lambda a: jnp.linalg.eigvalsh(positive(a)),
        svd=lambda a: jnp.linalg.svd(a, compute_uv=False),
        qr=lambda a: jnp.abs(jnp.linalg.qr(a, mode="r")),
    ),
    *on("fq", tridiagonal_solve=lambda a: lax.linalg.tridiagonal_solve(a[0], 5 + a[1], a[2], a)),
    *on(
        "fq,fv",
        custom_linear_solve=held,
        solve=lambda a, b: jnp.linalg.solve(positive(a), b),
        cho=lambda a, b: jax.scipy.linalg.solve(positive(a), b, assume_a="pos"),
    ),
    *on("fq,fm", triangular_solve=lambda a, b: lax.linalg.triangular_solve(positive(a), b, lower=True, transpose_a=True)),
    *on(
        "cq,cv",
        triangular_solve=lambda a, b: jax.scipy.linalg.solve_triangular(a + 4 * jnp.eye(3), b, trans=2),
        cholesky=lambda a, b: jnp.linalg.cholesky(a @ lax.conj(a).T + 2 * jnp.eye(3)) @ b,
    ),
    *on("fv", fft=lambda x: jnp.fft.fft(x), householder_product=lambda x: lax.linalg.householder_product(x[:, None] / 2, x[:1]).ravel()),
    *on("cv", fft=lambda x: jnp.fft.ifft(x)),
    *on("fv", fft=lambda x: jnp.abs(jnp.fft.rfft(x)).sum() * x),
    # calls, loops, branches
    *on(
        "fv",
        custom_jvp=doubled_slope,
        custom_vjp=tripled_slope,
        custom_root=root,
        jit=jax.jit(lambda x: jax.jit(jnp.sin)(x) * x),
        remat=jax.checkpoint(jnp.tanh),
    ),
    *on(
        "fa",
        relu=jax.nn.relu,
        softplus=jax.nn.softplus,
        silu=jax.nn.silu,
        norm=jnp.linalg.norm,
        sinc=jnp.sinc,
        map_=lambda x: x + lax.map(jnp.sin, jnp.atleast_1d(x)).sum(),
    ),
    *on("fm", scan=lambda x: lax.scan(lambda c, r: (c * r, c + r), x[0], x), map_=lambda x: lax.map(jnp.prod, x)[0] * x),
    *on("fm", scan=lambda x: lax.scan(lambda c, r: (c + r, c * 2), x[0], x, reverse=True), vmap=lambda x: jax.vmap(lambda r: r * r[0])(x)),
    *on("fv", fori_loop=lambda x: lax.fori_loop(0, 3, lambda k, y: jnp.sin(y) + x[k], x), while_loop=doubling),
    *on(
        "fv",
        while_=lambda x: lax.fori_loop(0, 4, lambda k, y: y * 0.5 + x, 0 * x),
        scan=lambda x: lax.scan(lambda c, _: (c * 0.9, None), 1.0, length=20)[0] * x,
    ),
    *on(
        "fv",
        cond=lambda x: lax.cond(x[0] > 0, jnp.sin, jnp.cos, x),
        switch=lambda x: lax.switch(2, [jnp.sin, jnp.cos], x),
        platform_dependent=lambda x: lax.platform_dependent(x, cpu=jnp.sin, default=jnp.cos),
    ),
    *on(
        "fv,iv",
        switch=lambda x, k: lax.switch(k[0], [jnp.sin, jnp.cos, jnp.tanh], x),
        cond=lambda x, k: lax.cond(k[0] > k[1], lambda x: x * 2, lambda x: x - 1, x),
    ),
    *on(
        "fv",
        composite=lax.composite(lambda x: jnp.sin(x) + 1, name="jaxlag.sin_and_one"),
        interp=lambda x: jnp.interp(x, np.arange(-2.0, 3.0), np.array([0.0, 1, -1, 2, 0])),
    ),
]

NOT_COVERED = {
    "they return shapes and dtypes, not numbers": (
        "broadcast_shapes conv_dimension_numbers conv_general_permutations conv_general_shape_tuple conv_shape_tuple "
        "conv_transpose_shape_tuple dtype padtype_to_pads reduce_window_shape_tuple shape_as_value"
    ),
    "they communicate with other devices": (
        "all_gather all_to_all axis_index axis_size pbroadcast pcast pmax pmean pmin ppermute precv psend pshuffle psum psum_scatter "
        "pswapaxes ragged_all_to_all with_sharding_constraint"
    ),
    "they have an effect or an order, but no numbers": "after_all create_token dce_sink stage",
    "they are random, not a function of their operands": "rng_bit_generator rng_uniform",
    "their result is uninitialised": "empty",
    "they need shapes or dtypes beyond those of small programs": "ragged_dot_general scaled_dot",
    "it is broadcast_in_dim": "broadcast_like",
}
