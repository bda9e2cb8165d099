"""No public function gives NaN, or an infinite gradient, from finite input of its domain: a search.

Random trees of all joint kinds, with locks, massless links, other bases, grounds and closures, all in one capacity, so
that each function is compiled once; in states that are random, at rest at the identity, straight, turned by pi, with
frames that coincide. For each, all outputs and the gradient of a random sum of them by everything that is a number.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from structures import QUICKLY, body, quaternions, rotation, unit, with_frames, without_mass

import sdyn
from sdyn.coordinates import retract
from sdyn.parts import KINDS

ROBOTS, STATES = 24, 6


def random_robot(seed) -> sdyn.Robot:
    """A robot with the names l0 to l6, j0 to j5, and up to two closures."""
    rng = np.random.default_rng([17, seed])
    kinds = rng.choice(list(KINDS), 6)
    square = lambda: [np.eye(3), rotation(rng)][rng.integers(2)]  # aligned with its neighbours, or not
    links = [body(rng, f"l{k}", 20.0 * (k == 0) or None) for k in range(7)]
    if seed % 4 == 0:  # spheres: equal principal moments
        links = [sdyn.Link(x.name, x.mass, (0, 0, 0.1), 0.1 * np.eye(3)) for x in links]
    joints = [
        sdyn.Joint(
            f"j{k}", kind, f"l{rng.integers(max(0, k - 2), k + 1)}", f"l{k + 1}", square(), rng.uniform(-0.4, 0.4, 3),
            unit(rng) if rng.integers(2) else (0, 0, 1.0), pitch=0.3 if kind == "helical" else 0.0,
            rotor_inertia=0.1 * (seed % 3), damping=0.2 * (seed % 2), stiffness=0.0 if kind == "spherical" else 1.0,
        )
        for k, kind in enumerate(kinds)
    ]  # fmt: skip
    robot = with_frames(sdyn.Robot(links, joints), rng, [("l6", np.zeros(3)), ("l0", np.zeros(3))])
    if seed % 5 == 1:
        robot = without_mass(robot, f"l{rng.integers(1, 5)}")
    robot = robot.reroot(f"l{rng.choice([0, 0, 3, 6])}")
    turning = [x.name for x in robot.joints if x.kind in ("revolute", "prismatic", "helical")]
    robot = robot.lock({name: rng.choice([0.0, np.pi, 0.7]) for name in turning if rng.random() < 0.25})
    if seed % 3 == 2:
        robot = robot.ground(robot.base, [0.3, -0.2, 0.5, 0.5, 0.5, -0.5, 0.5])
    q = closed_at(robot)
    if seed % 2:
        robot = robot.close("c6", "c3", rng.choice(["point", "weld", "universal", "revolute"]), name="first", q=q)
    if seed % 4 == 3:
        robot = robot.close("e1", "c5", "point", name="second", q=q)
    return robot


def closed_at(robot):
    """A configuration; the closures keep the relative poses that it has."""
    q = np.random.default_rng(robot.nv).normal(size=robot.nq)
    for at in quaternions(robot):
        q[at] /= np.linalg.norm(q[at])
    return q


@cache
def found() -> list:
    """Robots that can be packed; the others are refused, which is an answer too."""
    out = []
    for seed in range(2 * ROBOTS):
        robot = random_robot(seed)
        try:
            sdyn.pack(robot, dtype="float64")
        except sdyn.RobotError:
            continue
        out.append(robot)
    assert len(out) >= ROBOTS
    return out[:ROBOTS]


@cache
def size():
    return sdyn.capacity(found())


def states(robot):
    """Padded q and v of: a closed state, rest at zero, motion at zero, all at pi, fast with w = 0, almost closed."""
    rng = np.random.default_rng(len(robot.joints) + robot.nv)
    q, v = rng.normal(size=(STATES, robot.nq)), rng.normal(size=(STATES, robot.nv))
    q[1:3], q[3], v[1], v[4] = 0, np.pi, 0, 10 * v[4]
    for at in quaternions(robot):
        q[:, at] = [unit(rng, 4), *np.eye(4)[[0, 0, 1]], np.eye(4)[3], unit(rng, 4)]
    q[0] = q[5] = closed_at(robot)
    for joint, name in enumerate(robot.q_names):
        q[5, joint] += 1e-3 * np.sin(joint) * (".q" not in name)
    chain = sdyn.pack(robot, size(), dtype="float64")
    return chain, *sdyn.pad(chain, q, v)


g = jnp.array([0.0, 0.0, -9.81])
DOWN = dict(gravity=g)
links = lambda c: jnp.ones((c.capacity.links, 6))
rates = lambda c, v: v[c.capacity.base_nv :]


def phases(c, q, v, u):
    """Two of one structure, the second without duration."""
    family, durations = jax.tree.map(lambda x: jnp.stack([x, x]), c), jnp.array([0.01, 0.0])
    options = dict(method="semi_implicit", drift=1.0)
    found = sdyn.hybrid_rollout(family, q, v, jnp.stack([u[None], u[None]]), durations, jnp.array([0, 1]), **options)
    return found.q, found.v, found.impulse


FUNCTIONS = {  # of a chain, q, v, and something laid out like v
    "body_poses": lambda c, q, v, u: sdyn.body_poses(c, q),
    "frame_pose": lambda c, q, v, u: sdyn.frame_pose(c, q, 6),
    "frame_jacobian": lambda c, q, v, u: sdyn.frame_jacobian(c, q, 6),
    "frame_velocity": lambda c, q, v, u: sdyn.frame_velocity(c, q, v, 6),
    "frame_acceleration": lambda c, q, v, u: sdyn.frame_acceleration(c, q, v, u, 6),
    "centre_of_mass": lambda c, q, v, u: sdyn.centre_of_mass(c, q),
    "momentum": lambda c, q, v, u: sdyn.momentum(c, q, v),
    "kinetic_energy": lambda c, q, v, u: sdyn.kinetic_energy(c, q, v),
    "mass_matrix": lambda c, q, v, u: sdyn.mass_matrix(c, q),
    "solve_mass": lambda c, q, v, u: sdyn.solve_mass(c, q, u),
    "bias_force": lambda c, q, v, u: sdyn.bias_force(c, q, v, **DOWN),
    "inverse_dynamics": lambda c, q, v, u: sdyn.inverse_dynamics(c, q, v, u, f_ext=links(c), **DOWN),
    "forward_dynamics": lambda c, q, v, u: sdyn.forward_dynamics(c, q, v, u, f_ext=links(c), **DOWN),
    "constrained_dynamics": lambda c, q, v, u: sdyn.constrained_dynamics(c, q, v, u, **DOWN)[:2],
    "constrained_inverse_dynamics": sdyn.constrained_inverse_dynamics,
    "loop_residual": lambda c, q, v, u: sdyn.loop_residual(c, q),
    "loop_jacobian": lambda c, q, v, u: sdyn.loop_jacobian(c, q),
    "loop_wrenches": lambda c, q, v, u: sdyn.loop_wrenches(c, q, jnp.ones(c.capacity.rows)),
    "project": lambda c, q, v, u: sdyn.project(c, q, v),
    "regressor": lambda c, q, v, u: sdyn.regressor(c, q, v, u, **DOWN),
    "generalised_jacobian": lambda c, q, v, u: sdyn.generalised_jacobian(c, q, 6),
    "reaction_null_space": lambda c, q, v, u: sdyn.reaction_null_space(c, q)[0],
    "floating_velocity": lambda c, q, v, u: sdyn.floating_velocity(c, q, rates(c, v)),
    "floating_forward_dynamics": lambda c, q, v, u: sdyn.floating_forward_dynamics(c, q, rates(c, v), rates(c, u)),
    "floating_inverse_dynamics": lambda c, q, v, u: sdyn.floating_inverse_dynamics(c, q, v, rates(c, u)),
    "reduced_dynamics": lambda c, q, v, u: sdyn.reduced_dynamics(c, q, rates(c, v), **DOWN),
    "frame_wrench": lambda c, q, v, u: sdyn.frame_wrench(c, q, 6, u[:6]),
    "wheels": lambda c, q, v, u: tuple(sdyn.wheels(c, q, v, ["j0"]))[:1],
    "integrate": lambda c, q, v, u: sdyn.integrate(c, q, v, u, 0.01, **DOWN),
    "rollout": lambda c, q, v, u: sdyn.rollout(c, q, v, jnp.stack([u, u]), 0.01, method="semi_implicit", drift=1.0),
    "growth": lambda c, q, v, u: sdyn.growth(c, q, v, u[None], 0.01, method="semi_implicit", drift=1.0)[0],
    "hybrid_rollout": phases,
    "conditioning": lambda c, q, v, u: sdyn.conditioning(c, q),
    "diagnose": lambda c, q, v, u: sdyn.diagnose(c, q[None], v[None], **DOWN),
    "transfer": lambda c, q, v, u: sdyn.transfer(c, c, q, v)[1:],
}
ELSEWHERE = {  # and where
    "params", "with_params", "with_locks",  # below, in every function
    "partition",  # picks rows, no numbers; its solver is `constrained_dynamics`, test_closures.py
    "forward_dynamics_jacobians",  # test_jacobians.py
    "choose",  # measures, and refuses what is not finite; test_accuracy.py
    "pad", "unpad", "pack", "capacity", "family", "load", "save", "reduce",  # host stage
}  # fmt: skip
SINGULAR = {  # where the gradient has no meaning: its value alone is searched
    "reaction_null_space",  # jumps where the rank changes, and random states have no rank in common
}


def test_every_public_function_is_searched():
    functions = {name for name, x in vars(sdyn).items() if callable(x) and not isinstance(x, type) and name[0] != "_"}
    assert functions == FUNCTIONS.keys() | ELSEWHERE


def test_retraction_where_quaternions_are_empty():
    """Found by the search: an empty quaternion read zeros at q = 0, and its length spoilt the slope of every step."""
    slopes = jax.jit(jax.jacrev(retract, (1, 2)), **QUICKLY)
    for robot in found():
        chain, q, v = states(robot)
        assert all(np.isfinite(x).all() for at in range(STATES) for x in slopes(chain, q[at], 0.1 * v[at]))


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_nothing_is_nan(name):
    """Of 24 robots in 6 states each."""
    f = FUNCTIONS[name]

    def one(chain, q, v):
        tau = jnp.sin(1.0 + jnp.arange(chain.nv, dtype=q.dtype))

        def total(params, q, v, tau):
            out = jax.tree.leaves(f(sdyn.with_params(chain, params), q, v, tau))
            out = [x for x in out if jnp.issubdtype(x.dtype, jnp.floating)]
            return sum((jnp.cos(1.0 + jnp.arange(x.size)).reshape(x.shape) * x).sum() for x in out), out

        if name in SINGULAR:
            return total(sdyn.params(chain), q, v, tau)
        return jax.value_and_grad(total, (0, 1, 2, 3), has_aux=True)(sdyn.params(chain), q, v, tau)

    search = jax.jit(jax.vmap(one, (None, 0, 0)), **QUICKLY)
    bad = []
    for k, robot in enumerate(found()):
        chain, q, v = states(robot)
        for path, x in jax.tree_util.tree_leaves_with_path(search(chain, q, v)):
            wrong = np.flatnonzero(~np.isfinite(np.asarray(x)).reshape(STATES, -1).all(1))
            bad += [(k, int(state), jax.tree_util.keystr(path)) for state in wrong]
    assert not bad, f"{len(bad)} entries, the first (robot, state, place): {bad[:6]}"
