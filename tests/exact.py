"""Accelerations of a robot in 60 decimal digits: a plain program with Python's own decimals, for what rounding spoils.

Free or grounded trees of revolute and prismatic joints, by articulated bodies in world axes and about the world's
origin, which costs decimals nothing. Checked against a mass matrix of its own and elimination.
"""

from decimal import Decimal, getcontext

import numpy as np

getcontext().prec = 60
exactly = np.vectorize(Decimal, otypes=[object])
ZERO, ONE = Decimal(0), Decimal(1)


def accelerations(robot, q, v, tau) -> np.ndarray:
    """vdot of one state, in the coordinates of `sdyn`, rounded at the end."""
    R, p = _base(robot, q)
    tree, nb = robot.tree, 0 if robot.grounded else 6
    q, v, tau = exactly(q[0 if robot.grounded else 7 :]), exactly(v), exactly(tau)
    number = {link.name: i for i, link in enumerate(robot.links)}
    column = {joint.name: nb + k for k, joint in enumerate(robot.moving)}
    n = len(robot.links)
    poses, V, A, S, IA, f = [[None] * n for _ in range(6)]  # A: spatial acceleration where vdot is zero
    for i in tree.order:
        up, joint = tree.parent[i], robot.joints[tree.joint[i]] if tree.parent[i] >= 0 else None
        if up < 0:
            poses[i] = R, p
            # [w; v] of the base's origin in base axes is T v about the world's origin
            T = np.block([[R, R * ZERO], [_hat(p) @ R, R]])
            V[i] = T @ v[:6] if nb else exactly(np.zeros(6))
            A[i] = V[i] * ZERO  # the base's part of vdot is its spatial acceleration
        else:
            place = exactly(joint.rotation), exactly(joint.position)
            turned, moved = _motion(joint, q[column[joint.name] - nb] if joint.name in column else ZERO)
            Rj, pj = place[0] @ turned, place[0] @ moved + place[1]
            if not tree.forward[i]:
                Rj, pj = Rj.T, -(Rj.T @ pj)
            poses[i] = poses[up][0] @ Rj, poses[up][0] @ pj + poses[up][1]
            V[i], A[i] = V[up], A[up]
        if joint is not None and joint.name in column:
            R1, p1 = poses[number[joint.parent]]
            axis, at = R1 @ place[0] @ exactly(joint.axis), R1 @ place[1] + p1
            screw = np.concatenate([axis, np.cross(at, axis)] if joint.kind == "revolute" else [axis * ZERO, axis])
            S[i] = screw if tree.forward[i] else -screw
            rate = v[column[joint.name]]
            V[i], A[i] = V[up] + S[i] * rate, A[up] + _cross(V[up], S[i]) * rate
        link, (Ri, pi) = robot.links[i], poses[i]
        m, c = Decimal(link.mass), _hat(Ri @ exactly(link.com) + pi)
        I = exactly(link.inertia)
        I = Ri @ (I + I.T) @ Ri.T / 2 + m * (c @ c.T)
        IA[i] = np.block([[I, m * c], [m * c.T, m * exactly(np.eye(3))]])
        h = IA[i] @ V[i]
        gyroscopic = [np.cross(V[i][:3], h[:3]) + np.cross(V[i][3:], h[3:]), np.cross(V[i][:3], h[3:])]
        f[i] = IA[i] @ A[i] + np.concatenate(gyroscopic)

    u = [None] * n
    for i in reversed(tree.order[1:]):
        up = tree.parent[i]
        if S[i] is not None:
            U = IA[i] @ S[i]
            D = S[i] @ U
            u[i] = U, D, tau[column[robot.joints[tree.joint[i]].name]] - S[i] @ f[i]
            IA[i], f[i] = IA[i] - U[:, None] * U[None] / D, f[i] + U * (u[i][2] / D)
        IA[up], f[up] = IA[up] + IA[i], f[up] + f[i]
    out, a, root = exactly(np.zeros(robot.nv)), [None] * n, tree.order[0]
    if nb:
        out[:6] = _solved(T.T @ IA[root] @ T, tau[:6] - T.T @ f[root])
    a[root] = T @ out[:6] if nb else V[root] * ZERO
    for i in tree.order[1:]:
        a[i] = a[tree.parent[i]]
        if S[i] is not None:
            U, D, rest = u[i]
            k = column[robot.joints[tree.joint[i]].name]
            out[k] = (rest - U @ a[i]) / D
            a[i] = a[i] + S[i] * out[k]
    return out.astype(float)


def _base(robot, q):
    if robot.grounded:
        return tuple(map(exactly, robot.ground_pose))
    quat = exactly(q[3:7])
    quat = quat / sum(quat * quat).sqrt()
    w, U = quat[0], _hat(quat[1:])
    return exactly(np.eye(3)) + 2 * w * U + 2 * (U @ U), exactly(q[:3])


def _motion(joint, x):
    axis, eye = exactly(joint.axis), exactly(np.eye(3))
    if joint.kind == "prismatic":
        return eye, axis * x
    U, (s, c) = _hat(axis), _sine_cosine(x)
    return eye + s * U + (ONE - c) * (U @ U), axis * ZERO


def _sine_cosine(x):
    """By their series at x / 2^20, doubled."""
    y = x / 2**20
    s, c, term = ZERO, ZERO, ONE
    for k in range(16):
        s, c = (s, c + term) if k % 2 == 0 else (s + term, c)
        term = term * y / (k + 1) * (-1 if k % 2 else 1)
    for _ in range(20):
        s, c = 2 * s * c, c * c - s * s
    return s, c


def _hat(a):
    return np.array([[ZERO, -a[2], a[1]], [a[2], ZERO, -a[0]], [-a[1], a[0], ZERO]], object)


def _cross(a, b):
    return np.concatenate([np.cross(a[:3], b[:3]), np.cross(a[:3], b[3:]) + np.cross(a[3:], b[:3])])


def _solved(M, b):
    M, b = M.copy(), b.copy()
    for k in range(len(b)):
        for i in range(k + 1, len(b)):
            factor = M[i, k] / M[k, k]
            M[i, k:] -= factor * M[k, k:]
            b[i] -= factor * b[k]
    for k in reversed(range(len(b))):
        b[k] = (b[k] - M[k, k + 1 :] @ b[k + 1 :]) / M[k, k]
    return b
