"""The gate: a robot of names and parts becomes a chain of arrays, in NumPy until one transfer to the device."""

import jax
import numpy as np

from sdyn.chain import BaseRow, Capacity, Chain, JointRow, JointValue, LinkRow, SlotRow, name_hash
from sdyn.checks import RobotError
from sdyn.merge import derive
from sdyn.robot import Robot
from sdyn.schedule import schedule


def pack(robot: Robot, capacity: Capacity | None = None, *, width: int | None = None, dtype=None) -> Chain:
    """Pack a robot into arrays.

    Args:
        robot: The structure.
        capacity: Sizes to pad to, from `capacity([...])`; exact sizes if left out.
        width: Bodies in a step of the schedule, for exact sizes: 1 (default) is best for batches; about the number
            of arms is best for one sample at a time.
        dtype: float32 or float64; by default float64 where JAX has it switched on.

    Returns:
        The chain. A structure of the same capacity is the same compile key.

    Raises:
        RobotError: If a body without inertia hangs from a moving joint, a loop is open business, or the capacity is
            too small.
    """
    capacity = _capacity_of([robot], width or 1, padded=False) if capacity is None else capacity
    return jax.device_put(_arrays(robot, capacity, _float_type(dtype)))


def capacity(robots, *, width: int = 1) -> Capacity:
    """Sizes that hold any of the robots.

    Args:
        robots: The variants, at least one.
        width: Bodies in a step of the schedule.
    """
    robots = list(robots)
    if not robots:
        raise RobotError("capacity: the list of robots is empty.")
    return _capacity_of(robots, width, padded=True)


def family(robots, *, width: int = 1, dtype=None) -> Chain:
    """Robots packed to one capacity and stacked along a leading axis, for `vmap` over structures."""
    robots = list(robots)
    shared = capacity(robots, width=width)
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


def _capacity_of(robots, width, padded) -> Capacity:
    if width < 1:
        raise RobotError(f"the width is {width}; a step holds at least one body.")
    union = lambda key: tuple(dict.fromkeys(part.name for robot in robots for part in getattr(robot, key)))
    links, joints, frames = union("links"), union("joints"), union("frames")
    sizes = [_sizes(robot, width) for robot in robots]
    steps, nq, nv, quaternions = (max(column) for column in zip(*sizes, strict=True))
    layout = "padded" if padded else "grounded" if robots[0].grounded else "free"
    return Capacity(
        max(steps, 1), width, len(links), len(joints), len(frames), nq, nv, quaternions, layout, links, joints, frames
    )


def _sizes(robot, width):
    """Steps, entries of q, of v, quaternions."""
    moving = robot.moving
    return (
        len(schedule(_bodies(robot)[0], width)),
        sum(joint.nq for joint in moving),
        sum(joint.dof for joint in moving),
        sum(joint.kind == "spherical" for joint in moving),
    )


def _check_fits(robot, capacity, needs):
    """Refuse a robot whose names or sizes are not those of the capacity."""
    again = "make the capacity with this robot in the list"
    for key, names in (("link", capacity.link_names), ("joint", capacity.joint_names), ("frame", capacity.frame_names)):
        mine = [part.name for part in getattr(robot, key + "s")]
        at = {name: k for k, name in enumerate(names)}
        for name in mine:
            if name not in at:
                raise RobotError(f"pack: the capacity has no {key} {name!r}; {again}.")
        if key == "joint" and mine != sorted(mine, key=at.get):
            raise RobotError("pack: the robot declares its joints in another order than the capacity; keep one order.")
        if len({name_hash(name) for name in names}) < len(names):
            raise RobotError(f"pack: two {key}s have the same hash of their names, {list(names)}; rename one.")
    if capacity.layout != "padded" and (capacity.layout == "grounded") != robot.grounded:
        raise RobotError("pack: the capacity is the exact one of another robot; use sdyn.capacity([...]).")
    have = capacity.steps, capacity.nq, capacity.nv, capacity.quaternions
    for what, need, room in zip(("steps", "entries of q", "entries of v", "quaternions"), needs, have, strict=True):
        if need > room:
            raise RobotError(f"pack: the robot needs {need} {what} and the capacity has {room}; {again}.")


# ---- arrays ----------------------------------------------------------------------------------------------------------


def _bodies(robot):
    """The tree of bodies: one per degree of freedom, links locked together in one.

    Returns:
        Parent body of each body (-1 the base), (link, row of its joint's screws) of each, body of each link.
    """
    tree, parent, what = robot.tree, [], []
    body = [-1] * len(robot.links)
    for i in tree.order[1:]:
        joint = robot.joints[tree.joint[i]]
        body[i] = body[tree.parent[i]]
        if not robot.is_locked(joint):
            for k in range(joint.dof):
                parent.append(body[i])
                what.append((i, k))
                body[i] = len(parent) - 1
    return parent, what, body


