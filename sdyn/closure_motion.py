"""What closures do in a motion, their wrenches on the slots and K v̇ − k, and its derivatives, as kernels.

The cotangent is one inward sweep. With P, B*, A* the cotangents of a small motion of a slot with all that it carries,
of its twist V and of its spatial acceleration A, which the frames fixed in it gather, and s = S q̇:
    inward    (P, A*, B* + s x* A*) are added to the parent; g = P − V' x* (B* + s x* A*) − A' x* A*
    of q      S · g;  of a turn and shift of the joint's frame, g itself
    of q̇      S · b,  b = B* − V' x* A*
    of q̈      S · A*
as in `rnea_adjoint.py`, where the bodies are what gathers.
"""

from functools import cache

import jax
import jax.numpy as jnp

from sdyn.batching import Kernel
from sdyn.closure_rows import acceleration, basis, ends_of, wrenches
from sdyn.materialise import keep
from sdyn.rnea_adjoint import geometry, of_quaternions
from sdyn.rnea_motion import Motion
from sdyn.spatial import cat, cross, dot, force_cross
from sdyn.sweep import add_to, batch_of, block, joints_of, moved, placed, put, take, walk_of
from sdyn.workspace import Workspace

OPERANDS = (
    "slot_index", "slots", "rows", "slot_value", "q", "quat", "V0", "qd", "A0", "qdd", "ground", "frames", "lam",
)  # fmt: skip
FLOATS = OPERANDS[3:]


def closures(*operands, work):
    """Wrenches on the slots, base axes and origin [slots + 2, 6, B], and K v̇ − k [nc, B].

    slots: those of frames a and b [2, loops]; the dummy stands for the ground. rows: `Chain.row_index`.
    ground: pose of the world, seen from the base [12, B]. frames: poses of frames a and b in their slots
    [24, loops, B]. lam: multipliers [nc, B]. The others as for `motions`. B: columns of samples, two axes.
    """
    x = dict(zip(OPERANDS, operands, strict=True))
    B = batch_of(*(x[k] for k in FLOATS), axes=2)
    walk, _, R, p, _, V, A = _kinematics(x, work, B)
    F, opening = _local(x, *at_ends(walk, x, R, p, V, A), x["lam"])
    return on_slots(walk.zeros(6, B, F.dtype), x["slots"], F), opening


def _kinematics(x, work, B):
    walk = walk_of(x["slot_index"], work)
    joints = joints_of(walk, x["slot_index"], x["slot_value"], x["q"], x["quat"])
    R, p, S = placed(walk, joints, B)
    return walk, joints, R, p, S, *moved(walk, S, x["V0"], x["qd"], x["A0"], x["qdd"], B)


def at_ends(walk, x, R, p, *motions):
    """Poses [12, loops, B] and motions of the slots of frames a, then of frames b; the world's own for the ground."""
    poses, ground = cat([R, p], 1), x["ground"][:, None]
    out = []
    for slots in x["slots"]:
        grounded = (slots == walk.slots + 1).reshape(-1, *(1,) * (ground.ndim - 2))
        out += [jnp.where(grounded, ground, take(poses, slots)), *(take(y, slots) for y in motions)]
    return out


def _local(x, at_a, Va, Aa, at_b, Vb, Ab, lam):
    """The same from the poses [12, loops, B], twists and accelerations of the slots; the wrenches by loop."""
    ends = ends_of(at_a, at_b, x["frames"])
    X = basis(x["rows"], ends)
    return wrenches(x["rows"], X, lam, Va.shape[1]), acceleration(x["rows"], ends, X, Va, Vb, Aa, Ab)


def on_slots(stored, slots, F):
    """Adds F [6, loops, B] at the slots of frames a and subtracts it at those of frames b."""
    return add_to(add_to(stored, slots[0], F), slots[1], -F)


