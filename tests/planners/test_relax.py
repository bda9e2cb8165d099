"""By how much a constraint must give: a circle, limits and bounds, with answers by hand."""

import jax.numpy as jnp
import numpy as np

from planners import relax, sqp
from planners.problem import Block, Form, Problem, Rows, Values

NAMES = ("limit of first", "limit of second", "floor of first", "floor of second")
SCALES = (1.0, 2.0, 1.0, 0.5)  # m


def values(x, data):
    """A circle of some radius; limits and floors of both coordinates; nothing to be gained."""
    x, (radius, most, least) = x["x"], data
    below = jnp.concatenate([x - most, least - x]) / jnp.array(SCALES)
    return Values(0.0 * x[0], 1e-3 * x, jnp.array([x @ x - radius**2]), below)


FORM = Form((Block("x", (2,), 0.5, units="m"),), values)


def relaxed(radius, most, least, box, start):
    """Amounts by name, from where the solver ends."""
    rows = tuple(Rows(name, scale, "m", (1,)) for name, scale in zip(NAMES, SCALES, strict=True))
    data = radius, np.array(most, float), np.array(least, float)
    problem = Problem(FORM, data, {"x": -box}, {"x": box}, (Rows("circle", 1.0, "m^2", (1,)),), rows)
    *_, states = sqp.solve(problem, np.array([start], float) / 0.5)
    end = sqp.outcome(sqp.pick(states, 0))
    assert end.status == "infeasible"
    found = relax.relaxations(problem, end, np.array(start) / 0.5)
    assert all(x.unit == ("m^2" if x.name == "circle" else "m") for x in found)
    return {x.name: x.amount for x in found}


def close(found, want):
    """Amounts as by hand, the smallest of its scale first, and None for what is not enough."""
    assert found.keys() == want.keys()
    for name, x in want.items():
        assert found[name] is None if x is None else abs(found[name] - x) < 1e-3 * x, (name, found[name])


ONE, BOTH = np.sqrt(0.75) - 0.5, np.sqrt(0.5) - 0.5  # from (1/2, 1/2) to the unit circle, by one coordinate or both


def test_limits_that_keep_a_point_off_a_circle():
    """(1/2, 1/2) is within the circle; a coordinate, or both, or the circle may give. Measured: within 2e-9."""
    found = relaxed(1.0, (0.5, 0.5), (-0.5, -0.5), 3.0, (0.4, 0.45))
    one = next(name for name in found if name.startswith("limit"))
    close(found, {"circle": 0.5, one: ONE, "every limit": BOTH})


def test_limits_below_floors():
    """No limit alone is enough; (1, 1) is on the circle, and so is (-1, -1), which lets the floors give by 2."""
    found = relaxed(np.sqrt(2), (0, 0), (1, 1), 3.0, (0.6, 0.5))
    one = next(name for name in found if name.startswith(("limit of", "floor of")))
    close(found, {"circle": None, one: None, "every limit": 1.0, "every floor": 2.0})


def test_bounds_that_are_too_narrow():
    found = relaxed(1.0, (9, 9), (-9, -9), 0.5, (0.4, 0.45))
    one = next(name for name in found if name.startswith("upper"))
    close(found, {"circle": 0.5, one: ONE, "every upper bound of x": BOTH})


def test_what_is_said():
    say = relax.sentence
    needed = [relax.Relaxation("torque limit of a", 1.23456, "N m"), relax.Relaxation("b", None, "m")]
    assert say(needed) == "To relax one of these would be enough: torque limit of a by 1.23 N m."
    assert "No constraint was found" in say(needed[1:])
