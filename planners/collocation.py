"""The motion of a free base in CasADi, by collocation of its momentum.

Of every grid point, the joints' path, the base's attitude (quaternion), its angular velocity and its acceleration are
variables of their own. What holds them: the splines (linear in the control points), the momentum about the centre of
mass, no wrench on the base but what pushes it, and Hermite-Simpson collocation of the attitude, with the joints' path
between two points as the quintic polynomial through their positions, rates and accelerations. Where something pushes
the base, momentum and centre of mass are variables of the points too, held like the attitude: a column [PUSHED] each.

Source: Hargraves and Paris (1987), Direct trajectory optimization (the collocation).
"""

from typing import NamedTuple

import casadi as ca
import numpy as np

import sdyn
from planners import symbolic
from planners.bspline import Clamped
from planners.referee import Programme, matrix
from planners.symbolic import Tree


def symbols(**sizes):
    """Scalars and vectors of these sizes."""
    return [ca.SX.sym(name, size) for name, size in sizes.items()]


PUSHED = 15  # centre of mass, angular momentum about it, linear momentum, world axes; moment and force, base axes


class Drift(NamedTuple):
    """A system that nothing acts on, or what it is at one instant; world axes."""

    tree: Tree
    linear: ca.DM  # [3] momentum, N s
    angular: ca.DM  # [3] about the centre of mass, N m s
    centre: ca.DM  # [3] centre of mass at time zero, or at the instant, m


def drift_of(robot: sdyn.Robot, q, v) -> Drift:
    """The drift of a robot from its state at time zero."""
    tree, R = symbolic.tree_of(sdyn.pack(robot)), symbolic.rotation(ca.DM(q[3:7]))
    c = symbolic.centre_of_mass(tree, ca.DM(q[7:]))
    h = symbolic.momentum(tree, ca.DM(q[7:]), ca.DM(v[:6]), ca.DM(v[6:]))
    return Drift(tree, R @ h[3:], R @ (h[:3] - ca.cross(c, h[3:])), q[:3] + R @ c)


def joined(a: Drift, b: Drift, robot: sdyn.Robot) -> Drift:
    """Two systems as one, of the structure of a robot."""
    tree = symbolic.tree_of(sdyn.pack(robot))
    centre = (a.tree.mass * a.centre + b.tree.mass * b.centre) / (a.tree.mass + b.tree.mass)
    angular = sum(x.angular + ca.cross(x.centre - centre, x.linear) for x in (a, b))
    return Drift(tree, a.linear + b.linear, angular, centre)


def later(system: Drift, time) -> Drift:
    """The system at a later instant."""
    return system._replace(centre=system.centre + system.linear * time / system.tree.mass)


def instant(system: Drift, push) -> Drift:
    """The system as a column [PUSHED] says, where there is one; else as it is."""
    return Drift(system.tree, push[6:9], push[3:6], push[:3]) if push.numel() else system


def gained(tree: Tree, q, R, push):
    """Rates of a column's centre of mass and momenta [9]."""
    moment, force = push[9:12], push[12:]
    about_centre = moment - ca.cross(symbolic.centre_of_mass(tree, q), force)
    return ca.vertcat(push[6:9] / tree.mass, R @ about_centre, R @ force)


def on_base(push):
    """Moment about the base's origin and force, its axes, [6]."""
    return push[9:] if push.numel() else ca.DM.zeros(6)


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


def point(system: Drift, n: int, room: int = 0) -> ca.Function:
    """(q, rates, accelerations, quat, w, a, push [room]) -> (momentum and base wrench that must be zero [9], torques
    [n], what acts on the base [6]).
    """
    q, rates, qdd, quat, w, a, push = names = symbols(q=n, rates=n, qdd=n, quat=4, w=3, a=6, push=room)
    base = base_of(instant(system, push), q, rates, quat, w)
    wrench, tau = symbolic.newton_euler(system.tree, q, base.twist, rates, a, qdd)
    acting = on_base(push)
    return ca.Function("point", names, [ca.vertcat(base.miss, wrench - acting), tau, acting])


