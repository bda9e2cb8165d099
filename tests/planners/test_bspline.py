import numpy as np
import pytest
from scipy.interpolate import BSpline

from planners.bspline import Clamped

SPLINES = [Clamped(7), Clamped(12), Clamped(6, 3), Clamped(4, 3)]


@pytest.mark.parametrize("spline", SPLINES)
def test_values_and_derivatives_are_those_of_scipy(spline):
    points = np.random.default_rng(0).normal(size=(spline.count, 2))
    s, other = np.linspace(0, 1, 41), BSpline(spline.knots, points, spline.degree)
    for order in range(3):
        ours = spline.basis(s, order) @ points
        assert np.allclose(ours, other(s, order), rtol=0, atol=1e-11 * max(1, np.abs(ours).max()))


@pytest.mark.parametrize("spline", SPLINES)
def test_the_basis_sums_to_one_and_the_hull_bounds_the_rate(spline):
    s = np.linspace(0, 1, 201)
    assert np.allclose(spline.basis(s).sum(axis=1), 1, atol=1e-14)
    points = np.random.default_rng(1).normal(size=spline.count)
    rate, hull = spline.basis(s, 1) @ points, spline.hull(1) @ points
    assert hull.min() - 1e-12 <= rate.min() and rate.max() <= hull.max() + 1e-12


@pytest.mark.parametrize("spline", [s for s in SPLINES if s.count > 6])
def test_end_maps_set_value_rate_and_acceleration(spline):
    first, last = spline.ends
    start, end = np.array([0.3, -1.0, 2.0]), np.array([-0.2, 0.5, 1.0])
    points = np.r_[first @ start, np.zeros(spline.count - 6), last @ end]
    for s, wanted in ((0.0, start), (1.0, end)):
        assert np.allclose([(spline.basis([s], k) @ points)[0] for k in range(3)], wanted, atol=1e-12)
