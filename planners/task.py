"""What is to be planned, and the strict reader of its description in TOML.

SI units and radians everywhere. Every section of a file is one record below: its fields are the keys, those without a
default must be given, and a key that is not a field is refused with the closest ones.
"""

import difflib
import hashlib
import tomllib
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path

import numpy as np

import sdyn

FOLDER = Path(__file__).parent / "tasks"
LARGEST_FILE = 1 << 20  # bytes
LARGEST = 1e30  # of the numbers in a task; their products stay within float64


class TaskError(ValueError):
    """A task that cannot be what it says; the message names the key and the remedy."""


def _is_number(value) -> bool:
    """Whether it is a number of a size that quantities have; true, nan and inf are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def number(least=-np.inf, most=np.inf, default=MISSING, whole=False):
    """A field that holds one number."""

    def check(value, where):
        good = _is_number(value) and (isinstance(value, int) or not whole)
        if not good or not least <= value <= most:
            kind = "a whole number" if whole else "a number"
            raise TaskError(f"{where} is {value!r}; it must be {kind} from {least:g} to {most:g}.")
        return int(value) if whole else float(value)

    return field(default=default, metadata={"check": check})


def vector(size, default=MISSING):
    """A field that holds a list of numbers."""

    def check(value, where):
        numbers = isinstance(value, list) and all(map(_is_number, value))
        if not numbers or len(value) != size:
            raise TaskError(f"{where} is {value!r}; it must be a list of {size} numbers.")
        return tuple(map(float, value))

    return field(default=default, metadata={"check": check})


def text(default=MISSING):
    """A field that holds a string."""

    def check(value, where):
        if not isinstance(value, str) or not value:
            raise TaskError(f"{where} is {value!r}; it must be a string in quotes.")
        return value

    return field(default=default, metadata={"check": check})


def named_numbers():
    """A field that holds {name: number}."""

    def check(value, where):
        if not isinstance(value, dict) or not all(map(_is_number, value.values())):
            raise TaskError(f"{where} is {value!r}; it must look like {{ joint1 = 0.3, joint2 = 1.2 }}.")
        return {name: float(x) for name, x in value.items()}

    return field(default_factory=dict, metadata={"check": check})


def names():
    """A field that holds a list of names."""

    def check(value, where):
        if not isinstance(value, list) or not all(isinstance(x, str) for x in value):
            raise TaskError(f'{where} is {value!r}; it must look like ["joint1", "joint2"].')
        return tuple(value)

    return field(default=(), metadata={"check": check})


@dataclass(frozen=True, kw_only=True)
class Chaser:
    """Section [robot]: who does it, and how it starts, at rest."""

    model: str = text()
    """A shipped model, or the path of a robot file next to the task."""
    frame: str = text(default="hand")
    joints: dict = named_numbers()  # noqa: RUF009  (a field, as its neighbours)
    """Joint positions at the start [rad or m]; zero where not named."""
    moving: tuple = names()
    """Joints that move; all of them if left out. The others are locked where `joints` has them."""


@dataclass(frozen=True, kw_only=True)
class Passive:
    """Section [target]: a free rigid body, its frame to be grasped, and its state at time zero."""

    model: str = text()
    frame: str = text(default="grasp")
    position: tuple = vector(3)
    """Of the base origin, world axes [m]."""
    quaternion: tuple = vector(4, default=(1.0, 0.0, 0.0, 0.0))
    """wxyz, body to world."""
    twist: tuple = vector(6)
    """[w; v] of the base origin, body axes [rad/s, m/s]."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """Section [goal]: where the robot's frame is to be, at rest; world axes, the base starts at their origin."""

    position: tuple = vector(3)
    """m."""
    quaternion: tuple | None = vector(4, default=None)
    """wxyz, frame to world; any orientation if left out."""