def turned(quat, w):
    """Rate of a quaternion."""
    return symbolic.product(quat, ca.vertcat(0, w)) / 2


def between(system: Drift, n: int, room: int = 0) -> ca.Function:
    """Of one interval: (q, rates, accelerations, quat, w, push) at both ends, wrench on the base and w in the middle,
    its length -> zero [7, or 16 with a push].
    """
    start, end = (symbols(q=n, rates=n, qdd=n, quat=4, w=3, push=room) for _ in range(2))
    wrench, w, h = symbols(wrench=6 if room else 0, w=3, h=1)
    (q0, v0, a0, Q0, w0, push0), (q1, v1, a1, Q1, w1, push1) = start, end
    q = (q0 + q1) / 2 + 5 * h / 32 * (v0 - v1) + h**2 / 64 * (a0 + a1)
    rates = 15 / 8 * (q1 - q0) / h - 7 / 16 * (v0 + v1) + h / 32 * (a1 - a0)
    d0, d1 = turned(Q0, w0), turned(Q1, w1)
    middle = (Q0 + Q1) / 2 + h / 8 * (d0 - d1)
    zero, now = [Q1 - Q0 - h / 6 * (d0 + 4 * turned(middle, w) + d1)], system
    if room:
        ends = ((q0, Q0, push0), (q1, Q1, push1))
        e0, e1 = (gained(system.tree, q, symbolic.rotation(Q), push) for q, Q, push in ends)
        push = ca.vertcat((push0[:9] + push1[:9]) / 2 + h / 8 * (e0 - e1), wrench)
        rate, now = gained(system.tree, q, symbolic.rotation(middle), push), instant(system, push)
        zero.append(push1[:9] - push0[:9] - h / 6 * (e0 + 4 * rate + e1))
    names = [*start, *end, wrench, w, h]
    return ca.Function("between", names, [ca.vertcat(base_of(now, q, rates, middle, w).miss, *zero)])


class Path(NamedTuple):
    """One phase at its grid's points, a column each."""

    q: ca.MX
    rates: ca.MX
    qdd: ca.MX
    quat: ca.MX
    w: ca.MX
    a: ca.MX
    push: ca.MX  # without rows where nothing pushes
    tau: ca.MX
    acting: ca.MX  # [6] on the base


def collocated(nlp: Programme, system: Drift, spline, intervals: int, P, T, quat, wrench=None) -> Path:
    """The motion of one phase, as variables and rows of a programme.

    It starts with the attitude `quat`. With control points [count - 2, 6] of the wrench on the base, the system is what
    it is where the phase starts.
    """
    n, K, s = P.shape[1], intervals + 1, np.linspace(0, 1, intervals + 1)
    splines = [(matrix(spline.basis(s, order)) @ P).T for order in range(3)]
    numbers = [nlp.value(x / T**order).full() for order, x in enumerate(splines)]
    acting, halfway = ca.DM(0, K), ca.DM(0, intervals)
    if wrench is not None:
        cubic = Clamped(spline.count - 2, spline.degree - 2)
        acting, halfway = ((matrix(cubic.basis(at)) @ wrench).T for at in (s, (s[1:] + s[:-1]) / 2))
    now = [nlp.value(x) for x in (ca.vertcat(system.centre, system.angular, system.linear), quat, acting)]
    guess = simulated(system, numbers, nlp.value(T / intervals), *now)
    q, rates, qdd = path = [nlp.variable(x) for x in numbers]
    Q, w, a, middle = (nlp.variable(x) for x in guess[:-1])
    for order, (x, wanted) in enumerate(zip(path, splines, strict=True)):
        nlp.zero(x * T**order - wanted)
    nlp.zero(Q[:, 0] - quat)
    push = acting
    if wrench is not None:
        push = ca.vertcat(nlp.variable(guess[-1]), acting)
        nlp.zero(push[:9, 0] - ca.vertcat(system.centre, system.angular, system.linear))
    room = push.shape[0]
    zero, tau, acting = point(system, n, room).map(K)(q, rates, qdd, Q, w, a, push)
    nlp.zero(zero)
    start, end = ([x[:, part] for x in (q, rates, qdd, Q, w, push)] for part in (slice(0, K - 1), slice(1, K)))
    h = ca.repmat(T / intervals, 1, intervals)
    nlp.zero(between(system, n, room).map(intervals)(*start, *end, halfway, middle, h))
    return Path(q, rates, qdd, Q, w, a, push, tau, acting)


