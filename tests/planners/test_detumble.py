"""The published detumbling of a planar chaser; its statement against another one; what is refused."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

import planners
import sdyn
from planners import animation, certify_detumble, detumble, figures, motion, referee
from planners.shapes import ORANGE
from planners.task import FOLDER, TaskError, parse

PUBLISHED = json.loads((Path(__file__).parents[1] / "data" / "detumble_published.json").read_text())
TEXT = (FOLDER / "detumble.toml").read_text()
PLANE = [1, 3, 5, 6, 7, 8]  # about y, along x and z, joints


@pytest.fixture(scope="module")
def task():
    """The shipped one, with fewer control points and grid points."""
    return parse(TEXT.replace("control_points = 12", "control_points = 8").replace("intervals = 42", "intervals = 12"))


@pytest.fixture(scope="module")
def chain(task):
    return sdyn.pack(task.compound)


# -- the model and the start are the published ones --------------------------------------------------------------------


def test_the_published_motion_needs_the_published_forces(chain):
    """Drake's model and dynamics, where its optimiser left them at 1e-7."""
    act = jax.jit(sdyn.inverse_dynamics)
    for step in PUBLISHED["steps"]:
        c, s = np.cos(step["pitch"]), np.sin(step["pitch"])
        half = step["pitch"] / 2
        q = np.r_[0, 0, 0, np.cos(half), 0, np.sin(half), 0, step["joints"]]
        turn = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])  # of (about y, along x, along z) to base axes
        (spin, *slide), (spun, *slid) = (turn @ step[key][:3] for key in ("velocity", "acceleration"))
        slid -= spin * np.array([slide[1], -slide[0]])  # the derivative of components in turning axes
        v, vdot = np.zeros((2, 9))
        v[PLANE], vdot[PLANE] = np.r_[spin, slide, step["velocity"][3:]], np.r_[spun, slid, step["acceleration"][3:]]
        tau = np.asarray(act(chain, q, v, vdot))
        found = np.r_[turn.T @ tau[PLANE[:3]], tau[6:]]
        assert np.abs(found - step["acting"]).max() < 3e-7, step["step"]  # measured 1.2e-7


def test_the_velocities_at_the_start_come_from_the_generalised_jacobian(task, chain):
    """Joint rates that turn the target about its centre at 5 degrees/s without momentum; then no linear momentum."""

    @jax.jit
    def known(chain, q):
        _, p = sdyn.body_poses(chain, q)
        arm = p[chain.capacity.link_names.index("target_target")] - sdyn.frame_pose(chain, q, "target_grasp")[1]
        return arm, sdyn.generalised_jacobian(chain, q, "target_grasp"), sdyn.mass_matrix(chain, q)

    arm, G, M = map(np.array, known(chain, task.first))
    G[3:] += np.cross(G[:3], arm, axis=0)
    rates = np.linalg.pinv(G) @ [0, np.deg2rad(5), 0, 0, 0, 0]
    twist = -np.linalg.solve(M[:6, :6], np.r_[np.zeros(3), M[3:6, 6:] @ rates])
    start = np.r_[twist, rates]
    assert np.abs(start - task.captured).max() < 1e-12
    assert np.abs(start[PLANE] - PUBLISHED["start"]).max() < 1e-9  # measured 5e-13
    assert np.abs(M[3:6] @ start).max() < 1e-14


# -- the statement against another one, and the plan -------------------------------------------------------------------


def test_values_are_those_of_the_referee(task):
    """At random variables, out of the plane too: rows and cost as CasADi's own dynamics say."""
    problem = detumble.problem(task)
    z = detumble.first_guesses(task, problem, 1)[0]
    z = z + 0.3 * np.random.default_rng(0).normal(size=z.shape)
    value = jax.jit(problem.form.at)(z, problem.data)
    programme = referee.programme(task, problem, z)
    (rows, low, high) = zip(*programme.rows["below"], strict=True)
    at = np.concatenate([programme.value(x).full().ravel() for x in rows])
    below = np.stack([at - np.concatenate(high), np.concatenate(low) - at], axis=1).ravel()
    assert sum(rows.size for rows in problem.below) == len(below) == len(value.below)
    assert np.abs(value.below - below).max() < 1e-10  # measured 9e-13
    assert abs(value.cost / float(programme.value(programme.cost)) - 1) < 1e-12  # measured 1e-13


@pytest.fixture(scope="module")
def judged(task):
    """Planned by the referee, which compiles nothing."""
    return planners.plan(task, solver="casadi", progress=False)


def test_it_comes_to_rest_and_is_certified(judged):
    assert judged.status == "solved", judged.verdict
    assert judged.certificate.passed, str(judged.certificate)
    assert judged.certificate.worst("speed at the end") <= 1e-3
    assert judged.certificate.active == ("the torque limit of joint1",)
    assert sum(judged.info["results"]["cost_parts"].values()) < PUBLISHED["cost"]  # measured 8.400, and 8.544


@pytest.mark.parametrize(
    ("key", "column", "by", "words"),
    [
        ("tau", 1, 1e-3, "angular momentum"),
        ("tau", 3, 1e-3, "linear momentum"),
        ("tau", 7, 1e-3, "energy"),
        ("v", 8, 2e-3, "speed at the end"),
    ],
)
def test_what_is_not_so_is_seen(judged, key, column, by, words):
    phase = judged.phases[0]
    other = getattr(phase, key).copy()
    other[1:, column] += by
    rows = certify_detumble.rows(judged.task, replace(judged, phases=(replace(phase, **{key: other}),)))
    assert [row.name for row in rows if words in row.name and not row.ok], [(row.name, row.value) for row in rows]


