"""Computed from another base, in the user's coordinates: the same accelerations, forces and slopes."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from functions import FD, SOLVE, fd
from structures import QUICKLY, capacity, close, on_states, packed, robot, state, tree

import sdyn
from sdyn import doctor, heaviest

FD_OTHER, SOLVE_OTHER = on_states(fd, **QUICKLY), on_states(sdyn.solve_mass, **QUICKLY)
NAMES = ("leaf_as_base", "all_kinds_backwards", "locked_tip_base", "grounded", "passive_kinds")


@pytest.fixture
def chains(monkeypatch):
    """Chains of the table that are all computed from their heaviest body, and as they are packed otherwise."""
    plain = {name: packed(name) for name in NAMES}
    monkeypatch.setattr(heaviest, "SMALL", 0.9)
    size = replace(capacity(), rebased=True)
    return {name: (sdyn.pack(robot(name), size), plain[name]) for name in NAMES}


def test_accelerations_and_solves_are_the_same(chains):
    for name, (other, plain) in chains.items():
        x = state(name)
        heaviest_link = max(robot(name).links, key=lambda link: link.mass).name
        assert heaviest.better_base(robot(name)) == (None if name == "grounded" else heaviest_link)
        args = x.q, x.v, x.tau, x.gravity, x.f_ext
        close(FD_OTHER(other, *args), FD(plain, *args), 1e-11)  # measured 3e-13
        close(SOLVE_OTHER(other, x.q, x.vdot), SOLVE(plain, x.q, x.vdot), 1e-11)  # measured 2e-13


def test_parameters_and_locks_reach_the_other_base(chains):
    """Also where they are changed after packing."""
    other, plain = chains["locked_tip_base"]
    x = state("locked_tip_base")

    def changed(chain):
        p = sdyn.params(chain)
        chain = sdyn.with_params(chain, replace(p, mass=p.mass * 1.3, com=p.com + 0.01))
        return sdyn.with_locks(chain, {"j4": -0.2})

    args = x.q, x.v, x.tau, x.gravity, x.f_ext
    want = FD(changed(plain), *args)
    close(FD_OTHER(changed(other), *args), want, 1e-11)  # measured 2e-13
    assert np.abs(FD(plain, *args) - want).max() > 1e-3


def test_packing_says_so():
    """`sdyn check` names the link; and a capacity that knows only ordinary bases refuses, rather than lose digits."""
    good = tree((0, 1, 2))
    base = replace(good.links[0], mass=1e-7, inertia=1e-7 * np.eye(3))
    bad = replace(good, links=(base, *good.links[1:]))
    (note,) = [x for x in doctor.examine(bad) if "computed instead" in x.wrong]
    assert note.level == "note" and note.part == "link 'l0'" and heaviest.better_base(bad) in note.wrong
    assert sdyn.pack(good).inner is None and sdyn.pack(bad).inner is not None
    both = sdyn.capacity([good, bad])
    assert both.rebased and sdyn.pack(good, both).inner is not None
    with pytest.raises(sdyn.RobotError, match="too light"):
        sdyn.pack(bad, sdyn.capacity([good]))


@pytest.mark.slow
def test_slopes_are_the_same(chains):
    """With respect to the state, forces, gravity and wrenches, forward and reverse."""
    along = on_states(lambda chain, x, dx: jax.jvp(lambda *x: fd(chain, *x), x, dx), **QUICKLY)
    back = jax.jit(lambda chain, x: jax.grad(lambda *x: jnp.sin(fd(chain, *x)).sum(), range(5))(*x), **QUICKLY)
    for name in NAMES[:3]:
        other, plain = chains[name]
        x = state(name)[:5]
        dx = tuple(jnp.cos(3.0 * y + 1) for y in x)
        for a, b in zip(along(other, x, dx), along(plain, x, dx), strict=True):
            close(a, b, 1e-10)
        one = tuple(y[0] for y in x)
        for a, b in zip(back(other, one), back(plain, one), strict=True):
            close(a, b, 1e-9)
