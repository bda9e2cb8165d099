"""A free-floating or docked robot brings a frame from rest to a pose at rest, as a problem.

Variables: the duration, unless the task fixes it; the joints' end, and the inner control points of a quintic spline of
every joint, which starts and ends at rest by construction. Total momentum is zero: the base follows the joints. Of a
docked robot the base is the docked link, which rests: what holds it takes the momentum. A number says which, so that
both share one compilation. Limits of position, rate and torque; cost of time, torque and smoothness.
"""

import functools
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sdyn
from planners import floating
from planners.bspline import Clamped
from planners.floating import Motion
from planners.ik import inverse_kinematics
from planners.joints import effort, limit_rows, within
from planners.motion import rotations
from planners.plan import PhaseResult
from planners.problem import ONCE, Block, Form, Problem, Rows, Values
from planners.task import Task, TaskError

POSTURES, SPREAD = 8, 0.6  # from which inverse kinematics starts, and how far they are from the start [rad]
GOLDEN, SECTIONS = (5**0.5 - 1) / 2, 60
FINE = 12  # intervals of the reported load of a dock for one of the solver's


class Data(NamedTuple):
    """Numbers of one reach; all traced."""

    chain: sdyn.Chain
    frame: jax.Array  # [] number of the frame in the chain
    goal: tuple  # (rotation [3, 3], position [3]), axes of the base at the start; any rotation where the form says so
    q0: jax.Array  # [n]
    position: jax.Array  # [n, 2] limits
    rate: jax.Array  # [n]
    torque: jax.Array  # [n]
    margin: jax.Array  # [] part of the torque kept free
    duration: jax.Array  # [2] shortest and longest
    weights: jax.Array  # [3] time, torque, smoothness
    floats: jax.Array  # [] 1, or 0 where the base is held


@dataclass(frozen=True)
class Reach:
    """Cost and constraints, for one grid; with or without an orientation to be reached."""

    spline: Clamped
    intervals: int
    oriented: bool

    def __call__(self, x, data: Data) -> Values:
        """The values for variables by name, physical units."""
        T, P = duration(x, data), control_points(self.spline, x, data.q0)
        at = motion(self.spline, self.intervals, x, data)
        return Values(
            data.weights[0] * T,
            effort(data, at.times, at.tau, at.vdot[:, 6:]),
            miss(data, at, self.oriented),
            within(data, P, self.spline.hull(1) @ P / T, at.tau),
        )


def duration(x, data: Data):
    """The duration [s], a variable or fixed."""
    return x["duration"][0] if "duration" in x else data.duration[0]


def control_points(spline: Clamped, x, q0):
    """Control points [count, n]: those at either end that are no variables stand still."""
    count = (spline.count - len(x["reach"])) // 2
    still = lambda q: jnp.broadcast_to(q, (count, len(q0)))
    return jnp.concatenate([still(q0), x["reach"], still(x["end"])])


def motion(spline: Clamped, intervals: int, x, data: Data) -> Motion:
    """The motion on the grid, from the variables by name."""
    T, P = duration(x, data), control_points(spline, x, data.q0)
    s = np.linspace(0, 1, 2 * intervals + 1)
    path = tuple(spline.basis(s, order) @ P / T**order for order in range(3))
    return floating.at_zero_momentum(data.chain, path, np.linspace(0, 1, intervals + 1) * T, data.floats)


def miss(data: Data, at: Motion, oriented: bool):
    """What the frame lacks to the goal at the end: place [3] in axes of the start; turn [3] in the goal's, to third
    order.
    """
    R, p = sdyn.frame_pose(data.chain, floating.at_rest(at.q[-1]), data.frame)
    R, p = at.R[-1] @ R, at.p[-1] + at.R[-1] @ p
    turn = [floating.logarithm(data.goal[0].T @ R)] if oriented else []
    return jnp.concatenate([p - data.goal[1], *turn])


