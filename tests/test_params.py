"""Parameters and lock values of a chain: replaced on the device as on the host, and differentiated."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from structures import QUICKLY

import sdyn
from sdyn import RobotError

ROBOT = sdyn.models.load("deos7")
LOCKS = {"joint2": 0.7, "joint5": -0.4}


@pytest.fixture(scope="module")
def accelerate():
    return jax.jit(partial(sdyn.forward_dynamics), **QUICKLY)  # a function of its own: jit counts programs per function


def state(robot):
    rng = np.random.default_rng(1)
    return robot.configuration({j.name: rng.normal() for j in robot.moving}), *rng.normal(size=(2, robot.nv))


def test_lock_values_are_data(accelerate):
    locked, other = ROBOT.lock(LOCKS), ROBOT.lock({"joint2": 0.0, "joint5": 1.0})
    want = accelerate(sdyn.pack(locked), *state(locked))
    got = accelerate(sdyn.with_locks(sdyn.pack(other), LOCKS), *state(locked))
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-13 * np.abs(want).max())  # measured 1e-15
    assert accelerate._cache_size() == 1


def test_accelerations_are_differentiable_in_lock_values():
    chain, at = sdyn.pack(ROBOT.lock(LOCKS)), state(ROBOT.lock(LOCKS))
    f = lambda x: sdyn.forward_dynamics(sdyn.with_locks(chain, {"joint2": x}), *at)
    run = jax.jit(lambda x: jax.jvp(f, (x,), (1.0,)), **QUICKLY)
    step = 1e-4  # below it the difference is rounding: the last link weighs 2000 times less than seen from the base
    difference = (run(0.7 + step)[0] - run(0.7 - step)[0]) / (2 * step)
    slope = run(0.7)[1]
    np.testing.assert_allclose(slope, difference, rtol=0, atol=2e-7 * np.abs(slope).max())  # measured 2e-8


def test_poses_are_differentiable_in_lock_values_forward_and_reverse():
    chain, q = sdyn.pack(ROBOT.lock(LOCKS)), state(ROBOT.lock(LOCKS))[0]
    f = lambda x: jnp.sin(sdyn.frame_pose(sdyn.with_locks(chain, {"joint2": x}), q, "hand")[1]).sum()
    run = jax.jit(lambda x: (*jax.jvp(f, (x,), (1.0,)), jax.grad(f)(x)), **QUICKLY)
    _, forward, reverse = run(0.7)
    step = 1e-5
    np.testing.assert_allclose(reverse, forward, rtol=1e-13)  # measured 1e-16
    difference = (run(0.7 + step)[0] - run(0.7 - step)[0]) / (2 * step)
    np.testing.assert_allclose(forward, difference, rtol=1e-8)  # measured 1e-10


def test_an_unknown_joint_is_named():
    with pytest.raises(RobotError, match="there is no joint 'joint22'; did you mean"):
        sdyn.with_locks(sdyn.pack(ROBOT), {"joint22": 0.0})
