"""The parts of a robot: links, joints, frames and loops, each checked when it is made.

A joint of any kind is a short sequence of screws `exp([a; b] q)`, or a unit quaternion
(spherical): `KINDS` is the only table that knows what a "revolute" is.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from sdyn.checks import (
    FAR,
    RobotError,
    array,
    distinct,
    is_physical,
    number,
    principal_moments,
    quantity,
    rotation,
    unit,
)


@dataclass(frozen=True)
class Kind:
    """What a joint kind is made of: one row per degree of freedom."""

    coordinates: tuple[str, ...]
    """Suffixes of the names of its entries of q."""
    rates: tuple[str, ...]
    """Suffixes of the names of its entries of v."""

    @cached_property
    def dof(self) -> int:
        return len(self.rates)

    @cached_property
    def nq(self) -> int:
        return len(self.coordinates)


KINDS = {
    "fixed": Kind((), ()),
    "revolute": Kind(("",), ("",)),
    "prismatic": Kind(("",), ("",)),
    "helical": Kind(("",), ("",)),
    "cylindrical": Kind((".slide", ".angle"), (".slide", ".angle")),
    "universal": Kind((".first", ".second"), (".first", ".second")),
    "planar": Kind((".x", ".y", ".angle"), (".x", ".y", ".angle")),
    "spherical": Kind((".qw", ".qx", ".qy", ".qz"), (".wx", ".wy", ".wz")),
}
CLOSURES = {  # what each kind holds of the twist in frame a: angular x y z, linear x y z, and 6, see closures.py
    "weld": (0, 1, 2, 3, 4, 5),
    "point": (3, 4, 5),
    "revolute": (0, 1, 3, 4, 5),
    "prismatic": (0, 1, 2, 3, 4),
    "universal": (6, 3, 4, 5),
    "spherical": (3, 4, 5),
    "cylindrical": (0, 1, 3, 4),
    "planar": (0, 1, 5),
}


class Part:
    """Equality field by field, arrays included."""

    def __eq__(self, other):
        return type(self) is type(other) and all(
            np.array_equal(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)
        )

    def __hash__(self):
        return hash((type(self), self.name))


@dataclass(frozen=True, eq=False)
class Link(Part):
    """A rigid body.

    Args:
        name: Unique among the links.
        mass: Mass [kg].
        com: Centre of mass in link axes [m].
        inertia: Inertia about the centre of mass, link axes [kg m^2].
        allow_unphysical: Accept an inertia that no distribution of mass can have.

    Raises:
        RobotError: If a number is not finite, the mass negative, or the inertia impossible.
    """

    name: str
    mass: float
    com: np.ndarray = (0.0, 0.0, 0.0)
    inertia: np.ndarray = ((0.0,) * 3,) * 3
    allow_unphysical: bool = False

    def __post_init__(self):
        here = f"link {self.name!r}"
        put = lambda key, value: object.__setattr__(self, key, value)
        number(self.mass, f"the mass of {here}", least=0.0)
        put("mass", quantity(self.mass, f"the mass of {here}", small=False))
        put("com", quantity(self.com, f"the centre of mass of {here}", (3,)))
        put("inertia", quantity(self.inertia, f"the inertia of {here}", (3, 3), small=False))
        if np.abs(self.inertia - self.inertia.T).max() > 1e-9 * max(np.abs(self.inertia).max(), 1e-300):
            raise RobotError(f"the inertia of {here} is not symmetric: {self.inertia.tolist()}.")
        if not self.allow_unphysical and not is_physical(self.mass, self.inertia):
            moments = ", ".join(f"{x:.6g}" for x in principal_moments(self.inertia))
            raise RobotError(
                f"the inertia of {here} is impossible: its principal moments ({moments}) kg m^2 must be "
                f"positive, and no one larger than the sum of the others. Correct it, let `sdyn check` "
                f"propose a repair, or pass allow_unphysical=True."
            )

    @cached_property
    def is_solid(self) -> bool:
        """Whether it resists any motion, about every axis by at least mass times (1e-5 m)^2."""
        near = np.abs(self.com).max() < FAR and is_physical(self.mass, self.inertia)
        return bool(near and self.mass > 0 and principal_moments(self.inertia)[0] > 1e-10 * self.mass)


@dataclass(frozen=True, eq=False)
class Joint(Part):
    """A joint between two links: `x_parent = rotation @ x_joint + position`, and the joint frame is the
    child's frame before the joint moved.

    Args:
        name: Unique among the joints.
        kind: revolute, prismatic, helical, cylindrical, universal, planar, spherical or fixed.
        parent, child: Names of two links.
        rotation, position: Pose of the joint frame in the parent's frame [-, m].
        axis: Unit vector in the joint frame. Universal: the first axis; the second is the next of the
            right-handed triad (x, y, axis), that is x, carried along by the first. Planar: the normal;
            x and y of that triad are the directions of the slides.
        limits: (lower, upper) of the position, or one pair per degree of freedom [m or rad].
        rate: Largest speed, or one per degree of freedom [m/s or rad/s].
        effort: Largest force, or one per degree of freedom [N or N m].
        pitch: Advance of a helical joint [m/rad].
        damping: Force against the rate [N s/m or N m s/rad].
        stiffness: Force towards zero [N/m or N m/rad]; not for spherical joints.
        rotor_inertia: Reflected inertia of the drive, added to the diagonal of M [kg or kg m^2].

    Raises:
        RobotError: If a value is impossible; the message names the joint.
    """

    name: str
    kind: str
    parent: str
    child: str
    rotation: np.ndarray = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    position: np.ndarray = (0.0, 0.0, 0.0)
    axis: np.ndarray = (0.0, 0.0, 1.0)
    limits: tuple | None = None
    rate: float | tuple | None = None
    effort: float | tuple | None = None
    pitch: float = 0.0
    damping: float = 0.0
    stiffness: float = 0.0
    rotor_inertia: float = 0.0

    def __post_init__(self):
        here = f"joint {self.name!r}"
        put = lambda key, value: object.__setattr__(self, key, value)
        if self.kind not in KINDS:
            raise RobotError(f"{here} is of kind {self.kind!r}; the kinds are {', '.join(KINDS)}.")
        if self.parent == self.child:
            raise RobotError(f"{here} joins link {self.parent!r} to itself; parent and child must differ.")
        put("rotation", rotation(self.rotation, f"the rotation of {here}"))
        put("position", quantity(self.position, f"the position of {here}", (3,)))
        put("axis", unit(self.axis, f"the axis of {here}"))
        put("pitch", quantity(self.pitch, f"the pitch of {here}"))
        for key in ("damping", "stiffness", "rotor_inertia"):
            number(getattr(self, key), f"the {key} of {here}", least=0.0)
            put(key, quantity(getattr(self, key), f"the {key} of {here}", small=key != "rotor_inertia"))
        if self.pitch and self.kind != "helical":
            raise RobotError(f"{here} is {self.kind} and has a pitch; only a helical joint has one.")
        if self.stiffness and self.kind == "spherical":
            raise RobotError(f"{here} is spherical; a stiffness about no axis is not defined. Set it to 0.")
        self._check_bounds(here, put)

    def _check_bounds(self, here, put):
        """Limits as pairs and bounds as numbers, one per degree of freedom where there are several."""
        dof, plain = self.dof, lambda x: float(x[0]) if self.dof == 1 else tuple(map(float, x))
        for key in ("rate", "effort"):
            if getattr(self, key) is not None:
                x = _spread(getattr(self, key), (dof,), f"the {key} limit of {here}")
                if (x < 0).any():
                    raise RobotError(f"the {key} limit of {here} is {x.tolist()}; it must not be negative.")
                put(key, plain(x) if dof else None)
        if self.limits is not None:
            if self.kind == "spherical":
                raise RobotError(f"{here} is spherical; limits on its quaternion are not supported. Leave them out.")
            x = _spread(self.limits, (dof, 2), f"the limits of {here}")
            if (x[:, 0] > x[:, 1]).any():
                raise RobotError(f"the limits of {here} are {x.tolist()}; the lower one must come first.")
            put("limits", (tuple(map(float, x[0])) if dof == 1 else tuple(tuple(map(float, r)) for r in x)) or None)

    @cached_property
    def dof(self) -> int:
        """Degrees of freedom."""
        return KINDS[self.kind].dof

    @cached_property
    def nq(self) -> int:
        """Entries of q."""
        return KINDS[self.kind].nq

    @cached_property
    def is_near(self) -> bool:
        """Whether its lengths are ordinary ones."""
        return bool(max(np.abs(self.position).max(), abs(self.pitch)) < FAR)

    @cached_property
    def screws(self) -> np.ndarray:
        """Rows `[a; b]`, one per degree of freedom, in the joint frame; for spherical joints the child's axes."""
        a, o = self.axis, np.zeros(3)
        x, y = triad(a)
        turn, slide = lambda e: np.concatenate([e, o]), lambda e: np.concatenate([o, e])
        rows = {
            "fixed": [],
            "revolute": [turn(a)],
            "prismatic": [slide(a)],
            "helical": [np.concatenate([a, self.pitch * a])],
            "cylindrical": [slide(a), turn(a)],
            "universal": [turn(a), turn(x)],
            "planar": [slide(x), slide(y), turn(a)],
            "spherical": [turn(e) for e in np.eye(3)],
        }[self.kind]
        return np.array(rows).reshape(-1, 6)

    @cached_property
    def constants(self) -> np.ndarray:
        """Rotation, position and three screws [30]; screws that it has not are zero."""
        return np.concatenate([self.rotation.ravel(), self.position, self.screws.ravel(), np.zeros(18 - 6 * self.dof)])


