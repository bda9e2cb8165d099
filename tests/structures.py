"""The table of structures that the laws run over, the ugly ones included, and states of them.

All robots here name their parts alike (links l0, l1, ...; joints j0, j1, ...; a frame c0, c1, ... at the centre of mass
of each link, and e0, e1, ... elsewhere), so that they share one capacity: a function is compiled once for all of them.
"""

import sys
import zlib
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import oracles

import sdyn

STATES = 4  # of each structure: two random ones, one at rest at the identity pose, one large and fast


# -- robots ------------------------------------------------------------------------------------------------------------


def unit(rng, n=3):
    x = rng.normal(size=n)
    return x / np.linalg.norm(x)


def rotation(rng):
    w, x, y, z = unit(rng, 4)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def body(rng, name, mass=None):
    """A link with a full, possible inertia."""
    mass = rng.uniform(0.5, 5.0) if mass is None else mass
    second = (lambda A: mass * A @ A.T)(rng.uniform(-0.3, 0.3, (3, 3)) + 0.1 * np.eye(3))
    return sdyn.Link(name, mass, rng.uniform(-0.2, 0.2, 3), np.trace(second) * np.eye(3) - second)


def tree(parents, kinds="revolute", *, first=0, seed=0, base_mass=20.0, **rest):
    """A robot whose link k + 1 hangs from link parents[k], with random placements.

    Args:
        parents: Numbers of links; a joint is declared from parents[k] to k + 1.
        kinds: One kind, or one for each joint.
        first: Number of the base's name.
        seed, base_mass: Of the random numbers; of the base.
        **rest: Further arguments of all joints.
    """
    rng = np.random.default_rng([seed, len(parents)])
    kinds = [kinds] * len(parents) if isinstance(kinds, str) else kinds
    links = [body(rng, f"l{first + k}", None if k else base_mass) for k in range(len(parents) + 1)]
    joints = [
        sdyn.Joint(
            f"j{first + k}", kind, f"l{first + p}", f"l{first + k + 1}", rotation(rng), rng.uniform(-0.4, 0.4, 3),
            unit(rng), pitch=0.3 if kind == "helical" else 0.0, **rest,
        )
        for k, (p, kind) in enumerate(zip(parents, kinds, strict=True))
    ]  # fmt: skip
    return with_frames(sdyn.Robot(links, joints), rng)


def with_frames(robot, rng, ends=()):
    """The robot with a frame at each centre of mass, and two more."""
    number = lambda link: link.name.removeprefix("l")
    frames = [sdyn.Frame(f"c{number(link)}", link.name, position=link.com) for link in robot.links]
    some = [(robot.links[-1].name, rng.uniform(-0.2, 0.2, 3)), (robot.links[0].name, rng.uniform(-0.2, 0.2, 3))]
    ends = [(f"e{k}", *end) for k, end in enumerate(ends or some)]
    return replace(robot, frames=(*frames, *(sdyn.Frame(name, link, rotation(rng), p) for name, link, p in ends)))


def renamed(robot, seed=0):
    """The robot with this table's names."""
    link = {x.name: f"l{k}" for k, x in enumerate(robot.links)}
    joint = {x.name: f"j{k}" for k, x in enumerate(robot.joints)}
    robot = replace(
        robot,
        links=[replace(x, name=link[x.name]) for x in robot.links],
        joints=[replace(x, name=joint[x.name], parent=link[x.parent], child=link[x.child]) for x in robot.joints],
        frames=(),
        base=link[robot.base],
        locked={joint[name]: value for name, value in robot.locked.items()},
    )
    return with_frames(robot, np.random.default_rng(seed))


def without_mass(robot, *names):
    """The robot with links that weigh nothing, as fixtures do."""
    return replace(robot, links=[sdyn.Link(x.name, 0.0, x.com) if x.name in names else x for x in robot.links])


