"""What a task asks for, phase by phase, in words and physical units: what is shown before anything is planned."""

from typing import NamedTuple

import numpy as np

import sdyn
from planners import solids
from planners.task import Task


class PhaseOutline(NamedTuple):
    """One phase of a task."""

    name: str
    duration: tuple[float, float]
    """Shortest and longest [s]."""
    robot: sdyn.Robot
    """The structure that moves."""
    apart: sdyn.Robot | None
    """The target, as long as it moves on its own."""
    change: str
    """What becomes another structure where the phase begins; empty if nothing does."""
    base: str
    """What moves the base."""
    decided: str
    """What the solver decides."""
    holds: tuple[str, ...]
    """Constraints of this phase, besides those of all."""


class Outline(NamedTuple):
    """A task in words."""

    phases: tuple[PhaseOutline, ...]
    limits: tuple[str, ...]
    """In all phases."""
    cost: tuple[str, ...]
    """Terms of the cost, those with weight."""


def outline(task: Task) -> Outline:
    """A task in words: its phases in their order, what holds in all of them, and what it costs."""
    return Outline(tuple(KINDS[task.kind](task, name) for name in task.phases), _limits(task), _cost(task))


def _limits(task) -> tuple[str, ...]:
    slides = any(joint.kind == "prismatic" for joint in task.joints)
    unit, moment = ("rad or m", "N m or N") if slides else ("rad", "N m")
    position, kept = task.position_limits, f", {100 * task.limits.margin:g} % kept free"
    joints = (
        f"position from {_range(position[:, 0])} to {_range(position[:, 1])} {unit}",
        f"rate at most {_range(task.rate_limits)} {'rad/s or m/s' if slides else 'rad/s'}",
        f"torque at most {_range(task.torque_limits)} {moment}{kept if task.limits.margin else ''}",
    )
    turn, clear = task.base_attitude, task.clearance
    base = (f"the base turns by at most {turn.turn:g} rad, at most {turn.rate:g} rad/s",) if turn else ()
    pairs = len(solids.pairs(task)) if clear else 0
    apart = (f"{pairs} pair{'s' * (pairs > 1)} of shapes keep {clear.distance:g} m clear",) if clear else ()
    return (*joints, *base, *apart)


def _cost(task) -> tuple[str, ...]:
    terms, sought = TERMS[type(task.weights).__name__], " and ".join(task.unknown)
    missing = ("base_torque",) * (task.base is None) + ("base_force",) * (task.base is None or not task.base.force)
    terms = [term for term in terms if term[0] not in missing]
    weights = ((getattr(task.weights, name), unit, term) for name, unit, term in terms)
    texts = (f"{weight:g}{unit} x {term}" for weight, unit, term in weights if weight)
    if sought:
        return tuple(text.replace("Fisher information", f"Fisher information on the {sought}") for text in texts)
    return tuple(text for text in texts if "Fisher" not in text)


PUSH = (
    ("base_torque", "/(N^2 m^2 s)", "integral of |moment on the base|^2"),
    ("base_force", "/(N^2 s)", "integral of |force on the base|^2"),
)
ARM = (
    ("information", "", "-log det of the Fisher information"),
    ("time", "/s", "duration"),
    ("torque", "/s", "integral of the mean of (torque / limit)^2"),
    ("smoothness", " s^3", "integral of the mean of (joint acceleration)^2"),
)
TERMS = {
    "Weights": ARM,
    "GraspWeights": (*ARM, *PUSH),
    "Effort": (
        ("time", "/s", "duration"),
        *PUSH,
        ("joint_torque", "/(N^2 m^2 s)", "integral of |joint torques|^2"),
        ("end_base", " (s^2, s^2/m^2)", "|velocity of the base at the end|^2"),
        ("end_joints", " s^2", "|joint rates at the end|^2"),
    ),
}


def _range(values) -> str:
    """One number, or the least and the largest of several."""
    low, high = (f"{x:.4g}" for x in (np.min(values), np.max(values)))
    return low if low == high else f"{low}..{high}"


