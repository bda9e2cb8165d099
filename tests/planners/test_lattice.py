"""Interpolation on lattices: exact where it must be, and its error where that is known."""

import itertools

import numpy as np
import pytest

from planners.lattice import Lattice

UNEVEN = [np.array([0.0, 1.0, 1.5, 4.0]), np.array([-1.0, 0.0, 2.0]), np.array([3.0])]
POINTS = np.array(list(itertools.product(*UNEVEN)))


def interpolated(lattice, point, values):
    return sum(weight * values[k] for k, weight in lattice.weights(point).items())


def test_what_is_linear_along_each_axis_is_met(rng):
    lattice = Lattice(rng.permutation(POINTS))
    f = lambda x: 2 + x[..., 0] - 3 * x[..., 1] + 0.5 * x[..., 0] * x[..., 1]
    for point in (*rng.uniform([0, -1, 3], [4, 2, 3], (20, 3)), POINTS[0], POINTS[-1], [4.0, 1.0, 3.0]):
        assert abs(interpolated(lattice, point, f(lattice.points)) - f(np.asarray(point))) < 1e-12
        assert abs(sum(lattice.weights(point).values()) - 1) < 1e-14
    assert lattice.weights(POINTS[5]) == {list(map(tuple, lattice.points)).index(tuple(POINTS[5])): 1.0}


def test_the_error_at_a_kink_is_within_the_bound_which_is_sharp():
    """A kink anywhere in a cell, at the lattice's end too: the largest error is where it is."""
    axis, ratios = np.array([0.0, 1.0, 1.5, 4.0, 4.5]), []
    lattice = Lattice(axis[:, None])
    for kink in np.linspace(0.01, 4.49, 225):
        values = np.maximum(axis - kink, 0.0)
        weights = lattice.weights([kink])
        if len(weights) == 2:
            ratios.append(
                sum(w * values[k] for k, w in weights.items()) / lattice.error(weights, dict(enumerate(values)))
            )
    assert 0.95 < max(ratios) <= 1  # measured 0.99


def test_the_error_of_a_quadratic_is_known(rng):
    """Along each axis of an even lattice: at most an eighth of the bound, and that much in the middle."""
    lattice = Lattice(list(itertools.product(np.arange(4.0), 0.5 * np.arange(3.0))))
    f = lambda x: np.stack([3 * x[..., 0] ** 2 + x[..., 1] ** 2, x[..., 1] - x[..., 0] ** 2], axis=-1)
    values = f(lattice.points)
    middles = lattice.middles(range(len(values)))
    assert len(middles) == 6
    for point in (*middles, *rng.uniform(0, [3, 1], (20, 2))):
        error = np.abs(interpolated(lattice, point, values) - f(point))
        bound = lattice.error(lattice.weights(point), dict(enumerate(values)))
        assert np.allclose(bound, [6 + 2 * 0.5**2, 2.0])
        assert (error <= bound / 8 + 1e-12).all()
        assert not any(np.array_equal(point, x) for x in middles) or np.allclose(error, bound / 8)


def test_where_points_are_missing_nothing_is_said():
    some = np.delete(POINTS, 4, axis=0)  # (1, 0, 3)
    lattice = Lattice(some)
    assert lattice.weights([0.5, -0.5, 3]) is None and lattice.weights([5.0, 0, 3]) is None
    assert lattice.weights([1.2, 2.0, 3]) is not None  # on an edge that is whole
    assert len(lattice.middles(range(len(some)))) == 2
    for points in ([1.0, 2.0], [], [[np.nan]]):
        with pytest.raises(ValueError, match=r"\[count, axes\]"):
            Lattice(points)
    two = Lattice([[0.0], [1.0]])
    assert np.isinf(two.error(two.weights([0.5]), {0: np.zeros(2), 1: np.ones(2)})).all()


@pytest.mark.parametrize("first", [0, 7])
def test_every_point_follows_one_as_near_as_any(first, rng):
    ball = [n for n in itertools.product(range(-2, 3), repeat=3) if np.dot(n, n) <= 4]
    points = np.array(ball) * [1.0, 0.1, 5.0]
    points[[0, first]] = points[[first, 0]]
    lattice = Lattice(points)
    order = lattice.order
    assert order[0] == 0 and sorted(order) == list(range(len(points))) and order == Lattice(points).order
    for at in range(1, len(order)):
        near = [lattice.distances(k)[order[:at]].min() for k in order[at:]]
        assert near[0] == min(near) == 1
