"""The manoeuvre that shows inertial parameters of a free-floating base, of what it holds, or of both, as a problem.

Variables: the duration and the inner control points of a quintic spline of every joint, which starts and ends at rest
in the same posture. Total momentum is zero; `inertial.response` says what the base and the joint torques then do, for
parameters phi of the bodies that are not known. Its derivatives for phi, and dtheta/dphi_i = int R dw/dphi_i dt for
the attitude theta, are seen by the sensors; the Fisher information sums their squares over the samples, and the cost is
minus its log determinant. A constant bias of a sensor is a nuisance: the Schur complement over it is the sum of squares
about the mean. The joints' path counts as known here; `estimate` lets encoders tell it.
Source: Swevers et al. (1997), Optimal robot excitation; Rackl, Lampariello and Albu-Schaeffer (2013).
"""

import functools
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sdyn
from planners import floating, inertial
from planners.bspline import Clamped
from planners.floating import Motion
from planners.inertial import PARAMETERS
from planners.joints import effort, limit_rows, trapezoid, within
from planners.plan import PhaseResult
from planners.problem import ONCE, Block, Form, Problem, Rows, Values, summary
from planners.sqp import PENALTIES, merit
from planners.task import Task

GAP = 1e-6  # relative singular value below which a direction counts as not identifiable
LOST = 0.3  # entry of a direction below which a parameter is not named


class Data(NamedTuple):
    """Numbers of one manoeuvre; all traced."""

    chain: sdyn.Chain
    origins: jax.Array  # [k] frames at the origins of the bodies that are not known
    sizes: jax.Array  # [k, 10] magnitudes of their parameters
    q0: jax.Array  # [n]
    position: jax.Array  # [n, 2] limits
    rate: jax.Array  # [n]
    torque: jax.Array  # [n]
    margin: jax.Array  # []
    attitude: jax.Array  # [] rad, largest turn of the base at the grid's points
    lever: jax.Array  # [3] m
    sensors: jax.Array  # [9 + n] sqrt(samples per second) / noise of the sensors' entries; zero if absent
    biased: jax.Array  # [9 + n] 1 for an entry with an unknown constant bias, else 0
    weights: jax.Array  # [4] information, time, torque, smoothness


def control_points(spline: Clamped, x, q0):
    """Control points [count, n]: three at either end stand still."""
    still = jnp.broadcast_to(q0, (3, len(q0)))
    return jnp.concatenate([still, x["excite"], still])


def joint_path(spline: Clamped, intervals: int, x, q0):
    """Joint positions, rates and accelerations at grid points and midpoints, [2 intervals + 1, n] each."""
    T, P, s = x["duration"][0], control_points(spline, x, q0), np.linspace(0, 1, 2 * intervals + 1)
    return tuple(spline.basis(s, order) @ P / T**order for order in range(3))


def motion(spline: Clamped, intervals: int, x, data: Data) -> Motion:
    """The motion on the grid, from the variables by name."""
    times = np.linspace(0, 1, intervals + 1) * x["duration"][0]
    return floating.at_zero_momentum(data.chain, joint_path(spline, intervals, x, data.q0), times)


@floating.locally
def _slopes(data: Data, x):
    """Derivatives of angular velocity, specific force and joint torques for the parameters [(6 + n) p], one after the
    other; x are joint positions, rates and accelerations.
    """
    path = inertial.path(data.chain, data.origins, *jnp.split(x, 3))

    def seen(change):
        twist, acceleration, tau = inertial.response(path, change.reshape(-1, 10) * data.sizes)
        return jnp.concatenate([twist[:3], inertial.felt(data.lever, twist, acceleration), tau])

    return jax.jacfwd(seen)(jnp.zeros(data.sizes.size)).ravel()


