"""Motion of a base that forces of its own move: a curve of all coordinates says what acts, without integration.

A curve is x = [c, theta, q]: centre of mass of all in the world, attitude R = exp(hat(theta)) of the base, joints. With
b the centre of mass and m b x, m 1, M_vj the rows of the mass matrix for the base's velocity v, base axes,

    hat(w) = R^T R',  hat(w') = skew(R^T R''),  p = c - R b,  v = R^T c' - w x b - M_vj q' / m,
    [n; f; tau] = ID(q, [w; v; q'], [w'; a; q'']) with the acceleration a that makes f = m R^T c''.

Joints that move and a c that rests need no force: the coordinates are as little coupled as the system is. The attitude
is unique up to a full turn: |theta| < 2 pi.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sdyn
from planners import floating

TURN = 3.6  # rad about each axis: all three together stay below a full turn


class State(NamedTuple):
    """One point of a curve."""

    R: jax.Array  # [3, 3] attitude of the base
    p: jax.Array  # [3] m, its origin
    v: jax.Array  # [6 + n] base axes
    vdot: jax.Array  # [6 + n]
    tau: jax.Array  # [6 + n] moment [N m] about the base's origin and force [N], base axes, then joint torques


def state(chain, x, rate, acceleration) -> State:
    """The state at a point x [6 + n] of a curve, and what acts there without gravity, from its derivatives by time."""
    q, turning = floating.at_rest(x[6:]), lambda theta, rate: jax.jvp(floating.exponential, (theta,), (rate,))
    (R, R1), (_, R2) = jax.jvp(turning, (x[3:6], rate[3:6]), (rate[3:6], acceleration[3:6]))
    c, w, wdot = floating.coupling(sdyn.mass_matrix(chain, q)), _axial(R.T @ R1), _axial(R.T @ R2)
    v = R.T @ rate[:3] - floating.cross(w, c.centre) - c.linear @ rate[6:] / c.mass
    v = jnp.concatenate([w, v, rate[6:]])
    acting = sdyn.inverse_dynamics(chain, q, v, jnp.concatenate([wdot, jnp.zeros(3), acceleration[6:]]))
    force = c.mass * R.T @ acceleration[:3]
    lacks = force - acting[3:6]
    moment, torques = acting[:3] + floating.cross(c.centre, lacks), acting[6:] + c.linear.T @ lacks / c.mass
    vdot = jnp.concatenate([wdot, lacks / c.mass, acceleration[6:]])
    return State(R, x[:3] - R @ c.centre, v, vdot, jnp.concatenate([moment, force, torques]))


def _axial(A):
    """The vector [3] of the skew part of A."""
    return jnp.array([A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1]]) / 2


class Start(NamedTuple):
    """Where a curve starts, with the base at the world's origin, in its axes."""

    x: jax.Array  # [6 + n]
    rate: jax.Array  # [6 + n]
    reply: jax.Array  # [6 + n, 6 + n] accelerations of the coordinates per unit of what acts, at rest


def start(chain, q, v) -> Start:
    """The start of a curve from the state there, q [nq] and v [6 + n]."""
    M = sdyn.mass_matrix(chain, q)
    c = floating.coupling(M)

    def rate(v):
        linear = v[3:6] + floating.cross(v[:3], c.centre) + c.linear @ v[6:] / c.mass
        return jnp.concatenate([linear, v[:3], v[6:]])

    reply = jax.vmap(rate, 1, 1)(jnp.linalg.inv(M))
    return Start(jnp.concatenate([c.centre, jnp.zeros(3), q[7:]]), rate(v), reply)


def calmed(chain, start: Start, q, rate, T):
    """Attitudes [k + 1, 3, 3] of the base over T seconds while the angular momentum falls evenly to zero, from joints
    and their rates at points and midpoints of a grid, [2 k + 1, n] each.
    """
    c, k = floating.couplings(chain, q), len(q) // 2
    drift = floating.drift(c, rate)
    angular = jnp.linalg.solve(c.compliance[0], start.rate[3:6] - drift[0])
    left = 1 - (np.arange(k) + 0.5) / k
    steps = jnp.full(k, T / k)
    compliance, drift = floating.thirds(c.compliance), floating.thirds(drift)
    return floating.attitudes(jnp.eye(3), compliance, drift, left[:, None] * angular, steps)


@floating.locally
def _acting(chain, y):
    at = state(chain, *jnp.split(y, 3))
    return jnp.concatenate([at.tau, at.v])


def acting(chain, x, rate, acceleration):
    """What acts, and velocities, at k points of a curve: tau and v, [k, 6 + n] each, as in `State`."""
    return jnp.split(_acting(chain, jnp.concatenate([x, rate, acceleration], axis=1)), 2, axis=1)
