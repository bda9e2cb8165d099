"""Declarations: a `Capacity` holds sizes and is the compile key; a `Chain` is a structure packed into arrays of them.

Slots: the bodies are numbered `t W + w` in a schedule of T steps of width W, one degree of freedom each; the base is
slot `T W`, and slot `T W + 1` is a dummy that empty slots point to. Links locked together share a slot.
"""

import zlib
from dataclasses import dataclass, field
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sdyn.checks import RobotError, known


class SlotRow:
    """Rows of `Chain.slot_index`."""

    PARENT, DOF, QUAT, LIVE, JOINT, SCREW, SIGN, FORWARD, FIRST, FROM = range(10)


class ValueRow:
    """First rows of the parts of `Chain.slot_value`."""

    C0, C1, C2, POINT, SLIDE, AXIS, MASS, COM, INERTIA = 0, 9, 18, 27, 30, 33, 39, 40, 43


class BaseRow:
    """First entries of the parts of `Chain.base_value`."""

    MASS, COM, INERTIA, FREE, POSE = 0, 1, 4, 13, 14


class LinkRow:
    """Rows of `Chain.link_index`."""

    NAME, SLOT, PARENT, JOINT, FORWARD, FIXED = range(6)


class LoopRow:
    """Rows of `Chain.loop_index`. The link number behind the last one is the ground."""

    NAME, PRESENT, A, B = range(4)


class ClosureRow:
    """Rows of `Chain.row_index`. `PART` as in `parts.CLOSURES`."""

    LOOP, PART, LIVE = range(3)


class JointRow:
    """Rows of `Chain.joint_index`."""

    NAME, PRESENT, MOVES, Q, NQ, V, DOF, PARENT, CHILD = range(9)


class JointValue:
    """First columns of the parts of `Chain.joint_value`, and their number."""

    ROTATION, POSITION, SCREWS, LOCK, LOCK_QUAT, SIZE = 0, 9, 12, 30, 33, 37


