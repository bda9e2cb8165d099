"""What is rigid, as one link: a robot whose locked and fixed joints are gone from its parts, not only from its motion.

`pack` merges locked links too, but keeps every original link as data (its mass, its pose). Where nobody asks for those,
the merged robot has the arrays, the names and the cost of one that was built small by hand.
"""

from dataclasses import replace

import numpy as np

from sdyn.parts import Frame, Joint, Link
from sdyn.posture import joint_pose
from sdyn.robot import GROUND, Robot


def merged(robot: Robot) -> Robot:
    """The same robot with one link in place of each set of links that do not move against each other.

    A merged link has the name and the frame of its link next to the base. Coordinates, their order and signs stay.
    Loops within one link go. A link that a joint names as its child, away from that frame, stays without mass.
    """
    head, R, p = _places(robot)
    number = {link.name: i for i, link in enumerate(robot.links)}
    members = {i: [k for k, of in enumerate(head) if of == i] for i in sorted(set(head))}
    links = [_composite(robot.links[i].name, [robot.links[k] for k in ks], R[ks], p[ks]) for i, ks in members.items()]
    joints, marks = [], {}
    for joint in robot.moving:
        at, child = number[joint.parent], number[joint.child]
        if head[child] != child:
            marks[child] = robot.joints[robot.tree.joint[child]].name
        moved = R[at] @ joint.rotation, R[at] @ joint.position + p[at]
        joints.append(replace(joint, parent=robot.links[head[at]].name, rotation=moved[0], position=moved[1]))
    for i, name in marks.items():
        links.append(Link(robot.links[i].name, 0.0))
        joints.append(Joint(name, "fixed", robot.links[head[i]].name, robot.links[i].name, R[i], p[i]))

    def on_head(frame: Frame) -> Frame:
        if frame.link == GROUND:
            return frame
        i = number[frame.link]
        place = R[i] @ frame.rotation, R[i] @ frame.position + p[i]
        return Frame(frame.name, robot.links[head[i]].name, *place)

    still = {GROUND: robot.base if robot.grounded else GROUND}
    body = lambda frame: still.get(frame.link) or robot.links[head[number[frame.link]]].name
    loops = [x for x in robot.loops if body(x.frame_a) != body(x.frame_b)]
    return replace(
        robot,
        links=links,
        joints=joints,
        frames=[on_head(frame) for frame in robot.frames],
        loops=[replace(x, frame_a=on_head(x.frame_a), frame_b=on_head(x.frame_b)) for x in loops],
        locked={},
    )


def _places(robot):
    """The link that each one is merged into, and its rotation and position in it."""
    tree, n = robot.tree, len(robot.links)
    head, R, p = list(range(n)), np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    for i in tree.order[1:]:
        joint, up = robot.joints[tree.joint[i]], tree.parent[i]
        if robot.is_locked(joint):
            rotation, position = joint_pose(joint, robot.locked.get(joint.name, ()))
            if not tree.forward[i]:
                rotation, position = rotation.T, -rotation.T @ position
            head[i], R[i], p[i] = head[up], R[up] @ rotation, R[up] @ position + p[up]
    return head, R, p


def _composite(name, links, R, p) -> Link:
    """One link for several, whose rotations and positions in its frame are R and p."""
    if len(links) == 1:
        return links[0]
    mass = sum(link.mass for link in links)
    centres = [Rk @ link.com + pk for link, Rk, pk in zip(links, R, p, strict=True)]
    com = sum(link.mass * c for link, c in zip(links, centres, strict=True)) / (mass or 1.0)
    inertia = np.zeros((3, 3))
    for link, Rk, c in zip(links, R, centres, strict=True):
        d = c - com
        inertia += Rk @ link.inertia @ Rk.T + link.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return Link(name, mass, com, (inertia + inertia.T) / 2, any(link.allow_unphysical for link in links))
