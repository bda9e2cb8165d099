"""What is wrong with a robot, and what repairs it: the back end of `sdyn check`.

    for finding in doctor.examine(robot): print(finding)
    robot = doctor.repaired(robot)          # the inertias

A robot whose inertias are impossible can be loaded for this with `load(path, allow_unphysical=True)`.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from sdyn.checks import FAR, RobotError, hat, is_physical, principal_moments
from sdyn.heaviest import better_base
from sdyn.posture import link_poses, turn
from sdyn.robot import Robot

SIZE = 100.0  # m; the radius of gyration and the offset of a centre of mass that pass without a question
EMPTY = 1e-12  # share that is left of what an inertia is summed up from, below which it counts as none
LIGHT = 1e-9  # share of the mass of a robot below which a link does not count as ordinary


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, or that may be."""

    level: str
    """error: the dynamics are wrong or singular; warning: planners lack it; note: worth a look."""
    part: str
    """Which part, as in "link 'arm1'"."""
    wrong: str
    """What is wrong with it."""
    repair: str
    """What repairs it."""

    def __str__(self):
        return f"{self.level}: {self.part} {self.wrong}; {self.repair}."


def examine(robot: Robot) -> tuple[Finding, ...]:
    """Everything that looks wrong: errors first, then warnings, then notes; each in the order of the parts."""
    found = [x for link in robot.links for x in _link(link)]
    found += [x for joint in robot.moving for x in _joint(joint)]
    found += [x for name, value in robot.locked.items() for x in _locked(robot.joint(name), value)]
    found += loose_joints(repaired(robot))
    if better := better_base(robot):
        wrong = f"is a base much lighter than link {better!r}, from which dynamics are computed instead"
        found.append(Finding("note", f"link {robot.base!r}", wrong, f"leave it so; reroot({better!r}) is faster"))
    return tuple(sorted(found, key=lambda x: ("error", "warning", "note").index(x.level)))


def refuse_loose(robot: Robot) -> None:
    """Refuse a robot with a joint, or a free base, that nothing resists: its acceleration is not determined.

    Robots of ordinary links pass without a closer look, which would take longer than all other work on a structure.
    """
    if not _is_ordinary(robot):
        for finding in loose_joints(robot):
            raise RobotError(f"{finding.part} {finding.wrong}; {finding.repair}.")


def _is_ordinary(robot) -> bool:
    """Whether every moving body, and a free base, has a link that resists any motion by itself."""
    solid, tree = set(), robot.tree
    least = LIGHT * sum(link.mass for link in robot.links)
    body = [0] * len(robot.links)
    for i in tree.order:
        moves = tree.parent[i] < 0 or robot.moves[tree.joint[i]]
        body[i] = i if moves else body[tree.parent[i]]
        if robot.links[i].is_solid and robot.links[i].mass > least:
            solid.add(body[i])
    free = set(body) - ({tree.order[0]} if robot.grounded else set())
    near = all(joint.is_near for joint in robot.joints) and all(np.abs(x).max() < FAR for x in robot.locked.values())
    return near and free <= solid


def repaired(robot: Robot) -> Robot:
    """The same robot with the nearest possible inertia in each link whose own is impossible."""
    return replace(robot, links=tuple(map(_repaired_link, robot.links)))


def nearest_inertia(inertia) -> np.ndarray:
    """The possible inertia nearest to a given one, in the Frobenius norm [kg m^2].

    The principal axes stay. The principal moments are (b + c, a + c, a + b) of the second moments a, b, c >= 0
    of the mass along the axes, and the nearest such triple has some of them at zero and fits best in the others.
    """
    moments, axes = np.linalg.eigh((inertia + np.transpose(inertia)) / 2)
    shape = 1.0 - np.eye(3)
    best = (np.inf, np.zeros(3))
    for k in range(4):
        for free in map(list, combinations(range(3), k)):
            second = np.zeros(3)
            second[free] = np.linalg.lstsq(shape[:, free], moments)[0] if free else 0.0
            if second.min() >= 0.0:
                best = min(best, (np.linalg.norm(shape @ second - moments), tuple(second)))
    out = axes @ np.diag(shape @ np.array(best[1])) @ axes.T
    return (out + out.T) / 2


def _repaired_link(link):
    if is_physical(link.mass, link.inertia):
        return replace(link, allow_unphysical=False)
    return replace(link, inertia=nearest_inertia(link.inertia), allow_unphysical=False)


def _link(link):
    part = f"link {link.name!r}"
    words = lambda moments: "(" + ", ".join(f"{x:.6g}" for x in moments) + ") kg m^2"
    if not is_physical(link.mass, link.inertia):
        moments, better = principal_moments(link.inertia), principal_moments(nearest_inertia(link.inertia))
        yield Finding(
            "error",
            part,
            f"has an impossible inertia: of its principal moments {words(moments)} "
            + ("one is negative" if moments[0] < 0 else "one is larger than the sum of the others"),
            f"the nearest possible ones are {words(better)}, about the same axes (doctor.repaired)",
        )
    if link.mass == 0.0 and link.inertia.any():
        yield Finding("note", part, "has an inertia but no mass", "give it a mass, unless it is an idealised rotor")
    if link.mass == 0.0 and link.com.any():
        yield Finding("note", part, "has a centre of mass but no mass", "give it a mass, or leave the centre out")
    if link.mass > 0.0 and not link.inertia.any():
        yield Finding("note", part, f"has {link.mass:g} kg in one point", "give it an inertia about its centre of mass")
    if link.mass > 0.0 and principal_moments(link.inertia)[-1] > SIZE**2 * link.mass:
        radius = np.sqrt(principal_moments(link.inertia)[-1] / link.mass)
        yield Finding("note", part, f"has a radius of gyration of {radius:.3g} m", "check the units: kg, m, kg m^2")
    if np.linalg.norm(link.com) > SIZE:
        far = np.linalg.norm(link.com)
        yield Finding("note", part, f"has its centre of mass {far:.3g} m from its origin", "check the unit: m")


