"""Closed chains against the reference data, and the laws of closures."""

import json
from functools import cache

import jax
import numpy as np
import oracles
import pytest
from structures import QUICKLY, close, robot

import sdyn

LOOPS = [
    ("tree7", "3D"),
    ("tree7", "6D"),
    ("tree11", "6D"),
    ("tree11", "6D_3D"),
    ("tree17", "3D"),
    ("tree17", "6D_3D"),
]


@cache
def closed(name, loop) -> tuple[sdyn.Robot, list]:
    """A tree of the reference data with its loops, and their description."""
    info = json.loads((oracles.DATA / f"{name}_loop_{loop}.json").read_text())["loops"]
    mine = robot(name)
    for k, x in enumerate(info):
        a, b = (sdyn.Frame(f"{e}{k}", f"l{x[f'link_{e}']}", x[f"frame_{e}"]["R"], x[f"frame_{e}"]["p"]) for e in "ab")
        mine = mine.close(a, b, "weld" if x["type"] == "6D" else "point", name=f"loop{k}")
    return mine, info


@cache
def loop_capacity() -> sdyn.Capacity:
    return sdyn.capacity([closed(*x)[0] for x in LOOPS])


def constrained(chain, q, v, tau, gravity):
    out = sdyn.constrained_dynamics(chain, q, v, tau, gravity=gravity)
    by_partition = sdyn.constrained_dynamics(chain, q, v, tau, gravity=gravity, method="partition")[:2]
    return *out, by_partition, sdyn.loop_jacobian(chain, q), sdyn.loop_residual(chain, q), sdyn.body_poses(chain, q)[0]


CONSTRAINED = jax.jit(jax.vmap(constrained, (None, 0, 0, 0, None)), **QUICKLY)


@pytest.mark.parametrize(("name", "loop"), LOOPS)
def test_loops_of_trees(name, loop):
    """Accelerations and multipliers by both methods; a free base has no part in a closure between two links."""
    mine, info = closed(name, loop)
    chain, data = sdyn.pack(mine, loop_capacity()), oracles.tree(f"{name}_loop_{loop}")
    q, v = sdyn.pad(chain, data["q"], data["nu"])
    _, tau = sdyn.pad(chain, data["q"], data["tau"])
    vdot, lam, status, (vdot2, lam2), K, residual, R = CONSTRAINED(chain, q, v, tau, data["gravity"])
    for found in (vdot, vdot2):
        close(sdyn.unpad(chain, q, found)[1], data["nudot"], 6e-14)  # 7.5e-15
    at, want = 0, []
    for x in info:  # theirs is [force; torque] on link a, world axes
        turn = np.asarray(R)[:, chain.capacity.link_names.index(f"l{x['link_a']}")] @ np.array(x["frame_a"]["R"])
        theirs = data["lam"][:, at : at + (6 if x["type"] == "6D" else 3)]
        want += [np.einsum("sji,sj->si", turn, y) for y in (theirs[:, 3:], theirs[:, :3]) if y.size]
        at += theirs.shape[1]
    for found in (lam, lam2):
        close(found[:, :at], np.concatenate(want, 1), 2e-13)  # 2.4e-14
        assert not np.asarray(found)[:, at:].any()
    assert not np.asarray(K)[:, :, :6].any()
    close(residual, 0 * residual, 1e-14, scale=1.0)  # 1.3e-15
    assert (status.rank == at).all() and not np.asarray(status.singular).any()
    assert not np.asarray(status.error).max() > 2e-13  # 2.3e-14


# -- grapples ----------------------------------------------------------------------------------------------------------


@cache
def grapples() -> dict:
    """Of each tree: its tip; free, its tip tied to the ground by a closure, and with the tip as a grounded base."""
    out = {}
    for name in oracles.TREES:
        mine, tip = robot(name), f"l{int(oracles.raw(f'{name}_grapple')['tip_link'])}"
        out[name] = tip, [mine, mine.close(sdyn.Frame("tip", tip), "ground", name="grip"), mine.reroot(tip).ground(tip)]
    size = sdyn.capacity([x for _, variants in out.values() for x in variants])
    return {name: (tip, [sdyn.pack(x, size) for x in variants]) for name, (tip, variants) in out.items()}


def grapple(before, after, q, v, tau, gravity):
    """The state after, its accelerations, and what a judge of the jump needs."""
    chain, q, v, impulse = sdyn.transfer(before, after, q, v)
    vdot, lam, status = sdyn.constrained_dynamics(chain, q, v, tau, gravity=gravity)
    totals = sdyn.momentum(chain, q, v), sdyn.centre_of_mass(chain, q), sdyn.kinetic_energy(chain, q, v)
    return chain, q, v, impulse, vdot, lam, status, sdyn.body_poses(chain, q), totals


