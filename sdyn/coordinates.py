"""From the user's q and v to the operands of the kernels, and back.

Kernels know one scalar per degree of freedom and a quaternion per spherical joint, in the base's frame and with a
trailing batch axis of one. A spherical joint is three screws along the child's axes behind R(quat); its internal rates
are those of the tree's child in its own axes, which is `-R w` where the joint is traversed backwards.
"""

from typing import NamedTuple

import jax.numpy as jnp

from sdyn.chain import BASE_POSE, Chain
from sdyn.rotation import conjugate, matrix
from sdyn.spatial import cross


class Pose(NamedTuple):
    """Operands that depend on q."""

    R: jnp.ndarray
    """Rotation of the base, base to world [3, 3]."""
    p: jnp.ndarray
    """Position of the base's origin, world [3]."""
    q: jnp.ndarray
    """Scalar joint coordinates [nv, 1]."""
    quat: jnp.ndarray
    """Quaternions of the spherical joints, tree's child to tree's parent [quaternions, 4, 1]."""


def pose_of(chain: Chain, q) -> Pose:
    """Split q; the pose of a grounded base comes from the chain."""
    capacity, nb = chain.capacity, chain.capacity.base_nq
    ground = chain.base_value[BASE_POSE:]
    base = ground if nb == 0 else jnp.where(chain.free == 1, q[:7], ground) if capacity.layout == "padded" else q[:7]
    joints, quat = q[nb:], jnp.zeros((0, 4, 1), q.dtype)
    if capacity.quaternions:
        scalar = chain.dof_to_q >= 0
        quat = joints[chain.quat_index[0][:, None] + jnp.arange(4)]
        joints = jnp.where(scalar, joints[jnp.where(scalar, chain.dof_to_q, 0)], 0)
        real = _quat_is_real(chain)[:, None]
        quat = jnp.where(real, quat, jnp.array([1, 0, 0, 0], q.dtype))
        back = chain.quat_index[2][:, None] == 1
        quat = jnp.where(back, jnp.stack([conjugate(x) for x in quat]), quat)[..., None]
    return Pose(matrix(base[3:]), base[:3], joints[:, None], quat)


def rates_of(chain: Chain, pose: Pose, v):
    """Split v, or anything laid out like it: base part [6, 1], internal joint part [nv, 1]."""
    nb = chain.capacity.base_nv
    base = v[:6] if nb else jnp.zeros(6, v.dtype)
    return base[:, None], _turn(chain, pose, v[nb:], inward=True)[:, None]


def join(chain: Chain, pose: Pose, base, joints):
    """The inverse of `rates_of`."""
    joints = _turn(chain, pose, joints[:, 0], inward=False)
    return joints if chain.capacity.base_nv == 0 else jnp.concatenate([base[:, 0], joints])


def spin(chain: Chain, qd):
    """What a sequence of three screws along turning axes adds to the accelerations of a spherical joint:
    the axes of the child turn together, so A = A' + V' x S w + S ẇ, and ẇ = q̈ + (w2 w3, -w1 w3, w1 w2)."""
    if chain.capacity.quaternions == 0:
        return jnp.zeros_like(qd)
    dofs, real = _quat_dofs(chain), _quat_is_real(chain)[:, None]
    w = jnp.where(real, qd[dofs, 0], 0)
    extra = jnp.stack([w[:, 1] * w[:, 2], -w[:, 0] * w[:, 2], w[:, 0] * w[:, 1]], 1)
    return jnp.zeros_like(qd).at[dofs, 0].add(extra)


def gravity_of(pose: Pose, gravity):
    """[0; gravity] in base axes [6, 1], or empty."""
    if gravity is None:
        return jnp.zeros((0, 1), pose.R.dtype)
    return jnp.concatenate([jnp.zeros(3, pose.R.dtype), pose.R.T @ gravity])[:, None]


def qdot(chain: Chain, q, v):
    """The plain time derivative of q."""
    nb, pose = chain.capacity.base_nq, pose_of(chain, q)
    joints = v[chain.capacity.base_nv :]
    out = jnp.zeros_like(q)
    if chain.capacity.quaternions == 0:
        out = out.at[nb : nb + joints.shape[0]].set(joints)
    else:
        at = jnp.where(chain.dof_to_q >= 0, nb + chain.dof_to_q, q.shape[0])
        out = out.at[at].set(joints, mode="drop")
        real = _quat_is_real(chain)[:, None]
        quat = q[nb + chain.quat_index[0][:, None] + jnp.arange(4)]
        rate = jnp.where(real, _quat_rate(quat.T, joints[_quat_dofs(chain)].T).T, 0)
        out = out.at[nb + chain.quat_index[0][:, None] + jnp.arange(4)].add(rate)
    if nb:
        base = jnp.concatenate([pose.R @ v[3:6], _quat_rate(q[3:7], v[:3])])
        out = out.at[:7].set(jnp.where(chain.free == 1, base, 0))
    return out


def _quat_rate(quat, w):
    """q̇ = 1/2 q o [0; w], rates in body axes."""
    return 0.5 * jnp.concatenate([-(quat[1:] * w).sum(0)[None], quat[0] * w + cross(quat[1:], w)])


def _quat_is_real(chain):
    """Whether a quaternion slot is used: the joint it belongs to moves."""
    return chain.quat_index[0] >= 0


def _quat_dofs(chain):
    return jnp.maximum(chain.quat_index[1], 0)[:, None] + jnp.arange(3)


def _turn(chain, pose, x, inward: bool):
    """Rates of backward spherical joints between the user's (child axes) and the internal ones (tree's child)."""
    if chain.capacity.quaternions == 0:
        return x
    dofs, back = _quat_dofs(chain), (chain.quat_index[2] == 1)[:, None]
    w = x[dofs]
    R = matrix(pose.quat[..., 0].T)  # tree's child to tree's parent [3, 3, quaternions]
    other = -jnp.einsum("jin,nj->ni" if inward else "ijn,nj->ni", R, w)
    return x.at[dofs].add(jnp.where(back & _quat_is_real(chain)[:, None], other - w, 0))


def turned_columns(chain: Chain, pose: Pose, columns):
    """Rows [nv, 6] for the internal rates, made rows for the user's: Jᵀ w_int = (Jᵀ T) w."""
    if chain.capacity.quaternions == 0:
        return columns
    return jnp.stack([_turn(chain, pose, column, inward=False) for column in columns.T], 1)
