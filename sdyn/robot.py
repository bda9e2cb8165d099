"""The complete physical system, and the edits of its structure. Every edit returns a new `Robot`.

| edit | the paper's function |
|---|---|
| `lock`, `unlock`, `attach`, `detach` | new number of joints |
| `reroot` | invert chain |
| `ground`, `release` | extract fixed-base equations |
| `close`, `open` | close loop |
"""

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import compress

import numpy as np

from sdyn.checks import RobotError, array, distinct, known, pose, quantity, read_only, unit
from sdyn.parts import KINDS, Frame, Joint, Link, Loop, Part, renamed
from sdyn.posture import link_poses
from sdyn.table import Table, table
from sdyn.tree import Tree, span

GROUND = "ground"


@dataclass(frozen=True, eq=False)
class Robot(Part):
    """Links and joints, named frames, loops, a base that is free or grounded, and the joints that are locked.

    Args:
        links, joints: The joints must connect the links to one tree. Their order is the order of all arrays.
        frames: Named frames: end-effectors, grapple points, sensors.
        loops: Closures; see `close`.
        base: Name of the base link; the first link if left out.
        grounded: Whether the base stands still.
        ground_pose: (rotation, position) of a grounded base in the world [-, m]; identity by default.
        locked: Values of the locked joints, by name [m, rad, or unit quaternion].
        name, source: What the robot is called, and where its numbers come from.

    Raises:
        RobotError: If a name is used twice or unknown, or the joints do not form one tree.
    """

    links: tuple[Link, ...]
    joints: tuple[Joint, ...] = ()
    frames: tuple[Frame, ...] = ()
    loops: tuple[Loop, ...] = ()
    base: str | None = None
    grounded: bool = False
    ground_pose: tuple = None
    locked: dict = field(default_factory=dict)
    name: str = "robot"
    source: str = ""

    def __post_init__(self):
        put = lambda key, value: object.__setattr__(self, key, value)
        for key in ("links", "joints", "frames", "loops"):
            put(key, tuple(getattr(self, key)))
            distinct([part.name for part in getattr(self, key)], key[:-1])
        if not self.links:
            raise RobotError("the robot has no link; it needs at least a base.")
        names = {link.name for link in self.links}
        if GROUND in names:
            raise RobotError(f"a link is named {GROUND!r}; that name stands for inertial space. Rename it.")
        put("base", self.links[0].name if self.base is None else self.base)
        known(self.base, names, "link")
        for frame in self.frames:
            if frame.link not in names:
                known(frame.link, names, f"link (of frame {frame.name!r}) named")
        for loop in self.loops:
            for end in (loop.frame_a, loop.frame_b):
                if end.link != GROUND:
                    known(end.link, names, f"link (of loop {loop.name!r}) named")
        put("ground_pose", pose(self.ground_pose, "the ground pose"))
        joints = {joint.name: joint for joint in self.joints}
        put("locked", {name: _lock_value(joints.get(name) or self.joint(name), x) for name, x in self.locked.items()})
        self.tree  # noqa: B018  (refuses cycles and loose links now, not later)

    def __eq__(self, other):
        plain = [f.name for f in fields(self) if f.name not in ("ground_pose", "locked")]
        same = type(self) is type(other) and all(getattr(self, key) == getattr(other, key) for key in plain)
        return (
            same
            and all(map(np.array_equal, self.ground_pose, other.ground_pose))
            and self.locked.keys() == other.locked.keys()
            and all(np.array_equal(value, other.locked[name]) for name, value in self.locked.items())
        )

    __hash__ = Part.__hash__

    # -- what it is ------------------------------------------------------------------------------------------------

    @cached_property
    def tree(self) -> Tree:
        """The spanning tree, seen from the base."""
        return span(self.links, self.joints, self.base)

    def is_locked(self, joint: Joint) -> bool:
        """Whether a joint does not move: it is locked, or of kind fixed."""
        return joint.kind == "fixed" or joint.name in self.locked

    @cached_property
    def moves(self) -> tuple[bool, ...]:
        """Whether each joint moves, in declared order."""
        return tuple(not self.is_locked(joint) for joint in self.joints)

    @cached_property
    def moving(self) -> tuple[Joint, ...]:
        """The joints that move, in declared order."""
        return tuple(compress(self.joints, self.moves))

    @property
    def nv(self) -> int:
        """Degrees of freedom: entries of v."""
        return len(self.v_names)

    @property
    def nq(self) -> int:
        """Entries of q."""
        return len(self.q_names)

    @property
    def q_names(self) -> tuple[str, ...]:
        """Names of the entries of q, in order."""
        base = () if self.grounded else tuple(f"{self.base}.{x}" for x in ("x", "y", "z", "qw", "qx", "qy", "qz"))
        return base + tuple(j.name + x for j in self.moving for x in KINDS[j.kind].coordinates)

    @property
    def v_names(self) -> tuple[str, ...]:
        """Names of the entries of v, in order."""
        base = () if self.grounded else tuple(f"{self.base}.{x}" for x in ("wx", "wy", "wz", "vx", "vy", "vz"))
        return base + tuple(j.name + x for j in self.moving for x in KINDS[j.kind].rates)

    def neutral(self) -> np.ndarray:
        """The configuration of zeros and identity rotations, [nq]."""
        return self.configuration()

    def configuration(self, joints=None, *, position=(0.0, 0.0, 0.0), quaternion=(1.0, 0.0, 0.0, 0.0)) -> np.ndarray:
        """A configuration from joint values by name; joints not named are at zero.

        Args:
            joints: Value of each joint [m, rad, or unit quaternion wxyz], as {name: value}.
            position, quaternion: Pose of a free base [m, unit quaternion wxyz, body to world].

        Returns:
            q [nq].
        """
        joints, out = dict(joints or {}), []
        if not self.grounded:
            out += [quantity(position, "the position", (3,)), unit(quaternion, "the quaternion", 4)]
        for joint in self.moving:
            rest = np.r_[1.0, 0.0, 0.0, 0.0] if joint.kind == "spherical" else np.zeros(joint.nq)
            out.append(_value(joint, joints.pop(joint.name, rest)))
        self._refuse_rest(joints)
        return np.concatenate([np.zeros(0), *out])

    def velocity(self, joints=None, *, twist=(0.0,) * 6) -> np.ndarray:
        """A velocity from joint rates by name; joints not named rest.

        Args:
            joints: Rate of each joint [m/s or rad/s], as {name: rate}.
            twist: `[w; v]` of a free base, of its origin and in its axes [rad/s, m/s].

        Returns:
            v [nv].
        """
        joints = dict(joints or {})
        out = [] if self.grounded else [array(twist, (6,), "the twist")]
        for joint in self.moving:
            rate = np.broadcast_to(joints.pop(joint.name, 0.0), (joint.dof,))
            out.append(array(rate, (joint.dof,), f"the rate of joint {joint.name!r}"))
        self._refuse_rest(joints)
        return np.concatenate([np.zeros(0), *out])

    def table(self, base: int = 0, merged: bool = False) -> Table:
        """The paper's connectivity table: rows (link, parent, end_effector, connect, cflag).

        Args:
            base: 0 leaves the base out and calls it 0 (Table II); 1 lists it as link 1 (Table III).
            merged: Show locked links as one body.
        """
        return table(self, base, merged)

    # -- new number of joints --------------------------------------------------------------------------------------

    def lock(self, joints: dict) -> "Robot":
        """Take joints out of the model: the links on both sides become one body.

        Args:
            joints: {name: value}, the value in the units of q.
        """
        return replace(self, locked={**self.locked, **joints})

    def unlock(self, joints=None) -> "Robot":
        """Let joints move again: those named, or all."""
        names = list(self.locked) if joints is None else [joints] if isinstance(joints, str) else list(joints)
        for name in names:
            if self.joint(name).name not in self.locked:
                raise RobotError(f"joint {name!r} is not locked; there is nothing to unlock.")
        return replace(self, locked={k: v for k, v in self.locked.items() if k not in names})

    def attach(self, other: "Robot", frame: str, other_frame: str, kind: str = "fixed", name: str | None = None):
        """Join another robot at a frame of each; the frames coincide where the joint is at zero.

        Args:
            other: A free robot. Names that clash raise: use `other.prefixed("t_")`.
            frame, other_frame: Frame names on this and on the other robot.
            kind: Kind of the joint; its axis is the frame's z axis.
            name: Name of the joint; "frame_other_frame" if left out.

        Returns:
            The compound, with the base of this robot.
        """
        if other.grounded:
            raise RobotError("attach: the other robot is grounded; release it first, or close a loop to ground.")
        for key in ("links", "joints", "frames", "loops"):
            taken = {part.name for part in getattr(self, key)}
            for part in getattr(other, key):
                if part.name in taken:
                    raise RobotError(
                        f"attach: both robots have a {key[:-1]} named {part.name!r}, and names must be unique; "
                        f"attach other.prefixed('t_')."
                    )
        here, there = self.frame(frame), other.frame(other_frame)
        name = f"{frame}_{other_frame}" if name is None else name
        joint = dict(kind=kind, parent=here.link, rotation=here.rotation, position=here.position)
        fixture, child = (), there.link
        if kind == "fixed":  # the child's frame, seen from the frame that coincides with ours
            R = here.rotation @ there.rotation.T
            added = (Joint(name, "fixed", here.link, child, R, here.position - R @ there.position),)
        elif np.array_equal(there.rotation, np.eye(3)) and not there.position.any():
            added = (Joint(name, child=child, **joint),)
        else:  # the joint's axis goes through the frame: a link without mass stands there
            fixture = (Link(f"{name}_fixture", 0.0),)
            mount = Joint(f"{name}_mount", "fixed", child, fixture[0].name, there.rotation, there.position)
            added = (Joint(name, child=fixture[0].name, **joint), mount)
        return replace(
            self,
            links=self.links + other.links + fixture,
            joints=self.joints + other.joints + added,
            frames=self.frames + other.frames,
            loops=self.loops + other.loops,
            locked={**self.locked, **other.locked},
        )

    def detach(self, joint: str) -> tuple["Robot", "Robot"]:
        """Take a joint away.

        Returns:
            The part with the base, and the other part, whose base is the link at the joint.
        """
        j = self.joints.index(self.joint(joint))
        top = self.tree.joint.index(j)
        beyond = {top}
        for i in self.tree.order:
            if self.tree.parent[i] in beyond:
                beyond.add(i)
        far = {self.links[i].name for i in beyond}
        for loop in self.loops:
            if (loop.frame_a.link in far) != (loop.frame_b.link in far):
                raise RobotError(f"detach: loop {loop.name!r} still joins the two parts; open it first.")

        def part(inside, base, grounded):
            joints = tuple(x for x in self.joints if inside(x.parent) and inside(x.child))
            return replace(
                self,
                links=tuple(x for x in self.links if inside(x.name)),
                joints=joints,
                frames=tuple(x for x in self.frames if inside(x.link)),
                loops=tuple(x for x in self.loops if inside(x.frame_a.link) or inside(x.frame_b.link)),
                base=base,
                grounded=grounded,
                ground_pose=self.ground_pose if grounded else None,
                locked={x.name: self.locked[x.name] for x in joints if x.name in self.locked},
            )

        return (
            part(lambda link: link not in far, self.base, self.grounded),
            part(lambda link: link in far, self.links[top].name, False),
        )

    def prefixed(self, prefix: str) -> "Robot":
        """The same robot with `prefix` before every name."""
        ends = lambda frame: replace(frame, link=frame.link if frame.link == GROUND else prefix + frame.link)
        loops = tuple(replace(x, frame_a=ends(x.frame_a), frame_b=ends(x.frame_b)) for x in self.loops)
        return replace(
            self,
            links=renamed(self.links, prefix),
            joints=renamed(self.joints, prefix, "parent", "child"),
            frames=renamed(self.frames, prefix, "link"),
            loops=renamed(loops, prefix),
            base=prefix + self.base,
            locked={prefix + name: value for name, value in self.locked.items()},
        )

    # -- invert chain ----------------------------------------------------------------------------------------------

    def reroot(self, link: str) -> "Robot":
        """Make another link the base. Joints keep their names, order and sign; the base's coordinates become
        the new base link's own origin and axes."""
        known(link, [x.name for x in self.links], "link")
        if self.grounded and link != self.base:
            raise RobotError(
                f"reroot: the base {self.base!r} is grounded and stays the base; release() it first, "
                f"or ground {link!r} as well with close(..., 'ground')."
            )
        return replace(self, base=link)

    # -- fixed-base equations --------------------------------------------------------------------------------------

    def ground(self, link_or_frame: str, pose=None) -> "Robot":
        """Fix the base to inertial space (grapple).

        Args:
            link_or_frame: The base link, or a frame on it.
            pose: Its pose in the world, (rotation, position) or [x, y, z, qw, qx, qy, qz]; identity by default.
        """
        frames = {frame.name: frame for frame in self.frames}
        names = [link.name for link in self.links]
        known(link_or_frame, [*names, *frames], "link or frame")
        mark = Frame("", link_or_frame) if link_or_frame in names else frames[link_or_frame]
        if mark.link != self.base:
            raise RobotError(
                f"ground: {link_or_frame!r} is on link {mark.link!r}, and the base is {self.base!r}; "
                f"reroot({mark.link!r}) first" + (", or close it to 'ground'." if self.grounded else ".")
            )
        if self.grounded:
            raise RobotError(f"ground: the base {self.base!r} is grounded already; close further frames to 'ground'.")
        R, p = _pose(pose, f"the pose of {link_or_frame!r}")
        R = R @ mark.rotation.T
        return replace(self, grounded=True, ground_pose=(R, p - R @ mark.position))

    def release(self) -> "Robot":
        """Let a grounded base go."""
        if not self.grounded:
            raise RobotError(f"release: the base {self.base!r} is free already.")
        return replace(self, grounded=False, ground_pose=None)

    # -- close loop ------------------------------------------------------------------------------------------------

    def close(self, frame_a, frame_b, kind: str = "weld", name: str | None = None, q=None) -> "Robot":
        """Join two frames by a weld, a point or a joint kind.

        Args:
            frame_a, frame_b: A frame's name, a `Frame`, or "ground".
            kind: weld, point, revolute, prismatic, universal, spherical, cylindrical or planar.
            name: Name of the loop; "frame_a_frame_b" if left out.
            q: Configuration whose relative pose the frames keep; without it they coincide.
        """
        a, b = (self._end(x) for x in (frame_a, frame_b))
        if q is not None:  # frame b moves to where frame a is
            R, p = link_poses(self, q)
            at = {link.name: (R[i], p[i]) for i, link in enumerate(self.links)} | {GROUND: (np.eye(3), np.zeros(3))}
            (Ra, pa), (Rb, pb) = at[a.link], at[b.link]
            b = replace(b, rotation=Rb.T @ Ra @ a.rotation, position=Rb.T @ (pa + Ra @ a.position - pb))
        return replace(self, loops=(*self.loops, Loop(name or f"{a.name}_{b.name}", a, b, kind)))

    def open(self, loop: str) -> "Robot":
        """Undo a closure."""
        known(loop, [x.name for x in self.loops], "loop")
        return replace(self, loops=tuple(x for x in self.loops if x.name != loop))

    # -- parts by name ---------------------------------------------------------------------------------------------

    def link(self, name: str) -> Link:
        """A link by its name."""
        return _find(self.links, name, "link")

    def joint(self, name: str) -> Joint:
        """A joint by its name."""
        return _find(self.joints, name, "joint")

    def frame(self, name: str) -> Frame:
        """A frame by its name."""
        return _find(self.frames, name, "frame")

    def _end(self, x) -> Frame:
        if isinstance(x, str):
            return Frame(GROUND, GROUND) if x == GROUND else self.frame(x)
        known(x.link, [*(link.name for link in self.links), GROUND], "link")
        return x

    def _refuse_rest(self, joints):
        for name in joints:
            if name in self.locked:
                raise RobotError(f"joint {name!r} is locked and has no coordinate; unlock it, or leave it out.")
            known(name, [joint.name for joint in self.moving], "moving joint")


def _lock_value(joint, value) -> np.ndarray:
    if joint.kind == "fixed":
        raise RobotError(f"lock: joint {joint.name!r} is of kind fixed and cannot move anyway; leave it out.")
    return _value(joint, value)


def _value(joint, value) -> np.ndarray:
    """Entries of q of one joint."""
    what = f"the value of joint {joint.name!r}"
    if joint.kind == "spherical":
        return unit(value, what, 4)
    if joint.nq == 1 and np.ndim(value) == 0:
        return read_only(np.array([quantity(value, what)]))
    return quantity(value, what, (joint.nq,))


_pose = pose  # `ground` has an argument of the same name


def _find(parts, name, what):
    for part in parts:
        if part.name == name:
            return part
    return known(name, [part.name for part in parts], what)
