"""The choice of a structure: bounds that hold, one compilation, and the best of all."""

import json
import tomllib
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from structures import QUICKLY

import planners
import sdyn
from planners import floating, reach, sqp
from planners.problem import Linear
from planners.structures import REACHED, _bounds, dual_bound, variant
from planners.task import parse, written

TEXT = """
kind = "reach"
[robot]
model = "planar3"
joints = { joint1 = -0.9, joint2 = 1.5, joint3 = 0.5 }
[goal]
position = [1.0, 0.3, 0.0]
[phases.reach]
duration = [2.0, 30.0]
control_points = 8
intervals = 12
[limits]
torque = 4.0
[weights]
time = 0.02
smoothness = 20.0
"""
TASK = parse(TEXT, "planar")
HAND = planners.Structure("hand", ("joint1",))
DOCKED = planners.Structure("hand", ("joint1", "joint3", "leg1", "leg2"), dock="foot")
LEGS = "joint1 = -0.9, joint2 = 1.5, joint3 = 0.5, leg1 = 0.6, leg2 = -0.8"


@pytest.fixture(scope="module")
def two_arms(tmp_path_factory):
    """The planar robot with a second arm, whose foot can be docked."""
    folder, one = tmp_path_factory.mktemp("robot"), sdyn.models.load("planar3")
    legs = [sdyn.Link(f"shank{k}", 2.0, [0.2, 0, 0], np.diag([0.01, 0.03, 0.03])) for k in (1, 2)]
    each = dict(limits=(-2, 2), rate=0.5, effort=1)
    joints = [
        sdyn.Joint("leg1", "revolute", "base", "shank1", np.diag([-1.0, -1, 1]), [-0.37, 0, 0], **each),
        sdyn.Joint("leg2", "revolute", "shank1", "shank2", position=[0.4, 0, 0], **each),
    ]
    foot = sdyn.Frame("foot", "shank2", position=[0.4, 0, 0])
    robot = replace(one, links=(*one.links, *legs), joints=(*one.joints, *joints), frames=(*one.frames, foot))
    sdyn.save(robot, folder / "two.json")
    text = TEXT.replace("planar3", "two.json").replace("joint1 = -0.9, joint2 = 1.5, joint3 = 0.5", LEGS)
    return parse(text, "two", folder)


def large(*arms):
    """Arms of the 37-DOF robot, and a goal that the first may reach."""
    moving = ", ".join(f'"arm{a}_{k}"' for a in arms for k in range(1, 8))
    bent = ", ".join(f"arm{a}_2 = 0.8, arm{a}_4 = -1.2" for a in arms)
    text = TEXT.replace('"planar3"', f'"paper37"\nframe = "hand1"\nmoving = [{moving}]')
    text = text.replace("joint1 = -0.9, joint2 = 1.5, joint3 = 0.5", bent).replace("[limits]", "[limits]\nrate = 0.4")
    return parse(text.replace("[1.0, 0.3, 0.0]", "[1.2, 0.2, 1.3]"), "large")


COMPILED = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **rest: COMPILED.append(event) if event.endswith("backend_compile_duration") else None
)


def test_every_way_to_lock_some_joints():
    found = planners.lockings(TASK, 2)
    assert len(found) == len(set(found)) == 1 + 3 + 3 and {x.frame for x in found} == {"hand"}
    found = planners.lockings(large(1, 2))
    assert [x.frame for x in found] == ["hand1"] * 8 + ["hand2"] * 8
    assert all(name.startswith("arm" + x.frame[-1]) for x in found for name in x.joints)


def test_a_dock_is_held_by_an_arm_that_moves_or_is_locked(two_arms):
    found = [x for x in planners.lockings(two_arms, 1, ("foot",)) if x.frame == "hand"]
    joints = ("joint1", "joint2", "joint3")
    assert [x.joints for x in found if x.dock is None] == [joints, joints[1:], joints[::2], joints[:2]]
    assert {x.joints for x in found if x.dock and len(x.joints) > 3} == {
        (*x.joints, "leg2", "leg1") for x in found if x.dock is None
    }
    assert len(found) == len(set(found)) == 12
    feet = [x for x in planners.lockings(two_arms, 0, ("foot",)) if x.frame == "foot"]
    assert [(x.joints, x.dock) for x in feet] == [(("leg1", "leg2"), None)], "a frame is not docked and moved at once"


