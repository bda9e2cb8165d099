"""Honest numbers: how many digits there can be, where a motion breaks, and how fast its errors grow."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from host_dynamics import mass_matrix
from structures import QUICKLY, ROBOTS, packed, padded, states

import sdyn
from sdyn.diagnose import QUANTITIES

CONDITION = jax.jit(sdyn.conditioning, **QUICKLY)
DIAGNOSE = jax.jit(lambda chain, qs, vs: sdyn.diagnose(chain, qs, vs, gravity=jnp.zeros(3, chain.dtype)), **QUICKLY)


@pytest.mark.parametrize("name", ["unbalanced_tree", "leaf_as_base", "grounded", "all_kinds", "passive", "one_body"])
def test_conditioning_is_that_of_the_scaled_mass_matrix(name):
    """In the layout with empty slots too, which count for nothing."""
    robot, chain = ROBOTS[name](), packed(name)
    values = {joint.name: [1.0, 0, 0, 0] if joint.kind == "spherical" else np.zeros(joint.nq) for joint in robot.moving}
    M = mass_matrix(robot, values)
    size = np.sqrt(np.diag(M))
    want = np.linalg.cond(M / np.outer(size, size))
    q, _ = sdyn.pad(chain, robot.neutral(), robot.velocity())
    found, trust = CONDITION(chain, q)
    assert abs(found - want) <= 1e-10 * want and trust == sdyn.Trust.GOOD  # measured 3e-14


def broken(quantity, at):
    """Twenty states of one structure, one of them bad."""
    chain, robot = packed("unbalanced_tree"), ROBOTS["unbalanced_tree"]()
    x = padded(robot, chain, states(robot, "unbalanced_tree"))
    qs, vs = np.array(jnp.tile(x.q[:1], (20, 1))), np.array(jnp.tile(x.v[:1], (20, 1)))
    if quantity in (1, 2):
        (qs, vs)[quantity - 1][at:, 8] = np.nan if at % 2 else np.inf
    if quantity == 3:
        qs[at:, 3:7] *= 1.01
    return chain, qs, vs


@pytest.mark.parametrize(("quantity", "at"), [(1, 7), (2, 0), (1, 19), (3, 4), (0, -1)])
def test_the_first_bad_step_is_named(quantity, at):
    """And everything else is said about the states before it, in finite numbers."""
    found = DIAGNOSE(*broken(quantity, at))
    assert (found.bad_step, found.bad_quantity) == (at, quantity)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(found))
    assert found.energy < 1e-12 and found.closures == 0 and found.sigma_min == 1
    assert ("All states are good" if at < 0 else f"State {at} is bad: {QUANTITIES[quantity]}") in str(found)


def test_drift_is_that_of_the_states():
    """A state with twice the velocity has twice the momentum and four times the energy, which is 1/2 v M v."""
    chain, qs, vs = broken(0, 0)
    robot, v = ROBOTS["unbalanced_tree"](), vs[0]
    values = {joint.name: qs[0, 7 + k : 8 + k] for k, joint in enumerate(robot.joints)}
    energy = v[:14] @ mass_matrix(robot, values) @ v[:14] / 2
    vs[11] *= 2
    found = DIAGNOSE(chain, qs, vs)
    assert abs(found.energy / (3 * energy) - 1) <= 1e-13  # measured 1e-15
    vs[11] *= 2
    assert np.abs(DIAGNOSE(chain, qs, vs).momentum / found.momentum - 3).max() <= 1e-12  # measured 7e-16


def test_float32_refuses_what_it_cannot_resolve():
    """A tip of 1e8 times the mass of the base, computed from the base: refused in float32, good in float64. From the
    tip, as `pack` chooses it, good."""
    robot = sdyn.Robot(
        [sdyn.Link("a", 1.0, (0, 0, 0.1), np.eye(3)), sdyn.Link("b", 1.0, (0, 0, 0.3), np.eye(3)),
         sdyn.Link("c", 1e8, (0.1, 0, 0.5), 1e8 * np.eye(3))],
        [sdyn.Joint("j", "revolute", "a", "b", position=(0, 0.2, 0.5), axis=(1, 0, 0)),
         sdyn.Joint("k", "revolute", "b", "c", position=(0.3, 0, 0.5), axis=(0, 1, 0))],
    )  # fmt: skip

    def found(robot, dtype, chosen):
        state = robot.neutral().astype(dtype)[None], robot.velocity().astype(dtype)[None]
        chain = sdyn.pack(robot, dtype=dtype)
        return DIAGNOSE(chain if chosen else replace(chain, inner=None), *state)

    bad = found(robot, "float32", False)
    assert bad.bad_step == 0 and "the mass matrix is refused" in str(bad)
    assert found(robot, "float32", True).trust == sdyn.Trust.GOOD
    assert found(robot, "float64", False).trust == sdyn.Trust.GOOD
