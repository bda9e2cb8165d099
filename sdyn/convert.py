"""A robot's states in the conventions of Pinocchio and of MuJoCo, and back. Host code that imports neither.

| | here | Pinocchio | MuJoCo |
|---|---|---|---|
| joints | as declared | in the order of `model.names` | in the order of the model's joints |
| free base, q | position, quaternion wxyz | position, quaternion xyzw | position, quaternion wxyz |
| free base, v | angular, linear; base axes | linear, angular; base axes | linear in world axes, angular in base axes |
| vdot | derivatives of these components | the same of its own | the same of its own |
| tau of the base | moment, force; base axes | force, moment; base axes | force in world axes, moment in base axes |
| revolute | angle | angle, or (cosine, sine) where continuous | hinge |
| prismatic | | | slide |
| helical | angle | the same | there is none |
| cylindrical, universal | two entries | one joint of two entries, or two joints | two joints |
| spherical | wxyz; rate in child axes | xyzw; the same rate | ball: the same in both |
| planar | x, y, angle; rates in parent axes | x, y, cosine, sine; slides in child axes | three joints |

All velocities of a base are of its origin, forces act there. A peer's joint has the name of the robot's joint, or of
one of its coordinates where the peer spreads it over several joints ("wrist.first", "wrist.second", as in
`robot.q_names`). That the peer's axes and frames are those of the robot is up to who built it.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sdyn.checks import RobotError, known
from sdyn.parts import KINDS
from sdyn.robot import Robot

CLOSE = 1e-6  # from unit length: quaternions, and pairs of cosine and sine


def pinocchio(robot: Robot, names, sizes) -> "Converter":
    """The converter to and from a Pinocchio model: `sdyn.convert.pinocchio(robot, model.names, model.nqs)`.

    Args:
        robot: Its moving joints must be those of the model. Carry the state of a robot with locked joints to an
            unlocked one first (`sdyn.transfer`) where the model has them.
        names: Names of the model's joints in its order. Those of size 0 ("universe") count for nothing; the free
            flyer of a free base may have any name.
        sizes: Entries of q of each: a revolute joint of size 2 is (cosine, sine), a planar one of size 4 has them last.

    Raises:
        RobotError: If a joint is missing, unknown or locked, or has another number of entries.
    """
    if len(names) != len(sizes):
        raise RobotError(f"{len(names)} names and {len(sizes)} sizes were given; give model.names and model.nqs.")
    entries = [(str(name), int(size)) for name, size in zip(names, sizes, strict=True) if size]
    return _converter("Pinocchio", robot, entries, PINOCCHIO)


def mujoco(robot: Robot, names) -> "Converter":
    """The converter to and from a MuJoCo model: `names = [model.joint(k).name for k in range(model.njnt)]`.

    Args:
        robot: Its moving joints must be those of the model, see `pinocchio`.
        names: Names of the model's joints in its order; the free joint of a free base may have any name, or none.

    Raises:
        RobotError: If a joint is missing, unknown or locked, or of a kind that MuJoCo has not.
    """
    return _converter("MuJoCo", robot, [(str(name), None) for name in names], MUJOCO)


class Turned(NamedTuple):
    """A part of v that the peer writes in axes that turn against ours: T(q) v, with dT/dt = T hat(spin)."""

    ours: slice
    theirs: slice
    rotation: slice  # in q: the quaternion of the base, or the angle of a planar joint
    spin: slice  # in v

    def axes(self, q) -> np.ndarray:
        """T [..., k, k]: base to world, or parent to child of a planar joint."""
        x = q[..., self.rotation]
        if x.shape[-1] == 4:
            return rotations(x)
        c, s = np.cos(x[..., 0]), np.sin(x[..., 0])
        return np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)

    def lag(self, v) -> np.ndarray:
        """hat(spin) v [..., k]; a planar joint turns about its normal, and T turns back."""
        w, x = v[..., self.spin], v[..., self.ours]
        return np.cross(w, x) if w.shape[-1] == 3 else w * np.stack([x[..., 1], -x[..., 0]], -1)


@dataclass(frozen=True, eq=False)
class Converter:
    """States in a peer's order and axes, and back; see `sdyn.convert` for both conventions.

    Every array may have batch axes in front, which broadcast; the type of the numbers stays. Units are SI and radians
    on both sides. Angles that the peer holds as (cosine, sine) come back within (-pi, pi]. All methods raise
    `RobotError` where a size is wrong, a number is not finite, or a quaternion is not of unit length.
    """

    peer: str
    """Pinocchio or MuJoCo."""
    q_at: np.ndarray
    """[nq of the peer] where each entry of its q is in ours; of a cosine and a sine, where their angle is."""
    v_at: np.ndarray
    """[nv] where each entry of its v is in ours."""
    circles: tuple[np.ndarray, np.ndarray]
    """Angles in our q, and places of their cosines in the peer's, which their sines follow."""
    quaternions: np.ndarray
    """[k, 4] places in our q."""
    turned: tuple[Turned, ...]

    def to_q(self, q) -> np.ndarray:
        """The peer's configuration [..., nq of the peer] of q [..., nq]."""
        q = self._ours(q)
        out, (angles, cosines) = q[..., self.q_at], self.circles
        out[..., cosines], out[..., cosines + 1] = np.cos(q[..., angles]), np.sin(q[..., angles])
        return out

    def from_q(self, q) -> np.ndarray:
        """Our configuration [..., nq] of the peer's."""
        q, (angles, cosines) = _given(q, len(self.q_at), f"{self.peer}'s q"), self.circles
        c, s = q[..., cosines], q[..., cosines + 1]
        _of_unit_length(np.hypot(c, s), f"(cosine, sine) in {self.peer}'s q")
        out = np.empty((*q.shape[:-1], 1 + self.q_at.max(initial=-1)), q.dtype)
        out[..., self.q_at] = q
        out[..., angles] = np.arctan2(s, c)
        return self._ours(out)

    def to_v(self, q, v) -> np.ndarray:
        """The peer's velocity [..., nv] of v [..., nv] at q."""
        return self._put(self._ours(q), self._rates(v, "v"))

    def from_v(self, q, v) -> np.ndarray:
        """Our velocity [..., nv] of the peer's, at the peer's q."""
        return self._take(self.from_q(q), self._rates(v, f"{self.peer}'s v"))

    def to_vdot(self, q, v, vdot) -> np.ndarray:
        """The peer's acceleration [..., nv] of vdot [..., nv] at q and v."""
        vdot, v = _alike(self._rates(vdot, "vdot"), self._rates(v, "v"))
        return self._put(self._ours(q), vdot + self._lag(v))

    def from_vdot(self, q, v, vdot) -> np.ndarray:
        """Our acceleration [..., nv] of the peer's, at the peer's q and v."""
        q, v = self.from_q(q), self.from_v(q, v)
        out, v = _alike(self._take(q, self._rates(vdot, f"{self.peer}'s vdot")), v)
        return out - self._lag(v)

    def to_tau(self, q, tau) -> np.ndarray:
        """The peer's generalised forces [..., nv] of tau [..., nv] at q: the same power on every velocity."""
        return self._put(self._ours(q), self._rates(tau, "tau"))

    def from_tau(self, q, tau) -> np.ndarray:
        """Our generalised forces [..., nv] of the peer's, at the peer's q."""
        return self._take(self.from_q(q), self._rates(tau, f"{self.peer}'s tau"))

    def _put(self, q, x):
        """T is orthogonal: forces turn as velocities do."""
        q, x = _alike(q, x)
        out = x[..., self.v_at]
        for part in self.turned:
            out[..., part.theirs] = np.einsum("...ij,...j->...i", part.axes(q), x[..., part.ours])
        return out

    def _take(self, q, x):
        q, x = _alike(q, x)
        out = np.empty_like(x)
        out[..., self.v_at] = x
        for part in self.turned:
            out[..., part.ours] = np.einsum("...ji,...j->...i", part.axes(q), x[..., part.theirs])
        return out

    def _lag(self, v):
        out = np.zeros_like(v)
        for part in self.turned:
            out[..., part.ours] = part.lag(v)
        return out

    def _ours(self, q):
        q = _given(q, 1 + self.q_at.max(initial=-1), "q")
        _of_unit_length(np.linalg.norm(q[..., self.quaternions], axis=-1), "a quaternion in q")
        return q

    def _rates(self, x, what):
        return _given(x, len(self.v_at), what)


