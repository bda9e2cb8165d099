"""Points on a lattice: an order in which each has an earlier neighbour, and linear interpolation with its error.

Plans change smoothly with a task's numbers, but for kinks where a limit begins or ceases to hold. Linear along each
axis of a cell, they are off by at most

    |f - I f| <= sum_k h_k max |change of the slope along k|

with h the sides of the cell, and the slopes those to either side of its corners. Along one axis this holds for a kink
anywhere in the cell, where it is sharp, and is 8 times h^2 |f''| / 8 where f is smooth; along the others because
interpolating does not enlarge. It is an estimate: slopes come from differences, and two kinks may hide each other.
Source: de Boor (2001), A Practical Guide to Splines, chapters II and XVII, for smooth functions.
"""

import functools
import itertools

import numpy as np


class Lattice:
    """Points [count, axes], any part of a regular lattice; the axes need not be even."""

    def __init__(self, points):
        self.points = np.asarray(points, float)
        if self.points.ndim != 2 or not self.points.size or not np.isfinite(self.points).all():
            raise ValueError(f"points have the shape {self.points.shape}; give finite numbers, [count, axes].")
        self.axes = [np.unique(x) for x in self.points.T]
        self.steps = np.stack([np.searchsorted(a, x) for a, x in zip(self.axes, self.points.T, strict=True)], axis=1)
        self.row = {tuple(map(int, step)): k for k, step in enumerate(self.steps)}

    @functools.cached_property
    def order(self) -> list[int]:
        """From the first point on, always the one next that is nearest to any before it; of equals, the first."""
        out, distance = [0], self.distances(0)
        while len(out) < len(self.points):
            distance[out] = np.inf
            out.append(int(np.argmin(distance)))
            distance = np.minimum(distance, self.distances(out[-1]))
        return out

    def distances(self, k: int) -> np.ndarray:
        """From one point to all, in steps of the lattice, [count]."""
        return np.linalg.norm(self.steps - self.steps[k], axis=1)

    def weights(self, point) -> dict[int, float] | None:
        """{row: weight} of the points that are interpolated at one [axes]; None where one of them is missing."""
        sides = []
        for axis, x in zip(self.axes, np.asarray(point, float), strict=True):
            if not axis[0] <= x <= axis[-1]:
                return None
            k = int(np.searchsorted(axis, x, side="right")) - 1
            part = 0.0 if k == len(axis) - 1 else float((x - axis[k]) / (axis[k + 1] - axis[k]))
            sides.append([(k, 1 - part), (k + 1, part)] if part else [(k, 1.0)])
        corners = {tuple(k for k, _ in c): np.prod([w for _, w in c]) for c in itertools.product(*sides)}
        return {self.row[c]: float(w) for c, w in corners.items()} if all(c in self.row for c in corners) else None

    def error(self, rows, values: dict[int, np.ndarray]) -> np.ndarray:
        """What interpolating between rows of a cell errs by at most, of values {row: array}; infinite where no corner
        has values on both of its sides.
        """
        total = np.zeros_like(next(iter(values.values())))
        corners = self.steps[list(rows)]
        for k in np.flatnonzero(np.ptp(corners, axis=0)):
            side = np.diff(self.axes[k][[corners[:, k].min(), corners[:, k].max()]])[0]
            found = [self._bend(corner, k, values) for corner in corners]
            found = [x for x in found if x is not None]
            total = total + (side * np.max(found, axis=0) if found else np.inf)
        return total

    def _bend(self, step, k, values):
        """Change of the slope along one axis at a point; None where a neighbour along it has no values."""
        rows = [self.row.get(tuple(map(int, step + d * (np.arange(len(step)) == k)))) for d in (-1, 0, 1)]
        if any(row not in values for row in rows):
            return None
        a, b, c = (self.points[row, k] for row in rows)
        f, g, h = (values[row] for row in rows)
        return np.abs((h - g) / (c - b) - (g - f) / (b - a))

    def middles(self, rows) -> np.ndarray:
        """Middles of the cells whose corners are all among some rows, [cells, axes]."""
        wide, out = [len(axis) > 1 for axis in self.axes], []
        for k in rows:
            ends = [(s, s + w) for s, w in zip(self.steps[k], wide, strict=True)]
            if all(self.row.get(tuple(map(int, c))) in rows for c in itertools.product(*ends)):
                out.append([axis[[s, e]].mean() for axis, (s, e) in zip(self.axes, ends, strict=True)])
        return np.reshape(out, (-1, len(self.axes)))
