"""Certificates: what a plan keeps, measured by code that is not the solver.

What is independent: limits, grasp, tracking and momentum are read off the plan's arrays by `sdyn` functions that the
solver does not call (momentum, body poses of each structure, forward dynamics); the splines are evaluated again by
scipy; the motion is integrated again from the planned torques by articulated-body forward dynamics and an RK4 on
quaternions. What is shared: the robot models, `sdyn` itself, and, for the conditions of a minimum only, the statement
of the problem, which `optimality` differentiates by differences and weighs with the plan's multipliers.
"""

import functools
import importlib
import json
from dataclasses import asdict, dataclass

import jax
import jax.numpy as jnp
import numpy as np

import sdyn
from planners import optimality
from planners.optimality import Price
from planners.problem import ONCE

LIMIT, MOMENTUM, STATIONARITY = 1e-6, 1e-10, 1e-6
FLAT = 1e-6  # negative curvature that differences of gradients cannot tell from none, scaled as the stationarity
DRIFT = 1e-9  # of momentum within a phase, relative to its largest term
INTEGRATION = 1e-6  # m, rad, m/s, rad/s: largest difference to the integrated motion


@dataclass(frozen=True)
class Row:
    """One check: passed if value <= bound."""

    name: str
    value: float
    bound: float
    unit: str
    touched: str = ""
    """Limit that the plan touches there, in words."""

    @property
    def ok(self) -> bool:
        """Whether the value is finite and within the bound."""
        return bool(np.isfinite(self.value) and self.value <= self.bound)


@dataclass(frozen=True)
class Certificate:
    """Every check of one plan."""

    rows: tuple[Row, ...]
    active: tuple[str, ...] = ()
    """Limits that the plan touches."""
    prices: tuple[Price, ...] = ()
    """What one unit more of a limit, or of a wanted value, would save of the cost; the most important ones."""

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(row.ok for row in self.rows)

    def worst(self, name: str) -> float:
        """The largest value of the checks whose names start so; infinite if one is not a number."""
        return float(np.nan_to_num([row.value for row in self.rows if row.name.startswith(name)], nan=np.inf).max())

    @property
    def sentence(self) -> str:
        """The certificate in one line of words."""
        say = lambda r: f"{r.name} is {r.value:.3g} {r.unit}".rstrip() + f" and may be {r.bound:.3g}"
        bad = [say(row) for row in self.rows if not row.ok]
        touched = f"; it touches {', '.join(self.active)}" if self.active else ""
        if bad:
            return f"Not certified: {'; '.join(bad)}."
        return f"Certified: {len(self.rows)} checks passed on a grid 24 times finer than the solver's{touched}."

    def __str__(self) -> str:
        width = max(len(row.name) for row in self.rows)
        say = lambda r: f"{'ok ' if r.ok else 'BAD'}  {r.name:{width}}  {r.value:9.2e} <= {r.bound:7.1e} {r.unit}"
        lines = [say(row).rstrip() for row in self.rows]
        lines += [f"{p.name}: saves {p.amount:.3g} of the cost per {p.unit or 'unit'}" for p in self.prices]
        return "\n".join([*lines, self.sentence])

    def to_json(self) -> str:
        """The certificate as JSON text."""
        value = lambda row: row.value if np.isfinite(row.value) else None
        rows = [asdict(row) | {"value": value(row), "ok": row.ok} for row in self.rows]
        said = {"passed": self.passed, "sentence": self.sentence, "rows": rows, "active": list(self.active)}
        said["prices"] = [asdict(price) for price in self.prices]
        return json.dumps(said, indent=1)

    @classmethod
    def from_json(cls, text: str) -> "Certificate":
        """Reads what `to_json` wrote."""
        said = json.loads(text)
        value = lambda row: np.nan if row["value"] is None else row["value"]
        rows = tuple(Row(r["name"], value(r), r["bound"], r["unit"]) for r in said["rows"])
        return cls(rows, tuple(said["active"]), tuple(Price(**p) for p in said.get("prices", ())))


def certify(task, plan) -> Certificate:
    """Measures what a plan keeps.

    Args:
        task: What was asked for.
        plan: What is offered; its arrays are read, never how they were made.
    """
    rows, active = _limits(task, plan)
    module = importlib.import_module(f"planners.certify_{task.kind}")
    best = _optimality(task, plan)
    rows += _integration(plan) + module.rows(task, plan)
    rows += [
        Row("stationarity and complementarity", best.residual, STATIONARITY, ""),
        Row("least curvature within the constraints, negated", -best.curvature, FLAT, ""),
    ]
    touched = (row.touched for row in rows if row.touched)
    return Certificate(tuple(rows), (*active, *touched), best.prices)


def statement(task, solver):
    """The module that states a task for a solver."""
    return importlib.import_module(f"planners.{'shooting' if solver == 'riccati' else task.kind}")