def test_a_docked_variant_is_the_task_that_its_text_says(two_arms):
    """Its base is the docked link, held where it is while the robot's base is at the origin."""
    task = variant(two_arms, DOCKED)
    again = parse(task.source, "two", two_arms.folder)
    assert again.robot == task.robot and repr(again.chaser) == repr(task.chaser) and again.place == task.place
    assert task.chaser.base == "shank2" and [j.name for j in task.joints] == list(DOCKED.joints)
    knee, foot = np.pi + 0.6, np.pi + 0.6 - 0.8
    assert np.abs(np.subtract(task.place[0], [-0.37 + 0.4 * np.cos(knee), 0.4 * np.sin(knee), 0.0])).max() < 1e-15
    assert np.abs(np.subtract(task.place[1], [np.cos(foot / 2), 0.0, 0.0, np.sin(foot / 2)])).max() < 1e-15


def test_a_docked_robot_needs_the_torques_of_the_grounded_one(two_arms, rng):
    """And what holds it is the rate of its momentum."""
    robot = variant(two_arms, DOCKED).chaser
    free, grounded = sdyn.pack(robot), sdyn.pack(robot.ground(robot.base))
    path = tuple(rng.normal(size=(3, 5, len(DOCKED.joints))))
    at = jax.jit(lambda floats: floating.at_zero_momentum(free, path, np.arange(3.0), floats), **QUICKLY)(0.0)
    assert max(np.abs(x).max() for x in (at.R - np.eye(3), at.p, at.v[:, :6], at.vdot[:, :6])) == 0

    def known(q, v, vdot):
        q7, state = floating.at_rest(q), lambda q, v: (sdyn.momentum(free, q, v), sdyn.centre_of_mass(free, q))
        (_, c), (h, _) = jax.jvp(state, (q7, v), (jnp.concatenate([jnp.zeros(7), v[6:]]), vdot))
        wrench = h.at[:3].add(jnp.cross(c, h[3:]))
        return wrench, sdyn.inverse_dynamics(grounded, q, v[6:], vdot[6:])

    wrench, tau = jax.jit(jax.vmap(known), **QUICKLY)(at.q, at.v, at.vdot)
    assert np.abs(at.tau - tau).max() < 1e-13 * np.abs(tau).max()
    assert np.abs(floating.holding(free, at) - wrench).max() < 1e-13 * np.abs(wrench).max()


@pytest.mark.parametrize("name", ["reach", "grasp", "identify"])
def test_a_task_that_is_written_again_says_the_same(name):
    task = planners.load(name)
    again = parse(written(tomllib.loads(task.source)), name)
    for key in ("robot", "phases", "limits", "weights", "goal", "target", "sensors", "tolerance"):
        assert getattr(again, key) == getattr(task, key)


def test_a_variant_is_the_task_that_its_text_says():
    task = variant(TASK, planners.Structure("hand", ("joint1", "joint3")))
    again = parse(task.source, "planar")
    assert again.robot == task.robot and repr(again.chaser) == repr(task.chaser)
    assert [j.name for j in task.joints] == ["joint1", "joint3"] and task.chaser.locked["joint2"][0] == 1.5


def test_a_variant_may_have_another_goal():
    """Its place and orientation are written too; the table says where each goes."""
    goal = planners.Goal(position=(0.9, 0.2, 0.0), quaternion=(0.0, 1.0, 0.0, 0.0))
    structure = planners.Structure("hand", ("joint1",), goal)
    task = variant(TASK, structure)
    assert task.goal == parse(task.source, "planar").goal == goal
    out = planners.Candidate(structure, (), "unreachable", "", np.inf)
    assert "hand to 0.9, 0.2, 0" in str(planners.StructureChoice(TASK, (out,)))


def test_room_for_more_joints_changes_nothing():
    """The same motion in a capacity with room for one more joint: base, torques and goal, and the cost by its mean."""
    small = variant(TASK, planners.Structure("hand", ("joint1", "joint3")))
    roomy = sdyn.pack(small.chaser, sdyn.capacity([small.chaser, TASK.chaser]))
    values = jax.jit(lambda z, data, form: form.at(z, data), static_argnums=2, **QUICKLY)
    found = []
    for data in (reach.data(small), reach.data(small, roomy)):
        problem = reach.problem(small, 1.0, data)
        end = np.pad([0.4, -0.6], (0, len(data.q0) - 2)) + data.q0
        v = values(reach.guess(problem, end, 8.0), data, problem.form)
        assert len(v.below) == sum(rows.size for rows in problem.below)
        found.append((v.equal, np.asarray(v.residual) ** 2, v.smooth))
    (equal, squares, smooth), (equal_2, squares_2, smooth_2) = found
    assert np.abs(equal - equal_2).max() < 1e-14 and smooth == smooth_2
    squares_2 = 1.5 * squares_2.reshape(2, -1, 3)
    assert (squares_2[..., 2] == 0).all()
    assert np.abs(squares_2[..., :2] - squares.reshape(2, -1, 2)).max() < 1e-14 * squares.max()


