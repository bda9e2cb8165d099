"""The gate: a robot of names and parts becomes a chain of arrays, in NumPy until one transfer to the device."""

from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np

from sdyn.chain import BaseRow, Capacity, Chain, JointRow, JointValue, LinkRow, LoopRow, SlotRow
from sdyn.checks import RobotError
from sdyn.doctor import refuse_loose
from sdyn.heaviest import better_base
from sdyn.merge import derive
from sdyn.parts import CLOSURES
from sdyn.robot import GROUND, Robot
from sdyn.schedule import schedule

MEMORY = 2e9
"""Bytes that packing may take; they grow with the square of the bodies. A chain of 10 000 joints takes half of them."""
FRAMES = ("common", "link")
"""Where dynamics are computed."""


def pack(
    robot: Robot, capacity: Capacity | None = None, *, width: int | None = None, frame: str = "common", dtype=None
) -> Chain:
    """Pack a robot into arrays.

    Args:
        robot: The structure.
        capacity: Sizes to pad to, from `capacity([...])`; exact sizes if left out.
        width: Bodies in a step of the schedule, for exact sizes: 1 (default) is best for batches; about the number
            of arms is best for one sample at a time.
        frame: Where dynamics are computed, for exact sizes: in the base's "common" frame, or in each "link"'s, which
            takes up to a sixth longer and loses fewer digits far from the base, of float32 above all; derivatives and
            closures are computed in the common one, so gradients take longer, and so are poses, velocities and
            accelerations of frames, which lose nothing there.
        dtype: float32 or float64; by default float64 where JAX has it switched on.

    Returns:
        The chain. A structure of the same capacity is the same compile key.

    Raises:
        RobotError: If nothing resists the motion of a joint or of a free base, or the capacity is too small.
    """
    capacity = _capacity_of([robot], width or 1, frame, padded=False) if capacity is None else capacity
    return jax.device_put(_arrays(robot, capacity, _float_type(dtype)))


def capacity(robots, *, width: int = 1, frame: str = "common", memory: float = MEMORY) -> Capacity:
    """Sizes that hold any of the robots.

    Args:
        robots: The variants, at least one.
        width: Bodies in a step of the schedule.
        frame: Where dynamics are computed, see `pack`.
        memory: What packing one of them may take [bytes].

    Raises:
        RobotError: If it would take more; `pack` without a capacity has the same limit.
    """
    robots = list(robots)
    if not robots:
        raise RobotError("capacity: the list of robots is empty.")
    return _capacity_of(robots, width, frame, padded=True, memory=memory)


def family(robots, *, width: int = 1, frame: str = "common", dtype=None) -> Chain:
    """Robots packed to one capacity and stacked along a leading axis, for `vmap` over structures.

    Each structure is a loop of its own, so a sample takes about three times as long as in a batch that shares one
    (37 DOF, batch 64; where only parameters differ 1.4 times, see benchmarks/growth.py).

    Args:
        robots: The variants, at least one.
        width: Bodies in a step of the schedule.
        frame: Where dynamics are computed, see `pack`.
        dtype: float32 or float64, as for `pack`.
    """
    robots = list(robots)
    shared = capacity(robots, width=width, frame=frame)
    chains = [_arrays(robot, shared, _float_type(dtype)) for robot in robots]
    return jax.device_put(jax.tree.map(lambda *x: np.stack(x), *chains))


def pad(chain: Chain, q, v):
    """Exact coordinates of a robot in the layout of its capacity: base block, moving joints, zeros.

    Args:
        chain: Packed with a capacity; concrete, not traced.
        q, v: Exact coordinates [..., nq], [..., nv] of the robot.
    """
    base, nq, nv = _counts(chain, "pad")
    q, v = np.asarray(q), np.asarray(v)
    for x, want, what in ((q, nq + 7 * base, "q"), (v, nv + 6 * base, "v")):
        if x.shape[-1] != want:
            raise ValueError(f"pad: {what} has {x.shape[-1]} entries; the robot has {want}.")
    lead, size = q.shape[:-1], chain.capacity
    if not base:
        q = np.concatenate([np.broadcast_to(np.asarray(chain.base_value)[BaseRow.POSE :], (*lead, 7)), q], -1)
        v = np.concatenate([np.zeros((*lead, 6)), v], -1)
    fill = lambda x, n: np.concatenate([x, np.zeros((*lead, n - x.shape[-1]))], -1)
    return tuple(jax.device_put(fill(x, n).astype(chain.dtype)) for x, n in ((q, 7 + size.nq), (v, 6 + size.nv)))