def _optimality(task, plan) -> optimality.Optimality:
    options = plan.info["options"]
    problem = statement(task, options["solver"]).problem(task, options["fine"])
    multipliers = plan.multipliers["equal"], plan.multipliers["below"]
    return optimality.measure(problem, problem.form.join(plan.variables), *multipliers)


def _limits(task, plan):
    """Joint position, rate and torque, and what acts on the base, on the fine grid: the largest excess over a limit,
    and which ones are touched.
    """
    n, rows, active = len(task.joints), [], []
    rest = lambda key: np.concatenate([getattr(phase, key)[:, -n:] for phase in plan.phases])
    low, high = task.position_limits.T
    excess = {
        "position": np.maximum(rest("q") - high, low - rest("q")),
        "rate": np.abs(rest("v")) - task.rate_limits,
        "torque": np.abs(rest("tau")) - task.torque_limits,
    }
    widths = {"position": 1.0, "rate": task.rate_limits, "torque": task.torque_limits}
    for (key, over), unit in zip(excess.items(), ("rad", "rad/s", "N m"), strict=True):
        rows.append(Row(f"excess over {key} limits", float(max(over.max(), 0.0)), LIMIT, unit))
        near = (over > -0.03 * widths[key]).any(axis=0)
        active += [f"the {key} limit of {task.joints[k].name}" for k in np.flatnonzero(near)]
    wrench = np.abs(np.concatenate([phase.tau[:, :6] for phase in plan.phases]))
    if task.robot.dock:  # what holds the base may be any wrench
        return rows, active
    if task.base is None:
        return [*rows, Row("force on the free base", float(wrench.max()), 0.0, "N, N m")], active
    over = wrench - task.base_limits
    for k, (what, unit) in enumerate((("torque", "N m"), ("force", "N"))):
        axes = slice(3 * k, 3 * k + 3)
        rows.append(Row(f"excess over {what} limits of the base", float(max(over[:, axes].max(), 0.0)), LIMIT, unit))
        near = (over[:, axes] > -0.03 * task.base_limits[axes]).any(axis=0)
        active += [f"the {what} limit of the base, {axis}" for axis, held in zip("xyz", near, strict=True) if held]
    return rows, active


# -- motion integrated again -------------------------------------------------------------------------------------------


def _turn(quat, theta):
    """quat times the quaternion of the rotation vector theta."""
    half = jnp.linalg.norm(theta) / 2
    w, x = jnp.cos(half), theta / 2 * jnp.sinc(half / jnp.pi)
    a, b = quat[0], quat[1:]
    return jnp.concatenate([jnp.array([a * w - b @ x]), a * x + w * b + jnp.cross(b, x)])


def _rate(chain, q0, state, tau):
    """Rates of (rotation vector from q0's attitude, position, joints, v) under a torque."""
    theta, p, joints, v = state
    quat = _turn(q0[3:7], theta)
    q = jnp.concatenate([p, quat / jnp.linalg.norm(quat), joints])
    vdot = sdyn.forward_dynamics(chain, q, v, tau)
    w, c, x = v[:3], jnp.cross(theta, v[:3]), theta @ theta
    K = jnp.cross(quat[1:], v[3:6]) * 2  # rotates v[3:6] to the world
    turning = w + c / 2 + (1 / 12 + x / 720 + x * x / 30240) * jnp.cross(theta, c)
    return turning, v[3:6] + quat[0] * K + jnp.cross(quat[1:], K), v[6:], vdot


