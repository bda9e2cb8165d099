"""The small shipped grasp: planned twice, by both solvers, from several seeds; tasks of its shape that cannot be."""

from dataclasses import replace

import numpy as np
import pytest

import planners
from planners import grasp, sqp
from planners.task import FOLDER, parse

TEXT = (FOLDER / "grasp_planar.toml").read_text()


@pytest.fixture(scope="module")
def plan():
    return planners.plan(planners.load("grasp_planar"), progress=False)


def test_it_is_planned_and_certified(plan):
    assert plan.status == "solved", plan.verdict
    assert plan.certificate.passed, str(plan.certificate)
    assert plan.phases[0].robot.nv == 9
    assert len(plan.history) < 80  # measured 33


def test_the_same_plan_twice_is_identical(plan):
    again = planners.plan(plan.task, progress=False)
    assert all(np.array_equal(plan.variables[k], again.variables[k]) for k in plan.variables)
    for a, b in zip(plan.phases, again.phases, strict=True):
        assert np.array_equal(a.q, b.q) and np.array_equal(a.v, b.v) and np.array_equal(a.tau, b.tau)


@pytest.fixture(scope="module")
def judged(plan):
    """The same task stated again in CasADi, from the same first guess to IPOPT's minimum."""
    return planners.plan(plan.task, solver="casadi", progress=False)


def test_the_referee_plans_it_too_and_is_certified(plan, judged):
    assert judged.status == "solved" and judged.certificate.passed, judged.verdict
    for found in (plan, judged):  # measured 7.6e-8, 7.5e-7
        assert found.certificate.worst("stationarity and complementarity") < 1e-6
    assert judged.info["options"]["solver"] == "casadi" and judged.info["stationarity"] < 1e-9


def test_the_default_solver_stays_where_the_referee_went(judged):
    """Two statements, two differentiations, two solvers: one minimum. Alone they end in different ones, 7 % apart."""
    problem = grasp.problem(judged.task)
    z = problem.form.join(judged.variables)
    first, *_, state = sqp.solve(problem, z[None])
    ours = sqp.outcome(sqp.pick(state, 0))
    assert ours.status == "solved"
    assert abs(ours.cost - judged.info["cost"]) < 1e-6 * ours.cost  # measured 1.6e-7
    assert abs(sqp.pick(first, 0).near.cost - judged.info["cost"]) < 1e-13  # of one point, measured 4e-16


def spinning(task, spin):
    return replace(task, target=replace(task.target, twist=(0.0, float(spin), 0.0, *task.target.twist[3:])))


def test_plans_between_those_of_a_table_are_near_what_is_interpolated(plan, tmp_path):
    """As near as is said there, and a few iterations away from a certified plan."""
    spins = [[0.0305], [0.03], [0.031]]
    table = planners.table(lambda point: spinning(plan.task, point[0]), spins, tmp_path)
    assert table.solved == [0, 1, 2] and [entry.start for entry in table.entries] == [-1, 0, 0]
    assert all(entry.certificate.passed for entry in table.entries)
    assert abs(table.entries[1].cost - plan.info["cost"]) < 1e-6  # measured 2e-14
    (check,) = table.check(1)
    assert check.entry.status == "solved" and check.entry.iterations <= 10  # measured 7; from first guesses, 32
    assert all(check.error[name] <= check.bound[name] for name in check.error)
    assert check.error["durations"] < 0.01  # s, measured 1.0e-3
    assert 0 < max(amount for _, amount, _ in check.violations) < 1e-4  # m, rad; measured 4.2e-5


@pytest.mark.parametrize(
    ("old", "new"),
    [("position = [1.7223", "position = [1.7233"), ("time = 0.02", "time = 0.0202")],
    ids=["target", "weight"],
)
def test_the_plan_follows_its_task_as_its_derivative_says(plan, old, new):
    assert old in TEXT
    other = parse(TEXT.replace(old, new))
    before = sqp._optimised._cache_size()
    found = planners.sensitivity(plan.task, plan, other)
    assert sqp._optimised._cache_size() == before  # nothing is compiled
    problem = grasp.problem(other)
    z = problem.form.join(plan.variables)
    *_, states = sqp.solve(problem, z[None])
    again = sqp.outcome(sqp.pick(states, 0))
    assert again.status == "solved"
    assert np.linalg.norm(again.z - z - found.z) < 0.02 * np.linalg.norm(found.z)
    assert abs(again.cost - plan.info["cost"] - found.cost) < 0.02 * abs(found.cost)


@pytest.mark.slow
def test_a_wanted_error_decides_the_grid(plan):
    """The motion, integrated again by other code, is that close to the plan."""
    found = planners.plan(plan.task, accuracy="1e-7", progress=False)
    assert found.status == "solved" and found.certificate.worst("integrated again") <= 1e-7
    assert found.info["options"]["accuracy"] in ("fast", "balanced", "accurate", "reference")


def test_a_guess_that_fits_no_plan_is_refused(plan):
    for guess, words in (({}, "hold 'durations'"), (plan.variables | {"end": np.full(3, np.nan)}, "hold 'end'")):
        with pytest.raises(planners.TaskError, match=words):
            planners.plan(plan.task, guess=guess, progress=False)
    with pytest.raises(planners.TaskError, match="seeds is 2, and a guess"):
        planners.plan(plan.task, guess=plan.variables, seeds=2, progress=False)


@pytest.mark.parametrize(
    ("old", "new", "words", "enough", "amount", "unit"),
    [
        ("position = [1.7223", "position = [4.7223", "place of 'hand'", "place of 'hand' on", 2.804, "m"),
        pytest.param(
            "margin =", "torque = 1e-3\nmargin =", "torque limit", "every torque limit", 0.097, "N m",
            marks=pytest.mark.slow,
        ),
    ],
    ids=["out of reach", "too weak"],
)  # fmt: skip
def test_an_infeasible_task_is_found_out_and_explained(plan, old, new, words, enough, amount, unit):
    """Tasks of the same shapes, so that nothing compiles anew. With 0.1 N m more the weak one has a plan to 3e-6, with
    0.06 N m none is found."""
    found = planners.plan(parse(TEXT.replace(old, new)), progress=False)
    assert found.status == "infeasible"
    assert words in found.verdict and "off by" in found.verdict
    (first, *others) = found.info["relaxation"]
    assert first["name"].startswith(enough) and first["unit"] == unit
    assert abs(first["amount"] - amount) < 0.05 * amount and f"{first['amount']:.3g} {unit}" in found.verdict
    assert all(x["amount"] is None for x in others)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["grasp_planar", "grasp"])
def test_several_seeds_find_no_worse_plan_than_one(name):
    one, found = (planners.plan(planners.load(name), seeds=n, progress=False) for n in (1, 12))
    assert found.status == "solved" and found.certificate.passed, found.verdict
    starts = found.info["starts"]
    assert found.info["options"]["seeds"] == sum(starts.values()) == 12 and starts["dropped"] > 0
    assert found.info["cost"] < one.info["cost"] * (1 + 1e-6)  # 1.2382 both; 0.9215 and 0.9903