def _splines(task, name, also=()) -> str:
    phase, (low, high) = task.phases[name], task.phases[name].duration
    free = (*(["duration"] if low < high else []), *also)
    points = f"{phase.control_points} control points of each joint's quintic spline, on {phase.intervals} intervals"
    if task.chaser.loops:
        points = f"torques of all joints, linear on each of {phase.intervals} intervals"
    return "; ".join([", ".join(free), points] if free else [points])


FLOATS = "floats; its motion follows from momentum"


def _of_grasp(task, name) -> PhaseOutline:
    together, t = name == "stabilise", task.tolerance
    hand, grip = task.robot.frame, f"target_{task.target.frame}"
    holds = {
        "wait": ("all joints rest",),
        "approach": (),
        "track": (
            f"{hand!r} on {grip!r}: within {t.position:g} m, {t.angle:g} rad and {t.speed:g} m/s",
            f"at both ends {hand!r} and {grip!r} move alike",
        ),
        "stabilise": ("all joints rest at the end",),
    }
    if task.gripper and together:
        most = task.gripper
        holds[name] += (
            f"the gripper bears {most.force:g} N and {most.torque:g} N m; at the grasp {most.impulse:g} N s and "
            f"{most.angular_impulse:g} N m s",
        )
    if task.sight and not together:
        holds[name] += (
            f"a camera on {task.sight.link!r} has {grip!r} within {task.sight.half_angle:g} rad of its axis",
        )
    return PhaseOutline(
        name,
        task.phases[name].duration,
        task.compound if together else task.chaser,
        None if together else task.body,
        f"{hand!r} takes {grip!r}: the target joins the robot" if together else "",
        FLOATS if name == "wait" else _pushed(task),
        "duration" if name == "wait" else _splines(task, name, also=("the base's push",) if task.base else ()),
        holds[name],
    )


def _pushed(task) -> str:
    """What moves the base of a grasp or of a detumbling."""
    if task.base is None:
        return FLOATS
    moment = f"{_range(task.base.torque)} N m"
    if task.base.force is None:
        return f"attitude control, at most {moment} about each axis; it is carried along as momentum says"
    return f"thrusters, at most {moment} and {_range(task.base.force)} N about and along each axis"


def _of_reach(task, name) -> PhaseOutline:
    place = ", ".join(f"{x:g}" for x in task.goal.position)
    turn = "with its orientation" if task.goal.quaternion else "in any orientation"
    goal = f"{task.robot.frame!r} ends at ({place}) m, {turn}"
    holds = (goal, "all joints rest at both ends")
    if task.chaser.loops:
        holds += ("loops stay closed",)
    dock, (low, high) = task.robot.dock, task.phases[name].duration
    base = FLOATS if dock is None else f"is held: {dock!r} is docked where it is at the start"
    return PhaseOutline(name, (low, high), task.chaser, None, "", base, _splines(task, name), holds)


def _of_identify(task, name) -> PhaseOutline:
    ends = "all joints rest at both ends, in one posture"
    holds = (ends,) if task.attitude is None else (ends, f"the base turns by at most {task.attitude:g} rad")
    return PhaseOutline(name, task.phases[name].duration, task.chaser, None, "", FLOATS, _splines(task, name), holds)


def _of_detumble(task, name) -> PhaseOutline:
    wheels = f"; {', '.join(task.base.wheels)} may spin on" if task.base.wheels else ""
    return PhaseOutline(
        name,
        task.phases[name].duration,
        task.compound,
        None,
        f"{task.robot.frame!r} has taken 'target_{task.target.frame}': the target is part of the robot",
        _pushed(task),
        _splines(task, name, also=("the base's spline",)),
        (f"base and joints slower than {task.end.speed:g} m/s and rad/s at the end{wheels}",),
    )


KINDS = {"grasp": _of_grasp, "reach": _of_reach, "identify": _of_identify, "detumble": _of_detumble}
