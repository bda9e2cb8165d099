"""Laws of closures: each kind against the joint of that kind, both solvers, redundancy, derivatives, compilations."""

import json
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from mechanisms import bricard, four_bar, row_of_four_bars
from structures import QUICKLY, UNBALANCED, body, close, rotation, tree, unit
from test_gradients import along_joints, differences

import sdyn
from sdyn.dynamics import tree_dynamics
from sdyn.posture import link_poses

GRAVITY = np.array([0.4, -0.7, -9.81])
KINDS = ("weld", "revolute", "prismatic", "universal", "spherical", "cylindrical", "planar")


# -- each kind of closure is the joint of that kind --------------------------------------------------------------------


def tree_and_loop(kind, rng):
    """Two arms on a free base, the second one joined to the first by a joint; and by three slides, a ball and a
    closure."""
    links = [body(rng, name) for name in ("base", "one", "two", "tool")]
    place = lambda: (rotation(rng), rng.uniform(-0.4, 0.4, 3))
    arm = [sdyn.Joint(f"arm{k}", "revolute", *ends, *place(), unit(rng)) for k, ends in enumerate(
        (("base", "one"), ("one", "two")))]  # fmt: skip
    at = place()
    frames = [sdyn.Frame("grip", "tool", position=rng.uniform(-0.2, 0.2, 3)), sdyn.Frame("hand", "two", *at)]
    joined = sdyn.Robot(
        links, [*arm, sdyn.Joint("tie", "fixed" if kind == "weld" else kind, "two", "tool", *at)], frames
    )
    carts = [sdyn.Link(f"cart{k}", 0.0) for k in range(3)]
    chain = ["base", "cart0", "cart1", "cart2", "tool"]
    rails = [sdyn.Joint(f"rail{k}", "prismatic", *chain[k : k + 2], axis=np.eye(3)[k]) for k in range(3)]
    ball = sdyn.Joint("ball", "spherical", "cart2", "tool")
    loose = sdyn.Robot([*links, *carts], [*arm, *rails, ball], frames)
    return joined, loose.close("hand", sdyn.Frame("tool", "tool"), kind, name="tie")


def quaternion(R):
    w = np.sqrt(max(1 + np.trace(R), 1e-300)) / 2
    return np.r_[w, np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w)]


@partial(jax.jit, **QUICKLY)
def motion(chain, q, v, tau):
    """Accelerations of two frames by both solvers, the free ones, and what belongs to the closure."""
    J = jnp.concatenate([sdyn.frame_jacobian(chain, q, name) for name in ("grip", "hand")])
    found = [sdyn.constrained_dynamics(chain, q, v, tau, gravity=GRAVITY, method=m) for m in ("proximal", "partition")]
    frames = lambda vdot: jnp.concatenate([sdyn.frame_acceleration(chain, q, v, vdot, x) for x in ("grip", "hand")])
    return J, [frames(x[0]) for x in found], found, sdyn.loop_residual(chain, q)


@partial(jax.jit, **QUICKLY)
def free_motion(chain, q, v, tau):
    vdot = sdyn.forward_dynamics(chain, q, v, tau, gravity=GRAVITY)
    J = jnp.concatenate([sdyn.frame_jacobian(chain, q, name) for name in ("grip", "hand")])
    return J, jnp.concatenate([sdyn.frame_acceleration(chain, q, v, vdot, name) for name in ("grip", "hand")])


@pytest.mark.parametrize("kind", KINDS)
def test_closure_is_the_joint_of_its_kind(kind, rng):
    """Accelerations of a tree with a joint, and of a tree of more coordinates with a closure in its place."""
    joined, closed = tree_and_loop(kind, rng)
    everything = [tree_and_loop(k, np.random.default_rng(0))[1] for k in KINDS]
    both = sdyn.capacity([joined, *(tree_and_loop(k, np.random.default_rng(0))[0] for k in KINDS)])
    one, two = sdyn.pack(joined, both), sdyn.pack(closed, sdyn.capacity([closed, *everything]))
    q = 0.7 * rng.normal(size=joined.nq)
    q[3:7] = unit(rng, 4)
    if kind == "spherical":
        q[-4:] = unit(rng, 4)
    v, tau = rng.normal(size=joined.nv), rng.normal(size=8)
    R, p = link_poses(joined, q)
    R, p = R[0].T @ R[3], R[0].T @ (p[3] - p[0])
    q2 = np.r_[q[:9], p, quaternion(R)]
    (qa, va), (qb, _) = sdyn.pad(one, q, v), sdyn.pad(two, q2, np.zeros(14))
    ta, tb = sdyn.pad(one, q, np.r_[tau, np.zeros(joined.nv - 8)])[1], sdyn.pad(two, q2, np.r_[tau, np.zeros(6)])[1]
    J, want = free_motion(one, qa, va, ta)
    Jb = np.asarray(motion(two, qb, jnp.zeros(two.nv), tb)[0])
    vb = np.zeros(two.nv)
    vb[:14] = np.linalg.lstsq(np.r_[Jb, np.eye(8, two.nv)][:, :14], np.r_[J @ va, v[:8]])[0]
    _, accelerations, found, residual = motion(two, qb, vb, tb)
    close(residual, 0 * residual, 1e-14, scale=1.0)
    for got, (_, _, status) in zip(accelerations, found, strict=True):
        close(got, want, 1e-12)
        assert status.rank == two.row_index[2].sum() and not status.redundant
        assert float(status.error) < 1e-11 and not status.singular
    close(found[0][1], found[1][1], 1e-12, scale=1.0)  # the multipliers of the two solvers


