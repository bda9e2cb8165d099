"""`sdyn plan`, killed by the system: the folder holds the plan of before or the new one, never none, never a half."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import planners

ROOT = Path(__file__).parents[2]
# The command with its own way of writing, figures and animation included, but a plan that is at hand: while a plan is
# looked for, nothing is written.
SCRIPT = """
import sys, numpy as np, planners
from sdyn import cli
task, phases = planners.load("grasp"), []
for k, name in enumerate(task.phases):
    robot, times = (task.compound if name == "stabilise" else task.chaser), np.linspace(k, k + 1, 30)
    q, v = np.tile(robot.neutral(), (30, 1)), np.zeros((30, robot.nv))
    passive = None if name == "stabilise" else (task.body, q[:, :7], v[:, :6])
    phases.append(planners.PhaseResult(name, robot, times, q, v, 0 * v, passive))
history = np.ones((3, 3))
plan = planners.Plan(task, tuple(phases), "solved", sys.argv[2], {}, {}, history, {"compile_s": 1.0, "solve_s": 1.0})
planners.plan = lambda *args, **rest: plan
print("writes", flush=True)
sys.exit(cli.main(["plan", "grasp", "--out", sys.argv[1]]))
"""


@pytest.mark.slow
def test_five_kills_while_a_plan_is_written(tmp_path, rng):
    """At random times. What loads is a plan that was saved whole, and the last one is not lost."""
    folder = tmp_path / "grasp"
    start = lambda name: subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(folder), name], cwd=ROOT, env=os.environ | {"SDYN_CACHE": "off"},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip

    def whole(name):
        process = start(name)
        process.stdout.readline()
        began = time.monotonic()
        said = process.communicate()
        assert process.returncode == 0, said
        return time.monotonic() - began

    last, ends = "plan 0", []
    seconds = whole(last)
    for k in range(1, 6):
        process = start(f"plan {k}")
        process.stdout.readline()
        time.sleep(rng.uniform(0.3, 1.0) * seconds)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        found = planners.Plan.load(folder)
        assert found.verdict in (last, f"plan {k}")
        ends.append("old" if found.verdict == last else "new")
        last = found.verdict
    print(f"\n{ends}, a run writes for {seconds:.1f} s")  # noqa: T201
    whole("the end")
    assert planners.Plan.load(folder).verdict == "the end" and not (folder / ".new").exists()


@pytest.mark.slow
def test_five_kills_of_the_whole_command(tmp_path, rng):
    """One in each fifth of its time, into an empty folder: no plan is there then, or the whole one; the compilations
    that were kept stay good.
    """
    command = [sys.executable, "-m", "sdyn", "plan", "grasp", "--out"]
    rest = dict(cwd=ROOT, env=os.environ | {"SDYN_CACHE": str(tmp_path / "cache")}, stdout=subprocess.DEVNULL)

    def whole(name):
        began = time.monotonic()
        assert subprocess.run([*command, tmp_path / name], **rest, check=False).returncode == 0
        return time.monotonic() - began, planners.Plan.load(tmp_path / name)

    _, wanted = whole("first")
    seconds, _ = whole("again")
    ends = []
    for k in range(5):
        folder = tmp_path / f"killed {k}"
        process = subprocess.Popen([*command, folder], **rest)
        time.sleep((k + rng.uniform()) / 5 * seconds)
        process.send_signal(signal.SIGKILL)
        process.wait()
        ends.append((folder / "plan.json").exists() or (folder / ".new").exists())
        if ends[-1]:
            assert same(planners.Plan.load(folder), wanted)
        else:
            assert not folder.exists()
    print(f"\nplans there: {ends}, a run takes {seconds:.1f} s")  # noqa: T201
    assert not all(ends) and same(whole("killed 0")[1], wanted)


def same(one, other):
    return all(np.array_equal(one.variables[key], other.variables[key]) for key in other.variables)
