"""First guesses for the grasp: inverse kinematics at many times and from many postures."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from planners import floating, grasp
from planners.ik import inverse_kinematics
from planners.problem import ONCE
from planners.task import Task

TIMES, POSTURES = 12, 8  # candidates of the grasp's time, and random postures for each


@functools.partial(jax.jit, static_argnums=0, **ONCE)
def reach(frame: str, data: grasp.Data, times, q):
    """Joints that bring the hand to the grasp at times [k], from postures q [k, n], with the base as while waiting.

    Returns:
        (q [k, n], miss [k]): the postures, and the norms of what is left of the pose errors [m, rad].
    """
    chain = jax.tree.map(lambda a: a[0], data.chains)

    def one(time, q):
        R, p, _ = floating.tumbled(data.waiting, time)
        goal, start = grasp.grip_motion(data, time)[:2], jnp.concatenate([p, floating.quaternion(R), q])
        found = inverse_kinematics(chain, frame, goal, start, limits=data.position)
        return found.q[7:], found.error

    return jax.vmap(one)(times, q)


def guesses(task: Task, data: grasp.Data, grid: grasp.Grid, count: int, seed: int = 0) -> list[dict]:
    """The best first guesses, by name, physical units: what is out of reach last, then by the time they need."""
    low, high = np.array([task.phases[name].duration for name in task.phases]).T
    rng, n = np.random.default_rng(seed), len(task.joints)
    earliest = low.sum() - low[3]
    times = np.repeat(np.linspace(earliest, max(earliest, high[:3].sum() * 0.9), TIMES), POSTURES)
    spread = np.tile(np.r_[0.0, np.full(POSTURES - 1, 0.8)], TIMES)[:, None]
    limits = np.asarray(data.position)
    start = np.clip(task.start + spread * rng.normal(size=(len(times), n)), limits[:, 0], limits[:, 1])
    q, miss = reach(task.robot.frame, data, jnp.asarray(times), jnp.asarray(start))
    tracking = np.clip(0.5 * (low[2] + high[2]), low[2], high[2])
    before, miss_before = reach(task.robot.frame, data, jnp.asarray(times - tracking), q)
    q, before, miss = np.asarray(q), np.asarray(before), np.asarray(miss + miss_before)
    need = 2.0 * (np.abs(before - task.start) / task.rate_limits).max(axis=1)
    need = np.maximum(need, 2.0 * np.abs(q - before).max(axis=1) / task.rate_limits.min())
    late = np.maximum(need - (times - tracking), 0.0)
    order = np.argsort(100 * np.maximum(miss - 1e-6, 0) + late + 0.1 * times + 0.1 * need, kind="stable")
    # one for each time before a second for any: postures often end in the same one
    again = [np.sum(times[order[:k]] == times[order[k]]) for k in range(len(order))]
    order = order[np.argsort(again, kind="stable")]
    approach = np.clip(need, low[1], high[1])
    return [_guess(task, grid, times[k], tracking, approach[k], before[k], q[k]) for k in order[:count]]


def _guess(task, grid, time, tracking, approach, before, q):
    low, high = np.array([task.phases[name].duration for name in task.phases]).T
    rate, rest = (q - before) / tracking, np.zeros_like(q)
    x = {
        "durations": np.clip([time - tracking - approach, approach, tracking, 0.5 * (low[3] + high[3])], low, high),
        "track_state": np.stack([before, rate, rest]),
        "grasp_state": np.stack([q, rate, rest]),
        "end": q + rate * 2.0,
    }
    stops = (task.start, before, q, x["end"])
    for k, (name, spline) in enumerate(zip(grasp.MOVING, grid.splines, strict=True)):
        s = np.array([spline.knots[j + 1 : j + 1 + spline.degree].mean() for j in range(3, spline.count - 3)])[:, None]
        x[name] = stops[k] * (1 - s) + stops[k + 1] * s
    return x
