"""Whether a point is a minimum of a problem, and what its limits cost, measured without the solver's own estimates.

The gradient of the Lagrangian is taken by central differences of the problem's values. The curvature is that of the
Lagrangian, by central differences of its gradient, within the constraints that hold: Z^T W Z with a basis Z of what
their rows leave free. Its least value is sought by Lanczos' method in the metric of Gauss-Newton, B = Z^T J^T J Z,
where the eigenvalues lie close to 1: a few directions tell. It is positive at a strict minimum.
Source: Nocedal and Wright, Numerical Optimization, theorems 12.1 and 12.6 (the conditions); Golub and Van Loan, Matrix
Computations, chapter 10 (Lanczos).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cholesky, eigh, null_space, solve_triangular

from planners import sqp
from planners.problem import Problem, summaries

DIFFERENCE, BEND = 1e-6, 1e-4  # steps of differences of values and of gradients, scaled variables
HELD = 1e-6  # distance to a bound, scaled
DIRECTIONS = 12  # in which the curvature is looked at
SOFT = 1e-9  # part of the largest curvature that is added to the metric
PRICES = 5  # limits that are named


@dataclass(frozen=True)
class Price:
    """What one unit more would save of the cost, to first order: of a group of rows, or of one bound."""

    name: str
    amount: float
    unit: str
    """Of what would be given: the price is per such unit."""


class Optimality(NamedTuple):
    """What is left of the conditions of a minimum, relative to 1 + the gradient of the cost; scaled variables."""

    residual: float  # of stationarity, complementarity and the signs of multipliers
    curvature: float  # the least that was found within the constraints that hold; zero where they leave nothing free
    prices: tuple[Price, ...]  # the largest first, relative to the groups' scales


def measure(problem: Problem, z, y, u) -> Optimality:
    """What can be said of a point z [n] (scaled) with multipliers y [e] and u [i] of the rows."""
    form, (data, low, high) = problem.form, problem.numbers

    def values(zs):
        v = summaries(form, zs, data)
        return np.array([v.cost, v.cost + v.equal @ y + v.below @ u])

    steps = DIFFERENCE * np.eye(len(z))
    slopes, r = (values(z + steps) - values(z - steps)) / (2 * DIFFERENCE)
    (below,) = summaries(form, z[None], data).below
    bounds = np.where(z <= low + HELD, np.maximum(r, 0.0), 0.0), np.where(z >= high - HELD, np.maximum(-r, 0.0), 0.0)
    left = r - bounds[0] + bounds[1]
    worst = max(np.abs(left).max(), np.abs(u * below).max(initial=0.0), -u.min(initial=0.0))
    scale = 1 + np.abs(slopes).max()
    curvature = _least_curvature(problem, z, y, u, u > -below, sum(bounds) > 0)
    return Optimality(float(worst / scale), float(curvature / scale), _prices(problem, y, u, *bounds))


def _least_curvature(problem, z, y, u, holds, held) -> float:
    """Least curvature of the Lagrangian in the null space of the rows and bounds that hold."""
    near = sqp.near(problem, z)
    rows = np.concatenate([near.A, np.asarray(near.C)[holds], np.eye(len(z))[held]])
    Z = null_space(rows) if len(rows) else np.eye(len(z))
    if not Z.shape[1]:
        return 0.0
    B = Z.T @ np.asarray(near.curvature) @ Z
    factor = cholesky(B + SOFT * max(np.trace(B), 1.0) * np.eye(len(B)), lower=True)

    bent = lambda x: Z.T @ curved(problem, z, y, u, Z @ x)
    X, WX = [], []  # directions, orthonormal in the metric, and what the curvature makes of them
    new = np.random.default_rng(0).normal(size=len(B))
    while len(X) < min(DIRECTIONS, len(B)):
        for x in X + X:  # twice: to rounding
            new = new - x * (x @ new)
        if np.linalg.norm(new) < 1e-8:
            break
        X.append(new / np.linalg.norm(new))
        WX.append(solve_triangular(factor, bent(solve_triangular(factor, X[-1], trans=1, lower=True)), lower=True))
        new = WX[-1]
    X, WX = np.array(X).T, np.array(WX).T
    plain = solve_triangular(factor, X, trans=1, lower=True)  # the same directions, in the metric of the variables
    return eigh((X.T @ WX + WX.T @ X) / 2, plain.T @ plain, eigvals_only=True)[0]


def curved(problem: Problem, z, y, u, d) -> np.ndarray:
    """Curvature of the Lagrangian times a direction d [n], by central differences of its gradient at z [n]."""
    step = BEND / max(np.abs(d).max(), 1e-300)
    there, back = (sqp.near(problem, z + s * d) for s in (step, -step))
    gradient = lambda at: np.asarray(at.gradient + y @ at.A + u @ at.C)
    return (gradient(there) - gradient(back)) / (2 * step)


def _prices(problem, y, u, lower, upper) -> tuple[Price, ...]:
    """Sums of the multipliers of each group, and those of bounds, in units of the cost per physical unit."""
    found = []
    for groups, multipliers in ((problem.equal, np.abs(y)), (problem.below, u)):
        ends = np.cumsum([rows.size for rows in groups]).astype(int)
        for rows, part in zip(groups, np.split(multipliers, ends[:-1]) if groups else (), strict=True):
            found.append((part.sum(), Price(rows.name, float(part.sum() / rows.scale), rows.unit)))
    name = lambda b, k: f"{b.name}[{k}]" if b.size > 1 else b.name
    names = [(name(b, k), unit, b.units) for b in problem.form.blocks for k, unit in enumerate(np.ravel(b.unit))]
    for side, multipliers in (("lower", lower), ("upper", upper)):
        for k in np.flatnonzero(multipliers):
            name, unit, words = names[k]
            found.append((multipliers[k], Price(f"{side} bound of {name}", float(multipliers[k] / unit), words)))
    best = sorted(found, key=lambda pair: -pair[0])[:PRICES]
    return tuple(price for weight, price in best if weight > 0)
