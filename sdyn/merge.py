"""What a structure's slots are made of: locked links merged into bodies, joints folded into constants.

One function for both stages: `xp` is `numpy` when a robot is packed, and `jax.numpy` when parameters, lock values or
placements are traced. The index arrays say which links belong together; they come from `pack`.
"""

import numpy as np

from sdyn.chain import JointValue, LinkRow, SlotRow

STILL = np.zeros((1, JointValue.SIZE))  # the joint of a base or of an empty slot: identity placement, no screw
STILL[:, [0, 4, 8, JointValue.LOCK_QUAT]] = 1.0
AT_POSITION = np.array([0, 0, 0, 1])
HAT_ENTRY = np.array([[0, 2, 1], [2, 1, 0], [1, 0, 2]])  # hat(a) = [[0, -a2, a1], [a2, 0, -a0], [-a1, a0, 0]]
HAT_SIGN = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]])


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
    X = _link_poses(xp, link_index, joints)
    R, p = X[:-1, :, :3], X[:-1, :, 3]
    m, c, I = _bodies(xp, link_index[LinkRow.SLOT], steps * width, mass, com, inertia, R, p)

    # an empty slot has a frame, an axis and an inertia: 1/0 would be masked in value, but not in the gradient
    live = index[SlotRow.LIVE] == 1
    body = [xp.where(live, m[:-1], 1.0)[:, None], c[:-1]]
    body += [xp.where(live[:, None, None], I[:-1], np.eye(3, dtype=m.dtype)).reshape(-1, 9)]
    slot_value = xp.concatenate([*_joint_constants(xp, index, joints, X), *body], 1)
    slot_value = xp.moveaxis(slot_value.reshape(steps, width, -1), 1, 2)
    base = xp.concatenate([m[-1:], c[-1], I[-1].reshape(9)])
    return slot_value, base, xp.concatenate([R.reshape(-1, 9), p], 1)


def placement(joints):
    """Rotation and position of joint frames in their declared parents."""
    R, p = joints[:, JointValue.ROTATION : JointValue.POSITION], joints[:, JointValue.POSITION : JointValue.SCREWS]
    return R.reshape(-1, 3, 3), p


def _pose(xp, R, p):
    """Poses [R | p], [..., 3, 4]."""
    return xp.concatenate([R, p[..., None]], -1)


def _compose(A, B):
    """One pose behind the other, [Ra Rb | Ra pb + pa]."""
    return A[..., :3] @ B + A * AT_POSITION.astype(A.dtype)


def _displacement(xp, joints):
    """The pose exp(S1 q1) exp(S2 q2) exp(S3 q3) R(quat) of each joint at its lock value."""
    screws, q = _screws(joints), joints[:, JointValue.LOCK : JointValue.LOCK_QUAT, None]
    c0, c1, c2 = _screw_rotation(screws[..., :3])
    X = _pose(xp, c0 + c1 * xp.cos(q)[..., None] + c2 * xp.sin(q)[..., None], screws[..., 3:] * q)
    turned = _quaternion_rotation(joints[:, JointValue.LOCK_QUAT : JointValue.LOCK_QUAT + 4])
    X = _compose(_compose(X[:, 0], X[:, 1]), X[:, 2])
    return xp.concatenate([X[..., :3] @ turned, X[..., 3:]], -1)


def _link_poses(xp, link_index, joints):
    """Pose of every link in its slot, and last the identity.

    Pointer doubling: each link knows its pose in the link that it is locked to; log2(n) rounds of composing it with
    the pose of the link pointed to end at the slot (number n).
    """
    n = link_index.shape[1]
    joint = joints[link_index[LinkRow.JOINT]]
    fixed, forward = link_index[LinkRow.FIXED] == 1, (link_index[LinkRow.FORWARD] == 1)[:, None, None]
    eye = np.eye(3, 4, dtype=joints.dtype)

    # x_parent = place (displace x_child); a moving joint traversed backwards keeps its placement behind the motion
    place = _pose(xp, *placement(joint))
    locked = _compose(place, _displacement(xp, joint))
    ahead = xp.where(fixed[:, None, None], locked, eye)
    behind = xp.where(fixed[:, None, None], locked, place)
    Rt = xp.swapaxes(behind[..., :3], 1, 2)
    X = xp.where(forward, ahead, _pose(xp, Rt, -_turn(Rt, behind[..., 3])))

    X = xp.concatenate([X, eye[None]])
    pointer = xp.concatenate([xp.where(fixed, link_index[LinkRow.PARENT], n), np.array([n], link_index.dtype)])
    for _ in range(n.bit_length()):
        X, pointer = _compose(X[pointer], X), pointer[pointer]
    return X


