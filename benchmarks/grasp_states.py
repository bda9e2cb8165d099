"""How often is a tumbling target grasped? The shipped grasp with every spin of a lattice up to 5 degrees/s.

The target starts where `grasp.toml` says, in the same attitude and with the same drift; its spin is each point of the
lattice of 1.25 degrees/s within the ball of 5 degrees/s, in body axes: 257 states, from rest to spins about the
largest, the smallest and the intermediate axis. A success counts only with its certificate. A failure is compared with
where the handle goes, by inverse kinematics from many postures once a second, the base as it waits: whether the hand
can be on the handle, and whether the joints can then move as it does, for as long as tracking takes. Where no posture
is near the handle at any time, only some states are planned all the same; the others count as failures. Where a plan
was not found though the handle can be followed, `relax` says what would have to give for one.

A second, fine table about the task's own spin says what interpolating between plans errs by.

`grasp_states.py FOLDER` keeps all plans in a folder, goes on where a killed one was, and writes the results at the end.
"""

import functools
import itertools
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import harness

if __name__ == "__main__":
    os.environ |= harness.ONE_THREAD

import jax
import jax.numpy as jnp
import numpy as np

import planners
import sdyn
from planners import floating, grasp, relax, seeds, sqp
from planners.lattice import Lattice
from planners.table import NOWHERE, Entry

STEP, MOST = 1.25, 5.0  # degrees/s
TIMES = np.arange(5.0, 82.0)  # s, from the shortest approach to the longest wait, approach and tracking
POSTURES = 5  # from which inverse kinematics starts, each time
NEAR = 0.05  # m, rad; as the base reacts to the arm, the hand may come somewhat further than from a fixed one
REACHED = 1e-4  # m, rad
LEFT, NEIGHBOURS = "not found", 2  # what failed without such a reason is tried again from so many others
FASTER = 1.0  # rad/s
SETTLE = 20  # iterations from where that ended, for the multipliers that say which constraints hold
PARTS = 101, 110  # where the states that are near enough are split into tables, which were planned side by side
TRIES = 60  # iterations of the solver, each time; those that succeed take about 25
FAR = 64  # of the states without a posture near the handle at any time, those that are planned all the same
UNTRIED = Entry("not tried", "No plan was tried.", NOWHERE, 0, np.nan, {}, None)
FINE, CELLS = 0.1, 8  # degrees/s between the plans of the fine table, and cells in whose middles it is checked


def lattice() -> np.ndarray:
    """Spins [count, 3] in degrees/s, the one nearest to the task's first."""
    side = STEP * np.arange(-round(MOST / STEP), round(MOST / STEP) + 1)
    points = np.array([w for w in itertools.product(side, repeat=3) if np.linalg.norm(w) < MOST + 1e-9])
    first = np.argmin(np.linalg.norm(points - own_spin(), axis=1))
    return np.r_[points[first : first + 1], np.delete(points, first, axis=0)]


def own_spin() -> np.ndarray:
    """The task's own, degrees/s."""
    return np.rad2deg(planners.load("grasp").target.twist[:3])


def task_at(spin) -> planners.Task:
    """The shipped grasp with another spin of the target, degrees/s."""
    task = planners.load("grasp")
    twist = (*map(float, np.deg2rad(spin)), *task.target.twist[3:])
    return replace(task, target=replace(task.target, twist=twist))


# -- where the handle goes ---------------------------------------------------------------------------------------------


def followed(spin, rng) -> dict:
    """How near the hand can be brought to the handle at TIMES, position and angle together [m, rad], and how fast the
    joints must then move to stay on it, in parts of their limits; the best of some postures. And how far it is from
    the arm's root [m].
    """
    task = task_at(spin)
    data, n = grasp.data(task), len(task.joints)
    low, high = task.position_limits.T
    postures = np.clip(task.start + 0.8 * rng.normal(size=(len(TIMES), POSTURES, n)), low, high)
    postures[:, 0] = task.start
    times = jnp.asarray(np.repeat(TIMES, POSTURES))
    q, miss = seeds.reach(task.robot.frame, data, times, jnp.asarray(postures.reshape(-1, n)))
    J, goal, far = map(np.asarray, _motion(task.robot.frame, data, task.joints[0].position, times, q))
    rates = np.array([least_rates(*x, task.rate_limits) for x in zip(J, goal, strict=True)])
    on = np.asarray(miss) < REACHED
    grid = lambda x: x.reshape(len(TIMES), POSTURES).min(axis=1)
    return {"miss": grid(np.asarray(miss)), "rates": grid(np.where(on, rates, np.inf)), "distance": grid(far)}


