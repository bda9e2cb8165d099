"""Spheres, capsules and ellipsoids on links, and how far they are apart: what a task says and what a plan keeps.

The distances here are exact, of whole paths at once: of two segments by looking at all the places where their closest
points can be; to an ellipsoid by bisection for its closest point, and by a search along the segment, since that
distance is convex. The solver's own are those of `clearance`, by other formulas.
"""

import numpy as np

from planners.sections import Solid, TaskError

BISECTIONS, SEARCHES = 60, 40  # the interval is then 1e-18 and 1e-8 of the first; the distance's error is its square


def pairs(task) -> tuple[tuple[str, str], ...]:
    """The shapes that keep apart; an ellipsoid comes second."""
    if task.clearance is None:
        return ()
    own = [name for name, solid in task.shapes.items() if not _on_target(task, solid)]
    found = task.clearance.pairs or [(a, b) for a in own for b in task.shapes if b not in own]
    return tuple(_in_order(task, pair) for pair in found)


def least(task) -> np.ndarray:
    """The distance that each pair must keep, [pairs] (m): less, for a pair in contact, where the grasp leaves less."""
    free = {_in_order(task, pair) for pair in task.clearance.contact}
    room = lambda pair: at_grasp(task, pair) - 2 * task.clearance.margin if pair in free else np.inf
    return np.array([min(task.clearance.distance, room(pair)) for pair in pairs(task)])


def apart(task, motion, target) -> np.ndarray:
    """Distances of all pairs along one phase, [k, pairs] (m).

    Args:
        task: With [clearance].
        motion, target: `motion.Motion` of the robot, and of the target while it is separate.
    """

    def placed(name):
        solid = task.shapes[name]
        mover = target if target is not None and _on_target(task, solid) else motion
        i = [link.name for link in mover.robot.links].index(solid.link)
        return mover.R[:, i], mover.p[:, i]

    return np.stack([_distance(*((task.shapes[name], *placed(name)) for name in pair)) for pair in pairs(task)], axis=1)


def at_grasp(task, pair) -> float:
    """Distance of a pair, one of them on the link of the hand and one on the target, in the grasp [m]."""
    frames = task.chaser.frame(task.robot.frame), task.body.frame(f"target_{task.target.frame}")

    def placed(name):  # in axes of the grasped frame
        frame = frames[_on_target(task, task.shapes[name])]
        return task.shapes[name], frame.rotation.T[None], -(frame.rotation.T @ frame.position)[None]

    return float(_distance(*map(placed, pair))[0])


# -- distances ---------------------------------------------------------------------------------------------------------


def segments(p, u, q, w) -> np.ndarray:
    """Distance of the segments p + s u and q + t w, 0 <= s, t <= 1; [k, 3] each, [k]."""
    dot = lambda a, b: (a * b).sum(axis=-1)
    over = lambda a, b: np.divide(a, b, out=np.zeros_like(a), where=b > 0)
    r, a, b, e = p - q, dot(u, u), dot(u, w), dot(w, w)
    det = a * e - b * b
    inside = [over(b * dot(w, r) - e * dot(u, r), det), over(a * dot(w, r) - b * dot(u, r), det)]
    places = [tuple(np.clip(x, 0, 1) for x in inside)]
    for end in (0.0 * a, 0.0 * a + 1):
        places.append((end, np.clip(over(dot(w, r) + end * b, e), 0, 1)))
        places.append((np.clip(over(end * b - dot(u, r), a), 0, 1), end))
    return np.min([np.linalg.norm(r + s[:, None] * u - t[:, None] * w, axis=-1) for s, t in places], axis=0)


def from_ellipsoid(x, semi_axes) -> np.ndarray:
    """Distance of points x [k, 3] from an ellipsoid about the origin, its axes; within it a bound, below zero.

    The closest point is y_i = a_i^2 x_i / (a_i^2 + t), with the one t >= 0 that puts it on the surface.
    """
    a = np.asarray(semi_axes)
    level = np.linalg.norm(x / a, axis=-1)
    low, high = np.zeros(len(x)), np.linalg.norm(x, axis=-1) * a.max()
    for _ in range(BISECTIONS):
        t = (low + high) / 2
        out = (np.square(a * x / (a**2 + t[:, None])).sum(axis=-1)) > 1
        low, high = np.where(out, t, low), np.where(out, high, t)
    gap = np.linalg.norm(x * (high / (a**2 + high[:, None]).T).T, axis=-1)
    return np.where(level > 1, gap, (level - 1) * a.min())


