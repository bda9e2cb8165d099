"""What closures hold, from the frames that they join: components first, then loops or rows, then any batch axes.

A closure compares two frames, in the axes and at the origin of frame a, fixed in its link: with Δ = V_a − V_b,
    K v = X Δ,   K v̇ − k = X (A_a − A_b + V_a x V_b),
where a row of X picks a component of the twist in frame a. The twists are compared at one point, so the columns of a
free base are zero for a closure between two links. The universal joint's angular row is along n = z_a x x_b, which
turns: it adds −n' · (w_b − w_a). The wrench on link a is Xᵀ lam, on link b its opposite.

Twists and wrenches are in the base's axes, about the base's origin, as in the sweeps.
"""

from typing import NamedTuple

import jax.numpy as jnp

from sdyn.chain import ClosureRow
from sdyn.materialise import keep
from sdyn.spatial import cat, cross, dot, mm, motion_cross, mtv, mv


class Ends(NamedTuple):
    """The frames of all loops, base axes and origin."""

    Ra: jnp.ndarray
    xa: jnp.ndarray
    Rb: jnp.ndarray
    xb: jnp.ndarray
    """Rotations [3, 3, loops, *B] and origins [3, loops, *B]."""


def ends_of(at_a, at_b, frames) -> Ends:
    """The frames from the poses of their slots [12, loops, *B], and their own in these [24, loops, *B]."""
    return Ends(*_composed(at_a, frames[:12]), *_composed(at_b, frames[12:]))


def _composed(outer, inner):
    """Rotation and position of poses [12, loops, *B] in one another."""
    (R, p), (S, x) = ((y[:9].reshape(3, 3, *y.shape[1:]), y[9:]) for y in (outer, inner))
    return mm(R, S), p + mv(R, x)


def basis(rows, ends: Ends):
    """The rows X [rows, 6, *B]: what the closures hold of a difference of twists."""
    axes = [ends.Ra[:, k] for k in range(3)]
    turns = [cat([e, 0 * e]) for e in (*axes, _universal_axis(ends))]
    slides = [cat([cross(ends.xa, e), e]) for e in axes]  # e · (w x x) = w · (x x e)
    return held(rows, jnp.stack([*turns[:3], *slides, turns[3]]))


def acceleration(rows, ends: Ends, X, Va, Vb, Aa, Ab):
    """K v̇ − k [rows, *B] from the twists and spatial accelerations of the slots [6, loops, *B]."""
    D = keep(of_rows(rows, Aa - Ab + motion_cross(Va, Vb)))
    spin, z, x = Vb[:3] - Va[:3], ends.Ra[:, 2], ends.Rb[:, 0]
    turning = dot(cross(z, cross(spin, x)), spin)  # n' = z_a x ((w_b − w_a) x x_b), as seen from link a
    return dot(jnp.moveaxis(X, 1, 0), D) - held(rows, jnp.stack([*[0 * turning[None]] * 6, turning[None]]))[:, 0]


def residual(rows, ends: Ends):
    """How far open [rows, *B]: angles and distances of frame a from frame b, in the axes of frame a."""
    R, d = mm(jnp.swapaxes(ends.Ra, 0, 1), ends.Rb), mtv(ends.Ra, ends.xa - ends.xb)
    half = lambda c: 2 / jnp.maximum(1 + c, 1e-9)
    tilt, twist = half(R[2, 2]), half(R[0, 0])
    parts = [R[1, 2] * tilt, -R[0, 2] * tilt, -R[1, 0] * twist, *d, R[2, 0]]
    return held(rows, jnp.stack(parts)[:, None])[:, 0]


def wrenches(rows, X, lam, loops: int):
    """Wrench on link a of each loop [6, loops, *B]."""
    each = jnp.moveaxis(X * lam[:, None], 1, 0)
    own = rows[ClosureRow.LOOP] == jnp.arange(loops)[:, None]
    return jnp.where(own.reshape(1, *own.shape, *(1,) * (each.ndim - 2)), each[:, None], 0).sum(2)


def held(rows, parts):
    """The rows that are held [rows, k, *B], of the seven parts of each loop [7, k, loops, *B]."""
    loop, part, live = rows
    count = parts.shape[2]
    flat = jnp.moveaxis(parts, 2, 1).reshape(7 * count, parts.shape[1], *parts.shape[3:])
    found = jnp.take(flat, part * count + loop, axis=0)
    return keep(found * live.reshape(-1, *(1,) * (found.ndim - 1)).astype(found.dtype))


def of_rows(rows, x):
    """Values of the loops [k, loops, *B], for each row [k, rows, *B]."""
    return jnp.take(x, rows[ClosureRow.LOOP], axis=1)


def _universal_axis(ends):
    """z_a x x_b, base axes."""
    return cross(ends.Ra[:, 2], ends.Rb[:, 0])
