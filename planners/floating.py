"""Motion of an unactuated base, from momentum.

With M(q_j) = [[M_bb, M_bj], [., M_jj]] of the joints alone (base axes, base origin), I the inertia about the centre of
mass c, A the angular momentum about c of unit joint rates, and the momenta P, L (about c) in world axes:

    L_B = I w + A qd        w = I^-1 (R^T L - A qd)
    P_B = m (v - c x w) + M_vj qd        v = (R^T P - M_vj qd) / m + c x w
    R' = R hat(w), by Munthe-Kaas RK4;  p = (c_0 + P t / m) - R c, without integration.

All that depends on the joints is computed for all points at once; the scan over time holds 3x3 algebra only.
Source: Yoshida and Umetani, momentum of free-floating manipulators; Munthe-Kaas, Runge-Kutta methods on Lie groups.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sdyn
from planners.motion import continuous, quaternions

_HAT = np.cross(np.eye(3)[:, None], np.eye(3)[None]).transpose(2, 1, 0)  # hat(x) = _HAT x
STAGES = np.array([[0, 1 / 6], [1 / 2, 1 / 3], [1 / 2, 1 / 3], [1, 1 / 6]])  # of RK4: time and weight
SERIES_BELOW = 1e-2  # rad^2; below, five terms of the series of the exponential are exact to the last digit


class Coupling(NamedTuple):
    """What the base's motion needs from the mass matrix, base axes; leading axes are points."""

    mass: jax.Array  # kg
    centre: jax.Array  # [3] m, from the base origin
    compliance: jax.Array  # [3, 3] I^-1 about the centre of mass, 1 / (kg m^2)
    angular: jax.Array  # [3, joints] A, kg m^2 per rad/s
    linear: jax.Array  # [3, joints] M_vj, kg m per rad/s


class Momentum(NamedTuple):
    """Total momentum, and where the centre of mass is at one instant; world axes."""

    centre: jax.Array  # [3] m
    linear: jax.Array  # [3] N s
    angular: jax.Array  # [3] N m s, about the centre of mass


AT_REST = Momentum(*np.zeros((3, 3)))


def hat(x):
    """Cross-product matrix [3, 3] of x [3]."""
    return jnp.dot(_HAT.astype(x.dtype), x)


def cross(a, b):
    """Cross product, [3]; of few operations, since it is compiled in so many places."""
    (a1, a2), (b1, b2) = _turned(a), _turned(b)
    return a1 * b2 - a2 * b1


def _turned(x):
    """Entries (1, 2, 0) and (2, 0, 1)."""
    twice = jnp.concatenate([x, x])
    return twice[1:4], twice[2:5]


def inverse(S):
    """Inverse of a 3x3 matrix by its columns' cross products."""
    rows = jnp.array([cross(S[:, 1], S[:, 2]), cross(S[:, 2], S[:, 0]), cross(S[:, 0], S[:, 1])])
    return rows / (S[:, 0] @ rows[0])


def exponential(theta):
    """Rotation exp(hat(theta)), [3, 3], smooth at zero."""
    x = theta @ theta
    small = x < SERIES_BELOW
    angle = jnp.sqrt(jnp.where(small, 1.0, x))
    a = jnp.where(small, 1 - x / 6 * (1 - x / 20 * (1 - x / 42 * (1 - x / 72))), jnp.sin(angle) / angle)
    b = jnp.where(small, 0.5 - x / 24 * (1 - x / 30 * (1 - x / 56 * (1 - x / 90))), (1 - jnp.cos(angle)) / angle**2)
    K = hat(theta)
    return jnp.eye(3, dtype=theta.dtype) + a * K + b * (K @ K)


def logarithm(R):
    """Twice the vector part of R's quaternion, [3]: the rotation vector to third order, smooth below half a turn."""
    skew = jnp.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return skew / jnp.sqrt(1 + jnp.trace(R))


def rotation(quat):
    """Matrix [3, 3] of a unit quaternion wxyz."""
    w, x = quat[0], quat[1:]
    K = hat(x)
    return jnp.eye(3, dtype=quat.dtype) + 2 * w * K + 2 * K @ K


