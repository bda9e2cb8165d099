"""What is to be planned, and the strict reader of its description in TOML.

SI units and radians everywhere. Every section of a file is one record of `sections`; a key that is not a field of it is
refused with the closest ones.
"""

import difflib
import hashlib
import json
import tomllib
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path

import numpy as np

import sdyn
from planners import solids
from planners.motion import quaternions
from planners.sections import (
    NAMED,
    OPTIONAL,
    PHASES,
    SECTIONS,
    BaseAttitude,
    Capture,
    Chaser,
    Clearance,
    Effort,
    Goal,
    Gripper,
    Held,
    Limits,
    Passive,
    Phase,
    Pushed,
    Rest,
    Sensors,
    Sight,
    Solid,
    TaskError,
    Tolerance,
    Weights,
    is_number,
)

FOLDER = Path(__file__).parent / "tasks"
LARGEST_FILE = 1 << 20  # bytes


@dataclass(frozen=True, kw_only=True)
class Task:
    """A task, checked: everything that a planner needs, and where it came from."""

    name: str
    kind: str
    chaser: sdyn.Robot
    robot: Chaser
    phases: dict[str, Phase]
    limits: Limits
    weights: Weights | Effort
    tolerance: Tolerance | None = None
    target: Passive | Held | None = None
    body: sdyn.Robot | None = None
    """The target's structure; its names carry the prefix "target_"."""
    load: Held | None = None
    load_body: sdyn.Robot | None = None
    """The load's structure; its names carry the prefix "load_"."""
    unknown: dict[str, str] = field(default_factory=dict)
    """What is to be identified, "base" or "load": the name of its link."""
    sensors: Sensors | None = None
    goal: Goal | None = None
    capture: Capture | None = None
    base: Pushed | None = None
    end: Rest | None = None
    shapes: dict[str, Solid] = field(default_factory=dict)
    clearance: Clearance | None = None
    gripper: Gripper | None = None
    base_attitude: BaseAttitude | None = None
    sight: Sight | None = None
    attitude: float | None = None
    """Largest turn of the base from its start [rad]."""
    place: tuple = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
    """Of the base at the start, position [m] and quaternion; of a docked robot, whose base is the docked link."""
    source: str = ""
    """The text that was read."""
    folder: Path = field(default=FOLDER, repr=False)
    """Where robot files are looked for."""

    @property
    def sha256(self) -> str:
        """Hash of the text."""
        return hashlib.sha256(self.source.encode()).hexdigest()

    @property
    def reads_files(self) -> bool:
        """Whether a robot comes from a file next to the task, not from the shipped ones."""
        models = [part.model for part in (self.robot, self.target, self.load) if part]
        return any(Path(model).suffix for model in models)

    @property
    def compound(self) -> sdyn.Robot:
        """The robot after the grasp."""
        return self.chaser.attach(self.body, self.robot.frame, f"target_{self.target.frame}")

    @property
    def joints(self) -> tuple:
        """The joints that move."""
        return self.chaser.moving

    @property
    def position_limits(self) -> np.ndarray:
        """Lower and upper joint limits, [joints, 2]; infinite where the robot has none."""
        return np.array([j.limits or (-np.inf, np.inf) for j in self.joints])

    @property
    def rate_limits(self) -> np.ndarray:
        """Largest joint speeds, [joints]."""
        return self._bounds("rate", self.limits.rate)

    @property
    def torque_limits(self) -> np.ndarray:
        """Largest joint torques, [joints]."""
        return self._bounds("effort", self.limits.torque)

    def _bounds(self, key, override):
        own = [np.inf if getattr(j, key) is None else getattr(j, key) for j in self.joints]
        return np.array(own if override is None else [override] * len(own), float)

    @property
    def base_limits(self) -> np.ndarray:
        """Largest moments and forces on the base, its axes, [6]; zero where there are none."""
        return np.zeros(6) if self.base is None else np.r_[self.base.torque, self.base.force or np.zeros(3)]

    @property
    def captured(self) -> np.ndarray:
        """Velocity after the capture, [nv]."""
        return np.r_[self.capture.twist, [self.capture.rates.get(joint.name, 0.0) for joint in self.joints]]

    @property
    def start(self) -> np.ndarray:
        """Joint positions at the start, [joints]."""
        return self.first[7:]

    @property
    def first(self) -> np.ndarray:
        """Configuration at time zero, [nq]: the model's base at the world's origin."""
        position, quaternion = self.place
        return self.chaser.configuration(_posture(self.chaser, self.robot), position=position, quaternion=quaternion)


