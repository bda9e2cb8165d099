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
    return *out, sdyn.loop_jacobian(chain, q), sdyn.loop_residual(chain, q), sdyn.body_poses(chain, q)[0]


CONSTRAINED = jax.jit(jax.vmap(constrained, (None, 0, 0, 0, None)), **QUICKLY)


@pytest.mark.parametrize(("name", "loop"), LOOPS)
def test_loops_of_trees(name, loop):
    """Accelerations and multipliers; a free base has no part in a closure between two links."""
    mine, info = closed(name, loop)
    chain, data = sdyn.pack(mine, loop_capacity()), oracles.tree(f"{name}_loop_{loop}")
    q, v = sdyn.pad(chain, data["q"], data["nu"])
    _, tau = sdyn.pad(chain, data["q"], data["tau"])
    vdot, lam, status, K, residual, R = CONSTRAINED(chain, q, v, tau, data["gravity"])
    close(sdyn.unpad(chain, q, vdot)[1], data["nudot"], 6e-14)  # 7.5e-15
    at, want = 0, []
    for x in info:  # theirs is [force; torque] on link a, world axes
        turn = np.asarray(R)[:, chain.capacity.link_names.index(f"l{x['link_a']}")] @ np.array(x["frame_a"]["R"])
        theirs = data["lam"][:, at : at + (6 if x["type"] == "6D" else 3)]
        want += [np.einsum("sji,sj->si", turn, y) for y in (theirs[:, 3:], theirs[:, :3]) if y.size]
        at += theirs.shape[1]
    close(lam[:, :at], np.concatenate(want, 1), 2e-13)  # 2.4e-14
    assert not np.asarray(lam)[:, at:].any()
    assert not np.asarray(K)[:, :, :6].any()
    close(residual, 0 * residual, 1e-14, scale=1.0)  # 1.3e-15
    assert (status.rank == at).all() and not np.asarray(status.singular).any()
    assert not np.asarray(status.error).max() > 2e-13  # 2.3e-14
