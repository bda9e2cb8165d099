"""What a motion is worth: where it breaks, what it loses of what it should keep, and how fast errors in it grow."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sdyn.chain import Chain
from sdyn.closures import loop_residual, system_of
from sdyn.conditioning import Trust, conditioning
from sdyn.constraints import closure_spectrum
from sdyn.coordinates import quaternions_of
from sdyn.momentum import centre_of_mass, kinetic_energy, momentum
from sdyn.rollout import rollout

QUANTITIES = (
    "nothing",
    "q is not finite",
    "v is not finite",
    "a quaternion is not unit",
    "the mass matrix is refused",
    "the adaptive method ran out of steps; take a shorter dt, or a tolerance of more than 1e-13",
)
BATCH = 64


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Diagnosis:
    """What `diagnose` found; numbers are over the states before the first bad one. Not differentiable."""

    bad_step: Int[Array, ""]
    """Number of the first bad state; -1 if all are good."""
    bad_quantity: Int[Array, ""]
    """What is bad there, an index of `QUANTITIES`; 0 if all are good."""
    momentum: Float[Array, "6"]
    """Largest change of each entry since the start [N m s, N s]."""
    energy: Float[Array, ""]
    """Largest change of kinetic, spring and gravity energy since the start [J]."""
    closures: Float[Array, ""]
    """Largest entry of `loop_residual` [rad, m]."""
    condition: Float[Array, ""]
    """Largest condition number of the scaled mass matrix, see `conditioning`."""
    trust: Int[Array, ""]
    """Worst `Trust`."""
    sigma_min: Float[Array, ""]
    """Smallest singular value of the closures, see `Status`; 1 where there are none."""
    turn: Float[Array, ""]
    """Largest turn of a base or of a spherical joint from one state to the next [rad]. Past 0.3, a step is too long."""

    def __str__(self) -> str:
        bad, quantity = int(self.bad_step), QUANTITIES[int(self.bad_quantity)]
        return (
            ("All states are good" if bad < 0 else f"State {bad} is bad: {quantity}. Before it")
            + f": momentum drifts by {float(jnp.abs(self.momentum).max()):.1e}, energy by {float(self.energy):.1e} J, "
            f"closures are open by {float(self.closures):.1e}; the scaled mass matrix has the condition number "
            f"{float(self.condition):.1e} ({Trust(int(self.trust)).name.lower()}), the closures the smallest "
            f"singular value {float(self.sigma_min):.1e}."
            + (f" Something turns by {float(self.turn):.2g} rad a step; take shorter ones." if self.turn > 0.3 else "")
        )


def diagnose(
    chain: Chain, qs: Float[Array, "nt nq"], vs: Float[Array, "nt nv"], *, gravity: Float[Array, "3"] | None = None
) -> Diagnosis:
    """The first bad state of a motion, and drift and conditioning up to it.

    Args:
        chain: Packed structure.
        qs, vs: States, as `rollout` returns them.
        gravity: As for `forward_dynamics`; counts in the energy.

    Returns:
        The diagnosis; it is finite whatever the states are. print() says it in words, outside of jit.
    """
    chain, qs, vs = jax.lax.stop_gradient((chain, qs, vs))
    count = len(qs)
    if count == 0:
        raise ValueError("diagnose: there is no state; give at least one.")
    blocks = -(-count // BATCH)
    fill = lambda x: jnp.concatenate([x, jnp.repeat(x[-1:], blocks * BATCH - count, 0)]).reshape(blocks, BATCH, -1)
    of_state = lambda x: _of_state(chain, *x, gravity)
    found = jax.lax.map(jax.vmap(of_state), (fill(qs), fill(vs)))
    found = jax.tree.map(lambda x: x.reshape(blocks * BATCH, *x.shape[2:])[:count], found)
    quantity, h, energy, opening, condition, trust, sigma = found

    bad = quantity > 0
    first = jnp.where(bad.any(), jnp.argmax(bad), -1)
    before = jnp.arange(count) < jnp.where(first < 0, count, first)
    largest = lambda x, default: jnp.where(before.reshape(-1, *[1] * (x.ndim - 1)), x, default).max(0)
    change = lambda x: largest(jnp.abs(x - jnp.where(before[0], x[0], 0)), 0)
    return Diagnosis(
        bad_step=first,
        bad_quantity=quantity[jnp.maximum(first, 0)],
        momentum=change(h),
        energy=change(energy),
        closures=largest(opening, 0),
        condition=largest(condition, 1),
        trust=largest(trust, 0),
        sigma_min=-largest(-sigma, -1),
        turn=largest(jnp.concatenate([jnp.zeros(1, qs.dtype), _turns(chain, qs)]), 0),
    )


def _of_state(chain, q, v, gravity):
    """Number of what is bad, momentum, energy, opening, condition, trust, smallest singular value."""
    finite = jnp.isfinite(q).all(), jnp.isfinite(v).all()
    eps = jnp.finfo(q.dtype).eps
    off = jnp.abs(jnp.linalg.norm(quaternions_of(chain, q), axis=1) - 1).max(initial=0)
    condition, trust = conditioning(chain, q)
    tests = jnp.stack([~finite[0], ~finite[1], off > jnp.sqrt(eps), trust == Trust.REFUSED])
    given_up = jnp.isposinf(q).all() & jnp.isposinf(v).all() & (v.size > 0)  # as the adaptive method leaves it
    quantity = jnp.where(given_up, 5, jnp.where(tests.any(), 1 + jnp.argmax(tests), 0))

    q, v = (jnp.where(good, x, 0) for good, x in zip(finite, (q, v), strict=True))
    energy = kinetic_energy(chain, q, v) + _potential(chain, q, gravity)
    opening, sigma = jnp.zeros_like(energy), jnp.ones_like(energy)
    if chain.capacity.rows:
        opening = jnp.abs(loop_residual(chain, q)).max()
        _, sigma, _ = closure_spectrum(system_of(chain, q).saved)
    return quantity, momentum(chain, q, v), energy, opening, condition, trust, sigma


def _turns(chain, qs):
    """Largest angle between the quaternions of a state and of the next [nt - 1]."""
    quats = jax.vmap(lambda q: quaternions_of(chain, q))(qs)
    a, b = quats[1:], quats[:-1]
    apart = jnp.minimum(((a - b) ** 2).sum(-1), ((a + b) ** 2).sum(-1))  # of unit quaternions: (2 sin(angle / 4))²
    return 4 * jnp.arcsin(jnp.minimum(jnp.sqrt(apart) / 2, 1.0)).max(1, initial=0.0)


def _potential(chain, q, gravity):
    """Energy of springs, and of the weight of all links [J]."""
    nb, to_q = chain.capacity.base_nq, chain.dof_to_q
    x = jnp.where(to_q >= 0, q[nb + jnp.maximum(to_q, 0)], 0) if len(to_q) else jnp.zeros(0, q.dtype)
    energy = (chain.dof_value[1] * x * x).sum() / 2
    if gravity is None:
        return energy
    return energy - chain.link_mass.sum() * (gravity @ centre_of_mass(chain, q))


def growth(
    chain: Chain,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    taus,
    dt,
    **options,
) -> tuple[Float[Array, " nt+1"], Int[Array, ""]]:
    """By how much an error of the start grows along a motion, and how far the motion can be trusted.

    The estimate is the length of one tangent of the motion, in a direction without symmetry: it misses a factor, not
    the exponent. Past the horizon, derivatives are noise too; planners use several short arcs instead of one.

    Args:
        chain, q, v, taus, dt, **options: As for `rollout`.

    Returns:
        Growth at every state, 1 at the start; number of the first state with growth times eps beyond 1e-3, -1 if none.
    """
    start = jnp.sin(1.0 + 1.7 * jnp.arange(v.shape[0], dtype=v.dtype))
    start = start / jnp.linalg.norm(start)
    _, (dq, dv) = jax.jvp(lambda v: rollout(chain, q, v, taus, dt, **options), (v,), (start,))
    by = jnp.sqrt((dq**2).sum(1) + (dv**2).sum(1))
    lost = by * jnp.finfo(v.dtype).eps > 1e-3
    return by, jnp.where(lost.any(), jnp.argmax(lost), -1)