def load(path_or_name) -> Task:
    """Reads a task.

    Args:
        path_or_name: Path of a TOML file, or the name of a shipped task.

    Raises:
        TaskError: If there is no such task, or it is not one; the message names the key and the remedy.
    """
    path = Path(path_or_name)
    if path.suffix != ".toml":
        names = sorted(x.stem for x in FOLDER.glob("*.toml"))
        if str(path_or_name) not in names:
            raise TaskError(
                f"there is no shipped task {str(path_or_name)!r}{_close(str(path_or_name), names)}; shipped are "
                f"{', '.join(names)}. The file of a task ends in .toml."
            )
        path = FOLDER / f"{path_or_name}.toml"
    if not path.is_file():
        raise TaskError(f"there is no file {path}; give the path of a TOML file, or the name of a shipped task.")
    if path.stat().st_size > LARGEST_FILE:
        raise TaskError(f"{path} is larger than {LARGEST_FILE} bytes; that is no task.")
    try:
        source = path.read_text(encoding="utf-8")
        return parse(source, path.stem, path.parent)
    except UnicodeDecodeError as error:
        raise TaskError(f"{path} is not UTF-8 text ({error.reason} at byte {error.start}).") from None
    except (TaskError, sdyn.RobotError) as error:
        raise TaskError(f"{path.name}: {error}") from None


def parse(source: str, name: str = "task", folder: Path = FOLDER) -> Task:
    """Reads a task from its text; robot files are looked for in `folder`. Raises as `load`."""
    try:
        tree = tomllib.loads(source)
    except RecursionError:
        raise TaskError("this is no task: its values are nested too deeply.") from None
    except ValueError as error:  # also of a whole number with thousands of digits
        raise TaskError(f"not valid TOML: {str(error).split(';')[0]}.") from None
    kind = tree.pop("kind", None)
    if not isinstance(kind, str) or kind not in SECTIONS:
        raise TaskError(f"the key kind is {kind!r}; it must be one of {', '.join(map(repr, SECTIONS))}.")
    extra, sought = {}, tree.pop("parameters", ["base"]) if kind == "identify" else []
    if kind == "identify":
        extra["attitude"] = _attitude(tree.pop("attitude", None))
    several = NAMED.get(kind, {})
    _refuse_unknown(tree, {*SECTIONS[kind], *several, "phases"}, "the task")
    phases = tree.get("phases", {})
    _refuse_unknown(_table(phases, "[phases]"), PHASES[kind], "[phases]")
    given = {key: record for key, record in SECTIONS[kind].items() if key in tree or key not in OPTIONAL.get(kind, ())}
    sections = {key: _section(tree.get(key, {}), record, f"[{key}]") for key, record in given.items()}
    sections["phases"] = {p: _section(phases.get(p, {}), Phase, f"[phases.{p}]") for p in PHASES[kind]}
    for key, record in several.items():
        given = _table(tree.get(key, {}), f"[{key}]")
        sections[key] = {name: _section(x, record, f"[{key}.{name}]") for name, x in given.items()}
    chaser = _chaser(sections["robot"], folder)
    task = Task(name=name, kind=kind, chaser=chaser, source=source, folder=folder, **sections, **extra)
    return docked(_checked(_closed(_loaded(task, sought)), folder))


