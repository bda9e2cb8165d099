"""Tables of plans: what they start from, and that a kill leaves no trace. The plans are made up; true ones are in
test_grasp_planar.py.
"""

import itertools
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

import planners
from planners.certify import Certificate, Row

module, study = sys.modules["planners.table"], sys.modules["planners.study"]  # functions bear these names
POINTS = np.array(list(itertools.product([0.0, 1.0, 2.0], [0.0, 5.0, 10.0])))
HARD, LOST = (1.0, 5.0), (2.0, 10.0)  # from first guesses only; not at all


@dataclass(frozen=True)
class Made:
    """As much of a task as these plans need."""

    point: tuple
    weights: np.ndarray = field(default_factory=lambda: np.ones(2))


def task_at(point):
    return Made(tuple(map(float, point)))


class Killed(BaseException):
    """Ends the process, in the tests only the call."""


@pytest.fixture
def calls(monkeypatch):
    """Planning of what is made up; all calls, as (point, guess)."""
    out = []

    def plan(task, *, guess, iterations=150, explain, progress):
        assert not explain and not progress
        *start, seen = guess["x"]
        out.append((task.point, tuple(start), iterations))
        good = task.point != LOST and (task.point != HARD or np.isnan(start[0]))
        x = {"x": np.array([*task.point, seen + np.pi / 7])}
        certificate = Certificate((Row("something", 1e-9, 1e-6, "m"),)) if good else None
        status, history = "solved" if good else "infeasible", np.array([[0, 1, 1], [1, 1, np.nansum(start)]])
        return planners.Plan(task, (), status, status, x, {}, history, {}, {"cost": sum(task.point)}, certificate)

    monkeypatch.setattr(module, "plan", plan)
    monkeypatch.setattr(
        module, "_first_guesses", lambda task, count: [{"x": np.array([np.nan, k, 0])} for k in range(count)]
    )
    return out


def test_each_plan_starts_from_the_nearest_that_is_solved(calls, tmp_path):
    table = planners.table(task_at, POINTS, tmp_path, neighbours=2, seeds=3, iterations=9)
    assert [entry.status for entry in table.entries].count("solved") == len(table.solved) == 8
    assert {count for _, _, count in calls} == {9}
    guess = lambda start: "first guess" if np.isnan(start[0]) else start
    tried = {p: [guess(start) for point, start, _ in calls if point == p] for p in map(tuple, POINTS)}
    assert tried[tuple(POINTS[0])] == ["first guess"]
    far = lambda point, start: np.linalg.norm(np.subtract(point, start) / [1, 5])
    for point, entry in zip(map(tuple, POINTS), table.entries, strict=True):
        starts = [start for start in tried[point] if start != "first guess"]
        assert LOST not in starts and len(set(starts)) == len(starts)
        assert [far(point, start) for start in starts] == sorted(far(point, start) for start in starts)
        assert not starts or far(point, starts[0]) == 1
        if point in (HARD, LOST):
            assert tried[point][-1] == "first guess" and len(starts) == 2
            assert len(tried[point]) == (3 if point == HARD else 5)
        assert tuple(entry.variables["x"][:2]) == point and entry.cost == sum(point) and entry.iterations == 1
        nowhere = not starts or point in (HARD, LOST)
        assert entry.start == (-1 if nowhere else POINTS.tolist().index(list(starts[0])))
        assert (entry.certificate is None) == (point == LOST)
    count = len(calls)
    again = planners.table(task_at, POINTS, tmp_path, neighbours=2, seeds=3, iterations=9)
    assert len(calls) == count and str(again.entries) == str(table.entries)
    other = lambda point: replace(task_at(point), weights=np.array([1.0, 1.0 + 1e-15]))
    with pytest.raises(planners.StudyError, match="another"):
        planners.table(other, POINTS, tmp_path, neighbours=2, seeds=3, iterations=9)


def test_between_solved_points_there_are_guesses(calls, tmp_path):
    table = planners.table(task_at, POINTS, tmp_path)
    guess = table.guess([0.5, 2.0])
    assert np.allclose(guess.variables["x"][:2], [0.5, 2.0])
    assert guess.error["cost"] == 0 and guess.error["x"] > 0.1  # the third entry counts the plans on the way there
    for point in ([1.5, 7.0], [-1.0, 0.0], LOST):
        with pytest.raises(ValueError, match="in no cell"):
            table.guess(point)


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix != ".part"}


@pytest.mark.parametrize("call", ["write", "replace", "fsync"])
def test_a_table_that_is_killed_becomes_the_same(call, calls, tmp_path, monkeypatch):
    planners.table(task_at, POINTS, tmp_path / "whole")
    whole, killed = files(tmp_path / "whole"), 0
    for at in range(0, 20, 3):
        folder, count, real = tmp_path / str(at), iter(range(100)), getattr(study.os, call)

        def fatal(*args, count=count, real=real, at=at):
            if next(count) == at:
                raise Killed
            return real(*args)

        with monkeypatch.context() as patch:
            patch.setattr(study.os, call, fatal)
            try:
                planners.table(task_at, POINTS, folder)
            except Killed:
                killed += 1
        planners.table(task_at, POINTS, folder)
        assert files(folder) == whole
    assert killed >= 3


SCRIPT = """
import sys, jax
from dataclasses import replace
jax.config.update("jax_enable_x64", True)
import planners
task = planners.load("grasp_planar")
twist = lambda spin: (0.0, spin, 0.0, *task.target.twist[3:])
task_at = lambda point: replace(task, target=replace(task.target, twist=twist(float(point[0]))))
planners.plan(task, progress=False)
print("compiled", flush=True)
planners.table(task_at, [[0.03 + 5e-4 * k] for k in range(8)], sys.argv[1])
"""


@pytest.mark.slow
def test_a_table_of_a_grasp_that_is_killed_becomes_the_same(tmp_path, rng):
    """Three times by the system, at random times while plans are made; the files are those of a table left alone."""
    start = lambda folder: subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(folder)], stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2]
    )
    done = []
    for _ in range(3):
        process = start(tmp_path / "killed")
        assert process.stdout.readline() == "compiled\n"
        time.sleep(rng.uniform(0, 8))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert process.returncode == -signal.SIGKILL
        done.append(len(list((tmp_path / "killed").glob("*.npz"))))
    assert done == sorted(done) and done[-1] < 8
    for name in ("killed", "whole"):
        process = start(tmp_path / name)
        process.communicate()
        assert process.returncode == 0
    assert files(tmp_path / "killed") == files(tmp_path / "whole")
