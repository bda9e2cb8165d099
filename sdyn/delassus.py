"""Closed chains by the articulated-body algorithm: x and y of M x − Kᵀ y = c, K x = d.

A unit of multiplier r is a pair of opposite wrenches on the tree. Swept inward through the factor of `aba.py`, it
leaves u_r at the joints and f_r at the base, and so does c. M⁻¹ being symmetric, no row need go outward:
    G_rs = (K M⁻¹ Kᵀ)_rs = Σ u_r D⁻¹ u_s + f_r · IA₀⁻¹ f_s             the Delassus matrix
    (K M⁻¹ c)_r = Σ u_r D⁻¹ u_c + f_r · IA₀⁻¹ f_c
    y = G⁺ (d − K M⁻¹ c),  and x by one outward sweep of u_c + Σ y_r u_r.

Forward dynamics is this with c = τ − b and d = k. The solution solves
    ID(q, v, v̇) − Kᵀ lam = τ,  K v̇ − k = d,
so its derivatives are solutions too, of what the same factor is given: dτ and dd less the slopes of the left sides. The
shortest y turns with the null space of Kᵀ besides: with z such that K z = y, by (1 − G⁺ G) dK z.
"""

from typing import NamedTuple

import jax.numpy as jnp

from sdyn.aba import Factor, accelerated, articulated, at_base, moving, reduced
from sdyn.batching import Kernel
from sdyn.chain import BaseRow, ClosureRow
from sdyn.closure_motion import OPERANDS, at_ends, closure_motion, closure_slope, on_slots
from sdyn.closure_rows import acceleration, basis, ends_of, residual, wrenches
from sdyn.materialise import keep
from sdyn.rnea import loaded
from sdyn.rnea_derivatives import slope
from sdyn.rnea_motion import flat
from sdyn.semidefinite import improved, product, pseudo_inverse
from sdyn.spatial import cat, cross, dot
from sdyn.sweep import add_to, batch_of, joints_of, take, walk_of

STRUCTURE = (
    "slot_index", "slots", "rows", "ancestors", "slot_value", "base_value", "rotor", "q", "quat", "ground", "frames",
)  # fmt: skip
"""Operands that all kernels start with, as of `newton_euler` and `closure_motion`."""
MOTION = ("V0", "qd", "f0", "tau", "G", "F", "d")
OF_CLOSURES = ("slot_value", "q", "quat", "ground", "frames")
"""What K depends on."""
FIRST_FLOAT = STRUCTURE.index("slot_value")


class Saved(NamedTuple):
    """What solutions at the same configuration use again."""

    bodies: jnp.ndarray
    factor: jnp.ndarray
    base: jnp.ndarray
    """Bodies [slots + 2, 19, B], factor of M [slots + 2, 7, B] and that of the base [21, B]."""
    u: jnp.ndarray
    f: jnp.ndarray
    """u_r [T, W, nc, B], and f_r and IA₀⁻¹ f_r [2, 6, nc, B]."""
    G: jnp.ndarray
    """The Delassus matrix, and a pseudo-inverse of it [2, nc, nc, B]."""
    judged: jnp.ndarray
    """Of each row: its length, of that of the twists that it picks a component of; 1 if it is zero but for rounding;
    and the pivot below which it depends on others [3, nc, B]."""


def _prepared(walk, x, R, p, S, blocks, bodies, leave, B):
    """The frames, rows X, and what is saved."""
    free = x["base_value"][BaseRow.FREE]
    G, Dinv, base = articulated(walk, S, blocks, x["rotor"], free, B, None)
    factor = Factor(G, walk.cleared(Dinv), base)
    ends = ends_of(*at_ends(walk, x, R, p), x["frames"])
    X = basis(x["rows"], ends)
    u, f, G = _columns(walk, S, factor, x["rows"], x["slots"], X, free)
    judged = _judged(x, walk.slots, walk.cleared(S), ends, X, free)
    inverse = pseudo_inverse(G, jnp.maximum(judged[1], leave), judged[2])
    return ends, X, Saved(flat(bodies), cat(factor[:2], 1), base, u, f, jnp.stack([G, inverse]), judged)


