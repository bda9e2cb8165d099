"""The command line: exit codes, one-sentence errors, and a width of 80 columns."""

import json
import types
from dataclasses import replace

import numpy as np
import pytest

import planners
import sdyn
from sdyn import cli, edits
from sdyn.cli import main

TASKS = sorted(path.stem for path in planners.task.FOLDER.glob("*.toml"))


@pytest.fixture(autouse=True)
def plain(monkeypatch):
    """80 columns, no cache of compiled programs, no browser."""
    monkeypatch.setenv("SDYN_CACHE", "off")
    monkeypatch.setattr(cli.console, "_width", 80)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


def sentence(capsys) -> str:
    """The one sentence on stderr; stdout is empty."""
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ") and err.count("\n") == 1 and "Traceback" not in err
    return err


# -- usage -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("argv", [[], ["--help"], ["plan", "--help"], ["show", "--help"], ["check", "--help"]])
def test_help_fits_80_columns(argv, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert main(argv) == 0
    out = capsys.readouterr().out
    assert "usage: sdyn" in out and max(map(len, out.splitlines())) <= 80


@pytest.mark.parametrize("argv", [["shw"], ["plan"], ["plan", "grasp", "--seeds", "many"], ["bench", "x"]])
def test_wrong_usage_is_exit_code_2(argv, capsys):
    assert main(argv) == 2
    assert capsys.readouterr().out == ""


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("sdyn 0.")


# -- show --------------------------------------------------------------------------------------------------------------


def test_show_prints_structure_and_table(capsys):
    assert main(["show", "paper37"]) == 0
    out = capsys.readouterr().out
    assert "37 degrees of freedom (6 of the base, 31 of the joints)" in " ".join(out.split())
    assert "cflag" in out and "arm4_link7" in out and "frame hand1" in out
    assert max(map(len, out.splitlines())) <= 80


def test_show_before_and_after(capsys, tmp_path):
    text = "lock joint2=0.3, joint3=-1e-1; reroot hand; ground hand"
    assert main(["show", "deos7", "--edit", text, "--out", str(tmp_path / "new")]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "free base 'base'; 13 degrees of freedom" in out
    assert "grounded base 'arm7'; 5 degrees of freedom (0 of the base, 5 of the joints)" in out
    assert "locked at 0.3" in out and "locked at -0.1" in out
    assert (tmp_path / "new" / "structure.png").stat().st_size > 10_000


def test_show_puts_tables_side_by_side_where_there_is_room(capsys, monkeypatch):
    monkeypatch.setattr(cli.console, "_width", 140)
    assert main(["show", "planar3", "--edit", "reroot hand"]) == 0
    assert any(line.count("cflag") == 2 for line in capsys.readouterr().out.splitlines())


def test_show_a_file(capsys, tmp_path):
    sdyn.save(sdyn.models.load("planar3"), tmp_path / "a.json")
    assert main(["show", str(tmp_path / "a.json")]) == 0
    assert "9 degrees of freedom" in capsys.readouterr().out


# -- show a task -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TASKS)
def test_show_a_task(name, capsys, tmp_path):
    """Its phases with their durations and what they hold, at 80 columns, and a picture."""
    assert main(["show", name, "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    for phase, section in planners.load(name).phases.items():
        assert phase in out and f"{section.duration[1]:g} s" in out
    for words in ("degrees of freedom (base 6", "holds", "torque at most", "duration", "phases.png"):
        assert words in out
    assert max(map(len, out[: out.index("The picture")].splitlines())) <= 80
    assert (tmp_path / "phases.png").stat().st_size > 10_000


def test_show_says_what_a_grasp_changes(capsys, tmp_path):
    assert main(["show", "grasp", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    before, after = out.split("stabilise")
    assert before.count("apart") == 3 and "8 links" in before and "change" not in before
    assert "apart" not in after and "9 links" in after and "'hand' takes 'target_grasp'" in after


def test_show_a_task_file(capsys, tmp_path, monkeypatch):
    """The picture goes where the plan would go."""
    (tmp_path / "mine.toml").write_text((planners.task.FOLDER / "reach.toml").read_text())
    monkeypatch.chdir(tmp_path)
    assert main(["show", "mine.toml"]) == 0
    assert "mine: reach in 1 phase, 10 s" in capsys.readouterr().out
    assert (tmp_path / "out" / "mine" / "phases.png").is_file()


def test_robots_and_tasks_have_different_names():
    """So that `show NAME` is clear."""
    assert not set(TASKS) & set(sdyn.models.names())


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["show", "grsap"], ["'grsap'", "grasp", "deos7"]),
        (["show", "missing.toml"], ["missing.toml"]),
        (["show", "grasp", "--edit", "lock joint1=0"], ["edits are of robots", "grasp"]),
    ],
)
def test_what_cannot_be_shown_is_one_sentence(argv, words, capsys):
    assert main(argv) == 1
    error = sentence(capsys)
    assert all(word in error for word in words)


# -- edits -------------------------------------------------------------------------------------------------------------


def load(name):
    return sdyn.models.load(name)


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("lock joint1=0.5", lambda r: r.lock({"joint1": 0.5})),
        ("lock joint1 = .5 joint2=(1)", lambda r: r.lock({"joint1": 0.5, "joint2": 1})),
        ("lock joint1=1; unlock joint1", lambda r: r),
        ("lock joint1=1,joint2=2;unlock;", lambda r: r),
        ("reroot arm3", lambda r: r.reroot("arm3")),
        ("reroot hand; ground hand", lambda r: r.reroot("arm7").ground("hand")),
        ("ground base; release", lambda r: r),
        ("close hand ground point", lambda r: r.close("hand", "ground", "point")),
        ("close hand ground; open hand_ground", lambda r: r),
        ("attach sat50 hand grasp", lambda r: r.attach(load("sat50"), "hand", "grasp")),
        ("attach deos7 hand hand t_", lambda r: r.attach(load("deos7").prefixed("t_"), "hand", "t_hand")),
        ("detach joint4", lambda r: r.detach("joint4")[0]),
    ],
)
def test_edits_in_words_are_edits(text, same):
    robot = load("deos7")
    assert edits.edited(robot, text, load)[0] == same(robot)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("lock joint9=1", ["edit 1 of 1", "'lock joint9=1'", "'joint9'", "did you mean 'joint"]),
        ("unlock joint1", ["'joint1' is not locked"]),
        ("release", ["free already"]),
        ("lock joint1=1; lock joint2", ["edit 2 of 2", "lock JOINT=VALUE"]),
        ("lock joint1=much", ["'much'"]),
        ("lock joint1=nan", ["'nan'"]),
        ("lock joint1=1 joint2", ["lock JOINT=VALUE"]),
        ("reroot hnad", ["'hnad'", "'hand'"]),
        ("reroot", ["reroot LINK"]),
        ("ground hand", ["reroot"]),
        ("lokc joint1=1", ["did you mean 'lock'"]),
        ("attach sat51 hand grasp", ["'sat51'", "'sat50'"]),
        ("attach deos7 hand hand", ["both have links named", "attach deos7 hand hand t_"]),
        ("attach sat50 hand", ["attach MODEL FRAME OTHER_FRAME"]),
        ("close hand ground glue", ["'glue'"]),
        ("open it", ["'it'"]),
        ("detach joint44", ["'joint4'"]),
    ],
)
def test_edits_that_cannot_be(text, words, capsys):
    assert main(["show", "deos7", "--edit", text]) == 1
    error = sentence(capsys)
    for word in words:
        assert word in error


