"""What happens to the state when the structure changes.

Poses continue: every link keeps its pose, joints are matched by name, and `after` takes lock values, ground pose and
the placement of new joints from the state. Velocities jump as in a plastic impact: v+ is the possible velocity that is
nearest in kinetic energy,
    M (v+ − v0) = Σ J_iᵀ I_i (V_i − J_i v0),
with I_i, V_i the inertia and twist of each original link before, and v0 the base's twist and the joint rates before.
Closures then stop what they hold of it: v ← v − (1 + e) M⁻¹ Kᵀ S K v, with the restitution e of the loops that are new.
Where the V_i are possible after the change (unlock, release, open, re-root) nothing jumps. Total momentum is kept where
nothing is grounded, and kinetic energy never grows.
"""

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sdyn.chain import BaseRow, Chain, ClosureRow, JointRow, JointValue, LinkRow, LoopRow
from sdyn.closures import at_links, closure_acceleration, frame_wrenches, frames_of, system_of
from sdyn.coordinates import pose_of
from sdyn.dynamics import solve_mass
from sdyn.inputs import expect
from sdyn.kinematics import jacobian_columns, link_motions, poses
from sdyn.merge import placement
from sdyn.momentum import link_momenta
from sdyn.params import rederived
from sdyn.rotation import from_matrix, normalised, product


def transfer(before, after, q, v, *, restitution=0.0):
    """The state of one variant, as the state of another variant of the same physical system.

    Args:
        before: Chain, or a tuple of chains that `after` attaches.
        after: Chain, or a tuple of chains that come from a detach.
        q, v: State of `before`; tuples if it is one.
        restitution: How fast the frames of a new loop part, as a fraction of how fast they met, 0 to 1; a locked joint
            and a grounded base stop.

    Returns:
        after: With lock values, ground pose, the placement of newly attached joints and the relative pose of new loops
            taken from the state; a new joint that moves starts at zero, and so does a loop that has a joint's kind.
        q, v: State of `after`; tuples if it is one.
        impulse: One impulsive wrench [n; f] per link of `after`, the one that reaches it through the joint to its
            parent in the tree (the base: through the ground), world axes, about the link's origin [N m s, N s]; then
            one per loop, on frame a and about its origin: [n + loops, 6].

    Differentiable in everything, forward and reverse.

    Source:
        formulas.md, "Loops" and "Momentum and capture": the jump of a plastic impact, in coordinates that hold it.
    """
    if not isinstance(before, tuple):
        before, q, v = (before,), (q,), (v,)
    world = _World(*map(jnp.concatenate, zip(*map(_world, before, q, v), strict=True)))
    if not isinstance(after, tuple):
        return _arrive(world, after, restitution)
    return tuple(zip(*(_arrive(world, chain, restitution) for chain in after), strict=True))


class _World(NamedTuple):
    """Links and joints before the change, of all chains."""

    link: Float[Array, " n"]
    """Hashes of the names, -1 where absent."""
    R: Float[Array, "n 3 3"]
    p: Float[Array, "n 3"]
    """Pose of each link in the world."""
    base: Float[Array, "n 4"]
    turn: Float[Array, "n 3 3"]
    """Quaternion of the base of its chain, and rotation of the link in it."""
    V: Float[Array, "n 6"]
    """Twist of each link about its own origin, world axes."""
    joint: Float[Array, " joints"]
    """Hashes of the names, -1 where absent; the last one is nobody's."""
    value: Float[Array, "joints 7"]
    """Coordinates as in the lock values of `Chain.joint_value`."""
    rate: Float[Array, "joints 3"]
    loop: Float[Array, " loops"]
    """Hashes of the names, -1 where absent; the last one is nobody's."""
    frames: Float[Array, "loops 24"]
    """Their frames, as in `Chain.loop_value`."""


def _world(chain: Chain, q, v) -> _World:
    q, v = expect(chain, q=q, v=v)
    pose = pose_of(chain, q)
    R, p, V, _ = link_motions(chain, pose, v, jnp.zeros_like(v))
    ground = chain.base_value[BaseRow.POSE + 3 :]
    nb, nv = chain.capacity.base_nq, chain.capacity.base_nv
    quat = normalised(jnp.where(chain.free == 1, q[3:7], ground) if nb else ground)
    at_origin = jnp.concatenate([V[:, :3], V[:, 3:] + jnp.cross(V[:, :3], p)], 1)
    world = (at_origin.reshape(-1, 2, 3) @ pose.R.T).reshape(-1, 6)
    present = chain.link_index[LinkRow.SLOT] <= chain.capacity.slots
    joint = chain.joint_index
    none = jnp.full((1,), -1, joint.dtype)
    pad = lambda x, like: jnp.concatenate([x, jnp.zeros((1, like), x.dtype)])
    return _World(
        jnp.where(present, chain.link_index[LinkRow.NAME], -1),
        pose.R @ R,
        pose.p + p @ pose.R.T,
        jnp.broadcast_to(quat, (len(R), 4)),
        R,
        world,
        jnp.concatenate([jnp.where(joint[JointRow.PRESENT] == 1, joint[JointRow.NAME], -1), none]),
        pad(_values(chain, q[nb:]), 7),
        pad(_gather(v[nv:], joint[JointRow.V], joint[JointRow.DOF], 3), 3),
        jnp.append(jnp.where(chain.loop_index[LoopRow.PRESENT] == 1, chain.loop_index[LoopRow.NAME], -1), -1),
        pad(chain.loop_value, 24),
    )


