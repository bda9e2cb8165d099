"""What a detumbling plan must keep besides limits and dynamics."""

import jax
import numpy as np
from scipy.integrate import cumulative_simpson

import sdyn
from planners.certify import Row, largest, see
from planners.motion import rotations
from planners.problem import ONCE

BALANCE = 1e-6  # of momentum and energy, relative to their largest terms; by Simpson's rule, whole pairs of intervals


def rows(task, plan) -> list[Row]:
    """Start, end, and the balances of momentum and energy."""
    (phase,) = plan.phases
    seen = see([(phase.robot, task.robot.frame, phase.q, phase.v)])[0]
    start = max(np.abs(phase.q[0] - task.first).max(), np.abs(phase.v[0] - task.captured).max())
    base, rates = phase.v[-1, :6].reshape(2, 3), dict(zip(phase.robot.v_names[6:], phase.v[-1, 6:], strict=True))
    left = [abs(rate) for name, rate in rates.items() if name not in task.base.wheels]
    return [
        Row("start differs from the state after the capture", float(start), 1e-12, "m, rad, m/s, rad/s"),
        Row("speed at the end", float(max(*np.linalg.norm(base, axis=1), *left)), task.end.speed, "rad/s, m/s"),
        *_momentum(seen, phase),
        Row("energy that is no work, relative", _energy(phase), BALANCE, ""),
    ]


def _momentum(seen, phase):
    """Change of momentum about the world's origin against the integral of the wrench on the base."""
    angular, linear = np.split(seen.momentum, 2, axis=1)
    total = np.hstack([angular + np.cross(seen.centre, linear), linear])
    turn = lambda x: np.einsum("kij,kj->ki", rotations(phase.q[:, 3:7]), x)
    moment, force = turn(phase.tau[:, :3]), turn(phase.tau[:, 3:6])
    wrench = np.hstack([moment + np.cross(phase.q[:, :3], force), force])
    miss = largest((total - total[0] - cumulative_simpson(wrench, x=phase.times, axis=0, initial=0))[::2])
    scale = largest(seen.parts)
    return [
        Row(f"{name} momentum that no force gave, relative", float(part), BALANCE, "")
        for name, part in zip(("angular", "linear"), miss / np.where(scale > 0, scale, 1.0), strict=True)
    ]


_energies = jax.jit(jax.vmap(sdyn.kinetic_energy, (None, 0, 0)), **ONCE)


def _energy(phase) -> float:
    """Change of kinetic energy against the work of all that acts, relative to the largest energy."""
    energy = np.asarray(_energies(sdyn.pack(phase.robot), phase.q, phase.v))
    work = cumulative_simpson(np.sum(phase.tau * phase.v, axis=1), x=phase.times, initial=0)
    return float(np.abs(energy - energy[0] - work)[::2].max() / max(energy.max(), np.finfo(float).tiny))