def rotations(quaternions) -> np.ndarray:
    """Rotation matrices [..., 3, 3] of quaternions wxyz [..., 4] of any length."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    s = 2 / (w * w + x * x + y * y + z * z)
    rows = [
        [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
        [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)],
        [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


# -- what is where -----------------------------------------------------------------------------------------------------


class Form(NamedTuple):
    """How a peer writes one joint; all places count from the joint's first entry, here and there."""

    q: tuple[int, ...]
    """Of each entry of the peer's q, its place in ours."""
    v: tuple[int, ...]
    circle: tuple[int, int] | None = None
    """Place of the angle here, and of its cosine there."""
    turned: Turned | None = None


ONE, TWO, THREE = (Form(tuple(range(k)), tuple(range(k))) for k in (1, 2, 3))
PINOCCHIO = {  # by kind and entries of q
    "free": {7: Form((0, 1, 2, 4, 5, 6, 3), (3, 4, 5, 0, 1, 2))},
    "revolute": {1: ONE, 2: Form((0, 0), (0,), (0, 0))},
    "prismatic": {1: ONE},
    "helical": {1: ONE},
    "cylindrical": {2: TWO},
    "universal": {2: TWO},
    "planar": {
        3: THREE,  # a composite of three joints
        4: Form((0, 1, 2, 2), (0, 1, 2), (2, 2), Turned(slice(0, 2), slice(0, 2), slice(2, 3), slice(2, 3))),
    },
    "spherical": {4: Form((1, 2, 3, 0), (0, 1, 2))},
}
WORLD = Turned(slice(3, 6), slice(0, 3), slice(3, 7), slice(0, 3))
MUJOCO = {  # which tells no numbers of entries
    "free": {None: Form(tuple(range(7)), (3, 4, 5, 0, 1, 2), None, WORLD)},
    "revolute": {None: ONE},
    "prismatic": {None: ONE},
    "spherical": {None: Form((0, 1, 2, 3), (0, 1, 2))},
}
SLIDES = (".slide", ".x", ".y")  # of the coordinates of joints that have several, those that are lengths


