"""Distances of shapes, by the solver's and by the certificate's formulas and by others'; what a mission may ask."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

import planners
import sdyn
from planners import certify_mission, clearance, floating, grasp, mission, solids, sqp
from planners.motion import follow, quaternions
from planners.problem import ONCE
from planners.sections import Solid
from planners.shapes import _along
from planners.task import parse

SOURCE = (Path(__file__).parents[1] / "data" / "grasp_planar_clear.toml").read_text()
TASK = parse(SOURCE, "clear")


def capsules(rng, count):
    """Segments p, u, q, w [count, 3]: crossing ones, distant ones, parallel ones, points."""
    p, u, q, w = rng.normal(size=(4, count, 3)) * np.r_[0.3, 1, 1][:, None].repeat(count // 3, 0)
    w[::5] = 0.7 * u[::5]
    u[::7], w[::11] = 0, 0
    return p, u, q, w


def numerically(p, u, q, w):
    """The same distance by a constrained minimisation."""
    square = lambda x: np.square(p + x[0] * u - q - x[1] * w).sum()
    slope = lambda x: 2 * np.array([u, -w]) @ (p + x[0] * u - q - x[1] * w)
    starts = [minimize(square, x, jac=slope, bounds=[(0, 1)] * 2, tol=1e-14).fun for x in ((0.5, 0.5), (0.1, 0.9))]
    return np.sqrt(min(starts))


def test_segments_are_as_far_apart_as_a_minimisation_says(rng):
    x = capsules(rng, 99)
    found, wanted = solids.segments(*x), np.array([numerically(*row) for row in zip(*x, strict=True)])
    assert np.abs(found**2 - wanted**2).max() < 1e-12  # measured 7e-15


def test_an_ellipsoid_is_as_far_away_as_a_minimisation_says(rng):
    a = np.array([0.3, 0.5, 0.9])
    for x in 1.5 * rng.normal(size=(20, 3)):
        if np.linalg.norm(x / a) < 1.05:
            continue
        on = {"type": "eq", "fun": lambda y: np.square(y / a).sum() - 1}
        y = minimize(lambda y: np.square(y - x).sum(), a * x / np.linalg.norm(x), constraints=on, tol=1e-14).x  # noqa: B023
        assert abs(solids.from_ellipsoid(x[None], a)[0] - np.linalg.norm(x - y)) < 1e-9  # measured 5e-12


def test_coal_says_the_same(rng):
    coal = pytest.importorskip("coal")
    at = lambda p, u: coal.Transform3s(_along(u / np.linalg.norm(u)), p + u / 2)
    rod = lambda radius, u: coal.Capsule(radius, np.linalg.norm(u))
    ask = lambda *pair: coal.distance(*pair, coal.DistanceRequest(), coal.DistanceResult())
    p, u, q, w = np.array(capsules(rng, 99))[:, [k for k in range(99) if k % 7 and k % 11]]
    body = Solid(link="b", position=(0.0, 0.0, 0.0), semi_axes=(0.3, 0.5, 0.9))
    for k, d in enumerate(solids.segments(p, u, q, w)):
        theirs = ask(rod(0.01, u[k]), at(p[k], u[k]), rod(0.02, w[k]), at(q[k], w[k]))
        assert abs(theirs - d + 0.03) < 1e-12  # measured 6e-16
        mine = Solid(link="a", position=tuple(p[k]), to=tuple(p[k] + u[k]), radius=0.01)
        (d,) = solids._distance(*((x, np.eye(3)[None], np.zeros((1, 3))) for x in (mine, body)))
        if d > 0:
            theirs = ask(rod(0.01, u[k]), at(p[k], u[k]), coal.Ellipsoid(0.3, 0.5, 0.9), coal.Transform3s())
            assert abs(theirs - d) < 1e-5  # measured 1.5e-6; its iterations end at 1e-6


def test_the_solvers_distance_is_above_the_exact_one_by_no_more_than_it_says(rng):
    x = capsules(rng, 99)
    exact, found = solids.segments(*x), np.asarray(jax.jit(clearance.segments, **ONCE)(*x))
    far = exact > 0.1
    most = clearance.ROUND * sum(np.square(y).sum(axis=1) for y in (x[1], x[3])) / 8 / exact
    assert (found >= exact - 1e-12).all()
    assert (found - exact < most + 1e-9)[far].all() and far.sum() > 60


def test_its_derivative_is_right_also_where_segments_are_parallel(rng):
    x = tuple(map(jnp.asarray, capsules(rng, 99)))
    y = tuple(rng.normal(size=(99, 3)) * (a.any(axis=1, keepdims=True) if k % 2 else 1) for k, a in enumerate(x))
    along = lambda h: clearance.segments(*(a + h * b for a, b in zip(x, y, strict=True)))
    at = jax.jit(lambda h: jax.jvp(along, (h,), (1.0,)), **ONCE)
    (d, slope), numeric = at(0.0), (at(1e-6)[0] - at(-1e-6)[0]) / 2e-6
    assert d.min() > 0.01 and np.abs(slope - numeric).max() < 1e-7  # measured 7e-9


def test_the_level_of_an_ellipsoid_is_a_bound_below_its_distance(rng):
    body = Solid(link="b", position=(0.1, 0.0, 0.2), semi_axes=(0.3, 0.5, 0.9))
    rod = Solid(link="a", position=(0.0, 0.0, 0.0), to=(0.4, 0.1, 0.0), radius=0.05)
    shapes = {"a": rod, "b": replace(body, link=TASK.body.base)}
    task = replace(TASK, shapes=shapes, clearance=replace(TASK.clearance, pairs=(), contact=()))
    numbers, links = clearance.solids_of(task)
    assert links == ["a"]
    R = np.linalg.qr(rng.normal(size=(40, 2, 3, 3)))[0]
    R *= np.linalg.det(R)[..., None, None]
    p = np.stack([1.5 * rng.normal(size=(40, 3)), np.zeros((40, 3))], axis=1)
    level = np.asarray(jax.jit(clearance.apart, **ONCE)(numbers, R, p))[:, 0]
    exact = solids._distance((rod, R[:, 0], p[:, 0]), (shapes["b"], R[:, 1], p[:, 1]))
    assert (level <= exact + 1e-3)[exact > 0.1].all() and (exact > 0.1).sum() > 20


# -- what a task may say -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('link = "arm3"', 'link = "arm9"', ["[shapes.palm]", "'arm9'", "arm3"]),
        ("semi_axes = [0.25", "radius = 0.2\nsemi_axes = [0.25", ["[shapes.bus]", "semi_axes"]),
        ("semi_axes = [0.25", "semi_axes = [0.0", ["[shapes.bus]", "above zero"]),
        ('contact = [["palm", "bus"]]', "", ["'palm', 'bus'", "0.055", "contact"]),
        ('contact = [["palm", "bus"]]', 'contact = [["forearm", "bus"]]', ["contact", "'arm3'"]),
        ('contact = [["palm", "bus"]]', 'contact = [["palm", "bu"]]', ["no shape 'bu'", "bus"]),
        ('contact = [["palm", "bus"]]', 'contact = ["palm"]', ["contact in [clearance]", "must look like"]),
        ("[clearance]\ndistance", "[clearing]\ndistance", ["'clearing'", "did you mean 'clearance'"]),
        ("distance = 0.06", 'distance = 0.06\npairs = [["bus", "horn"]]', ["'bus', 'horn'", "one link"]),
        ("force = 0", "forse = 0", ["[gripper]", "did you mean 'force'"]),
        ("turn = 0", "turn = 4", ["turn in [base_attitude]", "to 3"]),
        ("axis = [1.0, 1.0, 0.0]", "axis = [0.0, 0.0, 0.0]", ["axis in [sight]", "no length"]),
    ],
)
def test_a_bad_mission_is_refused_in_one_sentence(old, new, words):
    assert old in SOURCE
    with pytest.raises(ValueError) as error:
        parse(SOURCE.replace(old, new, 1))
    message = str(error.value)
    assert all(word in message for word in words) and "\n" not in message, message


def test_who_does_not_ask_has_no_rows():
    task = planners.load("grasp_planar")
    assert mission.of(task) is None and mission.rows(task, 1.0, (4, 4, 4)) == ()


# -- the rows, of a motion that is made up -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def made_up():
    """Numbers of the task, three phases of three points each, and what the models say of them."""
    rng, data = np.random.default_rng(5), grasp.data(TASK)
    motions, phases = [], []
    for name, start in (("approach", 0.5), ("track", 4.5), ("stabilise", 6.0)):
        times = start + np.arange(3.0)
        R = Rotation.from_rotvec(0.5 * rng.normal(size=(3, 3))).as_matrix()
        p, q, v = 0.2 * rng.normal(size=(3, 3)), 0.5 * rng.normal(size=(3, 3)), 0.1 * rng.normal(size=(3, 9))
        motions.append(floating.Motion(times, R, p, q, v, 0 * v, q))
        states = (TASK.body, *grasp._states(data.target, times)) if name != "stabilise" else None
        robot = TASK.chaser if states else TASK.compound
        phases.append(SimpleNamespace(robot=robot, q=np.hstack([p, quaternions(R), q]), v=v, passive=states))
    return data, motions, phases


def test_the_rows_are_what_the_models_say(made_up):
    data, motions, phases = made_up
    below = jax.jit(lambda data: mission.below(data, 0.5, motions), **ONCE)(data)
    names = [row.name for row in mission.rows(TASK, 1.0, (2, 2, 2))]
    sizes = [row.size for row in mission.rows(TASK, 1.0, (2, 2, 2))]
    assert sum(sizes) == sum(map(len, below))
    got = dict(zip(names, np.split(np.concatenate(below), np.cumsum(sizes)[:-1]), strict=True))
    pairs = follow(SimpleNamespace(phases=phases))
    exact = np.concatenate([solids.apart(TASK, *pair) for pair in pairs])
    for k, (a, b) in enumerate(solids.pairs(TASK)):
        mine = solids.least(TASK)[k] + TASK.clearance.margin - got[f"clearance of {a!r} from {b!r}"][-9:]
        far = exact[:, k] > 0.1
        assert far.sum() > 3 and (mine[far] < exact[far, k] + 1e-3).all()
        if TASK.shapes[b].semi_axes is None:
            assert np.abs(mine - exact[:, k])[far].max() < 1e-3
    robots = [robot for robot, _ in pairs]
    R, _, twist = (np.concatenate(x) for x in zip(*(x.of(sdyn.Frame("base", "base")) for x in robots), strict=True))
    kept = 1 - TASK.limits.margin
    limit = replace(TASK.base_attitude, turn=kept * TASK.base_attitude.turn, rate=kept * TASK.base_attitude.rate)
    turn = np.array([np.linalg.norm(Rotation.from_matrix(x).as_rotvec()) for x in R])
    assert (np.sign(got["turn of the base"]) == np.sign(turn - limit.turn)).all()
    near = np.abs(turn - limit.turn) < 0.3
    assert np.abs(got["turn of the base"] - turn + limit.turn)[near].max() < 0.1
    fast = np.linalg.norm(twist[:, :3], axis=1)
    assert np.allclose(got["angular velocity of the base"], (fast**2 / limit.rate**2 - 1) / 2)
    sight, angle, camera = (
        TASK.sight,
        kept * TASK.sight.half_angle,
        sdyn.Frame("camera", "base", position=TASK.sight.position),
    )
    for k, (robot, target) in enumerate(pairs[:2]):
        R, p, _ = robot.of(camera)
        ray = target.of(TASK.body.frame("target_grasp"))[1] - p
        cosine = (ray * (R @ sight.axis)).sum(axis=1) / np.linalg.norm(ray, axis=1) / np.linalg.norm(sight.axis)
        rows = got["angle of sight"][-6 + 3 * k :][:3]
        assert np.abs(np.cos(angle) - cosine - np.sin(angle) * rows).max() < 1e-9


def test_the_certificate_sees_what_is_too_close(made_up):
    """Bodies that stand in the world, a known distance apart."""
    *_, phases = made_up
    (robot, target), *_ = follow(SimpleNamespace(phases=phases[:1]))
    still = lambda x, at: replace(x, R=np.zeros_like(x.R) + np.eye(3), p=np.zeros_like(x.p) + at)
    for gap, active in ((0.05, True), (0.09, True), (0.11, False)):
        # the horn lies along x, 0.3 from the target's origin; the trunk is a ball about the origin of all links
        pair = still(robot, 0.0), still(target, [-0.27, 0.0, gap + 0.3 + 0.02 - 0.30])
        rows = {row.name: row for row in certify_mission._clearance(TASK, [pair])}
        row = rows["lack of clearance of 'trunk' from 'horn'"]
        assert abs(row.value - (0.06 - gap)) < 1e-12 and row.ok == (gap > 0.06) and bool(row.touched) == active


# -- planned -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plan():
    return planners.plan(TASK, progress=False)


@pytest.mark.slow
def test_a_mission_is_planned_and_certified(plan):
    """What holds the solver's grid is touched, by other formulas on a finer one, and nothing is beyond its limit."""
    assert plan.status == "solved" and plan.certificate.passed, plan.verdict
    touched = "the clearance of 'palm' from 'horn'", "the limit of the angular velocity of the base"
    assert set(touched) <= set(plan.certificate.active)


@pytest.mark.slow
def test_both_solvers_agree_on_it():
    """The default solver stays where the referee went; from the first guess it goes to a better minimum, by 1.5 %."""
    judged = planners.plan(TASK, solver="casadi", progress=False)
    assert judged.status == "solved" and judged.certificate.passed, judged.verdict
    problem = grasp.problem(TASK)
    first, *_, state = sqp.solve(problem, problem.form.join(judged.variables)[None])
    ours = sqp.outcome(sqp.pick(state, 0))
    assert ours.status == "solved"
    assert abs(ours.cost - judged.info["cost"]) < 1e-6 * ours.cost  # measured 7e-8
    assert abs(sqp.pick(first, 0).near.cost - judged.info["cost"]) < 1e-12  # of one point, measured 2e-15
