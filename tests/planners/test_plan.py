"""The files of a plan: all of one plan, or refused."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest

import planners
from planners import animation, figures
from planners.certify import Certificate, Row


class Killed(BaseException):
    """Ends the process, in the tests only the call."""


@pytest.fixture
def plans(monkeypatch):
    """Two plans of one task that differ in all files; nothing is drawn."""
    monkeypatch.setattr(animation, "write", lambda plan, path: path.write_text(plan.verdict))
    monkeypatch.setattr(figures, "draw", lambda plan, folder: (folder / "base.png").write_text(plan.verdict))
    task = planners.load("grasp")
    phases = []
    for k, name in enumerate(task.phases):
        robot, times = (task.compound if name == "stabilise" else task.chaser), np.linspace(k, k + 1, 3)
        q, v = np.tile(robot.neutral(), (3, 1)), np.zeros((3, robot.nv))
        passive = None if name == "stabilise" else (task.body, q[:, :7], v[:, :6])
        phases.append(planners.PhaseResult(name, robot, times, q, v, 0 * v, passive))
    certificate = lambda x: Certificate((Row("something", x, 1.0, "m"),))
    plan = planners.Plan(task, tuple(phases), "solved", "first", {"a": np.zeros(2)}, {}, np.zeros((1, 3)), {})
    other = replace(plan, verdict="second", variables={"a": np.ones(2)})
    return replace(plan, certificate=certificate(0.1)), replace(other, certificate=certificate(0.2))


def same(a, b):
    return (
        a.verdict == b.verdict and a.certificate == b.certificate and np.array_equal(a.variables["a"], b.variables["a"])
    )


@pytest.mark.parametrize("call", ["rename", "replace", "unlink", "mkdir", "rmdir", "fsync"])
def test_a_save_that_is_killed_leaves_one_plan(plans, tmp_path, monkeypatch, call):
    """Killed before and after each file that is moved, removed or made: what loads is the old plan or the new one, and
    never none."""
    old, new = plans
    seen = []
    for after in (False, True):
        for at in range(20):
            folder = tmp_path / f"{after}{at}"
            old.save(folder)
            (folder / "mine.txt").write_text("kept")
            kept = (folder / "plan.json").read_text()
            stray = json.loads(kept)
            stray["files"]["gyro.png"] = "of an earlier task"
            (folder / "plan.json").write_text(json.dumps(stray))
            (folder / "gyro.png").write_text("old")
            count, real = iter(range(100)), getattr(os, call)

            def one(*args, count=count, real=real, at=at, after=after, **rest):
                now = next(count) == at
                if now and not after:
                    raise Killed
                real(*args, **rest)
                if now:
                    raise Killed

            with monkeypatch.context() as patch:
                patch.setattr(os, call, one)
                patch.setattr("shutil.rmtree", lambda path, **_: None)  # a process that is killed cleans nothing up
                try:
                    new.save(folder)
                except Killed:
                    pass
                else:
                    break
            found = [path.name for path in folder.iterdir()]
            if ".new" not in found and json.loads((folder / "plan.json").read_text())["verdict"] == "first":
                (folder / "plan.json").write_text(kept)
            seen.append([same(planners.Plan.load(folder), plan) for plan in plans])
            assert any(seen[-1])
            assert (folder / "mine.txt").read_text() == "kept"
        assert same(planners.Plan.load(folder), new) and not (folder / "gyro.png").exists()
    assert ([True, False] in seen) == (call in ("rename", "mkdir", "fsync"))  # the rename is where the new one counts
    assert ([False, True] in seen) == (call not in ("mkdir", "fsync"))


@pytest.mark.parametrize("name", ["plan.npz", "certificate.json", "base.png", "plan.html"])
def test_a_file_of_another_plan_is_refused(plans, tmp_path, name):
    for plan, folder in zip(plans, ("one", "two"), strict=True):
        plan.save(tmp_path / folder)
    os.replace(tmp_path / "one" / name, tmp_path / "two" / name)
    with pytest.raises(planners.PlanError, match=f"{name} is not the one"):
        planners.Plan.load(tmp_path / "two")


def test_pictures_may_be_thrown_away_and_a_plan_without_certificate_takes_none(plans, tmp_path):
    old, new = plans
    old.save(tmp_path)
    (tmp_path / "plan.html").unlink()
    assert same(planners.Plan.load(tmp_path), old)
    replace(new, certificate=None).save(tmp_path)
    assert planners.Plan.load(tmp_path).certificate is None
    assert not (tmp_path / "certificate.json").exists()


@pytest.mark.parametrize("text", ["[]", "{}", '{"version": 1}'])
def test_another_format_is_refused(plans, tmp_path, text):
    plans[0].save(tmp_path)
    (tmp_path / "plan.json").write_text(text)
    with pytest.raises(planners.PlanError, match=r"plan.json has the version .*; this sdyn reads 2"):
        planners.Plan.load(tmp_path)
    plans[1].save(tmp_path)
    assert same(planners.Plan.load(tmp_path), plans[1])
