"""Many steps in one scan, with a schedule of structures: what planners differentiate."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from sdyn.chain import Chain
from sdyn.inputs import expect
from sdyn.integrate import step
from sdyn.transition import transfer


def rollout(
    chain: Chain,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    taus,
    dt,
    *,
    method: str = "rk4",
    steps: int | None = None,
    schedule: Int[Array, " nt"] | None = None,
    gravity: Float[Array, "3"] | None = None,
    f_ext: Float[Array, "n 6"] | None = None,
) -> tuple[Float[Array, "nt+1 nq"], Float[Array, "nt+1 nv"]]:
    """States along a motion.

    Args:
        chain: Packed structure; or, with a schedule, a stacked `family`.
        q, v: State at the start; of the first member of the schedule.
        taus: Forces [nt, nv], constant over a step; or a function (t, q, v) -> [nv], evaluated at every stage.
        dt: Step [s].
        method: As for `integrate`.
        steps: Number of steps, static; needed where taus is a function.
        schedule: Member of the family in each step. Where it changes, the state is transferred; lock values, ground
            pose and placements come from the state.
        gravity, f_ext: As for `forward_dynamics`, constant.

    Returns:
        qs, vs: States at the ends of the steps, the start first; at a change, the state before it.
    """
    force, steps = _force(taus, steps)
    first = chain if schedule is None else jax.tree.map(lambda x: x[schedule[0]], chain)
    q, v = expect(first, q=q, v=v)
    options = dict(method=method, gravity=gravity, f_ext=f_ext)

    def advance(chain, q, v, i):
        return step(chain, q, v, lambda t, q, v: force(i, t, q, v), i * jnp.asarray(dt, q.dtype), dt, **options)

    def alone(state, i):
        state = advance(chain, *state, i)
        return state, state

    def in_turn(carry, x):
        (current, member, q, v), (i, now) = carry, x
        new = jax.tree.map(lambda x: x[now], chain)
        change = lambda: transfer(current, new, q, v)[:3]
        current, q, v = lax.cond(now == member, lambda: (current, q, v), change)
        q, v = advance(current, q, v, i)
        return (current, now, q, v), (q, v)

    if schedule is None:
        _, (qs, vs) = lax.scan(alone, (q, v), jnp.arange(steps))
    else:
        _, (qs, vs) = lax.scan(in_turn, (first, schedule[0], q, v), (jnp.arange(steps), schedule))
    return jnp.concatenate([q[None], qs]), jnp.concatenate([v[None], vs])


def _force(taus, steps):
    """The force in step i as a function of time and state, and the number of steps."""
    if callable(taus):
        if steps is None:
            raise ValueError("rollout: taus is a function; say how many steps with steps=.")
        return (lambda i, t, q, v: taus(t, q, v)), steps
    taus = jnp.asarray(taus)
    if steps not in (None, len(taus)):
        raise ValueError(f"rollout: steps is {steps} and taus has {len(taus)} rows; leave steps out.")
    return (lambda i, t, q, v: taus[i]), len(taus)
