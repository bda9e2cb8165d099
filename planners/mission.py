"""What a mission asks of a grasp besides the limits of the joints: clearance, attitude of the base, sight, grip.

All is seen from the base, so that little of it depends on much: the links' poses on the joints, the target's pose on
the motion, and, once it is grasped, on the joints again. What a task does not ask for is None here, and in no problem.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sdyn
from planners import clearance, floating, solids
from planners.clearance import Solids
from planners.problem import Rows


class View(NamedTuple):
    """A camera on a link."""

    position: jax.Array  # [3] m
    axis: jax.Array  # [3] unit vector
    half_angle: jax.Array  # [] rad


class Mission(NamedTuple):
    """Numbers of what is asked; all traced."""

    links: jax.Array  # [m] of the robot's shapes, of the hand, of the camera
    hand: tuple  # (rotation [3, 3], position [3]) on its link
    waiting: jax.Array  # [k] parts of the waiting time that are looked at
    solids: Solids | None
    view: View | None
    turn: jax.Array | None  # [2] rad, rad/s
    grip: jax.Array | None  # [2] N, N m

    @property
    def at_hand(self) -> int:
        """Place of the hand among the links."""
        return len(self.links) - 1 - (self.view is not None)


def of(task, fine: float = 1.0) -> Mission | None:
    """What a task asks; None if nothing."""
    if not any((task.clearance, task.sight, task.base_attitude, task.gripper)):
        return None
    number = {link.name: k for k, link in enumerate(task.chaser.links)}
    found, links = clearance.solids_of(task) if task.clearance else (None, [])
    hand, sight, grip, base = task.chaser.frame(task.robot.frame), task.sight, task.gripper, task.base_attitude
    links = [*links, hand.link, *([sight.link] if sight else [])]
    unit, kept = lambda x: np.array(x) / np.linalg.norm(x), 1 - task.limits.margin
    return Mission(
        np.array([number[link] for link in links]),
        (hand.rotation, hand.position),
        np.linspace(0, 1, max(4, round(task.phases["wait"].intervals * fine)) + 1),
        found,
        sight and View(np.array(sight.position), unit(sight.axis), np.array(kept * sight.half_angle)),
        base and kept * np.array([base.turn, base.rate]),
        grip and np.array([grip.force, grip.torque]),
    )


def rows(task, fine: float, intervals) -> tuple[Rows, ...]:
    """Names of the rows of `below`; `intervals` are those of approach, tracking and stabilising."""
    moving, seen = sum(intervals) + 3, sum(intervals[:2]) + 2
    waiting = max(4, round(task.phases["wait"].intervals * fine)) + 1
    out = [Rows(f"clearance of {a!r} from {b!r}", 1.0, "m", (waiting + moving,)) for a, b in solids.pairs(task)]
    if task.sight:
        out.append(Rows("angle of sight", 1.0, "rad", (waiting + seen,)))
    if task.base_attitude:
        out.append(Rows("turn of the base", 1.0, "rad", (moving,)))
        out.append(Rows("angular velocity of the base", task.base_attitude.rate, "rad/s", (moving,)))
    if task.gripper:
        out.append(Rows("force on the gripper", task.gripper.force, "N", (intervals[2] + 1,)))
        out.append(Rows("torque on the gripper", task.gripper.torque, "N m", (intervals[2] + 1,)))
    return tuple(out)


def below(data, wait, motions) -> tuple[jax.Array, ...]:
    """Rows of inequalities, in order; none of what is not asked.

    Args:
        data: `grasp.Data`.
        wait: Waiting time [s].
        motions: Approach, tracking and stabilising.
    """
    asked, out = data.mission, []
    if asked is None:
        return ()
    chain = jax.tree.map(lambda a: a[0], data.chains)
    whole = jax.tree.map(lambda *x: jnp.concatenate(x), *motions)
    times = wait * asked.waiting
    still = jnp.broadcast_to(data.q0, (len(times), len(data.q0)))
    R, p = _placed((chain, asked.links), jnp.concatenate([still, whole.q]))
    hand = R[:, asked.at_hand] @ asked.hand[0], p[:, asked.at_hand] + R[:, asked.at_hand] @ asked.hand[1]
    after = len(motions[2].q)
    if asked.solids is not None or asked.view is not None:
        free = _separate(data, times, motions[:2])
        held = _held(data.grip, hand[0][-after:], hand[1][-after:])
        R_t, p_t = (jnp.concatenate(x) for x in zip(free, held, strict=True))
    if asked.solids is not None:
        own, other = asked.at_hand, len(asked.solids.start) - asked.at_hand
        all_of = lambda x, x_t: jnp.concatenate([x[:, :own], jnp.repeat(x_t[:, None], other, axis=1)], axis=1)
        distance = clearance.apart(asked.solids, all_of(R, R_t), all_of(p, p_t))
        out.append((asked.solids.least - distance).T.ravel())
    if asked.view is not None:
        ray = p_t + R_t @ data.grip[1] - p[:, -1] - R[:, -1] @ asked.view.position
        cosine = jnp.einsum("ki,kij,j->k", ray, R[:, -1], asked.view.axis) / jnp.linalg.norm(ray, axis=1)
        out.append(beyond(cosine, asked.view.half_angle)[:-after])
    if asked.turn is not None:
        most, rate = asked.turn
        cosine = (jnp.trace(whole.R, axis1=1, axis2=2) - 1) / 2
        out += [beyond(cosine, most), (jnp.square(whole.v[:, :3] / rate).sum(axis=1) - 1) / 2]
    if asked.grip is not None:
        force, torque = _wrench_on_hand(chain, motions[2], hand[1][-after:])
        share = lambda x, most: (jnp.square(x / most).sum(axis=1) - (1 - data.margin) ** 2) / 2
        out += [share(force, asked.grip[0]), share(torque, asked.grip[1])]
    return tuple(out)


def beyond(cosine, angle):
    """By how much an angle, given by its cosine, is above another one; to first order, and smooth at zero."""
    return (jnp.cos(angle) - cosine) / jnp.sin(angle)


@floating.locally
def _link_rows(robot, q):
    """Poses of links, base axes, one after the other."""
    chain, links = robot
    R, p = sdyn.body_poses(chain, floating.at_rest(q))
    return jnp.concatenate([R[links].ravel(), p[links].ravel()])


def _placed(robot, q):
    """Poses of links in the base's axes, [k, m, 3, 3] and [k, m, 3]."""
    y, m = _link_rows(robot, q), len(robot[1])
    return y[:, : 9 * m].reshape(-1, m, 3, 3), y[:, 9 * m :].reshape(-1, m, 3)


