"""Robots in files: exact round trips, one clear sentence for every fault, and whole files or none."""

import copy
import json
import os
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sdyn import files, json_format, models, urdf
from sdyn.checks import RobotError
from sdyn.doctor import repaired
from sdyn.parts import KINDS, Frame, Joint, Link
from sdyn.posture import link_poses
from sdyn.robot import Robot

I = np.eye(3)


def rotation(rng):
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return Q * np.sign(np.linalg.det(Q))


def inertia(rng):
    R = rotation(rng)
    J = R @ np.diag(rng.uniform(1.0, 1.9, 3)) @ R.T
    return (J + J.T) / 2


def crowded() -> Robot:
    """A robot with everything that a robot can have, in numbers without a short form."""
    rng = np.random.default_rng(7)
    kinds = list(KINDS)
    names = ["base", *(f"b_{kind}" for kind in kinds), "bulky"]
    links = [Link(name, rng.uniform(1, 2), rng.normal(size=3), inertia(rng)) for name in names[:-1]]
    links.append(Link("bulky", 1.0, (-0.0, 1e-300, 1e22), np.diag([1.0, 1.0, 5.0]), allow_unphysical=True))
    joints = [Joint("last", "revolute", "bulky", "base", stiffness=0.1, rotor_inertia=0.3, damping=1 / 3)]
    for kind in kinds:
        axis = rng.normal(size=3)
        dof, bound = KINDS[kind].dof, {}
        if dof:
            bound = {"rate": rng.uniform(1, 2, dof), "effort": rng.uniform(1, 2, dof)}
        if dof and kind != "spherical":
            bound["limits"] = np.c_[rng.uniform(-2, -1, dof), rng.uniform(1, 2, dof)]
        placed = {"rotation": rotation(rng), "position": rng.normal(size=3), "axis": axis / np.linalg.norm(axis)}
        pitch = 0.1 if kind == "helical" else 0.0
        joints.append(Joint(kind, kind, "base", f"b_{kind}", **placed, **bound, pitch=pitch))
    frames = [Frame("tip", "b_fixed", rotation(rng), rng.normal(size=3)), Frame("größe", "base")]
    robot = Robot(links, joints, frames, name='a "crowded" robot', source="First line.\nSecond line.")
    robot = robot.lock({"revolute": 0.1, "planar": [1 / 3, 2, 3], "spherical": [1, 0, 0, 0]}).ground(
        "base", (rotation(rng), rng.normal(size=3))
    )
    return robot.close("tip", "ground").close(
        Frame("mark", "bulky", rotation(rng)), "größe", "universal", name="second"
    )


def faulty(tmp_path, name, data) -> str:
    """The message of the error that a file with these contents raises."""
    path = tmp_path / name
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    with pytest.raises(RobotError) as error:
        files.load(path)
    message = str(error.value)
    assert message.startswith(str(path)) and "\n" not in message and message.endswith((".", "?"))
    return message


# -- the own format ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", [crowded(), *map(models.load, models.names())], ids=lambda robot: robot.name)
def test_json_reads_back_the_same_robot(robot, tmp_path):
    path = tmp_path / "robot.json"
    files.save(robot, path)
    again = files.load(path)
    assert again == robot and again.source == robot.source
    for ours, theirs in zip((*robot.links, *robot.joints), (*again.links, *again.joints), strict=True):
        for key, value in vars(ours).items():
            if isinstance(value, np.ndarray):
                assert value.tobytes() == getattr(theirs, key).tobytes()  # bit for bit, the sign of zero included
    assert json_format.write(again) == path.read_bytes()


def test_json_is_laid_out_for_readers():
    lines = json_format.write(models.load("deos7")).decode().splitlines()
    assert lines[1:4] == ['  "format": "sdyn-robot",', '  "version": 1,', '  "name": "deos7",']
    assert max(map(len, lines)) <= 125
    assert any('"position": [-0.42, 0.47, -0.56], "limits": [-2.9671, 2.9671]' in line for line in lines)


