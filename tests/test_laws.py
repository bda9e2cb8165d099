"""Laws of mechanics and of the code, over the table of structures."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from functions import ALONG, BIAS, FD, GENERALISED, ID, MASS, MOTION, POSES, REGRESSOR, SOLVE, TOTALS, fd
from structures import (
    QUICKLY,
    ROBOTS,
    STATES,
    TABLE,
    State,
    capacity,
    close,
    frames_of,
    links_of,
    packed,
    padded,
    q_rate,
    real,
    robot,
    state,
    states,
    tree,
)

import sdyn
from sdyn.posture import link_poses

over_table = pytest.mark.parametrize("name", TABLE)
FREE = [name for name in TABLE if not ROBOTS[name]().grounded]


@cache
def accelerations(name):
    x = state(name)
    return np.asarray(FD(packed(name), x.q, x.v, x.tau, x.gravity, x.f_ext))


# -- the algorithms agree ----------------------------------------------------------------------------------------------


@over_table
def test_forward_after_inverse_dynamics(name):
    """And the other way round; empty entries are zero."""
    chain, x, at = packed(name), state(name), real(robot(name))
    tau, vdot = ID(chain, x.q, x.v, x.vdot, x.gravity, x.f_ext), accelerations(name)
    close(FD(chain, x.q, x.v, tau, x.gravity, x.f_ext), x.vdot, 4e-12, scale=vdot)  # 3.6e-13
    tau = ID(chain, x.q, x.v, vdot, x.gravity, x.f_ext)
    close(tau, x.tau, 8e-15, scale=BIAS(chain, x.q, x.v, x.gravity))  # 7.3e-16
    assert not vdot[:, ~at].any() and not np.asarray(tau)[:, ~at].any()


@over_table
def test_articulated_bodies_and_mass_matrix(name):
    """Forward dynamics and solve_mass against M and a dense solve; M is symmetric, positive, and zero where empty."""
    chain, x, at = packed(name), state(name), real(robot(name))
    M, b = np.asarray(MASS(chain, x.q)), np.asarray(BIAS(chain, x.q, x.v, x.gravity))
    none = 0 * x.f_ext
    vdot = np.asarray(FD(chain, x.q, x.v, x.tau, x.gravity, none))
    close(np.einsum("sij,sj->si", M, vdot) + b, x.tau, 2e-14, scale=b)  # 1.0e-15
    close(ID(chain, x.q, x.v, vdot, x.gravity, none), x.tau, 6e-15, scale=b)  # 5.9e-16
    close(M, M.swapaxes(1, 2), 2e-15)  # 1.3e-16
    assert not M[:, ~at].any() and not b[:, ~at].any()
    found = np.asarray(SOLVE(chain, x.q, x.tau))
    assert not found[:, ~at].any()
    for k in range(STATES):
        own = M[k][np.ix_(at, at)]
        assert not own.size or np.linalg.eigvalsh(own)[0] > 0
        close(found[k][at], np.linalg.solve(own, np.asarray(x.tau)[k][at]), 7e-12)  # 6.7e-13


@over_table
def test_energy_is_the_mass_matrix(name):
    chain, x = packed(name), state(name)
    M, v = np.asarray(MASS(chain, x.q)), np.asarray(x.v)
    close(TOTALS(chain, x.q, x.v)[2], 0.5 * np.einsum("si,sij,sj->s", v, M, v), 2e-14)  # 1.2e-15


@over_table
def test_regressor(name):
    """tau = Y theta, apart from damping, stiffness and rotors."""
    chain, x = packed(name), state(name)
    chain = replace(chain, dof_value=0 * chain.dof_value)
    p = sdyn.params(chain)
    c, m = p.com, p.mass
    I = p.inertia + m[:, None, None] * ((c * c).sum(1)[:, None, None] * np.eye(3) - c[:, :, None] * c[:, None])
    six = jnp.stack([I[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], 1)
    theta = jnp.concatenate([m[:, None], m[:, None] * c, six], 1).reshape(-1)
    Y = REGRESSOR(chain, x.q, x.v, x.vdot, x.gravity)
    assert Y.shape == (STATES, chain.nv, 10 * chain.capacity.links)
    close(Y @ theta, ID(chain, x.q, x.v, x.vdot, x.gravity, 0 * x.f_ext), 5e-14)  # 4.2e-15


# -- kinematics --------------------------------------------------------------------------------------------------------


@over_table
def test_poses(name):
    """Against the host's own, in NumPy."""
    exact, at = states(robot(name), name), links_of(robot(name))
    R, p = POSES(packed(name), state(name).q)
    for k in range(STATES):
        want = link_poses(robot(name), exact.q[k])
        close(R[k][np.array(at)], want[0], 2e-14)  # 1.1e-15
        close(p[k][np.array(at)], want[1], 6e-15, scale=1.0)  # 5.2e-16


