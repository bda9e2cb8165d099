"""The grasp of a tumbling target in CasADi.

The target's attitude is a spline through a motion integrated by scipy. The chaser starts at rest with its base at the
world's origin, as every task says.
"""

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

from planners import grasp, referee_mission, symbolic
from planners.collocation import (
    PUSHED,
    Drift,
    base_of,
    collocated,
    drift_of,
    instant,
    joined,
    later,
    limit_joints,
    running_cost,
    symbols,
    turned,
)
from planners.referee import Programme, matrix

TUMBLE = (0.05, 1e-13)  # step of the target's table [s], and the tolerance of what it holds


def errors(system: Drift, target: Drift, n: int, hand: str, grip: str, room: int) -> ca.Function:
    """(q, rates, quat, w, push, target's quat, time) -> the hand relative to the grasp frame [12], as
    `grasp.relative`.
    """
    q, rates, quat, w, push, *_ = names = symbols(q=n, rates=n, quat=4, w=3, push=room, quat_t=4, time=1)
    now, none = instant(system, push), ca.DM.zeros(0)
    base, body = base_of(now, q, rates, quat, w), symbolic.rotation(names[-2])
    twist = _free_twist(target, body)
    frames = []
    for drift, R, centre, V, frame in (
        (now, base.R, base.centre, base.twist, (q, rates, hand)),
        (later(target, names[-1]), body, symbolic.centre_of_mass(target.tree, none), twist, (none, none, grip)),
    ):
        F, r, spin, slide = symbolic.frame_motion(drift.tree, frame[0], V, *frame[1:])
        origin = drift.centre - R @ centre
        frames.append((R @ F, origin + R @ r, R @ spin, R @ slide))
    (R_h, p_h, w_h, v_h), (R_g, p_g, w_g, v_g) = frames
    D = R_g.T @ R_h
    turn = ca.vertcat(D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]) / ca.sqrt(1 + ca.trace(D))
    return ca.Function("errors", names, [ca.vertcat(p_h - p_g, turn, w_h - w_g, v_h - v_g)])


def _free_twist(body: Drift, R):
    """Twist of a rigid body, from its momentum."""
    (link,) = body.tree.bodies
    w = ca.solve(ca.DM(link.inertia), R.T @ body.angular)
    return ca.vertcat(w, R.T @ body.linear / link.mass - ca.cross(w, link.centre))


def tumbling(body: Drift, quat, horizon) -> ca.Function:
    """time -> attitude (quaternion) of a rigid body that nothing acts on."""
    Q, (step, tolerance) = ca.SX.sym("Q", 4), TUMBLE
    rate = ca.Function("rate", [Q], [turned(Q, _free_twist(body, symbolic.rotation(Q))[:3])])
    times = np.arange(-1.0, horizon + 1.0, step)
    options = dict(method="DOP853", rtol=tolerance, atol=tolerance)
    sides = [
        solve_ivp(lambda t, x: rate(x).full().ravel(), (0.0, end), quat, t_eval=at, **options).y
        for end, at in ((times[0], times[times <= 0][::-1]), (times[-1], times[times > 0]))
    ]
    table = np.hstack([sides[0][:, ::-1], sides[1]])
    return ca.interpolant("tumbling", "bspline", [times], table.ravel(order="F"), {"degree": [5]})


def programme(task, problem, z) -> Programme:
    """The task, to be started from the variables z of `problem`."""
    nlp, n = Programme(problem, z), len(task.joints)
    grid, x = problem.form.values.grid, nlp.x
    q_body = task.body.configuration(position=task.target.position, quaternion=task.target.quaternion)
    target = drift_of(task.body, q_body, np.array(task.target.twist))
    alone = drift_of(task.chaser, task.first, np.zeros(task.chaser.nv))
    compound = joined(alone, target, task.compound)
    wait, *T = ca.vertsplit(x["durations"])
    rest = ca.DM.zeros(1, n)
    stops = [ca.vertcat(ca.DM(task.start).T, rest, rest), x["track_state"], x["grasp_state"]]
    stops.append(ca.vertcat(x["end"].T, rest, rest))
    quat, now = ca.DM([1, 0, 0, 0]), alone
    points, rates, paths = [], [], []
    for k, (name, spline) in enumerate(zip(grasp.MOVING, grid.splines, strict=True)):
        powers = ca.vertcat(1, T[k], T[k] ** 2) @ ca.DM.ones(1, n)
        first, last = map(ca.DM, spline.ends)
        P = ca.vertcat(first @ (powers * stops[k]), x[name], last @ (powers * stops[k + 1]))
        system = compound if name == "stabilise" else alone
        if task.base and name == "stabilise":
            now = joined(now, later(target, wait + T[0] + T[1]), task.compound)
        wrench = _wrench(x, name, problem.data.push) if task.base else None
        path = collocated(nlp, now if task.base else system, spline, grid.intervals[k], P, T[k], quat, wrench)
        quat, now = path.quat[:, -1], instant(now, path.push[:, -1])
        points.append(P)
        rates.append(matrix(spline.hull(1)) @ P / T[k])
        paths.append(path)
        nlp.cost += running_cost(task, path, T[k] / grid.intervals[k])
    nlp.cost += task.weights.time * ca.sum1(x["durations"])

    track = paths[1]
    horizon = sum(phase.duration[1] for phase in task.phases.values())
    times = wait + T[0] + T[1] * ca.DM(np.linspace(0, 1, grid.intervals[1] + 1)).T
    attitude = tumbling(target, np.array(task.target.quaternion), horizon)
    room = PUSHED if task.base else 0
    see = errors(alone, target, n, task.robot.frame, f"target_{task.target.frame}", room).map(track.q.shape[1])
    e = see(track.q, track.rates, track.quat, track.w, track.push, attitude(times), times)
    at, ends = list(problem.form.values.poses), [0, grid.intervals[1]]
    for rows, where in ((e[:3, :], at), (e[3:6, :], at), (e[6:9, :], ends), (e[9:, :], ends)):
        nlp.equal(rows[:, where])
    limit_joints(nlp, task, points, rates, [path.tau for path in paths])
    if task.base:
        nlp.below(ca.vertcat(*(x[f"push_{name}"] for name in grasp.MOVING)), -1, 1)
    nlp.below(e[6:, :].T, -task.tolerance.speed / 2, task.tolerance.speed / 2)
    scene = referee_mission.Scene(alone, target, compound, attitude, paths, wait, T)
    referee_mission.limit(nlp, task, scene)
    return nlp


def _wrench(x, name, push):
    """Control points [count - 2, 6] of moment and force on the base in a phase."""
    P = ca.vertcat(x["push_approach"][-1, :], x[f"push_{name}"]) if name == "track" else x[f"push_{name}"]
    return ca.horzcat(P @ ca.diag(ca.DM(push.limits)), ca.DM(P.shape[0], 6 - P.shape[1]))
