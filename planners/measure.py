"""What the sensors of an identification manoeuvre record: a robot as it is, its noise and its biases.

The base moves by momentum (`floating`) and torques come from inverse dynamics, of a robot whose parameters may differ
from the task's; nothing here knows what the planner or the estimator derive. With encoders, the joints leave the
planned path a little, by random changes of the spline's control points.
"""

import functools
from dataclasses import dataclass
from typing import NamedTuple

import jax

import sdyn
from planners import floating, identify, inertial
from planners.bspline import Clamped
from planners.problem import ONCE
from planners.task import Sensors, Task, TaskError

NAMES = ("gyro", "accelerometer", "star_tracker", "torque", "encoder")
BIAS = 100.0  # standard deviation of simulated biases, in those of the noise
STRAY = 10.0  # of the joints' control points, in the encoders' noise


class Measurements(NamedTuple):
    """Samples at equal distances of one manoeuvre; None of a sensor that is not there."""

    times: jax.Array
    """[k + 1] s, from the start of the manoeuvre to its end."""
    gyro: jax.Array | None
    """[k + 1, 3] angular velocity of the base, base axes [rad/s]."""
    accelerometer: jax.Array | None
    """[k + 1, 3] specific force at the lever, base axes [m/s^2]."""
    star_tracker: jax.Array | None
    """[k + 1, 3, 3] attitude of the base, from the one at the start."""
    torque: jax.Array | None
    """[k + 1, n] N m or N."""
    encoder: jax.Array | None
    """[k + 1, n] rad or m."""


@dataclass(frozen=True)
class Setup:
    """What is measured, and when: all that is compiled."""

    spline: Clamped
    intervals: int
    sensors: Sensors

    @property
    def noise(self) -> dict[str, float]:
        """Standard deviations of the sensors that are there."""
        return {name: getattr(self.sensors, name) for name in NAMES if getattr(self.sensors, name) is not None}

    def biased(self, name: str) -> bool:
        """Whether a sensor has a constant bias."""
        return getattr(self.sensors, f"{name}_bias")


def setup(task: Task, variables: dict) -> Setup:
    """The sensors of a task, on the samples of a manoeuvre.

    Raises:
        TaskError: If the task is no identification, or float64 is off.
    """
    if task.kind != "identify":
        raise TaskError(f"the task {task.name!r} is of kind {task.kind!r}; only identifications measure.")
    if not jax.config.jax_enable_x64:
        raise TaskError('measurements need float64; call jax.config.update("jax_enable_x64", True) first.')
    intervals = max(4, round(task.sensors.rate * float(variables["duration"][0])))
    return Setup(Clamped(task.phases["excite"].control_points), intervals, task.sensors)


def measure(task: Task, variables: dict, *, truth: sdyn.Robot | None = None, seed: int = 0) -> Measurements:
    """Simulates what the sensors of a manoeuvre record.

    Args:
        task: An identification.
        variables: Of the manoeuvre, as `plan.variables`.
        truth: The robot as it is, with the structure of `task.chaser`; that one itself if left out.
        seed: Of noise, biases and, with encoders, of the path's deviation.
    """
    at = setup(task, variables)
    return _recorded(at, sdyn.pack(truth or task.chaser), identify.data(task), variables, jax.random.key(seed))


def recorded(setup: Setup, chain, data: identify.Data, x, key, noisy=1.0) -> Measurements:
    """`measure` of a packed robot, from the variables by name and a key; `noisy` scales all errors."""
    stray, *keys = jax.random.split(key, 1 + 2 * len(NAMES))
    if "encoder" in setup.noise:
        size = noisy * STRAY * setup.noise["encoder"]
        x = x | {"excite": x["excite"] + size * jax.random.normal(stray, x["excite"].shape)}
    clean, out = perfect(setup, chain, data, x), {}
    for k, (name, noise) in enumerate(setup.noise.items()):
        true = getattr(clean, name)
        shape = true.shape[:1] + true.shape[-1:]
        error = noisy * noise * jax.random.normal(keys[2 * k], shape)
        if setup.biased(name):
            error = error + noisy * BIAS * noise * jax.random.normal(keys[2 * k + 1], shape[1:])
        out[name] = jax.vmap(floating.exponential)(error) @ true if name == "star_tracker" else true + error
    return clean._replace(**out)


_recorded = functools.partial(jax.jit, static_argnums=0, **ONCE)(recorded)


def perfect(setup: Setup, chain, data: identify.Data, x) -> Measurements:
    """What the sensors would record without noise and bias."""
    at = identify.motion(setup.spline, setup.intervals, x, data._replace(chain=chain))
    force = jax.vmap(inertial.felt, (None, 0, 0))(data.lever, at.v[:, :6], at.vdot[:, :6])
    every = dict(zip(NAMES, (at.v[:, :3], force, at.R, at.tau, at.q), strict=True))
    return Measurements(at.times, **{name: every[name] if name in setup.noise else None for name in NAMES})
