"""Ten thousand mutations of robot and task files: each is refused in one sentence, or gives what can be computed with.

What is accepted goes through the check that `pack` makes, and then has a positive definite mass matrix, by a plain
program in NumPy that shares nothing with the kernels. Nothing is packed or compiled here.
"""

import copy
import json
import re
import time

import numpy as np
import pytest
from host_dynamics import mass_matrix
from hypothesis import given, settings
from hypothesis import strategies as st
from test_files import arm, crowded

from planners.task import FOLDER, TaskError
from planners.task import parse as parse_task
from sdyn import doctor, json_format, urdf
from sdyn.checks import RobotError

SLOWEST = 20.0  # s of this thread, for one file: a hang, not a speed; measured 0.05 s
MANY = dict(derandomize=True, deadline=None, database=None)

ROBOT = json.loads(json_format.write(crowded()))
ROBOT["source"] = ""
ROBOT["links"][-1].pop("allow_unphysical")
ROBOT["links"][-1] |= {"com": [0, 0.1, 0.2], "inertia": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
NUMBERS = [0, -0.0, 1, -1, 2.5, 1e-8, 1e8, 1e16, 1e-30, 1e30, 1e154, 1e-160, 5e-324, 1.7e308, -1e308, 10**400]
ODD = [*NUMBERS, None, True, "", "base", "ground", "b_planar", "1", [], {}, [0, 0, 1], [[]], np.eye(3).tolist()]


def places(tree, path=()):
    """Every path into nested objects and lists."""
    if path:
        yield path
    if isinstance(tree, dict | list):
        for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
            yield from places(value, (*path, key))


PLACES = list(places(ROBOT))
CHANGE = st.tuples(
    st.integers(0, len(PLACES) - 1), st.sampled_from(["put", "drop", "twice", "scale", "swap"]), st.sampled_from(ODD),
    st.integers(0, len(PLACES) - 1),
)  # fmt: skip


def mutated(top, changes):
    """A document with some places overwritten, removed, doubled, scaled, or exchanged with others."""
    top = copy.deepcopy(top)
    for at, how, odd, other in changes:
        try:
            *_, (place, key) = ((p, k) for p, k in _walk(top, PLACES[at]))
            *_, (there, name) = ((p, k) for p, k in _walk(top, PLACES[other]))
        except (LookupError, TypeError):
            continue  # an earlier change took it away
        if how == "put":
            place[key] = copy.deepcopy(odd)
        elif how == "drop":
            del place[key]
        elif how == "twice" and isinstance(place, list):
            place.insert(key, copy.deepcopy(place[key]))
        elif how == "scale" and isinstance(place[key], int | float) and isinstance(odd, int | float):
            place[key] = place[key] * float(min(odd, 1e308))
        elif how == "swap":
            place[key], there[name] = copy.deepcopy((there[name], place[key]))
    return top


def _walk(tree, path):
    for key in path:
        tree[key]
        yield tree, key
        tree = tree[key]


def computable(read, data) -> bool:
    """Whether the bytes are a robot; then everything that can be asked of it on the host works."""
    start = time.thread_time()
    try:
        robot = read(data)
        doctor.refuse_loose(robot)
    except RobotError as error:
        message = str(error)
        assert len(message) > 20 and "\n" not in message and message[-1] in ".?", message
        return False
    finally:
        assert time.thread_time() - start < SLOWEST
    assert json_format.read(json_format.write(robot)) == robot
    M = mass_matrix(robot)
    size = np.sqrt(np.diag(M))
    assert np.isfinite(M).all() and (size > 0).all()
    assert np.linalg.eigvalsh(M / np.outer(size, size)).min(initial=1.0) > 0
    return True


counts = {}


def count(name, good: bool):
    counts.setdefault(name, []).append(good)


@settings(max_examples=4000, **MANY)
@given(st.lists(CHANGE, min_size=1, max_size=3))
def test_json(changes):
    count("json", computable(json_format.read, json.dumps(mutated(ROBOT, changes)).encode()))


# -- text: URDF and TOML -----------------------------------------------------------------------------------------------

PIECE = re.compile(r"""[A-Za-z_]\w*|[-+.\w]+|"[^"]*"|\n|[^\w\s]""")
NEW = """0 -1 1e-160 1e30 1e308 1e400 nan 1_0 "" "a" a b [ { = < /> " \0 é true [[1]] 1979-05-27 &x; <!-- fixed floating
planar world"""
WORDS = [*NEW.split(), "9" * 400, "\n"]
DIGITS = re.compile(r"(?<=[\s\"\[])[-+]?[\d.][-+.\de]*")
SOME = ["0", "1", "-1", "2.5", "0.1", "3", "1e-8", "1e8", "-0.6", "1e-30", "1e16", "9.9e99"]
TEXT_CHANGE = st.one_of(
    st.tuples(st.integers(0, 9999), st.just("number"), st.sampled_from(SOME)),
    st.tuples(st.integers(0, 9999), st.sampled_from(["put", "drop", "twice", "cut"]), st.sampled_from(WORDS)),
)


def rewritten(text, changes) -> str:
    """A text with some of its words replaced, removed or doubled, or all cut off behind one."""
    for at, how, word in changes:
        pieces = list((DIGITS if how == "number" else PIECE).finditer(text))
        start, end = pieces[at % len(pieces)].span() if pieces else (0, 0)
        new = {"drop": "", "twice": text[start:end] * 2, "cut": ""}.get(how, word)
        text = text[:start] + new + ("" if how == "cut" and at % 7 == 0 else text[end:])
    return text


@settings(max_examples=4000, **MANY)
@given(st.lists(TEXT_CHANGE, min_size=1, max_size=3), st.sampled_from(["floating", "fixed", "prismatic", "revolute"]))
def test_urdf(changes, first):
    count("urdf", computable(urdf.read, rewritten(arm(first), changes).encode()))


TASKS = [(FOLDER / f"{name}.toml").read_text() for name in ("grasp", "identify", "reach")]
TASKS = ["\n".join(line.partition(" #")[0] for line in text.split("\n") if line[:1] != "#") for text in TASKS]


@settings(max_examples=2000, **MANY)
@given(st.lists(TEXT_CHANGE, min_size=1, max_size=3), st.sampled_from(TASKS))
def test_tasks(changes, text):
    start = time.thread_time()
    try:
        task = parse_task(rewritten(text, changes))
    except (TaskError, RobotError) as error:
        assert len(str(error)) > 20 and "\n" not in str(error), str(error)
        count("toml", False)
    else:
        limits = task.position_limits, task.rate_limits, task.torque_limits
        assert np.isfinite(task.first).all() and all((x[..., -1] > 0).all() for x in limits[1:]) and limits[0].ndim == 2
        count("toml", True)
    assert time.thread_time() - start < SLOWEST


@pytest.mark.parametrize(("name", "least"), [("json", 4000), ("urdf", 4000), ("toml", 2000)])
def test_the_mutations_were_made_and_are_of_both_sorts(name, least):
    """So many mutations as promised, and neither all refused nor all accepted."""
    assert len(counts[name]) >= least and 0.05 < np.mean(counts[name]) < 0.95, np.mean(counts[name])
