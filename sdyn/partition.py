"""The paper's equation (5): closed chains in independent coordinates, φ_D' = −J_D⁻¹ J_G φ_G'.

With Π the map from the independent rates to all, M_c = Πᵀ M Π, and the dependent ones follow. Which coordinates depend,
and which rows of K say so, is picked by pivoted QR and passed as data; it stays good while J_D is far from singular.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sdyn.chain import Chain
from sdyn.closures import loop_jacobian
from sdyn.dynamics import mass_matrix
from sdyn.inputs import expect

TOLERANCE = 1e-9  # of a pivot against the largest


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Partition:
    """Pairs of a dependent coordinate and a row of K; both numbers are one too large where there is no pair."""

    columns: Int[Array, " nc"]
    """Numbers of the dependent entries of v."""
    rows: Int[Array, " nc"]
    """Numbers of the independent rows of K."""


def partition(chain: Chain, q: Float[Array, " nq"]) -> Partition:
    """Picks dependent coordinates and independent rows at a configuration, to be used near it.

    Columns are scaled by the inertia that they move and rows to length one; the largest pivots come first.

    Args:
        chain: Packed structure.
        q: Configuration, closed [m, rad, unit quaternion wxyz].

    Source:
        formulas.md, "Loops"; the paper, equations (2) to (5).
    """
    (q,) = expect(chain, q=q)
    K = _scaled(chain, q, loop_jacobian(chain, q))
    nc, nv = K.shape
    _, R, columns = jax.scipy.linalg.qr(K, mode="economic", pivoting=True)
    pivots = jnp.abs(jnp.diagonal(R))
    count = (pivots > TOLERANCE * pivots.max(initial=0.0)).sum()
    place = jnp.arange(nc)
    columns = jnp.where(place < count, jnp.resize(columns, nc), nv)
    chosen = jnp.zeros(nv, K.dtype).at[columns].set(1.0, mode="drop")
    rows = jax.scipy.linalg.qr((K * chosen).T, mode="economic", pivoting=True)[2]
    return Partition(columns.astype(jnp.int32), jnp.where(place < count, rows, nc).astype(jnp.int32))


def solve(chain: Chain, q, pairs: Partition, c, d):
    """x, y of M x − Kᵀ y = c, K x = d, y the shortest."""
    K, M = loop_jacobian(chain, q), mass_matrix(chain, q)
    P, E, J, live = _blocks(K, pairs)
    independent = 1 - E.sum(1)
    Pi = jnp.diag(independent) - E @ jnp.linalg.solve(J, P @ K) * independent
    x_D = E @ jnp.linalg.solve(J, P @ d)
    empty = jnp.diagonal(M) == 0
    M_c = Pi.T @ M @ Pi + jnp.diag(jnp.where(empty | (independent == 0), 1.0, 0.0))
    x = Pi @ jax.scipy.linalg.solve(M_c, Pi.T @ (c - M @ x_D), assume_a="pos") + x_D
    y = jnp.linalg.solve(J.T, E.T @ (M @ x - c)) * live
    Z = _all_rows(K, E, J, live)
    return x, Z @ _of_square(Z, live, y)


def unseen(chain: Chain, q, pairs: Partition, t):
    """The part of t [nc] that Kᵀ maps to zero."""
    K = loop_jacobian(chain, q)
    _, E, J, live = _blocks(K, pairs)
    Z = _all_rows(K, E, J, live)
    return t - Z @ _of_square(Z, live, Z.T @ t)


def _blocks(K, pairs):
    """Which rows P [nc, nc] and columns E [nv, nc] were picked, J = P K E, and which pairs there are."""
    nc, nv = K.shape
    live = pairs.rows < nc
    E = (jnp.arange(nv)[:, None] == pairs.columns).astype(K.dtype)
    P = (pairs.rows[:, None] == jnp.arange(nc)).astype(K.dtype)
    return P, E, P @ K @ E + jnp.diag(1.0 - live), live


def _all_rows(K, E, J, live):
    """Z of K = Z (P K): all rows, from the independent ones."""
    return jnp.linalg.solve(J.T, (K @ E).T).T * live


def _of_square(Z, live, t):
    """(ZᵀZ)⁻¹ t."""
    return jnp.linalg.solve(Z.T @ Z + jnp.diag(1.0 - live), t)


def condition(chain: Chain, q, pairs: Partition):
    """Condition number of J_D, scaled as when it was picked: past 1e6, pick anew."""
    K = _scaled(chain, q, loop_jacobian(chain, q))
    nc = len(K)
    J = K[jnp.minimum(pairs.rows, nc - 1)][:, jnp.minimum(pairs.columns, K.shape[1] - 1)]
    live = pairs.rows < nc
    sigma = jnp.linalg.svd(jnp.where(live[:, None] & live, J, 0), compute_uv=False)
    return jnp.where(live.any(), sigma[0] / sigma[jnp.maximum(live.sum() - 1, 0)], 1.0)


def _scaled(chain, q, K):
    """K with columns in units of inertia and rows of length one."""
    m = jnp.diagonal(mass_matrix(chain, q))
    K = K / jnp.sqrt(jnp.where(m > 0, m, 1.0))
    length = jnp.sqrt((K * K).sum(1))
    noise = 64 * jnp.finfo(K.dtype).eps * length.max(initial=0.0)
    return jnp.where((length > noise)[:, None], K / jnp.where(length > noise, length, 1.0)[:, None], 0.0)
