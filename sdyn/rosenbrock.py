"""One step of a linearly implicit method for stiff joints: order 4, A-stable, a fast mode shrinks to a third in a step.

With J the Jacobian of f at the start, four stages come from three evaluations and one factored matrix, no iteration:
    (1 / (h g) - J) U_i = f(y + sum_j a_ij U_j) + sum_j c_ij / h U_j,    y1 = y + sum_j b_j U_j.
The coefficients are rational; those of the better known RODAS are printed to nine digits only, and so are its results.

Source: Shampine, Implementation of Rosenbrock methods (1982).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

GAMMA = 1 / 2
A = (), (2,), (48 / 25, 6 / 25)
C = (), (-8,), (372 / 25, 12 / 5), (-112 / 125, -54 / 125, -2 / 5)
B = 19 / 9, 1 / 2, 25 / 108, 125 / 108


def rosenbrock_step(f, y, t, dt):
    """y, a pytree, after a step of y' = f(t, y)."""
    start, unravel = ravel_pytree((y, t))  # time is one more component, so that f may depend on it

    def rate(x):
        y, t = unravel(x)
        return ravel_pytree((f(t, y), jnp.ones_like(t)))[0]

    one, U = jnp.eye(len(start), dtype=start.dtype), []
    factor = jax.scipy.linalg.lu_factor(one - GAMMA * dt * jax.jacfwd(rate)(start))
    summed = lambda row: sum((w * u for w, u in zip(np.asarray(row, start.dtype), U, strict=True)), 0 * start)
    for i, row in enumerate(C):
        if i < 3:
            slope = dt * rate(start + summed(A[i]))
        U.append(jax.scipy.linalg.lu_solve(factor, GAMMA * (slope + summed(row))))
    return unravel(start + summed(B))[0]
