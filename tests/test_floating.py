"""A base that only reacts, over the table of structures; wheels and thrusters."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from functions import FD, ID, MASS, MOTION, TOTALS
from structures import (
    QUICKLY,
    ROBOTS,
    STATES,
    TABLE,
    close,
    on_states,
    packed,
    q_rate,
    real,
    robot,
    state,
    states,
    tree,
)
from test_gradients import differences

import sdyn

over_table = pytest.mark.parametrize("name", TABLE)
FREE = [name for name in TABLE if not ROBOTS[name]().grounded]


def forms(chain, q, v, tau, gravity, f_ext, vdot, momentum):
    """Everything of `floating.py`, at a momentum."""
    options = dict(gravity=gravity, f_ext=f_ext)
    found, there = sdyn.floating_forward_dynamics(chain, q, v[6:], tau[6:], momentum, **options)
    forces = sdyn.floating_inverse_dynamics(chain, q, v, vdot[6:], wrench=tau[:6], **options)
    reduced = sdyn.reduced_dynamics(chain, q, v[6:], momentum, **options)
    return found, there, forces, reduced, sdyn.reaction_null_space(chain, q)


FORMS = on_states(forms, **QUICKLY)


def forms_of(name):
    chain, x = packed(name), state(name)
    momentum = TOTALS(chain, x.q, x.v)[0] if name in FREE else np.ones((STATES, 6))
    return FORMS(chain, *x, momentum), momentum


@over_table
def test_velocity_and_forward_dynamics(name):
    """The velocity at the momentum of a state is the state's, and the acceleration is that of an idle base."""
    chain, x = packed(name), state(name)
    (v, vdot, *_), _ = forms_of(name)
    close(v, x.v, 9e-14)  # 8.6e-15
    idle = np.array(x.tau)
    idle[:, :6] = 0
    want = FD(chain, x.q, x.v, idle, x.gravity, x.f_ext)
    close(vdot, want, 7e-12)  # 6.2e-13


@over_table
def test_inverse_dynamics(name):
    """The torques and the wrench cause the joint accelerations and the base's, by both other algorithms."""
    chain, x = packed(name), state(name)
    (_, _, (tau, vdot), *_), _ = forms_of(name)
    close(tau[:, :6], x.tau[:, :6] * float(chain.free), 2e-15)  # 0
    close(vdot[:, 6:], x.vdot[:, 6:], 2e-15)  # 0
    bias = ID(chain, x.q, x.v, 0 * vdot, x.gravity, x.f_ext)
    close(tau, ID(chain, x.q, x.v, vdot, x.gravity, x.f_ext), 3e-14, scale=bias)  # 2.1e-15
    close(FD(chain, x.q, x.v, tau, x.gravity, x.f_ext), vdot, 2e-11)  # 1.3e-12
    assert not np.asarray(tau)[:, ~real(robot(name))].any() and not np.asarray(vdot)[:, ~real(robot(name))].any()


@over_table
def test_reduced_dynamics(name):
    """M* q̈ + b* = τ holds for the motion of an idle base; M* is the inverse of the joints' block of M^-1."""
    chain, x, at = packed(name), state(name), real(robot(name))
    (_, vdot, _, (M, b), _), _ = forms_of(name)
    tau = np.asarray(x.tau)[:, 6:]
    close(np.einsum("sij,sj->si", M, np.asarray(vdot)[:, 6:]) + b, tau, 3e-13, scale=b)  # 2.4e-14
    close(M, np.asarray(M).swapaxes(1, 2), 4e-15, scale=MASS(chain, x.q))  # 3.9e-16
    joints = at[6:]
    assert not np.asarray(M)[:, ~joints].any() and not np.asarray(b)[:, ~joints].any()
    nb = int(at[:6].sum())
    for k in range(STATES):
        own = np.asarray(MASS(chain, x.q))[k][np.ix_(at, at)]
        want = np.linalg.inv(np.linalg.inv(own)[nb:, nb:])
        close(np.asarray(M)[k][np.ix_(joints, joints)], want, 9e-13)  # 8.1e-14


