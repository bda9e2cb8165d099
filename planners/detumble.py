"""A chaser and what it has grasped come to rest, by joints, thrusters and reaction wheels, as a problem.

A quintic spline holds the centre of mass, the base's attitude and the joints. Variables: the duration, the rates at
the end, and what further efforts would do in the posture of the start, besides even braking: the curvature of the cost
is then about diagonal. Velocities at the end are zero but for a tolerance, and but for reaction wheels. What acts on
the base and on the joints follows from inverse dynamics, and is kept in a box. The cost is the integral of 1 and of the
squares of what acts, and the squares of the velocities at the end, weighted.

Source: Vyas et al. (2022), Post-capture detumble trajectory stabilization for robotic active debris removal (the cost).
"""

import functools
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sdyn
from planners import floating, flying, pushed
from planners.bspline import Clamped
from planners.floating import Motion
from planners.joints import limit_rows, trapezoid, two_sided, within
from planners.plan import PhaseResult
from planners.problem import ONCE, Block, Form, Problem, Rows, Values
from planners.task import Task

FINE = 12  # intervals of the reported effort for one of the solver's


class Data(NamedTuple):
    """Numbers of one task; all traced."""

    chain: sdyn.Chain  # the compound
    start: flying.Start
    position: jax.Array  # [n, 2] limits
    rate: jax.Array  # [n]
    torque: jax.Array  # [n]
    wrench: jax.Array  # [6] limits of moment and force on the base
    margin: jax.Array  # [] part of the limits of what acts that is kept free
    rest: jax.Array  # [6 + n] tolerance of the velocities at the end
    time: jax.Array  # [] weight, 1/s
    weights: jax.Array  # [6 + n] of the squares of what acts
    end_weights: jax.Array  # [6 + n] of the squares of the velocities at the end


@dataclass(frozen=True)
class Detumble:
    """Cost and constraints, for one grid and the places in v of what must come to rest."""

    spline: Clamped
    intervals: int
    resting: tuple[int, ...]

    def along(self, points, x, data: Data):
        """What a map of the control points [k, count] gives, [k, 6 + n], from the variables by name: the map is joined
        to theirs first, or rounding of the control points would be as large as velocities at the end.
        """
        T, (braking, bent) = x["duration"][0], self.spline.between
        ends = jnp.stack([data.start.x, T * data.start.rate, T * x["end"]])
        return points @ braking @ ends + T**2 * (points @ bent) @ (data.start.reply @ x["efforts"]).T

    def curve(self, x, data: Data):
        """The coordinates and their first two derivatives by time at the grid's points, [k + 1, 6 + n] each."""
        s, T = np.linspace(0, 1, self.intervals + 1), x["duration"][0]
        return tuple(self.along(self.spline.basis(s, order), x, data) / T**order for order in range(3))

    def __call__(self, x, data: Data) -> Values:
        """The values for variables by name, physical units."""
        T, P, resting = x["duration"][0], self.along(np.eye(self.spline.count), x, data), np.array(self.resting)
        acting, v = flying.acting(data.chain, *self.curve(x, data))
        root = jnp.sqrt(2 * trapezoid(jnp.broadcast_to(T / self.intervals, (self.intervals,))))
        effort = root[:, None] * jnp.sqrt(data.weights) * acting
        left = jnp.sqrt(2 * data.end_weights) * v[-1]
        below = (
            within(data, P[:, 6:], self.spline.hull(1) @ P[:, 6:] / T, acting[:, 6:]),
            pushed.within(data.wrench, acting[:, :6], data.margin),
            two_sided(P[:, 3:6], -flying.TURN, flying.TURN),
            two_sided((v[-1] / data.rest)[resting], -1.0, 1.0),
        )
        residual = jnp.concatenate([effort.ravel(), left])
        return Values(data.time * T, residual, jnp.zeros(0), jnp.concatenate(below))


