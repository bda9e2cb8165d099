"""Trees of 7, 11 and 17 joints against data of an independent program; composites by hand; a floater in closed form."""

import json
from functools import partial

import numpy as np
import oracles
import pytest
from functions import BIAS, FD, ID, MASS, MOTION, POSES, SLOPES, SOLVE, TOTALS, TRANSFER
from oracles import TREES
from structures import (
    QUICKLY,
    STATES,
    State,
    capacity,
    close,
    frames_of,
    links_of,
    on_links,
    on_states,
    padded,
    q_rate,
    real,
    renamed,
    robot,
    states,
)

import sdyn

GRAVITY = oracles.raw("tree7_states")["gravity_g1"]
COUNT = 20  # states in each file


def run(f, chain, *arrays):
    """f over all states of a file, `STATES` at a time."""
    parts = [f(chain, *(x[k : k + STATES] for x in arrays)) for k in range(0, len(arrays[0]), STATES)]
    if isinstance(parts[0], tuple):
        return tuple(np.concatenate(x) for x in zip(*parts, strict=True))
    return np.concatenate(parts)


def state_of(name, chain, data, f_ext=None, **other) -> State:
    """The states of a file in the common capacity."""
    mine = robot(name)
    f_ext = np.zeros((COUNT, len(mine.links), 6)) if f_ext is None else f_ext
    x = {"tau": data["tau"], "vdot": data["nu"], **other}
    gravity = np.tile(GRAVITY, (COUNT, 1))
    return padded(mine, chain, State(data["q"], data["nu"], x["tau"], gravity, f_ext, x["vdot"]))


@pytest.fixture(params=TREES, scope="module")
def tree(request):
    """Name, chain, reference data, states of a tree."""
    name, data = request.param, oracles.tree(request.param + "_states")
    chain = sdyn.pack(robot(name), capacity())
    f_ext = oracles.wrenches(data, data["wrench_link"], data["link_p_world"])
    return name, chain, data, state_of(name, chain, data, f_ext)


def block(name, x):
    """The entries of M, a Jacobian or a vector that belong to the robot."""
    at = real(robot(name))
    return x[..., at][..., at, :] if x.shape[-2:] == (at.size, at.size) else x[..., at]


def test_poses(tree):
    name, chain, data, x = tree
    R, p = run(POSES, chain, x.q)
    close(R[:, links_of(robot(name))], data["link_R_world"], 8e-15)  # 7.8e-16
    close(p[:, links_of(robot(name))], data["link_p_world"], 2e-15)  # 2.0e-16


def test_mass_matrix(tree):
    name, chain, data, x = tree
    M, want = block(name, run(MASS, chain, x.q)), data["M"]
    close(M, want, 2e-15)  # 1.6e-16
    d = np.sqrt(np.einsum("sii->si", want))
    entries = d[:, :, None] * d[:, None]
    close(M / entries, want / entries, 1e-13)  # 9.9e-15


def test_bias(tree):
    name, chain, data, x = tree
    close(block(name, run(BIAS, chain, x.q, x.v, x.gravity)), data["bias_g1"], 4e-15)  # 3.1e-16
    close(block(name, run(BIAS, chain, x.q, x.v, 0 * x.gravity)), data["bias_g0"], 5e-15)  # 4.6e-16


def test_accelerations(tree):
    name, chain, data, x = tree
    rest = 0 * x.f_ext
    for key, gravity, f_ext in (("a", 0 * x.gravity, rest), ("b", x.gravity, x.f_ext), ("c", x.gravity, rest)):
        close(block(name, run(FD, chain, x.q, x.v, x.tau, gravity, f_ext)), data[f"nudot_{key}"], 6e-14)  # 5.6e-15


