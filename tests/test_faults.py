"""Bad input and bad luck, row by row: what is wrong is said in one sentence, and nothing is repaired in silence.

`ROWS` is the catalogue; each row names the tests that hold it, here or in another file.
"""

import ast
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from catalogue import without_a_test

import planners
import sdyn
from planners import animation, figures
from planners.task import FOLDER, parse
from sdyn import cli, compiled, files, urdf
from sdyn.checks import RobotError

ROOT = Path(__file__).parents[1]
ROWS = {
    "entity bomb": ["test_files::test_entity_bombs_are_refused",
                    "test_files::test_a_file_that_is_too_large_is_not_parsed"],
    "NaN, inf or text in URDF": ["test_files::test_broken_urdf"],
    "negative mass": ["test_files::test_wrong_json", "test_files::test_broken_urdf"],
    "impossible inertia": ["test_files::test_wrong_json", "test_files::test_unphysical_files_can_be_loaded_for_repair"],
    "non-unit axis": ["test_faults::test_directions_and_rotations_that_are_none"],
    "non-orthonormal rotation, non-unit quaternion": ["test_faults::test_directions_and_rotations_that_are_none"],
    "cycle, two roots, two parents, duplicate or missing names": [
        "test_files::test_broken_urdf", "test_files::test_a_cycle_in_urdf", "test_files::test_wrong_json",
    ],
    "wrong shape, type or size": ["test_compile::test_wrong_shapes_types_and_names"],
    "huge sizes": ["test_faults::test_huge_robots_are_refused_before_memory_is_taken"],
    "lock by a bad name": ["test_faults::test_names_that_do_not_exist", "test_cli::test_edits_that_cannot_be"],
    "NaN at run time": ["test_diagnose::test_the_first_bad_step_is_named"],
    "JSON": ["test_files::test_broken_json", "test_files::test_wrong_json"],
    "YAML": ["test_files::test_paths_that_hold_no_robot"],
    "pickle, npz": ["test_faults::test_a_plan_is_never_unpickled", "test_faults::test_nothing_reads_or_writes_pickles",
                    "test_faults::test_a_flipped_bit_in_a_plan_is_noticed"],
    "paths that leave the folder": ["test_faults::test_robot_files_stay_in_the_folder_of_the_task",
                                    "test_faults::test_meshes_are_not_read"],
    "corrupted cache": ["test_faults::test_a_corrupted_cache_of_compilations_is_remade"],
    "interrupted write": ["test_faults::test_a_write_that_is_killed_leaves_one_file",
                          "test_plan::test_a_save_that_is_killed_leaves_one_plan"],
    "resume of a batch": ["test_study::test_a_study_that_is_killed_at_every_point_of_writing",
                          "test_study::test_a_study_that_is_killed_is_resumed_bit_for_bit"],
    "disk full, read-only, interrupted": ["test_files::test_a_failed_write_leaves_the_old_file",
                                          "test_faults::test_a_plan_that_cannot_be_written"],
    "nondeterminism": ["test_faults::test_the_same_input_gives_the_same_bits"],
    "fuzz": ["test_fuzz::test_json", "test_fuzz::test_urdf", "test_fuzz::test_tasks"],
}  # fmt: skip


@pytest.mark.parametrize("row", ROWS)
def test_every_row_has_its_test(row):
    assert not without_a_test(ROWS[row])


def refused(*words):
    return pytest.raises(ValueError, match="(?s)" + "".join(f"(?=.*{word})" for word in words))


def test_directions_and_rotations_that_are_none():
    """Off by rounding is normalised; more is an error that says what was meant."""
    hinge = lambda **rest: sdyn.Joint("j", "revolute", "a", "b", **rest)
    assert np.linalg.norm(hinge(axis=(0, 0, 1 + 5e-7)).axis) == 1.0
    with refused("joint 'j'", "length 2", r"\[0.0, 0.0, 1.0\]"):
        hinge(axis=(0, 0, 2))
    with refused("joint 'j'", "zero"):
        hinge(axis=(0, 0, 0))
    with refused("joint 'j'", "rotation matrix", r"determinant \+1"):
        hinge(rotation=np.diag([1.0, 1.0, -1.0]))
    with refused("joint 'j'", "rotation matrix"):
        hinge(rotation=2 * np.eye(3))
    turned = hinge(rotation=np.eye(3) + 1e-7 * np.ones((3, 3))).rotation
    assert np.abs(turned.T @ turned - np.eye(3)).max() < 1e-15
    robot = sdyn.models.load("sat50")
    with refused("quaternion", "length 2"):
        robot.configuration(quaternion=(2, 0, 0, 0))
    with refused("ground pose|pose", "length"):
        robot.ground(robot.base, [0, 0, 0, 1, 1, 0, 0])