def _bodies(xp, slot, slots, mass, com, inertia, R, p):
    """Mass, centre and inertia about it of the body in each slot, the base last; a dummy's links are left out."""
    member = (np.arange(slots + 1)[:, None] == slot[None]).astype(mass.dtype)
    x = p + _turn(R, com)
    moments = member @ (mass[:, None] * xp.concatenate([xp.ones_like(x[:, :1]), x], 1))
    m = moments[:, 0]
    c = moments[:, 1:] / xp.where(m > 0, m, 1.0)[:, None]
    d = x - c[xp.minimum(slot, slots)]
    steiner = (d * d).sum(1)[:, None, None] * np.eye(3, dtype=mass.dtype) - d[:, :, None] * d[:, None]
    about_centre = R @ inertia @ xp.swapaxes(R, 1, 2) + mass[:, None, None] * steiner
    return m, c, (member @ about_centre.reshape(-1, 9)).reshape(-1, 3, 3)


def _joint_constants(xp, index, joints, X):
    """C0, C1, C2, point, slide and axis of each slot, see `Chain.slot_value`."""
    rows, first, eye = joints[index[SlotRow.JOINT]], index[SlotRow.FIRST] == 1, np.eye(3, 4, dtype=joints.dtype)
    ahead, start = first & (index[SlotRow.FORWARD] == 1), X[index[SlotRow.FROM]]
    place = _pose(xp, *placement(rows))
    put = xp.where(ahead[:, None, None], _compose(start, place), xp.where(first[:, None, None], start, eye))

    S = _screws(rows)[np.arange(len(rows)), index[SlotRow.SCREW]] * index[SlotRow.SIGN][:, None].astype(rows.dtype)
    S = xp.where((index[SlotRow.LIVE] == 1)[:, None], S, np.array([0, 0, 1, 0, 0, 0], rows.dtype))
    R = put[..., :3]
    rotations = [(R @ C).reshape(-1, 9) for C in _screw_rotation(S[:, :3])]
    return [*rotations, put[..., 3], _turn(R, S[:, 3:]), S]


def _screws(joints):
    """The three screws `[a; b]` of each joint; those it has not are zero."""
    return joints[:, JointValue.SCREWS : JointValue.SCREWS + 18].reshape(-1, 3, 6)


def _screw_rotation(a):
    """Constants of R(q) = C0 + C1 cos q + C2 sin q, for axes a [..., 3] that are unit or zero."""
    n2 = (a * a).sum(-1)[..., None, None]
    outer, eye = a[..., :, None] * a[..., None, :], np.eye(3, dtype=a.dtype)
    return outer + (1 - n2) * eye, n2 * eye - outer, _hat(a)


def _quaternion_rotation(quat):
    """Rotation matrices of unit quaternions [n, 4]: (1 - 2 v.v) 1 + 2 v vᵀ + 2 w hat(v)."""
    w, v = quat[:, 0, None, None], quat[:, 1:]
    n2 = (v * v).sum(1)[:, None, None]
    return np.eye(3, dtype=quat.dtype) * (1 - 2 * n2) + 2 * (v[:, :, None] * v[:, None] + w * _hat(v))


def _hat(a):
    """Matrices of the cross product with a [..., 3]."""
    return a[..., HAT_ENTRY] * HAT_SIGN.astype(a.dtype)


def _turn(R, x):
    """R x, row by row."""
    return (R @ x[..., None])[..., 0]
