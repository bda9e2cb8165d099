"""From a task to a certified plan."""

import platform
import time
from collections import Counter
from dataclasses import replace
from importlib.metadata import version

import jax
import numpy as np

from planners import relax, riccati, shooting, sqp
from planners.certify import certify, statement
from planners.plan import Plan
from planners.problem import Outcome
from planners.task import Task, TaskError

ACCURACIES = {"fast": 0.5, "balanced": 1.0, "accurate": 2.0, "reference": 4.0}  # multiples of the task's intervals
FINE = 24  # the output's grid, relative to the solver's: two steps of the certificate's integration
ITERATIONS = 150


def plan(
    task: Task,
    *,
    solver: str = "sqp",
    seeds: int = 1,
    accuracy: str | None = None,
    progress: bool = True,
    guess: dict | None = None,
    explain: bool = True,
    iterations: int = ITERATIONS,
) -> Plan:
    """Plans a task and certifies the result. The same call gives the same plan, bit by bit.

    Args:
        task: From `planners.load`.
        solver: "sqp"; "casadi", the referee: the task stated again in CasADi and solved by IPOPT, for a second
            opinion; or "riccati", multiple shooting with forward dynamics, for reaches with many knots, and plans that
            are made again (`riccati.py`). The latter two take one first guess after the other.
        seeds: First guesses. The default solver gives each some iterations and goes on with the best few (`sqp.py`);
            the best result that is certified is kept, and the plan's info says how all ended.
        accuracy: "fast" (half of the task's intervals), "balanced", "accurate" (twice) or "reference" (four times);
            balanced if left out. Or a wanted error such as "1e-6": the first of these that is certified and whose
            motion, integrated again by other code, is that close to the plan [m, rad, m/s, rad/s].
        progress: Whether to show a live table.
        guess: The variables of a similar task's plan to start from, instead of first guesses.
        explain: Whether to look for what an infeasible task's constraints would have to give; it takes longer than a
            plan.
        iterations: At most; the referee has its own limit.

    Returns:
        The plan. Its status is "solved", "infeasible" or "not converged", its verdict says so in a sentence.

    Raises:
        TaskError: If an argument is none of these, or float64 is off.
    """
    names, wanted = _checked(task, solver, seeds, accuracy, guess)
    for name in names:
        found = _planned(task, solver, seeds, name, guess, explain, iterations, progress)
        error = found.certificate.worst("integrated again") if found.certificate else np.inf
        if len(names) == 1 or found.status == "infeasible" or (found.status == "solved" and error <= wanted):
            return found
    if found.status != "solved":
        return found
    said = f"The motion integrated again differs by {error:.1e}, and {wanted:g} was wanted."
    return replace(found, status="not converged", verdict=f"{found.verdict} {said}")


def _planned(task, solver, seeds, accuracy, guess, explain, iterations, progress) -> Plan:
    """The plan on one grid."""
    from planners.progress import Live

    fine, module = ACCURACIES[accuracy], statement(task, solver)
    began = time.monotonic()
    with Live(task.name, seeds, show=progress, iterations=iterations, tolerance=sqp.FEASIBLE) as live:
        live.compiling("the task")
        problem = module.problem(task, fine)
        live.compiling("first guesses")
        z = module.first_guesses(task, problem, seeds) if guess is None else _joined(problem.form, guess)
        ends, history = SOLVERS[solver](task, problem, z, live, iterations)
        live.compiling("the certificate")
        options = {"solver": solver, "seeds": seeds, "accuracy": accuracy, "fine": fine}
        info = {"options": options, "starts": dict(Counter(end.status for end in ends))}
        ends = [end for end in ends if end.status != "dropped"]
        found = _best(_result(task, problem, module, end, np.array(history), info) for end in ends)
        if found.status == "infeasible" and solver == "sqp" and explain:
            found = _explained(found, problem, ends[0], z[0], live)
    timing = {"compile_s": live.compile_s, "solve_s": time.monotonic() - began - live.compile_s}
    return replace(found, timing=timing)


def _joined(form, guess) -> np.ndarray:
    """Variables by name as the one first guess [1, n], scaled."""
    for block in form.blocks:
        if np.shape(guess.get(block.name)) != block.shape or not np.isfinite(guess[block.name]).all():
            raise TaskError(
                f"guess must hold {block.name!r}, finite numbers of the shape {block.shape}, as such a plan has."
            )
    return form.join(guess)[None]


def _by_sqp(task, problem, z, live, iterations) -> tuple[list[Outcome], list]:
    """Where all starts end, the best first, and the iterations of the best."""
    from threadpoolctl import threadpool_limits  # importing it sets an environment variable

    live.compiling("the problem and the solver")
    sqp.compile_all(problem)
    history = []
    # matrices of a few hundred rows: two threads of BLAS take twice the time of one, and far more on a busy machine
    with threadpool_limits(1, "blas"):
        for states in sqp.solve(problem, z, iterations=iterations):
            best = states[sqp.ranking(states)[0]]
            history.append((len(history), float(best.near.cost), float(best.violation)))
            live.iteration(*history[-1], float(best.step), sqp.running(states))
    return [sqp.outcome(sqp.pick(states, k)) for k in sqp.ranking(states)], history