def data(task: Task, chain: sdyn.Chain | None = None) -> Data:
    """The numbers of a task; the chain of its robot is packed anew, or given with a capacity that has room for it.

    Where there is room for more joints, those are bound to nothing: they cost what they move, and rest.
    """
    chain, w, goal = sdyn.pack(task.chaser) if chain is None else chain, task.weights, task.goal
    (R0, p0), n = _start(task), chain.nv - 6
    room = lambda x, fill: np.concatenate([x, np.full((n - len(x), *x.shape[1:]), fill)])
    return Data(
        chain,
        np.asarray(chain.capacity.frame_names.index(task.robot.frame)),
        (R0.T @ rotations(np.array([goal.quaternion or (1.0, 0, 0, 0)]))[0], R0.T @ (np.array(goal.position) - p0)),
        room(task.start, 0.0),
        room(np.clip(task.position_limits, -1e3, 1e3), [-1e3, 1e3]),
        room(task.rate_limits, 1.0),
        room(task.torque_limits, 1.0),
        np.asarray(task.limits.margin),
        np.array(task.phases["reach"].duration),
        np.array([w.time, w.torque, w.smoothness]),
        np.array(float(task.robot.dock is None)),
    )


def _start(task):
    """Attitude [3, 3] and position [3] of the base at the start, world axes."""
    return rotations(task.first[None, 3:7])[0], task.first[:3]


def _shape(task, fine):
    phase = task.phases["reach"]
    return Clamped(phase.control_points), max(4, round(phase.intervals * fine))


def problem(task: Task, fine: float = 1.0, numbers: Data | None = None, *, still: int = 3) -> Problem:
    """The problem of a task, its grid multiplied by `fine`; its numbers are made unless given.

    So many control points are `still` at either end: 3, and accelerations start and end at zero; 2, and they may jump.

    Raises:
        TaskError: If the robot has closed loops.
    """
    if task.chaser.loops:
        raise TaskError("the joints of closed loops are no splines; the solver 'riccati' plans this reach.")
    numbers = data(task) if numbers is None else numbers
    (spline, intervals), n, frame = _shape(task, fine), len(numbers.q0), task.robot.frame
    low, high = task.phases["reach"].duration
    free = (Block("duration", (1,), 10.0, "s"),) if low < high else ()
    form = Form(
        (*free, Block("reach", (spline.count - 2 * still, n)), Block("end", (n,))),
        Reach(spline, intervals, task.goal.quaternion is not None),
    )
    equal = (Rows(f"place of {frame!r} at the end", 1.0, "m", (3,)),)
    if task.goal.quaternion is not None:
        equal += (Rows(f"orientation of {frame!r} at the end", 1.0, "rad", (3,)),)
    below = limit_rows(task, spline.count, spline.count - 1, intervals + 1, n - len(task.joints))
    return Problem(form, numbers, {"duration": low}, {"duration": high}, equal, below)


class Postures(NamedTuple):
    """Joints at the goal, as inverse kinematics finds them, and what it costs at least to go there."""

    q: np.ndarray  # [k, n]
    error: np.ndarray  # [k] what is left of the way to the goal, m and rad
    duration: np.ndarray  # [k] s
    cost: np.ndarray  # [k]

    @property
    def best(self) -> int:
        """The cheapest of those at the goal, or of those that come closest."""
        return int(np.lexsort((self.cost, np.round(self.error, 6)))[0])


def postures(task: Task, numbers: Data, count: int = POSTURES) -> Postures:
    """Postures from the start, first, and from random ones about it."""
    noise = np.random.default_rng(0).normal(size=(count, len(task.joints)))
    noise[0] = 0.0
    starts = numbers.q0 + SPREAD * np.pad(noise, ((0, 0), (0, len(numbers.q0) - len(task.joints))))
    found = _postures(numbers, task.goal.quaternion is not None, np.clip(starts, *numbers.position.T))
    return Postures(*map(np.asarray, found))


@functools.partial(jax.jit, static_argnums=1, **ONCE)
def _postures(numbers: Data, oriented: bool, starts) -> Postures:
    goal = numbers.goal[0] if oriented else None, numbers.goal[1]
    centre = lambda q: sdyn.centre_of_mass(numbers.chain, floating.at_rest(q))

    def one(q):
        start = floating.at_rest(q).at[:3].set(numbers.floats * (centre(numbers.q0) - centre(q)))
        options = dict(limits=numbers.position, floats=numbers.floats)
        found = inverse_kinematics(numbers.chain, numbers.frame, goal, start, **options)
        return Postures(found.q[7:], found.error, *least(numbers, found.q[7:]))

    return jax.vmap(one)(starts)


