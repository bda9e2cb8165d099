"""Cotangent of inverse dynamics, the gradient of c0 · f0 + c · τ, by one outward and one inward sweep.

With w the velocities that (c0, c) would cause, s = S q̇, F the applied wrenches and ρ the rotor inertia:
    outward   w = w' + S c
    body      f = I A + V x* I V − F,  A* = I w,  B* = −w x* I V − I (V x w),  T* = w x* F
    inward    (f, A*, B* + s x* A*, T*) are added to the parent; g = −w' x* f − V' x* (B* + s x* A*) − A' x* A* − T*
    of q      S · g;  of a turn and shift of the joint's frame, g itself
    of q̇      S · b,  b = B* − V' x* A*
    of q̈      S · A* + ρ c
    of S      c f + q̇ b + q̈ A*,  where the axis changes in its body
    of F      −w

Source: formulas.md, "Derivatives of forward dynamics"; the columns of a sample share its motion.
"""

import jax.numpy as jnp

from sdyn.chain import BaseRow, SlotRow
from sdyn.materialise import keep
from sdyn.rnea_motion import OPERANDS, Motion, motion_of
from sdyn.rotation import product
from sdyn.spatial import cat, cross, dot, force_cross, hat, inertia_times, mm, motion_cross, mtv, mv
from sdyn.spatial import transposed as tr
from sdyn.sweep import Walk, add_to, at, batch_of, block, body_of, inertia_at, inertia_of_base, put, take


def adjoint(*operands, parameters, work):
    """Gradient of c0 · f0 + c · τ with respect to all operands but `slot_index` and `saved`, in their order.

    Without `parameters`, those of slot_value and base_value are empty.
    """
    x, (c0, c) = dict(zip(OPERANDS, operands, strict=False)), operands[len(OPERANDS) :]
    spherical, wrench = x["quat"].shape[0] > 0, x["F"].shape[0] > 0
    motion = motion_of(x, parameters or spherical, work)
    walk, bodies, W, nv = motion.walk, motion.bodies, motion.walk.width, x["rotor"].shape[0]
    B = batch_of(*(operands[k] for k in range(1, len(operands)) if k != 12), axes=2)
    free = x["base_value"][BaseRow.FREE]
    dtype, w0 = free.dtype, c0 * free

    def local(inertia, V, IV, w):
        IVw = keep(inertia_times(*inertia, keep(motion_cross(V, w))))
        return keep(inertia_times(*inertia, w)), -keep(force_cross(w, IV)) - IVw

    def outward(t, parents, stored):
        w = keep(take(stored[0], parents) + block(bodies.S, t, W) * walk.of_step(c, t))
        here = local(inertia_at(bodies, t, W), block(motion.V, t, W), block(motion.IV, t, W), w)
        return tuple(put(y, t, W, z) for y, z in zip(stored, (w, *here), strict=True))

    at_base = local(inertia_of_base(walk, bodies), motion.V[walk.slots], motion.IV[walk.slots], w0)
    start = tuple(walk.empty(6, B, dtype, y) for y in (w0, *at_base))
    ws, As, Bs = walk.outward(outward, start)
    f, T = motion.f, ()
    if wrench:
        moment = force_cross(*(jnp.moveaxis(y, 1, 0) for y in (ws, jnp.broadcast_to(x["F"], ws.shape))))
        f, T = motion.f - x["F"], (jnp.moveaxis(moment, 0, 1),)

    def inward(t, parents, stored):
        f, As, Bs, *T, of_q, of_qd, of_qdd, more = stored
        S, qd = block(bodies.S, t, W), walk.of_step(motion.qd, t)
        fh, A, Bv, *Th = (keep(block(y, t, W)) for y in (f, As, Bs, *T))
        w, V, a = (keep(take(y, parents)) for y in (ws, motion.V, motion.A))
        up = keep(Bv + keep(force_cross(S * qd, A)))
        g = keep(keep(force_cross(w, fh)) + keep(force_cross(V, up)) + keep(force_cross(a, A)))
        g = -(g + Th[0]) if wrench else -g
        b = keep(Bv - keep(force_cross(V, A)))
        if more:
            of_S = keep(walk.of_step(c, t) * fh + qd * b + walk.of_step(motion.qdd, t) * A)
            found = [geometry(motion, t, parents, g, of_S)]
            found += [_inertial(motion, t, block(ws, t, W))] if parameters else []
            more = tuple(put(y, t, W, z) for y, z in zip(more, found, strict=True))
        sums = tuple(add_to(y, parents, z) for y, z in zip((f, As, Bs, *T), (fh, A, up, *Th), strict=True))
        slopes = zip((of_q, of_qd, of_qdd), (dot(S, g), dot(S, b), dot(S, A)), strict=True)
        return *sums, *(walk.put_dof(y, t, z) for y, z in slopes), more

    empty = walk.dofs(nv, B, dtype)
    more = (42, 13) if parameters else (42,) if spherical else ()
    more = tuple(walk.empty(k, B, dtype) for k in more)
    f, As, Bs, *T, of_q, of_qd, of_qdd, more = walk.inward(inward, (f, As, Bs, *T, empty, empty, empty, more))
    none = jnp.zeros((0, *B), dtype)
    of_quat = of_quaternions(x, walk, more[0][:, 39:]) if spherical else none[:, None]
    A0, V0 = As[walk.slots], Bs[walk.slots] * free
    of_G = -A0 if x["G"].shape[0] else none
    of_F = -walk.cleared(ws) if wrench else none[:, None, None]
    of_slot, of_base = none[:, None, None, None], none
    if parameters:
        rows = walk.cleared(cat([more[0][:, :39], more[1]], 1))[: walk.slots]
        of_slot = jnp.swapaxes(rows.reshape(*walk.parent.shape, 52, *B), 1, 2)
        of_base = _of_base(x["base_value"], w0, motion.V[walk.slots], motion.A[walk.slots])
    return (
        of_slot, of_base, c * x["qdd"], of_q[:nv], of_quat, V0, of_qd[:nv], A0 * free,
        of_qdd[:nv] + x["rotor"] * c, of_G, of_F,
    )  # fmt: skip


