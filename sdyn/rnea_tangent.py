"""Tangent of inverse dynamics τ = ID(q, V0, q̇, a0, q̈): one outward and one inward sweep for each column.

A change moves body i by the small motion ξ_i, and its axis by dS = ξ' x S, where ξ' is that of the parent:
    outward   ξ = ξ' + S dq,  dV = dV' + d(S q̇),  dA = dA' + d(S q̈) + dV x S q̇ + V x d(S q̇)
    force     df = ξ x* f + I (dA − ξ x A) + (dV − ξ x V) x* I V + V x* I (dV − ξ x V) + dI A + V x* dI V
    inward    dτ = dS · f + S · df,  df' += df

Source: the sweeps of `rnea.py`, differentiated by hand; the columns of a sample share its motion.
"""

import jax
import jax.numpy as jnp

from sdyn.chain import BaseRow, SlotRow, ValueRow
from sdyn.materialise import keep
from sdyn.rnea import force
from sdyn.rnea_motion import GEOMETRY, OPERANDS, Motion, motion_of
from sdyn.rotation import conjugate, product
from sdyn.spatial import cat, cross, dot, force_cross, inertia_times, mm, motion_cross, mv, rigid_inertia
from sdyn.spatial import transposed as tr
from sdyn.sweep import add_to, at, base_inertia, batch_of, block, body_of, inertia_at, inertia_of_base, put, take


def tangent(*operands, given, work):
    """(df0 [6, B], dtau [nv, B]) along tangents of the operands named."""
    x, d = dict(zip(OPERANDS, operands, strict=False)), dict(zip(given, operands[len(OPERANDS) :], strict=True))
    moving = [k for k in given if k in ("q", *GEOMETRY)]
    motion = motion_of(x, any(k in GEOMETRY for k in given), work)
    walk, bodies, W, nv = motion.walk, motion.bodies, motion.walk.width, x["rotor"].shape[0]
    B = batch_of(*(operands[k] for k in range(1, len(operands)) if k != 12), axes=2)
    free = x["base_value"][BaseRow.FREE]
    of = lambda k, t: walk.of_step(d[k], t)
    zero = jnp.zeros((6, *B), free.dtype)
    local = _displacements(x, d, motion, B) if [k for k in moving if k in GEOMETRY] else None
    heavier = _inertia_changes(d["slot_value"], motion) if "slot_value" in d else None

    def body_force(xi, dV, dA, V, A, IV, f, inertia, change):
        if moving:
            dV, dA = keep(dV - motion_cross(xi, V)), keep(dA - motion_cross(xi, A))
        df = keep(inertia_times(*inertia, dA)) + keep(force_cross(dV, IV))
        df = df + keep(force_cross(V, keep(inertia_times(*inertia, dV))))
        df = df + keep(force_cross(xi, f)) if moving else df
        return df if change is None else df + force(change, V, A)

    def outward(t, parents, stored):
        xis, dVs, dAs, *_ = stored
        S, V, A, IV, f = (block(y, t, W) for y in (bodies.S, motion.V, motion.A, motion.IV, motion.f))
        qd, qdd = walk.of_step(motion.qd, t), walk.of_step(motion.qdd, t)
        xi, dS = keep(take(xis, parents)), 0 * S
        if local:
            shift, direct = local(t, parents)
            xi = keep(xi + shift)
        if moving:
            dS = keep(motion_cross(xi, S) + direct if local else motion_cross(xi, S))
            xi = keep(xi + S * of("q", t)) if "q" in d else xi
        dSqd = keep(dS * qd + S * of("qd", t) if "qd" in d else dS * qd)
        dV = keep(take(dVs, parents) + dSqd)
        dA = take(dAs, parents) + keep(motion_cross(dV, S * qd)) + keep(motion_cross(V, dSqd)) + dS * qdd
        dA = keep(dA + S * of("qdd", t) if "qdd" in d else dA)
        change = heavier(t) if heavier else None
        df = body_force(xi, dV, dA, V, A, IV, f, inertia_at(bodies, t, W), change)
        return tuple(put(y, t, W, z) for y, z in zip(stored, (xi, dV, dA, dS + 0 * dV, df), strict=True))

    def inward(t, parents, stored):
        f, df, dtau = stored
        total, here = keep(block(f, t, W)), keep(block(df, t, W))
        found = dot(block(dSs, t, W), total) + dot(block(bodies.S, t, W), here)
        return add_to(f, parents, total), add_to(df, parents, here), walk.put_dof(dtau, t, found)

    dV0 = d["V0"] * free if "V0" in d else zero
    dA0 = d["a0"] * free if "a0" in d else zero
    dA0 = dA0 - d["G"] if "G" in d and d["G"].shape[0] else dA0
    rest = (y[walk.slots] for y in (motion.V, motion.A, motion.IV, motion.f))
    change = None
    if "base_value" in d:
        value, along = jnp.broadcast_arrays(x["base_value"], d["base_value"])
        _, change = jax.jvp(base_inertia, (value,), (along,))
    df0 = body_force(zero, dV0, dA0, *rest, inertia_of_base(walk, bodies), change)
    start = tuple(walk.empty(6, B, free.dtype, y) for y in (zero, dV0, dA0, zero, df0))
    _, _, _, dSs, df = walk.outward(outward, start)
    f = motion.f - x["F"] if x["F"].shape[0] else motion.f
    df = df - d["F"] if "F" in d and d["F"].shape[0] else df
    _, df, dtau = walk.inward(inward, (f, df, walk.dofs(nv, B, free.dtype)))
    dtau = dtau[:nv] + (d["rotor"] * x["qdd"] if "rotor" in d else 0)
    return df[walk.slots] * free, dtau + x["rotor"] * d["qdd"] if "qdd" in d else dtau


