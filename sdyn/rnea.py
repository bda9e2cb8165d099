"""Inverse dynamics by the recursive Newton-Euler algorithm, in the base's frame or in the links' own.

Outward, over the bodies:  V = V' + S q̇,  A = A' + S q̈ + V x S q̇,  f = I A + V x* I V − F
Inward:                    τ = S · f + ρ q̈,  f' += f
with V', A', f' those of the parent, F the applied wrench and ρ the rotor inertia.

Source: Featherstone, Rigid Body Dynamics Algorithms (2008), chapter 5; in the common frame without transforms.
"""

import jax.numpy as jnp

from sdyn.chain import BaseRow
from sdyn.materialise import keep
from sdyn.spatial import dot, force_cross, inertia_times, mtv, to_parent, transposed
from sdyn.sweep import (
    Bodies,
    Joints,
    Walk,
    add_to,
    batch_of,
    block,
    bodies_of,
    hinge,
    inertia_at,
    inertia_of_base,
    joints_of,
    moved,
    placed,
    up,
    walk_of,
)


def newton_euler(slot_index, slot_value, base_value, rotor, q, quat, V0, qd, a0, qdd, G, F, *, work, link=False):
    """Forces (f0 [6, B], tau [nv, B]) that cause the accelerations (a0, qdd).

    V0, a0: twist of the base, and the derivative of its components [6, B]. G: [0; gravity] in base axes [6, B], or
    empty. F: wrenches on the slots, base axes and origin [slots + 2, 6, B], or empty. link: Compute in the links' own
    frames.
    """
    B = batch_of(slot_value, base_value, rotor, q, quat, V0, qd, a0, qdd, G, F)
    free, walk = base_value[BaseRow.FREE], walk_of(slot_index, work)
    joints = joints_of(walk, slot_index, slot_value, q, quat, link)
    R, p, bodies = bodies_of(walk, joints, base_value, B)
    A0 = a0 * free - G if G.shape[0] else a0 * free
    hinges = (R, p) if link else None
    f = body_forces(walk, bodies, V0 * free, qd, A0, qdd, B, hinges)
    f = loaded(walk, joints, f, F, B)
    f0, tau = joint_forces(walk, bodies.S, f, rotor.shape[0], hinges)
    return f0 * free, tau + rotor * qdd


def loaded(walk: Walk, joints: Joints, f, F, B: tuple):
    """Forces f of the bodies less the wrenches F on them, which are in the base's frame."""
    if F.shape[0] == 0:
        return f
    if joints.link:
        R, p, _ = placed(walk, joints._replace(link=False), B)
        R, p, F = (jnp.moveaxis(x, 0, 1) for x in (R, p, jnp.broadcast_to(F, f.shape)))
        R = R.reshape(3, 3, *p.shape[1:])
        F = jnp.moveaxis(to_parent(transposed(R), -mtv(R, p), F), 1, 0)  # the base, seen from the link
    return f - F


def joint_forces(walk: Walk, S, f, nv: int, hinges=None):
    """The total force (f0 [6, B], tau [nv, B]) that reaches the base and each joint from the forces of the bodies."""
    W = walk.width

    def inward(t, parents, stored):
        f, tau = stored
        here = keep(block(f, t, W))
        tau = walk.put_dof(tau, t, dot(block(S, t, W), here))
        return add_to(f, parents, up(hinge(hinges, t, W), here)), tau

    f, tau = walk.inward(inward, (f, walk.dofs(nv, f.shape[2:], f.dtype)))
    return f[walk.slots], tau[:nv]


def body_forces(walk: Walk, bodies: Bodies, V0, qd, A0, qdd, B: tuple, hinges=None):
    """The force on each body that makes it move so [slots + 2, 6, B]."""
    each = lambda t, V, A: (force(inertia_at(bodies, t, walk.width), V, A),)
    stored = walk.empty(6, B, bodies.S.dtype, force(inertia_of_base(walk, bodies), V0, A0))
    V, A, f = moved(walk, bodies.S, V0, qd, A0, qdd, B, each, (stored,), hinges)
    walk.work.release(V, A)
    return f


def force(inertia, V, A):
    """I A + V x* I V."""
    return keep(inertia_times(*inertia, A)) + keep(force_cross(V, keep(inertia_times(*inertia, V))))
