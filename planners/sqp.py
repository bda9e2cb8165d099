"""Dense sequential quadratic programming with an l1 merit function and a trust region.

Each iteration solves one elastic programme (`qp`) in a box around the point. The curvature is Gauss-Newton plus a
symmetric rank-one correction that learns, from short steps, what Gauss-Newton leaves out (the constraints'
curvature); negative directions are mirrored. A step that does not pay is first bent (second-order correction), then
shortened.

The loop runs on the host, so that it can be watched; three compiled functions do the work.
Source: Fletcher's S l1 QP; Nocedal and Wright, Numerical Optimization, chapters 6 and 18.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from planners import qp
from planners.problem import Form, Linear

FEASIBLE = 1e-9  # scaled violation
STATIONARY = 1e-6  # scaled gradient of the Lagrangian, relative to 1 + |gradient of the cost|
ENOUGH = 1e-4  # the same, where rounding lets nothing more be gained
PENALTIES = (10.0, 1e5)  # first and largest
LENGTHS = 0.5 ** np.arange(8.0)
WORTH = 0.1  # part of the predicted decrease that a step must bring
NOISE = 1e-10  # relative change of the merit that says nothing: steps within it are taken, or the radius would collapse
LEARN_BELOW = 0.02  # scaled step; longer ones would teach the curvature of elsewhere
RADII = (1e-10, 2.0)  # smallest and largest trust region, scaled variables
PATIENCE = 8  # iterations without progress
STALLED = 20  # iterations at the largest penalty in which the violation does not fall by a hundredth: infeasible


@dataclass(frozen=True)
class State:
    """Where the solver is."""

    z: np.ndarray  # [n]
    near: Linear  # the problem at z
    y: np.ndarray  # [e] multipliers of the equalities
    u: np.ndarray  # [i] multipliers of the inequalities
    left_out: np.ndarray  # [n, n] curvature that Gauss-Newton leaves out
    radius: float
    penalty: float
    iteration: int = 0
    step: float = 0.0  # largest entry of the last step
    stationarity: float = np.inf
    idle: int = 0  # iterations in a row without progress
    least: float = np.inf  # smallest total violation so far
    stalled: int = 0  # iterations in a row, at the largest penalty, without a smaller one
    status: str = "running"  # then "solved", "infeasible" or "not converged"

    @property
    def violation(self) -> float:
        """Largest violation, scaled."""
        return float(violation(self.near.equal, self.near.below)[1])


def violation(equal, below):
    """Sum and largest of the violations."""
    below = jnp.maximum(below, 0.0)
    return jnp.abs(equal).sum() + below.sum(), qp.max_abs((equal, below))


def merit(form: Form, z, data, penalty):
    """Cost with the l1 penalty, infinite where it is not finite, and the equalities."""
    v = form.at(z, data)
    total = v.cost + penalty * violation(v.equal, v.below)[0]
    return jnp.where(jnp.isfinite(total), total, jnp.inf), v.equal


def subproblem(near: Linear, left_out, low, high, penalty):
    """The step d, the multipliers, the predicted merit, and the largest and total violation that d leaves."""
    H = near.curvature + left_out
    values, vectors = jnp.linalg.eigh((H + H.T) / 2)
    floor = 1e-8 * jnp.maximum(jnp.abs(values).max(), 1.0)
    H = (vectors * jnp.maximum(jnp.abs(values), floor)) @ vectors.T
    d, y, u = qp.solve(qp.Programme(H, near.gradient, near.A, near.equal, near.C, near.below, low, high, penalty))
    total, most = violation(near.equal + near.A @ d, near.below + near.C @ d)
    return d, y, u, near.cost + near.gradient @ d + d @ H @ d / 2 + penalty * total, most, total


_near = jax.jit(Form.near, static_argnums=0)
_merit = jax.jit(merit, static_argnums=0)
_subproblem = jax.jit(subproblem)


def compile_all(form: Form, z, numbers) -> None:
    """Compiles what `solve` calls, side by side."""
    data = numbers[0]
    shape = jax.eval_shape(form.near, jnp.asarray(z), data)
    near = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape)
    size = jnp.eye(len(z))
    with ThreadPoolExecutor(3) as pool:
        jobs = [
            pool.submit(_near, form, z, data),
            pool.submit(_merit, form, z, data, 1.0),
            pool.submit(_subproblem, near, size, size[0] - 2.0, size[0] + 1.0, 1.0),
        ]
        for job in jobs:
            jax.block_until_ready(job.result())


def solve(form: Form, z, numbers, *, iterations: int = 200) -> Iterator[State]:
    """Iterates from a first guess z (scaled); the last state says how it ended.

    Args:
        form, numbers: The problem, as in `Problem`.
        z: First guess [n].
        iterations: At most.
    """
    data, low, high = numbers
    z = np.clip(z, low, high)
    near = _host(_near(form, z, data))
    nothing = np.zeros(len(near.equal)), np.zeros(len(near.below))
    state = State(z, near, *nothing, np.zeros((len(z),) * 2), 0.3, PENALTIES[0])
    while state.status == "running":
        yield state
        state = _iterate(form, state, data, low, high)
        if state.status == "running" and state.iteration >= iterations:
            state = replace(state, status="not converged")
    yield state


def _host(near):
    return jax.tree.map(np.asarray, near)


def _iterate(form, s: State, data, low, high) -> State:
    box = np.maximum(low - s.z, -s.radius), np.minimum(high - s.z, s.radius)
    out = _host(_subproblem(s.near, s.left_out, *box, s.penalty))
    d, y, u, model, most_left, left = out
    before = float(violation(s.near.equal, s.near.below)[0])
    now = s.near.cost + s.penalty * before
    predicted = max(now - model, 0.0)
    z, length, gain = _search(form, s, d, now, predicted, (data, low, high))
    near = _host(_near(form, z, data)) if length else s.near
    size = float(np.abs(d).max())
    if length == 1:
        radius = max(s.radius, 2 * size) if gain > 0.5 * predicted - NOISE * abs(now) else s.radius
    else:
        radius = 2 * length * size if length else LENGTHS[-1] * size
    stuck = most_left > FEASIBLE and left > 0.3 * before
    progress = gain > NOISE * abs(now)
    after = float(violation(near.equal, near.below)[0])
    falls = after < 0.99 * s.least or s.penalty < PENALTIES[1]
    fresh = State(
        z,
        near,
        y,
        u,
        _learn(s.left_out, s.near, near, z - s.z, y, u),
        float(np.clip(radius, *RADII)),
        min(10 * s.penalty, PENALTIES[1]) if stuck else s.penalty,
        s.iteration + 1,
        float(np.abs(z - s.z).max()),
        _stationarity(near, y, u, z, low, high),
        0 if progress or (stuck and s.penalty < PENALTIES[1]) else s.idle + 1,
        min(s.least, after),
        0 if falls else s.stalled + 1,
    )
    return replace(fresh, status=_status(fresh))


def _search(form, s, d, now, predicted, numbers):
    """The next point, the length of the step (0 if none pays), and what it gains."""
    data, low, high = numbers
    noise = NOISE * abs(now)
    gram = s.near.A @ s.near.A.T
    gram = gram + 1e-12 * max(np.trace(gram), 1e-300) * np.eye(len(gram))
    for length in LENGTHS:
        straight = s.z + length * d
        value, equal = _host(_merit(form, straight, data, s.penalty))
        if now - value > WORTH * length * predicted - noise:
            return straight, length, now - value
        if np.isfinite(equal).all():
            unseen = equal - (1 - length) * s.near.equal
            bent = np.clip(straight - s.near.A.T @ np.linalg.solve(gram, unseen), low, high)
            value, _ = _host(_merit(form, bent, data, s.penalty))
            if now - value > WORTH * length * predicted - noise:
                return bent, length, now - value
    return s.z, 0.0, 0.0


def _learn(S, old: Linear, new: Linear, step, y, u):
    """Symmetric rank-one update, so that Gauss-Newton + S maps the step to the change of the Lagrangian's gradient."""
    gradient = lambda x: x.gradient + y @ x.A + u @ x.C
    miss = gradient(new) - gradient(old) - new.curvature @ step - S @ step
    size = miss @ step
    if np.abs(step).max() > LEARN_BELOW or abs(size) <= 1e-8 * np.linalg.norm(miss) * np.linalg.norm(step):
        return S
    return S + np.outer(miss, miss) / size


def _stationarity(near, y, u, z, low, high):
    """Largest entry of the gradient of the Lagrangian that no bound holds, and of u times its row."""
    r = near.gradient + y @ near.A + u @ near.C
    held = ((z <= low + 1e-7) & (r > 0)) | ((z >= high - 1e-7) & (r < 0))
    scale = 1 + np.abs(near.gradient).max()
    return float(max(np.abs(np.where(held, 0.0, r)).max(), np.abs(u * near.below).max(initial=0.0)) / scale)


def _status(s: State) -> str:
    feasible = s.violation <= FEASIBLE
    if feasible and s.stationarity <= STATIONARY:
        return "solved"
    if s.idle < PATIENCE and (feasible or s.stalled < STALLED):
        return "running"
    if not feasible:
        return "infeasible"
    return "solved" if s.stationarity <= ENOUGH else "not converged"