@over_table
def test_reaction_null_space(name):
    """An orthogonal projector onto rates with no reaction, as large as the rank leaves room."""
    chain, x, joints = packed(name), state(name), real(robot(name))[6:]
    (*_, (N, rank)), _ = forms_of(name)
    N, rank = np.asarray(N), np.asarray(rank)
    close(N, N.swapaxes(1, 2), 2e-15, scale=1.0)  # 2.8e-17
    close(N @ N, N, 2e-14, scale=1.0)  # 1.8e-15
    across = np.asarray(MASS(chain, x.q))[:, :6, 6:]
    close(across @ N, 0 * across, 2e-14, scale=across)  # 1.5e-15
    close(np.trace(N, axis1=1, axis2=2), joints.sum() - rank, 5e-14, scale=1.0)  # 4.6e-15
    assert not N[:, ~joints].any()
    if name not in FREE:
        assert (rank == 0).all()
        return
    for k in range(STATES):  # the rank, with singular values far from the tolerance
        s = np.linalg.svd(across[k] / np.linalg.norm(across[k]) if joints.any() else np.zeros((6, 1)))[1]
        assert rank[k] == (s > 1e-9).sum()


def along_motion(chain, q, v, q_rate, vdot, momentum, wrench):
    """Slopes along a motion and a change of momentum: of the velocity, and of M_bj N, with M_bj and N."""
    f = lambda q, rates, h: sdyn.floating_velocity(chain, q, rates, h)
    slope = jax.jvp(f, (q, v[6:], momentum), (q_rate, vdot[6:], wrench))[1]
    g = lambda q: (sdyn.mass_matrix(chain, q)[:6, 6:], sdyn.reaction_null_space(chain, q)[0])
    return slope, *jax.jvp(g, (q,), (q_rate,))


ALONG = on_states(along_motion, **QUICKLY)


@pytest.mark.parametrize("name", FREE)
def test_slopes_along_a_motion(name):
    """d/dt of the velocity at given momentum is the acceleration, the momentum growing by m g and nothing else; the
    null space follows the reaction."""
    mine, chain, x = robot(name), packed(name), state(name)
    exact, (_, momentum) = states(mine, name), forms_of(name)
    rate = np.array([q_rate(mine, *row) for row in zip(exact.q, exact.v, strict=True)])
    rate = np.pad(rate, ((0, 0), (0, chain.nq - rate.shape[1])))
    idle = np.array(x.tau)
    idle[:, :6] = 0
    vdot = FD(chain, x.q, x.v, idle, x.gravity, 0 * x.f_ext)
    weight = np.pad(sum(link.mass for link in mine.links) * np.asarray(x.gravity), ((0, 0), (3, 0)))
    slope, (A, N), (dA, dN) = ALONG(chain, x.q, x.v, rate, vdot, momentum, weight)
    close(slope, vdot, 3e-14)  # 2.1e-15
    A, N, dA, dN = map(np.asarray, (A, N, dA, dN))
    close(dA @ N + A @ dN, 0 * A, 3e-12, scale=dA)  # 2.3e-13
    close(dN, dN.swapaxes(1, 2), 2e-15, scale=1.0)  # 0
    close(N @ dN + dN @ N, dN, 6e-12, scale=1.0)  # 5.2e-13


# -- derivatives, layouts ----------------------------------------------------------------------------------------------


def wave(x):
    """A sum with weights that tell the entries apart."""
    return sum((y * jnp.cos(jnp.arange(y.size, dtype=y.dtype)).reshape(y.shape)).sum() for y in jax.tree.leaves(x))


def value(parts, chain, x):
    """One scalar of the forms, under a thruster that turns with its link."""
    q, v, vdot, momentum, wrench, mass = x
    p = sdyn.params(chain)
    chain = sdyn.with_params(chain, sdyn.Params(mass, p.com, p.inertia))
    thrust = sdyn.frame_wrench(chain, q, chain.capacity.frame_names.index("e0"), wrench)
    return sum(
        {
            "velocity": lambda: wave(sdyn.floating_velocity(chain, q, v[6:], momentum)),
            "inverse": lambda: wave(sdyn.floating_inverse_dynamics(chain, q, v, vdot[6:], wrench=wrench, f_ext=thrust)),
            "null": lambda: wave(sdyn.reaction_null_space(chain, q)[0]),
            "jacobian": lambda: wave(sdyn.generalised_jacobian(chain, q, 0)),
            "forward": lambda: wave(sdyn.floating_forward_dynamics(chain, q, v[6:], vdot[6:], momentum, f_ext=thrust)),
            "reduced": lambda: wave(sdyn.reduced_dynamics(chain, q, v[6:], momentum, f_ext=thrust)),
        }[part]()
        for part in parts
    )


