"""The mass matrix by composite bodies, in the base's frame: M_ij = S_j · Ic_i S_i for j that carries i.

Source: Featherstone, Rigid Body Dynamics Algorithms (2008), section 6.2; without transforms the walk along the
ancestors becomes one masked product.
"""

import jax.numpy as jnp
from jax import lax

from sdyn.batching import Kernel
from sdyn.chain import BaseRow, SlotRow
from sdyn.materialise import keep
from sdyn.spatial import cat, hat, inertia_times, rigid_inertia
from sdyn.sweep import add_to, base_inertia, batch_of, block, body_of, place, poses_from, put, steps_of, storage, take


def _crba(slot_index, ancestors, slot_value, base_value, rotor, q, quat):
    """M [6 + nv, 6 + nv, B], the base block first and zero when the base is grounded."""
    W, slots = slot_index.shape[2], slot_index.shape[1] * slot_index.shape[2]
    B, nv = batch_of(slot_value, base_value, rotor, q, quat), rotor.shape[0]
    pack = lambda m, h, Io: cat([m[None] + 0 * h[:1], h, Io.reshape(9, *Io.shape[2:])])

    def outward(stored, x):
        R, p, S = place(x, keep(take(stored, x.parent)))
        inertia = keep(pack(*rigid_inertia(R, p, *body_of(x.value))))
        return put(stored, x.t, W, cat([R.reshape(9, W, -1), p])), (S, inertia)

    def inward(stored, x):
        (t, parent), (S, inertia) = x
        Ic = keep(inertia + block(stored, t, W))
        return add_to(stored, parent, Ic), inertia_times(Ic[0], Ic[1:4], Ic[4:].reshape(3, 3, W, -1), S)

    steps = steps_of(slot_index, slot_value, q, quat)
    _, bodies = lax.scan(outward, poses_from(slots, B, slot_value.dtype), steps)
    base = jnp.broadcast_to(pack(*base_inertia(base_value))[:, 0], (13, B))
    total, IS = lax.scan(inward, storage(slots, base), ((steps.t, steps.parent), bodies), reverse=True)

    by_slot = lambda x: jnp.moveaxis(x, 2, 1).reshape(slots, 6, B)
    S, IS = by_slot(bodies[0]), by_slot(IS)
    lower = keep(sum(IS[:, None, k] * S[None, :, k] for k in range(6))) * ancestors[..., None].astype(S.dtype)
    diagonal = jnp.eye(slots, dtype=S.dtype)[..., None]
    M = lower + jnp.swapaxes(lower, 0, 1) * (1 - diagonal)

    live = slot_index[SlotRow.LIVE].reshape(slots)
    dof = jnp.where(live == 1, slot_index[SlotRow.DOF].reshape(slots), nv)  # empty slots go to a row that is cut off
    joints = jnp.zeros((nv + 1, nv + 1, B), S.dtype).at[dof[:, None], dof[None]].add(M)[:nv, :nv]
    joints = joints + jnp.eye(nv, dtype=S.dtype)[..., None] * rotor[:, None]
    across = jnp.zeros((nv + 1, 6, B), S.dtype).at[dof].add(IS)[:nv] * base_value[BaseRow.FREE]
    Io, h, m = total[slots, 4:].reshape(3, 3, B), hat(total[slots, 1:4]), total[slots, 0]
    eye = jnp.eye(3, dtype=S.dtype)[..., None]
    corner = cat([cat([Io, h], 1), cat([-h, m * eye], 1)]) * base_value[BaseRow.FREE]
    return (cat([cat([corner, jnp.swapaxes(across, 0, 1)], 1), cat([across, joints], 1)]),)


crba = Kernel(_crba)