def unpad(chain: Chain, q, v):
    """The exact coordinates of the robot, from the layout of its capacity; the inverse of `pad`."""
    base, nq, nv = _counts(chain, "unpad")
    return (q if base else q[..., 7:])[..., : nq + 7 * base], (v if base else v[..., 6:])[..., : nv + 6 * base]


def _counts(chain, what):
    """Whether the base is free, and the entries of q and v of its moving joints."""
    if chain.capacity.layout != "padded":
        raise ValueError(f"{what}: the chain has exact sizes already; this is for chains packed with a capacity.")
    if isinstance(chain.joint_index, jax.core.Tracer):
        raise ValueError(f"{what}: the chain is traced, so its sizes are not known; call {what} outside of jit.")
    joints = np.asarray(chain.joint_index)
    return bool(chain.free), int(joints[JointRow.NQ].sum()), int(joints[JointRow.DOF].sum())


def _float_type(dtype):
    """The type asked for, or JAX's own default."""
    found = jax.dtypes.canonicalize_dtype(dtype or float)
    if dtype is not None and (found != np.dtype(dtype) or found.kind != "f"):
        raise ValueError(
            f"pack: the type {np.dtype(dtype)} is not to be had; use float32, or float64 after "
            f"jax.config.update('jax_enable_x64', True)."
        )
    return found


# ---- sizes -----------------------------------------------------------------------------------------------------------


def _capacity_of(robots, width, frame, padded, memory=MEMORY) -> Capacity:
    if frame not in FRAMES:
        raise RobotError(f'pack: the frame is {frame!r}; it is "common" or "link".')
    if width < 1:
        raise RobotError(f"the width is {width}; a step holds at least one body.")
    bodies = max(sum(joint.dof for joint in robot.moving) for robot in robots)
    most = bodies * (bodies + 8 * max(len(robot.links) for robot in robots))  # `Chain.ancestors`, and in `merge.derive`
    if most > memory:
        raise RobotError(
            f"pack: {bodies} bodies take {most / 1e9:.3g} GB, and {memory / 1e9:.3g} GB are allowed; lock joints, or "
            f"make the capacity with memory={most:.2g}."
        )
    union = lambda key: tuple(dict.fromkeys(part.name for robot in robots for part in getattr(robot, key)))
    links, joints, frames, loops = (union(key) for key in ("links", "joints", "frames", "loops"))
    others = [robot.reroot(base) for robot in robots if (base := better_base(robot))]
    sizes = [_sizes(robot, len(schedule(_bodies(robot).parent, width))) for robot in (*robots, *others)]
    steps, nq, nv, quaternions, rows = (max(column) for column in zip(*sizes, strict=True))
    layout = "padded" if padded else "grounded" if robots[0].grounded else "free"
    return Capacity(
        max(steps, 1), width, len(links), len(joints), len(frames), nq, nv, quaternions, len(loops), rows,
        frame, layout, links, joints, frames, loops, bool(others),
    )  # fmt: skip


def _sizes(robot, steps):
    """Steps, entries of q, of v, quaternions, rows of closures."""
    moving = robot.moving
    return (
        steps,
        sum(joint.nq for joint in moving),
        sum(joint.dof for joint in moving),
        sum(joint.kind == "spherical" for joint in moving),
        sum(len(CLOSURES[loop.kind]) for loop in robot.loops),
    )


