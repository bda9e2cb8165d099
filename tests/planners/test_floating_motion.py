import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sdyn
from planners import floating


@pytest.fixture(scope="module")
def moving():
    """A free arm whose joints swing, with momentum: exact velocities from momentum, and a rollout to compare."""
    robot = sdyn.models.load("planar3")
    chain, k, h = sdyn.pack(robot), 40, 0.05
    t = np.arange(2 * k + 1) * h / 2
    a, w = np.array([0.5, -0.7, 0.4]), np.array([1.1, 0.8, 1.5])
    angle = w * t[:, None]
    q, rate, acceleration = a * np.sin(angle), a * w * np.cos(angle), -a * w**2 * np.sin(angle)
    momentum = floating.Momentum(jnp.array([0.1, 0.2, 0.3]), jnp.array([3.0, -2.0, 1.0]), jnp.array([0.3, -0.2, 0.5]))
    R0 = floating.exponential(jnp.array([0.3, -0.5, 0.8]))

    @jax.jit
    def motion(q, rate, acceleration):
        chains = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(q), *x.shape)), chain)
        c = floating.couplings(chains, q)
        along = lambda x: jnp.broadcast_to(x, (k, *jnp.shape(x)))
        stages = floating.thirds(c.compliance), floating.thirds(floating.drift(c, rate))
        R = floating.attitudes(R0, *stages, along(momentum.angular), along(h))
        c, chains = jax.tree.map(lambda x: x[::2], (c, chains))
        twist = jax.vmap(floating.base_twist, (0, 0, 0, None))(c, R, rate[::2], momentum)
        p = jax.vmap(floating.base_position, (0, 0, 0, None))(c, R, t[::2], momentum)
        v = jnp.concatenate([twist, rate[::2]], axis=1)
        tau, vdot = floating.free_torques(chains, c, q[::2], v, acceleration[::2])
        quat = jax.vmap(floating.quaternion)(R)
        return jnp.concatenate([p, quat, q[::2]], axis=1), v, tau, vdot

    return chain, h, momentum, *map(np.asarray, motion(q, rate, acceleration))


def test_momentum_is_the_given_one(moving):
    chain, _, momentum, q, v, _, _ = moving
    h, centre = jax.jit(jax.vmap(lambda q, v: (sdyn.momentum(chain, q, v), sdyn.centre_of_mass(chain, q))))(q, v)
    assert np.abs(h - np.r_[momentum.angular, momentum.linear]).max() < 1e-13
    assert np.abs(centre[0] - momentum.centre).max() < 1e-14


def test_forward_dynamics_under_the_torques_gives_the_accelerations(moving):
    chain, _, _, q, v, tau, vdot = moving
    tau = np.hstack([np.zeros((len(tau), 6)), tau])
    again = jax.jit(jax.vmap(lambda q, v, tau: sdyn.forward_dynamics(chain, q, v, tau)))(q, v, tau)
    assert np.abs(again - vdot).max() < 1e-11 * np.abs(vdot).max()


def test_a_rollout_under_the_torques_follows_the_motion(moving):
    chain, h, _, q, v, tau, _ = moving
    table = jnp.asarray(np.hstack([np.zeros((len(tau), 6)), tau]))
    force = lambda t, q, v: table[jnp.round(t / h).astype(int)]
    qs, vs = jax.jit(lambda q, v: sdyn.rollout(chain, q, v, force, 2 * h, steps=len(tau) // 2))(q[0], v[0])
    assert np.abs(np.asarray(vs) - v[::2]).max() < 2e-4
    assert np.abs(np.asarray(qs)[:, 7:] - q[::2, 7:]).max() < 2e-4


def test_a_tumbling_body_keeps_its_momentum_and_energy():
    robot = sdyn.models.load("sat50")
    chain = sdyn.pack(robot)
    q, v = robot.neutral(), np.array([0.02, 0.1, 0.07, 0.01, 0.02, 0.03])

    @jax.jit
    def at(time):
        R, p, v_later = floating.tumbled(floating.tumble(chain, jnp.asarray(q), jnp.asarray(v), 30.0, 0.1), time)
        return jnp.concatenate([p, floating.quaternion(R)]), v_later

    later, v_later = map(np.asarray, at(23.4567))
    before, after = (np.asarray(sdyn.momentum(chain, x, y)) for x, y in ((q, v), (later, v_later)))
    assert np.abs(after - before).max() < 1e-13
    energy = [float(sdyn.kinetic_energy(chain, x, y)) for x, y in ((q, v), (later, v_later))]
    assert abs(energy[1] - energy[0]) < 1e-10 * energy[0]


def test_derivatives_through_local_jacobians_are_those_of_central_differences(moving):
    chain, *_ = moving
    chains = jax.tree.map(lambda x: x[None], chain)
    total = lambda q: sum(jnp.sin(x).sum() for x in floating.couplings(chains, q[None]))
    q, d = jnp.array([0.3, -0.4, 0.9]), jnp.array([0.5, 1.0, -0.7])
    run = jax.jit(lambda q: (*jax.jvp(total, (q,), (d,)), jax.grad(total)(q) @ d))
    slope = (run(q + 1e-6 * d)[0] - run(q - 1e-6 * d)[0]) / 2e-6
    _, forward, reverse = run(q)
    assert abs(forward - slope) < 1e-7 and abs(reverse - slope) < 1e-7


def test_the_exponential_is_smooth_at_zero():
    angles = jnp.array([0.0, 1e-3, 0.0999, 0.1001, 1.0])
    near = jax.vmap(floating.exponential)(angles[:, None] * jnp.array([0.6, 0.0, 0.8]))
    assert np.abs(np.einsum("kij,klj->kil", near, near) - np.eye(3)).max() < 1e-14
    slope = jax.jit(jax.jacfwd(floating.exponential))(jnp.zeros(3))
    assert np.allclose(slope, jnp.stack([floating.hat(e) for e in jnp.eye(3)], axis=-1), atol=1e-15)
