"""Derivatives over the table of structures: with respect to everything, forward and reverse, at rest and at the
identity pose (the third state), on padded, locked and single bodies.

The function is w . vdot with a fixed w. Each block of arguments has a direction of its own, so that an error in one
cannot hide behind another.
"""

from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from functions import fd
from structures import QUICKLY, STATES, TABLE, capacity, close, links_of, packed, real, robot, state, states

import sdyn

over_table = pytest.mark.parametrize("name", TABLE)


class Arguments(NamedTuple):
    """Everything that accelerations depend on."""

    q: jax.Array
    v: jax.Array
    tau: jax.Array
    gravity: jax.Array
    f_ext: jax.Array
    mass: jax.Array
    com: jax.Array
    inertia: jax.Array
    joints: jax.Array
    """Placements, screws and lock values."""
    passive: jax.Array
    """Damping, stiffness and rotor inertia."""
    ground: jax.Array
    """Pose of the ground."""


SHARED = (None,) * 5  # of the state; the other arguments belong to the structure


def assembled(chain, x: Arguments):
    """The chain with parameters, joints, passive forces and ground pose replaced."""
    base = chain.base_value.at[-7:].set(x.ground)
    chain = replace(chain, joint_value=x.joints, dof_value=x.passive, base_value=base)
    return sdyn.with_params(chain, sdyn.Params(x.mass, x.com, x.inertia))


def value(chain, w, x: Arguments):
    return w @ fd(assembled(chain, x), *x[:5])


def arguments(name) -> Arguments:
    """One row for each state."""
    chain, x = packed(name), state(name)
    p = sdyn.params(chain)
    own = p.mass, p.com, p.inertia, chain.joint_value, chain.dof_value, chain.base_value[-7:]
    return Arguments(*x[:5], *(jnp.broadcast_to(y, (STATES, *y.shape)) for y in own))


def directions(name, rng) -> list[Arguments]:
    """A direction for each argument, and none in the others."""
    mine, chain, x = robot(name), packed(name), arguments(name)
    present = np.isin(capacity().link_names, [link.name for link in mine.links])
    out = []
    for k, key in enumerate(Arguments._fields):
        shape = x[k].shape[1:]
        y = rng.normal(size=(STATES, *shape))
        if key in ("v", "tau"):
            y = y * real(mine)
        if key in ("mass", "com", "inertia", "f_ext"):
            y = y * present.reshape(-1, *(1,) * (len(shape) - 1))
        if key == "inertia":
            y = (y + y.swapaxes(-1, -2)) * np.trace(np.asarray(x.inertia), axis1=-2, axis2=-1)[..., None, None]
        if key == "mass":
            y = y * np.asarray(x.mass)
        if key == "com":
            y = y * 0.1
        if key == "joints":
            y = 0.1 * along_joints(np.asarray(x.joints), y)
        if key == "passive":
            y = y * 0.01  # the smallest inertia in the table is 1e-3
        out.append(Arguments(*(y if i == k else np.zeros_like(z) for i, z in enumerate(x))))
    assert chain.nv == real(mine).size
    return out


def along_joints(joints, y):
    """The directions, made such that rotations, axes and lock quaternions keep their lengths: in others the derivative
    of a rotation matrix means nothing, and that of the chain leaves them out."""
    out = y.copy()
    R = joints[..., :9].reshape(*joints.shape[:-1], 3, 3)
    out[..., :9] = np.cross(y[..., None, :3], R, axis=-1).reshape(out[..., :9].shape)
    for k in (12, 18, 24):
        out[..., k : k + 3] = np.cross(joints[..., k : k + 3], y[..., k : k + 3])
    quat = joints[..., 33:37]
    out[..., 33:37] = y[..., 33:37] - (quat * y[..., 33:37]).sum(-1, keepdims=True) * quat
    return out


@partial(jax.jit, **QUICKLY)
def forward(chain, w, x, along):
    """Value, and the slope along each direction."""

    def one(w, x, along):
        y, slope = jax.linearize(partial(value, chain, w), x)
        return y, jax.vmap(slope)(along)

    return jax.vmap(one)(w, x, along)


