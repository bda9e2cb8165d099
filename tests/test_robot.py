"""Robots and their edits: names, coordinates, the paper's tables, and what is refused in which words."""

import re

import numpy as np
import pytest

from sdyn import models
from sdyn.checks import RobotError
from sdyn.parts import KINDS, Frame, Joint, Link, Loop
from sdyn.robot import Robot

I = np.eye(3)


def body(name, mass=1.0):
    return Link(name, mass, inertia=0.1 * I)


def hinge(name, parent, child, **rest):
    return Joint(name, "revolute", parent, child, position=(0.0, 0.0, 1.0), **rest)


def tree(parents: dict, tips=(), **rest) -> Robot:
    """A robot from {link: parent}, with a frame `tip_<link>` on each tip."""
    base, *others = parents
    joints = [hinge(f"j{link}", parents[link], link) for link in others]
    return Robot([body(x) for x in parents], joints, [Frame(f"tip_{x}", x) for x in tips], base=base, **rest)


def refused(*words):
    """The error whose message holds all the words, is one or two sentences, and ends like one."""
    return pytest.raises(RobotError, match="(?s)" + "".join(f"(?=.*{re.escape(word)})" for word in words) + r".*[.?]$")


# -- coordinates -------------------------------------------------------------------------------------------------------


def every_kind() -> Robot:
    kinds = [kind for kind in KINDS if kind != "fixed"]
    links = [body("base"), *(body(f"b_{kind}") for kind in kinds)]
    return Robot(links, [Joint(kind, kind, "base", f"b_{kind}", pitch=0.1 * (kind == "helical")) for kind in kinds])


def test_names_of_coordinates():
    robot = every_kind()
    base = tuple(f"base.{x}" for x in ("x", "y", "z", "qw", "qx", "qy", "qz"))
    joints = (
        *("revolute", "prismatic", "helical", "cylindrical.slide", "cylindrical.angle"),
        *("universal.first", "universal.second", "planar.x", "planar.y", "planar.angle"),
        *("spherical.qw", "spherical.qx", "spherical.qy", "spherical.qz"),
    )
    assert robot.q_names == base + joints
    assert robot.v_names[:6] == tuple(f"base.{x}" for x in ("wx", "wy", "wz", "vx", "vy", "vz"))
    assert robot.v_names[-3:] == ("spherical.wx", "spherical.wy", "spherical.wz")
    assert (robot.nq, robot.nv) == (7 + 14, 6 + 13)
    assert robot.ground("base").q_names == joints
    assert (robot.ground("base").nq, robot.ground("base").nv) == (14, 13)


def test_configuration_by_names():
    robot = every_kind()
    q = robot.configuration({"planar": [1, 2, 3], "helical": 4}, position=(5, 6, 7))
    q = dict(zip(robot.q_names, q, strict=True))
    assert [q[f"planar.{x}"] for x in ("x", "y", "angle")] == [1, 2, 3]
    assert (q["helical"], q["base.z"], q["base.qw"], q["spherical.qw"], q["revolute"]) == (4, 7, 1, 1, 0)
    assert np.array_equal(robot.neutral(), robot.configuration())
    v = dict(zip(robot.v_names, robot.velocity({"spherical": [1, 2, 3]}, twist=range(6)), strict=True))
    assert (v["spherical.wz"], v["base.wy"], v["base.vz"], v["planar.x"]) == (3, 1, 5, 0)
    with refused("wrist", "moving joint"):
        robot.configuration({"wrist": 1.0})
    with refused("'helical'", "locked", "unlock"):
        robot.lock({"helical": 1.0}).configuration({"helical": 1.0})
    with refused("'planar'", "shape"):
        robot.configuration({"planar": 1.0})
    with refused("quaternion", "length"):
        robot.configuration(quaternion=(1, 1, 0, 0))


# -- edits -------------------------------------------------------------------------------------------------------------


