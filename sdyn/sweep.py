"""What the sweeps over a chain share: the order of the bodies, storage by slot, and the bodies in the base's frame.

All quantities are in the base's own frame (the ground's, seen from the base, when it is grounded): inertias add up
without transforms and nothing depends on the pose of the base. The values, not the derivatives, of dynamics exist in
the links' own frames too, slower and more exact far from the base. Arrays are `(components, W, *B)` inside a step and
`(slots + 2, components, *B)` between steps; the last two slots are the base and a dummy. B is the batch: one axis, or
two where many columns share a sample.

What makes a step fast: many rows of B in few elementwise operations; a concatenation is stored (`keep`) before it is
used; a parent's value that several operations read is stored too, or XLA copies the whole storage in every step.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from sdyn.chain import BaseRow, SlotRow, ValueRow
from sdyn.materialise import keep
from sdyn.rotation import matrix
from sdyn.spatial import cat, cross, mm, motion_cross, mv, rigid_inertia, to_child, to_parent
from sdyn.trigonometry import sin_cos
from sdyn.workspace import Workspace


def batch_of(*operands, axes: int = 1) -> tuple[int, ...]:
    """The batch sizes of operands whose last axes are the batch, or 1 where it shares them."""
    return np.broadcast_shapes(*(x.shape[-axes:] for x in operands))


# ---- the order of the bodies -----------------------------------------------------------------------------------------


class Walk(NamedTuple):
    """The order in which sweeps visit the bodies."""

    parent: jnp.ndarray
    """Slot of the parent of each body [T, W]."""
    dof: jnp.ndarray
    live: jnp.ndarray
    """Degree of freedom, and whether there is a body [T, W]."""
    steps: int | jnp.ndarray
    """How many steps to take: those that hold bodies, which is data; all, a number, where JAX transposes the sweep."""
    work: Workspace
    """Where storages come from."""

    @property
    def width(self) -> int:
        """Bodies in a step."""
        return self.parent.shape[1]

    @property
    def slots(self) -> int:
        """Slots of bodies other than the base."""
        return self.parent.size

    def outward(self, body, stored):
        """Storage after `body(t, parents, stored) -> stored` in every step, from the base to the tips."""
        return self._loop(lambda i: i, body, stored)

    def inward(self, body, stored):
        """The same, from the tips to the base."""
        return self._loop(lambda i: self.steps - 1 - i, body, stored)

    def _loop(self, step, body, stored):
        def run(i, stored):
            t = step(i)
            return body(t, keep(at(self.parent, t)), stored)

        found = lax.fori_loop(0, self.steps, run, stored)
        return jax.tree.map(self.work.updated, stored, found)

    def empty(self, components: int, B: tuple, dtype, base=0, dummy=0):
        """Storage by slot without values, but for those of the base and of the dummy [components, *B]."""
        x = self.work.empty((self.slots + 2, components, *B), dtype)
        return self.work.updated(x, x.at[self.slots].set(base).at[self.slots + 1].set(dummy))

    def cleared(self, x):
        """A storage with zeros where there is no body, for others to read."""
        there = jnp.append(self.live.reshape(-1), jnp.array([True, True]))  # the base and the dummy have values
        return jnp.where(there.reshape(-1, *(1,) * (x.ndim - 1)), x, 0)

    def zeros(self, components: int, B: tuple, dtype):
        """Storage by slot, zero."""
        zero = keep(jnp.zeros((), dtype))  # one of its own: XLA would fill one storage and copy it to the others
        return jnp.broadcast_to(zero, (self.slots + 2, components, *B))

    def of_step(self, x, t):
        """Values (W, *B) of the degrees of freedom of step t, from those of all (nv, *B); zero in empty slots."""
        if x.shape[0] == 0:
            return jnp.zeros((self.width, *x.shape[1:]), x.dtype)
        live = at(self.live, t).reshape(-1, *(1,) * (x.ndim - 1))
        return keep(jnp.stack([at(x, k) for k in keep(at(self.dof, t))]) * live.astype(x.dtype))

    def dofs(self, nv: int, B: tuple, dtype):
        """Empty storage by degree of freedom; its last row is nobody's."""
        return jnp.zeros((nv + 1, *B), dtype)

    def put_dof(self, stored, t, x):
        """Store the values (W, B) of step t by degree of freedom; those of empty slots in the last row."""
        for w, k in enumerate(keep(at(jnp.where(self.live, self.dof, len(stored) - 1), t))):
            stored = lax.dynamic_update_index_in_dim(stored, x[w], k, 0, allow_negative_indices=False)
        return stored


