"""The extremes, row by row: a test at its pass mark, or a refusal that is flagged.

`ROWS` is the catalogue; each row names the tests that hold it. Marks are pairs (float64, float32); what was measured
stands behind them. The reference is `exact.py`, 60 decimal digits.
"""

from dataclasses import replace
from functools import cache, partial
from itertools import pairwise

import exact
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from catalogue import without_a_test
from functions import FD
from structures import QUICKLY, STATES, capacity, tree, unit

import sdyn
from sdyn.heaviest import better_base
from sdyn.rigid import merged
from sdyn.rotation import exp, matrix

ROWS = {
    "heavy tip, alternating, light tip, light middle, light base": [
        "test_extremes::test_mass_ratios", "test_extremes::test_what_the_wrong_base_would_give",
    ],
    "no mass, no inertia at the end": ["test_extremes::test_ends_without_mass_or_inertia"],
    "long chains": ["test_extremes::test_long_chains"],
    "near-singular and singular loops, partition": [
        "test_mechanisms::test_row_of_four_bars", "test_mechanisms::test_states_of_a_four_bar",
    ],
    "redundant closures": ["test_closures::test_closure_stated_twice", "test_mechanisms::test_bricard"],
    "drift, stiff Baumgarte gains": [
        "test_closures::test_drift", "test_extremes::test_stiff_baumgarte_gains_are_refused",
    ],
    "high spin": ["test_integrate::test_order_on_a_free_top", "test_extremes::test_a_step_that_turns_too_far_is_seen"],
    "quaternion drift, sign, length": ["test_extremes::test_quaternions"],
    "small angles, pi, 4 rad": ["test_extremes::test_rotations_at_every_switch"],
    "singular gradients": ["test_finite::test_nothing_is_nan"],
    "far from the origin": ["test_extremes::test_far_from_the_origin"],
    "chaotic horizon": ["test_extremes::test_growth_on_a_chaotic_pendulum"],
    "steps from zero to huge, backwards": ["test_extremes::test_steps"],
    "no joint, one link, all locked": [
        "test_extremes::test_nothing_moves", "test_laws::test_forward_after_inverse_dynamics",
    ],
    "many changes of structure": ["test_many_changes::test_many_changes"],
}  # fmt: skip
PATTERNS = {
    "heavy tip": lambda r: [1] * 8 + [r],
    "alternating": lambda r: [1, r] * 4 + [1],
    "light tip": lambda r: [1] * 8 + [1 / r],
    "light middle": lambda r: [1] * 4 + [1 / r] + [1] * 4,
    "light base": lambda r: [1 / r] + [1] * 8,
}
NAMES = ("float64", "float32")


@pytest.mark.parametrize("row", ROWS)
def test_every_row_has_its_test(row):
    assert not without_a_test(ROWS[row])


@cache
def weighted(pattern, ratio):
    """A chain of eight joints whose bodies have masses in a pattern."""
    robot = tree(tuple(range(8)), base_mass=2.0)
    scale = PATTERNS[pattern](ratio)
    links = [replace(x, mass=x.mass * s, inertia=x.inertia * s) for x, s in zip(robot.links, scale, strict=True)]
    return replace(robot, links=links)


CONDITION = jax.jit(sdyn.conditioning, **QUICKLY)
PLAIN = jax.jit(partial(sdyn.forward_dynamics), **QUICKLY)


def accelerations(robot, dtype, *, inner=True):
    """Of one state: computed, exact, condition, and how far the type is to be trusted; without `inner`, from the base
    of the user."""
    rng = np.random.default_rng(0)
    q, v, tau = rng.normal(size=robot.nq), *rng.normal(size=(2, robot.nv))
    if not robot.grounded:
        q[3:7] = unit(rng, 4)
    q, v, tau = (x.astype("float32").astype(float) for x in (q, v, tau))  # the same numbers in both types
    chain, state = sdyn.pack(robot, dtype=dtype), [x.astype(dtype) for x in (q, v, tau)]
    chain = chain if inner else replace(chain, inner=None)
    condition, trust = CONDITION(chain, state[0])
    return np.asarray(PLAIN(chain, *state)), exact.accelerations(robot, q, v, tau), float(condition), int(trust)


def error(found, exact):
    return np.abs(found - exact).max() / np.abs(exact).max()


