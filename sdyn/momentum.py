"""Energy, momentum and centre of mass."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from sdyn.chain import Chain, LinkRow
from sdyn.coordinates import pose_of, rates_of
from sdyn.inputs import expect
from sdyn.kinematics import link_motions, link_poses, poses


def centre_of_mass(chain: Chain, q: Float[Array, " nq"]) -> Float[Array, "3"]:
    """Centre of mass of all links, world [m].

    Args:
        chain: Packed structure.
        q: Configuration [m, rad, unit quaternion wxyz].
    """
    (q,) = expect(chain, q=q)
    pose = pose_of(chain, q)
    slots, _ = poses(chain.slot_index, chain.slot_value[..., None], pose.q, pose.quat)
    R, p = link_poses(chain, slots[..., 0])
    return pose.p + pose.R @ _centre(chain, R, p)


def momentum(chain: Chain, q: Float[Array, " nq"], v: Float[Array, " nv"]) -> Float[Array, "6"]:
    """Angular momentum about the centre of mass and linear momentum, world axes [N m s, N s].

    Args:
        chain: Packed structure.
        q, v: State.
    """
    q, v = expect(chain, q=q, v=v)
    pose = pose_of(chain, q)
    R, p, V, _ = link_motions(chain, pose, v, jnp.zeros_like(v))
    h = link_momenta(chain, R, p, V)
    L, P = h[:, :3].sum(0), h[:, 3:].sum(0)
    return jnp.concatenate([pose.R @ (L - jnp.cross(_centre(chain, R, p), P)), pose.R @ P])


def kinetic_energy(chain: Chain, q: Float[Array, " nq"], v: Float[Array, " nv"]) -> Float[Array, ""]:
    """Kinetic energy, rotors included [J].

    Args:
        chain: Packed structure.
        q, v: State.
    """
    q, v = expect(chain, q=q, v=v)
    pose = pose_of(chain, q)
    R, p, V, _ = link_motions(chain, pose, v, jnp.zeros_like(v))
    _, qd = rates_of(chain, pose, v)
    return 0.5 * ((V * link_momenta(chain, R, p, V)).sum() + (chain.dof_value[2] * qd[:, 0] ** 2).sum())


def link_momenta(chain: Chain, R, p, V):
    """Momentum [n; f] of every link about the base's origin, base axes [n, 6]; only twists V are moving."""
    m = chain.link_mass[:, None]
    x = p + (R @ chain.link_com[..., None])[..., 0]
    P = m * (V[:, 3:] + jnp.cross(V[:, :3], x))
    I = R @ chain.link_inertia @ jnp.swapaxes(R, 1, 2)
    return jnp.concatenate([(I @ V[:, :3, None])[..., 0] + jnp.cross(x, P), P], 1)


def _centre(chain, R, p):
    """Centre of mass in base axes."""
    x = p + (R @ chain.link_com[..., None])[..., 0]
    m = _masses(chain)
    return (m @ x) / m.sum()


def total_mass(chain: Chain) -> Float[Array, ""]:
    """Mass of all links [kg]."""
    return _masses(chain).sum()


def _masses(chain):
    present = chain.link_index[LinkRow.SLOT] <= chain.capacity.slots
    return jnp.where(present, chain.link_mass, 0)
