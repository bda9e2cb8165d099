"""The reach of a free-floating robot in CasADi. It starts at rest with its base at the world's origin."""

import casadi as ca
import numpy as np

from planners import symbolic
from planners.collocation import Drift, base_of, collocated, drift_of, limit_joints, running_cost, symbols
from planners.referee import Programme, matrix


def miss(system: Drift, n: int, frame: str, goal) -> ca.Function:
    """(q, quat) -> what the frame lacks to the goal at rest, as `reach.miss`: place [3], and turn [3] if asked for."""
    q, quat = names = symbols(q=n, quat=4)
    none = ca.DM.zeros(n)
    base = base_of(system, q, none, quat, ca.DM.zeros(3))
    F, r, _, _ = symbolic.frame_motion(system.tree, q, base.twist, none, frame)
    out = [system.centre + base.R @ (r - base.centre) - ca.DM(goal.position)]
    if goal.quaternion:
        D = symbolic.rotation(ca.DM(goal.quaternion)).T @ base.R @ F
        turn = ca.vertcat(D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1])
        out.append(turn / ca.sqrt(1 + ca.trace(D)))
    return ca.Function("miss", names, [ca.vertcat(*out)])


def programme(task, problem, z) -> Programme:
    """The task, to be started from the variables z of `problem`."""
    nlp, form, n = Programme(problem, z), problem.form.values, len(task.joints)
    spline, still = form.spline, ca.DM.ones(3, 1)
    T = nlp.x["duration"][0] if "duration" in nlp.x else ca.DM(task.phases["reach"].duration[0])
    P = ca.vertcat(still @ ca.DM(task.start).T, nlp.x["reach"], still @ nlp.x["end"].T)
    system = drift_of(task.chaser, task.first, np.zeros(task.chaser.nv))
    path = collocated(nlp, system, spline, form.intervals, P, T, ca.DM([1, 0, 0, 0]))
    nlp.cost += running_cost(task, path, T / form.intervals) + task.weights.time * T
    nlp.equal(miss(system, n, task.robot.frame, task.goal)(path.q[:, -1], path.quat[:, -1]))
    limit_joints(nlp, task, [P], [matrix(spline.hull(1)) @ P / T], [path.tau])
    return nlp