def test_notes_are_for_readers(tmp_path):
    path = tmp_path / "robot.json"
    path.write_text(
        '{"format": "sdyn-robot", "version": 1, "notes": "one","links": [{"name": "a", "mass": 1, "notes": ["x", 1]}]}'
    )
    assert files.load(path) == Robot([Link("a", 1.0)])


MINIMAL = {
    "format": "sdyn-robot",
    "version": 1,
    "links": [{"name": "a", "mass": 1, "inertia": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}, {"name": "b", "mass": 1}],
    "joints": [{"name": "j", "kind": "revolute", "parent": "a", "child": "b", "limits": [-1, 1], "rate": 1}],
    "frames": [{"name": "tip", "link": "b", "position": [0, 0, 1]}],
    "loops": [{"name": "hold", "kind": "weld", "frame_a": "tip", "frame_b": "ground"}],
    "locked": {"j": 0.5},
}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["not JSON", "line 1"]),
        ('{"format": "sdyn-robot"', ["not JSON", "line 1"]),
        ("[1, 2]", ["object", "[1"]),
        ("{}", ["format", "sdyn-robot"]),
        ('{"format": "sdyn-robot", "version": 2}', ["version 2", "version 1"]),
        ('{"format": "sdyn-robot", "version": true}', ["version"]),
        ('{"format": "sdyn-robot", "version": 1}', ["links"]),
        ('{"format": "sdyn-robot", "version": 1, "version": 1}', ["'version'", "twice"]),
        (b"\xff\xfe\x00", ["UTF-8"]),
        ("[" * 200_000, ["deeply"]),
        ('{"a":' * 200_000, ["deeply"]),
        ('{"format": "sdyn-robot", "version": 1, "links": [{"name": "a", "mass": 1e999}]}', ["1e999", "finite"]),
        ('{"format": "sdyn-robot", "version": 1, "links": [{"name": "a", "mass": NaN}]}', ["NaN", "finite"]),
        ('{"format": "sdyn-robot", "version": 1, "links": [{"name": "a", "mass": -Infinity}]}', ["-Infinity"]),
        ('{"format": "sdyn-robot", "version": 1, "links": [{"name": "a", "mass": 1' + "0" * 5000 + "}]}", ["finite"]),
    ],
)
def test_broken_json(text, words, tmp_path):
    message = faulty(tmp_path, "robot.json", text)
    assert all(word in message for word in words), message


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (["links", 0, "mass"], "1", ["link 'a'", "mass", "number"]),
        (["links", 0, "mass"], True, ["link 'a'", "mass", "number"]),
        (["links", 0, "mass"], None, ["link 'a'", "mass", "number"]),
        (["links", 0, "mass"], -1, ["link 'a'", "mass", "at least 0"]),
        (["links", 0, "mas"], 1, ["link 'a'", "'mas'", "did you mean 'mass'"]),
        (["links", 0, "inertia", 2, 2], 5, ["link 'a'", "(1, 1, 5)", "sdyn check"]),
        (["links", 0, "inertia", 2, 2], [5], ["link 'a'", "inertia"]),
        (["links", 0, "allow_unphysical"], 1, ["link 'a'", "true or false"]),
        (["links", 0], 3, ["link 1", "object"]),
        (["links", 0, "name"], 3, ["name", "string"]),
        (["links"], {}, ["links", "list"]),
        (["links"], [], ["no link"]),
        (["joints", 0, "kind"], "hinge", ["joint 'j'", "'hinge'", "revolute"]),
        (["joints", 0, "axis"], [0, 0, 2], ["joint 'j'", "length 2"]),
        (["joints", 0, "limits"], [1, -1], ["joint 'j'", "lower"]),
        (["joints", 0, "rate"], "fast", ["joint 'j'", "rate", "number"]),
        (["joints", 0, "child"], "c", ["'j'", "'c'"]),
        (["joints", 0, "parents"], "a", ["joint 'j'", "'parents'", "did you mean 'parent'"]),
        (["frames", 0, "link"], "c", ["'tip'", "'c'"]),
        (["frames", 0, "position"], [0, 0], ["'tip'", "shape"]),
        (["loops", 0, "frame_a"], "tap", ["'hold'", "'tap'", "'tip'"]),
        (["loops", 0, "frame_a"], 3, ["'hold'", "frame_a", "object"]),
        (["loops", 0, "kind"], "glue", ["'hold'", "'glue'", "weld"]),
        (["locked"], {"k": 0}, ["'k'"]),
        (["locked", "j"], "shut", ["'j'", "number"]),
        (["locked"], [], ["locked", "object"]),
        (["ground_pose"], [0] * 7, ["ground pose", "object"]),
        (["base"], "c", ["'c'"]),
        (["grounded"], "yes", ["grounded", "true or false"]),
        (["source"], 3, ["source", "string"]),
        (["sauce"], "x", ["'sauce'", "did you mean 'source'"]),
    ],
)
def test_wrong_json(path, value, words, tmp_path):
    top = copy.deepcopy(MINIMAL)
    place = top
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    message = faulty(tmp_path, "robot.json", json.dumps(top))
    assert all(word in message for word in words), message


