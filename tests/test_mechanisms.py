"""Mechanisms of the literature over seconds: closed without drift, and where the references are."""

import json
from functools import partial

import jax
import jax.numpy as jnp
import mechanisms
import numpy as np
import oracles
import pytest
from scipy.integrate import solve_ivp
from structures import QUICKLY, close

import sdyn

DOWN = np.array([0.0, -9.81, 0.0])


@partial(jax.jit, static_argnums=4)
def roll(chain, q, v, dt, steps):
    """States, energies and how far the closures are open."""
    qs, vs = sdyn.rollout(chain, q, v, jnp.zeros((steps, chain.nv)), dt, gravity=DOWN)
    mass = sdyn.params(chain).mass.sum()
    energy = lambda q, v: sdyn.kinetic_energy(chain, q, v) - mass * sdyn.centre_of_mass(chain, q) @ DOWN
    residual = lambda q: jnp.abs(sdyn.loop_residual(chain, q)).max()
    return qs, vs, jax.vmap(energy)(qs, vs), jax.vmap(residual)(qs).max()


@pytest.mark.parametrize("method", ["proximal", "partition"])
def test_states_of_a_four_bar(method):
    """Accelerations and the force in the pin, with two rows and in space with five, three of them dead."""
    states = json.loads((oracles.DATA / "fourbar_states.json").read_text())["states"]
    q, v, tau, want, force = (
        np.array([[float(y) for y in x[key]] for x in states]) for key in ("q", "qd", "tau", "qdd", "lam_on_coupler_xy")
    )
    for kind, first in (("point", 0), ("revolute", 2)):
        chain = sdyn.pack(mechanisms.four_bar(kind))
        solve = lambda q, v, tau, chain=chain: sdyn.constrained_dynamics(chain, q, v, tau, gravity=DOWN, method=method)
        vdot, lam, status = jax.jit(jax.vmap(solve), **QUICKLY)(q, v, tau)
        close(vdot, want, 1e-14)  # 7.5e-16
        turn = (q[:, 0] + q[:, 1])[:, None]  # frame a turns with the coupler
        c, s, (x, y) = np.cos(turn), np.sin(turn), (np.asarray(lam)[:, [first + k]] for k in (0, 1))
        close(np.concatenate([c * x - s * y, s * x + c * y], 1), force, 1e-13)
        assert (status.rank == 2).all()


def test_four_bar_for_ten_seconds():
    """Against 30 digits."""
    data = np.load(oracles.DATA / "fourbar_rbdjl.npz")
    keys = ("theta", "gamma", "phi")
    q, v, energy, residual = roll(
        sdyn.pack(mechanisms.four_bar()), np.array([data[k][0] for k in keys]), np.zeros(3), 0.0005, 20000
    )
    every = 20000 // (len(data["t"]) - 1)
    close(q[::every], np.stack([data[k] for k in keys], 1), 1e-8)
    close(v[::every], np.stack([data[f"{k}_dot"] for k in keys], 1), 1e-8)
    close(energy, np.full(20001, energy[0]), 1e-9)
    assert residual < 1e-14


def test_bricard():
    """Ten seconds of a chain whose closure has five rows of rank four: energy to 1e-9 J, points to 1e-7 m."""
    data = np.load(oracles.DATA / "bricard_square.npz")
    chain = sdyn.pack(mechanisms.bricard())
    still = np.zeros(5)
    _, _, status = jax.jit(sdyn.constrained_dynamics, **QUICKLY)(chain, still, still, still, gravity=DOWN)
    assert status.rank == 4 and status.redundant and not status.singular
    q, _, energy, residual = roll(chain, np.zeros(5), np.zeros(5), 0.0025, 4000)
    assert np.abs(energy - energy[0]).max() < 1e-9 and residual < 1e-14  # 6.4e-11, 6.9e-16
    want = np.stack([data["a"], data["b"], -data["a"], -data["b"], -data["a"]], 1)
    close(q[::4], want, 1e-9)  # 1.6e-10


def test_andrews():
    """The squeezer at 0.03 s, in quadruple precision."""
    robot, p = mechanisms.andrews()
    chain, data, names = sdyn.pack(robot), np.load(oracles.DATA / "andrews.npz"), mechanisms.ANDREWS
    force = mechanisms.andrews_force(p)
    rows = slice(None, None, 10)
    q, v, want = (np.stack([data[x + end][rows] for x in names], 1) for end in ("", "_dot", "_ddot"))
    for method in ("proximal", "partition"):
        solve = lambda q, v, method=method: sdyn.constrained_dynamics(chain, q, v, force(0, q, v), method=method)
        vdot, _, status = jax.jit(jax.vmap(solve), **QUICKLY)(q, v)
        close(vdot, want, 2e-14)  # 2.1e-15
        assert (status.rank == 6).all()
    start = np.array([data[x][0] for x in names])
    q, v = jax.jit(lambda q, v: sdyn.rollout(chain, q, v, force, 0.03 / 4500, steps=4500))(start, np.zeros(7))
    close(q[-1], np.array([data[x][-1] for x in names]), 1e-11)  # 3e-12
    close(v[-1], np.array([data[f"{x}_dot"][-1] for x in names]), 1e-9)
    assert np.abs(jax.vmap(lambda q: sdyn.loop_residual(chain, q))(q)).max() < 1e-12  # 5e-17


@pytest.mark.parametrize("count", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 5, 10))])
def test_row_of_four_bars(count):
    """Ten turns through positions where all rods are in line and the rank drops: a pendulum in closed form."""
    chain = sdyn.pack(mechanisms.row_of_four_bars(count))
    q = np.r_[np.full(count + 1, np.pi / 2), np.full(count, -np.pi / 2)]
    v = np.r_[np.full(count + 1, -1.0), np.full(count, 1.0)]
    dt, steps = 0.005, 2000
    qs, _, energy, residual = roll(chain, q, v, dt, steps)
    assert np.abs(energy / energy[0] - 1).max() < 1e-8 and residual < 1e-13  # 1.5e-9, 4e-15
    angle = np.asarray(qs)[:, : count + 1]
    close(angle, angle[:, :1] + 0 * angle, 1e-11)  # the branch of the parallelogram
    close(qs[:, count + 1 :], -angle[:, :count], 1e-11)
    inertia, weight = (count + 1) / 3 + count, 9.81 * ((count + 1) / 2 + count)
    slope = lambda t, y: [y[1], -weight / inertia * np.cos(y[0])]
    t = np.arange(steps + 1) * dt
    want = solve_ivp(slope, (0, t[-1]), q[:1].tolist() + v[:1].tolist(), "DOP853", t, rtol=1e-12, atol=1e-12).y[0]
    close(angle[:, 0], want, 1e-7)  # 8e-8 of 30 rad is 3e-9
    nearest = int(np.argmin(np.abs(np.sin(angle[:, 0]))))
    sigma = jax.jit(lambda q: sdyn.constrained_dynamics(chain, q, 0 * v, 0 * v)[2].sigma_min, **QUICKLY)
    assert sigma(qs[nearest]) < 1e-2 * sigma(qs[0])  # the status says where
