"""The manoeuvre that shows the inertial parameters of a free-floating base, in CasADi.

With phi the ten parameters of the base, W its wrench and H the momentum, all about its origin and in its axes, and
total momentum zero,

    M dV/dphi = -dH/dphi,   M da/dphi = -dW/dphi - dW/dV dV/dphi,   M = dH/dV = dW/da,

where `identify` differentiates the momentum in time instead. Sums over the grid, of the information and of the
attitude's sensitivity, are variables too.
"""

import casadi as ca
import numpy as np

from planners import inertial, symbolic
from planners.collocation import Drift, base_of, collocated, drift_of, limit_joints, running_cost, symbols
from planners.referee import Programme, matrix
from planners.task import TaskError

UPPER = np.triu_indices(10)


def _momentum(phi, V):
    """Momentum of one body with parameters phi (m, m c, I about the origin)."""
    rows = ((4, 5, 6), (5, 7, 8), (6, 8, 9))
    I = ca.vertcat(*(ca.horzcat(*(phi[k] for k in row)) for row in rows))
    return ca.vertcat(I @ V[:3] + ca.cross(phi[1:4], V[3:]), phi[0] * V[3:] + ca.cross(V[:3], phi[1:4]))


def sensitivities(system: Drift, task) -> ca.Function:
    """(q, rates, qdd, quat, w, a) -> what gyro and accelerometer see of the parameters [6, 10], over their noise and
    relative to nominal magnitudes, and the turn of the base that it is the rate of [3, 10], world axes.
    """
    n, sensors = len(task.joints), task.sensors
    q, rates, qdd, quat, w, a = names = symbols(q=n, rates=n, qdd=n, quat=4, w=3, a=6)
    base = base_of(system, q, rates, quat, w)
    V, phi = ca.SX.sym("V", 6), ca.SX.sym("phi", 10)
    wrench, _ = symbolic.newton_euler(system.tree, q, V, rates, a, qdd)
    own = _momentum(phi, a) + symbolic.force_cross(V, _momentum(phi, V))
    _, size = inertial.nominal(task.chaser.link(task.chaser.base))
    factor = ca.chol(ca.jacobian(wrench, a))
    solve = lambda b: -ca.solve(factor, ca.solve(factor.T, b))
    dV = solve(ca.jacobian(_momentum(phi, V), phi) @ ca.diag(size))
    da = solve(ca.jacobian(own, phi) @ ca.diag(size) + ca.jacobian(wrench, V) @ dV)
    lever = ca.DM(sensors.lever)
    felt = a[3:] + ca.cross(V[:3], V[3:] + ca.cross(V[:3], lever)) + ca.cross(a[:3], lever)
    df = ca.jacobian(felt, V) @ dV + ca.jacobian(felt, a) @ da
    weight = lambda noise: 0.0 if noise is None else np.sqrt(sensors.rate) / noise
    seen = ca.vertcat(weight(sensors.gyro) * dV[:3, :], weight(sensors.accelerometer) * df)
    seen, spin = ca.substitute([seen, base.R @ dV[:3, :]], [V], [base.twist])
    return ca.Function("sensitivities", names, [ca.vec(seen), ca.vec(spin)])


def log_det() -> ca.Function:
    """Upper triangle of a symmetric positive matrix [10, 10], row by row -> log of its determinant."""
    x = ca.SX.sym("x", 55)
    S = ca.SX.zeros(10, 10)
    for k, (i, j) in enumerate(zip(*UPPER, strict=True)):
        S[i, j] = S[j, i] = x[k]
    return ca.Function("log_det", [x], [2 * ca.sum1(ca.log(ca.diag(ca.chol(S))))])


def squares(rows: int) -> ca.Function:
    """A matrix S [rows, 10] as a vector -> upper triangle of S^T S."""
    S = ca.SX.sym("S", rows, 10)
    product = S.T @ S
    return ca.Function("squares", [ca.vec(S)], [ca.vertcat(*(product[i, j] for i, j in zip(*UPPER, strict=True)))])


def programme(task, problem, z) -> Programme:
    """The task, to be started from the variables z of `problem`."""
    biased = any(getattr(task.sensors, f"{name}_bias") for name in ("gyro", "accelerometer", "star_tracker"))
    if list(task.unknown) != ["base"] or task.sensors.torque or biased:
        raise TaskError(
            "the referee states the parameters of the base alone, seen by gyro, accelerometer and star tracker "
            'without biases; plan this task with solver "sqp".'
        )
    nlp, form = Programme(problem, z), problem.form.values
    spline, K = form.spline, form.intervals + 1
    T, free = nlp.x["duration"][0], nlp.x["excite"]
    h = T / form.intervals
    still = ca.DM.ones(3, 1) @ ca.DM(task.start).T
    P = ca.vertcat(still, free, still)
    system = drift_of(task.chaser, task.first, np.zeros(task.chaser.nv))
    path = collocated(nlp, system, spline, form.intervals, P, T, ca.DM([1, 0, 0, 0]))
    seen, spin = sensitivities(system, task).map(K)(*path[:-1])
    ends = np.ones(K)
    ends[[0, -1]] = 0.5
    weights = h * ca.DM(ends)
    middles = (spin[:, 1:] + spin[:, :-1]) / 2
    turned = nlp.variable(nlp.value(h * ca.horzcat(ca.DM.zeros(30, 1), ca.cumsum(middles, 1))).full())
    nlp.zero(turned[:, 0])
    nlp.zero(turned[:, 1:] - turned[:, :-1] - h * middles)
    star = 0.0 if task.sensors.star_tracker is None else np.sqrt(task.sensors.rate) / task.sensors.star_tracker
    parts = (squares(6).map(K)(seen) + star**2 * squares(3).map(K)(turned)) @ ca.diag(weights)
    # Relative to the first guess's, so that its entries are about 1. All its sums are variables: one alone would depend
    # on every point, and its row of the Jacobian would cost more than all others.
    sums = nlp.value(ca.cumsum(parts, 1)).full()
    diagonal = UPPER[0] == UPPER[1]
    roots = np.sqrt(sums[diagonal, -1])
    scale = (roots[UPPER[0]] * roots[UPPER[1]])[:, None]
    F, parts = nlp.variable(sums / scale), parts / ca.repmat(ca.DM(scale), 1, K)
    nlp.zero(F[:, 0] - parts[:, 0])
    nlp.zero(F[:, 1:] - F[:, :-1] - parts[:, 1:])
    nlp.cost += running_cost(task, path, h) + task.weights.time * T
    nlp.cost -= task.weights.information * (log_det()(F[:, -1]) + np.log(scale[diagonal]).sum())
    limit_joints(nlp, task, [P], [matrix(spline.hull(1)) @ P / T], [path.tau])
    versine = 2 * ca.sum1(path.quat[1:, :] ** 2) / ca.sum1(path.quat**2)  # 1 - cos of the base's turn
    nlp.below(versine.T / (1 - np.cos(problem.data.attitude)) - 1, -np.inf, 0.0)
    return nlp