# -- redundancy and derivatives ----------------------------------------------------------------------------------------


def doubled():
    """A four-bar in space with a revolute closure, and with that stated twice: ten rows, two of them independent."""
    once = four_bar()
    loop = once.loops[0]
    return once, once.close(loop.frame_a, loop.frame_b, loop.kind, name="again")


def state():
    data = json.loads((oracles.DATA / "fourbar_states.json").read_text())["states"][4]
    return [np.array([float(x) for x in data[key]]) for key in ("q", "qd", "tau")]


def both(chain, method, q, v, tau, mass):
    chain = sdyn.with_params(chain, replace(sdyn.params(chain), mass=mass))
    vdot, lam, status = sdyn.constrained_dynamics(chain, q, v, tau, gravity=GRAVITY, method=method)
    return jnp.concatenate([vdot, lam]), status


@partial(jax.jit, static_argnums=(1, 5), **QUICKLY)
def derivatives(chain, method, w, x, along, order):
    """Slope and gradient; for order 2 the slope of the gradient too."""
    f = lambda *x: both(chain, method, *x)[0]
    gradient = jax.grad(lambda *x: w @ f(*x), (0, 1, 2, 3))
    g, turned = jax.jvp(gradient, x, along) if order == 2 else (gradient(*x), None)
    return jax.jvp(f, x, along)[1], g, turned


BOTH = jax.jit(both, static_argnums=1, **QUICKLY)
SECOND = [pytest.param(2, method, marks=pytest.mark.slow) for method in ("proximal", "partition")]


@pytest.mark.parametrize(("order", "method"), [(1, "proximal"), *SECOND])
def test_closure_stated_twice(order, method, rng):
    """The same accelerations and half the multiplier each; so are their first and second derivatives."""
    size, at = sdyn.capacity(doubled()), np.arange(19) >= 6  # of v and lam, behind a base that is grounded
    along, out = [np.r_[np.zeros(6 + (k == 0)), rng.normal(size=3)] for k in range(3)], []
    w = at * np.r_[rng.normal(size=9), 0.3, -0.2, 0.0, 0.7, -0.9, np.zeros(5)]
    for chain in (sdyn.pack(mine, size) for mine in doubled()):
        q, v, tau = state()
        mass = np.asarray(chain.link_mass)
        x = (*sdyn.pad(chain, q, v), np.r_[np.zeros(6), tau], mass)
        y, status = BOTH(chain, method, *x)
        slopes = derivatives(chain, method, w, x, (*along, 0.3 * mass), order)
        assert status.rank == 2 and status.redundant
        out.append((y[6:], slopes[0][6:]))
        value = lambda x, chain=chain: BOTH(chain, method, *x)[0]
        close(slopes[0], differences(value, x, (*along, 0.3 * mass), 1e-4), 1e-9)
        close(sum((a * b).sum() for a, b in zip(slopes[1], (*along, 0.3 * mass), strict=True)), w @ slopes[0], 1e-12)
        if order == 2:
            gradient = lambda x, a=(chain, method, w), b=along, m=mass: np.concatenate(
                derivatives(*a, x, (*b, 0.3 * m), 1)[1]
            )
            close(np.concatenate(slopes[2]), differences(gradient, x, (*along, 0.3 * mass), 1e-4), 1e-8)
    for once, twice in zip(*out, strict=True):
        close(twice[:3], once[:3], 1e-13)
        close(twice[3:8], once[3:8] / 2, 1e-13)
        close(twice[8:], once[3:8] / 2, 1e-13)


def turning(method, t):
    """Accelerations and multipliers of the Bricard mechanism along its motion, of which q and v are closed."""
    data, chain, still = np.load(oracles.DATA / "bricard_square.npz"), sdyn.pack(bricard()), np.zeros(5)
    a, b = (data[k][np.array([100, 101])] for k in "ab")
    start, then = np.stack([a, b, -a, -b, -a], 1)
    rate = then - start
    q, v = sdyn.project(chain, start + t * rate, rate)
    return jnp.concatenate(sdyn.constrained_dynamics(chain, q, v, still, gravity=GRAVITY, method=method)[:2])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["proximal", "partition"])