def test_missing_keys(tmp_path):
    for path, words in [
        (("links", 0, "mass"), ["link 'a'", '"mass"']),
        (("joints", 0, "child"), ["joint 'j'", '"child"']),
    ]:
        top = copy.deepcopy(MINIMAL)
        del top[path[0]][path[1]][path[2]]
        message = faulty(tmp_path, "robot.json", json.dumps(top))
        assert all(word in message for word in words), message


ODD = st.sampled_from([None, True, -1, 0, 1.5, 1e308, "", "a", "ground", [], [0, 0, 1], [1, [2]], {}, {"name": "a"}])


@settings(derandomize=True, deadline=None, max_examples=200, database=None)
@given(st.data())
def test_any_change_of_a_file_gives_an_error_or_a_robot(data):
    top = copy.deepcopy(MINIMAL)
    for _ in range(data.draw(st.integers(1, 3))):
        place = top
        while True:
            keys = sorted(place) if isinstance(place, dict) else range(len(place))
            if not keys:
                break
            key = data.draw(st.sampled_from(list(keys)))
            if isinstance(place[key], dict | list) and data.draw(st.booleans()):
                place = place[key]
                continue
            if data.draw(st.booleans()):
                place[key] = copy.deepcopy(data.draw(ODD))
            else:
                del place[key]
            break
    try:
        robot = json_format.read(json.dumps(top).encode())
    except RobotError as error:
        assert "\n" not in str(error)
    else:
        assert json_format.read(json_format.write(robot)) == robot
        assert np.isfinite(link_poses(robot, robot.neutral())[1]).all()


# -- URDF --------------------------------------------------------------------------------------------------------------


def close_to(a: Robot, b: Robot, within=1e-15):
    """Same robot, except for the rounding of rotations."""
    for x, y in zip((*a.joints, *a.frames), (*b.joints, *b.frames), strict=True):
        assert np.abs(x.rotation - y.rotation).max() <= within
    same = lambda parts, by: [replace(x, rotation=y.rotation) for x, y in zip(parts, by, strict=True)]
    assert np.abs(a.ground_pose[0] - b.ground_pose[0]).max() <= within
    pose = (a.ground_pose[0], b.ground_pose[1])
    b = replace(b, joints=same(b.joints, a.joints), frames=same(b.frames, a.frames), ground_pose=pose, source=a.source)
    assert a == b