def test_detach_says_what_went(capsys):
    assert main(["show", "deos7", "--edit", "detach joint4"]) == 0
    assert "detached: 4 links with base 'arm4', 9 degrees of freedom" in capsys.readouterr().out


# -- robots that are not there, or are not robots ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("deos8", None, "did you mean 'deos7'"),
        ("missing.json", None, "missing.json"),
        ("broken.json", "{", "broken.json"),
        ("broken.urdf", "<robot", "broken.urdf"),
        ("wrong.json", "[1]", "wrong.json"),
        ("robot.txt", "hello", "robot.txt"),
    ],
)
@pytest.mark.parametrize("command", ["show", "check"])
def test_bad_robots_are_one_sentence(command, name, content, word, tmp_path, capsys):
    path = tmp_path / name
    if content is not None:
        path.write_text(content)
    assert main([command, str(path) if "." in name else name]) == 1
    assert word in sentence(capsys)


# -- check -------------------------------------------------------------------------------------------------------------


def test_check_is_silent_about_a_sound_robot(capsys):
    assert main(["check", "deos7"]) == 0
    assert "Nothing is wrong" in capsys.readouterr().out


def test_check_says_what_was_repaired_in_a_shipped_model(capsys):
    assert main(["check", "ets7"]) == 0
    assert "Repaired: the published principal moments" in " ".join(capsys.readouterr().out.split())


