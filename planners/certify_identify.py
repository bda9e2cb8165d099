"""What an identification manoeuvre must keep besides limits and dynamics."""

import numpy as np

from planners.certify import LIMIT, Row, see


def rows(task, plan) -> list[Row]:
    """Start and end at rest in one posture, zero momentum, turn of the base."""
    phase, n = plan.phases[0], len(task.joints)
    seen = see([(phase.robot, phase.robot.frames[0].name, phase.q, phase.v)])[0]
    quat = phase.q[:, 3:7]
    turn = 2 * np.arccos(np.clip(np.abs(quat @ quat[0]), 0, 1)).max()
    posture = max(np.abs(phase.q[0] - task.first).max(), np.abs(phase.q[-1, -n:] - phase.q[0, -n:]).max())
    out = [
        Row("start or end differs from the posture", float(posture), 1e-9, "m, rad"),
        Row("speed at start and end", float(np.abs(phase.v[[0, -1]]).max()), LIMIT, "rad/s, m/s"),
        Row("total momentum", float(np.abs(seen.momentum).max()), LIMIT, "N m s, N s"),
    ]
    if task.attitude:
        out.append(Row("turn of the base", float(turn), task.attitude + LIMIT, "rad"))
    return out
