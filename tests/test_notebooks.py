"""Every notebook runs from top to bottom and prints what is kept in it, numbers of rounding size aside."""

import os
import pathlib
import re

import nbformat
import pytest
from nbclient import NotebookClient

QUICKLY = {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"}  # to compile
NOTEBOOKS = sorted((pathlib.Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
SLOW = {"05_identification"}  # two minutes to compile


def printed(notebook):
    cells = (cell for cell in notebook.cells if cell.cell_type == "code")
    outputs = (output for cell in cells for output in cell.outputs if output.get("name") == "stdout")
    text = "".join(output["text"] for output in outputs)
    return re.sub(r"\d\.?\d*e-1\d", "tiny", text)


def marked(path):
    return pytest.param(path, id=path.stem, marks=[pytest.mark.slow] * (path.stem in SLOW))


@pytest.mark.parametrize("path", list(map(marked, NOTEBOOKS)))
def test_notebook_runs_and_prints_what_it_shows(path):
    kept = nbformat.read(path, as_version=4)
    fresh = nbformat.read(path, as_version=4)
    NotebookClient(fresh, timeout=300, kernel_name="python3").execute(env=os.environ | QUICKLY)
    assert printed(fresh) == printed(kept)
