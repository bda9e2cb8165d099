"""Tasks stated for multiple shooting: forward dynamics from knot to knot, under torques that are linear in between.

A state is the configuration, the velocity, what acts, and the duration T, which stays; the control is what acts at the
next knot. So torques are continuous, their squares are integrated exactly, and a free duration is a state that is not
given at the start. Accelerations cost by their means over the steps of integration. The kind `reach` is stated so, with
closed loops too: their motion is that of forward dynamics, projected after each step, and all rest where the joints do
that the others follow.
"""

import functools
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import qr

import sdyn
from planners import floating, reach
from planners.joints import limit_rows
from planners.plan import PhaseResult
from planners.problem import ONCE, Block, Form, Problem, Rows, Values
from planners.task import Task, TaskError

STEPS = 6  # of RK4 from knot to knot: with one, a slow arm misses its goal by 6e-5 m; with six, by 7e-9 m
CLOSED = 1e-9  # of loops at the start [rad, m]
DEPENDENT = 1e-9  # part of the largest pivot, below which rows of loops say nothing new
TOGETHER = 32  # motions that a certificate follows at once


class State(NamedTuple):
    """At one knot."""

    q: jax.Array  # [7 + n]
    v: jax.Array  # [6 + n]
    acts: jax.Array  # [n] torques of the joints
    T: jax.Array  # [] s, duration of the whole motion


class Data(NamedTuple):
    """Numbers of one task; all traced. Tangents are [turn, base's place, joints, v, acts, T]."""

    chain: sdyn.Chain
    start: State
    given: jax.Array  # [x] 1 where the start is given
    lower: jax.Array  # [x] bounds at the knots
    upper: jax.Array  # [x]
    scale: jax.Array  # [x] of rows of the bounds
    time: jax.Array  # [] weight of T, 1/s
    effort: jax.Array  # [n] weights of the integrals of the squares of what acts
    smoothness: jax.Array  # [n] and of accelerations
    independent: jax.Array | None  # [k] joints whose rates say whether all rest; None for all of them
    frame: jax.Array  # [] number of the frame that is to be at the goal
    goal: tuple  # (rotation [3, 3], position [3])


@dataclass(frozen=True)
class Shooting:
    """What is compiled.

    Args:
        intervals: Between the knots.
        oriented: Whether the frame has an orientation to be reached, too. All starts and ends at rest, without torque.
        differenced: Whether curvature is found by differences of gradients: with closed loops, where exact second
            derivatives take minutes to compile.
    """

    intervals: int
    oriented: bool
    differenced: bool

    def move(self, x: State, dx) -> State:
        """Along a tangent: the base turns about its own axes."""
        nq, n = x.q.size, x.v.size
        turn = jnp.concatenate([jnp.ones(1), dx[:3] / 2])
        quat = _times(x.q[3:7], turn) / jnp.sqrt(turn @ turn)
        q = jnp.concatenate([x.q[:3] + dx[3:6], quat, x.q[7:nq] + dx[6:n]])
        return State(q, x.v + dx[n : 2 * n], x.acts + dx[2 * n : -1], x.T + dx[-1])

    def gap(self, a: State, b: State):
        """The tangent from b to a, turns to third order."""
        apart = _times(b.q[3:7] * jnp.array([1, -1, -1, -1.0]), a.q[3:7])
        turn = 2 * jnp.where(apart[0] < 0, -1, 1) * apart[1:]
        same = a.q[:3] - b.q[:3], a.q[7:] - b.q[7:], a.v - b.v, a.acts - b.acts, (a.T - b.T)[None]
        return jnp.concatenate([turn, *same])

    def bounded(self, x: State):
        """What bounds hold, laid out like a tangent."""
        return jnp.concatenate([jnp.zeros(6), x.q[7:], x.v, x.acts, x.T[None]])

    def bounds(self, data: Data):
        """Lower and upper bounds [N + 1, x]; of T, at the start only."""
        free = jnp.arange(data.given.size) == data.given.size - 1

        def along(path, none):
            all = jnp.broadcast_to(path, (self.intervals + 1, path.size))
            return all.at[1:].set(jnp.where(free, none, all[1:]))

        return along(data.lower, -jnp.inf), along(data.upper, jnp.inf)

    def start(self, data: Data):
        """The state at the start, and 1 for what of it is given."""
        return data.start, data.given

    def force(self, acts):
        """What acts, laid out like v."""
        return jnp.concatenate([jnp.zeros(6), acts])

    def stage(self, x: State, u, data: Data, steps: int = STEPS, drift="project"):
        """The state at the next knot, and what half the squares of are the cost in between."""
        h = x.T / self.intervals
        force = lambda t, q, v: self.force(x.acts + t / h * (u - x.acts))
        qs, vs = sdyn.rollout(data.chain, x.q, x.v, force, h / steps, steps=steps, drift=drift)
        mean, change = (x.acts + u) / 2, (u - x.acts) / np.sqrt(12)
        effort = jnp.sqrt(2 * h * data.effort) * jnp.stack([mean, change])
        smooth = jnp.sqrt(2 * data.smoothness * steps / h) * jnp.diff(vs[:, 6:], axis=0)
        return State(qs[-1], vs[-1], u, x.T), jnp.concatenate([effort.ravel(), smooth.ravel()])

    def rough(self, x: State, u, data: Data):
        """The same in one step, exact enough for curvature; in it, closed loops stay so without help."""
        return self.stage(x, u, data, 1, 0.0)

    def end(self, x: State, data: Data):
        """Residuals of the cost at the end, of which there are none, what must be zero there, and the cost of time."""
        R, p = sdyn.frame_pose(data.chain, x.q, data.frame)
        turn = [floating.logarithm(data.goal[0].T @ R)] if self.oriented else []
        rates = x.v[6:] if data.independent is None else x.v[6:][data.independent]
        return jnp.zeros(0), jnp.concatenate([p - data.goal[1], *turn, rates, x.acts]), data.time * x.T

    def first(self, x, data: Data) -> tuple[State, jax.Array]:
        """The start and the controls, from the variables by name."""
        T = x["duration"][0] if "duration" in x else data.start.T
        return data.start._replace(T=T), x["acts"]

    def variables(self, x: State, u) -> dict:
        """The inverse of `first`, from states at the knots and controls."""
        return {"duration": x.T[:1], "acts": u}

    def path(self, x, data: Data):
        """States at the knots, controls and residuals, from the variables by name: what the torques do."""
        start, u = self.first(x, data)

        def stage(x, u):
            new, r = self.stage(x, u, data)
            return new, (new, r)

        _, (after, r) = jax.lax.scan(stage, start, u)
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, after), u, r

    def __call__(self, x, data: Data) -> Values:
        """The same problem with the torques alone as variables: values for variables by name, physical units."""
        path, _, r = self.path(x, data)
        _, e, smooth = self.end(jax.tree.map(lambda y: y[-1], path), data)
        at, (lower, upper) = jax.vmap(self.bounded)(path), self.bounds(data)
        below = self.rows(at - upper, lower - at, data, 1 / data.scale)
        return Values(smooth, r.ravel(), e, below)

    def rows(self, over, under, data: Data, scale):
        """Rows of the bounds, in the order of `_named`, from what belongs to upper and lower ones [N + 1, x]."""
        n = data.start.q.size - 7
        over, under = over * scale, under * scale
        parts = slice(6, 6 + n), slice(12 + n, 12 + 2 * n), slice(-1 - n, -1)
        return jnp.concatenate([_in_turn(over[:, part], under[:, part]) for part in parts])


