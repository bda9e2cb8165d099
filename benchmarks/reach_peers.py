"""One reach, three ways to plan it: `planners`, Crocoddyl, and CasADi with IPOPT as a user would write it by hand.

A robot with a free-floating base and seven joints (13 degrees of freedom) brings its hand in 10 s from rest to a pose
at rest, at the least integral of w_1 mean (tau / limit)^2 + w_2 mean qdd^2, within limits of position, rate and torque:
the shipped task `reach`, on 100 intervals. The peers hold the torque on each interval; ours follows from splines of 15
control points, once as the task has them, without acceleration at the ends, which costs more, and once without that.

A contender has reached a cost when its torques, integrated anew from the start by Pinocchio, bring hand and joints to
the goal within FEASIBLE, within the limits, at a cost that near the least that any of them found. All start from a
straight path of the joints to the same posture, which is not timed. Seconds are those of the processor, of one thread;
the clock's are kept beside.
"""

import json
import sys
import time
from dataclasses import replace
from typing import NamedTuple

import harness

if __name__ == "__main__":
    harness.one_thread()

import jax
import numpy as np
import peers
import pinocchio as pin
import reach_casadi
import reach_crocoddyl
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

import planners
import sdyn
from planners import reach, sqp

KNOTS, POINTS, STEPS = 100, 15, 4  # intervals; control points of ours; steps of the evaluation per interval
FEASIBLE, EXCESS = 1e-4, 1e-6  # of the goal [m, rad, rad/s], and beyond the limits, relative to them
WITHIN = (0.1, 0.05, 0.02, 0.01, 0.001)  # of the least cost
AGREED = 1e-10


class Common(NamedTuple):
    """The problem in Pinocchio's conventions, and a first guess."""

    model: pin.Model
    frame: int
    goal: tuple  # rotation [3, 3], position [3]
    position: np.ndarray  # [n, 2] limits
    rate: np.ndarray  # [n]
    torque: np.ndarray  # [n]
    weights: tuple  # torque, smoothness
    duration: float  # s
    knots: int
    start: np.ndarray  # [nx]
    states: np.ndarray  # [knots + 1, nx]
    torques: np.ndarray  # [knots, n]


class Followed(NamedTuple):
    """What torques do, integrated from the start."""

    cost: float
    place: float  # m, of the hand from its goal
    turn: float  # rad
    speed: float  # rad/s, the largest joint rate at the end
    excess: float  # the largest one beyond a limit, relative to it

    @property
    def feasible(self) -> bool:
        return max(self.place, self.turn, self.speed) <= FEASIBLE and self.excess <= EXCESS


def common_task():
    """The shipped reach on the common grid."""
    task = planners.load("reach")
    return replace(task, phases={"reach": replace(task.phases["reach"], control_points=POINTS, intervals=KNOTS)})


def common_of(task) -> Common:
    """The problem of a task, and its first guess."""
    problem = reach.problem(task)
    (z,) = reach.first_guesses(task, problem, 1)
    (guess,) = reach.phases(task, problem.data, problem.form.split(z), 2)
    theirs = peers.Pinocchio(task.chaser, guess.q, guess.v, guess.tau)
    frame = task.chaser.frame(task.robot.frame)
    joint, place = theirs.links[[link.name for link in task.chaser.links].index(frame.link)]
    place = place * pin.SE3(frame.rotation, frame.position)
    number = theirs.model.addFrame(pin.Frame(frame.name, joint, 0, place, pin.FrameType.OP_FRAME))
    theirs.model.names[1] = "root_joint"  # by which Crocoddyl knows a free base
    w, states = task.weights, np.hstack([theirs.q, theirs.v])
    return Common(
        theirs.model,
        number,
        tuple(map(np.asarray, problem.data.goal)),
        task.position_limits,
        task.rate_limits,
        task.torque_limits,
        (w.torque, w.smoothness),
        guess.times[-1],
        KNOTS,
        states[0],
        states[::2],
        guess.tau[1::2, 6:],
    )


# -- the neutral evaluation --------------------------------------------------------------------------------------------


