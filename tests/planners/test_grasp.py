"""The shipped grasp, planned end to end once: what its certificate says, and what other tasks of its shape do."""

from dataclasses import replace

import numpy as np
import pytest

import planners
from planners.task import FOLDER, parse

TEXT = (FOLDER / "grasp.toml").read_text()


@pytest.fixture(scope="module")
def plan():
    return planners.plan(planners.load("grasp"), progress=False)


def value(certificate, name):
    (row,) = [row for row in certificate.rows if row.name == name]
    return row.value


def test_the_grasp_is_planned_and_certified(plan):
    assert plan.status == "solved", plan.verdict
    assert plan.certificate.passed, str(plan.certificate)
    assert [phase.name for phase in plan.phases] == ["wait", "approach", "track", "stabilise"]


@pytest.mark.parametrize(
    ("check", "bound"),  # on a grid 24 times finer than the solver's; SI units; measured values behind
    [
        ("excess over position limits", 1e-6),  # 0
        ("excess over rate limits", 1e-6),  # 0
        ("excess over torque limits", 1e-6),  # 0
        ("place error at the grasp", 1e-6),  # 3.4e-7 m
        ("orientation error at the grasp", 1e-6),  # 1.2e-7 rad
        ("velocity error at the grasp", 1e-6),  # 2.6e-9 m/s
        ("angular velocity error at the grasp", 1e-6),  # 3.0e-9 rad/s
        ("place error while tracking", 1e-3),  # 8.5e-5 m
        ("orientation error while tracking", 1e-3),  # 6.1e-5 rad
        ("velocity error while tracking", 1e-3),  # 7.6e-4 m/s
        ("angular momentum lost at the grasp, relative", 1e-10),  # 1.1e-14
        ("linear momentum lost at the grasp, relative", 1e-10),  # 5.5e-15
        ("integrated again: joint positions", 1e-6),
        ("integrated again: velocities", 1e-6),
    ],
)
def test_what_the_certificate_measures(plan, check, bound):
    assert value(plan.certificate, check) <= bound


def test_phases_join_and_the_structure_changes_at_the_grasp(plan):
    for a, b in zip(plan.phases[:-1], plan.phases[1:], strict=True):
        assert abs(a.times[-1] - b.times[0]) < 1e-12
        assert np.abs(a.q[-1, 7:] - b.q[0, 7:]).max() < 1e-12
    assert [phase.passive is None for phase in plan.phases] == [False, False, False, True]
    assert len(plan.phases[-1].robot.links) == len(plan.phases[0].robot.links) + 1


@pytest.mark.slow
def test_the_same_plan_twice_is_identical(plan):
    again = planners.plan(plan.task, progress=False)
    assert all(np.array_equal(plan.variables[k], again.variables[k]) for k in plan.variables)
    for a, b in zip(plan.phases, again.phases, strict=True):
        assert np.array_equal(a.q, b.q) and np.array_equal(a.v, b.v) and np.array_equal(a.tau, b.tau)


@pytest.mark.slow
def test_both_solvers_find_the_same_minimum(plan):
    judged = planners.plan(plan.task, solver="casadi", progress=False)
    assert judged.status == "solved" and judged.certificate.passed, judged.verdict
    assert abs(judged.info["cost"] - plan.info["cost"]) < 1e-4 * plan.info["cost"]
    for found in (plan, judged):
        assert found.certificate.worst("stationarity and complementarity") < 1e-6


def tampered(plan, name, key, change):
    phases = [replace(p, **{key: change(getattr(p, key))}) if p.name == name else p for p in plan.phases]
    return replace(plan, phases=tuple(phases))


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("position = [-2.158", "position = [-12.158", "place of 'hand'"),
        ("torque = 5.0", "torque = 0.05", "torque limit"),
    ],
    ids=["out of reach", "too weak"],
)
def test_an_infeasible_task_is_found_out_and_named(plan, old, new, words):
    assert old in TEXT
    found = planners.plan(parse(TEXT.replace(old, new)), progress=False)  # same shapes: nothing compiles anew
    assert found.status == "infeasible"
    assert words in found.verdict and "off by" in found.verdict
    assert found.info["relaxation"] and "relax" in found.verdict
