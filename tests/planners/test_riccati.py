"""The Riccati solver against dense algebra and another optimiser; plans by multiple shooting."""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import planners
from planners import riccati, shooting
from planners.problem import ONCE
from planners.task import TaskError, parse

NEAR = jax.jit(riccati.linearised, static_argnums=0, **ONCE)


@functools.partial(jax.jit, static_argnums=0, **ONCE)
def newton(form, data, s):
    near = riccati.linearised(form, data, s.x, s.u, s.lam, s.nu)
    return near, riccati.newton(form, data, s, near)


# -- two carts: a linear system ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Carts:
    """Two masses on rails, under forces that are constant between the knots: x = [places, velocities]."""

    count: int = 12
    h: float = 0.25

    def move(self, x, dx):
        return x + dx

    def gap(self, a, b):
        return a - b

    def bounded(self, x):
        return x

    def bounds(self, data):
        return tuple(jnp.broadcast_to(x, (self.count + 1, 4)) for x in (-data["most"], data["most"]))

    def start(self, data):
        return data["start"], data["given"]

    def stage(self, x, u, data):
        p, v, a = x[:2], x[2:], u / data["mass"]
        new = jnp.concatenate([p + self.h * v + self.h**2 / 2 * a, v + self.h * a])
        return new, data["weights"] @ jnp.concatenate([x, u]) - data["wish"]

    rough = stage
    differenced = False

    def end(self, x, data):
        return x - 1, data["rows"] @ x - data["goal"], 0.3 * x[0]


def carts(rng):
    """Rows at the end, of which the third is the sum of the others; the velocity of the second cart is not given."""
    rows = rng.normal(size=(2, 4))
    rows, goal = np.vstack([rows, rows.sum(0)]), rng.normal(size=2)
    return dict(
        most=np.full(4, np.inf), start=rng.normal(size=4), given=np.array([1.0, 1, 1, 0]), mass=np.array([1.0, 2.5]),
        weights=rng.normal(size=(8, 6)), wish=rng.normal(size=8), rows=rows, goal=np.append(goal, goal.sum()),
    )  # fmt: skip


def dense(form, data, near, first):
    """The same step by one dense matrix, least squares for the multipliers."""
    N, size, m = form.count, 4, 2
    n = (N + 1) * size + N * m
    x, u = (lambda k: np.arange(size) + k * size), (lambda k: np.arange(m) + (N + 1) * size + k * m)
    H, g, A, b = np.zeros((n, n)), np.zeros(n), [], []
    for k in range(N):
        at = np.r_[x(k), u(k)]
        H[np.ix_(at, at)] += near.H[k]
        g[at] += near.g[k]
        row = np.zeros((size, n))
        row[:, x(k)], row[:, u(k)], row[:, x(k + 1)] = near.A[k], near.B[k], -np.eye(size)
        A, b = [*A, row], [*b, near.d[k]]
    H[np.ix_(x(N), x(N))] += near.H_end
    g[x(N)] += near.g_end
    row, given = np.zeros((len(near.e), n)), np.flatnonzero(data["given"])
    row[:, x(N)] = near.E
    start = np.zeros((len(given), n))
    start[np.arange(len(given)), x(0)[given]] = -1
    A, b = np.vstack([*A, row, start]), np.concatenate([*b, near.e, (data["start"] - first)[given]])
    K = np.block([[H, A.T], [A, np.zeros((len(A), len(A)))]])
    return np.split(np.linalg.lstsq(K, -np.r_[g, b], rcond=1e-13)[0][:n], [(N + 1) * size])


def test_a_newton_step_is_that_of_the_dense_system_and_solves_a_linear_problem(rng):
    form, data = Carts(), carts(rng)
    s = riccati.BEGIN(form, data, rng.normal(size=(13, 4)), rng.normal(size=(12, 2)))
    near, step = jax.tree.map(np.asarray, newton(form, data, s))
    dx, du = dense(form, data, near, s.x[0])
    scale = np.abs(dx).max()
    assert np.abs(step.dx.ravel() - dx).max() < 1e-12 * scale
    assert np.abs(step.du.ravel() - du).max() < 1e-12 * scale
    after = s._replace(x=s.x + step.dx, u=s.u + step.du, lam=step.lam, nu=step.nu)
    found = riccati.SOLVE(form, data, after, 1)
    assert found.stationarity < 1e-12 and found.violation < 1e-12
    assert riccati.STATUSES[found.status] == "solved"


