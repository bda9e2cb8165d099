"""Small algebra, components first: `w[3, ...]`, `R[3, 3, ...]`, 6-vectors angular first `[w; v]`, `[n; f]`.

Sums over 3 and 6 are written out, so that every operation is an elementwise loop over the trailing axes.
"""

import jax.numpy as jnp

from sdyn.materialise import keep

cat = jnp.concatenate


def cross(a, b):
    """a x b."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def mv(M, x):
    """M x."""
    return sum(M[:, k] * x[k] for k in range(M.shape[1]))


def mtv(M, x):
    """Mᵀ x."""
    return sum(M[k] * x[k] for k in range(M.shape[0]))


def mm(A, B):
    """A B."""
    return sum(A[:, k, None] * B[k][None] for k in range(A.shape[1]))


def dot(a, b):
    """a · b."""
    return sum(a[k] * b[k] for k in range(a.shape[0]))


def transposed(M):
    """Mᵀ."""
    return jnp.swapaxes(M, 0, 1)


def hat(a):
    """The matrix of the cross product, hat(a) b = a x b."""
    o = jnp.zeros_like(a[0])
    return jnp.stack([jnp.stack([o, -a[2], a[1]]), jnp.stack([a[2], o, -a[0]]), jnp.stack([-a[1], a[0], o])])


def motion_cross(V, m):
    """V x m of motion vectors."""
    return cat([cross(V[:3], m[:3]), cross(V[:3], m[3:]) + cross(V[3:], m[:3])])


def force_cross(V, f):
    """V x* f of a motion and a force vector."""
    return cat([cross(V[:3], f[:3]) + cross(V[3:], f[3:]), cross(V[:3], f[3:])])


def eye3(like):
    """The identity [3, 3, 1, ...] that broadcasts against the trailing axes of `like [k, ...]`."""
    return jnp.eye(3, dtype=like.dtype).reshape(3, 3, *(1,) * (like.ndim - 1))


def rigid_inertia(R, p, m, c, I):
    """Inertia of a body about the common origin: (m, h = m x, Io), with its centre at x = p + R c."""
    x = p + mv(R, c)
    RI = keep(mm(R, I))
    turned = sum(RI[:, k, None] * R[None, :, k] for k in range(3))
    return m, m * x, turned + m * (dot(x, x) * eye3(x) - x[:, None] * x[None])


def inertia_times(m, h, Io, V):
    """Spatial inertia times motion: [Io w + h x v; m v - h x w]."""
    return cat([mv(Io, V[:3]) + cross(h, V[3:]), m * V[3:] - cross(h, V[:3])])


PACKED = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
"""Where the entries of a symmetric 3 x 3 matrix are among the six of its upper triangle."""


def blocks_of(m, h, Io):
    """Spatial inertia as A [6, ...], H [9, ...], M [6, ...] of [[A, H], [Hᵀ, M]], A and M packed."""
    o = jnp.zeros_like(h[:1])
    m = m + o
    return cat([Io[0], Io[1, 1:], Io[2, 2:]]), hat(h).reshape(9, *h.shape[1:]), cat([m, o, o, m, o, m])


def blocks_times(A, H, M, V):
    """[[A, H], [Hᵀ, M]] V."""
    w, v, H = V[:3], V[3:], H.reshape(3, 3, *H.shape[1:])
    return cat([packed_times(A, w) + mv(H, v), mtv(H, w) + packed_times(M, v)])


def packed_times(X, x):
    """X x of a packed symmetric matrix."""
    return jnp.stack([X[i] * x[0] + X[j] * x[1] + X[k] * x[2] for i, j, k in PACKED])


def blocks_outer(a, b):
    """The blocks of a bᵀ, where that is symmetric."""
    packed = lambda a, b: keep(cat([a[0] * b, a[1] * b[1:], a[2] * b[2:]]))
    H = a[:3, None] * b[None, 3:]
    return packed(a[:3], b[:3]), H.reshape(9, *a.shape[1:]), packed(a[3:], b[3:])


def to_child(R, p, V):
    """A motion vector in the frame of a child, which stands at (R, p) in the vector's own."""
    w, v = V[:3], V[3:]
    return cat([mtv(R, w), mtv(R, keep(v + cross(w, p)))])


def to_parent(R, p, f):
    """A force vector of that child in the frame of its parent."""
    linear = keep(mv(R, f[3:]))
    return cat([mv(R, f[:3]) + cross(p, linear), linear])


def blocks_to_parent(R, p, A, H, M):
    """An inertia of that child in the frame of its parent: turned, then about the parent's origin."""
    square = lambda X: jnp.stack([jnp.stack([X[k] for k in row]) for row in PACKED])
    turned = lambda X: keep(mm(keep(mm(R, X)), transposed(R)))
    packed = lambda X: cat([X[0], X[1, 1:], X[2, 2:]])
    A, H, M = (turned(X) for X in (square(A), H.reshape(3, 3, *H.shape[1:]), square(M)))
    P = hat(p)
    moved = keep(H + mm(P, M))
    A = A - mm(moved, P) + mm(P, transposed(H))
    return packed(A), moved.reshape(9, *moved.shape[2:]), packed(M)


def solve6(A, H, M, b):
    """x of [[A, H], [Hᵀ, M]] x = b, positive definite, by an unrolled L D Lᵀ."""

    def K(i, j):  # of the lower triangle, i >= j
        packed = lambda X, i, j: X[PACKED[i][j]]
        return packed(A, i, j) if i < 3 else H[3 * j + i - 3] if j < 3 else packed(M, i - 3, j - 3)

    L, E = {}, {}  # E = L D
    Di, y, x = {}, {}, {}
    for j in range(6):
        Di[j] = 1 / (K(j, j) - sum((L[j, k] * E[j, k] for k in range(j)), 0.0))
        for i in range(j + 1, 6):
            E[i, j] = keep(K(i, j) - sum((E[i, k] * L[j, k] for k in range(j)), 0.0))
            L[i, j] = keep(E[i, j] * Di[j])
    for i in range(6):
        y[i] = keep(b[i] - sum((L[i, k] * y[k] for k in range(i)), 0.0))
    for i in reversed(range(6)):
        x[i] = keep(y[i] * Di[i] - sum((L[k, i] * x[k] for k in range(i + 1, 6)), 0.0))
    return jnp.stack([x[i] for i in range(6)])
