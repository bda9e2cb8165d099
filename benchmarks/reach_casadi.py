"""The common reach as a user of CasADi would write it: articulated bodies in symbols, multiple shooting, IPOPT.

State [position, quaternion xyzw, joints; linear and angular velocity of the base in its axes, joint rates], constant
torques on each interval, RK4 over it. Numbers of the bodies are those of a Pinocchio model, 6-vectors linear first.
Source: Featherstone, Rigid Body Dynamics Algorithms (2008), section 7.3.
"""

import casadi as ca
import numpy as np

OPTIONS = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": 300}


def rotation(x):
    """Matrix of a quaternion xyzw, of any length but zero."""
    K = ca.skew(x[:3])
    return ca.SX.eye(3) + 2 / ca.sumsqr(x) * (x[3] * K + K @ K)


def to_child(R, p):
    """Motion transform from a frame to one at rotation R and position p in it."""
    return ca.blockcat([[R.T, -R.T @ ca.skew(p)], [ca.SX(3, 3), R.T]])


def cross(V):
    """V x, of motions."""
    v, w = ca.skew(V[:3]), ca.skew(V[3:])
    return ca.blockcat([[w, v], [ca.SX(3, 3), w]])


def numbers(x):
    """A sparse matrix of numbers."""
    return ca.sparsify(ca.DM(np.asarray(x)))


class Body:
    """A body of a Pinocchio model behind a revolute joint, or the base: its numbers."""

    def __init__(self, model, k):
        self.up, self.inertia = model.parents[k] - 1, numbers(model.inertias[k].matrix())
        self.place, self.axis = model.jointPlacements[k], np.array(model.joints[k].createData().S).reshape(6, -1)

    def pose(self, q):
        """Rotation and position in the body before it."""
        K = ca.skew(ca.DM(self.axis[3:, 0]))
        turn = ca.SX.eye(3) + ca.sin(q) * K + (1 - ca.cos(q)) * (K @ K)
        return numbers(self.place.rotation) @ turn, ca.DM(self.place.translation)


def bodies(model) -> list[Body]:
    """The base and the bodies of a tree of revolute joints, in the order of the joints."""
    return [Body(model, k) for k in range(1, model.njoints)]


def accelerations(tree, q, V0, qd, tau):
    """Of the base and of the joints, by the articulated-body recursion; nothing pushes the base."""
    X, S, V, c = [None], [None], [V0], [ca.SX(6, 1)]
    for body, x, rate in zip(tree[1:], ca.vertsplit(q), ca.vertsplit(qd), strict=True):
        X.append(to_child(*body.pose(x)))
        S.append(numbers(body.axis))
        V.append(X[-1] @ V[body.up] + S[-1] * rate)
        c.append(cross(V[-1]) @ (S[-1] * rate))
    A = [body.inertia for body in tree]
    p = [-cross(v).T @ (body.inertia @ v) for body, v in zip(tree, V, strict=True)]
    U, D, u = ([None] * len(tree) for _ in range(3))
    for k in range(len(tree) - 1, 0, -1):
        up, U[k], u[k] = tree[k].up, A[k] @ S[k], tau[k - 1] - S[k].T @ p[k]
        D[k] = S[k].T @ U[k]
        left = A[k] - U[k] @ U[k].T / D[k]
        A[up] = A[up] + X[k].T @ left @ X[k]
        p[up] = p[up] + X[k].T @ (p[k] + left @ c[k] + U[k] * (u[k] / D[k]))
    a, qdd = [-ca.ldl_solve(p[0], *ca.ldl(A[0]))], []
    for k, body in enumerate(tree[1:], 1):
        reached = X[k] @ a[body.up] + c[k]
        qdd.append((u[k] - U[k].T @ reached) / D[k])
        a.append(reached + S[k] * qdd[-1])
    return a[0], ca.vertcat(*qdd)


