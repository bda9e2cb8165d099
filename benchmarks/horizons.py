"""What an iteration of the Riccati solver costs, over the number of knots: a planar reach of 9 degrees of freedom.

Seconds of the processor, since a shared machine has no quiet minute; the best of some rounds of a few iterations each,
all from the same first guess, compiled before. That a step is that of the dense system, and where it ends, is tested in
`tests/planners/test_riccati.py`; here every run must lower the violation.
"""

import json
import time

import harness

if __name__ == "__main__":
    harness.one_thread()

import jax
import jax.numpy as jnp

from planners import riccati, shooting
from planners.task import parse

KNOTS, ROUNDS, ITERATIONS = (100, 200, 400), 3, 3
TASK = """
kind = "reach"
[robot]
model = "planar3"
joints = { joint1 = -0.9, joint2 = 1.5, joint3 = 0.5 }
[goal]
position = [1.35, 0.25, 0.0]
[phases.reach]
duration = [8.0, 8.0]
control_points = 9
intervals = 100
[weights]
smoothness = 20.0
"""


def costs(task, intervals) -> dict:
    """Seconds of the processor per iteration, and to compile."""
    problem = shooting.problem(task, intervals / task.phases["reach"].intervals)
    form, data = problem.form.values, jax.tree.map(jnp.asarray, problem.data)
    (guess,) = shooting.first_guesses(task, problem, 1)
    start = riccati.BEGIN(form, data, *guess)
    began = time.process_time()
    jax.block_until_ready(riccati.SOLVE(form, data, start, 0))
    compiled, runs = time.process_time() - began, []
    for _ in range(ROUNDS):
        began = time.process_time()
        found = jax.block_until_ready(riccati.SOLVE(form, data, start, ITERATIONS))
        runs.append((time.process_time() - began) / ITERATIONS)
    first = riccati.SOLVE(form, data, start, 1)
    assert found.iteration == ITERATIONS and found.violation < first.violation
    return dict(knots=intervals, iteration_cpu_s=round(min(runs), 4), compile_cpu_s=round(compiled, 1))


def main():
    task = parse(TASK)
    result = dict(
        machine=harness.machine(), task="planar reach, 9 degrees of freedom, 22 entries of a state, 3 controls"
    )
    result["rows"] = rows = []
    for intervals in KNOTS:
        rows.append(costs(task, intervals))
        print(json.dumps(rows[-1]), flush=True)
        harness.save("horizons", result)
    first, last = rows[0], rows[-1]
    ratio = last["iteration_cpu_s"] / first["iteration_cpu_s"] / (last["knots"] / first["knots"])
    result["time_per_knot_last_over_first"] = round(ratio, 3)
    harness.save("horizons", result)


if __name__ == "__main__":
    main()
