"""Motions through phases of other structure: switch times are data, with derivatives, and one program serves all."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from functions import TRANSFER
from structures import QUICKLY, UNBALANCED, capacity, close, padded, real, states, tree
from test_gradients import differences

import sdyn

# -- two bodies on a line, that stick together at a free time ----------------------------------------------------------

A, B, PUSH = 3.0, 5.0, 0.7  # masses, and the constant force between them


@pytest.fixture(scope="module")
def line():
    """Free, and with the slide locked: a plastic grasp at whatever distance it happens."""
    links = [sdyn.Link(name, mass, inertia=np.eye(3)) for name, mass in (("a", A), ("b", B))]
    free = sdyn.Robot(links, [sdyn.Joint("slide", "prismatic", "a", "b", axis=(1.0, 0, 0))])
    return sdyn.family([free, free.lock({"slide": 0.0})])


def at(x):
    """State of the line from the base's place and the distance, and their rates."""
    q = jnp.zeros(8).at[jnp.array([0, 3, 7])].set(jnp.stack([x[0], 1.0, x[1]]))
    return q, jnp.zeros(7).at[jnp.array([3, 6])].set(x[2:])


def end_of_line(family, members, x, push, durations):
    """Place of the base at the end, and all phases."""
    taus = jnp.zeros((len(members), 2, 7)).at[..., 6].set(push)
    out = sdyn.hybrid_rollout(family, *at(x), taus, durations, members)
    return out.q[-1, -1, 0], out


RUN = jax.jit(jax.value_and_grad(end_of_line, (2, 3, 4), has_aux=True), **QUICKLY)
START, TIMES, GRASP = np.array([0.3, 0.9, 0.4, -0.5]), np.array([0.8, 1.7]), np.array([0, 1])


def chosen(chains, k):
    """One of several stacked chains."""
    return jax.tree.map(lambda x: x[k], chains)


def closed_form(x, push, durations):
    """Place of the base at the end, and distance, common velocity and rate at the grasp, by Newton."""
    p, s, vp, vs = x
    t, rest = durations
    p, s = p + vp * t - push / A * t**2 / 2, s + vs * t + push * (1 / A + 1 / B) * t**2 / 2
    vp, vs = vp - push / A * t, vs + push * (1 / A + 1 / B) * t
    common = vp + B / (A + B) * vs
    return p + common * rest, (s, common, vs)


def test_grasp_at_a_free_time(line):
    """Position, distance, velocity, lost energy, impulse; and the slopes of the end, that of the grasp's time too."""
    (place, out), slope = RUN(line, GRASP, START, PUSH, TIMES)
    want, (distance, common, u) = closed_form(START, PUSH, TIMES)
    close(place, want, 2e-15)
    close(out.chain.joint_value[1, 0, 30], distance, 2e-15)
    close(out.v[1, :, 3], np.full(3, common), 2e-15)
    energy = [sdyn.kinetic_energy(chosen(out.chain, k), out.q[k, i], out.v[k, i]) for k, i in ((0, -1), (1, 0))]
    close(energy[0] - energy[1], A * B / (A + B) * u**2 / 2, 5e-15)
    close(out.impulse[1, 1], np.r_[np.zeros(3), -A * B / (A + B) * u, 0, 0], 5e-15)
    assert not np.asarray(out.impulse[0]).any()
    close(out.t, np.array([[0, 0.4, 0.8], [0.8, 1.65, 2.5]]), 2e-15)
    want = jax.grad(lambda *x: closed_form(*x)[0], (0, 1, 2))(START, PUSH, TIMES)
    for a, b in zip(slope, want, strict=True):
        close(a, b, 5e-15)


def test_saltation(line):
    """With the end's time fixed, the slope along the switch time is that of the rest along Dg f− − f+."""
    (_, out), (_, _, slope) = RUN(line, GRASP, START, PUSH, TIMES)

    def rate(chain, q, v, tau):
        vdot = sdyn.forward_dynamics(chain, q, v, jnp.zeros(7).at[6].set(tau))
        return jnp.zeros(8).at[jnp.array([0, 7])].set(v[jnp.array([3, 6])]), vdot

    before, after = chosen(line, 0), chosen(line, 1)
    q, v = out.q[0, -1], out.v[0, -1]
    go = lambda q, v: sdyn.transfer(before, after, q, v)[1:3]
    jump = jax.jit(lambda q, v, *along: jax.jvp(go, (q, v), along), **QUICKLY)
    plus, (dq, dv) = jump(q, v, *rate(before, q, v, PUSH))
    fq, fv = rate(chosen(out.chain, 1), *plus, PUSH)
    want = (dq - fq)[0] + TIMES[1] * (dv - fv)[3]  # behind the switch, the base goes straight on
    close(slope[0] - slope[1], want, 5e-15)


