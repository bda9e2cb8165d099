"""Choosing the structure of a reach of the 37-DOF robot: dropping candidates early against optimising all of them.

Both share one compilation, made before, and start every candidate from the same first guess. "four arms" has every
hand with up to two joints locked, and most candidates cannot reach the goal, as is found out cheaply; "one arm" has up
to three of its joints locked, and most can. "docked" has two arms with up to one joint locked, and the other hand free,
or docked with its arm locked, or with its arm moving. What it would take without those that cannot is said too. Seconds
are those of the processor.
"""

import time
from collections import Counter

import harness

if __name__ == "__main__":
    harness.one_thread()

import jax
import numpy as np

from planners import structures
from planners.task import parse

TASK = """
kind = "reach"
[robot]
model = "paper37"
frame = "hand1"
moving = [{moving}]
joints = {{ {joints} }}
[goal]
position = {position}
[phases.reach]
duration = [2.0, 20.0]
control_points = 8
intervals = 12
[limits]
rate = 0.4
torque = 2.0
margin = 0.02
[weights]
time = 0.02
torque = 1.0
smoothness = 5.0
"""
SCENES = {
    "four arms": ((1, 2, 3, 4), [0.75, 0.6, 1.2], 2),
    "one arm": ((1,), [1.2, 0.2, 1.3], 3),
    "docked": ((1, 2), [1.2, 0.2, 1.3], 1, ("hand1", "hand2")),
}


def scene(arms, position, lock, docks=()):
    """A task and its candidates."""
    names = ", ".join(f'"arm{a}_{k}"' for a in arms for k in range(1, 8))
    bent = ", ".join(f"arm{a}_2 = 0.8, arm{a}_4 = -1.2" for a in arms)
    task = parse(TASK.format(moving=names, joints=bent, position=position), "reach")
    return task, structures.lockings(task, lock, docks)


COMPILED = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **rest: COMPILED.append(event) if event.endswith("backend_compile_duration") else None
)


def measured(task, candidates) -> dict:
    """Both ways; the first call compiles, and optimises everything, so that whatever can be compiled is."""
    began = time.process_time()
    structures.choose_structure(task, candidates, drop=False)
    first, before = time.process_time() - began, len(COMPILED)
    runs = {}
    for name, drop in (("dropping", True), ("all", False)):
        began = time.process_time()
        choice = structures.choose_structure(task, candidates, drop=drop)
        runs[name] = choice, time.process_time() - began
    assert len(COMPILED) == before, "another candidate compiled something"
    (quick, short), (whole, long) = runs.values()
    reachable = [c for c in whole.candidates if np.isfinite(c.bound)]
    saved = sum(c.seconds for c in whole.candidates) - sum(c.seconds for c in reachable)
    above = [c.bound / c.cost - 1 for c in reachable if c.cost]
    print(quick)
    return dict(
        candidates=len(candidates),
        at_the_goal=len(reachable),
        compiled_after_the_first_call=len(COMPILED) - before,
        best=dict(frame=quick.best.structure.frame, locked=quick.best.locked, cost=quick.best.cost),
        best_of_all=dict(frame=whole.best.structure.frame, locked=whole.best.locked, cost=whole.best.cost),
        relative_difference=quick.best.cost / whole.best.cost - 1,
        dropping=dict(cpu_s=round(short, 2), ended=Counter(c.status for c in quick.candidates)),
        all=dict(cpu_s=round(long, 2), ended=Counter(c.status for c in whole.candidates)),
        part_of_its_time=round(short / long, 3),
        part_of_its_time_without_what_is_out_of_reach=round(short / (long - saved), 3),
        iterations=[sum(c.iterations for c in x.candidates) for x in (quick, whole)],
        largest_bound_above_cost=max(above),
        **docking(whole),
        first_call_cpu_s=round(first, 1),
    )


def docking(choice) -> dict:
    """What the best candidate with and without a dock costs, and what the dock must hold; nothing without docks."""
    best = {}
    for c in filter(lambda c: c.cost, choice.candidates):  # the cheapest first
        arm = "moves" if any(not c.structure.frame.endswith(name[3]) for name in c.structure.joints) else "is locked"
        best.setdefault(f"docked, its arm {arm}" if c.structure.dock else "free", c)
    of = lambda c: dict(
        frame=c.structure.frame, locked=c.locked, cost=c.cost, time=c.time, torque=c.torque, smoothness=c.smoothness,
        duration_s=c.duration, dock_moment_N_m=c.dock_moment, dock_force_N=c.dock_force,
    )  # fmt: skip
    return {"docking": {name: of(c) for name, c in best.items()}} if len(best) > 1 else {}


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    result = dict(machine=harness.machine())
    for name, parts in SCENES.items():
        result[name] = measured(*scene(*parts))
        print(name, result[name], flush=True)
    harness.save("structure_choice", result)