def rows(task: Task, values: Detumble) -> tuple[Rows, ...]:
    """Names of the inequalities, in the order of the values."""
    count, points = values.spline.count, values.intervals + 1
    wrench = pushed.limit_rows(task.base_limits, points)
    turn = Rows("turn of the base", 1.0, "rad", (3, count, 2))
    speed, joints = task.end.speed, len(values.resting) - 6
    base = Rows("velocity of the base at the end", speed * 3**-0.5, "rad/s, m/s", (6, 2))
    rates = Rows("joint rates at the end", speed, "rad/s", (joints, 2))
    return *limit_rows(task, count, count - 1, points), *wrench, turn, base, rates


_start = jax.jit(flying.start, **ONCE)


def data(task: Task) -> Data:
    """The numbers of a task."""
    w, chain = task.weights, sdyn.pack(task.compound)
    numbers = (
        np.clip(task.position_limits, -1e3, 1e3),
        task.rate_limits,
        task.torque_limits,
        task.base_limits,
        task.limits.margin,
        # so that the base's speeds are within it, and all that touch it, by more than rounding
        (1 - 1e-6) * task.end.speed * np.r_[np.full(6, 3**-0.5), np.ones(len(task.joints))],
        w.time,
        np.repeat([w.base_torque, w.base_force, w.joint_torque], [3, 3, len(task.joints)]),
        np.r_[[w.end_base] * 6, [w.end_joints * (joint.name not in task.base.wheels) for joint in task.joints]],
    )
    return Data(chain, _start(chain, task.first, task.captured), *map(jnp.asarray, numbers))


def _shape(task, fine) -> Detumble:
    phase, wheels = task.phases["stabilise"], task.base.wheels
    resting = (k for k, name in enumerate(task.chaser.v_names) if name not in wheels)
    return Detumble(Clamped(phase.control_points), max(4, round(phase.intervals * fine)), tuple(resting))


def _scales(task, numbers) -> tuple[tuple, tuple]:
    """Rates at the end, and efforts that cost about 1, reach a limit, or turn base and joints by about 1 rad: the next
    powers of ten, so that slightly other numbers compile nothing.
    """
    duration, limits = np.sqrt(np.prod(task.phases["stabilise"].duration)), np.r_[task.base_limits, task.torque_limits]
    wheels = [6 + k for k, joint in enumerate(task.joints) if joint.name in task.base.wheels]
    reply = np.asarray(numbers.start.reply)
    turned = duration**2 * np.linalg.norm(np.delete(reply, [0, 1, 2, *wheels], axis=0), axis=0)
    efforts = (2 * duration * np.asarray(numbers.weights) + limits**-2.0 + turned**2) ** -0.5
    rates = np.full(len(limits), task.end.speed)
    rates[wheels] = (duration * efforts * np.diag(reply))[wheels]
    return tuple(tuple((10.0 ** np.round(np.log10(x))).tolist()) for x in (rates, efforts))


def problem(task: Task, fine: float = 1.0) -> Problem:
    """The problem of a task, its grid multiplied by `fine`."""
    values, numbers = _shape(task, fine), data(task)
    low, high = task.phases["stabilise"].duration
    rates, efforts = _scales(task, numbers)
    blocks = (
        Block("duration", (1,), 10.0, "s"),
        Block("end", (len(rates),), rates),
        Block("efforts", (len(rates), values.spline.count - 3), efforts),
    )
    return Problem(
        Form(blocks, values, quick=True), numbers, {"duration": low}, {"duration": high}, (), rows(task, values)
    )


@functools.partial(jax.jit, static_argnums=0, **ONCE)
def _braking(values: Detumble, x, data: Data):
    """The base's rotation vectors [k + 1, 3] at the grid's points, and attitudes if angular momentum falls evenly."""
    s, T = np.linspace(0, 1, 2 * values.intervals + 1), x["duration"][0]
    path, rate = (values.along(values.spline.basis(s, order), x, data) / T**order for order in range(2))
    return path[::2, 3:6], flying.calmed(data.chain, data.start, path[:, 6:], rate[:, 6:], T)


