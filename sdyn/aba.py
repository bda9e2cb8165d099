"""Forward dynamics by the articulated-body algorithm, and M⁻¹ b by the same sweeps at rest, in the base's frame.

Inward, over the bodies, with c = V x S q̇ and ρ the rotor inertia:
    U = IA S,  D = S · U + ρ,  u = τ − S · pA
    IA' += IA − U D⁻¹ Uᵀ,  pA' += pA + Ia c + U D⁻¹ u
Base:     IA₀ a₀ = −pA₀
Outward:  a = a' + c,  q̈ = D⁻¹ (u − U · a),  a += S q̈

Neither is differentiated by AD. Forward dynamics solves ID(q, v, v̇) = τ, so
    dv̇ = M⁻¹ (dτ − dID),  and  d(M⁻¹ b) = M⁻¹ (db − dM x),
with dID and dM x from inverse dynamics; the transpose of M⁻¹ is itself.

Source: Featherstone, Rigid Body Dynamics Algorithms (2008), section 7.3. In Jain's operators P = IA, G = U D⁻¹,
ε = u, ν = D⁻¹ u, z = pA.
"""

import jax
import jax.numpy as jnp
from jax import lax

from sdyn.batching import Kernel
from sdyn.chain import BaseRow
from sdyn.materialise import keep
from sdyn.rnea import rnea
from sdyn.spatial import (
    blocks_times,
    cat,
    dot,
    eye3,
    force_cross,
    hat,
    inertia_times,
    motion_cross,
    rigid_inertia,
    solve6,
)
from sdyn.sweep import (
    add_to,
    base_inertia,
    batch_of,
    block,
    body_of,
    by_dof,
    by_step,
    move,
    place,
    poses_from,
    put,
    steps_of,
    storage,
    take,
    wrenches_of,
)


def _aba(slot_index, slot_value, base_value, rotor, q, quat, V0, qd, f0, tau, G, F):
    """Accelerations (a0 [6, B], qdd [nv, B]); the operands as in `rnea`."""
    W, slots = slot_index.shape[2], slot_index.shape[1] * slot_index.shape[2]
    B = batch_of(slot_value, base_value, rotor, q, quat, V0, qd, f0, tau, G, F)
    free = base_value[BaseRow.FREE]
    V0 = V0 * free

    def bias(inertia, V, F):
        pA = force_cross(V, keep(inertia_times(*inertia, V)))
        return keep(pA if F is None else pA - F)

    def outward(stored, x):
        x, qd, F = x
        parent = keep(take(stored, x.parent))
        R, p, S, Sqd, V = move(x, parent, qd)
        inertia = keep(rigid_inertia(R, p, *body_of(x.value)))
        c = keep(motion_cross(V, Sqd))
        return put(stored, x.t, W, cat([R.reshape(9, W, -1), p, V])), (S, inertia, bias(inertia, V, F), c)

    steps = steps_of(slot_index, slot_value, q, quat)
    by_slot, on_base = wrenches_of(slot_index, F)
    stored = poses_from(slots, B, slot_value.dtype, V0)
    _, bodies = lax.scan(outward, stored, (steps, by_step(slot_index, qd), by_slot))
    base = base_inertia(base_value)
    pA0 = bias(base, V0[:, None], on_base)[:, 0] - f0 * free
    start = -G * (1 - free) if G.shape[0] else None
    a0, qdd = _solve(slot_index, steps, bodies, base, pA0, by_step(slot_index, tau), rotor, free, start, B)
    return (a0 + G if G.shape[0] else a0) * free, qdd


def _mass_solve(slot_index, slot_value, base_value, rotor, q, quat, b0, b):
    """x of M x = b, as (x0 [6, B], x [nv, B])."""
    W, slots = slot_index.shape[2], slot_index.shape[1] * slot_index.shape[2]
    B = batch_of(slot_value, base_value, rotor, q, quat, b0, b)
    free = base_value[BaseRow.FREE]

    def outward(stored, x):
        R, p, S = place(x, keep(take(stored, x.parent)))
        inertia = keep(rigid_inertia(R, p, *body_of(x.value)))
        return put(stored, x.t, W, cat([R.reshape(9, W, -1), p])), (S, inertia, None, None)

    steps = steps_of(slot_index, slot_value, q, quat)
    _, bodies = lax.scan(outward, poses_from(slots, B, slot_value.dtype), steps)
    base = base_inertia(base_value)
    x0, x = _solve(slot_index, steps, bodies, base, -b0 * free, by_step(slot_index, b), rotor, free, None, B)
    return x0 * free, x