def test_a_bound_is_that_of_the_cheapest_posture_of_any_part():
    """Postures that miss the goal do not count."""
    names = planners.Structure("a", ("x", "y")), planners.Structure("a", ("x",)), planners.Structure("b", ("x",))
    one = lambda cost, error=0.0: reach.Postures(np.zeros((1, 2)), np.array([error]), np.ones(1), np.array([cost]))
    assert np.array_equal(_bounds(names, [one(3.0), one(2.0), one(1.0)]), [2.0, 2.0, 1.0])
    assert np.array_equal(_bounds(names, [one(3.0), one(2.0, 2 * REACHED), one(1.0)]), [3.0, np.inf, 1.0])


def test_the_dual_bound_of_a_convex_programme_is_below_its_minimum(rng):
    """And is the minimum with the right multipliers; some variables are held by their bounds."""
    n, e = 6, 2
    H, A, g, a = rng.normal(size=(n, n)), rng.normal(size=(e, n)), rng.normal(size=n), rng.normal(size=e)
    H = H @ H.T + np.eye(n)
    low, high = np.r_[-np.inf, np.full(n - 1, -9.0)], np.full(n, 9.0)
    K = np.block([[H, A.T], [A, np.zeros((e, e))]])
    d, y = np.split(np.linalg.solve(K, -np.r_[g, a]), [n])
    least = g @ d + d @ H @ d / 2
    none = np.zeros(0)
    for k in range(20):
        z = rng.normal(size=n) * (k > 0)
        near = Linear(g @ z + z @ H @ z / 2, g + H @ z, H, A @ z + a, A, none, np.zeros((0, n)))
        state = sqp.State(z, near, y, none, np.zeros((n, n)), *[0.0] * 10)
        assert dual_bound(state, low, high) == pytest.approx(least, rel=1e-10)
        off = dual_bound(state._replace(y=y + rng.normal(size=e)), low, high)
        assert off < least


def test_the_table_says_what_became_of_each_and_json_holds_it():
    structure = planners.Structure("hand", ("joint1", "joint2"))
    best = planners.Candidate(structure, ("joint3",), "best", "", 0.1, 0.2, 0.1, 0.06, 0.04, 5.0, 7, 0.1)
    other = replace(best, locked=(), status="solved", cost=0.25)
    out = planners.Candidate(structure, ("joint1",), "unreachable", "no posture found", np.inf)
    choice = planners.StructureChoice(TASK, (best, other, out))
    head, *lines = str(choice).split("\n")
    assert head.split() == "frame locked status cost more time torque smooth T, s".split()
    assert "0.20000" in lines[0] and "+25.00 %" in lines[1] and "no posture found" in lines[2]
    assert max(map(len, lines)) <= 80 and choice.best is best
    rows = json.loads(choice.to_json())["candidates"]
    assert [row["status"] for row in rows] == ["best", "solved", "unreachable"] and rows[2]["bound"] is None


@pytest.mark.parametrize(
    ("task", "candidates", "words"),
    [
        ("grasp", None, "kind 'grasp'"),
        ("reach", [], "missing"),
        ("reach", [planners.Structure("hand", ())], "moves nothing"),
        ("reach", [planners.Structure("hand", ("joint9",))], "'joint9' of a candidate rests"),
        ("reach", [HAND, replace(HAND, goal=planners.Goal(position=(1.0, 0, 0)))], "to all or to none"),
        ("reach", [replace(HAND, goal=planners.Goal(position=(1.0, 0, 0), quaternion=(1.0, 1, 0, 0)))], "quaternion"),
        ("reach", [planners.Structure("hant", ("joint1",))], "'hant'"),
        ("reach", [replace(HAND, dock="hant")], "'hant'"),
        ("reach", [replace(HAND, dock="hand")], "'hand' is on the link that is to reach"),
    ],
)
def test_what_cannot_be_chosen_is_refused(task, candidates, words):
    with pytest.raises(ValueError, match=words):
        planners.choose_structure(planners.load(task), candidates)


