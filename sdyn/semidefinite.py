"""The shortest solution of G x = b for a small symmetric matrix G that is positive definite or singular.

G is scaled to a unit diagonal and swept (Gauss-Jordan), where it matters in the order of its largest pivots. A row
whose pivot is below the tolerance depends on the rows before it: it is left out, never regularised. With P the swept
rows, D the others and X = G_PP⁻¹ G_PD, the columns of N = [−X; 1] span the null space, and with
Q = 1 − N (Nᵀ W N)⁻¹ Nᵀ W,
    S = Q [G_PP⁻¹, 0; 0, 0] Qᵀ
gives the solution with the least xᵀ W x, W undoing the scale. Proximal iterations on G + μ tend to it as μ goes to
zero; as they do, it is improved by x += S (b − G x), a fixed number of times.

Source: Carpentier, Budhiraja, Mansard, Proximal and sparse resolution of constrained dynamic equations (2021); the
sweep operator: Goodnight (1979).
"""

import jax.numpy as jnp
from jax import lax

from sdyn.batching import Kernel
from sdyn.materialise import keep

CLEAR = 1e-4  # a pivot above which rows are independent in any order; below, the largest one comes first
STEPS = 2  # of x += S (b − G x), the first from zero; a third changes nothing on any mechanism of the tests


def scaled(G, dead):
    """G with a unit diagonal, and the scale of its rows; dead rows become those of the identity."""
    n, diagonal = G.shape[0], _diagonal(G)
    live = (dead == 0) & (diagonal > 0)
    d = jnp.where(live, 1 / jnp.sqrt(jnp.where(live, diagonal, 1.0)), 0.0)
    return G * d[:, None] * d[None] + jnp.eye(n, dtype=G.dtype)[..., None] * (1 - live), d


def swept(A, tolerance):
    """A after sweeping its rows, the largest pivot first, and which rows were swept [n, B].

    On the swept rows P and the others D, it holds [[−A_PP⁻¹, A_PP⁻¹ A_PD], [its transpose, 0]].
    """
    n = A.shape[0]
    numbers = jnp.arange(n)[:, None]

    def step(_, carry):
        A, left, done = carry
        diagonal = jnp.where(left, _diagonal(A), -1.0)
        e = numbers == jnp.argmax(diagonal, 0)
        pivot = jnp.where(e, diagonal, 0).sum(0)
        take = e & (pivot > tolerance)
        x = jnp.where(e[None], A, 0).sum(1) - e
        pivot = jnp.where(take.any(0), pivot, 1.0)
        change = x[:, None] * x[None] / pivot + 2 * (e[:, None] & e[None])
        return A - jnp.where(take.any(0), change, 0), left & ~e, done | take

    start = A, jnp.ones(A.shape[1:], bool), jnp.zeros(A.shape[1:], bool)
    A, _, done = lax.fori_loop(0, n, step, start)
    return A, done


def swept_in_order(A):
    """The same, the rows in their order, all of them; and the least pivot [B]."""
    n = A.shape[0]
    eye = jnp.eye(n, dtype=A.dtype)[..., None]

    def step(k, carry):
        A, least = carry
        row, e = lax.dynamic_index_in_dim(A, k, 0, False), lax.dynamic_index_in_dim(eye, k, 0, False)
        pivot = lax.dynamic_index_in_dim(row, k, 0, False)
        x = keep((row - e) / pivot)
        change = x[:, None] * (row - e)[None] + 2 * e[:, None] * e[None]
        return A - change, jnp.minimum(least, pivot)

    return lax.fori_loop(0, n, step, (A, jnp.ones_like(A[0, 0])))


