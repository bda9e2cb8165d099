"""The three examples of the paper, each as restructured models and as the models it compares with.

Every model of an example is in the same physical state, and returns the accelerations of the joints they share.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sdyn

QUICKLY = dict(compiler_options={"xla_backend_optimization_level": 0})  # for what is called a few times only


class Model(NamedTuple):
    """A packed structure in a state, and how its joints accelerate."""

    chain: sdyn.Chain
    q: np.ndarray
    v: np.ndarray
    tau: np.ndarray
    f: Callable
    """(chain, q, v, tau) -> vdot, all of it."""
    shared: np.ndarray | None
    """Which entries of vdot are compared; None where the model is here for its cost only."""

    @property
    def size(self) -> str:
        """Coordinates, and rows of constraints."""
        return f"{self.chain.nv} + {self.chain.capacity.rows}" if self.chain.capacity.rows else f"{self.chain.nv}"

    def accelerations(self):
        """Of the shared joints."""
        return np.asarray(jax.jit(self.f, **QUICKLY)(self.chain, self.q, self.v, self.tau))[self.shared]


def joints_of(robot, names) -> np.ndarray:
    """Entries of v that belong to the joints."""
    at = {name: k for k, name in enumerate(robot.v_names)}
    return np.array([at[name] for name in names])


@partial(jax.jit, **QUICKLY)
def motion_of(chain, q, v, frame):
    """Position, heading in the plane and velocity of a frame."""
    R, p = sdyn.frame_pose(chain, q, frame)
    return p, jnp.arctan2(R[1, 0], R[0, 0]), sdyn.frame_velocity(chain, q, v, frame)


# -- example 1: a free-flyer of one joint grapples a fixed point by a fixture of one degree of freedom -----------------


def flyer():
    """The free-flyer with the fixture at its hand: base, arm, fixture, all turning about z."""
    bar = lambda mass, length: np.diag([0.01, 1.0, 1.0]) * mass * length**2 / 12
    links = [
        sdyn.Link("base", 50.0, inertia=np.diag([4.0, 4.0, 6.0])),
        sdyn.Link("arm", 6.0, (0.5, 0, 0), bar(6.0, 1.0)),
    ]
    elbow = sdyn.Joint("elbow", "revolute", "base", "arm", position=(0.4, 0, 0))
    marks = [sdyn.Frame("hand", "arm", position=(1.0, 0, 0)), sdyn.Frame("middle", "base")]
    alone = sdyn.Robot(links, [elbow], marks)
    fixture = sdyn.Robot([sdyn.Link("fixture", 0.5, inertia=1e-3 * np.eye(3))], frames=[sdyn.Frame("grip", "fixture")])
    return alone, alone.attach(fixture, "hand", "grip", "revolute", "wrist")


def example_1() -> dict[str, Model]:
    """Two degrees of freedom on a fixed base, against five coordinates with virtual links, and against a free base."""
    _, robot = flyer()
    held = robot.reroot("fixture").ground("grip")
    names, q, v, tau = ("elbow", "wrist"), np.array([0.7, -0.4]), np.array([0.3, 0.5]), np.array([2.0, 0.0])
    chain = sdyn.pack(held)
    (x, y, z), turn, twist = map(np.asarray, motion_of(chain, q, v, held.frames.index(held.frame("middle"))))

    # the base on a planar joint to the ground, three virtual coordinates; the fixture is welded to the ground
    virtual = sdyn.Joint("virtual", "planar", "ground_link", "base")
    links, joints = (sdyn.Link("ground_link", 0.0), *robot.links), (virtual, *robot.joints)
    whole = sdyn.Robot(links, joints, robot.frames, base="ground_link", grounded=True).close("grip", "ground")
    q5, v5 = np.r_[x, y, turn, q], np.r_[twist[3:5], twist[2], v]

    # the base free, six coordinates
    free = robot.close("grip", "ground")
    cos, sin = np.cos(turn), np.sin(turn)
    q8 = np.r_[x, y, z, np.cos(turn / 2), 0, 0, np.sin(turn / 2), q]
    v8 = np.r_[twist[:3], cos * twist[3] + sin * twist[4], cos * twist[4] - sin * twist[3], 0, v]

    model = lambda robot, q, v: Model(
        sdyn.pack(robot), q, v, np.r_[np.zeros(robot.nv - 2), tau], sdyn.forward_dynamics, joints_of(robot, names)
    )
    return {
        "restructured, fixed base": model(held, q, v),
        "virtual links, hand constrained": model(whole, q5, v5),
        "free base, hand constrained": model(free, q8, v8),
    }


# -- example 2: three arms, a loop, the hand as base, ground, a second loop --------------------------------------------


def steps_2(q=None) -> dict[str, sdyn.Robot]:
    """The robot after each step; the closures hold the frames as they are in configuration q, or together."""
    robot = sdyn.models.load("paper37")
    for joint in ("arm4_1", "wheel_1", "wheel_2", "wheel_3"):
        robot, _ = robot.detach(joint)
    hand, joints = robot.frame("hand1").link, None if q is None else q[7:]
    looped = robot.close("hand2", "hand1", q=q)
    held = looped.reroot(hand).ground("hand1")
    return {
        "free, three arms": robot,
        "arm 2 closed on arm 1": looped,
        "end-effector 1 as base": looped.reroot(hand),
        "grounded": held,
        "arm 3 closed on the ground": held.close("hand3", "ground", q=joints),
    }


def example_2() -> dict[str, Model]:
    """The last step of the restructuring, against the connectivity kept: a free base and three closures."""
    rng = np.random.default_rng(2)
    free = steps_2()["free, three arms"]
    names = [joint.name for joint in free.moving]
    torques = dict(zip(names, 5.0 * rng.normal(size=len(names)), strict=True))
    q = free.configuration({name: 0.5 * rng.normal() for name in names})
    v = free.velocity({name: 0.2 * rng.normal() for name in names})
    kept = free.close("hand2", "hand1", q=q).close("hand1", "ground", name="held", q=q)
    robots = steps_2(q) | {"connectivity kept, three closures": kept.close("hand3", "ground", q=q)}

    def model(robot, q, v):
        at, tau = joints_of(robot, names), np.zeros(robot.nv)
        tau[at] = [torques[name] for name in names]
        return Model(sdyn.pack(robot), np.asarray(q), np.asarray(v), tau, sdyn.forward_dynamics, at)

    size = sdyn.capacity(robots.values())
    transfer = jax.jit(sdyn.transfer, **QUICKLY)  # the state goes from one to the next, by one program
    chain, out = sdyn.pack(free, size), {}
    q, v = sdyn.pad(chain, q, v)
    for step, robot in list(robots.items())[1:]:
        chain, q, v, _ = transfer(chain, sdyn.pack(robot, size), q, v)
        out[step] = model(robot, *sdyn.unpad(chain, q, v))
    *_, last, kept = out.values()
    return {"restructured, two closures": last, "connectivity kept, three closures": kept}


# -- example 3: of 37 degrees of freedom, 9 move -----------------------------------------------------------------------

ACTIVE = ("arm1_1", "arm1_2", "arm1_3")


def example_3() -> dict[str, Model]:
    """The 9-DOF form, against the full model with its 28 idle joints held in place by constraints."""
    full, rng = sdyn.models.load("paper37"), np.random.default_rng(3)
    names = [joint.name for joint in full.moving]
    angles = {name: 0.5 * rng.normal() for name in names}
    small = full.lock({name: angles[name] for name in names if name not in ACTIVE})
    pose = dict(position=(0.3, -0.2, 0.5), quaternion=(0.5, 0.5, -0.5, 0.5))
    rates, twist = {name: 0.3 * rng.normal() for name in ACTIVE}, 0.1 * rng.normal(size=6)
    torque = np.r_[np.zeros(6), 5.0 * rng.normal(size=3)]
    q, v = full.configuration(angles, **pose), full.velocity(rates, twist=twist)
    base = [f"base.{x}" for x in ("wx", "wy", "wz", "vx", "vy", "vz")]
    at = joints_of(full, [*base, *ACTIVE])
    idle = np.setdiff1d(np.arange(full.nv), at)
    tau = np.zeros(full.nv)
    tau[at] = torque
    chain = sdyn.pack(full)
    q9 = small.configuration({name: angles[name] for name in ACTIVE}, **pose)
    v9 = small.velocity(rates, twist=twist)

    def multipliers(chain, q, v, tau):
        """qdd = 0 of the idle joints as constraints: M vdot + b = tau + K^T lam, K vdot = 0, K the rows of the idle."""
        vdot = sdyn.forward_dynamics(chain, q, v, tau)
        K = jnp.eye(chain.nv)[idle]
        Y = jax.vmap(lambda row: sdyn.solve_mass(chain, q, row))(K)
        return vdot - Y.T @ jnp.linalg.solve(Y[:, idle], vdot[idle])

    def eliminated(chain, q, v, tau):
        """The rows and columns of the active joints out of the full model's equations."""
        M, b = sdyn.mass_matrix(chain, q), sdyn.bias_force(chain, q, v)
        return jnp.zeros(chain.nv).at[at].set(jnp.linalg.solve(M[at][:, at], (tau - b)[at]))

    return {
        "restructured, 9 DOF": Model(sdyn.pack(small), q9, v9, torque, sdyn.forward_dynamics, np.arange(9)),
        "37 DOF, idle joints held by multipliers": Model(chain, q, v, tau, multipliers, at),
        "37 DOF, idle joints eliminated from M": Model(chain, q, v, tau, eliminated, at),
        "37 DOF, nothing held (other accelerations)": Model(chain, q, v, tau, sdyn.forward_dynamics, None),
    }


EXAMPLES = {
    "Example 1: a one-joint free-flyer grapples a fixed point": example_1,
    "Example 2: three arms close two loops, grappled": example_2,
    "Example 3: from 37 to 9 degrees of freedom": example_3,
}