@partial(jax.jit, **QUICKLY)
def reverse(chain, w, x):
    return jax.vmap(lambda w, x: jax.grad(value, 2)(chain, w, x))(w, x)


VALUE = jax.jit(jax.vmap(value, (None, 0, 0)), **QUICKLY)


@cache
def gradient(name):
    return reverse(packed(name), weights(name), arguments(name))


@cache
def weights(name):
    return np.random.default_rng(7).normal(size=(STATES, packed(name).nv)) * real(robot(name))


def differences(f, x, along, h):
    """Central differences of order 4."""
    at = lambda t: np.asarray(f(jax.tree.map(lambda a, b: a + t * b, x, along)))
    return (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)


@over_table
def test_forward_mode_equals_differences(name, rng):
    chain, x, w, each = packed(name), arguments(name), weights(name), directions(name, rng)
    y, slopes = forward(chain, w, x, jax.tree.map(lambda *d: jnp.stack(d, 1), *each))
    scale = np.asarray(y)
    for k, along in enumerate(each):
        want = differences(lambda x: VALUE(chain, w, x), x, along, 1e-4)
        # each state for itself: the fast one must not hide the one at rest
        for i in range(STATES):
            close(slopes[i, k], want[i], 1e-7, scale=scale[i])


@over_table
def test_reverse_mode_equals_forward_mode(name, rng):
    """Each entry finite, and along each direction the same slope."""
    chain, x, w, each = packed(name), arguments(name), weights(name), directions(name, rng)
    found = gradient(name)
    for key, part in found._asdict().items():
        assert np.isfinite(part).all(), key
    _, slopes = forward(chain, w, x, jax.tree.map(lambda *d: jnp.stack(d, 1), *each))
    for k, (part, along) in enumerate(zip(found, each, strict=True)):
        terms = np.asarray(part) * along[k]
        for i in range(STATES):
            close(terms[i].sum(), slopes[i, k], 1e-11, scale=np.abs(terms[i]).sum())


@over_table
def test_empty_entries_have_no_slope(name):
    """What is not there does not matter: coordinates behind the robot's own, links and joints of other robots."""
    mine, found = robot(name), gradient(name)
    assert not np.asarray(found.v)[:, ~real(mine)].any()
    assert not np.asarray(found.tau)[:, ~real(mine)].any()
    assert not np.asarray(found.q)[:, 7 + mine.nq - (0 if mine.grounded else 7) :].any()
    absent = ~np.isin(capacity().link_names, [link.name for link in mine.links])
    for key in ("mass", "com", "inertia", "f_ext"):
        assert not np.asarray(getattr(found, key))[:, absent].any(), key
    absent = ~np.isin(capacity().joint_names, [joint.name for joint in mine.joints])
    assert not np.asarray(found.joints)[:, absent].any()


@pytest.mark.parametrize("name", ["one_body", "all_kinds_locked"])
def test_padded_gradient_equals_exact(name):
    """And none is lost to the exact layout's own special cases: no moving joint, no quaternion."""
    mine, chain, x = robot(name), sdyn.pack(robot(name)), states(robot(name), name)
    at = real(mine)

    @partial(jax.jit, **QUICKLY)
    def slopes(chain, w, q, v, tau, mass):
        def f(q, v, tau, mass):
            changed = sdyn.with_params(chain, replace(sdyn.params(chain), mass=mass))
            return w @ sdyn.forward_dynamics(changed, q, v, tau, gravity=x.gravity[0], f_ext=x.f_ext[0])

        return jax.grad(f, (0, 1, 2, 3))(q, v, tau, mass)

    got = slopes(chain, weights(name)[0][at], x.q[0], x.v[0], x.tau[0], sdyn.params(chain).mass)
    want = gradient(name)
    links = np.array(links_of(mine))
    for a, b in zip(got, (want.q[0][: mine.nq], want.v[0][at], want.tau[0][at], want.mass[0][links]), strict=True):
        close(a, b, 1e-12)


# -- nestings ----------------------------------------------------------------------------------------------------------


