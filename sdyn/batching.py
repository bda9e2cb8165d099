"""Kernels whose batch axis comes last, behind functions that are written for one sample.

XLA on a CPU runs a sweep several times faster when the batch is the last, contiguous axis; `jax.vmap` puts it first.
So every kernel is one JAX primitive. Its operands are arrays `(..., B)`, or `(..., 1)` where a batch shares them;
`vmap` folds each new axis into B, and an operand that is not batched stays as it is. Integer operands (the topology)
have no batch axis: where they are batched (`family`), the structures are run one after the other.

A `grouped` kernel works on columns, the tangents or cotangents of samples. Its operands may also be `(..., s)`, where
s divides B: the batch is B/s columns of s samples each, the samples contiguous, and the columns share what belongs to
the sample. So a Jacobian under `vmap` computes what depends on the sample once.

Derivatives are kernels too, made by AD of the kernel's function or by its own `rule`, so they batch alike.
`custom_vmap` (no reverse mode) and `linear_call` (no batching) cannot do this.
"""

import math
from functools import cache, cached_property, partial

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from sdyn.workspace import Workspace

BLOCKS, CACHE = (8, 128), 5 << 20
"""Samples or columns that a CPU works on at once, at least and at most: long rows, and storages that fit a cache
[bytes]. Measured: chains of 100 to 1000 joints are each within a fifth of their best block."""
FEW = (2, 6)
"""Samples, and columns of them, for which a kernel is traced to learn shapes."""


