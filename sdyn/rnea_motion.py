"""What the derivatives of inverse dynamics share: the motion of all bodies at the point where they are taken."""

from typing import NamedTuple

import jax.numpy as jnp

from sdyn.chain import BaseRow
from sdyn.materialise import keep
from sdyn.rnea import force
from sdyn.spatial import cat, inertia_times
from sdyn.sweep import (
    Bodies,
    Joints,
    Walk,
    batch_of,
    bodies_of,
    inertia_at,
    inertia_of_base,
    joints_of,
    moved,
    walk_of,
)
from sdyn.workspace import Workspace

OPERANDS = ("slot_index", "slot_value", "base_value", "rotor", "q", "quat", "V0", "qd", "a0", "qdd", "G", "F", "saved")
"""Of both kernels; `saved` holds the bodies where a sweep left them behind, or is empty."""
GEOMETRY = ("slot_value", "quat")
"""Operands whose derivatives need the joints' frames."""


class Motion(NamedTuple):
    """What the columns of a sample share."""

    walk: Walk
    joints: Joints | None
    R: jnp.ndarray | None
    p: jnp.ndarray | None
    """Joints, rotations [slots + 2, 9, *B] and positions; None where only the axes are known."""
    bodies: Bodies
    V: jnp.ndarray
    A: jnp.ndarray
    IV: jnp.ndarray
    f: jnp.ndarray
    """Twist, acceleration, momentum and force without F of each slot [slots + 2, 6, *B]."""
    qd: jnp.ndarray
    qdd: jnp.ndarray
    """Of the degrees of freedom [nv, *B]."""


def flat(bodies: Bodies):
    """The bodies as one array [slots + 2, 19, *B]."""
    return cat([*bodies[:3], jnp.broadcast_to(bodies.m, bodies.S[:, :1].shape)], 1)


def motion_of(x: dict, geometry: bool, work: Workspace, axes: int = 2) -> Motion:
    """What follows from the operands x, by name, with so many batch axes; the joints' frames if `geometry`."""
    B = batch_of(*(x[k] for k in OPERANDS[1:12]), axes=axes)
    walk, free, joints, R, p = walk_of(x["slot_index"], work), x["base_value"][BaseRow.FREE], None, None, None
    if geometry or x["saved"].shape[0] == 0:
        joints = joints_of(walk, x["slot_index"], x["slot_value"], x["q"], x["quat"])
        R, p, bodies = bodies_of(walk, joints, x["base_value"], B)
    else:
        bodies = Bodies(*jnp.split(x["saved"], (6, 15, 18), 1))
    A0 = x["a0"] * free - x["G"] if x["G"].shape[0] else x["a0"] * free
    qd, qdd, V0 = x["qd"], x["qdd"], x["V0"] * free

    def dynamics(inertia, V, A):
        return keep(inertia_times(*inertia, V)), force(inertia, V, A)

    each = lambda t, V, A: dynamics(inertia_at(bodies, t, walk.width), V, A)
    start = (walk.empty(6, B, V0.dtype, y) for y in dynamics(inertia_of_base(walk, bodies), V0, A0))
    return Motion(walk, joints, R, p, bodies, *moved(walk, bodies.S, V0, qd, A0, qdd, B, each, tuple(start)), qd, qdd)
