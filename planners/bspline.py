"""Clamped B-splines on the unit interval, as matrices made on the host.

A curve is x(s) = sum_j N_j(s) P_j with s = t / T in [0, 1], uniform inner knots and control points P [n, ...], so
value, rate and acceleration are matrix products: x = N P, x' = N' P / T, x'' = N'' P / T^2.

Source: de Boor, A Practical Guide to Splines (recurrence of the basis, control points of the derivative).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class Clamped:
    """The basis of `count` functions of one degree; the curve starts at the first control point and ends at the last.

    Args:
        count: Number of control points, more than `degree`.
        degree: 3 for continuous accelerations, 5 for continuous fourth derivatives.
    """

    count: int
    degree: int = 5

    @property
    def knots(self) -> np.ndarray:
        """The knots, [count + degree + 1]."""
        inner = np.linspace(0.0, 1.0, self.count - self.degree + 1)
        return np.r_[np.zeros(self.degree), inner, np.ones(self.degree)]

    def basis(self, s, order: int = 0) -> np.ndarray:
        """Values of the `order`-th derivatives of all basis functions at the points s.

        Args:
            s: Points in [0, 1], [m].
            order: 0 for the value, 1 for the first derivative with respect to s, ...

        Returns:
            Matrix [m, count].
        """
        values, difference = _basis(self.knots, self.degree - order, np.asarray(s, float)), np.eye(self.count)
        for k in range(order):
            difference = self._difference(k) @ difference
        return values[:, order : self.count] @ difference

    def hull(self, order: int) -> np.ndarray:
        """Map from the control points to those of the `order`-th derivative, [count - order, count].

        The curve of the derivative stays between the smallest and the largest of them.
        """
        difference = np.eye(self.count)
        for k in range(order):
            difference = self._difference(k) @ difference
        return difference

    def _difference(self, k: int) -> np.ndarray:
        """Control points of the k-th derivative to those of the next."""
        degree, knots = self.degree - k, self.knots[k : len(self.knots) - k]
        n = self.count - k
        span = knots[degree + 1 : degree + n] - knots[1:n]
        return (np.eye(n, k=1) - np.eye(n))[: n - 1] * (degree / span)[:, None]

    @cached_property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Maps [3, 3] from (x, T x', T^2 x'') at the start to the first three control points, and from the end's
        to the last three.
        """
        rows = [np.concatenate([self.basis([s], k) for k in range(3)]) for s in (0.0, 1.0)]
        return np.linalg.inv(rows[0][:, :3]), np.linalg.inv(rows[1][:, -3:])

    @cached_property
    def between(self) -> tuple[np.ndarray, np.ndarray]:
        """Maps to the control points of a curve with given position and rate at the start and rate at the end.

        Returns:
            [count, 3] from (x, T x', T x' at the end) to the curve of constant acceleration, and [count, count - 3]
            from what is free to a curve that is zero in all three, T^2 times the acceleration: of orthonormal ones.
        """
        s = np.linspace(0.0, 1.0, 20 * self.count)
        even = np.linalg.lstsq(self.basis(s), np.stack([s**0, s - s**2 / 2, s**2 / 2], axis=1))[0]
        held = np.concatenate([self.basis([0.0]), self.basis([0.0], 1), self.basis([1.0], 1)])
        free = np.linalg.svd(held)[2][3:].T
        bent = self.basis(s, 2) @ free
        return even, free @ np.linalg.inv(np.linalg.cholesky(bent.T @ bent / len(s))).T


def _basis(knots, degree, s):
    """All basis functions of one degree at the points s, [m, len(knots) - degree - 1], by the recurrence."""
    last = np.searchsorted(knots, knots[-1]) - 1  # the interval that holds its right end
    cell = np.minimum(np.searchsorted(knots, s, side="right") - 1, last)
    N = np.eye(len(knots) - 1)[cell]
    for p in range(1, degree + 1):
        left, right = knots[p:-1] - knots[: -p - 1], knots[p + 1 :] - knots[1:-p]
        up = np.divide(s[:, None] - knots[: -p - 1], left, where=left > 0, out=np.zeros((len(s), len(left))))
        down = np.divide(knots[p + 1 :] - s[:, None], right, where=right > 0, out=np.zeros((len(s), len(right))))
        N = up * N[:, :-1] + down * N[:, 1:]
    return N