def energy_like(chain, x):
    """A scalar of q, v, tau in one vector."""
    nq, nv = chain.nq, chain.nv
    return (sdyn.forward_dynamics(chain, x[:nq], x[nq : nq + nv], x[nq + nv :]) ** 2).sum()


@cache
def second():
    return jax.jit(
        lambda chain, x: (jax.grad(energy_like, 1)(chain, x), jax.hessian(energy_like, 1)(chain, x)), **QUICKLY
    )


@pytest.mark.parametrize("row", [0, 2])
@pytest.mark.parametrize("name", ["one_body", "unbalanced_tree", "all_kinds_backwards", "locked_tip_base"])
def test_second_derivatives(name, row, rng):
    """Forward over reverse, as jax.hessian does: symmetric, finite, and the difference of gradients."""
    chain, x = packed(name), state(name)
    x = jnp.concatenate([x.q[row], x.v[row], x.tau[row]])
    slope, H = second()(chain, x)
    assert np.isfinite(H).all()
    close(H, H.T, 1e-11)
    along = rng.normal(size=x.shape)
    want = differences(lambda x: second()(chain, x)[0], x, along, 1e-4)
    close(H @ along, want, 1e-7, scale=slope)


def test_gradient_of_a_batch_and_batch_of_gradients(rng):
    """grad of vmap of vmap = vmap of vmap of grad, where the batches share operands; and over a family."""
    names = ["unbalanced_tree", "grounded", "all_locked"]
    chains = jax.tree.map(lambda *x: jnp.stack(x), *map(packed, names))
    q, v, tau = (jnp.stack([getattr(state(name), key)[:2] for name in names]) for key in ("q", "v", "tau"))
    w = rng.normal(size=(*v.shape[:2], v.shape[-1]))
    f = lambda chain, q, v, tau, w: w @ sdyn.forward_dynamics(chain, q, v, tau)

    def total(q, v, tau):
        inner = jax.vmap(f, (None, None, 0, 0, 0))  # the states share the first q
        return jax.vmap(inner)(chains, q[:, 0], v, tau, w).sum()

    @partial(jax.jit, **QUICKLY)
    def both(q, v, tau):
        each = jax.vmap(jax.vmap(jax.grad(f, (1, 2, 3)), (None, None, 0, 0, 0)))(chains, q[:, 0], v, tau, w)
        return jax.grad(total, (0, 1, 2))(q, v, tau), each

    (of_q, of_v, of_tau), each = both(q, v, tau)
    close(of_q[:, 0], each[0].sum(1), 1e-12)
    assert not np.asarray(of_q)[:, 1].any()
    close(of_v, each[1], 1e-12)
    close(of_tau, each[2], 1e-12)


def test_gradient_through_scan_and_checkpoint(rng):
    """Of a rollout with respect to the initial state, the forces and the masses, against differences."""
    name = "all_kinds_backwards"
    chain, mine = packed(name), robot(name)
    w = rng.normal(size=chain.nq) * (np.arange(chain.nq) < mine.nq)
    taus = rng.normal(size=(3, chain.nv)) * real(mine)

    @jax.checkpoint
    def end(x):
        changed = sdyn.with_params(chain, replace(sdyn.params(chain), mass=x[3]))
        return w @ sdyn.rollout(changed, x[0], x[1], x[2], 0.05, method="semi_implicit")[0][-1]

    x = (state(name).q[0], state(name).v[0], taus, sdyn.params(chain).mass)
    along = [rng.normal(size=y.shape) for y in x]
    along[1], along[2] = along[1] * real(mine), along[2] * real(mine)
    along[3] = along[3] * np.asarray(x[3])
    run = jax.jit(jax.value_and_grad(end), **QUICKLY)
    g = run(x)[1]
    for k in range(4):
        only = tuple(d if i == k else np.zeros_like(d) for i, d in enumerate(along))
        want = differences(lambda x: run(x)[0], x, only, 1e-4)
        close((np.asarray(g[k]) * along[k]).sum(), want, 1e-7, scale=1.0)
