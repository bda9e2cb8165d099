"""A thousand random changes of the 37-DOF robot: momentum stays, energy never grows, nothing compiles or piles up."""

import gc
import os
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
from structures import QUICKLY
from test_compile import Compilations

import sdyn

PAPER = sdyn.models.load("paper37")
JOINTS = [joint.name for joint in PAPER.moving]
BASES = ["base", *(frame.link for frame in PAPER.frames), "arm2_link4"]
LOOPS = {"twelve": ("hand1", "hand2"), "thirty_four": ("hand3", "hand4"), "held": ("hand4", "ground")}


def closed(robot, names):
    """The robot with some of the loops."""
    for name in names:
        robot = robot.close(*LOOPS[name], name=name)
    return robot


def some(rng, things, most):
    """Up to so many of them."""
    return [str(x) for x in rng.choice(things, rng.integers(0, most + 1), replace=False)]


def change(rng, robot, loops: bool):
    """Another structure: locks, then perhaps another base, the ground, loops."""
    robot = robot.release() if robot.grounded else robot
    for name in [loop.name for loop in robot.loops if rng.random() < 0.5]:
        robot = robot.open(name)
    robot = robot.unlock(some(rng, sorted(robot.locked), len(robot.locked)))
    free = [name for name in JOINTS if name not in robot.locked]
    robot = robot.lock(dict.fromkeys(some(rng, free, 6), 0.0))  # the value comes from the state
    robot = robot.reroot(str(rng.choice(BASES)))
    robot = robot.ground(robot.base) if rng.random() < 0.2 else robot
    have = [loop.name for loop in robot.loops]
    return closed(robot, [x for x in some(rng, list(LOOPS), 2) if x not in have]) if loops else robot


def measured(before, after, q, v):
    """State after, energies and momenta before and after."""
    chain, q2, v2, _ = sdyn.transfer(before, after, q, v)
    of = lambda chain, q, v: (sdyn.kinetic_energy(chain, q, v), sdyn.momentum(chain, q, v))
    return chain, q2, v2, of(before, q, v), of(chain, q2, v2)


def memory() -> int:
    """Bytes that the process holds."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.parametrize(("kind", "count"), [("trees", 200), ("loops", 1000)])
def test_many_changes(kind, count, rng):
    robots = [PAPER, *(PAPER.reroot(base) for base in BASES)]
    size = sdyn.capacity([*robots, closed(PAPER, LOOPS)] if kind == "loops" else robots)
    run = jax.jit(partial(measured), **QUICKLY)
    robot, chain = PAPER, sdyn.pack(PAPER, size)
    q, _ = map(np.array, sdyn.pad(chain, PAPER.configuration({name: rng.normal() for name in JOINTS}), np.zeros(37)))
    held, least_lost = {}, 0.0
    with Compilations() as first:
        run(chain, chain, q, np.zeros(chain.nv))
    assert first.count
    with Compilations() as made:
        for k in range(count):
            kick = np.where(moving(robot, chain), rng.normal(size=chain.nv), 0.0)
            _, q, v, *_ = run(chain, chain, q, kick)  # what the closures allow of it
            robot = change(rng, robot, kind == "loops")
            after = sdyn.pack(robot, size)
            chain, q, v, *totals = run(chain, after, q, v)
            (T, h), (T2, h2) = jax.tree.map(np.asarray, totals)
            assert T2 <= T * (1 + 1e-12)
            least_lost = max(least_lost, T2 / T)
            if not robot.grounded and not any(loop.name == "held" for loop in robot.loops):
                error = np.abs(h2 - h).max() / np.abs(h).max()
                assert error <= 1e-10, f"change {k}: {error:.1e}"  # 1.8e-12
            if k in (count // 2, count - 1):
                gc.collect()
                held[k] = len(jax.live_arrays()), memory()
    assert made.count == 0
    (arrays, bytes_then), (arrays_now, bytes_now) = held.values()
    assert arrays_now <= arrays and bytes_now - bytes_then < 4e6  # 48, 48, 0.5e6
    assert least_lost > 0.99  # some changes lose nothing


def moving(robot, chain) -> np.ndarray:
    """Which entries of v are the robot's."""
    joints = np.arange(chain.nv - 6) < robot.nv - (0 if robot.grounded else 6)
    return np.r_[np.full(6, not robot.grounded), joints]
