"""The grasp of a tumbling target by an arm on a free base, as a problem.

Variables: four durations; the joints' state (position, rate, acceleration) where tracking starts and where the grasp
is; the joints' end; inner control points of a quintic spline for each phase. The splines join with continuous
accelerations and start and end at rest by construction. The base follows from momentum, before and after the grasp;
torques from inverse dynamics. At the grasp the target joins the chain: momenta add, the joints' path goes on. A base
that is pushed changes the momenta by splines of its own (`pushed.py`), and is then no other problem.
"""

import functools
import operator
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sdyn
from planners import floating, mission, pushed
from planners.bspline import Clamped
from planners.floating import Momentum, Motion, Tumble, path_quaternions
from planners.joints import effort, limit_rows, two_sided, within
from planners.plan import PhaseResult
from planners.problem import ONCE, Block, Form, Problem, Rows, Values, summary
from planners.task import Task

MOVING = ("approach", "track", "stabilise")
CANDIDATES = 24  # first guesses of which those that keep clear best are taken
TABLE_STEP = 0.1  # s; Munthe-Kaas RK4 at the tumble rates of satellites errs by less than 1e-12 rad a minute


class Data(NamedTuple):
    """Numbers of one grasp; all traced."""

    chains: sdyn.Chain  # the chaser and the compound, stacked
    waiting: Tumble  # the chaser with its joints at rest
    target: Tumble
    grip: tuple  # (rotation [3, 3], position [3]) of the grasp frame in the target's base
    q0: jax.Array  # [n] joints at the start
    position: jax.Array  # [n, 2] limits
    rate: jax.Array  # [n]
    torque: jax.Array  # [n]
    margin: jax.Array  # [] part of the torque kept free
    speed: jax.Array  # [] tolerance while tracking, rad/s and m/s
    weights: jax.Array  # [3] time, torque, smoothness
    push: pushed.Push | None  # what moves the base
    mission: mission.Mission | None  # what is asked besides


@dataclass(frozen=True)
class Grid:
    """Splines and grids of the three moving phases; `fine` multiplies the intervals."""

    splines: tuple[Clamped, ...]
    intervals: tuple[int, ...]

    @classmethod
    def of(cls, task: Task, fine: float = 1.0) -> "Grid":
        """The grid of a task."""
        phases = [task.phases[name] for name in MOVING]
        return cls(
            tuple(Clamped(p.control_points) for p in phases),
            tuple(max(4, round(p.intervals * fine)) for p in phases),
        )


def control_points(grid: Grid, x, q0):
    """Control points of the three phases, [count, n] each, from the variables by name."""
    T, rest = x["durations"][1:], jnp.zeros_like(q0)
    stops = [jnp.stack([q0, rest, rest]), x["track_state"], x["grasp_state"], jnp.stack([x["end"], rest, rest])]
    out = []
    for k, (name, spline) in enumerate(zip(MOVING, grid.splines, strict=True)):
        first, last = spline.ends
        powers = jnp.stack([T[k] ** 0, T[k], T[k] ** 2])[:, None]
        out.append(jnp.concatenate([first @ (powers * stops[k]), x[name], last @ (powers * stops[k + 1])]))
    return out


def paths(grid: Grid, points, T):
    """Joint position, rate and acceleration at grid points and midpoints of each phase, [2 k + 1, n] each."""
    out = []
    for spline, count, P, length in zip(grid.splines, grid.intervals, points, T, strict=True):
        s = np.linspace(0, 1, 2 * count + 1)
        out.append(tuple(spline.basis(s, order) @ P / length**order for order in range(3)))
    return out


def later(tumble: Tumble, time) -> Momentum:
    """Momentum of a drifting system, with its centre of mass at a time."""
    m = tumble.momentum
    return m._replace(centre=m.centre + m.linear * (time / tumble.coupling.mass))


