"""Curvature, prices and derivatives of solutions, where they are known in closed form."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from planners import optimality, sqp
from planners.problem import Block, Form, Problem, Rows, Values
from planners.sensitivity import derivative


def nearest(x, data):
    """The point of a disc that is nearest to a far one, above a floor: half the squared distance."""
    x = x["x"]
    below = jnp.stack([(x @ x - data["radius"] ** 2) / 2, data["floor"] - x[1]])
    return Values(0.0 * x[0], x - data["far"], jnp.zeros(0), below)


FORM = Form((Block("x", (2,), 2.0, "m"),), nearest)
ROWS = (Rows("disc", 0.5, "m2", (1,)), Rows("floor", 1.0, "m", (1,)))


def problem(radius=1.0, far=(3.0, 4.0), floor=-5.0):
    data = {"radius": radius, "far": np.array(far), "floor": floor}
    return Problem(FORM, data, {}, {}, (), ROWS)


def solved(p, start=(0.1, 0.1)):
    *_, states = sqp.solve(p, np.array([start]))
    end = sqp.outcome(sqp.pick(states, 0))
    assert end.status == "solved" and end.stationarity < 1e-8  # measured 1e-12
    return end


def test_curvature_and_prices_of_the_nearest_point_of_a_disc():
    """On the unit circle at distance D = 5 from its centre: multiplier D - 1, curvature D along the circle."""
    p = problem()
    end = solved(p)
    assert np.abs(2 * end.z - [0.6, 0.8]).max() < 1e-8
    found = optimality.measure(p, end.z, end.y, end.u)
    assert found.residual < 1e-8  # measured 1e-10
    scale = 1 + 2 * 3.2  # 1 + the largest entry of the gradient, for variables in units of 2 m
    assert abs(found.curvature - 4 * 5 / scale) < 1e-6
    (price,) = found.prices
    assert (price.name, price.unit) == ("disc", "m2") and abs(price.amount - 4 / 0.5) < 1e-6


def test_a_saddle_is_no_minimum():
    """The farthest point of the circle keeps the first-order conditions, with the multiplier -D - 1 of an equality."""
    form = Form((Block("x", (2,)),), lambda x, far: nearest_on(x["x"], far))
    p = Problem(form, np.array([3.0, 4.0]), {}, {}, (Rows("circle", 1.0, "m2", (1,)),), ())
    found = optimality.measure(p, np.array([-0.6, -0.8]), np.array([-6.0]), np.zeros(0))
    assert found.residual < 1e-8 and abs(found.curvature * (1 + 4.8) + 5) < 1e-6


def nearest_on(x, far):
    return Values(0.0 * x[0], x - far, (x @ x - 1)[None] / 2, jnp.zeros(0))


@pytest.mark.parametrize("change", [{"radius": 1.3}, {"far": (3.3, 3.9)}], ids=["limit", "target"])
def test_the_derivative_is_that_of_solving_again(change):
    """x = r f / |f|, cost (|f| - r)^2 / 2: differences of solutions, and the closed form's slope by r."""
    p, end = problem(), solved(problem())
    before = sqp._optimised._cache_size()
    found = derivative(p, problem(**change), end.z, end.y, end.u)
    assert sqp._optimised._cache_size() == before  # nothing is compiled
    t, mine = 1e-3, {"radius": 1.0, "far": (3.0, 4.0)}
    part = lambda s: {k: np.add(mine[k], s * t * np.subtract(x, mine[k])) for k, x in change.items()}
    ahead, back = (solved(problem(**part(s)), 2 * end.z) for s in (1, -1))
    assert np.abs(found.z - (ahead.z - back.z) / (2 * t)).max() < 1e-6
    assert np.abs(found.u - (ahead.u - back.u) / (2 * t)).max() < 1e-5
    assert abs(found.cost - (ahead.cost - back.cost) / (2 * t)) < 1e-5
    if "radius" in change:
        assert np.abs(found.variables["x"] - 0.3 * np.array([0.6, 0.8])).max() < 1e-7
        assert abs(found.cost + 0.3 * 4) < 1e-7


def test_where_there_is_no_derivative_the_constraint_is_named():
    """The far point lies on the circle: the disc is touched, and does not matter."""
    p = problem(far=(0.6, 0.8))
    with pytest.raises(ValueError, match="disc is touched"):
        derivative(p, problem(radius=2.0, far=(0.6, 0.8)), np.array([0.3, 0.4]), np.zeros(0), np.zeros(2))
    with pytest.raises(ValueError, match="more than numbers"):
        other = replace(p, form=Form((Block("x", (3,)),), nearest))
        derivative(p, other, np.zeros(2), np.zeros(0), np.zeros(2))
