"""The same state, forces and accelerations seen from another base: what the heaviest body computes, in the user's
coordinates.

`chain.inner` is the structure packed from the heaviest body, see `heaviest.py`. With T(q) the map of the user's v to
its rates, v_i = T v, forces go by τ = Tᵀ τ_i and so by the wrench on the user's base link; accelerations come back as
the spatial acceleration of that link, which in its own axes is the derivative of the components of v.
"""

from dataclasses import replace

import jax.numpy as jnp

from sdyn.chain import BaseRow, Chain, LinkRow
from sdyn.coordinates import Pose, pose_of
from sdyn.kinematics import jacobian_columns, link_motions, link_poses, poses
from sdyn.rotation import from_matrix


def inner_of(chain: Chain) -> Chain:
    """The structure seen from the other base, with what may have changed since it was packed."""
    base_value = jnp.concatenate([chain.inner.base_value[: BaseRow.POSE], chain.base_value[BaseRow.POSE :]])
    return replace(chain.inner, base_value=base_value, dof_value=chain.dof_value)


def base_link(chain: Chain):
    """Number of the base link."""
    size, index = chain.capacity, chain.link_index
    return jnp.argmax((index[LinkRow.SLOT] == size.slots) & (index[LinkRow.JOINT] == size.joints))


def state_seen(chain: Chain, inner: Chain, q, v):
    """q and v of the other base: its pose, and its twist in its own axes."""
    if chain.capacity.base_nv == 0:
        return q, v
    pose, b = pose_of(chain, q), base_link(inner)
    R, p, V, _ = link_motions(chain, pose, v, jnp.zeros_like(v))
    place = jnp.concatenate([pose.p + pose.R @ p[b], from_matrix(pose.R @ R[b])])
    return q.at[:7].set(place), v.at[:6].set(_moved(R[b], p[b], V[b]))


def force_seen(chain: Chain, inner: Chain, pose: Pose, tau):
    """Forces laid out like v of the other base: the joints' own, and those of the wrench on the user's base link."""
    if chain.capacity.base_nv == 0:
        return tau
    R, p, J = _of_link(inner, pose, base_link(chain))
    n, f = R @ tau[:3], R @ tau[3:6]
    return tau.at[:6].set(0) + J.T @ jnp.concatenate([n + jnp.cross(p, f), f])


def rates_back(chain: Chain, inner: Chain, pose: Pose, x):
    """The inverse of v_i = T v: rates of the user's coordinates."""
    if chain.capacity.base_nv == 0:
        return x
    R, p, J = _of_link(inner, pose, base_link(chain))
    return x.at[:6].set(_moved(R, p, J @ x))


def acceleration_back(chain: Chain, inner: Chain, pose: Pose, v, vdot):
    """The user's vdot from that of the other base, at its v."""
    if chain.capacity.base_nv == 0:
        return vdot
    u = base_link(chain)
    R, p, _, A = link_motions(inner, pose, v, vdot)
    return vdot.at[:6].set(_moved(R[u], p[u], A[u]))


def _of_link(chain, pose, link):
    """Rotation and origin of a link in base axes, and its Jacobian about the base's origin."""
    slots, S = poses(chain.slot_index, chain.slot_value[..., None], pose.q, pose.quat)
    R, p = link_poses(chain, slots[..., 0])
    return R[link], p[link], jacobian_columns(chain, pose, S[..., 0], chain.link_index[LinkRow.SLOT][link])


def _moved(R, p, V):
    """A twist, or a spatial acceleration, about the point p and in the axes R."""
    return jnp.concatenate([V[:3] @ R, (V[3:] + jnp.cross(V[:3], p)) @ R])