def _separate(data, times, motions):
    """Pose of the target's base in the axes of the chaser's, [k, 3, 3] and [k, 3]: waiting, then in some phases."""
    R, p, _ = jax.vmap(floating.tumbled, (None, 0))(data.waiting, times)
    R = jnp.concatenate([R, *(at.R for at in motions)])
    p = jnp.concatenate([p, *(at.p for at in motions)])
    times = jnp.concatenate([times, *(at.times for at in motions)])
    R_t, p_t, _ = jax.vmap(floating.tumbled, (None, 0))(data.target, times)
    return jnp.einsum("kji,kjl->kil", R, R_t), jnp.einsum("kji,kj->ki", R, p_t - p)


def _held(grip, R_hand, p_hand):
    """The same while the hand holds it."""
    turn, lever = grip
    R = R_hand @ turn.T
    return R, p_hand - R @ lever


@floating.locally
def _base_wrench(chain, x):
    """Wrench on the base that a motion x = [q, v, vdot] needs."""
    n = (len(x) - 12) // 3
    return sdyn.inverse_dynamics(chain, floating.at_rest(x[:n]), x[n : 2 * n + 6], x[2 * n + 6 :])[:6]


def _wrench_on_hand(chain, at, p_hand):
    """Force and moment about the hand, base axes, [k, 3] each: what the chaser alone would need at its base, besides
    what pushes it.
    """
    wrench = _base_wrench(chain, jnp.concatenate([at.q, at.v, at.vdot], axis=1))
    wrench = wrench if at.push is None else wrench - at.push
    moment, force = wrench[:, :3], wrench[:, 3:]
    return force, moment - jax.vmap(floating.cross)(p_hand, force)
