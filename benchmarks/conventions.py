"""Do the converters of `sdyn.convert` speak as Pinocchio and MuJoCo do? Every kind of joint, free and grounded.

States are converted there. The peer's poses of all links must be ours; so must its accelerations under gravity and the
torques of its inverse dynamics, converted back. Results: results/conventions.json; exits with 1 on a difference.
"""

import sys

import harness

harness.one_thread()

import jax  # noqa: E402
import numpy as np  # noqa: E402
import peers  # noqa: E402

import sdyn  # noqa: E402
from sdyn.posture import link_poses  # noqa: E402

KINDS = ("cylindrical", "universal", "planar", "spherical", "revolute", "prismatic", "revolute", "helical")
PARENTS, CONTINUOUS = (0, 1, 2, 3, 4, 1, 0, 6), ("joint_4",)
COUNT, GRAVITY, AGREE = 6, np.array([0.3, -1.0, -9.0]), 1e-11


def robot(kinds, grounded: bool) -> sdyn.Robot:
    """A tree with random placements; its joints are declared in another order than the peers have them."""
    rng = np.random.default_rng(3)
    unit = lambda n: (lambda x: x / np.linalg.norm(x))(rng.normal(size=n))
    turn = lambda: peers.rotations(unit(4))
    links = []
    for k in range(len(kinds) + 1):
        A = rng.uniform(-0.3, 0.3, (3, 3)) + 0.2 * np.eye(3)
        inertia = np.trace(A @ A.T) * np.eye(3) - A @ A.T
        links.append(sdyn.Link(f"link_{k}", 2.0, rng.uniform(-0.2, 0.2, 3), inertia))
    joints = [
        sdyn.Joint(
            f"joint_{k}", kind, f"link_{PARENTS[k]}", f"link_{k + 1}", turn(), rng.uniform(-0.4, 0.4, 3), unit(3),
            pitch=0.3 if kind == "helical" else 0.0,
        )
        for k, kind in enumerate(kinds)
    ]  # fmt: skip
    made = sdyn.Robot(links, joints[::-1])
    return made.ground("link_0", (turn(), rng.normal(size=3))) if grounded else made


def states(robot):
    """Random q, v, tau [COUNT, ...]."""
    rng = np.random.default_rng(0)
    q, v, tau = (rng.normal(size=(COUNT, n)) for n in (robot.nq, robot.nv, robot.nv))
    for k, name in enumerate(robot.q_names):
        if name.endswith("qw"):
            q[:, k : k + 4] /= np.linalg.norm(q[:, k : k + 4], axis=1, keepdims=True)
    return q, v, tau


def pinocchio(*state):
    """The peer, and its inverse dynamics of state k at its accelerations."""
    peer = peers.Pinocchio(*state, continuous=CONTINUOUS)
    peer.model.gravity.linear = GRAVITY
    return peer, lambda k, a: peer.pin.rnea(peer.model, peer.data, peer.q[k], peer.v[k], a)


def mujoco(*state):
    """The same."""
    peer = peers.MuJoCo(*state)
    peer.model.opt.gravity = GRAVITY

    def torques(k, a):
        peer.set(k)
        peer.data.qacc = a
        peer.mujoco.mj_inverse(peer.model, peer.data)
        return peer.data.qfrc_inverse.copy()

    return peer, torques


def differences(robot, make) -> dict[str, float]:
    """From ours, relative to the largest entry of ours."""
    q, v, tau = states(robot)
    chain = sdyn.pack(robot)
    ours = np.asarray(jax.jit(jax.vmap(lambda *x: sdyn.forward_dynamics(chain, *x, gravity=GRAVITY)))(q, v, tau))
    peer, torques = make(robot, q, v, tau)
    to = peer.convert
    theirs = np.array([torques(k, a) for k, a in enumerate(to.to_vdot(q, v, ours))])
    off = lambda a, b: float(np.abs(a - b).max() / np.abs(b).max())
    poses = [zip(peer.poses(k), link_poses(robot, q[k]), strict=True) for k in range(COUNT)]
    return {
        "accelerations": off(peer.vdot(), ours),
        "torques": off(to.from_tau(peer.q, theirs), tau),
        "rotations and positions": max(off(a, b) for pair in poses for a, b in pair),
    }


def main():
    """Compare, save, and say so."""
    result, kinds = harness.machine("pin", "mujoco"), {"Pinocchio": (pinocchio, KINDS), "MuJoCo": (mujoco, KINDS[:-1])}
    for name, (make, joints) in kinds.items():
        for base, grounded in (("free", False), ("grounded", True)):
            result[f"{name}, {base}"] = found = differences(robot(joints, grounded), make)
            print(f"{name}, {base}:", ", ".join(f"{what} differ by {x:.1e}" for what, x in found.items()))
            if not max(found.values()) < AGREE:
                sys.exit(f"{name}: conventions differ")
    harness.save("conventions", result)


if __name__ == "__main__":
    main()