def _columns(walk, S, factor, rows, slots, X, free):
    """u_r [T, W, nc, B], the forces on the base and IA₀⁻¹ times them [2, 6, nc, B], and the Delassus matrix."""
    nc, _, *B = X.shape
    F, loop = jnp.moveaxis(X, 1, 0), rows[ClosureRow.LOOP]
    f = walk.zeros(6, (nc, *B), X.dtype)
    for k in range(slots.shape[1]):
        own = keep(jnp.where((loop == k).reshape(nc, *(1,) * len(B)), F, 0))[:, None]
        f = add_to(add_to(f, slots[0, k : k + 1], -own), slots[1, k : k + 1], own)
    over = Factor(factor.G[:, :, None], factor.Dinv[:, :, None], factor.base[:, None])
    left, u = reduced(walk, S[:, :, None], over, f, jnp.zeros((0, nc, *(1,) * len(B)), X.dtype))
    u, r = _live(walk, u), -left * free
    a0 = at_base(over, r)
    G = _across(u, u * _by_step(walk, factor.Dinv)[:, :, None]) + sum(r[k][:, None] * a0[k][None] for k in range(6))
    return u, jnp.stack([r, a0]), keep(G)


def _live(walk, x):
    """Values by step [T, W, ...], zero where there is no body."""
    return jnp.where(walk.live.reshape(*walk.live.shape, *(1,) * (x.ndim - 2)), x, 0)


def _across(u, w):
    """Sums over the joints of products u_r w_s [nc, nc, B]."""
    flat = lambda y: y.reshape(-1, *y.shape[2:])
    return (flat(u)[:, :, None] * flat(w)[:, None]).sum(0)


def _by_step(walk, x):
    """Values of the slots [slots + 2, 1, B], by step [T, W, B]."""
    return x[: walk.slots, 0].reshape(*walk.parent.shape, *x.shape[2:])


def _judged(x, n, S, ends, X, free):
    """The share of each row, which are zero, and the squared sine below which a row depends on others.

    A row is off by rounding, and by as much as the closures are open: where rows are redundant on the closed chain,
    that makes them look independent.
    """
    rows, slots = x["rows"], x["slots"]
    live, present = (slots < n)[..., None], (slots <= n).astype(X.dtype)
    carries = jnp.where(live, x["ancestors"][jnp.minimum(slots, n - 1)], False).astype(X.dtype)
    sign, beside = carries[0] - carries[1], ((present[0] - present[1]) ** 2)[:, None] * free
    D = jnp.moveaxis(S[:n], 1, 0)[:, None] * sign[None, :, :, None]  # twists [6, loops, slots, B]
    squares = lambda y: sum(z * z for z in y)
    turn = squares(D[:3]).sum(1) + 3 * beside
    slide = squares(D[3:] + cross(D[:3], ends.xa[:, :, None])).sum(1) + (3 + 2 * squares(ends.xa)) * beside
    loop, part, _ = rows
    size = jnp.where(((part >= 3) & (part < 6))[:, None], slide[loop], turn[loop])
    size = size * rows[ClosureRow.LIVE][:, None]
    K = dot(jnp.moveaxis(X, 1, 0)[:, :, None], jnp.moveaxis(S[:n], 1, 0)[:, None]) * sign[loop][..., None]
    square = (K * K).sum(1) + squares(jnp.moveaxis(X, 1, 0)) * beside[loop]
    eps = jnp.finfo(X.dtype).eps
    safe = jnp.sqrt(jnp.where(size > 0, size, 1.0))
    share = jnp.where(size > 0, jnp.sqrt(square) / safe, 0.0)
    drift = jnp.max(jnp.where(size > 0, jnp.abs(residual(rows, ends)) / safe, 0.0), 0, initial=0.0)
    off = jnp.maximum(64 * eps, jnp.minimum(10 * drift, 3e-5))
    dead = share <= off
    tolerance = jnp.maximum(64 * len(size) * eps, (off / jnp.where(dead, 1.0, share)) ** 2)
    return keep(jnp.stack([share, dead.astype(X.dtype), tolerance]))