@pytest.mark.slow
def test_the_best_of_two_places_is_found():
    """The near one of two goals, without a compilation more than for one."""
    places = [None, planners.Goal(position=(1.3, 0.2, 0.0)), planners.Goal(position=(9.0, 0.0, 0.0))]
    planners.choose_structure(TASK, planners.lockings(TASK)[:1])
    before = len(COMPILED)
    candidates = [replace(planners.lockings(TASK)[0], goal=goal) for goal in places]
    choices = [planners.choose_structure(TASK, candidates, drop=drop) for drop in (True, False)]
    assert len(COMPILED) == before
    assert choices[0].best.cost == choices[1].best.cost == min(c.cost for c in choices[1].candidates if c.cost)
    assert choices[0].candidates[-1].status == "unreachable" and choices[0].candidates[-1].structure.goal is places[2]
    assert choices[0].task.goal == (choices[0].best.structure.goal or TASK.goal)


def test_only_a_reach_by_the_default_solver_is_docked(two_arms):
    with pytest.raises(ValueError, match="not for the kind 'detumble'"):
        parse(planners.load("detumble").source.replace("[robot]", '[robot]\ndock = "hand"'))
    task = variant(two_arms, DOCKED)
    with pytest.raises(ValueError, match="'foot' is docked"):
        planners.plan(task, solver="casadi", progress=False)
    with pytest.raises(ValueError, match="leave dock out"):
        planners.choose_structure(task)


@pytest.mark.slow
def test_whether_to_dock_is_chosen_as_by_optimising_everything(two_arms):
    """Swinging about the foot is best here, and better than on a base that is held. What was chosen is planned, and
    certified: the motion is integrated under the wrench of the dock. One compilation serves free and docked ones.
    """
    candidates = [x for x in planners.lockings(two_arms, 1, ("foot",)) if x.frame == "hand"]
    planners.choose_structure(two_arms, [candidates[0], candidates[5]])  # as it is, and with everything that can move
    before = len(COMPILED)
    quick, whole = (planners.choose_structure(two_arms, candidates, drop=drop) for drop in (True, False))
    assert len(COMPILED) == before
    assert quick.best.structure == whole.best.structure and quick.best.cost == whole.best.cost
    assert all(c.status in ("best", "solved") and c.bound <= c.cost for c in whole.candidates)
    assert quick.best.structure.dock == "foot" and not quick.best.locked and "dock, N m" in str(quick)
    costs = {(c.structure.dock, c.structure.joints): c.cost for c in whole.candidates}
    floats, held = (costs[dock, candidates[0].joints] for dock in (None, "foot"))
    assert quick.best.cost < floats < held
    plan = planners.plan(quick.task, progress=False)
    assert plan.status == "solved" and plan.info["results"]["dock"]["force_N"] > 0, plan.verdict
    off = plan.phases[0].tau * np.r_[np.full(6, 1.01), np.ones(len(quick.task.joints))]
    spoiled = replace(plan, phases=(replace(plan.phases[0], tau=off),))
    assert "integrated again" in planners.certify(quick.task, spoiled).sentence


@pytest.fixture(scope="module")
def choices():
    """The planar robot with up to one joint locked, with and without dropping, and what each compiled."""
    out = []
    for drop in (True, False):
        planners.choose_structure(TASK, planners.lockings(TASK)[:1], drop=drop)
        before = len(COMPILED)
        choice = planners.choose_structure(TASK, drop=drop)
        out.append((choice, len(COMPILED) - before))
    return out


@pytest.mark.slow
def test_the_choice_is_that_of_all_candidates_and_compiles_nothing_more(choices):
    assert len(COMPILED) > 3, "the first calls compile, or this test counts nothing"
    (quick, _), (whole, _) = choices
    assert [compiled for _, compiled in choices] == [0, 0]
    assert quick.best.structure == whole.best.structure and quick.best.cost == whole.best.cost
    assert all(c.bound <= c.cost for c in whole.candidates if c.cost)
    assert [j.name for j in quick.task.joints] == list(quick.best.structure.joints)


@pytest.mark.slow
def test_the_best_of_64_structures_of_the_large_robot_is_found():
    """Against all of them optimised; the first hand, with up to three of its seven joints locked."""
    task = large(1)
    candidates = planners.lockings(task, 3)
    assert len(candidates) == 64
    quick, whole = (planners.choose_structure(task, candidates, drop=drop) for drop in (True, False))
    assert quick.best.structure == whole.best.structure and quick.best.cost == whole.best.cost
    iterations = [sum(c.iterations for c in choice.candidates) for choice in (quick, whole)]
    assert iterations[0] < 0.25 * iterations[1]
    plan = planners.plan(quick.task, accuracy="accurate", progress=False)  # the choice's grid is coarse
    assert plan.status == "solved", plan.verdict