@cache
def slopes(parts):
    return jax.jit(jax.value_and_grad(partial(value, parts), 1), **QUICKLY)


PARTS = [("velocity", "null"), pytest.param(("inverse", "jacobian", "forward", "reduced"), marks=pytest.mark.slow)]


@pytest.mark.parametrize("row", [0, 2])
@pytest.mark.parametrize("name", ["one_body", "grounded", "unbalanced_tree", "all_kinds_backwards", "all_locked"])
@pytest.mark.parametrize("parts", PARTS, ids=" ".join)
def test_derivatives(parts, name, row, rng):
    """With respect to the state, momentum, wrench and masses, against differences; finite where nothing is."""
    chain, x, mine = packed(name), state(name), robot(name)
    x = (x.q[row], x.v[row], x.vdot[row], *rng.normal(size=(2, 6)), sdyn.params(chain).mass)
    along = [rng.normal(size=y.shape) for y in x]
    along[-1] = along[-1] * np.asarray(x[-1])
    along[1], along[2] = along[1] * real(mine), along[2] * real(mine)
    y, found = slopes(parts)(chain, x)
    assert all(np.isfinite(z).all() for z in found)
    for k, key in enumerate(found):
        only = tuple(d if i == k else np.zeros_like(d) for i, d in enumerate(along))
        want = differences(lambda x: slopes(parts)(chain, x)[0], x, only, 1e-4)
        close((np.asarray(key) * along[k]).sum(), want, 1e-9, scale=y)  # 5.6e-11


@pytest.mark.parametrize("name", ["one_body", "all_kinds_grounded"])
def test_exact_layout(name):
    """The same numbers without padding, where there is no joint and where there is no base block."""
    mine, chain, x, at = robot(name), sdyn.pack(robot(name)), states(robot(name), name), real(robot(name))
    nb = 6 - 6 * mine.grounded

    @partial(jax.jit, **QUICKLY)
    def exact(chain, q, v, tau, vdot, momentum):
        found = sdyn.floating_forward_dynamics(chain, q, v[nb:], tau[nb:], momentum)
        forces = sdyn.floating_inverse_dynamics(chain, q, v, vdot[nb:], wrench=tau[:6] if nb else None)
        return *found, *forces, *sdyn.reduced_dynamics(chain, q, v[nb:], momentum), *sdyn.reaction_null_space(chain, q)

    momentum = np.arange(6.0)
    y, none = state(name), 0 * state(name).f_ext
    want = FORMS(packed(name), y.q, y.v, y.tau, 0 * y.gravity, none, y.vdot, np.tile(momentum, (STATES, 1)))
    v, vdot, (tau, other), (M, b), (N, rank) = jax.tree.map(lambda z: np.asarray(z)[0], want)
    want = v[at], vdot[at], tau[at], other[at], M[at[6:]][:, at[6:]], b[at[6:]], N[at[6:]][:, at[6:]], rank
    for a, b in zip(exact(chain, x.q[0], x.v[0], x.tau[0], x.vdot[0], momentum), want, strict=True):
        close(a, b, 2e-14)  # 1.7e-15


# -- closed chains -----------------------------------------------------------------------------------------------------