def motion(grid: Grid, x, data: Data) -> tuple[Motion, Motion, Motion]:
    """The motion of approach, tracking and stabilising from the variables by name, physical units."""
    _, *T = x["durations"]
    approach, track, after = paths(grid, control_points(grid, x, data.q0), T)
    path = tuple(jnp.concatenate([a, b[1:], c]) for a, b, c in zip(approach, track, after, strict=True))
    steps = jnp.concatenate([jnp.broadcast_to(t / n, (n,)) for t, n in zip(T, grid.intervals, strict=True)])
    first, split = grid.intervals[0], sum(grid.intervals[:2])
    # points and midpoints of the whole grid; the grasp is there twice, once in each structure
    after_grasp = np.arange(len(path[0])) > 2 * split
    chains = jax.tree.map(lambda a: a[after_grasp.astype(int)], data.chains)
    c = floating.couplings(chains, path[0])
    times, R, momentum, push = (_floats if data.push is None else _pushed)(grid, x, data, c, path[1], steps)
    # from here on, grid points only
    points = lambda a: jnp.concatenate([part[::2] for part in _cut(grid, a)])
    c, chains, (q, rate, acceleration) = jax.tree.map(points, (c, chains, path))
    p = jax.vmap(floating.base_position, (0, 0, None, 0))(c, R, 0.0, momentum)
    v = jnp.concatenate([jax.vmap(floating.base_twist)(c, R, rate, momentum), rate], axis=1)
    tau, vdot = floating.free_torques(chains, c, q, v, acceleration, push=push)
    whole = Motion(times, R, p, q, v, vdot, tau, push)
    parts = slice(first + 1), slice(first, split + 1), slice(split + 1, None)
    return tuple(jax.tree.map(operator.itemgetter(part), whole) for part in parts)


def _cut(grid, a):
    """What holds until the grasp, and from then on, of points and midpoints of the whole grid."""
    end = 2 * sum(grid.intervals[:2]) + 1
    return a[:end], a[end:]


def _times(grid, x, steps):
    """Times at grid points; the grasp is there twice."""
    split, times = sum(grid.intervals[:2]), x["durations"][0] + jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)])
    return jnp.concatenate([times[: split + 1], times[split:]])


def _floats(grid, x, data, c, rates, steps):
    """Of a base that floats freely, at grid points: times, attitude, momentum (and the centre of mass at the time), and
    what pushes it.
    """
    wait, *T = x["durations"]
    split, grasp = sum(grid.intervals[:2]), wait + T[0] + T[1]
    momenta = (
        later(data.waiting, wait),
        floating.momentum_sum(
            (data.waiting.coupling.mass, data.target.coupling.mass),
            (later(data.waiting, grasp), later(data.target, grasp)),
        ),
    )
    stages = lambda a: tuple(map(jnp.concatenate, zip(*map(floating.thirds, _cut(grid, a)), strict=True)))
    angular = jnp.stack([m.angular for m in momenta])[(np.arange(sum(grid.intervals)) >= split).astype(int)]
    R0, _, _ = floating.tumbled(data.waiting, wait)
    R = floating.attitudes(R0, stages(c.compliance), stages(floating.drift(c, rates)), angular, steps)
    R = jnp.concatenate([R[: split + 1], R[split:]])
    times, late = _times(grid, x, steps), (np.arange(len(R)) > split).astype(int)
    momentum, starts = jax.tree.map(lambda *m: jnp.stack(m)[late], *momenta), jnp.stack([wait, grasp])[late]
    mass = jnp.concatenate([part[::2] for part in _cut(grid, c.mass)])
    drifted = momentum.linear * ((times - starts) / mass)[:, None]
    return times, R, momentum._replace(centre=momentum.centre + drifted), None


