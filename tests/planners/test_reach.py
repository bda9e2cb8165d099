"""A hand that comes to a pose, from rest to rest."""

from dataclasses import replace

import numpy as np
import pytest

import planners
from planners import reach
from planners.task import FOLDER, parse

TEXT = (FOLDER / "reach.toml").read_text()


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


@pytest.mark.parametrize("low", [0.5, 4.0])
def test_the_least_cost_of_a_displacement_is_that_of_the_best_of_all_durations(low):
    """Against a search over durations of the cubic motion, which has the least squared acceleration."""
    far, rate, weights = np.array([0.3, -1.2, 0.0]), np.array([1.0, 0.4, 1.0]), (0.02, 1.0, 3.0)
    numbers = reach.Data(None, 0, (), np.zeros(3), None, rate, None, 0.0, (low, 20.0), weights)
    T = np.linspace(low, 20.0, 200001)
    cost = weights[0] * T + weights[2] * np.mean(12 * far[:, None] ** 2 / T**3, axis=0)
    cost[T < (np.abs(far) / rate).max()] = np.inf
    found = reach.least(numbers, far)
    assert found[0] == pytest.approx(T[cost.argmin()], abs=1e-4)
    assert found[1] == pytest.approx(cost.min(), rel=1e-8)


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
