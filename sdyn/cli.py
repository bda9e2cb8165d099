"""The command line: `sdyn plan | show | check | view | bench`, also as `python -m sdyn`.

Commands compute in float64. Compiled programs are kept in the user's cache folder, so that the same command starts
faster next time; SDYN_CACHE names another folder, SDYN_CACHE=off keeps nothing.
Exit codes: 0 done, 1 not possible or something is wrong (one sentence on stderr), 2 usage, 130 interrupted.
"""

import os
import sys
import zipfile
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from sdyn import compiled, drawing, edits, models
from sdyn.checks import RobotError
from sdyn.files import FORMATS, load

arg = tyro.conf.arg
TaskWord = Annotated[str, tyro.conf.Positional, arg(metavar="TASK")]
RobotOrTask = Annotated[str, tyro.conf.Positional, arg(metavar="ROBOT|TASK")]
RobotOrPlan = Annotated[str, tyro.conf.Positional, arg(metavar="ROBOT|PLAN")]
PlanWord = Annotated[Path, tyro.conf.Positional, arg(metavar="PLAN")]
Folder = Annotated[Path | None, arg(metavar="DIR")]
Benchmark = Annotated[Literal["speed", "accuracy", "structure"], tyro.conf.Positional]


console = Console(highlight=False, soft_wrap=False)


class Failure(ValueError):
    """What a command could not do, in one sentence."""


def main(argv: list[str] | None = None) -> int:
    """Run a command.

    Args:
        argv: The words after `sdyn`; those of the process if left out.

    Returns:
        The exit code.
    """
    argv = sys.argv[1:] if argv is None else list(argv)
    if argv == ["--version"]:
        _say(f"sdyn {version('sdyn')}")
        return 0
    commands = {"plan": plan, "show": show, "check": check, "view": view, "bench": bench}
    about = "Dynamics and motion planning for robots whose structure changes while they work.\n"
    about += "`sdyn plan grasp` plans, certifies and animates the grasp of a tumbling target."
    try:
        return tyro.extras.subcommand_cli_from_dict(
            commands, prog="sdyn", description=about, args=argv or ["--help"], sort_subcommands=False
        )
    except SystemExit as usage:
        return int(usage.code or 0)
    except KeyboardInterrupt:
        return _fail("interrupted; nothing was written.", 130)
    except OSError as error:
        return _fail(f"{error.filename}: {error.strerror}." if error.filename else error)
    except ValueError as error:
        if not type(error).__module__.startswith(("sdyn", "planners")):
            raise  # a fault of the program, not of its input
        return _fail(error)


# -- commands ----------------------------------------------------------------------------------------------------------


def plan(
    task: TaskWord,
    out: Folder = None,
    solver: Annotated[str, arg(metavar="NAME")] = "sqp",
    seeds: int = 1,
    accuracy: Annotated[str, arg(metavar="fast|balanced|accurate|reference|ERROR")] = "balanced",
    after: Folder = None,
) -> int:
    """Plan a task, certify the result, and write it with figures and an animation.

    Args:
        task: A shipped task (grasp, grasp_planar, grasp_clear, identify, identify_load, reach, detumble), or .toml.
        out: Folder for the results; out/TASK if left out. Earlier results in it are replaced.
        solver: sqp; casadi for a second opinion: the task stated again in CasADi and solved by IPOPT; or riccati:
            multiple shooting with forward dynamics, for a reach.
        seeds: How many starting points to try; the worst are dropped early, the best certified result is kept.
        accuracy: How fine the solver's grid is: fast (half of the task's intervals), balanced, accurate (twice) or
            reference (four times); or a wanted error such as 1e-6, for the first of these that delivers it.
        after: Folder of the plan of a grasp, at whose end a detumbling starts.
    """
    planners = _planners()
    wanted = planners.load(task)
    if after is not None:
        wanted = planners.after(_plan_in(after), wanted)
    folder = out or Path("out") / wanted.name
    if folder.exists() and not folder.is_dir():
        raise Failure(f"{folder} is a file; name a folder with --out.")
    found = planners.plan(wanted, solver=solver, seeds=seeds, accuracy=accuracy, progress=True)
    if found.status != "solved":
        raise Failure(f"{wanted.name} is {found.status}: {found.verdict} Nothing was written.")
    found.save(folder)
    _say(found.verdict)
    _files(folder)
    return 0


