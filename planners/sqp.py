"""Dense sequential quadratic programming with an l1 merit function and a trust region, from one start or several.

Each iteration solves one elastic programme (`qp`) in a box around the point. The curvature is Gauss-Newton plus a
symmetric rank-one correction that learns, from short steps, what Gauss-Newton leaves out (the constraints'
curvature); negative directions are mirrored. A step that does not pay is first bent (second-order correction), then
shortened. The penalty grows only where the linearised constraints gain by it. Once steps are short, Newton's step on
the constraints that hold is tried first (`newton`), and taken where it halves the residual of the conditions of
optimality: the curvature is then that of the constraints' null space, unmirrored, no trust region's barrier bends it,
and what the merit gains, which drowns in rounding, is not asked.

The loop runs on the host, so that it can be watched; three compiled functions do the work, for one start, so that one
start and many share them. Several starts take turns, one iteration each. After TRIAL iterations they are compared by
the merit, all with the first penalty: the KEPT best of those that still run go on, the others are dropped. Only if none
that went on is solved, the best of those are taken up again. What has ended before is neither compared nor dropped.
Source: Fletcher's S l1 QP; Nocedal and Wright, Numerical Optimization, chapters 6 and 18; Byrd, Nocedal and Waltz
(2008), Steering exact penalty methods.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import cho_factor, cho_solve

from planners import newton, qp
from planners.problem import ONCE, Form, Linear, Outcome, Problem, summary

FEASIBLE = 1e-9  # scaled violation
STATIONARY = 1e-8  # scaled gradient of the Lagrangian, relative to 1 + |gradient of the cost|
ENOUGH = 1e-4  # the same, where rounding lets nothing more be gained
CLOSE = 1e-3  # scaled violation from which on Newton's step on the constraints that hold is tried
PENALTIES = (10.0, 1e5)  # first and largest
LENGTHS = 0.5 ** np.arange(8.0)
WORTH = 0.1  # part of the predicted decrease that a step must bring
NOISE = 1e-10  # relative change of the merit that says nothing: steps within it are taken, or the radius would collapse
SHORT = 0.02  # scaled step; longer ones would teach the curvature of elsewhere
TEACHES = 1e-2  # least cosine of a step and the change it teaches; a smaller one would become an enormous curvature
RADII = (1e-6, 0.1, 2.0)  # trust region, scaled variables: smallest, at least after a larger penalty, largest
WIDE = 1e3  # scaled: a trust region that is none
STEER = (0.3, 0.1)  # parts of the violation: one left by a step asks for more penalty, one gained is worth it
# Least curvature, of the largest: rounding and no more. Where all that moves little costs little, as with small joints
# under a heavy base, minima may be flatter than 1e-8, and a larger floor would shorten each step along them.
FLOOR = 1e-13
IDLE = 2  # iterations without progress after which more penalty is tried anyway
PATIENCE = 8  # iterations without progress
# Iterations in which neither the violation falls by a hundredth, nor the merit by more than the violation counts in it,
# nor the penalty grows: infeasible.
STALLED = 12
TRIAL, KEPT = 10, 4  # iterations of each of several starts, and how many go on: by then costs are near their minima
STATUSES = ("running", "solved", "infeasible", "not converged", "dropped")
RUNNING, SOLVED, INFEASIBLE, UNCONVERGED, DROPPED = range(5)


class State(NamedTuple):
    """Where the solver is, from one start."""

    z: jax.Array  # [n]
    near: Linear  # the problem at z
    y: jax.Array  # [e] multipliers of the equalities
    u: jax.Array  # [i] multipliers of the inequalities
    left_out: jax.Array  # [n, n] curvature that Gauss-Newton leaves out
    radius: jax.Array  # []
    penalty: jax.Array  # []
    violation: jax.Array  # [] the largest one, scaled
    stationarity: jax.Array  # []
    step: jax.Array  # [] largest entry of the last step
    least: jax.Array  # [] total violation when it last fell by a hundredth, or did not matter
    idle: jax.Array  # [] iterations in a row without progress
    stalled: jax.Array  # [] iterations since then
    iteration: jax.Array  # []
    status: jax.Array  # [] index into STATUSES


class Step(NamedTuple):
    """What the quadratic programme says."""

    d: jax.Array  # [n]
    y: jax.Array  # [e]
    u: jax.Array  # [i]
    penalty: jax.Array  # []
    now: jax.Array  # [] merit
    predicted: jax.Array  # [] its decrease
    left: jax.Array  # [] total violation that d leaves, and the largest one
    most: jax.Array  # []


class Found(NamedTuple):
    """What the search along a step says."""

    z: jax.Array  # [n] the next point
    length: jax.Array  # [] of the step; 0 if none pays
    gain: jax.Array  # [] of merit


def violation(equal, below):
    """Sum and largest of the violations."""
    below = jnp.maximum(below, 0.0)
    return jnp.abs(equal).sum() + below.sum(), qp.max_abs((equal, below))


def direction(s: State, low, high, penalty) -> Step:
    """The step of the quadratic programme in the trust region."""
    near = s.near
    H = near.curvature + s.left_out
    values, vectors = jnp.linalg.eigh((H + H.T) / 2)
    floor = FLOOR * jnp.maximum(jnp.abs(values).max(), 1.0)
    H = (vectors * jnp.maximum(jnp.abs(values), floor)) @ vectors.T
    box = jnp.maximum(low - s.z, -s.radius), jnp.minimum(high - s.z, s.radius)
    d, y, u = qp.solve(qp.Programme(H, near.gradient, near.A, near.equal, near.C, near.below, *box, penalty))
    left, most = violation(near.equal + near.A @ d, near.below + near.C @ d)
    now = near.cost + penalty * violation(near.equal, near.below)[0]
    model = near.cost + near.gradient @ d + d @ H @ d / 2 + penalty * left
    return Step(d, y, u, penalty, now, jnp.maximum(now - model, 0.0), left, most)


def search(form: Form, s: State, step: Step, numbers) -> Found:
    """Tries the step at each of LENGTHS, straight and then bent, until one pays; on the host."""
    data, low, high = numbers
    z, d, A, equal = (np.asarray(x) for x in (s.z, step.d, s.near.A, s.near.equal))
    now, predicted, penalty, factors = float(step.now), float(step.predicted), float(step.penalty), None

    def gained(there):
        v = summary(form, there, data)
        gain = now - merit(v, penalty)
        return gain if np.isfinite(gain) else -np.inf, v.equal

    for length in LENGTHS:
        least, there = WORTH * length * predicted - NOISE * abs(now), z + length * d
        gain, left = gained(there)
        if gain <= least and len(A) and np.isfinite(left).all():
            factors = factors or _normal(A)
            there = np.clip(there - A.T @ cho_solve(factors, left - (1 - length) * equal), low, high)
            gain, _ = gained(there)
        if gain > least:
            return Found(there, np.float64(length), np.float64(gain))
    return Found(z, np.float64(0), np.float64(0))


def _normal(A):
    """Cholesky factors of A A^T."""
    gram = A @ A.T
    return cho_factor(gram + 1e-12 * max(np.trace(gram), 1e-200) * np.eye(len(A)))


def total_violation(v) -> float:
    """Sum of the violations of a summary or a linear model, on the host."""
    return float(np.abs(v.equal).sum() + np.maximum(v.below, 0.0).sum())


def merit(v, penalty: float) -> float:
    """Cost of a summary or a linear model, with an l1 penalty; on the host."""
    return float(v.cost) + penalty * total_violation(v)


def arrive(form: Form, s: State, step: Step, found: Found, numbers) -> State:
    """The state at the point that was found."""
    data, low, high = numbers
    z, length, gain = found
    near = form.near(z, data)
    size, noise = jnp.abs(step.d).max(), NOISE * jnp.abs(step.now)
    wider = jnp.where(gain > 0.5 * step.predicted - noise, jnp.maximum(s.radius, 2 * size), s.radius)
    shorter = jnp.where(length > 0, 2 * length, LENGTHS[-1]) * size
    after, most = violation(near.equal, near.below)
    raised = step.penalty > s.penalty
    falls = (after < 0.99 * s.least) | (gain > step.penalty * after) | raised
    radius = jnp.where(length == 1, wider, shorter)
    radius = jnp.where(raised, jnp.maximum(radius, RADII[1]), radius)
    new = State(
        z,
        near,
        step.y,
        step.u,
        learn(s.left_out, s.near, near, z - s.z, step.y, step.u),
        jnp.clip(radius, RADII[0], RADII[2]),
        step.penalty,
        most,
        stationarity(near, step.y, step.u, z, low, high),
        jnp.abs(z - s.z).max(),
        jnp.where(falls, after, s.least),
        jnp.where((gain > noise) | raised, 0, s.idle + 1),
        jnp.where(falls, 0, s.stalled + 1),
        s.iteration + 1,
        s.status,
    )
    return new._replace(status=status(new))


def learn(S, old: Linear, new: Linear, step, y, u):
    """Symmetric rank-one update, so that Gauss-Newton + S maps the step to the change of the Lagrangian's gradient."""
    gradient = lambda x: x.gradient + y @ x.A + u @ x.C
    miss = gradient(new) - gradient(old) - new.curvature @ step - S @ step
    size = miss @ step
    well = jnp.abs(size) > TEACHES * jnp.linalg.norm(miss) * jnp.linalg.norm(step)
    well = well & (jnp.abs(step).max() <= SHORT)
    return S + jnp.where(well, jnp.outer(miss, miss) / jnp.where(well, size, 1.0), 0.0)


