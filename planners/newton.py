"""Newton's step on the constraints that hold: a quadratic programme whose active rows are known, solved exactly.

    minimise  g.d + d.H d / 2   subject to   J d + c = 0

by an orthonormal basis [Y, Z] of the rows' span and of their null space (QR of J^T with pivots; rows that depend on
others get no multiplier). Which rows hold is found by the primal-dual active set method: those whose multiplier
exceeds their slack. All on the host.
Source: Nocedal and Wright, Numerical Optimization, section 16.2; Hintermueller, Ito and Kunisch (2002), The primal-dual
active set strategy as a semismooth Newton method.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, qr, solve_triangular

from planners.problem import Linear

DEPENDENT = 1e-10  # part of the largest pivot below which a row depends on others
ROUNDS = 8  # of active sets


class Limits(NamedTuple):
    """All inequalities of a problem near one point, the finite bounds as rows behind the others."""

    rows: np.ndarray  # [k, n]
    values: np.ndarray  # [k], at most zero
    weights: np.ndarray  # [k] multipliers


class Basis:
    """The rows J [k, n] that hold, their span and their null space."""

    def __init__(self, J):
        Q, R, order = qr(J.T, pivoting=True)
        pivots = np.abs(np.diag(R))
        rank = int((pivots > DEPENDENT * pivots.max(initial=0.0)).sum())
        self.J, self.held, self.R = J, order[:rank], R[:rank, :rank]
        self.Y, self.Z = Q[:, :rank], Q[:, rank:]

    def within(self, c):
        """The shortest d [n] with J d + c = 0."""
        return self.Y @ solve_triangular(self.R, -c[self.held], trans=1)

    def balance(self, slope):
        """Multipliers [k] with J^T multipliers + slope = 0, as far as the rows' span goes."""
        multipliers = np.zeros(len(self.J))
        multipliers[self.held] = solve_triangular(self.R, -self.Y.T @ slope)
        return multipliers

    def solve(self, H, g, c):
        """The step d [n] and the multipliers [k].

        Raises:
            LinAlgError: If the curvature on the null space, Z^T H Z, is not positive definite.
        """
        factors, d = cho_factor(self.Z.T @ H @ self.Z), self.within(c)
        d = d - self.Z @ cho_solve(factors, self.Z.T @ (g + H @ d))
        return d, self.balance(g + H @ d)


def limits(near: Linear, z, y, u, low, high) -> Limits:
    """The inequalities at z [n], with multipliers y and u; those of bounds balance the gradient of the Lagrangian."""
    upper, lower, one = np.isfinite(high), np.isfinite(low), np.eye(len(z))
    r = near.gradient + y @ near.A + u @ near.C
    return Limits(
        np.concatenate([near.C, one[upper], -one[lower]]),
        np.concatenate([near.below, (z - high)[upper], (low - z)[lower]]),
        np.concatenate([u, np.maximum(-r, 0)[upper], np.maximum(r, 0)[lower]]),
    )


def step(near: Linear, H, z, y, u, low, high):
    """The step from z [n] with curvature H [n, n], and its multipliers: (d, y, u), or None where there is none."""
    at, e = limits(near, z, y, u, low, high), len(y)
    holds = at.weights > -at.values
    for _ in range(ROUNDS):
        J, c = np.concatenate([near.A, at.rows[holds]]), np.concatenate([near.equal, at.values[holds]])
        try:
            d, found = Basis(J).solve(H, near.gradient, c)
        except LinAlgError:
            return None
        weights = np.zeros(len(holds))
        weights[holds] = found[e:]
        before, holds = holds, weights > -(at.values + at.rows @ d)
        if np.array_equal(before, holds):
            return d, found[:e], weights[: len(u)]
    return None
