"""Edits of a robot in words, as `sdyn show ROBOT --edit "lock joint1=0.3; reroot hand; ground hand"` takes them."""

import re

from sdyn.checks import RobotError, known, written
from sdyn.parts import CLOSURES
from sdyn.robot import Robot

FORMS = {
    "lock": "lock JOINT=VALUE, JOINT=VALUE, ...",
    "unlock": "unlock JOINT JOINT ... (none: all)",
    "reroot": "reroot LINK (a frame means its link)",
    "ground": "ground LINK (or a frame on the base)",
    "release": "release",
    "close": "close FRAME FRAME [KIND] (a frame may be 'ground')",
    "open": "open LOOP",
    "attach": "attach MODEL FRAME OTHER_FRAME [PREFIX]",
    "detach": "detach JOINT",
}
VALUE = re.compile(r"([^\s=,]+)\s*=\s*(\([^()]*\)|[^\s=,()]+)")  # joint=0.3, or joint=(1, 0, 0, 0)


def edited(robot: Robot, text: str, load) -> tuple[Robot, tuple[str, ...]]:
    """The robot after the edits of a text, and what is to be said about them.

    Args:
        robot: What to edit.
        text: Edits, one after the other, with ";" between them; `FORMS` lists them.
        load: A function that gives the robot of a name or path, for `attach`.

    Raises:
        RobotError: If an edit cannot be done; the message holds the edit, its position and the remedy.
    """
    edits = [edit.strip() for edit in text.split(";") if edit.strip()]
    remarks = []
    for k, edit in enumerate(edits, 1):
        try:
            robot, remark = _edit(robot, edit, load)
        except RobotError as error:
            raise RobotError(f"edit {k} of {len(edits)}, '{edit}': {error}") from None
        remarks += remark
    return robot, tuple(remarks)


def _edit(robot, edit, load):
    verb, _, rest = edit.partition(" ")
    known(verb, FORMS, "edit")
    words = rest.replace(",", " ").split()
    if verb == "lock":
        return robot.lock(_values(rest)), ()
    if verb == "unlock":
        return robot.unlock(words or None), ()
    if verb == "attach":
        return _attach(robot, _counted(verb, words, 3, 4), load), ()
    if verb == "detach":
        return _detach(robot, *_counted(verb, words, 1))
    if verb == "close":
        return _close(robot, *_counted(verb, words, 2, 3)), ()
    if verb == "release":
        _counted(verb, words, 0)
        return robot.release(), ()
    (name,) = _counted(verb, words, 1)
    if verb == "reroot":
        return robot.reroot(_link_of(robot, name)), ()
    return robot.ground(name) if verb == "ground" else robot.open(name), ()


def _counted(verb, words, least, most=None):
    if not least <= len(words) <= (most or least):
        raise RobotError(f"it must read: {FORMS[verb]}.")
    return words


def _values(text) -> dict:
    """{joint: value} of "a=0.3, b=(1, 0, 0, 0)"."""
    pairs = VALUE.findall(text)
    if not pairs or VALUE.sub("", text).strip(" ,"):
        raise RobotError(f"it must read: {FORMS['lock']}, as in lock joint1=0.3; several numbers as (1, 0, 0, 0).")
    return {name: _number(value) if value[0] != "(" else _numbers(value) for name, value in pairs}


def _number(text) -> float:
    return written(text, "a value in radians or metres")


def _numbers(text) -> list[float]:
    return [_number(word) for word in text.strip("()").replace(",", " ").split()]


def _link_of(robot, name) -> str:
    """A link by its name, or by the name of a frame on it."""
    frames = {frame.name: frame.link for frame in robot.frames}
    links = [link.name for link in robot.links]
    known(name, [*links, *frames], "link or frame")
    return name if name in links else frames[name]


def _attach(robot, words, load):
    model, frame, other_frame, *prefix = words
    other = load(model)
    if prefix:
        other, other_frame = other.prefixed(prefix[0]), prefix[0] + other_frame
    for parts in ("links", "joints", "frames", "loops"):
        clash = {x.name for x in getattr(robot, parts)} & {x.name for x in getattr(other, parts)}
        if clash:
            name = min(clash)
            raise RobotError(f"both have {parts} named {name!r}; add a prefix: attach {model} {frame} {words[2]} t_")
    return robot.attach(other, frame, other_frame)


def _detach(robot, joint):
    near, far = robot.detach(joint)
    links = "1 link" if len(far.links) == 1 else f"{len(far.links)} links"
    return near, (f"detached: {links} with base {far.base!r}, {far.nv} degrees of freedom; the rest is shown.",)


def _close(robot, frame_a, frame_b, kind="weld"):
    known(kind, CLOSURES, "kind of closure")
    return robot.close(frame_a, frame_b, kind)