def stationarity(near, y, u, z, low, high):
    """Largest entry of the gradient of the Lagrangian that no bound holds, and of u times its row."""
    r = near.gradient + y @ near.A + u @ near.C
    held = ((z <= low + 1e-7) & (r > 0)) | ((z >= high - 1e-7) & (r < 0))
    return qp.max_abs((jnp.where(held, 0.0, r), u * near.below)) / (1 + jnp.abs(near.gradient).max())


def status(s: State):
    """Whether to go on, by index into STATUSES."""
    feasible = s.violation <= FEASIBLE
    ended = jnp.where(feasible, jnp.where(s.stationarity <= ENOUGH, SOLVED, UNCONVERGED), INFEASIBLE)
    more = (s.idle < PATIENCE) & (feasible | (s.stalled < STALLED))
    ended = jnp.where(more, RUNNING, ended)
    return jnp.where(feasible & (s.stationarity <= STATIONARY), SOLVED, ended).astype(s.status.dtype)


_direction = jax.jit(direction)
_optimised, _quick = (jax.jit(arrive, static_argnums=0, **options) for options in ({}, ONCE))


def _arrive(form: Form, *rest) -> State:
    """The state, its numbers on the host, where comparing them compiles nothing."""
    state = (_quick if form.quick else _optimised)(form, *rest)
    return jax.tree.map(lambda x: x if x.ndim else np.asarray(x)[()], state)


