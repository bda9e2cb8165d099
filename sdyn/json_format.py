"""The own robot format: JSON that holds everything a `Robot` holds, and reads back bit for bit.

    {
      "format": "sdyn-robot", "version": 1, "name": ..., "source": text or list of lines,
      "base": link name, "grounded": false, "ground_pose": {"rotation": 3x3, "position": [x, y, z]},
      "links":  [{"name", "mass", "com", "inertia": 3x3 about the centre of mass}],
      "joints": [{"name", "kind", "parent", "child", "rotation", "position", "axis", "limits", "rate", "effort", ...}],
      "frames": [{"name", "link", "rotation", "position"}],
      "loops":  [{"name", "kind", "frame_a", "frame_b"}],     frames by name, as objects, or "ground"
      "locked": {joint name: value}
    }

Units and meanings are those of `Link`, `Joint`, `Frame` and `Loop`; what equals the default may be left out. Every
object may have `notes` for its readers; they are not kept. Duplicate keys, unknown keys, NaN, infinities and numbers
beyond float64 are refused.
"""

import json
import math
from dataclasses import MISSING, fields

import numpy as np

from sdyn.checks import RobotError, known
from sdyn.parts import Frame, Joint, Link, Loop
from sdyn.robot import GROUND, Robot

FORMAT, VERSION = "sdyn-robot", 1
WORDS = {"name", "kind", "parent", "child", "link", "base"}
FLAGS = {"grounded", "allow_unphysical"}
WIDTH = 118


# -- reading -----------------------------------------------------------------------------------------------------------


def read(data: bytes, *, allow_unphysical: bool = False) -> Robot:
    """The robot in the bytes of a JSON file.

    Args:
        data: UTF-8 text.
        allow_unphysical: Accept inertias that no distribution of mass can have, and mark their links.

    Raises:
        RobotError: If it is not JSON, not this format, or not a robot.
    """
    top = _object(_parse(data), "the file")
    if top.pop("format", None) != FORMAT:
        raise RobotError(f'this is not a robot: the key "format" must be "{FORMAT}".')
    version = top.pop("version", None)
    if isinstance(version, bool) or version != VERSION:
        raise RobotError(f"this robot has version {version}; this sdyn reads version {VERSION}.")
    top["source"] = _text(top.get("source", ""))
    if "links" not in top:
        raise RobotError('the robot has no key "links"; it needs at least a base.')
    items = {key: _list(top.pop(key, []), key) for key in ("links", "joints", "frames", "loops")}
    pose, locked = top.pop("ground_pose", None), top.pop("locked", {})
    values = _values(Robot, top, "the robot")
    frames = [_part(Frame, item, "frame", i) for i, item in enumerate(items["frames"])]
    if pose is not None:
        pose = _values(Frame, _object(pose, "the ground pose"), "the ground pose", ("rotation", "position"))
        pose = (pose.get("rotation", np.eye(3)), pose.get("position", np.zeros(3)))
    return Robot(
        links=[_link(item, i, allow_unphysical) for i, item in enumerate(items["links"])],
        joints=[_part(Joint, item, "joint", i) for i, item in enumerate(items["joints"])],
        frames=frames,
        loops=[_loop(item, i, frames) for i, item in enumerate(items["loops"])],
        ground_pose=pose,
        locked={k: _numbers(v, f"the value of joint {k!r}") for k, v in _object(locked, "locked").items()},
        **values,
    )


def _parse(data: bytes):
    def pairs(items):
        out = {}
        for key, value in items:
            if key in out:
                raise RobotError(f"the key {key!r} occurs twice in one object; keep one of them.")
            out[key] = value
        return out

    def finite(text):
        x = float(text)
        if not math.isfinite(x):
            raise RobotError(f"the number {text[:20]} is not finite; every number must be.")
        return x

    numbers = {"parse_float": finite, "parse_int": finite, "parse_constant": finite}
    try:
        return json.loads(data.decode("utf-8-sig"), object_pairs_hook=pairs, **numbers)
    except UnicodeDecodeError as error:
        raise RobotError(f"this is not UTF-8 text (byte {error.start}); save it as UTF-8.") from None
    except json.JSONDecodeError as error:
        raise RobotError(f"this is not JSON: {error.msg} at line {error.lineno}, column {error.colno}.") from None
    except RecursionError:
        raise RobotError("this is not a robot: its objects are nested too deeply.") from None


def _link(item, i, allow_unphysical) -> Link:
    try:
        return _part(Link, item, "link", i)
    except RobotError:
        if not allow_unphysical or not isinstance(item, dict):
            raise
        return _part(Link, {**item, "allow_unphysical": True}, "link", i)


def _loop(item, i, frames) -> Loop:
    item = dict(_object(item, f"loop {i + 1}"))
    here = f"loop {item.get('name', i + 1)!r}"
    by_name = {frame.name: frame for frame in frames} | {GROUND: Frame(GROUND, GROUND)}
    ends = {}
    for key in ("frame_a", "frame_b"):
        end = item.pop(key, None)
        if isinstance(end, str):
            known(end, by_name, f"frame (of {here}) named")
            ends[key] = by_name[end]
        else:
            ends[key] = _part(Frame, end, f"{key} of {here},", 0)
    return Loop(**_values(Loop, item, here, ("name", "kind"), ("name",)), **ends)