def walk_of(slot_index, work: Workspace) -> Walk:
    """The order of the bodies."""
    live = slot_index[SlotRow.LIVE] == 1
    steps = live.shape[0] if work.whole else jnp.any(live, 1).sum(dtype=jnp.int32)
    return Walk(slot_index[SlotRow.PARENT], slot_index[SlotRow.DOF], live, steps, work)


def at(x, t):
    """The entry of step t."""
    return lax.dynamic_index_in_dim(x, t, 0, keepdims=False, allow_negative_indices=False)


def take(stored, slots):
    """(slots, components, B), (W,) -> (components, W, B): W contiguous copies, cheaper than a gather."""
    return jnp.stack([at(stored, i) for i in slots], 1)


def block(stored, t, W: int):
    """The value stored for the bodies of step t."""
    sizes = (W, *stored.shape[1:])
    return jnp.moveaxis(lax.dynamic_slice(stored, _corner(stored, t * W), sizes, allow_negative_indices=False), 0, 1)


def put(stored, t, W: int, x):
    """Store the value of the bodies of step t."""
    x = jnp.moveaxis(jnp.broadcast_to(x, (stored.shape[1], W, *stored.shape[2:])), 1, 0)
    return lax.dynamic_update_slice(stored, x, _corner(stored, t * W), allow_negative_indices=False)


def put_step(x, t, value):
    """Store the values (W, *B) of step t in (T, W, *B)."""
    return lax.dynamic_update_index_in_dim(x, value, t, 0, allow_negative_indices=False)


def add_to(stored, slots, x):
    """Add to the slots named; one after the other, since two bodies may share a parent."""
    for w, i in enumerate(slots):
        there = at(stored, i) + x[:, w]
        stored = lax.dynamic_update_index_in_dim(stored, there, i, 0, allow_negative_indices=False)
    return stored


def _corner(stored, first):
    return (first, *(jnp.zeros_like(first),) * (stored.ndim - 1))


# ---- the bodies in the base's frame ----------------------------------------------------------------------------------


class Joints(NamedTuple):
    """Of the joint of each slot, by step."""

    walk: Walk
    value: jnp.ndarray
    """Its constants, see `Chain.slot_value` [T, 52, W, B]."""
    q: jnp.ndarray
    """Coordinates of the degrees of freedom [nv, B]."""
    quat: jnp.ndarray | None
    """Rotation of the spherical joint that starts in a slot, identity elsewhere [T, 3, 3, W, B]."""
    link: bool = False
    """Whether each body is in its own frame, instead of all in the base's."""

    def turned(self, t):
        """The coordinates q of step t [W, B], the rotations that they cause [3, 3, W, B], sin q and cos q."""
        c0, c1, c2 = (at(self.value, t)[k : k + 9] for k in (ValueRow.C0, ValueRow.C1, ValueRow.C2))
        q = self.walk.of_step(self.q, t)
        sin, cos = keep(sin_cos(q))
        turn = keep(c0 + c1 * cos + c2 * sin)
        return q, turn.reshape(3, 3, *turn.shape[1:]), sin, cos


class Bodies(NamedTuple):
    """Of each slot, in the base's frame and about its origin."""

    S: jnp.ndarray
    """Axis of its joint [slots + 2, 6, B]."""
    Io: jnp.ndarray
    h: jnp.ndarray
    m: jnp.ndarray
    """Rotational inertia [slots + 2, 9, B], first moment [slots + 2, 3, B] and mass [slots + 2, 1, B]."""


