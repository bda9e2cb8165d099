"""`sdyn plan`, killed by the system: the folder holds the plan of before or the new one, and never none."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import planners

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_five_kills_while_a_plan_is_made(tmp_path, rng):
    """Two at any time, three while files are written. What loads is a plan that was saved whole."""
    folder = tmp_path / "grasp"
    command = [sys.executable, "-m", "sdyn", "plan", "grasp", "--accuracy", "draft", "--out", str(folder)]
    options = dict(cwd=ROOT, env=os.environ | {"SDYN_CACHE": str(tmp_path / "cache")}, stdout=subprocess.DEVNULL)

    def run():
        start = time.monotonic()
        assert subprocess.run(command, check=False, stderr=subprocess.DEVNULL, **options).returncode == 0
        return time.monotonic() - start

    run()
    whole = run()  # with compiled programs at hand, as in the runs that are killed
    old = {path.name: path.read_bytes() for path in folder.iterdir()}
    state = lambda: [folder.stat().st_mtime, *(path.stat().st_mtime for path in sorted(folder.iterdir()))]
    ends = []
    for writing in (False, True, True, False, True):
        before = state()
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL, **options)
        began = time.monotonic()
        if writing:
            known = set(tmp_path.glob(".grasp-*"))
            while set(tmp_path.glob(".grasp-*")) <= known and process.poll() is None and time.monotonic() < began + 500:
                time.sleep(0.005)
            time.sleep(rng.uniform(0, 2.0))
        else:
            time.sleep(rng.uniform(0.05, 0.9) * whole)
        process.send_signal(signal.SIGKILL)
        process.wait()
        found = planners.Plan.load(folder)
        assert found.status == "solved" and found.certificate.passed
        ends.append("new" if state() != before else "old")
    assert "old" in ends, ends
    print(f"\n{ends}, a run takes {whole:.0f} s")  # noqa: T201
    run()
    assert planners.Plan.load(folder).status == "solved"
    assert set(old) == {path.name for path in folder.iterdir()}
