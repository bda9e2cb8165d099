"""The same robot in other libraries: each builds its own model from a `Robot` and gives accelerations as `sdyn` does.

Speed is compared for robots of revolute joints with a free base; Pinocchio and MuJoCo take all kinds of joints, and a
grounded base too. A peer has

    name, package       what it is
    q, v, tau           the states that were handed in, in its own order and axes
    vdot(...)           its accelerations of these states [count, nv], in sdyn's order and axes

and what is timed, see `speed.py`. Importing this file imports none of the libraries.
"""

import importlib.metadata
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import sdyn
from sdyn.convert import rotations
from sdyn.parts import KINDS, triad
from sdyn.posture import link_poses


def version(package: str) -> str | None:
    """The version of an installed package, or None."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def merged(robot: sdyn.Robot) -> sdyn.Robot:
    """The robot with its locked joints gone and the links on both sides joined to one, as every peer gets it."""
    R, p = link_poses(robot, robot.neutral())
    tree, top = robot.tree, list(range(len(robot.links)))  # top: the first link of each link's body
    for i in tree.order[1:]:
        if robot.is_locked(robot.joints[tree.joint[i]]):
            top[i] = top[tree.parent[i]]
    links = []
    for t in sorted(set(top)):
        parts = [i for i in range(len(top)) if top[i] == t]
        mass = np.array([robot.links[i].mass for i in parts])
        com = np.array([R[t].T @ (p[i] + R[i] @ robot.links[i].com - p[t]) for i in parts])
        centre = mass @ com / max(mass.sum(), 1e-300)
        inertia = sum(
            R[t].T @ R[i] @ robot.links[i].inertia @ R[i].T @ R[t] + m * ((d @ d) * np.eye(3) - np.outer(d, d))
            for i, m, d in zip(parts, mass, com - centre, strict=True)
        )
        links.append(sdyn.Link(robot.links[t].name, mass.sum(), centre, (inertia + inertia.T) / 2))
    joints = []
    for joint in robot.moving:
        i = tree.joint.index(robot.joints.index(joint))
        up = top[tree.parent[i]]
        place = dict(rotation=R[up].T @ R[i], position=R[up].T @ (p[i] - p[up]))  # at zero, the child's own frame
        joints.append(replace(joint, parent=robot.links[up].name, **place))
    return sdyn.Robot(links, joints, base=robot.base, name=robot.name)


def states(robot: sdyn.Robot, count: int, seed: int = 0):
    """Random q, v, tau [count, ...]; no force on the base."""
    rng = np.random.default_rng(seed)
    q, v, tau = (rng.normal(size=(count, n)) for n in (robot.nq, robot.nv, robot.nv))
    q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    tau[:, :6] = 0.0
    return q, v, tau


def along(robot: sdyn.Robot):
    """Links of a merged robot from the base outwards: (link, joint to it or None)."""
    for i in robot.tree.order:
        yield robot.links[i], robot.joints[robot.tree.joint[i]] if robot.tree.joint[i] >= 0 else None


def quaternion(R) -> np.ndarray:
    """wxyz of a rotation matrix."""
    _, V = np.linalg.eigh(
        np.array([
            [R[0, 0] + R[1, 1] + R[2, 2], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
            [R[0, 2] - R[2, 0], R[0, 1] + R[1, 0], R[1, 1] - R[0, 0] - R[2, 2], R[1, 2] + R[2, 1]],
            [R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], R[2, 2] - R[0, 0] - R[1, 1]],
        ])
    )  # fmt: skip
    return V[:, -1]


class Pinocchio:
    """C++ (`pin`); joints by name in `continuous` are (cosine, sine) there."""

    name, package = "Pinocchio", "pin"

    def __init__(self, robot, q, v, tau, continuous=()):
        import pinocchio as pin

        self.pin, self.model = pin, pin.Model()
        self.model.gravity.setZero()
        at = {}  # of each link, the joint that it hangs from, and its pose there
        for link, joint in along(robot):
            if joint is None:  # the ground pose of a free base is the identity
                place = pin.SE3(*robot.ground_pose)
                free = 0 if robot.grounded else self.model.addJoint(0, pin.JointModelFreeFlyer(), place, "free")
                at[link.name] = free, place
            else:
                kind, turn = self.joint(joint, joint.name in continuous)
                parent, place = at[joint.parent]
                place = place * pin.SE3(joint.rotation, joint.position) * turn
                at[link.name] = self.model.addJoint(parent, kind, place, joint.name), turn.inverse()
            inertia = pin.Inertia(link.mass, link.com, link.inertia)
            self.model.appendBodyToJoint(at[link.name][0], inertia, at[link.name][1])
        self.data = self.model.createData()
        self.links = [at[link.name] for link in robot.links]
        self.convert = c = sdyn.convert.pinocchio(robot, self.model.names, self.model.nqs)
        self.q, self.v, self.tau = (np.ascontiguousarray(x) for x in (c.to_q(q), c.to_v(q, v), c.to_tau(q, tau)))

    def joint(self, joint, continuous):
        """Its model, and the turn to that model's own axes."""
        pin, axes = self.pin, [screw[:3] + screw[3:] for screw in joint.screws]
        which = np.flatnonzero(np.abs(joint.axis) > 1 - 1e-12)
        upright = len(which) == 1 and joint.axis[which[0]] > 0
        plain = (pin.JointModelRX, pin.JointModelRY, pin.JointModelRZ)
        turn = pin.SE3.Identity()
        if joint.kind == "planar" or continuous:  # which it has about z only
            turn = pin.SE3(np.column_stack([*triad(joint.axis), joint.axis]), np.zeros(3))
        if joint.kind == "revolute" and upright and not continuous:
            return plain[which[0]](), turn
        if joint.kind == "cylindrical":
            both = pin.JointModelComposite(pin.JointModelPrismaticUnaligned(joint.axis))
            both.addJoint(pin.JointModelRevoluteUnaligned(joint.axis))
            return both, turn
        made = {
            "revolute": lambda: pin.JointModelRUBZ() if continuous else pin.JointModelRevoluteUnaligned(joint.axis),
            "prismatic": lambda: pin.JointModelPrismaticUnaligned(joint.axis),
            "helical": lambda: pin.JointModelHelicalUnaligned(joint.axis, joint.pitch),
            "universal": lambda: pin.JointModelUniversal(*axes),
            "planar": pin.JointModelPlanar,
            "spherical": pin.JointModelSpherical,
        }
        return made[joint.kind](), turn

    def acceleration(self, k):
        """In its own axes, of one state."""
        return self.pin.aba(self.model, self.data, self.q[k], self.v[k], self.tau[k])

    def vdot(self):
        found = np.array([self.acceleration(k) for k in range(len(self.q))])
        return self.convert.from_vdot(self.q, self.v, found)

    def poses(self, k):
        """Rotations and positions of the links in the world."""
        self.pin.forwardKinematics(self.model, self.data, self.q[k])
        found = [self.data.oMi[j] * place for j, place in self.links]
        return np.array([x.rotation for x in found]), np.array([x.translation for x in found])

    def jacobians(self):
        """Derivatives [count, 3, nv, nv] by increments of q as sdyn's, by v and by tau; of revolute joints only."""
        out, at = np.empty((len(self.q), 3, *self.v.shape[1:] * 2)), self.convert.v_at
        for k, state in enumerate(zip(self.q, self.v, self.tau, strict=True)):
            for J, found in zip(out[k], self.pin.computeABADerivatives(self.model, self.data, *state), strict=True):
                J[np.ix_(at, at)] = found
        R = rotations(self.q[:, [6, 3, 4, 5]])  # pin moves the base in its own axes
        out[:, 0, :, 3:6] = out[:, 0, :, 3:6] @ R.swapaxes(1, 2)
        return out


