"""From a wanted error to the cheapest accuracy that delivers it, by measuring on the scene at hand."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from sdyn.accuracy import METHODS, PRESETS, Accuracy, wanted_error
from sdyn.chain import Chain
from sdyn.checks import RobotError
from sdyn.inputs import expect
from sdyn.march import forces, march

CANDIDATES = PRESETS["balanced"], PRESETS["fast"], Accuracy("semi_implicit", dtype="float32")
STIFF = Accuracy("implicit", dtype="float64")
"""Where the explicit ones are unstable at one step for each of the rollout's."""
MOST = 4096  # steps for each of the rollout's
TIMES = 3  # that a run is timed; the shortest counts


@dataclass(frozen=True)
class Measured:
    """What an accuracy gave on a scene."""

    accuracy: Accuracy
    error: float
    """Largest distance from the reference along the motion: of q relative to how far it moves, of v to its largest."""
    seconds: float
    """That the motion took to compute, compiled."""


@dataclass(frozen=True)
class Choice:
    """The cheapest accuracy that delivers, and all that was measured."""

    accuracy: Accuracy
    error: float
    seconds: float
    tried: tuple[Measured, ...]


def choose(chain: Chain, q, v, taus, dt, error, *, steps: int | None = None, gravity=None, f_ext=None) -> Choice:
    """The cheapest accuracy that keeps a motion within an error, measured against the reference preset.

    Each candidate is compiled once and run with more and more steps, so this takes seconds to minutes; it is for
    choosing once what is computed many times. On a busy machine the times, and with them the choice between close
    ones, may vary.

    Args:
        chain, q, v, taus, dt, steps, gravity, f_ext: As for `rollout`.
        error: The wanted one, a number or a string such as "1e-6"; see `Measured`.

    Raises:
        RobotError: While tracing, or if no candidate delivers it.
    """
    wanted = wanted_error(str(error))
    if not wanted or wanted < 0:
        raise RobotError(f"choose: the wanted error is {error!r}; it must be a number above 0, such as '1e-6'.")
    q, v = expect(chain, q=q, v=v)
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves((chain, q, v, dt, gravity, f_ext))):
        raise RobotError("choose: it measures, and cannot under jit or grad; choose before, and pass what it returns.")
    force, steps = forces("choose", taus, steps, 0)
    run = partial(runner, chain, q, v, force, dt, steps, gravity, f_ext)
    truth, seconds = run(PRESETS["reference"])(PRESETS["reference"].tolerance)
    if not np.isfinite(truth[0]).all():
        raise RobotError("choose: the reference itself breaks on this motion, see `diagnose`; take shorter steps.")
    tried = [Measured(PRESETS["reference"], PRESETS["reference"].tolerance, seconds)]
    good = lambda: [x for x in tried if x.error <= wanted]
    if not good():
        raise RobotError(f"choose: the wanted error is {error}; the reference itself is good to {tried[0].error:g}.")
    for candidate in CANDIDATES:
        tried += _ladder(candidate, run(candidate), truth, wanted, min(x.seconds for x in good()))
    if not tried[1].error < 0.1:
        tried += _ladder(STIFF, run(STIFF), truth, wanted, min(x.seconds for x in good()))
    best = min(good(), key=lambda x: x.seconds)
    return Choice(best.accuracy, best.error, best.seconds, tuple(tried))


def distance(found, truth) -> float:
    """The error of a motion (qs, vs), see `Measured`; infinite where it is not finite."""
    (q, v), (q0, v0) = ([np.asarray(x, float) for x in motion] for motion in (found, truth))
    moved, fastest = np.abs(q0 - q0[0]).max(initial=0.0), np.abs(v0).max(initial=0.0)
    error = max(np.abs(q - q0).max(initial=0.0) / (moved or 1.0), np.abs(v - v0).max(initial=0.0) / (fastest or 1.0))
    return float(error) if np.isfinite(error) else np.inf


def runner(chain, q, v, force, dt, steps, gravity, f_ext, accuracy) -> Callable:
    """x -> the motion (qs, vs) with x substeps, or to the tolerance x, and the seconds that it took; compiled once."""
    what = "tolerance" if accuracy.method == "adaptive" else "substeps"
    chain, q, v, dt, gravity, f_ext = accuracy.cast((chain, q, v, jnp.asarray(dt, chain.dtype), gravity, f_ext))

    @jax.jit
    def motion(chain, q, v, dt, gravity, x):
        dial, t = replace(accuracy, **{what: x}), dt * jnp.arange(steps + 1)
        return march(chain, q, v, force, t, dt, dial, gravity=gravity, f_ext=f_ext)

    def run(x):
        best = np.inf
        for _ in range(TIMES):
            start = time.perf_counter()
            qs, vs = jax.block_until_ready(motion(chain, q, v, dt, gravity, x))
            best = min(best, time.perf_counter() - start)
        return tuple(np.concatenate([x[None], xs]) for x, xs in ((q, qs), (v, vs))), best

    jax.block_until_ready(motion(chain, q, v, dt, gravity, 1e-3 if what == "tolerance" else 1))
    return run


def _ladder(candidate, run, truth, wanted, budget) -> list[Measured]:
    """More and more substeps, doubled until the error is as wanted, grows again or takes longer than another that is;
    then as few as the order says."""
    out = []

    def measure(n):
        found, seconds = run(n)
        out.append(Measured(replace(candidate, substeps=n), distance(found, truth), seconds))
        return out[-1].error

    n, last = 1, np.inf
    while (error := measure(n)) > wanted and (error < last or error > 0.1) and n < MOST and out[-1].seconds < budget:
        n, last = 2 * n, error
    if n > 1 and error <= wanted:
        fewer = int(np.ceil(1.02 * n * (error / wanted) ** (1 / METHODS[candidate.method])))
        if fewer < n:
            measure(fewer)
    return out
