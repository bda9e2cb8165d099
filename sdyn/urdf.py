"""URDF in and out.

What URDF says is read as its tools read it; what it cannot say is refused by the name of the joint, on output.

Reading
  - A link without `<inertial>` has no mass. Inertias are turned into link axes.
  - A root named `world` is inertial space: the base is grounded. If it has no mass and one fixed joint, the child is
    the base and the joint its ground pose. A root without mass whose only joint is `floating` stands for the free base
    below it. Any other root is a free base.
  - A link without mass behind a fixed joint, with nothing but such links further out, is a `Frame`.
  - `revolute` without `<limit>` has no limits; so has a `<limit>` with neither `lower` nor `upper`.
  - An axis of any length is normalised. Damping is read, dry friction is not modelled and left out.
  - `<visual>`, `<collision>`, `<transmission>` and whatever else describes no motion is left out; `<mimic>` is refused.

Writing
  - Frames are links without mass behind fixed joints, so that other tools see them.
  - A free base is the root as it stands; a grounded one hangs on a link `world` by a fixed joint.
  - Poses come back to 1e-15 (roll, pitch and yaw in between), all other numbers exactly. The source becomes a comment
    and is not read back.

Source of the format: http://wiki.ros.org/urdf/XML.
"""

from xml.sax.saxutils import quoteattr

import numpy as np

from sdyn.checks import RobotError, distinct, written
from sdyn.parts import Frame, Joint, Link
from sdyn.robot import Robot

WORLD = "world"
KINDS = {
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
    "planar": "planar",
    "fixed": "fixed",
    "floating": "floating",
}


# -- reading -----------------------------------------------------------------------------------------------------------


def read(data: bytes, *, allow_unphysical: bool = False) -> Robot:
    """The robot in the bytes of a URDF file.

    Args:
        data: XML; document types and entities are refused.
        allow_unphysical: Accept inertias that no distribution of mass can have, and mark their links.

    Raises:
        RobotError: If it is not URDF, not a tree, or uses what is not supported.
    """
    top = _parse(data)
    if top.tag != "robot":
        raise RobotError(f"this is not URDF: the outermost element is <{top.tag}>, it must be <robot>.")
    links = [_link(element, allow_unphysical) for element in top.findall("link")]
    joints = [_joint(element) for element in top.findall("joint")]
    distinct([link.name for link in links], "link")
    distinct([joint["name"] for joint in joints], "joint")
    root = _root(links, joints)
    links, joints, base, ground = _base(links, joints, root)
    frames, links, joints = _frames(links, joints, base)
    return Robot(
        links,
        [Joint(**joint) for joint in joints],
        frames,
        base=base,
        grounded=ground is not None,
        ground_pose=ground,
        name=top.get("name", "robot"),
    )


def _parse(data: bytes):
    from xml.etree.ElementTree import ParseError

    from defusedxml import DefusedXmlException
    from defusedxml.ElementTree import fromstring

    try:
        return fromstring(data, forbid_dtd=True)
    except ParseError as error:
        line, column = error.position
        raise RobotError(f"this is not XML: {str(error).split(':')[0]} at line {line}, column {column}.") from None
    except DefusedXmlException:
        raise RobotError("this XML has a document type or entities, which are refused; take them out.") from None
    except (ValueError, LookupError) as error:
        raise RobotError(f"this is not XML: {error}.") from None


