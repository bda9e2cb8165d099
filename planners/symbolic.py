"""Kinematics and dynamics of a packed chain as CasADi expressions: a second implementation, for a second opinion.

It reads the arrays of `sdyn.Chain` and nothing else of `sdyn`, and works in the frames of the bodies, where sdyn's own
kernels work in the base's. Motions are [w; v], forces [n; f], at the origin of the frame that they are in.

    outward  V = X V' + S q̇,  A = X A' + S q̈ + V x S q̇;   inward  f = I A + V x* I V + sum Xᵀ f,  τ = S · f

Source: Featherstone, Rigid Body Dynamics Algorithms (2008), chapter 5.
"""

from typing import NamedTuple

import casadi as ca
import numpy as np

import sdyn

VALUES = (9, 18, 27, 30, 33, 39, 40, 43)  # where the parts of `Chain.slot_value` start, behind the first
BASE = (1, 4, 13)  # of `Chain.base_value`


class Body(NamedTuple):
    """A degree of freedom and the body behind it, whose frame turns by C0 + C1 cos q + C2 sin q."""

    parent: int  # place in the list; the base is first and its own parent
    dof: int
    turn: tuple  # C0, C1, C2 [3, 3], body to parent
    point: np.ndarray  # [3] m
    slide: np.ndarray  # [3] m per unit of q
    axis: np.ndarray  # [6]
    mass: float  # kg
    centre: np.ndarray  # [3] m
    inertia: np.ndarray  # [3, 3] about the centre, kg m^2


class Tree(NamedTuple):
    """A chain with a free base, taken from its arrays."""

    bodies: tuple[Body, ...]
    passive: np.ndarray  # [3, nv]: damping, stiffness, rotor inertia of each degree of freedom
    frames: dict  # {name: (place of its body, rotation [3, 3], position [3])}
    mass: float  # kg


def tree_of(chain: sdyn.Chain) -> Tree:
    """The tree of a packed chain.

    Raises:
        ValueError: If its base is grounded, or if it has spherical joints or closures.
    """
    size = chain.capacity
    if size.layout != "free" or size.quaternions or size.loops:
        raise ValueError("symbolic: the chain must have exact sizes, a free base, no spherical joints and no closures.")
    index, value = np.asarray(chain.slot_index), np.asarray(chain.slot_value)
    parent, dof, _, live = (x.ravel() for x in index[:4])
    value = np.moveaxis(value, 1, 2).reshape(-1, value.shape[1])
    mass, centre, inertia = np.split(np.asarray(chain.base_value)[: BASE[-1]], BASE[:2])
    eye = np.eye(3)
    root = Body(0, -1, (eye, 0 * eye, 0 * eye), np.zeros(3), np.zeros(3), np.zeros(6), mass[0], centre, inertia)
    bodies, place = [root._replace(inertia=inertia.reshape(3, 3))], {size.slots: 0}
    for slot in np.flatnonzero(live):
        *turn, point, slide, axis, mass, centre, inertia = np.split(value[slot], VALUES)
        place[slot] = len(bodies)
        turn = tuple(C.reshape(3, 3) for C in turn)
        up = place[parent[slot]]
        bodies.append(Body(up, dof[slot], turn, point, slide, axis, mass[0], centre, inertia.reshape(3, 3)))
    pose, at = np.asarray(chain.link_pose), np.asarray(chain.frame_value)
    slot, link = np.asarray(chain.link_index)[1], np.asarray(chain.frame_index)[1]
    frames = {}
    for k, name in enumerate(size.frame_names):
        (R, p), (F, r) = ((x[:9].reshape(3, 3), x[9:]) for x in (pose[link[k]], at[k]))
        frames[name] = place[slot[link[k]]], R @ F, p + R @ r
    return Tree(tuple(bodies), np.asarray(chain.dof_value), frames, float(sum(body.mass for body in bodies)))


# -- geometry ----------------------------------------------------------------------------------------------------------


def rotation(quat):
    """Matrix of a quaternion wxyz, of any length but zero."""
    w, x = quat[0], quat[1:]
    return ca.DM.eye(3) + 2 / ca.sumsqr(quat) * (w * ca.skew(x) + ca.skew(x) @ ca.skew(x))


def product(a, b):
    """Product of two quaternions wxyz."""
    return ca.vertcat(a[0] * b[0] - ca.dot(a[1:], b[1:]), a[0] * b[1:] + b[0] * a[1:] + ca.cross(a[1:], b[1:]))


