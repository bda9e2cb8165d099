"""Plans of many similar tasks, each from that of the nearest one that is solved; what is between them is interpolated.

    spins = np.linspace(0.02, 0.04, 5)[:, None]                      # [points, axes]
    table = planners.table(task_at, spins, "out/spins")              # task_at(point) -> Task
    variables, error = table.guess([0.033])                          # in no time
    plan = planners.plan(task_at([0.033]), guess=variables)          # in a few iterations

The order depends on the points alone, and what a plan starts from on earlier plans alone: a table that was killed goes
on where it was and becomes the same, bit for bit. Errors of interpolation are estimates (`lattice.py`); `check` plans
in the middles of cells and says whether they hold.
"""

import hashlib
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from planners.certify import Certificate
from planners.driver import plan
from planners.lattice import Lattice
from planners.plan import Plan
from planners.problem import summary
from planners.study import study
from planners.task import Task

NOWHERE = -1  # the start of a plan that was made from first guesses or from an interpolation


class Entry(NamedTuple):
    """What a table holds of one plan."""

    status: str
    """solved, infeasible or not converged."""
    verdict: str
    """One sentence, which explains a failure in physical units."""
    start: int
    """The point whose plan it started from; -1 if from none."""
    iterations: int
    cost: float
    variables: dict[str, np.ndarray]
    """Physical units."""
    certificate: Certificate | None


class Check(NamedTuple):
    """A plan in the middle of a cell against its interpolation; errors by name of the variables, and of the cost."""

    point: np.ndarray
    """[axes]."""
    error: dict[str, float]
    """Largest difference, physical units; not a number where no plan was found."""
    bound: dict[str, float]
    """What it was estimated to be at most."""
    violations: list[tuple[str, float, str]]
    """What the interpolated plan violates most: rows, amount, unit."""
    entry: Entry
    """The plan found from the interpolated one."""


class Guess(NamedTuple):
    """An interpolated plan."""

    variables: dict[str, np.ndarray]
    """Physical units."""
    error: dict[str, float]
    """Estimated largest error of each, and of the cost; infinite where too few points are solved for an estimate."""


@dataclass(frozen=True)
class PlanTable:
    """Plans at points of a lattice."""

    task_at: Callable[[np.ndarray], Task]
    lattice: Lattice
    entries: tuple[Entry, ...]
    """In the order of the points."""
    folder: Path

    @property
    def solved(self) -> list[int]:
        """The points that have a certified plan."""
        return [k for k, entry in enumerate(self.entries) if entry.status == "solved"]

    def guess(self, point) -> Guess:
        """The plan between the points, linear along each axis.

        Raises:
            ValueError: If the point is in no cell whose corners are all solved.
        """
        solved, weights = self.solved, self.lattice.weights(point)
        if weights is None or not set(weights) <= set(solved):
            raise ValueError(
                f"{np.asarray(point).tolist()} is in no cell of the table whose corners are all solved; plan there "
                f"from the variables of a near entry."
            )
        values = {k: self._values(k) for k in solved}
        mean = {name: sum(w * values[k][name] for k, w in weights.items()) for name in values[solved[0]]}
        error = {name: self.lattice.error(weights, {k: x[name] for k, x in values.items()}).max() for name in mean}
        return Guess({name: mean[name] for name in self.entries[solved[0]].variables}, error)

    def _values(self, k):
        return self.entries[k].variables | {"cost": np.array(self.entries[k].cost)}

    def check(self, most: int = 50) -> list[Check]:
        """Plans in the middles of at most so many cells, from what is interpolated there; kept in the folder too."""
        middles = self.lattice.middles(self.solved)
        chosen = middles[np.unique(np.linspace(0, len(middles) - 1, min(most, len(middles))).astype(int))]
        tasks = [self.task_at(point) for point in chosen]

        def work(parameters, rng):
            k = parameters["number"]
            return _arrays(
                plan(tasks[k], guess=self.guess(chosen[k]).variables, explain=False, progress=False), NOWHERE
            )

        found = study(self.folder / f"check-{len(chosen)}", _runs(chosen, tasks, range(len(tasks)), {}), work)
        return [self._checked(*each) for each in zip(chosen, tasks, map(_entry, found.values()), strict=True)]

    def _checked(self, point, task, entry) -> Check:
        variables, bound = self.guess(point)
        problem = importlib.import_module(f"planners.{task.kind}").problem(task)
        at = summary(problem.form, problem.form.join(variables), problem.numbers[0])
        error = {name: float(np.abs(x - entry.variables[name]).max()) for name, x in variables.items()}
        cost = sum(w * self.entries[k].cost for k, w in self.lattice.weights(point).items())
        error |= {"cost": abs(cost - entry.cost)}
        error = error if entry.status == "solved" else dict.fromkeys(error, np.nan)
        return Check(point, error, bound, problem.worst(at.equal, at.below, 3), entry)


