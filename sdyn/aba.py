"""Forward dynamics by the articulated-body algorithm, and M⁻¹ b by the same sweeps at rest.

In the base's frame, or in the links' own: then what goes from a body to another is transformed on the way.

Outward, the force f of each body at zero accelerations (see `rnea.py`). Inward, with ρ the rotor inertia:
    U = IA S,  D = S · U + ρ,  G = U D⁻¹,  IA' += IA − G Uᵀ         (the factor)
    u = τ − S · f,  f' += f + G u                                   (the right-hand side)
Base:     IA₀ a₀ = −f₀
Outward:  q̈ = D⁻¹ u − G · a',  a = a' + S q̈

The accelerations that velocities cause are in f, so that one factor serves many right-hand sides.
Source: Featherstone, Rigid Body Dynamics Algorithms (2008), section 7.3. In Jain's operators IA = P, u = ε, f = z.
"""

from functools import cache, partial
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from sdyn.batching import Kernel
from sdyn.chain import BaseRow, ValueRow
from sdyn.materialise import keep
from sdyn.rnea import force, loaded, newton_euler
from sdyn.rnea_derivatives import slope
from sdyn.rnea_motion import flat
from sdyn.spatial import blocks_of, blocks_outer, blocks_times, blocks_to_parent, cat, dot, solve6
from sdyn.sweep import (
    Bodies,
    Joints,
    Walk,
    add_to,
    advanced,
    at,
    base_inertia,
    batch_of,
    block,
    down,
    eye,
    hinge,
    inertia_of,
    joints_of,
    masses,
    placed,
    put,
    put_step,
    take,
    up,
    walk_of,
)
from sdyn.workspace import Workspace

LIGHT = 0.02
"""Share of the mass below which a free base is light. The inertia that it feels is a small difference of large ones,
and accelerations lose digits in proportion (0.3 kg of 800 kg: 1e-11); one step of refinement brings them back (3e-13).
"""


class Factor(NamedTuple):
    """M⁻¹ in the making: what the articulated inertias leave behind."""

    G: jnp.ndarray
    Dinv: jnp.ndarray
    """U D⁻¹ [slots + 2, 6, B] and D⁻¹ [slots + 2, 1, B] of each slot."""
    base: jnp.ndarray
    """Blocks A, H, M of the articulated inertia of the base [21, B]."""


def _aba(slot_index, slot_value, base_value, rotor, q, quat, V0, qd, f0, tau, G, F, *, work, saving=False, link=False):
    """Accelerations (a0 [6, B], qdd [nv, B]); the operands as of `newton_euler`, and the forces (f0, tau).

    With `saving`, also what `mass_solve` and the derivatives can use again: bodies [slots + 2, 19, B], factor
    [slots + 2, 7, B] and that of the base [21, B].
    """
    B = batch_of(slot_value, base_value, rotor, q, quat, V0, qd, f0, tau, G, F)
    free, walk, structure = base_value[BaseRow.FREE], walk_of(slot_index, work), (slot_index, slot_value, base_value)
    held = -G * (1 - free) if G.shape[0] else jnp.zeros_like(V0)  # a free base falls with the rest
    joints = joints_of(walk, slot_index, slot_value, q, quat, link)
    R, p, S, V, A, f, blocks, bodies = moving(walk, joints, base_value, V0 * free, qd, held, B, saving)
    walk.work.release(V, A)
    hinges = (R, p) if link else None
    factor = articulated(walk, S, blocks, rotor, free, B, hinges)
    f = loaded(walk, joints, f, F, B)
    a0, qdd = solve(walk, S, factor, f, f0 * free, tau, free, rotor.shape[0], hinges)

    def improved(x):
        """One step of refinement: x + M⁻¹ (τ − ID(x)), by the same factor."""
        (a0, qdd), own = x, Workspace(work.whole)  # what is in a branch stays there
        operands = *structure, rotor, q, quat, V0, qd, lifted(a0), qdd, G, F
        found0, found = newton_euler(*operands, work=own, link=link)
        left, same = (f0 * free - found0, tau - found), walk._replace(work=own)
        more = solve(same, S, factor, walk.zeros(6, B, f.dtype), *left, free, len(qdd), hinges)
        return tuple(y + d for y, d in zip(x, more, strict=True))

    lifted = lambda a0: a0 + G * free if G.shape[0] else a0
    m0, m = base_value[BaseRow.MASS], slot_value[:, ValueRow.MASS]
    light = m0 < LIGHT * (m0 + m.sum((0, 1)))
    a0, qdd = lax.cond(jnp.any(light & (free == 1)), improved, lambda x: x, (a0, qdd))
    a0 = lifted(a0)
    return (a0, qdd, flat(bodies), cat(factor[:2], 1), factor.base) if saving else (a0, qdd)