def _times(a, b):
    """Product of quaternions wxyz."""
    return jnp.concatenate([(a[0] * b[0] - a[1:] @ b[1:])[None], a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])])


def _in_turn(over, under):
    """As `joints.two_sided`: [k, n] each to [n * k * 2]."""
    return jnp.moveaxis(jnp.stack([over, under], axis=-1), -2, 0).ravel()


# -- from tasks --------------------------------------------------------------------------------------------------------

FINE = 12  # intervals of the motion whose end is reported, between two knots


def data(task: Task, intervals: int, chain: sdyn.Chain | None = None) -> Data:
    """The numbers of a reach on a grid; its chain is packed anew, or given with room for more joints."""
    d = reach.data(task, chain)
    n, (time, torque, smoothness), (low, high) = len(d.q0), d.weights, d.duration
    free, part = np.full(6, np.inf), 1 - d.margin
    near = d.margin * d.rate * low / intervals  # bounds hold at the knots; so that they hold in between too
    still = State(np.r_[np.zeros(3), 1.0, np.zeros(3), d.q0], np.zeros(6 + n), np.zeros(n), np.asarray(low))
    return Data(
        d.chain,
        still,
        np.r_[np.ones(12 + 3 * n), 1.0 * (low == high)],
        np.r_[-free, d.position[:, 0] + near, -free, -part * d.rate, -part * d.torque, low],
        np.r_[free, d.position[:, 1] - near, free, part * d.rate, part * d.torque, high],
        np.r_[np.ones(12 + n), d.rate, d.torque, 1.0],
        time,
        torque / n * d.torque**-2.0,
        np.full(n, smoothness / n),
        _independent(d.chain, still.q),
        d.frame,
        d.goal,
    )