def test_lock_takes_coordinates_away_and_unlock_brings_them_back():
    robot = models.load("paper37")
    assert robot.nv == 37
    keep = {"arm1_2", "arm1_4", "arm1_6"}
    small = robot.lock({joint.name: 0.1 for joint in robot.joints if joint.name not in keep})
    assert len(small.locked) == 28 and small.nv == 9
    assert small.v_names[6:] == ("arm1_2", "arm1_4", "arm1_6")
    assert len(small.links) == len(robot.links)
    assert small.unlock() == robot
    assert small.unlock(["arm3_1"]).v_names[6:] == ("arm1_2", "arm1_4", "arm1_6", "arm3_1")
    assert small.unlock("arm3_1") == small.unlock(["arm3_1"])
    assert robot.lock({"arm1_1": 1.0}).lock({"arm1_1": 2.0}).locked["arm1_1"] == 2.0
    with refused("'arm1_9'", "did you mean 'arm1_7'"):
        robot.lock({"arm1_9": 0.0})
    with refused("arm1_1", "not locked"):
        robot.unlock(["arm1_1"])
    with refused("'arm1_1'", "finite"):
        robot.lock({"arm1_1": np.nan})
    with refused("'arm1_1'", "number"):
        robot.lock({"arm1_1": "0.1"})


def test_reroot_keeps_names_order_and_sign():
    robot = models.load("deos7")
    turned = robot.reroot("arm7")
    assert turned.base == "arm7" and turned.joints == robot.joints and turned.links == robot.links
    assert turned.v_names[6:] == robot.v_names[6:] and turned.v_names[0] == "arm7.wx"
    assert turned.reroot("base") == robot
    assert turned.tree.order == tuple(reversed(range(8))) and not any(turned.tree.forward[:7])
    with refused("'arm8'", "arm7"):
        robot.reroot("arm8")


def test_ground_and_release():
    robot = models.load("deos7")
    held = robot.reroot("arm7").ground("hand", ([[0, -1, 0], [1, 0, 0], [0, 0, 1]], (1, 2, 3)))
    rotation, position = held.ground_pose
    hand = robot.frame("hand")
    assert np.allclose(rotation @ hand.position + position, (1, 2, 3), atol=1e-15)
    assert held.nv == 7 and held.release() == robot.reroot("arm7")
    seven = robot.ground("base", [1, 2, 3, np.cos(0.1), 0, 0, np.sin(0.1)])
    assert np.allclose(seven.ground_pose[0][:2, :2], [[np.cos(0.2), -np.sin(0.2)], [np.sin(0.2), np.cos(0.2)]])
    with refused("'hand'", "'arm7'", "reroot"):
        robot.ground("hand")
    with refused("'claw'"):
        robot.ground("claw")
    with refused("'base'", "free already"):
        robot.release()
    with refused("'arm7'", "grounded already"):
        held.ground("hand")
    with refused("'arm7'", "release"):
        held.reroot("base")
    with refused("'base'", "not a rotation"):
        robot.ground("base", (2 * I, (0, 0, 0)))


def test_close_and_open():
    robot = models.load("paper37")
    closed = robot.close("hand1", "hand2", "revolute").close("hand3", "ground", name="anchor")
    assert [loop.name for loop in closed.loops] == ["hand1_hand2", "anchor"]
    assert closed.nv == robot.nv and closed.open("anchor").open("hand1_hand2") == robot
    assert closed.close(Frame("mark", "base"), "hand4").loops[-1].frame_a.link == "base"
    with refused("'hand9'", "did you mean 'hand4'"):
        robot.close("hand1", "hand9")
    with refused("'clasp'", "weld"):
        robot.close("hand1", "hand2", "clasp")
    with refused("'tail'", "link"):
        robot.close(Frame("mark", "tail"), "hand1")
    with refused("'base'", "itself"):
        robot.close(Frame("a", "base"), Frame("b", "base"))
    with refused("hand1_hand2", "unique"):
        closed.close("hand1", "hand2")
    with refused("'anker'", "anchor"):
        closed.open("anker")


def test_attach_and_detach():
    robot, target = models.load("deos7"), models.load("sat50").prefixed("t_")
    both = robot.attach(target, "hand", "t_grasp")
    assert both.nv == 13 and both.links == robot.links + target.links and both.base == "base"
    assert both.joints[-1].name == "hand_t_grasp"
    chaser, free = both.detach("hand_t_grasp")
    assert chaser.links == robot.links and chaser.joints == robot.joints and chaser.frames == robot.frames
    assert free.links == target.links and free.base == "t_target" and free.nv == 6
    jointed = robot.attach(target, "hand", "t_grasp", kind="revolute", name="fixture")
    assert jointed.v_names[-1] == "fixture" and jointed.nv == 14
    with refused("'base'", "unique", "prefixed"):
        robot.attach(robot, "hand", "hand")
    with refused("grasp", "t_grasp"):
        robot.attach(target, "hand", "grasp")
    with refused("grounded", "release"):
        robot.attach(target.ground("t_target"), "hand", "t_grasp")
    with refused("'fixture'"):
        both.detach("fixture")
    with refused("'held'", "open"):
        both.close("hand", Frame("rim", "t_target", position=(0, 0, 1)), name="held").detach("hand_t_grasp")


