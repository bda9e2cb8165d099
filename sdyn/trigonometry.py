"""Sine and cosine of all joints at once: XLA on a CPU calls a library for each float64 angle, 5 times slower.

Source: reduction by Cody and Waite, polynomials of fdlibm (Sun Microsystems, 1993).
"""

from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

LARGEST = 1e5
"""Angle [rad] up to which the reduced argument is exact to rounding."""
HALF_PI = (1.5707963267341256, 6.0771005063039222e-11, 2.0222662487959506e-21)  # pi/2 in pieces, the first of 33 bits
SINE = (
    1.58969099521155010221e-10, -2.50507602534068634195e-08, 2.75573137070700676789e-06,
    -1.98412698298579493134e-04, 8.33333333332248946124e-03, -1.66666666666666324348e-01,
)  # fmt: skip
COSINE = (
    -1.13596475577881948265e-11, 2.08757232129817482790e-09, -2.75573143513906633035e-07,
    2.48015872894767294178e-05, -1.38888888888741095749e-03, 4.16666666666666019037e-02,
)  # fmt: skip


@jax.custom_jvp
def sin_cos(x):
    """sin x and cos x, to rounding; in float32 those of XLA."""
    if x.dtype != jnp.float64:
        return jnp.sin(x), jnp.cos(x)
    return lax.cond(jnp.any(jnp.abs(x) > LARGEST), lambda x: (jnp.sin(x), jnp.cos(x)), _polynomials, x)


@sin_cos.defjvp
def _(primals, tangents):
    (s, c), (dx,) = sin_cos(*primals), tangents
    return (s, c), (c * dx, -s * dx)


def _polynomials(x):
    k = jnp.round(x * (2 / np.pi))
    r = ((x - k * HALF_PI[0]) - k * HALF_PI[1]) - k * HALF_PI[2]
    z = r * r
    horner = lambda coefficients: reduce(lambda total, c: total * z + c, coefficients)
    s, c = r + r * z * horner(SINE), 1 - 0.5 * z + z * z * horner(COSINE)
    quadrant = k - 4 * jnp.floor(k * 0.25)
    odd = (quadrant == 1) | (quadrant == 3)
    s, c = jnp.where(odd, c, s), jnp.where(odd, s, c)
    return jnp.where(quadrant >= 2, -s, s), jnp.where((quadrant == 1) | (quadrant == 2), -c, c)