def _solution(walk, S, saved: Saved, f, f0, tau, d, free, nv: int):
    """(x0, x, y) from forces f of the bodies, f0 on the base, tau [nv, B] and d [nc, B]."""
    factor = Factor(saved.factor[:, :6], saved.factor[:, 6:], saved.base)
    left, u = reduced(walk, S, factor, f, tau)
    u, r = _live(walk, u), f0 - left
    flat = lambda y: y.reshape(-1, *y.shape[2:])
    moves = flat(saved.u * (u * _by_step(walk, factor.Dinv))[:, :, None]).sum(0)
    moves = moves + sum(saved.f[1, k] * r[k] for k in range(6))
    y = keep(improved(*saved.G, keep(d - moves)[:, None])[:, 0])
    u = keep(u + (saved.u * y).sum(2))
    a0 = at_base(factor, r) * free + (saved.f[1] * y).sum(1)
    return a0, accelerated(walk, S, factor, a0, u, nv), y


def _prepare(*operands, work):
    """What solutions use again; `leave` [nc, B], last, is 1 for rows to leave out."""
    *operands, leave = operands
    x, B = dict(zip(STRUCTURE, operands, strict=True)), batch_of(*operands[FIRST_FLOAT:], leave)
    walk, none = walk_of(x["slot_index"], work), jnp.zeros((6, *B), leave.dtype)
    joints = joints_of(walk, x["slot_index"], x["slot_value"], x["q"], x["quat"])
    R, p, S, _, _, _, blocks, bodies = moving(walk, joints, x["base_value"], none, 0 * x["q"], none, B, True)
    return tuple(_prepared(walk, x, R, p, S, blocks, bodies, leave, B)[-1])


def _closed_aba(*operands, work):
    """(a0 [6, B], qdd [nv, B], lam [nc, B]) of M v̇ + b = τ + Kᵀ lam, K v̇ = k + d; the wrenches of the closures on
    the slots [slots + 2, 6, B]; and what is `Saved`."""
    x = dict(zip(STRUCTURE + MOTION, operands, strict=True))
    B = batch_of(*operands[FIRST_FLOAT:])
    walk, free, rows = walk_of(x["slot_index"], work), x["base_value"][BaseRow.FREE], x["rows"]
    joints = joints_of(walk, x["slot_index"], x["slot_value"], x["q"], x["quat"])
    held = -x["G"] if x["G"].shape[0] else jnp.zeros_like(x["V0"])  # of the ground, seen from what falls freely
    V0, A0 = (jnp.broadcast_to(y, (6, *B)) for y in (x["V0"] * free, held * (1 - free)))
    R, p, S, V, A, f, blocks, bodies = moving(walk, joints, x["base_value"], V0, x["qd"], A0, B, True)
    ends, X, saved = _prepared(walk, x, R, p, S, blocks, bodies, 0.0, B)
    f = loaded(walk, joints, f, x["F"], B)
    (Va, Aa), (Vb, Ab) = ((take(V, s), jnp.where((s == walk.slots + 1)[:, None], held[:, None], take(A, s)))
                          for s in x["slots"])  # fmt: skip
    d = x["d"] - acceleration(rows, ends, X, Va, Vb, Aa, Ab)
    a0, qdd, lam = _solution(walk, S, saved, f, x["f0"] * free, x["tau"], d, free, len(x["rotor"]))
    F = on_slots(walk.zeros(6, B, X.dtype), x["slots"], wrenches(rows, X, lam, x["slots"].shape[1]))
    return a0 - held * free, qdd, lam, F, *saved


def _solve(*operands, work):
    """(x0 [6, B], x [nv, B], y [nc, B]) of M x − Kᵀ y = c, K x = d, with c = (c0, c)."""
    n = len(STRUCTURE)
    x, saved = dict(zip(STRUCTURE, operands, strict=False)), Saved(*operands[n : n + len(Saved._fields)])
    c0, c, d = operands[n + len(saved) :]
    walk, free = walk_of(x["slot_index"], work), x["base_value"][BaseRow.FREE]
    B = batch_of(saved.base, c0, c, d, axes=2)
    f = walk.zeros(6, B, d.dtype)
    return _solution(walk, saved.bodies[:, :6], saved, f, c0 * free, c, d, free, len(x["rotor"]))