@over_table
def test_velocities_and_accelerations_are_derivatives(name):
    """Velocity = J v = the derivative of the pose, acceleration = the derivative of the velocity."""
    mine, chain, x, exact = robot(name), packed(name), state(name), states(robot(name), name)
    at = np.array([*frames_of(mine), *(chain.capacity.frame_names.index(e) for e in ("e0", "e1"))])
    rate = np.array([q_rate(mine, *row) for row in zip(exact.q, exact.v, strict=True)])
    rate = np.pad(rate if not mine.grounded else np.pad(rate, ((0, 0), (7, 0))), ((0, 0), (0, chain.nq)))[:, : chain.nq]
    (R, p, V, *_), (dR, dp, dV, *_) = (np.array, *ALONG(chain, x.q, x.v, rate, x.vdot))[1:]
    R, p, V, dR, dp, dV = (np.asarray(y)[:, at] for y in (R, p, V, dR, dp, dV))
    _, _, _, A, J = (np.asarray(y)[:, at] for y in MOTION(chain, x.q, x.v, x.vdot))
    close(np.einsum("sfij,sj->sfi", J, x.v), V, 5e-15)  # 4.6e-16
    close(dp, V[..., 3:], 4e-14)  # 3.7e-15
    spin = dR @ R.swapaxes(-1, -2)
    w = np.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], -1)
    close(w, V[..., :3], 5e-14)  # 4.8e-15
    close(spin + spin.swapaxes(-1, -2), 0 * spin, 3e-13, scale=spin)  # 2.1e-14
    close(dV, A, 4e-14)  # 3.6e-15
    assert not J[..., ~real(mine)].any()


@over_table
def test_newton_and_euler_projected(name):
    """Inverse dynamics = the sum of J^T [I al + w x I w - n; m (a - g) - f] over the links, and what joints ask for."""
    mine, chain, x, n = robot(name), packed(name), state(name), len(robot(name).links)
    at, links = np.array(frames_of(mine)), np.array(links_of(mine))
    R, p, V, A, J = (np.asarray(y)[:, at] for y in MOTION(chain, x.q, x.v, x.vdot))
    m = np.array([link.mass for link in mine.links])
    I = R @ np.array([link.inertia for link in mine.links]) @ R.swapaxes(-1, -2)
    turn = lambda B, y: np.einsum("snij,snj->sni", B, y)
    moment = turn(I, A[..., :3]) + np.cross(V[..., :3], turn(I, V[..., :3]))
    force = m[:, None] * (A[..., 3:] - np.asarray(x.gravity)[:, None])
    applied = np.asarray(x.f_ext)[:, links]
    origin = np.asarray(POSES(chain, x.q)[1])[:, links]
    moment = moment - applied[..., :3] - np.cross(origin - p, applied[..., 3:])
    want = np.einsum("snkv,snk->sv", J, np.concatenate([moment, force - applied[..., 3:]], -1))
    nb = 0 if mine.grounded else 6
    at_v, at_q = 6, 7
    for joint in mine.moving:
        v, q = slice(at_v, at_v + joint.dof), slice(at_q, at_q + joint.dof)
        want[:, v] += joint.rotor_inertia * x.vdot[:, v] + joint.damping * x.v[:, v] + joint.stiffness * x.q[:, q]
        at_v, at_q = at_v + joint.dof, at_q + joint.nq
    assert n and (nb or mine.grounded)
    close(ID(chain, x.q, x.v, x.vdot, x.gravity, x.f_ext), want, 7e-15)  # 6.1e-16


