"""Forward dynamics by the articulated-body algorithm, and M⁻¹ b by the same sweeps at rest, in the base's frame.

Outward, the force f of each body at zero accelerations (see `rnea.py`). Inward, with ρ the rotor inertia:
    U = IA S,  D = S · U + ρ,  G = U D⁻¹,  IA' += IA − G Uᵀ         (the factor)
    u = τ − S · f,  f' += f + G u                                   (the right-hand side)
Base:     IA₀ a₀ = −f₀
Outward:  q̈ = D⁻¹ u − G · a',  a = a' + S q̈

The accelerations that velocities cause are in f, so that one factor serves many right-hand sides.
Source: Featherstone, Rigid Body Dynamics Algorithms (2008), section 7.3. In Jain's operators IA = P, u = ε, f = z.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from sdyn.batching import Kernel
from sdyn.chain import BaseRow
from sdyn.materialise import keep
from sdyn.rnea import body_forces, joint_forces
from sdyn.rnea_derivatives import slope
from sdyn.rnea_motion import flat
from sdyn.spatial import blocks_times, dot, hat, solve6
from sdyn.sweep import (
    Bodies,
    Walk,
    add_to,
    at,
    batch_of,
    block,
    bodies_of,
    eye,
    joints_of,
    put,
    put_step,
    take,
    walk_of,
)

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
    """Blocks A, H, M of the articulated inertia of the base [27, B]."""


def _aba(slot_index, slot_value, base_value, rotor, q, quat, V0, qd, f0, tau, G, F, *, saving=False, whole=False):
    """Accelerations (a0 [6, B], qdd [nv, B]); the operands as of `newton_euler`, and the forces (f0, tau).

    With `saving`, also what `mass_solve` and the derivatives can use again: bodies [slots + 2, 19, B], factor
    [slots + 2, 7, B] and that of the base [27, B].
    """
    B = batch_of(slot_value, base_value, rotor, q, quat, V0, qd, f0, tau, G, F)
    free, walk = base_value[BaseRow.FREE], walk_of(slot_index, whole)
    bodies, factor = _factored(walk, slot_index, slot_value, base_value, rotor, q, quat, B)
    held = -G * (1 - free) if G.shape[0] else jnp.zeros_like(V0)  # a free base falls with the rest
    f = body_forces(walk, bodies, V0 * free, walk.by_step(qd), held, None, F, B)
    f = f.at[walk.slots].add(-f0 * free)
    a0, qdd = solve(walk, bodies.S, factor, f, walk.by_step(tau), free, rotor.shape[0])

    def improved(x):
        """One step of refinement: x + M⁻¹ (τ − ID(x)), by the same factor."""
        a0, qdd = x
        start = a0 + held
        f = body_forces(walk, bodies, V0 * free, walk.by_step(qd), start, walk.by_step(qdd), F, B)
        found0, found = joint_forces(walk, bodies.S, f, len(qdd))
        left = jnp.zeros_like(f).at[walk.slots].set((found0 - f0) * free)
        rest = walk.by_step(tau - found - rotor * qdd)
        return tuple(y + d for y, d in zip(x, solve(walk, bodies.S, factor, left, rest, free, len(qdd)), strict=True))

    light = bodies.m[walk.slots, 0] < LIGHT * bodies.m[:-1].sum((0, 1))
    a0, qdd = lax.cond(jnp.any(light & (free == 1)), improved, lambda x: x, (a0, qdd))
    a0 = a0 + G * free if G.shape[0] else a0
    return (a0, qdd, flat(bodies), jnp.concatenate(factor[:2], 1), factor.base) if saving else (a0, qdd)


def _mass_solve(slot_index, slot_value, base_value, rotor, q, quat, saved, factor, base, b0, b, *, whole=False):
    """x of M x = b, as (x0 [6, B], x [nv, B]); `saved`, `factor` and `base` are empty, or from the same M."""
    walk, free, nv = walk_of(slot_index, whole), base_value[BaseRow.FREE], rotor.shape[0]
    if saved.shape[0]:
        S, factor = saved[:, :6], Factor(factor[:, :6], factor[:, 6:], base)
    else:
        B = batch_of(slot_value, base_value, rotor, q, quat, axes=2)
        (S, *_), factor = _factored(walk, slot_index, slot_value, base_value, rotor, q, quat, B)
    B = batch_of(S, b0, b, axes=2)
    f = walk.zeros(6, B, b0.dtype).at[walk.slots].set(-b0 * free)
    return solve(walk, S, factor, f, walk.by_step(b), free, nv)


def _factored(walk, slot_index, slot_value, base_value, rotor, q, quat, B):
    joints = joints_of(walk, slot_index, slot_value, q, quat)
    _, _, bodies = bodies_of(walk, joints, base_value, B)
    return bodies, articulated(walk, bodies, rotor, base_value[BaseRow.FREE], B)


def articulated(walk: Walk, bodies: Bodies, rotor, free, B: tuple) -> Factor:
    """The articulated inertias, and the factor that they give."""
    W, dtype = walk.width, bodies.S.dtype
    rotor = walk.by_step(rotor)

    def inward(t, parents, stored):
        *stored, Gs, Ds = stored
        S = block(bodies.S, t, W)
        A, H, M = (block(x, t, W).reshape(3, 3, W, *B) for x in stored)
        U = keep(blocks_times(A, H, M, S))
        D = keep(1 / (dot(S, U) + at(rotor, t)))
        G = keep(U * D)
        less = lambda X, a, b: (X - a[:, None] * b[None]).reshape(9, W, *B)
        out = less(A, G[:3], U[:3]), less(H, G[:3], U[3:]), less(M, G[3:], U[3:])
        added = (add_to(x, parents, y) for x, y in zip(stored, out, strict=True))
        return *added, put(Gs, t, W, G), put(Ds, t, W, D[None])

    one, h = eye(dtype, *B).reshape(9, *B), hat(jnp.moveaxis(bodies.h, 1, 0))
    blocks = bodies.Io, jnp.moveaxis(h.reshape(9, *h.shape[2:]), 0, 1), bodies.m * one
    stored = *blocks, walk.zeros(6, B, dtype), walk.zeros(1, B, dtype)
    *blocks, G, D = walk.inward(inward, stored)
    held = one * (1 - free)  # a grounded base may have no mass
    A, H, M = (x[walk.slots] for x in blocks)
    return Factor(G, D, jnp.concatenate([A + held, H, M + held]))


def solve(walk: Walk, S, factor: Factor, f, tau, free, nv: int):
    """Accelerations (a0 [6, B], qdd [nv, B]) from the forces f of the bodies and tau [T, W, B]."""
    W = walk.width

    def inward(t, parents, stored):
        f, us = stored
        here = keep(block(f, t, W))
        u = keep(at(tau, t) - dot(block(S, t, W), here))
        return add_to(f, parents, here + block(factor.G, t, W) * u), put_step(us, t, u)

    def outward(t, parents, stored):
        a, x = stored
        before = keep(take(a, parents))
        qdd = keep(at(u, t) * block(factor.Dinv, t, W)[0] - dot(block(factor.G, t, W), before))
        return put(a, t, W, before + block(S, t, W) * qdd), walk.put_dof(x, t, qdd)

    f, u = walk.inward(inward, (f, jnp.broadcast_to(jnp.zeros_like(tau), (*tau.shape[:2], *f.shape[2:]))))
    A, H, M = factor.base.reshape(3, 3, 3, *factor.base.shape[1:])
    a0 = -solve6(A, H, M, f[walk.slots]) * free
    start = jnp.zeros_like(f).at[walk.slots].set(a0)
    return a0, walk.outward(outward, (start, walk.dofs(nv, f.shape[2:], f.dtype)))[1][:nv]


# ---- derivatives -----------------------------------------------------------------------------------------------------
# Forward dynamics solves ID(q, v, v̇) = τ, so dv̇ = M⁻¹ (dτ − dID), and d(M⁻¹ b) = M⁻¹ (db − dM x), by one factor; the
# transpose of M⁻¹ is itself. What a kernel saves follows from its other operands, whose tangents say all.


def _difference(b, slope, like):
    """b − slope, either of which may be None."""
    b = tuple(jnp.zeros_like(y) if x is None else x for x, y in zip(b, like, strict=True))
    return b if slope is None else tuple(x - y for x, y in zip(b, slope, strict=True))


def _aba_rule(primals, tangents):
    """dv̇ = M⁻¹ (dτ − dID(q, v, v̇))."""
    a0, qdd, *left = out = aba_saving(*primals)
    operands, along = list(primals), list(tangents)
    operands[8:10], along[8:10] = (a0, qdd), (None, None)
    b = _difference(tangents[8:10], slope(operands, left[0], along), primals[8:10])
    return out, [*mass_solve(*primals[:6], *left, *b), *(jnp.zeros_like(x) for x in left)]


def _mass_solve_rule(primals, tangents):
    """dx = M⁻¹ (db − dM x)."""
    structure, left = primals[:6], primals[6:9]
    out = mass_solve(*primals)
    rest, none = [jnp.zeros_like(x) for x in out], jnp.zeros((0, 1), out[0].dtype)
    operands = [*structure, *rest, *out, none, none[..., None]]
    b = _difference(tangents[9:], slope(operands, left[0], [*tangents[:6], *[None] * 6]), primals[9:])
    return out, mass_solve(*structure, *left, *b)


def _mass_solve_transpose(operands, cotangents):
    """M is symmetric: the cotangent of b is M⁻¹ of that of x."""
    found = mass_solve(*operands[:9], *cotangents)
    return [x for x, b in zip(found, operands[9:], strict=True) if b is None]


def _first_two(primals, tangents):
    out, slopes = _aba_rule(primals, tangents)
    return out[:2], slopes[:2]


aba = Kernel(_aba, rule=_first_two)
aba_saving = Kernel(partial(_aba, saving=True), rule=_aba_rule)
mass_solve = Kernel(_mass_solve, rule=_mass_solve_rule, linear=(9, 10), transpose=_mass_solve_transpose, grouped=True)


def nothing_saved(dtype):
    """Operands of `mass_solve` that make it start afresh."""
    return jnp.zeros((0, 1, 1), dtype), jnp.zeros((0, 1, 1), dtype), jnp.zeros((0, 1), dtype)
