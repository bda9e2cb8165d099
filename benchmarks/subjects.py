"""The robots that are measured."""

import numpy as np

import sdyn


def compared() -> dict[str, sdyn.Robot]:
    """Those that all libraries get: 31, 3 and 7 joints on a free base."""
    full = sdyn.models.load("paper37")
    reduced = full.lock({joint.name: 0.3 for joint in full.moving[3:]})
    return {"paper37": full, "9-DOF form": reduced, "iiwa_free": sdyn.models.load("iiwa_free")}


def arms(count: int, joints: int) -> sdyn.Robot:
    """A free base of 100 kg with equal arms; one arm is a chain, arms of one joint are a bush."""
    links = [sdyn.Link("base", 100.0, inertia=10.0 * np.eye(3))]
    hinges, axes = [], np.eye(3)
    for a in range(count):
        turn = 2 * np.pi * a / count
        place, parent = (np.cos(turn), np.sin(turn), 0.0), "base"
        for k in range(joints):
            name = f"{a}_{k}"
            links.append(sdyn.Link(f"l{name}", 1.0, (0.0, 0.01, 0.05), np.diag([0.01, 0.012, 0.004])))
            hinges.append(sdyn.Joint(f"j{name}", "revolute", parent, f"l{name}", position=place, axis=axes[k % 3]))
            place, parent = (0.0, 0.0, 0.1), f"l{name}"
    return sdyn.Robot(links, hinges, name=f"{count} x {joints}")


def chain(joints: int) -> sdyn.Robot:
    """One arm."""
    return arms(1, joints)


def bush(joints: int) -> sdyn.Robot:
    """Arms of one joint."""
    return arms(joints, 1)
