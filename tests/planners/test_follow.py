"""A detumbling that begins where a grasp ends."""

import numpy as np
import pytest

import planners
from planners import PhaseResult, Plan
from planners.task import TaskError, parse

NEXT = """
kind = "detumble"
[robot]
model = "planar3"
moving = ["joint1", "joint2"]
[target]
model = "sat50"
[base]
torque = [0.5, 0.5, 0.5]
force = [0.5, 0.5, 0.5]
[phases.stabilise]
duration = [5.0, 60.0]
control_points = 8
intervals = 18
[limits]
margin = 0.02
"""


def caught(rate=0.0) -> Plan:
    """A plan of one point, after the grasp."""
    task = planners.load("grasp_planar")
    q, v = np.r_[0.1, 0.2, 0.3, 1.0, 0, 0, 0, 0.4, 0.5, 0.6][None], np.r_[0, 0, 0.01, 0.02, 0.03, 0, 0.04, 0.0, rate]
    phase = PhaseResult("stabilise", task.compound, np.zeros(1), q, v[None], 0 * v[None])
    return Plan(task, (phase,), "solved", "", {}, {}, np.zeros((1, 3)), {})


def test_the_state_is_that_of_the_plans_end():
    task = planners.after(caught(), parse(NEXT, "rest"))
    assert task.name == "rest_after_grasp_planar"
    assert dict(zip([j.name for j in task.joints], task.start, strict=True)) == {"joint1": 0.4, "joint2": 0.5}
    assert task.robot.joints["joint3"] == 0.6
    assert np.array_equal(task.captured, [0, 0, 0.01, 0.02, 0.03, 0, 0.04, 0.0])
    assert parse(task.source, task.name).captured.tolist() == task.captured.tolist()


def test_another_robot_is_refused():
    with pytest.raises(TaskError) as error:
        planners.after(caught(), parse(NEXT.replace('"planar3"', '"planar100"'), "rest"))
    assert all(word in str(error.value) for word in ("[robot] model", "'planar3'", "'planar100'")), str(error.value)


def test_a_joint_that_moves_at_the_end_cannot_be_locked():
    with pytest.raises(TaskError, match="'joint3'"):
        planners.after(caught(rate=0.01), parse(NEXT, "rest"))


def test_only_a_detumbling_follows_a_grasp():
    with pytest.raises(TaskError, match="'grasp' and then 'reach'"):
        planners.after(caught(), planners.load("reach"))


@pytest.mark.slow
def test_a_grasp_and_then_rest():
    """From two bodies that tumble apart to one that rests, certified in both halves."""
    grasp = planners.plan(planners.load("grasp_planar"), progress=False)
    rest = planners.plan(planners.after(grasp, parse(NEXT, "rest")), progress=False)
    for found in (grasp, rest):
        assert found.status == "solved" and found.certificate.passed, found.verdict
    assert np.abs(grasp.v[-1][-1, :6]).max() > 1e-3 >= np.abs(rest.v[-1][-1]).max()