@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6, 1e8])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_mass_ratios(pattern, ratio):
    """float64 keeps 1e-13 at every ratio: a base that is light is refined, one that is far too light is not computed
    from. float32 keeps 5e-5 where nothing is wrong; in between, where refinement has to help, it says so."""
    robot = weighted(pattern, ratio)
    found, true, condition, trust = accelerations(robot, "float64")
    assert error(found, true) <= 1e-13 and trust == sdyn.Trust.GOOD  # measured 5e-14
    light, other = pattern in ("light tip", "light middle"), better_base(robot) is not None
    assert other == (not light and ratio >= 1e6)
    assert condition < 1e4 if light or other else condition > ratio  # measured 1e3: a light end spoils nothing
    found, true, condition, trust = accelerations(robot, "float32")
    eps = np.finfo("float32").eps
    assert error(found, true) <= min(10 * eps * condition, 5e-5 if trust == sdyn.Trust.GOOD else 1e-3)  # 8e-6, 2e-4
    assert trust == sdyn.Trust.GOOD or ratio == 1e4 or pattern == "light base"
    assert trust != sdyn.Trust.GOOD or ratio != 1e4 or light


@pytest.mark.parametrize("pattern", ["heavy tip", "light base", "alternating"])
def test_what_the_wrong_base_would_give(pattern):
    """Without the other base, float32 is garbage at 1e8 and is refused, and so is what `diagnose` sees of it."""
    robot = weighted(pattern, 1e8)
    for dtype, mark in zip(NAMES, (1e-13, 5e-5), strict=True):
        chosen, wrong = (accelerations(robot, dtype, inner=inner) for inner in (True, False))
        assert error(*chosen[:2]) <= mark and chosen[3] == sdyn.Trust.GOOD  # measured 5e-15, 4e-6
        assert wrong[3] == (sdyn.Trust.REFUSED if dtype == "float32" else sdyn.Trust.GOOD)
        assert error(*wrong[:2]) > 1e-2 or dtype == "float64"


def test_ends_without_mass_or_inertia():
    """Refused by the names of link and joint where the acceleration is not determined; allowed where it is."""
    base = sdyn.Link("base", 10.0, inertia=np.eye(3))
    hinge = lambda name, a, b: sdyn.Joint(name, "revolute", a, b, axis=(1, 0, 0), position=(0, 0, 1))
    for end, words in [
        (sdyn.Link("end", 0.0), "'j' moves link 'end', which has no mass and no inertia"),
        (sdyn.Link("end", 2.0, (0.3, 0, 0)), "'j' moves link 'end' without any inertia about its axis"),
    ]:
        with pytest.raises(sdyn.RobotError, match=words):
            sdyn.pack(sdyn.Robot([base, end], [hinge("j", "base", "end")]))
    with pytest.raises(sdyn.RobotError, match="free base that nothing keeps"):
        sdyn.pack(sdyn.Robot([sdyn.Link("base", 0.0)]))
    bodies = [replace(base, name="l0"), sdyn.Link("l1", 0.0), sdyn.Link("l2", 5.0, (0.1, 0.2, 0.3), np.eye(3))]
    middle = sdyn.Robot(bodies, [hinge("j0", "l0", "l1"), replace(hinge("j1", "l1", "l2"), axis=(0, 1, 0))])
    point = replace(middle, links=[bodies[0], bodies[2], sdyn.Link("l1", 1.0, (0, 0.5, 0.5))])
    for robot in (middle, point):
        found, true, _, _ = accelerations(robot, "float64")
        assert error(found, true) <= 1e-13  # measured 5e-16


def long_chain(n, straight):
    rng = np.random.default_rng(n)
    links = [sdyn.Link(f"l{k}", 1.0, (0, 0, 0.5), np.diag([1.0, 1.0, 0.1]) / 12) for k in range(n + 1)]
    axis = lambda k: ((1.0, 0, 0), (0, 1.0, 0))[k % 2] if straight else unit(rng)
    place = dict(position=(0, 0, 1))
    return sdyn.Robot(
        links, [sdyn.Joint(f"j{k}", "revolute", f"l{k}", f"l{k + 1}", axis=axis(k), **place) for k in range(n)]
    )


@pytest.mark.parametrize("straight", [False, True], ids=["crumpled", "straight"])
@pytest.mark.parametrize("n", [10, 100, 1000])
def test_long_chains(n, straight):
    """A thousand joints to 1e-8, in less than 1 GB; one program for all lengths."""
    robot, rng = long_chain(n, straight), np.random.default_rng(1)
    q = np.r_[0, 0, 0, 1, 0, 0, 0, rng.uniform(-1e-3, 1e-3, n) if straight else rng.uniform(-3, 3, n)]
    v, tau = 0.01 * rng.normal(size=n + 6), rng.normal(size=n + 6)
    size = sdyn.capacity([long_chain(1000, True)])
    chain = sdyn.pack(robot, size)
    state = *sdyn.pad(chain, q, v), sdyn.pad(chain, q, tau)[1]
    found = np.asarray(PLAIN(chain, *state))[: n + 6]
    mark = {10: 1e-12, 100: 1e-10, 1000: 1e-8}[n]
    assert error(found, exact.accelerations(robot, q, v, tau)) <= mark  # straight 3e-12 at 100, 9e-11 at 1000
    memory = PLAIN.lower(chain, *state).compile().memory_analysis()
    assert memory.temp_size_in_bytes + memory.argument_size_in_bytes < 1e9  # measured 7e5