def test_inverse_mass(tree):
    name, chain, data, x = tree
    at = np.flatnonzero(real(robot(name)))
    for k, want in enumerate(data["Minv"]):
        for i in range(0, len(at), STATES):
            columns = at[np.minimum(np.arange(i, i + STATES), len(at) - 1)]
            b = np.eye(chain.nv)[columns]
            got = SOLVE(chain, np.tile(x.q[k], (STATES, 1)), b)
            close(block(name, np.asarray(got)), want[np.searchsorted(at, columns)], 4e-14, scale=want)  # 3.1e-15


def test_points(tree):
    """Jacobians and accelerations of the end-effectors; accelerations of all centres of mass."""
    name, chain, data, x = tree
    still = 0 * x.vdot
    _, _, V, A, J = run(MOTION, chain, x.q, x.v, still)
    ends = [chain.capacity.frame_names.index(f"e{k}") for k in range(data["J_ee"].shape[1])]
    close(block(name, J[:, ends]), data["J_ee"], 6e-15)  # 5.6e-16
    close(A[:, ends], data["Jdot_nu_ee"], 5e-15)  # 4.3e-16
    close(V[:, ends], np.einsum("skij,sj->ski", data["J_ee"], data["nu"]), 6e-15)  # 5.8e-16
    vdot = state_of(name, chain, data, vdot=data["nudot_b"]).vdot
    _, _, _, A, _ = run(MOTION, chain, x.q, x.v, vdot)
    close(A[:, frames_of(robot(name))], data["link_com_acc_and_alpha_world_b"], 7e-15)  # 6.5e-16


def test_energy_and_momentum(tree):
    _, chain, data, x = tree
    h, c, T = run(TOTALS, chain, x.q, x.v)
    close(c, data["com_world"], 2e-15)  # 1.1e-16
    close(T, data["kinetic_energy"], 5e-15)  # 4.5e-16
    close(h[:, 3:], data["lin_momentum_world"], 4e-15)  # 3.9e-16
    want = oracles.about(data["com_world"], data["ang_momentum_world_origin"], data["lin_momentum_world"])
    close(h[:, :3], want, 3e-15, scale=data["ang_momentum_world_origin"])  # 2.4e-16


def test_derivatives(tree):
    """Of accelerations, against the complex step: along p += R dx, R <- R exp(dth), q += dq, and along v."""
    name, chain, data, x = tree
    mine, at, n = robot(name), real(robot(name)), len(data["dnudot_dxi_c"])
    of_q, of_v = SLOPES(chain, *(y[:STATES] for y in (x.q, x.v, x.tau, x.gravity, 0 * x.f_ext)))
    for k in range(n):
        close(block(name, np.asarray(of_v[k])), data["dnudot_dnu_c"][k], 7e-14)  # 6.1e-15
        steps = np.stack([q_rate(mine, data["q"][k], e) for e in np.eye(mine.nv)], 1)
        got = np.asarray(of_q[k])[at][:, : mine.nq] @ steps
        close(got, data["dnudot_dxi_c"][k], 2e-13)  # 1.2e-14


@pytest.mark.parametrize("name", TREES)
def test_locked_joints(name):
    data, file = oracles.tree(f"{name}_locked"), oracles.tree(f"{name}_states")
    data = data | {key: file[key] for key in ("q", "tau")}
    mine, full = robot(name), sdyn.pack(robot(name), capacity())
    n = len(mine.joints)
    x = state_of(name, full, data, vdot=data["nudot_full_g1"])
    held = run(ID, full, x.q, x.v, x.vdot, x.gravity, x.f_ext)[:, 6 : 6 + n]
    for k, mask in enumerate(data["locked_mask"]):
        variant = mine.lock({f"j{i}": data["q"][k, 7 + i] for i in np.flatnonzero(mask)})
        keep = np.r_[np.ones(6, bool), ~mask]
        chain, m = sdyn.pack(variant, capacity()), int(keep.sum())
        exact = State(
            data["q"][k][np.r_[True, keep]], data["nu"][k][keep], data["tau"][k][keep], GRAVITY,
            np.zeros((n + 1, 6)), np.zeros(m),
        )  # fmt: skip
        one = [np.tile(y, (STATES, *(1,) * y.ndim)) for y in padded(variant, chain, exact)]
        q, v, tau, gravity, f_ext, _ = one
        at = real(variant)
        got = np.asarray(FD(chain, q, v, tau, gravity, f_ext))[0]
        close(got[at], data["nudot_full_g1"][k][keep], 6e-14)  # 5.1e-15
        assert not got[~at].any()
        close(np.asarray(MASS(chain, q))[0][np.ix_(at, at)], data["M_reduced_padded"][k, :m, :m], 4e-15)  # 3.1e-16
        close(np.asarray(BIAS(chain, q, v, gravity))[0][at], data["bias_reduced_padded_g1"][k, :m], 4e-15)  # 4.0e-16
        close(held[k][mask], data["lock_reaction_torque_g1"][k][mask], 2e-13)  # 2.0e-14


