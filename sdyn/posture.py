"""Where the links are, on the host: forward kinematics in NumPy, for checks, pictures and edits at a configuration."""

import numpy as np

from sdyn.checks import array, hat, pose


def link_poses(robot, q) -> tuple[np.ndarray, np.ndarray]:
    """Poses of all links in the world, in declared order.

    Args:
        robot: A `Robot`; locked joints stand at their lock values.
        q: Configuration [nq].

    Returns:
        Rotations [n, 3, 3] and positions [n, 3] in m, link axes to world.
    """
    q = array(q, (robot.nq,), "the configuration")
    base = robot.ground_pose if robot.grounded else pose(q[:7], "the pose of the base")
    values, at = {}, 0 if robot.grounded else 7
    for joint in robot.moving:
        values[joint.name], at = q[at : at + joint.nq], at + joint.nq
    values |= robot.locked

    tree = robot.tree
    R, p = np.empty((len(robot.links), 3, 3)), np.empty((len(robot.links), 3))
    for i in tree.order:
        if tree.parent[i] < 0:
            R[i], p[i] = base
            continue
        joint, up = robot.joints[tree.joint[i]], tree.parent[i]
        rotation, position = joint_pose(joint, values.get(joint.name, ()))
        if not tree.forward[i]:
            rotation, position = rotation.T, -rotation.T @ position
        R[i], p[i] = R[up] @ rotation, R[up] @ position + p[up]
    return R, p


def joint_pose(joint, value) -> tuple[np.ndarray, np.ndarray]:
    """Pose of a joint's child in its declared parent, with the joint at `value` [nq]."""
    R, p = joint.rotation, joint.position
    if joint.kind == "spherical":
        turned, _ = pose(np.r_[0.0, 0.0, 0.0, value], f"the value of joint {joint.name!r}")
        return R @ turned, p
    for screw, x in zip(joint.screws, value, strict=True):
        p = p + R @ screw[3:] * x  # along the axis if it turns, so the order of the two lines does not matter
        R = R @ turn(screw[:3], x)
    return R, p


def turn(axis, angle: float) -> np.ndarray:
    """The rotation by an angle [rad] about a unit axis; about a zero axis, none."""
    A = hat(axis)
    return np.eye(3) + np.sin(angle) * A + 2 * np.sin(angle / 2) ** 2 * A @ A
