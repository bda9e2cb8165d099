"""Two 7-joint arms on a free base take hold of one target, and let it go: one program, and its gradients."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from structures import QUICKLY, close
from test_gradients import differences

import sdyn

STEPS = 32  # of each phase
DURATIONS = np.array([0.3, 0.2, 0.25, 0.25])  # approach, capture and hold, hold under other torques, release


def two_arms():
    """The base of paper37 with two of its arms, the first one holding the target: 20 degrees of freedom."""
    robot = sdyn.models.load("paper37")
    for joint in ("arm3_1", "arm4_1", "wheel_1", "wheel_2", "wheel_3"):
        robot, _ = robot.detach(joint)
    inertia = np.array([[4.0, 0.3, -0.2], [0.3, 5.0, 0.1], [-0.2, 0.1, 3.0]])
    grips = [sdyn.Frame("grip1", "target", position=(0.4, 0, 0)), sdyn.Frame("grip2", "target", position=(-0.4, 0, 0))]
    target = sdyn.Robot([sdyn.Link("target", 40.0, (0.02, -0.03, 0.05), inertia)], frames=grips)
    return robot.attach(target, "hand1", "grip1")


ROBOT = two_arms()
GROUNDED = ROBOT.reroot("target").ground("target")
TORQUES = np.r_[np.zeros(6), np.tile([1.0, 1.0, 0.5, 0.5, 0.1, 0.03, 0.003], 2)]  # N m; the hands are light
VARIANTS = [ROBOT, ROBOT.close("hand2", "grip2"), GROUNDED, GROUNDED.close("hand2", "grip2")]
ORDERS = {"free": np.array([0, 1, 1, 0]), "one arm grounded": np.array([2, 3, 3, 2])}


def start(rng):
    """Angles and rates of the joints, a tumbling base."""
    q = ROBOT.neutral()
    q[7:] = rng.uniform(-0.8, 0.8, 14)
    v = np.r_[0.03 * rng.normal(size=6), 0.1 * rng.normal(size=14)]
    return q, v


def end(family, members, x):
    """A scalar of the whole motion: states, impulses, all of it."""
    q, v, taus, inertia, capture = x
    p = sdyn.params(jax.tree.map(lambda y: y[0], family))
    at = family.capacity.link_names.index("target")
    p = sdyn.Params(p.mass, p.com, p.inertia.at[at].set(inertia))
    family = jax.vmap(sdyn.with_params, (0, None))(family, p)
    durations = jnp.asarray(DURATIONS).at[0].add(capture).at[1].add(-capture)
    out = sdyn.hybrid_rollout(family, q, v, taus, durations, members)
    wave = lambda y: (y * jnp.cos(jnp.arange(y.shape[-1], dtype=y.dtype))).sum()
    return wave(out.q[:, -1]) + wave(out.v[:, -1]) + 0.01 * wave(out.impulse), out


RUN = jax.jit(jax.value_and_grad(end, 2, has_aux=True), **QUICKLY)


@pytest.mark.slow
@pytest.mark.parametrize("case", ORDERS)
def test_gradients_of_a_capture_and_release(case):
    """With respect to the initial state, torques, target inertia and capture time, against differences; energy, closure
    and momentum on the way; both cases are one program.

    The motion keeps away from singular configurations, where differences, not the gradients, are off.
    """
    rng = np.random.default_rng(0)
    family, members = sdyn.family(VARIANTS), ORDERS[case]
    q, v = start(rng)
    x = sdyn.pad(jax.tree.map(lambda y: y[members[0]], family), *((q, v) if case == "free" else (q[7:], v[6:])))
    moves = np.arange(20) >= 6
    x = (*x, rng.normal(size=(4, STEPS, 20)) * TORQUES, ROBOT.link("target").inertia, np.array(0.0))
    (_, out), slope = RUN(family, members, x)
    _check_motion(out, free=case == "free")
    turn = rng.normal(size=(3, 3))
    moving = np.ones(7) if case == "free" else np.zeros(7)
    along = [
        np.r_[0.1 * rng.normal(size=7) * moving, rng.normal(size=14)],
        rng.normal(size=20) * np.r_[moving[:6], np.ones(14)],
        rng.normal(size=x[2].shape) * moves,
        turn + turn.T,
        np.array(0.05),
    ]
    for k, direction in enumerate(along):
        only = tuple(direction if i == k else np.zeros_like(y) for i, y in enumerate(x))
        want = differences(lambda y: RUN(family, members, y)[0][0], x, only, 3e-4)
        close((np.asarray(slope[k]) * direction).sum(), want, 1e-6)  # 3.7e-7 for the inertia, 3.6e-9 for the others
    assert RUN._cache_size() == 1


def _check_motion(out, free):
    """Closed while it should be; the jump loses energy; the momentum of a free robot stays."""
    one = lambda k: jax.tree.map(lambda y: y[k], out.chain)
    for k in (1, 2):
        residual = jax.vmap(partial(sdyn.loop_residual, one(k)))(out.q[k])
        assert np.abs(residual).max() < 1e-12  # 1e-15
        K = jax.vmap(partial(sdyn.loop_jacobian, one(k)))(out.q[k])
        assert np.abs(np.einsum("sij,sj->si", K, out.v[k])).max() < 1e-9  # 8e-11
    before = sdyn.kinetic_energy(one(0), out.q[0, -1], out.v[0, -1])
    after = sdyn.kinetic_energy(one(1), out.q[1, 0], out.v[1, 0])
    assert after < before * (1 - 1e-3)
    close(out.v[3, 0], out.v[2, -1], 1e-13)  # a release does not jump
    if not free:
        return
    h = jax.vmap(lambda c, q, v: jax.vmap(partial(sdyn.momentum, c))(q, v))(out.chain, out.q, out.v)
    close(h, np.broadcast_to(h[0, 0], h.shape), 1e-6)  # 1.6e-7, of the steps
