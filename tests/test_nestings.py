"""The nestings of JAX transformations that users write, on every public device function.

Functions that share their work are one function of one vector here, so that each nesting is compiled once for all.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from structures import QUICKLY, close, tree

import sdyn


def parts(chain, x):
    """q, v, and accelerations or forces."""
    return jnp.split(x, (chain.nq, chain.nq + chain.nv))


def kinematics(chain, x):
    q, v, a = parts(chain, x)
    poses = sdyn.body_poses(chain, q), sdyn.frame_pose(chain, q, "e0"), sdyn.frame_jacobian(chain, q, "e0")
    moving = sdyn.frame_velocity(chain, q, v, "e0"), sdyn.frame_acceleration(chain, q, v, a, "e0")
    return poses, moving, sdyn.frame_wrench(chain, q, "e0", x[:6])


def dynamics(chain, x):
    q, v, a = parts(chain, x)
    load = dict(gravity=x[:3], f_ext=x[3:9] * jnp.ones((chain.capacity.links, 1)))
    both = sdyn.forward_dynamics(chain, q, v, a, **load), sdyn.inverse_dynamics(chain, q, v, a, **load)
    return both, sdyn.bias_force(chain, q, v), sdyn.mass_matrix(chain, q), sdyn.solve_mass(chain, q, a)


def linearised(chain, x):
    return sdyn.forward_dynamics_jacobians(chain, *parts(chain, x)), sdyn.regressor(chain, *parts(chain, x))


def totals(chain, x):
    q, v, _ = parts(chain, x)
    stored = sdyn.wheels(chain, q, v, ["j0"])
    return sdyn.momentum(chain, q, v), sdyn.kinetic_energy(chain, q, v), sdyn.centre_of_mass(chain, q), stored[:2]


def floating(chain, x):
    q, v, a = parts(chain, x)
    rates, h = v[6:], a[:6]
    reduced = sdyn.floating_velocity(chain, q, rates, h), sdyn.reduced_dynamics(chain, q, rates, h)
    both = sdyn.floating_forward_dynamics(chain, q, rates, a[6:], h), sdyn.floating_inverse_dynamics(chain, q, v, a[6:])
    return reduced, both, sdyn.generalised_jacobian(chain, q, "e0"), sdyn.reaction_null_space(chain, q)[0]


def motion(chain, x):
    q, v, tau = parts(chain, x)
    return sdyn.integrate(chain, q, v, tau, 0.01), sdyn.rollout(chain, q, v, tau[None], 0.01)


def held(chain, x):
    q, v, a = parts(chain, x)
    vdot, lam, _ = sdyn.constrained_dynamics(chain, q, v, a)
    loops = sdyn.loop_residual(chain, q), sdyn.loop_jacobian(chain, q), sdyn.loop_wrenches(chain, q, lam)
    return vdot, lam, loops, sdyn.project(chain, q, v), sdyn.constrained_inverse_dynamics(chain, q, v, vdot)


GROUPS = (kinematics, dynamics, linearised, totals, floating, motion, held)
ELSEWHERE = {
    "params", "with_params", "with_locks",  # test_params, test_gradients
    "transfer", "hybrid_rollout",  # test_transfer, test_hybrid: of two structures, and of many
    "partition", "conditioning", "diagnose", "growth", "choose", "reduce",  # numbers that nobody differentiates
    "capacity", "family", "pack", "pad", "unpad", "load", "save",  # before the device
}  # fmt: skip


def test_every_device_function_is_in_a_group():
    used = {name for group in GROUPS for name in group.__code__.co_names}
    functions = {name for name, x in vars(sdyn).items() if callable(x) and name[0].islower()}
    assert functions <= used | ELSEWHERE, functions - used - ELSEWHERE


def structure(group):
    """A base and two joints; tied to the ground where closures are the subject. Redundant ones: test_closures.py."""
    robot = tree((0, 1), seed=5)
    return robot.close("e1", "ground", kind="spherical", q=robot.neutral()) if group is held else robot


@pytest.mark.slow  # they compile for ten minutes; those of forward dynamics are in test_gradients too
@pytest.mark.parametrize("group", GROUPS, ids=lambda f: f.__name__)
def test_nestings(group):
    robot = structure(group)
    chain, rng = sdyn.pack(robot), np.random.default_rng(4)
    xs = rng.normal(size=(2, chain.nq + 2 * chain.nv))
    xs[:, 3:7] /= np.linalg.norm(xs[:, 3:7], axis=1, keepdims=True)
    f = lambda x: jnp.concatenate([jnp.ravel(y) for y in jax.tree.leaves(group(chain, x))])
    w, d = rng.normal(size=jax.eval_shape(f, xs[0]).shape), rng.normal(size=xs.shape[1])
    one = lambda x: jnp.sin(0.1 * w @ f(x))
    slope, x = jax.grad(one), xs[0]
    scanned = lambda x: jax.lax.scan(lambda c, _: (c * (1 + 0.01 * jax.checkpoint(one)(c)), None), x, length=2)[0] @ d
    nestings = {
        "vmap of vmap of grad": lambda: jax.vmap(jax.vmap(slope))(xs[:, None])[:, 0],
        "grad of vmap": lambda: jax.grad(lambda xs: jax.vmap(one)(xs).sum())(xs),
        "jacfwd": lambda: jax.jacfwd(one)(x),
        "hessian": lambda: jax.hessian(one)(x) @ d,
        "grad of grad": lambda: jax.grad(lambda x: slope(x) @ d)(x),
        "grad through scan and checkpoint": lambda: jax.grad(scanned)(x) @ d,
        "jvp through scan and checkpoint": lambda: jax.jvp(scanned, (x,), (d,))[1],
    }
    found = [jax.jit(nesting, **QUICKLY)() for nesting in nestings.values()]
    each, of_batch, forward, hessian, twice, back, along = map(np.asarray, found)
    close(each, of_batch, 1e-9)
    close(each[0], forward, 1e-9)
    close(hessian, twice, 1e-9)
    close(back, along, 1e-9)