def moving(walk: Walk, joints: Joints, base_value, V0, qd, A0, B: tuple, saving: bool):
    """Poses, axes S, twists, accelerations and forces at zero q̈, and inertia blocks of all bodies; the bodies, if
    `saving`."""
    of_pose = lambda R, p: (R, p) if joints.link else None

    def values(V, A, m, h, Io):
        own = (Io.reshape(9, *h.shape[1:]), h) if saving else ()
        return (V, A, force((m, h, Io), V, A), *blocks_of(m, h, Io), *own)

    def body(t, parents, R, p, S, stored):
        V, A = (keep(down(of_pose(R, p), take(x, parents))) for x in stored[:2])
        V, A = advanced(V, A, S, walk.of_step(qd, t))
        return values(V, A, *keep(inertia_of(joints, t, R, p)))

    more = (walk.empty(len(x), B, V0.dtype, x) for x in values(V0, A0, *base_inertia(base_value)))
    R, p, S, V, A, f, *blocks = placed(walk, joints, B, body, tuple(more))
    bodies = Bodies(S, *blocks[3:], masses(walk, joints, base_value)) if saving else None
    return R, p, S, V, A, f, blocks[:3], bodies


def _mass_solve(slot_index, slot_value, base_value, rotor, q, quat, saved, factor, base, b0, b, *, work, link=False):
    """x of M x = b, as (x0 [6, B], x [nv, B]); `saved`, `factor` and `base` are empty, or from the same M."""
    walk, free, nv, hinges = walk_of(slot_index, work), base_value[BaseRow.FREE], rotor.shape[0], None
    if saved.shape[0]:
        S, factor = saved[:, :6], Factor(factor[:, :6], factor[:, 6:], base)
    else:
        B = batch_of(slot_value, base_value, rotor, q, quat, axes=2)
        joints = joints_of(walk, slot_index, slot_value, q, quat, link)
        hinges, S, factor = _factored(walk, joints, base_value, rotor, B)
    B = batch_of(S, b0, b, axes=2)
    return solve(walk, S, factor, walk.zeros(6, B, b0.dtype), b0 * free, b, free, nv, hinges)


def _factored(walk: Walk, joints: Joints, base_value, rotor, B: tuple):
    """Hinges, axes S, and the factor."""
    body = lambda t, parents, R, p, S, stored: blocks_of(*keep(inertia_of(joints, t, R, p)))
    more = (walk.empty(len(x), B, rotor.dtype, x) for x in blocks_of(*base_inertia(base_value)))
    R, p, S, *blocks = placed(walk, joints, B, body, tuple(more))
    hinges = (R, p) if joints.link else None
    return hinges, S, articulated(walk, S, blocks, rotor, base_value[BaseRow.FREE], B, hinges)


def articulated(walk: Walk, S, blocks, rotor, free, B: tuple, hinges) -> Factor:
    """The articulated inertias, from those of the bodies, and the factor that they give."""
    W, axes, dtype = walk.width, S, S.dtype

    def inward(t, parents, stored):
        *IAs, Gs, Ds = stored
        S, IA = block(axes, t, W), [block(x, t, W) for x in IAs]
        U = keep(blocks_times(*IA, S))
        D = keep(1 / (dot(S, U) + walk.of_step(rotor, t)))
        G = keep(U * D)
        found = [x - y for x, y in zip(IA, blocks_outer(G, U), strict=True)]
        if hinges is not None:
            found = blocks_to_parent(*hinge(hinges, t, W), *keep(found))
        added = (add_to(x, parents, y) for x, y in zip(IAs, found, strict=True))
        return *added, put(Gs, t, W, G), put(Ds, t, W, D[None])

    *blocks, G, D = walk.inward(inward, (*blocks, walk.empty(6, B, dtype), walk.empty(1, B, dtype)))
    massless = blocks_of(1 - free, jnp.zeros((3, *B), dtype), eye(dtype, *B) * (1 - free))  # as a grounded base may be
    return Factor(G, D, cat([x[walk.slots] + y for x, y in zip(blocks, massless, strict=True)]))


def solve(walk: Walk, S, factor: Factor, f, f0, tau, free, nv: int, hinges=None):
    """Accelerations (a0 [6, B], qdd [nv, B]) from the forces f of the bodies, f0 on the base and tau [nv, B]."""
    left, u = reduced(walk, S, factor, f, tau, hinges)
    a0 = at_base(factor, f0 - left) * free
    return a0, accelerated(walk, S, factor, a0, u, nv, hinges)


