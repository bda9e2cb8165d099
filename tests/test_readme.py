"""The README's Python runs and prints what it says; its table of files is complete."""

import pathlib
import re
import subprocess
import sys

import sdyn

ROOT = pathlib.Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf8")


def test_the_example_runs_and_compiles_once():
    code, _ = re.findall(r"```python\n(.*?)```", TEXT, re.S)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    assert lines[-1] == "1 compilation"
    assert [int(line.split()[0]) for line in lines[-4:-1]] == [37, 9, 9]


def test_the_reduced_robot_is_as_small_as_it_says():
    """What the second example says of sizes; it measures nothing here."""
    _, code = re.findall(r"```python\n(.*?)```", TEXT, re.S)
    names = {"sdyn": sdyn, "full": sdyn.models.load("paper37"), "print": lambda report: None}
    exec(code.replace("reduce(full, scene)", "reduce(full, scene, samples=0)"), names)
    assert names["report"].coordinates == (37, 9) and names["report"].links == (32, 4)


def test_every_file_it_names_exists():
    for folder, cells in re.findall(r"\| file in `(\w+)/` \| content \|\n\|---\|---\|\n((?:\|.*\n)+)", TEXT):
        for name in re.findall(r"`([\w./]+)`", "".join(row.split("|")[1] for row in cells.splitlines())):
            assert (ROOT / folder / name).exists(), f"{folder}/{name}"
