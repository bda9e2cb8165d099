"""Dense sequential quadratic programming with an l1 merit function and a trust region, for several starts at once.

Each iteration solves one elastic programme (`qp`) in a box around the point. The curvature is Gauss-Newton plus a
symmetric rank-one correction that learns, from short steps, what Gauss-Newton leaves out (the constraints'
curvature); negative directions are mirrored. A step that does not pay is first bent (second-order correction), then
shortened. The penalty grows only where the linearised constraints gain by it.

The functions below are for one start and are vmapped over all of them: a start that has ended waits, unchanged. The
loop runs on the host, so that it can be watched; three compiled functions do the work.
Source: Fletcher's S l1 QP; Nocedal and Wright, Numerical Optimization, chapters 6 and 18; Byrd, Nocedal and Waltz
(2008), Steering exact penalty methods.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from planners import qp
from planners.problem import Form, Linear, Outcome, Problem

FEASIBLE = 1e-9  # scaled violation
STATIONARY = 1e-6  # scaled gradient of the Lagrangian, relative to 1 + |gradient of the cost|
ENOUGH = 1e-4  # the same, where rounding lets nothing more be gained
PENALTIES = (10.0, 1e5)  # first and largest
LENGTHS = 0.5 ** np.arange(8.0)
WORTH = 0.1  # part of the predicted decrease that a step must bring
NOISE = 1e-10  # relative change of the merit that says nothing: steps within it are taken, or the radius would collapse
LEARN_BELOW = 0.02  # scaled step; longer ones would teach the curvature of elsewhere
RADII = (1e-6, 0.1, 2.0)  # trust region, scaled variables: smallest, at least after a larger penalty, largest
STEER = (0.3, 0.1)  # parts of the violation: one left by a step asks for more penalty, one gained is worth it
IDLE = 2  # iterations without progress after which more penalty is tried anyway
PATIENCE = 8  # iterations without progress
STALLED = 12  # iterations in which neither the violation falls by a hundredth nor the penalty grows: infeasible
STATUSES = ("running", "solved", "infeasible", "not converged")
RUNNING, SOLVED, INFEASIBLE, UNCONVERGED = range(4)


class State(NamedTuple):
    """Where the solver is; of several starts, all arrays have a leading axis."""

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
    least: jax.Array  # [] total violation when it last fell by a hundredth
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


def merit(form: Form, z, data, penalty):
    """Cost with the l1 penalty, infinite where it is not finite, and the equalities."""
    v = form.at(z, data)
    total = v.cost + penalty * violation(v.equal, v.below)[0]
    return jnp.where(jnp.isfinite(total), total, jnp.inf), v.equal


def direction(s: State, low, high, penalty) -> Step:
    """The step of the quadratic programme in the trust region."""
    near = s.near
    H = near.curvature + s.left_out
    values, vectors = jnp.linalg.eigh((H + H.T) / 2)
    floor = 1e-8 * jnp.maximum(jnp.abs(values).max(), 1.0)
    H = (vectors * jnp.maximum(jnp.abs(values), floor)) @ vectors.T
    box = jnp.maximum(low - s.z, -s.radius), jnp.minimum(high - s.z, s.radius)
    d, y, u = qp.solve(qp.Programme(H, near.gradient, near.A, near.equal, near.C, near.below, *box, penalty))
    left, most = violation(near.equal + near.A @ d, near.below + near.C @ d)
    now = near.cost + penalty * violation(near.equal, near.below)[0]
    model = near.cost + near.gradient @ d + d @ H @ d / 2 + penalty * left
    return Step(d, y, u, penalty, now, jnp.maximum(now - model, 0.0), left, most)


def search(form: Form, s: State, step: Step, numbers) -> Found:
    """Tries the step at each of LENGTHS, straight and then bent, until one pays."""
    data, low, high = numbers
    A, lengths = s.near.A, jnp.asarray(LENGTHS)
    gram = A @ A.T
    gram = gram + 1e-12 * jnp.maximum(jnp.trace(gram), 1e-200) * jnp.eye(len(A))
    factors = jax.scipy.linalg.cho_factor(gram)

    def attempt(carry):
        trial, _, _, unseen = carry
        length, bent = lengths[trial // 2], trial % 2
        z = s.z + length * step.d
        z = jnp.where(bent, jnp.clip(z - A.T @ jax.scipy.linalg.cho_solve(factors, unseen), low, high), z)
        value, equal = merit(form, z, data, step.penalty)
        return trial + 1, z, step.now - value, equal - (1 - length) * s.near.equal

    def goes_on(carry):
        trial, _, gain, _ = carry
        pays = gain > WORTH * lengths[jnp.maximum(trial - 1, 0) // 2] * step.predicted - NOISE * jnp.abs(step.now)
        return (trial < 2 * len(LENGTHS)) & ~((trial > 0) & pays)

    carry = jnp.asarray(0), s.z, jnp.zeros_like(step.now), jnp.zeros_like(s.near.equal)
    trial, z, gain, _ = jax.lax.while_loop(goes_on, attempt, carry)
    length = lengths[(trial - 1) // 2]
    pays = gain > WORTH * length * step.predicted - NOISE * jnp.abs(step.now)
    return Found(jnp.where(pays, z, s.z), jnp.where(pays, length, 0.0), jnp.where(pays, gain, 0.0))


def arrive(form: Form, s: State, step: Step, found: Found, numbers) -> State:
    """The state at the point that was found; a state that has ended stays."""
    data, low, high = numbers
    z, length, gain = found
    near = form.near(z, data)
    size, noise = jnp.abs(step.d).max(), NOISE * jnp.abs(step.now)
    wider = jnp.where(gain > 0.5 * step.predicted - noise, jnp.maximum(s.radius, 2 * size), s.radius)
    shorter = jnp.where(length > 0, 2 * length, LENGTHS[-1]) * size
    after, most = violation(near.equal, near.below)
    raised = step.penalty > s.penalty
    falls = (after < 0.99 * s.least) | raised
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
    new = new._replace(status=status(new))
    return jax.tree.map(lambda a, b: jnp.where(s.status == RUNNING, a, b), new, s)


def learn(S, old: Linear, new: Linear, step, y, u):
    """Symmetric rank-one update, so that Gauss-Newton + S maps the step to the change of the Lagrangian's gradient."""
    gradient = lambda x: x.gradient + y @ x.A + u @ x.C
    miss = gradient(new) - gradient(old) - new.curvature @ step - S @ step
    size = miss @ step
    well = jnp.abs(size) > 1e-8 * jnp.linalg.norm(miss) * jnp.linalg.norm(step)
    well = well & (jnp.abs(step).max() <= LEARN_BELOW)
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
    return jnp.where(feasible & (s.stationarity <= STATIONARY), SOLVED, jnp.where(more, RUNNING, ended))