def _pushed(grid, x, data, c, rates, steps):
    """The same of a base that is pushed."""
    wait, *T = x["durations"]
    split, grasp = sum(grid.intervals[:2]), wait + T[0] + T[1]
    grids = [np.linspace(0, 1, 2 * count + 1) for count in grid.intervals]
    phases = grid.splines, grids, pushed.control_points(x, data.push), T
    acts = [pushed.acting(*(part[at] for part in phases)) for at in (slice(2), slice(2, None))]
    moved = c, floating.drift(c, rates)
    early, late = (jax.tree.map(lambda a, k=k: _cut(grid, a)[k], moved) for k in range(2))
    R0, _, _ = floating.tumbled(data.waiting, wait)
    R, before = pushed.driven(later(data.waiting, wait), R0, *early, acts[0], steps[:split])
    masses, end = (data.waiting.coupling.mass, data.target.coupling.mass), jax.tree.map(lambda a: a[-1], before)
    start = floating.momentum_sum(masses, (end, later(data.target, grasp)))
    R_after, after = pushed.driven(start, R[-1], *late, acts[1], steps[split:])
    halves = zip((R, R_after), (before, after), (act.wrench[::2] for act in acts), strict=True)
    R, momentum, push = jax.tree.map(lambda *x: jnp.concatenate(x), *halves)
    return _times(grid, x, steps), R, momentum, push


def hand_motion(chains, frame: str, at: Motion):
    """Pose and twist of a frame of the chaser at every grid point, world axes: R, p, angular, linear."""

    @floating.locally
    def local(chain, x):
        q = floating.at_rest(x[:n])
        R, p = sdyn.frame_pose(chain, q, frame)
        return jnp.concatenate([R.ravel(), p, sdyn.frame_velocity(chain, q, x[n:], frame)])

    k, n = at.q.shape
    chain = jax.tree.map(lambda a: jnp.broadcast_to(a[0], (k, *a.shape[1:])), chains)
    y = local(chain, jnp.concatenate([at.q, at.v], axis=1))
    turn = lambda x: jnp.einsum("kij,kj->ki", at.R, x)
    return at.R @ y[:, :9].reshape(k, 3, 3), at.p + turn(y[:, 9:12]), turn(y[:, 12:15]), turn(y[:, 15:])


def grip_motion(data: Data, time):
    """Pose and twist of the grasp frame at a time, world axes: R, p, angular, linear."""
    R, p, v = floating.tumbled(data.target, time)
    turn, lever = data.grip
    return R @ turn, p + R @ lever, R @ v[:3], R @ (v[3:] + floating.cross(v[:3], lever))


def relative(data: Data, frame: str, at: Motion):
    """Pose and twist of the hand relative to the grasp frame at every grid point.

    Returns:
        (position [k, 3] m, rotation vector [k, 3] rad, angular [k, 3] rad/s, linear [k, 3] m/s), world axes; the
        rotation vector in axes of the grasp frame, exact to third order.
    """
    hand, grip = hand_motion(data.chains, frame, at), jax.vmap(grip_motion, (None, 0))(data, at.times)
    turn = jax.vmap(lambda a, b: floating.logarithm(a.T @ b))(grip[0], hand[0])
    return hand[1] - grip[1], turn, hand[2] - grip[2], hand[3] - grip[3]


@dataclass(frozen=True)
class Grasp:
    """Cost and constraints, for one grid, one frame of the hand, and the grid points of the tracking phase where it
    must agree with the target in pose. Twists agree at its ends, and within half of the tolerance at all its points,
    or the approach's last acceleration would ring through the first span.
    """

    grid: Grid
    frame: str
    poses: tuple[int, ...]

    def __call__(self, x, data: Data) -> Values:
        """The values for variables by name, physical units."""
        T, splines = x["durations"], self.grid.splines
        P = control_points(self.grid, x, data.q0)
        motions = motion(self.grid, x, data)
        rates = [s.hull(1) @ p / t for s, p, t in zip(splines, P, T[1:], strict=True)]
        place, turn, spin, slide = relative(data, self.frame, motions[1])
        poses, ends = np.array(self.poses), np.array([0, -1])
        residual, base = [effort(data, at.times, at.tau, at.vdot[:, 6:]) for at in motions], []
        if data.push is not None:
            residual += [pushed.effort(data.push, at.times, at.push) for at in motions]
            base = [pushed.held(x)]
        below = (
            within(data, *map(jnp.concatenate, (P, rates, [at.tau for at in motions]))),
            *base,
            two_sided(jnp.concatenate([spin, slide], axis=1), -data.speed / 2, data.speed / 2),
            *mission.below(data, T[0], motions),
        )
        return Values(
            data.weights[0] * T.sum(),
            jnp.concatenate(residual),
            jnp.concatenate([e.ravel() for e in (place[poses], turn[poses], spin[ends], slide[ends])]),
            jnp.concatenate(below),
        )


