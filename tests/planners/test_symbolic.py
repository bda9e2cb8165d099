"""The dynamics in CasADi against sdyn's own: another implementation, in other frames."""

import casadi as ca
import jax
import numpy as np
import pytest
from structures import tree

import sdyn
from planners import symbolic

COUNT = 4


def functions(robot):
    """Joint and base forces, momentum about the base's origin, and a frame's motion, in CasADi."""
    shape, n = symbolic.tree_of(sdyn.pack(robot)), robot.nv - 6
    q, V, qd, a, qdd = (ca.SX.sym(name, k) for name, k in (("q", n), ("V", 6), ("qd", n), ("a", 6), ("qdd", n)))
    out = [*symbolic.newton_euler(shape, q, V, qd, a, qdd), symbolic.momentum(shape, q, V, qd)]
    R, p, w, v = symbolic.frame_motion(shape, q, V, qd, robot.frames[-1].name)
    return ca.Function("f", [q, V, qd, a, qdd], [*out, symbolic.centre_of_mass(shape, q), ca.vec(R.T), p, w, v])


def states(robot, rng):
    q, v, vdot = (rng.normal(size=(COUNT, n)) for n in (robot.nq, robot.nv, robot.nv))
    q[:, :7] = 0, 0, 0, 1, 0, 0, 0  # base axes are world axes
    return q, v, vdot


@jax.jit
def ours(chain, q, v, vdot, frame):
    def one(q, v, vdot):
        R, p = sdyn.frame_pose(chain, q, frame)
        h, c = sdyn.momentum(chain, q, v), sdyn.centre_of_mass(chain, q)
        about_origin = h.at[:3].add(jax.numpy.cross(c, h[3:]))
        tau = sdyn.inverse_dynamics(chain, q, v, vdot)
        return jax.numpy.concatenate([tau, about_origin, c, R.ravel(), p, sdyn.frame_velocity(chain, q, v, frame)])

    return jax.vmap(one)(q, v, vdot)


def mixed():
    """Kinds of joints, a branch, a base in the middle of the tree, springs and rotors."""
    kinds = ["revolute", "prismatic", "helical", "universal", "cylindrical", "planar", "fixed"]
    robot = tree([0, 1, 1, 3, 0, 5, 6], kinds, seed=3, damping=0.3, stiffness=0.7, rotor_inertia=0.2)
    return robot.reroot("l4")


ROBOTS = {name: sdyn.models.load(name) for name in sdyn.models.names()} | {"mixed": mixed()}
ROBOTS["paper37, 9 DOF"] = ROBOTS["paper37"].lock({j.name: 0.2 for j in ROBOTS["paper37"].moving[3:]})
CAPACITY = sdyn.capacity(ROBOTS.values())  # one program for all


@pytest.mark.parametrize("name", ROBOTS)
def test_it_is_sdyns(name, rng):
    robot = ROBOTS[name]
    q, v, vdot = states(robot, rng)
    chain = sdyn.pack(robot, CAPACITY)
    (q_there, v_there), (_, vdot_there) = sdyn.pad(chain, q, v), sdyn.pad(chain, q, vdot)
    frame = CAPACITY.frame_names.index(robot.frames[-1].name)
    want = np.asarray(ours(chain, q_there, v_there, vdot_there, frame))
    want = np.delete(want, np.s_[robot.nv : 6 + CAPACITY.nv], axis=1)
    f = functions(robot)
    for k in range(COUNT):
        got = f(q[k, 7:], v[k, :6], v[k, 6:], vdot[k, :6], vdot[k, 6:])
        got = np.concatenate([x.full().ravel() for x in got])
        assert np.abs(got - want[k]).max() < 1e-13 * (1 + np.abs(want[k]).max())  # measured at most 1.2e-15


def test_what_it_cannot_hold_is_refused():
    grounded = ROBOTS["planar3"].ground(ROBOTS["planar3"].base)
    with pytest.raises(ValueError, match="a free base"):
        symbolic.tree_of(sdyn.pack(grounded))