def joints_of(walk: Walk, slot_index, slot_value, q, quat, link: bool = False) -> Joints:
    """The joints, of constants and coordinates."""
    R = None
    if quat.shape[0]:
        one = eye(quat.dtype, 1, *quat.shape[2:])
        rotations = cat([matrix(jnp.swapaxes(quat, 0, 1)), one], 2)
        R = keep(jnp.moveaxis(jnp.take(rotations, slot_index[SlotRow.QUAT], axis=2), 2, 0))
    return Joints(walk, slot_value, q, R, link)


def place(joints: Joints, t, Rp, pp):
    """Rotation, position and motion subspace S of the bodies of step t, from their parents' R [3, 3, W, B] and p.

    Where each body is in its own frame, its pose is that in its parent's, and S is constant.
    """
    value, (q, turn, *_) = at(joints.value, t), joints.turned(t)
    offset = value[ValueRow.POINT : ValueRow.SLIDE] + value[ValueRow.SLIDE : ValueRow.AXIS] * q
    axis = value[ValueRow.AXIS : ValueRow.MASS]
    R, p = (turn, offset) if joints.link else (keep(mm(Rp, turn)), keep(pp + mv(Rp, offset)))
    if joints.quat is not None:
        R = keep(mm(R, at(joints.quat, t)))
    if joints.link:
        return R, p, axis
    a = keep(mv(R, axis[:3]))
    return R, p, keep(cat([a, mv(R, axis[3:]) + cross(p, a)]))


def inertia_of(joints: Joints, t, R, p):
    """(m, h, Io) of the bodies of step t at (R, p), or each in its own frame."""
    m, c, I = body_of(at(joints.value, t))
    return rigid_inertia(*((eye(c.dtype, *(1,) * (c.ndim - 1)), 0 * c) if joints.link else (R, p)), m, c, I)


def eye(dtype, *batch):
    """Identity matrices [3, 3, *batch]."""
    return jnp.broadcast_to(jnp.eye(3, dtype=dtype).reshape(3, 3, *(1,) * len(batch)), (3, 3, *batch))


def placed(walk: Walk, joints: Joints, B: tuple, each=None, more=()):
    """Rotations and positions by slot, and the axes S.

    Args:
        walk, joints: Order and joints.
        B: Batch size.
        each, more: `each(t, parents, R, p, S, more) -> values` to be kept beside them, in the storages `more`.
    """
    W, dtype = walk.width, joints.value.dtype

    def outward(t, parents, stored):
        Rs, ps, _, *more = stored
        Rp, pp = (keep(take(Rs, parents)).reshape(3, 3, W, *B), take(ps, parents)) if not joints.link else (None, None)
        R, p, S = place(joints, t, Rp, pp)
        values = (R.reshape(9, *R.shape[2:]), p, S, *(each(t, parents, R, p, S, more) if each else ()))
        return tuple(put(x, t, W, y) for x, y in zip(stored, values, strict=True))

    one = eye(dtype, *B).reshape(9, *B)
    start = walk.empty(9, B, dtype, one, one), walk.empty(3, B, dtype), walk.empty(6, B, dtype)
    return walk.outward(outward, (*start, *more))


def bodies_of(walk: Walk, joints: Joints, base_value, B: tuple):
    """Rotations and positions of all slots, and their axes and inertias."""
    dtype = joints.value.dtype

    def inertia(t, parents, R, p, S, more):
        _, h, Io = inertia_of(joints, t, R, p)
        return Io.reshape(9, *h.shape[1:]), h

    _, h0, Io0 = base_inertia(base_value)
    more = walk.empty(9, B, dtype, Io0.reshape(9, *h0.shape[1:])), walk.empty(3, B, dtype, h0)
    R, p, S, Io, h = placed(walk, joints, B, inertia, more)
    return R, p, Bodies(S, Io, h, masses(walk, joints, base_value))