def test_one_compilation(line):
    """Whatever the members, their order, durations and states; a phase may take no time."""
    back = jax.tree.map(lambda x: x[::-1], line)
    f = jax.jit(lambda *x: end_of_line(*x)[0], **QUICKLY)
    close(f(line, GRASP, START, PUSH, TIMES), f(back, 1 - GRASP, START, PUSH, TIMES), 2e-15)
    one = f(line, GRASP, START, PUSH, np.array([0.8, 0.0]))
    two = f(line, 0 * GRASP, START, PUSH, np.array([0.5, 0.3]))
    close(one, two, 2e-15)
    assert f._cache_size() == 1


# -- a tree, locked, re-rooted and unlocked ----------------------------------------------------------------------------

TREE = tree(UNBALANCED)
LOCKS = {"j0": 0.4, "j4": -1.1, "j7": 2.0}
MEMBERS = [TREE, TREE.lock(LOCKS), TREE.lock(LOCKS).reroot("l8")]
ORDER, STEPS = np.array([0, 1, 2, 0]), 2


def motion_of(rng):
    """A family, the start, forces and durations of a motion over changes of structure."""
    chains = [sdyn.pack(robot, capacity()) for robot in MEMBERS]
    family = jax.tree.map(lambda *x: jnp.stack(x), *chains)
    x = padded(TREE, chains[0], states(TREE, "schedule"))
    taus = 0.1 * rng.normal(size=(len(ORDER), STEPS, x.v.shape[1])) * real(MEMBERS[1])
    return family, x, taus, np.array([0.1, 0.15, 0.05, 0.1])


def phases(family, q, v, taus, durations, gravity):
    return sdyn.hybrid_rollout(family, q, v, taus, durations, ORDER, method="semi_implicit", gravity=gravity)


def test_phases_equal_pieces(rng):
    """Against rollouts with transfers by hand."""
    family, x, taus, durations = motion_of(rng)
    out = jax.jit(phases, **QUICKLY)(family, x.q[0], x.v[0], taus, durations, x.gravity[0])
    assert out.q.shape == (len(ORDER), STEPS + 1, x.q.shape[1])
    piece = jax.jit(partial(sdyn.rollout, method="semi_implicit"), **QUICKLY)
    chain, q, v = chosen(family, 0), x.q[0], x.v[0]
    for k, member in enumerate(ORDER):
        if k:
            chain, q, v, impulse = TRANSFER(chain, chosen(family, member), q, v)
            close(out.impulse[k], impulse, 2e-15)
        qs, vs = piece(chain, q, v, taus[k], durations[k] / STEPS, gravity=x.gravity[0])
        close(out.q[k], qs, 2e-15)
        close(out.v[k], vs, 2e-15)
        q, v = qs[-1], vs[-1]


@pytest.mark.slow
def test_gradient_of_phases(rng):
    """Of the end with respect to the start, the forces and the durations, against differences."""
    family, x, taus, durations = motion_of(rng)
    w = np.cos(np.arange(x.v.shape[1]))
    end = lambda v, taus, d: w @ phases(family, x.q[0], v, taus, d, x.gravity[0]).v[-1, -1]
    run = jax.jit(jax.value_and_grad(end, (0, 1, 2)), **QUICKLY)
    at = x.v[0], taus, durations
    along = rng.normal(size=x.v[0].shape) * real(TREE), rng.normal(size=taus.shape) * real(TREE), rng.normal(size=4)
    _, g = run(*at)
    for k in range(3):
        only = tuple(d if i == k else 0 * d for i, d in enumerate(along))
        want = differences(lambda y: run(*y)[0], at, only, 1e-4)
        close((np.asarray(g[k]) * along[k]).sum(), want, 1e-8, scale=1.0)


def test_what_is_refused(line):
    go = partial(sdyn.hybrid_rollout, line, *at(jnp.zeros(4)))
    with pytest.raises(ValueError, match="2 durations and members of shape"):
        go(np.zeros((2, 3, 7)), np.ones(2), np.array([0, 1, 0]))
    with pytest.raises(ValueError, match="3 phases"):
        go(np.zeros((3, 2, 7)), np.ones(2), np.array([0, 1]))
    with pytest.raises(ValueError, match=r"\[phases, steps, nv\]"):
        go(np.zeros((3, 7)), np.ones(2), np.array([0, 1]))
    with pytest.raises(ValueError, match="say how many steps"):
        go(lambda t, q, v: 0 * v, np.ones(2), np.array([0, 1]))
