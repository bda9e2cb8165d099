import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from planners import qp, sqp
from planners.problem import Block, Form, Problem, Rows, Values


def programme(rng, n, e, i, penalty=1e3):
    H = rng.normal(size=(n, n))
    A, C, x = rng.normal(size=(e, n)), rng.normal(size=(i, n)), rng.normal(size=n)
    c = -C @ x - rng.uniform(0, 1, i)
    wide = 10 * np.ones(n)
    return qp.Programme(H @ H.T / n, rng.normal(size=n), A, -A @ x, C, c, -wide, wide, np.asarray(penalty))


@pytest.mark.parametrize("sizes", [(6, 2, 5), (8, 0, 12), (5, 3, 0)])
def test_qp_agrees_with_scipy_and_meets_the_optimality_conditions(sizes):
    q = jax.tree.map(jnp.asarray, programme(np.random.default_rng(sizes[0]), *sizes))
    d, y, u = map(np.asarray, jax.jit(qp.solve)(q))
    assert np.abs(q.A @ d + q.a).max(initial=0) < 1e-9 and (q.C @ d + q.c).max(initial=0) < 1e-9
    assert np.abs(q.H @ d + q.g + y @ q.A + u @ q.C).max() < 1e-7
    assert np.abs(u * (q.C @ d + q.c)).max(initial=0) < 1e-8 and u.min(initial=0) >= 0
    value = lambda d: float(q.g @ d + d @ q.H @ d / 2)
    rules = [{"type": "eq", "fun": lambda d: np.asarray(q.A @ d + q.a)}] if sizes[1] else []
    rules += [{"type": "ineq", "fun": lambda d: -np.asarray(q.C @ d + q.c)}] if sizes[2] else []
    options = {"ftol": 1e-13, "maxiter": 500}
    other = minimize(value, np.zeros(sizes[0]), method="SLSQP", constraints=rules, options=options)
    assert value(d) <= other.fun + 1e-6 * (1 + abs(other.fun))


def test_qp_that_has_no_solution_puts_the_multipliers_at_the_penalty():
    q = programme(np.random.default_rng(0), 6, 2, 3, 100.0)
    A, a = q.A.copy(), q.a.copy()
    A[1], a[1] = A[0], a[0] + 1
    d, y, _ = jax.jit(qp.solve)(jax.tree.map(jnp.asarray, q._replace(A=A, a=a)))
    assert abs(np.abs(A @ d + a).sum() - 1) < 1e-8
    assert abs(np.abs(y).max() - 100) < 1e-6


def test_qp_with_redundant_rows_has_its_multipliers():
    """Rows that are zero or there twice, and more of them active than variables: rounding must not take over."""
    rng = np.random.default_rng(3)
    q = programme(rng, 8, 3, 30, 1e3)
    A, C, x = np.zeros((9, 8)), np.repeat(q.C, 2, axis=0), rng.normal(size=8) * 1e-3
    A[:3], A[3:6] = q.A, q.A
    C[40:] = 1e3 * C[40:]
    q = q._replace(A=A, a=-A @ x, C=C, c=-C @ x, lower=-0.01 + 0 * q.lower, upper=0.01 + 0 * q.upper)
    d, y, u = map(np.asarray, jax.jit(qp.solve)(jax.tree.map(jnp.asarray, q)))
    assert np.abs(A @ d + q.a).max() < 1e-9 and (C @ d + q.c).max() < 1e-9
    r = q.H @ d + q.g + y @ A + u @ C
    held = (np.abs(d) > 0.01 - 1e-7) & (r * d < 0)
    assert np.abs(np.where(held, 0, r)).max() < 1e-6
    assert np.abs(u * (C @ d + q.c)).max() < 1e-6 and u.min() >= 0


def hock_schittkowski_71(x, data):
    x = x["x"]
    cost = x[0] * x[3] * (x[0] + x[1] + x[2]) + x[2]
    return Values(cost, jnp.zeros(1), jnp.array([x @ x - 40]), jnp.array([25 - jnp.prod(x)]))


def rosenbrock_on_circle(x, radius):
    x = x["x"]
    residual = jnp.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])
    return Values(0 * x[0], residual, jnp.array([x @ x - radius**2]), jnp.array([x[0] - 0.5, 0.6 - x[0]]))


def ends(problem, *starts):
    return list(sqp.solve(problem, np.array(starts, float)))[-1]


def last(problem, z):
    return sqp.pick(ends(problem, z), 0)


def said(state):
    return sqp.STATUSES[state.status]


def problem_71():
    rows = (Rows("norm", 1.0, "", (1,)),), (Rows("product", 1.0, "", (1,)),)
    return Problem(Form((Block("x", (4,)),), hock_schittkowski_71), 0.0, {"x": 1.0}, {"x": 5.0}, *rows)


def test_sqp_solves_hock_schittkowski_71():
    state = last(problem_71(), [1, 5, 5, 1])
    assert said(state) == "solved"
    assert abs(state.near.cost - 17.0140172891) < 1e-7
    assert np.allclose(state.z, [1, 4.74299963, 3.82114998, 1.37940829], atol=1e-5)


def circle(radius, box=3.0):
    rows = (Rows("circle", 1.0, "m", (1,)),), (Rows("left", 1.0, "m", (1,)), Rows("right", 1.0, "m", (1,)))
    return Problem(Form((Block("x", (2,)),), rosenbrock_on_circle), radius, {"x": -box}, {"x": box}, *rows)


