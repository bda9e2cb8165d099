"""The mass matrix by composite bodies, in the base's frame: M_ij = S_j · Ic_i S_i for j that carries i.

Source: Featherstone, Rigid Body Dynamics Algorithms (2008), section 6.2; without transforms the walk along the
ancestors becomes one masked product.
"""

import jax.numpy as jnp

from sdyn.batching import Kernel
from sdyn.chain import BaseRow, SlotRow
from sdyn.materialise import keep
from sdyn.spatial import cat, hat, inertia_times
from sdyn.sweep import (
    add_to,
    batch_of,
    block,
    bodies_of,
    inertia_at,
    inertia_of_base,
    joints_of,
    put,
    walk_of,
)


def _crba(slot_index, ancestors, slot_value, base_value, rotor, q, quat, *, work):
    """M [6 + nv, 6 + nv, B], the base block first and zero when the base is grounded."""
    walk = walk_of(slot_index, work)
    W, slots, nv = walk.width, walk.slots, rotor.shape[0]
    B, dtype = batch_of(slot_value, base_value, rotor, q, quat), slot_value.dtype
    joints = joints_of(walk, slot_index, slot_value, q, quat)
    _, _, bodies = bodies_of(walk, joints, base_value, B)
    flat = lambda m, h, Io: cat([m[None] + 0 * h[:1], h, Io.reshape(9, *Io.shape[2:])])

    def inward(t, parents, stored):
        total, IS = stored
        Ic = keep(flat(*inertia_at(bodies, t, W)) + block(total, t, W))
        S = block(bodies.S, t, W)
        moved = keep(inertia_times(Ic[0], Ic[1:4], Ic[4:].reshape(3, 3, W, *B), S))
        return add_to(total, parents, Ic), put(IS, t, W, moved)

    base = flat(*inertia_of_base(walk, bodies))
    total, IS = walk.inward(inward, (walk.zeros(13, B, dtype).at[slots].set(base), walk.zeros(6, B, dtype)))
    S, IS = bodies.S[:slots], IS[:slots]
    lower = keep(sum(IS[:, None, k] * S[None, :, k] for k in range(6))) * ancestors[..., None].astype(S.dtype)
    diagonal = jnp.eye(slots, dtype=S.dtype)[..., None]
    M = lower + jnp.swapaxes(lower, 0, 1) * (1 - diagonal)

    live = slot_index[SlotRow.LIVE].reshape(slots)
    dof = jnp.where(live == 1, slot_index[SlotRow.DOF].reshape(slots), nv)  # empty slots go to a row that is cut off
    joints = jnp.zeros((nv + 1, nv + 1, *B), S.dtype).at[dof[:, None], dof[None]].add(M)[:nv, :nv]
    joints = joints + jnp.eye(nv, dtype=S.dtype)[..., None] * rotor[:, None]
    across = jnp.zeros((nv + 1, 6, *B), S.dtype).at[dof].add(IS)[:nv] * base_value[BaseRow.FREE]
    Io, h, m = total[slots, 4:].reshape(3, 3, *B), hat(total[slots, 1:4]), total[slots, 0]
    eye = jnp.eye(3, dtype=S.dtype)[..., None]
    corner = cat([cat([Io, h], 1), cat([-h, m * eye], 1)]) * base_value[BaseRow.FREE]
    return (cat([cat([corner, jnp.swapaxes(across, 0, 1)], 1), cat([across, joints], 1)]),)


crba = Kernel(_crba)
