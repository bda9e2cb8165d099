"""The equations of motion, for one sample: M(q) v̇ + b(q, v) = τ + Σ Jᵀ f.

Every function is unbatched, differentiable forward and reverse in every float argument and in the floats of the chain,
and `vmap` of it runs the batch-last kernel. A structure of the same capacity is the same compiled program.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sdyn import aba as _aba
from sdyn import rebase
from sdyn.chain import Chain, LinkRow
from sdyn.coordinates import gravity_of, join, pose_of, rates_of, spin, turned_columns
from sdyn.crba import crba
from sdyn.inputs import expect
from sdyn.kinematics import link_poses, poses
from sdyn.rnea_derivatives import rnea


def tree_dynamics(
    chain: Chain,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    tau: Float[Array, " nv"],
    *,
    gravity: Float[Array, "3"] | None = None,
    f_ext: Float[Array, "n 6"] | None = None,
) -> Float[Array, " nv"]:
    """`forward_dynamics` of the tree alone: what the closures hold is let go.

    Source:
        Featherstone (2008), section 7.3; derivatives by the implicit rule, see `aba.py`.
    """
    q, v, tau, gravity, f_ext = expect(chain, q=q, v=v, tau=tau, gravity=gravity, f_ext=f_ext)
    if chain.inner is not None:
        inner = rebase.inner_of(chain)
        q, v = rebase.state_seen(chain, inner, q, v)
        pose = pose_of(inner, q)
        force = rebase.force_seen(chain, inner, pose, tau)
        vdot = tree_dynamics(inner, q, v, force, gravity=gravity, f_ext=f_ext)
        return rebase.acceleration_back(chain, inner, pose, v, vdot)
    pose, structure, G, F = operands_of(chain, q, gravity, f_ext)
    V0, qd = rates_of(chain, pose, v)
    f0, force = rates_of(chain, pose, tau)
    a0, qdd = _aba.aba(*structure, V0, qd, f0, force - passive_force(chain, pose, qd), G, F, link=_by_link(chain))
    return join(chain, pose, a0, qdd + spin(chain, qd))


def inverse_dynamics(
    chain: Chain,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    vdot: Float[Array, " nv"],
    *,
    gravity: Float[Array, "3"] | None = None,
    f_ext: Float[Array, "n 6"] | None = None,
) -> Float[Array, " nv"]:
    """Forces that cause given accelerations; the inverse of `forward_dynamics`, with the same arguments.

    Returns:
        tau, laid out as v [N m, N]; the base part is the wrench on the base, about its origin and in its axes.

    Source:
        Featherstone (2008), chapter 5.
    """
    q, v, vdot, gravity, f_ext = expect(chain, q=q, v=v, vdot=vdot, gravity=gravity, f_ext=f_ext)
    return inverse_dynamics_under(chain, q, v, vdot, gravity, f_ext)


def inverse_dynamics_under(chain, q, v, vdot, gravity, f_ext, on_slots=None):
    """`inverse_dynamics` under wrenches on the slots too, base axes and origin [slots + 2, 6]."""
    pose, structure, G, F = operands_of(chain, q, gravity, f_ext)
    if on_slots is not None:
        F = on_slots[..., None] if f_ext is None else F + on_slots[..., None]
    V0, qd = rates_of(chain, pose, v)
    a0, qdd = rates_of(chain, pose, vdot)
    f0, tau = rnea(*structure, V0, qd, a0, qdd - spin(chain, qd), G, F, link=_by_link(chain))
    return join(chain, pose, f0, tau + passive_force(chain, pose, qd))


def bias_force(
    chain: Chain, q: Float[Array, " nq"], v: Float[Array, " nv"], *, gravity: Float[Array, "3"] | None = None
) -> Float[Array, " nv"]:
    """The force b(q, v) at zero acceleration: Coriolis, gravity, damping and stiffness [N m, N]."""
    (v,) = expect(chain, v=v)
    return inverse_dynamics(chain, q, v, jnp.zeros_like(v), gravity=gravity)


def mass_matrix(chain: Chain, q: Float[Array, " nq"]) -> Float[Array, "nv nv"]:
    """The mass matrix M(q), rotor inertias included [kg m^2, kg m, kg].

    Source:
        Featherstone (2008), section 6.2.
    """
    (q,) = expect(chain, q=q)
    if _by_link(chain):  # in its columns, the forces of unit accelerations
        zero = jnp.zeros(chain.nv, q.dtype)
        still = inverse_dynamics(chain, q, zero, zero)  # of the springs
        return jax.vmap(lambda e: inverse_dynamics(chain, q, zero, e) - still)(jnp.eye(chain.nv, dtype=q.dtype))
    pose, (index, *rest), _, _ = operands_of(chain, q, None, None)
    (M,) = crba(index, chain.ancestors, *rest)
    M, nb = M[..., 0], chain.capacity.base_nv
    if chain.capacity.quaternions:
        turn = lambda rows: jnp.concatenate([rows[:6], turned_columns(chain, pose, rows[6:])])
        M = turn(turn(M).T)
    return M[6 - nb :, 6 - nb :]


def solve_mass(chain: Chain, q: Float[Array, " nq"], b: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """M(q)⁻¹ b by two sweeps of the articulated-body algorithm, without forming M.

    Args:
        chain: Packed structure.
        q: Configuration [m, rad, unit quaternion wxyz].
        b: Right-hand side, laid out as v.
    """
    q, b = expect(chain, q=q, b=b)
    if chain.inner is not None:
        inner = rebase.inner_of(chain)
        q, _ = rebase.state_seen(chain, inner, q, jnp.zeros_like(b))
        pose = pose_of(inner, q)
        return rebase.rates_back(chain, inner, pose, solve_mass(inner, q, rebase.force_seen(chain, inner, pose, b)))
    pose, structure, _, _ = operands_of(chain, q, None, None)
    left = _aba.nothing_saved(chain.dtype)
    return join(chain, pose, *_aba.mass_solve(*structure, *left, *rates_of(chain, pose, b), link=_by_link(chain)))


def _by_link(chain: Chain) -> bool:
    return chain.capacity.frame == "link"


def operands_of(chain, q, gravity, f_ext):
    """Pose, the operands that all kernels start with, gravity and wrenches."""
    pose = pose_of(chain, q)
    value, base, rotor = chain.slot_value[..., None], chain.base_value[:, None], chain.dof_value[2][:, None]
    structure = (chain.slot_index, value, base, rotor, pose.q, pose.quat)
    F = jnp.zeros((0, 6, 1), chain.dtype) if f_ext is None else _wrenches(chain, pose, f_ext)
    return pose, structure, gravity_of(pose, gravity), F


def _wrenches(chain, pose, f_ext):
    """Wrenches on the slots, base axes and origin: [Rᵀ n + x × Rᵀ f; Rᵀ f], summed over the links of a slot."""
    slots, _ = poses(chain.slot_index, chain.slot_value[..., None], pose.q, pose.quat)
    _, x = link_poses(chain, slots[..., 0])
    n, f = f_ext[:, :3] @ pose.R, f_ext[:, 3:] @ pose.R
    F = jnp.concatenate([n + jnp.cross(x, f), f], 1)
    return jnp.zeros((slots.shape[0], 6), F.dtype).at[chain.link_index[LinkRow.SLOT]].add(F)[..., None]


def passive_force(chain, pose, qd):
    """Force that damping and stiffness ask for."""
    damping, stiffness, _ = chain.dof_value[..., None]
    return damping * qd + stiffness * pose.q