def _braked(problem: Problem, T: float) -> np.ndarray:
    """Efforts [6 + n, count - 3] of even braking, in which the base follows from its angular momentum: its own even
    braking would move it against the joints' reactions.
    """
    form, values, data = problem.form, problem.form.values, problem.data
    x = form.split(form.join({"duration": T, "end": 0.0, "efforts": 0.0}))
    even, R = map(np.asarray, _braking(values, x, data))
    quat = floating.path_quaternions(R)
    half = np.linalg.norm(quat[:, 1:], axis=1, keepdims=True)
    theta = 2 * np.arctan2(half, quat[:, :1]) * quat[:, 1:] / np.maximum(half, np.finfo(float).tiny)
    basis, (_, bent) = values.spline.basis(np.linspace(0, 1, len(R))), values.spline.between
    moved = np.zeros((len(data.rest), bent.shape[1]))
    moved[3:6] = np.linalg.lstsq(T**2 * basis @ bent, theta - even)[0].T
    return np.linalg.solve(data.start.reply, moved)


def first_guesses(task: Task, problem: Problem, count: int) -> np.ndarray:
    """Even braking [count, n], scaled; several differ in duration and from even."""
    form, (low, high) = problem.form, task.phases["stabilise"].duration
    rng, (_, _, bent) = np.random.default_rng(0), form.blocks

    def guess(T, away=0.0):
        return form.join({"duration": T, "end": 0.0, "efforts": _braked(problem, T) + away * bent.unit})

    guesses = [guess(np.sqrt(low * high))]
    for _ in range(count - 1):
        T = np.sqrt(low * high) * (high / low) ** rng.uniform(-0.4, 0.4)
        guesses.append(guess(T, rng.normal(size=bent.shape)))
    return np.stack(guesses)


@functools.partial(jax.jit, static_argnums=0, **ONCE)
def _detailed(values: Detumble, x, data: Data) -> Motion:
    curve = values.curve(x, data)
    at = jax.vmap(flying.state, (None, 0, 0, 0))(data.chain, *curve)
    times = np.linspace(0.0, 1.0, len(at.p)) * x["duration"][0]
    return Motion(times, at.R, at.p, curve[0][:, 6:], at.v, at.vdot, at.tau)


def phases(task: Task, data: Data, x: dict, fine: int) -> tuple[PhaseResult, ...]:
    """The motion on a grid `fine` times finer than the task's, from the variables by name."""
    at = jax.tree.map(np.asarray, _detailed(_shape(task, fine), x, data))
    q = np.hstack([at.p, floating.path_quaternions(at.R), at.q])
    return (PhaseResult("stabilise", task.compound, at.times, q, at.v, at.tau),)


def results(task: Task, problem: Problem, x: dict) -> dict:
    """Time and effort, and the parts of the cost."""
    grid, data = problem.form.values, problem.data
    at = jax.tree.map(np.asarray, _detailed(replace(grid, intervals=FINE * grid.intervals), x, data))
    integral = lambda y: np.trapezoid(y, at.times, axis=0)
    effort, left = data.weights * integral(at.tau**2), np.sum(data.end_weights * at.v[-1] ** 2)
    parts = [data.time * at.times[-1], effort[:3].sum(), effort[3:6].sum(), effort[6:].sum(), left]
    names = ("time", "base torque", "base force", "joint torque", "speed at the end")
    return {
        "duration_s": float(at.times[-1]),
        "cost_parts": dict(zip(names, map(float, parts), strict=True)),
        "base_impulse_N_m_s": integral(np.abs(at.tau[:, :3])).tolist(),
        "base_impulse_N_s": integral(np.abs(at.tau[:, 3:6])).tolist(),
        "largest_base_wrench": np.abs(at.tau[:, :6]).max(axis=0).tolist(),
        "largest_joint_torque_N_m": np.abs(at.tau[:, 6:]).max(axis=0).tolist(),
        "velocity_at_the_end": at.v[-1].tolist(),
    }


def sentence(x: dict, info: dict) -> str:
    """The verdict on a solved plan."""
    parts = info["cost_parts"]
    said = ", ".join(f"{name} {part:.3g}" for name, part in parts.items())
    return f"All is at rest after {info['duration_s']:.2f} s; the cost of {sum(parts.values()):.4g} is {said}."