# -- a pendulum: not linear, with bounds -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pendulum:
    """Swings up in the time T with little torque: x = [angle, rate, T]."""

    count: int = 16

    def move(self, x, dx):
        return x + dx

    def gap(self, a, b):
        return a - b

    def bounded(self, x):
        return x

    def bounds(self, data):
        free = jnp.arange(self.count + 1)[:, None] > 0
        most = jnp.where(free, jnp.array([jnp.inf, 0, jnp.inf]), jnp.array([jnp.inf, 0, 6.0]))
        least = jnp.where(free, jnp.array([-jnp.inf, 0, -jnp.inf]), jnp.array([-jnp.inf, 0, 1.0]))
        rate = jnp.array([0, 1.0, 0]) * data["rate"]
        return least - rate, most + rate

    def start(self, data):
        return data["start"], data["given"]

    def stage(self, x, u, data):
        h = x[2] / self.count
        slope = lambda y: jnp.array([y[1], u[0] - jnp.sin(y[0])])
        middle = x[:2] + h / 2 * slope(x[:2])
        return jnp.append(x[:2] + h * slope(middle), x[2]), jnp.sqrt(2 * h) * u

    rough = stage
    differenced = False

    def end(self, x, data):
        return jnp.zeros(1), x[:2] - data["goal"], data["time"] * x[2]


def pendulum(rate=2.0, time=0.5, goal=np.pi, start=(0.0, 0.0), T=None):
    given = np.array([1.0, 1.0, float(T is not None)])
    return dict(
        rate=np.array(rate), time=np.array(time), goal=np.array([goal, 0.0]), start=np.array([*start, T or 3.0]),
        given=given,
    )  # fmt: skip


PENDULUM = Pendulum()


def swing(data, form=PENDULUM):
    x = np.linspace([0.0, 0.0, 3.0], [np.pi, 0.0, 3.0], form.count + 1)
    return riccati.SOLVE(form, data, riccati.BEGIN(form, data, x, np.zeros((form.count, 1))), 200)


def judged(data, form=PENDULUM):
    """The least cost by single shooting and SLSQP; of the duration and the torques."""

    @jax.jit
    def path(z):
        def step(x, u):
            new, r = form.stage(x, u[None], data)
            return new, (new, r @ r / 2)

        last, (x, cost) = jax.lax.scan(step, jnp.append(data["start"][:2], z[0]), z[1:])
        _, e, smooth = form.end(last, data)
        return cost.sum() + smooth, e, data["rate"] ** 2 - x[:, 1] ** 2

    slope = jax.jit(jax.jacfwd(path))
    rules = [
        dict(type=kind, fun=lambda z, k=k: np.asarray(path(z)[k]), jac=lambda z, k=k: np.asarray(slope(z)[k]))
        for k, kind in ((1, "eq"), (2, "ineq"))
    ]
    limits, z = [(1.0, 6.0)] + [(None, None)] * form.count, np.append(3.0, np.full(form.count, 0.5))
    options = dict(ftol=1e-12, maxiter=1000)
    cost, gradient = (lambda z: path(z)[0]), lambda z: slope(z)[0]
    return minimize(cost, z, jac=gradient, bounds=limits, constraints=rules, method="SLSQP", options=options)


def test_a_problem_with_bounds_and_a_free_duration_is_solved_as_by_another_optimiser():
    data = pendulum(1.0)
    found = swing(data)
    assert riccati.STATUSES[found.status] == "solved"
    other = judged(data)
    assert other.success and abs(found.cost / other.fun - 1) < 1e-7
    assert abs(found.x[0, 2] - other.x[0]) < 1e-4
    assert np.abs(found.x[:, 1]).max() <= 1.0 and found.zu[:, 1].max() > 0.01  # the bound of the rate is active


def test_curvature_by_differences_is_that_of_second_derivatives(rng):
    class Differenced(Pendulum):
        differenced = True

    data = pendulum()
    x, u, lam, nu = rng.uniform(1, 2, (17, 3)), rng.normal(size=(16, 1)), rng.normal(size=(17, 3)), np.zeros(2)
    exact, near = (NEAR(form, data, x, u, lam, nu).C for form in (PENDULUM, Differenced()))
    assert np.abs(near - exact).max() < 1e-9 * np.abs(exact).max()


def test_other_numbers_compile_nothing_and_many_are_solved_at_once():
    swing(pendulum())
    before = riccati.SOLVE._cache_size()
    goals = [2.0, 2.5, 3.0]
    alone = [swing(pendulum(1.5, 0.4, goal, T=3.0)) for goal in goals]
    assert riccati.SOLVE._cache_size() == before
    form, data = Pendulum(), jax.tree.map(lambda *x: np.stack(x), *(pendulum(1.5, 0.4, goal, T=3.0) for goal in goals))
    x = np.linspace([0.0, 0.0, 3.0], [np.pi, 0.0, 3.0], form.count + 1)
    plan = lambda data: riccati.solve(form, data, riccati.begin(form, data, x, np.zeros((form.count, 1))), 200)
    many = jax.jit(jax.vmap(plan), **ONCE)(data)
    assert (many.status == riccati.SOLVED).all()
    assert np.allclose(many.cost, [float(s.cost) for s in alone], rtol=1e-8)