@pytest.mark.parametrize("name", FREE)
def test_momentum_changes_by_the_applied_wrench(name):
    """d/dt P = sum of the forces, d/dt L about the centre of mass = sum of the moments; energy by the power."""
    mine, chain, x = robot(name), packed(name), state(name)
    exact, vdot = states(mine, name), accelerations(name)
    rate = np.array([q_rate(mine, *row) for row in zip(exact.q, exact.v, strict=True)])
    rate = np.pad(rate, ((0, 0), (0, chain.nq - rate.shape[1])))
    (_, _, _, h, c, _), (_, _, _, dh, dc, dT) = ALONG(chain, x.q, x.v, rate, vdot)
    R, p = (np.asarray(y) for y in POSES(chain, x.q))
    f, links = np.asarray(x.f_ext), np.array(links_of(mine))
    base = capacity().link_names.index(mine.base)
    mass = sum(link.mass for link in mine.links)
    c, P = np.asarray(c), np.asarray(h)[:, 3:]
    wrench = np.asarray(x.tau)[:, :6].reshape(-1, 2, 3) @ R[:, base].swapaxes(-1, -2)  # on the base, in world axes
    wrench = np.concatenate([f[:, links], wrench.reshape(-1, 1, 6)], 1)
    arm = np.concatenate([p[:, links], p[:, [base]]], 1) - c[:, None]
    force = wrench[..., 3:].sum(1) + mass * np.asarray(x.gravity)
    moment = (wrench[..., :3] + np.cross(arm, wrench[..., 3:])).sum(1)
    close(dh[:, 3:], force, 7e-14, scale=P)  # 6.3e-15
    close(dh[:, :3], moment, 2e-13, scale=np.asarray(h)[:, :3])  # 1.5e-14
    close(mass * dc, P, 2e-14)  # 1.0e-15

    _, _, V, _, _ = MOTION(chain, x.q, x.v, x.vdot)
    w = np.asarray(V)[:, np.array(frames_of(mine))]  # of the centres of mass
    origin = np.array([R[:, i] @ -link.com for i, link in zip(links, mine.links, strict=True)]).swapaxes(0, 1)
    at_origin = w[..., 3:] + np.cross(w[..., :3], origin)
    power = np.einsum("sv,sv->s", x.tau, x.v) + mass * np.einsum("si,si->s", x.gravity, dc)
    power += (f[:, links, :3] * w[..., :3] + f[:, links, 3:] * at_origin).sum((1, 2))
    at_v, at_q = 6, 7
    for joint in mine.moving:
        v, q = np.asarray(x.v)[:, at_v : at_v + joint.dof], np.asarray(x.q)[:, at_q : at_q + joint.dof]
        power -= (joint.damping * v * v + joint.stiffness * q * v).sum(1)
        at_v, at_q = at_v + joint.dof, at_q + joint.nq
    close(dT, power, 3e-12, scale=np.einsum("sv,sv->s", np.abs(x.tau), np.abs(x.v)))  # 3.0e-13