def _adjoint(*operands, parameters, work):
    """Gradient of C · F + c · (K v̇ − k) with respect to all float operands; that of slot_value if `parameters`."""
    x, (C, c) = dict(zip(OPERANDS, operands, strict=False)), operands[len(OPERANDS) :]
    B = batch_of(*(operands[k] for k in range(3, len(operands))), axes=2)
    walk, joints, R, p, S, V, A = _kinematics(x, work, B)
    W, nv, where, spherical = walk.width, x["q"].shape[0], x["slots"], x["quat"].shape[0] > 0
    dtype = c.dtype
    wide = lambda y: jnp.broadcast_to(y, (*y.shape[: -len(B)], *B))
    ends = [jnp.broadcast_to(y, (*y.shape[: -len(B)], *B)) for y in at_ends(walk, x, R, p, V, A)]
    frames = wide(x["frames"])
    local = lambda frames, *y: _local({**x, "frames": frames}, *y)
    _, pull = jax.vjp(local, frames, *ends, wide(x["lam"]))
    of_frames, *of_ends, of_lam = pull((take(wide(C), where[0]) - take(wide(C), where[1]), wide(c)))
    Ps, Bs, As = (walk.zeros(6, B, dtype) for _ in range(3))
    for s, at_end, cotangent in zip(where, (ends[:3], ends[3:]), (of_ends[:3], of_ends[3:]), strict=True):
        gathered = (_of_motion(at_end, cotangent), *cotangent[1:])
        Ps, Bs, As = (add_to(z, s, new) for z, new in zip((Ps, Bs, As), gathered, strict=True))
    motion = Motion(walk, joints, R, p, None, V, A, None, None, x["qd"], x["qdd"])

    def inward(t, parents, stored):
        Ps, As, Bs, of_q, of_qd, of_qdd, more = stored
        axis, qd = block(S, t, W), walk.of_step(motion.qd, t)
        P, a, Bv = (keep(block(y, t, W)) for y in (Ps, As, Bs))
        V1, A1 = (keep(take(y, parents)) for y in (V, A))
        up = keep(Bv + keep(force_cross(axis * qd, a)))
        g = keep(P - keep(force_cross(V1, up)) - keep(force_cross(A1, a)))
        b = keep(Bv - keep(force_cross(V1, a)))
        if more:
            found = geometry(motion, t, parents, g, keep(qd * b + walk.of_step(motion.qdd, t) * a))
            more = (put(more[0], t, W, found),)
        sums = (add_to(y, parents, z) for y, z in zip((Ps, As, Bs), (P, a, up), strict=True))
        slopes = zip((of_q, of_qd, of_qdd), (dot(axis, g), dot(axis, b), dot(axis, a)), strict=True)
        return *sums, *(walk.put_dof(y, t, z) for y, z in slopes), more

    more = (walk.empty(42, B, dtype),) if parameters or spherical else ()
    start = (Ps, As, Bs, *(walk.dofs(nv, B, dtype) for _ in range(3)), more)
    Ps, As, Bs, of_q, of_qd, of_qdd, more = walk.inward(inward, start)
    none = jnp.zeros((0, *B), dtype)
    of_quat = of_quaternions(x, walk, more[0][:, 39:]) if spherical else none[:, None]
    of_slot = none[:, None, None]
    if parameters:
        rows = cat([walk.cleared(more[0][:, :39]), walk.zeros(13, B, dtype)], 1)[: walk.slots]
        of_slot = jnp.swapaxes(rows.reshape(*walk.parent.shape, 52, *B), 1, 2)
    of_ground = _of_pose(wide(x["ground"]), Ps[walk.slots + 1])
    base = walk.slots
    return of_slot, of_q[:nv], of_quat, Bs[base], of_qd[:nv], As[base], of_qdd[:nv], of_ground, of_frames, of_lam


def _of_motion(at_end, cotangent):
    """Cotangent [6, ...] of a small motion [theta; u] of a slot with its pose [12, ...], twist and acceleration, which
    turns R by theta, moves p by u + theta x p, and moves the others with it."""
    (pose, V, A), (of_pose, of_V, of_A) = at_end, cotangent
    R, dR = (y[:9].reshape(3, 3, *y.shape[1:]) for y in (pose, of_pose))
    turn = sum(cross(R[:, k], dR[:, k]) for k in range(3)) + cross(pose[9:], of_pose[9:])
    return keep(cat([turn, of_pose[9:]]) + keep(force_cross(V, of_V)) + keep(force_cross(A, of_A)))


def _of_pose(pose, g):
    """A cotangent of a pose [12, ...] that says the same as g, of its small motions."""
    R, turn = pose[:9].reshape(3, 3, *pose.shape[1:]), g[:3] - cross(pose[9:], g[3:])
    dR = jnp.stack([cross(turn, R[:, k]) for k in range(3)], 1) / 2
    return cat([dR.reshape(9, *dR.shape[2:]), g[3:]])


@cache
def closure_adjoint(parameters: bool) -> Kernel:
    """The kernel of the cotangents."""
    n = len(OPERANDS)

    def fun(*operands, work):
        return _adjoint(*operands, parameters=parameters, work=work)

    def transpose(operands, cotangents):
        given = [(k, y) for k, y in zip(FLOATS, cotangents, strict=True) if y.size]
        found = closure_tangent(tuple(k for k, _ in given))(*operands[:n], *(y for _, y in given))
        return [y for y, z in zip(found, operands[n:], strict=True) if z is None]

    return Kernel(fun, linear=(n, n + 1), transpose=transpose, grouped=True)


@cache
def closure_tangent(given: tuple[str, ...]) -> Kernel:
    """The kernel of the tangents along the operands named, which come last."""
    n, places = len(OPERANDS), [OPERANDS.index(k) for k in given]

    def fun(*operands, work):
        def f(*xs):
            full = list(operands[:n])
            for i, y in zip(places, xs, strict=True):
                full[i] = y
            return closures(*full, work=Workspace(work.whole))

        pairs = [jnp.broadcast_arrays(operands[i], t) for i, t in zip(places, operands[n:], strict=True)]
        return jax.jvp(f, *map(tuple, zip(*pairs, strict=True)))[1]

    def transpose(operands, cotangents):
        found = closure_adjoint("slot_value" in given)(*operands[:n], *cotangents)
        found = dict(zip(FLOATS, found, strict=True))
        return [found[k] for k, y in zip(given, operands[n:], strict=True) if y is None]

    return Kernel(fun, linear=tuple(range(n, n + len(given))), transpose=transpose, grouped=True)


def closure_slope(primals, tangents):
    """Tangents of `closure_motion` at `primals`, in the order of `OPERANDS`, None being none; or None."""
    given = [i for i, t in enumerate(tangents) if t is not None and t.size]
    if not given:
        return None
    return closure_tangent(tuple(OPERANDS[i] for i in given))(*primals, *(tangents[i] for i in given))


def _rule(primals, tangents):
    out = closure_motion(*primals)
    return out, closure_slope(primals, tangents) or [jnp.zeros_like(y) for y in out]


closure_motion = Kernel(closures, rule=_rule, grouped=True)
