"""A hand that comes to a pose, from rest to rest."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.optimize import minimize

import planners
from planners import reach
from planners.task import FOLDER, parse

TEXT = (FOLDER / "reach.toml").read_text()
LEAST = jax.jit(reach.least)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[goal]", "[goals]", "did you mean 'goal'"),
        ("position = [-0.70, 1.30, -2.85]", "", "lacks the key position"),
        ("quaternion = [0.17025763", "quaternion = [0.9", "unit vector"),
        ('frame = "hand"', 'frame = "hant"', "'hand'"),
        ("[phases.reach]", "[phases.track]", "'track'"),
        ("duration = [10.0, 10.0]", "duration = [0.0, 10.0]", "> 0 s"),
    ],
)
def test_a_bad_reach_is_refused_in_a_sentence(old, new, words):
    assert old in TEXT
    with pytest.raises(ValueError, match=words):
        parse(TEXT.replace(old, new, 1))


@pytest.mark.parametrize("still", [2, 3])
def test_it_rests_at_both_ends_and_accelerations_may_jump_there(still):
    problem = reach.problem(parse(TEXT), still=still)
    spline, rng = problem.form.values.spline, np.random.default_rng(0)
    x = {block.name: rng.normal(size=block.shape) for block in problem.form.blocks}
    rate, acceleration = (
        spline.basis([0.0, 1.0], k) @ np.asarray(reach.control_points(spline, x, problem.data.q0)) for k in (1, 2)
    )
    assert abs(rate).max() < 1e-12 and (abs(acceleration).min() > 1e-2) == (still == 2)


def numbers(duration, rate=(1.0, 0.4, 1.0), weights=(0.02, 1.0, 3.0)):
    """Data of joints that start at zero, as far as costs need them."""
    return reach.Data(
        None, 0, (), np.zeros(3), None, np.array(rate), None, 0.0, np.array(duration), np.array(weights), 1.0
    )


@pytest.mark.parametrize("slower", [1.2, 2.0])  # than all the way at the largest rate
def test_the_least_cost_of_a_displacement_is_that_of_the_best_path(slower):
    """Of a rate sampled at 81 times, found by another optimiser."""
    far, rate, n = 1.2, 0.4, 80
    T = slower * far / rate
    squares = lambda v: (np.diff(v, prepend=0.0, append=0.0) ** 2).sum() * n / T
    slope = lambda v: -2 * np.diff(np.diff(v, prepend=0.0, append=0.0), prepend=0.0)[1:] * n / T
    whole = {"type": "eq", "fun": lambda v: v.sum() * T / n - far, "jac": lambda v: np.full(n - 1, T / n)}
    start = np.full(n - 1, far / T)
    found = minimize(squares, start, jac=slope, bounds=[(-rate, rate)] * (n - 1), constraints=[whole], method="SLSQP")
    (_, cost), (time, _, smoothness) = LEAST(numbers((T, T)), np.array([0.0, far, 0.0])), (0.02, 1.0, 3.0)
    assert 3 * (cost - time * T) / smoothness == pytest.approx(found.fun, rel=2e-3)  # measured 6e-4


@pytest.mark.parametrize("low", [0.5, 4.0])
def test_the_least_cost_is_that_of_the_best_duration(low):
    far = np.array([0.3, -1.2, 0.0])
    T, cost = map(float, LEAST(numbers((low, 20.0)), far))
    others = np.linspace(max(low, 3.0), 20.0, 2001)
    costs = [float(LEAST(numbers((t, t)), far)[1]) for t in others]
    assert cost == pytest.approx(min(costs), rel=1e-5) and T == pytest.approx(others[np.argmin(costs)], abs=0.01)


@pytest.fixture(scope="module")
def plan():
    return planners.plan(planners.load("reach"), progress=False)


@pytest.mark.slow
def test_it_is_planned_and_certified(plan):
    assert plan.status == "solved" and plan.certificate.passed, plan.verdict
    assert plan.times[0][-1] == 10.0 and plan.phases[0].robot.nv == 13


@pytest.mark.slow
@pytest.mark.parametrize(("key", "at", "words"), [("q", -1, "goal"), ("q", 0, "start"), ("v", -1, "speed")])
def test_the_certificate_fails_when_the_plan_is_tampered_with(plan, key, at, words):
    array = getattr(plan.phases[0], key).copy()
    array[at, -2] += 1e-5
    found = planners.certify(plan.task, replace(plan, phases=(replace(plan.phases[0], **{key: array}),)))
    assert not found.passed and words in found.sentence


@pytest.mark.slow
@pytest.mark.parametrize("duration", ["[10.0, 10.0]", "[5.0, 20.0]"])
def test_both_solvers_find_the_same_minimum(duration):
    task = parse(TEXT.replace("[10.0, 10.0]", duration), "reach")
    ours, judged = (planners.plan(task, solver=solver, progress=False) for solver in ("sqp", "casadi"))
    assert ours.status == judged.status == "solved", (ours.verdict, judged.verdict)
    assert abs(ours.info["cost"] - judged.info["cost"]) < 1e-6 * ours.info["cost"]


@pytest.mark.slow
def test_any_orientation_will_do_where_none_is_asked_for(plan):
    """And costs less."""
    line = next(line for line in TEXT.split("\n") if line.startswith("quaternion"))
    free = planners.plan(parse(TEXT.replace(line, ""), "reach"), progress=False)
    assert free.status == "solved" and free.info["cost"] < plan.info["cost"]