def reduced(walk: Walk, S, factor: Factor, f, tau, hinges=None):
    """The force that reaches the base [6, B], and u [T, W, B]."""
    W = walk.width

    def inward(t, parents, stored):
        f, us = stored
        here = keep(block(f, t, W))
        u = keep(walk.of_step(tau, t) - dot(block(S, t, W), here))
        return add_to(f, parents, up(hinge(hinges, t, W), here + block(factor.G, t, W) * u)), put_step(us, t, u)

    f, u = walk.inward(inward, (f, walk.work.empty((*walk.live.shape, *f.shape[2:]), f.dtype)))
    return f[walk.slots], u


def at_base(factor: Factor, f0):
    """IA₀⁻¹ f₀."""
    return solve6(factor.base[:6], factor.base[6:15], factor.base[15:], f0)


def accelerated(walk: Walk, S, factor: Factor, a0, u, nv: int, hinges=None):
    """q̈ [nv, B] from the acceleration of the base and u."""
    W, B = walk.width, u.shape[2:]

    def outward(t, parents, stored):
        a, x = stored
        before = keep(down(hinge(hinges, t, W), take(a, parents)))
        qdd = keep(at(u, t) * block(factor.Dinv, t, W)[0] - dot(block(factor.G, t, W), before))
        return put(a, t, W, before + block(S, t, W) * qdd), walk.put_dof(x, t, qdd)

    return walk.outward(outward, (walk.empty(6, B, u.dtype, a0), walk.dofs(nv, B, u.dtype)))[1][:nv]


# ---- derivatives -----------------------------------------------------------------------------------------------------
# Forward dynamics solves ID(q, v, v̇) = τ, so dv̇ = M⁻¹ (dτ − dID), and d(M⁻¹ b) = M⁻¹ (db − dM x), by one factor; the
# transpose of M⁻¹ is itself. What a kernel saves follows from its other operands, whose tangents say all.


def _difference(b, slope, like):
    """b − slope, either of which may be None."""
    b = tuple(jnp.zeros_like(y) if x is None else x for x, y in zip(b, like, strict=True))
    return b if slope is None else tuple(x - y for x, y in zip(b, slope, strict=True))


def _aba_rule(primals, tangents, link=False):
    """dv̇ = M⁻¹ (dτ − dID(q, v, v̇)); in the links' frames, starting afresh."""
    out = aba_saving(*primals) if not link else (*aba(*primals, link=True), *nothing_saved(primals[1].dtype))
    a0, qdd, *left = out
    operands, along = list(primals), list(tangents)
    operands[8:10], along[8:10] = (a0, qdd), (None, None)
    b = _difference(tangents[8:10], slope(operands, left[0], along), primals[8:10])
    return out, [*mass_solve(*primals[:6], *left, *b, link=link), *(jnp.zeros_like(x) for x in left)]


def _first_two(primals, tangents, link):
    out, slopes = _aba_rule(primals, tangents, link)
    return out[:2], slopes[:2]


def _mass_solve_rule(primals, tangents, link):
    """dx = M⁻¹ (db − dM x)."""
    structure, left = primals[:6], primals[6:9]
    out = mass_solve(*primals, link=link)
    rest, none = [jnp.zeros_like(x) for x in out], jnp.zeros((0, 1), out[0].dtype)
    operands = [*structure, *rest, *out, none, none[..., None]]
    b = _difference(tangents[9:], slope(operands, left[0], [*tangents[:6], *[None] * 6]), primals[9:])
    return out, mass_solve(*structure, *left, *b, link=link)


def _mass_solve_transpose(operands, cotangents, link):
    """M is symmetric: the cotangent of b is M⁻¹ of that of x."""
    found = mass_solve(*operands[:9], *cotangents, link=link)
    return [x for x, b in zip(found, operands[9:], strict=True) if b is None]


@cache
def _aba_kernel(link: bool) -> Kernel:
    return Kernel(partial(_aba, link=link), rule=partial(_first_two, link=link))


@cache
def _mass_kernel(link: bool) -> Kernel:
    rule, transpose = partial(_mass_solve_rule, link=link), partial(_mass_solve_transpose, link=link)
    return Kernel(partial(_mass_solve, link=link), rule=rule, linear=(9, 10), transpose=transpose, grouped=True)


def aba(*operands, link=False):
    """Accelerations (a0 [6, B], qdd [nv, B]), see `_aba`."""
    return _aba_kernel(link)(*operands)


def mass_solve(*operands, link=False):
    """x of M x = b, see `_mass_solve`; what is saved is of the common frame."""
    return _mass_kernel(link)(*operands)


aba_saving = Kernel(partial(_aba, saving=True), rule=_aba_rule)


def nothing_saved(dtype):
    """Operands of `mass_solve` that make it start afresh."""
    return jnp.zeros((0, 1, 1), dtype), jnp.zeros((0, 1, 1), dtype), jnp.zeros((0, 1), dtype)