def test_derivatives_where_the_redundancy_turns(method, rng):
    """Of accelerations and multipliers along a motion of a redundant chain, against differences of their values."""
    f, w = partial(turning, method), rng.normal(size=10)
    along = lambda f: lambda t: jax.jvp(f, (t,), (1.0,))[1]
    value, slope = jax.jit(f, **QUICKLY), jax.jit(along(f), **QUICKLY)(0.0)
    close(slope, differences(lambda t: value(t[0]), (0.0,), (1.0,), 1e-3), 1e-8)
    h, weights = 0.3, np.array([2, -27, 270, -490, 270, -27, 2]) / 180
    want = sum(c * np.asarray(value(k * h)) for k, c in zip(range(-3, 4), weights, strict=True)) / h**2
    close(jax.jit(along(along(f)), **QUICKLY)(0.0), want, 1e-6)
    back = jax.jit(along(jax.grad(lambda t: w @ f(t))), **QUICKLY)(0.0)
    close(back, w @ want, 1e-6, scale=want)


def hinged(rng):
    """A free base with a moving spherical joint and a locked one, held by a universal closure and by the ground."""
    loose = tree_and_loop("universal", rng)[1].open("tie")
    q = np.r_[0.5 * rng.normal(size=3), unit(rng, 4), rng.uniform(-0.5, 0.5, 5), unit(rng, 4)]
    mine = loose.close("hand", sdyn.Frame("tool", "tool"), "universal", q=q, name="tie")
    mine = mine.close("grip", "ground", "point", q=q, name="foot").lock({"arm0": q[7]})
    return sdyn.pack(mine), np.delete(q, 7)


def test_gradient_of_a_closed_chain(rng):
    """With respect to state, forces, gravity, wrenches, masses, joints and closures, against differences; each has a
    direction of its own."""
    chain, q = hinged(rng)
    w, nv = rng.normal(size=chain.nv + chain.capacity.rows), chain.nv
    own = chain.link_mass, chain.joint_value, chain.loop_value
    x = (q, rng.normal(size=nv), rng.normal(size=nv), GRAVITY, rng.normal(size=(chain.capacity.links, 6)), *own)
    along = [rng.normal(size=np.shape(y)) for y in x]
    along[6] = 0.1 * along_joints(np.asarray(x[6]), along[6])

    def value(q, v, tau, gravity, f_ext, mass, joints, loops):
        new = sdyn.with_params(
            replace(chain, joint_value=joints, loop_value=loops), replace(sdyn.params(chain), mass=mass)
        )
        out = sdyn.constrained_dynamics(new, q, v, tau, gravity=gravity, f_ext=f_ext)
        return w @ jnp.concatenate(out[:2])

    run = jax.jit(value, **QUICKLY)
    g = jax.jit(jax.grad(value, range(8)), **QUICKLY)(*x)
    found = [(np.asarray(a) * b).sum() for a, b in zip(g, along, strict=True)]
    for k in range(8):
        only = tuple(y if i == k else 0 * y for i, y in enumerate(along))
        close(found[k], differences(lambda y: run(*y), x, only, 1e-4), 1e-8, scale=found)


@partial(jax.jit, **QUICKLY)
def torques(chain, q, v, tau, actuated):
    """Of the motion that tau causes: with K, the motion that they cause, and inverse dynamics of the tree."""
    vdot = sdyn.forward_dynamics(chain, q, v, tau, gravity=GRAVITY)
    new, lam = sdyn.constrained_inverse_dynamics(chain, q, v, vdot, actuated=actuated, gravity=GRAVITY)
    again = sdyn.forward_dynamics(chain, q, v, new, gravity=GRAVITY)
    force = sdyn.inverse_dynamics(chain, q, v, vdot, gravity=GRAVITY)
    return new, lam, again, vdot, sdyn.loop_jacobian(chain, q), force


def test_torques_of_a_closed_chain(rng):
    """Their motion is the wanted one; those of one motor are the only ones; those of three are the smallest."""
    (q, v, _), chain = state(), sdyn.pack(doubled()[1])
    for actuated in ([1, 1, 1], [1, 0, 0], [0, 1, 1]):
        at = np.array(actuated, float)
        tau, lam, again, vdot, K, force = map(np.asarray, torques(chain, q, v, rng.normal(size=3), at))
        close(tau * (1 - at), 0 * tau, 1e-12, scale=tau)
        close(again, vdot, 1e-12)
        close(tau + K.T @ lam, force, 1e-12)
        # what the closures can do without the other joints cannot make the sum of squares smaller
        U, s, _ = np.linalg.svd(np.where(at == 0, K, 0))
        free = K.T @ U[:, (s > 1e-12 * np.linalg.norm(K)).sum() :]
        close(free.T @ tau, 0 * (free.T @ tau), 1e-11, scale=1.0)


