"""What one change of structure of the 37-DOF robot costs: edit, pack, and the one transfer to the device.

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

import sdyn

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


def timed(edit, capacity):
    """Seconds of each repeat: (edit and pack, pack alone)."""
    rows = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        robot = edit()
        middle = time.perf_counter()
        jax.block_until_ready(sdyn.pack(robot, capacity))
        end = time.perf_counter()
        rows.append((end - start, end - middle))
    return np.array(rows).T


def main():
    jax.config.update("jax_enable_x64", True)
    paper = sdyn.models.load("paper37")
    capacity, rows = sdyn.capacity([paper, *(edit() for edit in edits(paper).values())]), {}
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **rest: compiled.append(event) if "compile" in event else None
    )
    for name, edit in edits(paper).items():
        both, alone = timed(edit, capacity) * 1e3
        low, median, high = np.percentile(both, (10, 50, 90))
        rows[name] = dict(
            median_ms=median,
            p10_ms=low,
            p90_ms=high,
            least_ms=both.min(),
            pack_median_ms=np.median(alone),
            repeats=REPEATS,
        )
        print(f"{name:20s} {median:6.2f} ms  ({low:.2f} to {high:.2f}), of which packing {np.median(alone):.2f}")
    print(f"compilations: {len(compiled)}")
    result = dict(
        what="one structure change of paper37: edit, pack, transfer to the device [ms]",
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        jax=jax.__version__,
        python=platform.python_version(),
        machine=platform.machine(),
        device=str(jax.devices()[0]),
        cores=os.cpu_count(),
        load=os.getloadavg()[0],
        compilations=len(compiled),
        edits={name: {k: round(v, 3) for k, v in row.items()} for name, row in rows.items()},
    )
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
