"""Kernels whose batch axis comes last, behind functions that are written for one sample.

XLA on a CPU runs a sweep several times faster when the batch is the last, contiguous axis; `jax.vmap` puts it first.
So every kernel is one JAX primitive. Its operands are arrays `(..., B)`, or `(..., 1)` where a batch shares them;
`vmap` folds each new axis into B, and an operand that is not batched stays as it is. Integer operands (the topology)
have no batch axis: where they are batched (`family`), the structures are run one after the other.

Derivatives are kernels too, made by AD of the kernel's function or by its own `rule`, so they batch alike.
`custom_vmap` (no reverse mode) and `linear_call` (no batching) cannot do this.
"""

from functools import cache, cached_property

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


class Kernel:
    """A function of arrays `(..., B)` that returns a tuple of such arrays.

    Args:
        fun: The function; differentiable by JAX unless `rule` is given.
        rule: `(primals, tangents, outputs) -> output tangents`, a tangent being None where it is zero.
        linear: Positions of operands in which `fun` is linear; with `transpose`, or by AD.
        transpose: `(operands, cotangents) -> cotangents of the linear operands`, which have None in their places.
        expand: Positions of operands that set the shape of outputs, so that a batch may not share them.
        tangent_transpose: `(positions with a tangent) -> transpose` of the kernel's tangent, or None for AD.
    """

    def __init__(self, fun, *, rule=None, linear=(), transpose=None, expand=(), tangent_transpose=None):
        self.fun, self.rule, self.linear, self.transpose, self.expand = fun, rule, linear, transpose, expand
        self.tangent_transpose = tangent_transpose

    def __call__(self, *operands):
        return tuple(_primitive.bind(*operands, kernel=self))

    @cached_property
    def jitted(self):
        return jax.jit(self.fun)


_primitive = Primitive("sdyn_kernel")
_primitive.multiple_results = True
_primitive.def_impl(lambda *operands, kernel: kernel.jitted(*operands))
mlir.register_lowering(
    _primitive, mlir.lower_fun(lambda *operands, kernel: kernel.fun(*operands), multiple_results=True)
)


def _is_index(x) -> bool:
    return not jnp.issubdtype(x.dtype, jnp.floating)


@_primitive.def_abstract_eval
def _abstract(*operands, kernel):
    shaped = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in operands]
    return [jax.core.ShapedArray(x.shape, x.dtype) for x in jax.eval_shape(kernel.fun, *shaped)]


# ---- vmap ------------------------------------------------------------------------------------------------------------


def _batch(operands, dims, *, kernel):
    if any(d is not None and _is_index(x) for x, d in zip(operands, dims, strict=True)):
        return _one_by_one(operands, dims, kernel)
    n = next(x.shape[d] for x, d in zip(operands, dims, strict=True) if d is not None)
    single = [x if d is None else jax.ShapeDtypeStruct((*x.shape[:d], *x.shape[d + 1 :]), x.dtype)
              for x, d in zip(operands, dims, strict=True)]  # fmt: skip
    B = max((x.shape[-1] for x in single if not _is_index(x)), default=1)

    def fold(i, x, d):  # (..., b) and the new axis -> (..., B n), b being 1 or B
        if _is_index(x) or (d is None and x.shape[-1] == 1 and i not in kernel.expand):
            return x
        x = x[..., None] if d is None else jnp.moveaxis(x, d, -1)
        return jnp.broadcast_to(x, (*x.shape[:-2], B, n)).reshape(*x.shape[:-2], B * n)

    folded = [fold(i, x, d) for i, (x, d) in enumerate(zip(operands, dims, strict=True))]
    out = _primitive.bind(*folded, kernel=kernel)
    want = [x.shape[-1] for x in jax.eval_shape(kernel.fun, *single)]

    def unfold(y, b):  # (..., B n) -> (..., b, n); the sum is the cotangent of an operand that B shared
        y = jnp.broadcast_to(y, (*y.shape[:-1], B * n)).reshape(*y.shape[:-1], B, n)
        return y if b == B else y.sum(-2, keepdims=True)

    out = [unfold(y, b) for y, b in zip(out, want, strict=True)]
    return out, [y.ndim - 1 for y in out]


def _one_by_one(operands, dims, kernel):
    batched = tuple(jnp.moveaxis(x, d, 0) for x, d in zip(operands, dims, strict=True) if d is not None)

    def one(xs):
        xs = iter(xs)
        full = [x if d is None else next(xs) for x, d in zip(operands, dims, strict=True)]
        return tuple(_primitive.bind(*full, kernel=kernel))

    out = lax.map(one, batched)
    return out, [0] * len(out)


