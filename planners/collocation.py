"""A free-floating motion in CasADi, by collocation of the base's momentum.

Of every grid point, the joints' path, the base's attitude (quaternion), its angular velocity and its acceleration are
variables of their own. What holds them: the splines (linear in the control points), the momentum about the centre of
mass, no wrench on the base, and Hermite-Simpson collocation of the attitude, with the joints' path between two points
as the quintic polynomial through their positions, rates and accelerations.

Source: Hargraves and Paris (1987), Direct trajectory optimization (the collocation).
"""

from typing import NamedTuple

import casadi as ca
import numpy as np

import sdyn
from planners import symbolic
from planners.referee import Programme, matrix
from planners.symbolic import Tree


def symbols(**sizes):
    """Scalars and vectors of these sizes."""
    return [ca.SX.sym(name, size) for name, size in sizes.items()]


class Drift(NamedTuple):
    """A system that nothing acts on; world axes, numbers."""

    tree: Tree
    linear: np.ndarray  # [3] momentum, N s
    angular: np.ndarray  # [3] about the centre of mass, N m s
    centre: np.ndarray  # [3] centre of mass at time zero, m


def drift_of(robot: sdyn.Robot, q, v) -> Drift:
    """The drift of a robot from its state at time zero."""
    tree, R = symbolic.tree_of(sdyn.pack(robot)), symbolic.rotation(ca.DM(q[3:7]))
    c = symbolic.centre_of_mass(tree, ca.DM(q[7:]))
    h = symbolic.momentum(tree, ca.DM(q[7:]), ca.DM(v[:6]), ca.DM(v[6:]))
    numbers = R @ h[3:], R @ (h[:3] - ca.cross(c, h[3:])), q[:3] + R @ c
    return Drift(tree, *(x.full().ravel() for x in numbers))


def joined(a: Drift, b: Drift, robot: sdyn.Robot) -> Drift:
    """Two systems as one, of the structure of a robot."""
    tree = symbolic.tree_of(sdyn.pack(robot))
    centre = (a.tree.mass * a.centre + b.tree.mass * b.centre) / (a.tree.mass + b.tree.mass)
    angular = sum(x.angular + np.cross(x.centre - centre, x.linear) for x in (a, b))
    return Drift(tree, a.linear + b.linear, angular, centre)


class Base(NamedTuple):
    """The base at one instant, as far as momentum gives it from its attitude and angular velocity."""

    R: ca.SX
    centre: ca.SX  # of mass, from the base's origin, base axes
    twist: ca.SX  # [6] base axes
    miss: ca.SX  # [3] angular momentum that is too much, base axes


def base_of(system: Drift, q, rates, quat, w) -> Base:
    """What momentum says; `miss` is zero where w is right."""
    tree, R = system.tree, symbolic.rotation(quat)
    c = symbolic.centre_of_mass(tree, q)
    h = symbolic.momentum(tree, q, ca.vertcat(w, ca.DM.zeros(3)), rates)
    P = R.T @ system.linear
    v = (P - h[3:]) / tree.mass
    angular = h[:3] + tree.mass * ca.cross(c, v) - ca.cross(c, P)
    return Base(R, c, ca.vertcat(w, v), angular - R.T @ system.angular)


def point(system: Drift, n: int) -> ca.Function:
    """(q, rates, accelerations, quat, w, a) -> (momentum and base wrench that must be zero [9], torques [n])."""
    q, rates, qdd, quat, w, a = names = symbols(q=n, rates=n, qdd=n, quat=4, w=3, a=6)
    base = base_of(system, q, rates, quat, w)
    wrench, tau = symbolic.newton_euler(system.tree, q, base.twist, rates, a, qdd)
    return ca.Function("point", names, [ca.vertcat(base.miss, wrench), tau])


def turned(quat, w):
    """Rate of a quaternion."""
    return symbolic.product(quat, ca.vertcat(0, w)) / 2


def between(system: Drift, n: int) -> ca.Function:
    """Of one interval: (q, rates, accelerations, quat, w) at both ends, w in the middle, its length -> zero [7]."""
    start, end = (symbols(q=n, rates=n, qdd=n, quat=4, w=3) for _ in range(2))
    w, h = symbols(w=3, h=1)
    (q0, v0, a0, Q0, w0), (q1, v1, a1, Q1, w1) = start, end
    q = (q0 + q1) / 2 + 5 * h / 32 * (v0 - v1) + h**2 / 64 * (a0 + a1)
    rates = 15 / 8 * (q1 - q0) / h - 7 / 16 * (v0 + v1) + h / 32 * (a1 - a0)
    d0, d1 = turned(Q0, w0), turned(Q1, w1)
    middle = (Q0 + Q1) / 2 + h / 8 * (d0 - d1)
    gap = Q1 - Q0 - h / 6 * (d0 + 4 * turned(middle, w) + d1)
    return ca.Function("between", [*start, *end, w, h], [ca.vertcat(base_of(system, q, rates, middle, w).miss, gap)])


