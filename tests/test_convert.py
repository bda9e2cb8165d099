"""States in the conventions of Pinocchio and MuJoCo: vectors written by hand, and laws.

`benchmarks/conventions.py` asks the libraries themselves.
"""

import numpy as np
import pytest
from structures import q_rate, quaternions, tree

import sdyn
from sdyn.convert import mujoco, pinocchio

KINDS = ("cylindrical", "universal", "planar", "spherical", "revolute", "prismatic", "revolute")
ROBOT = tree((0, 1, 2, 3, 4, 1, 0), KINDS, seed=2)  # joints j0 to j6, links l0 to l7
PINOCCHIO = {"j6": 1, "root_joint": 7, "universe": 0, "j3": 4, "j1": 2, "j0": 2, "j2": 4, "j5": 1, "j4": 2}  # any order
MUJOCO = ("j5", "", "j0.angle", "j0.slide", "j1.first", "j1.second", "j6", "j2.angle", "j3", "j2.y", "j2.x", "j4")


def converters(robot):
    """Of one robot to both peers."""
    keep = lambda name: not robot.grounded or name not in ("root_joint", "")
    sizes = {name: size for name, size in PINOCCHIO.items() if keep(name)}
    return [pinocchio(robot, list(sizes), list(sizes.values())), mujoco(robot, [x for x in MUJOCO if keep(x)])]


FREE = dict(zip(("Pinocchio", "MuJoCo"), converters(ROBOT), strict=True))
GROUNDED = dict(zip(("Pinocchio", "MuJoCo"), converters(ROBOT.ground("l0")), strict=True))
CASES = [(ROBOT, x) for x in FREE.values()] + [(ROBOT.ground("l0"), x) for x in GROUNDED.values()]
IDS = [f"{x.peer} {base}" for base in ("free", "grounded") for x in FREE.values()]
every = pytest.mark.parametrize(("robot", "peer"), CASES, ids=IDS)


def some(robot, *batch):
    """q, v, vdot and tau of any shape in front."""
    rng = np.random.default_rng(0)
    q = 2 * rng.normal(size=(*batch, robot.nq))
    for at in quaternions(robot):
        q[..., at] /= np.linalg.norm(q[..., at], axis=-1, keepdims=True)
    return q, *rng.normal(size=(3, *batch, robot.nv))


def body(kind=None, **rest):
    """A free base, turned a quarter about z, and perhaps a joint."""
    links = [sdyn.Link("base", 2.0, inertia=np.eye(3)), sdyn.Link("arm", 1.0, inertia=np.eye(3))]
    return sdyn.Robot(links, [sdyn.Joint("joint", kind, "base", "arm", **rest)]) if kind else sdyn.Robot(links[:1])


