"""What `examine` finds, and what `repaired` makes of it."""

from itertools import pairwise

import numpy as np
import pytest

from sdyn import doctor, models
from sdyn.checks import is_physical, principal_moments
from sdyn.parts import Joint, Link
from sdyn.robot import Robot

I = 0.1 * np.eye(3)
GOOD = {"limits": (-1, 1), "rate": 1.0, "effort": 1.0}


def chain(*links, kind="revolute", **joint) -> Robot:
    """Links in a row, each on the one before."""
    bounds = {**GOOD, **joint}
    if kind == "spherical":
        bounds.pop("limits")
    joints = [
        Joint(f"j{i}", kind, a.name, b.name, position=(0, 0, 1), axis=(1, 0, 0), **bounds)
        for i, (a, b) in enumerate(pairwise(links), 1)
    ]
    return Robot(links, joints)


def found(robot) -> list:
    return [(x.level, x.part) for x in doctor.examine(robot)]


BASE = Link("base", 10.0, inertia=I)


def test_a_sound_robot_has_no_findings():
    assert doctor.examine(chain(BASE, Link("a", 1.0, inertia=I), Link("b", 1.0, inertia=I))) == ()
    assert doctor.examine(Robot([BASE])) == ()


def test_impossible_inertias_and_their_repair():
    bad = Link("a", 1.0, inertia=np.diag([1.0, 1.0, 5.0]), allow_unphysical=True)
    worse = Link("b", 1.0, inertia=np.diag([-1.0, 1.0, 1.0]), allow_unphysical=True)
    robot = chain(BASE, bad, worse)
    first, second = (x for x in doctor.examine(robot) if x.level == "error" and x.part.startswith("link"))
    assert first.part == "link 'a'" and "(1, 1, 5)" in first.wrong and "(2, 2, 4)" in first.repair
    assert second.part == "link 'b'" and "negative" in second.wrong
    assert str(first).startswith("error: link 'a' has an impossible inertia") and str(first).endswith(".")
    better = doctor.repaired(robot)
    assert all(is_physical(link.mass, link.inertia) and not link.allow_unphysical for link in better.links)
    assert better.link("base") == robot.link("base") and better.joints == robot.joints
    assert doctor.repaired(better) == better


def test_the_repair_is_the_nearest_possible_inertia():
    rng = np.random.default_rng(0)
    for _ in range(50):
        A = rng.normal(size=(3, 3))
        A = A + A.T
        near = doctor.nearest_inertia(A)
        assert is_physical(1.0, near)
        assert np.allclose(doctor.nearest_inertia(near), near, atol=1e-14)
        least = np.linalg.norm(near - A)
        for _ in range(100):  # nothing possible, near or far, is nearer
            step = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-4, 0)
            other = near + step + step.T
            assert not principal_moments(other)[:2].sum() >= principal_moments(other)[2] or (
                np.linalg.norm(other - A) >= least - 1e-12
            )


@pytest.mark.parametrize("kind", ["revolute", "prismatic", "spherical", "universal", "planar"])
def test_a_leaf_without_mass_names_the_joint_above(kind):
    robot = chain(BASE, Link("a", 1.0, inertia=I), Link("tip", 0.0), kind=kind)
    (finding,) = doctor.examine(robot)
    assert (finding.level, finding.part) == ("error", "joint 'j2'") and "'tip'" in finding.wrong
    assert (
        doctor.examine(robot.lock({"j2": [1, 0, 0, 0] if kind == "spherical" else [0.0] * robot.joint("j2").nq})) == ()
    )


def test_a_leaf_without_mass_is_found_from_every_base():
    robot = chain(Link("tip", 0.0), Link("a", 1.0, inertia=I), BASE)
    assert ("error", "joint 'j1'") in found(robot.reroot("base")) and ("error", "joint 'j1'") in found(
        robot.reroot("a")
    )
    assert ("error", "link 'tip'") in found(robot) or ("error", "joint 'j1'") in found(robot)


def test_links_without_mass_in_the_middle_are_fine():
    arm = Link("a", 1.0, inertia=I)
    assert doctor.examine(chain(BASE, Link("middle", 0.0), arm)) == ()
    assert doctor.examine(chain(BASE, arm, Link("rotor", 0.0), rotor_inertia=0.1)) == ()
    fixed = Robot(
        [BASE, arm, Link("eye", 0.0)], [Joint("j", "revolute", "base", "a", **GOOD), Joint("f", "fixed", "a", "eye")]
    )
    assert doctor.examine(fixed) == ()
    # a mass further out, but on the axis of both joints
    spin = Robot(
        [BASE, Link("middle", 0.0), Link("point", 1.0)],
        [Joint("j", "revolute", "base", "middle", **GOOD), Joint("k", "fixed", "middle", "point", position=(0, 0, 1))],
    )
    assert ("error", "joint 'j'") in found(spin)
    aligned = chain(BASE, Link("a", 0.0), Link("b", 0.0), Link("point", 1.0, inertia=I), kind="prismatic")
    assert ("error", "joint 'j1'") in found(aligned) or ("error", "joint 'j2'") in found(aligned)


def test_a_free_base_needs_inertia():
    assert ("error", "link 'base'") in found(Robot([Link("base", 0.0)]))
    assert ("error", "link 'base'") in found(Robot([Link("base", 1.0)]))
    assert doctor.examine(Robot([Link("base", 0.0)]).ground("base")) == ()


def test_missing_and_impossible_bounds():
    arm = Link("a", 1.0, inertia=I)
    assert found(chain(BASE, arm, rate=None)) == [("warning", "joint 'j1'")]
    assert found(chain(BASE, arm, effort=None)) == [("warning", "joint 'j1'")]
    assert found(chain(BASE, arm, effort=0.0)) == [("warning", "joint 'j1'")]
    assert found(chain(BASE, arm, limits=None)) == [("note", "joint 'j1'")]
    assert found(chain(BASE, arm, kind="prismatic", limits=None)) == [("warning", "joint 'j1'")]
    assert found(chain(BASE, arm, limits=(1, 1))) == [("warning", "joint 'j1'")]
    assert found(chain(BASE, arm, limits=(-170, 170))) == [("note", "joint 'j1'")]
    assert found(chain(BASE, arm, rate=None).lock({"j1": 0.5})) == []
    assert found(chain(BASE, arm).lock({"j1": 1.5})) == [("warning", "joint 'j1'")]


def test_values_that_look_like_other_units():
    assert found(Robot([Link("a", 1.0, (700, 0, 0), I)])) == [("note", "link 'a'")]
    assert found(Robot([Link("a", 1.0, inertia=1e6 * I)])) == [("note", "link 'a'")]
    assert ("note", "link 'point'") in found(chain(BASE, Link("point", 1.0, (0, 1, 0))))
    assert ("note", "link 'a'") in found(chain(BASE, Link("a", 0.0, inertia=I)))


def test_errors_come_first():
    levels = [x.level for x in doctor.examine(chain(BASE, Link("a", 1.0), Link("tip", 0.0), rate=None, limits=None))]
    assert levels == sorted(levels, key=("error", "warning", "note").index) and len(set(levels)) == 3


def test_shipped_models_have_notes_at_most():
    for name in models.names():
        assert {x.level for x in doctor.examine(models.load(name))} <= {"note"}
