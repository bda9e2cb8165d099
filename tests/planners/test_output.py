"""What a person sees of a plan: figures, the animation, progress. The plan is synthetic: smooth, not a solution."""

import io
import re
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console

import planners
import sdyn
from planners import animation, figures, motion, progress, shapes

LAST = 30.0  # s
SPANS = {"wait": (0.0, 4.0), "approach": (4.0, 18.0), "track": (18.0, 22.0), "stabilise": (22.0, LAST)}


@pytest.fixture(scope="module")
def plan():
    """A chaser that waves its arm at a tumbling target, and carries it in the last phase."""
    chaser, target = sdyn.models.load("planar3"), sdyn.models.load("sat50").prefixed("target_")
    compound = chaser.attach(target, "hand", "target_grasp")
    phases = []
    for name, (start, end) in SPANS.items():
        times = np.linspace(start, end, 40)
        q, v = wave(chaser, times)
        capture = name == "stabilise"
        robot, passive = (compound, None) if capture else (chaser, (target, *tumble(times)))
        tau = np.zeros_like(v)
        phases.append(SimpleNamespace(name=name, robot=robot, times=times, q=q, v=v, tau=tau, passive=passive))
    bounds = np.array([1.0, 1.0, np.inf])
    task = SimpleNamespace(
        name="grasp",
        kind="grasp",
        joints=chaser.moving,
        position_limits=np.array([[-2.0, 2.0]] * 3),
        rate_limits=bounds,
        torque_limits=100.0 * bounds,
        tolerance=SimpleNamespace(position=1e-3, angle=1e-3, speed=1e-3),
        robot=SimpleNamespace(frame="hand"),
        target=SimpleNamespace(frame="grasp"),
        body=target,
        load_body=None,
        goal=None,
        base=None,
        shapes={},
        clearance=None,
    )
    return SimpleNamespace(task=task, phases=tuple(phases), status="solved")


@pytest.fixture(scope="module")
def motions(plan):
    return motion.follow(plan)


def wave(robot, times):
    """q [k, nq] and v [k, nv] of a base that rests and joints that swing."""
    q = np.tile(robot.neutral(), (len(times), 1))
    v = np.zeros((len(times), robot.nv))
    for j, (size, rate) in enumerate(((0.3, 0.2), (0.8, 0.15), (0.5, 0.1))):
        q[:, 7 + j], v[:, 6 + j] = size * np.sin(rate * times), size * rate * np.cos(rate * times)
    return q, v


def tumble(times):
    """q [k, 7] and v [k, 6] of a body that drifts along x and spins about z."""
    rate, drift = 0.05, 0.01
    q = np.zeros((len(times), 7))
    q[:, 0], q[:, 1] = 2.0 + drift * times, 1.0
    q[:, 3], q[:, 6] = np.cos(rate * times / 2), np.sin(rate * times / 2)
    v = np.zeros((len(times), 6))
    v[:, 2], v[:, 3], v[:, 4] = rate, drift * np.cos(rate * times), -drift * np.sin(rate * times)
    return q, v


# -- figures -----------------------------------------------------------------------------------------------------------


def test_figures_are_drawn(plan, tmp_path):
    before = dict(matplotlib.rcParams)
    paths = figures.draw(plan, tmp_path / "new")
    names = {"joint_angles", "joint_rates", "joint_torques", "base", "momentum", "grasp"}
    assert {path.stem for path in paths} == names == {path.stem for path in (tmp_path / "new").iterdir()}
    for path in paths:
        picture = imread(path)
        assert min(picture.shape[:2]) > 300 and picture.std() > 0.05
    assert dict(matplotlib.rcParams) == before


def test_labels_have_units_and_phases_have_names(plan):
    figure = figures.joints(plan, "torques")
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["limit", *SPANS]
    assert [axes.get_ylabel() for axes in figure.axes] == ["N m"] * 3


def test_joints_that_are_locked_in_a_phase_are_drawn_in_the_others(plan):
    phases = list(plan.phases)
    last = phases[-1]
    locked = last.robot.lock({"joint2": 0.3})
    phases[-1] = SimpleNamespace(**{**vars(last), "robot": locked, "q": np.delete(last.q, 8, 1)})
    figure = figures.joints(SimpleNamespace(task=plan.task, phases=phases), "angles")
    curves = [[line for line in axes.lines if line.get_linestyle() == "-"] for axes in figure.axes]
    assert list(map(len, curves)) == [4, 3, 4]


def test_separation_is_that_of_the_frames(plan, motions):
    phase, (robot, target) = plan.phases[0], motions[0]
    distance, angle, speed, spin = figures.separation(plan.task, robot, target)
    R, p, twist = robot.of(phase.robot.frame("hand"))
    grip = target.p[:, 0] + target.R[:, 0] @ target.robot.frames[0].position
    np.testing.assert_allclose(distance, np.linalg.norm(grip - p, axis=1), atol=1e-12)
    rate = np.gradient(np.einsum("kji,kj->ki", R, grip - p), phase.times, axis=0, edge_order=2)
    np.testing.assert_allclose(speed, np.linalg.norm(rate, axis=1), atol=1e-3)
    spins = phase.passive[2][:, :3] - twist[:, :3]
    np.testing.assert_allclose(spin, np.linalg.norm(spins, axis=1), atol=1e-12)
    assert angle.min() >= 0.0