def hinges(tree: Tree, q):
    """Rotation (body to parent) and position in its parent of every body but the base."""
    out = []
    for body in tree.bodies[1:]:
        C0, C1, C2 = body.turn
        x = q[int(body.dof)]
        out.append((C0 + C1 * ca.cos(x) + C2 * ca.sin(x), body.point + body.slide * x))
    return out


def poses(tree: Tree, q):
    """Rotation and position of every body in the base's frame."""
    out = [(ca.DM.eye(3), ca.DM.zeros(3))]
    for body, (R, p) in zip(tree.bodies[1:], hinges(tree, q), strict=True):
        Rp, pp = out[body.parent]
        out.append((Rp @ R, pp + Rp @ p))
    return out


def centre_of_mass(tree: Tree, q):
    """Centre of mass in the base's frame."""
    placed = zip(tree.bodies, poses(tree, q), strict=True)
    return sum(body.mass / tree.mass * (p + R @ body.centre) for body, (R, p) in placed)


def frame_motion(tree: Tree, q, V0, qd, name: str):
    """Pose and twist of a frame, base axes: R, p, angular, linear velocity of its origin."""
    k, F, r = tree.frames[name]
    R, p = poses(tree, q)[k]
    V = twists(tree, hinges(tree, q), V0, qd)[k]
    return R @ F, p + R @ r, R @ V[:3], R @ (V[3:] + ca.cross(V[:3], r))


# -- dynamics ----------------------------------------------------------------------------------------------------------


def _to_child(R, p, V):
    return ca.vertcat(R.T @ V[:3], R.T @ (V[3:] + ca.cross(V[:3], p)))


def _to_parent(R, p, f):
    n, f = R @ f[:3], R @ f[3:]
    return ca.vertcat(n + ca.cross(p, f), f)


def _motion_cross(V, S):
    return ca.vertcat(ca.cross(V[:3], S[:3]), ca.cross(V[:3], S[3:]) + ca.cross(V[3:], S[:3]))


def force_cross(V, f):
    """V x* f."""
    return ca.vertcat(ca.cross(V[:3], f[:3]) + ca.cross(V[3:], f[3:]), ca.cross(V[:3], f[3:]))


def _inertia(body, V):
    """I V of one body about its origin."""
    P = body.mass * (V[3:] + ca.cross(V[:3], body.centre))
    return ca.vertcat(body.inertia @ V[:3] + ca.cross(body.centre, P), P)


def twists(tree: Tree, places, V0, qd):
    """Twist of every body in its own frame."""
    out = [V0]
    for body, (R, p) in zip(tree.bodies[1:], places, strict=True):
        out.append(_to_child(R, p, out[body.parent]) + body.axis * qd[int(body.dof)])
    return out


def _gathered(tree, places, forces):
    """Forces of the bodies, each with those of all that it carries."""
    forces = list(forces)
    for k in range(len(forces) - 1, 0, -1):
        up = tree.bodies[k].parent
        forces[up] = forces[up] + _to_parent(*places[k - 1], forces[k])
    return forces


def momentum(tree: Tree, q, V0, qd):
    """Momentum [angular; linear] about the base's origin, base axes."""
    places = hinges(tree, q)
    parts = [_inertia(body, V) for body, V in zip(tree.bodies, twists(tree, places, V0, qd), strict=True)]
    return _gathered(tree, places, parts)[0]


def newton_euler(tree: Tree, q, V0, qd, a0, qdd):
    """Wrench on the base and joint forces that cause accelerations: the derivatives of the components of V0 and qd."""
    places, A, forces = hinges(tree, q), [a0], []
    V = twists(tree, places, V0, qd)
    for k, body in enumerate(tree.bodies):
        if k:
            Sqd = body.axis * qd[int(body.dof)]
            up = _to_child(*places[k - 1], A[body.parent])
            A.append(up + body.axis * qdd[int(body.dof)] + _motion_cross(V[k], Sqd))
        forces.append(_inertia(body, A[k]) + force_cross(V[k], _inertia(body, V[k])))
    forces = _gathered(tree, places, forces)
    tau = [None] * (len(tree.bodies) - 1)
    for body, f in zip(tree.bodies[1:], forces[1:], strict=True):
        damping, stiffness, rotor = tree.passive[:, body.dof]
        k = int(body.dof)
        tau[k] = ca.dot(body.axis, f) + damping * qd[k] + stiffness * q[k] + rotor * qdd[k]
    return forces[0], ca.vertcat(*tau)