def sensitivities(data: Data, at: Motion):
    """What the sensors see of the parameters, per root second and parameter's magnitude: [k + 1, 9 + n, p] of gyro,
    accelerometer, attitude and torques, about their means where a bias hides those.
    """
    n = len(data.q0)
    seen = _slopes(data, jnp.concatenate([at.q, at.v[:, 6:], at.vdot[:, 6:]], axis=1))
    seen, steps = seen.reshape(-1, 6 + n, data.sizes.size), jnp.diff(at.times)
    turning = at.R @ seen[:, :3]
    turned = jnp.cumsum((turning[1:] + turning[:-1]) / 2 * steps[:, None, None], axis=0)
    turned = jnp.concatenate([jnp.zeros_like(turned[:1]), turned])
    seen = jnp.concatenate([seen[:, :6], turned, seen[:, 6:]], axis=1)
    mean = jnp.einsum("k,kij->ij", trapezoid(steps) / at.times[-1], seen)
    return data.sensors[:, None] * (seen - data.biased[:, None] * mean)


def information(data: Data, at: Motion):
    """Fisher information [p, p] of the parameters, relative to their magnitudes, biases being unknown."""
    seen = sensitivities(data, at)
    return jnp.einsum("k,kij,kil->jl", trapezoid(jnp.diff(at.times)), seen, seen)


@dataclass(frozen=True)
class Identify:
    """Cost and constraints, for one grid."""

    spline: Clamped
    intervals: int

    def __call__(self, x, data: Data) -> Values:
        """The values for variables by name, physical units."""
        at, T = motion(self.spline, self.intervals, x, data), x["duration"][0]
        P, w = control_points(self.spline, x, data.q0), data.weights
        turn = (3 - jnp.einsum("ij,kij->k", at.R[0], at.R)) / (2 * (1 - jnp.cos(data.attitude)))
        below = (
            within(data, P, self.spline.hull(1) @ P / T, at.tau),
            turn - 1,
        )
        return Values(
            w[1] * T - w[0] * jnp.linalg.slogdet(information(data, at))[1],
            effort(data, at.times, at.tau, at.vdot[:, 6:]),
            jnp.zeros(0),
            jnp.concatenate(below),
        )


def data(task: Task) -> Data:
    """The numbers of a task."""
    s, w, n = task.sensors, task.weights, len(task.joints)
    frames = tuple(sdyn.Frame(f"origin of {link}", link) for link in task.unknown.values())
    count = len(task.chaser.frames)
    robot = replace(task.chaser, frames=task.chaser.frames + frames)
    widths = {"gyro": 3, "accelerometer": 3, "star_tracker": 3, "torque": n}
    entries = lambda value: np.concatenate([np.full(width, value(name)) for name, width in widths.items()])
    noise = {name: getattr(s, name) for name in widths}
    return Data(
        sdyn.pack(robot),
        np.arange(count, count + len(frames)),
        np.stack([inertial.nominal(robot.link(link))[1] for link in task.unknown.values()]),
        np.asarray(task.start),
        np.clip(task.position_limits, -1e3, 1e3),
        np.asarray(task.rate_limits),
        np.asarray(task.torque_limits),
        np.asarray(task.limits.margin),
        np.asarray((task.attitude or 3.0) * (1 - task.limits.margin)),
        np.asarray(s.lever),
        entries(lambda name: 0.0 if noise[name] is None else np.sqrt(s.rate) / noise[name]),
        entries(lambda name: float(getattr(s, f"{name}_bias"))),
        np.array([w.information, w.time, w.torque, w.smoothness]),
    )


def _shape(task, fine):
    phase = task.phases["excite"]
    return Clamped(phase.control_points), max(4, round(phase.intervals * fine))


def problem(task: Task, fine: float = 1.0) -> Problem:
    """The problem of a task, its grid multiplied by `fine`."""
    spline, intervals = _shape(task, fine)
    n, (low, high) = len(task.joints), task.phases["excite"].duration
    blocks = Block("duration", (1,), 10.0, "s"), Block("excite", (spline.count - 6, n))
    below = limit_rows(task, spline.count, spline.count - 1, intervals + 1)
    turn = Rows("turn of the base, relative to its limit (1 - cos)", 1.0, "", (intervals + 1,))
    form = Form(blocks, Identify(spline, intervals), quick=True)
    return Problem(form, data(task), {"duration": low}, {"duration": high}, (), (*below, turn))


def waves(rng, shape) -> np.ndarray:
    """A random smooth motion from zero to zero, [points, n]: five sines for each joint, the higher ones less."""
    s = np.linspace(0, 1, shape[0])[:, None]
    return sum(rng.normal(size=shape[1]) * np.sin(np.pi * k * s) / k for k in range(1, 6))


