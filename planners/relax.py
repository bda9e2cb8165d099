"""Why a problem has no solution: by how much a constraint would have to give, the others kept, for one to exist.

For one group of rows or bounds at a time,

    minimise t   subject to   the group's rows within t,   all others kept

with t in physical units. The solver first goes on from where it ended, with the group left out; then steps of an
elastic programme lower t. What a step leaves of the other rows is dear, its length costs too, and a filter takes a
step that lowers the one or the other. What is found is a local minimum: more is not needed, less may do elsewhere.
Source: Fletcher and Leyffer (2002), Nonlinear programming without a penalty function; Lewis and Wright (2016), A
proximal method for composite minimization.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from planners import qp, sqp
from planners.problem import Linear, Outcome, Problem

COUNTS = (1, 1, 2)  # groups that are looked at: of equalities, of limits and bounds, of all limits of one sort together
LEAST = 1e-3  # part of the largest multiplier that makes a group worth a look
DEAR = 1e4  # penalty of the other rows, in parts of 1 + t
KEPT, NEARLY = 1e-6, 1e-4  # scaled violation of the other rows, in sum, that counts as none: in the end, on the way
SETTLED = 1e-3  # relative gain of t that is worth a step
MARGIN = 1e-4  # relative gain that makes a point better than one that was seen
STIFF = (1.0, 1e-4, 1e3)  # weight of a step's length, first, smallest and last; the cost's curvature measures it
CHEAP = 10.0  # cost at the start, beyond which it counts for less
LONGEST = 1.0  # step of a scaled variable
WORTH = 0.3  # part of the promised gain that makes the next step bolder
TRIES = 60  # iterations of the solver without a group
ITERATIONS, PATIENCE = 60, 12  # steps that lower t, and those in a row that gain nothing


class Group(NamedTuple):
    """Rows and bounds that give together; of each, the scaled amount for one unit of t, zero for those that stay."""

    name: str
    unit: str
    scale: float  # physical value of t = 1
    equal: np.ndarray  # [e]
    below: np.ndarray  # [i]
    lower: np.ndarray  # [n]
    upper: np.ndarray  # [n]


class Relaxation(NamedTuple):
    """What one group would have to give."""

    name: str
    amount: float | None
    """The smallest one found, in `unit`; None if nothing was found that keeps the others."""
    unit: str


class Point(NamedTuple):
    """A point, with the violation of the group and of the others."""

    z: np.ndarray
    near: Linear
    t: float
    rest: float


def relaxations(problem: Problem, end: Outcome, guess, say=lambda words: None) -> list[Relaxation]:
    """What the most promising groups would have to give, each alone; the smallest relative to its scale comes first.

    Args:
        problem: One that ended as infeasible; what the solver compiled for it is used again.
        end: Where, with its multipliers: only what holds there can help.
        guess: A first guess [n], scaled: another point to start from.
        say: Is told what is looked at, group by group.
    """
    groups, found = candidates(problem, end), []
    for k, group in enumerate(groups, start=1):
        say(f"How much would have to give, {k} of {len(groups)}: {group.name}?")
        found.append(_found(problem, group, end.z, guess))
    order = sorted(range(len(groups)), key=lambda k: np.inf if found[k] is None else found[k])
    needed = lambda group, t: Relaxation(group.name, None if t is None else float(t * group.scale), group.unit)
    return [needed(groups[k], found[k]) for k in order]


def sentence(needed: list[Relaxation]) -> str:
    """What was found, in words."""
    enough = [f"{x.name} by {x.amount:.3g} {x.unit}".rstrip() for x in needed if x.amount is not None]
    if not enough:
        return "No constraint was found that would be enough to relax alone."
    return f"To relax one of these would be enough: {'; '.join(enough)}."


# -- which groups ------------------------------------------------------------------------------------------------------


class _Part(NamedTuple):
    """What may give alone: rows of one name, or one bound."""

    name: str
    family: tuple[str, str]  # what it is of its sort, and the unit
    where: str  # field of Group
    places: np.ndarray
    scale: float
    weight: float  # sum of its multipliers


def candidates(problem: Problem, end: Outcome) -> list[Group]:
    """Of equalities, of limits and bounds, and of all limits of one sort together, those that weigh most.

    What has no multiplier does not hold the end, and cannot help.
    """
    equal = [*_rows(problem.equal, "equal", np.abs(end.y))]
    limits = [*_rows(problem.below, "below", end.u), *_bounds(problem, end)]
    families = {}
    for part in limits:
        families.setdefault(part.family, []).append(part)
    sorts = [[part] for part in equal], [[part] for part in limits], [x for x in families.values() if len(x) > 1]
    weight = lambda parts: sum(part.weight for part in parts)
    least = LEAST * max((weight(parts) for sort in sorts for parts in sort), default=0.0)
    order = [sorted((x for x in sort if weight(x) > least), key=weight, reverse=True) for sort in sorts]
    best = [parts for sort, count in zip(order, COUNTS, strict=True) for parts in sort[:count]]
    sizes = len(end.y), len(end.u), len(end.z)
    return [_group(parts, *sizes) for parts in best]


def _rows(groups, where, multipliers):
    at = 0
    for rows in groups:
        places = np.arange(at, at + rows.size)
        family = rows.name.partition(" of ")[0], rows.unit
        yield _Part(rows.name, family, where, places, rows.scale, float(multipliers[places].sum()))
        at += rows.size


def _bounds(problem, end):
    """Bounds of variables; their multipliers are what the gradient of the Lagrangian leaves there."""
    near, (_, low, high) = sqp.near(problem, end.z), problem.numbers
    force = np.asarray(near.gradient + end.y @ near.A + end.u @ near.C)
    for side, bounds, sign in (("lower", low, 1.0), ("upper", high, -1.0)):
        held, at = np.abs(end.z - bounds) <= 1e-7, 0
        for block in problem.form.blocks:
            family = f"{side} bound of {block.name}", block.units
            for k, scale in enumerate(np.ravel(block.unit), start=at):
                if np.isfinite(bounds[k]):
                    name = f"{family[0]}[{k - at}]" if block.size > 1 else family[0]
                    weight = max(sign * force[k], 0.0) if held[k] else 0.0
                    yield _Part(name, family, side, np.array([k]), float(scale), float(weight))
            at += block.size


def _group(parts, e, i, n) -> Group:
    scale = max(part.scale for part in parts)
    give = {"equal": np.zeros(e), "below": np.zeros(i), "lower": np.zeros(n), "upper": np.zeros(n)}
    for part in parts:
        give[part.where][part.places] = scale / part.scale
    (sort, unit), *_ = (part.family for part in parts)
    return Group(parts[0].name if len(parts) == 1 else f"every {sort}", unit, scale, **give)


# -- how much one group must give --------------------------------------------------------------------------------------


def _found(problem, group, *starts) -> float | None:
    """The smallest t from where the others can be kept, by the first start that leads there; None without one."""
    for z in starts:
        z = _without(problem, group, z)
        if z is not None:
            t = min(_least(problem, group, z), _least(problem, group, starts[0]))
            return t if t < np.inf else None
    return None


def _without(problem, group, z):
    """Where the solver ends without the group, from z; None if that has no solution either."""
    kept, low, high = problem.numbers
    cost = np.minimum(1.0, CHEAP / float(sqp.near(problem, z).cost))  # limits may scale it: no penalty would be enough
    kept = kept._replace(equal=kept.equal * (group.equal == 0), below=kept.below * (group.below == 0), cost=cost)
    numbers = kept, np.where(group.lower > 0, -np.inf, low), np.where(group.upper > 0, np.inf, high)
    *_, (state,) = sqp.solve(problem, z[None], iterations=TRIES, numbers=numbers)
    return None if state.violation > KEPT else np.asarray(state.z)


def _least(problem, group, z) -> float:
    """The smallest t that was found near a point with all others kept; infinite without one."""
    _, low, high = problem.numbers
    look = lambda z: _point(group, z, sqp.near(problem, z), low, high)
    now, stiff = look(z), STIFF[0]
    best, seen, idle, lowest = None, [(now.t, now.rest)], 0, now.rest
    while idle < PATIENCE and len(seen) < ITERATIONS:
        if now.rest <= NEARLY:
            falls = best is None or now.t < (1 - SETTLED) * best.t
            best = now if falls else best
        else:
            falls = now.rest < 0.99 * lowest
            lowest = min(lowest, now.rest)
        idle = 0 if falls else idle + 1
        d, t, rest = _step(group, now, now.near, stiff, low, high)
        new = look(now.z + d)
        better = all(_better(new, *old) for old in seen)
        if not better and np.isfinite(new.t):  # bent: second-order correction
            unseen = dict(equal=new.near.equal - now.near.A @ d, below=new.near.below - now.near.C @ d)
            new = look(now.z + _step(group, now, now.near._replace(**unseen), stiff, low, high)[0])
            better = all(_better(new, *old) for old in seen)
        gain, promised = (now.t - new.t, now.t - t) if now.rest <= NEARLY else (now.rest - new.rest, now.rest - rest)
        pays = better and gain > WORTH * promised
        stiff = max(stiff / 2, STIFF[1]) if pays else (2 if better else 8) * stiff
        if better:
            seen.append((new.t, new.rest))
            now = new
    for _ in range(PATIENCE * (best is not None)):  # short steps, to the others alone
        if best.rest <= KEPT:
            return best.t
        best = look(best.z + _step(group, best, best.near, STIFF[2], low, high)[0])
    return np.inf


def _better(new, t, rest) -> bool:
    """Whether a point is not dominated by one that was seen; what is kept well enough is kept."""
    a, b = max(new.rest, NEARLY), max(rest, NEARLY)
    return a < (1 - MARGIN) * b or new.t < t - MARGIN * max(a - NEARLY, SETTLED * t)


def _point(group, z, near, low, high) -> Point:
    t, rest = 0.0, 0.0
    over = np.abs(near.equal), near.below, low - z, z - high
    for give, violation in zip(group[3:], over, strict=True):
        t = max(t, (violation[give > 0] / give[give > 0]).max(initial=0.0))
        rest += np.maximum(violation[give == 0], 0.0).sum()
    finite = np.isfinite(near.A).all() and np.isfinite(near.C).all() and np.isfinite([t, rest]).all()
    return Point(z, near, float(t), float(rest)) if finite else Point(z, near, np.inf, np.inf)


def _step(group, at: Point, near, stiff, low, high):
    """The step d [n], and the t and the violation of the others that the linearised rows leave."""
    d, t, rest = _programme(near, group[3:], at.z, at.t, low, high, stiff)
    return np.asarray(d), float(t), float(rest)


@jax.jit
def _programme(near, gives, z, t, low, high, stiff):
    """The group's equalities become inequalities, its bounds rows; rows that are not needed are 0 <= 1."""
    equal, below, lower, upper = gives
    row = lambda rows, give: jnp.concatenate([rows * jnp.where(give > 0, 1.0, 0.0)[:, None], -give[:, None]], axis=1)
    level = lambda give, value: jnp.where(give > 0, value - give * t, -1.0)
    one, held = jnp.eye(z.size), equal == 0
    C = jnp.concatenate(
        [
            jnp.concatenate([near.C, -below[:, None]], axis=1),
            row(near.A, equal),
            row(-near.A, equal),
            row(-one, lower),
            row(one, upper),
        ]
    )
    c = jnp.concatenate(
        [
            near.below - below * t,
            level(equal, near.equal),
            level(equal, -near.equal),
            level(lower, low - z),
            level(upper, z - high),
        ]
    )
    A = jnp.concatenate([near.A * held[:, None], jnp.zeros((len(equal), 1))], axis=1)
    a = jnp.where(held, near.equal, 0.0)
    H = jnp.pad(stiff * (near.curvature / (1 + jnp.abs(near.cost)) + 1e-2 * jnp.eye(z.size)), (0, 1))
    g = jnp.append(jnp.zeros_like(z), 1 / (1 + t))
    left = jnp.append(jnp.where(lower > 0, -LONGEST, jnp.maximum(low - z, -LONGEST)), -t)
    right = jnp.append(jnp.where(upper > 0, LONGEST, jnp.minimum(high - z, LONGEST)), 10 * (1 + t))
    x, _, _ = qp.solve(qp.Programme(H, g, A, a, C, c, left, right, jnp.asarray(DEAR)))
    d, more = x[:-1], x[-1]
    rest = jnp.abs(A @ x + a).sum() + jnp.maximum(C @ x + c, 0.0).sum()
    return d, t + more, rest