def test_a_motion_is_planned_again_from_where_it_was_pushed():
    whole = swing(pendulum(T=3.0))
    before = riccati.SOLVE._cache_size()
    at = whole.x[4] + np.array([0.05, -0.05, 0.0])
    data = pendulum(T=2.25, start=at[:2])
    again = riccati.SOLVE(Pendulum(), data, riccati.RESUME(Pendulum(), data, whole, 0.25), 200)
    assert riccati.SOLVE._cache_size() == before
    cold = swing(data)
    assert riccati.STATUSES[again.status] == riccati.STATUSES[cold.status] == "solved"
    assert abs(again.cost / cold.cost - 1) < 1e-6
    assert again.iteration <= 6 < cold.iteration  # measured 6 and 8


def test_what_cannot_be_reached_is_called_infeasible():
    found = swing(pendulum(rate=0.5, T=3.0))
    assert riccati.STATUSES[found.status] == "infeasible"


# -- plans -------------------------------------------------------------------------------------------------------------

PLANAR = """
kind = "reach"
[robot]
model = "planar3"
joints = { joint1 = -0.9, joint2 = 1.5, joint3 = 0.5 }
[goal]
position = [1.35, 0.25, 0.0]
[phases.reach]
duration = [8.0, 8.0]
control_points = 9
intervals = 24
[limits]
margin = 0.02
[weights]
time = 0.02
torque = 1.0
smoothness = 20.0
"""


@pytest.mark.parametrize("name", ["grasp", "identify", "detumble"])
def test_kinds_that_it_does_not_know_are_refused(name):
    with pytest.raises(TaskError, match="'sqp' and 'casadi'"):
        planners.plan(planners.load(name), solver="riccati", progress=False)


@pytest.mark.slow
def test_a_stage_and_its_derivatives_are_those_of_the_motion(rng):
    """Of the planar robot: along the manifold of states, against differences."""
    problem = shooting.problem(parse(PLANAR))
    form, data = problem.form.values, problem.data
    size, m = data.given.size, len(data.effort)
    joints = np.r_[data.start.q[7:] + rng.normal(size=3)]
    quat = rng.normal(size=4)
    x = shooting.State(
        np.r_[rng.normal(size=3), quat / np.linalg.norm(quat), joints],
        0.3 * rng.normal(size=9),
        rng.normal(size=3),
        np.array(8.0),
    )
    u = rng.normal(size=m)

    def stage(dz, data):
        new, r = form.stage(form.move(x, dz[:size]), u + dz[size:], data)
        return form.gap(new, x), r

    at = jax.jit(stage, **ONCE)
    J = jax.jit(jax.jacfwd(stage), **ONCE)(np.zeros(size + m), data)
    for step in 1e-5 * np.eye(size + m):
        slope = jax.tree.map(lambda a, b: (a - b) / 2e-5, at(step, data), at(-step, data))
        for found, want in zip(J, slope, strict=True):
            assert np.abs(found[:, step > 0][:, 0] - want).max() < 1e-8


@pytest.fixture(scope="module")
def plan():
    return planners.plan(parse(PLANAR), solver="riccati", progress=False)


@pytest.mark.slow
def test_a_reach_is_planned_and_certified(plan):
    assert plan.status == "solved" and plan.certificate.passed, plan.verdict
    assert plan.certificate.worst("distance") < 1e-7  # measured 8e-9


@pytest.mark.slow
def test_a_reach_is_planned_again_from_where_it_was_pushed(rng):
    """Half way, joints and rates pushed by 0.01 rad and rad/s: from the earlier solution in fewer iterations than from
    a straight path to its end, to the same minimum, and nothing is compiled for it.
    """
    task = parse(PLANAR)
    problem = shooting.problem(task)
    form, data = problem.form.values, jax.tree.map(jnp.asarray, problem.data)
    (guess,) = shooting.first_guesses(task, problem, 1)
    whole = riccati.SOLVE(form, data, riccati.BEGIN(form, data, *guess), 150)
    before = riccati.SOLVE._cache_size()
    half, last = (jax.tree.map(lambda y, k=k: y[k], whole.x) for k in (form.intervals // 2, -1))
    push = 0.01 * np.r_[np.zeros(6), rng.normal(size=3), np.zeros(6), rng.normal(size=3), np.zeros(4)]
    start = form.move(half, push)._replace(T=half.T / 2)
    low, high = (x.at[-1].set(start.T) for x in (data.lower, data.upper))
    later = data._replace(start=start, lower=low, upper=high)
    again = riccati.SOLVE(form, later, riccati.RESUME(form, later, whole, 0.5), 150)
    straight = jax.vmap(lambda s: form.move(start, s * form.gap(last, start)))(np.linspace(0, 1, form.intervals + 1))
    x = straight._replace(T=jnp.full(form.intervals + 1, start.T))
    cold = riccati.SOLVE(form, later, riccati.BEGIN(form, later, x, jnp.zeros_like(whole.u)), 150)
    assert riccati.SOLVE._cache_size() == before
    assert whole.status == again.status == cold.status == riccati.SOLVED
    assert abs(again.cost / cold.cost - 1) < 1e-7
    assert again.iteration <= 5 < cold.iteration  # measured 5 and 7
