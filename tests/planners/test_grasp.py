from dataclasses import replace

import numpy as np
import pytest

import planners
from planners.task import FOLDER, parse

PLANAR = (FOLDER / "grasp_planar.toml").read_text()


@pytest.fixture(scope="module")
def plan():
    return planners.plan(planners.load("grasp_planar"), progress=False)


def test_a_grasp_is_planned_and_certified(plan):
    assert plan.status == "solved", plan.verdict
    assert plan.certificate.passed, str(plan.certificate)
    assert [phase.name for phase in plan.phases] == ["wait", "approach", "track", "stabilise"]


def test_phases_join_and_the_structure_changes_at_the_grasp(plan):
    for a, b in zip(plan.phases[:-1], plan.phases[1:], strict=True):
        assert abs(a.times[-1] - b.times[0]) < 1e-12
        assert np.abs(a.q[-1, 7:] - b.q[0, 7:]).max() < 1e-12
    assert [phase.passive is None for phase in plan.phases] == [False, False, False, True]
    assert len(plan.phases[-1].robot.links) == len(plan.phases[0].robot.links) + 1


def test_the_same_plan_twice_is_identical(plan):
    again = planners.plan(plan.task, progress=False)
    assert all(np.array_equal(plan.variables[k], again.variables[k]) for k in plan.variables)
    for a, b in zip(plan.phases, again.phases, strict=True):
        assert np.array_equal(a.q, b.q) and np.array_equal(a.v, b.v) and np.array_equal(a.tau, b.tau)


def tampered(plan, name, key, change):
    phases = [replace(p, **{key: change(getattr(p, key))}) if p.name == name else p for p in plan.phases]
    return replace(plan, phases=tuple(phases))


@pytest.mark.parametrize(
    ("name", "key", "change", "words"),
    [
        ("track", "q", lambda x: x + 1e-5 * np.eye(x.shape[1])[7], "place error at the grasp"),
        ("approach", "tau", lambda x: 1.01 * x, "integrated again"),
        ("stabilise", "v", lambda x: x + 1e-3 * np.eye(x.shape[1])[0], "momentum lost"),
        ("approach", "v", lambda x: 10 * x, "excess over rate limits"),
    ],
)
def test_the_certificate_fails_when_the_plan_is_tampered_with(plan, name, key, change, words):
    certificate = planners.certify(plan.task, tampered(plan, name, key, change))
    assert not certificate.passed
    assert words in certificate.sentence


def test_a_plan_survives_saving(plan, tmp_path):
    plan.save(tmp_path / "out")
    back = planners.Plan.load(tmp_path / "out")
    assert back.certificate.passed and back.status == plan.status
    assert all(np.array_equal(a, b) for a, b in zip(plan.q, back.q, strict=True))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out"]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [("position = [1.7223", "position = [4.7223", "place of 'hand'"), ("margin =", "torque = 1e-3\nmargin =", "")],
)
def test_an_infeasible_task_is_found_out_and_named(old, new, words):
    plan = planners.plan(parse(PLANAR.replace(old, new)), progress=False)
    assert plan.status == "infeasible"
    assert words in plan.verdict and "off by" in plan.verdict
