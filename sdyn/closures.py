"""Closures of a chain: the residual of each, its Jacobian K, and what solutions of the closed chain share.

The formulas are in `closure_rows.py`, the kernels in `closure_motion.py` and `delassus.py`; here is one sample.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sdyn.chain import Chain, LinkRow, LoopRow
from sdyn.closure_motion import closure_motion
from sdyn.closure_rows import Ends, basis, ends_of, of_rows, residual, wrenches
from sdyn.coordinates import Pose, join, pose_of, rates_of, spin
from sdyn.delassus import Saved, closed_solve, prepare
from sdyn.dynamics import operands_of
from sdyn.inputs import expect
from sdyn.kinematics import jacobian_columns, link_poses, poses
from sdyn.spatial import cat

IDENTITY = (1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0, 0, 0, 0)  # rotation and position of a frame that is its link's own


def loop_residual(chain: Chain, q: Float[Array, " nq"]) -> Float[Array, " nc"]:
    """How far the closures are from closed: zero on the closed chain, with the derivative K v there.

    Args:
        chain: Packed structure.
        q: Configuration [m, rad, unit quaternion wxyz].

    Returns:
        One entry per row: angles [rad] and distances [m] of frame a from frame b, in the axes of frame a. Angular
        rows are twice the tangent of half the angle between two axes, so they have no second zero.
    """
    (q,) = expect(chain, q=q)
    pose = pose_of(chain, q)
    slots, _ = poses(chain.slot_index, chain.slot_value[..., None], pose.q, pose.quat)
    return residual(chain.row_index, frames_of(chain, pose, slots[..., 0]))


def loop_jacobian(chain: Chain, q: Float[Array, " nq"]) -> Float[Array, "nc nv"]:
    """The matrix K of the closures: K v is the twist of frame a minus that of frame b, in the axes and at the origin of
    frame a, in the rows that the closures hold, angular ones first [rad, m per unit of v].

    Args:
        chain: Packed structure.
        q: Configuration [m, rad, unit quaternion wxyz].
    """
    (q,) = expect(chain, q=q)
    pose = pose_of(chain, q)
    slots, S = poses(chain.slot_index, chain.slot_value[..., None], pose.q, pose.quat)
    Ja, Jb = (jacobian_columns(chain, pose, S[..., 0], slot) for slot in end_slots(chain))
    X = basis(chain.row_index, frames_of(chain, pose, slots[..., 0]))
    return jnp.einsum("rk,krv->rv", X, of_rows(chain.row_index, jnp.moveaxis(Ja - Jb, 0, 1)))


def loop_wrenches(chain: Chain, q: Float[Array, " nq"], lam: Float[Array, " nc"]) -> Float[Array, "n 6"]:
    """What the closures do to the links: one wrench [n; f] per link, world axes, about the link's origin [N m, N].

    Args:
        chain: Packed structure.
        q: Configuration.
        lam: Multipliers, from `constrained_dynamics`.
    """
    (q,) = expect(chain, q=q)
    pose = pose_of(chain, q)
    slots, _ = poses(chain.slot_index, chain.slot_value[..., None], pose.q, pose.quat)
    _, p = link_poses(chain, slots[..., 0])
    F = at_links(chain, frame_wrenches(chain, frames_of(chain, pose, slots[..., 0]), lam))
    return jnp.concatenate([(F[:, :3] - jnp.cross(p, F[:, 3:])) @ pose.R.T, F[:, 3:] @ pose.R.T], 1)


def frame_wrenches(chain: Chain, ends: Ends, lam):
    """Wrench on link a of each loop, base axes and origin [loops, 6]."""
    return wrenches(chain.row_index, basis(chain.row_index, ends), lam, chain.capacity.loops).T


def at_links(chain: Chain, F):
    """Sums over the closures of wrenches on links a [loops, 6], and of their opposites on links b: [n, 6]."""
    a, b = chain.loop_index[LoopRow.A], chain.loop_index[LoopRow.B]
    return jnp.zeros((chain.capacity.links, 6), F.dtype).at[a].add(F, mode="drop").at[b].add(-F, mode="drop")


def frames_of(chain: Chain, pose: Pose, slots) -> Ends:
    """The frames of the loops, from the poses of the slots [slots + 2, 12]."""
    slots = slots.at[-1].set(_ground(pose))
    return ends_of(*(slots[slot].T for slot in end_slots(chain)), _frames(chain))


def end_slots(chain: Chain):
    """Slots of the links a and b of each loop [2, loops]; the dummy for the ground."""
    slot = jnp.append(chain.link_index[LinkRow.SLOT], chain.capacity.slots + 1)
    return slot[chain.loop_index[LoopRow.A :]]


def _ground(pose: Pose):
    """Pose of the world, seen from the base [12]."""
    return cat([pose.R.T.reshape(9), -pose.p @ pose.R])


def _frames(chain: Chain):
    """Poses of frames a and b in their slots [24, loops]."""
    own = cat([chain.link_pose, jnp.asarray([IDENTITY], chain.dtype)])
    ends = ends_of(*(own[link].T for link in chain.loop_index[LoopRow.A :]), chain.loop_value.T)
    return cat([x.reshape(math.prod(x.shape[:-1]), x.shape[-1]) for x in ends])


# ---- operands of the kernels -----------------------------------------------------------------------------------------


def closure_forces(chain: Chain, q, v, vdot, lam):
    """Wrenches on the slots [slots + 2, 6], base axes and origin, and K v̇ − k [nc]."""
    pose = pose_of(chain, q)
    V0, qd = rates_of(chain, pose, v)
    a0, qdd = rates_of(chain, pose, vdot)
    F, opening = closure_motion(
        chain.slot_index, end_slots(chain), chain.row_index, chain.slot_value[..., None], pose.q, pose.quat,
        V0 * chain.free, qd, a0 * chain.free, qdd - spin(chain, qd), _ground(pose)[:, None],
        _frames(chain)[..., None], lam[:, None],
    )  # fmt: skip
    return F[..., 0], opening[:, 0]


def closure_acceleration(chain: Chain, q, v, vdot):
    """K v̇ − k [nc]."""
    return closure_forces(chain, q, v, vdot, jnp.zeros(chain.capacity.rows, q.dtype))[1]


def closed_operands(chain: Chain, q, gravity=None, f_ext=None):
    """Pose, the operands that the kernels of `delassus.py` start with, gravity and wrenches."""
    pose, (index, *rest), G, F = operands_of(chain, q, gravity, f_ext)
    frames = _ground(pose)[:, None], _frames(chain)[..., None]
    return pose, (index, end_slots(chain), chain.row_index, chain.ancestors, *rest, *frames), G, F


class System(NamedTuple):
    """[M, −Kᵀ; K, 0] at a configuration, ready to be solved."""

    chain: Chain
    pose: Pose
    structure: tuple
    saved: Saved

    def solve(self, c, d):
        """x [nv] and y [nc] of M x − Kᵀ y = c, K x = d; y the shortest."""
        b = rates_of(self.chain, self.pose, c)
        *x, y = closed_solve(*self.structure, *self.saved, *b, d[:, None])
        return join(self.chain, self.pose, *x), y[:, 0]


def system_of(chain: Chain, q, leave=None) -> System:
    """The closed chain at a configuration; `leave` is 1 for rows to leave out."""
    pose, structure, _, _ = closed_operands(chain, q)
    leave = jnp.zeros(chain.capacity.rows, q.dtype) if leave is None else leave
    return System(chain, pose, structure, Saved(*prepare(*structure, leave[:, None])))
