"""Inertial parameters from what the sensors of a manoeuvre recorded, physically consistent, with their covariance.

Unknown are eta, for each body the ten numbers of `inertial.consistent`; constant biases; and, with encoders, how the
joints' control points differ from the plan. The latter two, b, enter the whitened residuals linearly, the path by its
derivative at the first guess, so they are eliminated exactly: with B = Q R,

    r(eta, b) = r(eta) + B b,   min over b: |r|^2 - |Q^T r|^2,   F = J^T J - (Q^T J)^T (Q^T J),

the Schur complement of the information. Steps are Levenberg and Marquardt's; what the joints' path alone decides is
computed once.
Source: Golub and Pereyra (1973), Separable nonlinear least squares; Nocedal and Wright, Numerical Optimization, 10.3.
"""

import functools
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sdyn
from planners import floating, identify, inertial
from planners.inertial import Path
from planners.measure import Measurements, Setup, setup
from planners.problem import ONCE
from planners.task import Task

ITERATIONS = 50
CLOSE = 1e-8  # squared length of a Newton step, in standard deviations of the estimate, that ends the iterations
DAMPED = 1e-5  # at first
DAMPING = (1e-12, 10.0, 1e12)  # relative to the diagonal, smallest, factor, largest
STATUSES = ("solved", "not converged", "not finite", "not identifiable", "running")
SOLVED, UNCONVERGED, INFINITE, LOST, RUNNING = range(5)


class Known(NamedTuple):
    """What is computed once: the joints' path, and what constant biases and the path's deviation do."""

    points: Path  # at the samples
    middles: Path  # between them
    steps: jax.Array  # [k] s
    q: jax.Array  # [k + 1, n]
    passive: jax.Array  # [k + 1, n] torques of springs and dampers
    nominal: jax.Array  # [bodies, 10]
    lever: jax.Array  # [3]
    basis: jax.Array  # [rows, b] Q


class Squares(NamedTuple):
    """The sum of squares near eta, nuisances eliminated."""

    information: jax.Array  # [p, p]
    gradient: jax.Array  # [p]
    cost: jax.Array  # [] half of the sum


class Fit(NamedTuple):
    """Where the iterations ended."""

    eta: jax.Array  # [p]
    phi: jax.Array  # [bodies, 10]
    covariance: jax.Array  # [p, p] of phi
    cost: jax.Array  # []
    iterations: jax.Array  # []
    status: jax.Array  # [] index into STATUSES


@dataclass(frozen=True)
class Estimate:
    """Parameters of the bodies that were not known."""

    status: str
    """solved, not converged, not finite, or not identifiable (then some deviations are infinite)."""
    parameters: dict[str, np.ndarray]
    """By body, "base" or "load": m, m c, I about the link's origin [10], SI units."""
    deviations: dict[str, np.ndarray]
    """Their standard deviations."""
    covariance: np.ndarray
    """Of all parameters, bodies one after the other."""
    misfit: float
    """Sum of squared residuals over their number, both without the nuisances': about 1 if model and noise are right."""
    iterations: int
    robot: sdyn.Robot
    """The robot with these parameters."""


def estimate(task: Task, variables: dict, measured: Measurements) -> Estimate:
    """Estimates what the task names as unknown, from the robot of the task as a first guess.

    Args:
        task: An identification.
        variables: Of the manoeuvre that was made, as `plan.variables`.
        measured: Samples of the sensors that the task has, at the task's rate.

    Returns:
        The estimate, with a status; its bodies can exist, whatever the data say.

    Raises:
        TaskError: If the task is no identification, or float64 is off.

    Source:
        See the head of this file.
    """
    at = setup(task, variables)
    known = prepared(at, identify.data(task), first_guess(task), passive(task), variables)
    found = jax.tree.map(np.asarray, fitted(at, known, known.nominal, measured))
    sigma = np.sqrt(np.diag(found.covariance)).reshape(-1, 10)
    free = known.basis.shape[0] - known.basis.shape[1] - found.eta.size
    by_link = dict(zip(task.unknown.values(), found.phi, strict=True))
    finite = np.isfinite(found.phi).all()
    return Estimate(
        STATUSES[found.status],
        dict(zip(task.unknown, found.phi, strict=True)),
        dict(zip(task.unknown, sigma, strict=True)),
        found.covariance,
        float(2 * found.cost / free),
        int(found.iterations),
        inertial.replaced(task.chaser, by_link) if finite else task.chaser,
    )


