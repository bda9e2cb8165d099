"""Inverse dynamics by the recursive Newton-Euler algorithm, in the base's frame.

Outward, over the bodies:  V = V' + S q̇,  A = A' + S q̈ + V x S q̇,  f = I A + V x* I V − F
Inward:                    τ = S · f + ρ q̈,  f' += f
with V', A', f' those of the parent, F the applied wrench and ρ the rotor inertia.

Source: Featherstone, Rigid Body Dynamics Algorithms (2008), chapter 5, with link-frame transforms left out.
"""

from sdyn.chain import BaseRow
from sdyn.materialise import keep
from sdyn.spatial import dot, force_cross, inertia_times
from sdyn.sweep import (
    Bodies,
    Walk,
    add_to,
    batch_of,
    block,
    bodies_of,
    inertia_at,
    inertia_of_base,
    joints_of,
    moved,
    walk_of,
)


def newton_euler(slot_index, slot_value, base_value, rotor, q, quat, V0, qd, a0, qdd, G, F, *, work):
    """Forces (f0 [6, B], tau [nv, B]) that cause the accelerations (a0, qdd).

    V0, a0: twist of the base, and the derivative of its components [6, B]. G: [0; gravity] in base axes [6, B], or
    empty. F: wrenches on the slots, base axes and origin [slots + 2, 6, B], or empty.
    """
    B = batch_of(slot_value, base_value, rotor, q, quat, V0, qd, a0, qdd, G, F)
    free, walk = base_value[BaseRow.FREE], walk_of(slot_index, work)
    joints = joints_of(walk, slot_index, slot_value, q, quat)
    _, _, bodies = bodies_of(walk, joints, base_value, B)
    A0 = a0 * free - G if G.shape[0] else a0 * free
    f = body_forces(walk, bodies, V0 * free, qd, A0, qdd, F, B)

    f0, tau = joint_forces(walk, bodies.S, f, rotor.shape[0])
    return f0 * free, tau + rotor * qdd


def joint_forces(walk: Walk, S, f, nv: int):
    """The total force (f0 [6, B], tau [nv, B]) that reaches the base and each joint from the forces of the bodies."""

    def inward(t, parents, stored):
        f, tau = stored
        here = keep(block(f, t, walk.width))
        return add_to(f, parents, here), walk.put_dof(tau, t, dot(block(S, t, walk.width), here))

    f, tau = walk.inward(inward, (f, walk.dofs(nv, f.shape[2:], f.dtype)))
    return f[walk.slots], tau[:nv]


def body_forces(walk: Walk, bodies: Bodies, V0, qd, A0, qdd, F, B: tuple):
    """The force on each body that makes it move so [slots + 2, 6, B]."""
    each = lambda t, V, A: (force(inertia_at(bodies, t, walk.width), V, A),)
    f0 = force(inertia_of_base(walk, bodies), V0, A0)
    stored = walk.empty(6, B, bodies.S.dtype, f0)
    V, A, f = moved(walk, bodies.S, V0, qd, A0, qdd, B, each, (stored,))
    walk.work.release(V, A)
    return f - F if F.shape[0] else f


def force(inertia, V, A):
    """I A + V x* I V."""
    return keep(inertia_times(*inertia, A)) + keep(force_cross(V, keep(inertia_times(*inertia, V))))