def test_sqp_names_the_constraint_that_cannot_hold():
    problem = circle(1.0)
    state = last(problem, [-1, 1])
    assert said(state) == "infeasible" and state.iteration < 60
    (name, amount, unit), *rest = problem.worst(state.near.equal, state.near.below)
    assert name in ("left", "right") and unit == "m" and abs(amount - 0.1) < 1e-6
    assert all(x[1] < 1e-6 for x in rest)


def around_a_corner(x, data):
    """The highest point of a disc that is far wider than the trust region, from its side along the edge."""
    x = x["x"]
    return Values(-x[1], jnp.zeros(1), jnp.zeros(0), (x @ x / data - data)[None] / 2)


def test_a_step_that_brings_more_than_its_violation_costs_is_progress():
    """Every iterate but the first leaves the disc by as much, until the top is near: no reason to give up."""
    radius = 40.0
    problem = Problem(Form((Block("x", (2,)),), around_a_corner), radius, {}, {}, (), (Rows("disc", 1.0, "", (1,)),))
    *_, state = sqp.solve(problem, np.array([[radius, 0.0]]))
    end = sqp.outcome(sqp.pick(state, 0))
    assert end.status == "solved" and end.iteration > 2 * sqp.STALLED  # measured 64
    assert np.abs(end.z - [0.0, radius]).max() < 1e-6  # measured 1.9e-11


def test_the_same_solve_twice_is_identical():
    assert np.array_equal(last(problem_71(), [1, 5, 5, 1]).z, last(problem_71(), [1, 5, 5, 1]).z)


# -- several starts ----------------------------------------------------------------------------------------------------


def two_valleys(x, tilt):
    x = x["x"]
    return Values(tilt * x[0], jnp.array([x[0] ** 2 - 1, x[1]]), jnp.array([x[1] - x[0] ** 3 + x[0]]), jnp.zeros(0))


VALLEYS = Problem(
    Form((Block("x", (2,)),), two_valleys), 0.1, {"x": -4.0}, {"x": 4.0}, (Rows("path", 1.0, "m", (1,)),), ()
)
STARTS = [[3.0, 2.0], [1.1, 0.0], [-0.4, 0.3], [-2.0, -1.0]]


def test_several_starts_are_solved_as_each_alone():
    rounds = list(sqp.solve(VALLEYS, np.array(STARTS)))
    together = rounds[-1]
    for k, z in enumerate(STARTS):
        alone, state = last(VALLEYS, z), sqp.pick(together, k)
        assert said(state) == said(alone) == "solved"
        assert np.array_equal(state.z, alone.z)  # one program does both
        ended = [states[k] for states in rounds if states[k].status != sqp.RUNNING]
        assert all(np.array_equal(s.z, state.z) for s in ended)  # what has ended waits
    assert sqp.running(rounds[0]) == 4 and sqp.running(together) == 0
    assert len({int(s.iteration) for s in together}) > 1


def test_the_best_start_comes_first():
    together = ends(VALLEYS, *STARTS)
    order = sqp.ranking(together)
    costs = np.array([s.near.cost for s in together])[order]
    assert np.diff(costs).min() > -1e-9 and costs[-1] - costs[0] > 0.19  # the valleys' bottoms: 0.1 and -0.1
    assert together[order[0]].z[0] < -0.9
    lost = [s._replace(status=sqp.INFEASIBLE) if k == order[0] else s for k, s in enumerate(together)]
    assert sqp.ranking(lost)[-1] == order[0]


def worse_valley(x, tilt):
    """Slow enough that all starts are compared: far along a curved valley."""
    x = x["x"]
    bend = jnp.array([10 * (x[1] - x[0] ** 2), x[0] ** 2 - 1])
    return Values(tilt * x[0], bend, jnp.zeros(0), jnp.array([x[1] - 20]))


SLOW = Problem(
    Form((Block("x", (2,)),), worse_valley), 0.1, {"x": -4.0}, {"x": 4.0}, (), (Rows("height", 1.0, "m", (1,)),)
)


def test_after_some_iterations_only_the_best_starts_go_on(monkeypatch):
    monkeypatch.setattr(sqp, "TRIAL", 2)
    starts = np.random.default_rng(0).uniform(-4, 4, (12, 2))
    rounds = list(sqp.solve(SLOW, starts))
    merit = lambda s: sqp.merit(s.near, sqp.PENALTIES[0])
    before, compared, end = rounds[1], rounds[2], rounds[-1]
    dropped = [s for s in compared if said(s) == "dropped"]
    running = [s for s in compared if said(s) == "running"]
    assert sqp.running(before) > sqp.KEPT == len(running) and dropped
    assert min(map(merit, dropped)) >= max(map(merit, running))
    assert [said(s) for s in end].count("dropped") == len(dropped)
    best, *_, last_of_all = sqp.ranking(end)
    assert said(end[best]) == "solved" and said(end[last_of_all]) == "dropped"


def test_dropped_starts_are_taken_up_again_where_none_is_solved(monkeypatch):
    monkeypatch.setattr(sqp, "TRIAL", 1)
    *_, end = sqp.solve(circle(1.0), np.random.default_rng(0).uniform(-2, 2, (6, 2)))
    assert {said(s) for s in end} == {"infeasible"}