def show(what: RobotOrTask, edit: Annotated[str, arg(metavar="EDITS")] = "", out: Folder = None) -> int:
    """Show a robot, before and after edits, or the phases of a task.

    Args:
        what: A shipped model or task, or the path of a .json, .urdf or .toml file.
        edit: Edits of a robot, as in "lock joint1=0.3; reroot hand; ground hand". Also: unlock, release, close, open,
            attach, detach.
        out: Folder for a picture: structure.png of a robot, phases.png of a task; out/TASK if left out for a task.
    """
    if Path(what).suffix == ".toml" or what in _tasks():
        if edit.strip():
            raise Failure(f"edits are of robots, and {what} is a task; change its file.")
        return _show_task(what, out)
    try:
        before = _robot(what)
    except Failure as error:
        raise Failure(f"{error} Or name a task: {', '.join(_tasks())}.") from None
    robots = {"before": before}
    if edit.strip():
        robots["after"], remarks = edits.edited(before, edit, _robot)
    else:
        robots, remarks = {before.name: before}, ()
    views = [_view(caption, shown) for caption, shown in robots.items()]
    needed = max(console.measure(part).maximum for view in views for part in view[1:])
    if len(views) * (needed + 4) <= console.width:  # side by side
        grid = Table.grid(padding=(0, 4), expand=True)
        for _ in views:
            grid.add_column(ratio=1)
        grid.add_row(*(Group(*view) for view in views))
        console.print(grid)
    else:
        console.print(Group(*(part for view in views for part in view)))
    for remark in remarks:
        _say(remark)
    if out:
        out.mkdir(parents=True, exist_ok=True)
        drawing.save_picture(out / "structure.png", robots)
        _say(f"The picture is {out / 'structure.png'}.")
    return 0


def check(what: RobotOrPlan) -> int:
    """Say what is wrong with a robot and what repairs it, or certify a plan again.

    Args:
        what: A shipped model, the path of a .json or .urdf file, or the folder of a plan.
    """
    if Path(what).is_dir():
        return _check_plan(Path(what))
    from sdyn import doctor

    robot = _robot(what, allow_unphysical=True)
    _say(drawing.summary(robot))
    if robot.source:
        console.print(Text(" ".join(robot.source.split()), style="dim"))
    findings = doctor.examine(robot)
    if not findings:
        _say("Nothing is wrong with it.")
        return 0
    table = Table("level", "part", "what is wrong", "repair", header_style="bold", show_lines=True)
    for finding in findings:
        style = {"error": "red", "warning": "yellow"}.get(finding.level, "")
        cells = (finding.level, finding.part, finding.wrong, finding.repair)
        table.add_row(*map(Text, cells), style=style)
    console.print(table)
    bad = sum(finding.level != "note" for finding in findings)
    _say(f"{bad} to repair, {len(findings) - bad} to note.")
    return 1 if bad else 0


def view(folder: PlanWord) -> int:
    """Open the animation of a plan in the browser, and print its path.

    Args:
        folder: The folder of a plan, such as out/grasp.
    """
    page = folder / "plan.html"
    if not page.is_file():
        _plan_in(folder).save(folder)
    _say(str(page.resolve()))
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform in ("darwin", "win32"):
        import webbrowser

        webbrowser.open(page.resolve().as_uri())
    return 0


def bench(what: Benchmark = "speed") -> int:
    """Run a benchmark of this checkout.

    Args:
        what: Which benchmark.
    """
    script = Path(__file__).parents[1] / "benchmarks" / f"{what}.py"
    if not script.is_file():
        raise Failure(f"there is no {script}; benchmarks come with the repository, not with the installed package.")
    import subprocess

    return subprocess.run([sys.executable, str(script)], check=False).returncode


# -- their parts -------------------------------------------------------------------------------------------------------


def _robot(name: str, **options):
    """A shipped model by its name, or the robot in a file."""
    if Path(name).suffix.lower() in FORMATS:
        return load(name, **options)
    if Path(name).exists() or os.sep in name:
        raise Failure(f"{name} is no robot file; robot files end in {' or '.join(FORMATS)}.")
    try:
        return models.load(name)
    except RobotError as error:
        raise Failure(f"{error} Or give the path of a {' or '.join(FORMATS)} file.") from None


def _tasks() -> list[str]:
    """The names of the shipped tasks; without loading the planners."""
    return sorted(path.stem for path in (Path(find_spec("planners").origin).parent / "tasks").glob("*.toml"))


