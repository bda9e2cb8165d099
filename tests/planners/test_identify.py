"""The shipped identification manoeuvre, planned end to end."""

import numpy as np
import pytest

import planners
from planners import identify, sqp


@pytest.mark.slow
def test_the_manoeuvre_is_planned_certified_and_tells_what_it_identifies():
    plan = planners.plan(planners.load("identify"), progress=False)
    assert plan.status == "solved", plan.verdict
    assert plan.certificate.passed, str(plan.certificate)
    assert plan.phases[0].robot.nv == 9
    assert "all ten parameters are identifiable" in plan.verdict
    assert np.isfinite(plan.info["cost"])


@pytest.mark.slow
def test_the_default_solver_stays_where_the_referee_went():
    judged = planners.plan(planners.load("identify"), solver="casadi", progress=False)
    assert judged.status == "solved" and judged.certificate.passed, judged.verdict
    assert judged.certificate.worst("stationarity and complementarity") < 1e-6
    problem = identify.problem(judged.task)
    first, *_, state = sqp.solve(problem, problem.form.join(judged.variables)[None])
    ours, there = sqp.outcome(sqp.pick(state, 0)), sqp.pick(first, 0).near.cost
    assert ours.status == "solved"
    assert abs(ours.cost - judged.info["cost"]) < 1e-6 * abs(ours.cost)  # measured 4.8e-10
    assert abs(there - judged.info["cost"]) < 1e-7 * abs(ours.cost)  # of one point, measured 2.5e-10