def _spread(value, shape, what) -> np.ndarray:
    """One value for all degrees of freedom, or one for each."""
    try:
        x = np.broadcast_to(np.array(value), shape)
    except ValueError:
        one = "a pair (lower, upper)" if len(shape) == 2 else "a number"
        raise RobotError(f"{what} is {value!r}; it must be {one}, or one for each degree of freedom.") from None
    return array(x, shape, what)


def triad(axis) -> tuple[np.ndarray, np.ndarray]:
    """The x and y axes, turned by the smallest rotation that takes z to `axis` (about x if axis = -z)."""
    a, z = np.asarray(axis), np.array([0.0, 0.0, 1.0])
    if a[2] < -1 + 1e-12:
        return np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])
    R = lambda e: e - (a + z) * ((a + z) @ e) / (1 + a[2]) + 2 * a * (z @ e)  # Rodrigues, for z -> a
    return R(np.array([1.0, 0.0, 0.0])), R(np.array([0.0, 1.0, 0.0]))


@dataclass(frozen=True, eq=False)
class Frame(Part):
    """A named frame on a link (end-effector, grapple point): `x_link = rotation @ x_frame + position` [m]."""

    name: str
    link: str
    rotation: np.ndarray = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    position: np.ndarray = (0.0, 0.0, 0.0)

    def __post_init__(self):
        here = f"frame {self.name!r}"
        object.__setattr__(self, "rotation", rotation(self.rotation, f"the rotation of {here}"))
        object.__setattr__(self, "position", quantity(self.position, f"the position of {here}", (3,)))


@dataclass(frozen=True, eq=False)
class Loop(Part):
    """A closure between two frames, or between a frame and "ground".

    Args:
        name: Unique among the loops.
        frame_a, frame_b: Frame records; on link "ground" the pose is in the world.
        kind: weld, point, revolute, prismatic, universal, spherical, cylindrical or planar. The axis (planar: the
            normal) is frame a's z; the second axis of a universal joint is frame b's x.
    """

    name: str
    frame_a: Frame
    frame_b: Frame
    kind: str = "weld"

    def __post_init__(self):
        if self.kind not in CLOSURES:
            raise RobotError(f"loop {self.name!r} is of kind {self.kind!r}; the kinds are {', '.join(CLOSURES)}.")
        if self.frame_a.link == self.frame_b.link:
            raise RobotError(f"loop {self.name!r} closes link {self.frame_a.link!r} onto itself.")


def renamed(parts, prefix: str, *keys: str) -> tuple:
    """Copies of the parts with `prefix` before their names and before the names under `keys`."""
    new = lambda part: {k: prefix + getattr(part, k) for k in ("name", *keys)}
    parts = tuple(replace(part, **new(part)) for part in parts)
    distinct([part.name for part in parts], "part")
    return parts