def _by_ipopt(task, problem, z, live, _) -> tuple[list[Outcome], list]:
    """The same by the referee, one start after the other; of each, its end counts as an iteration."""
    from planners import referee

    ends, history = [], []
    for k, start in enumerate(z):
        live.compiling("the problem in CasADi")
        programme = referee.programme(task, problem, start)
        live.note(f"IPOPT solves from guess {k + 1} of {len(z)}.")
        ends.append(programme.solve())
        history.append((ends[-1].iteration, ends[-1].cost, ends[-1].violation))
    return sorted(ends, key=lambda end: (end.status != "solved", end.cost)), history


def _by_riccati(task, problem, guesses, live, iterations) -> tuple[list[Outcome], list]:
    """The same by multiple shooting, one start after the other: states and controls, or variables."""
    ends, histories = [], []
    for guess in guesses:
        live.compiling("the problem and the solver")
        history = []
        start = guess if isinstance(guess, tuple) else shooting.driven(problem, guess)
        for state in riccati.iterations(problem, *start, iterations):
            history.append((int(state.iteration), float(state.cost), float(state.violation)))
            live.iteration(*history[-1], float(state.step))
        ends.append(riccati.outcome(problem, state))
        histories.append(history)
    order = sorted(range(len(ends)), key=lambda k: (ends[k].status != "solved", ends[k].cost))
    return [ends[k] for k in order], histories[order[0]]


SOLVERS = {"sqp": _by_sqp, "casadi": _by_ipopt, "riccati": _by_riccati}


def _best(results) -> Plan:
    """The first of several results, from the best to the worst, that is certified; else the first of all."""
    first = None
    for found in results:
        if found.status == "solved":
            certificate = certify(found.task, found)
            status = "solved" if certificate.passed else "not converged"
            verdict = f"{found.verdict} {certificate.sentence}"
            found = replace(found, certificate=certificate, status=status, verdict=verdict)
        if found.status == "solved":
            return found
        first = first or found
    return first


def _explained(found: Plan, problem, end: Outcome, guess, live) -> Plan:
    """With what each constraint would have to give for a motion to exist, in its verdict and its description."""
    from threadpoolctl import threadpool_limits  # as in _by_sqp

    with threadpool_limits(1, "blas"):
        needed = relax.relaxations(problem, end, guess, live.note)
    info = found.info | {"relaxation": [x._asdict() for x in needed]}
    return replace(found, verdict=f"{found.verdict} {relax.sentence(needed)}", info=info)


def _checked(task, solver, seeds, accuracy, guess) -> tuple[tuple[str, ...], float]:
    """Names of the grids to try, and the error that ends it."""
    if solver not in SOLVERS:
        raise TaskError(f"there is no solver {solver!r}; this version has {', '.join(map(repr, SOLVERS))}.")
    if task.robot.dock and solver != "sqp":
        raise TaskError(f"{task.robot.dock!r} is docked, and the solver {solver!r} knows free robots only; use 'sqp'.")
    if not isinstance(seeds, int) or seeds < 1:
        raise TaskError(f"seeds is {seeds!r}; it must be a whole number from 1.")
    if guess is not None and seeds != 1:
        raise TaskError(f"seeds is {seeds}, and a guess was given; a plan starts from the one or the other.")
    if not jax.config.jax_enable_x64:
        raise TaskError('planning needs float64; call jax.config.update("jax_enable_x64", True) first.')
    if accuracy is None or accuracy in ACCURACIES:
        return (accuracy or "balanced",), np.inf
    try:
        wanted = float(accuracy)
    except (TypeError, ValueError):
        wanted = np.nan
    if not 0 < wanted < np.inf:
        named = ", ".join(map(repr, ACCURACIES))
        raise TaskError(f"accuracy is {accuracy!r}; it must be one of {named}, or a wanted error such as '1e-6'.")
    return tuple(ACCURACIES), wanted


def _result(task, problem, module, end: Outcome, history, info):
    x = {name: np.asarray(value) for name, value in problem.form.split(end.z).items()}
    info = info | {
        "versions": {name: version(name) for name in ("sdyn", "jax", "jaxlib", "numpy", "casadi")}
        | {"python": platform.python_version()},
        "sizes": {"variables": len(end.z), "equalities": len(end.y), "inequalities": len(end.u)},
        "cost": end.cost,
        "stationarity": end.stationarity,
        "results": module.results(task, problem, x),
    }
    phases = module.phases(task, problem.data, x, round(FINE * max(info["options"]["fine"], 1.0)))
    multipliers = {"equal": end.y, "below": end.u}
    verdict = _verdict(problem, end, x, module, info)
    return Plan(task, phases, end.status, verdict, x, multipliers, history, {}, info)


def _verdict(problem, end, x, module, info):
    off = [row for row in problem.worst(end.equal, end.below) if row[1] > 1e-6]
    worst = "; ".join(f"{name} is off by {amount:.3g} {unit}" for name, amount, unit in off)
    if end.status == "infeasible":
        held = problem.holding(end.u, [name for name, _, _ in off])
        most = f" What holds it back most is the {held}." if held else ""
        return f"No motion was found that keeps all constraints: {worst}.{most}"
    if end.status == "not converged":
        return f"The solver stopped before the optimum after {end.iteration} iterations{f': {worst}' if worst else ''}."
    return module.sentence(x, info["results"])