# ---- derivatives -----------------------------------------------------------------------------------------------------


def _changes(x: dict, saved: Saved, state, lam, F, tangents: dict):
    """Slopes of ID(q, v, v̇) − Kᵀ lam, of K v̇ − k, and of the wrenches of the closures: (c0, c, d, F), any of them None.

    state: V0, qd, a0, qdd and G. F: all wrenches on the slots. tangents: of the operands named, at fixed lam and v̇.
    """
    V0, qd, a0, qdd, G = state
    d = tangents.get
    free = x["base_value"][BaseRow.FREE]
    of_closures = closure_slope(
        (x["slot_index"], x["slots"], x["rows"], x["slot_value"], x["q"], x["quat"], V0 * free, qd, a0 * free, qdd,
         x["ground"], x["frames"], lam),
        (None, None, None, d("slot_value"), d("q"), d("quat"), _times(d("V0"), free), d("qd"), None, None,
         d("ground"), d("frames"), None),
    )  # fmt: skip
    turned, opening = of_closures or (None, None)
    dF = d("F") if turned is None else turned if d("F") is None or not d("F").size else turned + d("F")
    of_bodies = slope(
        (x["slot_index"], x["slot_value"], x["base_value"], x["rotor"], x["q"], x["quat"], V0, qd, a0, qdd, G, F),
        saved.bodies,
        (None, d("slot_value"), d("base_value"), d("rotor"), d("q"), d("quat"), d("V0"), d("qd"), None, None,
         d("G"), dF),
    )  # fmt: skip
    return *(of_bodies or (None, None)), opening, turned


def _turned(operands, saved: Saved, y, tangents: dict):
    """What the null space changes of the shortest y as it turns."""
    n = len(STRUCTURE)
    x = dict(zip(STRUCTURE, operands, strict=False))
    if all(tangents.get(k) is None for k in OF_CLOSURES):
        return 0.0
    rest = jnp.zeros((6, 1), y.dtype), jnp.zeros((len(x["q"]), 1), y.dtype)
    z = closed_solve(*operands[:n], *saved, *rest, y)[:2]
    kinematic = OPERANDS[:6]
    at = [*(x[k] for k in kinematic), *rest, *z, x["ground"], x["frames"], y]
    along = [*map(tangents.get, kinematic), *[None] * 4, *map(tangents.get, OF_CLOSURES[3:]), None]
    slopes = closure_slope(at, along)
    return 0.0 if slopes is None else unseen(*operands[:n], *saved, slopes[1])[0]


def _unseen(*operands, work):
    """u = (1 − G⁺ G) t [nc, B], what K moves nothing of: Kᵀ u = 0; on the rows that are not dead."""
    saved, t = Saved(*operands[len(STRUCTURE) : -1]), operands[-1]
    (G, inverse), live = saved.G, 1 - saved.judged[1]
    t = t * live
    return ((t - product(inverse, product(G, t[:, None]))[:, 0]) * live,)


def _unseen_rule(primals, tangents):
    """du = (1 − G⁺ G) (dt − dK z) − w, where K z = t − u, and w the shortest of Kᵀ w = dKᵀ u."""
    n, t, dt = len(STRUCTURE), primals[-1], tangents[-1]
    x, saved = dict(zip(STRUCTURE, primals, strict=False)), Saved(*primals[n:-1])
    (u,) = unseen(*primals)
    rest = jnp.zeros((6, 1), t.dtype), jnp.zeros((len(x["q"]), 1), t.dtype)
    along = dict(zip(STRUCTURE, tangents, strict=False))
    slopes = _changes(x, saved, (*rest, *rest, jnp.zeros((0, 1), t.dtype)), u, _wrenches(x, u), along)
    moved = [jnp.zeros_like(y) if c is None else c for y, c in zip(rest, slopes, strict=False)]
    w = closed_solve(*primals[:-1], *moved, jnp.zeros_like(t))[2]
    dt = jnp.zeros_like(t) if dt is None else dt
    return (u,), (unseen(*primals[:-1], dt)[0] - _turned(primals, saved, t - u, along) - w,)


