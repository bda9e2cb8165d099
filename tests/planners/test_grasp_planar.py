"""The small shipped grasp: planned twice, from several seeds, and tasks of its shape that cannot be."""

import numpy as np
import pytest

import planners
from planners.task import FOLDER, parse

TEXT = (FOLDER / "grasp_planar.toml").read_text()


@pytest.fixture(scope="module")
def plan():
    return planners.plan(planners.load("grasp_planar"), progress=False)


def test_it_is_planned_and_certified(plan):
    assert plan.status == "solved", plan.verdict
    assert plan.certificate.passed, str(plan.certificate)
    assert plan.phases[0].robot.nv == 9
    assert len(plan.history) < 80  # measured 33


def test_the_same_plan_twice_is_identical(plan):
    again = planners.plan(plan.task, progress=False)
    assert all(np.array_equal(plan.variables[k], again.variables[k]) for k in plan.variables)
    for a, b in zip(plan.phases, again.phases, strict=True):
        assert np.array_equal(a.q, b.q) and np.array_equal(a.v, b.v) and np.array_equal(a.tau, b.tau)


@pytest.mark.slow
def test_a_wanted_error_decides_the_grid(plan):
    """The motion, integrated again by other code, is that close to the plan."""
    found = planners.plan(plan.task, accuracy="1e-7", progress=False)
    assert found.status == "solved" and found.certificate.worst("integrated again") <= 1e-7
    assert found.info["options"]["accuracy"] in ("fast", "balanced", "accurate", "reference")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("position = [1.7223", "position = [4.7223", "place of 'hand'"),
        ("margin =", "torque = 1e-3\nmargin =", "torque limit"),
    ],
    ids=["out of reach", "too weak"],
)
def test_an_infeasible_task_is_found_out_and_named(plan, old, new, words):
    found = planners.plan(parse(TEXT.replace(old, new)), progress=False)  # same shapes: nothing compiles anew
    assert found.status == "infeasible"
    assert words in found.verdict and "off by" in found.verdict


@pytest.mark.slow
@pytest.mark.parametrize("name", ["grasp_planar", "grasp"])
def test_several_seeds_are_solved_at_once(name):
    found = planners.plan(planners.load(name), seeds=4, progress=False)
    assert found.status == "solved" and found.certificate.passed, found.verdict
    assert found.info["options"]["seeds"] == 4
