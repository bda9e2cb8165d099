"""Dynamics in the links' own frames: the numbers of the common frame, without its cancellation far from the base."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from functions import FD, ID, MASS, SOLVE, fd
from structures import QUICKLY, TABLE, close, on_states, packed, state, tree

import sdyn

over_table = pytest.mark.parametrize("name", TABLE)


def linked(chain: sdyn.Chain) -> sdyn.Chain:
    """The same arrays, computed in the links' frames."""
    return replace(chain, capacity=replace(chain.capacity, frame="link"))


def slopes(chain, *x):
    """Gradients of the sines of accelerations and of M^-1 tau."""
    one = jax.grad(lambda x: jnp.sin(0.01 * fd(chain, *x)).sum())(x)
    return one, jax.grad(lambda q, b: jnp.sin(0.01 * sdyn.solve_mass(chain, q, b)).sum(), (0, 1))(x[0], x[2])


@over_table
def test_values_are_those_of_the_common_frame(name):
    x, chain = state(name), packed(name)
    other, vdot = linked(chain), FD(chain, *x[:5])
    M = MASS(chain, x.q)
    forces = np.einsum("kij,kj->ki", np.abs(M), np.abs(vdot))  # what inverse dynamics adds up
    close(FD(other, *x[:5]), vdot, 5e-12)  # measured 3.8e-13
    close(ID(other, x.q, x.v, vdot, *x[3:5]), ID(chain, x.q, x.v, vdot, *x[3:5]), 1e-13, forces)  # 1.4e-15
    close(MASS(other, x.q), M, 5e-14)  # 3.4e-15
    close(SOLVE(other, x.q, x.tau), SOLVE(chain, x.q, x.tau), 1e-12)  # 1.1e-13


@pytest.mark.parametrize("name", ["one_body", "some_locked", "all_kinds_backwards", "grounded_tip", "passive"])
def test_gradients_are_those_of_the_common_frame(name):
    x, chain = state(name), packed(name)
    gradients = on_states(slopes, **QUICKLY)
    for mine, other in zip(
        jax.tree.leaves(gradients(linked(chain), *x[:5])), jax.tree.leaves(gradients(chain, *x[:5])), strict=True
    ):
        close(mine, other, 5e-12)  # measured 4.0e-13


def test_far_from_the_base_float32_keeps_its_digits():
    """A chain of 60 joints: what float32 loses in the common frame grows with the distance, here it does not."""
    robot = tree(tuple(range(60)), seed=3)
    rng, B = np.random.default_rng(0), 4
    q, v, tau = rng.normal(size=(B, robot.nq)), 0.1 * rng.normal(size=(B, robot.nv)), rng.normal(size=(B, robot.nv))
    q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)

    def accelerations(frame, dtype):
        chain = sdyn.pack(robot, frame=frame, dtype=dtype)
        f = jax.jit(jax.vmap(sdyn.forward_dynamics, (None, 0, 0, 0)), **QUICKLY)
        return np.asarray(f(chain, *(jnp.asarray(x, dtype) for x in (q, v, tau))), float)

    exact = accelerations("link", "float64")
    error = lambda *how: np.abs(accelerations(*how) - exact).max() / np.abs(exact).max()
    common, link = error("common", "float32"), error("link", "float32")
    assert link < 5e-6, link  # measured 6.5e-7
    assert common > 3 * link, (common, link)  # measured 6.3e-6
    assert error("common", "float64") < 1e-13  # measured 8.3e-15


def test_frame_is_a_compile_key_and_a_word():
    robot = tree((0,))
    assert sdyn.pack(robot, frame="link").capacity != sdyn.pack(robot).capacity
    assert sdyn.capacity([robot], frame="link").frame == "link"
    with pytest.raises(sdyn.RobotError, match=r"the frame is 'world'.*common"):
        sdyn.pack(robot, frame="world")