def docked(task: Task) -> Task:
    """The task with the link of the robot's dock as base, and its place at the start; as it is without a dock."""
    if task.robot.dock is None:
        return task
    if task.kind != "reach":
        raise TaskError(f"dock in [robot]: robots dock for a reach, not for the kind {task.kind!r}; leave it out.")
    chaser, link = task.chaser, task.chaser.frame(task.robot.dock).link
    if chaser.frame(task.robot.frame).link == link:
        raise TaskError(f"dock in [robot]: {task.robot.dock!r} is on the link that is to reach the goal; dock another.")
    first = chaser.configuration(_posture(chaser, task.robot))
    at = chaser.close(sdyn.Frame("dock", link), "ground", q=first).loops[-1].frame_b  # where the link is in the world
    place = tuple(at.position.tolist()), tuple(quaternions(at.rotation).tolist())
    return replace(task, chaser=chaser.reroot(link), place=place)


def _posture(chaser, section) -> dict:
    """Values of the joints that move, by name, as the section [robot] has them."""
    moving = {joint.name for joint in chaser.moving}
    return {name: x for name, x in section.joints.items() if name in moving}


def written(tree: dict, name: str = "") -> str:
    """The text of a task, from what TOML reads it as; what is nested deeper than its sections is inline."""
    section = lambda key, x: isinstance(x, dict) and (not name or name == "phases")
    plain = [f"{key} = {_value(x)}\n" for key, x in tree.items() if not section(key, x)]
    deeper = [written(x, f"{name}.{key}" if name else key) for key, x in tree.items() if section(key, x)]
    return "".join([f"[{name}]\n" if name else "", *plain, *deeper])


def _value(x) -> str:
    if isinstance(x, dict):
        return "{ " + ", ".join(f"{json.dumps(key)} = {_value(y)}" for key, y in x.items()) + " }"
    return json.dumps(x)


def _attitude(value):
    if value is None:
        return None
    if not is_number(value) or not 0 < value <= 3:
        raise TaskError(f"attitude is {value!r}; it is the largest turn of the base, from 0 to 3 rad.")
    return float(value)


def _table(values, where):
    if not isinstance(values, dict):
        raise TaskError(f"{where} is {values!r}; it must be a section with keys.")
    return values


def _section(values, record, where):
    _table(values, where)
    known = {f.name: f for f in fields(record)}
    _refuse_unknown(values, known, where)
    missing = [k for k, f in known.items() if f.default is MISSING and f.default_factory is MISSING and k not in values]
    if missing:
        raise TaskError(f"{where} lacks the key {missing[0]}; add it.")
    return record(**{k: known[k].metadata["check"](x, f"{k} in {where}") for k, x in values.items()})


def _refuse_unknown(values, known, where):
    for key in values:
        if key not in known:
            raise TaskError(f"{where} has no key {key!r}{_close(key, known)}; it may have {', '.join(sorted(known))}.")


