"""The certificate's measures where there is nothing to compare with, and how exactly it integrates."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planners
import sdyn
from planners.certify import STEP, integrate, see
from planners.certify_grasp import _momentum


@pytest.fixture(scope="module")
def still():
    """A grasp without any momentum: the arm swings, the base reacts, the target rests. (robots, targets)"""
    task = planners.load("grasp_planar")
    before, after = task.chaser, task.compound
    capacity, t = sdyn.capacity([before, after, task.body]), np.linspace(0.0, 2.0, 9)
    momentum = lambda chain, q: jax.jacfwd(lambda v: sdyn.momentum(chain, q, v))(jnp.zeros(9))
    columns = jax.jit(jax.vmap(momentum, (None, 0)))
    joints, rates = np.outer(np.sin(t), [0.5, -0.7, 0.4]), np.outer(np.cos(t), [0.5, -0.7, 0.4])

    def movers(robot):
        q = np.hstack([np.tile([0.0, 0, 0, 1, 0, 0, 0], (len(t), 1)), joints])
        J = np.asarray(columns(sdyn.pack(robot, capacity), q))
        base = -np.linalg.solve(J[..., :6], np.einsum("kij,kj->ki", J[..., 6:], rates)[..., None])[..., 0]
        return robot, "hand", q, np.hstack([base, rates])

    body = task.body, "target_grasp", np.tile(task.body.neutral(), (len(t), 1)), np.zeros((len(t), 6))
    *robots, target = see([movers(before), movers(after), body])
    return robots, [target]


def test_momentum_is_compared_with_its_parts_where_the_total_is_zero(still):
    rows = _momentum(*still)
    assert all(row.ok for row in rows), [(row.name, row.value) for row in rows]  # measured 1e-16


@pytest.mark.parametrize(("part", "name"), [(2, "angular"), (3, "linear")])
def test_momentum_that_comes_from_nowhere_is_seen(still, part, name):
    (before, after), targets = still
    momentum = after.momentum.copy()
    momentum[0, part] += 1e-8 * after.parts[:, 3 * (part // 3) :][:, :3].max()
    bad = [row.name for row in _momentum([before, replace(after, momentum=momentum)], targets) if not row.ok]
    assert f"{name} momentum lost at the grasp, relative" in bad


def test_what_does_not_move_has_lost_nothing(still):
    robots, targets = still
    before, after = (replace(x, momentum=np.zeros((9, 6)), parts=np.zeros((9, 6))) for x in robots)
    assert all(row.value == 0 for row in _momentum([before, after], targets))
    after.momentum[0, 2] = 1e-300
    assert not all(row.ok for row in _momentum([before, after], targets))


def test_a_motion_is_integrated_again_to_eighth_order():
    """A tumbling body under moments and forces that change."""
    chain, steps = sdyn.pack(sdyn.models.load("sat50")), 64
    q, v = np.r_[np.zeros(3), 1.0, np.zeros(3)], np.array([0.3, -0.2, 0.4, 0.1, 0.0, -0.1])

    def end(count):
        t = np.linspace(0.0, 12.0, STEP * count + 1)
        tau = np.sin(np.outer(t, [0.9, 0.7, 0.5, 0.8, 0.4, 0.6])) * [0.4, 0.6, 0.5, 3, 2, 4]
        tau = np.stack([tau[k : k + STEP * count : STEP] for k in range(STEP + 1)], axis=1)
        rest = steps - count  # of no length, so that nothing compiles again
        h = np.r_[np.full(count, 12.0 / count), np.zeros(rest)]
        return np.concatenate([x[-1] for x in integrate(chain, q, v, np.pad(tau, ((0, rest), (0, 0), (0, 0))), h)])

    coarse, fine = (np.abs(end(count) - end(steps)).max() for count in (8, 16))
    assert fine < 1e-5 and coarse > 2**7 * fine  # measured 1.5e-6 and 2^7.7
