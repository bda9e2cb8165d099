"""The functions of `sdyn` that several tests use, jitted once, for `STATES` states of one structure.

All take arrays in the layout of the common capacity, so each is compiled once for all structures and robots.
"""

import jax
import jax.numpy as jnp
from structures import QUICKLY, on_states

import sdyn


def fd(chain, q, v, tau, gravity, f_ext):
    return sdyn.forward_dynamics(chain, q, v, tau, gravity=gravity, f_ext=f_ext)


def inverse(chain, q, v, vdot, gravity, f_ext):
    return sdyn.inverse_dynamics(chain, q, v, vdot, gravity=gravity, f_ext=f_ext)


def motion(chain, q, v, vdot):
    """Of every frame: rotation, origin, velocity, acceleration, Jacobian."""
    frames = jnp.arange(len(chain.capacity.frame_names))
    R, p = jax.vmap(lambda k: sdyn.frame_pose(chain, q, k))(frames)
    V = jax.vmap(lambda k: sdyn.frame_velocity(chain, q, v, k))(frames)
    A = jax.vmap(lambda k: sdyn.frame_acceleration(chain, q, v, vdot, k))(frames)
    J = jax.vmap(lambda k: sdyn.frame_jacobian(chain, q, k))(frames)
    return R, p, V, A, J


def totals(chain, q, v):
    """Momentum, centre of mass, kinetic energy."""
    return sdyn.momentum(chain, q, v), sdyn.centre_of_mass(chain, q), sdyn.kinetic_energy(chain, q, v)


def along(chain, q, v, q_rate, vdot):
    """Poses, velocities and totals, and their derivatives where q and v change at the given rates."""

    def f(q, v):
        R, p, V, _, _ = motion(chain, q, v, jnp.zeros_like(v))
        return R, p, V, *totals(chain, q, v)

    return jax.jvp(f, (q, v), (q_rate, vdot))


FD = on_states(fd)
ID = on_states(inverse)
MASS = on_states(sdyn.mass_matrix)
BIAS = on_states(lambda chain, q, v, gravity: sdyn.bias_force(chain, q, v, gravity=gravity))
SOLVE = on_states(sdyn.solve_mass)
POSES = on_states(sdyn.body_poses)
MOTION = on_states(motion)
TOTALS = on_states(totals)
ALONG = on_states(along, **QUICKLY)
REGRESSOR = on_states(lambda chain, q, v, vdot, gravity: sdyn.regressor(chain, q, v, vdot, gravity=gravity))
GENERALISED = on_states(sdyn.generalised_jacobian, **QUICKLY)
TRANSFER = jax.jit(sdyn.transfer, **QUICKLY)
SLOPES = on_states(jax.jacfwd(fd, (1, 2)), **QUICKLY)