def test_prefixed_names_everything():
    robot = models.load("deos7").lock({"joint1": 0.2}).close("hand", "ground", name="hold")
    other = robot.prefixed("t_")
    assert other.base == "t_base" and other.locked.keys() == {"t_joint1"}
    assert other.loops[0].frame_a.link == "t_arm7" and other.loops[0].frame_b.link == "ground"
    names = [x.name for part in (other.links, other.joints, other.frames, other.loops) for x in part]
    assert all(name.startswith("t_") for name in names)


def test_a_robot_cannot_be_changed_in_place():
    robot = models.load("deos7")
    with pytest.raises(AttributeError):
        robot.base = "arm1"
    with pytest.raises(ValueError, match="read-only"):
        robot.links[0].inertia[0, 0] = 1.0
    assert len({robot, robot.reroot("arm1"), models.load("deos7")}) == 2 and robot == models.load("deos7")


# -- the paper's tables ------------------------------------------------------------------------------------------------

# Figure 2: a base, link 1 with the branches 2 and 3-4, and the branch 5-6-7.
FIGURE_2 = {"0": None, "1": "0", "2": "1", "3": "1", "4": "3", "5": "0", "6": "5", "7": "6"}


def test_table_2():
    robot = tree(FIGURE_2, tips=("2", "4", "7"))
    before = [
        (1, 0, 0, 0, -1),
        (2, 1, 1, 0, -1),  # print: end-effector 0, a misprint; link 2 is a leaf like 4 and 7
        (3, 1, 0, 0, -1),
        (4, 3, 2, 0, -1),
        (5, 0, 0, 0, -1),
        (6, 5, 0, 0, -1),  # print: parent 6, the link itself, a misprint
        (7, 6, 3, 0, -1),  # print: parent 7, the link itself, a misprint; connect 2, unexplained: no joint is locked
    ]
    assert [tuple(row) for row in robot.table()] == before
    closed = robot.close("tip_2", "tip_7")
    assert [tuple(row) for row in closed.table()] == [*before[:6], (7, 6, 3, 0, 2)]
    assert [tuple(row) for row in closed.open("tip_2_tip_7").table()] == before


def test_table_3():
    parents = {"1": None, "2": "1", "3": "2", "4": "3", "5": "4", "6": "1", "7": "6", "8": "7", "9": "8"}
    robot = tree(parents, tips=("5", "9"))
    free = [row[3] for row in robot.table(base=1)]
    locked = robot.lock({f"j{k}": 0.1 * k for k in range(4, 10)})
    assert free == [0] * 9
    assert [tuple(row) for row in locked.table(base=1)] == [
        (1, 0, 0, 0, -1),
        (2, 1, 0, 0, -1),
        (3, 2, 0, 0, -1),
        (4, 3, 0, 2, -1),  # print: connect 0; links 4 and 5 are one locked run of 2, marked on each link here
        (5, 4, 1, 2, -1),
        (6, 1, 0, 4, -1),
        (7, 6, 0, 4, -1),
        (8, 7, 0, 4, -1),
        (9, 8, 2, 4, -1),
    ]
    after = [(1, 0, 0, 0, -1), (2, 1, 0, 0, -1), (3, 2, 1, 0, -1)]
    assert [tuple(row) for row in locked.table(base=1, merged=True)] == after
    assert locked.table(base=1, merged=True).names == ("1", "2", "3")
    assert locked.nv == 6 + 2


