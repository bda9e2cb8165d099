"""Only what a scene requires: a smaller robot, and a report of what went, what that saves and what it costs in error.

The full model is the judge: it is given the motion of the small one, with the joints that were left out at the rates
that they really have, and says by inverse dynamics which forces that motion needs. What the small one does under these
forces, instead of those that act, differs by the error; what joints that were left out need is what brakes must hold.
"""

import time
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np

from sdyn.checks import RobotError, known
from sdyn.constraints import forward_dynamics
from sdyn.dynamics import inverse_dynamics
from sdyn.floating import floating_velocity
from sdyn.pack import pack
from sdyn.parts import KINDS
from sdyn.rigid import merged
from sdyn.robot import Robot

STEPS = 32  # of a timed rollout; a single call would time its own overhead, which is as much as the work of 64 states


@dataclass(frozen=True)
class Scene:
    """What a task needs of a robot."""

    moving: tuple[str, ...]
    """Joints that move; the others are locked and leave the model."""
    posture: dict = field(default_factory=dict)
    """Where joints that do not move stand, by name; at zero if not named [m, rad, or unit quaternion wxyz]."""
    rates: dict = field(default_factory=dict)
    """Rates that joints left out have in truth, by name: a wheel that spins, a brake that slips [m/s, rad/s]."""
    momentum: tuple | None = None
    """Total momentum, where only joints are driven: angular about the centre of mass, and linear, world axes [N m s,
    N s]. Then the base is no coordinate: `floating_forward_dynamics` moves it. None: something acts on the base."""
    gravity: tuple | None = None
    """World axes [m/s^2]."""
    loops: tuple[str, ...] | None = None
    """Closures that hold; all of them by default."""
    frames: tuple[str, ...] | None = None
    """Frames that are asked for; all of them by default."""


@dataclass(frozen=True)
class Report:
    """What `reduce` left out, and what was measured: float64 or the type that JAX has switched on, this machine."""

    coordinates: tuple[int, int]
    """Entries of the state's velocity, before and after."""
    links: tuple[int, int]
    left_out: tuple[str, ...]
    """What went, one phrase each."""
    seconds: tuple[float, float]
    """Forward dynamics per state, in a rollout of a batch, of the full model and of the reduced one."""
    error: float
    """Largest error of an acceleration, as a part of the largest acceleration of its state."""
    held: dict
    """Largest force that each joint left out must hold, by name [N m, N]."""
    samples: int
    """States in the batch, and states that the error is the largest of; with none, nothing was measured."""

    @property
    def speedup(self) -> float:
        """Time of the full model over that of the reduced one."""
        return self.seconds[0] / self.seconds[1]

    def __str__(self) -> str:
        fewer = lambda counts: f"{counts[0]} -> {counts[1]}"
        rows = [f"{fewer(self.coordinates)} coordinates, {fewer(self.links)} links."]
        rows.append(f"Left out: {'; '.join(self.left_out) or 'nothing'}.")
        if self.samples:
            full, small = (x * 1e6 for x in self.seconds)
            rows.append(f"Forward dynamics in a batch of {self.samples}: {self.speedup:.1f} times faster, ")
            rows[-1] += f"{small:.2f} us instead of {full:.2f} us a state."
            rows.append(f"Accelerations differ from the full model's by at most {self.error:.1e} of the largest one.")
        if self.held:
            name = max(self.held, key=self.held.get)
            rows.append(f"Joints left out must hold up to {self.held[name]:.3g} N m or N ({name}).")
        return "\n".join(rows)


def reduce(robot: Robot, scene: Scene, *, samples: int = 64) -> tuple[Robot, Report]:
    """The smallest robot that a scene requires, and what it leaves out.

    Args:
        robot: The full model.
        scene: What the task needs of it.
        samples: Random states to measure time and error on, at unit rates and forces. Both models are compiled for
            that; 0 measures nothing.

    Returns:
        The robot: names, order and signs of its coordinates are those of the full one. Locked links are one link.
        The report; print it.

    Raises:
        RobotError: If the scene names what the robot has not, or knows the momentum of a grounded robot or under
            closures to ground.
    """
    small, left_out = _reduced(robot, scene)
    coordinates = robot.nv, small.nv - (0 if scene.momentum is None else 6)
    seconds, error, held = _measured(robot, small, scene, samples) if samples else ((np.nan, np.nan), np.nan, {})
    return small, Report(coordinates, (len(robot.links), len(small.links)), left_out, seconds, error, held, samples)