def _part(cls, item, what, i):
    item = _object(item, f"{what} {i + 1}")
    needed = [f.name for f in fields(cls) if f.default is MISSING]
    return cls(**_values(cls, item, f"{what} {item.get('name', i + 1)!r}", None, needed))


def _values(cls, item, here, allowed=None, needed=()) -> dict:
    """The arguments of a record from an object, each checked for its JSON type."""
    allowed = [f.name for f in fields(cls)] if allowed is None else list(allowed)
    out = {}
    for key, value in item.items():
        if key == "notes":
            continue
        known(key, allowed, f"key (in {here}) named")
        what = f"the {key} of {here}"
        if key in WORDS or key == "source":
            if not isinstance(value, str):
                raise RobotError(f"{what} is {_short(value)}; it must be a string.")
        elif key in FLAGS:
            if not isinstance(value, bool):
                raise RobotError(f"{what} is {_short(value)}; it must be true or false.")
        else:
            value = _numbers(value, what)
        out[key] = value
    for key in needed:
        if key not in out:
            raise RobotError(f'{here} has no "{key}"; add it.')
    return out


def _numbers(value, what):
    """A number or nested lists of numbers; true, null and strings are none."""
    if isinstance(value, list):
        return [_numbers(x, what) for x in value]
    if not isinstance(value, float):
        raise RobotError(f"{what} holds {_short(value)} where a number must be.")
    return value


def _object(value, what) -> dict:
    if not isinstance(value, dict):
        raise RobotError(f"{what} must be an object {{...}}, not {_short(value)}.")
    return value


def _list(value, what) -> list:
    if not isinstance(value, list):
        raise RobotError(f"{what} must be a list [...], not {_short(value)}.")
    return value


def _text(value) -> str:
    lines = value if isinstance(value, list) else [value]
    if not all(isinstance(line, str) for line in lines):
        raise RobotError("the source must be a string or a list of strings, one for each line.")
    return "\n".join(lines)


def _short(value) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:37] + "..."


# -- writing -----------------------------------------------------------------------------------------------------------


def write(robot: Robot) -> bytes:
    """The bytes of a JSON file that reads back as the same robot."""
    top = {"format": FORMAT, "version": VERSION, "name": robot.name}
    if robot.source:
        lines = robot.source.split("\n")
        top["source"] = lines if len(lines) > 1 else robot.source
    top |= {"base": robot.base, "grounded": robot.grounded}
    rotation, position = robot.ground_pose
    if position.any() or not np.array_equal(rotation, np.eye(3)):
        top["ground_pose"] = {"rotation": rotation, "position": position}
    top["links"] = [_fields(link) for link in robot.links]
    top["joints"] = [_fields(joint) for joint in robot.joints]
    top["frames"] = [_fields(frame) for frame in robot.frames]
    named = {frame.name: frame for frame in robot.frames} | {GROUND: Frame(GROUND, GROUND)}
    end = lambda frame: frame.name if named.get(frame.name) == frame else _fields(frame)
    top["loops"] = [
        {"name": x.name, "kind": x.kind, "frame_a": end(x.frame_a), "frame_b": end(x.frame_b)} for x in robot.loops
    ]
    top["locked"] = {name: value[0] if len(value) == 1 else value for name, value in robot.locked.items()}
    top = {key: value for key, value in top.items() if value is not False and value not in ([], {})}
    return (_layout(top) + "\n").encode()


def _fields(part) -> dict:
    """The fields of a part that are not at their defaults."""
    out = {}
    for f in fields(part):
        value = getattr(part, f.name)
        if f.default is MISSING or not (value is f.default or np.array_equal(value, f.default)):
            out[f.name] = value
    return out


def _layout(value, indent: int = 0) -> str:
    """JSON on one line where it fits, otherwise one entry per line."""
    line = _one_line(value)
    short = len(line) + indent <= WIDTH and indent > 0
    if short or not isinstance(value, dict | list) or not value:
        return line
    pad, (left, right) = " " * (indent + 2), "{}" if isinstance(value, dict) else "[]"
    if isinstance(value, dict) and indent > 2:
        return _filled(value, indent)
    if isinstance(value, dict):
        rows = [f"{json.dumps(k, ensure_ascii=False)}: {_layout(v, indent + 2)}" for k, v in value.items()]
    else:
        rows = [_layout(v, indent + 2) for v in value]
    return left + "\n" + ",\n".join(pad + row for row in rows) + "\n" + " " * indent + right


def _filled(value: dict, indent: int) -> str:
    """An object whose entries fill lines like words."""
    lines = []
    for key, entry in value.items():
        word = _one_line({key: entry})[1:-1]
        if lines and len(lines[-1]) + len(word) + indent + 4 <= WIDTH:
            lines[-1] += ", " + word
        else:
            lines.append(word)
    return "{" + (",\n " + " " * indent).join(lines) + "}"


def _one_line(value) -> str:
    if isinstance(value, dict):
        inner = (f"{json.dumps(k, ensure_ascii=False)}: {_one_line(v)}" for k, v in value.items())
        return "{" + ", ".join(inner) + "}"
    if isinstance(value, list | tuple | np.ndarray):
        return "[" + ", ".join(map(_one_line, value)) + "]"
    if isinstance(value, float):  # np.float64 is one
        return repr(float(value)).removesuffix(".0")
    return json.dumps(value, ensure_ascii=False)
