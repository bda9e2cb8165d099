"""What the sweeps over a chain share: storage by slot, operands by step, and the kinematics of one step.

All quantities are in the base's own frame (the ground's, seen from the base, when it is grounded): inertias add up
without transforms and nothing depends on the pose of the base. Arrays are `(components, W, B)` inside a step and
`(slots + 2, components, B)` between steps; the last two slots are the base and a dummy.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from sdyn.chain import SlotRow, ValueRow
from sdyn.materialise import keep
from sdyn.rotation import matrix
from sdyn.spatial import cat, cross, mm, motion_cross, mv, rigid_inertia


class Steps(NamedTuple):
    """Operands of a sweep, one leading entry for each step."""

    t: jnp.ndarray
    parent: jnp.ndarray
    value: jnp.ndarray
    sin: jnp.ndarray
    cos: jnp.ndarray
    q: jnp.ndarray
    quat: jnp.ndarray | None


def batch_of(*operands) -> int:
    """The batch size of operands `(..., B)` or `(..., 1)`."""
    return max(x.shape[-1] for x in operands)


def steps_of(slot_index, slot_value, q, quat) -> Steps:
    """The joint constants and coordinates of each step; the sines of all joints at once."""
    T = slot_index.shape[1]
    qs = by_step(slot_index, q)
    sin, cos = keep((jnp.sin(qs), jnp.cos(qs)))
    R = None
    if quat.shape[0]:  # rotation of the spherical joint that starts in a slot, identity elsewhere
        one = jnp.broadcast_to(jnp.eye(3, dtype=quat.dtype)[..., None, None], (3, 3, 1, quat.shape[-1]))
        rotations = cat([matrix(jnp.swapaxes(quat, 0, 1)), one], 2)
        R = keep(jnp.moveaxis(jnp.take(rotations, slot_index[SlotRow.QUAT], axis=2), 2, 0))
    return Steps(jnp.arange(T, dtype=jnp.int32), slot_index[SlotRow.PARENT], slot_value, sin, cos, qs, R)


def by_step(slot_index, x):
    """Values of the degrees of freedom (nv, B), laid out by slot (T, W, B), zero in empty slots."""
    if x.shape[0] == 0:
        return jnp.zeros((*slot_index.shape[1:], x.shape[-1]), x.dtype)
    return jnp.take(x, slot_index[SlotRow.DOF], axis=0) * slot_index[SlotRow.LIVE][..., None].astype(x.dtype)


def by_dof(slot_index, x, nv: int):
    """The inverse of `by_step`: (T, W, B) -> (nv, B)."""
    if nv == 0:  # the transpose of a scatter into nothing is a gather that JAX refuses
        return jnp.zeros((0, x.shape[-1]), x.dtype)
    live = jnp.where(slot_index[SlotRow.LIVE][..., None] == 1, x, 0)
    return jnp.zeros((nv, x.shape[-1]), x.dtype).at[slot_index[SlotRow.DOF]].add(live)[:nv]


def storage(slots: int, base):
    """Storage by slot that starts with the base's value (components, B); other slots are zero."""
    return jnp.zeros((slots + 2, *base.shape), base.dtype).at[slots].set(base)


def take(stored, index):
    """(slots, ..., B), (W,) -> (..., W, B): W contiguous copies, cheaper than a gather."""
    return jnp.stack([lax.dynamic_index_in_dim(stored, i, 0, keepdims=False) for i in index], -2)


def put(stored, t, W: int, x):
    """Store the value of the bodies of step t."""
    return lax.dynamic_update_slice_in_dim(stored, jnp.moveaxis(x, -2, 0), t * W, 0)


def block(stored, t, W: int):
    """The value stored for the bodies of step t."""
    return jnp.moveaxis(lax.dynamic_slice_in_dim(stored, t * W, W, 0), 0, -2)


def add_to(stored, index, x):
    """Add to the slots named by index; one after the other, since two bodies may share a parent."""
    for w, i in enumerate(index):
        there = lax.dynamic_index_in_dim(stored, i, 0, keepdims=False)
        stored = lax.dynamic_update_index_in_dim(stored, there + x[..., w, :], i, 0)
    return stored


BASE_AT = (1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0, 0, 0, 0)  # rotation and position of the base in its own frame


def poses_from(slots: int, B: int, dtype, *more):
    """Storage of poses, and of `more` (components, B) behind them; the dummy's pose is the identity too."""
    pose = jnp.broadcast_to(jnp.array(BASE_AT, dtype)[:, None], (12, B))
    stored = storage(slots, cat([pose, *(jnp.broadcast_to(x, (*x.shape[:-1], B)) for x in more)]))
    return stored.at[slots + 1, :12].set(pose)


def place(x: Steps, parent):
    """Rotation, position and motion subspace S of the bodies of a step, from their parents' poses."""
    c, W = x.value, x.value.shape[1]
    Rp, pp = parent[:9].reshape(3, 3, W, -1), parent[9:12]
    local = c[ValueRow.C0:ValueRow.C1] + c[ValueRow.C1:ValueRow.C2] * x.cos + c[ValueRow.C2:ValueRow.POINT] * x.sin
    R = keep(mm(Rp, local.reshape(3, 3, W, -1)))
    if x.quat is not None:
        R = keep(mm(R, x.quat))
    p = keep(pp + mv(Rp, c[ValueRow.POINT:ValueRow.SLIDE] + c[ValueRow.SLIDE:ValueRow.AXIS] * x.q))
    a = mv(R, c[ValueRow.AXIS : ValueRow.AXIS + 3])
    S = keep(cat([a, mv(R, c[ValueRow.AXIS + 3 : ValueRow.MASS]) + cross(p, a)]))
    return R, p, S


def move(x: Steps, parent, qd):
    """`place`, with S q̇ and the twists V = V' + S q̇."""
    R, p, S = place(x, parent)
    Sqd = keep(S * qd)
    return R, p, S, Sqd, keep(parent[12:18] + Sqd)


def accelerated(parent, S, qdd, V, Sqd):
    """Spatial accelerations A = A' + S q̈ + V x S q̇."""
    return keep(parent[18:24] + S * qdd + motion_cross(V, Sqd))


def wrenches_of(slot_index, F):
    """Wrenches on the bodies of each step [T, 6, W, B], and on the base [6, 1, B]; None where F is empty."""
    T, W = slot_index.shape[1:]
    if not F.shape[0]:
        return None, None
    return F[: T * W].reshape(T, W, 6, -1).swapaxes(1, 2), F[T * W][:, None]


def body_of(value):
    """Mass, centre and inertia of the bodies of a step."""
    m, c, I = value[ValueRow.MASS], value[ValueRow.COM : ValueRow.INERTIA], value[ValueRow.INERTIA :]
    return m, c, I.reshape(3, 3, *value.shape[1:])


def base_of(base_value):
    """Mass, centre and inertia of the base, with a step's W = 1."""
    return base_value[0][None], base_value[1:4, None], base_value[4:13].reshape(3, 3, 1, -1)


def base_inertia(base_value):
    """(m, h, Io) of the base about its own origin."""
    m, c, I = base_of(base_value)
    return rigid_inertia(jnp.eye(3, dtype=m.dtype)[..., None, None], jnp.zeros_like(c), m, c, I)
