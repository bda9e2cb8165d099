"""One step of fixed size on the manifold of configurations.

The increment xi of a step lives in the tangent space at its start (`coordinates.retract`), so quaternions stay unit and
RK4 keeps its order: θ' = w + 1/2 θ x w + 1/12 θ x (θ x w). Without the last term the order is 3.

Source: Munthe-Kaas, High order Runge-Kutta methods on manifolds (1999).
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from sdyn.accuracy import Accuracy
from sdyn.adaptive import adaptive_step
from sdyn.chain import Chain
from sdyn.constraints import constrained_dynamics, forward_dynamics
from sdyn.coordinates import increment_rate, retract
from sdyn.drift import corrected
from sdyn.inputs import expect
from sdyn.rosenbrock import rosenbrock_step
from sdyn.variational import variational_step


def integrate(
    chain: Chain,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    tau: Float[Array, " nv"],
    dt,
    *,
    method: str = "rk4",
    drift="project",
    gravity: Float[Array, "3"] | None = None,
    f_ext: Float[Array, "n 6"] | None = None,
) -> tuple[Float[Array, " nq"], Float[Array, " nv"]]:
    """The state after one step under constant forces.

    Args:
        chain: Packed structure.
        q, v: State.
        tau: Force, laid out as v [N m, N].
        dt: Step [s]; may be traced, zero or negative.
        method: "rk4" (order 4), "semi_implicit" (order 1, one evaluation), "variational" (order 2; keeps momentum to
            rounding and energy without a trend), "implicit" (order 4, A-stable, for stiff joints and forces) or
            "adaptive" (order 8, up to 4096 steps in one, to a relative and absolute error of 1e-13; where these are not
            enough, q and v are infinite, and `diagnose` says so; needs diffrax).
        drift: How loops stay closed: "project" moves the state back after the step, in the mass metric; a number is a
            Baumgarte rate [1/s] (cheaper, but the error only decays; rate times dt at most 1), 0 does nothing. The
            variational method closes them itself.
        gravity: Acceleration of free fall, world axes [m/s^2].
        f_ext: Wrenches on the links, as for `forward_dynamics`.

    Returns:
        q, v.

    Raises:
        ValueError: If the method is unknown, or a shape or type differs.
    """
    q, v, tau = expect(chain, q=q, v=v, tau=tau)
    dial = Accuracy(method, drift=drift)
    return step(chain, q, v, lambda t, q, v: tau, 0.0, dt, dial, gravity=gravity, f_ext=f_ext)


def step(chain, q, v, force, t, dt, dial: Accuracy, *, gravity=None, f_ext=None):
    """`integrate`, with the force (and f_ext, if it is callable) as a function of time and state, for every stage."""
    project, method = isinstance(dial.drift, str), dial.method
    if isinstance(dial.drift, int | float) and isinstance(dt, int | float) and abs(dial.drift * dt) > 1:
        raise ValueError(
            f"integrate: the Baumgarte rate times dt is {dial.drift * dt:g}; keep it at most 1, as steps blow up at 2 "
            f"(semi_implicit) or 2.8 (rk4). Take a rate of {1 / abs(dt):g} or less, or drift='project'."
        )
    dt = jnp.asarray(dt, chain.dtype)
    options = dict(gravity=gravity) | ({} if project else dict(baumgarte=dial.drift))
    wrenches = f_ext if callable(f_ext) else lambda t, q, v: f_ext

    def acceleration(t, q, v):
        x = chain, q, v, force(t, q, v)
        if dial.loops == "partition" and chain.capacity.rows:
            return constrained_dynamics(*x, f_ext=wrenches(t, q, v), method="partition", **options)[0]
        return forward_dynamics(*x, f_ext=wrenches(t, q, v), **options)

    reached = True
    if method == "variational":
        guess = v + dt / 2 * acceleration(t, q, v)
        return variational_step(chain, q, v, force, wrenches, gravity, guess, t, dt)
    if method == "rk4":
        q, v = _rk4(chain, q, v, acceleration, t, dt)
    elif method == "semi_implicit":
        v = v + dt * acceleration(t, q, v)
        q = retract(chain, q, dt * increment_rate(chain, q, jnp.zeros_like(v), v))
    elif method == "implicit":
        q, v = _implicit(chain, q, v, acceleration, t, dt)
    else:
        q, v, reached = adaptive_step(chain, q, v, acceleration, t, dt, dial.tolerance, dial.derivatives)
    q, v = corrected(chain, q, v) if project and chain.capacity.rows else (q, v)
    return (q, v) if reached is True else tuple(jnp.where(reached, x, jnp.inf) for x in (q, v))


def _rk4(chain, q0, v0, acceleration, t0, dt):
    """The four stages in a scan, so that one of them is compiled."""

    def stage(carry, x):
        """The slope at the fraction c of the step, reached along the slope before, and the weighted sum so far."""
        ((k, total), (c, weight)) = carry, x
        xi, v = c * dt * k[0], v0 + c * dt * k[1]
        q = retract(chain, q0, xi)
        k = increment_rate(chain, q, xi, v), acceleration(t0 + c * dt, q, v)
        return (k, jax.tree.map(lambda s, x: s + weight * x, total, k)), None

    rest = jnp.zeros_like(v0), jnp.zeros_like(v0)
    fractions, weights = jnp.array([0, 1 / 2, 1 / 2, 1], v0.dtype), jnp.array([1 / 6, 1 / 3, 1 / 3, 1 / 6], v0.dtype)
    (_, (xi, dv)), _ = lax.scan(stage, (rest, rest), (fractions, weights))
    return retract(chain, q0, dt * xi), v0 + dt * dv


def _implicit(chain, q0, v0, acceleration, t0, dt):
    """The linearly implicit method in the increment and the rates."""

    def rates(t, y):
        xi, v = y
        q = retract(chain, q0, xi)
        return increment_rate(chain, q, xi, v), acceleration(t, q, v)

    xi, v = rosenbrock_step(rates, (jnp.zeros_like(v0), v0), jnp.asarray(t0, v0.dtype), dt)
    return retract(chain, q0, xi), v