GRAPPLE = jax.jit(jax.vmap(grapple, (None, None, 0, 0, 0, None)), **QUICKLY)


@pytest.mark.parametrize("name", oracles.TREES)
def test_grapples(name):
    """The plastic jump, its impulse, and the accelerations after it: as a closure to ground, and as a grounded base."""
    tip, (free, tied, fixed) = grapples()[name]
    data, world = oracles.tree(f"{name}_grapple"), oracles.raw(f"{name}_grapple")
    q, v = sdyn.pad(free, data["q"], data["nu_before"])
    tau = sdyn.pad(free, data["q"], data["tau"])[1]
    *_, totals = GRAPPLE(free, free, q, v, tau, data["gravity"])
    _, q1, v1, impulse, vdot, lam, status, (R, p), after = GRAPPLE(free, tied, q, v, tau, data["gravity"])
    n, k, nv = free.capacity.links, free.capacity.link_names.index(tip), data["nu_after"].shape[-1]
    exact = lambda y: sdyn.unpad(tied, q1, y)[1]
    close(exact(v1), data["nu_after"], 1e-13)  # 1.1e-14
    close(exact(vdot), data["nudot"], 2e-13)  # 2.3e-14
    turn = lambda x: np.einsum("sij,sj->si", R[:, k], x)
    close(turn(lam[:, 3:]), world["lam"][:, :3], 1e-13, scale=world["lam"])  # 8.1e-15
    close(turn(lam[:, :3]), world["lam"][:, 3:], 1e-13, scale=world["lam"])
    assert (status.rank == 6).all()

    # the impulse of the closure is the jump of momentum, and what the ground gives to the base that is grounded there
    at_tip = np.asarray(impulse)[:, n]
    close(at_tip[:, 3:], world["impulse_on_tip"][:, :3], 1e-13)  # 1.2e-14
    close(at_tip[:, :3], world["impulse_on_tip"][:, 3:], 1e-13, scale=at_tip)
    (h0, *_, T0), (h1, c, T1) = totals, after
    arm = np.asarray(p)[:, k] - np.asarray(c)
    close(h1 - h0, np.concatenate([at_tip[:, :3] + np.cross(arm, at_tip[:, 3:]), at_tip[:, 3:]], 1), 2e-14)  # 1.8e-15
    assert (T1 < T0).all()
    only_joints = np.asarray(tau) * (np.arange(tau.shape[-1]) >= 6)
    _, _, v2, by_ground, a, *_ = GRAPPLE(free, fixed, q, v, only_joints, data["gravity"])
    close(np.asarray(by_ground)[:, k], at_tip, 2e-13)  # 1.3e-14
    close(v2[:, 6:nv], v1[:, 6:nv], 2e-13)  # 2.4e-14
    b = GRAPPLE(free, tied, q, v, only_joints, data["gravity"])[4]
    close(np.asarray(a)[:, 6:nv], np.asarray(b)[:, 6:nv], 1e-12)


def test_float32():
    """A closed tree in float32: as near as that allows, and nothing is promoted."""
    mine, data = closed("tree17", "6D_3D")[0], oracles.tree("tree17_loop_6D_3D")
    chain = sdyn.pack(mine, loop_capacity(), dtype="float32")
    q, v = sdyn.pad(chain, data["q"], data["nu"])
    single = [np.asarray(x, np.float32) for x in (q, v, sdyn.pad(chain, data["q"], data["tau"])[1], data["gravity"])]
    vdot, lam, status, *_ = CONSTRAINED(chain, *single)
    want = CONSTRAINED(sdyn.pack(mine, loop_capacity()), *(np.asarray(x, float) for x in single))
    assert vdot.dtype == lam.dtype == np.float32 and (status.rank == 9).all()
    close(vdot, want[0], 2e-5)  # 1.9e-6
    close(lam, want[1], 2e-5)  # 1.5e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", oracles.TREES)
def test_float32_of_grapples(name):
    """Jump, impulse and accelerations of a robot that grasps the ground, from the state that float32 holds."""
    _, (free, tied, _) = grapples()[name]
    data = oracles.tree(f"{name}_grapple")
    q, v = sdyn.pad(free, data["q"], data["nu_before"])
    state = [np.asarray(x, np.float32) for x in (q, v, sdyn.pad(free, data["q"], data["tau"])[1], data["gravity"])]
    *_, v1, impulse, vdot, lam, status, _, _ = GRAPPLE(*sdyn.PRESETS["fast"].cast((free, tied)), *state)
    want = GRAPPLE(free, tied, *(np.asarray(x, float) for x in state))[2:6]
    assert vdot.dtype == np.float32 and (status.rank == 6).all()
    for found, exact in zip((v1, impulse, vdot, lam), want, strict=True):
        close(found, exact, 5e-5)  # 2e-5 at most