def _close(word, known):
    close = difflib.get_close_matches(word, list(known), 1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def _model(name, folder):
    if Path(name).suffix in (".json", ".urdf"):
        path = Path(folder) / name
        if not path.resolve().is_relative_to(Path(folder).resolve()):
            raise TaskError(f"the robot file {name} is outside of the task's folder; put it into {folder}.")
        if not path.is_file():
            raise TaskError(f"there is no robot file {path}; the path is relative to the task's folder.")
        return sdyn.load(path)
    return sdyn.models.load(name)


def _chaser(section, folder):
    robot = _model(section.model, folder)
    for name in (*section.moving, *section.joints):
        robot.joint(name)
    still = [j for j in robot.moving if section.moving and j.name not in section.moving]
    several = [j.name for j in still if j.dof != 1 and j.name not in section.joints]
    if several:
        raise TaskError(f"joint {several[0]!r} has several degrees of freedom; a task cannot lock it.")
    return robot.lock({j.name: section.joints.get(j.name, 0.0) for j in still})


def _loaded(task, sought):
    """The task with its load in the hand, and that of an identification with the links whose parameters are sought."""
    bodies = {"base": task.chaser.base}
    if task.load:
        body = _model(task.load.model, task.folder)
        if body.grounded or len(body.links) != 1:
            raise TaskError(f"[load] model {task.load.model!r} must be one free link.")
        body = body.prefixed("load_")
        bodies["load"] = body.links[0].name
        chaser = task.chaser.attach(body, task.robot.frame, f"load_{task.load.frame}")
        task = replace(task, chaser=chaser, load_body=body)
    if task.kind != "identify":
        return task
    if not isinstance(sought, list) or not sought or any(x not in ("base", "load") for x in sought):
        raise TaskError(f'parameters is {sought!r}; it must be ["base"], ["load"] or ["base", "load"].')
    if "load" in sought and not task.load:
        raise TaskError('parameters names "load"; add the section [load] with its model.')
    return replace(task, unknown={name: link for name, link in bodies.items() if name in sought})


def _closed(task):
    """The task with the loops of its robot closed as they are at the start."""
    chaser = task.chaser
    for one, other in task.robot.closed:
        chaser = chaser.close(one, other, q=task.first)
    if chaser.loops and task.kind != "reach":
        raise TaskError(f"[robot] closes loops; of the kinds of tasks only 'reach' has them, not {task.kind!r}.")
    if chaser.loops and task.robot.dock:
        raise TaskError("[robot] closes loops and docks; a robot with loops floats: leave out dock, or closed.")
    return replace(task, chaser=chaser)


def _checked(task, folder):
    """The task with its target, after the checks that need the robots."""
    chaser = task.chaser
    if chaser.grounded or not chaser.joints:
        raise TaskError(f"[robot] model {task.robot.model!r} must have a free base and joints.")
    several = [j.name for j in chaser.moving if j.dof != 1]
    if several:
        raise TaskError(
            f"joint {several[0]!r} has several degrees of freedom; planners take joints with one: "
            f"leave it out of moving in [robot]."
        )
    for j, (lo, hi), q in zip(chaser.moving, task.position_limits, task.start, strict=True):
        if not lo <= q <= hi:
            raise TaskError(f"[robot] joints: {j.name!r} starts at {q:g}, outside its limits {lo:g} to {hi:g}.")
    for key, limits in (("rate", task.rate_limits), ("torque", task.torque_limits)):
        for j, limit in zip(chaser.moving, limits, strict=True):
            if not np.isfinite(limit) or limit <= 0:
                raise TaskError(f"joint {j.name!r} has no {key} limit; give {key} in [limits].")
    for name, phase in task.phases.items():
        low, high = phase.duration
        if not 0 <= low <= high or (name != "wait" and low <= 0):
            raise TaskError(f"duration in [phases.{name}] is {[low, high]}; give the shortest and the longest, > 0 s.")
    if task.base:
        _check_base(task)
    if task.kind == "detumble":
        _check_detumbling(task)
    if task.kind == "identify":
        return task
    chaser.frame(task.robot.frame)
    if task.kind == "reach":
        chaser.configuration(quaternion=task.goal.quaternion or (1.0, 0, 0, 0))  # refuses one that has not unit length
        return task
    body = _model(task.target.model, folder)
    if body.grounded or body.moving:
        raise TaskError(f"[target] model {task.target.model!r} must be one free rigid body; lock its joints.")
    body.frame(task.target.frame)
    task = replace(task, body=body.prefixed("target_"))
    if task.kind == "grasp":
        body.configuration(quaternion=task.target.quaternion)  # refuses one that has not unit length
        _check_mission(task)
    return task


def _check_mission(task):
    solids.check(task)
    if task.sight:
        task.chaser.link(task.sight.link)
        if not np.linalg.norm(task.sight.axis) > 1e-9:
            raise TaskError("axis in [sight] has no length; give where the camera looks.")


def _check_detumbling(task):
    moving = {joint.name: limit for joint, limit in zip(task.joints, task.rate_limits, strict=True)}
    for name in (*task.base.wheels, *task.capture.rates):
        if name not in moving:
            raise TaskError(f"{name!r} in [base] or [capture] is no joint that moves; there are {', '.join(moving)}.")
    for name, rate in task.capture.rates.items():
        if abs(rate) > moving[name]:
            raise TaskError(f"[capture] rates: {name!r} has {rate:g}, beyond its limit of {moving[name]:g}.")


def _check_base(task):
    if not (np.r_[task.base.torque, task.base.force or ()] > 0).all():
        raise TaskError(
            "torque and force in [base] must be above zero; a grasp without force has a base whose attitude is "
            "controlled, and one without [base] a base that floats."
        )
