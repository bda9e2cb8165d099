"""What one change of structure costs on the host, edit and pack, and the one copy to the device apart.

The 37-DOF robot, and what it costs to pack chains and bushes of up to 1000 joints.

    python benchmarks/structure_change.py

Prints the median and the spread (10th to 90th percentile) of each edit, and keeps them in
results/structure_change.json.
"""

import json
import os
import platform
import time
from datetime import UTC, datetime
from pathlib import Path

import jax
import numpy as np
import subjects

import sdyn
from sdyn.pack import _arrays  # `pack` without the copy to the device

REPEATS = 200
RESULT = Path(__file__).parent / "results" / "structure_change.json"


def edits(paper):
    """Name and edit; each leaves another structure of the same capacity."""
    joints, hand = [joint.name for joint in paper.moving], paper.frames[-1].link
    free = paper.reroot(hand)
    return {
        "lock one joint": lambda: paper.lock({joints[0]: 0.3}),
        "lock 28 of 31": lambda: paper.lock(dict.fromkeys(joints[3:], 0.3)),
        "re-root at a hand": lambda: paper.reroot(hand),
        "re-root and ground": lambda: free.ground(hand),
    }


def timed(edit, capacity, repeats=REPEATS):
    """Milliseconds of each repeat: edit, pack, copy to the device."""
    rows = []
    for _ in range(repeats):
        times = [time.perf_counter()]
        robot = edit()
        times.append(time.perf_counter())
        arrays = _arrays(robot, capacity, np.dtype("float64"))
        times.append(time.perf_counter())
        jax.block_until_ready(jax.device_put(arrays))
        times.append(time.perf_counter())
        rows.append(np.diff(times))
    return 1e3 * np.array(rows)


def row(host, **rest):
    """Median, spread and best of the time on the host."""
    low, median, high = np.percentile(host, (10, 50, 90))
    return dict(host_median_ms=median, host_p10_ms=low, host_p90_ms=high, host_least_ms=host.min(), **rest)


def main():
    jax.config.update("jax_enable_x64", True)
    paper = sdyn.models.load("paper37")
    capacity, rows = sdyn.capacity([paper, *(edit() for edit in edits(paper).values())]), {}
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **rest: compiled.append(event) if "compile" in event else None
    )
    for name, edit in edits(paper).items():
        times = timed(edit, capacity)
        edited, packed, copied = np.median(times, 0)
        rows[name] = row(
            times[:, :2].sum(1), edit_median_ms=edited, pack_median_ms=packed, copy_median_ms=copied, repeats=REPEATS
        )
        median, low, high, *_ = rows[name].values()
        print(
            f"{name:20s} {median:6.2f} ms  ({low:.2f} to {high:.2f}) on the host: edit {edited:.2f}, "
            f"pack {packed:.2f}; copy to the device {copied:.2f}"
        )
    print(f"compilations: {len(compiled)}")
    long = {"chain": subjects.chain(1000), "bush": subjects.bush(1000)}
    long = {name: timed(lambda x=x: x, sdyn.capacity([x]), repeats=10) for name, x in long.items()}
    for name, times in long.items():
        print(f"pack a {name} of 1000 joints: {np.median(times[:, 1]):.0f} ms")
    result = dict(
        what="one structure change of paper37 on the host: edit and pack; copy to the device apart [ms]",
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        jax=jax.__version__,
        python=platform.python_version(),
        machine=platform.machine(),
        device=str(jax.devices()[0]),
        cores=os.cpu_count(),
        load=os.getloadavg()[0],
        compilations=len(compiled),
        edits={name: {k: round(v, 3) for k, v in row.items()} for name, row in rows.items()},
        pack_1000_joints_ms={name: round(float(np.median(times[:, 1])), 1) for name, times in long.items()},
    )
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