def test_huge_robots_are_refused_before_memory_is_taken():
    n = 20_000
    links = [sdyn.Link(f"l{k}", 1.0, inertia=np.eye(3)) for k in range(n)]
    joints = [sdyn.Joint(f"j{k}", "revolute", f"l{k}", f"l{k + 1}") for k in range(n - 1)]
    robot = sdyn.Robot(links, joints)
    with refused("19999 bodies", "3.6 GB", "2 GB are allowed", "memory=3.6e"):
        sdyn.pack(robot)
    small = sdyn.models.load("deos7")
    with refused("7 bodies", "memory="):
        sdyn.capacity([small], memory=100)
    assert sdyn.capacity([small], memory=1e4) == sdyn.capacity([small])


def test_names_that_do_not_exist():
    robot = sdyn.models.load("deos7")
    for edit in (lambda r: r.lock({"joint11": 0}), lambda r: r.unlock(["joint11"]), lambda r: r.detach("joint11")):
        with refused("'joint11'", "did you mean", "'joint1'"):
            edit(robot)
    with refused("'hant'", "'hand'"):
        robot.close("hant", "ground")
    with refused("'arm99'", "did you mean"):
        robot.reroot("arm99")


# -- files -------------------------------------------------------------------------------------------------------------


def test_nothing_reads_or_writes_pickles():
    """Not by `pickle`, nor by NumPy, which is told so each time."""
    for path in (*(ROOT / "sdyn").rglob("*.py"), *(ROOT / "planners").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = {x.name for x in node.names} | {getattr(node, "module", None)}
                assert not names & {"pickle", "cloudpickle", "dill", "shelve", "marshal"}, path
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("np.load", "np.save", "numpy.load"):
                assert "allow_pickle=False" in ast.unparse(node), f"{path}:{node.lineno}"


@pytest.fixture
def plan(monkeypatch):
    """A plan of the grasp that stands still; nothing is drawn."""
    monkeypatch.setattr(animation, "write", lambda plan, path: path.write_text("page"))
    monkeypatch.setattr(figures, "draw", lambda plan, folder: (folder / "base.png").write_text("picture"))
    task, phases = planners.load("grasp"), []
    for k, name in enumerate(task.phases):
        robot, times = (task.compound if name == "stabilise" else task.chaser), np.linspace(k, k + 1, 3)
        q, v = np.tile(robot.neutral(), (3, 1)), np.zeros((3, robot.nv))
        passive = None if name == "stabilise" else (task.body, q[:, :7], v[:, :6])
        phases.append(planners.PhaseResult(name, robot, times, q, v, 0 * v, passive))
    return planners.Plan(task, tuple(phases), "solved", "one", {"a": np.zeros(2)}, {}, np.zeros((1, 3)), {})


def test_a_flipped_bit_in_a_plan_is_noticed(plan, tmp_path):
    plan.save(tmp_path)
    data = bytearray((tmp_path / "plan.npz").read_bytes())
    for at in (10, len(data) // 2, len(data) - 10):
        wrong = data.copy()
        wrong[at] ^= 4
        (tmp_path / "plan.npz").write_bytes(wrong)
        with pytest.raises(planners.PlanError, match=r"plan.npz is not the one"):
            planners.Plan.load(tmp_path)


def test_a_plan_is_never_unpickled(plan, tmp_path, monkeypatch, capsys):
    """Not even when the hashes are right."""
    import hashlib

    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "was here"),)

    plan.save(tmp_path)
    file = io.BytesIO()
    np.savez(file, history=np.array([Evil()], object))
    (tmp_path / "plan.npz").write_bytes(file.getvalue())
    said = json.loads((tmp_path / "plan.json").read_text())
    said["files"]["plan.npz"] = hashlib.sha256(file.getvalue()).hexdigest()
    (tmp_path / "plan.json").write_text(json.dumps(said))
    assert cli.main(["check", str(tmp_path)]) == 1
    assert "cannot be read" in capsys.readouterr().err and not (tmp_path / "was here").exists()


def test_robot_files_stay_in_the_folder_of_the_task(tmp_path):
    text = (FOLDER / "grasp.toml").read_text()
    inside = tmp_path / "tasks"
    inside.mkdir()
    for path in (tmp_path / "robot.json", inside / "robot.json"):
        files.save(sdyn.models.load("deos7"), path)
    (inside / "link.json").symlink_to(tmp_path / "robot.json")
    with_model = lambda name: text.replace('model = "deos7"', f'model = "{name}"')
    assert parse(with_model("robot.json"), folder=inside).chaser.name == "deos7"
    for name in ("../robot.json", str(tmp_path / "robot.json"), "link.json", "../tasks/../robot.json"):
        with pytest.raises(planners.TaskError, match="outside of the task's folder"):
            parse(with_model(name), folder=inside)