def _distance(first, second) -> np.ndarray:
    """Distance [k] of two solids, each with the rotations [k, 3, 3] and origins [k, 3] of its link."""
    (a, *place), (b, R, p) = first, second
    start, along = _segment(a, *place)
    if b.semi_axes is None:
        return segments(start, along, *_segment(b, R, p)) - a.radius - b.radius
    local = lambda x: np.einsum("kji,kj->ki", R, x)
    start, along = local(start - p) - b.position, local(along)
    gap = lambda s: from_ellipsoid(start + s[:, None] * along, b.semi_axes)
    low, high = np.zeros(len(start)), np.ones(len(start))
    for _ in range(SEARCHES):
        left, right = low + (high - low) * 0.49, low + (high - low) * 0.51
        nearer = gap(left) < gap(right)
        low, high = np.where(nearer, low, left), np.where(nearer, right, high)
    return gap((low + high) / 2) - a.radius


def _segment(solid: Solid, R, p):
    """Start and extent [k, 3] of a capsule's axis; of a sphere, its centre and nothing."""
    along = np.zeros(3) if solid.to is None else np.subtract(solid.to, solid.position)
    return p + R @ solid.position, R @ along


# -- what a task may say -----------------------------------------------------------------------------------------------


def check(task) -> None:
    """Refuses shapes and pairs that make no sense.

    Raises:
        TaskError: It names the shape or pair and the remedy.
    """
    target = task.body.base
    links = {link.name for link in task.chaser.links}
    for name, solid in task.shapes.items():
        where = f"[shapes.{name}]"
        if solid.link not in links | {target}:
            raise TaskError(f"{where} link {solid.link!r} is none; there are {', '.join(sorted(links))} and {target}.")
        if (solid.radius is None) == (solid.semi_axes is None) or (solid.semi_axes and solid.to):
            raise TaskError(f"{where} must have a radius, and `to` if a capsule; or semi_axes, if an ellipsoid.")
        if solid.semi_axes and min(solid.semi_axes) <= 0:
            raise TaskError(f"{where} semi_axes are {list(solid.semi_axes)}; all three must be above zero.")
    if task.clearance is None:
        if task.shapes:
            raise TaskError("shapes are given, but no [clearance]; say there how far they keep apart.")
        return
    if task.body.frame(f"target_{task.target.frame}").link != target:
        raise TaskError(f"[clearance] needs a target that is grasped at its base link; that is {target!r}.")
    for pair in (*task.clearance.pairs, *task.clearance.contact):
        _check_pair(task, pair)
    found, hand = pairs(task), task.chaser.frame(task.robot.frame).link
    if not found:
        raise TaskError("[clearance] has no pair of shapes; give [shapes.NAME] on the robot and on the target.")
    free = {_in_order(task, pair) for pair in task.clearance.contact}
    if free - set(found):
        raise TaskError(f"contact in [clearance]: {list(min(free - set(found)))} is none of the pairs that keep apart.")
    wanted = task.clearance.distance + task.clearance.margin
    for pair in found:
        solids = [task.shapes[name] for name in pair]
        held = {solid.link for solid in solids} == {hand, target}
        if pair in free and not held:
            raise TaskError(f"contact in [clearance]: of {list(pair)}, one must be on {hand!r} and one on {target!r}.")
        if held and pair not in free and at_grasp(task, pair) < wanted:
            raise TaskError(
                f"[clearance] {list(pair)} are {at_grasp(task, pair):.3g} m apart in the grasp, and {wanted:.3g} are "
                f"asked: name them in contact, or give smaller shapes."
            )


def _check_pair(task, pair):
    where = f"[clearance] {list(pair)}"
    for name in pair:
        if name not in task.shapes:
            raise TaskError(f"{where}: there is no shape {name!r}; there are {', '.join(task.shapes) or 'none'}.")
    solids = [task.shapes[name] for name in pair]
    if all(solid.semi_axes for solid in solids):
        raise TaskError(f"{where}: two ellipsoids; one must be a sphere or a capsule.")
    if solids[0].link == solids[1].link:
        raise TaskError(f"{where} are on one link; they cannot move apart.")


def _on_target(task, solid: Solid) -> bool:
    return solid.link == task.body.base


def _in_order(task, pair):
    return tuple(sorted(pair, key=lambda name: task.shapes[name].semi_axes is not None))
