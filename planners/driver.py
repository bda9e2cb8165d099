"""From a task to a certified plan."""

import importlib
import platform
import time
from dataclasses import replace
from importlib.metadata import version

import jax
import numpy as np

from planners import sqp
from planners.certify import certify
from planners.plan import Plan
from planners.task import Task, TaskError

ACCURACIES = {"draft": 0.5, "standard": 1.0, "fine": 2.0}  # multiples of the task's intervals
FINE = 12  # the output's grid, relative to the solver's; a multiple of 4 for the certificate
ITERATIONS = 150


def plan(
    task: Task, *, solver: str = "sqp", seeds: int = 1, accuracy: str | None = None, progress: bool = True
) -> Plan:
    """Plans a task and certifies the result. The same call gives the same plan, bit by bit.

    Args:
        task: From `planners.load`.
        solver: "sqp".
        seeds: First guesses; with more than one, each is improved by a descent and the best is solved.
        accuracy: "draft" (half of the task's intervals), "standard" or "fine" (twice); standard if left out.
        progress: Whether to show a live table.

    Returns:
        The plan. Its status is "solved", "infeasible" or "not converged", its verdict says so in a sentence.

    Raises:
        TaskError: If an argument is none of these, or float64 is off.
    """
    fine = _checked(solver, seeds, accuracy)
    from planners.progress import Live

    module = importlib.import_module(f"planners.{task.kind}")
    began = time.monotonic()
    with Live(task.name, seeds, show=progress, iterations=ITERATIONS, tolerance=sqp.FEASIBLE) as live:
        live.compiling("the task")
        problem = module.problem(task, fine)
        live.compiling("first guesses")
        z = module.first_guess(task, problem, seeds)
        live.compiling("the problem and the solver")
        sqp.compile_all(problem.form, z, problem.numbers)
        history = []
        for state in sqp.solve(problem.form, z, problem.numbers, iterations=ITERATIONS):
            history.append((state.iteration, float(state.near.cost), state.violation))
            live.iteration(*history[-1], state.step)
        live.compiling("the certificate")
        found = _result(task, problem, module, state, np.array(history), (seeds, fine, accuracy or "standard"))
        if found.status == "solved":
            certificate = certify(task, found)
            status = "solved" if certificate.passed else "not converged"
            verdict = f"{found.verdict} {certificate.sentence}"
            found = replace(found, certificate=certificate, status=status, verdict=verdict)
    timing = {"compile_s": live.compile_s, "solve_s": time.monotonic() - began - live.compile_s}
    return replace(found, timing=timing)


def _checked(solver, seeds, accuracy) -> float:
    if solver != "sqp":
        raise TaskError(f"there is no solver {solver!r}; this version has 'sqp'.")
    if not isinstance(seeds, int) or seeds < 1:
        raise TaskError(f"seeds is {seeds!r}; it must be a whole number from 1.")
    if accuracy is not None and accuracy not in ACCURACIES:
        raise TaskError(f"accuracy is {accuracy!r}; it must be one of {', '.join(map(repr, ACCURACIES))}.")
    if not jax.config.jax_enable_x64:
        raise TaskError('planning needs float64; call jax.config.update("jax_enable_x64", True) first.')
    return ACCURACIES[accuracy or "standard"]


def _result(task, problem, module, state, history, options):
    x = {name: np.asarray(value) for name, value in problem.form.split(state.z).items()}
    seeds, fine, accuracy = options
    info = {
        "versions": {name: version(name) for name in ("sdyn", "jax", "jaxlib", "numpy")}
        | {"python": platform.python_version()},
        "options": {"solver": "sqp", "seeds": seeds, "accuracy": accuracy, "fine": fine},
        "sizes": {"variables": len(state.z), "equalities": len(state.y), "inequalities": len(state.u)},
        "cost": float(state.near.cost),
        "stationarity": state.stationarity,
        "results": module.results(task, problem, x),
    }
    phases = module.phases(task, problem.data, x, round(FINE * max(fine, 1.0)))
    multipliers = {"equal": np.asarray(state.y), "below": np.asarray(state.u)}
    verdict = _verdict(problem, state, x, module, info)
    return Plan(task, phases, state.status, verdict, x, multipliers, history, {}, info)


def _verdict(problem, state, x, module, info):
    worst = "; ".join(f"{name} is off by {amount:.3g} {unit}" for name, amount, unit in _worst(problem, state))
    if state.status == "infeasible":
        return f"No motion was found that keeps all constraints: {worst}."
    if state.status == "not converged":
        end = f": {worst}." if worst else "."
        return f"The solver stopped before the optimum after {state.iteration} iterations{end}"
    return module.sentence(x, info["results"])


def _worst(problem, state):
    return [x for x in problem.worst(state.near.equal, state.near.below) if x[1] > 1e-6]