def test_numbering_rule_of_a_branched_system():
    """Section III-B: from the new base along the system until an end-effector, then the remaining branches."""
    robot = tree(FIGURE_2, tips=("2", "4", "7")).reroot("4")
    table = robot.table()
    assert table.names == ("3", "1", "0", "5", "6", "7", "2")
    # the chain 4-3-1-0-5-6-7 is numbered 0..6; branch 2 hangs on the number that its old parent, link 1, received
    assert [tuple(row)[:3] for row in table] == [
        (1, 0, 0),
        (2, 1, 0),
        (3, 2, 0),
        (4, 3, 0),
        (5, 4, 0),
        (6, 5, 1),
        (7, 2, 2),
    ]
    assert robot.reroot("0").table() == tree(FIGURE_2, tips=("2", "4", "7")).table()


def test_example_2_closes_loops_inverts_and_grounds():
    """Example IV-B: end-effector 2 joined to 1, inversion to end-effector 1, ground, the third arm closed to ground."""
    parents = {"0": None, "1": "0", "2": "1", "3": "2", "4": "0", "5": "4", "6": "0", "7": "6"}
    robot = tree(parents, tips=("3", "5", "7")).close("tip_5", "tip_3")
    assert [row.cflag for row in robot.table()] == [-1, -1, -1, -1, 3, -1, -1]
    held = robot.reroot("3").ground("tip_3").close("tip_7", "ground")
    table = held.table()
    assert table.names == ("2", "1", "0", "4", "5", "6", "7")
    assert [row.parent for row in table] == [0, 1, 2, 3, 4, 3, 6]
    assert [row.cflag for row in table] == [-1, -1, -1, -1, 0, -1, 0]


def test_example_1_is_a_fixed_base_system_of_two_degrees_of_freedom():
    robot = tree({"base": None, "link": "base"}, tips=("link",))
    fixture = Robot([body("fixture")], frames=[Frame("grip", "fixture")])
    held = robot.attach(fixture, "tip_link", "grip", kind="revolute").reroot("fixture").ground("grip")
    assert held.nv == 2


def test_table_prints():
    text = str(models.load("deos7").lock({"joint2": 0.0}).table())
    assert text.splitlines()[0].split() == ["link", "parent", "end-effector", "connect", "cflag", "name"]
    assert text.splitlines()[2].split() == ["2", "1", "0", "1", "-1", "arm2"]


# -- what is refused ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mass": -1.0}, ["mass", "at least 0"]),
        ({"mass": np.nan}, ["mass", "finite"]),
        ({"mass": np.inf}, ["mass", "finite"]),
        ({"mass": "1_000"}, ["mass", "number"]),
        ({"mass": 10**400}, ["mass", "number"]),
        ({"mass": None}, ["mass", "number"]),
        ({"com": (0.0, np.nan, 0.0)}, ["centre of mass", "finite"]),
        ({"com": (0.0, 0.0)}, ["centre of mass", "shape (2,)", "shape (3,)"]),
        ({"com": "abc"}, ["centre of mass", "numbers"]),
        ({"inertia": (1, 1, 1)}, ["inertia", "shape (3,)"]),
        ({"inertia": [[1, 0], [0, 1, 0], [0, 0, 1]]}, ["inertia", "different length"]),
        ({"inertia": [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]}, ["inertia", "symmetric"]),
        ({"inertia": np.diag([1.0, 1.0, 5.0])}, ["impossible", "(1, 1, 5)", "allow_unphysical"]),
        ({"inertia": np.diag([1.0, 1.0, -1.0])}, ["impossible", "-1"]),
        ({"inertia": np.full((3, 3), np.inf)}, ["inertia", "finite"]),
    ],
)
def test_impossible_links(change, words):
    with refused("'arm'", *words):
        Link(**{"name": "arm", "mass": 1.0, "inertia": I, **change})


