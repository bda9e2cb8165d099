"""How many digits the accelerations of a structure can have, from the mass matrix alone.

M is scaled to a unit diagonal, S = D^-1/2 M D^-1/2, so that light tips and mixed units cost nothing; its condition
number κ counts what is left: heavy bodies far from the base, long chains, joints that almost do the same. The error of
M⁻¹ b is below about eps κ; that of the articulated-body algorithm was 200 times smaller on chains of mass ratios to
1e8. So eps κ > 1e-2 is doubtful, and beyond 1 no digit is sure and the type of the numbers is refused.

Source: van der Sluis, Condition numbers and equilibration of matrices (1969).
"""

from enum import IntEnum

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sdyn.chain import Chain
from sdyn.coordinates import live_entries
from sdyn.dynamics import mass_matrix
from sdyn.inputs import expect
from sdyn.rebase import inner_of, state_seen


class Trust(IntEnum):
    """What the numbers of a type are worth on a structure."""

    GOOD = 0
    DOUBTFUL = 1
    """Fewer than two digits are sure."""
    REFUSED = 2
    """No digit is sure: use float64, another base, or joints that differ more."""


def conditioning(chain: Chain, q: Float[Array, " nq"]) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """Condition number of the mass matrix, scaled to a unit diagonal, and what it means for this type.

    Args:
        chain: Packed structure.
        q: Configuration [m, rad, unit quaternion wxyz].

    Returns:
        condition, trust: Infinite where rounding has made the matrix indefinite, or q is not finite; `Trust`. Not
        differentiable.
    """
    (q,) = expect(chain, q=q)
    chain, q = jax.lax.stop_gradient((chain, q))
    if chain.inner is not None:  # the mass matrix that is solved
        inner = inner_of(chain)
        q, _ = state_seen(chain, inner, q, jnp.zeros(chain.nv, chain.dtype))
        chain = inner
    M, live = mass_matrix(chain, q), live_entries(chain)
    diagonal = jnp.where(live, jnp.diagonal(M), 1)
    good = jnp.isfinite(M).all() & (diagonal > 0).all()
    scale = jnp.where(diagonal > 0, 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1)), 1)
    S = jnp.where(good & live & live[:, None], scale * M * scale[:, None], 0) + jnp.diag(1 - live.astype(M.dtype))
    eigenvalues = jnp.linalg.eigvalsh(jnp.where(good, S, jnp.eye(len(M), dtype=M.dtype)))
    least, most = eigenvalues.min(initial=1), eigenvalues.max(initial=1)
    condition = jnp.where(good & (least > 0), most / jnp.where(least > 0, least, 1), jnp.inf)
    eps = jnp.finfo(M.dtype).eps
    return condition, (eps * condition > 1e-2).astype(jnp.int32) + (eps * condition > 1)
