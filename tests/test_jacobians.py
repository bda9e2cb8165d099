"""All columns of the derivatives of forward dynamics at once equal those of reverse mode, over the table."""

import re
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from structures import QUICKLY, ROBOTS, close, padded, robot, states, tree

import sdyn

# the table's structures without spherical joints, in a capacity of their own
PLAIN = [name for name in ROBOTS if not name.startswith("all_kinds") and name != "paper37"]


@cache
def capacity():
    return sdyn.capacity([*map(robot, PLAIN), tree((0,) * 9)])


@cache
def packed(name):
    chain = sdyn.pack(robot(name), capacity())
    return chain, padded(robot(name), chain, states(robot(name), name))


@jax.jit
def increments(q, xi):
    """q moved by xi: a turn in the base's axes, a displacement in the world's, joint coordinates."""
    t2 = xi[:3] @ xi[:3]
    c, s = 1 - t2 / 8, 0.5 - t2 / 48
    w, u, d = q[3], q[4:7], s * xi[:3]
    quat = jnp.concatenate([(w * c - u @ d)[None], w * d + c * u + jnp.cross(u, d)])
    return jnp.concatenate([q[:3] + xi[3:6], quat, q[7:] + xi[6:]])


def _rows(chain, q, v, tau, gravity):
    f = lambda xi, v, tau: sdyn.forward_dynamics(chain, increments(q, xi), v, tau, gravity=gravity)
    return f(jnp.zeros_like(v), v, tau), *jax.jacrev(f, (0, 1, 2))(jnp.zeros_like(v), v, tau)


COLUMNS = jax.jit(
    jax.vmap(lambda chain, *x: sdyn.forward_dynamics_jacobians(chain, *x[:3], gravity=x[3]), (None, 0, 0, 0, 0)),
    **QUICKLY,
)
ROWS = jax.jit(jax.vmap(_rows, (None, 0, 0, 0, 0)), **QUICKLY)


@pytest.mark.parametrize("name", PLAIN)
def test_columns_equal_rows(name):
    chain, x = packed(name)
    live = np.asarray(sdyn.pad(chain, robot(name).neutral(), np.ones(robot(name).nv))[1]) == 1
    found, want = COLUMNS(chain, x.q, x.v, x.tau, x.gravity), ROWS(chain, x.q, x.v, x.tau, x.gravity)
    for a, b in zip(found, want, strict=True):
        a, b = (np.asarray(y)[:, live] for y in (a, b))
        if a.ndim == 3:
            a, b = a[..., live], b[..., live]
        for k in range(len(a)):  # each state for itself
            close(a[k], b[k], 1e-10)


def test_exact_layout_and_one_sample():
    """The 37-DOF robot as it is, one sample, without gravity; M^-1 is that of the mass matrix."""
    full = sdyn.models.load("paper37")
    chain, x = sdyn.pack(full), states(full, "paper37")
    vdot, of_q, _, Minv = jax.jit(sdyn.forward_dynamics_jacobians, **QUICKLY)(chain, x.q[0], x.v[0], x.tau[0])
    close(vdot, jax.jit(sdyn.forward_dynamics, **QUICKLY)(chain, x.q[0], x.v[0], x.tau[0]), 1e-13)
    close(Minv @ jax.jit(sdyn.mass_matrix, **QUICKLY)(chain, x.q[0]), np.eye(full.nv), 1e-11)
    assert not np.asarray(of_q[:, :6]).any()  # without gravity nothing depends on the pose of the base


def test_what_is_refused():
    ball = tree((0, 1), "spherical")
    chain = sdyn.pack(ball)
    with pytest.raises(ValueError, match=re.escape("jax.jacfwd(sdyn.forward_dynamics")):
        sdyn.forward_dynamics_jacobians(chain, ball.neutral(), np.zeros(ball.nv), np.zeros(ball.nv))