def first_guesses(task: Task, problem: Problem, count: int) -> np.ndarray:
    """The best of some smooth random motions [count, n], scaled."""
    rng, form, numbers = np.random.default_rng(0), problem.form, problem.numbers[0]
    shape = form.blocks[1].shape
    low, high = task.phases["excite"].duration
    guesses = []
    for _ in range(max(2 * count, 8)):
        swing = 0.12 * waves(rng, shape) * task.rate_limits * high
        inside = np.clip(task.start + swing, 0.9 * task.position_limits[:, 0], 0.9 * task.position_limits[:, 1])
        guesses.append(form.join({"duration": [(low + high) / 2], "excite": inside}))
    merits = [merit(summary(form, z, numbers), PENALTIES[0]) for z in guesses]
    return np.stack(guesses)[np.argsort(merits, kind="stable")[:count]]


detailed = functools.partial(jax.jit, static_argnums=(0, 1), **ONCE)(motion)
informed = functools.partial(jax.jit, **ONCE)(information)


def phases(task: Task, data: Data, x: dict, fine: int) -> tuple[PhaseResult, ...]:
    """The motion on a grid `fine` times finer than the solver's, from the variables by name."""
    at = jax.tree.map(np.asarray, detailed(*_shape(task, fine), x, data))
    q = np.hstack([at.p, floating.path_quaternions(at.R), at.q])
    tau = np.hstack([np.zeros((len(at.tau), 6)), at.tau])
    return (PhaseResult("excite", task.chaser, at.times, q, at.v, tau),)


def told(task: Task, problem: Problem, x: dict) -> np.ndarray:
    """Fisher information [p, p] of a manoeuvre on the solver's grid, from the variables by name."""
    return np.asarray(informed(problem.data, detailed(*_shape(task, 1.0), x, problem.data)))


def results(task: Task, problem: Problem, x: dict) -> dict:
    """What the manoeuvre tells about the parameters."""
    F = told(task, problem, x)
    values, vectors = np.linalg.eigh(F)
    sees = values > GAP**2 * values[-1]
    names = [f"{body} {name}" for body in task.unknown for name in PARAMETERS]
    links = [inertial.nominal(task.chaser.link(link)) for link in task.unknown.values()]
    out = {
        "parameters": names,
        "nominal": np.concatenate([phi for phi, _ in links]).tolist(),
        "magnitudes": np.concatenate([size for _, size in links]).tolist(),
        "log_det": float(np.linalg.slogdet(F)[1]),
        "smallest_eigenvalue": float(values[0]),
        "condition_number": float(np.sqrt(values[-1] / values[0])) if values[0] > 0 else None,
        "singular_values": np.sqrt(np.maximum(values[::-1], 0)).tolist(),
        "identifiable": int(sees.sum()),
    }
    if sees.all():
        C = np.linalg.inv(F)
        out["trace_of_inverse"] = float(np.trace(C))
        out["sigma_percent"] = dict(zip(names, (100 * np.sqrt(np.diag(C))).tolist(), strict=True))
        span = f"singular values span {out['condition_number']:.2g}"
        out["subspace"] = f"all {len(names)} parameters are identifiable; {span}"
    else:
        lost = "; ".join(_direction(v, names) for v in vectors[:, ~sees].T)
        out["subspace"] = f"{sees.sum()} of {len(names)} directions are identifiable; lost are {lost}"
    return out


def _direction(v, names) -> str:
    """A direction among the parameters, relative to their magnitudes, in words: its largest entries."""
    v = v * np.sign(v[np.argmax(np.abs(v))])
    order = np.argsort(-np.abs(v), kind="stable")
    return " ".join(f"{v[k]:+.2f} {names[k]}" for k in order if abs(v[k]) > LOST)


def sentence(x: dict, info: dict) -> str:
    """The verdict on a solved plan."""
    start = f"In {x['duration'][0]:.2f} s {info['subspace']}"
    if "sigma_percent" not in info:
        return start + "."
    name, worst = max(info["sigma_percent"].items(), key=lambda x: x[1])
    return f"{start}; the largest Cramer-Rao bound is {worst:.2g} % ({name})."