def _link(element, allow_unphysical) -> Link:
    name = _name(element)
    inertial = _only(element, "inertial", f"link {name!r}")
    if inertial is None:
        return Link(name, 0.0)
    here = f"the inertial of link {name!r}"
    mass = _number(_needed(inertial, "mass", here), "value", f"the mass of link {name!r}")
    rotation, com = _origin(inertial, here)
    tensor = _needed(inertial, "inertia", here)
    xx, xy, xz, yy, yz, zz = (_number(tensor, key, here) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if not np.array_equal(rotation, np.eye(3)):
        inertia = rotation @ inertia @ rotation.T
        inertia = (inertia + inertia.T) / 2
    try:
        return Link(name, mass, com, inertia)
    except RobotError:
        if not allow_unphysical:
            raise
        return Link(name, mass, com, inertia, allow_unphysical=True)


def _joint(element) -> dict:
    """The arguments of a `Joint`; the kind may be "floating"."""
    name = _name(element)
    here = f"joint {name!r}"
    kind = element.get("type")
    if kind not in KINDS:
        raise RobotError(f"{here} is of type {kind!r}; the types are {', '.join(KINDS)}.")
    if element.find("mimic") is not None:
        raise RobotError(f"{here} mimics another joint, which is not supported; take <mimic> out, or fix the joint.")
    out = {"name": name, "kind": KINDS[kind]}
    for key in ("parent", "child"):
        out[key] = _needed(element, key, here).get("link")
        if not out[key]:
            raise RobotError(f"the <{key}> of {here} names no link; give link=...")
    out["rotation"], out["position"] = _origin(element, here)
    axis, limit = _only(element, "axis", here), _only(element, "limit", here)
    dynamics = _only(element, "dynamics", here)
    if out["kind"] in ("fixed", "floating"):
        return out
    axis = np.array([1.0, 0.0, 0.0]) if axis is None else _vector(axis, "xyz", f"the axis of {here}")
    if not axis.any():
        raise RobotError(f"the axis of {here} is zero; give it a direction.")
    if abs(np.linalg.norm(axis) - 1.0) > 1e-6:
        axis = axis / np.abs(axis).max()  # no overflow on the way
        axis = axis / np.linalg.norm(axis)
    out["axis"] = axis
    if dynamics is not None and dynamics.get("damping") is not None:
        out["damping"] = _number(dynamics, "damping", f"the dynamics of {here}")
    return out | _bounds(limit, kind, here)


def _bounds(limit, kind, here) -> dict:
    if limit is None:
        return {}
    if kind == "planar":
        raise RobotError(f"{here} is planar and has a <limit>, whose meaning URDF does not define; take it out.")
    out, here = {}, f"the limit of {here}"
    if kind != "continuous" and not (limit.get("lower") is None and limit.get("upper") is None):
        out["limits"] = tuple(_number(limit, key, here) if limit.get(key) else 0.0 for key in ("lower", "upper"))
    for ours, theirs in (("effort", "effort"), ("rate", "velocity")):
        if limit.get(theirs) is not None:
            out[ours] = _number(limit, theirs, here)
    return out


def _root(links, joints) -> str:
    """The name of the link that is nobody's child."""
    names, above = {link.name for link in links}, {}
    if not links:
        raise RobotError("the robot has no link; it needs at least a base.")
    for joint in joints:
        for end in (joint["parent"], joint["child"]):
            if end not in names:
                raise RobotError(f"joint {joint['name']!r} names the link {end!r}, which does not exist; add it.")
        if joint["child"] in above:
            raise RobotError(
                f"link {joint['child']!r} is the child of the joints {above[joint['child']]!r} and {joint['name']!r}; "
                f"take one out and close the loop with robot.close(...)."
            )
        above[joint["child"]] = joint["name"]
    roots = [link.name for link in links if link.name not in above]
    if len(roots) > 1:
        raise RobotError(f"the links {roots} all have no parent; join them to one tree by joints.")
    if not roots:
        raise RobotError("every link is the child of a joint, so the joints form a cycle; take one out.")
    return roots[0]


def _base(links, joints, root):
    """What remains when inertial space is taken away: links, joints, base, and ground pose or None."""
    by_name = {link.name: link for link in links}
    at_root = [joint for joint in joints if joint["parent"] == root]
    bare = _massless(by_name[root]) and len(at_root) == 1
    for joint in joints:
        if joint["kind"] == "floating" and not (bare and joint is at_root[0]):
            raise RobotError(
                f"joint {joint['name']!r} is floating, and {joint['parent']!r} is not a root without mass and without "
                f"other joints; make the parts two robots, and attach them."
            )
    if bare and (at_root[0]["kind"] == "floating" or (root == WORLD and at_root[0]["kind"] == "fixed")):
        first = at_root[0]
        ground = None if first["kind"] == "floating" else (first["rotation"], first["position"])
        links = [link for link in links if link.name != root]
        return links, [joint for joint in joints if joint is not first], first["child"], ground
    return links, joints, root, (np.eye(3), np.zeros(3)) if root == WORLD else None


def _frames(links, joints, base):
    """Frames in place of the links without mass that only fixed joints carry."""
    above = {joint["child"]: joint for joint in joints}
    carried = {link.name: 0 for link in links}
    for joint in joints:
        carried[joint["parent"]] += 1
    plain = {
        link.name: above[link.name]
        for link in links
        if _massless(link) and link.name != base and above[link.name]["kind"] == "fixed"
    }
    todo = [name for name in plain if carried[name] == 0]
    marks = set()
    while todo:  # from the leaves inwards
        name = todo.pop()
        marks.add(name)
        parent = plain[name]["parent"]
        carried[parent] -= 1
        if carried[parent] == 0 and parent in plain:
            todo.append(parent)

    def frame(name):
        R, p, parent = plain[name]["rotation"], plain[name]["position"], plain[name]["parent"]
        while parent in marks:
            up = plain[parent]
            R, p, parent = up["rotation"] @ R, up["rotation"] @ p + up["position"], up["parent"]
        return Frame(name, parent, R, p)

    frames = [frame(link.name) for link in links if link.name in marks]
    return (
        frames,
        [link for link in links if link.name not in marks],
        [joint for joint in joints if joint["child"] not in marks],
    )


def _massless(link) -> bool:
    return link.mass == 0.0 and not link.inertia.any()


# -- elements ----------------------------------------------------------------------------------------------------------


def _name(element) -> str:
    name = element.get("name")
    if not name:
        raise RobotError(f"a <{element.tag}> has no name; give it one.")
    return name


def _only(element, tag, here):
    found = element.findall(tag)
    if len(found) > 1:
        raise RobotError(f"{here} has {len(found)} elements <{tag}>; keep one of them.")
    return found[0] if found else None


def _needed(element, tag, here):
    found = _only(element, tag, here)
    if found is None:
        raise RobotError(f"{here} has no <{tag}>; add it.")
    return found


def _number(element, key, here) -> float:
    text = element.get(key)
    if text is None:
        raise RobotError(f"{here} has no {key}; add {key}=... to <{element.tag}>.")
    return written(text.strip(), here if key == "value" else f"the {key} in {here}")


def _vector(element, key, here) -> np.ndarray:
    words = element.get(key, "").split()
    if len(words) != 3:
        raise RobotError(f"the {key} in {here} is {element.get(key)!r}; it must be three numbers.")
    return np.array([written(word, f"the {key} in {here}") for word in words])


def _origin(element, here):
    origin = _only(element, "origin", here)
    if origin is None:
        return np.eye(3), np.zeros(3)
    get = lambda key: np.zeros(3) if origin.get(key) is None else _vector(origin, key, f"the origin of {here}")
    return rotation_from_rpy(get("rpy")), get("xyz")


def rotation_from_rpy(rpy) -> np.ndarray:
    """The rotation by roll, pitch and yaw about the fixed axes x, y and z [rad]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rpy_from_rotation(R) -> np.ndarray:
    """Roll, pitch and yaw of a rotation [rad]; exact to rounding also where pitch is 90 degrees.

    The yaw is taken first, and the others from what is left after it: where roll and yaw turn about one axis,
    any yaw will do.
    """
    yaw = np.arctan2(R[1, 0], R[0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    first, second = c * R[0] + s * R[1], c * R[1] - s * R[0]  # rows of Rz(-yaw) R
    return np.array([np.arctan2(-second[2], second[1]), np.arctan2(-R[2, 0], first[0]), yaw])


# -- writing -----------------------------------------------------------------------------------------------------------


def write(robot: Robot) -> bytes:
    """The bytes of a URDF file.

    Raises:
        RobotError: If the robot has what URDF cannot hold; the message names it.
    """
    _refuse(robot)
    rows = ['<?xml version="1.0" encoding="utf-8"?>', f"<robot name={quoteattr(robot.name)}>"]
    if robot.source:
        rows.append(f"  <!-- {robot.source.replace('--', '- -').replace(chr(10), chr(10) + '       ')} -->")
    if robot.grounded and robot.base != WORLD:
        rows += [f'  <link name="{WORLD}"/>']
        rows += _joint_rows(Joint(f"{WORLD}_{robot.base}", "fixed", WORLD, robot.base, *robot.ground_pose))
    for link in robot.links:
        rows += _link_rows(link)
    for joint in robot.joints:
        rows += _joint_rows(joint)
    for frame in robot.frames:
        rows += _link_rows(Link(frame.name, 0.0))
        pose = (frame.rotation, frame.position)
        rows += _joint_rows(Joint(f"{frame.name}_frame", "fixed", frame.link, frame.name, *pose))
    return ("\n".join([*rows, "</robot>"]) + "\n").encode()


def _refuse(robot):
    """Name what URDF cannot hold."""
    other = "save it as .json"
    if robot.loops:
        raise RobotError(f"URDF cannot hold loop {robot.loops[0].name!r}; open it, or {other}.")
    if robot.locked:
        raise RobotError(f"URDF cannot hold the locked joint {next(iter(robot.locked))!r}; unlock it, or {other}.")
    for i, ahead in enumerate(robot.tree.forward):
        if not ahead:
            joint = robot.joints[robot.tree.joint[i]]
            raise RobotError(
                f"joint {joint.name!r} is declared towards the base {robot.base!r}, and URDF knows no such joint; "
                f"reroot, or {other}."
            )
    for joint in robot.joints:
        here = f"joint {joint.name!r}"
        if joint.kind not in KINDS:
            raise RobotError(f"URDF cannot hold {here}, which is {joint.kind}; {other}.")
        for key in ("stiffness", "rotor_inertia"):
            if getattr(joint, key):
                raise RobotError(f"URDF cannot hold the {key.replace('_', ' ')} of {here}; set it to 0, or {other}.")
        if joint.kind == "planar" and (joint.limits, joint.rate, joint.effort) != (None, None, None):
            raise RobotError(f"URDF cannot hold the bounds of {here}, which is planar; leave them out, or {other}.")
    names = {link.name for link in robot.links}
    if WORLD in names and not (robot.grounded and robot.base == WORLD):
        raise RobotError(f"link {WORLD!r} would be read as inertial space; rename it, or {other}.")
    if robot.base == WORLD and (robot.ground_pose[1].any() or not np.array_equal(robot.ground_pose[0], np.eye(3))):
        raise RobotError(f"URDF cannot hold a ground pose of the link {WORLD!r}; rename it, or {other}.")
    for frame in robot.frames:
        if frame.name in names | {WORLD}:
            raise RobotError(f"a frame and a link are both named {frame.name!r}; rename one, or {other}.")
    extra = [f"{frame.name}_frame" for frame in robot.frames] + [f"{WORLD}_{robot.base}"] * robot.grounded
    distinct([*(joint.name for joint in robot.joints), *extra], "joint")


def _link_rows(link) -> list[str]:
    name = quoteattr(link.name)
    if _massless(link) and not link.com.any():
        return [f"  <link name={name}/>"]
    I = link.inertia
    entries = {"ixx": I[0, 0], "ixy": I[0, 1], "ixz": I[0, 2], "iyy": I[1, 1], "iyz": I[1, 2], "izz": I[2, 2]}
    return [
        f"  <link name={name}>",
        "    <inertial>",
        f'      <origin xyz="{_words(link.com)}" rpy="0 0 0"/>',
        f'      <mass value="{_words([link.mass])}"/>',
        "      <inertia " + " ".join(f'{k}="{_words([v])}"' for k, v in entries.items()) + "/>",
        "    </inertial>",
        "  </link>",
    ]


def _joint_rows(joint) -> list[str]:
    kind = "continuous" if joint.kind == "revolute" and joint.limits is None else joint.kind
    rows = [
        f"  <joint name={quoteattr(joint.name)} type={quoteattr(kind)}>",
        f"    <parent link={quoteattr(joint.parent)}/>",
        f"    <child link={quoteattr(joint.child)}/>",
        f'    <origin xyz="{_words(joint.position)}" rpy="{_words(rpy_from_rotation(joint.rotation))}"/>',
    ]
    if kind != "fixed":
        rows.append(f'    <axis xyz="{_words(joint.axis)}"/>')
        bounds = {} if joint.limits is None else dict(zip(("lower", "upper"), joint.limits, strict=True))
        bounds |= {k: v for k, v in (("effort", joint.effort), ("velocity", joint.rate)) if v is not None}
        if bounds:
            rows.append("    <limit " + " ".join(f'{k}="{_words([v])}"' for k, v in bounds.items()) + "/>")
        if joint.damping:
            rows.append(f'    <dynamics damping="{_words([joint.damping])}"/>')
    return [*rows, "  </joint>"]


def _words(numbers) -> str:
    return " ".join(repr(float(x)) for x in numbers)