def _check_fits(robot, capacity, needs):
    """Refuse a robot whose names or sizes are not those of the capacity."""
    again = "make the capacity with this robot in the list"
    for key, at in capacity.numbers.items():
        for part in getattr(robot, key + "s"):
            if part.name not in at:
                raise RobotError(f"pack: the capacity has no {key} {part.name!r}; {again}.")
    order = [capacity.numbers["joint"][joint.name] for joint in robot.joints]
    if order != sorted(order):
        raise RobotError("pack: the robot declares its joints in another order than the capacity; keep one order.")
    if capacity.layout != "padded" and (capacity.layout == "grounded") != robot.grounded:
        raise RobotError("pack: the capacity is the exact one of another robot; use sdyn.capacity([...]).")
    have = capacity.steps, capacity.nq, capacity.nv, capacity.quaternions, capacity.rows
    kinds = "steps", "entries of q", "entries of v", "quaternions", "rows of closures"
    if better_base(robot) and not capacity.rebased and capacity.layout == "padded":
        raise RobotError(f"pack: base {robot.base!r} is too light, and the capacity has no room for another; {again}.")
    for what, need, room in zip(kinds, needs, have, strict=True):
        if need > room:
            raise RobotError(f"pack: the robot needs {need} {what} and the capacity has {room}; {again}.")


# ---- bodies ----------------------------------------------------------------------------------------------------------


class Bodies(NamedTuple):
    """The tree of bodies: one per degree of freedom, links locked together in one; the base is body -1."""

    parent: list[int]
    """The body that each hangs from."""
    link: list[int]
    """The link whose joint it belongs to."""
    screw: list[int]
    """Which degree of freedom of that joint it is, counted from the base outwards."""
    of_link: list[int]
    """The body that each link is part of."""


def _bodies(robot) -> Bodies:
    tree, parent, link, screw = robot.tree, [], [], []
    of_link = [-1] * len(robot.links)
    for i in tree.order[1:]:
        j = tree.joint[i]
        of_link[i] = of_link[tree.parent[i]]
        if robot.moves[j]:
            for k in range(robot.joints[j].dof):
                parent.append(of_link[i])
                link.append(i)
                screw.append(k)
                of_link[i] = len(parent) - 1
    return Bodies(parent, link, screw, of_link)


# ---- arrays ----------------------------------------------------------------------------------------------------------


def _arrays(robot: Robot, capacity: Capacity, dtype) -> Chain:
    """The chain of a robot, in NumPy."""
    bodies = _bodies(robot)
    steps = schedule(bodies.parent, capacity.width)
    _check_fits(robot, capacity, _sizes(robot, len(steps)))
    refuse_loose(robot)

    # where the robot's links, joints and bodies are in the arrays; the last entry, also number -1, stands for none
    links, joints = capacity.numbers["link"], capacity.numbers["joint"]
    link_at = np.array([*(links[link.name] for link in robot.links), capacity.links])
    joint_at = np.array([*(joints[joint.name] for joint in robot.joints), capacity.joints])
    slot = np.full(len(bodies.parent) + 1, capacity.slots)
    for t, step in enumerate(steps):
        for w, body in enumerate(step):
            slot[body] = t * capacity.width + w

    joint_index, dof_value, dof_to_q, quat_index = _coordinates(robot, capacity, joint_at)
    slot_index, ancestors = _slot_index(robot, capacity, bodies, slot, link_at, joint_at, joint_index)
    link_index = _link_index(robot, capacity, slot[bodies.of_link], link_at, joint_at)
    joint_value = _joint_value(robot, capacity, joint_at)
    mass, com, inertia = _params(robot, capacity, link_at)
    slot_value, base, link_pose = derive(np, slot_index, link_index, joint_value, mass, com, inertia)
    frame_index, frame_value = _frames(robot, capacity)
    loops = _loops(robot, capacity)
    base_value = np.concatenate([base, [0.0 if robot.grounded else 1.0], _ground(robot)])
    packed = Chain(
        slot_index, slot_value, base_value, ancestors, link_index, mass, com, inertia, link_pose, joint_index,
        joint_value, dof_value, quat_index, dof_to_q, frame_index, frame_value, *loops, capacity,
    )  # fmt: skip
    if capacity.rebased:
        inner = _arrays(robot.reroot(better_base(robot) or robot.base), replace(capacity, rebased=False), dtype)
        packed = replace(packed, inner=inner)
    with np.errstate(over="ignore"):
        packed = jax.tree.map(lambda x: x.astype(dtype) if x.dtype.kind == "f" else x, packed)
    if not all(np.isfinite(x).all() for x in (packed.slot_value, packed.base_value, packed.link_inertia)):
        raise RobotError(f"pack: a mass, an inertia or a length is beyond {dtype}; pack with dtype=float64.")
    return packed


