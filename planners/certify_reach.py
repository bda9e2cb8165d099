"""What a reach must keep besides limits and dynamics."""

import functools

import jax
import numpy as np

import sdyn
from planners import balance
from planners.certify import LIMIT, Row, see
from planners.motion import rotations
from planners.problem import ONCE

CLOSED = 1e-9  # rad, m, and their rates


def rows(task, plan) -> list[Row]:
    """Start, rest at both ends, the goal, zero momentum; of closed loops, that they stay closed, and the energy."""
    phase = plan.phases[0]
    (seen,) = see([(phase.robot, task.robot.frame, phase.q, phase.v)])
    out = [
        Row("start differs from the task's", float(np.abs(phase.q[0] - task.first).max()), 1e-12, "m, rad"),
        Row("speed at start and end", float(np.abs(phase.v[[0, -1]]).max()), LIMIT, "rad/s, m/s"),
        Row("distance from the goal", float(np.linalg.norm(seen.p[-1] - task.goal.position)), LIMIT, "m"),
    ]
    if task.robot.dock is None:
        out.append(Row("total momentum", float(np.abs(seen.momentum).max()), LIMIT, "N m s, N s"))
    else:
        moved = max(np.abs(phase.q[:, :7] - task.first[:7]).max(), np.abs(phase.v[:, :6]).max())
        out.append(Row(f"motion of the docked frame {task.robot.dock!r}", float(moved), 1e-12, "m, rad, m/s, rad/s"))
    if task.goal.quaternion:
        (R,) = rotations(np.array([task.goal.quaternion]))
        apart = np.linalg.norm(seen.R[-1] - R)  # of two rotations by a small angle, that times the root of 2
        out.append(Row("turn from the goal", float(2 * np.arcsin(min(apart / np.sqrt(8), 1.0))), LIMIT, "rad"))
    if phase.robot.loops:
        apart, speed = map(np.asarray, _loops(sdyn.pack(phase.robot), phase.q, phase.v))
        out += [
            Row("opening of the loops", float(np.abs(apart).max()), CLOSED, "rad, m"),
            Row("speed at which the loops open", float(np.abs(speed).max()), CLOSED, "rad/s, m/s"),
            balance.energy(phase),
        ]
    return out


@functools.partial(jax.jit, **ONCE)
def _loops(chain, q, v):
    one = lambda q, v: (sdyn.loop_residual(chain, q), sdyn.loop_jacobian(chain, q) @ v)
    return jax.vmap(one)(q, v)
