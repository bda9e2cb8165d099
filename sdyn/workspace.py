"""Storage for what a kernel keeps between its steps, which the blocks of a batch use one after the other."""

from collections.abc import Sequence

from jax import lax


class Workspace:
    """Storages by the order in which a kernel asks for them.

    XLA on a CPU has no memory without a value: a new array is filled, which costs a fifth of a sweep, and far more
    where a small structure lives in a large capacity. So a kernel leaves its storages to the next block.

    Args:
        whole: Whether loops must have a fixed length, for JAX to transpose them.
        given: Storages left by the block before; without them they are new.
    """

    def __init__(self, whole: bool = False, given: Sequence = ()):
        self.whole, self._given, self._free = whole, list(given), []
        self.storages = []

    def empty(self, shape: tuple, dtype):
        """An array of any values."""
        for x in self._free:
            if x.shape == shape and x.dtype == dtype:
                self._free = [y for y in self._free if y is not x]
                return x
        x = self._given[len(self.storages)] if self._given else lax.empty(shape, dtype)
        self.storages.append(x)
        return x

    def release(self, *storages):
        """Let others have these storages."""
        self._free += storages

    def updated(self, before, after):
        """`after`, which takes the place of the storage `before` from now on."""
        self.storages = [after if x is before else x for x in self.storages]
        return after
