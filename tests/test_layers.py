"""The order of the files, and that importing changes nothing and costs little."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import sdyn

ROOT = Path(__file__).parents[1]
# A file may import from files of the rows above it, and from files before it in its own row.
HOST = [
    ["checks", "tree", "table", "schedule", "heaviest"],
    ["parts"],
    ["posture"],
    ["robot"],
    ["json_format", "urdf", "doctor", "drawing", "edits", "rigid", "convert"],
    ["files"],
    ["models"],
]
DEVICE = [
    ["chain", "materialise", "workspace", "batching", "semidefinite"],
    ["merge", "spatial", "rotation", "trigonometry"],
    ["pack", "sweep", "inputs", "coordinates"],
    ["rnea", "rnea_motion", "rnea_tangent", "rnea_adjoint", "rnea_derivatives", "rnea_jacobian", "crba", "aba"],
    ["closure_rows", "closure_motion", "delassus"],
    ["kinematics", "rebase"],
    ["dynamics", "jacobians", "closures", "partition", "constraints", "drift"],
    ["conditioning", "momentum", "params", "floating", "actuators"],
    ["transition", "accuracy", "rosenbrock", "variational", "adaptive", "integrate", "march", "choose"],
    ["rollout", "diagnose"],
]
LAST = [["reduce"], ["__init__"], ["compiled"], ["cli"], ["__main__"]]
ORDER = [name for rows in (HOST, DEVICE, LAST) for row in rows for name in row]
FREE_OF_JAX = [name for row in HOST for name in row] + ["merge"]


def path_of(name) -> Path:
    folder = ROOT / "sdyn" / name
    return folder / "__init__.py" if folder.is_dir() else ROOT / "sdyn" / f"{name}.py"


def imported(path, package="sdyn") -> list[str]:
    """Dotted names of the modules a file imports, wherever in it."""
    out = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            out += [x.name for x in node.names]
        if isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path} imports relatively"
            known = {p.stem for p in (ROOT / package).glob("*.py")} | {
                p.name for p in (ROOT / package).iterdir() if p.is_dir()
            }
            out += [
                f"{package}.{x.name}" if node.module == package and x.name in known else node.module for x in node.names
            ]
    return out


def test_every_file_is_in_the_order():
    files = {path.stem for path in (ROOT / "sdyn").glob("*.py")} | {"models"}
    assert files == set(ORDER)
    assert len(ORDER) == len(set(ORDER))


@pytest.mark.parametrize("name", ORDER)
def test_imports_point_one_way(name):
    mine = [x.split(".")[1] for x in imported(path_of(name)) if x.startswith("sdyn.")]
    for other in mine:
        assert ORDER.index(other) < ORDER.index(name), f"{name} imports {other}, which comes after it"
    if name in [x for rows in (HOST, DEVICE) for row in rows for x in row]:
        assert "sdyn" not in imported(path_of(name)), f"{name} imports the package that imports it"
        assert not [x for x in imported(path_of(name)) if x.split(".")[0] == "planners"]


@pytest.mark.parametrize("name", FREE_OF_JAX)
def test_host_files_do_not_import_jax(name):
    assert not [x for x in imported(path_of(name)) if x.split(".")[0] in ("jax", "jaxlib", "jaxtyping")]


@pytest.mark.parametrize("path", sorted((ROOT / "planners").rglob("*.py")), ids=lambda path: path.stem)
def test_planners_use_public_names_only(path):
    public = set(dir(sdyn)) - {
        x
        for row in (*HOST, *DEVICE)
        for x in row
        if x not in ("models", "params", "integrate", "rollout", "pack", "momentum", "transfer", "reduce", "diagnose")
    }
    for name in imported(path, "planners"):
        assert name.split(".")[0] != "sdyn" or name == "sdyn", f"{path.name} imports {name}"
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "sdyn":
            assert node.attr in public and not node.attr.startswith("_"), f"{path.name} uses sdyn.{node.attr}"


STATE = """
import logging, os, sys, warnings
import jax, numpy as np
def state():
    return (
        {k: v for k, v in jax.config.values.items() if k in known}, dict(os.environ), list(warnings.filters),
        np.get_printoptions(), np.geterr(), np.random.get_state()[1].tolist(), sys.getrecursionlimit(),
        logging.root.level, list(logging.root.handlers), logging.getLogger("jax").level,
    )
known = set(jax.config.values)
before = state()
import sdyn, planners
after = state()
for a, b in zip(before, after, strict=True):
    assert a == b, (a, b)
assert "matplotlib" not in sys.modules and "casadi" not in sys.modules and "viser" not in sys.modules
assert not jax.config.jax_enable_x64
print("clean")
"""


def python(code):
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_changes_nothing():
    assert python(STATE) == "clean\n"


TIMED = """
import time
start = time.perf_counter()
import jax
middle = time.perf_counter()
import sdyn
print(middle - start, time.perf_counter() - middle)
"""


def test_importing_is_quick():
    """At most 0.3 s more than importing jax, or a fifth of that import where the machine is slow or busy."""
    times = [[float(x) for x in python(TIMED).split()] for _ in range(3)]
    alone, more = min(times, key=lambda x: x[1])
    assert more <= max(0.3, alone / 5), f"{more:.2f} s more than {alone:.2f} s"  # measured 0.23 s more than 3.4 s, busy