def least(data: Data, q):
    """Duration and cost that no motion to joints q undercuts: rest to rest within the rates, no torque, no dynamics.

    A joint that goes as far as d in the time T at rates up to v has at least this integral of its squared acceleration:
    12 d^2 / T^3 if T >= 1.5 d / v, else 16 v^2 / (9 (T - d / v)). The sum is convex in T.
    """
    far, (time, _, smoothness) = jnp.abs(q - data.q0), data.weights
    fastest, (low, high) = far / data.rate, data.duration

    def cost(T):
        late = 16 * data.rate**2 / (9 * jnp.maximum(T - fastest, 1e-30))
        squares = jnp.where(T >= 1.5 * fastest, 12 * far**2 / T**3, late)
        return time * T + smoothness * squares.mean()

    def section(_, ends):
        a, b = ends
        c, d = b - GOLDEN * (b - a), a + GOLDEN * (b - a)
        left = cost(c) < cost(d)
        return jnp.where(left, a, c), jnp.where(left, d, b)

    a, b = jax.lax.fori_loop(0, SECTIONS, section, (jnp.clip(fastest.max(), low, high), high))
    return (a + b) / 2, cost((a + b) / 2)


def first_guesses(task: Task, problem: Problem, count: int) -> np.ndarray:
    """First guesses [count, n], scaled: straight to the postures that cost least."""
    found = postures(task, problem.data, max(count, POSTURES))
    order = np.lexsort((found.cost, np.round(found.error, 6)))[:count]
    return np.stack([guess(problem, found.q[k], found.duration[k]) for k in order])


def guess(problem: Problem, q, duration) -> np.ndarray:
    """The straight motion to joints q in about that duration, longer where rates ask for it: variables [n], scaled."""
    numbers, (inner,) = problem.data, (b.shape[0] for b in problem.form.blocks if b.name == "reach")
    T = np.clip(max(duration, 2 * (np.abs(q - numbers.q0) / numbers.rate).max()), *numbers.duration)
    s = np.linspace(0, 1, inner + 2)[1:-1, None]
    return problem.form.join({"duration": [T], "reach": (1 - s) * numbers.q0 + s * q, "end": q})


@functools.partial(jax.jit, static_argnums=(0, 1), **ONCE)
def _detailed(spline, intervals, x, data):
    at = motion(spline, intervals, x, data)
    return at, jnp.where(data.floats, 0.0, floating.holding(data.chain, at))


def phases(task: Task, data: Data, x: dict, fine: int) -> tuple[PhaseResult, ...]:
    """The motion on a grid `fine` times finer than the solver's, from the variables by name."""
    at, held = jax.tree.map(np.asarray, _detailed(*_shape(task, fine), x, data))
    R0, p0 = _start(task)
    q = np.hstack([p0 + at.p @ R0.T, floating.path_quaternions(R0 @ at.R), at.q])
    return (PhaseResult("reach", task.chaser, at.times, q, at.v, np.hstack([held, at.tau])),)


def dock_load(task: Task, data: Data, x: dict) -> tuple[float, float]:
    """The largest moment about the docked frame [N m], and the largest force [N], that hold it; on a fine grid."""
    _, held = _detailed(*_shape(task, FINE), x, data)
    moment, force = np.split(np.asarray(held), 2, axis=1)
    moment = moment - np.cross(task.chaser.frame(task.robot.dock).position, force)
    return tuple(float(np.linalg.norm(load, axis=1).max()) for load in (moment, force))


def results(task: Task, problem: Problem, x: dict) -> dict:
    """How long it takes, and where the joints end."""
    end = dict(zip((j.name for j in task.joints), map(float, x["end"]), strict=True))
    out = {"frame": task.robot.frame, "duration_s": float(duration(x, problem.data)), "end": end}
    if task.robot.dock is None:
        return out
    moment, force = dock_load(task, problem.data, x)
    return out | {"dock": {"frame": task.robot.dock, "moment_N_m": moment, "force_N": force}}


def sentence(x: dict, info: dict) -> str:
    """The verdict on a solved plan."""
    said = f"The frame {info['frame']!r} is at its goal, at rest, after {info['duration_s']:.2f} s."
    if (dock := info.get("dock")) is None:
        return said
    return f"{said} {dock['frame']!r} is held by up to {dock['force_N']:.3g} N and {dock['moment_N_m']:.3g} N m."
