"""All columns of the derivatives of inverse dynamics at once, from sums over subtrees.

A displacement of joint i moves its subtree rigidly. In the moving axes, all twists beyond the joint change by W_i and
all accelerations by Z_i + W_i x (V − V_i), so the force of a subtree follows from its composite inertia IC, its sum of
C = I (· x V) + · x* I V + V x* I ·, and its force f:
    W = V x S,  z = A' x S + W x S q̇ − W x V
    of q_i    S x* f + IC z + C W       to the base and the joints that carry i, along their axes
    of q̇_i    2 IC W + C S
    of both, to a joint j that i carries:  IC_j S_j · z_i + Cᵀ_j S_j · W_i,  and  2 IC_j S_j · W_i + Cᵀ_j S_j · S_i

Source: Singh, Russo, Wensing, Efficient analytical derivatives of rigid-body dynamics using spatial vector algebra
(2022), in the base's frame, with a free base.
"""

import jax.numpy as jnp

from sdyn.batching import Kernel
from sdyn.chain import BaseRow, SlotRow
from sdyn.materialise import keep
from sdyn.rnea_motion import OPERANDS, Motion, motion_of
from sdyn.spatial import cat, force_cross, inertia_times, motion_cross
from sdyn.sweep import Bodies, add_to, block, inertia_at, inertia_of_base, put, take


def _jacobian(ancestors, *operands, work):
    """Derivatives [6 + nv, 6 + nv, B] of (f0, tau) by increments of (attitude, position, joints), and by (V0, qd)."""
    x = dict(zip(OPERANDS, operands, strict=True))
    motion, free, nv = motion_of(x, False, work, axes=1), x["base_value"][BaseRow.FREE], x["rotor"].shape[0]
    slots, dtype, B = motion.walk.slots, free.dtype, motion.V.shape[2:]
    (S, P, Q, z, W, of_q, of_v), IC0, C0 = _composites(motion)

    pair = lambda a, b: keep(sum(a[:, None, k] * b[None, :, k] for k in range(6)))
    below = ancestors[..., None].astype(dtype) * (1 - jnp.eye(slots, dtype=dtype)[..., None])
    carries = jnp.swapaxes(ancestors[..., None].astype(dtype), 0, 1)  # [j, i]: j carries i, or is it
    joints_q = pair(S, of_q) * carries + (pair(P, z) + pair(Q, W)) * below
    joints_v = pair(S, of_v) * carries + (2 * pair(P, W) + pair(Q, S)) * below

    # the base: e moves all bodies alike, their accelerations change by V0 x e, and gravity turns the other way
    e = jnp.broadcast_to(jnp.eye(6, dtype=dtype)[..., None], (6, 6, *B))
    lifted = motion_cross(motion.V[slots][:, None], e)
    falls = motion_cross(e, x["G"][:, None]) if x["G"].shape[0] else 0 * e
    falls = jnp.where(jnp.arange(6)[:, None] < 3, falls, 0)
    times = lambda A, X: sum(A[:, k, None] * X[k] for k in range(6))  # (n, 6, B), (6, 6, B) -> (n, 6, B)
    corners = inertia_times(*IC0, falls), C0 + inertia_times(*IC0, lifted)
    across = times(P, falls), Q + times(P, lifted)

    live = x["slot_index"][SlotRow.LIVE].reshape(slots)
    dof = jnp.where(live == 1, x["slot_index"][SlotRow.DOF].reshape(slots), nv)  # empty slots go to what is cut off
    rows = lambda y: jnp.zeros((nv + 1, *y.shape[1:]), dtype).at[dof].add(y)[:nv]

    def matrix(corner, across, joints, of):
        square = rows(jnp.swapaxes(rows(joints), 0, 1))
        top = cat([corner, jnp.swapaxes(rows(of), 0, 1)], 1) * free
        return cat([top, cat([rows(across) * free, jnp.swapaxes(square, 0, 1)], 1)])

    return matrix(corners[0], across[0], joints_q, of_q), matrix(corners[1], across[1], joints_v, of_v)


def _composites(motion: Motion):
    """Per slot [slots, 6, B]: S, IC S, Cᵀ S, z, W, forces of q and of q̇; and of the base IC (with an axis for columns)
    and C [6, 6, B]."""
    walk, bodies, W = motion.walk, motion.bodies, motion.walk.width
    B, dtype = motion.V.shape[2:], motion.V.dtype

    def coriolis(inertia, V, IV):
        """C [6, 6, ...], its columns those of the six units."""
        e = jnp.broadcast_to(jnp.eye(6, dtype=dtype).reshape(6, 6, *(1,) * (V.ndim - 1)), (6, *V.shape))
        inertia, V, IV = widened(inertia), V[:, None], IV[:, None]
        turned = keep(inertia_times(*inertia, keep(motion_cross(e, V))))
        return turned + keep(force_cross(e, IV)) + keep(force_cross(V, keep(inertia_times(*inertia, e))))

    def inward(t, parents, stored):
        m, h, Io, f, C, *kept = stored
        S, V = block(bodies.S, t, W), block(motion.V, t, W)
        own = keep(coriolis(inertia_at(bodies, t, W), V, block(motion.IV, t, W)).reshape(36, W, *B))
        sums = [keep(block(y, t, W)) for y in (m, h, Io, f)] + [keep(own + block(C, t, W))]
        IC, total = (sums[0][0], sums[1], sums[2].reshape(3, 3, W, *B)), sums[3]
        CC = sums[4].reshape(6, 6, W, *B)
        columns = lambda y: keep(sum(CC[:, k] * y[k] for k in range(6)))
        w = keep(motion_cross(V, S))
        z = keep(motion_cross(take(motion.A, parents), S)) + keep(motion_cross(w, S * walk.of_step(motion.qd, t) - V))
        of_q = keep(force_cross(S, total)) + keep(inertia_times(*IC, keep(z))) + columns(w)
        of_v = 2 * keep(inertia_times(*IC, w)) + columns(S)
        Q = sum(CC[k] * S[k] for k in range(6))
        values = S, keep(inertia_times(*IC, S)), Q, z, w, of_q, of_v
        added = (add_to(y, parents, here) for y, here in zip((m, h, Io, f, C), sums, strict=True))
        return *added, *(put(y, t, W, here) for y, here in zip(kept, values, strict=True))

    base = coriolis(inertia_of_base(walk, bodies), motion.V[walk.slots], motion.IV[walk.slots])
    C = walk.zeros(36, B, dtype).at[walk.slots].set(base.reshape(36, *B))
    wide = (jnp.broadcast_to(y, (*y.shape[:2], *B)) for y in (bodies.m, bodies.h, bodies.Io))  # samples may share them
    stored = *wide, motion.f, C, *(walk.empty(6, B, dtype) for _ in range(7))
    m, h, Io, _, C, *kept = walk.inward(inward, stored)
    IC0 = widened(inertia_of_base(walk, Bodies(bodies.S, Io, h, m)))
    return [walk.cleared(y)[: walk.slots] for y in kept], IC0, C[walk.slots].reshape(6, 6, *B)


def widened(inertia):
    """(m, h, Io) for columns [6, columns, ...]."""
    m, h, Io = inertia
    return m, h[:, None], Io[:, :, None]


rnea_jacobian = Kernel(_jacobian)