def quaternion(R):
    """Unit quaternion wxyz of a rotation [3, 3], from the largest of its entries; not to be differentiated."""
    t = jnp.trace(R)
    four = jnp.array([t, R[0, 0], R[1, 1], R[2, 2]])
    s = jnp.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    S = R + R.T
    rows = jnp.array(
        [
            [1 + t, s[0], s[1], s[2]],
            [s[0], 1 + 2 * R[0, 0] - t, S[0, 1], S[0, 2]],
            [s[1], S[0, 1], 1 + 2 * R[1, 1] - t, S[1, 2]],
            [s[2], S[0, 2], S[1, 2], 1 + 2 * R[2, 2] - t],
        ]
    )
    row = rows[jnp.argmax(four)]
    return row / jnp.linalg.norm(row)


def at_rest(joints):
    """Configuration with the base at the identity, [7 + joints]."""
    return jnp.concatenate([jnp.array([0.0, 0, 0, 1, 0, 0, 0], joints.dtype), joints])


def coupling(M) -> Coupling:
    """Reads the base's coupling off one mass matrix M [nv, nv]."""
    mass = M[3, 3]
    centre = jnp.array([M[2, 4], M[0, 5], M[1, 3]]) / mass
    inertia = M[:3, :3] + mass * hat(centre) @ hat(centre)
    return Coupling(mass, centre, inverse(inertia), M[:3, 6:] - hat(centre) @ M[3:6, 6:], M[3:6, 6:])


def base_twist(c: Coupling, R, rates, momentum: Momentum):
    """Twist [w; v] of the base, base axes, from the attitude and the joint rates."""
    w = c.compliance @ (R.T @ momentum.angular - c.angular @ rates)
    v = (R.T @ momentum.linear - c.linear @ rates) / c.mass + cross(c.centre, w)
    return jnp.concatenate([w, v])


def base_position(c: Coupling, R, time, momentum: Momentum):
    """Position [3] of the base origin, `time` seconds after the momentum's instant."""
    return momentum.centre + momentum.linear * (time / c.mass) - R @ c.centre


def advance(R, compliance, drive, angular, step, moments=None):
    """One step of Munthe-Kaas RK4 of R' = R hat(w), w = J R^T L + g, L' = R n.

    Args:
        R: Attitude [3, 3].
        compliance, drive: J and g at the start, middle and end of the step, three of each.
        angular: L [3] at the start, world axes.
        step: Length of the step [s].
        moments: n as J and g, base axes; None for none.

    Returns:
        R and L at the end.
    """
    momentum = R.T @ angular

    def stage(carry, row):  # a loop: it is compiled once, not once a stage
        (k, gain), total = carry
        (part, weight), J, g, n = row
        theta = part * step * k
        back = exponential(-theta)
        w = J @ (back @ (momentum if n is None else momentum + part * step * gain)) + g
        turn = cross(theta, w)
        rates = w + turn / 2 + cross(theta, turn) / 12, None if n is None else back.T @ n
        return (rates, jax.tree.map(lambda x, rate: x + weight * rate, total, rates)), None

    along = lambda x: jnp.stack([x[0], x[1], x[1], x[2]])
    still = jnp.zeros_like(momentum)
    still = still, None if moments is None else still
    rows = STAGES.astype(momentum.dtype), along(compliance), along(drive), None if moments is None else along(moments)
    (_, (mean, gained)), _ = jax.lax.scan(stage, (still, still), rows)
    return R @ exponential(step * mean), angular if gained is None else angular + step * R @ gained


def attitudes(R0, compliance, drive, angular, steps):
    """Attitudes [k + 1, 3, 3] along a grid: the arguments of `advance`, for k steps each."""
    k = len(steps)
    stages = jnp.concatenate([x.reshape(k, -1) for x in (*compliance, *drive, angular, steps)], axis=1)
    return march(_step, R0.ravel(), stages).reshape(k + 1, 3, 3)


def _step(x):
    """`advance` of its arguments in one row [49], as a row [9]."""
    R, J, g, angular = x[:9].reshape(3, 3), x[9:36].reshape(3, 3, 3), x[36:45].reshape(3, 3), x[45:48]
    return advance(R, J, g, angular, x[48])[0].ravel()


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def march(step, first, stages):
    """States [k + 1, m] from the first one [m] and the other arguments of each step [k, ...], a row both for `step`.

    Its derivative is one small Jacobian per step, all made at once, and a loop of matrix products.
    """

    def onwards(state, stage):
        state = step(jnp.concatenate([state, stage]))
        return state, state

    _, states = jax.lax.scan(onwards, first, stages)
    return jnp.concatenate([first[None], states])


