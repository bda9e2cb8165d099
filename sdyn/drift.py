"""Keeping closed what integration opens: projection on the closed configurations and velocities, in the mass metric.

With S = G⁺, one step is q ← q − M⁻¹ Kᵀ S φ(q), and v ← v − M⁻¹ Kᵀ S K v: the closest state in kinetic energy.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from sdyn.chain import Chain
from sdyn.closures import System, closure_acceleration, loop_residual, system_of
from sdyn.coordinates import increment_rate, retract
from sdyn.inputs import expect

STEPS = 8  # of Newton's method in `project`: from 0.3 rad and 0.1 m to rounding in 5


def project(
    chain: Chain, q: Float[Array, " nq"], v: Float[Array, " nv"]
) -> tuple[Float[Array, " nq"], Float[Array, " nv"]]:
    """A state in which the loops are closed, near a given one, for instance to start from.

    Args:
        chain: Packed structure.
        q, v: State, roughly closed.

    Returns:
        q by Newton's method, a fixed number of steps that move as little as they can in the mass metric; v the closest
        in kinetic energy. `loop_residual` tells whether it has arrived. Differentiable in everything.
    """
    q, v = expect(chain, q=q, v=v)
    if chain.capacity.rows == 0:
        return q, v

    def step(state, _):
        q, _ = state
        at, change = _step(chain, q, v, system_of(chain, q))
        return (at, v + change), None

    return lax.scan(step, (q, v), None, STEPS)[0]


def corrected(chain: Chain, q, v):
    """The state after a step, closed again, with the matrices of one configuration: two steps leave the square of the
    drift."""
    system = system_of(chain, q)

    def step(state, _):
        q, change = _step(chain, *state, system)
        return (q, state[1] + change), None

    return lax.scan(step, (q, v), None, 2)[0]


def _step(chain, q, v, system: System):
    """q after a step, and the change of v, by one solution for both."""
    still = jnp.zeros_like(v)
    open_by = jnp.stack([loop_residual(chain, q), closure_acceleration(chain, q, still, v)])
    step, change = jax.vmap(lambda d: system.solve(still, d)[0])(-open_by)
    return retract(chain, q, increment_rate(chain, q, still, step)), change