class Path(NamedTuple):
    """One phase at its grid's points, a column each."""

    q: ca.MX
    rates: ca.MX
    qdd: ca.MX
    quat: ca.MX
    w: ca.MX
    a: ca.MX
    tau: ca.MX


def collocated(nlp: Programme, system: Drift, spline, intervals: int, P, T, quat) -> Path:
    """The motion of one phase, as variables and rows of a programme; it starts with the attitude `quat`."""
    n, K, s = P.shape[1], intervals + 1, np.linspace(0, 1, intervals + 1)
    splines = [(matrix(spline.basis(s, order)) @ P).T for order in range(3)]
    numbers = [nlp.value(x / T**order).full() for order, x in enumerate(splines)]
    guess = simulated(system, numbers, nlp.value(T / intervals), nlp.value(quat))
    q, rates, qdd = path = [nlp.variable(x) for x in numbers]
    Q, w, a, middle = (nlp.variable(x) for x in guess)
    for order, (x, wanted) in enumerate(zip(path, splines, strict=True)):
        nlp.zero(x * T**order - wanted)
    nlp.zero(Q[:, 0] - quat)
    zero, tau = point(system, n).map(K)(q, rates, qdd, Q, w, a)
    nlp.zero(zero)
    start, end = ([x[:, part] for x in (q, rates, qdd, Q, w)] for part in (slice(0, K - 1), slice(1, K)))
    nlp.zero(between(system, n).map(intervals)(*start, *end, middle, ca.repmat(T / intervals, 1, intervals)))
    return Path(q, rates, qdd, Q, w, a, tau)


def simulated(system: Drift, path, h, quat):
    """First guesses of attitude, angular velocity and acceleration at the points, and angular velocity between them:
    Heun's method along the joints' path.
    """
    n, K = path[0].shape
    q, rates, qdd, Q, w, a = names = symbols(q=n, rates=n, qdd=n, quat=4, w=3, a=6)
    zero, _ = point(system, n)(*names)
    J = ca.substitute(ca.jacobian(zero, ca.vertcat(w, a)), ca.vertcat(w, a), ca.DM.zeros(9))
    spin = -ca.solve(J[:3, :3], ca.substitute(zero[:3], w, ca.DM.zeros(3)))
    push = -ca.solve(J[3:, 3:], ca.substitute(zero[3:], ca.vertcat(w, a), ca.vertcat(spin, ca.DM.zeros(6))))
    f = ca.Function("f", [q, rates, qdd, Q], [spin, push])
    quats, spins, pushes = [quat.full().ravel()], [], []
    for k in range(K):
        spin, push = (x.full().ravel() for x in f(*(x[:, k] for x in path), quats[k]))
        spins.append(spin)
        pushes.append(push)
        if k < K - 1:
            d = turned(ca.DM(quats[k]), spin)
            ahead = quats[k] + (h * d).full().ravel()
            later, _ = f(*(x[:, k + 1] for x in path), ahead)
            new = quats[k] + (h / 2 * (d + turned(ca.DM(ahead), later))).full().ravel()
            quats.append(new / np.linalg.norm(new))
    quats, spins, pushes = (np.array(x).T for x in (quats, spins, pushes))
    return quats, spins, pushes, (spins[:, :-1] + spins[:, 1:]) / 2


def running_cost(task, path: Path, h):
    """Integral of the mean squares of relative torque and acceleration, by the trapezoid rule."""
    weights = np.ones(path.q.shape[1])
    weights[[0, -1]] = 0.5
    torque = path.tau / ca.DM(task.torque_limits)
    each = task.weights.torque * ca.sum1(torque**2) + task.weights.smoothness * ca.sum1(path.qdd**2)
    return h / len(task.joints) * ca.dot(ca.DM(weights).T, each)


def limit_joints(nlp: Programme, task, points, rates, torques) -> None:
    """Rows of joint limits: of control points of position and of rate, [count, n] each, and of torques [n, k]."""
    nlp.below(ca.vertcat(*points), *np.clip(task.position_limits, -1e3, 1e3).T)
    of = lambda x, limits: (x.T / ca.DM(limits)).T
    nlp.below(of(ca.vertcat(*rates), task.rate_limits), -1, 1)
    nlp.below(of(ca.horzcat(*torques).T, task.torque_limits), task.limits.margin - 1, 1 - task.limits.margin)
