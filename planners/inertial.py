"""Inertial parameters of single bodies, and how a free-floating robot moves when they change.

phi = (m, m c, I) of a body, about its link's origin and in its axes, is linear in what follows; G(phi) is its spatial
inertia, J its Jacobian and V, A its twist and acceleration, so that a change of phi adds J^T G J to the mass matrix and

    J^T W,   W = G A + V x* G V

to the forces. Total momentum is zero. The pseudo-inertia P(phi) [4, 4] is positive definite for every body there can
be; P = U E E^T U^T with U of the nominal body and E upper triangular, its diagonal exponentials, reaches all of them.
Source: Wensing, Kim and Slotine (2018), Linear matrix inequalities for physically consistent inertial parameters;
Rucker and Wensing (2022), Smooth parameterization of rigid-body inertia.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sdyn
from planners import floating
from planners.floating import cross, hat

PARAMETERS = ("m", "m cx", "m cy", "m cz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def nominal(link: sdyn.Link) -> tuple[np.ndarray, np.ndarray]:
    """The ten parameters of a link, about its origin, and the magnitudes that they are measured against."""
    c = link.com
    I = link.inertia + link.mass * (c @ c * np.eye(3) - np.outer(c, c))
    radius = np.sqrt(np.trace(link.inertia) / (2 * link.mass))  # of gyration
    size = np.trace(link.inertia) / 3
    return np.r_[link.mass, link.mass * c, [I[pair] for pair in PAIRS]], np.r_[
        link.mass, [link.mass * radius] * 3, [size] * 6
    ]


def replaced(robot: sdyn.Robot, phi: dict) -> sdyn.Robot:
    """The robot with other parameters {name of a link: phi [10]}."""
    links = tuple(_link(link, np.asarray(phi[link.name])) if link.name in phi else link for link in robot.links)
    return replace(robot, links=links)


def _link(link, phi):
    c, I = phi[1:4] / phi[0], np.asarray(symmetric(phi[4:]))
    return replace(link, mass=float(phi[0]), com=c, inertia=I - phi[0] * (c @ c * np.eye(3) - np.outer(c, c)))


def symmetric(six):
    """The matrix [3, 3] with the entries xx xy xz yy yz zz."""
    xx, xy, xz, yy, yz, zz = six
    return jnp.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def spatial_inertia(phi):
    """G [6, 6], linear in phi [10]; angular rows first."""
    h = hat(phi[1:4])
    return jnp.block([[symmetric(phi[4:]), h], [-h, phi[0] * jnp.eye(3)]])


def pseudo_inertia(phi):
    """P [4, 4], linear in phi [10]; positive definite for a body that there can be."""
    I, h = symmetric(phi[4:]), phi[1:4]
    second = jnp.trace(I) / 2 * jnp.eye(3) - I
    return jnp.block([[second, h[:, None]], [h[None], phi[:1, None]]])


def consistent(phi, eta):
    """Parameters [10] near phi, of a body that there can be for every eta [10]; phi itself for zero.

    Differentiable in both; phi must have a positive definite pseudo-inertia.
    """
    flip = lambda S: S[::-1, ::-1]
    U = flip(jnp.linalg.cholesky(flip(pseudo_inertia(phi))))  # upper triangular
    E = jnp.diag(jnp.exp(eta[:4])).at[np.triu_indices(4, 1)].set(eta[4:])
    P = U @ E @ E.T @ U.T
    I = jnp.trace(P[:3, :3]) * jnp.eye(3) - P[:3, :3]
    return jnp.concatenate([P[3:, 3], P[:3, 3], jnp.stack([I[pair] for pair in PAIRS])])


class Path(NamedTuple):
    """At one point, all that the joints' path decides whatever the parameters are; base axes, n joints, m = 6 + n."""

    rate: jax.Array  # [n]
    acceleration: jax.Array  # [n]
    M: jax.Array  # [m, m] nominal mass matrix
    slope: jax.Array  # [m, m, n] its derivatives for the joints
    J: jax.Array  # [k, 6, m] Jacobians of the bodies that change, own axes and origin
    J_dot: jax.Array  # [k, 6, m]


def path(chain, frames, q, rate, acceleration) -> Path:
    """The path at joint positions, rates and accelerations [n]; `frames` [k] are those at the bodies' origins."""

    def jacobian(frame, q):
        R, _ = sdyn.frame_pose(chain, floating.at_rest(q), frame)
        J = sdyn.frame_jacobian(chain, floating.at_rest(q), frame)
        return jnp.concatenate([R.T @ J[:3], R.T @ J[3:]])

    mass = lambda q: (sdyn.mass_matrix(chain, floating.at_rest(q)),) * 2
    slope, M = jax.jacfwd(mass, has_aux=True)(q)
    jacobians = lambda q: jax.vmap(jacobian, (0, None))(frames, q)
    return Path(rate, acceleration, M, slope, *jax.jvp(jacobians, (q,), (rate,)))


def response(at: Path, change):
    """Base twist and acceleration [6], and joint torques [n] without passive ones, after phi [k, 10] has changed."""
    G = jax.vmap(spatial_inertia)(change)
    GJ = G @ at.J
    M = at.M + jnp.einsum("kai,kaj->ij", at.J, GJ)
    c = floating.coupling(M)
    twist = floating.base_twist(c, jnp.eye(3), at.rate, floating.AT_REST)
    V = jnp.concatenate([twist, at.rate])
    half = jnp.einsum("i,ijn->jn", V, at.slope)
    own = jnp.concatenate([force_cross(twist, at.M[:6] @ V), -half.T @ V / 2])  # of the nominal robot
    bodies = jax.vmap(force_cross)(at.J @ V, GJ @ V) + jnp.einsum("kab,kbj,j->ka", G, at.J_dot, V)
    force = M[:, 6:] @ at.acceleration + half @ at.rate + own + jnp.einsum("kai,ka->i", at.J, bodies)
    turn = -c.compliance @ (force[:3] - cross(c.centre, force[3:6]))
    pushed = jnp.concatenate([turn, cross(c.centre, turn) - force[3:6] / c.mass])
    return twist, pushed, force[6:] + M[6:, :6] @ pushed


def force_cross(V, f):
    """V x* f: the rate of a force or momentum f [6] that is at rest in axes which move with V [6]."""
    return jnp.concatenate([cross(V[:3], f[:3]) + cross(V[3:], f[3:]), cross(V[:3], f[3:])])


def felt(lever, twist, acceleration):
    """Specific force [3] at a lever [3] from the base's origin, from its twist and the rate of that [6]."""
    w = twist[:3]
    return acceleration[3:] + cross(w, twist[3:] + cross(w, lever)) + cross(acceleration[:3], lever)