@march.defjvp
def _(step, primals, tangents):
    states, m = march(step, *primals), len(primals[0])
    J = jax.vmap(jax.jacfwd(step))(jnp.concatenate([states[:-1], primals[1]], axis=1))
    causes = jnp.einsum("kij,kj->ki", J[:, :, m:], tangents[1])
    _, changes = jax.lax.scan(lambda d, row: (row[0] @ d + row[1],) * 2, tangents[0], (J[:, :, :m], causes))
    return states, jnp.concatenate([tangents[0][None], changes])


def thirds(x):
    """What a grid of points and midpoints [2 k + 1, ...] holds at the start, middle and end of its k steps."""
    return x[:-1:2], x[1::2], x[2::2]


def locally(f):
    """A function of a chain and a point x [m], over points [k, m], whose derivative is one small Jacobian per point.

    A tangent of the whole batch is then one matrix product, whatever the kernels inside f cost; the chains, stacked
    [k, ...] or one for all points, are constants, or what else f takes in their place.
    """
    over = lambda chains: (0 if isinstance(chains, sdyn.Chain) and chains.base_value.ndim == 2 else None, 0)

    @jax.custom_jvp
    def batch(chains, x):
        return jax.vmap(f, over(chains))(chains, x)

    @batch.defjvp
    def _(primals, tangents):
        twice = lambda chain, x: (f(chain, x),) * 2
        J, y = jax.vmap(jax.jacfwd(twice, 1, has_aux=True), over(primals[0]))(*primals)
        return y, jnp.einsum("kij,kj->ki", J, tangents[1])

    return batch


@locally
def _couplings(chain, q):
    """Entries of the coupling, one after the other."""
    return jnp.concatenate([x.ravel() for x in coupling(sdyn.mass_matrix(chain, at_rest(q)))])


@locally
def _wrenches(chain, x):
    """Forces for joint positions, velocities and joint accelerations x, with the base not accelerated."""
    n = (len(x) - 6) // 3
    return sdyn.inverse_dynamics(chain, at_rest(x[:n]), x[n : 2 * n + 6], jnp.r_[jnp.zeros(6), x[2 * n + 6 :]])


def couplings(chains, q) -> Coupling:
    """Couplings at joint positions q [k, n] of one chain, or of as many stacked chains."""
    k, n = q.shape
    parts = jnp.split(_couplings(chains, q), np.cumsum([1, 3, 9, 3 * n]), axis=1)
    shapes = ((k,), (k, 3), (k, 3, 3), (k, 3, n), (k, 3, n))
    return Coupling(*(x.reshape(shape) for x, shape in zip(parts, shapes, strict=True)))


def drift(c: Coupling, rates):
    """Angular velocity of the base that the joint rates alone cause, at points, [k, 3]."""
    return -jnp.einsum("kij,kjl,kl->ki", c.compliance, c.angular, rates)


def free_torques(chains, c: Coupling, joints, v, accelerations, floats=1.0, push=None):
    """Joint torques and accelerations of free-floating motion without external forces but for a push on the base.

    Args:
        chains, c: The chain, or k stacked ones, and k couplings.
        joints, v, accelerations: Joint positions [k, n], velocities [k, nv], joint accelerations [k, n].
        floats: 0 if the base is held at rest instead.
        push: Moment about the base's origin and force [k, 6], base axes; None for none.

    Returns:
        (tau [k, n], vdot [k, nv]): torques [N m] and accelerations of the components of v.
    """
    wrench = _wrenches(chains, jnp.concatenate([joints, v, accelerations], axis=1))
    wrench = wrench if push is None else wrench.at[:, :6].add(-push)

    def one(c, wrench, qdd):
        push = -floats * wrench[3:6] / c.mass  # acceleration that the centre of mass lacks
        turn = -floats * c.compliance @ (wrench[:3] - cross(c.centre, wrench[3:6]))
        tau = wrench[6:] + c.angular.T @ turn + c.linear.T @ push
        return tau, jnp.concatenate([turn, push + cross(c.centre, turn), qdd])

    return jax.vmap(one)(c, wrench, accelerations)


class Motion(NamedTuple):
    """One phase on its grid of k + 1 points; the base before and the joints after."""

    times: jax.Array  # [k + 1] s
    R: jax.Array  # [k + 1, 3, 3]
    p: jax.Array  # [k + 1, 3]
    q: jax.Array  # [k + 1, n]
    v: jax.Array  # [k + 1, 6 + n]
    vdot: jax.Array  # [k + 1, 6 + n]
    tau: jax.Array  # [k + 1, n]
    push: jax.Array | None = None  # [k + 1, 6] moment about the base's origin and force, base axes


