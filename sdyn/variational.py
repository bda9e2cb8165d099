"""One step of a variational integrator: the midpoint rule for the action, on the group of configurations.

The centre of mass is a coordinate of its own, and its motion is that of a point; what follows is about the motion
relative to it. A step of size h runs along a fixed increment h X of the tangent space (`coordinates.retract`):
rotations of the base and of spherical joints in body axes, everything else adds. With T(z, X) the kinetic energy at the
middle of the step, displaced by z, y = h X / 2 the half increment of a rotation, F the forces at the middle, and P the
momenta dual to X at the ends, seen from the middle (P0' = exp(-y) P0, P1' = exp(y) P1):
    c = h (dT/dz + F)                                                                       (1)
    dT/dX = S (P0' + c / 2) - a / 2 y x c,   S = 1 + b hat(y)^2                             (2)
    P1' = P0' + c                                                                           (3)
where a = (1 - cos t) / t^2 and b = (t - sin t) / t^3, t = |y|, come from the differential of exp; for what adds, S = 1
and a = 0. T does not change when the system turns or moves as a whole, so that total momentum is kept to rounding, and
energy without a trend. Closures hold at the ends: P0 + Kᵀ lam stands for P0, phi(q1) = 0, and K v = 0 behind the step.

Source: Marsden, West, Discrete mechanics and variational integrators (2001), sections 1.2, 2.3 and 3.5; on rotations
from the variation of exp(h X), as in Bou-Rabee, Marsden, Hamilton-Pontryagin integrators on Lie groups (2009).
"""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import lax

from sdyn.chain import Chain
from sdyn.closures import closure_acceleration, loop_jacobian, loop_residual, system_of
from sdyn.coordinates import increment_rate, join, on_rotations, pose_of, rates_of, retract
from sdyn.dynamics import inverse_dynamics, solve_mass
from sdyn.momentum import centre_of_mass, total_mass
from sdyn.rotation import exp, matrix
from sdyn.spatial import cross, mv

MOST = 50  # iterations for the velocity in the middle; as many as a step that is far too large may take
SLOPE = 24  # of the same iteration, for its derivative


def variational_step(chain: Chain, q, v, force, wrenches, gravity, guess, t, dt):
    """The state after a step.

    Args:
        chain, q, v: Structure and state.
        force, wrenches: Functions (t, q, v), evaluated in the middle of the step.
        gravity: As for `forward_dynamics`.
        guess: Of the velocity in the middle.
        t, dt: Time and size of the step.

    The velocity in the middle comes from M⁻¹ times what (2) misses, over and over until rounding stops it; in each turn
    the error shrinks by about dt times the rates. The derivative is the implicit one, by the same iteration.
    """
    rows, start = chain.capacity.rows, _momenta(chain, q, v)
    w0, P0 = _split(chain, q, start)
    if rows:
        system, K = system_of(chain, q), loop_jacobian(chain, q)
        of_w, of_P = jax.vmap(lambda row: _split(chain, q, _world(chain, q, row)))(K)

    def balance(x):
        """What (2), the path of the centre of mass and the closures miss, and how far the end is from where it goes."""
        (v, w, lam), end = x
        start_w, P = (w0 + lam @ of_w, P0 + lam @ of_P) if rows else (w0, P0)
        X = increment_rate(chain, retract(chain, q, dt / 2 * v), jnp.zeros_like(v), v)
        middle, last = (retract(chain, q, step * _lifted(chain, X, w)) for step in (dt / 2, dt))
        moving, now = v + _carried(chain, middle, w), t + dt / 2
        F, a = _forces(chain, middle, moving, force(now, middle, moving), wrenches(now, middle, moving), gravity)
        own, pull = jax.vjp(lambda z: _momenta(chain, retract(chain, middle, z), v), jnp.zeros_like(v))
        c = dt * (_inner(chain, pull(_world(chain, middle, v))[0] / 2) + F)
        y = dt / 2 * X
        before = on_rotations(chain, lambda y, P: _turned(-y, P), y, P)
        after = on_rotations(chain, lambda y, P: _turned(-y, P), y, before + c)
        missing = _body(chain, middle, own - on_rotations(chain, _mean, y, c, before + c / 2))
        last = _placed(chain, q, last, dt * w)
        opening = loop_residual(chain, last) if rows else lam
        found = last, start_w + dt * a, after
        return (missing, w - start_w - dt / 2 * a, opening), jax.tree.map(jnp.subtract, end, found)

    def solved(r):
        """x of the balance's slope times x = r, but for a share of about dt times the rates."""
        (missing, path, opening), end = r
        if not rows:
            return (solve_mass(chain, q, missing), path, opening), end
        x, lam = system.solve(missing, opening / jnp.where(dt == 0, 1, dt) - K @ _carried(chain, q, path))
        push = lam @ of_w
        return (x - _carried(chain, q, push), path + push, lam), end

    middle = guess - _carried(chain, q, w0), w0, jnp.zeros(rows, q.dtype)
    _, (end, w, P) = _root(balance, solved, (middle, (q, w0, P0)))
    v = _with_momenta(chain, end, w, P, start)
    if rows:
        still = jnp.zeros_like(v)
        v = v + system_of(chain, end).solve(still, -closure_acceleration(chain, end, still, v))[0]
    return end, v


