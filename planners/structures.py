"""Which structure does a reach best: which frame to use, which joints to lock, whether to dock another frame first, and
which of several goals to reach.

All candidates are packed to one capacity, so that one compilation serves them: their problems differ in numbers only.
A docked candidate is rooted at the docked link, which is held; the joints between it and the frame move or are locked.
Each starts from the straight motion to the cheapest posture that inverse kinematics finds, the most promising first. A
candidate is dropped

1. if no posture was found at the goal (a heuristic: another start may find one);
2. if what it costs at least to go to its cheapest posture, or to one with more joints locked, is above the best cost so
   far: rest to rest within the rates, without torque or dynamics (a bound, as far as there is no cheaper posture);
3. while it is optimised, if the least merit of its quadratic model is above the best cost so far by more than MARGIN (a
   heuristic: the model errs), or if so is the dual bound with the multipliers of the last step by anything,

       cost + y e + u i - r H^-1 r / 2,   r the gradient of the Lagrangian, H its curvature

   (a bound, as far as the problem is convex there).

A locked joint asks for no torque, so locking may gain. Means over joints are over as many as the largest candidate has,
a locked one counting zero, so that costs compare.

Source: Land and Doig (1960), branch and bound; Nocedal and Wright, Numerical Optimization, section 12.9 (duality).
"""

import itertools
import json
import time
import tomllib
from dataclasses import asdict, dataclass, replace

import jax
import numpy as np

import sdyn
from planners import reach, sqp
from planners.problem import Problem
from planners.sections import Goal
from planners.task import Task, TaskError, docked, written

ITERATIONS = 150
REACHED = 1e-6  # m, rad: error of inverse kinematics below which a posture is at the goal
MARGIN = 0.05  # relative; of the model's least merit, which was up to 0.043 above the cost in the end
ABOVE = 1e-6  # relative: how far a bound must be above the best cost


@dataclass(frozen=True)
class Structure:
    """A frame that is to reach the goal, and the joints that move for it; all others are locked."""

    frame: str
    joints: tuple[str, ...]
    goal: Goal | None = None
    """Another than the task's: one of several places where a target can be grasped."""
    dock: str | None = None
    """A frame that is fastened where the task starts, as to a station: reroot to its link, and ground it."""


@dataclass(frozen=True)
class Candidate:
    """What became of one structure. Costs are None where it was not optimised to the end."""

    structure: Structure
    locked: tuple[str, ...]
    """Those of the joints between base, or dock, and frame that are."""
    status: str
    """best, solved, infeasible or not converged; dropped; unreachable."""
    why: str
    """Of what is dropped, unreachable or infeasible."""
    bound: float
    """What it costs at least to go to its cheapest posture; infinite where there is none."""
    cost: float | None = None
    time: float | None = None
    """Its part of the cost; so are torque and smoothness."""
    torque: float | None = None
    smoothness: float | None = None
    duration: float | None = None
    """s."""
    iterations: int = 0
    seconds: float = 0.0
    """Of the processor, of the optimisation."""
    dock_moment: float | None = None
    """The largest one that holds a docked frame, about it [N m]; so is the force [N]."""
    dock_force: float | None = None


