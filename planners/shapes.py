"""Simple solids that show a robot, from its own numbers: no meshes are needed.

A heavy link (a satellite) is the box that has its inertia, a reaction wheel the cylinder that has its inertia, any
other link a tube from joint to joint and on to its frames. Shapes are placed in link axes.
"""

from dataclasses import dataclass, field

import numpy as np

import sdyn
from planners.sections import Solid

GREY, ORANGE, WHEEL, STEEL, PANEL = (200, 203, 209), (230, 159, 0), (86, 180, 233), (120, 126, 136), (38, 70, 130)
RED = (213, 94, 0)
ARMS = ((0, 114, 178), (0, 158, 115), (204, 121, 167), (240, 228, 66), (213, 94, 0))  # Okabe and Ito's palette


@dataclass(frozen=True)
class Shape:
    """A solid on a link."""

    kind: str
    """box, cylinder (along its own z), ball, ellipsoid, or axes."""
    size: tuple[float, ...]
    """Edges of a box; radius and height; radius; semi-axes; length of the axes [m]."""
    position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Centre, in link axes [m]."""
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    """Shape to link axes."""
    color: tuple[int, int, int] = GREY
    opacity: float | None = None


def robot_shapes(robot: sdyn.Robot, body: tuple[int, int, int] = GREY, panels: bool = False) -> dict[str, list[Shape]]:
    """The shapes of every link.

    Args:
        robot: What to draw; locked joints need no care, since links stay links.
        body: Colour of the heavy links.
        panels: Give the heavy links solar panels, which make a tumbling motion visible, unless they are long anyway.
    """
    total, radius = sum(link.mass for link in robot.links), _tube_radius(robot)
    arm = _arms(robot)
    shapes = {}
    for link in robot.links:
        color = ARMS[arm[link.name] % len(ARMS)]
        if link.mass > 0.3 * total:
            shapes[link.name] = _satellite(robot, link, body, panels, radius)
        elif (axis := _wheel_axis(robot, link)) is not None:
            shapes[link.name] = _wheel(link, axis)
        else:
            shapes[link.name] = _tubes(robot, link, color, radius)
        shapes[link.name] += [
            Shape("axes", (3.0 * radius,), x.position, x.rotation) for x in robot.frames if x.link == link.name
        ]
    return shapes


def keep_out(solid: Solid) -> list[Shape]:
    """What shows a shape that keeps clear, in axes of its link."""
    start = np.array(solid.position)
    if solid.semi_axes:
        return [Shape("ellipsoid", solid.semi_axes, start, color=RED, opacity=0.25)]
    ball = lambda place: Shape("ball", (solid.radius,), place, color=RED, opacity=0.25)
    if not solid.to:
        return [ball(start)]
    along = np.subtract(solid.to, start)
    length = float(np.linalg.norm(along))
    middle, turn = start + along / 2, _along(along / length)
    tube = Shape("cylinder", (solid.radius, length), middle, turn, RED, 0.25)
    return [tube, ball(start), ball(start + along)]


def extent(shapes: list[Shape]) -> float:
    """Radius of a ball about the link's origin that holds all its shapes [m]."""
    return max((np.linalg.norm(x.position) + np.linalg.norm(x.size) / 2 for x in shapes), default=0.0)


def box_of(link: sdyn.Link) -> tuple[np.ndarray, np.ndarray]:
    """The uniform box with the inertia of a link: edges along its principal axes [3] (m), and those axes [3, 3]."""
    moments, axes = np.linalg.eigh(link.inertia)
    if np.linalg.det(axes) < 0:
        axes[:, 2] *= -1.0
    edges = np.sqrt(np.maximum(6.0 / max(link.mass, 1e-12) * (moments.sum() - 2.0 * moments), 0.0))
    return np.maximum(edges, 0.05 * max(edges.max(), 1e-3)), axes


def _joint_points(robot, link):
    """Where joints and frames sit on a link: its own joint first, if it has one."""
    own = [np.zeros(3) for joint in robot.joints if joint.child == link.name]
    out = [joint.position for joint in robot.joints if joint.parent == link.name]
    return own + out + [frame.position for frame in robot.frames if frame.link == link.name]


