"""The sections of a task file: one record each, whose fields are the keys.

SI units and radians everywhere. A field without a default must be given; each checks its own value.
"""

from dataclasses import MISSING, dataclass, field

import numpy as np

LARGEST = 1e30  # of the numbers in a task; their products stay within float64


class TaskError(ValueError):
    """A task that cannot be what it says; the message names the key and the remedy."""


def is_number(value) -> bool:
    """Whether it is a number of a size that quantities have; true, nan and inf are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def number(least=-np.inf, most=np.inf, default=MISSING, whole=False):
    """A field that holds one number."""

    def check(value, where):
        good = is_number(value) and (isinstance(value, int) or not whole)
        if not good or not least <= value <= most:
            kind = "a whole number" if whole else "a number"
            raise TaskError(f"{where} is {value!r}; it must be {kind} from {least:g} to {most:g}.")
        return int(value) if whole else float(value)

    return field(default=default, metadata={"check": check})


def vector(size, default=MISSING):
    """A field that holds a list of numbers."""

    def check(value, where):
        numbers = isinstance(value, list) and all(map(is_number, value))
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
        if not isinstance(value, dict) or not all(map(is_number, value.values())):
            raise TaskError(f"{where} is {value!r}; it must look like {{ joint1 = 0.3, joint2 = 1.2 }}.")
        return {name: float(x) for name, x in value.items()}

    return field(default_factory=dict, metadata={"check": check})


def flag():
    """A field that holds true or false; false if left out."""

    def check(value, where):
        if not isinstance(value, bool):
            raise TaskError(f"{where} is {value!r}; it must be true or false.")
        return value

    return field(default=False, metadata={"check": check})


def names():
    """A field that holds a list of names."""

    def check(value, where):
        if not isinstance(value, list) or not all(isinstance(x, str) for x in value):
            raise TaskError(f'{where} is {value!r}; it must look like ["joint1", "joint2"].')
        return tuple(value)

    return field(default=(), metadata={"check": check})


def pairs_of_names():
    """A field that holds a list of pairs of names."""

    def check(value, where):
        pair = lambda x: isinstance(x, list) and len(x) == 2 and all(isinstance(name, str) for name in x)
        if not isinstance(value, list) or not all(map(pair, value)):
            raise TaskError(f'{where} is {value!r}; it must look like [["forearm", "bus"], ["wrist", "bus"]].')
        return tuple(map(tuple, value))

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
    closed: tuple = pairs_of_names()
    """Pairs of frames that are welded as they are at the start: another hand that holds the load, too."""
    dock: str | None = text(default=None)
    """Frame that a station holds where it is at the start, for a reach; nothing if left out, and the base floats."""


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
    uncertainty: float = number(0.0, 0.5, default=0.0)
    """Part by which mass and inertia may be others; the certificate then looks at the torques after the grasp."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """Section [goal]: where the robot's frame is to be, at rest; world axes, the base starts at their origin."""

    position: tuple = vector(3)
    """m."""
    quaternion: tuple | None = vector(4, default=None)
    """wxyz, frame to world; any orientation if left out."""


@dataclass(frozen=True, kw_only=True)
class Held:
    """Section [target] or [load]: a free rigid body whose frame the hand holds."""

    model: str = text()
    frame: str = text(default="grasp")


@dataclass(frozen=True, kw_only=True)
class Capture:
    """Section [capture]: velocities of robot and target right after it."""

    twist: tuple = vector(6, default=(0.0,) * 6)
    """[w; v] of the base's origin, base axes [rad/s, m/s]."""
    rates: dict = named_numbers()  # noqa: RUF009  (a field, as its neighbours)
    """Joint rates [rad/s or m/s]; zero where not named."""


@dataclass(frozen=True, kw_only=True)
class Pushed:
    """Section [base] of a grasp: what moves the base from the approach on, besides the reaction of the joints; it
    floats freely if left out.
    """

    torque: tuple = vector(3)
    """Largest moments about the base's axes, at its origin [N m]."""
    force: tuple | None = vector(3, default=None)
    """Largest forces along the base's axes [N]; if left out, its attitude is controlled and nothing else."""


@dataclass(frozen=True, kw_only=True)
class Actuators(Pushed):
    """Section [base] of a detumbling."""

    force: tuple = vector(3)
    wheels: tuple = names()
    """Joints that are reaction wheels: they may spin at the end."""


@dataclass(frozen=True, kw_only=True)
class Rest:
    """Section [end]: what counts as rest."""

    speed: float = number(1e-9, default=1e-3)
    """Largest joint rate, and largest linear and angular speed of the base [rad/s, m/s]."""


@dataclass(frozen=True, kw_only=True)
class Phase:
    """Section [phases.NAME]."""

    duration: tuple = vector(2)
    """Shortest and longest [s]."""
    control_points: int = number(7, 60, default=12, whole=True)
    """Of the quintic spline of every joint."""
    intervals: int = number(4, 400, default=24, whole=True)
    """Of the solver's grid; the certificate's is 24 times finer."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Section [limits]: what replaces the robot's own numbers, for all joints, and the solver's distance from them."""

    rate: float | None = number(0.0, default=None)
    """rad/s or m/s."""
    torque: float | None = number(0.0, default=None)
    """N m or N."""
    margin: float = number(0.0, 0.5, default=0.01)
    """Part kept free at the grid's points, of limits of torque, base, gripper and sight, for what is between them."""


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
class Solid:
    """Section [shapes.NAME]: a sphere, a capsule or an ellipsoid on a link; places and axes are the link's."""

    link: str = text()
    """Of the robot; or of the target, with "target_" before its name."""
    position: tuple = vector(3)
    """Centre, or one end of a capsule's axis [m]."""
    to: tuple | None = vector(3, default=None)
    """The other end of a capsule's axis [m]."""
    radius: float | None = number(0.0, default=None)
    """Of a sphere or a capsule [m]."""
    semi_axes: tuple | None = vector(3, default=None)
    """Of an ellipsoid [m]."""