@pytest.mark.parametrize("end", ["mid", "tip"])
@pytest.mark.parametrize("name", TREES)
def test_rerooted(name, end):
    """The same system from another base: by its own file, and by `reroot` and `transfer`."""
    file, data, start = f"{name}_reroot_{end}", oracles.tree(f"{name}_reroot_{end}"), oracles.tree(f"{name}_states")
    order, perm = data["link_order_new_to_old"], data["joint_perm_new_to_old"]

    # by the file, whose links have other frames: same wrench, in order of the new links
    chain = sdyn.pack(robot(file), capacity())
    x = state_of(file, chain, data)
    _, origin = run(POSES, chain, x.q)
    f_ext = oracles.wrenches(start, data["wrench_link"], origin[:, links_of(robot(file))])
    f_ext = np.asarray(on_links(robot(file), chain, f_ext))
    got = run(FD, chain, x.q, x.v, x.tau, x.gravity, f_ext)
    close(block(file, got), data["nudot"], 4e-13)  # 3.4e-14

    # by reroot and transfer: the state, then the accelerations of every link
    old = robot(name)
    new = old.reroot(old.links[order[0]].name)
    before, after = sdyn.pack(old, capacity()), sdyn.pack(new, capacity())
    f_ext = oracles.wrenches(start, start["wrench_link"], start["link_p_world"])
    free = start["tau"] * (np.arange(old.nv) >= 6)
    y = state_of(name, before, start, f_ext, tau=free)
    moved = [TRANSFER(before, after, q, v) for q, v in zip(y.q, y.v, strict=True)]
    q, v = (np.stack([np.asarray(z[k]) for z in moved]) for k in (1, 2))
    n = len(perm)
    close(q[:, :3], data["q"][:, :3], 3e-15)  # 2.4e-16
    turn = np.sign(np.einsum("si,si->s", q[:, 3:7], data["q"][:, 3:7]))[:, None]
    close(q[:, 3:7] * turn, data["q"][:, 3:7], 4e-15)  # 4.0e-16
    close(q[:, 7 : 7 + n][:, perm], data["q"][:, 7:], 2e-15)  # 0
    close(v[:, :6], data["nu"][:, :6], 2e-14)  # 1.0e-15
    close(v[:, 6 : 6 + n][:, perm], data["nu"][:, 6:], 3e-14)  # 2.4e-15
    vdot = run(FD, after, q, v, np.asarray(y.tau), y.gravity, y.f_ext)
    close(vdot[:, 6 : 6 + n][:, perm], data["nudot"][:, 6:], 5e-13)  # 4.8e-14
    close(vdot[:, :6], data["nudot"][:, :6], 6e-13)  # 5.1e-14
    _, _, _, A, _ = run(MOTION, after, q, v, vdot)
    close(A[:, frames_of(old)][:, order], data["link_com_acc_and_alpha_world"], 6e-13)  # 5.1e-14
    vdot = run(FD, before, y.q, y.v, y.tau, y.gravity, y.f_ext)
    close(block(name, vdot), data["orig_nudot_same_tau"], 5e-14)  # 4.5e-15


