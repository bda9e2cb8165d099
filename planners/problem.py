"""The problem that solvers see: a vector of variables in named blocks, a cost, and named rows of constraints.

    minimise  smooth(z) + |r(z)|^2 / 2   subject to  e(z) = 0,  i(z) <= 0,  lower <= z <= upper

Variables and rows are scaled: z = x / scale of its block, and a row is its physical value divided by the row's scale,
so that 1 is a large violation everywhere. `Rows` carries names, units and scales back to the reader.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

ONCE = dict(compiler_options={"xla_backend_optimization_level": 0})  # of programs that run for less than they compile


class Values(NamedTuple):
    """What a problem is at one point."""

    smooth: jax.Array  # [] cost that is not a square
    residual: jax.Array  # [r]; the cost has half its square
    equal: jax.Array  # [e]
    below: jax.Array  # [i], at most zero

    @property
    def cost(self):
        """The cost, []."""
        return self.smooth + self.residual @ self.residual / 2


class Summary(NamedTuple):
    """What a solver must know of one point."""

    cost: np.ndarray  # []
    equal: np.ndarray  # [e]
    below: np.ndarray  # [i]


class Kept(NamedTuple):
    """Numbers of a problem, and which of its rows are kept: 1, or 0 to leave one out; traced too."""

    data: Any
    equal: np.ndarray  # [e]
    below: np.ndarray  # [i]
    cost: np.ndarray  # [] factor


class Linear(NamedTuple):
    """A problem near one point."""

    cost: jax.Array  # []
    gradient: jax.Array  # [n]
    curvature: jax.Array  # [n, n] Gauss-Newton
    equal: jax.Array  # [e]
    A: jax.Array  # [e, n]
    below: jax.Array  # [i]
    C: jax.Array  # [i, n]


class Outcome(NamedTuple):
    """Where a solver ended, as numbers of the host."""

    z: np.ndarray  # [n] scaled
    cost: float
    equal: np.ndarray  # [e]
    below: np.ndarray  # [i]
    y: np.ndarray  # [e] multipliers of the equalities
    u: np.ndarray  # [i] multipliers of the inequalities
    stationarity: float  # of the Lagrangian, relative to 1 + |gradient of the cost|
    iteration: int
    status: str  # solved, infeasible, not converged, or dropped for better starts

    @property
    def violation(self) -> float:
        """The largest one, scaled."""
        return max(np.abs(self.equal).max(initial=0.0), self.below.max(initial=0.0))


@dataclass(frozen=True)
class Rows:
    """A group of constraint rows.

    Args:
        name: What it holds, in words: "torque of arm_3".
        scale: Physical value of 1.
        unit: Unit of the physical value.
        shape: Shape of the group; rows lie in C order.
    """

    name: str
    scale: float
    unit: str
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """Number of rows."""
        return int(np.prod(self.shape))


@dataclass(frozen=True)
class Block:
    """A named group of variables; its scale is one number, or one for each entry of the first axis."""

    name: str
    shape: tuple[int, ...]
    scale: float | tuple[float, ...] = 1.0
    units: str = ""

    @property
    def size(self) -> int:
        """Number of variables."""
        return int(np.prod(self.shape, dtype=int))

    @property
    def unit(self) -> np.ndarray:
        """Physical value of 1, broadcast to the shape."""
        scale = np.reshape(self.scale, np.shape(self.scale) + (1,) * (len(self.shape) - np.ndim(self.scale)))
        return np.broadcast_to(scale, self.shape)


@dataclass(frozen=True)
class Form:
    """A problem without its numbers: what is compiled. Equal forms share one compilation.

    Args:
        blocks: The variables.
        values: Hashable; values(x, data) -> Values, with x the variables by name, physical units.
        together: Points that `summaries` computes at once: many are faster, where one is a long chain of small steps.
        quick: Whether XLA spends little on it: where optimising takes longer than it saves in hundreds of iterations.
    """

    blocks: tuple[Block, ...]
    values: Callable
    together: int = 1
    quick: bool = False

    def join(self, x: dict) -> np.ndarray:
        """Variables by name (physical, broadcast to their blocks) to the vector z (scaled), on the host."""
        return np.concatenate([(np.broadcast_to(x[b.name], b.shape) / b.unit).ravel() for b in self.blocks])

    def split(self, z) -> dict:
        """The vector z (scaled) to variables by name (physical)."""
        out, at = {}, 0
        for b in self.blocks:
            out[b.name] = z[at : at + b.size].reshape(b.shape) * b.unit
            at += b.size
        return out

    def at(self, z, data) -> Values:
        """The problem at z (scaled); of rows that are not kept, nothing is asked."""
        if not isinstance(data, Kept):
            return self.values(self.split(z), data)
        v = self.values(self.split(z), data.data)
        return Values(
            v.smooth * data.cost,
            v.residual * jnp.sqrt(data.cost),
            v.equal * data.equal,
            v.below * data.below - (1 - data.below),
        )

    def near(self, z, data) -> Linear:
        """The problem and its first derivatives at z (scaled): forward mode, one tangent per variable, batched."""
        at = lambda z: self.at(z, data)
        v, push = jax.linearize(at, z)
        J = jax.vmap(push, out_axes=-1)(jnp.eye(z.size, dtype=z.dtype))
        return Linear(
            v.cost,
            J.smooth + v.residual @ J.residual,
            J.residual.T @ J.residual,
            v.equal,
            J.equal,
            v.below,
            J.below,
        )


def summary(form: Form, z, data) -> Summary:
    """The problem at z (scaled), as arrays of the host; compiled once for all who ask."""
    return Summary(*map(np.asarray, _summary(form, z, data)))


def summaries(form: Form, z, data) -> Summary:
    """The same at many points [k, n]."""
    parts = np.split(np.asarray(z), range(form.together, len(z), form.together))
    longer = (np.concatenate([part, np.repeat(part[-1:], form.together - len(part), axis=0)]) for part in parts)
    found = [_summaries(form, part, data) for part in longer]
    return Summary(*(np.concatenate(x)[: len(z)] for x in zip(*found, strict=True)))


@functools.partial(jax.jit, static_argnums=0, **ONCE)
def _summary(form, z, data):
    v = form.at(z, data)
    return v.cost, v.equal, v.below


def _summaries(form, z, data):
    if form.together == 1:
        return [x[None] for x in summary(form, z[0], data)]
    return _together(form, z, data)


_together = jax.jit(jax.vmap(_summary.__wrapped__, (None, 0, None)), static_argnums=0, **ONCE)


@dataclass(frozen=True, eq=False)
class Problem:
    """A form with its numbers, all traced: another target or limit compiles nothing.

    Args:
        form: What is compiled.
        data: Numbers that the form's values read, any pytree.
        lower, upper: Bounds of the variables by name, physical units; none where not named.
        equal, below: Names of the rows, in order.
    """

    form: Form
    data: Any
    lower: dict
    upper: dict
    equal: tuple[Rows, ...]
    below: tuple[Rows, ...]

    @property
    def numbers(self) -> tuple:
        """(data, lower [n], upper [n]): all that is traced; the bounds scaled, and all rows kept."""
        free = lambda bounds, x: self.form.join({b.name: x for b in self.form.blocks} | bounds)
        rows = (np.ones(sum(rows.size for rows in groups)) for groups in (self.equal, self.below))
        return Kept(self.data, *rows, np.ones(())), free(self.lower, -np.inf), free(self.upper, np.inf)

    def worst(self, equal, below, count: int = 3) -> list[tuple[str, float, str]]:
        """The groups that are violated most, relative to their scale: (name, amount, unit), physical units."""
        out, parts = [], [(self.equal, np.abs(equal)), (self.below, np.maximum(below, 0.0))]
        for groups, values in parts:
            at = 0
            for rows in groups:
                amount = values[at : at + rows.size].max(initial=0.0)
                at += rows.size
                out.append((amount, (rows.name, float(amount * rows.scale), rows.unit)))
        return [x for amount, x in sorted(out, key=lambda x: -x[0])[:count] if amount > 0]

    def holding(self, u, besides=()) -> str | None:
        """The group of inequalities whose multipliers u are largest in sum, besides some; None if there is none."""
        parts = np.split(u, np.cumsum([rows.size for rows in self.below])[:-1]) if self.below else ()
        sums = zip(self.below, parts, strict=True)
        weights = {rows.name: part.sum() for rows, part in sums if rows.name not in besides}
        name = max(weights, key=weights.get, default=None)
        return name if name and weights[name] > 1e-3 else None