def _coordinates(robot, capacity, joint_at):
    """joint_index, dof_value, dof_to_q and quat_index."""
    joints, at, links, row = robot.joints, joint_at[:-1], capacity.numbers["link"], JointRow
    moves = np.array(robot.moves, int)
    nq = moves * np.array([joint.nq for joint in joints], int)
    dof = moves * np.array([joint.dof for joint in joints], int)
    q, v = moves * (np.cumsum(nq) - nq), moves * (np.cumsum(dof) - dof)
    index = np.zeros((9, capacity.joints), np.int32)
    index[row.NAME] = capacity.hashes["joint"]
    index[row.PRESENT, at], index[row.MOVES, at] = 1, moves
    index[row.Q, at], index[row.NQ, at], index[row.V, at], index[row.DOF, at] = q, nq, v, dof
    index[row.PARENT, at] = [links[joint.parent] for joint in joints]
    index[row.CHILD, at] = [links[joint.child] for joint in joints]

    value, to_q = np.zeros((3, capacity.nv)), np.full(capacity.nv, -1, np.int32)
    of, n = np.repeat(np.arange(len(joints)), dof), dof.sum()  # the joint of each degree of freedom; their number
    value[:, :n] = np.array([(x.damping, x.stiffness, x.rotor_inertia) for x in joints]).reshape(-1, 3)[of].T
    to_q[:n] = np.where((nq > dof)[of], -1, (q - v)[of] + np.arange(n))

    quat, spherical = np.full((3, capacity.quaternions), -1, np.int32), np.flatnonzero(nq > dof)
    backwards = np.zeros(len(joint_at), bool)
    backwards[list(robot.tree.joint)] = np.logical_not(robot.tree.forward)
    quat[:, : len(spherical)] = q[spherical], v[spherical], backwards[spherical]
    return index, value, to_q, quat


def _slot_index(robot, capacity, bodies, slot, link_at, joint_at, joint_index):
    """slot_index and ancestors."""
    tree, row = robot.tree, SlotRow
    index = np.zeros((10, capacity.slots), np.int32)
    index[row.PARENT], index[row.JOINT], index[row.FROM] = capacity.slots + 1, capacity.joints, capacity.links
    index[row.QUAT], index[row.SIGN], index[row.FORWARD] = capacity.quaternions, 1, 1

    s, (parent, link, k) = slot[:-1], (np.array(x, int) for x in (bodies.parent, bodies.link, bodies.screw))
    joint, ahead = joint_at[np.array(tree.joint)[link]], np.array(tree.forward)[link]
    spherical = joint_index[JointRow.NQ] > joint_index[JointRow.DOF]
    straight = ahead | spherical[joint]  # traversed backwards, screws come in reverse and turn the other way
    screw = np.where(straight, k, joint_index[JointRow.DOF, joint] - 1 - k)
    quat = np.where(spherical[joint] & (k == 0), np.cumsum(spherical)[joint] - 1, capacity.quaternions)
    index[row.PARENT, s], index[row.FROM, s] = slot[parent], link_at[np.array(tree.parent)[link]]
    index[row.DOF, s], index[row.QUAT, s] = joint_index[JointRow.V, joint] + screw, quat
    index[row.JOINT, s], index[row.SCREW, s], index[row.SIGN, s] = joint, screw, np.where(straight, 1, -1)
    index[row.LIVE, s], index[row.FORWARD, s], index[row.FIRST, s] = 1, ahead, k == 0

    ancestors = np.zeros((capacity.slots + 1, capacity.slots), bool)  # the last row is the base's
    ancestors[s, s] = True
    for b, p in zip(s, slot[parent], strict=True):
        ancestors[b] |= ancestors[p]
    return index.reshape(10, capacity.steps, capacity.width), ancestors[:-1]