# -- single precision --------------------------------------------------------------------------------------------------


@partial(on_states, **QUICKLY)
def FAST(chain, q, v, tau, gravity, f_ext):
    """Accelerations, mass matrix and bias."""
    vdot = sdyn.forward_dynamics(chain, q, v, tau, gravity=gravity, f_ext=f_ext)
    return vdot, sdyn.mass_matrix(chain, q), sdyn.bias_force(chain, q, v, gravity=gravity)


def meets(found, want, most):
    """In every state, by its own largest entry."""
    for x, y in zip(np.asarray(found, float), want, strict=True):
        close(x, y, most)


@pytest.mark.parametrize("end", ["", "_reroot_mid", "_reroot_tip"])
@pytest.mark.parametrize("name", TREES)
def test_single_precision(name, end):
    """As `fast` computes: accelerations to 5e-5, from other bases too; mass matrix and bias to 5e-6."""
    mine, data = robot(name + end), oracles.tree(f"{name}_states")
    data = data | oracles.tree(name + end) if end else data
    chain = sdyn.pack(mine, capacity())
    origin = run(POSES, chain, state_of(name + end, chain, data).q)[1][:, links_of(mine)]
    x = state_of(name + end, chain, data, oracles.wrenches(data, data["wrench_link"], origin))
    chain, x = sdyn.PRESETS["fast"].cast((chain, x))
    assert (chain.dtype, chain.capacity.frame) == (np.float32, "link")
    vdot, M, bias = run(FAST, chain, *x[:5])
    meets(vdot[:, real(mine)], data["nudot" if end else "nudot_b"], 5e-5)  # 2e-5 from a tip, 6e-7 as declared
    if not end:
        meets(block(name, M), data["M"], 5e-6)  # 7e-8
        meets(block(name, bias), data["bias_g1"], 5e-6)  # 3e-7


@pytest.mark.parametrize("name", TREES)
def test_single_precision_of_locked_joints(name):
    """The same with every lock of the data."""
    data, file = oracles.tree(f"{name}_locked"), oracles.tree(f"{name}_states")
    for k, mask in enumerate(data["locked_mask"]):
        q, keep = file["q"][k], np.r_[np.ones(6, bool), ~mask]
        variant = robot(name).lock({f"j{i}": q[7 + i] for i in np.flatnonzero(mask)})
        chain = sdyn.pack(variant, capacity())
        still = np.zeros((len(mask) + 1, 6)), np.zeros(int(keep.sum()))
        exact = State(q[np.r_[True, keep]], data["nu"][k][keep], file["tau"][k][keep], GRAVITY, *still)
        x = [np.tile(y, (STATES, *(1,) * y.ndim)) for y in padded(variant, chain, exact)]
        chain, x = sdyn.PRESETS["fast"].cast((chain, x))
        vdot, M, bias = (y[:1] for y in run(FAST, chain, *x[:5]))
        at, m = real(variant), int(keep.sum())
        meets(vdot[:, at], data["nudot_full_g1"][k : k + 1, keep], 5e-6)  # 4e-7 at most
        meets(M[:, at][:, :, at], data["M_reduced_padded"][k : k + 1, :m, :m], 5e-6)
        meets(bias[:, at], data["bias_reduced_padded_g1"][k : k + 1, :m], 5e-6)


# -- composites by hand ------------------------------------------------------------------------------------------------