def masses(walk: Walk, joints: Joints, base_value):
    """Masses of the slots [slots + 2, 1, B]."""
    m = joints.value[:, ValueRow.MASS].reshape(walk.slots, 1, *joints.value.shape[3:])
    m0 = base_value[BaseRow.MASS]
    B = batch_of(m, m0, axes=m0.ndim)
    wide = lambda x: jnp.broadcast_to(x, (len(x), 1, *B))
    return cat([wide(m), wide(m0[None, None]), jnp.zeros((1, 1, *B), m.dtype)])


def inertia_at(bodies: Bodies, t, W: int):
    """(m, h, Io) of the bodies of step t."""
    Io = block(bodies.Io, t, W)
    return block(bodies.m, t, W)[0], block(bodies.h, t, W), Io.reshape(3, 3, *Io.shape[1:])


def inertia_of_base(walk: Walk, bodies: Bodies):
    """(m, h, Io) of the base."""
    Io = bodies.Io[walk.slots]
    return bodies.m[walk.slots, 0], bodies.h[walk.slots], Io.reshape(3, 3, *Io.shape[1:])


def body_of(value):
    """Mass, centre and inertia of the bodies of a step."""
    m, c, I = value[ValueRow.MASS], value[ValueRow.COM : ValueRow.INERTIA], value[ValueRow.INERTIA :]
    return m, c, I.reshape(3, 3, *value.shape[1:])


def base_inertia(base_value):
    """(m, h, Io) of the base about its own origin."""
    m, c = base_value[BaseRow.MASS], base_value[BaseRow.COM : BaseRow.INERTIA]
    I = base_value[BaseRow.INERTIA : BaseRow.FREE].reshape(3, 3, *m.shape)
    return rigid_inertia(eye(m.dtype, *(1,) * m.ndim), jnp.zeros_like(c), m, c, I)


# ---- their motion ----------------------------------------------------------------------------------------------------


def advanced(V, A, S, qd, qdd=None):
    """Twist and acceleration of the bodies of a step from those of their parents."""
    Sqd = keep(S * qd)
    V = keep(V + Sqd)
    A = A + keep(motion_cross(V, Sqd))
    return V, keep(A if qdd is None else A + S * qdd)


def hinge(hinges, t, W: int):
    """Rotation [3, 3, W, B] and position of the bodies of step t in their parents, or None in the common frame."""
    if hinges is None:
        return None
    R, p = (block(x, t, W) for x in hinges)
    return R.reshape(3, 3, *p.shape[1:]), p


def down(hinge, V):
    """Motion vectors of parents, in the frames of their children."""
    return V if hinge is None else keep(to_child(*hinge, V))


def up(hinge, f):
    """Force vectors of children, in the frames of their parents."""
    return f if hinge is None else keep(to_parent(*hinge, f))


def moved(walk: Walk, S, V0, qd, A0, qdd, B: tuple, each=None, more=(), hinges=None):
    """Twists V = V' + S q̇ and spatial accelerations A = A' + S q̈ + V x S q̇ of all slots [slots + 2, 6, B].

    Args:
        walk, S: Order and axes.
        V0, A0: Of the base [6, B].
        qd, qdd: Of the degrees of freedom [nv, B].
        B: Batch size.
        each, more: `each(t, V, A) -> values` to be kept beside them, in the storages `more`.
        hinges: Poses in the parents, where each body is in its own frame.
    """
    W = walk.width

    def outward(t, parents, stored):
        Vp, Ap = (down(hinge(hinges, t, W), take(x, parents)) for x in stored[:2])
        V, A = advanced(Vp, Ap, block(S, t, W), walk.of_step(qd, t), walk.of_step(qdd, t))
        values = (V, A, *(each(t, V, A) if each else ()))
        return tuple(put(x, t, W, y) for x, y in zip(stored, values, strict=True))

    start = (walk.empty(6, B, S.dtype, x) for x in (V0, A0))
    return walk.outward(outward, (*start, *more))