def _gather(x, start, count, width: int):
    """Rows [joints, width] of x from `start` on, zero behind `count`."""
    at = start[:, None] + jnp.arange(width)
    x = jnp.concatenate([x, jnp.zeros(width, x.dtype)])
    return jnp.where(jnp.arange(width) < count[:, None], x[jnp.where(at < len(x), at, 0)], 0)


def _values(chain, q):
    """Coordinates of all joints, moving ones from q and locked ones from their lock values."""
    joint = chain.joint_index
    x = _gather(q, joint[JointRow.Q], joint[JointRow.NQ], 4)
    quat = (joint[JointRow.NQ] == 4)[:, None]
    one = jnp.array([1.0, 0, 0, 0], q.dtype)
    moving = jnp.concatenate([jnp.where(quat, 0, x[:, :3]), jnp.where(quat, x, one)], 1)
    return jnp.where(joint[JointRow.MOVES][:, None] == 1, moving, chain.joint_value[:, JointValue.LOCK :])


def _arrive(world: _World, chain: Chain, restitution):
    """The part of the world that is `chain`: (chain, q, v, impulse)."""
    link = _match(chain.link_index[LinkRow.NAME], world.link)
    joint = _match(chain.joint_index[JointRow.NAME], world.joint)
    known = jnp.any(chain.joint_index[JointRow.NAME][:, None] == world.joint, 1)
    R, p, V = (x[link] for x in (world.R, world.p, world.V))
    R, p, V = _new_links(world, chain, R, p, V)
    chain = _carry(chain, world.value[joint], known, R, p)
    held = jnp.any(chain.loop_index[LoopRow.NAME][:, None] == world.loop, 1)
    frames = world.frames[_match(chain.loop_index[LoopRow.NAME], world.loop)]
    chain = replace(chain, loop_value=jnp.where(held[:, None], frames, _closed(chain, R, p)))

    slot, parent = chain.link_index[LinkRow.SLOT], chain.link_index[LinkRow.PARENT]
    base = jnp.argmax((slot == chain.capacity.slots) & (parent == len(R)))
    quat = product(world.base[link][base], from_matrix(world.turn[link][base]))
    base_value = chain.base_value.at[BaseRow.POSE :].set(jnp.concatenate([p[base], quat]))
    chain = replace(chain, base_value=base_value)

    q, v = _state(chain, base_value[BaseRow.POSE :], R[base], V[base], world.rate[joint] * known[:, None])
    v, impulse = _jump(chain, q, v, R, p, V, held, restitution)
    return chain, q, v, impulse


def _match(names, others):
    """Numbers of the names among the others; 0 where a name is not there."""
    return jnp.argmax(names[:, None] == others, 1)


def _new_links(world, chain, R, p, V):
    """A link that was nowhere before (a fixture) stands and moves with the link that its fixed joint mounts it on."""
    known = jnp.any(chain.link_index[LinkRow.NAME][:, None] == world.link, 1)
    parent, child = chain.joint_index[JointRow.PARENT], chain.joint_index[JointRow.CHILD]
    present = chain.joint_index[JointRow.PRESENT] == 1
    place_R, place_p = placement(chain.joint_value)
    at = jnp.where(present & known[parent] & ~known[child], child, len(R))
    arm = (R[parent] @ place_p[..., None])[..., 0]
    turned = jnp.concatenate([V[parent][:, :3], V[parent][:, 3:] + jnp.cross(V[parent][:, :3], arm)], 1)
    return tuple(x.at[at].set(y, mode="drop") for x, y in ((R, R[parent] @ place_R), (p, p[parent] + arm), (V, turned)))


def _carry(chain, value, known, R, p):
    """The chain with the lock values of the state, and new joints placed where their links are."""
    parent, child = chain.joint_index[JointRow.PARENT], chain.joint_index[JointRow.CHILD]
    back = jnp.swapaxes(R[parent], 1, 2)
    there = jnp.concatenate([(back @ R[child]).reshape(-1, 9), (back @ (p[child] - p[parent])[..., None])[..., 0]], 1)
    old = chain.joint_value
    screws, quat = old[:, JointValue.SCREWS : JointValue.LOCK], old[:, JointValue.LOCK_QUAT :]
    new = jnp.concatenate([there, screws, jnp.zeros_like(old[:, :3]), quat], 1)
    rows = jnp.where(known[:, None], jnp.concatenate([old[:, : JointValue.LOCK], value], 1), new)
    present = chain.joint_index[JointRow.PRESENT][:, None] == 1
    return rederived(replace(chain, joint_value=jnp.where(present, rows, old)))


