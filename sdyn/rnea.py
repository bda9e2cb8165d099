"""Inverse dynamics by the recursive Newton-Euler algorithm, in the base's frame.

Outward, over the bodies:  V = V' + S q̇,  A = A' + S q̈ + V x S q̇,  f = I A + V x* I V − F
Inward:                    τ = S · f + ρ q̈,  f' += f
with V', A', f' those of the parent, F the applied wrench and ρ the rotor inertia.

Source: Featherstone, Rigid Body Dynamics Algorithms (2008), chapter 5, with link-frame transforms left out.
"""

import jax.numpy as jnp
from jax import lax

from sdyn.batching import Kernel
from sdyn.chain import BaseRow
from sdyn.materialise import keep
from sdyn.spatial import cat, dot, force_cross, inertia_times, motion_cross, rigid_inertia
from sdyn.sweep import (
    accelerated,
    add_to,
    base_inertia,
    batch_of,
    block,
    body_of,
    by_dof,
    by_step,
    move,
    poses_from,
    put,
    steps_of,
    storage,
    take,
    wrenches_of,
)


def _rnea(slot_index, slot_value, base_value, rotor, q, quat, V0, qd, a0, qdd, G, F):
    """Forces (f0 [6, B], tau [nv, B]) that cause the accelerations (a0, qdd).

    V0, a0: twist of the base, and the derivative of its components [6, B]. G: [0; gravity] in base axes [6, B], or
    empty. F: wrenches on the slots, base axes and origin [slots + 2, 6, B], or empty.
    """
    W, slots = slot_index.shape[2], slot_index.shape[1] * slot_index.shape[2]
    B = batch_of(slot_value, base_value, rotor, q, quat, V0, qd, a0, qdd, G, F)
    free = base_value[BaseRow.FREE]
    A0 = a0 * free - G if G.shape[0] else a0 * free
    V0 = V0 * free

    def force(m, h, Io, V, A, F):
        f = inertia_times(m, h, Io, A) + force_cross(V, keep(inertia_times(m, h, Io, V)))
        return f if F is None else f - F

    def outward(stored, x):
        x, qd, qdd, F = x
        parent = keep(take(stored, x.parent))
        R, p, S, Sqd, V = move(x, parent, qd)
        A = accelerated(parent, S, qdd, V, Sqd)
        f = keep(force(*keep(rigid_inertia(R, p, *body_of(x.value))), V, A, F))
        return put(stored, x.t, W, cat([R.reshape(9, W, -1), p, V, A])), (S, f)

    def inward(stored, x):
        (t, parent), (S, f) = x
        f = keep(f + block(stored, t, W))
        return add_to(stored, parent, f), dot(S, f)

    steps = steps_of(slot_index, slot_value, q, quat)
    by_slot, on_base = wrenches_of(slot_index, F)
    stored = poses_from(slots, B, slot_value.dtype, V0, A0)
    _, forces = lax.scan(outward, stored, (steps, by_step(slot_index, qd), by_step(slot_index, qdd), by_slot))
    at_base = force(*base_inertia(base_value), V0[:, None], A0[:, None], on_base)
    start = storage(slots, jnp.broadcast_to(at_base[:, 0], (6, B)))
    total, tau = lax.scan(inward, start, ((steps.t, steps.parent), forces), reverse=True)
    return total[slots] * free, by_dof(slot_index, tau, rotor.shape[0]) + rotor * qdd


