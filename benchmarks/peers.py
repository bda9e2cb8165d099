"""The same robot in other libraries: each builds its own model from a `Robot` and gives accelerations as `sdyn` does.

Robots of revolute joints with a free base, as those that are compared here. A peer has

    name, version       what it is
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


def rotations(quats) -> np.ndarray:
    """Rotation matrices of quaternions wxyz [..., 4]."""
    w, x, y, z = np.moveaxis(quats, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def from_world_base(q, v, spin, linear):
    """[w', v'] in base axes, plain derivatives of components, from the base's accelerations: `spin` in base axes,
    and the classical one of its origin, `linear`, in world axes."""
    R = rotations(q[:, 3:7])
    return np.concatenate([spin, np.einsum("nji,nj->ni", R, linear) - np.cross(v[:, :3], v[:, 3:6])], 1)


class Pinocchio:
    """C++ (`pin`): free flyer, linear part first, quaternion xyzw."""

    name, package = "Pinocchio", "pin"

    def __init__(self, robot, q, v, tau):
        import pinocchio as pin

        self.pin, self.model = pin, pin.Model()
        self.model.gravity.setZero()
        at = {}
        for link, joint in along(robot):
            if joint is None:
                kind, place, parent = pin.JointModelFreeFlyer(), pin.SE3.Identity(), 0
            else:
                which = np.flatnonzero(np.abs(joint.axis) > 1 - 1e-12)
                plain = (pin.JointModelRX, pin.JointModelRY, pin.JointModelRZ)
                upright = len(which) == 1 and joint.axis[which[0]] > 0
                kind = plain[which[0]]() if upright else pin.JointModelRevoluteUnaligned(joint.axis)
                place, parent = pin.SE3(joint.rotation, joint.position), at[joint.parent]
            name = "free" if joint is None else joint.name
            at[link.name] = self.model.addJoint(parent, kind, place, name)
            inertia = pin.Inertia(link.mass, link.com, link.inertia)
            self.model.appendBodyToJoint(at[link.name], inertia, pin.SE3.Identity())
        self.data = self.model.createData()
        order = [self.model.idx_vs[self.model.getJointId(joint.name)] - 6 for joint in robot.joints]
        self.to_pin = np.argsort(order)
        self.v_at = np.r_[3:6, 0:3, 6 + self.to_pin]  # where each entry of pin's v is in ours
        self.q = np.ascontiguousarray(q[:, np.r_[0:3, 4:7, 3, 7 + self.to_pin]])
        self.v, self.tau = (np.ascontiguousarray(x[:, self.v_at]) for x in (v, tau))

    def vdot(self):
        out = np.empty_like(self.v)
        for k, state in enumerate(zip(self.q, self.v, self.tau, strict=True)):
            out[k, self.v_at] = self.pin.aba(self.model, self.data, *state)
        return out

    def jacobians(self):
        """Derivatives [count, 3, nv, nv] by increments of q as sdyn's, by v and by tau."""
        out = np.empty((len(self.q), 3, *self.v.shape[1:] * 2))
        for k, state in enumerate(zip(self.q, self.v, self.tau, strict=True)):
            for J, found in zip(out[k], self.pin.computeABADerivatives(self.model, self.data, *state), strict=True):
                J[np.ix_(self.v_at, self.v_at)] = found
        R = rotations(self.q[:, [6, 3, 4, 5]])  # pin moves the base in its own axes
        out[:, 0, :, 3:6] = out[:, 0, :, 3:6] @ R.swapaxes(1, 2)
        return out


class MuJoCo:
    """C (`mujoco`): free joint, linear part in world axes; nothing collides, no gravity, no constraint."""

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
            place = {} if joint is None else dict(pos=joint.position, quat=quaternion(joint.rotation))
            body = bodies[link.name] = parent.add_body(name=link.name, **place)
            body.mass, body.ipos, body.explicitinertial = link.mass, link.com, True
            body.fullinertia = link.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
            if joint is None:
                body.add_freejoint()
            else:
                body.add_joint(name=joint.name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=joint.axis)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.order = np.array([self.model.joint(joint.name).dofadr[0] - 6 for joint in robot.joints])
        back = np.argsort(self.order)
        self.ours = q, v
        linear = np.einsum("nij,nj->ni", rotations(q[:, 3:7]), v[:, 3:6])
        self.q = np.concatenate([q[:, :7], q[:, 7:][:, back]], 1)
        self.v = np.concatenate([linear, v[:, :3], v[:, 6:][:, back]], 1)
        self.tau = np.concatenate([0 * v[:, :6], tau[:, 6:][:, back]], 1)

    def set(self, k):
        self.data.qpos, self.data.qvel, self.data.qfrc_applied = self.q[k], self.v[k], self.tau[k]

    def vdot(self):
        out = np.empty_like(self.v)
        for k in range(len(out)):
            self.set(k)
            self.mujoco.mj_forward(self.model, self.data)
            out[k] = self.data.qacc
        return self.as_ours(out)

    def as_ours(self, qacc):
        q, v = self.ours
        return np.concatenate([from_world_base(q, v, qacc[:, 3:6], qacc[:, :3]), qacc[:, 6:][:, self.order]], 1)


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

        return self.as_ours(np.asarray(jax.jit(jax.vmap(self.accelerations))(self.q, self.v, self.tau)))


class JaxSim:
    """JAX (`jaxsim`), through an SDF file; velocities of the base in mixed representation (its origin, world axes)."""

    name, package = "JaxSim", "jaxsim"

    def __init__(self, robot, q, v, tau):
        import jaxsim.api as js

        self.js = js
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.sdf"
            path.write_text(sdf(robot))
            self.model = js.model.JaxSimModel.build_from_model_description(path, gravity=0.0)
        names = [joint.name for joint in robot.joints]
        mine = [names.index(name) for name in self.model.joint_names()]
        self.order, self.ours = np.argsort(mine), (q, v)
        R = rotations(q[:, 3:7])
        turn = lambda x: np.einsum("nij,nj->ni", R, x)
        self.q = np.concatenate([q[:, :7], q[:, 7:][:, mine]], 1)
        self.v = np.concatenate([turn(v[:, 3:6]), turn(v[:, :3]), v[:, 6:][:, mine]], 1)
        self.tau = tau[:, 6:][:, mine]

    def accelerations(self, q, v, tau):
        """Base (linear, angular; world axes) and joints, of one state."""
        import jax.numpy as jnp

        data = self.js.data.JaxSimModelData.build(
            self.model, q[:3], q[3:7], q[7:], v[:3], v[3:6], v[6:], velocity_representation=self.js.common.VelRepr.Mixed
        )
        return jnp.concatenate(self.js.model.forward_dynamics_aba(self.model, data, joint_forces=tau))

    def vdot(self):
        import jax

        a = np.asarray(jax.jit(jax.vmap(self.accelerations))(self.q, self.v, self.tau))
        q, v = self.ours
        spin = np.einsum("nji,nj->ni", rotations(q[:, 3:7]), a[:, 3:6])
        return np.concatenate([from_world_base(q, v, spin, a[:, :3]), a[:, 6:][:, self.order]], 1)


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