@functools.partial(jax.jit, static_argnums=0)
def _motion(frame, data, root, times, q):
    """Jacobians of the hand, twists of the handle, world axes, and its distance from the arm's root, at times [k]."""
    chain = jax.tree.map(lambda a: a[0], data.chains)

    def one(time, q):
        R, p, _ = floating.tumbled(data.waiting, time)
        _, place, *twist = grasp.grip_motion(data, time)
        at = jnp.concatenate([p, floating.quaternion(R), q])
        column = lambda v: sdyn.frame_velocity(chain, at, jnp.concatenate([jnp.zeros(6), v]), frame)
        columns = jax.vmap(column, out_axes=1)(jnp.eye(len(q)))
        return columns, jnp.concatenate(twist), jnp.linalg.norm(place - p - R @ root)

    return jax.vmap(one)(times, q)


def least_rates(J, twist, limits) -> float:
    """The least largest rate, in parts of the limits, at which seven joints give a twist: where two are as fast."""
    J = J * limits
    x, turn = np.linalg.lstsq(J, twist, rcond=None)[0], np.linalg.svd(J)[2][-1]
    i, j, sign = PAIRS
    at = (sign * x[j] - x[i]) / (turn[i] - sign * turn[j])
    return float(np.abs(x + at[:, None] * turn).max(axis=1).min())


PAIRS = np.array([(i, j, sign) for i, j in itertools.combinations(range(7), 2) for sign in (-1, 1)]).T


def again(states, entries, seen, folder) -> tuple[list, dict]:
    """The entries, those that failed and could be followed tried again: from where they ended, then from the nearest
    that are solved, now that all are known, then from a plan for faster joints. And, by number, where those ended that
    failed again.
    """
    solved = [k for k, entry in enumerate(entries) if entry.status == "solved"]
    failed = [k for k, pair in enumerate(zip(entries, seen, strict=True)) if k not in solved and said(*pair)[0] == LEFT]

    def work(x, rng):
        k = x["number"]
        near = sorted(solved, key=lambda j: np.linalg.norm(states[j] - states[k]))[:NEIGHBOURS]
        for j in (k, *near, NOWHERE):
            guess = entries[j].variables if j != NOWHERE else loose(task_at(states[k]))
            found = planners.plan(task_at(states[k]), guess=guess, explain=False, iterations=TRIES, progress=False)
            if found.status == "solved":
                break
        out = {"status": found.status, "iterations": len(found.history) - 1, "cost": found.info["cost"], "start": j}
        out |= {"certificate": found.certificate.to_json() if found.certificate else "", "verdict": found.verdict}
        return {name: np.array(x) for name, x in out.items()} | found.variables

    found, out, ends = planners.study(folder, {str(k): {"number": k} for k in failed}, work), list(entries), {}
    for k, x in zip(failed, found.values(), strict=True):
        numbers = dict(start=int(x["start"]), iterations=int(x["iterations"]), cost=float(x["cost"]))
        variables = ends[k] = {name: x[name] for name in entries[k].variables}
        if str(x["status"]) == "solved":
            del ends[k]
            certificate = planners.Certificate.from_json(str(x["certificate"]))
            words = dict(status="solved", verdict=str(x["verdict"]))
            out[k] = entries[k]._replace(variables=variables, certificate=certificate, **words, **numbers)
    return out, ends


def loose(task) -> dict:
    """The variables of a plan whose joints may be faster than they are."""
    faster = replace(task, limits=replace(task.limits, rate=FASTER))
    return planners.plan(faster, explain=False, iterations=TRIES, progress=False).variables