def _displacements(x, d, motion: Motion, B):
    """`(t, parents) -> (motion of the joint's frame, change of the axis in its body)`, where those are given."""
    joints, W = motion.joints, motion.walk.width
    turned = _quaternion_rates(x, d["quat"]) if "quat" in d and d["quat"].shape[0] else None
    change = d.get("slot_value")
    frame = lambda y: y.reshape(3, 3, *y.shape[1:])

    def local(t, parents):
        Rp, R, p = frame(take(motion.R, parents)), frame(block(motion.R, t, W)), block(motion.p, t, W)
        theta, shift, direct = (jnp.zeros((3, W, *B), p.dtype) for _ in range(3))
        direct = cat([direct, direct])
        if turned is not None:
            theta = theta + mv(R, at(turned, t))
        if change is not None:
            dC, (q, turn, sin, cos) = at(change, t), joints.turned(t)
            dL = dC[:9] + dC[9:18] * cos + dC[18:27] * sin
            s = mm(frame(dL), tr(turn))  # dL Lᵀ = hat(theta)
            spin = jnp.stack([s[2, 1] - s[1, 2], s[0, 2] - s[2, 0], s[1, 0] - s[0, 1]]) / 2
            theta = theta + mv(Rp, spin)
            shift = shift + mv(Rp, dC[ValueRow.POINT : ValueRow.SLIDE] + dC[ValueRow.SLIDE : ValueRow.AXIS] * q)
            a = mv(R, dC[ValueRow.AXIS : ValueRow.AXIS + 3])
            direct = direct + cat([a, mv(R, dC[ValueRow.AXIS + 3 : ValueRow.MASS]) + cross(p, a)])
        return keep(cat([theta, shift - cross(theta, p)])), keep(direct)

    return local


def _quaternion_rates(x, dquat):
    """Turns, child axes, of the spherical joints that start in each slot: 2 vec(q* o dq) / |q|² [T, 3, W, *B]."""
    quat, dquat = (jnp.swapaxes(y, 0, 1) for y in (x["quat"], dquat))
    theta = 2 * product(conjugate(quat), dquat)[1:] / dot(quat, quat)
    theta = cat([theta, jnp.zeros_like(theta[:, :1])], 1)
    return jnp.moveaxis(jnp.take(theta, x["slot_index"][SlotRow.QUAT], axis=1), 1, 0)


def _inertia_changes(change, motion: Motion):
    """`t -> (dm, dh, dIo)` of the bodies of a step."""
    W = motion.walk.width

    def changes(t):
        R, p = block(motion.R, t, W), block(motion.p, t, W)
        rigid = lambda m, c, I: rigid_inertia(R.reshape(3, 3, *R.shape[1:]), p, m, c, I)
        of, along = body_of(at(motion.joints.value, t)), body_of(at(change, t))
        pairs = [jnp.broadcast_arrays(y, z) for y, z in zip(of, along, strict=True)]
        return jax.jvp(rigid, *map(tuple, zip(*pairs, strict=True)))[1]

    return changes
