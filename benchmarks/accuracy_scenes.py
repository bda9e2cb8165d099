"""The motions whose error is measured, each with a reference that is not the library's own."""

import sys
from pathlib import Path

import newton_euler
import numpy as np

import sdyn
from sdyn.rigid import merged

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import scenes

STEPS, DT = 10, 0.05  # of the motions of free trees


def flying(robot):
    """Half a second without forces, at rates of about 0.5 rad/s, in long double."""
    rng = np.random.default_rng(1)
    joints = {joint.name: x for joint, x in zip(sdyn.models.load("paper37").moving, rng.normal(size=31), strict=True)}
    q = np.asarray(robot.neutral(), float)
    q[7:] = [joints.get(joint.name, 0.3) for joint in robot.moving]
    v = 0.5 * rng.normal(size=robot.nv)
    return sdyn.pack(robot), newton_euler.motion(robot, q, v, DT, STEPS), scenes.free, DT, None


def all_of_them() -> dict:
    """Chain, states of the reference, force (t, q, v), step and gravity, by name."""
    full = sdyn.models.load("paper37")
    reduced = merged(full.lock({joint.name: 0.3 for joint in full.moving[3:]}))
    return {
        "top": scenes.top,
        "top at 300 rad/s": scenes.fast_top,
        "four-bar": scenes.four_bar,
        "stiff governor": scenes.governor,
        "free flyer, 13 DOF": lambda: flying(sdyn.models.load("iiwa_free")),
        "Andrews": scenes.andrews,
        "robot, 9 of 37 DOF": lambda: flying(reduced),
        "robot, 37 DOF": lambda: flying(full),
    }


CHOSEN = "top", "four-bar", "stiff governor", "free flyer, 13 DOF", "Andrews"  # where a wanted error is asked for
