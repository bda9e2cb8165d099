"""What momentum and energy gain, against what acts: for the certificates of bases that are pushed."""

import jax
import numpy as np
from scipy.integrate import cumulative_simpson

import sdyn
from planners.certify import Row, largest
from planners.motion import rotations
from planners.problem import ONCE

BALANCE = 1e-6  # of momentum and energy, relative to their largest terms; by Simpson's rule, whole pairs of intervals


def momentum(seen, phases) -> list[Row]:
    """Change of momentum about the world's origin against the integral of the wrench on the base.

    Args:
        seen: What the models say about each phase.
        phases: Those of a plan.
    """
    worst = np.max([_lost(*pair) for pair in zip(seen, phases, strict=True)], axis=0)
    return [
        Row(f"{name} momentum that no force gave, relative", float(part), BALANCE, "")
        for name, part in zip(("angular", "linear"), worst, strict=True)
    ]


def _lost(seen, phase):
    angular, linear = np.split(seen.momentum, 2, axis=1)
    total = np.hstack([angular + np.cross(seen.centre, linear), linear])
    turn = lambda x: np.einsum("kij,kj->ki", rotations(phase.q[:, 3:7]), x)
    moment, force = turn(phase.tau[:, :3]), turn(phase.tau[:, 3:6])
    wrench = np.hstack([moment + np.cross(phase.q[:, :3], force), force])
    miss = largest((total - total[0] - cumulative_simpson(wrench, x=phase.times, axis=0, initial=0))[::2])
    scale = largest(seen.parts)
    return miss / np.where(scale > 0, scale, 1.0)


_energies = jax.jit(jax.vmap(sdyn.kinetic_energy, (None, 0, 0)), **ONCE)


def energy(phase) -> Row:
    """Change of kinetic energy against the work of all that acts, relative to the largest energy."""
    energy = np.asarray(_energies(sdyn.pack(phase.robot), phase.q, phase.v))
    work = cumulative_simpson(np.sum(phase.tau * phase.v, axis=1), x=phase.times, initial=0)
    lost = np.abs(energy - energy[0] - work)[::2].max() / max(energy.max(), np.finfo(float).tiny)
    return Row("energy that is no work, relative", float(lost), BALANCE, "")