UNBALANCED = (0, 1, 0, 2, 4, 2, 5, 7)  # depths 1 to 6, declared in another order than depth first
KINDS = ("cylindrical", "universal", "planar", "spherical", "revolute", "spherical")
POSE = [0.3, -0.2, 0.5, 0.5, 0.5, -0.5, 0.5]
ROBOTS = {
    "one_body": lambda: tree(()),
    "no_joint_grounded": lambda: tree(()).ground("l0", POSE),
    "only_fixed": lambda: tree((0, 1), "fixed"),
    "chain": lambda: tree((0, 1, 2, 3, 4)),
    "unbalanced_tree": lambda: tree(UNBALANCED),
    "all_locked": lambda: tree(UNBALANCED).lock({f"j{k}": 0.2 * k - 0.7 for k in range(8)}),
    "some_locked": lambda: tree(UNBALANCED).lock({"j0": 0.4, "j4": -1.1, "j7": 2.0}),
    "leaf_as_base": lambda: tree(UNBALANCED).reroot("l8"),
    "grounded": lambda: tree(UNBALANCED).ground("l0", POSE),
    "grounded_tip": lambda: tree((0, 1, 2, 3, 4)).reroot("l5").ground("l5", POSE),
    "locked_tip_base": lambda: tree(UNBALANCED).lock({"j4": 0.5, "j7": -0.3}).reroot("l8"),
    "screws": lambda: tree((0, 1, 2, 0), ("prismatic", "helical", "revolute", "helical"), seed=1),
    "all_kinds": lambda: tree((0, 1, 2, 3, 4, 1), KINDS, seed=2),
    "all_kinds_backwards": lambda: tree((0, 1, 2, 3, 4, 1), KINDS, seed=2).reroot("l5"),
    "all_kinds_grounded": lambda: tree((0, 1, 2, 3, 4, 1), KINDS, seed=2).reroot("l6").ground("l6", POSE),
    "all_kinds_locked": lambda: (
        tree((0, 1, 2, 3, 4, 1), KINDS, seed=2)
        .lock({"j0": [0.1, 0.4], "j1": [0.3, -0.8], "j2": [0.2, -0.1, 0.9], "j3": [0.5, 0.5, -0.5, 0.5]})
        .reroot("l4")
    ),
    "fixture": lambda: without_mass(tree((0, 1, 2, 3), ("revolute", "fixed", "revolute", "fixed")), "l1", "l4"),
    "massless_middle": lambda: without_mass(tree((0, 1, 2, 1)), "l1", "l2"),
    "passive": lambda: tree(UNBALANCED, damping=0.7, stiffness=3.0, rotor_inertia=0.4),
    "passive_kinds": lambda: tree(
        (0, 1, 2, 3), ("universal", "planar", "cylindrical", "helical"), damping=0.7, stiffness=3.0, rotor_inertia=0.4
    ).reroot("l3"),
    "paper37": lambda: renamed(sdyn.models.load("paper37")),
}
TABLE = tuple(ROBOTS)


@cache
def robot(name) -> sdyn.Robot:
    """A robot of the table, or a tree of the reference data."""
    return ROBOTS[name]() if name in ROBOTS else tree_of(oracles.model(name))


def tree_of(model) -> sdyn.Robot:
    """A robot from the format of the reference data: see `oracles.py`."""
    links = [sdyn.Link(f"l{k}", x["mass"], x["com"], x["inertia_com"]) for k, x in enumerate(model["links"])]
    joints = [
        sdyn.Joint(
            f"j{k - 1}", joint["type"], f"l{x['parent']}", f"l{k}", joint["X_parent_joint"]["R"],
            joint["X_parent_joint"]["p"], joint["axis"],
        )
        for k, x in enumerate(model["links"]) if (joint := x["joint"]) and k
    ]  # fmt: skip
    ends = [(f"l{x['link']}", x["point"]) for x in model["end_effectors"]]
    return with_frames(sdyn.Robot(links, joints), np.random.default_rng(0), ends)


@cache
def capacity() -> sdyn.Capacity:
    """The one capacity of all tests that are not about sizes; every structure of the table is over-capacity in it."""
    spare = tree((0,) * 31, [*("spherical",) * 4, *("fixed",) * 27])
    spare = with_frames(spare, np.random.default_rng(0), [("l0", np.zeros(3))] * 4)
    return sdyn.capacity([*map(robot, TABLE), spare])


# -- states ------------------------------------------------------------------------------------------------------------


class State(NamedTuple):
    """Arguments of the dynamics, one row for each state."""

    q: np.ndarray
    v: np.ndarray
    tau: np.ndarray
    gravity: np.ndarray
    f_ext: np.ndarray
    vdot: np.ndarray


def states(robot, seed="", count=STATES) -> State:
    """States in the exact layout; the third one rests at the identity pose."""
    rng = np.random.default_rng(zlib.crc32(seed.encode()))
    size = np.array([1.0, 1.0, 0.0, 4.0])[:count, None]
    q = size * rng.normal(size=(count, robot.nq))
    for at in quaternions(robot):
        q[:, at] = [unit(rng, 4) if x else [1.0, 0.0, 0.0, 0.0] for x in size[:, 0]]
    v = size * rng.normal(size=(count, robot.nv))
    tau, vdot = rng.normal(size=(2, count, robot.nv))
    gravity, f_ext = rng.normal(size=(count, 3)), rng.normal(size=(count, len(robot.links), 6))
    return State(q, v, tau, gravity, f_ext, vdot)