@pytest.mark.parametrize("name", models.names())
@pytest.mark.parametrize("grounded", [False, True])
def test_urdf_reads_back_the_same_robot(name, grounded, tmp_path):
    robot = models.load(name)
    if grounded:
        rng = np.random.default_rng(3)
        robot = robot.ground(robot.base, (rotation(rng), rng.normal(size=3)))
    files.save(robot, tmp_path / "robot.urdf")
    close_to(robot, files.load(tmp_path / "robot.urdf"))


def test_urdf_reads_back_every_kind_it_has():
    rng = np.random.default_rng(5)
    axis = lambda: (a := rng.normal(size=3)) / np.linalg.norm(a)
    place = lambda: {"rotation": rotation(rng), "position": rng.normal(size=3)}
    joints = [
        Joint(
            "turn", "revolute", "a", "b", axis=axis(), limits=(-1, 1 / 3), rate=2.0, effort=0.1, damping=0.7, **place()
        ),
        Joint("spin", "revolute", "b", "c", axis=axis(), **place()),
        Joint("slide", "prismatic", "c", "d", axis=axis(), limits=(0, 1), **place()),
        Joint("push", "prismatic", "c", "e", axis=axis(), effort=3.0, **place()),
        Joint("float", "planar", "a", "f", axis=axis(), **place()),
        Joint("glue", "fixed", "a", "g", **place()),
    ]
    links = [Link(name, rng.uniform(1, 2), rng.normal(size=3), inertia(rng)) for name in "abcdef"] + [Link("g", 1.0)]
    links[2] = Link("c", 0.0)  # without mass, but others hang on it
    robot = Robot(links, joints, [Frame("eye", "c", **place()), Frame("tip", "d")], name="<kinds> & 'more'")
    close_to(robot, urdf.read(urdf.write(robot)))


def test_roll_pitch_yaw_keeps_every_rotation():
    rng = np.random.default_rng(1)
    for k in range(3000):
        rpy = rng.uniform(-4, 4, 3)
        if k % 2:  # at and near the singular pitch
            rpy[1] = rng.choice([-1, 1]) * np.pi / 2 + rng.choice([0.0, 1e-16, 1e-9, 1e-5])
        R = urdf.rotation_from_rpy(rpy)
        assert np.abs(urdf.rotation_from_rpy(urdf.rpy_from_rotation(R)) - R).max() < 1e-15
    assert np.allclose(urdf.rotation_from_rpy((0, 0, np.pi / 2)) @ (1, 0, 0), (0, 1, 0))
    assert np.allclose(urdf.rotation_from_rpy((np.pi / 2, 0, np.pi / 2)) @ (0, 1, 0), (0, 0, 1))


ARM = """<robot name="arm">
  <link name="root"/>
  <joint name="float" type="{first}"><parent link="root"/><child link="a"/><origin xyz="1 2 3"/></joint>
  <link name="a"><visual/><inertial><origin xyz="0 0 .5" rpy="0 0 1.5707963267948966"/><mass value="+2."/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="2" iyz="0" izz="2.5"/></inertial></link>
  <joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 -4"/>
    <dynamics damping="0.5" friction="0.1"/>{inside}</joint>
  <link name="b"><inertial><mass value="1e-1"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="flange"/><link name="tool"/>
  <joint name="f" type="fixed"><parent link="b"/><child link="flange"/>
    <origin xyz="0 0 1" rpy="0 0 1.57079632679"/></joint>
  <joint name="t" type="fixed"><parent link="flange"/><child link="tool"/><origin xyz="1 0 0"/></joint>
  <transmission name="unknown"/>
</robot>"""


def arm(first="floating", inside="") -> str:
    return ARM.format(first=first, inside=inside)


