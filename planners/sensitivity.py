"""How a plan changes with the numbers of its task: the derivative of a solution, without solving again.

Numbers p move on a line. Where the rows J that hold keep holding, the conditions of optimality, differentiated, say

    [W  J^T] [dz     ]     [d(gradient of the Lagrangian)/dp]
    [J  0  ] [dlambda] = - [d(rows)/dp                      ],    dcost = d(Lagrangian)/dp.

What the rows leave free is found by conjugate gradients, with products of W by differences of gradients and
Gauss-Newton as the preconditioner: nothing is compiled that the solver had not.
Source: Fiacco (1983), Introduction to Sensitivity and Stability Analysis in Nonlinear Programming.
"""

import importlib
from typing import NamedTuple

import jax
import numpy as np
from scipy.linalg import cho_factor, cho_solve

from planners import newton, sqp
from planners.optimality import SOFT, curved
from planners.plan import Plan
from planners.problem import Problem
from planners.task import Task

PART = 1e-3  # of the way to the other numbers, for differences
DECIDED = 1e-6  # scaled: least sum of a row's slack and its multiplier
EXACT, MOST = 1e-8, 100  # relative residual of the conjugate gradients, and their iterations


class Sensitivity(NamedTuple):
    """Derivatives for the whole way to the other numbers: what a solution would change by, to first order."""

    cost: float
    variables: dict[str, np.ndarray]  # by name, physical units
    z: np.ndarray  # [n] the same, scaled
    y: np.ndarray  # [e] multipliers of the equalities
    u: np.ndarray  # [i] multipliers of the inequalities


def sensitivity(task: Task, plan: Plan, other: Task) -> Sensitivity:
    """How the plan of a task changes on the way to another task that differs in numbers.

    Args:
        task: What was planned.
        plan: A solved one.
        other: The same with other limits, weights, states or masses; the closer, the better the line between the
            numbers stands for what is between the tasks.

    Raises:
        ValueError: If the tasks differ in more than numbers, or if the solution has no derivative: a limit is touched
            that has no weight, the rows that hold contradict each other, or the minimum is not strict.
    """
    make, fine = importlib.import_module(f"planners.{task.kind}").problem, plan.info["options"]["fine"]
    problem, there = make(task, fine), make(other, fine)
    z, multipliers = problem.form.join(plan.variables), plan.multipliers
    return derivative(problem, there, z, multipliers["equal"], multipliers["below"])


def derivative(problem: Problem, other: Problem, z, y, u) -> Sensitivity:
    """The same for a problem, its solution z [n] (scaled) and multipliers y [e], u [i]; errors as in `sensitivity`."""
    if problem.form != other.form:
        raise ValueError("sensitivity: the two tasks differ in more than numbers; give them the same sizes and names.")
    e, at = len(y), sqp.near(problem, z)
    _, low, high = problem.numbers
    here = newton.limits(at, z, y, u, low, high)
    holds = _decided(problem, here)
    weights = np.where(holds, here.weights, 0.0)[: len(u)]

    def told(t):
        """Lagrangian, its gradient and the rows that hold, part t of the way."""
        numbers = _between(problem.numbers, other.numbers, t)
        near = sqp.near(problem, z, numbers)
        rows = newton.limits(near, z, y, u, *numbers[1:])
        gradient = near.gradient + y @ near.A + weights @ near.C
        values = np.concatenate([near.equal, rows.values[holds]])
        return np.concatenate([[near.cost + multipliers @ values], gradient, values])

    multipliers = np.concatenate([y, here.weights[holds]])
    cost, slope, rows = np.split((told(PART) - told(-PART)) / (2 * PART), [1, 1 + len(z)])
    basis = newton.Basis(np.concatenate([at.A, here.rows[holds]]))
    W = lambda d: curved(problem, z, y, weights, d)
    dz = basis.within(rows)
    if np.abs(basis.J @ dz + rows).max(initial=0.0) > DECIDED * (1 + np.abs(rows).max(initial=0.0)):
        raise ValueError("sensitivity: the rows that hold the solution depend on each other and would part.")
    dz = dz + _free(basis.Z, np.asarray(at.curvature), W, slope + W(dz))
    change = basis.balance(slope + W(dz))
    du = np.zeros(len(here.weights))
    du[holds] = change[e:]
    return Sensitivity(float(cost[0]), problem.form.split(dz), dz, change[:e], du[: len(u)])


def _decided(problem, at: newton.Limits):
    """Which rows and bounds hold; each must do so clearly, or be clearly free."""
    holds, sure = at.weights > -at.values, np.abs(at.weights) + np.abs(at.values) > DECIDED
    if sure.all():
        return holds
    ends = np.cumsum([rows.size for rows in problem.below])
    group = int(np.searchsorted(ends, np.flatnonzero(~sure)[0], side="right"))
    name = problem.below[group].name if group < len(ends) else "bound of a variable"
    raise ValueError(
        f"sensitivity: the {name} is touched, but nothing is gained by giving it room: the solution follows it on one "
        "side only, and has no derivative. Change the limit a little."
    )


def _between(mine, other, t):
    """Numbers, part t of the way from mine to the other's."""

    def point(a, b):
        x, y = np.asarray(a), np.asarray(b)
        if np.array_equal(x, y):
            return a
        if x.shape != y.shape or x.dtype.kind != "f":
            raise ValueError("sensitivity: the two tasks differ in their structures, not only in numbers.")
        x = x + t * np.subtract(y, x, out=np.zeros_like(x), where=x != y)  # without infinite bounds
        return float(x) if getattr(a, "weak_type", isinstance(a, float)) else x  # of the same type for JAX

    return jax.tree.map(point, mine, other)


def _free(Z, curvature, W, slope):
    """The step within Z that Z^T (W d + slope) = 0 asks for."""
    from scipy.sparse.linalg import LinearOperator, cg  # importing it adds a filter of warnings

    m, B = Z.shape[1], Z.T @ curvature @ Z
    if not m:
        return np.zeros(len(Z))
    factor = cho_factor(B + SOFT * max(np.trace(B), 1.0) * np.eye(m))
    as_operator = lambda f: LinearOperator((m, m), matvec=f, dtype=float)
    product, like = as_operator(lambda x: Z.T @ W(Z @ x)), as_operator(lambda x: cho_solve(factor, x))
    x, failed = cg(product, -Z.T @ slope, rtol=EXACT, maxiter=MOST, M=like)
    if failed or x @ (Z.T @ slope) > 0:  # = -x.W x at the solution
        raise ValueError("sensitivity: the solution is no strict minimum within what holds it; solve it better first.")
    return Z @ x