def _unseen_transpose(operands, cotangents):
    return unseen(*operands[:-1], *cotangents)


def _wrenches(x: dict, lam):
    """What multipliers do to the slots [slots + 2, 6, B]."""
    rest = (jnp.zeros((6, 1), lam.dtype), jnp.zeros((len(x["q"]), 1), lam.dtype)) * 2
    return closure_motion(*(x[k] for k in OPERANDS[:6]), *rest, x["ground"], x["frames"], lam)[0]


def _times(x, y):
    return None if x is None else x * y


def _less(given, slopes, like):
    """given − slopes, where None is zero."""
    given = (jnp.zeros_like(y) if x is None else x for x, y in zip(given, like, strict=True))
    return [x if y is None else x - y for x, y in zip(given, slopes, strict=True)]


def _closed_rule(primals, tangents):
    out = closed_aba_saving(*primals)
    (a0, qdd, lam, F), saved = out[:4], Saved(*out[4:])
    names = STRUCTURE + MOTION
    x, along = dict(zip(names, primals, strict=True)), dict(zip(names, tangents, strict=True))
    total = F + x["F"] if x["F"].shape[0] else F
    *slopes, dF = _changes(x, saved, (x["V0"], x["qd"], a0, qdd, x["G"]), lam, total, along)
    given = _less([along[k] for k in ("f0", "tau", "d")], slopes, (x["f0"], x["tau"], x["d"]))
    a0, qdd, y = closed_solve(*primals[: len(STRUCTURE)], *saved, *given)
    dlam = y + _turned(primals, saved, lam, along)
    more = _wrenches(x, dlam)
    return out, [a0, qdd, dlam, more if dF is None else more + dF, *(jnp.zeros_like(y) for y in saved)]


def _first_three(primals, tangents):
    out, slopes = _closed_rule(primals, tangents)
    return out[:3], slopes[:3]


def _solve_rule(primals, tangents):
    """d(M x − Kᵀ y) = dc, d(K x) = dd: inverse dynamics at rest, with accelerations x and wrenches of y."""
    n = len(STRUCTURE)
    x, saved = dict(zip(STRUCTURE, primals, strict=False)), Saved(*primals[n : n + len(Saved._fields)])
    x0, qdd, y = out = closed_solve(*primals)
    rest, none = (jnp.zeros_like(x0), jnp.zeros_like(qdd)), jnp.zeros((0, 1), x0.dtype)
    along = dict(zip(STRUCTURE, tangents, strict=False))
    *slopes, _ = _changes(x, saved, (*rest, x0, qdd, none), y, _wrenches(x, y), along)
    *dx, dy = closed_solve(*primals[: n + len(saved)], *_less(tangents[-3:], slopes, primals[-3:]))
    return out, [*dx, dy + _turned(primals, saved, y, along)]


def _solve_transpose(operands, cotangents):
    """The transpose of [M, −Kᵀ; K, 0]⁻¹ is the same with the signs of d and y changed.

    y has nothing of what K does not see; without that, d is possible, which the derivative of the solution asks for.
    """
    *c, d = cotangents
    *x, y = closed_solve(*operands[:-3], *c, unseen(*operands[:-3], d)[0] - d)
    return [z for z, b in zip((*x, -y), operands[-3:], strict=True) if b is None]


def _prepare_rule(primals, tangents):
    """What is saved follows from the structure, whose tangents say all."""
    out = prepare(*primals)
    return out, [jnp.zeros_like(y) for y in out]


_linear = tuple(len(STRUCTURE) + len(Saved._fields) + k for k in range(3))
prepare = Kernel(_prepare, rule=_prepare_rule)
closed_aba_saving = Kernel(_closed_aba, rule=_closed_rule)
closed_solve = Kernel(_solve, rule=_solve_rule, linear=_linear, transpose=_solve_transpose, grouped=True)
unseen = Kernel(_unseen, rule=_unseen_rule, linear=_linear[:1], transpose=_unseen_transpose, grouped=True)
closed_aba = Kernel(lambda *operands, work: _closed_aba(*operands, work=work)[:3], rule=_first_three)
