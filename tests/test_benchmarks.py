"""The kept results of benchmarks: the README says what they say, and the tables fit a terminal."""

import json
import re
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
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


# -- reduced robots ----------------------------------------------------------------------------------------------------


def test_what_leaving_out_saves():
    """Within 10 % of a robot built small by hand; Jacobians 5 times faster, accelerations in proportion to the bodies,
    of which the whole robot has 31 and the others 3 and 7; errors of rounding."""
    result = json.loads((ROOT / "benchmarks" / "results" / "reduce.json").read_text())
    ratios = {(x["what"].partition(",")[0], x["case"]): x for x in result["rows"]}  # of the largest batch
    for case, joints in (("37 to 9", 3), ("37 to 13", 7)):
        assert abs(ratios["accelerations", case]["over_by_hand"] - 1) <= 0.1
        assert ratios["accelerations", case]["ratio"] >= min(5, 0.9 * 31 / joints)
        assert ratios["Jacobians", case]["ratio"] >= 5
        assert result["error"][case] <= 1e-11


# -- conventions of other libraries ------------------------------------------------------------------------------------


def test_the_peers_read_states_as_they_are_meant():
    """Of the kept run: poses, accelerations and torques of every kind of joint, free and grounded."""
    result = json.loads((ROOT / "benchmarks" / "results" / "conventions.json").read_text())
    cases = [result[f"{peer}, {base}"] for peer in ("Pinocchio", "MuJoCo") for base in ("free", "grounded")]
    for case in cases:
        assert len(case) == 3 and max(case.values()) <= 1e-12


# -- accuracy ----------------------------------------------------------------------------------------------------------

ACCURACY = json.loads((ROOT / "benchmarks" / "results" / "accuracy.json").read_text())


def points(scene, contender, error=float("inf")):
    return [x for x in ACCURACY["scenes"][scene]["points"] if x["contender"] == contender and x["error"] <= error]


def test_the_tables_of_accuracy_fit_80_columns(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import accuracy_report

    accuracy_report.show(ACCURACY)
    lines = capsys.readouterr().out.split("Cheapest way")[1].splitlines()
    assert max(map(len, lines)) <= 80 and not any("…" in line for line in lines)
    for name in ("accuracy_report", "harness"):
        del sys.modules[name]


def test_the_chart_says_what_is_claimed():
    """Of the kept run: the reference on Andrews, orders along the ladders, a wanted error met at a fair price."""
    assert ACCURACY["chosen"]["Andrews"]["errors"]["reference"] <= 1e-11
    orders = {"RK4": 4, "semi-implicit": 1, "variational": 2, "implicit": 4}
    for contender, order in orders.items():
        ladder = [x for x in points("free flyer, 13 DOF", contender, 1e-2) if x["error"] > 1e-10]
        steepest = max(np.log2(a["error"] / b["error"]) for a, b in pairwise(ladder))
        assert abs(steepest - order) < 0.2, (contender, steepest)
    assert len(ACCURACY["chosen"]) == 5
    for scene, x in ACCURACY["chosen"].items():
        assert x["error"] <= 1e-6 and x["ratio"] <= 1.5, (scene, x)


def test_points_on_the_front_are_marked():
    for scene in ACCURACY["scenes"].values():
        for a in scene["points"]:
            beaten = any(b["error"] < a["error"] and b["seconds"] < a["seconds"] for b in scene["points"])
            assert not (beaten and a["pareto"])
        assert sum(a["pareto"] for a in scene["points"]) >= 3


# -- one reach, here and in other libraries ----------------------------------------------------------------------------


def test_the_peers_of_the_reach_solve_one_problem():
    """Of the kept run: one robot and one cost everywhere, feasible motions, one minimum; the README says how soon."""
    result = json.loads((ROOT / "benchmarks" / "results" / "reach_peers.json").read_text())
    assert max(result["agreement"].values()) <= 1e-10  # measured 9e-13
    runs, text = result["contenders"], " ".join((ROOT / "README.md").read_text(encoding="utf8").split())
    ends = {name: run["iterates"][-1] for name, run in runs.items()}
    assert len(ends) == 4 and all(end["feasible"] for end in ends.values())
    same = [end["cost"] for name, end in ends.items() if name != "planners, smooth"]
    assert max(same) <= (1 + 2e-4) * min(same)  # measured 8e-5, between splines and torques that are held
    (line,) = re.findall(r"One reach of 13 degrees of freedom.*?reach_peers.py", text)
    for name in ("planners", "Crocoddyl, FDDP", "CasADi, IPOPT"):
        assert f"{result['seconds_within'][name]['0.001']:.2g} s" in line