@dataclass(frozen=True)
class Capacity:
    """Sizes of the arrays of a family of structures, and the names behind the indices.

    Two capacities with the same numbers are the same compile key, whatever the names.
    """

    steps: int
    """Steps of the schedule, T."""
    width: int
    """Bodies in a step, W."""
    links: int
    joints: int
    frames: int
    nq: int
    """Entries of q behind the base block."""
    nv: int
    """Entries of v behind the base block."""
    quaternions: int
    """Moving spherical joints."""
    loops: int
    rows: int
    """Rows of the closures: entries of lam."""
    frame: str
    """"common" or "link": the frame that the dynamics are computed in."""
    layout: str
    """"free" or "grounded": exact arrays of one structure; "padded": a base block always, zeros at the end."""
    link_names: tuple[str, ...] = field(compare=False)
    joint_names: tuple[str, ...] = field(compare=False)
    frame_names: tuple[str, ...] = field(compare=False)
    loop_names: tuple[str, ...] = field(compare=False)
    rebased: bool = False
    """Whether chains hold a second form, whose base is the heaviest body; see `heaviest.py`."""

    @property
    def slots(self) -> int:
        """Slots of bodies other than the base."""
        return self.steps * self.width

    @cached_property
    def numbers(self) -> dict[str, dict[str, int]]:
        """The number of each part by its name, for "link", "joint", "frame" and "loop"."""
        return {key: {name: k for k, name in enumerate(names)} for key, names in self._names().items()}

    @cached_property
    def hashes(self) -> dict[str, np.ndarray]:
        """Hashes of the names, in order, for "link", "joint", "frame" and "loop".

        Raises:
            RobotError: If two parts of a sort have the same hash.
        """
        out = {key: np.array([name_hash(name) for name in names], np.int32) for key, names in self._names().items()}
        for key, names in self._names().items():
            if len(set(out[key].tolist())) < len(names):
                raise RobotError(f"pack: two {key}s have the same hash of their names, {list(names)}; rename one.")
        return out

    def _names(self):
        return {key: getattr(self, key + "_names") for key in ("link", "joint", "frame", "loop")}

    @property
    def base_nq(self) -> int:
        """Entries of q of the base block."""
        return 0 if self.layout == "grounded" else 7

    @property
    def base_nv(self) -> int:
        """Entries of v of the base block."""
        return 0 if self.layout == "grounded" else 6


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Chain:
    """A structure, packed. Everything but `capacity` is traced: a change of structure is a change of data.

    Differentiable in every float array; in rotations, axes and quaternions, along those that keep their lengths.
    `slot_value`, `base_value` and `link_pose` follow from the original links and joints (`with_params` derives them
    anew).
    """

    slot_index: Int[Array, "10 steps width"]
    """Per slot: parent slot, degree of freedom, quaternion, live, joint, screw and its sign, joint
    traversed forward, first of its joint, link it hangs from."""
    slot_value: Float[Array, "steps 52 width"]
    """Per slot: rotation C0 + C1 cos q + C2 sin q in the parent's slot [9 each], its point and slide [m, m per unit
    of q], axis [a; b], and mass, centre and inertia of its body [kg, m, kg m^2]."""
    base_value: Float[Array, " 21"]
    """Mass, centre, inertia of the base body; 1 if it is free; pose of a grounded base [m, wxyz]."""
    ancestors: Bool[Array, "slots slots"]
    """[i, j]: whether slot j carries slot i, or is it."""
    link_index: Int[Array, "6 links"]
    """Per link: hash of its name, slot, parent in the tree, joint to it, forward, locked."""
    link_mass: Float[Array, " links"]
    link_com: Float[Array, "links 3"]
    link_inertia: Float[Array, "links 3 3"]
    """Mass, centre and inertia about it of the original links, link axes [kg, m, kg m^2]."""
    link_pose: Float[Array, "links 12"]
    """Rotation and position of each link in its slot [-, m]."""
    joint_index: Int[Array, "9 joints"]
    """Per joint: hash of its name, present, moves, first entry of q behind the base block, entries of q, the same two
    of v, declared parent and child link."""
    joint_value: Float[Array, "joints 37"]
    """Per joint: rotation and position in the declared parent, three screws, lock values, lock quaternion."""
    dof_value: Float[Array, "3 nv"]
    """Damping, stiffness and rotor inertia of each degree of freedom."""
    quat_index: Int[Array, "3 quaternions"]
    """Per quaternion: first entry of q, first of v behind the base block, 1 if the joint is traversed backwards."""
    dof_to_q: Int[Array, " nv"]
    """Entry of q behind the base block that belongs to each degree of freedom; -1 for spherical and empty ones."""
    frame_index: Int[Array, "2 frames"]
    """Per frame: hash of its name, link."""
    frame_value: Float[Array, "frames 12"]
    """Rotation and position of each frame in its link [-, m]."""
    loop_index: Int[Array, "4 loops"]
    """Per loop: hash of its name, present, links of the frames a and b."""
    loop_value: Float[Array, "loops 24"]
    """Rotation and position of frame a in its link (or in the world), and of frame b [-, m]."""
    row_index: Int[Array, "3 rows"]
    """Per row of the closures: its loop, which part of the relative twist it holds, live."""
    capacity: Capacity = field(metadata={"static": True})
    inner: "Chain | None" = None
    """The same structure with the heaviest body as base, where the user's is too light to compute from."""

    @property
    def dtype(self):
        """Floating-point type of the structure, and of what is computed with it."""
        return self.slot_value.dtype

    @property
    def free(self):
        """1 if the base is free, 0 if it is grounded."""
        return self.base_value[BaseRow.FREE]

    @property
    def nq(self) -> int:
        """Entries of q."""
        return self.capacity.base_nq + self.capacity.nq

    @property
    def nv(self) -> int:
        """Entries of v."""
        return self.capacity.base_nv + self.capacity.nv


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Params:
    """Inertial parameters of the original links, to differentiate or to estimate."""

    mass: Float[Array, " n"]
    """Masses [kg]."""
    com: Float[Array, "n 3"]
    """Centres of mass, link axes [m]."""
    inertia: Float[Array, "n 3 3"]
    """Inertias about the centres of mass, link axes [kg m^2]."""


def index_of(name, names: tuple[str, ...], hashes, what: str):
    """The index of a name or an index, by the hash of the name: names are data, so another robot of the same
    capacity finds its own.

    Raises:
        RobotError: While tracing, if no such name exists.
    """
    if not isinstance(name, str):
        if isinstance(name, int) and not -len(names) <= name < len(names):
            raise RobotError(f"there is no {what} {name}; the structure has {len(names)}.")
        return name
    known(name, names, what)
    return jnp.argmax(hashes == name_hash(name))


def name_hash(name: str) -> int:
    """A 31-bit hash of a name, the same in every process."""
    return zlib.crc32(name.encode()) & 0x7FFFFFFF
