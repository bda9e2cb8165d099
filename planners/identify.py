"""The manoeuvre that shows the inertial parameters of a free-floating base, as a problem.

Variables: the duration and the inner control points of a quintic spline of every joint, which starts and ends at rest
in the same posture. Total momentum is zero, so with phi = (m, m c, I) of the base, about its origin,

    M_bb v + M_bj qd = 0,   d M_bb / d phi_i = D_i, constant,
    dv/dphi_i = -M_bb^-1 D_i v,   dv'/dphi_i = -M_bb^-1 (D_i v' + M_bb' dv/dphi_i),
    dtheta/dphi_i = int R dw/dphi_i dt.

The Fisher information sums these, through the sensors, over the samples; the cost is minus its log determinant.
Source: Swevers et al. (1997), Optimal robot excitation; the momentum form after Rackl et al. (2013).
"""

import functools
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sdyn
from planners import floating
from planners.bspline import Clamped
from planners.floating import Motion
from planners.joints import effort, limit_rows, trapezoid, within
from planners.plan import PhaseResult
from planners.problem import ONCE, Block, Form, Problem, Rows, Values, summary
from planners.sqp import PENALTIES, merit
from planners.task import Task

PARAMETERS = ("m", "m cx", "m cy", "m cz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
GAP = 1e-6  # relative singular value below which a direction counts as not identifiable


class Data(NamedTuple):
    """Numbers of one manoeuvre; all traced."""

    chain: sdyn.Chain
    slopes: jax.Array  # [10, 6, 6] D_i, times the parameter's nominal magnitude
    q0: jax.Array  # [n]
    position: jax.Array  # [n, 2] limits
    rate: jax.Array  # [n]
    torque: jax.Array  # [n]
    margin: jax.Array  # []
    attitude: jax.Array  # [] rad
    lever: jax.Array  # [3] m
    sensors: jax.Array  # [3] sqrt(samples per second) / noise of gyro, accelerometer, star tracker; zero if absent
    weights: jax.Array  # [4] information, time, torque, smoothness


def control_points(spline: Clamped, x, q0):
    """Control points [count, n]: three at either end stand still."""
    still = jnp.broadcast_to(q0, (3, len(q0)))
    return jnp.concatenate([still, x["excite"], still])


def _sensitivities(data: Data, q, v, vdot):
    """Derivatives of angular velocity and specific force for the ten parameters, [6, 10], and dw [3, 10], from the
    joints and the velocities and accelerations of everything.
    """
    inertia = lambda q: sdyn.mass_matrix(data.chain, floating.at_rest(q))[:6, :6]
    M, slope = jax.jvp(inertia, (q,), (v[6:],))
    v, vdot = v[:6], vdot[:6]
    dv = -jnp.linalg.solve(M, jnp.einsum("pij,j->ip", data.slopes, v))
    dvdot = -jnp.linalg.solve(M, jnp.einsum("pij,j->ip", data.slopes, vdot) + slope @ dv)

    def felt(v, vdot):
        w, r = v[:3], data.lever
        return vdot[3:] + floating.cross(w, v[3:] + floating.cross(w, r)) + floating.cross(vdot[:3], r)

    df = jax.vmap(lambda a, b: jax.jvp(felt, (v, vdot), (a, b))[1], (1, 1), 1)(dv, dvdot)
    return jnp.concatenate([data.sensors[0] * dv[:3], data.sensors[1] * df]), dv[:3]


def motion(spline: Clamped, intervals: int, x, data: Data) -> Motion:
    """The motion on the grid, from the variables by name."""
    T, P = x["duration"][0], control_points(spline, x, data.q0)
    s = np.linspace(0, 1, 2 * intervals + 1)
    path = tuple(spline.basis(s, order) @ P / T**order for order in range(3))
    return floating.at_zero_momentum(data.chain, path, np.linspace(0, 1, intervals + 1) * T)


def information(data: Data, at: Motion):
    """Fisher information [10, 10] of the parameters, relative to their nominal magnitudes."""
    felt, spin = jax.vmap(_sensitivities, (None, 0, 0, 0))(data, at.q, at.v, at.vdot)
    turning, steps = at.R @ spin, jnp.diff(at.times)
    turned = jnp.cumsum((turning[1:] + turning[:-1]) / 2 * steps[:, None, None], axis=0)
    turned = jnp.concatenate([jnp.zeros((1, 3, 10)), turned])
    seen = jnp.concatenate([felt, data.sensors[2] * turned], axis=1)
    return jnp.einsum("k,kij,kil->jl", trapezoid(steps), seen, seen)


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


def nominal(link: sdyn.Link) -> tuple[np.ndarray, np.ndarray]:
    """The ten parameters of a link, about its origin, and the magnitudes that they are measured against."""
    c = link.com
    I = link.inertia + link.mass * (c @ c * np.eye(3) - np.outer(c, c))
    radius = np.sqrt(np.trace(link.inertia) / (2 * link.mass))  # of gyration
    size = np.trace(link.inertia) / 3
    return np.r_[link.mass, link.mass * c, [I[pair] for pair in PAIRS]], np.r_[
        link.mass, [link.mass * radius] * 3, [size] * 6
    ]


def _with_base(chain, index, phi):
    """The chain with other parameters (about the link's origin) of one link."""
    known, c = sdyn.params(chain), phi[1:4] / phi[0]
    I = jnp.array([[phi[4], phi[5], phi[6]], [phi[5], phi[7], phi[8]], [phi[6], phi[8], phi[9]]])
    I = I - phi[0] * (c @ c * jnp.eye(3) - jnp.outer(c, c))
    put = lambda old, new: old.at[index].set(new)
    new = replace(known, mass=put(known.mass, phi[0]), com=put(known.com, c), inertia=put(known.inertia, I))
    return sdyn.with_params(chain, new)


@functools.partial(jax.jit, static_argnums=1, **ONCE)
def _slopes(chain, index, phi, q):
    at = lambda phi: sdyn.mass_matrix(_with_base(chain, index, phi), floating.at_rest(q))[:6, :6]
    return jnp.moveaxis(jax.jacfwd(at)(phi), -1, 0)


def data(task: Task) -> Data:
    """The numbers of a task."""
    robot, s, w = task.chaser, task.sensors, task.weights
    chain, base = sdyn.pack(robot), [link.name for link in robot.links].index(robot.base)
    phi, size = nominal(robot.links[base])
    weight = lambda noise: 0.0 if noise is None else np.sqrt(s.rate) / noise
    return Data(
        chain,
        np.asarray(_slopes(chain, base, phi, task.start)) * size[:, None, None],
        jnp.asarray(task.start),
        np.clip(task.position_limits, -1e3, 1e3),
        jnp.asarray(task.rate_limits),
        jnp.asarray(task.torque_limits),
        jnp.asarray(task.limits.margin),
        jnp.asarray(task.attitude or 3.0),
        jnp.asarray(s.lever),
        jnp.array([weight(s.gyro), weight(s.accelerometer), weight(s.star_tracker)]),
        jnp.array([w.information, w.time, w.torque, w.smoothness]),
    )


def _shape(task, fine):
    phase = task.phases["excite"]
    return Clamped(phase.control_points), max(4, round(phase.intervals * fine))


def problem(task: Task, fine: float = 1.0) -> Problem:
    """The problem of a task, its grid multiplied by `fine`."""
    spline, intervals = _shape(task, fine)
    n, (low, high) = len(task.joints), task.phases["excite"].duration
    blocks = Block("duration", (1,), 10.0), Block("excite", (spline.count - 6, n))
    below = limit_rows(task, spline.count, spline.count - 1, intervals + 1)
    turn = Rows("turn of the base, relative to its limit (1 - cos)", 1.0, "", (intervals + 1,))
    form = Form(blocks, Identify(spline, intervals))
    return Problem(form, data(task), {"duration": low}, {"duration": high}, (), (*below, turn))


def first_guesses(task: Task, problem: Problem, count: int) -> np.ndarray:
    """The best of some smooth random motions [count, n], scaled."""
    rng, form = np.random.default_rng(0), problem.form
    shape = form.blocks[1].shape
    knots = np.linspace(0, 1, shape[0])[:, None]
    low, high = task.phases["excite"].duration
    guesses = []
    for _ in range(max(2 * count, 8)):
        waves = sum(rng.normal(size=shape[1]) * np.sin(np.pi * k * knots) / k for k in range(1, 6))
        swing = 0.12 * waves * task.rate_limits * high
        inside = np.clip(task.start + swing, 0.9 * task.position_limits[:, 0], 0.9 * task.position_limits[:, 1])
        guesses.append(form.join({"duration": [(low + high) / 2], "excite": inside}))
    merits = [merit(summary(form, z, problem.data), PENALTIES[0]) for z in guesses]
    return np.stack(guesses)[np.argsort(merits, kind="stable")[:count]]


@functools.partial(jax.jit, static_argnums=(0, 1), **ONCE)
def _detailed(spline, intervals, x, data):
    return motion(spline, intervals, x, data)


def phases(task: Task, data: Data, x: dict, fine: int) -> tuple[PhaseResult, ...]:
    """The motion on a grid `fine` times finer than the solver's, from the variables by name."""
    at = jax.tree.map(np.asarray, _detailed(*_shape(task, fine), x, data))
    q = np.hstack([at.p, floating.path_quaternions(at.R), at.q])
    tau = np.hstack([np.zeros((len(at.tau), 6)), at.tau])
    return (PhaseResult("excite", task.chaser, at.times, q, at.v, tau),)


def results(task: Task, problem: Problem, x: dict) -> dict:
    """What the manoeuvre tells about the parameters."""
    at = _detailed(*_shape(task, 1.0), x, problem.data)
    F = np.asarray(jax.jit(information)(problem.data, at))
    values, vectors = np.linalg.eigh(F)
    sees = values > GAP**2 * values[-1]
    base = task.chaser.link(task.chaser.base)
    out = {
        "parameters": PARAMETERS,
        "nominal": nominal(base)[0].tolist(),
        "magnitudes": nominal(base)[1].tolist(),
        "log_det": float(np.linalg.slogdet(F)[1]),
        "smallest_eigenvalue": float(values[0]),
        "condition_number": float(np.sqrt(values[-1] / values[0])) if values[0] > 0 else None,
        "singular_values": np.sqrt(np.maximum(values[::-1], 0)).tolist(),
        "identifiable": int(sees.sum()),
    }
    if sees.all():
        C = np.linalg.inv(F)
        out["trace_of_inverse"] = float(np.trace(C))
        out["sigma_percent"] = dict(zip(PARAMETERS, (100 * np.sqrt(np.diag(C))).tolist(), strict=True))
        out["subspace"] = f"all ten parameters are identifiable; singular values span {out['condition_number']:.2g}"
    else:
        lost = [PARAMETERS[np.argmax(np.abs(v))] for v in vectors[:, ~sees].T]
        out["subspace"] = f"{sees.sum()} of ten directions are identifiable; lost are mostly {', '.join(lost)}"
    return out


def sentence(x: dict, info: dict) -> str:
    """The verdict on a solved plan."""
    start = f"In {x['duration'][0]:.2f} s {info['subspace']}"
    if "sigma_percent" not in info:
        return start + "."
    name, worst = max(info["sigma_percent"].items(), key=lambda x: x[1])
    return f"{start}; the largest Cramer-Rao bound is {worst:.2g} % ({name})."
