"""What a plan of a grasp must keep of what its mission asks besides: clearance, sight, attitude of the base, grip.

Distances are those of `solids`, the wrench on the gripper is the rate of the target's momentum, by a spline through it.
A target of other mass or inertia is grasped by the same path of the joints: what torque does it take then?
"""

from dataclasses import replace
from itertools import product

import numpy as np
from scipy.interpolate import CubicSpline

import sdyn
from planners import grasp, solids
from planners.certify import LIMIT, Row
from planners.motion import follow

NEAR = 0.03  # part of a limit within which a plan touches it


def rows(task, plan, impulse) -> list[Row]:
    """The checks; none of what is not asked.

    Args:
        task: What was asked for.
        plan: What is offered.
        impulse: Impulsive wrench [n; f] on the target at the grasp, world axes, about its base's origin.
    """
    motions = follow(plan) if any((task.clearance, task.sight, task.base_attitude, task.gripper)) else ()
    return [
        *(_clearance(task, motions) if task.clearance else ()),
        *(_sight(task, motions) if task.sight else ()),
        *(_attitude(task, plan, motions) if task.base_attitude else ()),
        *(_grip(task, plan, motions, impulse) if task.gripper else ()),
        *(_other_targets(task, plan) if task.target.uncertainty else ()),
    ]


def _over(name, value, most, unit):
    """A value against its limit."""
    touched = f"the limit of the {name}" if value > (1 - NEAR) * most else ""
    return Row(name, float(value), most + LIMIT, unit, touched)


def _clearance(task, motions):
    closest = np.min([solids.apart(task, *pair).min(axis=0) for pair in motions], axis=0)
    for (a, b), d, least in zip(solids.pairs(task), closest, solids.least(task), strict=True):
        name = f"clearance of {a!r} from {b!r}"
        near = d < least + 1.5 * task.clearance.margin
        yield Row(f"lack of {name}", float(least - d), LIMIT, "m", f"the {name}" if near else "")


def _sight(task, motions):
    camera = sdyn.Frame("camera", task.sight.link, position=task.sight.position)
    axis, worst = np.array(task.sight.axis) / np.linalg.norm(task.sight.axis), 0.0
    for robot, target in motions:
        if target is not None:
            R, p, _ = robot.of(camera)
            ray = target.of(target.robot.frame(f"target_{task.target.frame}"))[1] - p
            worst = max(worst, _angle(ray, R @ axis).max())
    yield _over("angle of sight", worst, task.sight.half_angle, "rad")


def _angle(a, b):
    """Angle between vectors [k, 3]."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))


def _attitude(task, plan, motions):
    base = sdyn.Frame("base", task.chaser.base)
    R, _, twist = (np.concatenate(x) for x in zip(*(robot.of(base) for robot, _ in motions), strict=True))
    between = np.einsum("ji,kjl->kil", R[0], R)
    skew = np.linalg.norm(between - between.transpose(0, 2, 1), axis=(1, 2)) / np.sqrt(2)
    turn = np.arctan2(skew, np.trace(between, axis1=1, axis2=2) - 1)
    yield _over("turn of the base", turn.max(), task.base_attitude.turn, "rad")
    rate = np.linalg.norm(twist[:, :3], axis=1).max()
    yield _over("angular velocity of the base", rate, task.base_attitude.rate, "rad/s")


def _grip(task, plan, motions, impulse):
    """What the target feels at the grasped frame, after the grasp and at it."""
    limit, (compound, _) = task.gripper, motions[-1]
    frame = compound.robot.frame(f"target_{task.target.frame}")
    _, place, _ = compound.of(frame)
    momentum = compound.momentum([link.name for link in task.body.links])  # about the world's origin
    wrench = CubicSpline(plan.phases[-1].times, momentum)(plan.phases[-1].times, 1)
    moment, force = np.split(wrench, 2, axis=1)
    size = lambda x: np.linalg.norm(x, axis=-1).max()
    yield _over("force on the gripper", size(force), limit.force, "N")
    yield _over("torque on the gripper", size(moment - np.cross(place, force)), limit.torque, "N m")
    moment, force = np.split(impulse, 2)
    _, origin, _ = compound.of(sdyn.Frame("base", task.body.base))
    moment = moment - np.cross(place[0] - origin[0], force)
    yield _over("impulse on the gripper", size(force), limit.impulse, "N s")
    yield _over("angular impulse on the gripper", size(moment), limit.angular_impulse, "N m s")


def _other_targets(task, plan):
    """Torques after the grasp, had the target the least or most mass and inertia; how it tumbles stays the same."""
    intervals, spread, most = task.phases["stabilise"].intervals, task.target.uncertainty, 0.0
    fine = round((len(plan.phases[-1].times) - 1) / intervals)
    for mass, inertia in product((1 - spread, 1 + spread), repeat=2):
        links = tuple(replace(x, mass=mass * x.mass, inertia=inertia * x.inertia) for x in task.body.links)
        other = replace(task, body=replace(task.body, links=links))
        after = grasp.phases(other, grasp.data(other), plan.variables, fine)[-1]
        most = max(most, (np.abs(after.tau[:, 6:]) / task.torque_limits).max())
    yield _over("torque after the grasp of a target of other inertia, relative", most, 1.0, "")