def test_momentum_is_that_of_sdyn_and_its_shares_add_up(plan, motions):
    for phase, pair in zip(plan.phases, motions, strict=True):
        found = figures.shares(pair, {"target_target"}, "base")
        np.testing.assert_allclose(found["chaser"] + found["target"], found["total"], atol=1e-12)
        whole, k = sdyn.pack(phase.robot), 17
        about_com, com = sdyn.momentum(whole, phase.q[k], phase.v[k]), sdyn.centre_of_mass(whole, phase.q[k])
        angular = about_com[:3] + np.cross(com, about_com[3:])
        own = found["chaser" if phase.passive else "total"]
        np.testing.assert_allclose(own[k], np.concatenate([angular, about_com[3:]]), atol=1e-11)
    free = figures.shares(motions[0], {"target_target"}, "base")["target"]  # a free body keeps its momentum
    np.testing.assert_allclose(free, np.tile(free[0], (len(free), 1)), atol=1e-12)


def test_rotation_vectors_do_not_jump():
    angle = np.linspace(0.0, 5.5, 50)
    zero, one = np.zeros(50), np.ones(50)
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]]).transpose(2, 0, 1)
    np.testing.assert_allclose(figures.rotation_vectors(R), np.column_stack([zero, zero, angle]), atol=1e-12)


def test_quaternions_and_rotations_are_inverse():
    q = np.random.default_rng(0).normal(size=(50, 4))
    q[:4] = np.eye(4)
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    back = motion.quaternions(motion.rotations(q))
    np.testing.assert_allclose(np.abs((q * back).sum(1)), 1.0, atol=1e-14)


def test_figures_of_an_identification(plan, tmp_path):
    results = {"sigma_percent": {"m": 0.2, "Ixx": 0.01}, "singular_values": [3.0, 1.0], "subspace": "all"}
    results |= {"log_det": 2.25, "condition_number": None}
    other = {"kind": "identify", "body": None, "sensors": SimpleNamespace(gyro=1e-5)}
    task = SimpleNamespace(**{**vars(plan.task), **other})
    phase = SimpleNamespace(**{**vars(plan.phases[0]), "passive": None})
    alone = SimpleNamespace(task=task, phases=(phase,), info={"results": results})
    names = {path.stem for path in figures.draw(alone, tmp_path)}
    assert {"gyro", "information", "momentum"} <= names and "grasp" not in names
    del results["sigma_percent"]
    left, right = figures.information(alone).axes
    assert left.texts[0].get_text() == "all" and right.texts[0].get_text() == "log det: 2.25"


# -- animation ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def page(plan, tmp_path_factory):
    path = tmp_path_factory.mktemp("animation") / "plan.html"
    animation.write(plan, path)
    assert [x.name for x in path.parent.iterdir()] == ["plan.html"]
    return path.read_text(encoding="utf-8")


def test_page_needs_no_network(page):
    assert set(re.findall(r"""https?://[^"'\s)<>]+""", page)) <= {"http://www.w3.org/2000/svg"}  # a name, not a link
    assert not re.search(
        r"""<(script|link|img|iframe)[^>]+(src|href)=["']?(?!["']|data:|#)""", page[:5000] + page[-5000:]
    )
    assert "__VISER_EMBED_DATA__" in page and "<title>grasp: solved</title>" in page
    assert 300_000 < len(page) < 5_000_000


def test_page_is_made_in_silence(plan, tmp_path, capfd):
    animation.write(plan, tmp_path / "plan.html")
    assert capfd.readouterr() == ("", "")


def test_a_failed_page_leaves_the_old_one(plan, tmp_path, monkeypatch):
    path = tmp_path / "plan.html"
    path.write_text("old")
    monkeypatch.setattr(animation, "robot_shapes", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        animation.write(plan, path)
    assert path.read_text() == "old" and len(list(tmp_path.iterdir())) == 1


def test_tracks_follow_the_links(plan):
    times = animation.frame_times(plan)
    assert times[0] == 0.0 and times[-1] == LAST and np.diff(times).max() <= 1.01 / animation.FRAMES_PER_SECOND
    tracks = animation.tracks(plan, times)
    assert set(tracks) == {"base", "arm1", "arm2", "arm3", "target_target"}
    present, quaternion, position = tracks["target_target"]
    assert present.all()
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0, atol=1e-12)
    free = times < SPANS["stabilise"][0]
    np.testing.assert_allclose(position[free, 0], 2.0 + 0.01 * times[free], atol=1e-9)


@pytest.mark.parametrize("name", sdyn.models.names())
def test_every_link_of_every_model_has_a_shape(name):
    robot = sdyn.models.load(name)
    drawn = shapes.robot_shapes(robot)
    assert list(drawn) == [link.name for link in robot.links]
    for solids in drawn.values():
        assert solids and shapes.extent(solids) < 20.0
        for shape in solids:
            np.testing.assert_allclose(shape.rotation.T @ shape.rotation, np.eye(3), atol=1e-12)
            assert min(shape.size) > 0.0 and np.linalg.det(shape.rotation) > 0.0


