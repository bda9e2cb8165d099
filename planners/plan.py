"""Plans: what a planner found, kept as plain arrays, saved and loaded."""

import hashlib
import io
import json
import os
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import sdyn
from planners.task import Task, parse

FORMAT = 2
NEW = ".new"
NEEDED = ("plan.npz", "certificate.json")  # of the files that plan.json names


class PlanError(ValueError):
    """Files that are not those of one plan."""


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
    """[k, nv]: moment [N m] and force [N] on the base, its axes, zero where it floats freely; joint torques [N m]."""
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

        The files are made in a folder beside it, which one rename then puts into its place as `.new`: until then the
        earlier plan is whole, from then on this one is, and `load` finishes the moves that a kill left undone. Files
        of an earlier plan that this one has not are removed; what else is in the folder stays.
        """
        folder = Path(folder)
        folder.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
        try:
            self._write(made)
            folder.mkdir(exist_ok=True)
            _settle(folder)
            os.rename(made, folder / NEW)
        except BaseException:
            shutil.rmtree(made, ignore_errors=True)
            raise
        _settle(folder)

    def _write(self, folder):
        from planners import animation, figures

        np.savez(folder / "plan.npz", **_arrays(self))
        if self.certificate is not None:
            (folder / "certificate.json").write_text(self.certificate.to_json() + "\n", encoding="utf-8")
        figures.draw(self, folder)
        animation.write(self, folder / "plan.html")
        files = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}
        said = _description(self) | {"files": files}
        (folder / "plan.json").write_text(json.dumps(said, indent=1) + "\n", encoding="utf-8")
        for path in folder.iterdir():
            with path.open("rb") as file:
                os.fsync(file.fileno())

    @classmethod
    def load(cls, folder) -> "Plan":
        """Reads a plan; its robots are made again from the task.

        Raises:
            PlanError: If the files in the folder are not those of one plan.
        """
        from planners.certify import Certificate

        folder = Path(folder)
        _settle(folder)
        said = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
        read = _read(folder, said)
        with np.load(io.BytesIO(read["plan.npz"]), allow_pickle=False) as file:
            arrays = dict(file)
        place = {"folder": Path(said["task"]["folder"])} if said["task"]["folder"] else {}
        task = parse(said["task"]["text"], said["task"]["name"], **place)
        part = lambda key: {k[len(key) + 1 :]: x for k, x in arrays.items() if k.startswith(key + ".")}
        certificate = read.get("certificate.json")
        return cls(
            task,
            tuple(_phase(task, name, part(f"phase.{name}")) for name in task.phases),
            said["status"],
            said["verdict"],
            part("variable"),
            part("multiplier"),
            arrays["history"],
            said["timing"],
            said["info"],
            None if certificate is None else Certificate.from_json(certificate.decode()),
        )


def _read(folder, said) -> dict[str, bytes]:
    """What is in the files that plan.json names, each with the hash that it names."""
    version = said.get("version") if isinstance(said, dict) else None
    if version != FORMAT:
        raise PlanError(f"plan.json has the version {version!r}; this sdyn reads {FORMAT}")
    out = {}
    for name, digest in said["files"].items():
        path = folder / name
        if name in NEEDED or path.is_file():  # a figure may be thrown away, but not be another plan's
            out[name] = path.read_bytes()
            if hashlib.sha256(out[name]).hexdigest() != digest:
                raise PlanError(
                    f"{name} is not the one that plan.json names: saving was interrupted, or it was changed"
                )
    return out


def _settle(folder):
    """Move what a save left in `.new` to its place, plan.json last; the same after any number of kills."""
    new = folder / NEW
    if not new.is_dir():
        return
    named = _named(new)
    for name in sorted(named):
        if (new / name).exists():
            os.replace(new / name, folder / name)
    if named:
        for name in _named(folder) - named:
            (folder / name).unlink(missing_ok=True)
        os.replace(new / "plan.json", folder / "plan.json")
    os.rmdir(new)


def _named(folder) -> set[str]:
    """Names of the files of the plan in a folder, if there is one."""
    try:
        names = json.loads((folder / "plan.json").read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError):
        return set()
    return {name for name in names if Path(name).name == name}


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
    passive = (task.body, arrays["target_q"], arrays["target_v"]) if "target_q" in arrays else None
    robot = task.compound if name == "stabilise" else task.chaser
    return PhaseResult(name, robot, *(arrays[k] for k in ("times", "q", "v", "tau")), passive)
