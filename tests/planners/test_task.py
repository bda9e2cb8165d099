import numpy as np
import pytest

import planners
from planners.task import FOLDER, parse

GRASP = (FOLDER / "grasp.toml").read_text()


@pytest.mark.parametrize("name", ["grasp", "identify", "identify_load", "reach"])
def test_shipped_tasks_load(name):
    task = planners.load(name)
    assert task.name == name and len(task.joints) == len(task.rate_limits) == len(task.start)
    assert np.isfinite(task.torque_limits).all()


def test_the_grasp_has_thirteen_degrees_of_freedom_before_and_after():
    task = planners.load("grasp")
    assert task.chaser.nv == task.compound.nv == 13 and task.body.nv == 6


def test_the_identification_has_nine():
    assert planners.load("identify").chaser.nv == 9


def test_limits_of_the_task_replace_the_robots():
    assert np.array_equal(planners.load("grasp").torque_limits, np.full(7, 5.0))
    assert np.array_equal(parse(GRASP.replace("torque = 5.0", "")).torque_limits, np.full(7, 80.0))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("kind =", "kinds =", ["kind is None", "'grasp'"]),
        ('kind = "grasp"', 'kind = "dance"', ["'dance'", "'identify'"]),
        ("margin = 0.02", "margins = 0.02", ["[limits]", "'margins'", "did you mean 'margin'"]),
        ("margin = 0.02", "margin = 2", ["margin in [limits]", "from 0 to 0.5"]),
        ("margin = 0.02", "margin = nan", ["margin in [limits]", "nan"]),
        ("margin = 0.02", 'margin = "small"', ["margin in [limits]", "'small'"]),
        ("position = [-2.158, 0.712, -2.968]", "position = [1.0]", ["position in [target]", "3 numbers"]),
        ("twist = [", "twists = [", ["'twists'", "did you mean 'twist'"]),
        ("quaternion = [0.56395963", "quaternion = [0.9", ["unit vector"]),
        ('model = "deos7"', 'model = "deos8"', ["deos8", "deos7"]),
        ('model = "deos7"', 'model = "none.json"', ["none.json"]),
        ('frame = "hand"', 'frame = "hant"', ["'hant'", "'hand'"]),
        ("joint1 = -0.6", "joint9 = -0.6", ["joint9"]),
        ("joint1 = -0.6", "joint1 = -6.0", ["'joint1'", "outside its limits"]),
        ("duration = [5.0, 15.0]", "duration = [15.0, 5.0]", ["[phases.approach]", "shortest"]),
        ("[phases.track]", "[phases.follow]", ["'follow'", "track"]),
        ("intervals = 56", "intervals = 5.5", ["intervals in [phases.approach]", "whole number"]),
        ("time = 0.02", "time = 0.02\ntime = 0.03", ["not valid TOML"]),
    ],
)
def test_a_bad_task_is_refused_in_one_sentence_that_names_the_key(old, new, words):
    assert old in GRASP
    with pytest.raises(ValueError) as error:
        parse(GRASP.replace(old, new, 1))
    message = str(error.value)
    assert all(word in message for word in words), message
    assert "\n" not in message


def test_a_file_or_name_that_is_not_there_is_named(tmp_path):
    with pytest.raises(planners.TaskError, match="did you mean 'grasp'"):
        planners.load("grasps")
    with pytest.raises(planners.TaskError, match="there is no file"):
        planners.load(tmp_path / "mine.toml")
    (tmp_path / "mine.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(planners.TaskError, match="not UTF-8"):
        planners.load(tmp_path / "mine.toml")


BAD = [
    ({"solver": "magic"}, "no solver"),
    ({"seeds": 0}, "seeds"),
    ({"accuracy": "best"}, "'balanced'"),
    ({"accuracy": "-1"}, "'1e-6'"),
]


@pytest.mark.parametrize(("option", "words"), BAD)
def test_bad_options_are_refused(option, words):
    with pytest.raises(planners.TaskError, match=words):
        planners.plan(planners.load("grasp"), progress=False, **option)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('["base", "load"]', '["hand"]', ["'hand'", '["base", "load"]']),
        ('[load] # in the hand\nmodel = "sat50"\nframe = "grasp"\n', "", ["section [load]"]),
        ('model = "sat50"', 'model = "deos7"', ["[load]", "one free link"]),
        ("gyro_bias = true", "gyro_bias = 1", ["gyro_bias", "true or false"]),
    ],
)
def test_a_bad_identification_is_refused(old, new, words):
    source = planners.load("identify_load").source
    assert old in source
    with pytest.raises(ValueError) as error:
        parse(source.replace(old, new, 1))
    assert all(word in str(error.value) for word in words), error.value
