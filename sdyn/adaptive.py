"""One step by diffrax, of any size: as many steps of Dormand and Prince's order 8 as a tolerance asks for.

Source: Prince, Dormand, High order embedded Runge-Kutta formulae (1981), as diffrax has it.
"""

import importlib.util

import jax
import jax.numpy as jnp

from sdyn.coordinates import increment_rate, retract

MOST = 4096  # steps


def adaptive_step(chain, q, v, acceleration, t, dt, tolerance, derivatives):
    """The state after dt, and whether it was reached in `MOST` steps; from a state that is not finite, none is
    taken.

    Quaternions are integrated as they stand: at these tolerances their lengths drift less than anything else.
    """
    if importlib.util.find_spec("diffrax") is None:
        raise ValueError("integrate: the adaptive method needs diffrax; install sdyn[reference].")
    import diffrax

    def rates(t, y, _):
        q, v = y
        rest = jnp.zeros_like(v)
        rate = increment_rate(chain, q, rest, v)
        _, qdot = jax.jvp(lambda x: retract(chain, q, x), (rest,), (rate,))
        return qdot, acceleration(t, q, v)

    least = jnp.maximum(tolerance, 8 * jnp.finfo(v.dtype).eps).astype(v.dtype)
    kept = derivatives == "stored"
    sound = jnp.isfinite(q).all() & jnp.isfinite(v).all()
    found = diffrax.diffeqsolve(
        diffrax.ODETerm(rates),
        diffrax.Dopri8(),
        t,
        t + jnp.where(sound, dt, 0),
        None,
        (q, v),
        saveat=diffrax.SaveAt(t1=True),
        stepsize_controller=diffrax.PIDController(rtol=least, atol=least),
        max_steps=MOST,
        throw=False,
        adjoint=diffrax.DirectAdjoint() if kept else diffrax.RecursiveCheckpointAdjoint(),
    )
    q, v = (x[-1] for x in found.ys)
    return retract(chain, q, jnp.zeros_like(v)), v, sound & (found.result == diffrax.RESULTS.successful)
