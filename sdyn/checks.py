"""Checks of what a user hands in: each returns clean NumPy data or raises one sentence that says what to do."""

import difflib
import re

import numpy as np


class RobotError(ValueError):
    """A robot, an edit or a file that cannot be what it says; the message names the part and the remedy."""


FAR = 1e3  # m; lengths up to here are ordinary ones
LARGEST, SMALLEST = 1e30, 1e-30  # what physical quantities may be, beside zero: their products stay within float64


def number(value, what: str, *, least: float = -np.inf) -> float:
    """A finite float, at least `least`."""
    try:
        x = float(None if isinstance(value, str | bytes) else value)  # Python would read "1_000"
    except (TypeError, ValueError, OverflowError):
        raise RobotError(f"{what} is {value!r}; it must be a number.") from None
    if not np.isfinite(x):
        raise RobotError(f"{what} is {x}; it must be finite.")
    if x < least:
        raise RobotError(f"{what} is {x:g}; it must be at least {least:g}.")
    return x


NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)  # not nan, inf, 1_000 or full-width digits


def written(text: str, what: str) -> float:
    """The finite number that a word of a file or of a command spells."""
    if not NUMBER.fullmatch(text):
        hint = " Expand it with xacro first." if "${" in text else ""
        raise RobotError(f"{what} holds {text[:40]!r} where a number must be.{hint}")
    x = float(text)
    if not np.isfinite(x):
        raise RobotError(f"{what} is {text[:40]}; it must be finite.")
    return x


def array(value, shape: tuple[int, ...], what: str) -> np.ndarray:
    """A finite, read-only float64 array of the given shape."""
    try:
        x = np.array(value)
    except ValueError:
        raise RobotError(f"{what} has rows of different length; it must have shape {shape}.") from None
    if x.dtype.kind not in "biuf":
        raise RobotError(f"{what} must hold numbers; got {value!r}.")
    x = x.astype(np.float64, copy=False)
    if x.shape != shape:
        raise RobotError(f"{what} has shape {x.shape}; it must have shape {shape}.")
    if not np.isfinite(x).all():
        raise RobotError(f"{what} is {x.tolist()}; every entry must be finite.")
    return read_only(x)


def quantity(value, what: str, shape: tuple[int, ...] = (), *, small: bool = True):
    """A number or an array whose products with others neither overflow nor, unless `small`, vanish."""
    x = array(value, shape, what) if shape else number(value, what)
    size = np.abs(x).max(initial=0.0)
    if size > LARGEST:
        raise RobotError(f"{what} holds {size:.3g}, which is beyond {LARGEST:g}; check its unit.")
    if not small and 0.0 < size < SMALLEST:
        raise RobotError(f"{what} is {size:.3g}, which is below {SMALLEST:g}; set it to 0, or check its unit.")
    return x


def read_only(x: np.ndarray) -> np.ndarray:
    """The array itself, which can no longer be written to."""
    x.flags.writeable = False
    return x


def unit(value, what: str, size: int = 3) -> np.ndarray:
    """A unit vector; one that is off by rounding is normalised, any other is refused."""
    x = array(value, (size,), what)
    largest = np.abs(x).max()
    if largest == 0.0:
        raise RobotError(f"{what} is zero; give it a direction.")
    length = largest * np.linalg.norm(x / largest)  # neither overflows nor vanishes
    if abs(length - 1.0) > 1e-6:
        better = (x / largest / np.linalg.norm(x / largest)).tolist()
        raise RobotError(f"{what} has length {length:.6g}; give a unit vector, here {better}.")
    return x if abs(length - 1.0) < 4e-16 else array(x / length, (size,), what)


def rotation(value, what: str) -> np.ndarray:
    """A proper rotation matrix, to 1e-6; rounding is removed by the nearest rotation."""
    R = array(value, (3, 3), what)
    if np.abs(R).max() > 2.0 or np.abs(R.T @ R - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0.0:
        raise RobotError(f"{what} is not a rotation matrix (orthonormal, determinant +1): {R.tolist()}.")
    if np.abs(R.T @ R - np.eye(3)).max() > 4e-15:  # what the line below leaves stays as it is, bit for bit
        U, _, Vt = np.linalg.svd(R)
        R = array(U @ Vt, (3, 3), what)
    return R


def pose(value, what: str) -> tuple[np.ndarray, np.ndarray]:
    """A pose given as (rotation, position), or as [x, y, z, qw, qx, qy, qz]; None is the identity."""
    if value is None:
        return array(np.eye(3), (3, 3), what), array(np.zeros(3), (3,), what)
    if len(value) == 2:
        return rotation(value[0], f"the rotation of {what}"), quantity(value[1], f"the position of {what}", (3,))
    x = quantity(value, what, (7,))
    w, v = (u := unit(x[3:], f"the quaternion of {what}", 4))[0], u[1:]
    R = np.eye(3) + 2 * w * hat(v) + 2 * hat(v) @ hat(v)
    return rotation(R, what), array(x[:3], (3,), what)


def hat(a) -> np.ndarray:
    """The matrix of the cross product, `hat(a) @ b = a x b`."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def principal_moments(inertia) -> np.ndarray:
    """Principal moments of inertia, ascending [kg m^2]."""
    return np.linalg.eigvalsh(inertia)


def is_physical(mass: float, inertia) -> bool:
    """Whether some distribution of positive mass has this inertia about its centre (triangle inequality)."""
    moments = principal_moments(inertia)
    slack = 1e-9 * max(moments[2], 0.0)
    return mass >= 0 and moments[0] >= -slack and moments[0] + moments[1] - moments[2] >= -slack


def known(name: str, names, what: str) -> None:
    """Refuse a name that does not exist, and suggest the ones that are close."""
    names = list(names)
    if name not in names:
        close = difflib.get_close_matches(str(name), names, n=3) or names[:8]
        more = "; there are none." if not names else f"; did you mean {', '.join(map(repr, close))}?"
        raise RobotError(f"there is no {what} {name!r}{more}")


def distinct(names, what: str) -> None:
    """Refuse a name that is used twice."""
    seen = set()
    for name in names:
        if not isinstance(name, str) or not name:
            raise RobotError(f"a {what} is named {name!r}; a name must be a non-empty string.")
        if name in seen:
            raise RobotError(f"two {what}s are named {name!r}; names must be unique.")
        seen.add(name)