class MuJoCo:
    """C (`mujoco`); nothing collides, no gravity, no constraint."""

    name, package = "MuJoCo", "mujoco"

    def __init__(self, robot, q, v, tau):
        import mujoco

        self.mujoco, spec = mujoco, mujoco.MjSpec()
        spec.option.gravity = np.zeros(3)
        spec.option.timestep = 1e-9
        off = mujoco.mjtDisableBit
        spec.option.disableflags = off.mjDSBL_CONTACT | off.mjDSBL_CONSTRAINT | off.mjDSBL_SENSOR
        bodies = {}
        for link, joint in along(robot):
            parent = spec.worldbody if joint is None else bodies[joint.parent]
            R, p = robot.ground_pose if joint is None else (joint.rotation, joint.position)
            body = bodies[link.name] = parent.add_body(name=link.name, pos=p, quat=quaternion(R))
            body.mass, body.ipos, body.explicitinertial = link.mass, link.com, True
            body.fullinertia = link.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
            if joint is None and not robot.grounded:
                body.add_freejoint()
            elif joint is not None:
                self.add(body, joint)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.links = [self.model.body(link.name).id for link in robot.links]
        names = [self.model.joint(k).name for k in range(self.model.njnt)]
        self.convert = c = sdyn.convert.mujoco(robot, names)
        self.q, self.v, self.tau = c.to_q(q), c.to_v(q, v), c.to_tau(q, tau)

    def add(self, body, joint):
        """One joint, or one for each of its coordinates."""
        kinds = self.mujoco.mjtJoint
        if joint.kind == "spherical":
            body.add_joint(name=joint.name, type=kinds.mjJNT_BALL)
            return
        for screw, suffix in zip(joint.screws, KINDS[joint.kind].rates, strict=True):
            kind = kinds.mjJNT_HINGE if screw[:3].any() else kinds.mjJNT_SLIDE
            body.add_joint(name=joint.name + suffix, type=kind, axis=screw[:3] + screw[3:])

    def set(self, k):
        self.data.qpos, self.data.qvel, self.data.qfrc_applied = self.q[k], self.v[k], self.tau[k]

    def vdot(self):
        out = np.empty_like(self.v)
        for k in range(len(out)):
            self.set(k)
            self.mujoco.mj_forward(self.model, self.data)
            out[k] = self.data.qacc
        return self.convert.from_vdot(self.q, self.v, out)

    def poses(self, k):
        """Rotations and positions of the links in the world."""
        self.set(k)
        self.mujoco.mj_kinematics(self.model, self.data)
        return self.data.xmat[self.links].reshape(-1, 3, 3), self.data.xpos[self.links]