def relaxed(states, ends, folder) -> list[dict]:
    """What would have to give, from where a state's last plan ended, for a plan to be found: one constraint alone, by
    an amount in its unit, or none if none was found that is enough.
    """

    def work(x, rng):
        task = task_at(states[x["number"]])
        problem = grasp.problem(task)
        z = problem.form.join(ends[x["number"]])
        *_, (state,) = sqp.solve(problem, z[None], iterations=SETTLE)
        end = sqp.outcome(sqp.pick([state], 0))
        needed = relax.relaxations(problem, end, grasp.first_guesses(task, problem, 1)[0])
        return {"said": np.array(relax.sentence(needed)), "needed": np.array(json.dumps([n._asdict() for n in needed]))}

    found = planners.study(folder, {str(k): {"number": k} for k in ends}, work)
    read = lambda x: dict(said=str(x["said"]), needed=json.loads(str(x["needed"])))
    return [dict(spin=states[k].tolist()) | read(x) for k, x in zip(ends, found.values(), strict=True)]


def longest(good) -> int:
    """Most seconds in a row."""
    return max((sum(1 for _ in run) for value, run in itertools.groupby(good) if value), default=0)


def said(entry, seen) -> tuple[str, str]:
    """Why there is no plan, in one or a few words and in a sentence."""
    on, slow = seen["miss"] < REACHED, seen["rates"] < 1
    steady = int(planners.load("grasp").phases["track"].duration[0])  # three seconds hold three of TIMES at least
    if not on.any():
        how = f"the hand stays {seen['miss'].min():.2g} (m, rad) off, the handle {seen['distance'].min():.2f} m away"
        return "out of reach", f"At all times {how} from the arm's root."
    if longest(on) < steady:
        return "briefly in reach", f"The handle is in reach for {longest(on)} s at most; tracking takes {steady}."
    if longest(on & slow) < steady:
        pace = min(seen["rates"][k : k + steady].max() for k in range(len(TIMES) - steady + 1))
        return "too fast", f"To stay on the handle for {steady} s a joint must turn at {pace:.2f} times its rate limit."
    return LEFT, f"The handle can be followed for {longest(on & slow)} s. {entry.verdict}"


# -- results -----------------------------------------------------------------------------------------------------------


def summed_up(states, entries, seen) -> dict:
    """Rates of success, what successes violate at most, and what failures say."""
    solved = np.array([entry.status == "solved" and entry.certificate.passed for entry in entries])
    reached = np.array([said(*pair)[0] == LEFT for pair in zip(entries, seen, strict=True)])
    speed = np.linalg.norm(states, axis=1)
    good = [entry for entry, ok in zip(entries, solved, strict=True) if ok]
    rows = {}
    for row in (row for entry in good for row in entry.certificate.rows):
        worst = max(row.value, rows.get(row.name, {"worst": 0.0})["worst"])
        rows[row.name] = dict(worst=worst, bound=row.bound, unit=row.unit)
    spread = lambda x: dict(zip(("least", "median", "most"), map(float, np.percentile(x, (0, 50, 100))), strict=True))
    failed = [k for k, ok in enumerate(solved) if not ok]
    words = {k: said(entries[k], seen[k]) for k in failed}
    return dict(
        planned=sum(entry is not UNTRIED for entry in entries),
        all=rate(solved),
        followable=rate(solved[reached]) | dict(successes_elsewhere=int((solved & ~reached).sum())),
        by_speed={f"{v:g}": rate(solved[np.abs(speed - v) < 1e-9]) for v in np.unique(speed.round(9))},
        worst_of_successes=rows,
        grasp_after_s=spread([entry.variables["durations"][:3].sum() for entry in good]),
        cost=spread([entry.cost for entry in good]),
        iterations=spread([entry.iterations for entry in good]),
        from_a_neighbour=sum(entry.start >= 0 for entry in good),
        failures={kind: sum(w == kind for w, _ in words.values()) for kind, _ in sorted(set(words.values()))},
        failed=[dict(spin=states[k].tolist(), kind=words[k][0], said=words[k][1]) for k in failed],
    )


def rate(solved) -> dict:
    """Share of successes with its 95 % interval after Clopper and Pearson, as if states were drawn at random."""
    from scipy.stats import beta

    k, n = int(np.sum(solved)), len(solved)
    low, high = np.nan_to_num(beta.ppf(0.025, k, n - k + 1)), 1 if k == n else beta.ppf(0.975, k + 1, n - k)
    return dict(solved=k, of=n, rate=round(k / n, 4), interval=[round(float(low), 4), round(float(high), 4)])


