"""Parameters of a chain: inertias of the original links and lock values, and the equations linear in the former."""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from sdyn.chain import BaseRow, Chain, JointRow, JointValue, LinkRow, Params, index_of
from sdyn.coordinates import gravity_of, pose_of
from sdyn.inputs import expect
from sdyn.kinematics import jacobian_columns, link_motions, poses
from sdyn.merge import derive


def params(chain: Chain) -> Params:
    """Masses, centres of mass and inertias of the original links, as a pytree."""
    return Params(chain.link_mass, chain.link_com, chain.link_inertia)


def with_params(chain: Chain, params: Params) -> Chain:
    """The chain with other inertial parameters; differentiable, and compiles nothing new.

    Args:
        chain: Packed structure.
        params: One entry for each original link, locked ones included. Physical consistency is the caller's.
    """
    return rederived(replace(chain, link_mass=params.mass, link_com=params.com, link_inertia=params.inertia))


def with_locks(chain: Chain, values: dict) -> Chain:
    """The chain with other values of locked joints; differentiable, and compiles nothing new.

    Args:
        chain: Packed structure.
        values: {name of a locked joint: value}, in the units of q; values may be traced [m, rad, quaternion wxyz].

    Raises:
        RobotError: If there is no such joint. The value of a joint that moves has no effect.
    """
    rows = chain.joint_value
    for name, value in values.items():
        index = index_of(name, chain.capacity.joint_names, chain.joint_index[JointRow.NAME], "joint")
        value = jnp.atleast_1d(jnp.asarray(value, chain.dtype))
        first = JointValue.LOCK_QUAT if value.shape == (4,) else JointValue.LOCK
        rows = rows.at[index, first : first + len(value)].set(value)
    return rederived(replace(chain, joint_value=rows))


def rederived(chain: Chain) -> Chain:
    """The chain with its slots, base and link poses derived anew from links, joints and lock values."""
    inertial = chain.link_mass, chain.link_com, chain.link_inertia
    value, base, link_pose = derive(jnp, chain.slot_index, chain.link_index, chain.joint_value, *inertial)
    base_value = jnp.concatenate([base, chain.base_value[BaseRow.FREE :]])
    inner = chain.inner
    if inner is not None:
        keys = "link_mass", "link_com", "link_inertia", "joint_value"
        inner = rederived(replace(inner, **{key: getattr(chain, key) for key in keys}))
    return replace(chain, slot_value=value, base_value=base_value, link_pose=link_pose, inner=inner)


def regressor(
    chain: Chain,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    vdot: Float[Array, " nv"],
    *,
    gravity: Float[Array, "3"] | None = None,
) -> Float[Array, "nv 10n"]:
    """The matrix Y of inverse dynamics, tau = Y theta, without damping, stiffness and rotors.

    Args:
        chain: Packed structure.
        q, v, vdot: State and acceleration.
        gravity: Acceleration of free fall, world axes [m/s^2].

    Returns:
        Columns per original link: mass, first moment m c (3), inertia about the link's origin (xx xy xz yy yz zz).

    Source:
        Atkeson, An and Hollerbach, Estimation of inertial parameters (1986).
    """
    q, v, vdot, gravity = expect(chain, q=q, v=v, vdot=vdot, gravity=gravity)
    pose = pose_of(chain, q)
    R, p, V, A = link_motions(chain, pose, v, vdot)
    if gravity is not None:
        A = A - gravity_of(pose, gravity)[:, 0]
    # into link axes, about the link's origin
    turn = lambda x: jnp.einsum("nji,nj->ni", R, x)
    w, al = turn(V[:, :3]), turn(A[:, :3])
    u, a = turn(V[:, 3:] + jnp.cross(V[:, :3], p)), turn(A[:, 3:] + jnp.cross(A[:, :3], p))
    a = a + jnp.cross(w, u)  # classical acceleration of the origin
    hat = lambda x: jnp.stack([jnp.cross(x, e) for e in jnp.eye(3, dtype=x.dtype)], 2)
    hw, hal, ha = hat(w), hat(al), hat(a)
    force = jnp.concatenate([a[:, :, None], hal + hw @ hw, jnp.zeros((*a.shape, 6), a.dtype)], 2)
    moment = jnp.concatenate([jnp.zeros_like(a)[:, :, None], -ha, _inertia_columns(al) + hw @ _inertia_columns(w)], 2)
    # wrench of each link, columns per parameter, back to base axes and the base's origin
    force, moment = R @ force, R @ moment
    moment = moment + jnp.cross(p[:, :, None], force, axis=1)
    wrench = jnp.concatenate([moment, force], 1)

    _, S = poses(chain.slot_index, chain.slot_value[..., None], pose.q, pose.quat)
    columns = jacobian_columns(chain, pose, S[..., 0], chain.link_index[LinkRow.SLOT])
    return jnp.einsum("nkv,nkc->vnc", columns, wrench).reshape(chain.nv, -1)


def _inertia_columns(w):
    """The matrix with I w = L(w) [xx xy xz yy yz zz]."""
    o = jnp.zeros_like(w[:, 0])
    x, y, z = w.T
    rows = [[x, y, z, o, o, o], [o, x, o, y, z, o], [o, o, x, o, y, z]]
    return jnp.stack([jnp.stack(row, 1) for row in rows], 1)