class MJX(MuJoCo):
    """MuJoCo in JAX (`mujoco-mjx`), from the C model."""

    name, package = "MJX", "mujoco-mjx"

    def __init__(self, robot, q, v, tau):
        super().__init__(robot, q, v, tau)
        from mujoco import mjx

        self.mjx, self.model = mjx, mjx.put_model(self.model)
        self.blank = mjx.make_data(self.model)

    def accelerations(self, q, v, tau):
        """qacc of one state."""
        return self.mjx.forward(self.model, self.blank.replace(qpos=q, qvel=v, qfrc_applied=tau)).qacc

    def vdot(self):
        import jax

        found = np.asarray(jax.jit(jax.vmap(self.accelerations))(self.q, self.v, self.tau))
        return self.convert.from_vdot(self.q, self.v, found)


class JaxSim:
    """JAX (`jaxsim`), through an SDF file; velocities as MuJoCo's, but those of the base all in world axes."""

    name, package = "JaxSim", "jaxsim"

    def __init__(self, robot, q, v, tau):
        import jaxsim.api as js

        self.js = js
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.sdf"
            path.write_text(sdf(robot))
            self.model = js.model.JaxSimModel.build_from_model_description(path, gravity=0.0)
        self.convert = c = sdyn.convert.mujoco(robot, ["base", *self.model.joint_names()])
        self.R = rotations(q[:, 3:7])
        self.q, self.mixed, self.tau = c.to_q(q), c.to_v(q, v), c.to_tau(q, tau)[:, 6:]
        self.v = self.turned(self.mixed, "nij,nj->ni")

    def turned(self, x, rule):
        """The angular part to world axes, or back."""
        return np.concatenate([x[:, :3], np.einsum(rule, self.R, x[:, 3:6]), x[:, 6:]], 1)

    def accelerations(self, q, v, tau):
        """Base (linear, angular; world axes) and joints, of one state."""
        import jax.numpy as jnp

        data = self.js.data.JaxSimModelData.build(
            self.model, q[:3], q[3:7], q[7:], v[:3], v[3:6], v[6:], velocity_representation=self.js.common.VelRepr.Mixed
        )
        return jnp.concatenate(self.js.model.forward_dynamics_aba(self.model, data, joint_forces=tau))

    def vdot(self):
        import jax

        found = np.asarray(jax.jit(jax.vmap(self.accelerations))(self.q, self.v, self.tau))
        return self.convert.from_vdot(self.q, self.mixed, self.turned(found, "nji,nj->ni"))


def sdf(robot: sdyn.Robot) -> str:
    """An SDF file of a merged robot: JaxSim reads URDF only where Gazebo is installed.

    At zero all frames are parallel to the base's: angles lose half of the digits where the pitch is near 90 degrees.
    """
    R, p = link_poses(robot, robot.neutral())
    numbers = lambda x: " ".join(repr(float(y)) for y in x)
    at = {link.name: k for k, link in enumerate(robot.links)}
    out = [f'<sdf version="1.10"><model name="{robot.name}">']
    for link, joint in along(robot):
        k = at[link.name]
        I = R[k] @ link.inertia @ R[k].T
        tensor = "".join(
            f"<i{x}{y}>{float(I['xyz'.index(x), 'xyz'.index(y)])!r}</i{x}{y}>"
            for x, y in ("xx", "xy", "xz", "yy", "yz", "zz")
        )
        where = "" if joint is None else f'<pose relative_to="{joint.name}">0 0 0 0 0 0</pose>'
        out.append(
            f'<link name="{link.name}">{where}<inertial><pose>{numbers(R[k] @ link.com)} 0 0 0</pose>'
            f"<mass>{link.mass!r}</mass><inertia>{tensor}</inertia></inertial></link>"
        )
        if joint is not None:
            out.append(
                f'<joint name="{joint.name}" type="revolute">'
                f'<pose relative_to="{joint.parent}">{numbers(p[k] - p[at[joint.parent]])} 0 0 0</pose>'
                f"<parent>{joint.parent}</parent><child>{joint.child}</child>"
                f"<axis><xyz>{numbers(R[k] @ joint.axis)}</xyz></axis></joint>"
            )
    return "\n".join([*out, "</model></sdf>"])


ALL = (Pinocchio, MuJoCo, MJX, JaxSim)
