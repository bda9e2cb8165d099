"""Rows of N four-bars (IFToMM A02): ten seconds through the positions where all rods are in line and the rank drops.

    python benchmarks/four_bars.py [N ...]

The largest relative error of the energy, whether the parallelogram stays one, how far from the pendulum of the closed
form, and the least singular value that the status reports on the way, with how often it came near to singular;
results/four_bars.json, where the rows of other N stay. N = 40 takes ten minutes.
"""

import json
import sys
import time
from pathlib import Path

import harness

harness.one_thread()
sys.path.append(str(Path(__file__).parents[1] / "tests"))

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import mechanisms  # noqa: E402
import numpy as np  # noqa: E402
from scipy.integrate import solve_ivp  # noqa: E402

import sdyn  # noqa: E402

DOWN = np.array([0.0, -9.81, 0.0])
COUNTS, DT, STEPS = (1, 2, 5, 10, 40), 0.005, 2000
NEAR = 0.1  # of the largest singular value on the way: below it, a position is near singular


@jax.jit
def roll(chain, q, v):
    qs, vs = sdyn.rollout(chain, q, v, jnp.zeros((STEPS, chain.nv)), DT, gravity=DOWN)
    mass = sdyn.params(chain).mass.sum()
    energy = lambda q, v: sdyn.kinetic_energy(chain, q, v) - mass * sdyn.centre_of_mass(chain, q) @ DOWN

    def status(q, v):
        found = sdyn.constrained_dynamics(chain, q, v, 0 * v, gravity=DOWN)[2]
        return found.sigma_min, found.rank, found.singular, found.drift

    return qs, jax.lax.map(lambda x: energy(*x), (qs, vs)), jax.lax.map(lambda x: status(*x), (qs, vs))


def run(count: int) -> dict:
    chain = sdyn.pack(mechanisms.row_of_four_bars(count))
    q = np.r_[np.full(count + 1, np.pi / 2), np.full(count, -np.pi / 2)]
    v = np.r_[np.full(count + 1, -1.0), np.full(count, 1.0)]
    start = time.perf_counter()
    qs, energy, (sigma, rank, singular, drift) = map(jax.device_get, roll(chain, q, v))
    took = time.perf_counter() - start
    angle = qs[:, : count + 1]
    apart = max(np.abs(angle - angle[:, :1]).max(), np.abs(qs[:, count + 1 :] + angle[:, :count]).max())
    inertia, weight = (count + 1) / 3 + count, 9.81 * ((count + 1) / 2 + count)
    t = np.arange(STEPS + 1) * DT
    slope = lambda t, y: [y[1], -weight / inertia * np.cos(y[0])]
    want = solve_ivp(slope, (0, t[-1]), [np.pi / 2, -1.0], "DOP853", t, rtol=1e-12, atol=1e-12).y[0]
    return dict(
        bars=count,
        rows=int(chain.capacity.rows),
        energy_error=float(np.abs(energy / energy[0] - 1).max()),
        off_the_branch_rad=float(apart),
        off_the_pendulum_rad=float(np.abs(angle[:, 0] - want).max()),
        turned_rad=float(np.abs(want).max()),
        open_by_m=float(drift.max()),
        sigma_min=[float(sigma.min()), float(sigma.max())],
        passes_near_singular=int(np.diff((sigma < NEAR * sigma.max()).astype(int), prepend=0).clip(0).sum()),
        rank=[int(rank.min()), int(rank.max())],
        steps_called_singular=int(singular.sum()),
        seconds=round(took, 1),
    )


def main():
    kept = harness.RESULTS / "four_bars.json"
    found = {x["bars"]: x for x in json.loads(kept.read_text())["results"]} if kept.exists() else {}
    for count in map(int, sys.argv[1:] or COUNTS):
        found[count] = run(count)
        print(found[count], flush=True)
        results = [found[k] for k in sorted(found)]
        harness.save("four_bars", dict(machine=harness.machine(), steps=STEPS, dt=DT, results=results))


if __name__ == "__main__":
    main()