STEP = 12  # intervals of a plan's grid, which one step of the integration takes
PARTS = np.array([2, 4, 6, 12])  # substeps of the midpoint rule, all from grid point to grid point
LIMITS = [np.prod([a * a / (a * a - b * b) for b in PARTS if b != a]) for a in PARTS]  # weights: to no length, order 8
# one row for each use of the dynamics: grid point, length of the substep, whether it starts, factor of it, weight
ROWS = np.array(
    [
        [STEP // n * k, 1 / n, k == 0, 1 if k == 0 else 2, limit / 2 if k == n else 0]
        for n, limit in zip(PARTS, LIMITS, strict=True)
        for k in range(n + 1)
    ]
)


@functools.partial(jax.jit, **ONCE)
def integrate(chain, q, v, tau, steps):
    """States [k + 1, nq], [k + 1, nv] from torques tau [k, STEP + 1, nv] along k steps [s].

    Source: Gragg (1965), On extrapolation algorithms for ordinary initial value problems.
    """

    def step(state, inputs):
        (q, v), (tau, h) = state, inputs
        start = (jnp.zeros(3), q[:3], q[7:], v)

        def use(carry, row):  # a loop: the dynamics are compiled once, not once a substep
            before, now, end = carry
            at, part, first, factor, weight = row
            before, now = jax.tree.map(lambda a, b: jnp.where(first, a, b), (start, start), (before, now))
            moved = jax.tree.map(lambda k: part * h * k, _rate(chain, q, now, tau[at.astype(int)]))
            end = jax.tree.map(lambda a, b, c, d: a + weight * (b + c + d), end, before, now, moved)
            return (now, jax.tree.map(lambda a, b: a + factor * b, before, moved), end), None

        (_, _, end), _ = jax.lax.scan(use, (start, start, jax.tree.map(jnp.zeros_like, start)), jnp.asarray(ROWS))
        theta, p, joints, v = end
        quat = _turn(q[3:7], theta)
        new = jnp.concatenate([p, quat / jnp.linalg.norm(quat), joints]), v
        return new, new

    _, (qs, vs) = jax.lax.scan(step, (q, v), (tau, steps))
    return jnp.concatenate([q[None], qs]), jnp.concatenate([v[None], vs])


def _integration(plan):
    """Largest differences between the plan and its motion integrated from the planned torques."""
    worst = dict.fromkeys(("place of the base", "attitude of the base", "joint positions", "velocities"), 0.0)
    capacity = sdyn.capacity([phase.robot for phase in plan.phases])
    longest = max(len(phase.times) for phase in plan.phases) // STEP
    for phase in plan.phases:
        (qs, vs), q, v = _again(phase, capacity, longest), phase.q[::STEP], phase.v[::STEP]
        turn = 2 * np.sqrt(np.maximum(0.0, _quat_distance(qs[:, 3:7], q[:, 3:7])))
        parts = (qs[:, :3] - q[:, :3], turn, qs[:, 7:] - q[:, 7:], vs - v)
        worst = {k: max(x, float(np.abs(part).max())) for (k, x), part in zip(worst.items(), parts, strict=True)}
    units = ("m", "rad", "rad", "rad/s, m/s")
    return [Row(f"integrated again: {k}", x, INTEGRATION, u) for (k, x), u in zip(worst.items(), units, strict=True)]


def _quat_distance(a, b):
    """Squared distance of unit quaternions, either sign."""
    return np.minimum(np.sum((a - b) ** 2, axis=1), np.sum((a + b) ** 2, axis=1))


def _again(phase, capacity, longest):
    """One phase integrated; padded with steps of no length to share one program."""
    chain = sdyn.pack(phase.robot, capacity)
    count = len(phase.times) // STEP
    pad = lambda x: np.concatenate([x, np.zeros((longest - count, *x.shape[1:]))])
    tau = np.stack([phase.tau[k : k + STEP * count : STEP] for k in range(STEP + 1)], axis=1)
    q, v = sdyn.pad(chain, phase.q[0], phase.v[0])
    width = np.shape(v)[-1] - tau.shape[-1]
    tau = np.pad(tau, ((0, 0), (0, 0), (0, width)))
    qs, vs = integrate(chain, q, v, pad(tau), pad(np.diff(phase.times[::STEP])))
    return np.asarray(qs)[: count + 1, : phase.q.shape[1]], np.asarray(vs)[: count + 1, : phase.v.shape[1]]


# -- shared by the tasks -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Seen:
    """What the models say about one robot along one phase, world axes."""

    R: np.ndarray  # [k, 3, 3] attitude of its frame
    p: np.ndarray  # [k, 3] m
    twist: np.ndarray  # [k, 6] rad/s, m/s
    momentum: np.ndarray  # [k, 6] about its centre of mass, N m s, N s
    centre: np.ndarray  # [k, 3] m
    parts: np.ndarray  # [k, 6] sum of what each entry of v contributes to the momentum, absolute values

    @property
    def drift(self) -> np.ndarray:
        """Largest changes of the angular and of the linear momentum, [2]."""
        return largest(self.momentum - self.momentum[0])


def largest(momentum) -> np.ndarray:
    """Largest entries of the angular and of the linear part of momenta [..., 6], [2]."""
    return np.abs(momentum).reshape(-1, 2, 3).max(axis=(0, 2))


def see(movers) -> list[Seen]:
    """Observes several (robot, frame, q, v), all by one program: one capacity, paths of one length."""
    capacity = sdyn.capacity([robot for robot, _, _, _ in movers])
    room = max(len(q) for _, _, q, _ in movers)
    longer = lambda x: np.concatenate([x, np.repeat(x[-1:], room - len(x), axis=0)])
    out = []
    for robot, frame, q, v in movers:
        chain = sdyn.pack(robot, capacity)
        at = jnp.asarray(capacity.frame_names.index(frame))
        seen = _see(chain, *sdyn.pad(chain, longer(q), longer(v)), at)
        out.append(Seen(*(np.asarray(x)[: len(q)] for x in seen)))
    return out


@functools.partial(jax.jit, **ONCE)
def _see(chain, q, v, frame):
    def one(q, v):
        pose, twist = sdyn.frame_pose(chain, q, frame), sdyn.frame_velocity(chain, q, v, frame)
        parts = jax.vmap(lambda v: sdyn.momentum(chain, q, v))(jnp.diag(v))
        return *pose, twist, parts.sum(0), sdyn.centre_of_mass(chain, q), jnp.abs(parts).sum(0)

    return jax.vmap(one)(q, v)