def test_what_urdf_means():
    robot = urdf.read(arm().encode())
    assert robot.base == "a" and not robot.grounded and [x.name for x in robot.links] == ["a", "b"]
    assert np.allclose(robot.link("a").inertia, np.diag([2, 1, 2.5]), atol=1e-15)
    assert np.array_equal(robot.link("a").com, (0, 0, 0.5)) and robot.link("b").mass == 0.1
    joint = robot.joint("j")
    assert np.array_equal(joint.axis, (0, 0, -1)) and joint.damping == 0.5 and joint.limits is None
    assert robot.frame("flange").link == "b" and np.allclose(robot.frame("tool").position, (0, 1, 1))

    world = urdf.read(arm("fixed").replace("root", "world").encode())
    assert world.grounded and world.base == "a" and np.array_equal(world.ground_pose[1], (1, 2, 3))
    rail = urdf.read(arm("prismatic").replace("root", "world").encode())
    assert rail.grounded and rail.base == "world" and rail.nv == 2
    dummy = urdf.read(arm("fixed").encode())
    assert not dummy.grounded and dummy.base == "root" and dummy.nv == 7

    bounds = lambda text: urdf.read(arm(inside=text).encode()).joint("j")
    assert bounds('<limit effort="1" velocity="2" lower="-1" upper="3"/>').limits == (-1.0, 3.0)
    assert bounds('<limit effort="1" velocity="2"/>').limits is None
    assert bounds('<limit upper="3"/>').limits == (0.0, 3.0) and bounds('<limit upper="3"/>').effort is None


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("</robot>", "", ["not XML", "line"]),
        ("<robot name", '<!DOCTYPE x [<!ENTITY b "bb">]><robot name', ["document type"]),
        ("<robot name", "<model><robot name", ["not XML"]),
        ('<robot name="arm">', "", ["not XML"]),
        ('"+2."', '"nan"', ["link 'a'", "mass", "'nan'"]),
        ('"+2."', '"1_000"', ["link 'a'", "'1_000'"]),
        ('"+2."', '"1e400"', ["link 'a'", "finite"]),
        ('"+2."', '"\uff12"', ["link 'a'", "number"]),
        ('"+2."', '"${m}"', ["link 'a'", "xacro"]),
        ('"+2."', '"-2"', ["link 'a'", "mass", "at least 0"]),
        ("<mass value=", "<mass weight=", ["link 'a'", "no value"]),
        ('izz="2.5"', 'izz="9"', ["link 'a'", "(1, 2, 9)"]),
        ('izz="2.5"', "", ["link 'a'", "izz"]),
        ('xyz="0 0 .5"', 'xyz="0 0"', ["link 'a'", "three numbers"]),
        ('xyz="0 0 -4"', 'xyz="0 0 0"', ["joint 'j'", "axis", "zero"]),
        ('type="revolute"', 'type="ball"', ["joint 'j'", "'ball'", "revolute"]),
        ('type="revolute"', 'type="floating"', ["joint 'j'", "floating", "'a'"]),
        ("<dynamics", '<mimic joint="k"/><dynamics', ["joint 'j'", "mimic"]),
        ("<dynamics", '<limit lower="2" upper="1"/><dynamics', ["joint 'j'", "lower"]),
        ("<dynamics", '<limit lower="2"/><limit lower="2"/><dynamics', ["joint 'j'", "2 elements <limit>"]),
        ("<dynamics", '<limit effort="-1"/><dynamics', ["joint 'j'", "effort"]),
        ('<child link="b"/>', '<child link="c"/>', ["joint 'j'", "'c'"]),
        ('<child link="b"/>', "", ["joint 'j'", "<child>"]),
        ('<child link="b"/>', "<child/>", ["joint 'j'", "<child>"]),
        ('<child link="b"/>', '<child link="tool"/>', ["'tool'", "'j'", "'t'", "close("]),
        ('<parent link="root"/>', '<parent link="b"/>', ["'float'", "'b'"]),
        ('<link name="root"/>', '<link name="root"/><link name="root"/>', ["two links", "'root'"]),
        ('<link name="root"/>', '<link name="root"/><link name="loose"/>', ["'root'", "'loose'", "no parent"]),
        ('<link name="root"/>', "<link/>", ["<link>", "name"]),
        ('name="f" type', 'name="t" type', ["two joints", "'t'"]),
    ],
)
def test_broken_urdf(old, new, words, tmp_path):
    text = arm()
    assert old in text
    message = faulty(tmp_path, "robot.urdf", text.replace(old, new, 1))
    assert all(word in message for word in words), message


