"""Poses, Jacobians, velocities and accelerations of links and frames, in the world.

One outward sweep gives pose, twist V and spatial acceleration A of every slot in the base's frame; links and frames
follow by their fixed poses in a slot. The velocity of a point x is v + w x x, its classical acceleration
a + A_ang x x + w x (v + w x x), with [w; v] = V and a the linear part of A.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sdyn.batching import Kernel
from sdyn.chain import BaseRow, Chain, LinkRow, SlotRow, index_of
from sdyn.coordinates import Pose, pose_of, rates_of, spin, turned_columns
from sdyn.inputs import expect
from sdyn.spatial import cat
from sdyn.sweep import batch_of, joints_of, moved, placed, walk_of


def _poses(slot_index, slot_value, q, quat, *, work):
    """Rotation and position [slots + 2, 12, B], motion subspace [slots, 6, B], in base axes."""
    walk, B = walk_of(slot_index, work), batch_of(slot_value, q, quat)
    R, p, S = placed(walk, joints_of(walk, slot_index, slot_value, q, quat), B)
    return walk.cleared(cat([R, p], 1)), walk.cleared(S)[: walk.slots]


def _motions(slot_index, slot_value, q, quat, V0, qd, A0, qdd, *, work):
    """Rotation, position, twist and spatial acceleration [slots + 2, 24, B], in base axes."""
    walk, B = walk_of(slot_index, work), batch_of(slot_value, q, quat, V0, qd, A0, qdd)
    R, p, S = placed(walk, joints_of(walk, slot_index, slot_value, q, quat), B)
    V, A = moved(walk, S, V0, qd, A0, qdd, B)
    return (walk.cleared(cat([R, p, V, A], 1)),)


poses = Kernel(_poses)
motions = Kernel(_motions)


def slot_motions(chain: Chain, pose: Pose, v, vdot):
    """Rotation, position, twist and spatial acceleration of every slot [slots + 2, 24], in base axes."""
    value = chain.slot_value[..., None]
    V0, qd = rates_of(chain, pose, v)
    a0, qdd = rates_of(chain, pose, vdot)
    free = chain.base_value[BaseRow.FREE]
    (slots,) = motions(chain.slot_index, value, pose.q, pose.quat, V0 * free, qd, a0 * free, qdd - spin(chain, qd))
    return slots[..., 0]


def link_motions(chain: Chain, pose: Pose, v, vdot):
    """Rotation [n, 3, 3], origin [n, 3], twist and spatial acceleration [n, 6] of every link, in base axes."""
    slots = slot_motions(chain, pose, v, vdot)
    return *link_poses(chain, slots), *(slots[chain.link_index[LinkRow.SLOT], k : k + 6] for k in (12, 18))


def link_poses(chain: Chain, slots):
    """Rotation and origin of every link in base axes, from those of its slot."""
    at = slots[chain.link_index[LinkRow.SLOT]]
    R, p = at[:, :9].reshape(-1, 3, 3), at[:, 9:12]
    return R @ chain.link_pose[:, :9].reshape(-1, 3, 3), p + (R @ chain.link_pose[:, 9:, None])[..., 0]


def frame_at(chain: Chain, frame):
    """Number of a frame's link, and its rotation and position in it; NaN if this structure has no such frame."""
    index = index_of(frame, chain.capacity.frame_names, chain.frame_index[0], "frame")
    link, value = chain.frame_index[1][index], chain.frame_value[index]
    value = jnp.where(link >= 0, value, jnp.nan)
    return link, value[:9].reshape(3, 3), value[9:]


def body_poses(chain: Chain, q: Float[Array, " nq"]) -> tuple[Float[Array, "n 3 3"], Float[Array, "n 3"]]:
    """Poses of all links in the world.

    Args:
        chain: Packed structure.
        q: Configuration [m, rad, unit quaternion wxyz].

    Returns:
        Rotations (link to world) and origins [m] of the original links, locked ones included.
    """
    (q,) = expect(chain, q=q)
    pose = pose_of(chain, q)
    slots, _ = poses(chain.slot_index, chain.slot_value[..., None], pose.q, pose.quat)
    R, p = link_poses(chain, slots[..., 0])
    return pose.R @ R, pose.p + p @ pose.R.T


