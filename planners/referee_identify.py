"""The manoeuvre that shows the inertial parameters of a free-floating base, of what it holds, or of both, in CasADi.

With phi the parameters of the bodies that are not known, W the wrench on the base, tau the torques and H the momentum,
about the base's origin and in its axes, and total momentum zero,

    M dV/dphi = -dH/dphi,   M da/dphi = -dW/dphi - dW/dV dV/dphi,   M = dH/dV = dW/da,
    dtau = dtau/dphi + dtau/dV dV/dphi + dtau/da da/dphi,

where `identify` differentiates the momentum in time instead. Biases are parameters too: the determinant of all their
information is divided by that of the biases alone, where `identify` sums squares about a mean. Sums over the grid, of
the information and of the attitude's sensitivity, are variables too.
"""

from dataclasses import replace

import casadi as ca
import numpy as np

import sdyn
from planners import inertial, symbolic
from planners.collocation import Drift, base_of, collocated, drift_of, limit_joints, running_cost, symbols
from planners.referee import Programme, matrix

SEEN = ("gyro", "accelerometer", "torque", "star_tracker")  # in the order of rows; the last from the turn


def _momentum(phi, V):
    """Momentum of one body with parameters phi (m, m c, I about the origin)."""
    rows = ((4, 5, 6), (5, 7, 8), (6, 8, 9))
    I = ca.vertcat(*(ca.horzcat(*(phi[k] for k in row)) for row in rows))
    return ca.vertcat(I @ V[:3] + ca.cross(phi[1:4], V[3:]), phi[0] * V[3:] + ca.cross(V[:3], phi[1:4]))


def _origin(link: str) -> str:
    return f"origin of {link}"


def sensitivities(system: Drift, task, basis) -> ca.Function:
    """(q, rates, qdd, quat, w, a) -> what gyro, accelerometer and torques show of the parameters [6 + n, p], over their
    noise, in a basis [p, p], and the turn of the base that it is the rate of [3, p], world axes.
    """
    n, sensors, links = len(task.joints), task.sensors, task.unknown.values()
    q, rates, qdd, quat, w, a = names = symbols(q=n, rates=n, qdd=n, quat=4, w=3, a=6)
    base = base_of(system, q, rates, quat, w)
    V, phi = ca.SX.sym("V", 6), ca.SX.sym("phi", 10, len(links))
    wrench, tau = symbolic.newton_euler(system.tree, q, V, rates, a, qdd)
    momentum, own = ca.SX.zeros(6 + n), ca.SX.zeros(6 + n)  # of the bodies, on base and joints
    for k, link in enumerate(links):
        R, _, spin, slide = symbolic.frame_motion(system.tree, q, V, rates, _origin(link))
        U = ca.vertcat(R.T @ spin, R.T @ slide)  # twist of the body, its own axes
        J = ca.jacobian(U, ca.vertcat(V, rates))
        A, h = J @ ca.vertcat(a, qdd) + ca.jtimes(U, q, rates), _momentum(phi[:, k], U)
        momentum += J.T @ h
        own += J.T @ (_momentum(phi[:, k], A) + symbolic.force_cross(U, h))
    of_phi = lambda x: ca.jacobian(x, ca.vec(phi)) @ matrix(basis)
    factor = ca.chol(ca.jacobian(wrench, a))
    solve = lambda b: -ca.solve(factor, ca.solve(factor.T, b))
    dV = solve(of_phi(momentum[:6]))
    da = solve(of_phi(own[:6]) + ca.jacobian(wrench, V) @ dV)
    dtau = of_phi(own[6:]) + ca.jacobian(tau, V) @ dV + ca.jacobian(tau, a) @ da
    lever = ca.DM(sensors.lever)
    felt = a[3:] + ca.cross(V[:3], V[3:] + ca.cross(V[:3], lever)) + ca.cross(a[:3], lever)
    df = ca.jacobian(felt, V) @ dV + ca.jacobian(felt, a) @ da
    weight = lambda noise: 0.0 if noise is None else np.sqrt(sensors.rate) / noise
    rows = zip(SEEN[:3], (dV[:3, :], df, dtau), strict=True)
    seen = ca.vertcat(*(weight(getattr(sensors, name)) * row for name, row in rows))
    seen, spin = ca.substitute([seen, base.R @ dV[:3, :]], [V], [base.twist])
    return ca.Function("sensitivities", names, [ca.vec(seen), ca.vec(spin)])