def rows(task: Task, grid: Grid, poses, fine: float):
    """Names of the constraint rows: (equalities, inequalities), in the order of `values`."""
    hand, grip = task.robot.frame, task.target.frame
    equal = (
        Rows(f"place of {hand!r} on {grip!r} while tracking", 1.0, "m", (len(poses), 3)),
        Rows(f"orientation of {hand!r} on {grip!r} while tracking", 1.0, "rad", (len(poses), 3)),
        Rows(f"angular velocity of {hand!r} relative to {grip!r}", 1.0, "rad/s", (2, 3)),
        Rows(f"velocity of {hand!r} relative to {grip!r}", 1.0, "m/s", (2, 3)),
    )
    points, torques = sum(s.count for s in grid.splines), sum(grid.intervals) + 3
    steady = Rows("velocity while tracking", 1.0, "rad/s, m/s", (6, grid.intervals[1] + 1, 2))
    limits = limit_rows(task, points, points - 3, torques)
    pushes = sum(block.shape[0] for block in pushed.blocks(task, grid.splines))
    base = () if task.base is None else pushed.limit_rows(pushed.of(task).limits, pushes)
    return equal, (*limits, *base, steady, *mission.rows(task, fine, grid.intervals))


def data(task: Task, fine: float = 1.0) -> Data:
    """The numbers of a task."""
    chaser, body = task.chaser, task.body
    resting = chaser.lock(dict(zip([j.name for j in task.joints], task.start, strict=True)))
    horizon = sum(phase.duration[1] for phase in task.phases.values())
    q = np.stack(
        [
            resting.neutral(),
            body.configuration(position=task.target.position, quaternion=task.target.quaternion),
        ]
    )
    v = np.stack([np.zeros(6), task.target.twist])
    tumbles = jax.tree.map(np.asarray, _tumbles(sdyn.family([resting, body]), q, v, horizon))
    waiting, target = (jax.tree.map(operator.itemgetter(k), tumbles) for k in range(2))
    w = task.weights
    return Data(
        sdyn.family([chaser, task.compound]),
        waiting,
        target,
        _pose(sdyn.pack(body), body.neutral(), f"target_{task.target.frame}"),
        jnp.asarray(task.start),
        np.clip(task.position_limits, -1e3, 1e3),
        jnp.asarray(task.rate_limits),
        jnp.asarray(task.torque_limits),
        jnp.asarray(task.limits.margin),
        jnp.asarray(task.tolerance.speed),
        np.array([w.time, w.torque, w.smoothness]),
        pushed.of(task),
        mission.of(task, fine),
    )


@functools.partial(jax.jit, static_argnums=3, **ONCE)
def _tumbles(chains, q, v, horizon):
    return jax.vmap(lambda chain, q, v: floating.tumble(chain, q, v, horizon, TABLE_STEP))(chains, q, v)


_pose = jax.jit(sdyn.frame_pose, static_argnums=2, **ONCE)