def test_an_impossible_inertia_can_be_asked_for():
    assert Link("arm", 1.0, inertia=np.diag([1.0, 1.0, 5.0]), allow_unphysical=True).inertia[2, 2] == 5.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"kind": "ball"}, ["'ball'", "spherical"]),
        ({"child": "a"}, ["'a'", "itself"]),
        ({"axis": (0, 0, 0)}, ["axis", "zero"]),
        ({"axis": (0, 0, 2)}, ["axis", "length 2", "[0.0, 0.0, 1.0]"]),
        ({"axis": (0, 0, np.nan)}, ["axis", "finite"]),
        ({"rotation": 2 * I}, ["rotation"]),
        ({"rotation": np.diag([1.0, 1.0, -1.0])}, ["rotation", "determinant"]),
        ({"rotation": np.zeros((3, 3))}, ["rotation"]),
        ({"rotation": (1, 0, 0, 0)}, ["rotation", "shape"]),
        ({"position": (0, 0)}, ["position", "shape"]),
        ({"limits": (1, -1)}, ["limits", "lower"]),
        ({"limits": (0, 1, 2)}, ["limits", "pair"]),
        ({"limits": (None, 1)}, ["limits", "numbers"]),
        ({"limits": (-np.inf, 1)}, ["limits", "finite"]),
        ({"rate": -1}, ["rate", "negative"]),
        ({"rate": (1, 2)}, ["rate", "number"]),
        ({"effort": "much"}, ["effort", "number"]),
        ({"effort": np.nan}, ["effort", "finite"]),
        ({"damping": -1}, ["damping", "at least 0"]),
        ({"rotor_inertia": np.nan}, ["rotor_inertia", "finite"]),
        ({"pitch": 0.1}, ["pitch", "helical"]),
        ({"kind": "spherical", "stiffness": 1.0}, ["spherical", "stiffness"]),
        ({"kind": "spherical", "limits": (0, 1)}, ["spherical", "limits"]),
    ],
)
def test_impossible_joints(change, words):
    with refused("'elbow'", *words):
        Joint(**{"name": "elbow", "kind": "revolute", "parent": "a", "child": "b", **change})


def test_rounding_is_removed_and_nothing_else():
    joint = Joint("elbow", "revolute", "a", "b", axis=(0, 0, 1 + 1e-8), rotation=I + 1e-8)
    assert joint.axis[2] == 1.0 and np.abs(joint.rotation.T @ joint.rotation - I).max() < 4e-15
    again = Joint("elbow", "revolute", "a", "b", axis=joint.axis, rotation=joint.rotation)
    assert again == joint
    with refused("'elbow'", "rotation"):
        Joint("elbow", "revolute", "a", "b", rotation=I + 1e-4)


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda a, b, c: Robot([]), ["no link"]),
        (lambda a, b, c: Robot([a, a]), ["two links", "'a'", "unique"]),
        (lambda a, b, c: Robot([a, b], [hinge("j", "a", "b"), hinge("j", "a", "b")]), ["two joints", "'j'"]),
        (lambda a, b, c: Robot([a, b]), ["'b'", "not connected", "'a'"]),
        (lambda a, b, c: Robot([a, b], [hinge("j", "a", "x")]), ["'j'", "'x'", "does not exist"]),
        (
            lambda a, b, c: Robot([a, b, c], [hinge("j", "a", "b"), hinge("k", "b", "c"), hinge("l", "c", "a")]),
            ["cycle", "'a'", "'b'", "'c'", "close("],
        ),
        (lambda a, b, c: Robot([a, b], [hinge("j", "a", "b"), hinge("k", "a", "b")]), ["'k'", "cycle", "close("]),
        (lambda a, b, c: Robot([a], base="aa"), ["'aa'", "'a'"]),
        (lambda a, b, c: Robot([a], frames=[Frame("f", "b")]), ["'f'", "'b'"]),
        (lambda a, b, c: Robot([a], frames=[Frame("f", "a"), Frame("f", "a")]), ["two frames", "'f'"]),
        (lambda a, b, c: Robot([a], loops=[Loop("l", Frame("f", "x"), Frame("g", "a"))]), ["'l'", "'x'"]),
        (lambda a, b, c: Robot([body("ground")]), ["'ground'", "Rename"]),
        (lambda a, b, c: Robot([body("")]), ["name", "non-empty"]),
        (lambda a, b, c: Robot([body(3)]), ["3", "string"]),
        (lambda a, b, c: Robot([a], locked={"j": 0.0}), ["joint", "'j'"]),
        (lambda a, b, c: Robot([a, b], [Joint("j", "fixed", "a", "b")]).lock({"j": 0.0}), ["'j'", "fixed"]),
        (lambda a, b, c: Robot([a, b], [Joint("j", "spherical", "a", "b")]).lock({"j": [1, 1, 0, 0]}), ["'j'", "unit"]),
    ],
)
def test_impossible_robots(build, words):
    with refused(*words):
        build(body("a"), body("b"), body("c"))
