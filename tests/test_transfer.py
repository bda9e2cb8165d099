"""What a change of structure does to poses, momentum, energy and accelerations, and its derivatives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from functions import FD, MASS, MOTION, POSES, TOTALS, TRANSFER
from structures import (
    QUICKLY,
    STATES,
    UNBALANCED,
    capacity,
    close,
    frames_of,
    links_of,
    padded,
    real,
    renamed,
    robot,
    states,
    tree,
)  # fmt: skip
from test_gradients import differences

import sdyn

SHIPPED = sdyn.models.names()


def pack(robot):
    return sdyn.pack(robot, capacity())


def each(before, after, q, v):
    """The transfer of all states, one by one."""
    return [TRANSFER(before, after, q[k], v[k]) for k in range(len(q))]


def stacked(rows):
    return [np.stack([np.asarray(row[k]) for row in rows]) for k in (1, 2, 3)]


# -- re-rooting --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHIPPED)
def test_rerooting_at_every_link(name):
    """Poses, energy, momentum and, under joint torques, the accelerations of every link do not change; and back."""
    mine = renamed(sdyn.models.load(name))
    before, x = pack(mine), states(mine, name)
    x = padded(mine, before, x._replace(tau=x.tau * (np.arange(mine.nv) >= 6)))
    rows = slice(0, 2)
    links, frames = np.array(links_of(mine)), np.array(frames_of(mine))
    want = TOTALS(before, x.q, x.v), POSES(before, x.q), FD(before, x.q, x.v, x.tau, x.gravity, x.f_ext)
    A = np.asarray(MOTION(before, x.q, x.v, want[2])[3])[:, frames]
    for link in mine.links[1:]:
        after = pack(mine.reroot(link.name))
        moved = each(before, after, x.q, x.v)
        q, v, impulse = stacked(moved)
        for a, b in zip(POSES(after, q), want[1], strict=True):
            close(a[:, links], np.asarray(b)[:, links], 9e-15, scale=1.0)  # 8.9e-16
        for a, b in zip(TOTALS(after, q, v), want[0], strict=True):
            close(a, b, 2e-14)  # 1.6e-15
        vdot = FD(after, q, v, x.tau, x.gravity, x.f_ext)
        found = np.asarray(MOTION(after, q, v, vdot)[3])[:, frames]
        for k in range(STATES):  # each state for itself, on light hands as base too
            close(found[k], A[k], 1e-11)
            close(vdot[k, 6:], want[2][k, 6:], 1e-11, scale=want[2][k])
        close(impulse, 0 * impulse, 2e-15, scale=want[0][0])  # 2.9e-17
        for k in range(STATES)[rows]:
            _, back_q, back_v, _ = TRANSFER(after, before, q[k], v[k])
            sign = np.where(np.isin(np.arange(before.nq), range(3, 7)), np.sign(back_q[3:7] @ x.q[k, 3:7]), 1.0)
            close(back_q * sign, x.q[k], 2e-14)  # 1.4e-15
            close(back_v, x.v[k], 2e-13)  # 1.5e-14


# -- changes of one tree -----------------------------------------------------------------------------------------------

TREE = tree(UNBALANCED)
POSE = [0.3, -0.2, 0.5, 0.5, 0.5, -0.5, 0.5]
LOCKS = {"j0": 0.4, "j4": -1.1, "j7": 2.0}
# before, after, and the rows of the velocity before that the change stops: joints, or the base's twist
CHANGES = {
    "nothing": (TREE, TREE, []),
    "lock": (TREE, TREE.lock(LOCKS), ["j0", "j4", "j7"]),
    "lock everything": (TREE, TREE.lock({f"j{k}": 0.0 for k in range(8)}), [f"j{k}" for k in range(8)]),
    "unlock": (TREE.lock(LOCKS), TREE, []),
    "ground": (TREE, TREE.ground("l0"), ["base"]),
    "release": (TREE.ground("l0", POSE), TREE, []),
    "grapple": (TREE, TREE.reroot("l8").ground("l8"), ["c8"]),
    "ungrapple": (TREE.reroot("l8").ground("l8", POSE), TREE.reroot("l3"), []),
    "lock and re-root": (TREE, TREE.lock(LOCKS).reroot("l6"), ["j0", "j4", "j7"]),
    "lock when grounded": (TREE.ground("l0", POSE), TREE.ground("l0", POSE).lock({"j2": 1.0}), ["j2"]),
}


def momenta(robot, chain, q, v):
    """Momentum of every link [n, 6] about its own origin, world axes."""
    R, p = (np.asarray(y)[:, np.array(links_of(robot))] for y in POSES(chain, q))
    V = np.asarray(MOTION(chain, q, v, 0 * v)[2])[:, np.array(frames_of(robot))]
    P = np.array([link.mass for link in robot.links])[:, None] * V[..., 3:]
    I = R @ np.array([link.inertia for link in robot.links]) @ R.swapaxes(-1, -2)
    c = np.einsum("snij,nj->sni", R, np.array([link.com for link in robot.links]))
    return np.concatenate([np.einsum("snij,snj->sni", I, V[..., :3]) + np.cross(c, P), P], -1), p


@pytest.mark.parametrize("change", CHANGES)
def test_change(change):
    """Poses stay; the jump is the plastic one; momentum is kept or explained by the impulse; energy never grows."""
    one, two, stopped = CHANGES[change]
    before, after = pack(one), pack(two)
    x = padded(one, before, states(one, change))
    rows = each(before, after, x.q, x.v)
    q, v, impulse = stacked(rows)
    after_of = [row[0] for row in rows]
    links = np.array(links_of(one))
    now = lambda f, *x: jax.tree.map(
        lambda *y: np.stack([z[0] for z in y]), *(f(c, *(z[[k] * STATES] for z in x)) for k, c in enumerate(after_of))
    )
    poses = now(POSES, q)
    for a, b in zip(poses, POSES(before, x.q), strict=True):
        close(a[:, links], np.asarray(b)[:, links], 2e-14, scale=1.0)  # 1.4e-15

    # the jump v+ = v- - M^-1 K^T (K M^-1 K^T)^-1 K v-, with the structure before
    M, at = np.asarray(MASS(before, x.q)), real(one)
    J = np.asarray(MOTION(before, x.q, x.v, 0 * x.v)[4])
    V = np.asarray(MOTION(before, x.q, x.v, 0 * x.v)[2])
    names, frames = [joint.name for joint in one.moving], capacity().frame_names
    want, change_of_v = np.array(x.v), np.zeros_like(x.v)
    for k in range(STATES):
        eye = np.eye(before.nv)
        K = [
            eye[:6] if s == "base" else J[k, frames.index(s)] if s[0] == "c" else eye[[6 + names.index(s)]]
            for s in stopped
        ]
        if K:
            K = np.concatenate(K)[:, at]
            own = np.linalg.inv(M[k][np.ix_(at, at)])
            change_of_v[k, at] = -own @ K.T @ np.linalg.solve(K @ own @ K.T, K @ np.asarray(x.v)[k, at])
            want[k] += change_of_v[k]
    frames = np.array(frames_of(one))
    V_after = now(MOTION, q, v, 0 * v)[2]
    V_want = V + np.einsum("sfkv,sv->sfk", J, change_of_v)
    close(V_after[:, frames], V_want[:, frames], 5e-14)  # 4.2e-15

    # energy and momentum
    T = 0.5 * np.einsum("si,sij,sj->s", x.v, M, x.v)
    T_after = now(TOTALS, q, v)[2]
    assert (T_after <= T * (1 + 1e-12)).all()
    if not stopped:
        close(T_after, T, 2e-14)  # 1.5e-15
        close(impulse, 0 * impulse, 2e-15, scale=np.abs(M).max() * np.abs(x.v).max())  # 8.9e-17
    else:
        assert (T_after[[0, 1, 3]] < T[[0, 1, 3]]).all()
    h = TOTALS(before, x.q, x.v)[0]
    h_after = now(TOTALS, q, v)[0]
    if not two.grounded:
        close(h_after, h, 9e-15)  # 8.5e-16

    # of each link: what comes through its joint, less what goes on, is the change of its momentum
    h, p = momenta(one, before, x.q, x.v)
    h_after = now(lambda c, q, v: momenta(two, c, q, v)[0], q, v)
    net = impulse[:, links].copy()
    for i, parent in enumerate(two.tree.parent):
        if parent >= 0:
            n, f = impulse[:, links[i], :3], impulse[:, links[i], 3:]
            net[:, parent] -= np.concatenate([n + np.cross(p[:, i] - p[:, parent], f), f], -1)
    close(net, h_after - h, 9e-15, scale=h)  # 8.3e-16


# -- capture and release -----------------------------------------------------------------------------------------------


def pair():
    chaser, target = tree((0, 1, 2), seed=5), tree((0, 0), first=4, seed=6, base_mass=8.0)
    strip = lambda robot, mark: sdyn.Robot(robot.links, robot.joints, (*robot.frames[:-2], mark))
    rotation = robot("chain").frames[-1].rotation
    return strip(chaser, sdyn.Frame("e0", "l3", rotation, (0.1, 0.2, 0.3))), strip(
        target, sdyn.Frame("e1", "l5", position=(0, 0, 0))
    )


CAPTURES = [("capacity", "fixed"), ("capacity", "revolute"), ("capacity", "spherical")]


@pytest.mark.parametrize(("layout", "kind"), [*CAPTURES, pytest.param("exact", "revolute", marks=pytest.mark.slow)])
def test_capture_and_release(kind, layout):
    """Two free robots become one: the jump of the constrained pair, momentum kept; detached again, nothing jumps."""
    chaser, target = pair()
    both = chaser.attach(target, "e0", "e1", kind, "j30")
    assert both.nv == chaser.nv + target.nv - 6 + both.joint("j30").dof
    to = (lambda r: sdyn.pack(r, capacity())) if layout == "capacity" else sdyn.pack
    a, b, c = map(to, (chaser, target, both))
    x, y = states(chaser, "chaser"), states(target, "target")
    # the second stands so that the marks coincide
    i, j = partial(sdyn.frame_pose, frame="e0"), partial(sdyn.frame_pose, frame="e1")
    pad = padded if layout == "capacity" else (lambda r, chain, z: z)
    x, y = pad(chaser, a, x), pad(target, b, y)
    R, p = i(a, x.q[0])
    S, s = j(b, y.q[0])
    turn = np.asarray(R @ S.T)
    qb = np.array(y.q[0])
    base = np.asarray(sdyn.body_poses(b, y.q[0])[0])[capacity().link_names.index("l4") if layout == "capacity" else 0]
    qb[:3] = turn @ (qb[:3] - s) + p
    qb[3:7] = quaternion(turn @ base)
    qs, vs = (x.q[0], jnp.asarray(qb)), (x.v[0], y.v[0])
    after, q, v, _ = TRANSFER((a, b), c, qs, vs)

    total = lambda chain, q, v: (np.asarray(sdyn.momentum(chain, q, v)), np.asarray(sdyn.centre_of_mass(chain, q)))
    (h1, c1), (h2, c2), (h, centre) = total(a, qs[0], vs[0]), total(b, qs[1], vs[1]), total(after, q, v)
    shift = lambda h, c: np.r_[h[:3] + np.cross(c - centre, h[3:]), h[3:]]
    close(h, shift(h1, c1) + shift(h2, c2), 9e-15)  # 8.8e-16
    energy = lambda chain, q, v: float(sdyn.kinetic_energy(chain, q, v))
    T = energy(a, qs[0], vs[0]) + energy(b, qs[1], vs[1])
    assert 0 < energy(after, q, v) < T

    # the jump: the pair's own mass matrix, and twists of the marks that agree in what the joint holds
    M = np.zeros((a.nv + b.nv,) * 2)
    M[: a.nv, : a.nv], M[a.nv :, a.nv :] = sdyn.mass_matrix(a, qs[0]), sdyn.mass_matrix(b, qs[1])
    Ja, Jb = (np.asarray(sdyn.frame_jacobian(chain, z, e)) for chain, z, e in ((a, qs[0], "e0"), (b, qs[1], "e1")))
    K = np.concatenate([Ja, -Jb], 1)
    z = np.asarray(R)[:, 2]
    held = {
        "fixed": np.eye(6),
        "spherical": np.eye(6)[3:],
        "revolute": np.r_[np.linalg.svd(np.outer(z, z))[0].T[1:] @ np.eye(3, 6), np.eye(6)[3:]],
    }[kind]
    K, v0 = held @ K, np.concatenate([np.asarray(w) for w in vs])
    at = np.concatenate([real(chaser), real(target)]) if layout == "capacity" else np.ones(len(v0), bool)
    own, K = np.linalg.inv(M[np.ix_(at, at)]), K[:, at]
    new = v0.copy()
    new[at] -= own @ K.T @ np.linalg.solve(K @ own @ K.T, K @ v0[at])
    close(energy(after, q, v), 0.5 * new @ M @ new, 6e-15)  # 6.0e-16
    close(sdyn.frame_velocity(after, q, v, "e0"), Ja @ new[: a.nv], 2e-14)  # 1.3e-15
    close(sdyn.frame_velocity(after, q, v, "e1"), Jb @ new[a.nv :], 2e-13)  # 1.5e-14
    for e, chain, w in (("e0", a, qs[0]), ("e1", b, qs[1])):
        for got, want in zip(sdyn.frame_pose(after, q, e), sdyn.frame_pose(chain, w, e), strict=True):
            close(got, want, 8e-15, scale=1.0)  # 7.8e-16

    # and apart again: the states of the two, with what they have now
    parts, q2, v2, impulses = TRANSFER(after, (a, b), q, v)
    for k, start in enumerate(qs):
        sign = np.ones(len(start))
        sign[3:7] = np.sign(q2[k][3:7] @ start[3:7])
        close(q2[k] * sign, start, 4e-15)  # 3.6e-16
    close(np.concatenate(v2), new, 3e-14)  # 3.0e-15
    assert len(parts) == len(impulses) == 2
    for k in range(2):
        close(impulses[k], 0 * impulses[k], 2e-15, scale=h)  # 4.4e-17


def quaternion(R):
    """Of a rotation matrix, from the eigenvector of its axis-angle form."""
    K = np.array([
        [R[0, 0] + R[1, 1] + R[2, 2], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
        [R[2, 1] - R[1, 2], R[0, 0] - R[1, 1] - R[2, 2], R[1, 0] + R[0, 1], R[0, 2] + R[2, 0]],
        [R[0, 2] - R[2, 0], R[1, 0] + R[0, 1], R[1, 1] - R[0, 0] - R[2, 2], R[2, 1] + R[1, 2]],
        [R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[2, 1] + R[1, 2], R[2, 2] - R[0, 0] - R[1, 1]],
    ])  # fmt: skip
    return np.linalg.eigh(K)[1][:, -1]


def test_exact_layout_equals_capacity():
    """Locking a moving joint and grounding, in exact sizes."""
    for change in ("lock", "grapple"):
        one, two, _ = CHANGES[change]
        x = states(one, change)
        y = padded(one, pack(one), x)
        a, q, v, impulse = TRANSFER(sdyn.pack(one), sdyn.pack(two), x.q[0], x.v[0])
        b, *want = TRANSFER(pack(one), pack(two), y.q[0], y.v[0])
        want_q, want_v = sdyn.unpad(b, *want[:2])
        close(q, want_q, 2e-15)  # 0
        close(v, want_v, 9e-15)  # 8.5e-16
        close(impulse, np.asarray(want[2])[np.array(links_of(one))], 9e-15)  # 8.1e-16
        close(a.base_value[-7:], b.base_value[-7:], 2e-15)  # 0


# -- derivatives ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("change", ["lock and re-root", "grapple", "unlock"])
def test_gradient(change, rng):
    """Of the state, impulse, lock values and ground pose after, with respect to the state, masses and lock values."""
    one, two, _ = CHANGES[change]
    before, after = pack(one), pack(two)
    y = padded(one, before, states(one, change))
    x = (y.q[0], y.v[0], before.link_mass, before.joint_value)
    along = [rng.normal(size=z.shape) for z in x]
    along[1] = along[1] * real(one)
    along[2], along[3] = along[2] * np.asarray(x[2]), 0.1 * along[3]
    along[3][:, :30] = 0.0  # lock values only: of placements that are no rotation, a pose has no quaternion
    run = transfer_slope()
    value, g = run(before, after, x)
    for k in range(4):
        assert np.isfinite(g[k]).all()
        only = tuple(d if i == k else np.zeros_like(d) for i, d in enumerate(along))
        want = differences(lambda x: run(before, after, x)[0], x, only, 1e-4)
        close((np.asarray(g[k]) * along[k]).sum(), want, 5e-10, scale=value)  # 4.1e-11


def transfer_slope(found=[]):  # noqa: B006  (compiled once)
    def value(before, after, x):
        from dataclasses import replace

        q, v, mass, joints = x
        new = lambda chain: replace(chain, link_mass=mass, joint_value=joints)
        before, after = (sdyn.with_params(new(chain), sdyn.params(new(chain))) for chain in (before, after))
        chain, q, v, impulse = sdyn.transfer(before, after, q, v)
        wave = lambda y: (y * jnp.cos(jnp.arange(y.size, dtype=y.dtype)).reshape(y.shape)).sum()
        return (
            wave(q)
            + wave(v)
            + wave(impulse)
            + wave(chain.joint_value[:, 30:])
            + wave(chain.base_value[-7:])
            + wave(chain.link_pose)
        )

    if not found:
        found.append(jax.jit(jax.value_and_grad(value, 2), **QUICKLY))
    return found[0]
