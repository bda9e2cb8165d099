"""Inverse kinematics by damped Gauss-Newton: joints that bring a frame to a goal, within limits.

    minimise |e|^2,   e = [rotation vector of R R_goal^T; p - p_goal; residuals of the closures]
    dq = -J^T (J J^T + l 1)^-1 e,   l = DAMPING |e|^2 + a little

with J the Jacobian of the frame and of the closures for the joints alone, or, where the base floats, for joints whose
motion the base follows at zero momentum (the generalised Jacobian). A joint at a limit that would leave it stays.
Source: Sugihara (2011), Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method; Umetani and
Yoshida (1989), Resolved motion rate control of space manipulators.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

import sdyn
from planners import floating

DAMPING, LEAST = 1e-3, 1e-12
LONGEST = 0.3  # rad or m that a joint moves in one step
STATUSES = ("reached", "not reached")


class Posture(NamedTuple):
    """Where the search ended."""

    q: jax.Array  # [nq]
    error: jax.Array  # [] norm of what is left of the pose error, closures included; rad, m
    status: jax.Array  # [] index into STATUSES
    iterations: jax.Array  # []


def inverse_kinematics(
    chain: sdyn.Chain, frame, goal, q, *, limits=None, floats=False, iterations: int = 60, tolerance=1e-10
) -> Posture:
    """Joints that bring a frame to a goal, from one start; `vmap` it over starts, goals or structures.

    Args:
        chain: Packed structure, free or grounded, open or closed; no spherical joints.
        frame: Name or index.
        goal: (rotation [3, 3] or None where any will do, position [3]), world [m].
        q: The start [nq].
        limits: Lower and upper limits of the joints [joints, 2]; none if left out. The start is moved within them.
        floats: Whether a free base follows the joints at zero momentum, to first order in each step, with the centre of
            mass where it is; it keeps its pose otherwise. A number, 1 or 0, may be traced.
        iterations: At most.
        tolerance: Of the error's norm, at which the goal is reached.

    Raises:
        ValueError: If the structure has spherical joints, or a base floats that is grounded.

    Not differentiable in reverse; where the goal is out of reach, the status says so and q is what came closest.
    """
    nb = 0 if chain.capacity.layout == "grounded" else 7
    if chain.capacity.quaternions:
        raise ValueError("inverse_kinematics: spherical joints are not supported; use three revolute ones.")
    if floats is not False and not nb:
        raise ValueError("inverse_kinematics: a grounded base cannot float; leave floats out.")
    low, high = (-jnp.inf, jnp.inf) if limits is None else jnp.moveaxis(jnp.asarray(limits), -1, 0)
    mass_centre = sdyn.centre_of_mass(chain, q) if floats is not False else None

    def body(carry):  # at first nothing is known and nothing moves, so that what a posture says is compiled once
        best, s, (e, J, follow) = carry
        dq = _damped(J, e)
        inside = jnp.clip(s.q[nb:] + dq, low, high) - s.q[nb:]
        dq = _damped(J * (inside != 0), e)
        dq = dq * jnp.minimum(1.0, LONGEST / (jnp.abs(dq).max() + LEAST))
        joints = jnp.clip(s.q[nb:] + dq, low, high)
        base = s.q[:nb]
        if floats is not False:
            carried = _carried(chain, base, follow @ (joints - s.q[nb:]), joints, mass_centre)
            base = jnp.where(floats, carried, base)
        q = jnp.concatenate([base, joints])
        there = look(q)
        left = jnp.linalg.norm(there[0])
        new = Posture(q, left, jnp.where(left <= tolerance, 0, 1), s.iterations + 1)
        better = new.error < best.error
        return jax.tree.map(lambda a, b: jnp.where(better, a, b), new, best), new, there

    look = lambda q: _linear(chain, frame, goal, q, nb, floats)
    q = jnp.concatenate([q[:nb], jnp.clip(q[nb:], low, high)])
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(look, q))
    start = Posture(q, jnp.asarray(jnp.inf, q.dtype), jnp.asarray(1), jnp.asarray(-1))
    goes_on = lambda carry: (carry[1].status == 1) & (carry[1].iterations < iterations)
    best, now, _ = jax.lax.while_loop(goes_on, body, (start, start, nothing))
    return best._replace(iterations=now.iterations)


def _error(chain, frame, goal, q):
    """What is left [6 + rows], or [3 + rows] where any rotation will do."""
    R, p = sdyn.frame_pose(chain, q, frame)
    turn = [] if goal[0] is None else [_rotation_vector(R @ goal[0].T)]
    return jnp.concatenate([*turn, p - goal[1], sdyn.loop_residual(chain, q)])


def _rotation_vector(R):
    """Of a rotation, exact up to half a turn."""
    quat = floating.quaternion(R)
    w, x = jnp.abs(quat[0]), jnp.where(quat[0] < 0, -1.0, 1.0) * quat[1:]
    length = jnp.linalg.norm(x)
    return x * jnp.where(length > 0, 2 * jnp.arctan2(length, w) / jnp.where(length > 0, length, 1.0), 2.0)


def _linear(chain, frame, goal, q, nb, floats):
    """The error, its Jacobian for the joints, and the twist of the base [6, joints] that follows them."""
    e, first = _error(chain, frame, goal, q), 6 if nb else 0
    J = sdyn.frame_jacobian(chain, q, frame)
    closures = [sdyn.loop_jacobian(chain, q)] if chain.capacity.loops else []
    J = jnp.concatenate([J if goal[0] is not None else J[3:], *closures])
    if floats is False:
        return e, J[:, first:], None
    M = sdyn.mass_matrix(chain, q)[:6]
    follow = -floats * jnp.linalg.solve(M[:, :6], M[:, 6:])
    return e, J[:, 6:] + J[:, :6] @ follow, follow


def _damped(J, e):
    """The step of Gauss-Newton, damped."""
    size = DAMPING * (e @ e) + LEAST
    return -J.T @ jnp.linalg.solve(J @ J.T + size * jnp.eye(len(e)), e)


def _carried(chain, base, twist, joints, mass_centre):
    """The pose of a base after the small displacement `twist`, placed so that the centre of mass stays."""
    R = floating.rotation(base[3:]) @ floating.exponential(twist[:3])
    quat = floating.quaternion(R)
    there = sdyn.centre_of_mass(chain, jnp.concatenate([jnp.zeros(3), quat, joints]))
    return jnp.concatenate([mass_centre - there, quat])
