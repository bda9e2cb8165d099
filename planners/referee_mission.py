"""What a mission asks of a grasp besides, in CasADi: clearance, sight, attitude of the base, grip.

Poses are those of the world, and the closest points of two segments are the best of all that there can be.
"""

from dataclasses import replace
from functools import reduce
from typing import NamedTuple

import casadi as ca
import numpy as np

import sdyn
from planners import solids, symbolic
from planners.clearance import ROUND, TINY
from planners.collocation import PUSHED, Drift, Path, base_of, instant, later, on_base, symbols
from planners.referee import Programme


class Scene(NamedTuple):
    """The motion as the programme has it."""

    alone: Drift
    target: Drift
    compound: Drift
    attitude: ca.Function  # time -> quaternion of the target
    paths: list[Path]  # approach, tracking, stabilising
    wait: ca.MX
    lengths: list  # of the three


def limit(nlp: Programme, task, scene: Scene) -> None:
    """Adds the rows of `mission.rows`."""
    asked = nlp.problem.data.mission
    if asked is None:
        return
    after, count, kept = scene.paths[2], len(task.joints), 1 - task.limits.margin
    if task.clearance or task.sight:
        free = _separate(task, scene, asked.waiting)
    if task.clearance:
        d = ca.horzcat(free[:-1, :], _held(task, count).map(after.q.shape[1])(after.q))
        for k, least in enumerate(solids.least(task) + task.clearance.margin):
            nlp.below(-d[k, :].T, -np.inf, -least)
    if task.sight:
        _beyond(nlp, free[-1, :], kept * task.sight.half_angle)
    if task.base_attitude:
        quat, w = ca.horzcat(*(x.quat for x in scene.paths)), ca.horzcat(*(x.w for x in scene.paths))
        _beyond(nlp, 2 * quat[0, :] ** 2 / ca.sum1(quat**2) - 1, kept * task.base_attitude.turn)
        nlp.below(ca.sum1(w**2).T / (kept * task.base_attitude.rate) ** 2 / 2, -np.inf, 0.5)
    if task.gripper:
        share = _grip(task, scene, count).map(after.q.shape[1])(*after[:-2])
        for k in range(2):
            nlp.below(share[k, :].T / 2, -np.inf, kept**2 / 2)


def _beyond(nlp, cosine, angle):
    """Rows of an angle, given by its cosine [1, k], that is below another one."""
    nlp.below(-cosine.T / np.sin(angle), -np.inf, -np.cos(angle) / np.sin(angle))


def _separate(task, scene, waiting):
    """Distances and the cosine of sight, a column each: waiting, approaching, tracking."""
    room = scene.paths[0].push.shape[0]
    q, quat, push, quat_t, time = names = symbols(q=len(task.joints), quat=4, push=room, quat_t=4, time=1)
    poses, own, other = [], instant(scene.alone, push), later(scene.target, time)
    for drift, Q, joints in ((own, quat, q), (other, quat_t, ca.DM.zeros(0))):
        R = symbolic.rotation(Q)
        poses.append((R, drift.centre - R @ symbolic.centre_of_mass(drift.tree, joints)))
    links = _links(task, q, *poses[0])
    out = [*_distances(task, links, poses[1]), _cosine(task, links, poses[1])]
    see = ca.Function("see", names, [ca.vertcat(*out)])
    rest = ca.vertcat(scene.alone.centre, ca.DM(PUSHED - 3, 1))[:room]
    still = (ca.repmat(ca.DM(x), 1, len(waiting)) for x in (task.start, [1, 0, 0, 0], rest))
    columns, begun = [(*still, scene.wait * ca.DM(waiting).T)], scene.wait
    for path, length in zip(scene.paths[:2], scene.lengths, strict=False):
        s = np.linspace(0, 1, path.q.shape[1])
        columns.append((path.q, path.quat, path.push, begun + length * ca.DM(s).T))
        begun = begun + length
    return ca.horzcat(*(see.map(x[0].shape[1])(*x, scene.attitude(t), t) for *x, t in columns))


def _held(task, n) -> ca.Function:
    """q -> distances while the hand holds the target."""
    q = ca.SX.sym("q", n)
    hand, grip = task.chaser.frame(task.robot.frame), task.body.frame(f"target_{task.target.frame}")
    links = _links(task, q, ca.DM.eye(3), ca.DM.zeros(3))
    R, p = links[hand.link]
    R, p = R @ hand.rotation @ grip.rotation.T, p + R @ hand.position
    return ca.Function("held", [q], [ca.vertcat(*_distances(task, links, (R, p - R @ grip.position)))])