def quaternions(robot) -> list[slice]:
    """Where the quaternions are in q; the base's first."""
    out, at = ([] if robot.grounded else [slice(3, 7)]), 0 if robot.grounded else 7
    for joint in robot.moving:
        if joint.kind == "spherical":
            out.append(slice(at, at + 4))
        at += joint.nq
    return out


def q_rate(robot, q, v):
    """Time derivative of q: R v, 1/2 q o [0; w], rates."""
    out, nb = np.zeros_like(q), 0 if robot.grounded else 6
    qs, vs = quaternions(robot), [] if robot.grounded else [slice(0, 3)]
    at_q, at_v = (0, 0) if robot.grounded else (7, 6)
    if nb:
        out[:3] = matrix(q[3:7]) @ v[3:6]
    for joint in robot.moving:
        if joint.kind == "spherical":
            vs.append(slice(at_v, at_v + 3))
        else:
            out[at_q : at_q + joint.nq] = v[at_v : at_v + joint.dof]
        at_q, at_v = at_q + joint.nq, at_v + joint.dof
    for at, w in zip(qs, (v[x] for x in vs), strict=True):
        s, u = q[at][0], q[at][1:]
        out[at] = 0.5 * np.r_[-u @ w, s * w + np.cross(u, w)]
    return out


def matrix(quat):
    """Rotation matrix of a unit quaternion."""
    w, u = quat[0], quat[1:]
    U = np.array([[0, -u[2], u[1]], [u[2], 0, -u[0]], [-u[1], u[0], 0]])
    return np.eye(3) + 2 * w * U + 2 * U @ U


# -- packed ------------------------------------------------------------------------------------------------------------


@cache
def packed(name, dtype="float64") -> sdyn.Chain:
    """A robot of the table in the common capacity."""
    return sdyn.pack(robot(name), capacity(), dtype=dtype)


@cache
def state(name) -> State:
    """States of a robot of the table in the common capacity."""
    return padded(robot(name), packed(name), states(robot(name), name))


def padded(robot, chain, x: State) -> State:
    """States in the layout of the common capacity."""
    q, v = sdyn.pad(chain, x.q, x.v)
    tau, vdot = (sdyn.pad(chain, x.q, y)[1] for y in (x.tau, x.vdot))
    return State(q, v, tau, jnp.asarray(x.gravity, chain.dtype), on_links(robot, chain, x.f_ext), vdot)


def on_links(robot, chain, x):
    """Values of the links [..., n, k] at their numbers in the capacity, zero elsewhere."""
    names = chain.capacity.link_names
    at = [names.index(link.name) for link in robot.links]
    out = np.zeros((*x.shape[:-2], len(names), x.shape[-1]))
    out[..., at, :] = x
    return jnp.asarray(out, chain.dtype)


def links_of(robot) -> list[int]:
    """Numbers of the robot's links in the common capacity."""
    return [capacity().link_names.index(link.name) for link in robot.links]


def frames_of(robot) -> list[int]:
    """Numbers, in the common capacity, of the frames at the centres of mass."""
    return [capacity().frame_names.index("c" + link.name[1:]) for link in robot.links]


def real(robot) -> np.ndarray:
    """Which entries of v, in the layout of the common capacity, belong to the robot."""
    out, nb = np.zeros(6 + capacity().nv, bool), 0 if robot.grounded else 6
    out[:nb] = True
    out[6 : 6 + robot.nv - nb] = True
    return out


def on_states(f, **options):
    """f for one state, jitted for `STATES` of them that share the first argument, the structure."""
    return jax.jit(lambda *x: jax.vmap(f, (None, *(0,) * (len(x) - 1)))(*x), **options)


QUICKLY = dict(compiler_options={"xla_backend_optimization_level": 0})  # for what is compiled for one test only


def close(x, y, rtol, scale=None):
    """Whether the largest difference is at most rtol of the largest entry of y, and of `scale`.

    In the tests, rtol is about ten times the worst error that was measured; the comment behind the line says it.
    """
    x, y = np.asarray(x), np.asarray(y)
    assert x.shape == y.shape, f"shapes {x.shape} and {y.shape}"
    if y.size == 0:
        return
    size = max(np.abs(y).max(), 0.0 if scale is None else np.abs(scale).max())
    error = np.abs(x - y).max() / (size or 1.0)
    worst.append((sys._getframe(1).f_lineno, error, rtol))
    assert np.isfinite(x).all(), "an entry is not finite"
    assert error <= rtol, f"the largest difference is {error:.1e} of {size:.2e}; allowed is {rtol:.0e}"


worst = []  # line, error and tolerance of all comparisons so far
