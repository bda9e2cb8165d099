"""The public names: arguments in order, and shapes in both layouts."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from structures import UNBALANCED, tree

import planners
import sdyn

# positional arguments, then keyword-only ones; further ones with defaults are free
SIGNATURES = {
    "load": ("path", ""),
    "save": ("robot path", ""),
    "pack": ("robot capacity", "width dtype"),
    "capacity": ("robots", ""),
    "family": ("robots", ""),
    "pad": ("chain q v", ""),
    "unpad": ("chain q v", ""),
    "forward_dynamics": ("chain q v tau", "gravity f_ext"),
    "forward_dynamics_jacobians": ("chain q v tau", "gravity"),
    "inverse_dynamics": ("chain q v vdot", "gravity f_ext"),
    "constrained_dynamics": ("chain q v tau", "gravity f_ext method"),
    "loop_residual": ("chain q", ""),
    "loop_jacobian": ("chain q", ""),
    "mass_matrix": ("chain q", ""),
    "bias_force": ("chain q v", "gravity"),
    "solve_mass": ("chain q b", ""),
    "body_poses": ("chain q", ""),
    "frame_pose": ("chain q frame", ""),
    "frame_jacobian": ("chain q frame", ""),
    "frame_velocity": ("chain q v frame", ""),
    "frame_acceleration": ("chain q v vdot frame", ""),
    "momentum": ("chain q v", ""),
    "centre_of_mass": ("chain q", ""),
    "kinetic_energy": ("chain q v", ""),
    "generalised_jacobian": ("chain q frame", ""),
    "floating_velocity": ("chain q rates momentum", ""),
    "floating_forward_dynamics": ("chain q rates tau momentum", "gravity f_ext"),
    "floating_inverse_dynamics": ("chain q v accelerations", "wrench gravity f_ext"),
    "reduced_dynamics": ("chain q rates momentum", "gravity f_ext"),
    "reaction_null_space": ("chain q", "rtol"),
    "wheels": ("chain q v joints limits", ""),
    "frame_wrench": ("chain q frame wrench", "axes"),
    "transfer": ("before after q v", ""),
    "integrate": ("chain q v tau dt", "method gravity f_ext"),
    "rollout": ("chain q v taus dt", "method gravity f_ext steps accuracy"),
    "hybrid_rollout": ("family q v taus durations members", "method gravity f_ext steps accuracy"),
    "choose": ("chain q v taus dt error", "steps gravity f_ext"),
    "regressor": ("chain q v vdot", ""),
    "params": ("chain", ""),
    "with_params": ("chain params", ""),
    "convert.mujoco": ("robot names", ""),
    "convert.pinocchio": ("robot names sizes", ""),
    "models.load": ("name", ""),
    "models.names": ("", ""),
    "Link": ("name mass com inertia", ""),
    "Joint": (
        "name kind parent child rotation position axis",
        "limits rate effort pitch damping stiffness rotor_inertia",
    ),
    "Frame": ("name link rotation position", ""),
    "Robot": ("links joints frames loops base grounded", ""),
    "reduce": ("robot scene", ""),
    "diagnose": ("chain qs vs", ""),
    "conditioning": ("chain q", ""),
    "Robot.lock": ("self joints", ""),
    "Robot.unlock": ("self joints", ""),
    "Robot.reroot": ("self link", ""),
    "Robot.ground": ("self link_or_frame pose", ""),
    "Robot.release": ("self", ""),
    "Robot.close": ("self frame_a frame_b kind name q", ""),
    "Robot.open": ("self loop", ""),
    "Robot.attach": ("self other frame other_frame kind name", ""),
    "Robot.detach": ("self joint", ""),
    "Robot.table": ("self base merged", ""),
    "Robot.neutral": ("self", ""),
}


@pytest.mark.parametrize("name", SIGNATURES)
def test_signature(name):
    """Given by position in this order, or by these names."""
    thing = sdyn
    for part in name.split("."):
        thing = getattr(thing, part)
    positional, keywords = (x.split() for x in SIGNATURES[name])
    found = inspect.signature(thing).parameters
    assert list(found)[: len(positional)] == positional
    for key in positional:
        assert found[key].kind is inspect.Parameter.POSITIONAL_OR_KEYWORD
    for key in keywords:
        assert found[key].default is not inspect.Parameter.empty
    assert all(x.default is not inspect.Parameter.empty for key, x in found.items() if key not in positional)


@pytest.mark.parametrize("name", SIGNATURES)
def test_first_sentence(name):
    """Every public name says in a sentence what it is."""
    thing = sdyn
    for part in name.split("."):
        thing = getattr(thing, part)
    first = (inspect.getdoc(thing) or "").split("\n\n")[0]
    assert first.rstrip().endswith((".", ":")) and len(first) > 10


def test_planners():
    for name, want in {
        "load": ["path_or_name"],
        "plan": ["task", "solver", "seeds", "accuracy", "progress"],
        "certify": ["task", "plan"],
        "compare": ["task", "plans"],
    }.items():
        found = list(inspect.signature(getattr(planners, name)).parameters)
        assert found[: len(want)] == want or name in ("load", "compare"), (name, found)
    for key in ("save", "load"):
        assert callable(getattr(planners.Plan, key))


@pytest.mark.parametrize("layout", ["free", "grounded", "padded"])
def test_shapes(layout):
    robot = tree(UNBALANCED).lock({"j1": 0.2})
    robot = robot.ground("l0") if layout == "grounded" else robot
    chain = sdyn.pack(robot, sdyn.capacity([tree(UNBALANCED)]) if layout == "padded" else None)
    base, joints = (0, 7) if layout == "grounded" else (1, 7) if layout == "free" else (1, 8)
    nq, nv, n = 7 * base + joints, 6 * base + joints, 9
    assert (chain.nq, chain.nv) == (nq, nv)
    if layout != "padded":
        assert (robot.nq, robot.nv) == (nq, nv) == (len(robot.q_names), len(robot.v_names))
        assert robot.neutral().shape == (nq,)
    shape = lambda *size: jax.ShapeDtypeStruct(size, jnp.float64)
    q, v, frame = shape(nq), shape(nv), "e0"
    gravity, f_ext = shape(3), shape(n, 6)
    f = lambda name, *x, **rest: jax.tree.map(
        lambda y: y.shape, jax.eval_shape(lambda c, *x: getattr(sdyn, name)(c, *x, **rest), chain, *x)
    )
    assert f("forward_dynamics", q, v, v) == f("inverse_dynamics", q, v, v) == f("bias_force", q, v) == (nv,)
    assert jax.eval_shape(
        lambda *x: sdyn.forward_dynamics(chain, *x[:3], gravity=x[3], f_ext=x[4]), q, v, v, gravity, f_ext
    ).shape == (nv,)
    assert f("mass_matrix", q) == (nv, nv)
    assert f("solve_mass", q, v) == (nv,)
    assert f("body_poses", q) == ((n, 3, 3), (n, 3))
    assert f("frame_pose", q, frame=frame) == ((3, 3), (3,))
    assert f("frame_jacobian", q, frame=frame) == (6, nv)
    assert f("frame_velocity", q, v, frame=frame) == f("frame_acceleration", q, v, v, frame=frame) == (6,)
    assert f("momentum", q, v) == (6,) and f("centre_of_mass", q) == (3,) and f("kinetic_energy", q, v) == ()
    assert f("generalised_jacobian", q, frame=frame) == (6, joints)
    assert f("regressor", q, v, v) == (nv, 10 * n)
    assert f("integrate", q, v, v, dt=0.1) == ((nq,), (nv,))
    assert f("rollout", q, v, shape(5, nv), dt=0.1) == ((6, nq), (6, nv))
    after, *rest = jax.eval_shape(lambda q, v: sdyn.transfer(chain, chain, q, v), q, v)
    assert isinstance(after, sdyn.Chain) and [x.shape for x in rest] == [(nq,), (nv,), (n, 6)]
    p = sdyn.params(chain)
    assert (p.mass.shape, p.com.shape, p.inertia.shape) == ((n,), (n, 3), (n, 3, 3))
    assert jax.tree.structure(sdyn.with_params(chain, p)) == jax.tree.structure(chain)


def test_frame_by_traced_index():
    robot = tree(UNBALANCED)
    chain = sdyn.pack(robot)
    every = jax.vmap(lambda k: sdyn.frame_pose(chain, robot.neutral(), k)[1])(jnp.arange(len(robot.frames)))
    for k, frame in enumerate(robot.frames):
        np.testing.assert_allclose(every[k], sdyn.frame_pose(chain, robot.neutral(), frame.name)[1], atol=1e-15)


def test_pad_and_unpad():
    robot = tree(UNBALANCED)
    for mine in (robot, robot.lock({"j2": 0.1}), robot.ground("l0")):
        chain = sdyn.pack(mine, sdyn.capacity([robot]))
        q, v = np.arange(1.0, mine.nq + 1), np.arange(1.0, mine.nv + 1)
        padded = sdyn.pad(chain, q, v)
        assert [x.shape for x in padded] == [(15,), (14,)]
        for a, b in zip(sdyn.unpad(chain, *padded), (q, v), strict=True):
            assert np.array_equal(a, b)