_direction = jax.jit(jax.vmap(direction, (0, None, None, 0)))
_search = jax.jit(jax.vmap(search, (None, 0, 0, None)), static_argnums=0)
_arrive = jax.jit(jax.vmap(arrive, (None, 0, 0, 0, None)), static_argnums=0)


def _blank(problem: Problem, z) -> tuple[State, Step, Found]:
    """What `_arrive` takes to the state at first guesses z [s, n]: no step, from nowhere."""
    s, n = z.shape
    e, i = (sum(rows.size for rows in groups) for groups in (problem.equal, problem.below))
    zero, count, full = np.zeros, np.zeros(s, int), lambda x: np.full(s, x)
    near = Linear(zero(s), zero((s, n)), zero((s, n, n)), zero((s, e)), zero((s, e, n)), zero((s, i)), zero((s, i, n)))
    reals = full(0.3), full(PENALTIES[0]), zero(s), zero(s), zero(s), full(np.inf)
    state = State(z, near, near.equal, near.below, near.curvature, *reals, count - 1, count, count - 1, count)
    step = Step(0 * z, near.equal, near.below, full(PENALTIES[0]), *zero((4, s)))
    return state, step, Found(z, full(1.0), zero(s))


def compile_all(problem: Problem, count: int) -> None:
    """Compiles what `solve` calls for `count` starts, side by side."""
    _, low, high = numbers = problem.numbers
    state, step, found = _blank(problem, np.zeros((count, len(low))))
    jobs = (
        (_arrive, problem.form, state, step, found, numbers),
        (_search, problem.form, state, step, numbers),
        (_direction, state, low, high, step.penalty),
    )
    with ThreadPoolExecutor(len(jobs)) as pool:
        for job in [pool.submit(*job) for job in jobs]:
            jax.block_until_ready(job.result())


def solve(problem: Problem, z, *, iterations: int = 200) -> Iterator[State]:
    """Iterates from first guesses; the last state says how each ended.

    Args:
        problem: What is to be solved.
        z: First guesses [starts, n], scaled.
        iterations: At most.
    """
    form, numbers = problem.form, problem.numbers
    _, low, high = numbers
    state, step, found = _blank(problem, np.clip(z, low, high))
    state = _arrive(form, state, step, found, numbers)
    for _ in range(iterations):
        yield state
        if not running(state):
            return
        step = _steered(state, low, high)
        state = _arrive(form, state, step, _search(form, state, step, numbers), numbers)
    yield state._replace(status=np.where(np.asarray(state.status) == RUNNING, UNCONVERGED, state.status))


def _steered(state, low, high) -> Step:
    """The step, with ten times the penalty where that leaves clearly less violation, or where nothing else helps.

    A trust region that is too small for feasible linearised constraints is no reason for a larger penalty.
    """
    step = _direction(state, low, high, state.penalty)
    before = np.asarray(jax.vmap(violation)(state.near.equal, state.near.below)[0])
    left, penalty = np.asarray(step.left), np.asarray(step.penalty)
    stuck = (np.asarray(step.most) > FEASIBLE) & (left > STEER[0] * before) & (penalty < PENALTIES[1])
    stuck &= np.asarray(state.status) == RUNNING
    if not stuck.any():
        return step
    harder = _direction(state, low, high, np.where(stuck, 10 * penalty, penalty))
    better = (np.asarray(harder.left) < left - STEER[1] * before) | (np.asarray(state.idle) >= IDLE)
    choose = lambda a, b: np.where((stuck & better).reshape(-1, *(1,) * (np.ndim(a) - 1)), a, b)
    return jax.tree.map(choose, harder, step)


def ranking(state: State) -> np.ndarray:
    """Starts from the best to the worst: how they ended, then the cost with the largest penalty."""
    total = jax.vmap(violation)(state.near.equal, state.near.below)[0]
    merits = np.asarray(state.near.cost + PENALTIES[1] * total)
    return np.lexsort((merits, np.asarray(state.status) != SOLVED))


def running(state: State) -> int:
    """Number of starts that have not ended."""
    return int((np.asarray(state.status) == RUNNING).sum())


def pick(state: State, k: int) -> State:
    """The state of one start."""
    return jax.tree.map(lambda a: np.asarray(a[k]), state)


def outcome(state: State) -> Outcome:
    """What a state of one start says to those who do not know how it was found."""
    near, status = state.near, STATUSES[state.status]
    cost, stationarity, iteration = float(near.cost), float(state.stationarity), int(state.iteration)
    return Outcome(state.z, cost, near.equal, near.below, state.y, state.u, stationarity, iteration, status)
