"""The motion of a free-flying tree in long double, by means that share nothing with the library.

Newton and Euler in world axes, link by link; the mass matrix from unit accelerations, all at once; its Cholesky factor
written out; and the extrapolated midpoint rule of Gragg, Bulirsch and Stoer. Revolute joints, no forces.

Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I (1993), section II.9.
"""

import numpy as np

REAL = np.longdouble
COLUMNS = 8  # of the extrapolation: order 16


def motion(robot, q, v, dt, steps, parts=1):
    """States (qs, vs) at the ends of the steps, each in so many extrapolated ones."""
    tree, states = _Tree(robot), [(np.asarray(q, REAL), np.asarray(v, REAL))]
    for _ in range(steps):
        y = np.concatenate(states[-1])
        for _ in range(parts):
            y = _extrapolated(tree.rates, y, REAL(dt) / parts)
        y[3:7] /= np.sqrt((y[3:7] ** 2).sum())
        states.append((y[: len(q)], y[len(q) :]))
    return tuple(np.stack([state[k] for state in states]).astype(float) for k in (0, 1))


def _extrapolated(f, y, h):
    """y after one step h: modified midpoint with 2, 4, 6, ... parts, extrapolated to none."""
    table, slope = [], f(y)
    for k in range(1, COLUMNS + 1):
        n = 2 * k
        before, now = y, y + h / n * slope
        for _ in range(n - 1):
            before, now = now, before + 2 * h / n * f(now)
        row = [(before + now + h / n * f(now)) / 2]
        for j, old in enumerate(table):
            row.append(row[j] + (row[j] - old) / ((REAL(n) / (2 * (k - 1 - j))) ** 2 - 1))
        table = row
    return table[-1]


class _Tree:
    """Links from the base outwards."""

    def __init__(self, robot):
        self.links, self.up, self.joints, tree = [], [], [], robot.tree
        place = {i: k for k, i in enumerate(tree.order)}
        for i in tree.order:
            link = robot.links[i]
            self.links.append((REAL(link.mass), np.asarray(link.com, REAL), np.asarray(link.inertia, REAL)))
            self.up.append(place[tree.parent[i]] if tree.parent[i] >= 0 else -1)
            self.joints.append(robot.joints[tree.joint[i]] if tree.joint[i] >= 0 else None)
        moving = [joint.name for joint in robot.moving]
        self.dof = [moving.index(joint.name) if joint else -1 for joint in self.joints]

    def rates(self, y):
        """Time derivative of [q, v]."""
        n = len(self.links) - 1
        q, v = y[: 7 + n], y[7 + n :]
        R, p, axes = self._poses(q)
        units = np.concatenate([np.zeros((6 + n, 1), REAL), np.eye(6 + n, dtype=REAL)], 1)
        M = self._forces(R, p, axes, 0 * v, units)[:, 1:]
        bias = self._forces(R, p, axes, v, units[:, :1])[:, 0]
        s, u, w = q[3], q[4:7], v[:3]
        turn = np.concatenate([[-(u @ w)], s * w + np.cross(u, w)]) / 2
        return np.concatenate([R[0] @ v[3:6], turn, v[6:], _solve(M, -bias)])

    def _poses(self, q):
        s, u = q[3], q[4:7]
        R, p, axes = [(s * s - u @ u) * np.eye(3, dtype=REAL) + 2 * np.outer(u, u) + 2 * s * _hat(u)], [q[:3]], [None]
        for i in range(1, len(self.links)):
            joint, up = self.joints[i], self.up[i]
            a, angle = np.asarray(joint.axis, REAL), q[7 + self.dof[i]]
            K = _hat(a / np.sqrt(a @ a))
            frame = R[up] @ np.asarray(joint.rotation, REAL)
            R.append(frame @ (np.eye(3, dtype=REAL) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K))
            p.append(p[up] + R[up] @ np.asarray(joint.position, REAL))
            axes.append(frame @ a / np.sqrt(a @ a))
        return R, p, axes

    def _forces(self, R, p, axes, v, vdot):
        """Inverse dynamics for columns of accelerations [nv, k]."""
        cross = lambda a, b: np.cross(a, b, axisa=0, axisb=0, axisc=0)
        fixed = lambda a: np.broadcast_to(a[:, None], (3, vdot.shape[1]))
        w, al, a = [R[0] @ v[:3]], [R[0] @ vdot[:3]], [R[0] @ (vdot[3:6] + np.cross(v[:3], v[3:6])[:, None])]
        for i in range(1, len(self.links)):
            up, k, r = self.up[i], 6 + self.dof[i], fixed(p[i] - p[self.up[i]])
            spin = axes[i] * v[k]
            w.append(w[up] + spin)
            al.append(al[up] + np.outer(axes[i], vdot[k]) + np.cross(w[up], spin)[:, None])
            a.append(a[up] + cross(al[up], r) + cross(fixed(w[up]), cross(fixed(w[up]), r)))
        F, N = [], []
        for i, (m, c, inertia) in enumerate(self.links):
            r, I, W = fixed(R[i] @ c), R[i] @ inertia @ R[i].T, fixed(w[i])
            F.append(m * (a[i] + cross(al[i], r) + cross(W, cross(W, r))))
            N.append(I @ al[i] + np.cross(w[i], I @ w[i])[:, None] + cross(r, F[i]))
        out = np.zeros_like(vdot)
        for i in range(len(self.links) - 1, 0, -1):
            out[6 + self.dof[i]] = axes[i] @ N[i]
            N[self.up[i]] = N[self.up[i]] + N[i] + cross(fixed(p[i] - p[self.up[i]]), F[i])
            F[self.up[i]] = F[self.up[i]] + F[i]
        out[:3], out[3:6] = R[0].T @ N[0], R[0].T @ F[0]
        return out


def _hat(a):
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]], REAL)


def _solve(M, b):
    """x of M x = b, M positive definite."""
    n, L, x = len(b), M.copy(), b.copy()
    for j in range(n):
        L[j:, j] -= L[j:, :j] @ L[j, :j]
        L[j:, j] /= np.sqrt(L[j, j])
    for j in range(n):
        x[j] = (x[j] - L[j, :j] @ x[:j]) / L[j, j]
    for j in reversed(range(n)):
        x[j] = (x[j] - L[j + 1 :, j] @ x[j + 1 :]) / L[j, j]
    return x
