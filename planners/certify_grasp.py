"""What a plan of a grasp must keep besides limits and dynamics."""

import jax
import numpy as np

import sdyn
from planners import balance, certify_mission
from planners.certify import DRIFT, INTEGRATION, LIMIT, MOMENTUM, Row, largest, see
from planners.problem import ONCE


def rows(task, plan) -> list[Row]:
    """Start, tracking, grasp, momentum and end."""
    hand, grip = task.robot.frame, f"target_{task.target.frame}"
    alone = [phase for phase in plan.phases if phase.passive]
    movers = [(phase.robot, hand, phase.q, phase.v) for phase in plan.phases]
    seen = see([*movers, *((body, grip, q, v) for body, q, v in (phase.passive for phase in alone))])
    robots, targets = seen[: len(plan.phases)], seen[len(plan.phases) :]
    gap, impulse = _transfer(plan)
    return [
        *_ends(task, plan),
        *_tracking(task.tolerance, robots[len(alone) - 1], targets[-1]),
        *_momentum(robots, targets, pushed=task.base is not None),
        *([] if task.base is None else balance.momentum(robots[1:], plan.phases[1:])),
        Row("state after the grasp differs from the jump", gap, 10 * INTEGRATION, "m, rad, m/s, rad/s"),
        *certify_mission.rows(task, plan, impulse),
    ]


def _ends(task, plan):
    """Start as the task says, phases that join, rest at the end, and the target's own motion."""
    first, n = plan.phases[0], len(task.joints)
    start = np.abs(first.q[0] - task.first).max()
    state = task.body.configuration(position=task.target.position, quaternion=task.target.quaternion)
    q, v = first.passive[1][0], first.passive[2][0]
    sign = np.r_[np.ones(3), np.full(4, np.sign(q[3:] @ state[3:]))]
    target = np.abs(sign * q - state).max(), np.abs(v - task.target.twist).max()
    gaps = [
        max(np.abs(a.times[-1] - b.times[0]), np.abs(a.q[-1] - b.q[0]).max(), np.abs(a.v[-1, -n:] - b.v[0, -n:]).max())
        for a, b in zip(plan.phases[:-1], plan.phases[1:], strict=True)
    ]
    return [
        Row("start differs from the task's", float(max(start, *target)), 1e-12, "m, rad, m/s, rad/s"),
        Row("phases do not join", float(max(gaps)), LIMIT, "s, m, rad, rad/s"),
        Row("joint rates at the end", float(np.abs(plan.phases[-1].v[-1, -n:]).max()), LIMIT, "rad/s"),
    ]


def _tracking(limit, hand, grip):
    """Errors of the hand on the grasp frame: over the tracking phase, and at the grasp."""
    between = np.einsum("kji,kjl->kil", grip.R, hand.R)
    skew = between - between.transpose(0, 2, 1)
    turn = np.arcsin(np.clip(np.sqrt((skew**2).sum(axis=(1, 2)) / 8), 0, 1))
    turn = np.where(np.trace(between, axis1=1, axis2=2) < 1, np.pi - turn, turn)
    place = np.linalg.norm(hand.p - grip.p, axis=1)
    spin, slide = (np.linalg.norm(x, axis=1) for x in np.split(hand.twist - grip.twist, 2, axis=1))
    table = (
        ("place", place, limit.position, "m"),
        ("orientation", turn, limit.angle, "rad"),
        ("velocity", slide, limit.speed, "m/s"),
        ("angular velocity", spin, limit.speed, "rad/s"),
    )
    tracking = [Row(f"{name} error while tracking", float(x.max()), bound, unit) for name, x, bound, unit in table]
    return tracking + [Row(f"{name} error at the grasp", float(x[-1]), LIMIT, unit) for name, x, _, unit in table]


def _momentum(robots, targets, pushed=False):
    """Total momentum over the capture, about the compound's centre of mass, and its drift in each phase; of a robot
    that is pushed, while it waits.

    Relative to the parts that add up to it, which are there when the total is zero.
    """
    after, c = robots[-1].momentum[0], robots[-1].centre[0]
    before = [(x.momentum[-1], x.centre[-1]) for x in (robots[-2], targets[-1])]
    shifted = [np.r_[h[:3] + np.cross(centre - c, h[3:]), h[3:]] for h, centre in before]
    scale = np.max([largest(x.parts) for x in (*robots, *targets)], axis=0)
    relative = lambda change: np.divide(change, scale, out=np.where(change > 0, np.inf, 0.0), where=scale > 0)
    angular, linear = relative(largest(sum(shifted) - after))
    free = robots[:1] if pushed else robots
    drift = max(relative(x.drift).max() for x in (*free, *targets))
    return [
        Row("angular momentum lost at the grasp, relative", float(angular), MOMENTUM, ""),
        Row("linear momentum lost at the grasp, relative", float(linear), MOMENTUM, ""),
        Row("momentum drift within a phase, relative", float(drift), DRIFT, ""),
    ]


_jump = jax.jit(sdyn.transfer, **ONCE)


def _transfer(plan):
    """The momentum-consistent jump of the full systems at the grasp: how far the state is from it, and the impulsive
    wrench [6] on the target, world axes, about its base's origin.
    """
    before, after = plan.phases[-2], plan.phases[-1]
    body, q, v = before.passive
    chains = sdyn.pack(before.robot), sdyn.pack(body)
    _, q_new, v_new, impulse = _jump(chains, sdyn.pack(after.robot), (before.q[-1], q[-1]), (before.v[-1], v[-1]))
    gap = max(np.abs(np.asarray(q_new) - after.q[0]).max(), np.abs(np.asarray(v_new) - after.v[0]).max())
    target = [link.name for link in after.robot.links].index(body.base)
    return float(gap), np.asarray(impulse)[target]