def phases(task: Task, data: Data, x: dict, fine: int) -> tuple[PhaseResult, ...]:
    """The motion on a grid `fine` times finer than the solver's, from the variables by name."""
    grid = Grid.of(task, fine)
    motions = _detailed(grid, x, data)
    waiting = np.linspace(0.0, x["durations"][0], fine + 1)
    times = waiting, *(np.asarray(at.times) for at in motions[:2])
    chaser, target = (_states(tumble, np.concatenate(times)) for tumble in (data.waiting, data.target))
    cut = np.cumsum([len(t) for t in times])[:-1]
    targets = [(task.body, *state) for state in zip(*(np.split(x, cut) for x in target), strict=True)]
    passive = dict(zip(task.phases, targets, strict=False))  # all but the last
    n, acting = len(task.joints), lambda tau, push: np.hstack([np.zeros((len(tau), 6)) if push is None else push, tau])
    still = np.tile(task.start, (len(waiting), 1)), np.zeros((len(waiting), n))
    state = [np.hstack([part[: len(waiting)], more]) for part, more in zip(chaser, still, strict=True)]
    out = [PhaseResult("wait", task.chaser, waiting, *state, acting(0 * still[0], None), passive["wait"])]
    for name, at in zip(MOVING, motions, strict=True):
        at = jax.tree.map(np.asarray, at)
        q = np.hstack([at.p, path_quaternions(at.R), at.q])
        robot = task.chaser if name in passive else task.compound
        out.append(PhaseResult(name, robot, at.times, q, at.v, acting(at.tau, at.push), passive.get(name)))
    return tuple(out)


@functools.partial(jax.jit, static_argnums=0, **ONCE)
def _detailed(grid, x, data):
    return motion(grid, x, data)


@functools.partial(jax.jit, **ONCE)
def _tumbled(body, times):
    return jax.vmap(floating.tumbled, (None, 0))(body, times)


def _states(body, times):
    """q [k, 7] and v [k, 6] of a drifting rigid body."""
    R, p, v = map(np.asarray, _tumbled(body, jnp.asarray(times)))
    return np.hstack([p, path_quaternions(R)]), v


def pose_points(task: Task, grid: Grid) -> np.ndarray:
    """Grid points of the tracking phase where the poses must agree, evenly spread: two conditions fewer than the
    spline has control points.
    """
    return np.unique(np.round(np.linspace(0, grid.intervals[1], grid.splines[1].count - 4)).astype(int))


def problem(task: Task, fine: float = 1.0) -> Problem:
    """The problem of a task, its grid multiplied by `fine`."""
    grid, n = Grid.of(task, fine), len(task.joints)
    poses = pose_points(task, grid)
    low, high = np.array([task.phases[name].duration for name in task.phases]).T
    units = (1.0, 0.1, 0.05)  # rad, rad/s, rad/s^2
    blocks = (
        Block("durations", (4,), 10.0, "s"),
        Block("track_state", (3, n), units),
        Block("grasp_state", (3, n), units),
        Block("end", (n,)),
        *(Block(name, (s.count - 6, n)) for name, s in zip(MOVING, grid.splines, strict=True)),
        *pushed.blocks(task, grid.splines),
    )
    form = Form(blocks, Grasp(grid, task.robot.frame, tuple(map(int, poses))))
    return Problem(form, data(task, fine), {"durations": low}, {"durations": high}, *rows(task, grid, poses, fine))


def first_guesses(task: Task, problem: Problem, count: int) -> np.ndarray:
    """First guesses [count, n], scaled; of a mission that asks for more than limits, those that lack least of it."""
    from planners import seeds

    form = problem.form
    more = count if task.clearance is None else max(count, CANDIDATES)
    still = {block.name: 0.0 for block in pushed.blocks(task, form.values.grid.splines)}
    z = np.stack([form.join(x | still) for x in seeds.guesses(task, problem.data, form.values.grid, more)])
    if more == count:
        return z
    names = [rows.name for rows in problem.below]
    sizes = np.array([rows.size for rows in problem.below])
    kept = np.repeat([name.startswith("clearance of") for name in names], sizes)
    lack = [np.maximum(summary(form, x, problem.numbers[0]).below[kept], 0).sum() for x in z]
    return z[np.argsort(lack, kind="stable")[:count]]


def results(task: Task, problem: Problem, x: dict) -> dict:
    """What the plan's description says about this task."""
    return {"durations_s": dict(zip(task.phases, map(float, x["durations"]), strict=True))}


def sentence(x: dict, info: dict) -> str:
    """The verdict on a solved plan."""
    wait, approach, track, stabilise = x["durations"]
    return (
        f"The target is grasped after {wait + approach + track:.2f} s (wait {wait:.2f}, approach {approach:.2f}, track "
        f"{track:.2f}) and at rest {stabilise:.2f} s later."
    )