def _blank(problem: Problem, z) -> tuple[State, Step, Found]:
    """What `_arrive` takes to the state at a first guess z [n]: no step, from nowhere."""
    n = len(z)
    e, i = (sum(rows.size for rows in groups) for groups in (problem.equal, problem.below))
    zero, real, count = np.zeros, np.float64, np.int64
    near = Linear(real(0), zero(n), zero((n, n)), zero(e), zero((e, n)), zero(i), zero((i, n)))
    reals = real(0.3), real(PENALTIES[0]), real(0), real(0), real(0), real(np.inf)
    state = State(z, near, near.equal, near.below, near.curvature, *reals, count(-1), count(0), count(-1), count(0))
    step = Step(0 * z, near.equal, near.below, real(PENALTIES[0]), *zero(4))
    return state, step, Found(z, real(1), real(0))


def near(problem: Problem, z, numbers=None) -> Linear:
    """The problem near a point z [n] (scaled), by what `solve` compiles; with other numbers than its own if given.

    Its arrays are the host's: what is made of them compiles nothing.
    """
    return jax.tree.map(np.asarray, _arrive(problem.form, *_blank(problem, z), numbers or problem.numbers).near)


def compile_all(problem: Problem) -> None:
    """Compiles what `solve` calls, side by side."""
    data, low, high = numbers = problem.numbers
    state, step, found = _blank(problem, np.zeros(len(low)))
    jobs = (
        (_arrive, problem.form, state, step, found, numbers),
        (summary, problem.form, state.z, data),
        (_direction, state, low, high, step.penalty),
    )
    with ThreadPoolExecutor(len(jobs)) as pool:
        for job in [pool.submit(*job) for job in jobs]:
            jax.block_until_ready(job.result())


