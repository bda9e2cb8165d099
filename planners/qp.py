"""A dense convex quadratic programme with elastic constraints, by Mehrotra's primal-dual interior point.

    minimise    g.d + d.H d / 2 + penalty (sum |A d + a| + sum max(0, C d + c))
    subject to  lower <= d <= upper

Written with p, n >= 0 for A d + a = p - n, t >= 0 for C d + c <= t; these and the slacks are eliminated by hand, so
each step factors one matrix of the size of d and a. It always has a solution, and every multiplier stays below the
penalty: an infeasible linearisation shows itself as a multiplier at the penalty, not as a failure.

Source: Mehrotra (1992), On the implementation of a primal-dual interior point method; Fletcher's S l1 QP.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

ITERATIONS = 60
TOLERANCE = 1e-10  # of the complementarity and the residuals, relative to the data
PATIENCE = 5  # iterations without a better point
TO_BOUNDARY = 0.995


class Programme(NamedTuple):
    """Data; n variables, e equalities, i inequalities."""

    H: jax.Array  # [n, n], symmetric, positive semidefinite
    g: jax.Array  # [n]
    A: jax.Array  # [e, n]
    a: jax.Array  # [e]
    C: jax.Array  # [i, n]
    c: jax.Array  # [i]
    lower: jax.Array  # [n]
    upper: jax.Array  # [n]
    penalty: jax.Array  # []


class Point(NamedTuple):
    """Primal and dual variables; each (x, z) of `pairs` is complementary and positive."""

    d: jax.Array  # [n]
    y: jax.Array  # [e] multipliers of the equalities
    slack: tuple  # p, n [e]; t, s [i] with C d + c + s = t; distances to lower and upper [n]
    dual: tuple  # of the same shapes


class Progress(NamedTuple):
    """Where the iteration is, and the best that it has seen."""

    now: Point
    best: Point
    gap: jax.Array  # [] of the best
    count: jax.Array  # [] iterations
    worse: jax.Array  # [] iterations in a row without a better point


def solve(q: Programme):
    """Solution of a programme: the best point before rounding takes over, where the tolerance is out of reach.

    Returns:
        (d [n], y [e], u [i]): the step, and the multipliers of the equalities (any sign) and inequalities (>= 0).
    """
    goes_on = lambda s: (s.count < ITERATIONS) & (s.gap > TOLERANCE) & (s.worse < PATIENCE)
    x = jax.lax.while_loop(goes_on, lambda s: _step(q, s), _start(q)).best
    return x.d, x.y, x.dual[3]


def _scale(q):
    return 1.0 + jnp.abs(q.g).max()


def _start(q):
    nu = q.penalty
    mid = jnp.clip(jnp.zeros_like(q.g), q.lower + 0.01 * (q.upper - q.lower), q.upper - 0.01 * (q.upper - q.lower))
    e, i = q.A @ mid + q.a, q.C @ mid + q.c
    one = jnp.maximum(jnp.abs(e).max(initial=0.0), 1.0) * 0.1
    p, n = jnp.maximum(e, 0) + one, jnp.maximum(-e, 0) + one
    t = jnp.maximum(i, 0) + one
    full, half, least = jnp.full_like(q.a, nu), jnp.full_like(q.c, 0.5 * nu), 0.1 * _scale(q)
    slope = q.H @ mid + q.g + half @ q.C  # the duals of the bounds balance it: no residual is left but complementarity
    bounds = least + jnp.maximum(slope, 0.0), least + jnp.maximum(-slope, 0.0)
    x = Point(
        mid,
        jnp.zeros_like(q.a),
        (p, n, t, t - i, mid - q.lower, q.upper - mid),
        (full, full, half, half, *bounds),
    )
    return Progress(x, x, jnp.asarray(jnp.inf, q.g.dtype), jnp.asarray(0), jnp.asarray(0))


def _residuals(q, x):
    """Residuals of the dual and primal equations, in the order in which `_direction` takes them."""
    p, n, t, s, low, up = x.slack
    zp, zn, zt, z, zl, zu = x.dual
    return (
        q.H @ x.d + q.g + x.y @ q.A + z @ q.C + zu - zl,
        q.penalty - x.y - zp,
        q.penalty + x.y - zn,
        q.penalty - z - zt,
        q.A @ x.d + q.a - p + n,
        q.C @ x.d + q.c + s - t,
        x.d - q.lower - low,
        q.upper - x.d - up,
    )


def _average(x):
    total = sum(jnp.vdot(a, b) for a, b in zip(x.slack, x.dual, strict=True))
    return total / sum(a.size for a in x.slack)


def _gap(q, x):
    """Largest residual, relative to the data; the complementarity relative to the gradient."""
    r = _residuals(q, x)
    dual = max_abs(r[:4]) / _scale(q)
    return jnp.maximum(jnp.maximum(dual, max_abs(r[4:])), _average(x) / _scale(q))


def max_abs(arrays):
    """Largest absolute entry of several arrays, zero for empty ones."""
    return jnp.stack([jnp.abs(x).max(initial=0.0) for x in arrays]).max()


def _factor(q, x):
    """The condensed matrix [[H + C^T D C + bounds, A^T], [A, -E]] and its factors."""
    p, n, t, s, low, up = x.slack
    zp, zn, zt, z, zl, zu = x.dual
    E = p / zp + n / zn
    D = 1 / (t / zt + s / z)
    W = q.H + (q.C.T * D) @ q.C + jnp.diag(zl / low + zu / up)
    K = jnp.block([[W, q.A.T], [q.A, -jnp.diag(E)]])
    return jax.scipy.linalg.lu_factor(K), K, D


def _direction(q, x, r, factors, targets):
    """Newton direction for residuals r and complementarity x z -> x z - target."""
    lu, K, D = factors
    p, n, t, s, low, up = x.slack
    zp, zn, zt, z, zl, zu = x.dual
    rd, rp, rn, rt, re, ri, rl, ru = r
    cp, cn, ct, cs, cl, cu = targets  # x dz + z dx = -c
    # p: dzp = rp - dy, dp = -(cp + p dzp) / zp; alike for n, t and s, and for the bounds
    ge = re + (cp + p * rp) / zp - (cn + n * rn) / zn
    gi = ri - cs / z + (ct + t * rt) / zt
    gl, gu = (cl + zl * rl) / low, (cu + zu * ru) / up
    rhs = jnp.concatenate([-(rd + q.C.T @ (D * gi) + gl - gu), -ge])
    step = jax.scipy.linalg.lu_solve(lu, rhs)
    step = step + jax.scipy.linalg.lu_solve(lu, rhs - K @ step)
    dd, dy = step[: q.g.size], step[q.g.size :]
    dz = D * (q.C @ dd + gi)
    dzp, dzn, dzt = rp - dy, rn + dy, rt - dz
    dl, du = dd + rl, ru - dd
    dual = (dzp, dzn, dzt, dz, -(cl + zl * dl) / low, -(cu + zu * du) / up)
    slack = (-(cp + p * dzp) / zp, -(cn + n * dzn) / zn, -(ct + t * dzt) / zt, -(cs + s * dz) / z, dl, du)
    return Point(dd, dy, slack, dual)


def _longest(values, steps):
    """Largest step in [0, 1] that keeps all values positive."""
    room = lambda v, d: jnp.where(d < 0, -v / jnp.where(d < 0, d, -1.0), jnp.inf).min(initial=1.0)
    return jnp.stack([room(v, d) for v, d in zip(values, steps, strict=True)]).min()


def _move(x, dx, primal, dual):
    along = lambda a, b, s: jax.tree.map(lambda u, w: u + s * w, a, b)
    return Point(x.d + primal * dx.d, x.y + dual * dx.y, along(x.slack, dx.slack, primal), along(x.dual, dx.dual, dual))


def _step(q, s: Progress) -> Progress:
    x = s.now
    factors, r, mu = _factor(q, x), _residuals(q, x), _average(x)
    products = tuple(a * b for a, b in zip(x.slack, x.dual, strict=True))
    trial = _direction(q, x, r, factors, products)
    length = jnp.minimum(_longest(x.slack, trial.slack), _longest(x.dual, trial.dual))
    centre = (_average(_move(x, trial, length, length)) / mu) ** 3 * mu
    targets = tuple(c + a * b - centre for c, a, b in zip(products, trial.slack, trial.dual, strict=True))
    dx = _direction(q, x, r, factors, targets)
    length = TO_BOUNDARY * jnp.minimum(_longest(x.slack, dx.slack), _longest(x.dual, dx.dual))
    new = _move(x, dx, length, length)
    gap = _gap(q, new)
    better = gap < s.gap
    best = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, s.best)
    worse = jnp.where(better, 0, jnp.where(jnp.isfinite(gap), s.worse + 1, PATIENCE))
    return Progress(new, best, jnp.where(better, gap, s.gap), s.count + 1, worse)