def _show_task(name, out) -> int:
    planners = _planners()
    task = planners.load(name)
    said = planners.outline(task)
    stages = said.phases
    least, most = (sum(stage.duration[k] for stage in stages) for k in (0, 1))
    lasts = f"{least:g} s" if least == most else f"{least:g} to {most:g} s"
    _say(f"{task.name}: {task.kind} in {len(stages)} phase{'s' * (len(stages) > 1)}, {lasts}")
    table = Table.grid(padding=(0, 2))
    for stage in stages:
        low, high = stage.duration
        heading = Text(stage.name, "bold"), Text(f"{low:g} s" if low == high else f"{low:g} to {high:g} s", "cyan")
        table.add_row(*heading, Text(_in_short(stage.robot)))
        more = {"apart": stage.apart and _in_short(stage.apart), "change": stage.change, "base": stage.base}
        for title, text in (more | {"decided": stage.decided, "holds": "\n".join(stage.holds)}).items():
            if text:
                table.add_row("", Text(title, "dim"), Text(text))
    table.add_row(Text("always", "bold"), Text("holds", "dim"), Text("\n".join(said.limits)))
    table.add_row(Text("cost", "bold"), Text("sum of", "dim"), Text("\n".join(said.cost)))
    console.print(table)
    folder = out or Path("out") / task.name
    folder.mkdir(parents=True, exist_ok=True)
    robots = lambda stage: (stage.robot, *([stage.apart] if stage.apart else []))
    parts = (drawing.Stage(stage.name, stage.duration, robots(stage), stage.change) for stage in stages)
    drawing.save_stages(folder / "phases.png", tuple(parts))
    _say(f"The picture is {folder / 'phases.png'}.")
    return 0


def _in_short(robot) -> str:
    """Name, size and degrees of freedom."""
    links, moving = len(robot.links), sum(joint.dof for joint in robot.moving)
    size = f"{links} link{'s' * (links > 1)}; {robot.nv} degrees of freedom"
    return f"{robot.name}: {size} (base {robot.nv - moving}, joints {moving})"


def _view(caption, robot) -> list:
    """Degrees of freedom, structure and connectivity table of a robot."""
    table = Table(box=None)
    rows = robot.table()
    for title in ("link", "parent", "end-effector", "connect", "cflag", "name"):
        table.add_column(title, justify="left" if title == "name" else "right")
    for row, name in zip(rows, rows.names, strict=True):
        table.add_row(*map(str, row), Text(name))
    heading = Text(f"{caption}: {drawing.summary(robot)}" if caption != robot.name else drawing.summary(robot), "bold")
    return [heading, "", drawing.tree(robot), "", table if rows else Text("no joints, no connectivity table"), ""]


def _planners():
    """The planners, in float64 and with a cache of compiled programs."""
    import jax

    jax.config.update("jax_enable_x64", True)
    folder = os.environ.get("SDYN_CACHE") or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sdyn"
    if str(folder) != "off" and (changed := compiled.keep_in(Path(folder))):
        _say(f"{len(changed)} compiled programs in {folder} were damaged and are made again.", _errors())
    import planners

    return planners


def _plan_in(folder: Path):
    if not any((folder / name / "plan.npz").is_file() for name in ("", ".new")):
        raise Failure(f"{folder} holds no plan (plan.npz); make one with: sdyn plan TASK --out {folder}")
    planners = _planners()
    try:
        return planners.Plan.load(folder)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise Failure(f"the plan in {folder} cannot be read ({error}); make it again with: sdyn plan TASK") from None


def _check_plan(folder) -> int:
    found = _plan_in(folder)
    certificate = _planners().certify(found.task, found)
    _say(str(certificate))
    return 0 if certificate.passed else 1


def _files(folder):
    """Where the results are."""
    table = Table.grid(padding=(0, 2))
    for name, meaning in FILES.items():
        if (folder / name).exists():
            table.add_row(Text(f"  {name}"), Text(meaning, style="dim"))
    figures = sorted(path.stem for path in folder.glob("*.png"))
    table.add_row(Text("  *.png"), Text("figures: " + ", ".join(figures), style="dim"))
    _say(f"The results are in {folder}:")
    console.print(table)


FILES = {
    "plan.html": "the motion, to watch in a browser",
    "plan.npz": "the motion, as arrays",
    "plan.json": "inputs, versions, hashes, seeds",
    "certificate.json": "what was checked, and how well it holds",
}


def _say(text, to: Console = console):
    """One paragraph, wrapped on a terminal; whole lines for programs."""
    to.print(Text(str(text)), soft_wrap=not to.is_terminal)


def _fail(text, code: int = 1) -> int:
    _say(f"error: {text}", _errors())
    return code


def _errors() -> Console:
    return Console(stderr=True, highlight=False)
