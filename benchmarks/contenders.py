"""What is timed: functions of this library in compiled loops, and calls of the peers, on the same states."""

from functools import partial

import harness
import jax
import jax.numpy as jnp
import numpy as np
import peers
from harness import Contender, calls, loop

import sdyn

STATES = 64  # that C and C++ peers cycle through


def batched(f):
    """The function for states, of one structure."""
    return lambda chain, *x: jax.vmap(f, (None, *(0,) * len(x)))(chain, *x)


def forward(
    robot, batch: int, *, dtype="float64", width=None, frame="common", capacity=None, all_at_once=None
) -> Contender:
    """Forward dynamics of `batch` states in a compiled loop; batch 1 is one state, without vmap."""
    chain = sdyn.pack(robot, capacity, width=width, frame=frame, dtype=dtype)
    q, v, tau = peers.states(robot, batch)
    if capacity is not None:
        (q, v), (_, tau) = sdyn.pad(chain, q, v), sdyn.pad(chain, q, tau)
    x = tuple(jnp.asarray(y[0] if batch == 1 else y, dtype) for y in (q, v, tau))
    f = sdyn.forward_dynamics if batch == 1 else all_at_once or batched(sdyn.forward_dynamics)
    return Contender(loop(lambda chain, x: f(chain, *x), chain, x), batch)


def gradient(robot, batch: int) -> Contender:
    """Gradient of a scalar of the accelerations with respect to q, v and tau."""
    weights = jnp.asarray(np.random.default_rng(1).normal(size=robot.nv))
    slopes = jax.grad(lambda x, chain: weights @ sdyn.forward_dynamics(chain, *x))
    f = lambda chain, x: jax.vmap(slopes, (0, None))(x, chain)
    return Contender(loop(f, sdyn.pack(robot), peers.states(robot, batch)), batch)


def jacobians(robot, batch: int, by=jax.jacrev) -> Contender:
    """All derivatives d vdot / d (q, v, tau), by `jax.jacrev` or `jax.jacfwd`."""
    all_slopes = by(lambda x, chain: sdyn.forward_dynamics(chain, *x))
    f = lambda chain, x: jax.tree.map(lambda J: J.sum(1), jax.vmap(all_slopes, (0, None))(x, chain))
    return Contender(loop(f, sdyn.pack(robot), peers.states(robot, batch)), batch)


def columns(robot, batch: int) -> Contender:
    """The same, by `sdyn.forward_dynamics_jacobians`."""

    def f(chain, x):
        _, *slopes = jax.vmap(sdyn.forward_dynamics_jacobians, (None, 0, 0, 0))(chain, *x)
        of_q, of_v, of_tau = (J.sum(1) for J in slopes)
        return jnp.pad(of_q, ((0, 0), (1, 0))), of_v, of_tau

    return Contender(loop(f, sdyn.pack(robot), peers.states(robot, batch)), batch)


def pinocchio(peer) -> dict[str, Contender]:
    """ABA in both of its conventions, and its derivatives."""
    pin, model, data = peer.pin, peer.model, peer.data
    states = list(zip(peer.q, peer.v, peer.tau, strict=True))

    def every(f, *last):
        def run(n):
            for _ in range(n):
                for state in states:
                    f(model, data, *state, *last)

        return Contender(run, len(states))

    return {
        "pin.aba": every(pin.aba),
        "pin.aba (world)": every(pin.aba, pin.Convention.WORLD),
        "pin.computeABADerivatives": every(pin.computeABADerivatives),
    }


def mujoco(peer) -> dict[str, Contender]:
    """One state from Python, and many in the C loop."""
    from mujoco import rollout

    peer.set(0)
    start = np.concatenate([np.zeros((len(peer.q), 1)), peer.q, peer.v], 1)
    pool, steps = rollout.Rollout(nthread=0), 10
    roll = partial(pool.rollout, peer.model, peer.data, start, nstep=steps)
    return {
        "mj_forward": Contender(calls(partial(peer.mujoco.mj_forward, peer.model, peer.data)), 1),
        "mj_step": Contender(calls(partial(peer.mujoco.mj_step, peer.model, peer.data)), 1),
        "mujoco.rollout": Contender(calls(roll), steps * len(start)),
    }


def in_jax(peer, batch: int) -> dict[str, Contender]:
    """A peer that is written in JAX, in the same loop as ours."""
    f = lambda _, x: jax.vmap(peer.accelerations)(*x)
    return {f"{peer.name}, batch {batch}": Contender(loop(f, None, (peer.q, peer.v, peer.tau)), batch)}


def of_peer(kind, robot, batch: int) -> dict[str, Contender]:
    """Contenders of one peer; `batch` for those in JAX."""
    in_c = {peers.Pinocchio: pinocchio, peers.MuJoCo: mujoco}
    if kind in in_c:
        return in_c[kind](kind(robot, *peers.states(robot, STATES)))
    return in_jax(kind(robot, *peers.states(robot, batch)), batch)


def overhead(kinds) -> dict[str, float] | None:
    """What `pin.aba` of a single body costs: more than the call from Python that each of its timings holds."""
    if peers.Pinocchio not in kinds:
        return None
    body = sdyn.Robot([sdyn.Link("body", 1.0, inertia=np.eye(3))])
    run = pinocchio(peers.Pinocchio(body, *peers.states(body, STATES)))
    times, _ = harness.times({"pin.aba": run["pin.aba"]})
    return harness.spread(times["pin.aba"])