@pytest.mark.parametrize("name", FREE)
def test_free_fall(name):
    """A uniform gravity accelerates every link alike and no joint, whatever moves."""
    chain, x = packed(name), state(name)
    none = 0 * x.f_ext
    vdot = FD(chain, x.q, x.v, x.tau, x.gravity, none), FD(chain, x.q, x.v, x.tau, 0 * x.gravity, none)
    _, _, _, A, _ = MOTION(chain, x.q, x.v, vdot[0])
    _, _, _, B, _ = MOTION(chain, x.q, x.v, vdot[1])
    at = np.array(frames_of(robot(name)))
    difference = np.asarray(A - B)[:, at]
    close(
        difference[..., 3:], np.broadcast_to(np.asarray(x.gravity)[:, None], difference[..., 3:].shape), 1e-12, scale=A
    )
    close(difference[..., :3], 0 * difference[..., :3], 2e-15, scale=A)  # 0
    close((vdot[0] - vdot[1])[:, 6:], 0 * x.vdot[:, 6:], 2e-15, scale=vdot[0])  # 0


@over_table
def test_generalised_jacobian(name):
    """The frame's velocity when the base moves so that the momentum is zero; grounded, the plain Jacobian."""
    mine, chain, x = robot(name), packed(name), state(name)
    e0 = chain.capacity.frame_names.index("e0")
    got = GENERALISED(chain, x.q, np.full(STATES, e0))
    assert got.shape == (STATES, 6, chain.nv - 6)
    M, J = np.asarray(MASS(chain, x.q)), np.asarray(MOTION(chain, x.q, x.v, x.vdot)[4])[:, e0]
    v = np.array(x.v)
    v[:, :6] = 0 if mine.grounded else -np.linalg.solve(M[:, :6, :6], M[:, :6, 6:] @ v[:, 6:, None])[..., 0]
    close(np.einsum("skj,sj->sk", got, v[:, 6:]), np.einsum("skv,sv->sk", J, v), 8e-14)  # 7.7e-15
    if not mine.grounded:
        h = TOTALS(chain, x.q, v)[0]
        close(h, 0 * h, 3e-15, scale=np.abs(M).max() * np.abs(v).max())  # 3.0e-16


# -- joints of several degrees of freedom ------------------------------------------------------------------------------


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("kind", ["cylindrical", "universal", "planar"])
def test_a_joint_is_its_sequence(kind, backwards):
    """The same robot with revolute and prismatic joints between links without mass."""
    one = tree((0, 1, 2), ("revolute", kind, "revolute"), seed=3)
    joint = one.joints[1]
    x, y = (np.eye(3)[k] for k in (0, 1))
    z, axis = np.eye(3)[2], joint.axis
    v, c = np.cross(z, axis), z @ axis  # the smallest rotation that takes z to the axis
    hat = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    turn = np.eye(3) + hat + hat @ hat / (1 + c)
    x, y = turn @ x, turn @ y
    steps = {
        "cylindrical": [("prismatic", axis), ("revolute", axis)],
        "universal": [("revolute", axis), ("revolute", x)],
        "planar": [("prismatic", x), ("prismatic", y), ("revolute", axis)],
    }[kind]
    between = [f"l{4 + k}" for k in range(len(steps) - 1)]
    ends = [joint.parent, *between, joint.child]
    joints = [one.joints[0]]
    for k, (what, a) in enumerate(steps):
        place = dict(rotation=joint.rotation, position=joint.position) if k == 0 else {}
        joints.append(sdyn.Joint(f"j{1 + k}", what, ends[k], ends[k + 1], axis=a, **place))
    joints.append(replace(one.joints[2], name=f"j{1 + len(steps)}"))
    many = sdyn.Robot((*one.links, *(sdyn.Link(name, 0.0) for name in between)), joints, one.frames)
    if backwards:
        one, many = one.reroot("l3"), many.reroot("l3")
    exact = states(one, kind)
    chains = [sdyn.pack(r, capacity()) for r in (one, many)]
    a, b = padded(one, chains[0], exact), chains[1]
    assert one.nv == many.nv and one.nq == many.nq
    close(MASS(b, a.q), MASS(chains[0], a.q), 2e-15)  # 0
    got, want = (FD(c, a.q, a.v, a.tau, a.gravity, a.f_ext) for c in (b, chains[0]))
    close(got, want, 2e-15)  # 0
    got, want = (ID(c, a.q, a.v, a.vdot, a.gravity, a.f_ext) for c in (b, chains[0]))
    close(got, want, 2e-15)  # 0


