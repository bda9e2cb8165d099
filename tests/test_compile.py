"""A change of structure compiles nothing; and wrong arguments say what is wrong, while tracing."""

import re
import time
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from structures import POSE, QUICKLY, UNBALANCED, capacity, packed, padded, renamed, state, states, tree

import sdyn

EVENTS = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **rest: EVENTS.append(event) if "compile" in event else None
)


class Compilations:
    """Counts traces, lowerings and compilations in its block."""

    def __enter__(self):
        self.start = len(EVENTS)
        return self

    def __exit__(self, *error):
        self.count = len(EVENTS) - self.start


def variants():
    """Ten robots of one capacity: locks, bases, ground, lock values, names and masses."""
    one = tree(UNBALANCED)
    heavy = replace(one, links=[replace(x, mass=3 * x.mass, inertia=3 * x.inertia) for x in one.links])
    return [
        one,
        one.lock({"j0": 0.3}),
        one.lock({"j0": -1.2}),
        one.lock({"j2": 0.1, "j5": 0.2, "j7": 0.3}),
        one.reroot("l8"),
        one.reroot("l3").lock({"j6": 0.5}),
        one.ground("l0", POSE),
        one.reroot("l8").ground("l8"),
        heavy,
        one.lock({f"j{k}": 0.1 for k in range(8)}),
    ]


