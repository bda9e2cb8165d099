"""The dial between speed and accuracy: what a motion is computed with, named once.

Presets are points of the measured front, see `benchmarks/results/accuracy.png`; a wanted error is turned into such a
point by `choose`, on the scene at hand.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp

from sdyn.chain import Chain
from sdyn.checks import RobotError

METHODS = {"semi_implicit": 1, "rk4": 4, "variational": 2, "implicit": 4, "adaptive": 8}
"""The orders of the methods: an error of a motion shrinks like the step to this power."""


@dataclass(frozen=True)
class Accuracy:
    """What a motion is computed with."""

    method: str = "rk4"
    """Of integration, see `integrate`."""
    substeps: int = 1
    """Steps of the method in each step of the rollout."""
    dtype: str | None = None
    """float32 or float64; the chain's if left out."""
    frame: str | None = None
    """Axes of the sweeps, "common" or "link", see `pack`; the chain's if left out."""
    loops: str = "proximal"
    """Solver of closed chains, see `constrained_dynamics`."""
    drift: str | float = "project"
    """How loops stay closed, see `integrate`."""
    derivatives: str = "stored"
    """Reverse mode keeps all of every step, or only the states and has the rest "recomputed". The adaptive method has
    forward mode only where it is "stored"."""
    tolerance: float = 1e-13
    """Of the adaptive method, relative and absolute, in one step."""

    def __post_init__(self):
        allowed = dict(
            method=METHODS, dtype=(None, "float32", "float64"), frame=(None, "common", "link"),
            loops=("proximal", "partition"), derivatives=("stored", "recomputed"),
        )  # fmt: skip
        for name, values in allowed.items():
            if (value := getattr(self, name)) not in values:
                said = ", ".join(repr(x) for x in values if x)
                raise RobotError(f"accuracy: {name} is {value!r}; it must be one of {said}.")
        if isinstance(self.drift, str) and self.drift != "project":
            raise RobotError(f"accuracy: drift is {self.drift!r}; it must be 'project' or a Baumgarte rate [1/s].")
        if isinstance(self.substeps, int) and self.substeps < 1:
            raise RobotError(f"accuracy: substeps is {self.substeps}; it must be at least 1.")

    def cast(self, tree):
        """Chains in the dial's frame, and all floating-point arrays in its type."""
        if self.frame is not None:
            chain = lambda x: isinstance(x, Chain)
            tree = jax.tree.map(lambda x: _framed(x, self.frame) if chain(x) else x, tree, is_leaf=chain)
        if self.dtype is None:
            return tree
        if self.dtype == "float64" and not jax.config.jax_enable_x64:
            raise RobotError('accuracy: float64 is off; call jax.config.update("jax_enable_x64", True) first.')
        floating = lambda x: hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jnp.floating)
        return jax.tree.map(lambda x: jnp.asarray(x, self.dtype) if floating(x) else x, tree)


def _framed(chain, frame):
    inner = None if chain.inner is None else _framed(chain.inner, frame)
    return replace(chain, inner=inner, capacity=replace(chain.capacity, frame=frame))


# In float32 a motion in the link frame is 100 times more exact, and costs nothing in a batch (-4 % at 37 degrees of
# freedom, 64 samples); in float64 it costs 5 %. A single sample takes about a fifth longer in either.
PRESETS = {
    "fast": Accuracy(dtype="float32", frame="link"),
    "balanced": Accuracy(dtype="float64"),
    "accurate": Accuracy(dtype="float64", substeps=8),
    "reference": Accuracy("adaptive", dtype="float64", derivatives="recomputed"),
}


def preset(accuracy, **rest) -> Accuracy:
    """An `Accuracy`, or that of a preset's name; where it is None, one of the rest."""
    if accuracy is None:
        return Accuracy(**rest)
    if isinstance(accuracy, Accuracy):
        return accuracy
    if wanted_error(accuracy):
        raise RobotError(
            f"accuracy is {accuracy!r}: a wanted error is measured on a motion of one structure; "
            "give what `choose` finds for each phase, the finest of them."
        )
    if accuracy not in PRESETS:
        raise RobotError(
            f"accuracy is {accuracy!r}; it must be one of {', '.join(PRESETS)}, a wanted error such as '1e-6', or an "
            "Accuracy."
        )
    return PRESETS[accuracy]


def wanted_error(accuracy) -> float | None:
    """The error that a string such as "1e-6" asks for; None for all else."""
    try:
        return float(accuracy) if isinstance(accuracy, str) else None
    except ValueError:
        return None