@dataclass(frozen=True, kw_only=True)
class Phase:
    """Section [phases.NAME]."""

    duration: tuple = vector(2)
    """Shortest and longest [s]."""
    control_points: int = number(7, 60, default=12, whole=True)
    """Of the quintic spline of every joint."""
    intervals: int = number(4, 400, default=24, whole=True)
    """Of the solver's grid; the certificate's is twelve times finer."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Section [limits]: what replaces the robot's own numbers, for all joints, and the solver's distance from them."""

    rate: float | None = number(0.0, default=None)
    """rad/s or m/s."""
    torque: float | None = number(0.0, default=None)
    """N m or N."""
    margin: float = number(0.0, 0.5, default=0.01)
    """Part of the torque limit kept free at the grid's points, so that it holds between them too."""


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """Section [tolerance]: how well the hand follows the target while it tracks, at all times."""

    position: float = number(0.0, default=1e-3)
    """m."""
    angle: float = number(0.0, default=1e-3)
    """rad."""
    speed: float = number(0.0, default=1e-3)
    """m/s."""


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Section [weights]: of the cost; each term is about 1 for a plain manoeuvre."""

    time: float = number(0.0, default=0.05)
    """1/s: times the total duration."""
    torque: float = number(0.0, default=1.0)
    """1/s: times the integral of the mean squared torque, relative to its limit."""
    smoothness: float = number(0.0, default=1.0)
    """s^3: times the integral of the mean squared joint acceleration."""
    information: float = number(0.0, default=1.0)
    """Times -log det of the Fisher information."""


@dataclass(frozen=True, kw_only=True)
class Sensors:
    """Section [sensors]: what the base carries, white noise per sample; no noise given, no such sensor."""

    rate: float = number(1e-3, default=10.0)
    """Samples per second."""
    gyro: float | None = number(1e-12, default=None)
    """rad/s."""
    accelerometer: float | None = number(1e-12, default=None)
    """m/s^2, of the specific force."""
    lever: tuple = vector(3, default=(0.0, 0.0, 0.0))
    """Place of the accelerometer, base axes [m]."""
    star_tracker: float | None = number(1e-12, default=None)
    """rad."""


PHASES = {"grasp": ("wait", "approach", "track", "stabilise"), "identify": ("excite",), "reach": ("reach",)}
SECTIONS = {
    "grasp": {"robot": Chaser, "target": Passive, "limits": Limits, "tolerance": Tolerance, "weights": Weights},
    "identify": {"robot": Chaser, "limits": Limits, "sensors": Sensors, "weights": Weights},
    "reach": {"robot": Chaser, "goal": Goal, "limits": Limits, "weights": Weights},
}


@dataclass(frozen=True, kw_only=True)
class Task:
    """A task, checked: everything that a planner needs, and where it came from."""

    name: str
    kind: str
    chaser: sdyn.Robot
    robot: Chaser
    phases: dict[str, Phase]
    limits: Limits
    weights: Weights
    tolerance: Tolerance | None = None
    target: Passive | None = None
    body: sdyn.Robot | None = None
    """The target's structure; its names carry the prefix "target_"."""
    sensors: Sensors | None = None
    goal: Goal | None = None
    attitude: float | None = None
    """Largest turn of the base from its start [rad]."""
    source: str = ""
    """The text that was read."""
    folder: Path = FOLDER
    """Where robot files are looked for."""

    @property
    def sha256(self) -> str:
        """Hash of the text."""
        return hashlib.sha256(self.source.encode()).hexdigest()

    @property
    def reads_files(self) -> bool:
        """Whether a robot comes from a file next to the task, not from the shipped ones."""
        models = [self.robot.model] + ([self.target.model] if self.target else [])
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
    def start(self) -> np.ndarray:
        """Joint positions at the start, [joints]."""
        return self.first[7:]

    @property
    def first(self) -> np.ndarray:
        """Configuration at time zero, [nq]: the base at the world's origin."""
        moving = {joint.name for joint in self.joints}
        return self.chaser.configuration({k: x for k, x in self.robot.joints.items() if k in moving})


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
    extra = {}
    if kind == "identify":
        extra["attitude"] = _attitude(tree.pop("attitude", None))
    _refuse_unknown(tree, {*SECTIONS[kind], "phases"}, "the task")
    phases = tree.get("phases", {})
    _refuse_unknown(_table(phases, "[phases]"), PHASES[kind], "[phases]")
    sections = {key: _section(tree.get(key, {}), record, f"[{key}]") for key, record in SECTIONS[kind].items()}
    sections["phases"] = {p: _section(phases.get(p, {}), Phase, f"[phases.{p}]") for p in PHASES[kind]}
    chaser = _chaser(sections["robot"], folder)
    task = Task(name=name, kind=kind, chaser=chaser, source=source, folder=folder, **sections, **extra)
    return _checked(task, folder)


def _attitude(value):
    if value is None:
        return None
    if not _is_number(value) or not 0 < value <= 3:
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
    body.configuration(quaternion=task.target.quaternion)  # refuses one that has not unit length
    return replace(task, body=body.prefixed("target_"))