def rates(common, data, q, v, tau):
    """Rates of a state of Pinocchio's and of the cost."""
    q = unit(q)
    a = pin.aba(common.model, data, q, v, np.r_[np.zeros(6), tau])
    x, w = q[3:7], v[3:6]
    turn = np.r_[x[3] * w + np.cross(x[:3], w), -x[:3] @ w] / 2
    moves = np.r_[pin.Quaternion(x).toRotationMatrix() @ v[:3], turn, v[6:]]
    return moves, a, common.weights @ np.array([((tau / common.torque) ** 2).mean(), (a[6:] ** 2).mean()])


def unit(q):
    """With a quaternion of unit length."""
    return np.r_[q[:3], q[3:7] / np.linalg.norm(q[3:7]), q[7:]]


def followed(common, torques) -> Followed:
    """RK4 from the start under torques [steps, 3, n]: those at the start, in the middle and at the end of each step."""
    data, h = common.model.createData(), common.duration / len(torques)
    state, beyond = (common.start[:14], common.start[14:], 0.0), 0.0
    for first, middle, last in torques:
        k = [rates(common, data, *state[:2], first)]
        for part, tau in ((0.5, middle), (0.5, middle), (1.0, last)):
            k.append(rates(common, data, *(x + part * h * d for x, d in zip(state[:2], k[-1][:2], strict=True)), tau))
        state = tuple(x + h / 6 * (a + 2 * b + 2 * c + d) for x, a, b, c, d in zip(state, *k, strict=True))
        q, v = state[0][7:], state[1][6:]
        off = ((q - common.position[:, 1]), (common.position[:, 0] - q), abs(v) / common.rate - 1)
        beyond = max(beyond, *(x.max() for x in off), (abs(first) / common.torque - 1).max())
    pin.framesForwardKinematics(common.model, data, unit(state[0]))
    hand, (R, p) = data.oMf[common.frame], common.goal
    turn = np.linalg.norm(pin.log3(R.T @ hand.rotation))
    place = np.linalg.norm(hand.translation - p)
    return Followed(*map(float, (state[2], place, turn, abs(state[1][6:]).max(), beyond)))


def held(torques, steps=STEPS):
    """Torques [knots, n] that are constant on each interval, for `followed`."""
    return np.repeat(np.repeat(torques, steps, axis=0)[:, None], 3, axis=1)


# -- contenders: what makes a solver; from its iterates to torques for `followed`; rounds -----------------------------


def planner(still):
    """The default solver; so many control points stand still at either end."""
    task = common_task()
    problem = reach.problem(task, still=still)
    (z,) = reach.first_guesses(task, problem, 1)

    def make():
        sqp.compile_all(problem)

        def solve(note):
            with threadpool_limits(1, "blas"):
                for (state,) in sqp.solve(problem, z[None]):
                    note(np.asarray(state.z))
            return sqp.outcome(state).status

        return solve

    def torques(z):
        (phase,) = reach.phases(task, problem.data, problem.form.split(z), 2 * STEPS)
        tau = phase.tau[:, 6:]
        return np.stack([tau[:-1:2], tau[1::2], tau[2::2]], axis=1)

    return make, torques, 3


def peer(module, common, rounds):
    """Crocoddyl or CasADi."""

    def make():
        solve = module.prepared(common)
        return lambda note: solve(common.states, common.torques, note)

    return make, held, rounds


def contenders(common) -> dict:
    """All of them, by name; with the number of rounds."""
    return {
        "planners": planner(2),
        "planners, smooth": planner(3),
        "Crocoddyl, FDDP": peer(reach_crocoddyl, common, 3),
        "CasADi, IPOPT": peer(reach_casadi, common, 1),
    }


def timed(f):
    """What it returns, and the seconds of the processor and of the clock that it takes."""
    cpu, wall = time.process_time(), time.perf_counter()
    out = f()
    return out, dict(cpu_s=round(time.process_time() - cpu, 4), wall_s=round(time.perf_counter() - wall, 4))


def run(common, make, torques, rounds) -> dict:
    """A contender's best of some rounds: every iterate with the time that it took until then, and what it is worth."""
    solve, made = timed(make)
    found = []
    for _ in range(rounds):
        iterates, began = [], time.process_time()
        note = lambda x, iterates=iterates, began=began: iterates.append((time.process_time() - began, np.array(x)))
        status, total = timed(lambda note=note: solve(note))
        found.append(dict(status=status, **total, iterates=iterates))
    best = min(found, key=lambda x: x["cpu_s"])
    worth = [(round(t, 4), followed(common, torques(x))) for t, x in best["iterates"]]
    best["iterates"] = [dict(cpu_s=t, feasible=x.feasible, **x._asdict()) for t, x in worth]
    return dict(made=made) | best


