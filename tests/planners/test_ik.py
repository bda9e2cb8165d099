"""Inverse kinematics: what can be reached is, by free, grounded and closed robots; what cannot is said."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import four_bar
from structures import QUICKLY

import planners
import sdyn
from planners.ik import STATUSES

BARS = replace(four_bar(), frames=(sdyn.Frame("tip", "coupler", position=(0.6, 0.2, 0.0)),))
DEOS = sdyn.models.load("deos7")
ROBOTS = {"free": DEOS, "grounded": DEOS.ground(DEOS.base), "closed": BARS, "planar": sdyn.models.load("planar3")}
CAPACITY = sdyn.capacity(ROBOTS.values())  # one program for all but the floating ones
FRAMES = {"free": "hand", "grounded": "hand", "closed": "tip", "planar": "hand"}
BOX = np.tile([-3.0, 3.0], (CAPACITY.nv, 1))
within = jax.jit(
    lambda chain, frame, goal, q, limits: jax.vmap(
        lambda q: planners.inverse_kinematics(chain, frame, goal, q, limits=limits)
    )(q),
    **QUICKLY,
)
placed = jax.jit(jax.vmap(sdyn.frame_pose, (None, 0, None)), **QUICKLY)


def coupled(crank):
    """A closed configuration of the four-bar: where the circles of coupler and rocker meet."""
    elbow, pivot = 0.5 * np.array([np.cos(crank), np.sin(crank)]), np.array([1.1, 0.0])
    d = pivot - elbow
    length = np.linalg.norm(d)
    along = (1.2**2 - 0.75**2 + length**2) / (2 * length)
    side = np.sqrt(1.2**2 - along**2)
    pin = elbow + (along * d + side * np.array([-d[1], d[0]])) / length
    angle = lambda x: np.arctan2(x[1], x[0])
    return np.array([crank, angle(pin - elbow) - crank, angle(pin - pivot)])


def wanted(name, rng):
    """(robot, number of the frame, a configuration that is a solution, starts not far from it)."""
    robot = ROBOTS[name]
    q, n = robot.neutral(), len(robot.neutral())
    joints = slice(7 if n > robot.nv else 0, n)
    q[joints] = coupled(0.9) if name == "closed" else rng.uniform(-1.2, 1.2, q[joints].size)
    starts = np.tile(q, (8, 1))
    starts[:, joints] += rng.uniform(-0.3, 0.3, starts[:, joints].shape)
    return robot, CAPACITY.frame_names.index(FRAMES[name]), q, starts


def solved(name, rng, limits=BOX, shift=0.0):
    robot, frame, q, starts = wanted(name, rng)
    chain = sdyn.pack(robot, CAPACITY)
    there, _ = sdyn.pad(chain, q[None], np.zeros((1, robot.nv)))
    R, p = (x[0] for x in placed(chain, jnp.tile(there, (8, 1)), frame))
    starts, _ = sdyn.pad(chain, starts, np.zeros((len(starts), robot.nv)))
    return chain, frame, (R, p + shift), starts, within(chain, frame, (R, p + shift), starts, limits)


@pytest.mark.parametrize("name", ROBOTS)
def test_what_can_be_reached_is(name, rng):
    chain, frame, (R, p), starts, found = solved(name, rng)
    assert (found.status == STATUSES.index("reached")).all() and found.iterations.max() < 20  # measured 15
    R_there, p_there = placed(chain, found.q, frame)
    assert np.abs(R_there - R).max() < 1e-9 and np.abs(p_there - p).max() < 1e-9
    assert np.array_equal(found.q[:, :7], starts[:, :7])  # the base stays


def test_a_closed_chain_stays_closed(rng):
    *_, found = solved("closed", rng)
    assert np.abs(found.q[:, 7:10] - coupled(0.9)).max() < 1e-8


def test_limits_hold_and_what_is_out_of_reach_is_said(rng):
    tight = np.tile([-0.5, 0.5], (CAPACITY.nv, 1))
    *_, found = solved("free", rng, limits=tight)
    assert (np.abs(found.q[:, 7:]) <= 0.5).all()
    *_, far = solved("free", rng, shift=np.array([50.0, 0, 0]))
    assert (far.status == STATUSES.index("not reached")).all() and np.isfinite(far.q).all()
    assert (far.error < 50).all() and (far.error > 40).all()  # it came as near as it can: the arm is 3 m long
    # half a turn away is no goal reached: the error is the whole angle
    chain, frame, (R, p), _, found = solved("planar", rng)
    turned = within(chain, frame, (R @ jnp.diag(jnp.array([1.0, -1, -1])), p), found.q, BOX)
    assert (turned.status == STATUSES.index("not reached")).all()


def test_a_floating_base_follows_at_zero_momentum(rng):
    """The centre of mass stays, the hand is where it should be, and the base has turned as a small path says."""
    robot, chain = ROBOTS["planar"], sdyn.pack(ROBOTS["planar"])
    q = robot.neutral()
    q[7:] = 0.4, 0.8, -0.6
    _, p = sdyn.frame_pose(chain, q, "hand")
    step = np.array([0.003, -0.002, 0.0])
    float_to = jax.jit(lambda q, p: planners.inverse_kinematics(chain, "hand", (None, p), q, floats=True), **QUICKLY)
    found = float_to(q, p + step)
    assert STATUSES[found.status] == "reached"
    assert np.abs(sdyn.centre_of_mass(chain, found.q) - sdyn.centre_of_mass(chain, q)).max() < 1e-14
    rates = found.q[7:] - q[7:]
    M = np.asarray(sdyn.mass_matrix(chain, q))
    turn = 2 * np.asarray(found.q)[4:7] * np.sign(found.q[3])
    assert np.abs(turn + np.linalg.solve(M[:6, :6], M[:6, 6:] @ rates)[:3]).max() < 1e-2 * np.abs(turn).max()


def test_what_cannot_float_or_has_balls_is_refused():
    chain = sdyn.pack(ROBOTS["grounded"])
    with pytest.raises(ValueError, match="cannot float"):
        planners.inverse_kinematics(chain, "hand", (None, np.zeros(3)), np.zeros(7), floats=True)
    ball = sdyn.Robot(
        [sdyn.Link("a", 1.0, inertia=np.eye(3)), sdyn.Link("b", 1.0, inertia=np.eye(3))],
        [sdyn.Joint("ball", "spherical", "a", "b")],
    )
    with pytest.raises(ValueError, match="three revolute"):
        planners.inverse_kinematics(sdyn.pack(ball), 0, (None, np.zeros(3)), ball.neutral())
