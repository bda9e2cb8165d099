"""Reaction wheels, which are joints, and thrusters, which are wrenches at frames."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sdyn.chain import Chain, JointRow, JointValue, index_of
from sdyn.dynamics import mass_matrix
from sdyn.inputs import expect
from sdyn.kinematics import body_poses, frame_at


class WheelLoad(NamedTuple):
    """What reaction wheels hold."""

    momentum: Float[Array, " wheels"]
    """Of each wheel about its axis, relative to what carries it [N m s]."""
    total: Float[Array, "3"]
    """Sum over the wheels, world axes [N m s]: what unloading has to take away."""
    saturated: Bool[Array, " wheels"]
    """Whether a wheel holds its limit or more: it cannot take up more in that direction."""


def wheels(chain: Chain, q: Float[Array, " nq"], v: Float[Array, " nv"], joints, limits=None) -> WheelLoad:
    """Momentum stored in reaction wheels, and which of them are saturated.

    Args:
        chain: Packed structure.
        q, v: State.
        joints: Names (or indices, which may be traced) of revolute joints; a locked one holds nothing.
        limits: Largest momentum of each wheel, or of all [N m s]; without it no wheel saturates. Of a wheel with axial
            inertia J and largest speed w it is J w.

    Returns:
        The load. J = M_jj, the inertia about the axis of all that the joint carries, with its rotor's.
    """
    q, v = expect(chain, q=q, v=v)
    index, names = chain.joint_index, chain.capacity.joint_names
    at = jnp.stack([jnp.asarray(index_of(x, names, index[JointRow.NAME], "joint")) for x in joints])
    moves = index[JointRow.MOVES][at] == 1
    entry = chain.capacity.base_nv + jnp.where(moves, index[JointRow.V][at], 0)
    momentum = jnp.where(moves, jnp.diag(mass_matrix(chain, q))[entry] * v[entry], 0)
    R, _ = body_poses(chain, q)
    axis = chain.joint_value[at, JointValue.SCREWS : JointValue.SCREWS + 3]  # the same in the child's axes
    total = jnp.einsum("nij,nj,n->i", R[index[JointRow.CHILD][at]], axis, momentum)
    return WheelLoad(momentum, total, jnp.abs(momentum) >= (jnp.inf if limits is None else jnp.asarray(limits)))


def frame_wrench(
    chain: Chain, q: Float[Array, " nq"], frame, wrench: Float[Array, "6"], *, axes: str = "frame"
) -> Float[Array, "n 6"]:
    """A wrench at a frame (a thruster, a contact, a tool) as `f_ext`; several are added up.

    Args:
        chain: Packed structure.
        q: Configuration [m, rad, unit quaternion wxyz].
        frame: Name, or index, which may be traced.
        wrench: [n; f] about the frame's origin [N m, N].
        axes: "frame", so that it turns with the link, or "world".

    Returns:
        f_ext: One wrench per link, world axes, about the link's origin.

    Raises:
        ValueError: If the axes are neither.
    """
    if axes not in ("frame", "world"):
        raise ValueError(f"frame_wrench: axes is {axes!r}; it is 'frame' or 'world'.")
    (wrench,) = expect(chain, wrench=wrench)
    R, _ = body_poses(chain, q)
    link, Rf, pf = frame_at(chain, frame)
    n, f = (R[link] @ Rf @ wrench.reshape(2, 3).T).T if axes == "frame" else wrench.reshape(2, 3)
    moment = n + jnp.cross(R[link] @ pf, f)
    return jnp.zeros((chain.capacity.links, 6), q.dtype).at[link].add(jnp.concatenate([moment, f]))