def test_a_load_in_the_hand_is_shown_as_a_target_is():
    task = planners.load("identify_load")
    shown = animation._shapes(SimpleNamespace(task=task, phases=[SimpleNamespace(robot=task.chaser)]))
    assert {shape.color for shape in shown["load_target"]} >= {shapes.ORANGE, shapes.PANEL}
    assert shown.keys() == {link.name for link in task.chaser.links}


def test_the_goal_of_a_reach_is_shown_where_the_hand_ends():
    task = planners.load("reach")
    shown = animation._shapes(SimpleNamespace(task=task, phases=[SimpleNamespace(robot=task.chaser)]))
    (goal,) = animation._goal(task, shown)
    (hand,) = [shape for shape in shown[task.chaser.frame("hand").link] if shape.kind == "axes"]
    assert goal.kind == "axes" and goal.size[0] == 2 * hand.size[0]
    np.testing.assert_allclose(motion.quaternions(goal.rotation), task.goal.quaternion, atol=1e-7)
    anywhere = SimpleNamespace(goal=SimpleNamespace(position=task.goal.position, quaternion=None))
    (ball,) = animation._goal(anywhere, shown)
    assert ball.kind == "ball" and tuple(ball.position) == task.goal.position


def test_the_box_of_a_box_is_that_box():
    edges = np.array([0.4, 1.0, 2.0])
    link = sdyn.Link("box", 7.0, inertia=7.0 / 12.0 * np.diag((edges**2).sum() - edges**2))
    found, axes = shapes.box_of(link)
    np.testing.assert_allclose(np.abs(axes @ found), edges, atol=1e-12)


# -- progress ----------------------------------------------------------------------------------------------------------


def shown(terminal, **options) -> str:
    out = io.StringIO()
    console = Console(file=out, force_terminal=terminal, width=80, highlight=False)
    with progress.Live("planning", 3, console=console, **options) as live:
        live.compiling("the solver")
        for k in range(1, 101):
            live.iteration(k, 1.0 / k, 10.0 ** (-k / 20), 0.1, 2)
        live.note("The last word.")
    assert live.compile_s > 0.0
    return out.getvalue()


def test_progress_without_a_terminal_is_a_few_plain_lines():
    lines = shown(False, iterations=200, tolerance=1e-6).splitlines()
    assert lines[0] == "planning (3 seeds)" and lines[1].startswith("compiling the solver: 0.")
    assert lines[2].startswith("iteration 1: cost 1.00000") and lines[-2].startswith("iteration 100: ")
    assert lines[-1] == "The last word." and len(lines) <= 8 and max(map(len, lines)) <= 100


def test_progress_on_a_terminal_is_a_table():
    text = shown(True, iterations=200, tolerance=1e-6)
    for word in ("iteration", "feasibility", "time left", "compiling the solver", "The last word.", "0.0100000"):
        assert word in text


def test_the_table_of_several_seeds_fits_80_columns(monkeypatch):
    clock = iter(range(0, 10**6, 700))
    monkeypatch.setattr(progress.time, "monotonic", lambda: float(next(clock)))
    live = progress.Live("grasp", 4, show=False, iterations=150)
    for k in range(1, 13):
        live.iteration(k + 100, -1.23456e-5, 1.2e-10, 1.2e-10, 13 - k)
    out = io.StringIO()
    Console(file=out, width=80).print(live._draw())
    title, heads, *rows = out.getvalue().splitlines()
    assert title == "grasp (4 seeds)"
    assert heads.split() == ["iteration", "cost", "feasibility", "step", "elapsed", "time", "left", "seeds"]
    assert len(rows) == 10 and max(map(len, rows)) <= 80
    whole = r" +1\d\d +-1.23456e-05 +1.2e-10 1.2e-10 +\d+ min \d\d s < \d+ min \d\d s +"
    for row, seeds in zip(rows, range(10, 0, -1), strict=True):
        assert re.fullmatch(f"{whole}{seeds} ?", row)


def test_progress_can_be_silent():
    assert shown(True, show=False) == "" == shown(False, show=False)


def test_time_left_comes_from_the_pace(monkeypatch):
    clock = iter(range(1000))
    monkeypatch.setattr(progress.time, "monotonic", lambda: float(next(clock)))
    live = progress.Live("planning", show=False, iterations=100, tolerance=1e-8)
    for k in range(1, 6):
        live.iteration(k, 1.0, 10.0**-k, 0.1)
    assert live._left() == "3.0 s"  # a power of ten each second, three to go
    live.iteration(6, 1.0, 0.0, 0.1)
    assert live._left() == "< 94 s"  # feasible: at most to the limit


@pytest.mark.parametrize(("x", "text"), [(0.31, "0.3 s"), (12.4, "12 s"), (185.0, "3 min 05 s")])
def test_durations_read_well(x, text):
    assert progress.duration(x) == text
