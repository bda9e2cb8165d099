"""Keeping closed what integration opens: projection on the closed configurations and velocities, in the mass metric.

With S = G⁺, one step is q ← q − M⁻¹ Kᵀ S φ(q), and v ← v − M⁻¹ Kᵀ S K v: the closest state in kinetic energy.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from sdyn.chain import Chain
from sdyn.closures import loop_jacobian, loop_residual
from sdyn.coordinates import increment_rate, retract
from sdyn.delassus import delassus
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

    def step(q, _):
        system = delassus(chain, q)
        return _moved(chain, q, system), None

    q, _ = lax.scan(step, q, None, STEPS)
    system = delassus(chain, q)
    return q, v + system.Y @ system.multipliers(-(system.K @ v))


def corrected(chain: Chain, q, v):
    """The state after a step, closed again, with the matrices of one configuration.

    Two steps for q and one for v leave the square of the drift. The derivative is the implicit one of a closed state:
    the matrices are held fixed, which neglects the drift times theirs.
    """
    system = lax.stop_gradient(delassus(chain, q))
    for _ in range(2):
        q = _moved(chain, q, system)
    return q, v + system.Y @ system.multipliers(-(loop_jacobian(chain, q) @ v))


def _moved(chain, q, system):
    step = system.Y @ system.multipliers(-loop_residual(chain, q))
    return retract(chain, q, increment_rate(chain, q, jnp.zeros_like(step), step))