def first_guess(task: Task) -> jax.Array:
    """Parameters [bodies, 10] of the task's robot."""
    return jnp.stack([inertial.nominal(task.chaser.link(link))[0] for link in task.unknown.values()])


def passive(task: Task) -> tuple:
    """Stiffness and damping [n] of the joints."""
    return tuple(jnp.array([float(getattr(j, key)) for j in task.joints]) for key in ("stiffness", "damping"))


def _paths(setup: Setup, data: identify.Data, x):
    """The path at the samples and between them, and the joint positions at the samples."""
    q, rate, acceleration = identify.joint_path(setup.spline, setup.intervals, x, data.q0)
    whole = jax.vmap(inertial.path, (None, None, 0, 0, 0))(data.chain, data.origins, q, rate, acceleration)
    return jax.tree.map(lambda a: a[::2], whole), jax.tree.map(lambda a: a[1::2], whole), q[::2]


def predicted(known: Known, change) -> dict:
    """What perfect sensors would record, by name, if the parameters differed by change [bodies, 10]."""
    respond = jax.vmap(inertial.response, (0, None))
    twist, acceleration, tau = respond(known.points, change)
    w, between = twist[:, :3], respond(known.middles, change)[0][:, :3]
    still = jnp.zeros((len(between), 3, 3))
    R = floating.attitudes(jnp.eye(3), (still,) * 3, (w[:-1], between, w[1:]), still[:, 0], known.steps)
    force = jax.vmap(inertial.felt, (None, 0, 0))(known.lever, twist, acceleration)
    return dict(gyro=w, accelerometer=force, star_tracker=R, torque=tau + known.passive, encoder=known.q)


def residuals(setup: Setup, measured: dict, prediction: dict) -> jax.Array:
    """Prediction minus measurement over the noise, [rows], of the sensors that are there, one after the other."""
    turn = jax.vmap(lambda A, B: floating.logarithm(A @ B.T))
    minus = {name: turn if name == "star_tracker" else jnp.subtract for name in setup.noise}
    parts = {name: minus[name](prediction[name], measured[name]) / noise for name, noise in setup.noise.items()}
    return jnp.concatenate([part.ravel() for part in parts.values()])


@functools.partial(jax.jit, static_argnums=0, **ONCE)
def prepared(setup: Setup, data: identify.Data, nominal, passive, x) -> Known:
    """All that does not depend on the parameters or on the measurements."""
    stiffness, damping = passive
    steps = jnp.full(setup.intervals, x["duration"][0] / setup.intervals)

    def at(excite):
        points, middles, q = _paths(setup, data, x | {"excite": excite})
        springs = stiffness * q + damping * points.rate
        return Known(points, middles, steps, q, springs, nominal, data.lever, jnp.zeros((0, 0)))

    prediction = lambda excite: predicted(at(excite), jnp.zeros_like(nominal))
    here = prediction(x["excite"])
    blocks = [_biases(setup, here)]
    if "encoder" in setup.noise:
        strays = jax.jacfwd(lambda excite: residuals(setup, here, prediction(excite)))(x["excite"])
        blocks.append(strays.reshape(len(strays), -1))
    B = jnp.concatenate(blocks, axis=1)
    return at(x["excite"])._replace(basis=jnp.linalg.qr(B)[0])