def _solve(slot_index, steps, bodies, base, pA0, tau, rotor, free, start, B):
    """The inward sweep, the base, and the last outward sweep. `start` is the acceleration of a grounded base."""
    W, slots, dtype = slot_index.shape[2], slot_index.shape[1] * slot_index.shape[2], pA0.dtype
    moving = bodies[2] is not None

    def inward(stored, x):
        (t, parent), (S, (m, h, Io), pA, c), tau, rotor = x
        A, H, M, P = (block(s, t, W) for s in stored)
        A, H, M = keep((Io + A, hat(h) + H, m * eye3(h) + M))
        pA = keep(P + pA) if moving else keep(P)
        U = keep(blocks_times(A, H, M, S))
        D = keep(1 / (dot(S, U) + rotor))
        u, G = keep(((tau - dot(S, pA)) * D, U * D))
        pa = pA + U * (u - dot(G, c)) + blocks_times(A, H, M, c) if moving else pA + U * u
        less = lambda X, a, b: X - a[:, None] * b[None]
        out = (less(A, G[:3], U[:3]), less(H, G[:3], U[3:]), less(M, G[3:], U[3:]), pa)
        return tuple(add_to(s, parent, x) for s, x in zip(stored, out, strict=True)), (G, u)

    def outward(stored, x):
        parent, t, S, c, G, u = x
        a = keep(take(stored, parent) + c if moving else take(stored, parent))
        qdd = keep(u - dot(G, a))
        return put(stored, t, W, a + S * qdd), qdd

    m, h, Io = base
    held = eye3(h) * (1 - free)  # a grounded base may have no mass
    blocks = (Io + held, hat(h) + 0 * held, m * eye3(h) + held)
    wide = lambda x: storage(slots, jnp.broadcast_to(x, (*x.shape[:-1], B)))
    stored = (*(wide(x[..., 0, :]) for x in blocks), wide(pA0))
    nv, rotor = rotor.shape[0], by_step(slot_index, rotor)
    (A, H, M, P), (G, u) = lax.scan(inward, stored, ((steps.t, steps.parent), bodies, tau, rotor), reverse=True)
    a0 = -solve6(A[slots], H[slots], M[slots], P[slots])
    at_base = a0 * free if start is None else a0 * free + start
    S, c = bodies[0], bodies[3]
    _, qdd = lax.scan(outward, storage(slots, at_base.astype(dtype)), (steps.parent, steps.t, S, c, G, u))
    return a0, by_dof(slot_index, qdd, nv)


# ---- derivatives -----------------------------------------------------------------------------------------------------


def _slope(function, operands, tangents):
    """Tangent of `function` along the tangents that are given; None if none is."""
    at = [i for i, t in enumerate(tangents) if t is not None]
    if not at:
        return None

    def f(*xs):
        full = list(operands)
        for i, x in zip(at, xs, strict=True):
            full[i] = x
        return function(*full)

    return jax.jvp(f, tuple(operands[i] for i in at), tuple(tangents[i] for i in at))[1]


def _difference(b, slope, like):
    """b − slope, either of which may be None."""
    b = tuple(jnp.zeros_like(y) if x is None else x for x, y in zip(b, like, strict=True))
    return b if slope is None else tuple(x - y for x, y in zip(b, slope, strict=True))


def _aba_tangent(operands, tangents, out):
    """dv̇ = M⁻¹ (dτ − dID(q, v, v̇))."""
    index, f0, tau = operands[0], operands[8], operands[9]
    residual = lambda sv, bv, rotor, q, quat, V0, qd, G, F: rnea(index, sv, bv, rotor, q, quat, V0, qd, *out, G, F)
    keep_of = lambda x: (*x[1:8], *x[10:])
    slope = _slope(residual, keep_of(operands), keep_of(tangents))
    return mass_solve(*operands[:6], *_difference(tangents[8:10], slope, (f0, tau)))


def _mass_solve_tangent(operands, tangents, out):
    """dx = M⁻¹ (db − dM x)."""
    index, like = operands[0], operands[6:]
    rest, none = tuple(jnp.zeros_like(x) for x in out), jnp.zeros((0, 1), out[0].dtype)
    weight = lambda sv, bv, rotor, q, quat: rnea(index, sv, bv, rotor, q, quat, *rest, *out, none, none[..., None])
    return mass_solve(*operands[:6], *_difference(tangents[6:], _slope(weight, operands[1:6], tangents[1:6]), like))


def _mass_solve_transpose(operands, cotangents):
    """M is symmetric: the cotangent of b is M⁻¹ of that of x."""
    found = mass_solve(*operands[:6], *cotangents)
    return [x for x, b in zip(found, operands[6:], strict=True) if b is None]


aba = Kernel(_aba, rule=_aba_tangent)
mass_solve = Kernel(_mass_solve, rule=_mass_solve_tangent, linear=(6, 7), transpose=_mass_solve_transpose)
