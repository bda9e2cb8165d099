"""Materialisation: the one place that tells XLA to compute a value once and store it."""

from jax import lax


def keep(x):
    """Store `x` (any pytree) instead of recomputing it in every consumer.

    XLA:CPU fuses a producer into each of its consumers and evaluates it there again; the barrier between the stages
    of a sweep is worth about 10x. Never put it around an array that is carried and updated in place: it is copied.
    """
    return lax.optimization_barrier(x)