def _adjoint(slot_index, slot_value, base_value, rotor, q, quat, V0, qd, a0, qdd, G, F, c0, c):
    """Gradient of c0 · f0 + c · τ with respect to (q, V0, qd, a0, qdd, G, F), by one outward and one inward sweep.

    With w the body velocities that (c0, c) would cause and s = S q̇:
        at each body   f = I A + V x* I V − F,  A* = I w,  B* = −w x* I V − I (V x w),  T* = w x* F
        inward         (f, A*, B* + s x* A*, T*) are added to the parent
        of q           −(S x w') · f − (S x V') · (B* + s x* A*) − (S x A') · A* − S · T*
        of q̇           S · B* − (S x V') · A*
        of q̈           S · A* + ρ c
        of F           −w
    """
    W, slots = slot_index.shape[2], slot_index.shape[1] * slot_index.shape[2]
    B = batch_of(slot_value, base_value, rotor, q, quat, V0, qd, a0, qdd, G, F, c0, c)
    free, wrench = base_value[BaseRow.FREE], F.shape[0] > 0
    V0, w0 = V0 * free, c0 * free
    A0 = a0 * free - G if G.shape[0] else a0 * free

    def local(m, h, Io, V, A, w, F):
        times = lambda x: inertia_times(m, h, Io, x)
        IV = keep(times(V))
        f = times(A) + force_cross(V, IV)
        rest = [times(w), -force_cross(w, IV) - times(keep(motion_cross(V, w)))]
        return cat([f - F, *rest, force_cross(w, F)] if wrench else [f, *rest])

    def outward(stored, x):
        x, qd, qdd, c, F = x
        parent = keep(take(stored, x.parent))
        R, p, S, Sqd, V = move(x, parent, qd)
        A = accelerated(parent, S, qdd, V, Sqd)
        w = keep(parent[24:30] + S * c)
        here = keep(local(*keep(rigid_inertia(R, p, *body_of(x.value))), V, A, w, F))
        return put(stored, x.t, W, cat([R.reshape(9, W, -1), p, V, A, w])), (S, parent[12:], here)

    def inward(stored, x):
        (t, parent), (S, before, here), qd = x
        here = keep(here + block(stored, t, W))
        f, A, Bv = here[:6], here[6:12], here[12:18]
        V, a, w = before[:6], before[6:12], before[12:]
        up, SV = keep(Bv + force_cross(S * qd, A)), keep(motion_cross(S, V))
        of_q = -(dot(motion_cross(S, w), f) + dot(SV, up) + dot(motion_cross(S, a), A))
        if wrench:
            of_q = of_q - dot(S, here[18:])
        out = (of_q, dot(S, Bv) - dot(SV, A), dot(S, A))
        return add_to(stored, parent, keep(cat([f, A, up, here[18:]]))), out

    steps = steps_of(slot_index, slot_value, q, quat)
    by_slot, on_base = wrenches_of(slot_index, F)
    rates = [by_step(slot_index, x) for x in (qd, qdd, c)]
    stored, bodies = lax.scan(outward, poses_from(slots, B, slot_value.dtype, V0, A0, w0), (steps, *rates, by_slot))
    motion = (jnp.broadcast_to(x[:, None], (6, 1, B)) for x in (V0, A0, w0))
    at_base = local(*base_inertia(base_value), *motion, on_base)
    total = storage(slots, at_base[:, 0])
    total, slopes = lax.scan(inward, total, ((steps.t, steps.parent), bodies, rates[0]), reverse=True)
    of_q, of_qd, of_qdd = (by_dof(slot_index, x, rotor.shape[0]) for x in slopes)
    A, Bv = total[slots, 6:12], total[slots, 12:18]
    of_F = -stored[:, 24:30] if wrench else jnp.zeros((0, 6, B), q.dtype)
    return of_q, Bv * free, of_qd, A * free, of_qdd + rotor * c, -A if G.shape[0] else G[:, :1] * jnp.ones(B), of_F


rnea_adjoint = Kernel(_adjoint)
STATE = (4, 6, 7, 8, 9, 10, 11)  # operands of rnea that the adjoint covers: q, V0, qd, a0, qdd, G, F


def _transpose(given):
    """The transpose of the tangent of rnea along the given operands; None where AD has to do."""
    if not all(i in STATE for i in given):
        return None

    def transpose(operands, cotangents):
        found = dict(zip(STATE, rnea_adjoint(*operands[:12], *cotangents), strict=True))
        return [found[i] for i, tangent in zip(given, operands[12:], strict=True) if tangent is None]

    return transpose


rnea = Kernel(_rnea, tangent_transpose=_transpose)