def holding(chain, at: Motion):
    """Moment and force [k, 6] that hold the base at rest, about its origin, base axes; N m, N."""
    return _wrenches(chain, jnp.concatenate([at.q, at.v, at.vdot[:, 6:]], axis=1))[:, :6]


def at_zero_momentum(chain, path, times, floats=1.0) -> Motion:
    """Motion without momentum of a robot whose base starts at the world's origin, in its axes.

    Args:
        chain: Packed structure.
        path: Joint positions, rates and accelerations at grid points and midpoints, [2 k + 1, n] each.
        times: Grid points [k + 1], from zero [s].
        floats: 1; or 0, and the base is held where it starts. May be traced.
    """
    c, steps, still = couplings(chain, path[0]), jnp.diff(times), jnp.zeros((len(times) - 1, 3))
    R = attitudes(jnp.eye(3), thirds(c.compliance), thirds(floats * drift(c, path[1])), still, steps)
    c, (q, rate, acceleration) = jax.tree.map(lambda a: a[::2], (c, path))
    momentum = Momentum(c.centre[0], jnp.zeros(3), jnp.zeros(3))
    p = floats * jax.vmap(base_position, (0, 0, 0, None))(c, R, times, momentum)
    v = jnp.concatenate([floats * jax.vmap(base_twist, (0, 0, 0, None))(c, R, rate, momentum), rate], axis=1)
    tau, vdot = free_torques(chain, c, q, v, acceleration, floats)
    return Motion(times, R, p, q, v, vdot, tau)


def path_quaternions(R):
    """Unit quaternions [k, 4] along a path of rotations, without jumps of sign."""
    return continuous(quaternions(np.asarray(R)))


class Tumble(NamedTuple):
    """Torque-free motion of one rigid body, tabulated so that it can be asked for at any time, with its rate."""

    rotations: jax.Array  # [n, 3, 3] attitudes every `step` seconds
    step: jax.Array  # s
    coupling: Coupling
    momentum: Momentum


def tumble(chain, q, v, horizon, step) -> Tumble:
    """Tabulates the motion of a free robot without moving joints from state q [7], v [6], for `horizon` seconds."""
    c = coupling(sdyn.mass_matrix(chain, at_rest(q[7:])))
    momentum = initial_momentum(c, q, v)
    count = int(np.ceil(horizon / step)) + 1
    along = lambda x: jnp.broadcast_to(x, (count, *x.shape))
    J, g = (along(c.compliance),) * 3, (jnp.zeros((count, 3)),) * 3
    table = attitudes(rotation(q[3:7]), J, g, along(momentum.angular), along(jnp.asarray(step)))
    return Tumble(table, jnp.asarray(step), c, momentum)


def tumbled(body: Tumble, time):
    """Attitude [3, 3], position [3] and twist [6] (base axes) of the body at a time, which may be traced."""
    R = _attitude(body, time)
    p = base_position(body.coupling, R, time, body.momentum)
    return R, p, base_twist(body.coupling, R, jnp.zeros(0), body.momentum)


@jax.custom_jvp
def _attitude(body: Tumble, time):
    """Attitude of the body, a constant, at a time; its derivative is that of the motion, R hat(w)."""
    cell = jnp.clip(jnp.floor(time / body.step).astype(int), 0, len(body.rotations) - 2)
    J, g = (body.coupling.compliance,) * 3, (jnp.zeros(3),) * 3
    return advance(body.rotations[cell], J, g, body.momentum.angular, time - cell * body.step)[0]


@_attitude.defjvp
def _(primals, tangents):
    body, R = primals[0], _attitude(*primals)
    return R, R @ hat(body.coupling.compliance @ (R.T @ body.momentum.angular)) * tangents[1]


def initial_momentum(c: Coupling, q, v) -> Momentum:
    """Momentum of a robot with coupling c in state q [nq], v [nv]."""
    R, w, rates = rotation(q[3:7]), v[:3], v[6:]
    angular = inverse(c.compliance) @ w + c.angular @ rates
    linear = c.mass * (v[3:6] - cross(c.centre, w)) + c.linear @ rates
    return Momentum(q[:3] + R @ c.centre, R @ linear, R @ angular)


def momentum_sum(masses, momenta) -> Momentum:
    """Momentum of several separate systems at one instant: c = sum m c / sum m, L = sum [L + (c_i - c) x P]."""
    total = sum(masses)
    centre = sum(m * x.centre for m, x in zip(masses, momenta, strict=True)) / total
    angular = sum(x.angular + cross(x.centre - centre, x.linear) for x in momenta)
    return Momentum(centre, sum(x.linear for x in momenta), angular)