def test_a_cycle_in_urdf(tmp_path):
    joint = lambda name, a, b: f'<joint name="{name}" type="fixed"><parent link="{a}"/><child link="{b}"/></joint>'
    ring = joint("j", "a", "b") + joint("k", "b", "a")
    assert "cycle" in faulty(tmp_path, "ring.urdf", f'<robot><link name="a"/><link name="b"/>{ring}</robot>')
    apart = f'<robot><link name="c"/><link name="a"/><link name="b"/>{ring}</robot>'
    assert "not connected to the base 'c'" in faulty(tmp_path, "apart.urdf", apart)


def test_entity_bombs_are_refused(tmp_path):
    lines = [
        '<!ENTITY a "aaaaaaaaaa">',
        *(f'<!ENTITY {x} "{f"&{y};" * 10}">' for x, y in zip("bcdef", "abcde", strict=True)),
    ]
    bomb = f"<?xml version='1.0'?><!DOCTYPE r [{''.join(lines)}]><robot name='&f;'/>"
    assert "entities" in faulty(tmp_path, "bomb.urdf", bomb)
    outside = '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="&x;"/>'
    assert "entities" in faulty(tmp_path, "outside.urdf", outside)


BALL = Robot([Link("x", 1.0)], frames=[Frame("f", "x")])


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda r: r.close("hand", "ground", name="hold"), ["loop 'hold'", "open"]),
        (lambda r: r.lock({"joint2": 0.1}), ["'joint2'", "unlock"]),
        (lambda r: r.reroot("arm3"), ["'arm3'", "joint", "reroot"]),
        (lambda r: r.attach(BALL, "hand", "f", "helical"), ["'hand_f'", "helical"]),
        (lambda r: r.attach(BALL, "hand", "f", "spherical"), ["'hand_f'", "spherical"]),
        (lambda r: replace(r, joints=[replace(j, stiffness=1.0) for j in r.joints]), ["stiffness", "'joint1'"]),
        (lambda r: replace(r, joints=[replace(j, rotor_inertia=1.0) for j in r.joints]), ["rotor inertia", "'joint1'"]),
        (lambda r: replace(r, frames=(Frame("arm3", "arm7"),)), ["'arm3'", "rename"]),
        (lambda r: replace(r, joints=[replace(j, kind="planar") for j in r.joints]), ["'joint1'", "planar", "bounds"]),
        (lambda r: Robot([Link("world", 1.0)]), ["'world'", "inertial space"]),
    ],
)
def test_what_urdf_cannot_hold(edit, words, tmp_path):
    path = tmp_path / "robot.urdf"
    with pytest.raises(RobotError) as error:
        files.save(edit(models.load("deos7")), path)
    assert all(word in str(error.value) for word in words), str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_urdf_against_pinocchio():
    pinocchio = pytest.importorskip("pinocchio")
    for name in models.names():
        robot = models.load(name)
        peer = pinocchio.buildModelFromXML(urdf.write(robot).decode(), pinocchio.JointModelFreeFlyer())
        peer.gravity = pinocchio.Motion.Zero()
        data = peer.createData()
        rng = np.random.default_rng(2)
        value = {joint.name: rng.uniform(-1, 1) for joint in robot.joints}
        q = pinocchio.neutral(peer)
        for joint in robot.joints:
            k = peer.joints[peer.getJointId(joint.name)]
            turn = [np.cos(value[joint.name]), np.sin(value[joint.name])] if k.nq == 2 else value[joint.name]
            q[k.idx_q : k.idx_q + k.nq] = turn
        pinocchio.framesForwardKinematics(peer, data, q)
        R, p = link_poses(robot, robot.configuration(value))
        for i, link in enumerate(robot.links):
            pose = data.oMf[peer.getFrameId(link.name, pinocchio.FrameType.BODY)]
            assert np.abs(pose.rotation - R[i]).max() < 1e-14 and np.abs(pose.translation - p[i]).max() < 1e-14
        mass = sum(link.mass for link in robot.links)
        centre = sum(link.mass * (R[i] @ link.com + p[i]) for i, link in enumerate(robot.links)) / mass
        assert np.abs(pinocchio.centerOfMass(peer, data, q) - centre).max() < 1e-14