@dataclass(frozen=True)
class StructureChoice:
    """Every candidate, the best first; str() prints a table."""

    task: Task
    """That of the best candidate, to be planned; the given one where nothing was found."""
    candidates: tuple[Candidate, ...]

    @property
    def best(self) -> Candidate | None:
        """The solved candidate of least cost, if there is one."""
        return next((c for c in self.candidates if c.status == "best"), None)

    def __str__(self) -> str:
        heads = ("frame", "locked", "status"), ("cost", "more", "time", "torque", "smooth", "T, s")
        if any(c.structure.dock for c in self.candidates):
            heads = heads[0], (*heads[1], "dock, N m", "N")
        names = [(_where(c.structure), ", ".join(c.locked) or "none", c.status) for c in self.candidates]
        numbers = [() if c.cost is None else self._numbers(c) for c in self.candidates]
        aligned = zip(_columns([heads[0], *names]), _columns([heads[1], *numbers], str.rjust), strict=True)
        why = ["", *(c.why for c in self.candidates)]
        return "\n".join("  ".join(filter(None, (*pair, x))) for pair, x in zip(aligned, why, strict=True))

    def _numbers(self, c):
        terms = (f"{x:.4f}" for x in (c.time, c.torque, c.smoothness))
        held = () if c.dock_moment is None else (f"{c.dock_moment:.2f}", f"{c.dock_force:.2f}")
        return f"{c.cost:.5f}", f"{100 * (c.cost / self.best.cost - 1):+.2f} %", *terms, f"{c.duration:.2f}", *held

    def to_json(self) -> str:
        """The candidates as JSON text."""
        finite = lambda x: None if isinstance(x, float) and not np.isfinite(x) else x
        rows = [{k: finite(x) for k, x in asdict(c).items()} for c in self.candidates]
        return json.dumps({"candidates": rows}, indent=1)


def _where(structure: Structure) -> str:
    """The frame, the place that it goes to, if it is not the task's, and what is docked."""
    at = "" if structure.goal is None else f" to {', '.join(f'{x:g}' for x in structure.goal.position)}"
    return structure.frame + at + (f", {structure.dock} docked" if structure.dock else "")


def _columns(rows, align=str.ljust) -> list[str]:
    """Rows of words as lines of aligned columns; an empty row is an empty line."""
    widths = [max(map(len, column)) for column in itertools.zip_longest(*rows, fillvalue="")]
    return ["  ".join(align(x, w) for x, w in zip(row, widths, strict=False)) for row in rows]


def lockings(task: Task, lock: int = 1, docks: tuple[str, ...] = ()) -> tuple[Structure, ...]:
    """Every frame of a task's robot, with up to `lock` of the joints between it and the base locked in every way.

    Args:
        task: A reach; its moving joints are the ones to choose from.
        lock: Joints, at most; one always moves.
        docks: Frames, each to be docked in turn besides: with all joints between it and the base locked, and with none.
    """
    out = []
    for frame, dock in itertools.product(task.chaser.frames, (None, *docks)):
        own, whole = _between(task.chaser, frame.name), _between(task.chaser, frame.name, dock)
        arm = tuple(name for name in whole if name not in own)
        path = tuple(name for name in own if name in whole)
        for count in range(min(lock, len(path) - 1) + 1):
            for still in itertools.combinations(path, count):
                moving = tuple(name for name in path if name not in still)
                out += [Structure(frame.name, moving + more, dock=dock) for more in dict.fromkeys(((), arm))]
    return tuple(out)


def _between(robot, frame: str, dock: str | None = None) -> tuple[str, ...]:
    """The moving joints between the base, or a docked frame, and a frame."""
    robot = robot.reroot(robot.frame(dock).link) if dock else robot
    tree, link, out = robot.tree, [link.name for link in robot.links].index(robot.frame(frame).link), []
    while tree.parent[link] >= 0:
        out.append(robot.joints[tree.joint[link]])
        link = tree.parent[link]
    moving = {j.name for j in robot.moving}
    return tuple(j.name for j in reversed(out) if j.name in moving)