def _arrays(robot: Robot, capacity: Capacity, dtype) -> Chain:
    """The chain of a robot, in NumPy."""
    if robot.loops:
        names = [loop.name for loop in robot.loops]
        raise RobotError(f"pack: the robot has the loops {names}; closed chains are not supported yet, open() them.")
    _check_fits(robot, capacity, _sizes(robot, capacity.width))
    parent, what, body = _bodies(robot)
    _check_inertia(robot, parent, what, body)
    joint_at = {name: k for k, name in enumerate(capacity.joint_names)}
    link_at = {name: k for k, name in enumerate(capacity.link_names)}
    joint_index, dof_value, dof_to_q, quats = _coordinates(robot, capacity, joint_at, link_at)
    steps = schedule(parent, capacity.width)

    W, slots = capacity.width, capacity.slots
    slot = {b: t * W + w for t, step in enumerate(steps) for w, b in enumerate(step)} | {-1: slots}
    slot_index, ancestors = _slot_index(robot, capacity, parent, what, slot, joint_at, link_at, joint_index, quats)
    link_index = _link_index(robot, capacity, body, slot, joint_at, link_at)
    joint_value = _joint_value(robot, capacity, joint_at)
    mass, com, inertia = _params(robot, capacity, link_at)
    slot_value, base, link_pose = derive(np, slot_index, link_index, joint_value, mass, com, inertia)
    frame_index, frame_value = _frames(robot, capacity, link_at)
    quat_index = np.full((3, capacity.quaternions), -1, np.int32)
    quat_index[:, : len(quats)] = np.array([x[:3] for x in quats.values()], np.int32).reshape(-1, 3).T
    base_value = np.concatenate([base, [0.0 if robot.grounded else 1.0], _ground(robot)])
    chain = Chain(
        slot_index, slot_value, base_value, ancestors, link_index, mass, com, inertia, link_pose, joint_index,
        joint_value, dof_value, quat_index, dof_to_q, frame_index, frame_value, capacity,
    )  # fmt: skip
    return jax.tree.map(lambda x: x.astype(dtype) if x.dtype.kind == "f" else x, chain)


def _check_inertia(robot, parent, what, body):
    """Refuse a moving joint with neither inertia beyond it nor a rotor: its acceleration is not determined."""
    heavy = [False] * (len(parent) + 1)
    for i, link in enumerate(robot.links):
        heavy[body[i]] |= link.mass > 0 or bool(link.inertia.any())
    for b in reversed(range(len(parent))):
        joint = robot.joints[robot.tree.joint[what[b][0]]]
        heavy[b] |= joint.rotor_inertia > 0
        if not heavy[b]:
            link = robot.links[what[b][0]].name
            raise RobotError(
                f"pack: link {link!r} and what hangs from it have no mass, so joint {joint.name!r} has no defined "
                f"acceleration; give the link mass, lock the joint, or give the joint a rotor_inertia."
            )
        heavy[parent[b]] |= heavy[b]
    if not heavy[-1] and not robot.grounded:
        raise RobotError(f"pack: the free robot has no mass at all; give link {robot.base!r} a mass, or ground it.")


def _coordinates(robot, capacity, joint_at, link_at):
    """joint_index, dof_value, dof_to_q, and {joint: (first of q, first of v, backwards)} of the quaternions."""
    index = np.zeros((9, capacity.joints), np.int32)
    index[JointRow.NAME] = [name_hash(name) for name in capacity.joint_names]
    values, to_q, quats, q, v = np.zeros((3, capacity.nv)), np.full(capacity.nv, -1, np.int32), {}, 0, 0
    for joint in robot.joints:
        k = joint_at[joint.name]
        index[[JointRow.PRESENT, JointRow.PARENT, JointRow.CHILD], k] = 1, link_at[joint.parent], link_at[joint.child]
        if robot.is_locked(joint):
            continue
        values[:, v : v + joint.dof] = np.array([[joint.damping, joint.stiffness, joint.rotor_inertia]]).T
        if joint.kind != "spherical":
            to_q[v : v + joint.dof] = np.arange(q, q + joint.dof)
        index[[JointRow.MOVES, JointRow.Q, JointRow.NQ, JointRow.V, JointRow.DOF], k] = 1, q, joint.nq, v, joint.dof
        if joint.kind == "spherical":
            i = robot.tree.joint.index(robot.joints.index(joint))
            quats[joint.name] = (q, v, int(not robot.tree.forward[i]))
        q, v = q + joint.nq, v + joint.dof
    return index, values, to_q, quats


