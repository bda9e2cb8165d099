"""A base that is pushed: a moment and a force on it, as splines, and what they give to the momentum.

Variables are control points of cubic splines, base axes, relative to the limits: the moment n about the base's origin
and the force f; or n alone, where only the attitude is controlled. With b from the base's origin to the centre of mass,

    L' = R (n - b x f),  P' = m c'' = R f,  R' = R hat(I^-1 (R^T L - A qd))

R and L by Munthe-Kaas RK4; P and c by integrals of cubic Hermite polynomials through R f and its rate. A spline is
between its control points: what these keep holds at all times. A base that floats is no special case of it, but what
it tends to as limits tend to zero.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from planners import floating
from planners.bspline import Clamped
from planners.floating import Coupling, Momentum
from planners.joints import trapezoid, two_sided
from planners.problem import Block, Rows


class Push(NamedTuple):
    """Numbers of what moves the base; all traced. m is 3 without forces, else 6."""

    limits: jax.Array  # [m] of moments and forces
    weights: jax.Array  # [m] of their squares in the cost


class Acting(NamedTuple):
    """What acts on the base over some phases, base axes: at points and midpoints of k steps."""

    wrench: jax.Array  # [2 k + 1, 6] moment about the base's origin [N m], force [N]
    rates: jax.Array  # [2, k, 6] its derivative by time where each step starts and ends; it may jump between phases


def of(task) -> Push | None:
    """What moves the base of a task; None if nothing does."""
    if task.base is None:
        return None
    limits, w = np.r_[task.base.torque, task.base.force or ()], task.weights
    return Push(limits, np.repeat([w.base_torque, w.base_force], 3)[: len(limits)])


NAMES = ("push_approach", "push_track", "push_stabilise")


def blocks(task, splines) -> tuple[Block, ...]:
    """The variables: control points of approach, tracking and stabilising. The first two join."""
    if task.base is None:
        return ()
    size = 3 if task.base.force is None else 6
    counts = (splines[0].count - 2, splines[1].count - 3, splines[2].count - 2)
    return tuple(Block(name, (count, size)) for name, count in zip(NAMES, counts, strict=True))


def control_points(x, push: Push):
    """Control points of the three phases, [count - 2, m] each, physical units, from the variables by name."""
    approach, track, stabilise = (x[name] * push.limits for name in NAMES)
    return approach, jnp.concatenate([approach[-1:], track]), stabilise


def acting(splines: tuple[Clamped, ...], grids, points, T) -> Acting:
    """The wrench over phases that follow each other, and join.

    Args:
        splines: The joints'; those of the wrench are their second derivatives, and have their knots.
        grids: Parts of each phase that are points and midpoints; the last of one is the first of the next.
        points: Control points [count - 2, m] of each.
        T: Durations [s].
    """
    wrenches, rates = [], []
    for spline, s, P, t in zip(splines, grids, points, T, strict=True):
        cubic, P = Clamped(spline.count - 2, spline.degree - 2), jnp.pad(P, ((0, 0), (0, 6 - P.shape[1])))
        wrenches.append((cubic.basis(s) @ P)[bool(wrenches) :])
        rate = cubic.basis(s[::2], 1) @ P / t
        rates.append(jnp.stack([rate[:-1], rate[1:]]))
    return Acting(jnp.concatenate(wrenches), jnp.concatenate(rates, axis=1))


def driven(start: Momentum, R0, c: Coupling, drift, act: Acting, steps):
    """The motion of a base along a grid of k steps.

    Args:
        start: Momentum at the start, with the centre of mass there.
        R0: Attitude there.
        c, drift, act: At points and midpoints, [2 k + 1, ...]; `drift` as `floating.drift` says.
        steps: [k] s.

    Returns:
        (R [k + 1, 3, 3], momentum [k + 1], with the centre of mass at each point).
    """
    moments = act.wrench[:, :3] - jax.vmap(floating.cross)(c.centre, act.wrench[:, 3:])
    thirds = (*floating.thirds(c.compliance), *floating.thirds(drift), *floating.thirds(moments), steps)
    rows = jnp.concatenate([x.reshape(len(steps), -1) for x in thirds], axis=1)
    states = floating.march(_step, jnp.concatenate([R0.ravel(), start.angular]), rows)
    R, angular = states[:, :9].reshape(-1, 3, 3), states[:, 9:]
    w = jnp.einsum("kij,klj,kl->ki", c.compliance[::2], R, angular) + drift[::2]
    turn = lambda R, x: jnp.einsum("kij,kj->ki", R, x)
    h, force, spin = steps[:, None], act.wrench[::2, 3:], jax.vmap(floating.cross)(w, act.wrench[::2, 3:])
    F, (first, last) = turn(R, force), act.rates[:, :, 3:]
    first, last = h * turn(R[:-1], spin[:-1] + first), h * turn(R[1:], spin[1:] + last)
    gained = h * ((F[:-1] + F[1:]) / 2 + (first - last) / 12)
    moved = h**2 * (7 * F[:-1] / 20 + 3 * F[1:] / 20 + first / 20 - last / 30)
    sums = lambda at, x: jnp.concatenate([at[None], at + jnp.cumsum(x, axis=0)])
    linear = sums(start.linear, gained)
    return R, Momentum(sums(start.centre, (h * linear[:-1] + moved) / c.mass[0]), linear, angular)


def _step(x):
    """`floating.advance` of its arguments in one row [12 + 46], as a row [12]."""
    R, angular, step = x[:9].reshape(3, 3), x[9:12], x[-1]
    J, g, moments = x[12:39].reshape(3, 3, 3), x[39:48].reshape(3, 3), x[48:57].reshape(3, 3)
    R, angular = floating.advance(R, J, g, angular, step, moments)
    return jnp.concatenate([R.ravel(), angular])


def effort(push: Push, times, wrench):
    """Residuals of the cost: half their squares are the integrals of the squares of what acts [k, 6], weighted."""
    root = jnp.sqrt(2 * trapezoid(jnp.diff(times)))[:, None]
    return (root * jnp.sqrt(push.weights) * wrench[:, : len(push.weights)]).ravel()


def within(limits, values, margin):
    """The rows that `limit_rows` names, of what acts [k, m]; a part of the limits is kept free."""
    return two_sided(values / limits, margin - 1, 1 - margin)


def held(x):
    """The same of all control points, which hold it at all times."""
    return two_sided(jnp.concatenate([x[name] for name in NAMES]), -1.0, 1.0)


def limit_rows(limits, points: int) -> tuple[Rows, ...]:
    """Names of the rows of limits [m] of what acts on the base, at so many points."""
    kinds = ("torque limit of the base about", "N m"), ("force limit of the base along", "N")
    named = [(f"{words} {axis}", unit) for words, unit in kinds for axis in "xyz"]
    return tuple(Rows(name, x, unit, (points, 2)) for (name, unit), x in zip(named, limits, strict=False))