def choose_structure(task: Task, candidates=None, *, drop: bool = True) -> StructureChoice:
    """Finds the structure that does a reach at least cost. The same call gives the same choice.

    A coarse grid is enough to choose; plan the best one (`choice.task`) on a finer, as by `accuracy="accurate"`.

    Args:
        task: A reach, whose robot has all the joints to choose from; those that a candidate leaves out are locked
            where the task starts.
        candidates: Structures; by default `lockings(task)`.
        drop: Whether to drop candidates early; else every one is optimised to the end, from the same first guess.

    Raises:
        TaskError: If the task is no reach, a candidate names what the task has not, or float64 is off.
    """
    from threadpoolctl import threadpool_limits  # importing it sets an environment variable

    candidates = lockings(task) if candidates is None else tuple(candidates)
    _check(task, candidates)
    tasks = [variant(task, structure) for structure in candidates]
    capacity = sdyn.capacity([x.chaser for x in tasks])
    problems = [reach.problem(x, 1.0, reach.data(x, sdyn.pack(x.chaser, capacity))) for x in tasks]
    found = [reach.postures(x, problem.data) for x, problem in zip(tasks, problems, strict=True)]
    bounds = _bounds(candidates, found)
    rows, best, cut = [], None, np.inf
    # matrices of a few hundred rows: two threads of BLAS take twice the time of one
    with threadpool_limits(1, "blas"):
        for k in np.argsort(bounds, kind="stable"):
            path = _between(task.chaser, candidates[k].frame, candidates[k].dock)
            locked = tuple(name for name in path if name not in candidates[k].joints)
            row = Candidate(candidates[k], locked, "dropped", "", float(bounds[k]))
            rows.append(_decided(row, tasks[k], problems[k], found[k], cut, drop))
            if rows[-1].status == "solved" and rows[-1].cost < cut:
                best, cut = k, rows[-1].cost
    if best is not None:
        rows = [replace(row, status="best") if row.structure is candidates[best] else row for row in rows]
    order = {"best": 0, "solved": 1, "dropped": 2}
    rows.sort(key=lambda row: (order.get(row.status, 3), row.bound if row.cost is None else row.cost))
    return StructureChoice(task if best is None else tasks[best], tuple(rows))


def _check(task, candidates):
    if task.kind != "reach":
        raise TaskError(f"the task {task.name!r} is of kind {task.kind!r}; structures are chosen for a reach.")
    if not jax.config.jax_enable_x64:
        raise TaskError('planning needs float64; call jax.config.update("jax_enable_x64", True) first.')
    if task.robot.dock:
        raise TaskError(f"the task docks {task.robot.dock!r}; leave dock out of [robot], and give it to candidates.")
    if task.load or task.chaser.loops:
        raise TaskError(
            "the task has a [load], or loops; structures are chosen for open chains with free hands: leave them out."
        )
    moving = [j.name for j in task.joints]
    if not candidates or not all(structure.joints for structure in candidates):
        raise TaskError("a candidate is missing or moves nothing; give Structure(frame, joints) with joints that move.")
    goals = [task.goal if structure.goal is None else structure.goal for structure in candidates]
    if len({goal.quaternion is None for goal in goals}) > 1:
        raise TaskError("some goals of the candidates have a quaternion and some have none; give it to all or to none.")
    for structure, goal in zip(candidates, goals, strict=True):
        task.chaser.frame(structure.frame)
        task.chaser.configuration(quaternion=goal.quaternion or (1.0, 0, 0, 0))  # refuses one that has not unit length
        for name in structure.joints:
            if name not in moving:
                raise TaskError(f"joint {name!r} of a candidate rests in this task; {', '.join(moving)} move.")


def variant(task: Task, structure: Structure) -> Task:
    """The task with the structure's frame, goal and dock, and its joints alone."""
    start = dict(zip([j.name for j in task.joints], task.start, strict=True))
    chaser = task.chaser.lock({name: q for name, q in start.items() if name not in structure.joints})
    tree = tomllib.loads(task.source)
    words = {"frame": structure.frame, "moving": structure.joints, "dock": structure.dock}
    tree["robot"] |= {key: x for key, x in words.items() if x is not None}
    section, goal = replace(task.robot, **words), structure.goal or task.goal
    tree["goal"] = {key: x for key, x in asdict(goal).items() if x is not None}
    return docked(replace(task, chaser=chaser, robot=section, goal=goal, source=written(tree)))