def solve(problem: Problem, z, *, iterations: int = 200, numbers=None) -> Iterator[list[State]]:
    """Iterates from first guesses; the last states say how each ended.

    Args:
        problem: What is to be solved.
        z: First guesses [starts, n], scaled.
        iterations: At most, of each.
        numbers: Others than the problem's own, of the same shapes.

    Returns:
        After each iteration, the states of all starts, in the order of the guesses.
    """
    form, numbers = problem.form, numbers or problem.numbers
    _, low, high = numbers
    states = [_arrive(form, *_blank(problem, start), numbers) for start in np.clip(z, low, high)]
    while True:
        states = _compared([_marked(s, UNCONVERGED) if _runs(s) and s.iteration >= iterations else s for s in states])
        yield states
        if not running(states):
            return
        states = [_iterated(form, s, numbers) if _runs(s) else s for s in states]


def _runs(s: State) -> bool:
    return bool(s.status == RUNNING)


def _marked(s: State, status) -> State:
    return s._replace(status=np.int64(status))


def _iterated(form, s: State, numbers) -> State:
    """The state after one iteration."""
    if s.iteration and s.violation <= CLOSE and s.step <= SHORT:
        new = _polished(form, s, numbers)
        if new is not None and residual(new) <= residual(s) / 2:
            return new
    step = _steered(s, *numbers[1:])
    return _arrive(form, s, step, search(form, s, step, numbers), numbers)


def residual(s: State) -> float:
    """What a state lacks to the conditions of optimality."""
    return max(float(s.violation), float(s.stationarity))


def _polished(form, s: State, numbers) -> State | None:
    """The state after Newton's step on the constraints that hold; None without one that is short."""
    _, low, high = numbers
    near, z, y, u, left_out = (jax.tree.map(np.asarray, x) for x in (s.near, s.z, s.y, s.u, s.left_out))
    found = newton.step(near, near.curvature + left_out, z, y, u, low, high)
    if found is None:  # what was learnt farther away is not the curvature of a minimum
        s = s._replace(left_out=np.zeros_like(near.curvature))
        found = newton.step(near, near.curvature, z, y, u, low, high)
    if found is None or np.abs(found[0]).max() > SHORT:
        return None
    d, y, u = found
    step = Step(d, y, u, np.asarray(s.penalty), *np.zeros(4))
    return _arrive(form, s, step, Found(np.clip(z + d, low, high), np.float64(1), np.float64(np.inf)), numbers)


def _compared(states) -> list[State]:
    """The states, the worst of those that ran for TRIAL iterations dropped; or taken up again where none is solved."""
    if not running(states) and not any(s.status == SOLVED for s in states):
        states = [_marked(s, RUNNING) if s.status == DROPPED else s for s in states]
    merits = {k: merit(s.near, PENALTIES[0]) for k, s in enumerate(states) if _runs(s) and s.iteration == TRIAL}
    worst = sorted(merits, key=merits.get)[KEPT:]
    return [_marked(s, DROPPED) if k in worst else s for k, s in enumerate(states)]


def _steered(s: State, low, high) -> Step:
    """The step, with ten times the penalty where that leaves clearly less violation, or where nothing else helps.

    A trust region that is too small for feasible linearised constraints is no reason for a larger penalty.
    """
    step, before = _direction(s, low, high, s.penalty), total_violation(s.near)
    left, penalty = float(step.left), float(step.penalty)
    if float(step.most) <= FEASIBLE or left <= STEER[0] * before or penalty >= PENALTIES[1]:
        return step
    harder = _direction(s, low, high, np.float64(10 * penalty))
    return harder if float(harder.left) < left - STEER[1] * before or s.idle >= IDLE else step


def forecast(s: State, low, high) -> float:
    """The least merit of the quadratic model about a state, wherever it is within the bounds."""
    step = _direction(s._replace(radius=np.float64(WIDE)), low, high, s.penalty)
    return float(step.now) - float(step.predicted)


def ranking(states) -> np.ndarray:
    """Starts from the best to the worst: how they ended, then the cost with the largest penalty."""
    merits = [merit(s.near, PENALTIES[1]) for s in states]
    return np.lexsort((merits, [(s.status != SOLVED) + (s.status == DROPPED) for s in states]))


def running(states) -> int:
    """Number of starts that have not ended."""
    return sum(map(_runs, states))


def pick(states, k: int) -> State:
    """The state of one start, as numbers of the host."""
    return jax.tree.map(np.asarray, states[k])


def outcome(state: State) -> Outcome:
    """What a state of one start says to those who do not know how it was found."""
    near, status = state.near, STATUSES[state.status]
    cost, stationarity, iteration = float(near.cost), float(state.stationarity), int(state.iteration)
    return Outcome(state.z, cost, near.equal, near.below, state.y, state.u, stationarity, iteration, status)
