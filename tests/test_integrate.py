"""Integration: conservation over free rollouts, order, tops in quadruple precision, steps of odd size."""

from functools import partial

import jax
import numpy as np
import oracles
import pytest
from structures import QUICKLY, close, packed, real, robot, state

import sdyn

FREE = ["one_body", "unbalanced_tree", "locked_tip_base", "screws", "all_kinds", "all_kinds_backwards", "paper37"]
METHODS = {"rk4": 4, "semi_implicit": 1}


def advance(chain, q, v, dt, steps, method, gravity=None):
    """Many steps without forces; the number of steps is traced, so that one program serves all."""
    tau = 0 * v
    step = lambda _, x: sdyn.integrate(chain, *x, tau, dt, method=method, gravity=gravity)
    return jax.lax.fori_loop(0, steps, step, (q, v))


RUN = jax.jit(advance, static_argnums=5, **QUICKLY)
ROLL = jax.jit(
    lambda chain, q, v, taus, dt: (
        (out := sdyn.rollout(chain, q, v, taus, dt)),
        jax.vmap(partial(sdyn.momentum, chain))(*out),
        jax.vmap(partial(sdyn.kinetic_energy, chain))(*out),
    ),
    **QUICKLY,
)


@pytest.mark.parametrize("name", FREE)
def test_free_rollout(name):
    """Momentum and energy are kept; a free rollout of passive joints would lose energy, so none is in the list."""
    chain, x = packed(name), state(name)
    (qs, vs), h, T = ROLL(chain, x.q[0], 0.3 * x.v[0], np.zeros((50, chain.nv)), 2e-3)
    assert qs.shape == (51, chain.nq) and vs.shape == (51, chain.nv)
    assert np.array_equal(qs[0], x.q[0]) and np.array_equal(vs[0], 0.3 * x.v[0])
    close(h, np.broadcast_to(h[0], h.shape), 3e-12)  # 2.8e-13
    close(T, np.broadcast_to(T[0], T.shape), 3e-12)  # 2.7e-13
    close((np.asarray(qs)[:, 3:7] ** 2).sum(1), np.ones(51), 4e-15)  # 3.3e-16
    assert np.abs(np.asarray(qs[-1] - qs[0])).max() > 1e-3  # it moved


@pytest.mark.parametrize(("name", "step", "count"), [("top_generic", 0.02, 100), ("top_fast_spin", 2.5e-4, 400)])
def test_order_on_a_free_top(name, step, count):
    """RK4 is of order 4 in attitude and rates, on a slow and on a fast top; momentum in space follows."""
    data = oracles.raw(name)
    inertia = {"top_generic": (1.0, 2.0, 3.0), "top_fast_spin": (2.0, 2.5, 4.0)}[name]
    chain = sdyn.pack(sdyn.Robot([sdyn.Link("top", 1.0, inertia=np.diag(inertia))]))
    sample = 8 if name == "top_generic" else 1  # a time at which the reference is tabulated
    t = data["t"][sample]
    q0, v0 = np.r_[np.zeros(3), 1.0, np.zeros(3)], np.r_[data["wx"][0], data["wy"][0], data["wz"][0], np.zeros(3)]
    want_q = np.array([data[k][sample] for k in ("qw", "qx", "qy", "qz")])
    want_w = np.array([data[k][sample] for k in ("wx", "wy", "wz")])

    def error(n, method):
        q, v = RUN(chain, q0, v0, t / n, n, method)
        quat = np.asarray(q)[3:7]
        return np.abs(quat * np.sign(quat @ want_q) - want_q).max(), np.abs(np.asarray(v)[:3] - want_w).max()

    n = round(t / step)
    coarse, fine = error(n, "rk4"), error(2 * n, "rk4")
    for a, b in zip(coarse, fine, strict=True):
        assert 3.8 < np.log2(a / b) < 4.3, (coarse, fine)


@pytest.mark.parametrize("method", METHODS)
def test_order_on_a_tree(method):
    """With spherical joints traversed backwards, against a fine solution."""
    name = "all_kinds_backwards"
    chain, x = packed(name), state(name)
    start = x.q[0], 0.3 * x.v[0]
    exact = RUN(chain, *start, 0.1 / 400, 400, "rk4")
    n = 10 if method == "rk4" else 40
    errors = []
    for steps in (n, 2 * n):
        end = RUN(chain, *start, 0.1 / steps, steps, method)
        errors.append(max(np.abs(np.asarray(a - b)).max() for a, b in zip(end, exact, strict=True)))
    assert abs(np.log2(errors[0] / errors[1]) - METHODS[method]) < 0.25, errors


def test_steps_of_odd_size():
    """No step changes nothing; back and forth returns; a tiny step is finite."""
    name = "all_kinds_backwards"
    chain, x = packed(name), state(name)
    q, v = RUN(chain, x.q[0], x.v[0], 0.0, 3, "rk4")
    close(q, x.q[0], 2e-15)  # 0
    close(v, x.v[0], 2e-15)  # 0
    there = RUN(chain, x.q[0], 0.3 * x.v[0], 1e-3, 20, "rk4")
    assert np.abs(np.asarray(there[0] - x.q[0])).max() > 1e-3
    q, v = RUN(chain, *there, -1e-3, 20, "rk4")
    close(q, x.q[0], 3e-15)  # 2.1e-16
    close(v, 0.3 * x.v[0], 2e-15)  # 1.4e-16
    q, v = RUN(chain, x.q[0], x.v[0], 1e-300, 1, "rk4")
    assert np.isfinite(q).all() and np.isfinite(v).all()


def test_forces_as_a_function():
    """taus may be a function (t, q, v), evaluated at every stage: constant, it is the same as an array."""
    chain, x = packed("unbalanced_tree"), state("unbalanced_tree")
    tau = x.tau[0]
    function = jax.jit(
        lambda q, v: sdyn.rollout(chain, q, v, lambda t, q, v: tau, 0.01, steps=3, method="semi_implicit"), **QUICKLY
    )
    array = jax.jit(
        lambda q, v: sdyn.rollout(chain, q, v, np.tile(tau, (3, 1)), 0.01, method="semi_implicit"), **QUICKLY
    )
    for a, b in zip(function(x.q[0], x.v[0]), array(x.q[0], x.v[0]), strict=True):
        close(a, b, 2e-15)  # 0
    with pytest.raises(ValueError, match="say how many steps"):
        sdyn.rollout(chain, x.q[0], x.v[0], lambda t, q, v: tau, 0.01)
    with pytest.raises(ValueError, match="leave steps out"):
        sdyn.rollout(chain, x.q[0], x.v[0], np.tile(tau, (3, 1)), 0.01, steps=4)
    with pytest.raises(ValueError, match="there is no method 'euler'"):
        sdyn.integrate(chain, x.q[0], x.v[0], tau, 0.01, method="euler")


def test_a_grounded_base_stays():
    """And what hangs from it keeps its energy."""
    name = "grounded"
    chain, x = packed(name), state(name)
    q, v = RUN(chain, x.q[0], x.v[0], 2e-3, 50, "rk4")
    assert np.array_equal(q[:7], x.q[0][:7]) and not np.asarray(v)[:6].any()
    assert not np.asarray(v)[~real(robot(name))].any()
    close(sdyn.kinetic_energy(chain, q, v), sdyn.kinetic_energy(chain, x.q[0], x.v[0]), 2e-15)  # 1.4e-16
    assert np.abs(np.asarray(q - x.q[0])).max() > 1e-2
