"""Two arms that hold one load: the loop that they close, in the task, the first guess, the certificate, and a plan."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

import planners
import sdyn
from planners import certify_reach, shooting
from planners.outline import outline
from planners.plan import PhaseResult
from planners.problem import ONCE
from planners.task import FOLDER, TaskError, parse

CARRY = (FOLDER / "carry.toml").read_text()


@pytest.fixture(scope="module")
def task():
    return planners.load("carry")


def loops_of(task, q):
    chain = sdyn.pack(task.chaser)
    at = jax.jit(lambda q: (sdyn.loop_residual(chain, q), sdyn.loop_jacobian(chain, q)), **ONCE)
    return map(np.asarray, at(q))


def test_the_other_hand_holds_the_load_from_start_to_end(task):
    """The first guess stays with its loop closed, and three joints say whether all of them rest."""
    problem = shooting.problem(task)
    ((x, u),) = shooting.first_guesses(task, problem, 3)
    apart, K = loops_of(task, x.q[0])
    assert np.abs(apart).max() < 1e-12 and np.abs(x.q - task.first).max() < 1e-15
    assert x.q.shape == (17, 13) and u.shape == (16, 6) and not x.v.any() and not u.any()
    others = np.delete(K[:, 6:], problem.data.independent, axis=1)
    assert len(problem.data.independent) == 3 == np.linalg.matrix_rank(K) == np.linalg.matrix_rank(others)


def test_its_outline_says_what_is_decided_and_held(task):
    (phase,) = outline(task).phases
    assert "torques" in phase.decided and "loops stay closed" in phase.holds


@pytest.mark.parametrize("solver", ["sqp", "casadi"])
def test_other_solvers_refuse_closed_loops(task, solver):
    with pytest.raises(TaskError, match="'riccati' plans this reach"):
        planners.plan(task, solver=solver, progress=False)


def test_structures_are_not_chosen_for_it(task):
    with pytest.raises(TaskError, match="free hands"):
        planners.choose_structure(task, (planners.Structure("left_hand", ("left_1",)),))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('closed = [["left_hand", "load_grasp"]]', 'closed = ["left_hand", "load_grasp"]', "it must look like"),
        ('closed = [["left_hand", "load_grasp"]]', 'closed = [["left_hand", "load_grip"]]', "'load_grip'"),
        ("\n[goal]", 'dock = "left_hand"\n[goal]', "leave out dock, or closed"),
    ],
)
def test_what_cannot_be_closed_is_refused(old, new, words):
    text = CARRY.replace("[load]", new.split("\n")[0] + "\n[load]") if old == "\n[goal]" else CARRY.replace(old, new)
    with pytest.raises(ValueError, match=words):
        parse(text)


def test_the_certificate_sees_a_loop_that_opens(task):
    """Standing still, but for one joint of one arm."""
    times, still = np.linspace(0, 10.0, 25), np.zeros((25, 12))
    q = np.repeat(task.first[None], 25, axis=0)
    rows = lambda q: {
        row.name: row
        for row in certify_reach.rows(
            task, SimpleNamespace(phases=(PhaseResult("reach", task.chaser, times, q, still, still),))
        )
    }
    closed = rows(q)
    assert all(row.ok for name, row in closed.items() if name != "distance from the goal")
    q[12, -1] += 1e-3
    opened = rows(q)["opening of the loops"]
    assert not opened.ok and 1e-4 < opened.value < 2e-3


@pytest.mark.slow
def test_a_load_is_carried_by_two_arms(task):
    plan = planners.plan(task, solver="riccati", progress=False)
    assert plan.status == "solved" and plan.certificate.passed, plan.verdict
