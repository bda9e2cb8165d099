"""The shipped identification manoeuvre, planned end to end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planners
from planners import identify, inertial, sqp


@pytest.fixture(scope="module")
def plan():
    return planners.plan(planners.load("identify"), progress=False)


@pytest.mark.slow
def test_the_manoeuvre_is_planned_certified_and_tells_what_it_identifies(plan):
    assert plan.status == "solved", plan.verdict
    assert plan.certificate.passed, str(plan.certificate)
    assert plan.phases[0].robot.nv == 9
    assert f"all {10 * len(plan.task.unknown)} parameters are identifiable" in plan.verdict
    assert np.isfinite(plan.info["cost"])


@pytest.mark.slow
def test_it_tells_more_than_random_manoeuvres(plan, rng):
    """Of its duration, as large as the limits allow: their confidence ellipsoids have at least ten times its volume."""
    problem = identify.problem(plan.task)
    form, start = problem.form, plan.task.start
    shape = form.blocks[1].shape
    see = jax.jit(lambda z: (form.at(z, problem.data).below.max(), information(form, z, problem.data)))
    s, volumes = np.linspace(0, 1, shape[0])[:, None], []
    for _ in range(20):
        swing = sum(rng.normal(size=shape[1]) * np.sin(np.pi * k * s) / k for k in range(1, 6))
        motion = lambda size, swing=swing: form.join({**plan.variables, "excite": start + size * swing})
        small, large = 0.0, 4.0
        for _ in range(12):
            size = (small + large) / 2
            small, large = (size, large) if see(motion(size))[0] <= 0 else (small, size)
        assert small > 0
        volumes.append((plan.info["results"]["log_det"] - see(motion(small))[1]) / 2)
    assert np.exp(min(volumes)) > 10  # measured 4.9e4, half of them above 6e8


@pytest.mark.slow
def test_the_bound_holds_for_a_robot_that_is_not_the_task_s(plan, rng):
    """200 draws of noise; the base differs by a few percent."""
    change = lambda phi: inertial.consistent(phi, jnp.asarray(0.03 * rng.normal(size=10)))
    links = plan.task.unknown.values()
    truth = {link: change(inertial.nominal(plan.task.chaser.link(link))[0]) for link in links}
    robot = inertial.replaced(plan.task.chaser, truth)
    found = planners.monte_carlo(plan.task, plan.variables, draws=200, truth=robot)
    assert found.passed, (found.statuses, found.ratios, found.band, found.normalised, found.normalised_band)


def information(form, z, data):
    """Log of the determinant of the information of a motion."""
    values = form.values
    at = identify.motion(values.spline, values.intervals, form.split(z), data)
    return jnp.linalg.slogdet(identify.information(data, at))[1]


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
