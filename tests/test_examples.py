"""The paper's examples: restructured models accelerate as those it compares with, in which the structure is kept."""

import importlib.util
from pathlib import Path

import numpy as np
from structures import close

spec = importlib.util.spec_from_file_location("examples", Path(__file__).parents[1] / "benchmarks" / "examples.py")
examples = importlib.util.module_from_spec(spec)
spec.loader.exec_module(examples)


def test_example_1():
    """A fixed base with two degrees of freedom, against five coordinates with virtual links."""
    alone, _ = examples.flyer()
    assert alone.nv == 6 + 1
    held, virtual, free = examples.example_1().values()
    assert (held.size, virtual.size, free.size) == ("2", "5 + 6", "8 + 6")
    want = held.accelerations()
    assert np.abs(want).min() > 1e-3
    close(virtual.accelerations(), want, 1e-10)
    close(free.accelerations(), want, 1e-10)


def test_example_2():
    """The table of each step, and the same accelerations with the base kept and three closures."""
    steps = examples.steps_2()
    rows = {name: [tuple(row) for row in robot.table()] for name, robot in steps.items()}
    names = list(steps)
    hand = {k: 7 * k for k in (1, 2, 3)}  # of 21 links; arms one after the other
    chain = lambda n: [(k, k - 1, 0) for k in range(1, n + 1)]
    free = rows[names[0]]
    assert [row[1] for row in free] == [0, *range(1, 7), 0, *range(8, 14), 0, *range(15, 21)]
    assert [row[2] for row in free] == [{7: 1, 14: 2, 21: 3}.get(k, 0) for k in range(1, 22)]
    assert [row[4] for row in free] == [-1] * 21
    closed = rows[names[1]]
    assert [row[:4] for row in closed] == [row[:4] for row in free]
    assert [row[4] for row in closed] == [hand[1] if k == hand[2] else -1 for k in range(1, 22)]
    for name in names[2:4]:  # arm 1 inverted: its hand is the base, the robot's base is link 7, arms 2 and 3 hang there
        assert [row[:3] for row in rows[name]][:7] == chain(7)
        assert [row[1] for row in rows[name]] == [*range(7), 7, *range(8, 14), 7, *range(15, 21)]
        assert [row[4] for row in rows[name]] == [0 if k == 14 else -1 for k in range(1, 22)]
    last = rows[names[4]]
    assert [row[:4] for row in last] == [row[:4] for row in rows[names[3]]]
    assert [row[4] for row in last] == [0 if k in (14, 21) else -1 for k in range(1, 22)]
    assert [robot.nv for robot in steps.values()] == [27, 27, 27, 21, 21]


def test_example_2_accelerates_alike():
    last, kept = examples.example_2().values()
    assert (last.size, kept.size) == ("21 + 12", "27 + 18")
    want = last.accelerations()
    close(kept.accelerations(), want, 1e-10)


def test_example_3():
    """Nine degrees of freedom, against 37 with 28 joints held in place."""
    small, *full, _ = examples.example_3().values()
    want = small.accelerations()
    assert small.size == "9"
    for model in full:
        assert model.size == "37"
        close(model.accelerations(), want, 1e-10)