# -- files -------------------------------------------------------------------------------------------------------------


def test_paths_that_hold_no_robot(tmp_path):
    files.save(models.load("sat50"), tmp_path / "sat50.json")
    for path, words in [
        (tmp_path / "sat5.json", ["'sat5.json'", "did you mean 'sat50.json'"]),
        (tmp_path / "robot.yaml", ["'.yaml'", ".json or .urdf"]),
        (tmp_path / "robot", ["''", ".json or .urdf"]),
        (tmp_path / "no" / "robot.json", ["no folder"]),
    ]:
        with pytest.raises(RobotError) as error:
            files.load(path)
        assert all(word in str(error.value) for word in words), str(error.value)
    (tmp_path / "folder.json").mkdir()
    for act in (files.load, lambda path: files.save(models.load("sat50"), path)):
        with pytest.raises(RobotError, match="is a folder"):
            act(tmp_path / "folder.json")
    with pytest.raises(RobotError, match="no folder"):
        files.save(models.load("sat50"), tmp_path / "no" / "robot.json")
    with pytest.raises(RobotError, match="UTF-8"):
        files.save(replace(models.load("sat50"), name="\ud800"), tmp_path / "robot.json")


def test_a_file_that_is_too_large_is_not_parsed(tmp_path):
    path = tmp_path / "robot.json"
    with path.open("wb") as file:
        file.truncate(files.LIMIT + 1)
    with pytest.raises(RobotError, match="larger than 16 MB"):
        files.load(path)


def test_unphysical_files_can_be_loaded_for_repair(tmp_path):
    top = copy.deepcopy(MINIMAL)
    top["links"][0]["inertia"][2][2] = 5
    path = tmp_path / "robot.json"
    path.write_text(json.dumps(top))
    robot = files.load(path, allow_unphysical=True)
    assert robot.link("a").allow_unphysical and not robot.link("b").allow_unphysical
    assert not repaired(robot).link("a").allow_unphysical
    xml = arm().replace('izz="2.5"', 'izz="9"').encode()
    assert urdf.read(xml, allow_unphysical=True).link("a").allow_unphysical
    top["links"][0]["mass"] = -1
    path.write_text(json.dumps(top))
    with pytest.raises(RobotError, match="mass"):
        files.load(path, allow_unphysical=True)


@pytest.mark.parametrize("step", ["fsync", "replace"])
@pytest.mark.parametrize("fault", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failed_write_leaves_the_old_file(step, fault, tmp_path, monkeypatch):
    path = tmp_path / "robot.json"
    files.save(models.load("sat50"), path)

    def fail(*args):
        raise fault

    monkeypatch.setattr(os, step, fail)
    with pytest.raises((RobotError, KeyboardInterrupt), match=r"No space left|^$"):
        files.save(models.load("deos7"), path)
    assert [x.name for x in tmp_path.iterdir()] == ["robot.json"]
    assert files.load(path) == models.load("sat50")


def test_saved_files_have_ordinary_permissions(tmp_path):
    path, plain = tmp_path / "robot.json", tmp_path / "plain"
    plain.write_text("")
    files.save(models.load("sat50"), path)
    assert path.stat().st_mode == plain.stat().st_mode
    path.chmod(0o600)
    files.save(models.load("sat50"), path)
    assert path.stat().st_mode & 0o777 == 0o600