def test_closed_chain(rng):
    """Two arms on one target, free: motion, forces, null space and reduced equations hold the loop, by its rows."""
    frames = [sdyn.Frame(f"e{k}", "l7", position=p) for k, p in enumerate(rng.uniform(-0.2, 0.2, (2, 3)))]
    robot = tree((0, 1, 2, 3, 4, 5, 6, 0, 8, 9, 10, 11, 12, 13), seed=7)
    q = robot.neutral()
    q[7:] = rng.normal(size=14)
    closed = robot.close("e0", frames[1], q=q)
    chain, joints = sdyn.pack(closed), slice(6, None)
    K = np.asarray(sdyn.loop_jacobian(chain, q))
    assert np.abs(K[:, :6]).max() < 1e-14
    rates = rng.normal(size=14)
    rates -= np.linalg.pinv(K[:, joints]) @ K[:, joints] @ rates
    tau, momentum = rng.normal(size=14), rng.normal(size=6)

    @partial(jax.jit, **QUICKLY)
    def everything(chain, q, rates, tau, momentum):
        v, vdot = sdyn.floating_forward_dynamics(chain, q, rates, tau, momentum)
        force, again = sdyn.floating_inverse_dynamics(chain, q, v, vdot[joints])
        back = sdyn.floating_forward_dynamics(chain, q, rates, force[joints], momentum)[1]
        M, b = sdyn.reduced_dynamics(chain, q, rates, momentum)
        return v, vdot, again, back, M, b, *sdyn.reaction_null_space(chain, q), sdyn.mass_matrix(chain, q)

    v, vdot, again, back, M, b, N, rank, mass = map(np.asarray, everything(chain, q, rates, tau, momentum))
    close(sdyn.momentum(chain, q, v), momentum, 1e-13)
    close(again, vdot, 1e-11)
    close(back, vdot, 1e-11)
    lam = np.linalg.lstsq(K[:, joints].T, M @ vdot[joints] + b - tau)[0]
    close(M @ vdot[joints] + b, tau + K[:, joints].T @ lam, 1e-11, scale=b)
    assert rank == 12
    close(np.trace(N), 2.0, 1e-12)
    close(mass[:6, joints] @ N, np.zeros((6, 14)), 1e-13, scale=mass)
    close(K[:, joints] @ N, np.zeros((6, 14)), 1e-13, scale=K)


# -- wheels and thrusters ----------------------------------------------------------------------------------------------


def test_wheels():
    """Their sum is the momentum of a robot at rest but for its wheels; limits, locked wheels, slopes."""
    paper = sdyn.models.load("paper37")
    size = sdyn.capacity([paper])
    names = [joint.name for joint in paper.moving if joint.name.startswith("wheel")]
    spin = dict(zip(names, (300.0, -628.3, 10.0), strict=True))
    q = paper.configuration({"arm1_2": 0.4}, quaternion=[0.5, 0.5, -0.5, 0.5])
    chain = sdyn.pack(paper, size)
    run = jax.jit(lambda chain, q, v: (sdyn.wheels(chain, q, v, names, 67.0), sdyn.momentum(chain, q, v)), **QUICKLY)
    load, h = run(chain, *sdyn.pad(chain, q, paper.velocity(spin)))
    close(load.momentum, [0.108 * w for w in spin.values()], 3e-15)  # 2.1e-16
    close(h, np.r_[load.total, 0, 0, 0], 3e-15)  # 2.1e-16
    assert load.saturated.tolist() == [False, True, False]

    locked = paper.lock({names[1]: 0.3})
    chain = sdyn.pack(locked, size)
    spin.pop(names[1])
    q, v = sdyn.pad(chain, locked.neutral(), locked.velocity(spin))
    load, _ = run(chain, q, v)
    assert load.momentum[1] == 0 and not load.saturated.any()
    with pytest.raises(sdyn.RobotError, match="wheel_9"):
        sdyn.wheels(chain, q, v, ["wheel_9"])


@pytest.mark.parametrize("name", ["unbalanced_tree", "grounded", "all_kinds_locked"])
@pytest.mark.parametrize("axes", ["frame", "world"])
def test_frame_wrench(axes, name, rng):
    """A wrench at a frame is J^T of it, turned into the world where it is given in the frame's axes."""
    chain, x = packed(name), state(name)
    frame = chain.capacity.frame_names.index("e0")
    wrench = rng.normal(size=(STATES, 6))
    f_ext = WRENCH[axes](chain, x.q, np.full(STATES, frame), wrench)
    R, _, _, _, J = (np.asarray(y)[:, frame] for y in MOTION(chain, x.q, x.v, x.vdot))
    world = wrench if axes == "world" else np.einsum("sij,skj->ski", R, wrench.reshape(-1, 2, 3)).reshape(-1, 6)
    got = ID(chain, x.q, x.v, x.vdot, x.gravity, f_ext) - ID(chain, x.q, x.v, x.vdot, x.gravity, 0 * f_ext)
    close(got, -np.einsum("skv,sk->sv", J, world), 4e-13)  # 3.5e-14
    with pytest.raises(ValueError, match="'body'"):
        sdyn.frame_wrench(chain, x.q[0], "e0", wrench[0], axes="body")


WRENCH = {axes: on_states(partial(sdyn.frame_wrench, axes=axes), **QUICKLY) for axes in ("frame", "world")}
