"""Integration: conservation over free rollouts, orders, mechanisms in quadruple precision, steps of odd size."""

from functools import partial

import jax
import jax.numpy as jnp
import mechanisms
import numpy as np
import oracles
import pytest
from structures import QUICKLY, close, packed, real, robot, state, states

import sdyn

METHODS = {"semi_implicit": 1, "rk4": 4, "variational": 2, "implicit": 4}

FREE = ["one_body", "unbalanced_tree", "locked_tip_base", "screws", "all_kinds", "all_kinds_backwards", "paper37"]
EQUATIONS = ["variational", "implicit"]  # the methods that solve some in each step, and take long to compile


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


@pytest.mark.parametrize("method", [method for method in METHODS if method != "semi_implicit"])
@pytest.mark.parametrize(("name", "size"), [("top_generic", 0.02), ("top_fast_spin", 2.5e-4)])
def test_order_on_a_free_top(name, size, method):
    """Within 0.2 of nominal in attitude and rates, on a slow and on a fast top; momentum in space follows."""
    data = oracles.raw(name)
    inertia = {"top_generic": (1.0, 2.0, 3.0), "top_fast_spin": (2.0, 2.5, 4.0)}[name]
    chain = sdyn.pack(sdyn.Robot([sdyn.Link("top", 1.0, inertia=np.diag(inertia))]))
    sample = 8 if name == "top_generic" else 1  # a time at which the reference is tabulated
    t = data["t"][sample]
    q0, v0 = np.r_[np.zeros(3), 1.0, np.zeros(3)], np.r_[data["wx"][0], data["wy"][0], data["wz"][0], np.zeros(3)]
    want_q = np.array([data[k][sample] for k in ("qw", "qx", "qy", "qz")])
    want_w = np.array([data[k][sample] for k in ("wx", "wy", "wz")])

    def error(n):
        q, v = RUN(chain, q0, v0, t / n, n, method)
        quat = np.asarray(q)[3:7]
        return np.abs(quat * np.sign(quat @ want_q) - want_q).max(), np.abs(np.asarray(v)[:3] - want_w).max()

    n = round(t / size)
    coarse, fine = error(n), error(2 * n)
    for a, b in zip(coarse, fine, strict=True):
        assert abs(np.log2(a / b) - METHODS[method]) < 0.2, (coarse, fine)


@pytest.mark.parametrize("method", [pytest.param(m, marks=[pytest.mark.slow] * (m in EQUATIONS)) for m in METHODS])
def test_order_on_a_tree(method):
    """Within 0.2 of nominal, with spherical joints traversed backwards, against a fine solution."""
    tree = robot("all_kinds_backwards")
    chain, x = sdyn.pack(tree), states(tree, "all_kinds_backwards")
    start = x.q[0], 0.3 * x.v[0]
    exact = RUN(chain, *start, 0.1 / 400, 400, "rk4")
    n = 10 if METHODS[method] == 4 else 40
    errors = []
    for steps in (n, 2 * n):
        end = RUN(chain, *start, 0.1 / steps, steps, method)
        errors.append(max(np.abs(np.asarray(a - b)).max() for a, b in zip(end, exact, strict=True)))
    assert abs(np.log2(errors[0] / errors[1]) - METHODS[method]) < 0.2, errors  # 1.00, 4.00, 2.00, 4.00


@pytest.mark.slow  # to compile
@pytest.mark.parametrize("method", EQUATIONS)
def test_order_on_a_closed_chain(method):
    """Within 0.2 of nominal, on the four-bar in 30 digits, which stays closed."""
    chain, data = sdyn.pack(mechanisms.four_bar("point")), oracles.raw("fourbar_rbdjl")
    keys, gravity, k = ("theta", "gamma", "phi"), np.array([0.0, -9.81, 0.0]), int(np.argmin(np.abs(data["t"] - 0.5)))
    errors, n, start = [], {2: 100, 4: 50}[METHODS[method]], (np.array([data[x][0] for x in keys]), np.zeros(3))
    for steps in (n, 2 * n):
        q, v = RUN(chain, *start, data["t"][k] / steps, steps, method, gravity)
        errors.append(max(np.abs(q - np.array([data[x][k] for x in keys]))))
        assert np.abs(sdyn.loop_residual(chain, q)).max() < 1e-14  # 2e-16
        assert np.abs(sdyn.loop_jacobian(chain, q) @ v).max() < 1e-13  # 1e-15
    assert abs(np.log2(errors[0] / errors[1]) - METHODS[method]) < 0.2, errors