# -- rotations ---------------------------------------------------------------------------------------------------------


def state_of(robot, dtype="float64", q=None):
    rng = np.random.default_rng(3)
    chain = sdyn.pack(robot, capacity(), dtype=dtype)
    q = robot.configuration({x.name: rng.normal(size=x.nq) for x in robot.moving}) if q is None else q
    v, tau = rng.normal(size=(2, robot.nv))
    (x, y), z = sdyn.pad(chain, q, v), sdyn.pad(chain, q, tau)[1]
    return chain, x, y, z


def many(*arrays):
    return [jnp.tile(jnp.asarray(x)[None], (STATES, *[1] * np.ndim(x))) for x in arrays]


def dynamics(chain, q, v, tau, gravity):
    nothing = jnp.zeros((chain.capacity.links, 6), chain.dtype)
    return np.asarray(FD(chain, *many(q, v, tau, jnp.asarray(gravity, chain.dtype), nothing)))[0]


def test_quaternions():
    """q and −q are one attitude, and so is any multiple; steps keep the length to rounding."""
    chain, q, v, tau = state_of(tree(tuple(range(8))))
    turn = np.array([0.5, -0.5, 0.5, 0.5])
    with_quat = lambda x: q.at[3:7].set(jnp.asarray(x))
    want = dynamics(chain, with_quat(turn), v, tau, (1.0, 2.0, 3.0))
    assert np.array_equal(dynamics(chain, with_quat(-turn), v, tau, (1.0, 2.0, 3.0)), want)
    assert error(dynamics(chain, with_quat(1.7 * turn), v, tau, (1.0, 2.0, 3.0)), want) < 1e-14  # measured 0
    slope = jax.jacfwd(matrix)(jnp.asarray(turn))
    assert np.abs(slope @ turn).max() < 1e-15  # that of the normalised map: none along the quaternion


ANGLES = [0.0, 1e-300, 1e-12, 1e-8, 1e-5, 1e-2, *np.sqrt(1e-3) * np.array([1 - 1e-15, 1, 1 + 1e-15]), 1.0,
          np.pi - 1e-9, np.pi, np.pi + 1e-9, 4.0, 2 * np.pi]  # fmt: skip


@pytest.mark.parametrize("dtype", NAMES)
def test_rotations_at_every_switch(dtype):
    """Values, first and second derivatives of the rotation of a rotation vector, where its formula changes too."""
    axis = np.array([2.0, -1.0, 2.0]) / 3
    first, second = jax.jit(jax.jacfwd(exp)), jax.jit(jax.jacfwd(jax.jacfwd(exp)))
    tol = {"float64": 4e-16, "float32": 3e-7}[dtype]
    for angle in ANGLES:
        theta = jnp.asarray(axis * angle, dtype)
        want = np.r_[np.cos(angle / 2), np.sin(angle / 2) * axis]
        assert np.abs(exp(theta) - want).max() <= tol + 0.6 * angle * np.finfo(dtype).eps
        along = np.r_[-np.sin(angle / 2) / 2, np.cos(angle / 2) / 2 * axis]
        assert np.abs(first(theta) @ axis.astype(dtype) - along).max() <= 4 * tol  # measured 2e-16, 6e-8
        bend = np.einsum("ijk,j,k->i", second(theta), axis, axis)
        assert np.abs(bend + want / 4).max() <= 20 * tol  # measured 4e-16, 1e-7
        assert np.isfinite(second(theta)).all()


def test_far_from_the_origin():
    """Accelerations do not know where the robot is, not in a bit; distances keep the digits that places have."""
    for dtype in NAMES:
        chain, q, v, tau = state_of(tree(tuple(range(8))), dtype)
        want = dynamics(chain, q, v, tau, (0.0, 0.0, -9.81))
        for far in (1e4, 1e8):
            there = q.at[:3].add(jnp.asarray([far, -far, far], dtype))
            assert np.array_equal(dynamics(chain, there, v, tau, (0.0, 0.0, -9.81)), want)


# -- time --------------------------------------------------------------------------------------------------------------

STEP = jax.jit(partial(sdyn.integrate), **QUICKLY)


