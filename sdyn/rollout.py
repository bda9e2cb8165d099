"""Many steps in one scan, and phases of other structures in a scan of scans: what planners differentiate.

A phase of duration T in N steps has the step T / N, so a switch time is data like any other. Its derivative comes
out of those of the steps and of `transfer`: a switch that is later by dt moves the state behind it by
    (Dg f− − f+) dt,
with x+ = g(x−) the transfer and f−, f+ the rates of the state on either side: what makes Dg the saltation matrix.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from sdyn.accuracy import preset, wanted_error
from sdyn.chain import Chain
from sdyn.choose import choose
from sdyn.inputs import expect
from sdyn.march import forces, march
from sdyn.transition import transfer


def rollout(
    chain: Chain,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    taus,
    dt,
    *,
    method: str = "rk4",
    drift="project",
    accuracy=None,
    steps: int | None = None,
    gravity: Float[Array, "3"] | None = None,
    f_ext=None,
) -> tuple[Float[Array, "nt+1 nq"], Float[Array, "nt+1 nv"]]:
    """States along a motion of one structure.

    Args:
        chain: Packed structure.
        q, v: State at the start.
        taus: Forces [nt, nv], constant over a step; or a function (t, q, v) -> [nv], evaluated at every stage.
        dt: Step [s].
        method, drift: As for `integrate`.
        accuracy: In their place, an `Accuracy`, the name of one (fast, balanced, accurate, reference), or a wanted
            error such as "1e-6", for which `choose` measures; that not under jit.
        steps: Number of steps, static; needed where taus is a function.
        gravity: As for `forward_dynamics`.
        f_ext: Wrenches on the links [n, 6], constant; or a function (t, q, v) -> [n, 6], evaluated at every stage.

    Returns:
        qs, vs: States at the ends of the steps, the start first.
    """
    if wanted_error(accuracy):
        accuracy = choose(chain, q, v, taus, dt, accuracy, steps=steps, gravity=gravity, f_ext=f_ext).accuracy
    force, steps = forces("rollout", taus, steps, 0)
    dial = preset(accuracy, method=method, drift=drift)
    chain, q, v, gravity, f_ext = dial.cast((chain, *expect(chain, q=q, v=v), gravity, f_ext))
    t = jnp.asarray(dt, q.dtype) * jnp.arange(steps + 1)
    qs, vs = march(chain, q, v, force, t, dt, dial, gravity=gravity, f_ext=f_ext)
    return jnp.concatenate([q[None], qs]), jnp.concatenate([v[None], vs])


class Phases(NamedTuple):
    """A motion through several structures; each phase from the state behind the switch to the one before the next."""

    t: Float[Array, "phases steps+1"]
    """Times [s]."""
    q: Float[Array, "phases steps+1 nq"]
    v: Float[Array, "phases steps+1 nv"]
    """States, each in the coordinates of its phase's structure."""
    impulse: Float[Array, "phases n+loops 6"]
    """What reached each link and loop at the start of the phase, see `transfer`; zero in the first."""
    chain: Chain
    """The structures, stacked [phases], with lock values, ground pose and closures as the motion left them."""


def hybrid_rollout(
    family: Chain,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    taus,
    durations: Float[Array, " phases"],
    members: Int[Array, " phases"],
    *,
    method: str = "rk4",
    drift="project",
    accuracy=None,
    steps: int | None = None,
    gravity: Float[Array, "3"] | None = None,
    f_ext=None,
) -> Phases:
    """A motion through phases of different structure, with `transfer` between them.

    One program for all members, orders and durations. A phase that needs more steps than the others is given as
    several phases of the same member.

    Args:
        family: Structures stacked along a leading axis, from `family`.
        q, v: State at the start, of the first phase's structure, in the layout of the capacity (`pad`).
        taus: Forces [phases, steps, nv], constant over a step, so that they stretch with the phase; or a function
            (t, q, v) -> [nv] of the time since the start, which does not.
        durations: Of the phases [s], not negative; switch times are their running sums.
        members: Number of each phase's structure in the family.
        method, drift: As for `integrate`.
        accuracy: In their place, an `Accuracy` or the name of one.
        steps: Steps in each phase, static; needed where taus is a function.
        gravity, f_ext: As for `rollout`.

    Returns:
        The phases. Differentiable in everything, the durations included.
    """
    force, steps = forces("hybrid_rollout", taus, steps, 1)
    dial = preset(accuracy, method=method, drift=drift)
    pick = lambda member: jax.tree.map(lambda x: x[member], family)
    first = pick(members[0])
    family, first, q, v, gravity, f_ext = dial.cast((family, first, *expect(first, q=q, v=v), gravity, f_ext))
    durations = jnp.asarray(durations, q.dtype)
    (count,) = durations.shape
    if jnp.shape(members) != (count,):
        raise ValueError(f"hybrid_rollout: {count} durations and members of shape {jnp.shape(members)}; one for each.")
    if not callable(taus) and len(jnp.asarray(taus)) != count:
        raise ValueError(f"hybrid_rollout: taus has {len(taus)} phases and there are {count} durations.")
    starts = jnp.cumsum(durations) - durations
    times = starts[:, None] + durations[:, None] * jnp.arange(steps + 1) / steps
    none = jnp.zeros((first.capacity.links + first.capacity.loops, 6), q.dtype)

    def phase(state, x):
        k, member, t, duration = x
        stay = lambda: (*state, none)
        chain, q, v, impulse = lax.cond(k == 0, stay, lambda: transfer(state[0], pick(member), *state[1:]))
        f = lambda i, t, q, v: force((k, i), t, q, v)
        qs, vs = march(chain, q, v, f, t, duration / steps, dial, gravity=gravity, f_ext=f_ext)
        path = jnp.concatenate([q[None], qs]), jnp.concatenate([v[None], vs])
        return (chain, qs[-1], vs[-1]), Phases(t, *path, impulse, chain)

    _, found = lax.scan(phase, (first, q, v), (jnp.arange(count), jnp.asarray(members), times, durations))
    return found