def simulated(system: Drift, path, h, state, quat, acting):
    """First guesses of attitude, angular velocity and acceleration at the points, angular velocity between them, and
    momenta: Heun's method along the joints' path, Euler's for what a push gives.
    """
    (n, K), room = path[0].shape, PUSHED * (acting.numel() > 0)
    q, rates, qdd, Q, w, a, push = names = symbols(q=n, rates=n, qdd=n, quat=4, w=3, a=6, push=room)
    zero, _, _ = point(system, n, room)(*names)
    J = ca.substitute(ca.jacobian(zero, ca.vertcat(w, a)), ca.vertcat(w, a), ca.DM.zeros(9))
    spin = -ca.solve(J[:3, :3], ca.substitute(zero[:3], w, ca.DM.zeros(3)))
    pull = -ca.solve(J[3:, 3:], ca.substitute(zero[3:], ca.vertcat(w, a), ca.vertcat(spin, ca.DM.zeros(6))))
    gain = gained(system.tree, q, symbolic.rotation(Q), push) if room else ca.DM.zeros(9)
    f = ca.Function("f", [q, rates, qdd, Q, push], [spin, pull, gain])
    quats, spins, pulls, states = [quat.full().ravel()], [], [], [state.full().ravel()]
    for k in range(K):
        column = lambda k, y: ca.vertcat(y, acting[:, k])[:room]
        spin, pull, gain = (x.full().ravel() for x in f(*(x[:, k] for x in path), quats[k], column(k, states[k])))
        spins.append(spin)
        pulls.append(pull)
        if k < K - 1:
            d, then = turned(ca.DM(quats[k]), spin), states[k] + h.full().ravel() * gain
            ahead = quats[k] + (h * d).full().ravel()
            later, _, _ = f(*(x[:, k + 1] for x in path), ahead, column(k + 1, then))
            new = quats[k] + (h / 2 * (d + turned(ca.DM(ahead), later))).full().ravel()
            quats.append(new / np.linalg.norm(new))
            states.append(then)
    quats, spins, pulls, states = (np.array(x).T for x in (quats, spins, pulls, states))
    return quats, spins, pulls, (spins[:, :-1] + spins[:, 1:]) / 2, states


def running_cost(task, path: Path, h):
    """Integral of the mean squares of relative torque and acceleration, and of the squares of what acts on the base, by
    the trapezoid rule.
    """
    weights = np.ones(path.q.shape[1])
    weights[[0, -1]] = 0.5
    torque = path.tau / ca.DM(task.torque_limits)
    each = task.weights.torque * ca.sum1(torque**2) + task.weights.smoothness * ca.sum1(path.qdd**2)
    cost = h / len(task.joints) * ca.dot(ca.DM(weights).T, each)
    if task.base is None:
        return cost
    share = np.repeat([task.weights.base_torque, task.weights.base_force], 3)
    return cost + h * ca.dot(ca.DM(weights).T, ca.DM(share).T @ path.acting**2)


def limit_joints(nlp: Programme, task, points, rates, torques) -> None:
    """Rows of joint limits: of control points of position and of rate, [count, n] each, and of torques [n, k]."""
    nlp.below(ca.vertcat(*points), *np.clip(task.position_limits, -1e3, 1e3).T)
    of = lambda x, limits: (x.T / ca.DM(limits)).T
    nlp.below(of(ca.vertcat(*rates), task.rate_limits), -1, 1)
    nlp.below(of(ca.horzcat(*torques).T, task.torque_limits), task.limits.margin - 1, 1 - task.limits.margin)