# -- agreement, before anything is timed -------------------------------------------------------------------------------


def agreement(common) -> dict:
    """Largest differences, relative to the largest value: accelerations, pose of the hand, cost of the same motion."""
    task = common_task()
    q, v, tau = peers.states(task.chaser, 20)
    theirs = peers.Pinocchio(task.chaser, q, v, tau)
    chain = sdyn.pack(task.chaser)
    hand = chain.capacity.frame_names.index(task.robot.frame)
    vdot = np.asarray(jax.vmap(sdyn.forward_dynamics, (None, 0, 0, 0))(chain, q, v, tau))
    R, p = map(np.asarray, jax.vmap(sdyn.frame_pose, (None, 0, None))(chain, q, hand))
    flow, data = reach_casadi.flow(common), common.model.createData()
    symbolic, poses = [], []
    for k in range(len(q)):
        rate, _ = flow(np.r_[theirs.q[k], theirs.v[k]], theirs.tau[k, 6:])
        symbolic.append(rate.full().ravel()[14:])
        pin.framesForwardKinematics(common.model, data, theirs.q[k])
        poses.append(data.oMf[common.frame].homogeneous[:3])
    far = lambda x, y: float(abs(x - y).max() / abs(y).max())
    symbolic = theirs.convert.from_vdot(theirs.q, theirs.v, np.array(symbolic))
    cost = followed(common, held(common.torques, 1)).cost  # one step of RK4 per interval, as the peers take
    F, x, summed = reach_casadi.interval(common), common.start, 0.0
    for tau in common.torques:
        x, part = F(x, tau)
        summed += float(part)
    return {
        "accelerations, planners and Pinocchio": far(vdot, theirs.vdot()),
        "accelerations, CasADi and Pinocchio": far(symbolic, theirs.vdot()),
        "pose of the hand": far(np.concatenate([R, p[..., None]], axis=2), np.array(poses)),
        "cost, Crocoddyl": abs(reach_crocoddyl.cost_of(common, common.torques) / cost - 1),
        "cost, CasADi": abs(summed / cost - 1),
    }


# -- report ------------------------------------------------------------------------------------------------------------


def reached(result) -> dict:
    """Of each contender, the seconds until its first feasible iterate within each part of the least cost of all."""
    runs = result["contenders"]
    least = min(x["cost"] for run in runs.values() for x in run["iterates"] if x["feasible"])
    first = lambda run, part: next(
        (x["cpu_s"] for x in run["iterates"] if x["feasible"] and x["cost"] <= (1 + part) * least), None
    )
    return {name: {f"{part:g}": first(run, part) for part in WITHIN} for name, run in runs.items()}


def show(result):
    """The table."""
    table = Table(title="Seconds of the processor to a feasible motion whose cost is within", title_justify="left")
    table.add_column("")
    for title in (*(f"{100 * part:g} %" for part in WITHIN), "least cost", "made"):
        table.add_column(title, justify="right")
    for name, run in result["contenders"].items():
        times = ("-" if t is None else f"{t:.3g}" for t in result["seconds_within"][name].values())
        costs = [x["cost"] for x in run["iterates"] if x["feasible"]]
        table.add_row(name, *times, f"{min(costs):.5f}" if costs else "-", f"{run['made']['cpu_s']:.1f}")
    Console(width=80).print(table)


def main(names):
    jax.config.update("jax_enable_x64", True)
    path = harness.RESULTS / "reach_peers.json"
    result = json.loads(path.read_text()) if path.is_file() and names else dict(contenders={})
    common = common_of(common_task())
    result |= dict(machine=harness.machine("casadi", "crocoddyl", "pin"), agreement=agreement(common))
    print(json.dumps(result["agreement"], indent=1), flush=True)
    assert max(result["agreement"].values()) <= AGREED
    for name, contender in contenders(common).items():
        if not names or name in names:
            result["contenders"][name] = run(common, *contender)
            result["seconds_within"] = reached(result)
            harness.save("reach_peers", result)
            show(result)


if __name__ == "__main__":
    main(sys.argv[1:])  # nothing: all; else names of contenders, to be measured again