# -- batches, layouts, compilation -------------------------------------------------------------------------------------

LAYOUTS = [("one_body", 1), ("no_joint_grounded", 1), ("unbalanced_tree", 3), ("all_kinds_grounded", 1)]


@pytest.mark.parametrize(("name", "width"), LAYOUTS)
def test_padded_equals_exact(name, width):
    """In value; the gradients are in test_gradients.py."""
    mine, x = robot(name), states(robot(name), name)
    chain, at = sdyn.pack(mine, width=width), real(mine)
    assert (chain.nq, chain.nv) == (mine.nq, mine.nv)

    @partial(jax.jit, **QUICKLY)
    def everything(chain, q, v, tau, gravity, f_ext):
        options = dict(gravity=gravity, f_ext=f_ext)
        vdot = sdyn.forward_dynamics(chain, q, v, tau, **options)
        M, (R, p) = sdyn.mass_matrix(chain, q), sdyn.body_poses(chain, q)
        return vdot, M, R, p, sdyn.momentum(chain, q, v), sdyn.inverse_dynamics(chain, q, v, tau, **options)

    y, links = state(name), np.array(links_of(mine))
    f_ext = np.zeros((STATES, len(chain.capacity.link_names), 6))
    f_ext[:, [chain.capacity.link_names.index(link.name) for link in mine.links]] = x.f_ext
    M, (R, p), h = MASS(packed(name), y.q), POSES(packed(name), y.q), TOTALS(packed(name), y.q, y.v)[0]
    tau = ID(packed(name), y.q, y.v, y.tau, y.gravity, y.f_ext)
    for k in range(STATES):
        got = everything(chain, x.q[k], x.v[k], x.tau[k], x.gravity[k], f_ext[k])
        want = accelerations(name)[k][at], np.asarray(M)[k][np.ix_(at, at)], R[k][links], p[k][links], h[k], tau[k][at]
        for a, b in zip(got, want, strict=True):
            close(a, b, 3e-13)  # 2.7e-14


@over_table
def test_batch_equals_loop(name):
    """vmap = one by one."""
    x, chain = state(name), packed(name)
    rows = [SINGLE(chain, *(y[k] for y in x[:5])) for k in range(STATES)]
    close(np.stack(rows), accelerations(name), 5e-12)  # 4.5e-13


SINGLE = jax.jit(fd)


def test_vmap_over_a_family():
    """Structures along a leading axis, states along another, and both orders of nesting."""
    names = ["one_body", "unbalanced_tree", "grounded", "all_kinds_backwards", "all_locked", "paper37"]
    chains = jax.tree.map(lambda *x: jnp.stack(x), *map(packed, names))
    x = State(*(jnp.stack(y) for y in zip(*map(state, names), strict=True)))
    want = np.stack([accelerations(name) for name in names])
    inner, outer = jax.vmap(jax.vmap(fd, (None, 0, 0, 0, 0, 0))), jax.vmap(jax.vmap(fd), (None, 1, 1, 1, 1, 1), 1)
    close(jax.jit(inner, **QUICKLY)(chains, *x[:5]), want, 1e-12)  # 1.0e-13
    close(jax.jit(outer, **QUICKLY)(chains, *x[:5]), want, 1e-12)  # 1.0e-13


