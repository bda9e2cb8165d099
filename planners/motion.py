"""Where the bodies of a plan are, phase by phase: what the figures and the animation show."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import sdyn


def link_poses(robot: sdyn.Robot, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses of all links in the world along q [k, nq]: rotations [k, n, 3, 3], positions [k, n, 3] (m)."""
    return _along(sdyn.body_poses, robot, q)


def frame_motion(robot: sdyn.Robot, q: np.ndarray, v: np.ndarray, frame: sdyn.Frame):
    """Motion of a frame along q [k, nq] and v [k, nv]; the robot need not have it.

    Returns:
        Rotations [k, 3, 3], positions [k, 3] (m), twists [k, 6] (rad/s, m/s; angular first, world axes).
    """
    marked, only = replace(robot, frames=(frame,)), (jnp.asarray(0),)
    return *_along(sdyn.frame_pose, marked, q, fixed=only), _along(sdyn.frame_velocity, marked, q, v, fixed=only)


def momentum(robot: sdyn.Robot, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Total momentum along q and v, about the world's origin, world axes: [k, 6] (N m s, N s; angular first)."""
    about_com = _along(sdyn.momentum, robot, q, v)
    com = _along(sdyn.centre_of_mass, robot, q)
    angular, linear = about_com[:, :3], about_com[:, 3:]
    return np.hstack([angular + np.cross(com, linear), linear])


def body_momentum(link: sdyn.Link, R: np.ndarray, p: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """Momentum [k, 6] of one link about the world's origin, from the motion of its own origin (see `frame_motion`)."""
    w, r = twist[:, :3], R @ link.com
    linear = link.mass * (twist[:, 3:] + np.cross(w, r))
    spin = np.einsum("kij,jl,kml,km->ki", R, link.inertia, R, w)
    return np.hstack([spin + np.cross(p + r, linear), linear])


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


def continuous(q: np.ndarray) -> np.ndarray:
    """Quaternions [k, 4] with signs chosen so that neighbours are close."""
    flips = np.where((q[1:] * q[:-1]).sum(1) < 0.0, -1.0, 1.0)
    return q * np.concatenate([[1.0], np.cumprod(flips)])[:, None]


def _along(f, robot, *rows, fixed=()):
    """`f(chain, *row, *fixed)` for every row, as NumPy arrays."""
    size = len(rows[0])
    room = 1 << (size - 1).bit_length()  # phases of different length share a compilation
    padded = [np.concatenate([x, np.repeat(x[-1:], room - size, axis=0)]) for x in rows]
    return jax.tree.map(lambda x: np.asarray(x)[:size], _mapped(f, sdyn.pack(robot), padded, fixed))


@partial(jax.jit, static_argnums=0)
def _mapped(f, chain, rows, fixed):
    return jax.vmap(lambda row: f(chain, *row, *fixed))(rows)