def _joint(joint):
    part = f"joint {joint.name!r}"
    if joint.limits is None and joint.kind in ("prismatic", "helical", "cylindrical"):
        yield Finding("warning", part, "has no limits", "give limits=(lower, upper) [m or rad]")
    elif joint.limits is None and joint.kind in ("revolute", "universal"):
        yield Finding("note", part, "has no limits", "give limits=(lower, upper) [rad], unless it is a wheel")
    for key, unit in (("rate", "m/s or rad/s"), ("effort", "N or N m")):
        bound = getattr(joint, key)
        if bound is None:
            yield Finding("warning", part, f"has no {key} limit", f"give {key}=... [{unit}]")
        elif not np.all(bound):
            yield Finding("warning", part, f"has a {key} limit of zero and cannot move", f"give {key}=... [{unit}]")
    if joint.limits is not None and not np.all(np.diff(joint.limits, axis=-1)):
        yield Finding("warning", part, "has equal limits and cannot move", "widen them, or lock it")
    if joint.limits is not None and joint.kind in ("revolute", "universal") and np.abs(joint.limits).max() > 8 * np.pi:
        wide = np.abs(joint.limits).max()
        yield Finding("note", part, f"has a limit of {wide:g} rad", "check the unit: radians, not degrees")


def _locked(joint, value):
    if joint.limits is not None:
        low, high = np.reshape(joint.limits, (-1, 2)).T
        if (value < low).any() or (value > high).any():
            wrong = f"is locked at {value.tolist()}, beyond its limits {joint.limits}"
            yield Finding("warning", f"joint {joint.name!r}", wrong, "lock it within them")


def loose_joints(robot):
    """Joints that nothing resists, at a configuration without symmetry: there the mass matrix is singular.

    Articulated inertias of all links, about the origin and in the axes of the base link, from the tips inwards.
    """
    tree = robot.tree
    values = crooked(robot)
    R, p = link_poses(robot, robot.configuration(values))
    index = {link.name: i for i, link in enumerate(robot.links)}
    inertia = np.array([spatial(link, R[i], p[i]) for i, link in enumerate(robot.links)])
    bare = [link.mass == 0.0 and not link.inertia.any() for link in robot.links]  # nor anything further out
    for i in reversed(tree.order[1:]):
        joint, up = robot.joints[tree.joint[i]], tree.parent[i]
        IA = inertia[i]
        if not robot.is_locked(joint):
            above = index[joint.parent]
            screws = screws_of(joint, values[joint.name], R[above], p[above])
            for S in screws[::-1] if tree.forward[i] else screws:
                U = IA @ S
                D = S @ U + joint.rotor_inertia
                if D <= EMPTY * (np.abs(S) @ np.abs(IA) @ np.abs(S) + joint.rotor_inertia):
                    yield _loose(joint, robot.links[i], bare[i])
                    break
                IA = IA - np.outer(U, U) / D
        inertia[up] += IA
        bare[up] &= bare[i]
    if not robot.grounded:
        total = inertia[tree.order[0]]
        scale = np.sqrt(np.maximum(np.diag(total), 1e-300))
        if np.linalg.eigvalsh(total / np.outer(scale, scale))[0] <= EMPTY or not total.any():
            yield Finding(
                "error",
                f"link {robot.base!r}",
                "is a free base that nothing keeps from accelerating without bound",
                "give it a mass and an inertia, or ground it",
            )


def _loose(joint, link, bare) -> Finding:
    if bare:
        wrong = f"moves link {link.name!r}, which has no mass and no inertia, nor has anything further out"
        return Finding("error", f"joint {joint.name!r}", wrong, "give it a mass and an inertia, or lock the joint")
    wrong = f"moves link {link.name!r} without any inertia about its axis: the mass is all on the axis"
    return Finding("error", f"joint {joint.name!r}", wrong, "give the link an inertia, or the joint a rotor_inertia")


def crooked(robot) -> dict:
    """Joint values without symmetry."""
    values = {}
    for k, joint in enumerate(robot.moving):
        x = 0.7 + 0.9 * np.sin(1.0 + 1.7 * k + 2.3 * np.arange(joint.nq))
        values[joint.name] = x / np.linalg.norm(x) if joint.kind == "spherical" else x
    return values


def spatial(link, R, p) -> np.ndarray:
    """Spatial inertia of a link about the world's origin [kg m^2, kg m, kg], angular first."""
    c = hat(R @ link.com + p)
    m = link.mass
    return np.block([[R @ link.inertia @ R.T + m * c @ c.T, m * c], [m * c.T, m * np.eye(3)]])


def screws_of(joint, value, R, p) -> np.ndarray:
    """The screws of a joint in world axes about the world's origin, each carried along by the ones before it.

    Args:
        joint, value: A joint that moves, and its coordinates.
        R, p: Pose of its declared parent in the world.
    """
    R, p, rows = R @ joint.rotation, R @ joint.position + p, []
    for screw, x in zip(joint.screws, np.zeros(3) if joint.kind == "spherical" else value, strict=True):
        axis = R @ screw[:3]
        rows.append(np.r_[axis, R @ screw[3:] + np.cross(p, axis)])
        R, p = R @ turn(screw[:3], x), p + R @ screw[3:] * x
    return np.array(rows)
