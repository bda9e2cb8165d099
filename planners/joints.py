"""What all tasks ask of the joints: their limits, as rows of a problem, and what their effort costs."""

import jax.numpy as jnp
import numpy as np

from planners.problem import Rows
from planners.task import Task


def limit_rows(task: Task, positions: int, rates: int, torques: int, room: int = 0) -> tuple[Rows, ...]:
    """Names of the rows of joint limits, for so many points of each, and for the room for further joints."""
    names, out = [j.name for j in task.joints], []
    for what, scales, unit, count in (
        ("position", np.ones(len(names)), "rad", positions),
        ("rate", task.rate_limits, "rad/s", rates),
        ("torque", task.torque_limits, "N m", torques),
    ):
        out += [Rows(f"{what} limit of {n}", x, unit, (count, 2)) for n, x in zip(names, scales, strict=True)]
        out += [Rows(f"{what} limit of no joint", 1.0, unit, (room, count, 2))] * (room > 0)
    return tuple(out)


def within(data, points, rates, torques):
    """The rows that `limit_rows` names.

    Args:
        data: Holds the limits `position` [n, 2], `rate` [n], `torque` [n], and `margin`, the part of it kept free.
        points, rates: Control points of position and rate, [count, n] each.
        torques: [k, n].
    """
    rows = (
        two_sided(points, data.position[:, 0], data.position[:, 1]),
        two_sided(rates / data.rate, -1.0, 1.0),
        two_sided(torques / data.torque, data.margin - 1, 1 - data.margin),
    )
    return jnp.concatenate(rows)


def two_sided(value, lower, upper):
    """Rows value <= upper and value >= lower, joint by joint: [..., n] to [n * rows * 2]."""
    both = jnp.stack([value - upper, lower - value], axis=-1)
    return jnp.moveaxis(both, -2, 0).ravel()


def effort(data, times, torques, accelerations):
    """Torque, relative to its limit, and acceleration, so that half their squares are the integrals of the cost.

    Args:
        data: Holds the limits `torque` [n] and the `weights`, those of torque and smoothness last.
        times: Grid points [k].
        torques, accelerations: [k, n].
    """
    root = jnp.sqrt(2 / len(data.torque) * trapezoid(jnp.diff(times)))[:, None]
    torque, smoothness = jnp.sqrt(data.weights[-2:])
    return jnp.concatenate(
        [(root * torque * torques / data.torque).ravel(), (root * smoothness * accelerations).ravel()]
    )


def trapezoid(steps):
    """Weights of the trapezoid rule, [k + 1]."""
    return jnp.concatenate([steps / 2, jnp.zeros(1)]) + jnp.concatenate([jnp.zeros(1), steps / 2])
