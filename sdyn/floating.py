"""A free base that only reacts: its motion from total momentum, and the equations of the joints alone.

With M = [[M_bb, M_bj], [M_jb, M_jj]], the total momentum h about the base's origin, in its axes, and the base wrench f:

    base        M_bb v_b = h − M_bj q̇                  M_bb v̇_b = f − b_b − M_bj q̈
    joints      M* q̈ + b* = τ,                          M* = M_jj − M_jb M_bb⁻¹ M_bj,  b* = b_j − M_jb M_bb⁻¹ b_b
    frame       V = J* q̇ at zero momentum,              J* = J_j − J_b M_bb⁻¹ M_bj
    null space  N = 1 − M_bj⁺ M_bj                      joint rates N x leave the base at rest

The base block is a rigid body's, [[I − m ĉ ĉ, m ĉ], [−m ĉ, m]] with ĉ x = c x x, so it is solved about the centre of
mass c: one 3x3 inverse. For a grounded base all of it is zero, and the joints stand alone.

A closure between two links has no columns for the base (K_b = 0), so closed chains add K_jᵀ lam to τ and K_j q̈ = k to
the joints' equations and leave the rest as it is. A closure to ground exchanges momentum, like a grounded base.

Source: Umetani and Yoshida, Resolved motion rate control of space manipulators (1989); Nenchev, Umetani and Yoshida,
Analysis of a redundant free-flying spacecraft/manipulator system (1992).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sdyn.chain import Chain
from sdyn.closures import loop_jacobian, loop_residual
from sdyn.constraints import forward_dynamics
from sdyn.coordinates import live_entries, pose_of
from sdyn.dynamics import inverse_dynamics, mass_matrix
from sdyn.inputs import expect
from sdyn.kinematics import frame_jacobian


def floating_velocity(
    chain: Chain, q: Float[Array, " nq"], rates: Float[Array, " joints"], momentum: Float[Array, "6"] | None = None
) -> Float[Array, " nv"]:
    """The velocity at given joint rates and total momentum.

    Args:
        chain: Packed structure; a grounded base rests, whatever the momentum.
        q: Configuration [m, rad, unit quaternion wxyz].
        rates: Joint rates, v without its base block [rad/s, m/s].
        momentum: Angular about the centre of mass, and linear, world axes [N m s, N s]; zero by default. The inverse
            of `sdyn.momentum`.

    Returns:
        v.
    """
    q, rates, momentum = expect(chain, q=q, rates=rates, momentum=momentum)
    base = _base(chain, mass_matrix(chain, q))
    h = -base.across @ rates
    if momentum is not None:
        R = pose_of(chain, q).R
        L, P = R.T @ momentum[:3], R.T @ momentum[3:]
        h = h + jnp.concatenate([L + jnp.cross(base.centre, P), P])
    return _with_base(chain, _solve(base, h), rates)


def floating_forward_dynamics(
    chain: Chain,
    q: Float[Array, " nq"],
    rates: Float[Array, " joints"],
    tau: Float[Array, " joints"],
    momentum: Float[Array, "6"] | None = None,
    *,
    gravity: Float[Array, "3"] | None = None,
    f_ext: Float[Array, "n 6"] | None = None,
) -> tuple[Float[Array, " nv"], Float[Array, " nv"]]:
    """Velocity and acceleration of a robot whose base no actuator moves, at given total momentum.

    Args:
        chain: Packed structure.
        q, rates, momentum: As for `floating_velocity`.
        tau: Joint forces [N m, N].
        gravity, f_ext: As for `forward_dynamics`.

    Returns:
        v, vdot: The base's part is its motion, the rest the joint rates and accelerations.
    """
    (tau,) = expect(chain, torques=tau)
    v = floating_velocity(chain, q, rates, momentum)
    force = _with_base(chain, jnp.zeros(6, tau.dtype), tau)
    return v, forward_dynamics(chain, q, v, force, gravity=gravity, f_ext=f_ext)


def floating_inverse_dynamics(
    chain: Chain,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    accelerations: Float[Array, " joints"],
    *,
    wrench: Float[Array, "6"] | None = None,
    gravity: Float[Array, "3"] | None = None,
    f_ext: Float[Array, "n 6"] | None = None,
) -> tuple[Float[Array, " nv"], Float[Array, " nv"]]:
    """Joint forces that cause given joint accelerations, and how the base reacts.

    Args:
        chain: Packed structure.
        q, v: State.
        accelerations: Joint accelerations, vdot without its base block [rad/s^2, m/s^2].
        wrench: [n; f] on the base, about its origin and in its axes [N m, N]; none by default.
        gravity, f_ext: As for `inverse_dynamics`.

    Returns:
        tau, vdot: `tau` starts with the wrench. `forward_dynamics` of the first is the second. In a closed chain the
        closures carry nothing under tau; `constrained_inverse_dynamics` of vdot has the smallest forces.
    """
    q, v, accelerations, wrench = expect(chain, q=q, v=v, accelerations=accelerations, wrench=wrench)
    wrench = jnp.zeros(6, q.dtype) if wrench is None else wrench
    base = _base(chain, mass_matrix(chain, q))
    at_rest = _with_base(chain, jnp.zeros(6, q.dtype), accelerations)
    f = inverse_dynamics(chain, q, v, at_rest, gravity=gravity, f_ext=f_ext)
    joints = f[chain.capacity.base_nv :]
    reaction = _solve(base, wrench - f[:6] if chain.capacity.base_nv else wrench)
    tau = _with_base(chain, wrench * chain.free, joints + base.across.T @ reaction)
    return tau, _with_base(chain, reaction, accelerations)


def reduced_dynamics(
    chain: Chain,
    q: Float[Array, " nq"],
    rates: Float[Array, " joints"],
    momentum: Float[Array, "6"] | None = None,
    *,
    gravity: Float[Array, "3"] | None = None,
    f_ext: Float[Array, "n 6"] | None = None,
) -> tuple[Float[Array, "joints joints"], Float[Array, " joints"]]:
    """Mass matrix and bias of the joints alone, the base eliminated by total momentum: M* q̈ + b* = τ.

    Args:
        chain: Packed structure.
        q, rates, momentum: As for `floating_velocity`.
        gravity, f_ext: As for `forward_dynamics`.

    Returns:
        M*, symmetric and positive on the joints that move; b*. Both of the tree; closures add their K^T lam to tau.
    """
    v = floating_velocity(chain, q, rates, momentum)
    M, nb = mass_matrix(chain, q), chain.capacity.base_nv
    b = inverse_dynamics(chain, q, v, jnp.zeros_like(v), gravity=gravity, f_ext=f_ext)
    base = _base(chain, M)
    turn, push = _about_centre(base)
    reduced = M[nb:, nb:] - turn.T @ base.compliance @ turn - push.T @ push / base.mass
    return reduced, b[nb:] - base.across.T @ _solve(base, b[:6]) if nb else b


def generalised_jacobian(chain: Chain, q: Float[Array, " nq"], frame) -> Float[Array, "6 joints"]:
    """Jacobian of a frame with respect to the joints alone, the free base reacting at zero momentum.

    Args:
        chain: Packed structure; the plain joint Jacobian when the base is grounded.
        q: Configuration.
        frame: Name, or index, which may be traced.

    Returns:
        J_j - J_b M_bb^-1 M_bj, angular rows first, world axes, at the frame's origin.
    """
    (q,) = expect(chain, q=q)
    J = frame_jacobian(chain, q, frame)
    if chain.capacity.base_nv == 0:
        return J
    base = _base(chain, mass_matrix(chain, q))
    return J[:, 6:] - J[:, :6] @ jax.vmap(lambda column: _solve(base, column), 1, 1)(base.across)


def reaction_null_space(
    chain: Chain, q: Float[Array, " nq"], *, rtol: float | None = None
) -> tuple[Float[Array, "joints joints"], Int[Array, ""]]:
    """Projector onto the joint rates that leave the free base at rest, at zero momentum, and the loops closed.

    Args:
        chain: Packed structure; every rate that its loops allow leaves a grounded base at rest.
        q: Configuration.
        rtol: What counts as no reaction and as no motion in a closure, as a part of the trace of the robot's own
            inertia and of its radius of gyration; by default 1000 eps, or ten times what the loops are open by.

    Returns:
        N, rank: N is symmetric, N N = N, zero where empty, orthogonal in joint rates (so it depends on units where
        joints that turn and joints that slide are mixed); rank is that of the reaction M_bj and of the closures
        together. Differentiable where the rank does not change; where it does, N jumps.
    """
    (q,) = expect(chain, q=q)
    base, moves = _base(chain, mass_matrix(chain, q)), live_entries(chain)[chain.capacity.base_nv :]
    size = 1 / jnp.trace(base.compliance)  # an inertia; with the mass, a length
    turn, push = _about_centre(base)
    A = jnp.concatenate([turn / size, push / jnp.sqrt(size * base.mass)])
    if A.size == 0:
        return jnp.zeros((0, 0), A.dtype), jnp.array(0)
    tol = 1000 * jnp.finfo(A.dtype).eps
    if chain.capacity.rows:
        K, length = loop_jacobian(chain, q)[:, chain.capacity.base_nv :], jnp.sqrt(size / base.mass)
        A = jnp.concatenate([A, K / jnp.maximum(1, length)])
        tol = jnp.maximum(tol, 10 * jnp.abs(loop_residual(chain, q)).max())
    N, rank = _null_projector(A, tol if rtol is None else rtol)
    return N * moves * moves[:, None], rank


# ---- parts -----------------------------------------------------------------------------------------------------------


class _Base(NamedTuple):
    """The base block of M as a rigid body's, and the blocks beside it."""

    free: jnp.ndarray
    mass: jnp.ndarray
    centre: jnp.ndarray
    """[3] m, from the base's origin, base axes."""
    compliance: jnp.ndarray
    """[3, 3], inverse of the inertia about the centre, 1 / (kg m^2)."""
    across: jnp.ndarray
    """M_bj [6, joints]: momentum of unit joint rates, about the base's origin."""


