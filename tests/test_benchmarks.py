"""The kept results of benchmarks: the README says what they say, and the table fits a terminal."""

import json
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
KEPT = json.loads((ROOT / "benchmarks" / "results" / "speed.json").read_text())


@pytest.fixture
def report(monkeypatch):
    """The module that shows the results."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import speed_report

    yield speed_report
    for name in ("speed_report", "harness"):
        del sys.modules[name]


def test_the_table_fits_80_columns(report, capsys, monkeypatch):
    """Nothing is cut, and all that was measured is there; also where a peer is missing."""
    monkeypatch.setenv("COLUMNS", "80")
    for absent in ({}, {"JaxSim": "not installed"}):
        report.show(KEPT | {"absent": absent})
        text = capsys.readouterr().out
        table = text[text.index("How many times faster") : text.index("first calls")]
        assert max(map(len, table.splitlines())) <= 80 and "…" not in text
        for row in KEPT["ratios"]:
            assert f"{row['ratio']:.2f}" in text and row["what"].split()[0] in text
        assert ("JaxSim was left out: not installed" in text) == bool(absent)


def test_the_readme_says_what_was_measured():
    """Every row of the README's table of speed is a ratio of the kept run."""
    text = (ROOT / "README.md").read_text(encoding="utf8")
    (table,) = re.findall(r"\| what \| against \| times faster \|\n\|.*\n((?:\|.*\n)+)", text)
    rows = [tuple(cell.strip(" `") for cell in line.split("|")[1:-1]) for line in table.splitlines()]
    assert len(rows) >= 8
    short = lambda x: f"{x:.1f}" if x >= 1 else f"{x:.2f}"
    measured = {(row["what"], row["slow"]): short(row["ratio"]) for row in KEPT["ratios"]}
    assert {row[:2]: row[2] for row in rows} == {key: measured[key] for key in [row[:2] for row in rows]}