def table(
    task_at: Callable[[np.ndarray], Task],
    points,
    folder,
    *,
    neighbours: int = 2,
    seeds: int = 2,
    iterations: int = 60,
) -> PlanTable:
    """Plans all points, each from the plan of the nearest one that is solved; where that leads to none, from others.

    Args:
        task_at: The task at a point [axes]. Tasks should differ in numbers only; then one compilation serves all.
        points: [count, axes], any part of a lattice. The first should be one that is easy to plan.
        folder: For the plans, a file each; made if it is not there. What is in it is not planned again.
        neighbours, seeds: Plans of the nearest solved points, then first guesses, that are tried one after the other.
        iterations: Of the solver, for each of them, at most.

    Raises:
        StudyError: If the folder holds another table, or is in use.
        ValueError: If the points are none.
    """
    lattice = Lattice(points)
    tasks = [task_at(point) for point in lattice.points]

    def starts(task, k, before):
        near = [int(j) for j, found in before.items() if found["status"] == "solved"]
        for j in sorted(near, key=lattice.distances(k).__getitem__)[:neighbours]:
            yield j, _entry(before[str(j)]).variables
        for guess in _first_guesses(task, seeds):
            yield NOWHERE, guess

    def work(parameters, rng, before):
        k, best = parameters["number"], None
        for start, guess in starts(tasks[k], k, before):
            found = plan(tasks[k], guess=guess, iterations=iterations, explain=False, progress=False)
            if best is None or _rank(found) < _rank(best[0]):
                best = found, start
            if found.status == "solved":
                break
        return _arrays(*best)

    options = {"neighbours": neighbours, "seeds": seeds, "iterations": iterations}
    found = study(folder, _runs(lattice.points, tasks, lattice.order, options), work, chained=True)
    entries = tuple(_entry(found[str(k)]) for k in range(len(tasks)))
    return PlanTable(task_at, lattice, entries, Path(folder))


def _first_guesses(task, count) -> list[dict]:
    """First guesses by name, physical units."""
    module = importlib.import_module(f"planners.{task.kind}")
    problem = module.problem(task)
    return [problem.form.split(z) for z in module.first_guesses(task, problem, count)]


def _rank(found: Plan):
    """Of two plans the better one has less: solved, then the one that violates less."""
    return found.status != "solved", float(found.history[-1][2])


def _runs(points, tasks, order, options) -> dict[str, dict]:
    """The runs of a study: a folder is refused if any number of any of its tasks has changed."""
    with np.printoptions(floatmode="unique", threshold=np.inf):
        sums = [hashlib.sha256(repr(task).encode()).hexdigest() for task in tasks]
    return {str(k): {"number": k, "point": points[k].tolist(), "task": sums[k]} | options for k in order}


def _arrays(found: Plan, start: int) -> dict:
    """A plan as arrays for a file; times are left out, they are never the same."""
    certificate = found.certificate.to_json() if found.certificate else ""
    out = {"status": found.status, "verdict": found.verdict, "certificate": certificate, "start": start}
    out |= {"iterations": int(found.history[-1][0]), "cost": found.info["cost"]}
    return {k: np.array(x) for k, x in out.items()} | {f"variable.{k}": x for k, x in found.variables.items()}


def _entry(arrays) -> Entry:
    """What a file holds."""
    variables = {k.removeprefix("variable."): x for k, x in arrays.items() if k.startswith("variable.")}
    said = str(arrays["certificate"])
    numbers = int(arrays["start"]), int(arrays["iterations"]), float(arrays["cost"])
    certificate = Certificate.from_json(said) if said else None
    return Entry(str(arrays["status"]), str(arrays["verdict"]), *numbers, variables, certificate)