def _slot_index(robot, capacity, parent, what, slot, joint_at, link_at, joint_index, quats):
    index = np.zeros((10, capacity.slots), np.int32)
    row, size = SlotRow, capacity
    index[row.PARENT], index[row.JOINT], index[row.FROM] = size.slots + 1, size.joints, size.links
    index[row.QUAT], index[row.SIGN], index[row.FORWARD] = size.quaternions, 1, 1
    first_v, v = {}, 0
    for joint in robot.moving:
        first_v[joint.name] = v
        v += joint.dof
    ancestors = np.zeros((capacity.slots, capacity.slots), bool)
    for b, (i, k) in enumerate(what):
        joint, ahead = robot.joints[robot.tree.joint[i]], robot.tree.forward[i]
        turned = joint.kind == "spherical"
        screw = k if ahead or turned else joint.dof - 1 - k  # traversed backwards, the screws come in reverse
        s = slot[b]
        index[row.PARENT, s], index[row.DOF, s] = slot[parent[b]], first_v[joint.name] + screw
        index[row.LIVE, s], index[row.FORWARD, s], index[row.FIRST, s] = 1, ahead, k == 0
        index[row.JOINT, s], index[row.SCREW, s] = joint_at[joint.name], screw
        index[row.SIGN, s] = 1 if ahead or turned else -1
        index[row.QUAT, s] = list(quats).index(joint.name) if turned and k == 0 else size.quaternions
        index[row.FROM, s] = link_at[robot.links[robot.tree.parent[i]].name]
        if parent[b] >= 0:
            ancestors[s] = ancestors[slot[parent[b]]]
        ancestors[s, s] = True
    return index.reshape(10, capacity.steps, capacity.width), ancestors


def _link_index(robot, capacity, body, slot, joint_at, link_at):
    index = np.zeros((6, capacity.links), np.int32)
    index[LinkRow.NAME] = [name_hash(name) for name in capacity.link_names]
    index[LinkRow.SLOT], index[LinkRow.PARENT] = capacity.slots + 1, capacity.links
    index[LinkRow.JOINT] = capacity.joints
    index[LinkRow.FORWARD] = 1
    for i, link in enumerate(robot.links):
        k, j = link_at[link.name], robot.tree.joint[i]
        index[LinkRow.SLOT, k] = slot[body[i]]
        if j < 0:
            continue
        joint = robot.joints[j]
        index[LinkRow.JOINT, k], index[LinkRow.FORWARD, k] = joint_at[joint.name], robot.tree.forward[i]
        index[LinkRow.PARENT, k] = link_at[robot.links[robot.tree.parent[i]].name]
        index[LinkRow.FIXED, k] = robot.is_locked(joint)
    return index


def _joint_value(robot, capacity, joint_at):
    values = np.zeros((capacity.joints, JointValue.SIZE))
    values[:, [0, 4, 8, JointValue.LOCK_QUAT]] = 1.0
    for joint in robot.joints:
        row = values[joint_at[joint.name]]
        row[:9], row[9:12] = joint.rotation.ravel(), joint.position
        row[JointValue.SCREWS : JointValue.SCREWS + 6 * joint.dof] = joint.screws.ravel()
        if joint.name in robot.locked:
            lock = JointValue.LOCK_QUAT if joint.kind == "spherical" else JointValue.LOCK
            row[lock : lock + joint.nq] = robot.locked[joint.name]
    return values


def _params(robot, capacity, link_at):
    at = [link_at[link.name] for link in robot.links]
    mass, com, inertia = np.zeros(capacity.links), np.zeros((capacity.links, 3)), np.zeros((capacity.links, 3, 3))
    mass[at] = [link.mass for link in robot.links]
    com[at] = [link.com for link in robot.links]
    inertia[at] = [link.inertia for link in robot.links]
    return mass, com, inertia


def _frames(robot, capacity, link_at):
    index, value = np.zeros((2, capacity.frames), np.int32), np.zeros((capacity.frames, 12))
    index[0], value[:, [0, 4, 8]] = [name_hash(name) for name in capacity.frame_names], 1.0
    index[1] = -1
    for frame in robot.frames:
        k = capacity.frame_names.index(frame.name)
        index[1, k] = link_at[frame.link]
        value[k] = np.concatenate([frame.rotation.ravel(), frame.position])
    return index, value


def _ground(robot):
    """Pose of a grounded base, [position, quaternion wxyz]."""
    R, p = robot.ground_pose
    t = np.array([1 + np.trace(R), *(1 - np.trace(R) + 2 * np.diag(R))])
    k = int(np.argmax(t))  # the largest of the four squares
    a = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    rows = np.zeros((4, 4))
    rows[0, 1:] = rows[1:, 0] = a
    rows[1:, 1:] = R + R.T
    rows[range(4), range(4)] = t
    return np.concatenate([p, rows[k] / np.linalg.norm(rows[k])])
