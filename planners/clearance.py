"""How far spheres, capsules and ellipsoids on links are apart, smoothly, for a solver to keep.

Of two capsules with the axes u and w: the distance of the axes, less the radii. Segments that are about parallel have
no one pair of closest points, and their distance a kink, which a small weight ROUND on the distance from the middle
takes away:

    d^2 = min |p + s u - q - t w|^2 + ROUND (|u|^2 (s - 1/2)^2 + |w|^2 (t - 1/2)^2),  0 <= s, t <= 1

It is too large by at most ROUND (|u|^2 + |w|^2) / (8 d), which the margin of the task must cover. The minimum is a
closed form, and by the envelope theorem its derivative is that with s and t held.
Of a capsule and an ellipsoid with the semi-axes a: with W = min(a) diag(1/a) the ellipsoid is a ball of radius min(a),
and |W x| <= |x|, so what is found there is a level, a lower bound of the distance, equal to it along the shortest axis.
Source: Ericson, Real-Time Collision Detection (2005), section 5.1.9, for the order in which s and t are clipped.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from planners import solids

ROUND = 1e-3
TINY = 1e-12  # m^2: points that coincide are a micrometre apart, and their derivative is finite


class Solids(NamedTuple):
    """Shapes and pairs of them, numbers; shapes of the robot, then those of the target."""

    start: jax.Array  # [m, 3] one end of the axis, on the link (m)
    along: jax.Array  # [m, 3] from there to the other end
    pairs: jax.Array  # [c, 2]
    metric: jax.Array  # [c, 3, 3] W, axes of the second one's link
    radius: jax.Array  # [c] of both together
    least: jax.Array  # [c] distance to be kept at the grid's points


def solids_of(task) -> tuple[Solids, list[str]]:
    """The solids of a task with [clearance], and the links of those on the robot."""
    shapes = sorted(task.shapes.items(), key=lambda x: x[1].link == task.body.base)
    place = {name: k for k, (name, _) in enumerate(shapes)}
    found = solids.pairs(task)
    size = lambda solid: solid.radius if solid.semi_axes is None else min(solid.semi_axes)
    metric = lambda solid: np.eye(3) if solid.semi_axes is None else np.diag(size(solid) / np.array(solid.semi_axes))
    each = lambda f: np.array([f(solid) for _, solid in shapes])
    numbers = Solids(
        each(lambda x: x.position),
        each(lambda x: np.subtract(x.to or x.position, x.position)),
        np.array([[place[a], place[b]] for a, b in found]),
        np.array([metric(task.shapes[b]) for _, b in found]),
        np.array([size(task.shapes[a]) + size(task.shapes[b]) for a, b in found]),
        solids.least(task) + task.clearance.margin,
    )
    return numbers, [solid.link for _, solid in shapes if solid.link != task.body.base]


def segments(p, u, q, w):
    """Distance of the segments p + s u and q + t w, [..., 3] each; a segment may be a point."""
    dot = lambda a, b: jnp.sum(a * b, axis=-1)
    part = lambda a, b: jnp.clip(a / jnp.where(b > 0, b, 1.0), 0, 1)
    off = lambda a, x: ROUND * a * jnp.square(x - 0.5)
    r = p - q
    a, b, e = dot(u, u), dot(u, w), dot(w, w)
    # A s - b t = c,  E t - b s = f
    A, E, c, f = (1 + ROUND) * a, (1 + ROUND) * e, ROUND * a / 2 - dot(u, r), ROUND * e / 2 + dot(w, r)
    s = part(c * E + b * f, A * E - b * b)
    t = part(b * s + f, E)
    s = part(b * t + c, A)
    s, t = jax.lax.stop_gradient((s, t))
    gap = r + s[..., None] * u - t[..., None] * w
    return jnp.sqrt(dot(gap, gap) + off(a, s) + off(e, t) + TINY)


def apart(solids: Solids, R, p):
    """Distances of all pairs, [k, c], from the poses [k, m, 3, 3], [k, m, 3] of their links in any axes."""
    start = p + jnp.einsum("kmij,mj->kmi", R, solids.start)
    along = jnp.einsum("kmij,mj->kmi", R, solids.along)
    first, second = solids.pairs.T
    turn = jnp.einsum("cij,kclj->kcil", solids.metric, R[:, second])
    seen = lambda x: jnp.einsum("kcij,kcj->kci", turn, x)
    origin = jnp.zeros_like(start[:, second])
    ends = seen(start[:, first] - start[:, second]), seen(along[:, first]), origin, seen(along[:, second])
    return segments(*ends) - solids.radius