def _converter(peer, robot, entries, forms) -> Converter:
    """The peer's joints one after the other."""
    here = f"the joints of the {peer} model"
    places = _places(robot)
    free = _name_of_base(robot, [name for name, _ in entries], places, here)
    q_at, v_at, circles, turned = [], [], [], []
    for name, size in entries:
        kind, q, v = ("free", 0, 0) if name == free else places[name]
        form = _form(kind, size, name, forms, peer, here)
        if form.circle:
            circles.append((q + form.circle[0], len(q_at) + form.circle[1]))
        if form.turned:
            shifts = (v, len(v_at), q, v)
            turned.append(Turned(*(slice(x.start + k, x.stop + k) for x, k in zip(form.turned, shifts, strict=True))))
        q_at += [q + k for k in form.q]
        v_at += [v + k for k in form.v]
    for k, name in enumerate(robot.v_names):
        if (times := v_at.count(k)) != 1:
            raise RobotError(
                f"{here} hold {name!r} of the robot {times} times; each must be there once. They are "
                f"{[name for name, _ in entries]}."
            )
    starts = [3] * (not robot.grounded) + [q for kind, q, _ in places.values() if kind == "spherical"]
    index = lambda x, *shape: np.array(x, int).reshape(shape)
    quaternions, circles = index(starts, -1, 1) + np.arange(4), index(circles, -1, 2)
    return Converter(peer, index(q_at, -1), index(v_at, -1), (*circles.T,), quaternions, tuple(turned))


def _places(robot) -> dict[str, tuple[str, int, int]]:
    """Kind, and first places in q and v, of each moving joint, and of each coordinate of those that have several."""
    out, q, v = {}, (0 if robot.grounded else 7), (0 if robot.grounded else 6)
    for joint in robot.moving:
        out[joint.name] = joint.kind, q, v
        if joint.dof > 1 and joint.kind != "spherical":
            for k, x in enumerate(KINDS[joint.kind].rates):
                out.setdefault(joint.name + x, ("prismatic" if x in SLIDES else "revolute", q + k, v + k))
        q, v = q + joint.nq, v + joint.dof
    return out


def _name_of_base(robot, names, places, here) -> str | None:
    """The one name that is no joint's stands for the free base; None where the base is grounded."""
    for name in names:
        if name in robot.locked:
            raise RobotError(
                f"{here}: {name!r} is locked in the robot and has no coordinate; carry the state to the unlocked robot "
                f"by sdyn.transfer, or build the model without it."
            )
    others = [name for name in names if name not in places]
    if not robot.grounded and not others:
        raise RobotError(f"{here} hold none for the free base of the robot; add its free joint, or ground the robot.")
    for name in others[not robot.grounded :]:
        beside = "the robot is grounded" if robot.grounded else f"{others[0]!r} stands for its free base"
        known(name, places, f"moving joint ({here} hold it, and {beside}) named")
    return None if robot.grounded else others[0]


def _form(kind, size, name, forms, peer, here) -> Form:
    """How the peer writes a joint."""
    if kind not in forms:
        parts = ", ".join(repr(name + x) for x in KINDS[kind].rates)
        remedy = f"name its coordinates instead: {parts}" if KINDS[kind].dof > 1 else "it cannot be converted"
        raise RobotError(f"{here}: {name!r} is {kind}, and {peer} has no such joint; {remedy}.")
    if size not in forms[kind]:
        sizes = " or ".join(map(str, forms[kind]))
        raise RobotError(f"{here}: {name!r} has {size} entries of q; a {kind} joint has {sizes}.")
    return forms[kind][size]


def _given(x, size, what) -> np.ndarray:
    """An array [..., size] of finite floats."""
    x = np.asarray(x)
    if x.dtype.kind not in "iuf" or x.shape[-1:] != (size,):
        raise RobotError(f"{what} has shape {x.shape} and type {x.dtype}; it must hold numbers, [..., {size}].")
    if not np.isfinite(x).all():
        raise RobotError(f"{what} has an entry that is not finite.")
    return x.astype(np.result_type(x, np.float32), copy=False)


def _of_unit_length(lengths, what):
    worst = lengths.ravel()[np.abs(lengths - 1).argmax()] if lengths.size else 1.0
    if abs(worst - 1) > CLOSE:
        raise RobotError(f"{what} has length {worst:.6g}; it must be 1.")


def _alike(*arrays):
    """The arrays [..., k] with the same batch axes."""
    try:
        batch = np.broadcast_shapes(*(x.shape[:-1] for x in arrays))
    except ValueError:
        shapes = " and ".join(str(x.shape) for x in arrays)
        raise RobotError(
            f"arrays of shapes {shapes} are of different batches; all axes but the last must fit."
        ) from None
    return [np.broadcast_to(x, (*batch, x.shape[-1])) for x in arrays]