def _reduced(robot, scene):
    """The small robot, and phrases for what went."""
    names = [joint.name for joint in robot.moving]
    for name in (*scene.moving, *scene.posture, *scene.rates):
        known(name, names, "moving joint")
    for key, given in (("loop", scene.loops), ("frame", scene.frames)):
        for name in given or ():
            known(name, [x.name for x in getattr(robot, key + "s")], key)
    idle = [joint for joint in robot.moving if joint.name not in scene.moving]
    small = robot.lock({joint.name: scene.posture.get(joint.name, _rest(joint)) for joint in idle})
    for loop in robot.loops:
        if scene.loops is not None and loop.name not in scene.loops:
            small = small.open(loop.name)
    small = merged(small)
    if scene.frames is not None:
        small = replace(small, frames=[frame for frame in small.frames if frame.name in scene.frames])
    if scene.momentum is not None and (robot.grounded or any(x.link == "ground" for x in _ends(small))):
        raise RobotError("reduce: total momentum is not kept where the ground holds; leave momentum out of the scene.")

    gone = lambda key: [x.name for x in getattr(robot, key) if x.name not in {y.name for y in getattr(small, key)}]
    out = [f"{len(gone('joints'))} joints ({_few(gone('joints'))})"] * bool(gone("joints"))
    for key in ("loops", "frames"):
        out += [f"{len(gone(key))} {key} ({_few(gone(key))})"] * bool(gone(key))
    out += ["the base's coordinates, which momentum decides"] * (scene.momentum is not None)
    out += ["gravity"] * (scene.gravity is None)
    out += ["a solver for loops"] * (not small.loops)
    return small, tuple(out)


def _rest(joint):
    return [1.0, 0.0, 0.0, 0.0] if joint.kind == "spherical" else np.zeros(joint.nq)


def _ends(robot):
    return [end for loop in robot.loops for end in (loop.frame_a, loop.frame_b)]


def _few(names) -> str:
    return ", ".join(names) if len(names) <= 4 else f"{names[0]}, {names[1]}, ... {names[-1]}"


# ---- measured --------------------------------------------------------------------------------------------------------


def _measured(robot, small, scene, samples):
    """Seconds per state of both, largest relative error, and the forces at the joints left out."""
    chains = [pack(x) for x in (robot, small)]
    rng, dtype = np.random.default_rng(0), chains[0].dtype
    given = lambda x: None if x is None else jnp.asarray(x, dtype)
    gravity, momentum = given(scene.gravity), given(scene.momentum)
    (q, v, tau), all_of_it = (_states(x, samples, rng, dtype) for x in (small, robot))
    if momentum is not None:
        tau = tau.at[:, :6].set(0)
    roll = lambda tau, count: _roll(chains[1], q, v, tau, gravity, momentum, count)
    seconds = _timed(lambda: _roll(chains[0], *all_of_it, gravity, None, STEPS), lambda: roll(tau, STEPS))

    at = [robot.v_names.index(name) for name in small.v_names]
    fill = jnp.zeros((samples, robot.nv), dtype).at[:, at].set
    v, vdot = roll(tau, 1)
    needed = _needed(chains[0], *_whole(robot, small, scene, q, fill(v)), fill(vdot), gravity)
    _, other = roll(needed[:, at], 1)  # what closures take of it does no harm
    error = jnp.abs(other - vdot).max(1, initial=0.0) / jnp.abs(vdot).max(1, initial=jnp.finfo(dtype).tiny)

    held = {}
    for joint in robot.moving:
        names = [joint.name + end for end in KINDS[joint.kind].rates]
        if joint.name not in scene.moving:
            held[joint.name] = float(jnp.abs(needed[:, [robot.v_names.index(name) for name in names]]).max())
    return tuple(x / samples / STEPS for x in seconds), float(error.max()), held


def _states(robot, samples, rng, dtype):
    """Random q, v and tau of unit size."""
    q = rng.uniform(-1, 1, (samples, robot.nq))
    for k in (k for k, name in enumerate(robot.q_names) if name.endswith(".qw")):
        q[:, k : k + 4] /= np.linalg.norm(q[:, k : k + 4], axis=1)[:, None]
    v, tau = rng.uniform(-1, 1, (2, samples, robot.nv))
    return tuple(jnp.asarray(x, dtype) for x in (q, v, tau))


def _whole(robot, small, scene, q, v):
    """State of the full model: the joints left out stand as the scene says, and move at the rates that it says."""
    rest = {x.name: scene.posture.get(x.name, _rest(x)) for x in robot.moving if x.name not in scene.moving}
    full = np.tile(robot.configuration(rest), (len(q), 1))
    full[:, [robot.q_names.index(name) for name in small.q_names]] = q
    rates = {name: rate for name, rate in scene.rates.items() if name not in scene.moving}
    return jnp.asarray(full, v.dtype), v + jnp.asarray(robot.velocity(rates), v.dtype)


@jax.jit
def _roll(chain, q, v, tau, gravity, momentum, count):
    """The velocity at the start, and the accelerations after `count` evaluations, each at other rates: in one program,
    as in a rollout."""

    def f(q, v, tau):
        v = v if momentum is None else floating_velocity(chain, q, v[6:], momentum)
        return v, forward_dynamics(chain, q, v, tau, gravity=gravity)

    step = lambda _, x: jax.vmap(f)(q, v + 1e-9 * x[1], tau)
    return jax.lax.fori_loop(0, count, step, (v, jnp.zeros_like(v)))


@jax.jit
def _needed(chain, q, v, vdot, gravity):
    return jax.vmap(lambda *x: inverse_dynamics(chain, *x, gravity=gravity))(q, v, vdot)


def _timed(*calls, rounds: int = 15) -> list[float]:
    """Shortest time of each call, taken in turns so that a busy machine is busy for all."""
    best = [np.inf] * len(calls)
    for round in range(rounds):
        for k, call in enumerate(calls):
            start = time.perf_counter()
            jax.block_until_ready(call())
            best[k] = min(best[k], time.perf_counter() - start) if round else np.inf  # the first one compiles
    return best