@dataclass(frozen=True, kw_only=True)
class Clearance:
    """Section [clearance]: how far shapes keep from each other, from the start to the end."""

    distance: float = number(0.0)
    """m."""
    margin: float = number(0.0, default=0.005)
    """Added at the grid's points, so that the distance holds between them too: a body that moves by x from one point to
    the next may come closer by x^2 / (8 d) between them [m]."""
    pairs: tuple = pairs_of_names()
    """Shapes that keep apart; if left out, each of the robot from each of the target."""
    contact: tuple = pairs_of_names()
    """Those of them that may come as close as they are in the grasp: one is on the link of the hand."""


@dataclass(frozen=True, kw_only=True)
class Gripper:
    """Section [gripper]: what it can bear; moments are about the grasped frame."""

    force: float = number(1e-6)
    """Largest force after the grasp [N]."""
    torque: float = number(1e-6)
    """Largest moment after the grasp [N m]."""
    impulse: float = number(1e-9)
    """Largest impulse at the grasp [N s]."""
    angular_impulse: float = number(1e-9)
    """Largest impulse of the moment at the grasp [N m s]."""


@dataclass(frozen=True, kw_only=True)
class BaseAttitude:
    """Section [base_attitude]: how far and how fast the base may turn, from the start to the end."""

    turn: float = number(1e-6, 3.0)
    """From its attitude at the start [rad]."""
    rate: float = number(1e-9)
    """rad/s."""


@dataclass(frozen=True, kw_only=True)
class Sight:
    """Section [sight]: a camera that sees the frame to be grasped until it is grasped."""

    link: str = text()
    """Of the robot."""
    position: tuple = vector(3)
    """Link axes [m]."""
    axis: tuple = vector(3)
    """Where it looks, link axes; of any length."""
    half_angle: float = number(1e-3, 3.0)
    """Of the cone that it sees [rad]."""


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
class GraspWeights(Weights):
    """Section [weights] of a grasp: what pushes the base counts as in a detumbling."""

    base_torque: float = number(0.0, default=1.0)
    """1/(N^2 m^2 s): times the integral of the squared moment on the base."""
    base_force: float = number(0.0, default=10.0)
    """1/(N^2 s): times the integral of the squared force on the base."""


@dataclass(frozen=True, kw_only=True)
class Effort:
    """Section [weights] of a cost in physical units: times the duration, and times integrals of squares."""

    time: float = number(0.0, default=1.0)
    """1/s."""
    base_torque: float = number(0.0, default=1.0)
    """1/(N^2 m^2 s), of the moment on the base."""
    base_force: float = number(0.0, default=10.0)
    """1/(N^2 s), of the force on the base."""
    joint_torque: float = number(0.0, default=1.0)
    """1/(N^2 m^2 s)."""
    end_base: float = number(0.0, default=0.0)
    """s^2 or s^2/m^2: times the squares of the base's velocity at the end."""
    end_joints: float = number(0.0, default=0.0)
    """s^2: times the squares of the joint rates at the end."""


@dataclass(frozen=True, kw_only=True)
class Sensors:
    """Section [sensors]: white noise per sample, and whether there is an unknown constant bias too; no noise given, no
    such sensor.
    """

    rate: float = number(1e-3, default=10.0)
    """Samples per second."""
    gyro: float | None = number(1e-12, default=None)
    """rad/s."""
    gyro_bias: bool = flag()
    accelerometer: float | None = number(1e-12, default=None)
    """m/s^2, of the specific force."""
    accelerometer_bias: bool = flag()
    lever: tuple = vector(3, default=(0.0, 0.0, 0.0))
    """Place of the accelerometer, base axes [m]."""
    star_tracker: float | None = number(1e-12, default=None)
    """rad."""
    star_tracker_bias: bool = flag()
    """World axes: the attitude at the start is then not known either."""
    torque: float | None = number(1e-12, default=None)
    """N m or N, of every joint."""
    torque_bias: bool = flag()
    encoder: float | None = number(1e-12, default=None)
    """rad or m, of every joint; for the estimator. The planner takes the joints' path as known."""
    encoder_bias: bool = flag()


PHASES = {
    "grasp": ("wait", "approach", "track", "stabilise"),
    "identify": ("excite",),
    "reach": ("reach",),
    "detumble": ("stabilise",),
}
SECTIONS = {
    "grasp": {
        "robot": Chaser,
        "target": Passive,
        "limits": Limits,
        "tolerance": Tolerance,
        "weights": GraspWeights,
        "base": Pushed,
        "clearance": Clearance,
        "gripper": Gripper,
        "base_attitude": BaseAttitude,
        "sight": Sight,
    },
    "identify": {"robot": Chaser, "load": Held, "limits": Limits, "sensors": Sensors, "weights": Weights},
    "reach": {"robot": Chaser, "load": Held, "goal": Goal, "limits": Limits, "weights": Weights},
    "detumble": {
        "robot": Chaser,
        "target": Held,
        "capture": Capture,
        "base": Actuators,
        "end": Rest,
        "limits": Limits,
        "weights": Effort,
    },
}
OPTIONAL = {
    "identify": ("load",),
    "reach": ("load",),
    "grasp": ("base", "clearance", "gripper", "base_attitude", "sight"),
}
NAMED = {"grasp": {"shapes": Solid}}  # sections of sections, with names of their own