def _tube_radius(robot) -> float:
    """A radius [m] that suits the arms of a robot; a share of the satellite's size where there is no arm."""
    lengths = [np.linalg.norm(joint.position) for joint in robot.joints]
    lengths = [length for length in lengths[1:] if length > 1e-3]
    if not lengths:
        return 0.03 * box_of(max(robot.links, key=lambda link: link.mass))[0].max()
    return min(0.28 * float(np.median(lengths)), 0.12 * max(lengths))


def _arms(robot) -> dict[str, int]:
    """The number of the branch, counted at the heaviest link, that each link belongs to."""
    root = max(robot.links, key=lambda link: link.mass).name
    tree = robot.release().reroot(root).tree if robot.grounded else robot.reroot(root).tree
    branch = {}
    for i in tree.order:
        p = tree.parent[i]
        inner = p >= 0 and tree.parent[p] >= 0
        branch[i] = branch[p] if inner else sum(tree.parent[k] == p for k in branch) if p >= 0 else 0
    return {link.name: branch[i] for i, link in enumerate(robot.links)}


def _satellite(robot, link, color, panels, radius) -> list[Shape]:
    edges, axes = box_of(link)
    shapes = [Shape("box", tuple(edges), link.com, axes, color, None if panels else 0.55)]
    if panels and edges.max() < 3.0 * edges.min():
        long, mid = np.argsort(edges)[[2, 1]]
        size = np.full(3, 0.03 * edges.max())
        size[long], size[mid] = 1.2 * edges[long], 0.8 * edges[mid]
        for side in (-1.0, 1.0):
            centre = link.com + side * 1.15 * edges[long] * axes[:, long]
            shapes.append(Shape("box", tuple(size), centre, axes, PANEL))
    for point in _joint_points(robot, link):
        inside = axes.T @ (point - link.com)
        if (np.abs(inside) > edges / 2).any():  # a strut to what is mounted outside the box
            nearest = link.com + axes @ np.clip(inside, -edges / 2, edges / 2)
            shapes += _tube(nearest, point, 0.5 * radius, STEEL)
    return shapes


def _wheel_axis(robot, link) -> np.ndarray | None:
    """The axis of a link that spins about its own centre of mass and carries nothing; None for any other link."""
    joints = [joint for joint in robot.joints if link.name in (joint.parent, joint.child)]
    carries = any(frame.link == link.name for frame in robot.frames)
    if len(joints) != 1 or joints[0].kind != "revolute" or joints[0].child != link.name or carries:
        return None
    return joints[0].axis if np.linalg.norm(link.com) < 1e-3 else None


def _wheel(link, axis) -> list[Shape]:
    spin = axis @ link.inertia @ axis
    radius = np.sqrt(2.0 * spin / link.mass)
    across = (np.trace(link.inertia) - spin) / 2.0
    height = np.sqrt(max(12.0 * across / link.mass - 3.0 * radius**2, (0.3 * radius) ** 2))
    R = _along(axis)
    mark = Shape("box", (1.6 * radius, 0.15 * radius, 1.05 * height), np.zeros(3), R, STEEL)
    return [Shape("cylinder", (radius, height), np.zeros(3), R, WHEEL), mark]


def _tubes(robot, link, color, radius) -> list[Shape]:
    start, *ends = _joint_points(robot, link) or [np.zeros(3)]
    if not any(np.linalg.norm(end - start) > 1e-6 for end in ends):
        ends = [start + 2.0 * (link.com - start)]
    shapes = [Shape("ball", (1.3 * radius,), start, color=STEEL)]
    for end in ends:
        shapes += _tube(start, end, radius, color)
    return shapes


def _tube(start, end, radius, color) -> list[Shape]:
    length = np.linalg.norm(end - start)
    if length < 1e-6:
        return []
    return [Shape("cylinder", (radius, length), (start + end) / 2, _along((end - start) / length), color)]


def _along(axis) -> np.ndarray:
    """A rotation that takes z to `axis`."""
    side = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(side, axis)
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(axis, x), axis])
