"""A chaser and what it has grasped come to rest, in CasADi.

Each grid point has variables of its own for coordinates, rates and accelerations, which the spline's control points
hold, and the momentum of all gives the base's velocity. The rotation vector turns into a quaternion by entire series,
and rates follow from CasADi's own derivatives.
"""

import casadi as ca
import numpy as np

import sdyn
from planners import flying, symbolic
from planners.collocation import symbols
from planners.referee import Programme, matrix

TERMS = 16  # of the series of sine and cosine of half the angle, below 3.2 rad: rounding is larger than the rest


def quaternion(theta):
    """Quaternion wxyz of a rotation vector."""
    x, cosine, sine, term = ca.sumsqr(theta) / 4, 0, 0, 1
    for k in range(TERMS):
        cosine, sine = cosine + term, sine + term / (2 * k + 1)
        term = -term * x / ((2 * k + 1) * (2 * k + 2))
    return ca.vertcat(cosine, sine / 2 * theta)


def point(tree: symbolic.Tree, n: int) -> ca.Function:
    """(coordinates, rates, accelerations, acceleration of the base's origin) -> (force that is not the mass times
    acceleration of the centre of mass [3], wrench and torques [6 + n], velocities [6 + n]).
    """
    x, rate, acceleration, a = names = symbols(x=6 + n, rate=6 + n, acceleration=6 + n, a=3)
    quat = quaternion(x[3:6])
    quat1 = ca.jtimes(quat, x[3:6], rate[3:6])
    quat2 = ca.jtimes(quat1, ca.vertcat(x[3:6], rate[3:6]), ca.vertcat(rate[3:6], acceleration[3:6]))
    conjugate, R = ca.vertcat(quat[0], -quat[1:]), symbolic.rotation(quat)
    w, wdot = (2 * symbolic.product(conjugate, y)[1:] for y in (quat1, quat2))
    h = symbolic.momentum(tree, x[6:], ca.vertcat(w, ca.DM.zeros(3)), rate[6:])
    v = R.T @ rate[:3] - h[3:] / tree.mass
    wrench, tau = symbolic.newton_euler(tree, x[6:], ca.vertcat(w, v), rate[6:], ca.vertcat(wdot, a), acceleration[6:])
    lacks = wrench[3:] - tree.mass * R.T @ acceleration[:3]
    return ca.Function("point", names, [lacks, ca.vertcat(wrench, tau), ca.vertcat(w, v, rate[6:])])


def programme(task, problem, z) -> Programme:
    """The task, to be started from the variables z of `problem`."""
    nlp, values, data = Programme(problem, z), problem.form.values, problem.data
    tree, n, K = symbolic.tree_of(sdyn.pack(task.compound)), len(task.joints), values.intervals + 1
    T, s = nlp.x["duration"][0], np.linspace(0, 1, K)
    braking, bent = map(matrix, values.spline.between)
    x, rate, reply = (ca.DM(np.asarray(x)) for x in data.start)
    P = braking @ ca.vertcat(x.T, T * rate.T, T * nlp.x["end"].T) + T**2 * bent @ (reply @ nlp.x["efforts"]).T
    splines = [(matrix(values.spline.basis(s, order)) @ P).T for order in range(3)]
    path = [nlp.variable(nlp.value(x / T**order).full()) for order, x in enumerate(splines)]
    for order, (x, wanted) in enumerate(zip(path, splines, strict=True)):
        nlp.zero(x * T**order - wanted)
    at, still = point(tree, n).map(K), ca.DM.zeros(3, K)
    a = nlp.variable(-nlp.value(at(*path, still)[0]).full() / tree.mass)
    lacks, acting, v = at(*path, a)
    nlp.zero(lacks)

    weights = np.ones(K)
    weights[[0, -1]] = 0.5
    squares = ca.DM(np.asarray(data.weights)).T @ acting**2
    nlp.cost += task.weights.time * T + T / values.intervals * squares @ ca.DM(weights)
    nlp.cost += ca.dot(ca.DM(np.asarray(data.end_weights)), v[:, -1] ** 2)
    of, free = lambda x, limits: (x / ca.DM(limits)).T, 1 - task.limits.margin
    nlp.below(P[:, 6:], *np.clip(task.position_limits, -1e3, 1e3).T)
    nlp.below(of((matrix(values.spline.hull(1)) @ P[:, 6:] / T).T, task.rate_limits), -1, 1)
    nlp.below(of(acting[6:, :], task.torque_limits), -free, free)
    nlp.below(of(acting[:6, :], task.base_limits), -free, free)
    nlp.below(P[:, 3:6], -flying.TURN, flying.TURN)
    nlp.below((v[:, -1] / ca.DM(np.asarray(data.rest)))[list(values.resting)].T, -1, 1)
    return nlp