def _root(f, solved, guess):
    """x of f(x) = 0; `solved` nearly inverts the slope of f, and the first array of x tells when it is there."""
    size = lambda x: jnp.abs(jax.tree.leaves(x)[0]).max()

    def more(state):
        x, change, last, count = state
        eps, shrinks = jnp.finfo(change.dtype).eps, change < last
        least = jnp.where(shrinks, 2 * eps, jnp.sqrt(eps)) * size(x)  # near rounding it must shrink
        return (count < MOST) & (change > least)

    def solve(f, x):
        def turn(state):
            x, change, _, count = state
            step = solved(f(x))
            return jax.tree.map(jnp.subtract, x, step), size(step), change, count + 1

        far = jnp.full_like(size(x), jnp.finfo(size(x).dtype).max)
        return lax.while_loop(more, turn, (x, far / 2, far, 0))[0]

    def slope(g, y):
        def turn(x, _):
            rest = jax.tree.map(jnp.subtract, y, g(x))
            return jax.tree.map(jnp.add, x, solved(rest)), None

        return lax.scan(turn, jax.tree.map(jnp.zeros_like, y), None, SLOPE)[0]

    return lax.custom_root(f, guess, solve, slope)


def _with_momenta(chain, q, w, P, start):
    """The velocity of given momenta; a step of refinement, so that rounding does not add up over many steps, and the
    linear momentum at the start is not rounded twice."""
    v = solve_mass(chain, q, _body(chain, q, P))
    if chain.capacity.base_nv:
        whole = _carried(chain, q, w)
        more = total_mass(chain) * (w - start[3:6] / total_mass(chain))
        P = (P + _momenta(chain, q, whole)).at[3:6].set(chain.free * (start[3:6] + more))
        v = v + whole
    return v + solve_mass(chain, q, _body(chain, q, P - _momenta(chain, q, v)))


def _momenta(chain, q, v):
    """Momenta dual to increments: M v, the base's linear part in world axes."""
    bare = replace(chain, dof_value=chain.dof_value.at[:2].set(0))  # without springs and dampers
    return _world(chain, q, inverse_dynamics(bare, q, jnp.zeros_like(v), v))


def _split(chain, q, P):
    """The velocity of the centre of mass, and momenta without it."""
    if chain.capacity.base_nv == 0:
        return jnp.zeros(3, P.dtype), P
    w = P[3:6] / total_mass(chain) * chain.free
    return w, (P - _momenta(chain, q, _carried(chain, q, w))).at[3:6].set(0)


def _forces(chain, q, v, tau, f_ext, gravity):
    """Generalised forces relative to the centre of mass, and its acceleration."""
    rest, pose = jnp.zeros_like(v), pose_of(chain, q)
    _, qd = rates_of(chain, pose, v)
    drag = join(chain, pose, jnp.zeros((6, 1), v.dtype), chain.dof_value[0][:, None] * qd)
    a = jnp.zeros(3, v.dtype)
    if chain.capacity.base_nv:
        total = pose.R @ tau[3:6] + (0 if f_ext is None else f_ext[:, 3:].sum(0))
        a = chain.free * (total / total_mass(chain) + (0 if gravity is None else gravity))
    falling = _carried(chain, q, a)
    F = tau - drag - inverse_dynamics(chain, q, rest, falling, gravity=gravity, f_ext=f_ext)
    return (F.at[3:6].set(0) if chain.capacity.base_nv else F), a


def _placed(chain, q, end, travel):
    """The configuration `end`, moved so that its centre of mass is `travel` away from that of q."""
    if chain.capacity.base_nv == 0:
        return end
    return end.at[:3].add(chain.free * (centre_of_mass(chain, q) + travel - centre_of_mass(chain, end)))


def _carried(chain, q, w):
    """The velocity of a system that moves as a whole, with w in world axes."""
    v = jnp.zeros(chain.nv, w.dtype)
    return v.at[3:6].set(w @ pose_of(chain, q).R) if chain.capacity.base_nv else v


def _lifted(chain, X, w):
    return X.at[3:6].add(w) if chain.capacity.base_nv else X


def _inner(chain, c):
    """Without the part of the base: kinetic energy does not depend on its pose."""
    return c.at[:6].set(0) if chain.capacity.base_nv else c


def _world(chain, q, p):
    """Momenta with the base's linear part turned to world axes."""
    return p.at[3:6].set(pose_of(chain, q).R @ p[3:6]) if chain.capacity.base_nv else p


def _body(chain, q, P):
    """And back to the base's."""
    return P.at[3:6].set(P[3:6] @ pose_of(chain, q).R) if chain.capacity.base_nv else P


def _turned(theta, x):
    """exp(theta) x."""
    return mv(matrix(exp(theta)), x)


def _mean(y, c, P):
    """S P - a / 2 y x c of (2)."""
    t2 = (y * y).sum(0)
    small = t2 < 0.5
    t = jnp.sqrt(jnp.where(small, 1.0, t2))
    series = lambda n: sum((-t2) ** k / math.factorial(2 * k + n) for k in range(8))
    a = jnp.where(small, series(2), (1 - jnp.cos(t)) / t**2)
    b = jnp.where(small, series(3), (t - jnp.sin(t)) / t**3)
    return P + b * cross(y, cross(y, P)) - a / 2 * cross(y, c)
