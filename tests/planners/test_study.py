"""A study that is killed, at every point of writing and in earnest, and resumed: the same bits as without."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import planners

module = sys.modules["planners.study"]  # the package has a function of that name
ROOT = Path(__file__).parents[2]
RUNS = {f"run {k}": {"mass": 10.0 * k} for k in range(3)}


class Killed(BaseException):
    """Ends the process, in the tests only the call."""


def work(parameters, rng):
    return {"x": parameters["mass"] + rng.normal(size=5), "n": np.arange(3)}


def same(a, b):
    return list(a) == list(b) and all(a[k][x].tobytes() == b[k][x].tobytes() for k in a for x in (*a[k], *b[k]))


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix != ".part"}


def test_a_study_is_repeated_from_what_it_holds(tmp_path):
    done = []

    def counted(parameters, rng):
        done.append(parameters["mass"])
        return work(parameters, rng)

    first = planners.study(tmp_path, RUNS, counted, seed=3)
    assert done == [0, 10, 20] and list(first) == list(RUNS)
    assert same(planners.study(tmp_path, RUNS, counted, seed=3), first) and len(done) == 3
    assert not same(planners.study(tmp_path / "other", RUNS, work, seed=4), first)
    lines = map(json.loads, (tmp_path / module.JOURNAL).read_text().splitlines())
    (path,) = (tmp_path / line["file"] for line in lines if line.get("run") == "run 1")
    path.write_bytes(path.read_bytes()[:-3])  # damaged: done again
    assert same(planners.study(tmp_path, RUNS, counted, seed=3), first) and done[3:] == [10]


@pytest.mark.parametrize("call", ["write", "fsync", "replace", "open", "close"])
def test_a_study_that_is_killed_at_every_point_of_writing(call, tmp_path, monkeypatch):
    """Before and after each call, also with half of a line in the journal."""
    want, expected = planners.study(tmp_path / "whole", RUNS, work), None
    for after in (False, True):
        for at in range(20):
            folder = tmp_path / f"{after}{at}"
            count, real = iter(range(100)), getattr(os, call)

            def fatal(*args, count=count, real=real, at=at, after=after):
                now = next(count) == at
                if now and not after:
                    if call == "write":
                        real(args[0], args[1][: len(args[1]) // 2])
                    raise Killed
                out = real(*args)
                if now:
                    raise Killed
                return out

            with monkeypatch.context() as patch:
                patch.setattr(module.os, call, fatal)
                try:
                    planners.study(folder, RUNS, work)
                except Killed:
                    pass
                else:
                    break
            assert same(planners.study(folder, RUNS, work), want)
            lines = (folder / module.JOURNAL).read_text().splitlines()
            assert len({json.loads(line).get("run") for line in lines}) == 4
        expected = at if expected is None else expected
        assert at == expected >= 3  # it was killed at every call


def test_what_is_not_this_study_is_refused(tmp_path):
    planners.study(tmp_path, RUNS, work)
    for runs, seed in (({"run 0": {"mass": 1.0}}, 0), (RUNS, 1)):
        with pytest.raises(planners.StudyError, match="other runs or another seed"):
            planners.study(tmp_path, runs, work, seed=seed)
    with module._locked(tmp_path), pytest.raises(planners.StudyError, match="another process"):
        planners.study(tmp_path, RUNS, work)
    (tmp_path / module.JOURNAL).write_text("not json\n")
    with pytest.raises(planners.StudyError, match="no journal"):
        planners.study(tmp_path, RUNS, work)
    with pytest.raises(ValueError, match="pickle"):
        planners.study(tmp_path / "new", RUNS, lambda *_: {"x": np.array([object()])})


SCRIPT = """
import sys, jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
import planners, sdyn
robot = sdyn.models.load("planar3")
roll = jax.jit(lambda chain, q, v: sdyn.rollout(chain, q, v, jnp.ones((20, 9)), 0.01)[0])
def work(parameters, rng):
    chain = sdyn.pack(robot)
    print("run", flush=True)
    return {"q": np.asarray(roll(chain, robot.neutral(), rng.normal(size=9) * parameters["speed"]))}
runs = {f"run {k}": {"speed": 0.1 * k} for k in range(200)}
planners.study(sys.argv[1], runs, work)
"""


@pytest.mark.slow
def test_a_study_that_is_killed_is_resumed_bit_for_bit(tmp_path, rng):
    """Five times by the system, at random times while runs are done; the files are those of a study left alone."""
    start = lambda folder: subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(folder)], stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    done = []
    for _ in range(5):
        process = start(tmp_path / "killed")
        process.stdout.readline()  # the first run of this process has begun
        time.sleep(rng.uniform(0, 0.2))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert process.returncode == -signal.SIGKILL
        done.append(len(list((tmp_path / "killed").glob("*.npz"))))
    assert done == sorted(done) and done[-1] < 200
    for name in ("killed", "whole"):
        process = start(tmp_path / name)
        process.communicate()
        assert process.returncode == 0
    assert files(tmp_path / "killed") == files(tmp_path / "whole")