def _links(task, q, R, p) -> dict:
    """Pose of every link of the robot, from that of its base."""
    frames = tuple(sdyn.Frame(link.name, link.name) for link in task.chaser.links)
    tree = symbolic.tree_of(sdyn.pack(replace(task.chaser, frames=frames)))
    bodies = symbolic.poses(tree, q)
    out = {}
    for name, (k, F, r) in tree.frames.items():
        R_k, p_k = bodies[k]
        out[name] = R @ R_k @ F, p + R @ (p_k + R_k @ r)
    return out


def _distances(task, links, target):
    """Of each pair."""
    links = links | {task.body.base: target}
    solid = lambda name: (task.shapes[name], *links[task.shapes[name].link])
    return [_distance(solid(a), solid(b)) for a, b in solids.pairs(task)]


def _distance(first, second):
    (a, *place), (b, R, p) = first, second
    (start, along), (other, across) = _segment(a, *place), _segment(b, R, p)
    if b.semi_axes is None:
        return _apart(start - other, along, across, a.to, b.to) - a.radius - b.radius
    size = min(b.semi_axes)
    W = ca.DM(np.diag(size / np.array(b.semi_axes))) @ R.T
    return _apart(W @ (start - other), W @ along, across, a.to, None) - a.radius - size


def _segment(solid, R, p):
    return p + R @ ca.DM(solid.position), R @ ca.DM(np.subtract(solid.to or solid.position, solid.position))


def _apart(r, u, w, long, wide):
    """Rounded distance of two segments that start r apart, by its definition; a segment may be a point."""
    clip = lambda x: ca.fmin(ca.fmax(x, 0), 1)
    square = lambda s, t: ca.sumsqr(r + s * u - t * w) + ROUND * (a * (s - 0.5) ** 2 + e * (t - 0.5) ** 2)
    a, b, e = ca.sumsqr(u), ca.dot(u, w), ca.sumsqr(w)
    A, E, c, f = (1 + ROUND) * a, (1 + ROUND) * e, ROUND * a / 2 - ca.dot(u, r), ROUND * e / 2 + ca.dot(w, r)
    if not long or not wide:
        return ca.sqrt(square(clip(c / A) if long else 0, clip(f / E) if wide else 0) + TINY)
    det = A * E - b**2
    places = [(clip((c * E + b * f) / det), clip((f * A + b * c) / det))]
    places += [(s, clip((f + s * b) / E)) for s in (0, 1)] + [(clip((c + t * b) / A), t) for t in (0, 1)]
    return ca.sqrt(reduce(ca.fmin, [square(s, t) for s, t in places]) + TINY)


def _cosine(task, links, target):
    """Of the angle between the camera's axis and the ray to the grasped frame."""
    if task.sight is None:
        return 0
    (R, p), (R_t, p_t) = links[task.sight.link], target
    _, _, handle = symbolic.tree_of(sdyn.pack(task.body)).frames[f"target_{task.target.frame}"]
    ray = p_t + R_t @ handle - p - R @ ca.DM(task.sight.position)
    axis = ca.DM(task.sight.axis) / np.linalg.norm(task.sight.axis)
    return ca.dot(ray, R @ axis) / ca.norm_2(ray)


def _grip(task, scene, n) -> ca.Function:
    """(q, rates, qdd, quat, w, a, push) -> squares of force and moment on the hand, relative to their limits."""
    room = scene.paths[2].push.shape[0]
    q, rates, qdd, quat, w, a, push = names = symbols(q=n, rates=n, qdd=n, quat=4, w=3, a=6, push=room)
    base = base_of(instant(scene.compound, push), q, rates, quat, w)
    wrench, _ = symbolic.newton_euler(scene.alone.tree, q, base.twist, rates, a, qdd)
    wrench = wrench - on_base(push)
    _, p, _, _ = symbolic.frame_motion(scene.alone.tree, q, base.twist, rates, task.robot.frame)
    moment = wrench[:3] - ca.cross(p, wrench[3:])
    share = ca.vertcat(ca.sumsqr(wrench[3:]) / task.gripper.force**2, ca.sumsqr(moment) / task.gripper.torque**2)
    return ca.Function("grip", names, [share])
