"""Inverse dynamics and its derivatives as kernels: the tangent and the adjoint are the transposes of each other."""

from functools import cache, partial

import jax
import jax.numpy as jnp

from sdyn.batching import Kernel
from sdyn.rnea import newton_euler
from sdyn.rnea_adjoint import adjoint
from sdyn.rnea_motion import OPERANDS
from sdyn.rnea_tangent import tangent


def _plain(kernel: Kernel):
    """The rule for second derivatives: AD of the same sweeps, started from the operands, not from what was saved."""

    def rule(primals, tangents):
        saved = OPERANDS.index("saved")
        bare = [jnp.zeros((0, 1, 1), x.dtype) if i == saved else x for i, x in enumerate(primals)]
        given = [i for i, t in enumerate(tangents) if t is not None and i != saved]

        def f(*xs):
            full = list(bare)
            for i, x in zip(given, xs, strict=True):
                full[i] = x
            return kernel(*full)

        if not given:
            out = kernel(*bare)
            return out, [jnp.zeros_like(y) for y in out]
        return jax.jvp(f, tuple(bare[i] for i in given), tuple(tangents[i] for i in given))

    return rule


@cache
def rnea_adjoint(parameters: bool) -> Kernel:
    """The kernel of the cotangents."""
    n = len(OPERANDS)
    fun = lambda *operands, work: adjoint(*operands, parameters=parameters, work=work)

    def transpose(operands, cotangents):
        given = [(k, x) for k, x in zip(OPERANDS[1:12], cotangents, strict=True) if x.size]
        found = rnea_tangent(tuple(k for k, _ in given))(*operands[:n], *(x for _, x in given))
        return [y for y, x in zip(found, operands[n:], strict=True) if x is None]

    options = dict(linear=(n, n + 1), grouped=True)
    return Kernel(fun, rule=_plain(Kernel(fun, **options)), transpose=transpose, **options)


@cache
def rnea_tangent(given: tuple[str, ...]) -> Kernel:
    """The kernel of the tangents along the operands named, which come last."""
    n, some = len(OPERANDS), len(given)
    fun = lambda *operands, work: tangent(*operands, given=given, work=work)

    def transpose(operands, cotangents):
        found = rnea_adjoint(any(k in ("slot_value", "base_value") for k in given))(*operands[:n], *cotangents)
        found = dict(zip(OPERANDS[1:12], found, strict=True))
        return [found[k] for k, x in zip(given, operands[n:], strict=True) if x is None]

    options = dict(linear=tuple(range(n, n + some)), grouped=True)
    return Kernel(fun, rule=_plain(Kernel(fun, **options)), transpose=transpose, **options)


def slope(primals, saved, tangents):
    """Tangents (df0, dtau) of inverse dynamics at `primals`, in the order of `OPERANDS`, None being none; or None."""
    given = [i for i, t in enumerate(tangents) if t is not None and t.size]
    if not given:
        return None
    kernel = rnea_tangent(tuple(OPERANDS[i] for i in given))
    return kernel(*primals, saved, *(tangents[i] for i in given))


def _rnea_rule(primals, tangents, link):
    out, none = rnea(*primals, link=link), jnp.zeros((0, 1, 1), primals[1].dtype)
    return out, slope(primals, none, tangents) or [jnp.zeros_like(y) for y in out]


@cache
def _rnea_kernel(link: bool) -> Kernel:
    return Kernel(partial(newton_euler, link=link), rule=partial(_rnea_rule, link=link))


def rnea(*operands, link=False):
    """Forces (f0 [6, B], tau [nv, B]), see `newton_euler`."""
    return _rnea_kernel(link)(*operands)