def test_nested_batches_that_share_operands():
    """Three axes, of which q, v and tau each miss some."""
    x, chain = state("unbalanced_tree"), packed("unbalanced_tree")
    q, v, tau = x.q[:2], x.v[:3], x.tau[:4]
    f = lambda q, v, tau: sdyn.forward_dynamics(chain, q, v, tau)
    nested = jax.vmap(jax.vmap(jax.vmap(f, (None, None, 0)), (None, 0, None)), (0, None, None))
    got = jax.jit(nested, **QUICKLY)(q, v, tau)
    assert got.shape == (2, 3, 4, chain.nv)
    for i, j, k in np.ndindex(2, 3, 4):
        want = SINGLE(chain, q[i], v[j], tau[k], 0 * x.gravity[0], 0 * x.f_ext[0])
        close(got[i, j, k], want, 3e-14)  # 2.2e-15


def test_bad_sample_stays_alone():
    """In a batch of several blocks, which use the same storage: one sample that is not a number spoils no other."""
    x, chain = state("unbalanced_tree"), packed("unbalanced_tree")
    q, v, tau = (jnp.tile(y, (75, 1)) for y in x[:3])
    f = jax.jit(jax.vmap(jax.value_and_grad(lambda *x: sdyn.forward_dynamics(chain, *x).sum(), (0, 1, 2))), **QUICKLY)
    whole, one_bad = f(q, v, tau), f(q, v.at[0].set(jnp.nan), tau)
    assert np.isnan(one_bad[0][0])
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(one_bad), strict=True):
        np.testing.assert_array_equal(a[1:], b[1:])


def test_without_jit():
    x, chain = state("all_kinds_backwards"), packed("all_kinds_backwards")
    close(fd(chain, *(y[0] for y in x[:5])), accelerations("all_kinds_backwards")[0], 3e-14)  # 2.1e-15


# -- float32 -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["one_body", "unbalanced_tree", "leaf_as_base", "grounded", "all_locked", "all_kinds_backwards"]
)
def test_float32(name):
    """Results are float32 and as near as that allows."""
    x, y = state(name), State(*(np.asarray(z, np.float32) for z in state(name)))
    chain, single = packed(name), packed(name, "float32")
    for f, arguments, rtol in (
        (FD, ("q", "v", "tau", "gravity", "f_ext"), 1e-4),  # 1.9e-5
        (ID, ("q", "v", "vdot", "gravity", "f_ext"), 5e-6),  # 6.0e-7
    ):
        got = jax.tree.leaves(f(single, *(getattr(y, key) for key in arguments)))
        want = jax.tree.leaves(f(chain, *(getattr(x, key) for key in arguments)))
        for a, b in zip(got, want, strict=True):
            assert a.dtype == np.float32
            close(a, b, rtol)


@pytest.mark.parametrize("f", ["fd", "inverse", "gradient", "transfer", "rollout", "regressor", "motion"])
def test_nothing_is_promoted_from_float32(f):
    """No float64 anywhere in the program."""
    import functions

    single = packed("all_kinds_backwards", "float32")
    x = State(*(np.asarray(z[0], np.float32) for z in state("all_kinds_backwards")))
    programs = {
        "fd": (functions.fd, x[:5]),
        "inverse": (functions.inverse, (x.q, x.v, x.vdot, x.gravity, x.f_ext)),
        "gradient": (jax.grad(lambda c, q, v, tau: sdyn.forward_dynamics(c, q, v, tau).sum(), (1, 2, 3)), x[:3]),
        "transfer": (lambda chain, q, v: sdyn.transfer(chain, chain, q, v), x[:2]),
        "rollout": (lambda chain, q, v: sdyn.rollout(chain, q, v, jnp.zeros((3, chain.nv), q.dtype), 0.1), x[:2]),
        "regressor": (sdyn.regressor, (x.q, x.v, x.vdot)),
        "motion": (functions.motion, (x.q, x.v, x.vdot)),
    }
    program, arguments = programs[f]
    text = jax.jit(program).lower(single, *arguments).as_text()
    assert "xf32>" in text and "xf64>" not in text  # constants, tensor<f64>, are converted before they are used