class Information:
    """Of biases and parameters, biases first, as the entries of its upper triangle but for the biases' own."""

    def __init__(self, task):
        s, n = task.sensors, len(task.joints)
        widths = (3, 3, n, 3)
        biased = [getattr(s, name) is not None and getattr(s, f"{name}_bias") for name in SEEN]
        self.star = 0.0 if s.star_tracker is None else np.sqrt(s.rate) / s.star_tracker
        self.columns = np.eye(sum(widths))[:, np.repeat(biased, widths)]  # biases relative to noise / sqrt(rate)
        self.biases, self.size = self.columns.shape[1], self.columns.shape[1] + 10 * len(task.unknown)
        i, j = np.triu_indices(self.size)
        self.entries = [(int(i), int(j)) for i, j in zip(i, j, strict=True) if j >= self.biases]

    def rate(self, biases) -> ca.Function:
        """(what the sensors see [6 + n, p], turn [3, p], as vectors) -> entries of one instant, per second, of unknowns
        that mean these biases [biases, biases + p].
        """
        p = self.size - self.biases
        seen, turned = ca.SX.sym("seen", len(self.columns) - 3, p), ca.SX.sym("turned", 3, p)
        S = ca.horzcat(ca.SX(len(self.columns), self.biases), ca.vertcat(seen, self.star * turned))
        S += matrix(self.columns @ biases)
        entries = ca.vertcat(*(ca.dot(S[:, i], S[:, j]) for i, j in self.entries))
        return ca.Function("rate", [ca.vec(seen), ca.vec(turned)], [entries])

    def whole(self, kind, entries, own):
        """The matrix, of a kind of CasADi's, from its entries and what each bias tells of itself."""
        F = kind(ca.Sparsity.diag(self.size), own)
        for k, (i, j) in enumerate(self.entries):
            F[i, j] = F[j, i] = entries[k]
        return F

    def log_det(self) -> ca.Function:
        """(entries, what each bias tells of itself) -> log determinant of the information of the parameters alone."""
        x, own = symbols(x=len(self.entries), own=1)
        factor = ca.chol(self.whole(ca.SX, x, own))
        return ca.Function("log_det", [x, own], [2 * ca.sum1(ca.log(ca.diag(factor))) - self.biases * ca.log(own)])


def programme(task, problem, z) -> Programme:
    """The task, to be started from the variables z of `problem`."""
    nlp, form = Programme(problem, z), problem.form.values
    spline, K = form.spline, form.intervals + 1
    T, free = nlp.x["duration"][0], nlp.x["excite"]
    h = T / form.intervals
    still = ca.DM.ones(3, 1) @ ca.DM(task.start).T
    P = ca.vertcat(still, free, still)
    origins = tuple(sdyn.Frame(_origin(link), link) for link in task.unknown.values())
    robot = replace(task.chaser, frames=task.chaser.frames + origins)
    system = drift_of(robot, task.first, np.zeros(robot.nv))
    path = collocated(nlp, system, spline, form.intervals, P, T, ca.DM([1, 0, 0, 0]))
    ends = np.ones(K)
    ends[[0, -1]] = 0.5
    weights = h * ca.DM(ends)

    def shown(basis):
        """At the points, what the sensors see, and of every interval, how far the base turns."""
        seen, spin = sensitivities(system, task, basis).map(K)(path.q, path.rates, path.qdd, path.quat, path.w, path.a)
        return seen, h * (spin[:, 1:] + spin[:, :-1]) / 2

    running = lambda turns: ca.horzcat(ca.DM.zeros(turns.shape[0], 1), ca.cumsum(turns, 1))
    known, seconds = Information(task), float(nlp.value(T))
    sizes = np.diag(np.concatenate([inertial.nominal(robot.link(link))[1] for link in task.unknown.values()]))
    seen, turns = shown(sizes)
    first = nlp.value(known.rate(np.eye(known.biases, known.size)).map(K)(seen, running(turns)) @ weights)
    # In the basis in which the first guess's information is the identity: there a step seldom makes it indefinite.
    factor = np.linalg.cholesky(known.whole(ca.DM, first, seconds).full())
    basis = np.linalg.inv(factor).T
    seen, turns = shown(sizes @ basis[known.biases :, known.biases :])
    turned = nlp.variable(nlp.value(running(turns)).full())
    nlp.zero(turned[:, 0])
    nlp.zero(turned[:, 1:] - turned[:, :-1] - turns)
    # What each instant adds is a variable too: else every row of the sum would depend on all points' variables.
    parts = known.rate(basis[: known.biases]).map(K)(seen, turned) @ ca.diag(weights)
    each = nlp.variable(nlp.value(parts).full())
    total = nlp.variable(nlp.value(ca.sum2(parts)).full())
    nlp.zero(each - parts)
    nlp.zero(total - ca.sum2(each))
    told = known.log_det()(total, T / seconds) + 2 * np.log(np.diag(factor)[known.biases :]).sum()
    nlp.cost += running_cost(task, path, h) + task.weights.time * T
    nlp.cost -= task.weights.information * told
    limit_joints(nlp, task, [P], [matrix(spline.hull(1)) @ P / T], [path.tau])
    versine = 2 * ca.sum1(path.quat[1:, :] ** 2) / ca.sum1(path.quat**2)  # 1 - cos of the base's turn
    nlp.below(versine.T / (1 - np.cos(problem.data.attitude)) - 1, -np.inf, 0.0)
    return nlp
