"""The shipped identification manoeuvres, planned end to end: a base; and base and load, with biases."""

import jax.numpy as jnp
import numpy as np
import pytest

import planners
from planners import identify, inertial, referee, sqp
from planners.problem import summary


@pytest.fixture(scope="module", params=["identify", "identify_load"])
def plan(request):
    return planners.plan(planners.load(request.param), progress=False)


@pytest.mark.slow
def test_the_manoeuvre_is_planned_certified_and_tells_what_it_identifies(plan):
    assert plan.status == "solved", plan.verdict
    assert plan.certificate.passed, str(plan.certificate)
    assert plan.phases[0].robot.nv == 9
    assert f"all {10 * len(plan.task.unknown)} parameters are identifiable" in plan.verdict
    assert np.isfinite(plan.info["cost"])


@pytest.mark.slow
def test_it_tells_more_than_random_manoeuvres(plan):
    """Of its duration, as large as the limits allow: their confidence ellipsoids have at least ten times its volume."""
    ratios = planners.volume_ratios(plan.task, plan.variables)
    assert np.isfinite(ratios).all(), "a random manoeuvre that tells nothing is no rival"
    assert ratios[0] > 10  # measured 9.5e9 with a load


@pytest.mark.slow
def test_the_bound_holds_for_a_robot_that_is_not_the_task_s(plan, rng):
    """200 draws of noise; the base differs by a few percent."""
    change = lambda phi: inertial.consistent(phi, jnp.asarray(0.03 * rng.normal(size=10)))
    links = plan.task.unknown.values()
    truth = {link: change(inertial.nominal(plan.task.chaser.link(link))[0]) for link in links}
    robot = inertial.replaced(plan.task.chaser, truth)
    found = planners.monte_carlo(plan.task, plan.variables, draws=200, truth=robot)
    assert found.passed, (found.statuses, found.ratios, found.band, found.normalised, found.normalised_band)


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


@pytest.mark.slow
def test_the_referee_stays_where_the_default_solver_went(plan):
    """With a load and biases, IPOPT takes too long from elsewhere: 37 000 variables, 5 s an iteration."""
    problem = identify.problem(plan.task)
    judged = referee.programme(plan.task, problem, problem.form.join(plan.variables), near=True).solve()
    assert judged.status == "solved" and judged.stationarity < 1e-9
    assert abs(judged.cost - plan.info["cost"]) < 1e-6 * abs(judged.cost)  # measured 2.8e-7 with a load


def test_the_referee_states_the_same_cost():
    """With a load and biases, at the first guess; its other transcription of the motion is as exact as the grid."""
    task = planners.load("identify_load")
    problem = identify.problem(task)
    (z,) = identify.first_guesses(task, problem, 1)
    stated = referee.programme(task, problem, z)
    ours = float(summary(problem.form, z, problem.numbers[0]).cost)
    assert abs(float(stated.value(stated.cost)) - ours) < 1e-6 * abs(ours)  # measured 2.4e-7
