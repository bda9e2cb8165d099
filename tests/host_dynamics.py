"""The mass matrix of a robot by a plain program in NumPy, M = Σ Jᵀ I J over its links, away from the kernels."""

import numpy as np

from sdyn import doctor
from sdyn.posture import link_poses


def mass_matrix(robot, values=None) -> np.ndarray:
    """M [nv, nv] with the base at the identity and joints at `values`, by default without symmetry."""
    tree, values = robot.tree, doctor.crooked(robot) if values is None else values
    R, p = link_poses(robot, robot.configuration(values))
    index = {link.name: i for i, link in enumerate(robot.links)}
    J, columns = np.zeros((len(robot.links), 6, robot.nv)), {}
    at = 0 if robot.grounded else 6
    for joint in robot.moving:
        columns[joint.name] = slice(at, at := at + joint.dof)
    for i in tree.order:
        if tree.parent[i] < 0:
            J[i, :, :6] = np.eye(6) if not robot.grounded else 0
            continue
        joint = robot.joints[tree.joint[i]]
        J[i] = J[tree.parent[i]]
        if joint.name in columns:
            up = index[joint.parent]
            screws = doctor.screws_of(joint, values[joint.name], R[up], p[up]).T
            J[i][:, columns[joint.name]] += screws if tree.forward[i] else -screws
    M = sum(j.T @ doctor.spatial(link, R[i], p[i]) @ j for i, (link, j) in enumerate(zip(robot.links, J, strict=True)))
    rotors = [np.full(joint.dof, joint.rotor_inertia) for joint in robot.moving]
    return M + np.diag(np.concatenate([np.zeros(0 if robot.grounded else 6), *rotors]))
