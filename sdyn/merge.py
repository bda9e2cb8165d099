"""What a structure's slots are made of: locked links merged into bodies, joints folded into constants.

One function for both stages: `xp` is `numpy` when a robot is packed, and `jax.numpy` when parameters, lock values or
placements are traced. The index arrays say which links belong together; they come from `pack`.
"""

import numpy as np

from sdyn.chain import JointValue, LinkRow, SlotRow

STILL = np.zeros((1, JointValue.SIZE))  # the joint of a base or of an empty slot: identity placement, no screw
STILL[:, [0, 4, 8, JointValue.LOCK_QUAT]] = 1.0


def derive(xp, slot_index, link_index, joint_value, mass, com, inertia):
    """Constants of slots, base and links, from the original links and joints.

    Args:
        xp: numpy or jax.numpy.
        slot_index, link_index, joint_value: As in `Chain`.
        mass, com, inertia: Of the original links, as in `Params`.

    Returns:
        slot_value [T, 52, W], mass, centre and inertia of the base [13], link_pose [n, 12].
    """
    steps, width = slot_index.shape[1:]
    index = slot_index.reshape(len(slot_index), -1)
    joints = xp.concatenate([joint_value, STILL.astype(joint_value.dtype)])
    R, p = _link_poses(xp, link_index, joints)
    m, c, I = _bodies(xp, link_index[LinkRow.SLOT], steps * width, mass, com, inertia, R[:-1], p[:-1])

    # an empty slot has a frame, an axis and an inertia: 1/0 would be masked in value, but not in the gradient
    live = index[SlotRow.LIVE] == 1
    body = [xp.where(live, m[:-1], 1.0)[:, None], c[:-1]]
    body += [xp.where(live[:, None, None], I[:-1], np.eye(3, dtype=m.dtype)).reshape(-1, 9)]
    slot_value = xp.concatenate([*_joint_constants(xp, index, joints, R, p), *body], 1)
    slot_value = xp.moveaxis(slot_value.reshape(steps, width, -1), 1, 2)
    base = xp.concatenate([m[-1:], c[-1], I[-1].reshape(9)])
    return slot_value, base, xp.concatenate([R[:-1].reshape(-1, 9), p[:-1]], 1)


def placement(joints):
    """Rotation and position of joint frames in their declared parents."""
    R, p = joints[:, JointValue.ROTATION : JointValue.POSITION], joints[:, JointValue.POSITION : JointValue.SCREWS]
    return R.reshape(-1, 3, 3), p


def displacement(xp, joints):
    """exp(S1 q1) exp(S2 q2) exp(S3 q3) R(quat) of each joint at its lock value: rotation, position."""
    screws = joints[:, JointValue.SCREWS : JointValue.SCREWS + 18].reshape(-1, 3, 6)
    R, p = np.eye(3, dtype=joints.dtype), 0.0
    for k in range(3):
        q = joints[:, JointValue.LOCK + k]
        a, b = screws[:, k, :3], screws[:, k, 3:]
        p = p + _turn(R, b * q[:, None])
        c0, c1, c2 = _screw_rotation(xp, a)
        R = R @ (c0 + c1 * xp.cos(q)[:, None, None] + c2 * xp.sin(q)[:, None, None])
    return R @ _quaternion_rotation(xp, joints[:, JointValue.LOCK_QUAT : JointValue.LOCK_QUAT + 4]), p


def _link_poses(xp, link_index, joints):
    """Pose of every link in its slot, and last the identity.

    Pointer doubling: each link knows its pose in the link that it is locked to; log2(n) rounds of composing it with
    the pose of the link pointed to end at the slot (number n).
    """
    n = link_index.shape[1]
    joint = joints[link_index[LinkRow.JOINT]]
    forward, fixed = link_index[LinkRow.FORWARD] == 1, link_index[LinkRow.FIXED] == 1
    eye, none = np.eye(3, dtype=joints.dtype), np.zeros((1, 3), joints.dtype)

    # x_parent = place (displace x_child); a moving joint traversed backwards keeps its placement behind the motion
    R, p = placement(joint)
    D, d = displacement(xp, joint)
    R, p = xp.where(fixed[:, None, None], R @ D, R), xp.where(fixed[:, None], p + _turn(R, d), p)
    Rt = xp.swapaxes(R, 1, 2)
    R, p = xp.where(forward[:, None, None], R, Rt), xp.where(forward[:, None], p, -_turn(Rt, p))
    at_slot = forward & ~fixed
    R, p = xp.where(at_slot[:, None, None], eye, R), xp.where(at_slot[:, None], none, p)

    R, p = xp.concatenate([R, eye[None]]), xp.concatenate([p, none])
    pointer = xp.where(fixed, link_index[LinkRow.PARENT], n)
    pointer = xp.concatenate([pointer, np.array([n], link_index.dtype)])
    for _ in range(n.bit_length()):
        Rp, pp = R[pointer], p[pointer]
        R, p, pointer = Rp @ R, pp + _turn(Rp, p), pointer[pointer]
    return R, p