def test_ten_variants_are_one_compilation():
    """Of forward dynamics, of a rollout and of a transfer; robots with other names are the same program too."""
    robots = variants()
    renamed_parts = [robot.prefixed("other_") for robot in robots]
    ours, others = sdyn.capacity(robots), sdyn.capacity(renamed_parts)
    chains = [sdyn.pack(r, ours) for r in robots] + [sdyn.pack(r, others) for r in renamed_parts]
    # partial: a jitted function shares its cache with every other jit of the same object
    fd = jax.jit(partial(sdyn.forward_dynamics), **QUICKLY)
    roll = jax.jit(lambda chain, q, v, taus: sdyn.rollout(chain, q, v, taus, 0.01, method="semi_implicit"), **QUICKLY)
    transfer = jax.jit(partial(sdyn.transfer), **QUICKLY)
    pose = jax.jit(lambda chain, q: sdyn.frame_pose(chain, q, 0), **QUICKLY)
    assert len(chains) == 20
    counts, results = [], []
    for k, (chain, robot) in enumerate(zip(chains, robots + renamed_parts, strict=True)):
        q, v = sdyn.pad(chain, robot.neutral(), np.ones(robot.nv))
        with Compilations() as made:
            vdot = fd(chain, q, v, jnp.ones_like(v))
            roll(chain, q, v, jnp.zeros((3, chain.nv)))
            if k not in (0, 10):
                transfer(chains[k // 10 * 10], chain, q, v)
            pose(chain, q)
        counts.append(made.count)
        results.append(np.asarray(vdot))
    assert counts[0] and counts[1], "the first calls compile, or this test counts nothing"
    assert counts[2:] == [0] * 18
    assert [f._cache_size() for f in (fd, roll, transfer, pose)] == [1] * 4
    assert len({x.tobytes() for x in results[:10]}) == 10  # ten structures, not one ten times
    for a, b in zip(results[:10], results[10:], strict=True):
        assert np.array_equal(a, b)


def test_lock_values_and_ground_pose_are_data():
    """The exact layout's compile key holds neither."""
    one = tree(UNBALANCED)
    f = jax.jit(partial(sdyn.body_poses), **QUICKLY)
    for angle in (0.1, 0.2, 0.3):
        chain = sdyn.pack(one.lock({"j3": angle}))
        f(chain, one.lock({"j3": angle}).neutral())
    assert f._cache_size() == 1
    for x in (0.0, 1.0):
        grounded = one.ground("l0", [x, 0, 0, 1, 0, 0, 0])
        assert f(sdyn.pack(grounded), grounded.neutral())[1][0, 0] == x
    assert f._cache_size() == 2


def test_edit_and_pack_run_on_the_host():
    """One structure change of the 37-DOF robot: no compilation, no trace, at most 10 ms."""
    paper = sdyn.models.load("paper37")
    frames = [frame.link for frame in paper.frames]
    size = sdyn.capacity([paper, paper.reroot(frames[0])])
    sdyn.pack(paper, size)
    names = [joint.name for joint in paper.moving]
    times = []
    with Compilations() as made:
        for k in range(20):
            start = time.perf_counter()
            edited = paper.lock({names[k]: 0.1 * k, names[k + 1]: 0.2}).reroot(frames[k % len(frames)])
            jax.block_until_ready(sdyn.pack(edited, size))
            times.append(time.perf_counter() - start)
    assert made.count == 0
    assert min(times) <= 10e-3, f"the fastest of {len(times)} took {min(times) * 1e3:.1f} ms"


def test_all_shipped_robots_in_one_capacity():
    """Different robots are different data."""
    f = jax.jit(partial(sdyn.momentum), **QUICKLY)
    for name in sdyn.models.names():
        robot = renamed(sdyn.models.load(name))
        chain = sdyn.pack(robot, capacity())
        x = padded(robot, chain, states(robot, name))
        f(chain, x.q[0], x.v[0])
    assert f._cache_size() == 1


# -- what is refused, while tracing ------------------------------------------------------------------------------------


def refused(*words):
    return pytest.raises(ValueError, match="(?s)" + "".join(f"(?=.*{re.escape(word)})" for word in words))


def test_wrong_shapes_types_and_names():
    chain, x = packed("unbalanced_tree"), state("unbalanced_tree")
    q, v, tau = x.q[0], x.v[0], x.tau[0]
    fd = sdyn.forward_dynamics
    with refused("q has shape", str(chain.nq - 1), str(chain.nq)):
        fd(chain, q[:-1], v, tau)
    with refused("v has shape", "padded layout"):
        fd(chain, q, x.v, tau)
    with refused("tau has shape", f"({chain.nv + 1},)"):
        jax.jit(fd)(chain, q, v, jnp.zeros(chain.nv + 1))
    with refused("gravity has shape", "(2,)", "(3,)"):
        fd(chain, q, v, tau, gravity=jnp.zeros(2))
    with refused("f_ext has shape", "(3, 6)"):
        fd(chain, q, v, tau, f_ext=jnp.zeros((3, 6)))
    with refused("q is float32", "float64", "dtype=float32"):
        fd(chain, q.astype("float32"), v, tau)
    with refused("v is float64", "float32"):
        fd(packed("unbalanced_tree", "float32"), q.astype("float32"), v, tau)
    with refused("there is no frame 'e9'", "did you mean", "'e0'"):
        sdyn.frame_pose(chain, q, "e9")
    with refused("there is no frame", "99"):
        sdyn.frame_jacobian(chain, q, 99)
    family = sdyn.family([tree(UNBALANCED), tree(UNBALANCED).reroot("l8")])
    with refused("stacked family", "vmap"):
        fd(family, jnp.zeros(15), jnp.zeros(14), jnp.zeros(14))
    with refused("pad", "exact sizes"):
        sdyn.pad(sdyn.pack(tree(UNBALANCED)), q, v)


def test_what_belongs_to_a_structure_that_has_it_not():
    """A frame that the capacity names and this robot lacks gives NaN, not another frame."""
    chain, x = packed("one_body"), state("one_body")
    assert np.isnan(sdyn.frame_pose(chain, x.q[0], "c5")[1]).all()


def test_integers_are_numbers():
    """A plain list or an integer array is taken as numbers of the structure's type."""
    robot = tree(())
    chain = sdyn.pack(robot)
    q = [0, 0, 0, 1, 0, 0, 0]
    vdot = sdyn.forward_dynamics(chain, q, [0] * 6, np.arange(6))
    assert vdot.dtype == jnp.float64 and np.isfinite(vdot).all()
