"""Where the bodies of a plan are, phase by phase: what the figures and the animation show.

All structures of a plan are packed to one capacity, so that one program, compiled once, follows them all.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

import sdyn


@dataclass(frozen=True)
class Motion:
    """The motion of all links of a robot over k times, in world axes."""

    robot: sdyn.Robot
    R: np.ndarray
    """Link to world, [k, n, 3, 3]."""
    p: np.ndarray
    """Origins, [k, n, 3] (m)."""
    twist: np.ndarray
    """Angular velocity, and velocity of the origin, [k, n, 6] (rad/s, m/s)."""

    def of(self, frame: sdyn.Frame) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rotations [k, 3, 3], positions [k, 3] and twists [k, 6] of a frame."""
        i = self._number(frame.link)
        arm = self.R[:, i] @ frame.position
        twist = self.twist[:, i].copy()
        twist[:, 3:] += np.cross(twist[:, :3], arm)
        return self.R[:, i] @ frame.rotation, self.p[:, i] + arm, twist

    def momentum(self, links=None) -> np.ndarray:
        """Momentum of some links (names), or of all, about the world's origin: [k, 6] (N m s, N s; angular first)."""
        return sum(map(self._momentum, [link.name for link in self.robot.links] if links is None else links))

    def _number(self, link):
        return [x.name for x in self.robot.links].index(link)

    def _momentum(self, name):
        link = self.robot.link(name)
        R, p, twist = self.of(sdyn.Frame("centre", name, position=link.com))
        linear, w = link.mass * twist[:, 3:], twist[:, :3]
        spin = np.einsum("kij,jl,kml,km->ki", R, link.inertia, R, w)
        return np.hstack([spin + np.cross(p, linear), linear])


def follow(plan) -> list[tuple[Motion, Motion | None]]:
    """For each phase, the motion of its robot, and of the separate target if there is one."""
    movers = [(phase.robot, phase.q, phase.v) for phase in plan.phases]
    movers += [phase.passive for phase in plan.phases if phase.passive]
    capacity = sdyn.capacity([_marked(robot) for robot, _, _ in movers])
    room = max(len(q) for _, q, _ in movers)
    motions = [_follow(robot, q, v, capacity, room) for robot, q, v in movers]
    targets = iter(motions[len(plan.phases) :])
    pairs = zip(plan.phases, motions, strict=False)
    return [(motion, next(targets) if phase.passive else None) for phase, motion in pairs]


def _marked(robot):
    """The robot with one frame on each link, of the same name; nothing else of it is needed."""
    return replace(robot, frames=tuple(sdyn.Frame(link.name, link.name) for link in robot.links), loops=())


def _follow(robot, q, v, capacity, room) -> Motion:
    chain = sdyn.pack(_marked(robot), capacity)
    longer = lambda x: np.concatenate([x, np.repeat(x[-1:], room - len(x), axis=0)])
    names = list(capacity.frame_names)
    rows = [names.index(link.name) for link in robot.links]
    found = _motion(chain, *sdyn.pad(chain, longer(q), longer(v)), jnp.arange(len(names)))
    return Motion(robot, *(np.asarray(x)[: len(q), rows] for x in found))


@jax.jit
def _motion(chain, q, v, frames):
    """Poses and twists of frames along a path."""

    def at(q, v, frame):
        return *sdyn.frame_pose(chain, q, frame), sdyn.frame_velocity(chain, q, v, frame)

    return jax.vmap(lambda q, v: jax.vmap(lambda frame: at(q, v, frame))(frames))(q, v)


def quaternions(R: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz [..., 4] of rotation matrices [..., 3, 3]."""
    # 4 q q^T is linear in R; its largest column, normalised, is q.
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    wx, wy, wz = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    xy, xz, yz = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    rows = [
        [1 + xx + yy + zz, wx, wy, wz],
        [wx, 1 + xx - yy - zz, xy, xz],
        [wy, xy, 1 - xx + yy - zz, yz],
        [wz, xz, yz, 1 - xx - yy + zz],
    ]
    Q = np.stack([np.stack(row, -1) for row in rows], -2)
    best = np.argmax(np.diagonal(Q, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(Q, best[..., None, None], axis=-2)[..., 0, :]
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def rotations(q: np.ndarray) -> np.ndarray:
    """Rotation matrices [k, 3, 3] of unit quaternions wxyz [k, 4]."""
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def continuous(q: np.ndarray) -> np.ndarray:
    """Quaternions [k, 4] with signs chosen so that neighbours are close."""
    flips = np.where((q[1:] * q[:-1]).sum(1) < 0.0, -1.0, 1.0)
    return q * np.concatenate([[1.0], np.cumprod(flips)])[:, None]
