"""Plans: what a planner found, kept as plain arrays, saved and loaded."""

import hashlib
import json
import os
import shutil
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

import sdyn
from planners.task import Task, parse

FORMAT = 1


@dataclass(frozen=True)
class PhaseResult:
    """One phase on the fine grid."""

    name: str
    robot: sdyn.Robot
    """The structure of the phase; after the grasp, the compound."""
    times: np.ndarray
    """[k] s, absolute; the first is the last of the phase before."""
    q: np.ndarray
    """[k, nq]."""
    v: np.ndarray
    """[k, nv]."""
    tau: np.ndarray
    """[k, nv] N m; zero for a free base."""
    passive: tuple[sdyn.Robot, np.ndarray, np.ndarray] | None = None
    """The separate target (robot, q [k, 7], v [k, 6]); None after the grasp."""


@dataclass(frozen=True)
class Plan:
    """A planned motion, how it was found, and what its certificate says."""

    task: Task
    phases: tuple[PhaseResult, ...]
    status: str
    """solved, infeasible or not converged."""
    verdict: str
    """One sentence."""
    variables: dict[str, np.ndarray]
    """What the solver decided, physical units."""
    multipliers: dict[str, np.ndarray]
    """equal [e] and below [i], of the scaled rows."""
    history: np.ndarray
    """[iterations, 3]: iteration, cost, feasibility."""
    timing: dict[str, float]
    """compile_s, solve_s."""
    info: dict = field(default_factory=dict)
    """Versions, hashes, seeds, options, and results of the task (identify: the information)."""
    certificate: object = None

    times = property(lambda self: tuple(phase.times for phase in self.phases))
    q = property(lambda self: tuple(phase.q for phase in self.phases))
    v = property(lambda self: tuple(phase.v for phase in self.phases))
    tau = property(lambda self: tuple(phase.tau for phase in self.phases))
    structures = property(lambda self: tuple(phase.robot for phase in self.phases))

    def save(self, folder) -> None:
        """Writes plan.npz, plan.json, certificate.json, figures and plan.html into a folder, all or none.

        The files are made in a folder beside it, which then takes its place file by file.
        """
        folder = Path(folder)
        folder.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
        try:
            self._write(made)
            folder.mkdir(exist_ok=True)
            for path in sorted(made.iterdir()):
                os.replace(path, folder / path.name)
        finally:
            shutil.rmtree(made)

    def _write(self, folder):
        from planners import animation, figures

        np.savez(folder / "plan.npz", **_arrays(self))
        (folder / "plan.json").write_text(json.dumps(_description(self), indent=1) + "\n", encoding="utf-8")
        if self.certificate is not None:
            (folder / "certificate.json").write_text(self.certificate.to_json() + "\n", encoding="utf-8")
        figures.draw(self, folder)
        animation.write(self, folder / "plan.html")

    @classmethod
    def load(cls, folder) -> "Plan":
        """Reads a plan; its robots are made again from the task."""
        from planners.certify import Certificate

        folder = Path(folder)
        said = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
        with np.load(folder / "plan.npz", allow_pickle=False) as file:
            arrays = dict(file)
        place = {"folder": Path(said["task"]["folder"])} if said["task"]["folder"] else {}
        task = parse(said["task"]["text"], said["task"]["name"], **place)
        part = lambda key: {k[len(key) + 1 :]: x for k, x in arrays.items() if k.startswith(key + ".")}
        plan = cls(
            task,
            tuple(_phase(task, name, part(f"phase.{name}")) for name in task.phases),
            said["status"],
            said["verdict"],
            part("variable"),
            part("multiplier"),
            arrays["history"],
            said["timing"],
            said["info"],
        )
        path = folder / "certificate.json"
        return replace(plan, certificate=Certificate.from_json(path.read_text())) if path.is_file() else plan


def _arrays(plan):
    out = {"history": plan.history}
    out |= {f"variable.{k}": x for k, x in plan.variables.items()}
    out |= {f"multiplier.{k}": x for k, x in plan.multipliers.items()}
    for phase in plan.phases:
        out |= {f"phase.{phase.name}.{k}": getattr(phase, k) for k in ("times", "q", "v", "tau")}
        if phase.passive:
            out |= {f"phase.{phase.name}.target_{k}": x for k, x in zip("qv", phase.passive[1:], strict=True)}
    return out


def _description(plan):
    task = plan.task
    return {
        "format": "sdyn-plan",
        "version": FORMAT,
        "task": {
            "name": task.name,
            "kind": task.kind,
            "sha256": task.sha256,
            "text": task.source,
            "folder": str(task.folder) if task.reads_files else None,
            "robots": {robot.name: _hash(robot) for robot in (task.chaser, task.body) if robot is not None},
        },
        "status": plan.status,
        "verdict": plan.verdict,
        "timing": plan.timing,
        "info": plan.info,
    }


def _hash(robot) -> str:
    """SHA-256 of everything a robot is."""
    return hashlib.sha256(repr(robot).encode()).hexdigest()


def _phase(task, name, arrays):
    after = task.kind == "grasp" and name == "stabilise"
    passive = (task.body, arrays["target_q"], arrays["target_v"]) if "target_q" in arrays else None
    return PhaseResult(
        name, task.compound if after else task.chaser, *(arrays[k] for k in ("times", "q", "v", "tau")), passive
    )