def flow(common) -> ca.Function:
    """(state, torques) -> its rate, and the cost's."""
    n = len(common.torque)
    x, tau = ca.SX.sym("x", 14 + common.model.nv), ca.SX.sym("tau", n)
    _, quat, q, v, w, qd = ca.vertsplit(x, np.cumsum([0, 3, 4, n, 3, 3, n]).tolist())
    a, qdd = accelerations(bodies(common.model), q, ca.vertcat(v, w), qd, tau)
    turn = ca.vertcat(quat[3] * w + ca.cross(quat[:3], w), -ca.dot(quat[:3], w)) / 2
    torque, smoothness = common.weights
    cost = (torque * ca.sumsqr(tau / ca.DM(common.torque)) + smoothness * ca.sumsqr(qdd)) / n
    return ca.Function("flow", [x, tau], [ca.vertcat(rotation(quat) @ v, turn, qd, a, qdd), cost])


def interval(common) -> ca.Function:
    """(state, torques) -> the state behind an interval, and what it costs."""
    f, h = flow(common), common.duration / common.knots
    x, tau = ca.MX.sym("x", f.size1_in(0)), ca.MX.sym("tau", f.size1_in(1))
    k, costs = [], []
    for part in (0, 1 / 2, 1 / 2, 1):
        rate, cost = f(x + part * h * k[-1] if k else x, tau)
        k, costs = [*k, rate], [*costs, cost]
    mean = lambda y: (y[0] + 2 * y[1] + 2 * y[2] + y[3]) / 6
    return ca.Function("interval", [x, tau], [x + h * mean(k), h * mean(costs)])


def miss(common) -> ca.Function:
    """state -> what the hand lacks to its goal, and the joint rates."""
    n = len(common.torque)
    x = ca.SX.sym("x", 14 + common.model.nv)
    frame, (R, p) = common.model.frames[common.frame], (rotation(x[3:7]), x[:3])
    tree, k, path = bodies(common.model), frame.parentJoint - 1, []
    while k:
        path, k = [(tree[k], x[6 + k]), *path], tree[k].up
    for body, q in path:
        turn, place = body.pose(q)
        R, p = R @ turn, p + R @ place
    D = ca.DM(common.goal[0]).T @ R @ ca.DM(frame.placement.rotation)
    turn = ca.vertcat(D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]) / 2
    place = p + R @ ca.DM(frame.placement.translation) - ca.DM(common.goal[1])
    return ca.Function("miss", [x], [ca.vertcat(place, turn, x[-n:])])


class Log(ca.Callback):
    """Keeps the iterates of a solver, and when each came."""

    def __init__(self, variables, rows):
        ca.Callback.__init__(self)
        self.sizes, self.note = (variables, 1, rows, variables, rows, 0), None
        self.construct("log", {})

    def get_n_in(self):
        return ca.nlpsol_n_out()

    def get_n_out(self):
        return 1

    def get_name_in(self, k):
        return ca.nlpsol_out(k)

    def get_sparsity_in(self, k):
        return ca.Sparsity.dense(self.sizes[k]) if self.sizes[k] else ca.Sparsity(0, 0)

    def eval(self, arguments):
        self.note(arguments[0].full().ravel())
        return [0]


def prepared(common, **options):
    """IPOPT for the reach: a function of first states [knots + 1, nx], torques [knots, n] and what notes torques."""
    F, N, n = interval(common), common.knots, len(common.torque)
    nx = F.size1_in(0)
    x, tau = ca.MX.sym("x", nx, N + 1), ca.MX.sym("tau", n, N)
    after, cost = F.map(N)(x[:, :-1], tau)
    z, rows = ca.veccat(x, tau), ca.veccat(after - x[:, 1:], miss(common)(x[:, -1]))
    low, high = np.full((nx, N + 1), -np.inf), np.full((nx, N + 1), np.inf)
    low[7 : 7 + n], high[7 : 7 + n] = common.position.T[:, :, None]
    low[-n:], high[-n:] = -common.rate[:, None], common.rate[:, None]
    low[:, 0] = high[:, 0] = common.start
    most = np.repeat(common.torque[:, None], N, axis=1)
    bounds = dict(lbx=ca.veccat(low, -most), ubx=ca.veccat(high, most), lbg=0, ubg=0)
    log = Log(z.numel(), rows.numel())
    options = OPTIONS | {"iteration_callback": log} | options
    solver = ca.nlpsol("reach", "ipopt", {"x": z, "f": ca.sum2(cost), "g": rows}, options)

    def solve(states, torques, note):
        log.note = lambda z: note(z[-n * N :].reshape(N, n))
        solver(x0=ca.veccat(states.T, torques.T), **bounds)
        return solver.stats()["return_status"]

    return solve
