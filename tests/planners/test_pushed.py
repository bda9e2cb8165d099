"""A grasp whose base is pushed: against momentum, energy and the grasp that floats; and whole plans."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planners
import sdyn
from planners import balance, floating, grasp, pushed
from planners.certify import see
from planners.outline import outline
from planners.task import FOLDER, TaskError, parse

TEXT = (FOLDER / "grasp_thrusters.toml").read_text()
FORCE = "force = [0.5, 0.5, 0.5] # N\n"
COARSE = TEXT.replace("intervals = 40", "intervals = 8").replace("intervals = 1", "intervals = ")
BASE = TEXT[TEXT.index("\n[base]\n") : TEXT.index("\n[phases.wait]")]
FLOATING = COARSE.replace(BASE, "")


@pytest.fixture(scope="module")
def moved():
    """Any motion of the arm, pushed in all six directions: (task, problem, variables, phases)."""
    task = parse(COARSE)
    problem = grasp.problem(task)
    z = 0.3 * np.random.default_rng(0).normal(size=len(problem.numbers[1]))
    x = problem.form.split(z) | {"durations": np.array([1.0, 9.0, 2.0, 5.0])}
    return task, problem, x, grasp.phases(task, problem.data, x, 24)


def test_momentum_is_what_the_push_gave_and_energy_is_its_work(moved):
    task, _, _, phases = moved
    seen = see([(phase.robot, task.robot.frame, phase.q, phase.v) for phase in phases])
    rows = [*balance.momentum(seen, phases), balance.energy(phases[-1])]
    assert all(row.ok for row in rows), rows  # at most 1e-6: measured 2.5e-10 of momentum, 3.0e-7 of energy
    assert np.ptp(seen[-1].momentum, axis=0).min() > 1e-3
    phase = phases[1]
    for k in (1, 3):  # a moment, and a force, that nothing took up
        other = replace(phase, tau=phase.tau + 1e-3 * np.eye(9)[k])
        assert not all(row.ok for row in balance.momentum(seen[1:2], [other]))
    other = replace(phases[-1], tau=phases[-1].tau + 1e-3 * np.eye(9)[7])
    assert not balance.energy(other).ok


def test_without_a_push_it_floats(moved):
    """The same motion and the same torques as the task without [base]."""
    _, problem, x, _ = moved
    task = parse(FLOATING)
    free, still = grasp.problem(task), {name: 0 * a for name, a in x.items() if name.startswith("push")}
    floats = grasp.phases(task, free.data, x, 24)
    for a, b in zip(floats, grasp.phases(moved[0], problem.data, x | still, 24), strict=True):
        assert max(np.abs(u - w).max() for u, w in ((a.q, b.q), (a.v, b.v), (a.tau, b.tau))) < 1e-12  # measured


def test_attitude_control_is_a_push_without_force(moved):
    _, problem, x, _ = moved
    push, splines = problem.data.push, problem.form.values.grid.splines
    grids, pushes = [np.linspace(0, 1, 9)] * 3, {name: a for name, a in x.items() if name.startswith("push")}
    turned = pushed.control_points(
        {name: a[:, :3] for name, a in pushes.items()}, push._replace(limits=push.limits[:3])
    )
    pressed = pushed.control_points({name: a * np.repeat([1, 0], 3) for name, a in pushes.items()}, push)
    ours, other = (pushed.acting(splines, grids, P, x["durations"][1:]) for P in (turned, pressed))
    assert np.array_equal(ours.wrench, other.wrench) and np.array_equal(ours.rates, other.rates)
    assert np.abs(ours.wrench[:, 3:]).max() == 0 < np.abs(ours.wrench[:, :3]).max()


@pytest.mark.parametrize("text", [COARSE, COARSE.replace(FORCE, ""), FLOATING], ids=["thrusters", "attitude", "floats"])
def test_every_row_has_a_name_and_the_outline_says_what_moves_the_base(text):
    task = parse(text)
    form = grasp.problem(task)
    found = jax.eval_shape(form.form.at, form.numbers[1], form.data)
    assert [sum(rows.size for rows in groups) for groups in (form.equal, form.below)] == [
        found.equal.size, found.below.size
    ]  # fmt: skip
    names = {rows.name for rows in form.below}
    assert ("torque limit of the base about x" in names) == (task.base is not None)
    assert ("force limit of the base along z" in names) == (FORCE in text)
    said = outline(task)
    words = "floats" if task.base is None else "thrusters" if task.base.force else "attitude control"
    assert [phase.base.split(",")[0].split(";")[0] for phase in said.phases] == ["floats", *[words] * 3]
    assert any("force on the base" in term for term in said.cost) == (task.base is not None and bool(task.base.force))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("torque = [0.1", "torque = [0.0", ["[base]", "above zero"]),
        (FORCE, "forces = [1.0, 1.0, 1.0]\n", ["'forces'", "did you mean 'force'"]),
        ("torque = [0.1, 0.1, 0.1] # N m\n", "", ["[base] lacks the key torque"]),
        (FORCE, 'wheels = ["joint1"]\n', ["'wheels'"]),
    ],
)
def test_a_bad_base_is_refused(old, new, words):
    assert old in TEXT
    with pytest.raises(TaskError) as error:
        parse(TEXT.replace(old, new, 1))
    assert all(word in str(error.value) for word in words), str(error.value)


# -- the shipped task --------------------------------------------------------------------------------------------------


def test_without_forces_its_target_is_out_of_reach(moved):
    """The centre of mass stays, and the hand is never as far from it as the target is."""
    _, problem, _, _ = moved
    chain = jax.tree.map(lambda a: a[0], problem.data.chains)

    def away(joints):
        q = floating.at_rest(joints)
        return jnp.linalg.norm(sdyn.frame_pose(chain, q, "hand")[1] - sdyn.centre_of_mass(chain, q))

    _, places, *_ = jax.jit(jax.vmap(grasp.grip_motion, (None, 0)))(problem.data, jnp.linspace(0.0, 53.0, 54))
    grid = np.stack(
        np.meshgrid(*[np.linspace(*limits, 13) for limits in problem.data.position], indexing="ij"), axis=-1
    )
    farthest = jax.jit(jax.vmap(away))(grid.reshape(-1, 3)).max()
    gap = jnp.linalg.norm(places - problem.data.waiting.momentum.centre, axis=1).min() - farthest
    assert gap > 0.3  # m; measured 0.370


@pytest.mark.slow
def test_thrusters_carry_the_base_to_it():
    """Both solvers say how, in one minimum."""
    plan = planners.plan(planners.load("grasp_thrusters"), progress=False)
    judged = planners.plan(plan.task, solver="casadi", guess=plan.variables, progress=False)
    assert plan.status == "solved" and plan.certificate.passed, plan.verdict
    assert plan.certificate.worst("stationarity") < 1e-6
    assert abs(plan.info["cost"] / judged.info["cost"] - 1) < 1e-4  # measured 1.7e-7
    assert plan.q[2][-1, 0] - plan.q[0][0, 0] > 0.5  # m, of the base along x until the grasp; measured 0.576
