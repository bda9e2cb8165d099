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


def hock_schittkowski_71(x, data):
    x = x["x"]
    cost = x[0] * x[3] * (x[0] + x[1] + x[2]) + x[2]
    return Values(cost, jnp.zeros(1), jnp.array([x @ x - 40]), jnp.array([25 - jnp.prod(x)]))


def rosenbrock_on_circle(x, radius):
    x = x["x"]
    residual = jnp.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])
    return Values(0 * x[0], residual, jnp.array([x @ x - radius**2]), jnp.array([x[0] - 0.5, 0.6 - x[0]]))




def last(problem, z):
    return list(sqp.solve(problem.form, np.asarray(z, float), problem.numbers))[-1]


def test_sqp_solves_hock_schittkowski_71():
    rows = (Rows("norm", 1.0, "", (1,)),), (Rows("product", 1.0, "", (1,)),)
    problem = Problem(Form((Block("x", (4,)),), hock_schittkowski_71), 0.0, {"x": 1.0}, {"x": 5.0}, *rows)
    state = last(problem, [1, 5, 5, 1])
    assert state.status == "solved"
    assert abs(state.near.cost - 17.0140172891) < 1e-7
    assert np.allclose(state.z, [1, 4.74299963, 3.82114998, 1.37940829], atol=1e-5)


def test_sqp_names_the_constraint_that_cannot_hold():
    rows = (Rows("circle", 1.0, "m", (1,)),), (Rows("left", 1.0, "m", (1,)), Rows("right", 1.0, "m", (1,)))
    problem = Problem(Form((Block("x", (2,)),), rosenbrock_on_circle), 1.0, {"x": -3.0}, {"x": 3.0}, *rows)
    state = last(problem, [-1, 1])
    assert state.status == "infeasible"
    (name, amount, unit), *rest = problem.worst(state.near.equal, state.near.below)
    assert name in ("left", "right") and unit == "m" and abs(amount - 0.1) < 1e-6
    assert all(x[1] < 1e-6 for x in rest)


def test_the_same_solve_twice_is_identical():
    rows = (Rows("norm", 1.0, "", (1,)),), (Rows("product", 1.0, "", (1,)),)
    problem = Problem(Form((Block("x", (4,)),), hock_schittkowski_71), 0.0, {"x": 1.0}, {"x": 5.0}, *rows)
    assert np.array_equal(last(problem, [1, 5, 5, 1]).z, last(problem, [1, 5, 5, 1]).z)