def _bounds(candidates, found) -> np.ndarray:
    """What each candidate costs at least; a posture with more joints locked is one of its postures too."""
    own = [x.cost[x.best] if x.error[x.best] <= REACHED else np.inf for x in found]
    return np.array([
        min(x for other, x in zip(candidates, own, strict=True)
            if (other.frame, other.goal, other.dock) == (one.frame, one.goal, one.dock)
            and set(other.joints) <= set(one.joints))
        for one in candidates
    ])  # fmt: skip


def _decided(row: Candidate, task, problem: Problem, found: reach.Postures, cut: float, drop: bool) -> Candidate:
    """What becomes of a candidate, given the best cost so far."""
    above = cut * (1 + ABOVE)
    if drop and not np.isfinite(row.bound):
        why = f"no posture found at the goal; {found.error[found.best]:.2g} m or rad are left"
        return replace(row, status="unreachable", why=why)
    if drop and row.bound > above:
        return replace(row, why=f"going to its posture costs {row.bound:.4f} at least")
    began = time.process_time()
    z, (_, low, high) = reach.guess(problem, found.q[found.best], found.duration[found.best]), problem.numbers
    why = ""
    for states in sqp.solve(problem, z[None], iterations=ITERATIONS):
        s = sqp.pick(states, 0)
        if drop and np.isfinite(cut) and (why := _hopeless(s, low, high, above)):
            break
    row = replace(row, iterations=int(s.iteration), seconds=time.process_time() - began)
    return replace(row, why=why) if why else replace(row, **_ended(task, problem, sqp.outcome(s)))


def _hopeless(s: sqp.State, low, high, above: float) -> str:
    """Why a candidate that is being optimised cannot become the best, or nothing."""
    model, dual = sqp.forecast(s, low, high), dual_bound(s, low, high)
    after = f"after {int(s.iteration)} iterations"
    if model > above * (1 + MARGIN):
        return f"its model's least is {model:.4f} {after}"
    return f"its dual bound is {dual:.4f} {after}" if dual > above else ""


def dual_bound(s: sqp.State, low, high) -> float:
    """The least value of the model of the Lagrangian about a state, along the variables that no bound holds."""
    near = s.near
    r = near.gradient + s.y @ near.A + s.u @ near.C
    free = ~(((s.z <= low + 1e-7) & (r > 0)) | ((s.z >= high - 1e-7) & (r < 0)))
    H = (near.curvature + s.left_out)[np.ix_(free, free)]
    values, vectors = np.linalg.eigh((H + H.T) / 2)
    values = np.maximum(np.abs(values), 1e-8 * max(np.abs(values).max(), 1.0))
    return float(near.cost + s.y @ near.equal + s.u @ near.below - ((vectors.T @ r[free]) ** 2 / values).sum() / 2)


def _ended(task, problem: Problem, end) -> dict:
    """How an optimisation ended: status, why, and the terms of the cost."""
    if end.status != "solved":
        off = problem.worst(end.equal, end.below, 1)
        return {"status": end.status, "why": "; ".join(f"{name} is off by {x:.2g} {unit}" for name, x, unit in off)}
    x, numbers, form = problem.form.split(end.z), problem.data, problem.form.values
    T, P = float(reach.duration(x, numbers)), np.asarray(reach.control_points(form.spline, x, numbers.q0))
    s = np.linspace(0, 1, form.intervals + 1)
    squares = np.mean((form.spline.basis(s, 2) @ P / T**2) ** 2, axis=1)
    terms = {"time": float(numbers.weights[0] * T)}
    terms["smoothness"] = float(numbers.weights[2] * np.trapezoid(squares, s * T))
    terms["torque"] = end.cost - sum(terms.values())
    if task.robot.dock:
        terms["dock_moment"], terms["dock_force"] = reach.dock_load(task, numbers, x)
    return {"status": "solved", "cost": end.cost, "duration": T, **terms}
