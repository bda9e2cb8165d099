"""Unit quaternions `wxyz` (body to world) and rotation vectors; finite at zero, in value and derivatives."""

import jax.numpy as jnp

from sdyn.spatial import cross


def matrix(quat):
    """Rotation matrix [3, 3, ...] of a quaternion [4, ...], which is normalised on the way."""
    w, x, y, z = quat
    s = 2 / (w * w + x * x + y * y + z * z)
    rows = [
        [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
        [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)],
        [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


def product(a, b):
    """Quaternion product a o b."""
    real = a[0] * b[0] - (a[1:] * b[1:]).sum(0)
    return jnp.concatenate([real[None], a[0] * b[1:] + b[0] * a[1:] + cross(a[1:], b[1:])])


def conjugate(quat):
    """The inverse of a unit quaternion."""
    return jnp.concatenate([quat[:1], -quat[1:]])


def normalised(quat):
    """quat / |quat|."""
    return quat / jnp.sqrt((quat * quat).sum(0))


def exp(theta):
    """Unit quaternion of a rotation vector [3]: [cos(t/2); sin(t/2)/t theta]."""
    t2 = (theta * theta).sum(0)
    small = t2 < 1e-3
    t = jnp.sqrt(jnp.where(small, 1.0, t2))
    series = lambda *c: sum(x * t2**k for k, x in enumerate(c))
    c = jnp.where(small, series(1.0, -1 / 8, 1 / 384, -1 / 46080, 1 / 10321920), jnp.cos(t / 2))
    s = jnp.where(small, series(1 / 2, -1 / 48, 1 / 3840, -1 / 645120, 1 / 185794560), jnp.sin(t / 2) / t)
    return jnp.concatenate([c[None], s * theta])


def from_matrix(R):
    """Unit quaternion of a rotation matrix [3, 3], w >= 0; by the largest of its four squares, so never near 0/0."""
    t = jnp.stack([
        1 + R[0, 0] + R[1, 1] + R[2, 2], 1 + R[0, 0] - R[1, 1] - R[2, 2],
        1 - R[0, 0] + R[1, 1] - R[2, 2], 1 - R[0, 0] - R[1, 1] + R[2, 2],
    ])  # fmt: skip
    a, b, c = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    d, e, f = R[1, 0] + R[0, 1], R[0, 2] + R[2, 0], R[2, 1] + R[1, 2]
    rows = jnp.stack([
        jnp.stack([t[0], a, b, c]), jnp.stack([a, t[1], d, e]), jnp.stack([b, d, t[2], f]), jnp.stack([c, e, f, t[3]]),
    ])  # fmt: skip
    quat = jnp.take(rows, jnp.argmax(t), axis=0)
    quat = quat / jnp.sqrt((quat * quat).sum())
    return jnp.where(quat[0] < 0, -quat, quat)
