"""From the user's q and v to the operands of the kernels, and back.

Kernels know one scalar per degree of freedom and a quaternion per spherical joint, in the base's frame and with a
trailing batch axis of one. A spherical joint is three screws along the child's axes behind R(quat); its internal rates
are those of the tree's child in its own axes, which is `-R w` where the joint is traversed backwards.
"""

from typing import NamedTuple

import jax.numpy as jnp

from sdyn.chain import BaseRow, Chain, JointRow
from sdyn.rotation import conjugate, exp, matrix, normalised, product
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
    ground = chain.base_value[BaseRow.POSE :]
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


def live_entries(chain: Chain):
    """Which entries of v are of a free base, or of a joint that moves [nv]; the others are empty."""
    first, count = chain.joint_index[JointRow.V], chain.joint_index[JointRow.DOF]
    entry = jnp.arange(chain.capacity.nv)
    joints = ((entry >= first[:, None]) & (entry < (first + count)[:, None])).any(0)
    return jnp.concatenate([jnp.broadcast_to(chain.free == 1, (chain.capacity.base_nv,)), joints])


def quaternions_of(chain: Chain, q):
    """Quaternions of a free base and of spherical joints [quaternions, 4]; empty ones are the identity."""
    nb, one = chain.capacity.base_nq, jnp.array([1, 0, 0, 0], q.dtype)
    found = [jnp.where(chain.free == 1, q[3:7], one)[None]] if nb else []
    if chain.capacity.quaternions:
        places = nb + chain.quat_index[0][:, None] + jnp.arange(4)
        found.append(jnp.where(_quat_is_real(chain)[:, None], q[places], one))
    return jnp.concatenate([jnp.zeros((0, 4), q.dtype), *found])


def _quat_is_real(chain):
    """Whether a quaternion is in use: the joint it belongs to moves."""
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


def retract(chain: Chain, q, xi):
    """The configuration at the increment `xi`, laid out like v: rotation vectors in body axes, the base's
    displacement in world axes; joints add."""
    nb, nv = chain.capacity.base_nq, chain.capacity.base_nv
    joints = xi[nv:]
    if chain.capacity.quaternions == 0:
        out = q.at[nb : nb + joints.shape[0]].add(joints)
    else:
        out = q.at[jnp.where(chain.dof_to_q >= 0, nb + chain.dof_to_q, q.shape[0])].add(joints, mode="drop")
        places = nb + chain.quat_index[0][:, None] + jnp.arange(4)
        real = _quat_is_real(chain)[:, None]
        quat = jnp.where(real, q[places], jnp.array([1, 0, 0, 0], q.dtype))  # what is no quaternion may have no length
        new = _turned(quat.T, joints[_quat_dofs(chain)].T).T
        out = out.at[jnp.where(real, places, q.shape[0])].set(new, mode="drop")
    if nb:
        base = jnp.concatenate([q[:3] + xi[3:6], _turned(q[3:7], xi[:3])])
        out = out.at[:7].set(jnp.where(chain.free == 1, base, q[:7]))
    return out


def increment_rate(chain: Chain, q, xi, v):
    """Time derivative of `xi` where `retract(q0, xi) = q` moves with v:
    θ' = w + 1/2 θ x w + 1/12 θ x (θ x w), and the base's origin with R v."""
    out = on_rotations(chain, _rotation_vector_rate, xi, v)
    if chain.capacity.base_nv:
        base = jnp.concatenate([out[:3], pose_of(chain, q).R @ v[3:6]])
        out = out.at[:6].set(base * chain.free)
    return out


def on_rotations(chain: Chain, f, *x):
    """The last of the arrays, laid out like v, with f(parts [3, ...] of all) where it describes a rotation."""
    out = x[-1]
    if chain.capacity.quaternions:
        dofs = chain.capacity.base_nv + _quat_dofs(chain)
        new, old = f(*(y[dofs].T for y in x)).T, out[dofs]
        out = out.at[dofs].add(jnp.where(_quat_is_real(chain)[:, None], new - old, 0))
    return out.at[:3].set(f(*(y[:3] for y in x))) if chain.capacity.base_nv else out


def _turned(quat, theta):
    """quat o exp(theta), normalised."""
    return normalised(product(normalised(quat), exp(theta)))


def _rotation_vector_rate(theta, w):
    return w + cross(theta, w) / 2 + cross(theta, cross(theta, w)) / 12