def _link_index(robot, capacity, slot, link_at, joint_at):
    """link_index; `slot` is that of each link's body."""
    row, (parent, joint) = LinkRow, (np.array(x) for x in (robot.tree.parent, robot.tree.joint))
    locked = np.array([*(not x for x in robot.moves), False])
    index, at = np.zeros((6, capacity.links), np.int32), link_at[:-1]
    index[row.NAME], index[row.FORWARD] = capacity.hashes["link"], 1
    index[row.SLOT], index[row.PARENT], index[row.JOINT] = capacity.slots + 1, capacity.links, capacity.joints
    index[row.SLOT, at], index[row.PARENT, at], index[row.JOINT, at] = slot, link_at[parent], joint_at[joint]
    index[row.FORWARD, at], index[row.FIXED, at] = robot.tree.forward, locked[joint]
    return index


def _joint_value(robot, capacity, joint_at):
    values = np.zeros((capacity.joints, JointValue.SIZE))
    values[:, [0, 4, 8, JointValue.LOCK_QUAT]] = 1.0
    if robot.joints:
        constants = np.concatenate([joint.constants for joint in robot.joints])
        values[joint_at[:-1], : JointValue.LOCK] = constants.reshape(-1, JointValue.LOCK)
    for name, value in robot.locked.items():
        first = JointValue.LOCK if len(value) < 4 else JointValue.LOCK_QUAT
        values[capacity.numbers["joint"][name], first : first + len(value)] = value
    return values


def _params(robot, capacity, link_at):
    mass, com, inertia = np.zeros(capacity.links), np.zeros((capacity.links, 3)), np.zeros((capacity.links, 3, 3))
    mass[link_at[:-1]] = [link.mass for link in robot.links]
    com[link_at[:-1]] = [link.com for link in robot.links]
    inertia[link_at[:-1]] = [link.inertia for link in robot.links]
    return mass, com, inertia


def _frames(robot, capacity):
    index, value = np.zeros((2, capacity.frames), np.int32), np.zeros((capacity.frames, 12))
    index[0], value[:, [0, 4, 8]] = capacity.hashes["frame"], 1.0
    index[1] = -1
    for frame in robot.frames:
        k = capacity.numbers["frame"][frame.name]
        index[1, k] = capacity.numbers["link"][frame.link]
        value[k, :9], value[k, 9:] = frame.rotation.ravel(), frame.position
    return index, value


def _loops(robot, capacity):
    """loop_index, loop_value, row_index; an absent loop joins the ground to itself, and has no live row."""
    index, value = np.zeros((4, capacity.loops), np.int32), np.zeros((capacity.loops, 24))
    index[LoopRow.NAME] = capacity.hashes["loop"]
    index[[LoopRow.A, LoopRow.B]] = capacity.links
    value[:, [0, 4, 8, 12, 16, 20]] = 1.0
    links, numbers = capacity.numbers["link"] | {GROUND: capacity.links}, capacity.numbers["loop"]
    rows = []
    for loop in sorted(robot.loops, key=lambda loop: numbers[loop.name]):
        k, (a, b) = numbers[loop.name], (loop.frame_a, loop.frame_b)
        index[1:, k] = 1, links[a.link], links[b.link]
        value[k] = np.concatenate([a.rotation.ravel(), a.position, b.rotation.ravel(), b.position])
        rows += [(k, part, 1) for part in CLOSURES[loop.kind]]
    row_index = np.zeros((3, capacity.rows), np.int32)
    row_index[:, : len(rows)] = np.array(rows, np.int32).reshape(-1, 3).T
    return index, value, row_index


def _ground(robot):
    """Pose of a grounded base, [position, quaternion wxyz]."""
    R, p = robot.ground_pose
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    M = np.array([  # 4 quat quatᵀ
        [1 + a + e + i, h - f, c - g, d - b],
        [h - f, 1 + a - e - i, b + d, c + g],
        [c - g, b + d, 1 - a + e - i, f + h],
        [d - b, c + g, f + h, 1 - a - e + i],
    ])  # fmt: skip
    row = M[M.diagonal().argmax()]
    return np.concatenate([p, row / np.linalg.norm(row)])