H = np.sqrt(0.5)
Q, V, VDOT, TAU = [1, 2, 3, H, 0, 0, H], [0, 0, 5, 1, 0, 0], [0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [1, 2, 3, 4, 5, 6]


def test_a_free_base_in_pinocchio():
    peer = pinocchio(body(), ["universe", "root_joint"], [0, 7])
    assert peer.to_q(Q).tolist() == [1, 2, 3, 0, 0, H, H]
    assert peer.to_v(Q, V).tolist() == [1, 0, 0, 0, 0, 5]
    assert peer.to_vdot(Q, V, VDOT).tolist() == [0.4, 0.5, 0.6, 0.1, 0.2, 0.3]
    assert peer.to_tau(Q, TAU).tolist() == [4, 5, 6, 1, 2, 3]


def test_a_free_base_in_mujoco():
    """Its x axis shows along the world's y; it turns at 5 rad/s and slides along x: pulled towards its y at 5 m/s^2."""
    peer = mujoco(body(), [""])
    assert peer.to_q(Q).tolist() == Q
    assert np.allclose(peer.to_v(Q, V), [0, 1, 0, 0, 0, 5], atol=1e-15)
    assert np.allclose(peer.to_vdot(Q, V, VDOT), [-5.5, 0.4, 0.6, 0.1, 0.2, 0.3], atol=1e-15)
    assert np.allclose(peer.to_tau(Q, TAU), [-5, 4, 6, 1, 2, 3], atol=1e-15)


def test_joints_in_pinocchio():
    """A continuous joint at 60 degrees; a planar one at 90, whose slides are then along the child's -y and x."""
    turn, plane = (
        pinocchio(body(kind), ["universe", "free", "joint"], [0, 7, size])
        for kind, size in (("revolute", 2), ("planar", 4))
    )
    assert np.allclose(turn.to_q([*Q, np.pi / 3])[7:], [0.5, np.sqrt(0.75)], atol=1e-15)
    assert np.allclose(plane.to_q([*Q, 7, 8, np.pi / 2])[7:], [7, 8, 0, 1], atol=1e-15)
    q, v = [*Q, 7, 8, np.pi / 2], [*V, 1, 2, 3]
    assert np.allclose(plane.to_v(q, v)[6:], [2, -1, 3], atol=1e-15)
    assert np.allclose(plane.to_vdot(q, v, [*VDOT, 0, 0, 4])[6:], [3 * -1, -3 * 2, 4], atol=1e-15)
    assert np.allclose(plane.to_tau(q, [*TAU, 1, 2, 3])[6:], [2, -1, 3], atol=1e-15)
    ball = pinocchio(body("spherical"), ["free", "joint"], [7, 4])
    assert ball.to_q([*Q, 0.5, 0.5, -0.5, 0.5])[7:].tolist() == [0.5, -0.5, 0.5, 0.5]


def test_the_order_is_that_of_the_names():
    peer = FREE["MuJoCo"]
    q, v, _, _ = some(ROBOT)
    ours, theirs = dict(zip(ROBOT.q_names, q, strict=True)), peer.to_q(q)
    assert theirs[0] == ours["j5"] and theirs[1:8].tolist() == q[:7].tolist()
    assert theirs[8:10].tolist() == [ours["j0.angle"], ours["j0.slide"]] and theirs[-1] == ours["j4"]
    assert peer.to_v(q, v)[-1] == v[ROBOT.v_names.index("j4")]


@every
def test_there_and_back(robot, peer):
    for batch in ((), (5,), (2, 3)):
        q, v, vdot, tau = some(robot, *batch)
        there = [peer.to_q(q), peer.to_v(q, v), peer.to_vdot(q, v, vdot), peer.to_tau(q, tau)]
        assert all(x.shape[:-1] == batch for x in there)
        assert there[0].shape[-1] == robot.nq + 2 * (peer.peer == "Pinocchio")
        back = peer.from_q(there[0])
        angles = peer.circles[0]
        turns = (back - q)[..., angles] / (2 * np.pi)
        assert np.allclose(turns, np.round(turns), atol=1e-15)  # measured 5e-18
        assert np.array_equal(np.delete(back, angles, -1), np.delete(q, angles, -1))
        at = there[0]
        assert np.allclose(peer.from_v(at, there[1]), v, atol=1e-14)  # measured 7e-16
        assert np.allclose(peer.from_vdot(at, there[1], there[2]), vdot, atol=1e-13)  # measured 2e-15
        assert np.allclose(peer.from_tau(at, there[3]), tau, atol=1e-14)  # measured 7e-16


@every
def test_batch_axes_broadcast_and_give_what_each_alone_gives(robot, peer):
    q, v, vdot, _ = some(robot, 3, 2)
    one = peer.to_vdot(q[0, 0], v[:, :1], vdot)
    assert one.shape == vdot.shape
    for k in range(3):
        for j in range(2):
            alone = peer.to_vdot(q[0, 0], v[k, 0], vdot[k, j])
            assert np.allclose(one[k, j], alone, atol=1e-14)  # measured 4e-16
    low = peer.to_v(q.astype("f4"), v.astype("f4"))
    assert low.dtype == np.float32 and np.allclose(low, peer.to_v(q, v), atol=1e-5)


@every
def test_power_is_the_same(robot, peer):
    q, v, _, tau = some(robot, 4)
    power = np.sum(peer.to_tau(q, tau) * peer.to_v(q, v), -1)
    assert np.allclose(power, np.sum(tau * v, -1), atol=1e-13)  # measured 3e-15


@every
def test_accelerations_are_the_derivatives_of_velocities(robot, peer):
    q, v, vdot, _ = some(robot)
    h, rate = 1e-5, np.asarray(q_rate(robot, q, v))
    at = lambda h: peer.to_v(q + h * rate, v + h * vdot)
    assert np.abs((at(h) - at(-h)) / (2 * h) - peer.to_vdot(q, v, vdot)).max() < 1e-8  # measured 2e-10


def test_velocities_are_the_rates_of_configurations():
    """By the peers' own rules: MuJoCo's position has the rate v; Pinocchio's slides are along turned axes."""
    q, v, _, _ = some(ROBOT)
    h, rate = 1e-5, np.asarray(q_rate(ROBOT, q, v))
    moving = lambda peer: (peer.to_q(q + h * rate) - peer.to_q(q - h * rate)) / (2 * h)
    peer = FREE["MuJoCo"]
    assert np.abs(moving(peer)[1:4] - peer.to_v(q, v)[1:4]).max() < 1e-9  # measured 3e-11
    peer = FREE["Pinocchio"]
    p, dp, w = peer.to_q(q), moving(peer), peer.to_v(q, v)
    c, s = p[18:20]  # j2, after j6, the base, j3, j1 and j0
    assert np.abs(dp[16:18] - np.array([[c, -s], [s, c]]) @ w[14:16]).max() < 1e-9  # measured 4e-12
    assert np.abs(dp[18:20] - w[16] * np.array([-s, c])).max() < 1e-9  # measured 5e-12


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: pinocchio(ROBOT, ["a"], [7, 1]), "1 names and 2 sizes"),
        (lambda: pinocchio(ROBOT, ["root", "j_0"], [7, 2]), "no moving joint .* named 'j_0'; did you mean 'j"),
        (lambda: pinocchio(ROBOT, ["root", "j0"], [7, 2]), "'j1.first' of the robot 0 times"),
        (lambda: mujoco(ROBOT, [*MUJOCO, "j4"]), "'j4' of the robot 2 times"),
        (lambda: mujoco(ROBOT, [x for x in MUJOCO if x]), "none for the free base"),
        (lambda: mujoco(ROBOT.ground("l0"), MUJOCO), "the robot is grounded"),
        (lambda: mujoco(ROBOT.lock({"j4": 0.1}), MUJOCO), "'j4' is locked"),
        (lambda: mujoco(ROBOT, ["", "j2"]), "'j2' is planar, and MuJoCo has no such joint; name .* 'j2.x', 'j2.y'"),
        (lambda: mujoco(tree((0,), "helical"), ["", "j0"]), "it cannot be converted"),
        (lambda: pinocchio(body("spherical"), ["f", "joint"], [7, 3]), "'joint' has 3 .* a spherical joint has 4"),
        (lambda: pinocchio(body(), ["f"], [6]), "'f' has 6 entries of q; a free joint has 7"),
        (lambda: FREE["MuJoCo"].to_q(np.zeros(3)), r"q has shape \(3,\) .* must hold numbers, \[..., 21\]"),
        (lambda: FREE["MuJoCo"].to_q(np.zeros(21)), "a quaternion in q has length 0"),
        (lambda: FREE["MuJoCo"].to_q(np.full(21, np.nan)), "q has an entry that is not finite"),
        (lambda: FREE["Pinocchio"].from_q(np.zeros(23)), "cosine, sine.* has length 0"),
        (lambda: FREE["Pinocchio"].to_v(some(ROBOT, 2)[0], np.zeros((3, 19))), "different batches"),
        (lambda: FREE["Pinocchio"].from_tau(np.zeros(23), ["a"] * 19), "has length 0"),
        (lambda: FREE["Pinocchio"].to_tau(some(ROBOT)[0], ["a"] * 19), "tau has shape"),
    ],
)
def test_what_cannot_be_is_refused(make, words):
    with pytest.raises(sdyn.RobotError, match=words):
        make()
