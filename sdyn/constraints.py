"""Dynamics of closed chains: M v̇ + b = τ + Kᵀ lam, with K v̇ = k.

The multipliers come from the Delassus matrix G = K M⁻¹ Kᵀ, see `delassus.py`. Nothing is differentiated by AD: where
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

from sdyn.chain import Chain
from sdyn.closures import closure_acceleration, closure_parts, loop_residual, loop_wrenches
from sdyn.delassus import multipliers, rank, scaled
from sdyn.dynamics import inverse_dynamics, solve_mass, tree_dynamics
from sdyn.inputs import expect


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
) -> Float[Array, " nv"]:
    """Accelerations of a structure, by the articulated-body algorithm; the loops that it has stay closed.

    Args:
        chain: Packed structure.
        q: Configuration [m, rad, unit quaternion wxyz].
        v: Velocity [rad/s, m/s]; the base part is the twist of the base's origin in base axes.
        tau: Force, laid out as v [N m, N]; damping and stiffness of the joints are added inside.
        gravity: Acceleration of free fall, world axes [m/s^2]; none by default.
        f_ext: One wrench [n; f] per link, world axes, about the link's origin [N m, N]; none by default.

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
    return _held(chain, q, v, tau, gravity, f_ext)[0]


def constrained_dynamics(
    chain: Chain,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    tau: Float[Array, " nv"],
    *,
    gravity: Float[Array, "3"] | None = None,
    f_ext: Float[Array, "n 6"] | None = None,
    method: str = "proximal",
) -> tuple[Float[Array, " nv"], Float[Array, " nc"], Status]:
    """Accelerations of a closed chain, and the wrenches in its closures.

    Args:
        chain, q, v, tau, gravity, f_ext: As for `forward_dynamics`; a consistent state comes from `project`.
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
    vdot, lam = _held(chain, q, v, tau, gravity, f_ext)
    return vdot, lam, _status(*jax.lax.stop_gradient((chain, q, v, vdot)))


@partial(jax.custom_jvp)
def _held(chain, q, v, tau, gravity, f_ext):
    """vdot and lam."""
    free = tree_dynamics(chain, q, v, tau, gravity=gravity, f_ext=f_ext)
    _, Y, G, judged = _delassus(chain, q)
    lam = multipliers(G, *judged, -closure_acceleration(chain, q, v, free))
    return free + Y @ lam, lam


@partial(_held.defjvp, symbolic_zeros=True)
def _held_tangent(primals, tangents):
    chain, q = primals[:2]
    vdot, lam = _held(*primals)
    c, d = _slope(lambda *x: _residual(*x, vdot, lam), primals, tangents)
    return (vdot, lam), _solve(chain, q, -c, -d)


def _residual(chain, q, v, tau, gravity, f_ext, vdot, lam):
    F = loop_wrenches(chain, q, lam)
    F = F if f_ext is None else F + f_ext
    force = inverse_dynamics(chain, q, v, vdot, gravity=gravity, f_ext=F)
    return force - tau, closure_acceleration(chain, q, v, vdot)


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


def _solve(chain, q, c, d):
    """x, y of M x − Kᵀ y = c, K x = d."""
    K, Y, G, judged = _delassus(chain, q)
    x = solve_mass(chain, q, c)
    y = multipliers(G, *judged, d - K @ x)
    return x + Y @ y, y


def _delassus(chain, q):
    """K, M⁻¹ Kᵀ, G = K M⁻¹ Kᵀ, and which rows are dead and when a pivot is zero."""
    Ja, Jb, open_by = closure_parts(chain, q)
    K = Ja - Jb
    Y = jax.vmap(lambda row: solve_mass(chain, q, row), out_axes=1)(K)
    return K, Y, K @ Y, _judged(*jax.lax.stop_gradient((K, Ja, Jb, open_by)))


def _judged(K, Ja, Jb, open_by):
    """Which rows of K are zero but for rounding, and the squared sine below which a row depends on others.

    A row is the difference of two, of length `size`, and it is off by their rounding, and by as much as the closures
    are open: where they should be redundant, that makes them look independent.
    """
    n, eps = len(K), jnp.finfo(K.dtype).eps
    size = jnp.sqrt((Ja * Ja + Jb * Jb).sum(1))
    length = jnp.sqrt((K * K).sum(1))
    share = jnp.where(size > 0, length / jnp.where(size > 0, size, 1.0), 0.0)
    drift = jnp.max(jnp.where(size > 0, jnp.abs(open_by) / jnp.where(size > 0, size, 1.0), 0.0))
    off = jnp.maximum(64 * eps, jnp.minimum(10 * drift, 3e-5))
    dead = share <= off
    tolerance = jnp.maximum(64 * n * eps, (off / jnp.where(dead, 1.0, share)) ** 2)
    return dead.astype(K.dtype), tolerance


def _status(chain, q, v, vdot) -> Status:
    K, _, G, judged = _delassus(chain, q)
    independent = rank(*(x[..., None] for x in (G, *judged)))[0][:, 0]
    count = independent.sum().astype(int)
    A, d = scaled(G[..., None], judged[0][:, None])
    A = A[..., 0] * (d[:, 0] > 0)  # dead rows have no singular value
    sigma = jnp.sqrt(jnp.maximum(jnp.linalg.eigvalsh(A)[::-1], 0))
    least = jnp.where(count > 0, sigma[jnp.maximum(count - 1, 0)], 1.0)
    drift = jnp.abs(loop_residual(chain, q)).max(initial=0.0)
    noise = jnp.maximum(drift, 64 * jnp.finfo(K.dtype).eps)
    live = jnp.sum(chain.row_index[2])
    return Status(
        rank=count,
        redundant=count < live,
        sigma_min=least,
        condition=jnp.where(count > 0, sigma[0], 1.0) / least,
        drift=drift,
        error=jnp.abs(closure_acceleration(chain, q, v, vdot)).max(initial=0.0),
        singular=least < 1e3 * noise,
    )