def test_the_variational_method_keeps_momentum_and_energy():
    """Over steps that are long for the motion: momentum to rounding, the path of the centre of mass, and energy that
    comes back."""
    tree = robot("unbalanced_tree")
    chain, x = sdyn.pack(tree), states(tree, "unbalanced_tree")
    roll = jax.jit(lambda q, v: sdyn.rollout(chain, q, v, jnp.zeros((1000, 14)), 0.02, method="variational"), **QUICKLY)
    qs, vs = roll(x.q[0], 0.3 * x.v[0])
    every = lambda f, *x: np.asarray(jax.jit(jax.vmap(partial(f, chain)), **QUICKLY)(*x))
    h, T, c = every(sdyn.momentum, qs, vs), every(sdyn.kinetic_energy, qs, vs), every(sdyn.centre_of_mass, qs)
    close(h, np.broadcast_to(h[0], h.shape), 1e-13)  # 7e-15
    close(c, c[0] + 0.02 * np.arange(1001)[:, None] * h[0, 3:] / sdyn.params(chain).mass.sum(), 1e-13)
    early, late = (np.abs(T[part] / T[0] - 1).max() for part in (slice(500), slice(500, None)))
    assert late < 2 * early < 1e-2, (early, late)
    assert np.abs(np.asarray(qs[-1] - qs[0])).max() > 1


@pytest.mark.slow
def test_the_variational_method_over_long_times():
    """1e5 steps of 37 degrees of freedom, 1000 s: momentum to 1e-12, energy bounded and without a trend."""
    tree = sdyn.models.load("paper37")
    chain, rng = sdyn.pack(tree), np.random.default_rng(0)
    q, v = np.r_[tree.neutral()[:7], rng.normal(size=31)], 0.2 * rng.normal(size=37)
    advance = lambda _, x: sdyn.integrate(chain, *x, np.zeros(37), 0.01, method="variational")

    @jax.jit
    def run(q, v):
        def block(x, _):
            x = jax.lax.fori_loop(0, 200, advance, x)
            return x, (sdyn.momentum(chain, *x), sdyn.kinetic_energy(chain, *x))

        return jax.lax.scan(block, (q, v), None, 500)[1]

    h0, T0 = sdyn.momentum(chain, q, v), sdyn.kinetic_energy(chain, q, v)
    h, T = map(np.asarray, run(q, v))
    close(h[:, :3], np.broadcast_to(h0[:3], (500, 3)), 1e-12)
    close(h[:, 3:], np.broadcast_to(h0[3:], (500, 3)), 1e-12)
    error = T / T0 - 1
    assert np.abs(error).max() < 5e-6
    assert np.abs(error[400:]).max() < 2 * np.abs(error[:100]).max()
    assert abs(error[250:].mean() - error[:250].mean()) < 0.1 * np.abs(error).max()


@pytest.mark.slow
@pytest.mark.parametrize("method", EQUATIONS)
def test_gradient_of_a_step(method, rng):
    """Of both that solve equations in a step, against differences: in the state, the force and the size of the step."""
    tree = robot("screws")
    chain, x = sdyn.pack(tree), states(tree, "screws")
    w = rng.normal(size=tree.nq), rng.normal(size=tree.nv)

    def value(xi, v, tau, dt):
        q = x.q[0] + jnp.zeros_like(x.q[0]).at[7:].set(xi)
        q, v = sdyn.integrate(chain, q, v, tau, dt, method=method, gravity=x.gravity[0])
        return w[0] @ q + w[1] @ v

    at = jnp.zeros(4), 0.3 * x.v[0], x.tau[0], 0.1
    along = tuple(rng.normal(size=np.shape(y)) for y in at)
    slopes = jax.jit(jax.grad(value, (0, 1, 2, 3)), **QUICKLY)(*at)
    forward = jax.jit(lambda: jax.jvp(value, at, along)[1], **QUICKLY)()
    compiled = jax.jit(value, **QUICKLY)
    ends = [compiled(*(y + s * 1e-5 * d for y, d in zip(at, along, strict=True))) for s in (1, -1)]
    want = (ends[0] - ends[1]) / 2e-5
    close(sum((g * d).sum() for g, d in zip(slopes, along, strict=True)), want, 1e-8)
    close(forward, want, 1e-8)


def test_a_stiff_governor():
    """The implicit method needs 0.005 s for 1e-6 where the explicit one is unstable at 0.0005 s."""
    (tree, force), data = mechanisms.flyball(), oracles.raw("flyball_governor")
    chain, gravity = sdyn.pack(tree), np.array([0.0, 0.0, -9.81])
    start, steps = (np.array([0.0, 0.5, np.pi / 3, np.pi / 3]), np.array([2 * np.pi, 0, 0, 0])), 200

    @partial(jax.jit, static_argnums=(1, 2), **QUICKLY)
    def roll(dt, steps, method):
        return sdyn.rollout(chain, *start, force, dt, steps=steps, method=method, gravity=gravity)[0][-1, 1]

    slide = roll(1.0 / steps, steps, "implicit")
    assert abs(slide - data["s"][100]) < 1e-6
    explicit = roll(1.0 / (10 * steps), 10 * steps, "rk4")
    assert not abs(explicit - data["s"][100]) < 1e-6


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
    with pytest.raises(ValueError, match="method is 'euler'"):
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
