"""Many steps in one scan, under forces given as arrays or as functions."""

import jax
import jax.numpy as jnp
from jax import lax

from sdyn.accuracy import Accuracy
from sdyn.integrate import step


def march(chain, q, v, force, times, dt, dial: Accuracy, *, gravity=None, f_ext=None):
    """States at the ends of the steps that start at times[:-1], under force(i, t, q, v) in step i; the steps within
    them, `dial.substeps`, may be traced, at the price of reverse mode."""

    def advance(state, x):
        i, t = x
        size = jnp.asarray(dt, chain.dtype) / dial.substeps

        def part(k, state):
            now = lambda t, q, v: force(i, t, q, v)
            return step(chain, *state, now, t + k * size, size, dial, gravity=gravity, f_ext=f_ext)

        once = isinstance(dial.substeps, int) and dial.substeps == 1
        state = part(0, state) if once else lax.fori_loop(0, dial.substeps, part, state)
        return state, state

    advance = jax.checkpoint(advance) if dial.derivatives == "recomputed" else advance
    _, found = lax.scan(advance, (q, v), (jnp.arange(len(times) - 1), times[:-1]))
    return found


def forces(name, taus, steps, axis: int):
    """The force in step i as a function of time and state, and the number of steps, along `axis` of an array."""
    if callable(taus):
        if steps is None:
            raise ValueError(f"{name}: taus is a function; say how many steps with steps=.")
        return (lambda i, t, q, v: jnp.asarray(taus(t, q, v), q.dtype)), steps
    taus = jnp.asarray(taus)
    if taus.ndim != axis + 2:
        want = "[phases, steps, nv]" if axis else "[nt, nv]"
        raise ValueError(f"{name}: taus has shape {taus.shape}; it is {want}, or a function (t, q, v).")
    if steps not in (None, taus.shape[axis]):
        raise ValueError(f"{name}: steps is {steps} and taus has {taus.shape[axis]} rows; leave steps out.")
    return (lambda i, t, q, v: taus[i].astype(q.dtype)), taus.shape[axis]