def _biases(setup, prediction):
    """One column of B for each entry of a sensor with a bias."""
    sizes = {name: (len(prediction[name]), prediction[name].shape[-1]) for name in setup.noise}
    columns, at, rows = [], 0, sum(k * width for k, width in sizes.values())
    for name, (k, width) in sizes.items():
        if setup.biased(name):
            block = np.zeros((rows, width))
            block[at : at + k * width] = np.tile(np.eye(width), (k, 1))
            columns.append(block)
        at += k * width
    return jnp.asarray(np.concatenate(columns, axis=1) if columns else np.zeros((rows, 0)))


def squares(setup: Setup, known: Known, phi, eta, measured: dict) -> Squares:
    """The sum of squares at parameters `consistent(phi, eta)`."""

    def at(eta):
        new = jax.vmap(inertial.consistent)(phi, eta.reshape(-1, 10))
        r = residuals(setup, measured, predicted(known, new - known.nominal))
        return r, r

    J, r = jax.jacfwd(at, has_aux=True)(eta)
    A = jnp.concatenate([J, r[:, None]], axis=1)
    hidden = known.basis.T @ A
    S = A.T @ A - hidden.T @ hidden
    return Squares(S[:-1, :-1], S[:-1, -1], S[-1, -1] / 2)


class _State(NamedTuple):
    eta: jax.Array
    at: Squares
    damping: jax.Array
    iteration: jax.Array
    status: jax.Array


def fit(setup: Setup, known: Known, phi, measured: Measurements) -> Fit:
    """Levenberg-Marquardt from parameters phi [bodies, 10]; to be vmapped over measurements."""
    data, (smallest, factor, largest) = measured._asdict(), DAMPING
    near = lambda eta: squares(setup, known, phi, eta, data)
    newton = lambda s, damping: (
        -jnp.linalg.solve(s.information + damping * jnp.diag(jnp.diag(s.information)), s.gradient)
    )

    def step(s: _State):
        d = newton(s.at, s.damping)
        new = near(s.eta + d)
        better, first = new.cost <= s.at.cost, jnp.isinf(s.at.cost)
        close = (d @ s.at.information @ d < CLOSE) & (s.damping <= 1.0) & ~first
        damping = jnp.where(better, jnp.maximum(s.damping / factor, smallest), s.damping * factor)
        eta, at = jax.tree.map(lambda a, b: jnp.where(better, a, b), (s.eta + d, new), (s.eta, s.at))
        over = (s.iteration + 1 >= ITERATIONS) | (damping > largest)
        status = jnp.select([~jnp.isfinite(at.cost), close, over], [INFINITE, SOLVED, UNCONVERGED], RUNNING)
        return _State(eta, at, damping, s.iteration + 1, status)

    p = phi.size
    nowhere = Squares(jnp.eye(p), jnp.zeros(p), jnp.asarray(jnp.inf))  # its step is zero, and what comes is better
    start = _State(jnp.zeros(p), nowhere, jnp.asarray(DAMPED), jnp.asarray(0), jnp.asarray(RUNNING))
    end = jax.lax.while_loop(lambda s: s.status == RUNNING, step, start)
    C, sees = covariance(phi, end.eta, end.at.information)
    status = jnp.where((end.status == SOLVED) & ~sees, LOST, end.status)
    return Fit(end.eta, _parameters(phi, end.eta), C, end.at.cost, end.iteration, status)


fitted = functools.partial(jax.jit, static_argnums=0, **ONCE)(fit)


def _parameters(phi, eta):
    return jax.vmap(inertial.consistent)(phi, eta.reshape(-1, 10))


def covariance(phi, eta, information):
    """Covariance [p, p] of the parameters, and whether all directions are seen; infinite if not."""
    root = jnp.sqrt(jnp.diag(information))
    values, vectors = jnp.linalg.eigh(information / jnp.outer(root, root))
    sees = values[0] > identify.GAP**2 * values[-1]
    D = jax.jacfwd(lambda eta: _parameters(phi, eta).ravel())(eta)
    half = D @ (vectors / (root[:, None] * jnp.sqrt(jnp.where(sees, values, 1.0))))
    return jnp.where(sees, half @ half.T, jnp.inf), sees
