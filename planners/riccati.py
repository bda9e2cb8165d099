"""Multiple shooting: states and controls at all knots are variables, and a Newton step costs as much as the knots.

    minimise  smooth(x_N) + sum |r_k(x_k, u_k)|^2 / 2 + |r_N(x_N)|^2 / 2
    subject to  f(x_k, u_k) = x_(k+1),  e(x_N) = 0,  lower <= x_k <= upper,  x_0 given in part

States live on a manifold: `move(x, dx)` goes along a tangent, `gap(a, b)` is the tangent from b to a. Bounds are kept
by a barrier mu with multipliers zl and zu (primal-dual), gaps close as the steps are taken. With A, B the derivatives
of f, d the gaps, g the gradient of the cost and the barrier and H the curvature of the Lagrangian, a step is the
solution of a linear-quadratic problem: backward over the knots, with

    V_k(dx; nu) = dx'P dx/2 + p'dx + nu'(G'dx + c) - nu'S nu/2,
    Quu = Huu + B'P B + reg 1,   du = K dx + k + Ke nu,

then nu, the multipliers of e, from what is left free at the start, and forward again, by the dynamics themselves. V_N
has rho |E dx + e|^2 / 2 besides, which moves no solution but bends up what e holds; where some Quu is not positive all
the same, stages lose their negative curvature. A line search takes as much of the step as lowers

    cost + barrier + penalty * sum of gaps + nu'e + rho |e|^2 / 2,

of which every such step is a direction of descent, and the last ones are taken whole; |e| in the place of the last two
terms would ask for a thirtieth of a step where e bends more than the cost does. Where little is taken, reg grows.

Source: Rao, Wright and Rawlings (1998), Application of interior-point methods to model predictive control; Nocedal and
Wright (2006), chapters 17 (augmented Lagrangian), 18 and 19; Waechter and Biegler (2006), sections 2 and 3 (the barrier
and its multipliers).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from planners.problem import ONCE, Outcome, Problem, summaries

STATUSES = ("running", "solved", "infeasible", "not converged")
SEEN = 5  # iterations from one report to the next
RUNNING, SOLVED, INFEASIBLE, NOT_CONVERGED = range(4)
STATIONARY, FEASIBLE, COMPLEMENTARY = 1e-8, 1e-10, 1e-9
BARRIERS, CALM, SLOWER, FASTER = (0.1, 1e-10), 10.0, 0.2, 1.5
INSIDE = 0.01  # part of the bounds' distance that a first guess keeps from them
TO_BOUNDARY, SUFFICIENT, HALVINGS = 0.995, 1e-4, 12
RESUMED = 1e-7  # barrier of a start from an earlier solution
REGULARISED = (1e-4, 1e8)  # smallest, and where the solver gives up
SHORT_LONG = (0.2, 0.8)  # parts of a step, below which reg grows and above which it falls
AUGMENTED = 100.0  # rho: more than multipliers of e that cost about 1, times how much e bends
DIFFERENCE = 1e-5  # of tangents, for curvature: to 1e-10 of what bends
REDUNDANT = 1e-11  # of scaled rows of e: what depends on others gets the multiplier of least change


class Near(NamedTuple):
    """The problem near one trajectory; k runs over the N stages, tangents have the size x, controls u."""

    cost: jax.Array  # []
    A: jax.Array  # [N, x, x]
    B: jax.Array  # [N, x, u]
    d: jax.Array  # [N, x] gaps
    H: jax.Array  # [N, x + u, x + u] Gauss-Newton
    C: jax.Array  # [N, x + u, x + u] what that leaves out of the curvature of the Lagrangian
    g: jax.Array  # [N, x + u]
    H_end: jax.Array  # [x, x]
    C_end: jax.Array  # [x, x] likewise
    g_end: jax.Array  # [x]
    e: jax.Array  # [e]
    E: jax.Array  # [e, x]


class Step(NamedTuple):
    """A Newton step, and the multipliers that come with it."""

    dx: jax.Array  # [N + 1, x]
    du: jax.Array  # [N, u]
    lam: jax.Array  # [N + 1, x] of the gaps, that of the start first
    nu: jax.Array  # [e]
    K: jax.Array  # [N, u, x]: du = K dx + k
    k: jax.Array  # [N, u]


class State(NamedTuple):
    """Where the solver stands."""

    x: Any  # states at the knots, leaves [N + 1, ...]
    u: jax.Array  # [N, u]
    lam: jax.Array  # [N + 1, x]
    nu: jax.Array  # [e]
    zl: jax.Array  # [N + 1, x] multipliers of the lower bounds
    zu: jax.Array  # [N + 1, x]
    mu: jax.Array  # [] barrier
    penalty: jax.Array  # [] of the gaps
    reg: jax.Array  # []
    step: jax.Array  # [] part of the last step that was taken
    cost: jax.Array  # []
    violation: jax.Array  # [] largest gap or entry of e
    stationarity: jax.Array  # [] of the Lagrangian, relative to 1 + |gradient of the cost|
    iteration: jax.Array  # []
    status: jax.Array  # [] index into STATUSES


def begin(form, data, x, u) -> State:
    """From a guess of states and controls: the states moved into their bounds."""
    at = jax.vmap(form.bounded)(x)
    lower, upper = form.bounds(data)
    keep = INSIDE * jnp.minimum(upper - lower, 1.0)
    x = jax.vmap(form.move)(x, jnp.clip(at, lower + keep, upper - keep) - at)
    low, high = _slacks(form, data, x)
    zero, mu = jnp.zeros(()), jnp.asarray(BARRIERS[0])
    e = jax.eval_shape(lambda x: form.end(x, data)[1], jax.tree.map(lambda y: y[-1], x))
    return State(
        x, u, jnp.zeros(at.shape), jnp.zeros(e.shape), mu / low, mu / high, mu,
        zero + 1, zero, zero, zero, zero + 1, zero + 1, jnp.zeros((), int), jnp.zeros((), int),
    )  # fmt: skip


def resumed(form, data, s: State, gone) -> State:
    """A start from an earlier solution of which the part `gone` is over: the rest of it, at the knots of a new motion.

    The multipliers go with it, and the barrier starts low. `data` says where the motion starts now.
    """
    count = s.u.shape[0]
    place = count * (gone + (1 - gone) * jnp.arange(count + 1) / count)
    k = jnp.minimum(place.astype(int), count - 1)
    part, pick = place - k, lambda k: lambda y: y[k]
    between = lambda a, b, part: form.move(a, part * form.gap(b, a))
    x = jax.vmap(between)(jax.tree.map(pick(k), s.x), jax.tree.map(pick(k + 1), s.x), part)
    mixed = lambda y: y[k] + part[:, None] * (y[k + 1] - y[k])
    new = begin(form, data, x, mixed(jnp.concatenate([s.u, s.u[-1:]]))[:-1])
    low, high = _slacks(form, data, new.x)
    mu = jnp.asarray(RESUMED)
    held = lambda z, slack: jnp.clip(mixed(z), mu / (10 * slack), 10 * mu / slack)
    return new._replace(mu=mu, lam=mixed(s.lam), nu=s.nu, zl=held(s.zl, low), zu=held(s.zu, high))


def solve(form, data, state: State, until) -> State:
    """Iterations until the solver has ended, or until their number is `until`; to be jitted, and to be mapped.

    Args:
        form: Hashable; what is compiled: `move`, `gap`, `bounded` (the entries of a state that bounds hold, laid out
            like a tangent), `bounds(data)` ([N + 1, x] each), `start(data)` (a state, and 1 for what of its tangent is
            given), `stage(x, u, data)` -> (x of the next knot, r), `rough(x, u, data)`, the same or nearly, which the
            curvature is of, `differenced`, whether by differences, and `end(x, data)` -> (r, e, smooth).
        data: Numbers that the form reads, any pytree; all traced.
        state: From `begin`, or where an earlier call stopped.
        until: Number of iterations, traced.
    """
    going = lambda s: (s.status == RUNNING) & (s.iteration < until)
    return jax.lax.while_loop(going, lambda s: advance(form, data, s), state)


BEGIN, RESUME, SOLVE = (jax.jit(f, static_argnums=0, **ONCE) for f in (begin, resumed, solve))


def iterations(problem: Problem, x, u, most: int):
    """States after some iterations each, from a guess of states and controls, until the solver has ended."""
    values, data = problem.form.values, jax.tree.map(jnp.asarray, problem.data)
    state = BEGIN(values, data, x, u)
    while state.status == RUNNING and state.iteration < most:
        state = SOLVE(values, data, state, min(int(state.iteration) + SEEN, most))
        yield jax.tree.map(np.asarray, state)


def advance(form, data, s: State) -> State:
    """One iteration."""
    near = linearised(form, data, s.x, s.u, s.lam, s.nu)
    s = _judged(form, data, s, near)
    step = newton(form, data, s, near)
    low, high = _slacks(form, data, s.x)
    dzl = (s.mu - s.zl * step.dx) / low - s.zl
    dzu = (s.mu + s.zu * step.dx) / high - s.zu
    longest = jnp.minimum(_longest(low, step.dx), _longest(high, -step.dx))
    dual = jnp.minimum(_longest(s.zl, dzl), _longest(s.zu, dzu))
    penalty = jnp.maximum(s.penalty, 1.2 * jnp.abs(step.lam).max())
    alpha, found, x, u = _search(form, data, s._replace(penalty=penalty), near, step, longest)
    taken = jnp.where(found, alpha, 0.0)
    x, u = jax.tree.map(lambda new, old: jnp.where(found, new, old), (x, u), (s.x, s.u))
    low, high = _slacks(form, data, x)
    held = lambda z, dz, slack: jnp.clip(z + found * dual * dz, s.mu / (1e10 * slack), 1e10 * s.mu / slack)
    least, (short, long) = REGULARISED[0], SHORT_LONG
    shorter = jnp.maximum(10 * s.reg, least)
    reg = jnp.where(taken < short, shorter, jnp.where(taken > long, jnp.where(s.reg > least, s.reg / 10, 0.0), s.reg))
    stuck = jnp.where(s.violation > 1e-6, INFEASIBLE, NOT_CONVERGED)
    new = s._replace(
        x=x, u=u, lam=s.lam + taken * (step.lam - s.lam), nu=s.nu + taken * (step.nu - s.nu),
        zl=held(s.zl, dzl, low), zu=held(s.zu, dzu, high), penalty=penalty, reg=reg, step=taken,
        iteration=s.iteration + 1, status=jnp.where(reg > REGULARISED[1], stuck, s.status),
    )  # fmt: skip
    return jax.tree.map(lambda old, new: jnp.where(s.status == RUNNING, new, old), s, new)


def linearised(form, data, x, u, lam, nu) -> Near:
    """The problem near a trajectory: forward mode, one tangent per entry of a stage's state and control.

    What Gauss-Newton leaves out, lam . f'' + r . r'', is that of the rough stage: a gradient, and tangents of it, or
    its differences.
    """
    before, after = _sides(x)
    size, held = jax.eval_shape(jax.vmap(form.bounded), x).shape[1], jax.lax.stop_gradient

    def stage(x, u, after, lam):
        moved = lambda z: (form.move(x, z[:size]), u + z[size:], data)

        def f(z):
            new, r = form.stage(*moved(z))
            return form.gap(new, after), r

        def weighed(z, at=None):
            new, r = form.rough(*moved(z))
            here, weight = held((new, r)) if at is None else at
            return lam @ form.gap(new, here) + weight @ r

        def curvature():
            if not form.differenced:
                return _bent(weighed, size + u.size)
            at = form.rough(x, u, data)  # of all gradients, so that their differences are of them alone
            return _differenced(lambda z: weighed(z, at), size + u.size)

        (d, r), (F, R) = _with_jacobian(f, size + u.size)
        return r @ r / 2, F[:, :size], F[:, size:], d, R.T @ R, curvature(), R.T @ r

    def end(dx):
        return form.end(form.move(last, dx), data)

    def end_weighed(dx):
        r, e, smooth = end(dx)
        return held(r) @ r + nu @ e + smooth

    cost, A, B, d, H, C, g = jax.vmap(stage)(before, u, after, lam[1:])
    last = jax.tree.map(lambda y: y[-1], x)
    (r, e, smooth), (R, E, slope) = _with_jacobian(end, size)
    cost, H_end, g_end = cost.sum() + r @ r / 2 + smooth, R.T @ R, R.T @ r + slope
    return Near(cost, A, B, d, H, C, g, H_end, _bent(end_weighed, size), g_end, e, E)


def _sides(x):
    """The states before and after the stages."""
    return jax.tree.map(lambda y: y[:-1], x), jax.tree.map(lambda y: y[1:], x)


def _with_jacobian(f, size):
    """f at zero, and its derivatives there [..., size]; not by `jax.linearize`, of which twice as much is compiled."""
    along = lambda dz: jax.jvp(f, (jnp.zeros(size),), (dz,))
    return jax.vmap(along, out_axes=(None, -1))(jnp.eye(size))


def _bent(f, size):
    """The second derivatives of a scalar f at zero [size, size]: those of its gradient."""
    along = lambda dz: jax.jvp(jax.grad(f), (jnp.zeros(size),), (dz,))[1]
    return jax.vmap(along)(jnp.eye(size))


def _differenced(f, size):
    """The same by central differences of the gradient, of which a quarter is compiled where f is long."""
    slopes = jax.vmap(jax.grad(f))(DIFFERENCE * jnp.concatenate([jnp.eye(size), -jnp.eye(size)]))
    H = (slopes[:size] - slopes[size:]) / (2 * DIFFERENCE)
    return (H + H.T) / 2


def _convex(H):
    """H without its negative curvature."""
    values, V = jnp.linalg.eigh(H)
    return H - (V * jnp.minimum(values, 0.0)) @ V.T


def newton(form, data, s: State, near: Near) -> Step:
    """The step to the solution of the linear-quadratic problem with the barrier."""
    size = near.A.shape[1]
    low, high = _slacks(form, data, s.x)
    bent, slope = s.zl / low + s.zu / high, s.mu / high - s.mu / low
    g, g_end = near.g.at[:, :size].add(slope[:-1]), near.g_end + slope[-1] + AUGMENTED * near.E.T @ near.e
    given, r = form.start(data)[1], _late(form, data, s.x)
    free = 1 - given

    def backward(H, H_end):
        """Factor of V_0 where the start is free, not finite if some Quu is not positive; V_0, the plan, and V_N."""
        H = H.at[:, :size, :size].add(jax.vmap(jnp.diag)(bent[:-1]))
        H_end = H_end + jnp.diag(bent[-1]) + AUGMENTED * near.E.T @ near.E
        value, stages = (H_end, g_end, near.E.T, near.e, jnp.zeros((near.e.size,) * 2)), (near.A, near.B, near.d, H, g)
        first, plan = jax.lax.scan(lambda value, stage: _backward(value, stage, s.reg), value, stages, reverse=True)
        start = first[0] * jnp.outer(free, free) + jnp.diag(given)
        return jax.scipy.linalg.cholesky(start, lower=True), first, plan, H_end

    H, H_end = near.H + near.C, near.H_end + near.C_end
    exact, convex = backward(H, H_end), lambda: backward(jax.vmap(_convex)(H), _convex(H_end))
    factor, (P, p, G, c, S), plan, H_end = jax.lax.cond(jnp.isfinite(exact[0]).all(), lambda: exact, convex)
    # at the start, what is given moves by r, and the rest is where V_0 is least
    least = lambda b: jax.scipy.linalg.cho_solve((factor, True), b * (free if b.ndim == 1 else free[:, None]))
    rest, turned = r - least(p + P @ r), least(G)
    S, c = S + G.T @ turned, c + G.T @ rest
    scale = jnp.diagonal(S)
    scale = jnp.where(scale > REDUNDANT * scale.max(initial=0.0), scale, 1.0) ** -0.5
    shifted = jax.scipy.linalg.cho_factor(scale[:, None] * S * scale + REDUNDANT * jnp.eye(c.size))
    nu = s.nu
    for _ in range(2):  # of the proximal point method: what the shift errs by is squared
        nu = scale * jax.scipy.linalg.cho_solve(shifted, scale * c + REDUNDANT * nu / scale)
    dx0 = rest - turned @ nu

    def forward(dx, stage):
        (A, B, d), (K, k, Ke, P, p, G) = stage
        du = K @ dx + k + Ke @ nu
        return A @ dx + B @ du + d, (dx, du, P @ dx + p + G @ nu)

    last, (dx, du, lam) = jax.lax.scan(forward, dx0, ((near.A, near.B, near.d), plan))
    end = H_end @ last + g_end + near.E.T @ nu
    K, k, Ke = plan[:3]
    return Step(jnp.concatenate([dx, last[None]]), du, jnp.concatenate([lam, end[None]]), nu, K, k + Ke @ nu)


def _backward(value, stage, reg):
    """V_k from V_(k+1), and the controls that make it least."""
    (P, p, G, c, S), (A, B, d, H, g) = value, stage
    n = A.shape[0]
    ahead = p + P @ d
    Qx, Qu, BG = g[:n] + A.T @ ahead, g[n:] + B.T @ ahead, B.T @ G
    Qxx, Qux = H[:n, :n] + A.T @ P @ A, H[n:, :n] + B.T @ P @ A
    Quu = H[n:, n:] + B.T @ P @ B + reg * jnp.eye(B.shape[1])
    solved = jax.scipy.linalg.cho_solve(
        jax.scipy.linalg.cho_factor(Quu), -jnp.concatenate([Qux, Qu[:, None], BG], axis=1)
    )
    K, k, Ke = solved[:, :n], solved[:, n], solved[:, n + 1 :]
    P = Qxx + Qux.T @ K
    new = (P + P.T) / 2, Qx + Qux.T @ k, A.T @ G + Qux.T @ Ke, c + G.T @ d + BG.T @ k, S - BG.T @ Ke
    return new, (K, k, Ke, *new[:3])


def _judged(form, data, s: State, near: Near) -> State:
    """The state with its errors, its status and, where they are small for the barrier, a smaller one."""
    size = near.A.shape[1]
    low, high = _slacks(form, data, s.x)
    z = s.zu - s.zl
    _, given = form.start(data)
    along = near.g[:, :size] + jnp.einsum("kij,ki->kj", near.A, s.lam[1:])
    along = (along + z[:-1] - s.lam[:-1]).at[0].set((1 - given) * (along + z[:-1])[0])
    across = near.g[:, size:] + jnp.einsum("kij,ki->kj", near.B, s.lam[1:])
    end = near.g_end + near.E.T @ s.nu + z[-1] - s.lam[-1]
    worst = lambda *parts: jnp.stack([jnp.abs(x).max(initial=0.0) for x in parts]).max()
    stationarity = worst(along, across, end) / (1 + worst(near.g, near.g_end))
    violation = worst(near.d, near.e, _late(form, data, s.x))
    product = lambda mu: worst(*(jnp.where(jnp.isfinite(a), a * b - mu, 0.0) for a, b in ((low, s.zl), (high, s.zu))))
    done = (stationarity <= STATIONARY) & (violation <= FEASIBLE) & (product(0.0) <= COMPLEMENTARY)
    calm = jnp.maximum(jnp.maximum(stationarity, violation), product(s.mu)) <= CALM * s.mu
    smaller = jnp.maximum(BARRIERS[1], jnp.minimum(SLOWER * s.mu, s.mu**FASTER))
    return s._replace(
        cost=near.cost, violation=violation, stationarity=stationarity, mu=jnp.where(calm, smaller, s.mu),
        penalty=jnp.where(calm, 1.0, s.penalty), status=jnp.where(done, SOLVED, s.status),
    )  # fmt: skip


def _slacks(form, data, x):
    """Distances to the lower and the upper bounds, [N + 1, x] each; infinite where there is none, or x_0 is given."""
    lower, upper = form.bounds(data)
    at, given = jax.vmap(form.bounded)(x), form.start(data)[1] == 1
    free = lambda slack: slack.at[0].set(jnp.where(given, jnp.inf, slack[0]))
    return free(at - lower), free(upper - at)


def _longest(slack, change):
    """The part of a change that leaves some of the slack, at most one."""
    ratio = jnp.where((change < 0) & jnp.isfinite(slack), -TO_BOUNDARY * slack / jnp.minimum(change, -1e-300), jnp.inf)
    return jnp.minimum(ratio.min(), 1.0)


def _moved(form, data, s: State, near: Near, step: Step, alpha):
    """States and controls after a part of a step, and the cost. The states follow from the controls by the dynamics
    themselves, so that the gaps shrink by just that part; the controls answer to what differs from the linear step."""
    before, _ = _sides(s.x)

    def stage(new, old):
        x, u, K, k, d = old
        u = u + alpha * k + K @ form.gap(new, x)
        after, r = form.stage(new, u, data)
        after = form.move(after, (alpha - 1) * d)
        return after, (after, u, r @ r / 2)

    first = form.move(jax.tree.map(lambda y: y[0], before), alpha * step.dx[0])
    last, (after, u, cost) = jax.lax.scan(stage, first, (before, s.u, step.K, step.k, near.d))
    r, e, smooth = form.end(last, data)
    x = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, after)
    return x, u, cost.sum() + r @ r / 2 + smooth, e


def _search(form, data, s: State, near: Near, step: Step, longest):
    """The largest of `longest` and its halves that lowers the merit enough, if there is one, and where it leads."""
    low, high = _slacks(form, data, s.x)
    gaps, size = sum(jnp.abs(x).sum() for x in (near.d, _late(form, data, s.x))), near.A.shape[1]
    priced = lambda e: step.nu @ e + AUGMENTED / 2 * e @ e
    slope = (near.g[:, :size] * step.dx[:-1]).sum() + (near.g[:, size:] * step.du).sum() + near.g_end @ step.dx[-1]
    slope += (s.mu * step.dx * (1 / high - 1 / low)).sum() - s.penalty * gaps
    slope -= step.nu @ near.e + AUGMENTED * near.e @ near.e
    merit = near.cost + _barrier(s.mu, low, high) + s.penalty * gaps + priced(near.e)
    slack = 1e-13 * (1 + jnp.abs(merit))  # what rounding does to the merit

    def halve(carry):
        alpha, _, k, *_ = carry
        alpha = jnp.where(k == 0, alpha, alpha / 2)
        x, u, cost, e = _moved(form, data, s, near, step, alpha)
        left = _slacks(form, data, x)
        inside = sum(jnp.sum(new < (1 - TO_BOUNDARY) * old) for new, old in zip(left, (low, high), strict=True)) == 0
        new = cost + _barrier(s.mu, *left) + s.penalty * (1 - alpha) * gaps + priced(e)
        good = inside & (new <= merit + SUFFICIENT * alpha * jnp.minimum(slope, 0.0) + slack)
        return alpha, good, k + 1, x, u

    going = lambda carry: ~carry[1] & (carry[2] < HALVINGS)
    alpha, found, _, x, u = jax.lax.while_loop(going, halve, (longest, jnp.array(False), 0, s.x, s.u))
    return alpha, found, x, u


def _barrier(mu, low, high):
    logs = lambda slack: jnp.where(jnp.isfinite(slack), jnp.log(jnp.where(jnp.isfinite(slack), slack, 1.0)), 0.0)
    return -mu * (logs(low) + logs(high)).sum()


def _late(form, data, x):
    """The tangent from the first state to what of it is given."""
    first, given = form.start(data)
    return form.gap(first, jax.tree.map(lambda y: y[0], x)) * given


def outcome(problem: Problem, s: State) -> Outcome:
    """What a state says to those who do not know how it was found: the torques alone, and what follows from them."""
    values = problem.form.values
    z = problem.form.join(values.variables(s.x, s.u))
    u = values.rows(s.zu, s.zl, problem.data, problem.data.scale)
    at = summaries(problem.form, z[None], problem.numbers[0])
    status = STATUSES[s.status] if s.status else STATUSES[NOT_CONVERGED]
    return Outcome(
        z, float(at.cost[0]), at.equal[0], at.below[0], s.nu, u, float(s.stationarity), int(s.iteration), status
    )