def geometry(motion: Motion, t, parents, g, of_S):
    """Cotangents of the joint's constants but the inertia [39, W, B], and of a turn of the child in its axes [3, W, B].

    g is the cotangent of a motion of the joint's frame: a turn of R by theta and a shift of p by x are the motion
    [theta; x − theta x p], so p has g_lin, and R has hat(g_ang − p x g_lin) R / 2.
    """
    joints, W = motion.joints, motion.walk.width
    frame = lambda y: y.reshape(3, 3, *y.shape[1:])
    Rp, R, p = frame(take(motion.R, parents)), frame(block(motion.R, t, W)), block(motion.p, t, W)
    turn, (q, _, sin, cos) = keep(g[:3] - cross(p, g[3:])), joints.turned(t)
    of_L = keep(mm(tr(Rp), mm(hat(turn), R))) / 2
    if joints.quat is not None:
        of_L = mm(of_L, tr(at(joints.quat, t)))
    of_L = of_L.reshape(9, *of_L.shape[2:])
    offset = mtv(Rp, g[3:])
    axis = mtv(R, of_S[:3] + cross(of_S[3:], p)), mtv(R, of_S[3:])
    parts = of_L, of_L * cos, of_L * sin, offset, offset * q, *axis
    return keep(cat([*parts, mtv(R, turn)]))


def _inertial(motion: Motion, t, w):
    """Cotangents of mass, centre and inertia [13, W, B] of the bodies of step t."""
    W = motion.walk.width
    R, p = block(motion.R, t, W), block(motion.p, t, W)
    m, c, _ = body_of(at(motion.joints.value, t))
    return _of_body(R.reshape(3, 3, *R.shape[1:]), p, m, c, w, block(motion.V, t, W), block(motion.A, t, W))


def _of_body(R, p, m, c, w, V, A):
    """Sums over (w, A) and (w x V, V) of products of the two at the centre of mass, in link axes."""
    x = p + mv(R, c)
    at_centre = lambda y: (mtv(R, y[:3]), mtv(R, y[3:] + cross(y[:3], x)))
    of_m, of_c, of_I = 0, 0, 0
    for al, be in ((w, A), (keep(motion_cross(w, V)), V)):
        (al, al_lin), (be, be_lin) = at_centre(al), at_centre(be)
        of_m = of_m + dot(al_lin, be_lin)
        of_c = of_c + m * (cross(be_lin, al) + cross(al_lin, be))
        of_I = of_I + (al[:, None] * be[None] + be[:, None] * al[None]) / 2
    return keep(cat([of_m[None], of_c, of_I.reshape(9, *of_I.shape[2:])]))


def _of_base(base_value, w, V, A):
    """Cotangent of the base's mass, centre and inertia; zero of the rest of `base_value`."""
    m, c = base_value[BaseRow.MASS], base_value[BaseRow.COM : BaseRow.INERTIA]
    one = jnp.broadcast_to(jnp.eye(3, dtype=m.dtype).reshape(3, 3, *(1,) * m.ndim), (3, 3, *m.shape))
    found = _of_body(one, 0 * c, m, c, w, V, A)
    return cat([found, jnp.zeros((len(base_value) - 13, *found.shape[1:]), found.dtype)])


def of_quaternions(x, walk: Walk, turn):
    """Cotangents (2 / |q|²) q o [0; theta] of the quaternions, from those of the turns of the slots."""
    of_slot, index = turn[: walk.slots], x["slot_index"][SlotRow.QUAT].reshape(-1)
    n = len(x["quat"])
    first = (index == jnp.arange(n)[:, None]).reshape(n, -1, *(1,) * (of_slot.ndim - 1))
    theta = jnp.moveaxis(jnp.where(first, of_slot, 0).sum(1), 1, 0)
    quat = jnp.swapaxes(x["quat"], 0, 1)
    found = 2 / dot(quat, quat) * product(quat + 0 * theta[:1], cat([0 * theta[:1], theta]))
    return jnp.swapaxes(found, 0, 1)