class Kernel:
    """A function of arrays `(..., B)` that returns a tuple of such arrays.

    Args:
        fun: The function, differentiable by JAX unless `rule` is given. That of a grouped kernel gets arrays
            `(..., columns, s)`. One with integer operands is called with `work`, a `Workspace`.
        rule: `(primals, tangents) -> outputs, output tangents`, a tangent being None where it is zero.
        linear: Positions of operands in which `fun` is linear; with `transpose`, or by AD.
        transpose: `(operands, cotangents) -> cotangents of the linear operands`, which have None in their places.
        expand: Positions of operands that set the shape of outputs, so that a batch may not share them.
        grouped: Whether operands may belong to a sample that several columns share.
    """

    def __init__(self, fun, *, rule=None, linear=(), transpose=None, expand=(), grouped=False):
        self.fun, self.rule, self.linear, self.transpose = fun, rule, linear, transpose
        self.expand, self.grouped = expand, grouped

    def __call__(self, *operands):
        return tuple(_primitive.bind(*operands, kernel=self))

    def apply(self, *operands, work: Workspace):
        """`fun` of operands as it wants them."""
        return self.fun(*operands, **({"work": work} if any(map(_is_index, operands)) else {}))

    def run(self, *operands, work: Workspace | None = None):
        """The outputs, in one piece."""
        work = work or Workspace()
        if not self.grouped:
            return self.apply(*operands, work=work)
        s, B = _sizes(operands)
        found = self.apply(*(_columns(x, s, B) for x in operands), work=work)
        return tuple(jnp.broadcast_to(y, (*y.shape[:-2], B // s, s)).reshape(*y.shape[:-2], B) for y in found)

    @cached_property
    def jitted(self):
        return jax.jit(self.__call__)


_primitive = Primitive("sdyn_kernel")
_primitive.multiple_results = True
_primitive.def_impl(lambda *operands, kernel: kernel.jitted(*operands))
mlir.register_lowering(
    _primitive, mlir.lower_fun(lambda *operands, kernel: kernel.run(*operands), multiple_results=True)
)


def _is_index(x) -> bool:
    return not jnp.issubdtype(x.dtype, jnp.floating)


@_primitive.def_abstract_eval
def _abstract(*operands, kernel):
    return [jax.core.ShapedArray(x.shape, x.dtype) for x in _shaped(kernel, operands)]


def _shaped(kernel, operands):
    """Shapes and types of the outputs."""
    (out, _), real, _ = _seen_in_few(kernel, operands)
    return [jax.ShapeDtypeStruct((*x.shape[:-1], real[x.shape[-1]]), x.dtype) for x in out]


def _storages(kernel, operands):
    """Shapes and types of the storages that the kernel asks for."""
    (_, stored), real, columns = _seen_in_few(kernel, operands)
    lead = lambda shape: (*shape[:-2], columns[shape[-2]]) if kernel.grouped else shape[:-1]
    return [jax.ShapeDtypeStruct((*lead(x.shape), real[x.shape[-1]]), x.dtype) for x in stored]


def _seen_in_few(kernel, operands):
    """What FEW samples and columns are to a kernel, and the sizes and numbers of columns for which theirs stand.

    Shapes of larger batches differ in these alone, and tracing a kernel costs far more than it says about shapes.
    """
    s, B = _sizes(operands)
    few = {s: FEW[0], B: FEW[0] if s == B else FEW[1], 1: 1}
    size = lambda x: x.shape if _is_index(x) else (*x.shape[:-1], few.get(x.shape[-1], FEW[0]))
    seen = _seen(kernel, *((size(x), x.dtype) for x in operands))
    return seen, {few[n]: n for n in few}, {FEW[1] // FEW[0]: B // s, 1: 1}


@cache
def _seen(kernel, *sizes):
    """Shapes and types of outputs and storages."""
    work = Workspace()
    out = jax.eval_shape(partial(kernel.run, work=work), *(jax.ShapeDtypeStruct(*size) for size in sizes))
    return out, [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in work.storages]


# ---- columns of samples ----------------------------------------------------------------------------------------------


def _sizes(operands) -> tuple[int, int]:
    """Samples s, and columns of them B, a multiple of s."""
    sizes = {x.shape[-1] for x in operands if not _is_index(x)}
    B = max(sizes)
    return max(sizes - {B}, default=B) if len(sizes - {1}) > 1 else B, B


def _columns(x, s: int, B: int):
    """(..., 1), (..., s) or (..., B) -> (..., columns, samples), with 1 where they are shared."""
    if _is_index(x):
        return x
    size = x.shape[-1]
    if size not in (1, s, B):  # shared by the samples too, in part
        x, size = jnp.tile(x, s // size), s
    return x.reshape(*x.shape[:-1], B // s, s) if size == B else x[..., None, :]


# ---- blocks ----------------------------------------------------------------------------------------------------------


def _blocked(*operands, kernel):
    """On a CPU: blocks of the batch that fit the cache, one after the other.

    XLA makes one function of a loop and of all that is in it. Outside of loops it starts each operation by itself,
    which costs more than a small one takes; so a single block is a loop too, of a length that XLA does not know.
    """
    shaped = _shaped(kernel, operands)
    s, B = _sizes(operands) if kernel.grouped else (math.inf, max(x.shape[-1] for x in shaped))
    s = min(s, B)
    most = _lanes(kernel, operands, B)
    b = _even(s, most)
    k = _even(B // s, max(1, most // b))

    def part(x, corner):
        if _is_index(x) or x.shape[-1] == 1:
            return x
        if x.shape[-1] == s:
            return lax.dynamic_slice_in_dim(x, corner[1], b, x.ndim - 1)
        at = (*(0,) * (x.ndim - 1), *corner)
        return lax.dynamic_slice(_columns(x, s, B), at, (*x.shape[:-1], k, b)).reshape(*x.shape[:-1], k * b)

    def body(i, carry):
        out, stored = carry
        i, now = lax.optimization_barrier((i, operands))  # or XLA moves what all blocks share in front of the loop
        i, j = i // -(-s // b), i % -(-s // b)
        corner = jnp.minimum(i * k, B // s - k), jnp.minimum(j * b, s - b)
        work = Workspace(given=stored)

        def put(whole, y):
            y = y.reshape(*y.shape[:-1], k, b)
            return lax.dynamic_update_slice(whole, y, (*(0,) * (y.ndim - 2), *corner))

        found = kernel.run(*(part(x, corner) for x in now), work=work)
        return tuple(put(x, y) for x, y in zip(out, found, strict=True)), tuple(work.storages)

    def all_blocks(_, out):
        stored = tuple(lax.empty(x.shape, x.dtype) for x in wanted)
        return lax.fori_loop(0, blocks, body, (out, stored))[0]

    wanted = _storages(kernel, [jax.eval_shape(part, x, (0, 0)) for x in operands])
    blocks, one = -(-s // b) * -(-(B // s) // k), 1
    for index in filter(_is_index, operands):
        blocks, one = jnp.where(index.ravel()[0] >= 0, blocks, 0), jnp.where(index.ravel()[0] >= 0, one, 0)
    empty = tuple(jnp.zeros((*x.shape[:-1], B // s, s), x.dtype) for x in shaped)
    return tuple(y.reshape(x.shape) for x, y in zip(shaped, lax.fori_loop(0, one, all_blocks, empty), strict=True))


def _lanes(kernel, operands, B) -> int:
    """Size of a block, a power of two, whose storages fit the cache."""
    each, (least, most) = sum(x.size * x.dtype.itemsize for x in _storages(kernel, operands)) / B, BLOCKS
    while most > least and most * each > CACHE:
        most //= 2
    return most


def _even(n: int, most: int) -> int:
    """Size of a block, so that as few blocks as can be are about equal."""
    return -(-n // -(-n // most))


mlir.register_lowering(_primitive, mlir.lower_fun(_blocked, multiple_results=True), platform="cpu")


# ---- vmap ------------------------------------------------------------------------------------------------------------


def _batch(operands, dims, *, kernel):
    if any(d is not None and _is_index(x) for x, d in zip(operands, dims, strict=True)):
        return _one_by_one(operands, dims, kernel)
    n = next(x.shape[d] for x, d in zip(operands, dims, strict=True) if d is not None)
    single = [x if d is None else jax.ShapeDtypeStruct((*x.shape[:d], *x.shape[d + 1 :]), x.dtype)
              for x, d in zip(operands, dims, strict=True)]  # fmt: skip
    B = max((x.shape[-1] for x in single if not _is_index(x)), default=1)
    shared = [d is None and i not in kernel.expand and (i not in kernel.linear or x.shape[-1] == 1)
              for i, (x, d) in enumerate(zip(operands, dims, strict=True))]  # fmt: skip
    # the new axis comes last, or before the samples that its columns share
    columns = kernel.grouped and any(s and not _is_index(x) and x.shape[-1] > 1
                                     for s, x in zip(shared, operands, strict=True))  # fmt: skip

    def fold(x, d, shared):  # (..., b) and the new axis -> (..., B n) or less
        if _is_index(x) or (shared and (columns or x.shape[-1] == 1)):
            return x
        x = jnp.broadcast_to(x[..., None], (*x.shape, n)) if d is None else jnp.moveaxis(x, d, -1)
        *lead, b, _ = x.shape
        if columns:
            x = jnp.swapaxes(x, -1, -2)
            return jnp.tile(x, B // b).reshape(*lead, n * B)
        if kernel.grouped and b == 1:
            return x.reshape(*lead, n)
        x = jnp.tile(x, (B // b, 1)) if b > 1 else jnp.broadcast_to(x, (*lead, B, n))
        return x.reshape(*lead, B * n)

    folded = [fold(x, d, s) for x, d, s in zip(operands, dims, shared, strict=True)]
    out = _primitive.bind(*folded, kernel=kernel)
    want = [1] * len(out) if B == 1 else [x.shape[-1] for x in _shaped(kernel, single)]

    def unfold(y, b):  # the sum is the cotangent of an operand that B shared
        if columns:
            y = jnp.swapaxes(jnp.broadcast_to(y, (*y.shape[:-1], n * B)).reshape(*y.shape[:-1], n, B), -1, -2)
        else:
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
    given = tuple(not isinstance(t, ad.Zero) and t.dtype != jax.dtypes.float0 for t in tangents)
    tangents = [t if g else None for t, g in zip(tangents, given, strict=True)]
    if kernel.linear and all(i in kernel.linear for i, g in enumerate(given) if g):
        out = _primitive.bind(*primals, kernel=kernel)
        along = [jnp.zeros_like(x) if i in kernel.linear and t is None else x if t is None else t
                 for i, (x, t) in enumerate(zip(primals, tangents, strict=True))]  # fmt: skip
        slopes = _primitive.bind(*along, kernel=kernel)
    elif kernel.rule is not None:
        out, slopes = kernel.rule(primals, tangents)
    else:
        out = _primitive.bind(*primals, kernel=kernel)
        slopes = _tangent(kernel, given)(*primals, *(t for t in tangents if t is not None))
    return list(out), list(slopes)


@cache
def _tangent(kernel, given) -> Kernel:
    """The kernel `(primals, tangents of the given ones) -> tangents of the outputs`, linear in the latter."""
    n = len(given)
    positions = [i for i in range(n) if given[i]]

    def fun(*operands, work=None):
        def f(*xs):
            full = list(operands[:n])
            for i, x in zip(positions, xs, strict=True):
                full[i] = x
            return tuple(kernel.apply(*full, work=Workspace(work is not None and work.whole)))

        # a batch may share the operand and not the tangent, or the other way round
        pairs = [jnp.broadcast_arrays(operands[i], t) for i, t in zip(positions, operands[n:], strict=True)]
        return jax.jvp(f, *map(tuple, zip(*pairs, strict=True)))[1]

    everything = tuple(range(n + len(positions)))
    expand = everything if kernel.expand else ()
    return Kernel(fun, linear=everything[n:], expand=expand, grouped=kernel.grouped)


def _transpose(cotangents, *operands, kernel):
    free = tuple(ad.is_undefined_primal(x) for x in operands)
    cotangents = [ad.instantiate_zeros(c) for c in cotangents]
    shapes = [x.aval.shape for x, f in zip(operands, free, strict=True) if f]
    if kernel.transpose is not None:
        found = kernel.transpose([None if f else x for x, f in zip(operands, free, strict=True)], cotangents)
    else:
        given = [x for x, f in zip(operands, free, strict=True) if not f]
        _, B = _sizes([*given, *cotangents])
        like = [jnp.zeros((*x.aval.shape[:-1], B), x.aval.dtype) for x, f in zip(operands, free, strict=True) if f]
        found = _adjoint(kernel, free, len(cotangents))(*given, *like, *cotangents)
    found = iter([_shared(c, shape) for c, shape in zip(found, shapes, strict=True)])
    return [next(found) if f else None for f in free]


def _shared(cotangent, shape):
    """The sum over the columns or samples that shared the operand."""
    s = shape[-1]
    return cotangent if cotangent.shape == shape else cotangent.reshape(*shape[:-1], -1, s).sum(-2)


@cache
def _adjoint(kernel, free, outputs: int) -> Kernel:
    """The kernel `(other operands, zeros like the free ones, output cotangents) -> cotangents of the free ones`."""
    given = [i for i, f in enumerate(free) if not f]
    wanted = [i for i, f in enumerate(free) if f]

    def fun(*operands, work=None):
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
            return tuple(kernel.apply(*at, work=Workspace(whole=True)))

        cotangents = operands[len(free) :]
        wide = [jnp.broadcast_to(c, y.shape) for c, y in zip(cotangents, jax.eval_shape(f, *like), strict=True)]
        return tuple(jax.linear_transpose(f, *like)(tuple(wide)))

    n, shapes = len(free), tuple(range(len(given), len(free)))
    expand = tuple(range(n)) if kernel.expand else shapes
    return Kernel(fun, linear=tuple(range(n, n + outputs)), expand=expand, grouped=kernel.grouped)


ad.primitive_jvps[_primitive] = _jvp
ad.primitive_transposes[_primitive] = _transpose
