"""The referee: the same task, stated again in CasADi, differentiated by CasADi and solved by IPOPT.

What it shares with the default solver is the meaning of the variables (blocks of splines and durations), the names of
the constraint rows, and the first guess. Dynamics, target motion, transcription, derivatives and solver are others, so
two solvers that agree on a minimum are strong evidence for it.
Source: Waechter and Biegler (2006), On the implementation of an interior-point filter line-search algorithm.
"""

import importlib
from functools import cached_property

import casadi as ca
import numpy as np

from planners.problem import Outcome, Problem

OPTIONS = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.max_iter": 500,
    "ipopt.tol": 1e-9,
    "ipopt.constr_viol_tol": 1e-10,
    "ipopt.bound_relax_factor": 0.0,
}
NEAR = {  # for a start that is all but a minimum: stay near the limits that it touches
    "ipopt.mu_init": 1e-5,
    "ipopt.bound_push": 1e-7,
    "ipopt.bound_frac": 1e-7,
    "ipopt.slack_bound_push": 1e-7,
    "ipopt.slack_bound_frac": 1e-7,
}
STATUSES = {"Solve_Succeeded": "solved", "Infeasible_Problem_Detected": "infeasible"}


def matrix(x) -> ca.DM:
    """A sparse matrix of numbers."""
    return ca.sparsify(ca.DM(np.asarray(x)))


class Programme:
    """A nonlinear programme that grows: variables, rows and a cost.

    Args:
        problem: Whose variables come first, and whose rows `equal` and `below` add, in its order.
        z: First guess of them, scaled.
    """

    near = False
    """Whether the first guess is all but a minimum."""

    def __init__(self, problem: Problem, z):
        self.problem, self.cost = problem, ca.MX(0)
        self.symbols, self.guesses, self.rows = [], [], {"zero": [], "equal": [], "below": []}
        z = self.variable(np.asarray(z)[:, None])
        self.x, at = {}, 0
        for block in problem.form.blocks:
            rows, columns = block.shape if len(block.shape) == 2 else (block.size, 1)
            part = ca.reshape(z[at : at + block.size], columns, rows).T
            self.x[block.name] = part * ca.DM(np.reshape(block.unit, (rows, columns)))
            at += block.size

    def variable(self, guess) -> ca.MX:
        """A matrix of further variables."""
        self.symbols.append(ca.MX.sym("x", *guess.shape))
        self.guesses.append(ca.DM(guess))
        return self.symbols[-1]

    def value(self, expression) -> ca.DM:
        """An expression at the first guess."""
        return ca.Function("value", self.symbols, [expression])(*self.guesses)

    def zero(self, expression) -> None:
        """Rows of the transcription's own, that must be zero."""
        self._add("zero", expression, 0.0, 0.0)

    def equal(self, expression) -> None:
        """The problem's next equalities, scaled, column by column."""
        self._add("equal", expression, 0.0, 0.0)

    def below(self, expression, lower, upper) -> None:
        """The problem's next inequalities, scaled, column by column; limits are one for each column."""
        self._add("below", expression, lower, upper)

    def _add(self, kind, expression, lower, upper):
        rows, columns = expression.shape
        limits = (np.repeat(np.broadcast_to(x, columns), rows) for x in (lower, upper))
        self.rows[kind].append((ca.vec(expression), *limits))

    @cached_property
    def solver(self) -> ca.Function:
        """IPOPT for the programme as it is; making it takes seconds."""
        x, g = ca.vertcat(*map(ca.vec, self.symbols)), ca.vertcat(*(row[0] for row in self._in_order()))
        return ca.nlpsol("referee", "ipopt", {"x": x, "f": self.cost, "g": g}, OPTIONS | NEAR if self.near else OPTIONS)

    def _in_order(self):
        return [row for rows in self.rows.values() for row in rows]

    def solve(self) -> Outcome:
        """The minimum that IPOPT finds from the first guess."""
        lbg, ubg = (np.concatenate([row[k] for row in self._in_order()]) for k in (1, 2))
        _, low, high = self.problem.numbers
        start, solver = ca.vertcat(*map(ca.vec, self.guesses)), self.solver
        free = np.full(start.numel() - len(low), np.inf)
        end = solver(x0=start, lbx=np.r_[low, -free], ubx=np.r_[high, free], lbg=lbg, ubg=ubg)
        stats = solver.stats()
        _, slope = solver.get_function("nlp_grad_f")(end["x"], [])
        _, J = solver.get_function("nlp_jac_g")(end["x"], [])
        left = slope + J.T @ end["lam_g"] + end["lam_x"]
        sizes = np.cumsum([sum(len(lower) for _, lower, _ in rows) for rows in self.rows.values()])
        _, equal, below = np.split(end["g"].full().ravel(), sizes[:-1])
        _, y, u = np.split(end["lam_g"].full().ravel(), sizes[:-1])
        lower, upper = lbg[sizes[1] :], ubg[sizes[1] :]
        pairs = lambda up, down: np.stack([up, down], axis=-1).ravel()
        # a one-sided row has no lower limit, and no partner
        both = np.stack([np.ones(len(lower), bool), np.isfinite(lower)], axis=-1).ravel()
        return Outcome(
            z=end["x"].full().ravel()[: len(low)],
            cost=float(end["f"]),
            equal=equal,
            below=pairs(below - upper, lower - below)[both],
            y=y,
            u=pairs(np.maximum(u, 0), np.maximum(-u, 0))[both],
            stationarity=float(ca.norm_inf(left) / (1 + ca.norm_inf(slope))),
            iteration=stats["iter_count"],
            status=STATUSES.get(stats["return_status"], "not converged"),
        )


def programme(task, problem: Problem, z, near: bool = False) -> Programme:
    """A task in CasADi, to be started from scaled variables z of its problem; `near` if those are all but a minimum."""
    nlp = importlib.import_module(f"planners.referee_{task.kind}").programme(task, problem, z)
    nlp.near = near
    return nlp