def _bodies(xp, slot, slots, mass, com, inertia, R, p):
    """Mass, centre and inertia about it of the body in each slot, the base last; a dummy's links are left out."""
    member = (np.arange(slots + 1)[:, None] == slot[None]).astype(mass.dtype)
    x = p + _turn(R, com)
    m = member @ mass
    c = (member @ (mass[:, None] * x)) / xp.where(m > 0, m, 1.0)[:, None]
    d = x - c[xp.minimum(slot, slots)]
    steiner = (d * d).sum(1)[:, None, None] * np.eye(3, dtype=mass.dtype) - d[:, :, None] * d[:, None]
    about_centre = R @ inertia @ xp.swapaxes(R, 1, 2) + mass[:, None, None] * steiner
    return m, c, (member @ about_centre.reshape(-1, 9)).reshape(-1, 3, 3)


def _joint_constants(xp, index, joints, R, p):
    """C0, ValueRow.C1, ValueRow.C2, point, slide and axis of each slot, see `Chain.slot_value`."""
    rows, eye = joints[index[SlotRow.JOINT]], np.eye(3, dtype=joints.dtype)
    first, ahead = index[SlotRow.FIRST] == 1, (index[SlotRow.FIRST] == 1) & (index[SlotRow.FORWARD] == 1)
    place_R, place_p = placement(rows)
    from_R, from_p = R[index[SlotRow.FROM]], p[index[SlotRow.FROM]]
    put_R = xp.where(ahead[:, None, None], from_R @ place_R, xp.where(first[:, None, None], from_R, eye))
    put_p = xp.where(ahead[:, None], from_p + _turn(from_R, place_p), xp.where(first[:, None], from_p, 0.0))

    screws = rows[:, JointValue.SCREWS : JointValue.SCREWS + 18].reshape(-1, 3, 6)
    S = screws[np.arange(len(rows)), index[SlotRow.SCREW]] * index[SlotRow.SIGN][:, None].astype(rows.dtype)
    S = xp.where((index[SlotRow.LIVE] == 1)[:, None], S, np.array([0, 0, 1, 0, 0, 0], rows.dtype))
    rotations = [(put_R @ C).reshape(-1, 9) for C in _screw_rotation(xp, S[:, :3])]
    return [*rotations, put_p, _turn(put_R, S[:, 3:]), S]


def _screw_rotation(xp, a):
    """Constants of R(q) = C0 + C1 cos q + C2 sin q, for axes a [n, 3] that are unit or zero."""
    n2 = (a * a).sum(1)[:, None, None]
    outer, eye = a[:, :, None] * a[:, None], np.eye(3, dtype=a.dtype)
    return outer + (1 - n2) * eye, n2 * eye - outer, _hat(xp, a)


def _quaternion_rotation(xp, quat):
    """Rotation matrices of unit quaternions [n, 4]: (1 - 2 v.v) 1 + 2 v vᵀ + 2 w hat(v)."""
    w, v = quat[:, 0, None, None], quat[:, 1:]
    n2 = (v * v).sum(1)[:, None, None]
    return np.eye(3, dtype=quat.dtype) * (1 - 2 * n2) + 2 * (v[:, :, None] * v[:, None] + w * _hat(xp, v))


def _hat(xp, a):
    """Matrices of the cross product with a [n, 3]."""
    o, (x, y, z) = 0 * a[:, 0], a.T
    return xp.stack([xp.stack([o, -z, y], 1), xp.stack([z, o, -x], 1), xp.stack([-y, x, o], 1)], 1)


def _turn(R, x):
    """R x, row by row."""
    return (R @ x[..., None])[..., 0]