def interpolated(table) -> dict:
    """What the fine table's interpolation errs by in the middles of cells, and was said to at most."""
    checks = table.check(CELLS)
    each = [
        dict(
            spin=check.point.tolist(),
            status=check.entry.status,
            iterations=check.entry.iterations,
            error=check.error,
            bound=check.bound,
            violations=check.violations,
        )
        for check in checks
    ]
    largest = {
        name: [max(getattr(c, key)[name] for c in checks) for key in ("error", "bound")] for name in checks[0].error
    }
    within = {name: all(c.error[name] <= c.bound[name] for c in checks) for name in checks[0].error}
    return dict(
        plans=len(table.entries), solved=len(table.solved), step_degrees_s=FINE, largest=largest, within=within,
        table_iterations=[entry.iterations for entry in table.entries], middles=each,
    )  # fmt: skip


def draw(states, entries, kinds, path):
    """The lattice in slices of the spin about z: when the target is grasped, or why not; and what successes violate."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 5, figsize=(15, 6.8), layout="constrained")
    marks = {"out of reach": ".", "briefly in reach": "+", "too fast": "x", LEFT: "1"}
    good = [e for e in entries if e.status == "solved"]
    after = np.array([e.variables["durations"][:3].sum() if e.status == "solved" else np.nan for e in entries])
    for axis, z in zip(axes.flat, np.unique(states[:, 2]), strict=False):
        here = states[:, 2] == z
        shown = axis.scatter(*states[here, :2].T, c=after[here], s=90, vmin=np.nanmin(after), vmax=np.nanmax(after))
        for kind, mark in marks.items():
            part = here & (np.array(kinds) == kind)
            axis.scatter(*states[part, :2].T, c="k", marker=mark, s=50)
        axis.set(title=f"z: {z:g} degrees/s", xlim=(-5.6, 5.6), ylim=(-5.6, 5.6), aspect="equal")
        axis.set(xlabel="spin about x, degrees/s")
    axes[0, 0].set_ylabel("spin about y, degrees/s")
    axes[1, 0].set_ylabel("spin about y, degrees/s")
    worst = [max(row.value / row.bound for row in e.certificate.rows if row.bound) for e in good]
    axes.flat[-1].semilogy(np.arange(1, len(good) + 1), np.sort(worst), "k.", ms=4)
    axes.flat[-1].axhline(1.0, color="r")
    axes.flat[-1].set(title="worst value / bound of certificates", xlabel="plans, sorted", ylim=(None, 2.0))
    figure.colorbar(shown, ax=axes, label="grasped after, s", fraction=0.02)
    label = lambda kind: f"no plan, {kind}: {kinds.count(kind)}"
    handles = [plt.Line2D([], [], ls="", c="k", marker=mark, label=label(kind)) for kind, mark in marks.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(path, dpi=110)


def main(folder):
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", str(folder / "compiled"))
    states = lattice()
    runs = {str(k): {"spin": spin.tolist()} for k, spin in enumerate(states)}
    seen = list(planners.study(folder / "followed", runs, lambda x, rng: followed(np.array(x["spin"]), rng)).values())
    near = np.array([x["miss"].min() < NEAR for x in seen])
    print(f"{len(states)} states, {near.sum()} of them near enough", flush=True)
    ordered = lambda part: np.flatnonzero(part)[Lattice(states[part]).order]
    some = np.split(ordered(near), PARTS)
    parts = {f"near-{k}": part for k, part in enumerate(some)} | {"far": ordered(~near)[:FAR]}
    planned = {}
    for name, part in parts.items():
        table = planners.table(task_at, states[part], folder / name, seeds=1 if name == "far" else 3)
        planned |= dict(zip(part, table.entries, strict=True))
    around = own_spin() + FINE * np.array([(0, 0, 0), *(x for x in itertools.product((-1, 0, 1), repeat=3) if any(x))])
    fine = planners.table(task_at, around, folder / "fine")
    entries, ends = again(states, [planned.get(k, UNTRIED) for k in range(len(states))], seen, folder / "again")
    summary = summed_up(states, entries, seen) | dict(explained=relaxed(states, ends, folder / "relaxed"))
    harness.save("grasp_states", dict(machine=harness.machine(), **summary, interpolation=interpolated(fine)))
    kinds = ["" if e.status == "solved" else said(e, x)[0] for e, x in zip(entries, seen, strict=True)]
    draw(states, entries, kinds, harness.RESULTS / "grasp_states.png")
    print(json.dumps({k: x for k, x in summary.items() if k not in ("failed", "by_speed")}, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