def test_steps():
    """Zero is the identity, backwards undoes forwards, errors shrink with the step until rounding; a huge step gives a
    state that `diagnose` names, not one that looks sound."""
    chain, q, v, tau = state_of(tree(tuple(range(8))))
    v = v * 0.3
    same = zip(STEP(chain, q, v, tau, 0.0), (q, v), strict=True)
    assert all(np.abs(x - y).max() < 4e-16 for x, y in same)
    for dt in (1e-12, 1e-6, 1e-3):
        back = STEP(chain, *STEP(chain, q, v, tau, dt), tau, -dt)
        assert all(np.abs(x - y).max() < 1e-9 for x, y in zip(back, (q, v), strict=True))  # measured 2e-10 at 1e-3
    ends = []
    for count in (1, 2, 4, 8, 16):
        x = q, v
        for _ in range(count):
            x = STEP(chain, *x, tau, 0.02 / count)
        ends.append(np.concatenate(x))
    assert abs(np.linalg.norm(x[0][3:7]) - 1) < 1e-15  # after 16 steps
    errors = [np.abs(x - ends[-1]).max() for x in ends[:-1]]
    assert all(b < a / 8 for a, b in pairwise(errors))
    lost = STEP(chain, q, v * 1e160, tau, 1e200)
    found = sdyn.diagnose(chain, *(x[None] for x in lost))
    assert found.bad_step == 0 and "not finite" in str(found)


def test_stiff_baumgarte_gains_are_refused():
    """With the limit in the message, where rate and step are plain numbers."""
    robot = tree((0, 1)).close("e0", "ground", "point")
    chain, state = sdyn.pack(robot), (robot.neutral(), robot.velocity(), robot.velocity())
    for method in ("rk4", "semi_implicit"):
        with pytest.raises(ValueError, match=r"times dt is 1.5; keep it at most 1.*rate of 100 or less"):
            sdyn.integrate(chain, *state, 0.01, method=method, drift=150.0)


def test_a_step_that_turns_too_far_is_seen():
    """A spin of 300 rad/s in steps of 5 ms turns by 1.5 rad a step, where RK4 is 0.1 rad wrong after 10 s."""
    robot = tree(())
    chain = sdyn.pack(robot, capacity())
    turns = np.array([np.r_[0, 0, 0, np.cos(a / 2), 0, 0, np.sin(a / 2)] for a in 1.5 * np.arange(5)])
    qs, vs = sdyn.pad(chain, turns, np.tile(robot.velocity(twist=(0, 0, 300, 0, 0, 0)), (5, 1)))
    found = sdyn.diagnose(chain, qs, vs)
    assert abs(found.turn - 1.5) < 1e-12 and "turns by 1.5 rad a step" in str(found)


def test_nothing_moves():
    """With all joints locked, the mass matrix is that of one rigid body: mass, first moment, composite inertia."""
    robot = tree(tuple(range(8))).lock({f"j{k}": 0.3 * k for k in range(8)})
    (link,) = merged(robot).links
    M = np.asarray(sdyn.mass_matrix(sdyn.pack(robot), robot.neutral()))
    c = np.cross(np.eye(3), link.com)
    assert np.abs(M[3:, 3:] - link.mass * np.eye(3)).max() <= 1e-13 * link.mass
    assert np.abs(M[:3, :3] - (link.inertia + link.mass * c @ c.T)).max() <= 1e-13 * np.abs(M).max()  # measured 2e-16
    empty = sdyn.Robot([sdyn.Link("a", 1.0)], grounded=True)
    assert sdyn.forward_dynamics(sdyn.pack(empty), *[np.zeros(0)] * 3).shape == (0,)


@pytest.mark.slow
def test_growth_on_a_chaotic_pendulum():
    """Errors of a double pendulum grow by 1e2 in 10 s and by 1e11 in 30 s: the estimate says when to stop trusting."""
    rod = lambda name: sdyn.Link(name, 1.0, (0, 0, -1), np.zeros((3, 3)))
    robot = sdyn.Robot(
        [sdyn.Link("base", 0.0), rod("upper"), rod("lower")],
        [sdyn.Joint("a", "revolute", "base", "upper", axis=(0, 1, 0)),
         sdyn.Joint("b", "revolute", "upper", "lower", axis=(0, 1, 0), position=(0, 0, -1))],
        grounded=True,
    )  # fmt: skip
    chain, down = sdyn.pack(robot), np.array([0, 0, -9.81])
    grow = lambda q, steps: sdyn.growth(chain, np.array(q), np.zeros(2), np.zeros((steps, 2)), 0.005, gravity=down)
    by, lost = grow([np.pi / 2, 0.0], 6000)
    assert by[0] == pytest.approx(1) and lost == -1  # 2e-4 of the digits are left after 30 s
    for state, known in ((2000, 2e2), (4000, 1.3e6), (6000, 5e11)):  # in quadruple precision, at 10, 20 and 30 s
        assert known / 10 < by[state] < known * 10  # measured 1.1e2, 6.6e5, 8.8e11
    by, lost = grow([0.75 * np.pi, 0.3], 6000)
    assert lost > 0 and by[lost] * 2.2e-16 > 1e-3 >= by[lost - 1] * 2.2e-16  # at 24 s
