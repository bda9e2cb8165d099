"""What a plan costs: the default solver, compiled, next to IPOPT; cold; and from 32 first guesses.

Seconds are those of the processor, since two solvers that take turns on a shared machine have no quiet minute in
common; the clock's are kept beside them. Both solvers start from the same first guess; then the default solver goes on
from where IPOPT ended, which says whether both state the same problem. IPOPT's time is without making its programme.
"""

import json
import resource
import subprocess
import sys
import time
from collections import Counter
from contextlib import contextmanager

import harness

if __name__ == "__main__":
    harness.one_thread()

import importlib

import jax
import numpy as np
from threadpoolctl import threadpool_limits

import planners
from planners import driver, referee, sqp

TASKS, SEEDS, ROUNDS = ("grasp_planar", "grasp", "identify"), 32, 3
COLD = """
import json, sys, jax
jax.config.update("jax_enable_x64", True)
import planners
plan = planners.plan(planners.load(sys.argv[1]), progress=False)
print(json.dumps(dict(status=plan.status, cost=plan.info["cost"], **plan.timing)))
"""


@contextmanager
def timed(into: dict):
    """Seconds of the processor and of the clock that a block takes."""
    cpu, wall = time.process_time(), time.perf_counter()
    yield
    into |= dict(cpu_s=round(time.process_time() - cpu, 3), wall_s=round(time.perf_counter() - wall, 3))


def described(end) -> dict:
    """Where a solver ended."""
    return dict(status=end.status, cost=end.cost, iterations=int(end.iteration), stationarity=end.stationarity)


def ours(problem, z, rounds=ROUNDS) -> dict:
    """The default solver from first guesses, compiled before; the best of some rounds."""
    sqp.compile_all(problem)
    runs = []
    with threadpool_limits(1, "blas"):
        for _ in range(rounds):
            runs.append({})
            with timed(runs[-1]):
                *_, states = sqp.solve(problem, z, iterations=driver.ITERATIONS)
                best = sqp.outcome(sqp.pick(states, sqp.ranking(states)[0]))
            runs[-1]["starts"] = dict(Counter(sqp.STATUSES[s.status] for s in states))
    return min(runs, key=lambda run: run["cpu_s"]) | described(best)


def theirs(task, problem, z) -> tuple[dict, np.ndarray]:
    """IPOPT from a first guess, and where it ended."""
    made, run = {}, {}
    with timed(made):
        programme = referee.programme(task, problem, z)
        assert programme.solver.numel_in()
    with timed(run):
        end = programme.solve()
    return run | described(end) | dict(made_cpu_s=made["cpu_s"]), end.z


def cold(name) -> dict:
    """A plan by a new process that has no compiled programs: import, compile, solve, certify."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run([sys.executable, "-c", COLD, name], capture_output=True, text=True, check=True)
    after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - began
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return dict(cpu_s=round(cpu, 1), wall_s=round(wall, 1)) | json.loads(done.stdout)


def solvers(name) -> dict:
    """Both solvers on one task."""
    task = planners.load(name)
    module = importlib.import_module(f"planners.{task.kind}")
    problem = module.problem(task)
    z = module.first_guesses(task, problem, 1)
    mine = ours(problem, z)
    judged, end = theirs(task, problem, z[0])
    further = ours(problem, end[None])
    return dict(
        sqp=mine,
        ipopt=judged,
        times_faster=round(judged["cpu_s"] / mine["cpu_s"], 2),
        times_faster_per_iteration=round(
            judged["cpu_s"] / judged["iterations"] / mine["cpu_s"] * mine["iterations"], 2
        ),
        sqp_from_ipopts_end=further | dict(relative_difference=abs(further["cost"] / judged["cost"] - 1)),
    )


def starts(name) -> dict:
    """Many first guesses against one."""
    task = planners.load(name)
    module = importlib.import_module(f"planners.{task.kind}")
    problem = module.problem(task)
    guesses = {}
    with timed(guesses):
        z = module.first_guesses(task, problem, SEEDS)
    one, many = ours(problem, z[:1]), ours(problem, z, 1)
    return dict(one=one, many=many, guesses=guesses, seeds=SEEDS, times_longer=round(many["cpu_s"] / one["cpu_s"], 2))


def main(parts):
    jax.config.update("jax_enable_x64", True)
    path = harness.RESULTS / "planning.json"
    result = json.loads(path.read_text()) if path.is_file() and parts else {}
    result["machine"] = harness.machine("casadi")
    for name in TASKS:
        for part in (solvers, cold) + (starts,) * (name == "grasp"):
            if not parts or f"{part.__name__}:{name}" in parts:
                found = result.setdefault(part.__name__, {})[name] = part(name)
                print(part.__name__, name, json.dumps(found, indent=1), flush=True)
                harness.save("planning", result)


if __name__ == "__main__":
    main(sys.argv[1:])  # nothing: all; else parts such as solvers:grasp, to be measured again