def _base(chain, M) -> _Base:
    """Read off a mass matrix; a grounded base is replaced by one of unit inertia, for finite derivatives."""
    if chain.capacity.base_nv == 0:
        M = jnp.pad(M, ((6, 0), (6, 0)))
    free = chain.free
    mass = jnp.where(free == 1, M[3, 3], 1)
    centre = jnp.stack([M[2, 4], M[0, 5], M[1, 3]]) / mass
    hat = jnp.cross(jnp.eye(3, dtype=M.dtype), centre)  # rows e x c: hat(c)
    inertia = jnp.where(free == 1, M[:3, :3] + mass * hat @ hat, jnp.eye(3, dtype=M.dtype))
    return _Base(free, mass, centre, _inverse3(inertia), M[:6, 6:])


def _inverse3(S):
    """Inverse of a matrix [3, 3], by cross products of its columns."""
    a, b, c = S.T
    rows = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])
    return rows / (a @ rows[0])


def _solve(base: _Base, f):
    """M_bb^-1 f of a wrench or momentum f = [n; f] about the base's origin; zero if grounded."""
    w = base.compliance @ (f[:3] - jnp.cross(base.centre, f[3:]))
    return jnp.concatenate([w, f[3:] / base.mass + jnp.cross(base.centre, w)]) * base.free