def test_the_target_is_shown_and_the_wrench_is_drawn(judged):
    assert {shape.color for shape in animation._shapes(judged)["target_target"]} >= {ORANGE}
    figure = figures.wrench(judged)
    assert [axes.get_title(loc="left") for axes in figure.axes][1::3] == ["torque about y", "force along y"]
    assert np.array_equal(figure.axes[1].lines[0].get_ydata(), judged.tau[0][:, 1])
    assert figure.axes[0].get_ylim()[1] > 1e-4 * judged.task.base_limits[0]  # nothing is about x: not magnified
    phase = replace(judged.phases[0], v=judged.phases[0].v + 1e-15)  # rounding, across the plane too
    noisy = replace(judged, phases=(phase,))
    assert min(panel.get_ylim()[1] for panel in figures.momenta(noisy, motion.follow(noisy)).axes) > 1e-3


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("torque = [2.5", "torque = [0.0", ["[base]", "above zero"]),
        ("joint1 = 0.06", "joint9 = 0.06", ["'joint9'", "joint1"]),
        ("joint1 = 0.06", "joint1 = 6.06", ["'joint1'", "beyond its limit"]),
        ("force = [2.0, 2.0, 2.0]", 'force = [2.0, 2.0, 2.0]\nwheels = ["wheel"]', ["'wheel'"]),
        ("[capture]\ntwist", "[capture]\ntwists", ["'twists'", "did you mean 'twist'"]),
        ("speed = 1e-3", "speed = 0", ["speed in [end]"]),
    ],
)
def test_a_bad_task_is_refused(old, new, words):
    assert old in TEXT
    with pytest.raises(TaskError) as error:
        parse(TEXT.replace(old, new, 1))
    assert all(word in str(error.value) for word in words), str(error.value)


# -- whole plans -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_published_detumbling():
    """Both solvers end in one minimum, which costs less than what was published, in about the same time."""
    task = planners.load("detumble")
    plan, judged = (planners.plan(task, solver=name, progress=False) for name in ("sqp", "casadi"))
    for found in (plan, judged):
        assert found.status == "solved" and found.certificate.passed, found.verdict
        assert found.certificate.worst("stationarity") < 1e-6
        assert found.certificate.worst("speed at the end") <= 1e-3
    assert abs(plan.info["cost"] / judged.info["cost"] - 1) < 1e-8  # measured 7e-11
    found = plan.info["results"]
    assert sum(found["cost_parts"].values()) < PUBLISHED["cost"]  # measured 8.387, and 8.544
    assert abs(found["duration_s"] / PUBLISHED["duration"] - 1) < 0.02  # measured 4.136 s, and 4.095


@pytest.mark.slow
def test_thirteen_degrees_of_freedom_from_a_tumbling_target():
    """The first guess keeps every limit, the duration is free, and the referee has the same minimum."""
    plan = planners.plan(planners.load("detumble_deos"), progress=False)
    assert plan.status == "solved" and plan.certificate.passed, plan.verdict
    problem = detumble.problem(plan.task)
    guess = jax.jit(problem.form.at)(detumble.first_guesses(plan.task, problem, 1)[0], problem.data)
    assert guess.below.max() <= 0
    low, high = plan.task.phases["stabilise"].duration
    assert low + 1 < plan.info["results"]["duration_s"] < high - 1  # free: measured 7.30 s
    end = referee.programme(plan.task, problem, problem.form.join(plan.variables), near=True).solve()
    assert end.status == "solved"
    assert abs(end.cost / plan.info["cost"] - 1) < 1e-7  # measured 3e-9


WHEELS = """
kind = "detumble"
[robot]
model = "paper37"
frame = "hand1"
moving = ["arm1_1", "arm1_2", "arm1_4", "wheel_1", "wheel_2", "wheel_3"]
joints = { arm1_2 = 0.8, arm1_4 = -1.2 }
[target]
model = "sat50"
[capture]
twist = [0.004, 0.003, -0.002, 0.001, -0.001, 0.002]
rates = { arm1_1 = 0.03, arm1_2 = -0.02, arm1_4 = 0.02 }
[base]
torque = [0.2, 0.2, 0.2]
force = [2.0, 2.0, 2.0]
wheels = ["wheel_1", "wheel_2", "wheel_3"]
[phases.stabilise]
duration = [5.0, 60.0]
control_points = 9
intervals = 16
[limits]
margin = 0.02
[weights]
base_torque = 100.0
"""


@pytest.mark.slow
def test_wheels_take_up_the_momentum_of_a_robot_in_space():
    plan, judged = (planners.plan(parse(WHEELS), solver=name, progress=False) for name in ("sqp", "casadi"))
    for found in (plan, judged):
        assert found.status == "solved" and found.certificate.passed, found.verdict
    assert np.abs(plan.v[0][-1, :9]).max() <= 1e-3 and np.abs(plan.v[0][-1, 9:]).max() > 1.0
    assert abs(plan.info["cost"] / judged.info["cost"] - 1) < 1e-6
