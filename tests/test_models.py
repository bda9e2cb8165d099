"""The shipped models: they load, say where their numbers come from, and are sound."""

import numpy as np
import pytest

from sdyn import doctor, models
from sdyn.checks import RobotError, is_physical
from sdyn.posture import link_poses

NAMES = ("deos7", "envisat", "ets7", "iiwa_free", "paper37", "planar100", "planar3", "sat50")
# Degrees of freedom, total mass [kg], and how far ahead of its first joint a stretched arm's hand is [m].
FACTS = {
    "deos7": (13, 696.2 + 7 * 3.3, 0.256 + 1.3245 + 0.126 + 0.9245 + 0.126 + 0.1645 + 0.1855),
    "envisat": (6, 7827.867, None),
    "ets7": (12, 2550 + 35 + 22.5 + 21.9 + 16.5 + 26 + 18.5, None),
    "iiwa_free": (13, 1000 + 17.5, 0.2025 + 0.42 + 0.4 + 0.126),
    "paper37": (37, 696.2 + 4 * 17.5 + 3 * 5, 0.2025 + 0.42 + 0.4 + 0.126),
    "planar100": (9, 100 + 10 + 8 + 4.1, 0.9 + 0.7 + 0.305),
    "planar3": (9, 64.859 + 2.913 + 2.646 + 1.699, 0.4488 + 0.4499 + 0.3545),
    "sat50": (6, 50.0, None),
}


def hand(robot, values=()):
    """Pose in the base of the first frame of a robot."""
    frame = robot.frames[0]
    R, p = link_poses(robot, robot.configuration(values))
    i = [link.name for link in robot.links].index(frame.link)
    return R[i] @ frame.rotation, R[i] @ frame.position + p[i]


def test_names():
    assert models.names() == NAMES and set(FACTS) == set(NAMES)
    with pytest.raises(RobotError, match="no model 'deos'; did you mean 'deos7'"):
        models.load("deos")
    with pytest.raises(RobotError, match=r"no model '\.\./deos7'"):
        models.load("../deos7")


@pytest.mark.parametrize("name", NAMES)
def test_a_model_is_sound_and_says_where_it_comes_from(name):
    robot = models.load(name)
    dof, mass, reach = FACTS[name]
    assert robot.name == name and robot.nv == dof and not robot.grounded and robot.frames
    assert sum(link.mass for link in robot.links) == pytest.approx(mass, rel=1e-14)
    assert all(is_physical(link.mass, link.inertia) and not link.allow_unphysical for link in robot.links)
    assert len(robot.source) > 200
    assert [x for x in doctor.examine(robot) if x.level != "note"] == []
    for joint in robot.joints:
        assert joint.rate > 0 and joint.effort > 0
        assert (joint.limits is None) == joint.name.startswith("wheel")
    if robot.joints and robot.joints[0].limits:
        assert "laceholder" in robot.source
    if reach is not None:
        R, p = hand(robot)
        assert R[:, 2] @ (p - robot.joints[0].position) == pytest.approx(reach, abs=1e-6)


def test_what_was_repaired_is_said():
    assert "Repaired" in models.load("ets7").source and "Changed" in models.load("deos7").source
    published = {"arm1": (0.25, 0.25, 1.69), "arm2": (0.1, 1.31, 3.75), "arm3": (0.1, 0.71, 2.53)}
    for name, moments in published.items():
        nearest = doctor.nearest_inertia(np.diag(moments))
        assert np.allclose(models.load("ets7").link(name).inertia, nearest, atol=2e-6)


def test_paper37_is_four_arms_and_three_wheels():
    robot = models.load("paper37")
    names = [f"arm{k}_{i}" for k in range(1, 5) for i in range(1, 8)] + [f"wheel_{k}" for k in (1, 2, 3)]
    assert [joint.name for joint in robot.joints] == names
    assert [frame.name for frame in robot.frames] == ["hand1", "hand2", "hand3", "hand4"]
    R, _ = link_poses(robot, robot.neutral())
    index = {link.name: i for i, link in enumerate(robot.links)}
    axes = [R[index[joint.child]] @ joint.axis for joint in robot.joints[-3:]]
    assert np.allclose(axes, np.eye(3), atol=1e-15)
    arms = [robot.joint(f"arm{k}_1") for k in (1, 2, 3, 4)]
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for a, b in zip(arms, [*arms[1:], arms[0]], strict=True):  # each arm is the one before, a quarter turn on
        assert np.allclose(quarter @ a.position, b.position) and np.allclose(quarter @ a.rotation, b.rotation)


def test_hands_and_grasps_point_the_right_way():
    for name in ("deos7", "iiwa_free", "paper37"):  # stretched out, the hand's z axis is that of the first joint
        robot = models.load(name)
        assert np.allclose(hand(robot)[0][:, 2], robot.joints[0].rotation[:, 2], atol=1e-15)
    assert np.allclose(hand(models.load("planar3"))[0][:, 2], (1, 0, 0))
    for name in ("sat50", "envisat"):  # the z axis of a hand that holds the target points into it
        robot = models.load(name)
        frame = robot.frame("grasp")
        assert frame.rotation[:, 2] @ (robot.links[0].com - frame.position) > 0


def test_arms_reach_in_front_of_the_base():
    _, p = hand(models.load("iiwa_free"), {"joint2": 0.6, "joint4": -1.2, "joint6": 0.8})
    assert p[0] > 0.5 and p[2] > 1.0
    _, p = hand(models.load("paper37"), {"arm1_2": -1.2, "arm1_4": 0.8})
    assert p[0] < 0.5 and p[2] > 1.2
    _, p = hand(models.load("ets7"), {"joint2": 0.5, "joint3": 1.0})
    assert p[2] > 2.0