def _about_centre(base: _Base):
    """Angular momentum about the centre, and linear, of unit joint rates with the base at rest [3, joints]."""
    push = base.across[3:]
    return base.across[:3] - jnp.cross(base.centre[:, None], push, axis=0), push


def _with_base(chain, base, joints):
    """The two parts in one vector, laid out like v."""
    return joints if chain.capacity.base_nv == 0 else jnp.concatenate([base, joints])


@jax.custom_jvp
def _null_projector(A, tol):
    """1 − A⁺ A from the singular values above `tol`, and their number."""
    _, s, Vt = jnp.linalg.svd(A, full_matrices=False)
    kept = s > tol
    return jnp.eye(A.shape[1], dtype=A.dtype) - (Vt.T * kept) @ Vt, kept.sum()


@_null_projector.defjvp
def _null_projector_jvp(primals, tangents):
    """At constant rank dN = −X − Xᵀ with X = A⁺ dA N (Golub and Pereyra, 1973); that of A⁺ is jnp.linalg.pinv's."""
    (A, tol), (dA, _) = primals, tangents
    N, rank = _null_projector(A, tol)
    largest = jnp.maximum(jnp.linalg.norm(jax.lax.stop_gradient(A), 2), jnp.finfo(A.dtype).tiny)
    X = jnp.linalg.pinv(A, rtol=tol / largest) @ dA @ N
    return (N, rank), (-X - X.T, jnp.zeros(rank.shape, jax.dtypes.float0))
