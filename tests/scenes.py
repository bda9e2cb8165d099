"""Motions with references that are not this library's: chain, states (qs, vs) of it, force, step, gravity."""

import mechanisms
import numpy as np
import oracles

import sdyn

DOWN = np.array([0.0, -9.81, 0.0])


def free(t, q, v):
    """No force."""
    return 0 * v


def andrews():
    """The squeezer over 0.03 s, in quadruple precision."""
    (model, p), data, names = mechanisms.andrews(), oracles.raw("andrews"), mechanisms.ANDREWS
    truth = tuple(np.stack([data[x + end] for x in names], 1) for end in ("", "_dot"))
    return sdyn.pack(model), truth, mechanisms.andrews_force(p), data["t"][1], None


def top(name="top_generic", inertia=(1.0, 2.0, 3.0)):
    """A free top, in quadruple precision."""
    data = oracles.raw(name)
    chain = sdyn.pack(sdyn.Robot([sdyn.Link("top", 1.0, inertia=np.diag(inertia))]))
    rows, none = slice(0, 9), np.zeros((9, 3))
    q = np.c_[none, np.stack([data[k][rows] for k in ("qw", "qx", "qy", "qz")], 1)]
    v = np.c_[np.stack([data[k][rows] for k in ("wx", "wy", "wz")], 1), none]
    return chain, (q, v), free, data["t"][1], None


def fast_top():
    """One at 300 rad/s."""
    return top("top_fast_spin", (2.0, 2.5, 4.0))


def four_bar():
    """The one of RigidBodyDynamics.jl, against 30 digits."""
    data, names = oracles.raw("fourbar_rbdjl"), ("theta", "gamma", "phi")
    truth = tuple(np.stack([data[x + end][:41] for x in names], 1) for end in ("", "_dot"))
    return sdyn.pack(mechanisms.four_bar("point")), truth, free, data["t"][1], DOWN


def governor():
    """The stiff one, against quadruple precision."""
    (model, force), data = mechanisms.flyball(), oracles.raw("flyball_governor")
    columns = lambda end: np.stack([data[x + end][:41] for x in ("phi", "s", "th", "th")], 1)
    return sdyn.pack(model), (columns(""), columns("_dot")), force, data["t"][1], np.array([0.0, 0.0, -9.81])


def pendulum():
    """The double pendulum, against quadruple precision."""
    data = oracles.raw("double_pendulum")
    a, b, da, db = (data[k][:41] for k in ("a", "b", "a_dot", "b_dot"))
    truth = np.stack([a, b - a], 1), np.stack([da, db - da], 1)
    return sdyn.pack(mechanisms.double_pendulum()), truth, free, data["t"][1], DOWN


def unsigned(found, truth):
    """Quaternions, of a free base, on the side of those of the truth."""
    (q, v), (want, _) = (tuple(map(np.asarray, x)) for x in (found, truth))
    if q.shape[1] != 7 or v.shape[1] != 6:  # not a single free body
        return q, v
    side = np.sign((q[:, 3:] * want[:, 3:]).sum(1, keepdims=True))
    return np.c_[q[:, :3], side * q[:, 3:]], v