def problem(task: Task, fine: float = 1.0, numbers: Data | None = None) -> Problem:
    """The problem of a task, its knots multiplied by `fine`; its numbers are made unless given.

    As every problem, its variables can be given to any solver: the torques, from which the states follow. The Riccati
    solver takes `form.values` apart, where states are variables too.

    Raises:
        TaskError: If the task is no reach.
    """
    if task.kind != "reach":
        raise TaskError(f"the solver 'riccati' does not know the kind {task.kind!r}; 'sqp' and 'casadi' solve it.")
    phase, oriented = task.phases["reach"], task.goal.quaternion is not None
    intervals, (low, high) = max(4, round(phase.intervals * fine)), phase.duration
    numbers = data(task, intervals) if numbers is None else numbers
    n, frame, points = len(numbers.effort), task.robot.frame, intervals + 1
    free = (Block("duration", (1,), 10.0),) if low < high else ()
    closed = bool(task.chaser.loops)
    values = Shooting(intervals, oriented, differenced=closed)
    form = Form((*free, Block("acts", (intervals, n))), values, TOGETHER, quick=closed)
    equal = (Rows(f"place of {frame!r} at the end", 1.0, "m", (3,)),)
    if oriented:
        equal += (Rows(f"orientation of {frame!r} at the end", 1.0, "rad", (3,)),)
    rates = Rows("joint rates at the end", 1.0, "rad/s", (len(numbers.independent) if closed else n,))
    equal += (rates, Rows("torques at the end", 1.0, "N m", (n,)))
    below = limit_rows(task, points, points, points, n - len(task.joints))
    return Problem(form, numbers, {"duration": low}, {"duration": high}, equal, below)


def _independent(chain: sdyn.Chain, q) -> np.ndarray | None:
    """Joints that the others follow, as loops have it at the start; None where there are no loops.

    Raises:
        TaskError: If the loops are not closed at the start.
    """
    if not chain.capacity.rows:
        return None
    apart, K = map(np.asarray, _loops(chain, q))
    if (apart := np.abs(apart).max()) > CLOSED:
        raise TaskError(
            f"[robot] joints: the loops of the model are open by {apart:.2g} (rad, m) at the start; name joints that "
            f"close them."
        )
    _, R, order = qr(K[:, 6:], pivoting=True)
    pivots = np.abs(np.diag(R))
    return np.sort(order[(pivots > DEPENDENT * pivots[0]).sum() :])


_loops = jax.jit(lambda chain, q: (sdyn.loop_residual(chain, q), sdyn.loop_jacobian(chain, q)), **ONCE)


def first_guesses(task: Task, problem: Problem, count: int) -> list[tuple[State, np.ndarray]]:
    """States at the knots and controls: the first guesses of the splines there; with closed loops, to stay."""
    values, start = problem.form.values, problem.data.start
    if task.chaser.loops:
        stay = jax.tree.map(lambda y: np.repeat(np.asarray(y)[None], values.intervals + 1, axis=0), start)
        return [(stay, stay.acts[1:])]
    fine, out = values.intervals / task.phases["reach"].intervals, []
    spline = reach.problem(task, fine)
    for z in reach.first_guesses(task, spline, count):
        (at,) = reach.phases(task, spline.data, spline.form.split(z), fine)
        acts = at.tau[:, 6:]
        out.append((State(at.q, at.v, acts, np.full(len(acts), at.times[-1])), acts[1:]))
    return out


def driven(problem: Problem, z) -> tuple[State, jax.Array]:
    """States at the knots and controls from the variables (scaled): the torques of another plan, from this start."""
    return _path(problem.form.values, problem.form.split(z), problem.data)[:2]


_path = jax.jit(Shooting.path, static_argnums=0, **ONCE)


@functools.partial(jax.jit, static_argnums=(0, 1), **ONCE)
def _detailed(values: Shooting, fine: int, x, data: Data):
    """Times, q, v and what acts, on a grid `fine` times finer than the knots."""
    start, u = values.first(x, data)
    acts, h = jnp.concatenate([start.acts[None], u]), start.T / values.intervals
    s = np.arange(fine * values.intervals + 1) / fine
    between = jax.vmap(jnp.interp, (None, None, 1), -1)
    force = lambda t, q, v: values.force(between(t / h, np.arange(len(acts)), acts))
    qs, vs = sdyn.rollout(data.chain, start.q, start.v, force, h / fine, steps=len(s) - 1)
    return s * h, qs, vs, jax.vmap(values.force)(between(s, np.arange(len(acts)), acts))


def phases(task: Task, data: Data, x: dict, fine: int) -> tuple[PhaseResult, ...]:
    """The motion on a grid `fine` times finer than the task's knots: what the torques do."""
    intervals = len(x["acts"])
    values = Shooting(intervals, task.goal.quaternion is not None, differenced=bool(task.chaser.loops))
    found = _detailed(values, round(fine * task.phases["reach"].intervals / intervals), x, data)
    return (PhaseResult("reach", task.chaser, *map(np.asarray, found)),)


def results(task: Task, problem: Problem, x: dict) -> dict:
    """How long it takes, and where the joints end."""
    (at,) = phases(task, problem.data, x, FINE)
    end = dict(zip((j.name for j in task.joints), map(float, at.q[-1, 7:]), strict=True))
    return {"frame": task.robot.frame, "duration_s": float(at.times[-1]), "end": end}


sentence = reach.sentence