def _closed(chain, R, p):
    """The frames of the loops with frame b moved to where frame a is."""
    eye = jnp.eye(3, dtype=R.dtype)[None]
    R, p = jnp.concatenate([R, eye]), jnp.concatenate([p, jnp.zeros((1, 3), p.dtype)])
    a, b, frame = chain.loop_index[LoopRow.A], chain.loop_index[LoopRow.B], chain.loop_value[:, :12]
    back = jnp.swapaxes(R[b], 1, 2)
    x = p[a] + (R[a] @ frame[:, 9:, None])[..., 0] - p[b]
    turned = back @ R[a] @ frame[:, :9].reshape(-1, 3, 3)
    return jnp.concatenate([frame, turned.reshape(-1, 9), (back @ x[..., None])[..., 0]], 1)


def _state(chain, base_pose, R, V, rate):
    """q after the change, and the guess v0 from the base's twist and the joint rates."""
    joint, nb, nv = chain.joint_index, chain.capacity.base_nq, chain.capacity.base_nv
    value = chain.joint_value[:, JointValue.LOCK :]
    value = jnp.where((joint[JointRow.NQ] == 4)[:, None], value[:, 3:], jnp.pad(value[:, :3], ((0, 0), (0, 1))))
    at_q = _places(joint[JointRow.Q], joint[JointRow.NQ], 4, nb, chain.nq)
    at_v = _places(joint[JointRow.V], joint[JointRow.DOF], 3, nv, chain.nv)
    q = jnp.zeros(chain.nq, value.dtype).at[at_q].set(value, mode="drop")
    v = jnp.zeros(chain.nv, value.dtype).at[at_v].set(rate, mode="drop")
    if nb:
        twist = jnp.concatenate([R.T @ V[:3], R.T @ V[3:]]) * chain.base_value[BaseRow.FREE]
        q, v = q.at[:7].set(base_pose), v.at[:6].set(twist)
    return q, v


def _places(start, count, width: int, first: int, size: int):
    """Where the entries of each joint go, `size` for those that go nowhere."""
    at = first + start[:, None] + jnp.arange(width)
    return jnp.where(jnp.arange(width) < count[:, None], at, size)


def _jump(chain, q, v0, R, p, V, held, restitution):
    """v after the impact, and the impulsive wrench that reaches each link and each loop."""
    pose, index = pose_of(chain, q), chain.link_index
    # twists before, about the base's origin and in its axes
    w, u = V[:, :3], V[:, 3:] + jnp.cross(V[:, :3], pose.p - p)
    V = jnp.concatenate([w @ pose.R, u @ pose.R], 1)
    present = (index[LinkRow.SLOT] <= chain.capacity.slots)[:, None]
    Rb, pb, V0, _ = link_motions(chain, pose, v0, jnp.zeros_like(v0))
    slots, S = poses(chain.slot_index, chain.slot_value[..., None], pose.q, pose.quat)
    J = jacobian_columns(chain, pose, S[..., 0], index[LinkRow.SLOT])
    h = jnp.where(present, link_momenta(chain, Rb, pb, V - V0), 0)
    dv = solve_mass(chain, q, jnp.einsum("nkv,nk->v", J, h))
    about = lambda F, x: jnp.concatenate([(F[:, :3] - jnp.cross(x, F[:, 3:])) @ pose.R.T, F[:, 3:] @ pose.R.T], 1)
    of_loops = jnp.zeros((0, 6), q.dtype)
    if chain.capacity.rows:
        more, lam = _stop(chain, q, v0 + dv, held, restitution)
        ends, dv = frames_of(chain, pose, slots[..., 0]), dv + more
        F = frame_wrenches(chain, ends, lam)
        h, of_loops = h + at_links(chain, F), about(F, ends.xa.T)
    dh = jnp.where(present, link_momenta(chain, Rb, pb, jnp.einsum("nkv,v->nk", J, dv)), 0) - h
    of_links = about(_subtree_sums(index[LinkRow.PARENT], dh), pb)
    return v0 + dv, jnp.concatenate([of_links, of_loops])


def _stop(chain, q, v, held, restitution):
    """What closures change of v, and their impulses: first those that were there before, then all, with restitution.

    The rates at which new loops meet are those that the old ones allow; one factor for all of them keeps energy from
    growing.
    """
    new = ~held[chain.row_index[ClosureRow.LOOP]]
    still = jnp.zeros_like(v)
    meeting = lambda v: closure_acceleration(chain, q, still, v)
    first, old = system_of(chain, q, new.astype(q.dtype)).solve(still, -meeting(v))
    more, lam = system_of(chain, q).solve(still, -(1 + restitution) * meeting(v + first))
    return first + more, old + lam


def _subtree_sums(parent, x):
    """Sums over the subtrees, in log2(n) rounds: each round adds the links that are twice as far below."""
    n = len(x)
    x, pointer = jnp.concatenate([x, jnp.zeros((1, 6), x.dtype)]), jnp.append(parent, n)
    for _ in range(n.bit_length()):
        x, pointer = x.at[jnp.where(pointer < n, pointer, n + 1)].add(x, mode="drop"), pointer[pointer]
    return x[:n]