def test_paper37_with_28_of_31_joints_locked(rng):
    """Against a robot of 4 bodies whose masses, centres and inertias are added up here."""
    paper = sdyn.models.load("paper37")
    moving = [paper.moving[k].name for k in (1, 3, 5)]
    locked = {j.name: rng.uniform(-2, 2) for j in paper.moving if j.name not in moving}
    variant = paper.lock(locked)
    assert (paper.nv, len(paper.moving), len(locked), variant.nv) == (37, 31, 28, 9)

    pose = {paper.base: (np.eye(3), np.zeros(3))}  # of each link in its body
    group = {paper.base: 0}
    parts = {0: [paper.base]}
    joints = []
    todo = list(paper.joints)
    while todo:
        joint = next(j for j in todo if j.parent in pose)
        todo.remove(joint)
        R, p = pose[joint.parent]
        R, p = R @ joint.rotation, p + R @ joint.position
        if joint.name in moving:
            group[joint.child], pose[joint.child] = len(parts), (np.eye(3), np.zeros(3))
            parts[len(parts)] = [joint.child]
            body = lambda link: f"body{group[link]}"
            joints.append(sdyn.Joint(joint.name, "revolute", body(joint.parent), body(joint.child), R, p, joint.axis))
        else:
            turn = rodrigues(joint.axis, locked[joint.name]) if joint.kind == "revolute" else np.eye(3)
            pose[joint.child], group[joint.child] = (R @ turn, p), group[joint.parent]
            parts[group[joint.parent]].append(joint.child)
    links = [composite(f"body{k}", [(paper.link(x), *pose[x]) for x in names]) for k, names in parts.items()]
    hand = sdyn.Robot(links, joints)

    ours, theirs = (sdyn.pack(renamed(r), capacity()) for r in (variant, hand))
    q, v, tau, gravity, _, vdot = padded(renamed(variant), ours, states(renamed(variant), "paper37"))
    none = np.zeros((STATES, capacity().links, 6))
    close(FD(ours, q, v, tau, gravity, none), FD(theirs, q, v, tau, gravity, none), 3e-15)  # 2.2e-16
    close(ID(ours, q, v, vdot, gravity, none), ID(theirs, q, v, vdot, gravity, none), 2e-15)  # 1.1e-17
    close(MASS(ours, q), MASS(theirs, q), 2e-15)  # 7.3e-17
    for a, b in zip(TOTALS(ours, q, v), TOTALS(theirs, q, v), strict=True):
        close(a, b, 4e-15)  # 3.1e-16


def rodrigues(axis, angle):
    x, y, z = axis
    A = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * A + (1 - np.cos(angle)) * A @ A


def composite(name, parts):
    """One link from links with poses (R, p) in it."""
    mass = sum(link.mass for link, _, _ in parts)
    at = [p + R @ link.com for link, R, p in parts]
    centre = sum(link.mass * x for (link, _, _), x in zip(parts, at, strict=True)) / mass
    inertia = np.zeros((3, 3))
    for (link, R, _), x in zip(parts, at, strict=True):
        d = x - centre
        inertia += R @ link.inertia @ R.T + link.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return sdyn.Link(name, mass, centre, (inertia + inertia.T) / 2)


# -- closed form -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", range(15))
def test_base_rotation_of_a_two_body_floater(case):
    """At zero momentum the base turns by the integral of -M_bb^-1 M_bm over the joint, masses 1e-3 to 1e3."""
    case = json.loads((oracles.DATA / "free_floater_two_body.json").read_text())["cases"][case]
    I1, m1, a, I2, m2, b, end = (float(case[key]) for key in ("I1", "m1", "a", "I2", "m2", "b", "q"))
    links = [
        sdyn.Link("l0", m1, inertia=np.diag([I1, I1, I1])),
        sdyn.Link("l1", m2, (b, 0, 0), np.diag([I2, I2, I2])),
    ]
    chain = sdyn.pack(sdyn.Robot(links, [sdyn.Joint("j0", "revolute", "l0", "l1", position=(a, 0, 0))]), capacity())
    nodes, weights = np.polynomial.legendre.leggauss(240)
    q = np.zeros((240, chain.nq))
    q[:, 3], q[:, 7] = 1.0, end * (nodes + 1) / 2
    M = run(MASS, chain, q)
    rate = [-np.linalg.solve(m[:6, :6], m[:6, 6])[2] for m in M]
    close(end / 2 * weights @ rate, np.asarray(float(case["base_rotation"])), 5e-13)  # 4.3e-14
