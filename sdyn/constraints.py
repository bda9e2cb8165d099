"""Dynamics of closed chains: M v̇ + b = τ + Kᵀ lam, with K v̇ = k.

The multipliers come from the Delassus matrix, see `delassus.py`. Nothing is differentiated by AD: where
r = [ID(q, v, v̇) − Kᵀ lam − τ; K v̇ − k] is zero,
    [M −Kᵀ; K 0] [dv̇; dlam] = −dr  along every change of state, parameters or closures,
with dr from inverse dynamics under the closures' wrenches and from one sweep of accelerations. It holds for redundant
closures too, along motions that keep them closed: there dv̇ is unique although K has dependent rows.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sdyn.chain import Chain, ClosureRow
from sdyn.closures import closure_acceleration, loop_residual, loop_wrenches
from sdyn.delassus import delassus, solve
from sdyn.dynamics import inverse_dynamics, tree_dynamics
from sdyn.inputs import expect
from sdyn.semidefinite import spectrum


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Status:
    """How well the closures determine the motion. Not differentiable."""

    rank: Int[Array, ""]
    """Independent rows."""
    redundant: Bool[Array, ""]
    """Whether rows depend on others: then lam is the shortest of many."""
    sigma_min: Float[Array, ""]
    """Smallest singular value of the independent rows of K M^-1/2, rows scaled to length one: the sine of the
    smallest angle between a row and the others, if there are two."""
    condition: Float[Array, ""]
    """Largest over smallest of these singular values."""
    drift: Float[Array, ""]
    """Largest entry of `loop_residual` [rad, m]."""
    error: Float[Array, ""]
    """Largest entry of K vdot - k [rad/s^2, m/s^2]: what a redundant row misses that contradicts the others."""
    singular: Bool[Array, ""]
    """Whether sigma_min is below a thousand times the drift or the rounding: the accelerations may be wrong by the
    ratio of the two."""


def forward_dynamics(
    chain: Chain,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    tau: Float[Array, " nv"],
    *,
    gravity: Float[Array, "3"] | None = None,
    f_ext: Float[Array, "n 6"] | None = None,
    baumgarte=None,
) -> Float[Array, " nv"]:
    """Accelerations of a structure, by the articulated-body algorithm; the loops that it has stay closed.

    Args:
        chain: Packed structure.
        q: Configuration [m, rad, unit quaternion wxyz].
        v: Velocity [rad/s, m/s]; the base part is the twist of the base's origin in base axes.
        tau: Force, laid out as v [N m, N]; damping and stiffness of the joints are added inside.
        gravity: Acceleration of free fall, world axes [m/s^2]; none by default.
        f_ext: One wrench [n; f] per link, world axes, about the link's origin [N m, N]; none by default.
        baumgarte: Rate a [1/s] at which open loops close: K vdot = k - 2 a K v - a^2 residual; none by default.

    Returns:
        vdot, the plain time derivative of the components of v [rad/s^2, m/s^2].

    Raises:
        ValueError: While tracing, if a shape or type differs; nothing at run time.

    Source:
        Featherstone (2008), section 7.3; derivatives by the implicit rule, see `aba.py` and `constraints.py`.
    """
    if chain.capacity.rows == 0:
        return tree_dynamics(chain, q, v, tau, gravity=gravity, f_ext=f_ext)
    q, v, tau, gravity, f_ext = expect(chain, q=q, v=v, tau=tau, gravity=gravity, f_ext=f_ext)
    return _held(chain, q, v, tau, gravity, f_ext, baumgarte)[0]


def constrained_dynamics(
    chain: Chain,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    tau: Float[Array, " nv"],
    *,
    gravity: Float[Array, "3"] | None = None,
    f_ext: Float[Array, "n 6"] | None = None,
    baumgarte=None,
    method: str = "proximal",
) -> tuple[Float[Array, " nv"], Float[Array, " nc"], Status]:
    """Accelerations of a closed chain, and the wrenches in its closures.

    Args:
        chain, q, v, tau, gravity, f_ext, baumgarte: As for `forward_dynamics`; a consistent state comes from `project`.
        method: "proximal", on the Delassus matrix.

    Returns:
        vdot: As of `forward_dynamics`.
        lam: One entry per row of the closures, the wrench on frame a in the axes and at the origin of frame a [N m,
            N]; where it is not unique, the one with the least sum of squares.
        status: See `Status`.

    Source:
        formulas.md, "Loops".
    """
    if method != "proximal":
        raise ValueError(f"constrained_dynamics: there is no method {method!r}; the method is 'proximal'.")
    q, v, tau, gravity, f_ext = expect(chain, q=q, v=v, tau=tau, gravity=gravity, f_ext=f_ext)
    vdot, lam = _held(chain, q, v, tau, gravity, f_ext, baumgarte)
    return vdot, lam, _status(*jax.lax.stop_gradient((chain, q, v, vdot)))


@partial(jax.custom_jvp)
def _held(chain, q, v, tau, gravity, f_ext, baumgarte):
    """vdot and lam."""
    free = tree_dynamics(chain, q, v, tau, gravity=gravity, f_ext=f_ext)
    system = delassus(chain, q)
    lam = system.multipliers(-_opening(chain, q, v, free, baumgarte))
    return free + system.Y @ lam, lam


@partial(_held.defjvp, symbolic_zeros=True)
def _held_tangent(primals, tangents):
    chain, q = primals[:2]
    vdot, lam = _held(*primals)
    c, d = _slope(lambda *x: _residual(*x, vdot, lam), primals, tangents)
    return (vdot, lam), solve(chain, q, -c, -d)


def _opening(chain, q, v, vdot, rate):
    """K v̇ − k, and what Baumgarte adds."""
    if rate is None:
        return closure_acceleration(chain, q, v, vdot)
    return closure_acceleration(chain, q, v, vdot + 2 * rate * v) + rate**2 * loop_residual(chain, q)


def _residual(chain, q, v, tau, gravity, f_ext, baumgarte, vdot, lam):
    F = loop_wrenches(chain, q, lam)
    F = F if f_ext is None else F + f_ext
    force = inverse_dynamics(chain, q, v, vdot, gravity=gravity, f_ext=F)
    return force - tau, _opening(chain, q, v, vdot, baumgarte)


def _slope(function, primals, tangents):
    """Derivative of `function` along the tangents that are not zero."""
    is_zero = lambda t: isinstance(t, jax.custom_derivatives.SymbolicZero) or t.dtype == jax.dtypes.float0
    (leaves, form), along = jax.tree.flatten(primals), jax.tree.leaves(tangents)
    at = [i for i, t in enumerate(along) if not is_zero(t)]

    def f(*xs):
        full = list(leaves)
        for i, x in zip(at, xs, strict=True):
            full[i] = x
        return function(*jax.tree.unflatten(form, full))

    return jax.jvp(f, tuple(leaves[i] for i in at), tuple(along[i] for i in at))[1]


def _status(chain, q, v, vdot) -> Status:
    system = delassus(chain, q)
    count, eigenvalues = spectrum(system.G, system.dead, system.tolerance)
    sigma = jnp.sqrt(jnp.maximum(eigenvalues[::-1], 0))
    least = jnp.where(count > 0, sigma[jnp.maximum(count - 1, 0)], 1.0)
    drift = jnp.abs(loop_residual(chain, q)).max(initial=0.0)
    noise = jnp.maximum(drift, 64 * jnp.finfo(q.dtype).eps)
    live = jnp.sum(chain.row_index[ClosureRow.LIVE])
    return Status(
        rank=count,
        redundant=count < live,
        sigma_min=least,
        condition=jnp.where(count > 0, sigma[0], 1.0) / least,
        drift=drift,
        error=jnp.abs(closure_acceleration(chain, q, v, vdot)).max(initial=0.0),
        singular=least < 1e3 * noise,
    )