def frame_pose(chain: Chain, q: Float[Array, " nq"], frame) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    """Pose of a frame in the world.

    Args:
        chain: Packed structure.
        q: Configuration [m, rad, unit quaternion wxyz].
        frame: Name, or index, which may be traced.

    Returns:
        Rotation (frame to world), origin [m].

    Raises:
        RobotError: While tracing, if there is no such frame.
    """
    R, p = body_poses(chain, q)
    link, Rf, pf = frame_at(chain, frame)
    return R[link] @ Rf, p[link] + R[link] @ pf


def frame_jacobian(chain: Chain, q: Float[Array, " nq"], frame) -> Float[Array, "6 nv"]:
    """Jacobian of a frame's twist, angular rows first, world axes, at the frame's origin [rad, m per unit of v].

    Args:
        chain: Packed structure.
        q: Configuration [m, rad, unit quaternion wxyz].
        frame: Name, or index, which may be traced.
    """
    (q,) = expect(chain, q=q)
    pose = pose_of(chain, q)
    slots, S = poses(chain.slot_index, chain.slot_value[..., None], pose.q, pose.quat)
    R, p = link_poses(chain, slots[..., 0])
    link, _, pf = frame_at(chain, frame)
    point = p[link] + R[link] @ pf
    J = jacobian_columns(chain, pose, S[..., 0], chain.link_index[LinkRow.SLOT][link])
    linear = J[3:] + jnp.cross(J[:3], point[:, None], axis=0)  # v + w x point
    return jnp.concatenate([pose.R @ J[:3], pose.R @ linear])


def jacobian_columns(chain: Chain, pose: Pose, S, slot):
    """Twists [..., 6, nv] of slots (numbers of any shape) per unit of v, base axes and origin; `S` [slots, 6]."""
    live = chain.slot_index[SlotRow.LIVE].reshape(-1) == 1
    n, nv = live.shape[0], chain.capacity.nv
    carries = jnp.where((slot < n)[..., None], chain.ancestors[jnp.minimum(slot, n - 1)], False)
    dof = jnp.where(live, chain.slot_index[SlotRow.DOF].reshape(-1), nv)
    by_dof = jnp.zeros((nv + 1, n), S.dtype).at[dof, jnp.arange(n)].add(1)[:nv]
    J = jnp.einsum("...s,sk,vs->...kv", carries.astype(S.dtype), S, by_dof)
    if chain.capacity.quaternions:
        turn = jax.vmap(lambda columns: turned_columns(chain, pose, columns.T).T)
        J = turn(J.reshape(-1, 6, nv)).reshape(J.shape)
    if chain.capacity.base_nv:
        present = jnp.where(slot <= n, chain.free, 0)[..., None, None]
        J = jnp.concatenate([jnp.eye(6, dtype=S.dtype) * present, J], -1)
    return J


def frame_velocity(chain: Chain, q: Float[Array, " nq"], v: Float[Array, " nv"], frame) -> Float[Array, "6"]:
    """Angular velocity of a frame and velocity of its origin, world axes [rad/s, m/s].

    Args:
        chain: Packed structure.
        q, v: State.
        frame: Name, or index, which may be traced.
    """
    (v,) = expect(chain, v=v)
    return frame_jacobian(chain, q, frame) @ v


def frame_acceleration(
    chain: Chain, q: Float[Array, " nq"], v: Float[Array, " nv"], vdot: Float[Array, " nv"], frame
) -> Float[Array, "6"]:
    """Angular acceleration of a frame and classical acceleration of its origin, world axes [rad/s^2, m/s^2].

    Args:
        chain: Packed structure.
        q, v: State.
        vdot: Time derivative of the components of v.
        frame: Name, or index, which may be traced.
    """
    q, v, vdot = expect(chain, q=q, v=v, vdot=vdot)
    pose = pose_of(chain, q)
    R, p, V, A = link_motions(chain, pose, v, vdot)
    link, _, pf = frame_at(chain, frame)
    x, V, A = p[link] + R[link] @ pf, V[link], A[link]
    velocity = V[3:] + jnp.cross(V[:3], x)
    acceleration = A[3:] + jnp.cross(A[:3], x) + jnp.cross(V[:3], velocity)
    return jnp.concatenate([pose.R @ A[:3], pose.R @ acceleration])
