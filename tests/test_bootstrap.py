"""`./run --find-python` finds a Python that is new enough wherever it lies, with stand-ins for the interpreters."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

RUN = Path(__file__).parents[1] / "run"
ELSEWHERE = [
    "usr/local/bin",
    "opt/homebrew/bin",
    "opt/*conda*/bin",
    "Library/Frameworks/Python.framework/Versions/*/bin",
]
NEW = f'#!/bin/sh\nexec "{sys.executable}" "$@"\n'
OLD = "#!/bin/sh\nexit 1\n"  # too old, or a shim that refuses to run: both end with an error

pytestmark = pytest.mark.skipif(os.name == "nt", reason="the script is for a POSIX shell")


def put(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)


@pytest.fixture
def machine(tmp_path):
    """A machine without Python: a PATH with the few tools that the script needs, and an account without a name."""
    for tool in ["cat", "dirname", "mkdir"]:
        (tmp_path / "tools").mkdir(exist_ok=True)
        (tmp_path / "tools" / tool).symlink_to(shutil.which(tool))
    put(tmp_path / "tools" / "id", OLD)
    (tmp_path / "my home").mkdir()
    (tmp_path / "bin").mkdir()
    return tmp_path


def find(machine: Path, *, path: tuple[str, ...] = ("bin",), **environment: str) -> subprocess.CompletedProcess:
    path = ":".join(str(machine / folder) for folder in (*path, "tools"))
    environment = {"PATH": path, "HOME": str(machine / "my home")} | environment
    return subprocess.run(
        [shutil.which("sh"), str(RUN), "--find-python"],
        env={name: value for name, value in environment.items() if value},
        cwd=machine,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.mark.parametrize(
    "place",
    [
        "bin/python3",
        "bin/python3.13",
        "bin/python3.12",
        "bin/python",
        "my home/.pyenv/versions/3.12.1/bin/python3",
        "my home/.local/share/uv/python/cpython-3.14.0-linux-x86_64-gnu/bin/python3",
        "my home/miniconda3/bin/python3.13",
    ],
)
def test_finds_python(machine, place):
    put(machine / place, NEW)
    if place != "bin/python3":
        put(machine / "bin/python3", OLD)
    done = find(machine)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, sys.executable, "")


def test_looks_behind_the_shims_of_pyenv(machine):
    for name in ["python3", "python3.13"]:
        put(machine / "pyenv/shims" / name, OLD)
    put(machine / "pyenv/versions/3.11.7/bin/python3", OLD)
    put(machine / "pyenv/versions/3.13.0/bin/python3", NEW)
    assert find(machine, path=("pyenv/shims",)).stdout.strip() == sys.executable


@pytest.mark.parametrize("variable", ["UV_PYTHON", "PYENV_ROOT", "UV_PYTHON_INSTALL_DIR"])
def test_variables_name_other_places(machine, variable):
    places = {"UV_PYTHON": "", "PYENV_ROOT": "versions/3.13.0", "UV_PYTHON_INSTALL_DIR": "cpython-3.13.0-linux"}
    python = machine / "elsewhere" / places[variable] / "bin/python3"
    put(python, NEW)
    value = python if variable == "UV_PYTHON" else machine / "elsewhere"
    assert find(machine, **{variable: str(value)}).stdout.strip() == sys.executable


def test_home_may_be_unset(machine):
    put(machine / "bin/python3.13", NEW)
    assert find(machine, HOME="").stdout.strip() == sys.executable


@pytest.mark.skipif(
    any(list(Path("/").glob(f"{folder}/python3.1[234]")) for folder in ELSEWHERE),
    reason="this machine has one where the script always looks",
)
def test_says_in_one_sentence_that_there_is_none(machine):
    put(machine / "bin/python3", OLD)
    done = find(machine)
    assert done.returncode == 1
    assert not done.stdout
    assert done.stderr.startswith("run: no Python 3.12 to 3.14 was found: install one")
    assert done.stderr.count("\n") == 1