# -- data, not programs ------------------------------------------------------------------------------------------------


def test_closing_compiles_nothing():
    """Opening, closing, another kind, a lock, another base, ground, and other names are one program."""
    open_tree = tree(UNBALANCED)
    at = open_tree.neutral()
    ends = sdyn.Frame("x", "l3"), sdyn.Frame("y", "l8")
    closed = open_tree.close(*ends, "weld", name="one", q=at)
    variants = [
        closed.close("e0", "ground", "point", name="two", q=at),
        open_tree,
        closed,
        open_tree.close(*ends, "universal", name="one", q=at),
        closed.lock({"j1": 0.0}),
        closed.reroot("l8"),
        closed.ground("l0"),
        open_tree.close("ground", "e0", name="two", q=at),
    ]
    size, other = sdyn.capacity(variants), sdyn.capacity([x.prefixed("other_") for x in variants])
    fd = jax.jit(partial(sdyn.forward_dynamics), **QUICKLY)
    for k, mine in enumerate(variants + [x.prefixed("other_") for x in variants]):
        chain = sdyn.pack(mine, size if k < 8 else other)
        q, v = sdyn.pad(chain, mine.neutral(), np.zeros(mine.nv))
        vdot = fd(chain, q, v, jnp.ones_like(v))
        K = sdyn.loop_jacobian(chain, q)
        close(K @ vdot, 0 * (K @ vdot), 1e-12, scale=vdot)
        close(sdyn.loop_residual(chain, q), np.zeros(size.rows), 1e-14, scale=1.0)
    assert fd._cache_size() == 1
    assert sdyn.capacity([open_tree]).rows == 0
    zeros = [np.zeros(n) for n in (open_tree.nq, open_tree.nv, open_tree.nv)]
    assert sdyn.loop_residual(sdyn.pack(open_tree), open_tree.neutral()).shape == (0,)
    count = lambda f: len(jax.make_jaxpr(f)(sdyn.pack(open_tree), *zeros).eqns)
    assert count(sdyn.forward_dynamics) == count(tree_dynamics)  # an open tree has no loop solver


# -- consistent states, drift ------------------------------------------------------------------------------------------


def test_projection(rng):
    """Closed, at rest where the closures hold, as near in kinetic energy as can be; and its slope."""
    mine = row_of_four_bars(2)
    chain = sdyn.pack(mine)
    q = np.r_[np.full(3, 1.1), np.full(2, -1.1)] + 0.15 * rng.normal(size=5)
    v = rng.normal(size=5)
    both = lambda q, v: jnp.concatenate(sdyn.project(chain, q, v))
    run = jax.jit(both, **QUICKLY)
    q1, v1 = np.split(run(q, v), 2)
    K, M = np.asarray(sdyn.loop_jacobian(chain, q1)), np.asarray(sdyn.mass_matrix(chain, q1))
    close(sdyn.loop_residual(chain, q1), np.zeros(6), 1e-14, scale=1.0)
    close(K @ v1, np.zeros(6), 1e-13, scale=1.0)
    free = np.linalg.svd(K)[2][np.linalg.matrix_rank(K) :]
    close(free @ M @ (v1 - v), np.zeros(len(free)), 1e-12, scale=1.0)
    assert np.abs(q1 - q).max() < 0.5
    along = rng.normal(size=5), rng.normal(size=5)
    slope = jax.jit(lambda *x: jax.jvp(both, *x)[1], **QUICKLY)((q, v), along)
    close(slope, differences(lambda x: run(*x), (q, v), along, 1e-4), 1e-8)


def test_drift():
    """Projection leaves rounding, Baumgarte lets an error decay at its rate, and nothing keeps it."""
    mine = four_bar("point")
    chain, (q, _, _) = sdyn.pack(mine), state()
    steps, rate, dt = 1000, 10.0, 0.0002
    still = q + np.array([0.0, 1e-4, 0.0])
    rest, options = np.zeros((steps, 3)), dict(method="semi_implicit")
    run = lambda drift: sdyn.rollout(chain, still, np.zeros(3), rest, dt, drift=drift, **options)[0]
    size = lambda q: np.abs(np.asarray(sdyn.loop_residual(chain, q))).max()
    project = jax.jit(lambda: run("project"), **QUICKLY)()
    baumgarte, nothing = map(jax.jit(run, **QUICKLY), (rate, 0.0))
    assert size(project[1]) < 1e-11 and size(project[2]) < 1e-14 and size(project[-1]) < 1e-14
    t = steps * dt
    assert abs(size(baumgarte[-1]) / (size(still) * (1 + rate * t) * np.exp(-rate * t)) - 1) < 0.05
    assert size(nothing[-1]) > 0.3 * size(still)