def test_meshes_are_not_read(tmp_path):
    """What shows a link is left out, wherever it is said to be; nothing is opened."""
    mesh = '<visual><geometry><mesh filename="{}"/></geometry></visual>'
    robot = lambda name: f'<robot name="r"><link name="a">{mesh.format(name) if name else ""}</link></robot>'.encode()
    for name in ("file:///etc/passwd", "../../secret.stl", "package://other/a.stl", "http://localhost:1/a.stl"):
        assert urdf.read(robot(name)) == urdf.read(robot(None))


# -- bad luck ----------------------------------------------------------------------------------------------------------


class Killed(BaseException):
    """Ends the process, in the tests only the call."""


@pytest.mark.parametrize("call", ["mkstemp", "fdopen", "fsync", "chmod", "replace"])
def test_a_write_that_is_killed_leaves_one_file(call, tmp_path, monkeypatch):
    """Before and after every call that touches the disk; a stray temporary file may stay, hidden, and hurts nobody."""
    path = tmp_path / "robot.json"
    old, new = sdyn.models.load("sat50"), sdyn.models.load("deos7")
    module = files.tempfile if call == "mkstemp" else os
    for after in (False, True):
        files.save(old, path)
        real = getattr(module, call)

        def fatal(*args, real=real, after=after, **rest):
            if after:
                real(*args, **rest)
            raise Killed

        with monkeypatch.context() as patch:
            patch.setattr(module, call, fatal)
            patch.setattr(Path, "unlink", lambda *_, **__: None)  # a process that is killed cleans nothing up
            with pytest.raises(Killed):
                files.save(new, path)
        assert files.load(path) == (new if (call, after) == ("replace", True) else old)
        files.save(new, path)
        assert files.load(path) == new


def test_a_plan_that_cannot_be_written(plan, tmp_path, monkeypatch):
    plan.save(tmp_path / "good")
    before = {path.name: path.read_bytes() for path in (tmp_path / "good").iterdir()}

    def full(*args, **rest):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", full)
        with pytest.raises(OSError, match="No space"):
            plan.save(tmp_path / "good")
    assert {path.name: path.read_bytes() for path in (tmp_path / "good").iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["good"]  # nothing is left beside it


CACHE = """
import sys, pathlib, jax, jax.numpy as jnp, numpy as np
import sdyn
from sdyn import compiled
changed = compiled.keep_in(pathlib.Path(sys.argv[1]))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.05)
x = jax.jit(sdyn.mass_matrix)(sdyn.pack(sdyn.models.load("planar3")), jnp.arange(10.0) / 7)
print(len(changed), np.asarray(x).tobytes().hex())
"""


def test_a_corrupted_cache_of_compilations_is_remade(tmp_path):
    """One bit that flips gives other numbers or a crash in JAX itself; here it is noticed, and compiled again."""

    def answer():
        command = [sys.executable, "-c", CACHE, str(tmp_path)]
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=300, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout.split()

    first = answer()
    (path,) = tmp_path.glob("*mass_matrix*-cache")
    data = bytearray(path.read_bytes())
    data[len(data) * 2 // 3] ^= 4
    path.write_bytes(data)
    assert answer() == ["1", first[1]]
    (tmp_path / compiled.SUMS).write_text("{ cut off")  # nothing is trusted then
    assert answer() == ["0", first[1]] == first and path.name in json.loads((tmp_path / compiled.SUMS).read_text())


def test_the_same_input_gives_the_same_bits():
    chain = sdyn.pack(sdyn.models.load("planar3"), dtype="float32")
    again = sdyn.pack(sdyn.models.load("planar3"), dtype="float32")
    for x, y in zip(*(vars(c).values() for c in (chain, again)), strict=True):
        assert x is y or x == y if isinstance(x, sdyn.Capacity) else np.asarray(x).tobytes() == np.asarray(y).tobytes()
    assert planners.load("grasp").sha256 == planners.load("grasp").sha256


def test_numbers_beyond_what_products_can_hold():
    for field, value in {"mass": 1e31, "com": (0, 0, 1e40), "inertia": 1e35 * np.eye(3)}.items():
        with refused("link 'a'", "beyond 1e\\+30", "unit"):
            sdyn.Link("a", **{"mass": 1.0, field: value})
    with refused("link 'a'", "below 1e-30"):
        sdyn.Link("a", 1e-310)
    with refused("joint 'j'", "beyond"):
        sdyn.Joint("j", "revolute", "a", "b", position=(1e200, 0, 0))
    far = sdyn.Robot([sdyn.Link("a", 1e30, (0, 1e20, 0), 1e30 * np.eye(3))])
    with pytest.raises(RobotError, match=r"beyond float32|no defined|without bound"):
        sdyn.pack(far, dtype="float32")
