"""Robots in files: `load` and `save`, by suffix; a file is replaced as a whole or not at all."""

import os
import tempfile
from importlib import import_module
from pathlib import Path

from sdyn.checks import RobotError, known
from sdyn.robot import Robot

FORMATS = {".json": "sdyn.json_format", ".urdf": "sdyn.urdf"}
LIMIT = 16 * 2**20  # bytes; read before anything is parsed


def load(path, *, allow_unphysical: bool = False) -> Robot:
    """The robot in a file.

    Args:
        path: A .json file in the own format, or a .urdf file.
        allow_unphysical: Accept inertias that no distribution of mass can have, to examine and repair them.

    Raises:
        RobotError: If there is no such file, or it holds no robot; the message starts with the path.
    """
    path = Path(path)
    form = _format(path)
    data = _bytes(path)
    try:
        return form.read(data, allow_unphysical=allow_unphysical)
    except RobotError as error:
        raise RobotError(f"{path}: {error}") from None


def save(robot: Robot, path) -> None:
    """Write a robot to a .json or .urdf file.

    The file is written beside its place and then moved there, so that a crash leaves the old file or the new one.
    URDF cannot hold everything; what it cannot hold is refused by name.

    Raises:
        RobotError: If the format cannot hold the robot, or the file cannot be written.
    """
    path = Path(path)
    form = _format(path)
    try:
        data = form.write(robot)
    except RobotError as error:
        raise RobotError(f"{path}: {error}") from None
    except UnicodeEncodeError:
        raise RobotError(f"{path}: a name or the source holds characters that UTF-8 cannot write.") from None
    write(path, data)


def write(path: Path, data: bytes) -> None:
    """Write bytes to a file, whole or not at all."""
    if path.is_dir():
        raise RobotError(f"{path} is a folder; give the name of a file in it.")
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except FileNotFoundError:
        raise RobotError(f"there is no folder {str(path.parent)!r}; make it first.") from None
    except OSError as error:
        raise RobotError(f"{path} cannot be written: {error.strerror}.") from None
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, path.stat().st_mode & 0o777 if path.exists() else 0o666 & ~_umask())
        os.replace(temporary, path)
    except OSError as error:
        raise RobotError(f"{path} cannot be written: {error.strerror}.") from None
    finally:
        Path(temporary).unlink(missing_ok=True)


def _format(path: Path):
    if path.suffix.lower() not in FORMATS:
        raise RobotError(f"{path} ends in {path.suffix!r}; robot files end in {' or '.join(FORMATS)}.")
    return import_module(FORMATS[path.suffix.lower()])


def _bytes(path: Path) -> bytes:
    if path.is_dir():
        raise RobotError(f"{path} is a folder; give a file in it.")
    if not path.exists():
        if not path.parent.is_dir():
            raise RobotError(f"there is no folder {str(path.parent)!r}, and so no file {str(path)!r}.")
        others = sorted(p.name for p in path.parent.iterdir() if p.suffix.lower() in FORMATS)
        if not others:
            raise RobotError(f"there is no file {str(path)!r}.")
        known(path.name, others, f"file in {str(path.parent)!r} named")
    try:
        with path.open("rb") as file:
            data = file.read(LIMIT + 1)
    except OSError as error:
        raise RobotError(f"{path} cannot be read: {error.strerror}.") from None
    if len(data) > LIMIT:
        raise RobotError(f"{path} is larger than {LIMIT // 2**20} MB; a robot file is much smaller.")
    return data


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