def inverse(A, weight, tolerance):
    """S, which solves A x = b with the least sum of weight x², and the independent rows [n, B]."""
    n = A.shape[0]
    eye = jnp.eye(n, dtype=A.dtype)[..., None]

    def in_order(_):
        return -direct, jnp.ones(A.shape[1:], bool)

    def by_pivots(_):
        B, rows = swept(A, tolerance)
        own = jnp.where(rows[:, None] & rows[None], -B, 0)
        return lax.cond(rows.all(), lambda _: own, restored, (B, own, rows)), rows

    def restored(found):
        B, own, rows = found
        N = jnp.where(~rows[None], eye - jnp.where(rows[:, None], B, 0), 0)
        square = product(jnp.swapaxes(N, 0, 1), weight[:, None] * N)
        inner, _ = swept(jnp.where(~rows[:, None] & ~rows[None], square, eye), jnp.zeros_like(tolerance))
        Q = eye - product(product(N, -inner), jnp.swapaxes(N, 0, 1) * weight[None])
        return product(product(Q, own), jnp.swapaxes(Q, 0, 1))

    direct, least = swept_in_order(A)
    good = least > jnp.maximum(CLEAR, tolerance.max(0))
    return lax.cond(good.all(), in_order, by_pivots, None)


def pseudo_inverse(G, dead, tolerance):
    """The S that gives the shortest solution, of G as it is [n, n, B]."""
    A, d = scaled(G, dead)
    return inverse(A, d * d, tolerance)[0] * d[:, None] * d[None]


def improved(G, S, b):
    """x of G x = b [n, m, B] by S, which is a bit off."""
    x = product(S, b)
    for _ in range(STEPS - 1):
        x = x + product(S, b - product(G, x))
    return x


def _solve(G, dead, tolerance, b):
    """x [n, m, B] for the columns of b [n, m, B]."""
    return (improved(G, pseudo_inverse(G, dead, tolerance), b),)


def _rank(G, dead, tolerance):
    A, d = scaled(G, dead)
    return ((swept(A, tolerance)[1] & (d > 0)).astype(G.dtype),)


def _diagonal(A):
    return jnp.stack([A[i, i] for i in range(A.shape[0])])


def product(A, B):
    """A B of matrices (n, n, B)."""
    return (A[:, :, None] * B[None]).sum(1)


# ---- derivatives -----------------------------------------------------------------------------------------------------


def _tangent(operands, tangents):
    """x, and dx = S (db − dG x) + (1 − S G) dG S x + S S dG (b − G x): the second term turns x with the null space, the
    third what is seen of a b that no x reaches."""
    G, dead, tolerance, b = operands
    dG, _, _, db = tangents
    again = lambda b: solve(G, dead, tolerance, b)[0]
    x = again(b)
    if dG is None:
        return (x,), (again(jnp.zeros_like(b) if db is None else db),)
    dx = again((0 if db is None else db) - product(dG, x))
    turn = product(dG, again(x))
    reached = again(again(product(dG, (b - product(G, x)) * (1 - dead)[:, None])))
    return (x,), (dx + turn - again(product(G, turn)) + reached,)


def _constant(operands, tangents):
    (found,) = rank(*operands)
    return (found,), (jnp.zeros_like(found),)


def _transpose(operands, cotangents):
    return solve(*operands[:3], cotangents[0])


solve = Kernel(_solve, rule=_tangent, linear=(3,), transpose=_transpose)
rank = Kernel(_rank, rule=_constant)


def shortest(G, dead, tolerance, b):
    """x [n] of G x = b, for one sample.

    Args:
        G: [n, n], symmetric.
        dead: 1 for rows to leave out [n].
        tolerance: Pivot of the scaled matrix below which a row depends on others [n].
        b: [n].
    """
    dead, tolerance = lax.stop_gradient((dead, tolerance))
    return solve(G[..., None], dead[:, None], tolerance[:, None], b[:, None, None])[0][:, 0, 0]


def spectrum(G, dead, tolerance, scale):
    """Number of independent rows, and the eigenvalues of G with the diagonal scale², ascending; zero for dead rows."""
    (independent,) = rank(G[..., None], dead[:, None], tolerance[:, None])
    A, d = scaled(G[..., None], dead[:, None])
    scale = jnp.where(d[:, 0] > 0, scale, 0.0)
    return independent.sum().astype(int), jnp.linalg.eigvalsh(A[..., 0] * scale * scale[:, None])
