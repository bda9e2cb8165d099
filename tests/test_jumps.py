"""Changes of structure with closures: momentum, energy, restitution."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from structures import QUICKLY, UNBALANCED, close, states, tree

import sdyn

ENDS = sdyn.Frame("x", "l3", position=(0.1, 0.0, 0.2)), sdyn.Frame("y", "l8", position=(0.0, 0.3, 0.0))
OPEN = tree(UNBALANCED)
CLOSED = OPEN.close(*ENDS, "revolute", name="one")
CHANGES = {
    "close": (OPEN, CLOSED),
    "close another": (CLOSED, CLOSED.close("e1", "e0", "point", name="two")),
    "close to ground": (CLOSED, CLOSED.close("e0", "ground", "universal", name="two")),
    "lock on the loop": (CLOSED, CLOSED.lock({"j2": 0.0})),
    "lock and close": (OPEN, CLOSED.lock({"j5": 0.0}).close("e1", "e0", "point", name="two")),
    "re-root": (CLOSED, CLOSED.reroot("l6")),
    "ground": (CLOSED, CLOSED.ground("l0")),
    "open": (CLOSED, OPEN),
    "unlock": (CLOSED.lock({"j2": 0.3}), CLOSED),
}
SIZE = sdyn.capacity([x for pair in CHANGES.values() for x in pair] + [CLOSED.close("e1", "e0", "weld", name="two")])


@partial(jax.jit, **QUICKLY)
def jump(before, after, q, v, restitution):
    chain, q1, v1, impulse = sdyn.transfer(before, after, q, v, restitution=restitution)
    totals = lambda chain, q, v: (
        sdyn.momentum(chain, q, v), sdyn.centre_of_mass(chain, q), sdyn.kinetic_energy(chain, q, v)
    )  # fmt: skip
    K = sdyn.loop_jacobian(chain, q1)
    return chain, q1, v1, impulse, K, sdyn.loop_residual(chain, q1), totals(before, q, v), totals(chain, q1, v1)


@pytest.fixture
def start(request, rng):
    """A state of the first structure of a change, its closures at the relative poses of that state."""
    one, two = CHANGES[request.param]
    x = states(one, request.param)
    loose = replace(one, loops=())
    before = sdyn.pack(loose, SIZE)
    q, v = sdyn.pad(before, x.q[0], x.v[0])
    before, q, v, *_ = jump(before, sdyn.pack(one, SIZE), q, v, 0.0)
    return request.param, before, sdyn.pack(two, SIZE), q, v


@pytest.mark.parametrize("start", CHANGES, indirect=True)
def test_change(start):
    """Closed and moving as the closures allow; momentum kept or explained; energy never up; continuous where free."""
    change, before, after, q, v = start
    _, two = CHANGES[change]
    chain, q1, v1, impulse, K, residual, (h0, _, T0), (h1, c, T1) = jump(before, after, q, v, 0.0)
    close(residual, 0 * residual, 1e-13, scale=1.0)
    close(K @ v1, 0 * (K @ v1), 1e-11, scale=v1)
    assert T1 <= T0 * (1 + 1e-12)
    n = SIZE.links
    outer = np.zeros(6)
    R, p = sdyn.body_poses(chain, q1)
    for k, name in enumerate(SIZE.loop_names):
        loop = next((x for x in two.loops if x.name == name and x.frame_b.link == "ground"), None)
        if loop:
            link = SIZE.link_names.index(loop.frame_a.link)
            outer += moved(impulse[n + k], p[link] + R[link] @ loop.frame_a.position, c)
    if two.grounded:
        outer += moved(impulse[SIZE.link_names.index(two.base)], p[SIZE.link_names.index(two.base)], c)
    close(np.asarray(h1), np.asarray(h0) + outer, 1e-11, scale=h0)
    if change in ("open", "unlock", "re-root"):
        close(T1, T0, 1e-12)
        close(impulse, 0 * impulse, 1e-12, scale=h0)


def moved(wrench, x, c):
    """A wrench about x, about c."""
    wrench, arm = np.asarray(wrench), np.asarray(x) - np.asarray(c)
    return np.r_[wrench[:3] + np.cross(arm, wrench[3:]), wrench[3:]]


@pytest.mark.parametrize("start", ["close", "close another", "lock and close"], indirect=True)
def test_restitution(start):
    """New closures part at a fraction of the rate at which they met, old ones stay closed; energy in between."""
    change, before, after, q, v = start
    out = {e: jump(before, after, q, v, e) for e in (0.0, 0.5, 1.0)}
    K, T = out[0.0][4], {e: float(x[-1][2]) for e, x in out.items()}
    close(K @ out[0.5][2], K @ out[1.0][2] / 2, 1e-11, scale=v)
    close(out[0.5][2], (out[0.0][2] + out[1.0][2]) / 2, 1e-12)
    close(out[1.0][-1][0], out[0.0][-1][0], 1e-11)
    T0 = float(out[0.0][-2][2])
    assert T[0.0] < T[0.5] < T[1.0] <= T0 * (1 + 1e-12)
    if change == "close":
        close(T[1.0], T0, 1e-12)
    if change == "close another":
        old = np.arange(SIZE.rows) < 5
        close((K @ out[1.0][2])[old], np.zeros(5), 1e-11, scale=v)
