"""Closures: the residual of each, its Jacobian K, and the acceleration K v̇ − k that a closed chain must not have.

A closure compares two frames, in the axes and at the origin of frame a, fixed in its link: with Δ = V_a − V_b,
    K v = X Δ,   K v̇ − k = X (A_a − A_b + V_a x V_b),
where a row of X picks a component of the twist in frame a. The twists are compared at one point, so the columns of a
free base are zero for a closure between two links. The universal joint's angular row is along n = z_a x x_b, which
turns: it adds −n' · (w_b − w_a). The wrench on link a is Xᵀ lam, on link b its opposite.

Twists and wrenches are in the base's axes, about the base's origin, as in the sweeps.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sdyn.chain import Chain, ClosureRow, LinkRow, LoopRow
from sdyn.coordinates import pose_of
from sdyn.inputs import expect
from sdyn.kinematics import jacobian_columns, link_poses, poses, slot_motions

IDENTITY = (1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0, 0, 0, 0)  # rotation and position of a frame that is its link's own


class Ends(NamedTuple):
    """The frames of all loops, base axes and origin."""

    Ra: Float[Array, "loops 3 3"]
    xa: Float[Array, "loops 3"]
    Rb: Float[Array, "loops 3 3"]
    xb: Float[Array, "loops 3"]


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
    return residual_of(chain, ends_of(chain, pose, slots[..., 0]))


def loop_jacobian(chain: Chain, q: Float[Array, " nq"]) -> Float[Array, "nc nv"]:
    """The matrix K of the closures: K v is the twist of frame a minus that of frame b, in the axes and at the origin of
    frame a, in the rows that the closures hold, angular ones first [rad, m per unit of v].

    Args:
        chain: Packed structure.
        q: Configuration [m, rad, unit quaternion wxyz].
    """
    (q,) = expect(chain, q=q)
    return closure_parts(chain, q)[0]


def closure_parts(chain: Chain, q):
    """K, the squared length of the twists that each row picks a component of, and the residual."""
    pose = pose_of(chain, q)
    slots, S = poses(chain.slot_index, chain.slot_value[..., None], pose.q, pose.quat)
    ends = ends_of(chain, pose, slots[..., 0])
    Ja, Jb = (jacobian_columns(chain, pose, S[..., 0], slot) for slot in end_slots(chain))
    D = Ja - Jb
    K = jnp.einsum("rk,rkv->rv", basis(chain, ends), D[chain.row_index[ClosureRow.LOOP]])
    linear = D[:, 3:] + jnp.cross(D[:, :3], ends.xa[:, :, None], axis=1)
    turn, slide = ((x * x).sum((1, 2))[:, None] for x in (D[:, :3], linear))
    size = _rows(chain, jnp.concatenate([turn, turn, turn, slide, slide, slide, turn], 1))
    return K, size, residual_of(chain, ends)


def closure_acceleration(chain: Chain, q, v, vdot):
    """K v̇ − k [nc]."""
    return _acceleration(chain, *_end_motions(chain, q, v, vdot))


def closure_forces(chain: Chain, q, v, vdot, lam):
    """Wrenches on the slots [slots + 2, 6], base axes and origin, and K v̇ − k, from one sweep."""
    ends, slots = _end_motions(chain, q, v, vdot)
    return at_slots(chain, wrenches(chain, ends, lam)), _acceleration(chain, ends, slots)


def _end_motions(chain, q, v, vdot):
    """The frames, and poses, twists and spatial accelerations of the slots."""
    pose = pose_of(chain, q)
    slots = slot_motions(chain, pose, v, vdot)
    return ends_of(chain, pose, slots), slots


def _acceleration(chain, ends, slots):
    Va, Vb, Aa, Ab = (slots[slot, k : k + 6] for k in (12, 18) for slot in end_slots(chain))
    D = Aa - Ab + _motion_cross(Va, Vb)
    rows = chain.row_index[ClosureRow.LOOP]
    return (basis(chain, ends) * D[rows]).sum(1) - _turning(chain, ends, Vb[:, :3] - Va[:, :3])


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
    F = at_links(chain, wrenches(chain, ends_of(chain, pose, slots[..., 0]), lam))
    return jnp.concatenate([(F[:, :3] - jnp.cross(p, F[:, 3:])) @ pose.R.T, F[:, 3:] @ pose.R.T], 1)


def at_links(chain: Chain, F):
    """Sums over the closures of wrenches on links a [loops, 6], and of their opposites on links b: [n, 6]."""
    a, b = chain.loop_index[LoopRow.A], chain.loop_index[LoopRow.B]
    return jnp.zeros((chain.capacity.links, 6), F.dtype).at[a].add(F, mode="drop").at[b].add(-F, mode="drop")


def at_slots(chain: Chain, F):
    """The same for the slots [slots + 2, 6]; what the ground gets, the dummy has."""
    a, b = end_slots(chain)
    return jnp.zeros((chain.capacity.slots + 2, 6), F.dtype).at[a].add(F).at[b].add(-F)


def end_slots(chain: Chain):
    """Slots of the links a and b of each loop; the dummy for the ground."""
    slot = jnp.append(chain.link_index[LinkRow.SLOT], chain.capacity.slots + 1)
    return slot[chain.loop_index[LoopRow.A]], slot[chain.loop_index[LoopRow.B]]


def wrenches(chain: Chain, ends: Ends, lam):
    """Wrench on link a of each loop, base axes and origin [loops, 6]."""
    of_rows = basis(chain, ends) * lam[:, None]
    return jnp.zeros((chain.capacity.loops, 6), lam.dtype).at[chain.row_index[ClosureRow.LOOP]].add(of_rows)


def ends_of(chain: Chain, pose, slots) -> Ends:
    """The frames of the loops, from the poses of the slots [slots + 2, 12 or more]."""
    out, still = [], jnp.concatenate([pose.R.T.reshape(9), -pose.p @ pose.R])  # the ground, seen from the base
    own = jnp.concatenate([chain.link_pose, jnp.asarray([IDENTITY], pose.R.dtype)])
    for end, slot, first in zip((LoopRow.A, LoopRow.B), end_slots(chain), (0, 12), strict=True):
        link, value = chain.loop_index[end], chain.loop_value[:, first : first + 12]
        at = jnp.where((link == chain.capacity.links)[:, None], still, slots[slot, :12])
        R, p = _composed(at, own[link])
        out += _composed(jnp.concatenate([R.reshape(-1, 9), p], 1), value)
    return Ends(*out)


def _composed(outer, inner):
    """Rotation and position of poses [loops, 12] in one another."""
    (R, p), (S, x) = ((y[:, :9].reshape(-1, 3, 3), y[:, 9:]) for y in (outer, inner))
    return R @ S, p + (R @ x[..., None])[..., 0]


def basis(chain: Chain, ends: Ends):
    """The rows X [nc, 6]: what the closures hold of a difference of twists."""
    Rt, o = jnp.swapaxes(ends.Ra, 1, 2), jnp.zeros_like(ends.Ra)
    lever = jnp.cross(ends.xa[:, None], Rt)  # e · (w x x) = w · (x x e)
    n = _universal_axis(ends)
    parts = [jnp.concatenate([Rt, o], 2), jnp.concatenate([lever, Rt], 2)]
    parts.append(jnp.concatenate([n, o[:, 0]], 1)[:, None])
    return _rows(chain, jnp.concatenate(parts, 1))


def residual_of(chain: Chain, ends: Ends):
    """`loop_residual`, from the frames."""
    R = jnp.swapaxes(ends.Ra, 1, 2) @ ends.Rb  # axes of b, seen from a
    d = ((ends.xa - ends.xb)[:, None] @ ends.Ra)[:, 0]
    half = lambda c: 2 / jnp.maximum(1 + c, 1e-9)
    tilt, twist = half(R[:, 2, 2]), half(R[:, 0, 0])
    angles = [R[:, 1, 2] * tilt, -R[:, 0, 2] * tilt, -R[:, 1, 0] * twist]
    return _rows(chain, jnp.concatenate([jnp.stack(angles, 1), d, R[:, 2, :1]], 1))


def _rows(chain, parts):
    """The rows that are held, of the seven parts of each loop [loops, 7, ...]."""
    loop, part, live = chain.row_index
    rows = parts[loop, part]
    return rows * live.reshape(-1, *(1,) * (rows.ndim - 1)).astype(rows.dtype)


def _universal_axis(ends):
    """z_a x x_b, base axes."""
    return jnp.cross(ends.Ra[:, :, 2], ends.Rb[:, :, 0])


def _turning(chain, ends, spin):
    """n' · (w_b − w_a) in the universal joints' rows, n' = z_a x ((w_b − w_a) x x_b) as seen from link a."""
    z, x = ends.Ra[:, :, 2], ends.Rb[:, :, 0]
    turning = (jnp.cross(z, jnp.cross(spin, x)) * spin).sum(1)
    return _rows(chain, jnp.concatenate([jnp.zeros((len(z), 6), z.dtype), turning[:, None]], 1))


def _motion_cross(V, m):
    """V x m of motion vectors [loops, 6]."""
    w, v = jnp.cross(V[:, :3], m[:, :3]), jnp.cross(V[:, :3], m[:, 3:]) + jnp.cross(V[:, 3:], m[:, :3])
    return jnp.concatenate([w, v], 1)