batching.primitive_batchers[_primitive] = _batch


# ---- derivatives -----------------------------------------------------------------------------------------------------


def _jvp(primals, tangents, *, kernel):
    out = _primitive.bind(*primals, kernel=kernel)
    given = tuple(not isinstance(t, ad.Zero) and t.dtype != jax.dtypes.float0 for t in tangents)
    if kernel.rule is not None:
        slopes = kernel.rule(primals, [t if g else None for t, g in zip(tangents, given, strict=True)], out)
    elif all(i in kernel.linear for i, g in enumerate(given) if g) and all(given[i] for i in kernel.linear):
        along = (t if g else p for p, t, g in zip(primals, tangents, given, strict=True))
        slopes = _primitive.bind(*along, kernel=kernel)
    else:
        along = (t for t, g in zip(tangents, given, strict=True) if g)
        slopes = _primitive.bind(*primals, *along, kernel=_tangent(kernel, given))
    return out, list(slopes)


@cache
def _tangent(kernel, given) -> Kernel:
    """The kernel `(primals, tangents of the given ones) -> tangents of the outputs`, linear in the latter."""
    n = len(given)
    positions = [i for i in range(n) if given[i]]

    def fun(*operands):
        def f(*xs):
            full = list(operands[:n])
            for i, x in zip(positions, xs, strict=True):
                full[i] = x
            return tuple(kernel.fun(*full))

        # a batch may share the operand and not the tangent, or the other way round
        pairs = [jnp.broadcast_arrays(operands[i], t) for i, t in zip(positions, operands[n:], strict=True)]
        return jax.jvp(f, *map(tuple, zip(*pairs, strict=True)))[1]

    everything = tuple(range(n + len(positions)))
    transpose = kernel.tangent_transpose(positions) if kernel.tangent_transpose else None
    return Kernel(fun, linear=everything[n:], transpose=transpose, expand=everything if kernel.expand else ())


def _transpose(cotangents, *operands, kernel):
    free = tuple(ad.is_undefined_primal(x) for x in operands)
    cotangents = [ad.instantiate_zeros(c) for c in cotangents]
    if kernel.transpose is not None:
        found = kernel.transpose([None if f else x for x, f in zip(operands, free, strict=True)], cotangents)
        shapes = [x.aval.shape for x, f in zip(operands, free, strict=True) if f]
        found = [_shared(c, shape) for c, shape in zip(found, shapes, strict=True)]
    else:
        given = [x for x, f in zip(operands, free, strict=True) if not f]
        like = [jnp.zeros(x.aval.shape, x.aval.dtype) for x, f in zip(operands, free, strict=True) if f]
        found = _primitive.bind(*given, *like, *cotangents, kernel=_adjoint(kernel, free, len(cotangents)))
    found = iter(found)
    return [next(found) if f else None for f in free]


def _shared(cotangent, shape):
    """The sum over the batch, where the batch shared the operand."""
    return cotangent if cotangent.shape == shape else cotangent.sum(-1, keepdims=True)


@cache
def _adjoint(kernel, free, outputs: int) -> Kernel:
    """The kernel `(other operands, zeros like the free ones, output cotangents) -> cotangents of the free ones`."""
    given = [i for i, f in enumerate(free) if not f]
    wanted = [i for i, f in enumerate(free) if f]

    def fun(*operands):
        full = [None] * len(free)
        for i, x in zip(given, operands, strict=False):
            full[i] = x
        for i in kernel.linear:  # linear operands with a known value do not matter for the slope
            full[i] = None if free[i] else jnp.zeros_like(full[i])
        like = operands[len(given) : len(free)]

        def f(*xs):
            at = list(full)
            for i, x in zip(wanted, xs, strict=True):
                at[i] = x
            return tuple(kernel.fun(*at))

        cotangents = operands[len(free) :]
        wide = [jnp.broadcast_to(c, y.shape) for c, y in zip(cotangents, jax.eval_shape(f, *like), strict=True)]
        return tuple(jax.linear_transpose(f, *like)(tuple(wide)))

    n, shapes = len(free), tuple(range(len(given), len(free)))
    return Kernel(fun, linear=tuple(range(n, n + outputs)), expand=tuple(range(n)) if kernel.expand else shapes)


ad.primitive_jvps[_primitive] = _jvp
ad.primitive_transposes[_primitive] = _transpose
