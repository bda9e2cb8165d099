"""The Delassus matrix G = K M⁻¹ Kᵀ of a closed chain: how much the closures give way to the multipliers."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sdyn.chain import Chain
from sdyn.closures import closure_parts
from sdyn.dynamics import solve_mass
from sdyn.semidefinite import shortest


class Delassus(NamedTuple):
    """What the closures and the mass matrix make of each other at a configuration."""

    K: Float[Array, "nc nv"]
    Y: Float[Array, "nv nc"]
    """M⁻¹ Kᵀ."""
    G: Float[Array, "nc nc"]
    share: Float[Array, " nc"]
    """Length of each row of K, of that of the twists that it picks a component of."""
    dead: Float[Array, " nc"]
    """1 where a row is zero but for rounding."""
    tolerance: Float[Array, " nc"]
    """Pivot below which a row depends on others."""

    def multipliers(self, b, dead=0.0):
        """lam of G lam = b, the shortest; rows that are `dead` are left out."""
        return shortest(self.G, jnp.maximum(self.dead, dead), self.tolerance, b)


def delassus(chain: Chain, q) -> Delassus:
    """The Delassus matrix, and what is needed beside it."""
    K, size, residual = closure_parts(chain, q)
    Y = jax.vmap(lambda row: solve_mass(chain, q, row), out_axes=1)(K)
    return Delassus(K, Y, K @ Y, *_judged(*jax.lax.stop_gradient((K, size, residual))))


def solve(chain: Chain, q, c, d):
    """x, y of M x − Kᵀ y = c, K x = d."""
    system = delassus(chain, q)
    x = solve_mass(chain, q, c)
    y = system.multipliers(d - system.K @ x)
    return x + system.Y @ y, y


def _judged(K, size, residual):
    """The share of each row, which are zero, and the squared sine below which a row depends on others.

    A row is off by rounding, and by as much as the closures are open: where rows are redundant on the closed chain,
    that makes them look independent.
    """
    n, eps = len(K), jnp.finfo(K.dtype).eps
    safe = jnp.sqrt(jnp.where(size > 0, size, 1.0))
    share = jnp.where(size > 0, jnp.sqrt((K * K).sum(1)) / safe, 0.0)
    drift = jnp.max(jnp.where(size > 0, jnp.abs(residual) / safe, 0.0), initial=0.0)
    off = jnp.maximum(64 * eps, jnp.minimum(10 * drift, 3e-5))
    dead = share <= off
    tolerance = jnp.maximum(64 * n * eps, (off / jnp.where(dead, 1.0, share)) ** 2)
    return share, dead.astype(K.dtype), tolerance