def test_check_names_an_impossible_inertia_and_its_repair(tmp_path, capsys):
    robot = load("planar3")
    bad = replace(robot.links[1], inertia=np.diag([1.0, 1.0, 5.0]), allow_unphysical=True)
    sdyn.save(replace(robot, links=(robot.links[0], bad, *robot.links[2:])), tmp_path / "bad.json")
    assert main(["check", str(tmp_path / "bad.json")]) == 1
    out = capsys.readouterr().out
    assert bad.name in out and "(2, 2, 4) kg m^2" in out and "1 to repair" in out
    assert max(map(len, out.splitlines()[1:])) <= 80


# -- plans -------------------------------------------------------------------------------------------------------------


class TaskError(ValueError):
    __module__ = "planners.task"


def fake(status="solved", error=None):
    """A stand-in for planners: what the command does with a plan, without making one."""

    def save(folder):
        folder.mkdir(parents=True)
        for name in ("plan.npz", "plan.html", "angles.png"):
            (folder / name).write_text("x")

    def plan(task, **options):
        if error:
            raise error
        verdict = f"The hand cannot reach the target ({options['accuracy']})."
        return types.SimpleNamespace(status=status, verdict=verdict, save=save)

    return types.SimpleNamespace(load=lambda name: types.SimpleNamespace(name=name), plan=plan)


def test_plan_says_the_verdict_and_where_the_files_are(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(cli, "_planners", fake)
    monkeypatch.chdir(tmp_path)
    assert main(["plan", "grasp", "--accuracy", "1e-6"]) == 0
    out = capsys.readouterr().out
    assert "reach" in out and "1e-6" in out and "out/grasp" in out and "plan.html" in out and "angles" in out


@pytest.mark.parametrize("status", ["infeasible", "not converged"])
def test_an_unsolved_plan_leaves_no_files(status, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(cli, "_planners", lambda: fake(status))
    assert main(["plan", "grasp", "--out", str(tmp_path / "new")]) == 1
    assert "cannot reach" in sentence(capsys)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("error", "code"), [(TaskError("no such key."), 1), (KeyboardInterrupt(), 130)])
def test_errors_and_interrupts_have_their_codes(error, code, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(cli, "_planners", lambda: fake(error=error))
    assert main(["plan", "grasp", "--out", str(tmp_path / "new")]) == code
    sentence(capsys)
    assert not list(tmp_path.iterdir())


def test_faults_of_the_program_are_not_hidden(monkeypatch):
    monkeypatch.setattr(cli, "_planners", lambda: fake(error=ValueError("a bug")))
    with pytest.raises(ValueError, match="a bug"):
        main(["plan", "grasp"])


def test_plan_refuses_a_file_as_its_folder(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(cli, "_planners", fake)
    (tmp_path / "a").write_text("mine")
    assert main(["plan", "grasp", "--out", str(tmp_path / "a")]) == 1
    assert "--out" in sentence(capsys) and (tmp_path / "a").read_text() == "mine"


@pytest.mark.parametrize("task", ["grsap", "missing.toml"])
def test_plan_of_an_unknown_task(task, capsys):
    assert main(["plan", task]) == 1
    assert task in sentence(capsys)


def test_view_and_check_of_a_folder_without_a_plan(tmp_path, capsys):
    assert main(["view", str(tmp_path / "nothing")]) == 1
    assert "holds no plan" in sentence(capsys)
    assert main(["check", str(tmp_path)]) == 1
    assert "holds no plan" in sentence(capsys)


@pytest.mark.parametrize(("npz", "json"), [(b"no zip", "{}"), (b"", "{"), (b"", None)])
def test_a_broken_plan_is_one_sentence(npz, json, tmp_path, capsys):
    (tmp_path / "plan.npz").write_bytes(npz)
    if json is not None:
        (tmp_path / "plan.json").write_text(json)
    assert main(["check", str(tmp_path)]) == 1
    assert "cannot be read" in sentence(capsys)


def test_view_prints_the_page(tmp_path, capsys):
    (tmp_path / "plan.html").write_text("<html></html>")
    assert main(["view", str(tmp_path)]) == 0
    assert str(tmp_path / "plan.html") in capsys.readouterr().out


def test_json_is_not_touched_by_show(tmp_path):
    sdyn.save(load("sat50"), tmp_path / "a.json")
    before = (tmp_path / "a.json").read_bytes()
    assert main(["show", str(tmp_path / "a.json")]) == 0
    assert (tmp_path / "a.json").read_bytes() == before and json.loads(before)
