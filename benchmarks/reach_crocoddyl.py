"""The common reach in Crocoddyl: box FDDP on RK4 with constant torques on each interval.

What must hold at the end is a penalty, which grows from one solve to the next, each from where the last ended. Limits
of torque are bounds of the controls, those of positions and rates quadratic barriers.
"""

import crocoddyl
import numpy as np
import pinocchio as pin

PENALTIES, BARRIER, ITERATIONS = (1e2, 1e5, 1e8), 1e2, 200


class Noted(crocoddyl.CallbackAbstract):
    """Passes the torques of every iteration on."""

    def __init__(self, note):
        crocoddyl.CallbackAbstract.__init__(self)
        self.note = note

    def __call__(self, solver):
        self.note(np.array(solver.us.tolist()))


def running(state, common):
    """The cost of one interval, and what keeps joints within their limits."""
    n, costs = len(common.torque), crocoddyl.CostModelSum(state, len(common.torque))
    term = lambda *parts: crocoddyl.CostModelResidual(state, *parts)
    torque = crocoddyl.ActivationModelWeightedQuad(2 * common.weights[0] / n / common.torque**2)
    costs.addCost("torque", term(torque, crocoddyl.ResidualModelControl(state, n)), 1.0)
    joints = crocoddyl.ActivationModelWeightedQuad(np.r_[np.zeros(6), np.full(n, 2 * common.weights[1] / n)])
    costs.addCost("smoothness", term(joints, crocoddyl.ResidualModelJointAcceleration(state, n)), 1.0)
    free = np.full(6, np.inf)
    low = np.r_[-free, common.position[:, 0], -free, -common.rate]
    high = np.r_[free, common.position[:, 1], free, common.rate]
    limits = crocoddyl.ActivationModelQuadraticBarrier(crocoddyl.ActivationBounds(low, high, 1.0))
    costs.addCost("limits", term(limits, crocoddyl.ResidualModelState(state, state.zero(), n)), BARRIER)
    return costs


def terminal(state, common, penalty):
    """The hand at its goal and the joints at rest."""
    n, costs = len(common.torque), crocoddyl.CostModelSum(state, len(common.torque))
    pose = crocoddyl.ResidualModelFramePlacement(state, common.frame, pin.SE3(*common.goal), n)
    costs.addCost("pose", crocoddyl.CostModelResidual(state, pose), penalty)
    rates = crocoddyl.ActivationModelWeightedQuad(np.r_[np.zeros(2 * state.nv - n), np.ones(n)])
    rest = crocoddyl.CostModelResidual(state, rates, crocoddyl.ResidualModelState(state, state.zero(), n))
    costs.addCost("rest", rest, penalty)
    return costs


def shooting(common, penalty):
    """The problem with one penalty."""
    state = crocoddyl.StateMultibody(common.model)
    actuation = crocoddyl.ActuationModelFloatingBase(state)
    dynamics = lambda costs: crocoddyl.DifferentialActionModelFreeFwdDynamics(state, actuation, costs)
    step = common.duration / common.knots
    node = crocoddyl.IntegratedActionModelRK(dynamics(running(state, common)), crocoddyl.RKType.four, step)
    node.u_lb, node.u_ub = -common.torque, common.torque
    end = crocoddyl.IntegratedActionModelEuler(dynamics(terminal(state, common, penalty)), 0.0)
    return crocoddyl.ShootingProblem(common.start, [node] * common.knots, end)


def prepared(common):
    """A function of first states [knots + 1, nx], torques [knots, n], and of what is told the torques it comes by."""
    solvers = [crocoddyl.SolverBoxFDDP(shooting(common, penalty)) for penalty in PENALTIES]

    def solve(states, torques, note):
        xs, us = list(states), list(torques)
        for solver in solvers:
            solver.setCallbacks([Noted(note)])
            done = solver.solve(xs, us, ITERATIONS, False)
            xs, us = list(solver.xs), list(solver.us)
        return "solved" if done else "not converged"

    return solve


def cost_of(common, torques) -> float:
    """The cost of a motion from the start, by Crocoddyl's own models and integration."""
    problem = shooting(common, 0.0)
    return problem.calc(problem.rollout(list(torques)), list(torques))
