"""Dynamics of closed chains: M v̇ + b = τ + Kᵀ lam, with K v̇ = k.

Two solvers share no step: the Delassus matrix, see `delassus.py`, and the paper's coordinate partition, see
`partition.py`. Neither is differentiated by AD: where
r = [ID(q, v, v̇) − Kᵀ lam − τ; K v̇ − k] is zero,
    [M −Kᵀ; K 0] [dv̇; dlam] = −dr  along every change of state, parameters or closures,
with dr from inverse dynamics under the closures' wrenches and from the accelerations of their frames. It holds for
redundant closures too, along motions that keep them closed: there dv̇ is unique although K has dependent rows.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sdyn.chain import Chain, ClosureRow
from sdyn.closures import (
    closed_operands,
    closure_acceleration,
    closure_forces,
    loop_jacobian,
    loop_residual,
    system_of,
)
from sdyn.coordinates import join, rates_of, spin
from sdyn.delassus import Saved, closed_aba, closed_aba_saving
from sdyn.dynamics import inverse_dynamics, inverse_dynamics_under, passive_force, tree_dynamics
from sdyn.inputs import expect
from sdyn.partition import Partition, condition, partition, unseen
from sdyn.partition import solve as partition_solve
from sdyn.semidefinite import shortest, spectrum


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Status:
    """How well the closures determine the motion. Not differentiable."""

    rank: Int[Array, ""]
    """Independent rows."""
    redundant: Bool[Array, ""]
    """Whether rows depend on others: then lam is the shortest of many."""
    sigma_min: Float[Array, ""]
    """Smallest singular value of the independent rows of K M^-1/2. A row is scaled to the share that it has of the
    twists of its frames, at most one: near zero, the closures let the motion through or say the same twice."""
    condition: Float[Array, ""]
    """Largest over smallest of these singular values."""
    drift: Float[Array, ""]
    """Largest entry of `loop_residual` [rad, m]."""
    error: Float[Array, ""]
    """Largest entry of K vdot - k [rad/s^2, m/s^2]: what a redundant row misses that contradicts the others."""
    singular: Bool[Array, ""]
    """Whether sigma_min is below a thousand times the drift or the rounding: the accelerations may be wrong by the
    ratio of the two."""
    partition: Float[Array, ""]
    """Condition number of the dependent block of the partition; past 1e6, pick it anew. 1 for the other method."""


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
    return _held(closed_aba, chain, q, v, tau, gravity, f_ext, _feedback(chain, q, v, baumgarte))[0]


def constrained_dynamics(
    chain: Chain,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    tau: Float[Array, " nv"],
    *,
    gravity: Float[Array, "3"] | None = None,
    f_ext: Float[Array, "n 6"] | None = None,
    method: str = "proximal",
    pairs: Partition | None = None,
    baumgarte=None,
) -> tuple[Float[Array, " nv"], Float[Array, " nc"], Status]:
    """Accelerations of a closed chain, and the wrenches in its closures.

    Args:
        chain, q, v, tau, gravity, f_ext, baumgarte: As for `forward_dynamics`; a consistent state comes from `project`.
        method: "proximal", on the Delassus matrix, or "partition", the paper's equation (5).
        pairs: What `partition` picked, for the second method; picked at q if left out, which costs more and may jump
            from one q to the next.

    Returns:
        vdot: As of `forward_dynamics`.
        lam: One entry per row of the closures, the wrench on frame a in the axes and at the origin of frame a [N m,
            N]; where it is not unique, the one with the least sum of squares.
        status: See `Status`.

    Source:
        formulas.md, "Loops".
    """
    if method not in ("proximal", "partition"):
        raise ValueError(f"constrained_dynamics: there is no method {method!r}; they are 'proximal' and 'partition'.")
    q, v, tau, gravity, f_ext = expect(chain, q=q, v=v, tau=tau, gravity=gravity, f_ext=f_ext)
    d = _feedback(chain, q, v, baumgarte)
    if method == "proximal":
        vdot, lam, *saved = _held(closed_aba_saving, chain, q, v, tau, gravity, f_ext, d)
        pairs = None
    else:
        pairs = partition(*jax.lax.stop_gradient((chain, q))) if pairs is None else pairs
        vdot, lam = _partitioned(chain, q, v, tau, gravity, f_ext, d, pairs)
        saved = system_of(*jax.lax.stop_gradient((chain, q))).saved
    return vdot, lam, _status(*jax.lax.stop_gradient((chain, q, v, vdot)), pairs, Saved(*saved))


def constrained_inverse_dynamics(
    chain: Chain,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    vdot: Float[Array, " nv"],
    *,
    actuated: Float[Array, " nv"] | None = None,
    weight: Float[Array, " nv"] | None = None,
    gravity: Float[Array, "3"] | None = None,
    f_ext: Float[Array, "n 6"] | None = None,
) -> tuple[Float[Array, " nv"], Float[Array, " nc"]]:
    """Forces for a motion of a closed chain, the smallest ones where the actuation is redundant.

    Args:
        chain, q, v, vdot, gravity, f_ext: As for `inverse_dynamics`; the motion keeps the loops closed.
        actuated: 1 for the entries of tau that a motor drives, 0 for those that must be zero; by default all joints,
            and not a free base.
        weight: Of the squares of the driven entries in the sum that tau makes least; ones by default, in N m and N.
            For a base that thrusters drive as well, say so in `actuated`.

    Returns:
        tau: With tau + K^T lam = `inverse_dynamics`. What the closures cannot take from the entries that are not driven
            is left in tau: a motion that needs it is not possible with these motors.
        lam: The multipliers that come with tau, the internal loads; the shortest, where tau does not decide.
    """
    q, v, vdot, gravity, f_ext = expect(chain, q=q, v=v, vdot=vdot, gravity=gravity, f_ext=f_ext)
    size = chain.capacity
    force = inverse_dynamics(chain, q, v, vdot, gravity=gravity, f_ext=f_ext)
    driven = (jnp.arange(chain.nv) >= size.base_nv) if actuated is None else jnp.asarray(actuated)
    driven = driven.astype(q.dtype)
    K, weight = loop_jacobian(chain, q), driven if weight is None else driven * weight
    tolerance = jnp.full(size.rows, 64 * (chain.nv + size.rows) * jnp.finfo(q.dtype).eps)

    def least(A, b):
        """x of A x = b in the sense of least squares, the shortest; and what takes away all that A sees."""
        G = A.T @ A
        dead = (jnp.diagonal(G) <= (64 * jnp.finfo(q.dtype).eps) ** 2 * jnp.trace(K @ K.T)).astype(q.dtype)
        inverse = lambda b: shortest(G, dead, tolerance, b)
        return inverse(A.T @ b), lambda z: z - inverse(G @ z)

    passive = K.T * (1 - driven)[:, None]
    lam, unseen = least(passive, force * (1 - driven))
    root = jnp.sqrt(weight)[:, None]
    rest = jax.vmap(unseen, 1, 1)(jnp.eye(size.rows, dtype=q.dtype))
    more, _ = least(root * (K.T @ rest), root[:, 0] * (force - K.T @ lam))
    lam = lam + rest @ more
    return force - K.T @ lam, lam


def _feedback(chain, q, v, rate):
    """K v̇ − k that Baumgarte asks for."""
    if rate is None:
        return jnp.zeros(chain.capacity.rows, q.dtype)
    return -2 * rate * closure_acceleration(chain, q, jnp.zeros_like(v), v) - rate**2 * loop_residual(chain, q)


def _held(kernel, chain, q, v, tau, gravity, f_ext, d):
    """vdot and lam, and what the kernel saves."""
    pose, structure, G, F = closed_operands(chain, q, gravity, f_ext)
    V0, qd = rates_of(chain, pose, v)
    f0, force = rates_of(chain, pose, tau)
    force = force - passive_force(chain, pose, qd)
    a0, qdd, lam, *saved = kernel(*structure, V0, qd, f0, force, G, F, d[:, None])
    return join(chain, pose, a0, qdd + spin(chain, qd)), lam[:, 0], *saved[1:]


@jax.custom_jvp
def _partitioned(chain, q, v, tau, gravity, f_ext, d, pairs):
    """vdot and lam."""
    rest = jnp.zeros_like(v)
    c = tau - inverse_dynamics(chain, q, v, rest, gravity=gravity, f_ext=f_ext)
    return partition_solve(chain, q, pairs, c, d - closure_acceleration(chain, q, v, rest))


@partial(_partitioned.defjvp, symbolic_zeros=True)
def _partitioned_tangent(primals, tangents):
    at, pairs = primals[:2], primals[-1]
    vdot, lam = _partitioned(*primals)
    c, d = _slope(lambda *x: _residual(*x, vdot, lam), primals[:-1], tangents[:-1])
    dvdot, y = partition_solve(*at, pairs, -c, -d)
    z, still = partition_solve(*at, pairs, jnp.zeros_like(vdot), lam)[0], jnp.zeros_like(vdot)
    turn = _slope(lambda *x: closure_acceleration(*x, still, z), at, tangents[:2])  # dK z, of lam = K z
    return (vdot, lam), (dvdot, y + unseen(*at, pairs, turn))


def _residual(chain, q, v, tau, gravity, f_ext, d, vdot, lam):
    F, opening = closure_forces(chain, q, v, vdot, lam)
    return inverse_dynamics_under(chain, q, v, vdot, gravity, f_ext, F) - tau, opening - d


def _slope(function, primals, tangents):
    """Derivative of `function` along the tangents that are not zero."""
    is_zero = lambda t: isinstance(t, jax.custom_derivatives.SymbolicZero) or t.dtype == jax.dtypes.float0
    (leaves, form), along = jax.tree.flatten(primals), jax.tree.leaves(tangents)
    at = [i for i, t in enumerate(along) if not is_zero(t)]
    if not at:
        return jax.tree.map(jnp.zeros_like, function(*primals))

    def f(*xs):
        full = list(leaves)
        for i, x in zip(at, xs, strict=True):
            full[i] = x
        return function(*jax.tree.unflatten(form, full))

    return jax.jvp(f, tuple(leaves[i] for i in at), tuple(along[i] for i in at))[1]


def closure_spectrum(saved: Saved):
    """Rank of the closures, their smallest singular value, and the largest over it: as in `Status`."""
    share, dead, tolerance = saved.judged[..., 0]
    count, eigenvalues = spectrum(saved.G[0, ..., 0], dead, tolerance, share)
    sigma = jnp.sqrt(jnp.maximum(eigenvalues[::-1], 0))
    least = jnp.where(count > 0, sigma[jnp.maximum(count - 1, 0)], 1.0)
    return count, least, jnp.where(count > 0, sigma[0], 1.0) / least


def _status(chain, q, v, vdot, pairs, saved: Saved) -> Status:
    count, least, ratio = closure_spectrum(saved)
    drift = jnp.abs(loop_residual(chain, q)).max(initial=0.0)
    noise = jnp.maximum(drift, 64 * jnp.finfo(q.dtype).eps)
    live = jnp.sum(chain.row_index[ClosureRow.LIVE])
    return Status(
        rank=count,
        redundant=count < live,
        sigma_min=least,
        condition=ratio,
        drift=drift,
        error=jnp.abs(closure_acceleration(chain, q, v, vdot)).max(initial=0.0),
        singular=least < 1e3 * noise,
        partition=jnp.ones_like(least) if pairs is None else condition(chain, q, pairs),
    )
