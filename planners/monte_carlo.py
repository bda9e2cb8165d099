"""Whether the estimator reaches what the information promises: many simulated manoeuvres, each estimated.

Compared with the Cramer-Rao bound at the truth are the sample variance of every parameter, (n - 1) s^2 / sigma^2 as
chi-square of n - 1, and the squared errors normalised by the bound, whose sum over n draws of p parameters is
chi-square of n p.
Source: Bar-Shalom, Li and Kirubarajan (2001), Estimation with applications to tracking and navigation, section 5.4.
"""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import sdyn
from planners import identify, inertial
from planners.estimate import STATUSES, first_guess, fit, passive, prepared
from planners.measure import recorded, setup
from planners.task import Task, TaskError

BATCH = 8  # draws side by side; more need more memory and are no faster
DOUBT = 0.01  # probability that a right estimator is outside of the bands, of all parameters together


@dataclass(frozen=True)
class MonteCarlo:
    """Errors of the estimates against the bound, and whether they are within the confidence bands."""

    parameters: tuple[str, ...]
    errors: np.ndarray
    """[draws, p] estimate minus truth, SI units."""
    bound: np.ndarray
    """[p] Cramer-Rao standard deviations, SI units."""
    ratios: np.ndarray
    """[p] sample variance over the bound's."""
    band: tuple[float, float]
    """Of every ratio."""
    normalised: float
    """Mean of the squared errors normalised by the bound, over their number; about 1."""
    normalised_band: tuple[float, float]
    statuses: dict[str, int]
    """How often the estimator ended how."""

    @property
    def passed(self) -> bool:
        """Whether all draws were solved and everything is within its band."""
        inside = lambda x, band: bool(np.all((x >= band[0]) & (x <= band[1])))
        every = self.statuses == {"solved": len(self.errors)}
        return every and inside(self.ratios, self.band) and inside(self.normalised, self.normalised_band)


def monte_carlo(
    task: Task, variables: dict, *, draws: int = 200, truth: sdyn.Robot | None = None, seed: int = 0
) -> MonteCarlo:
    """Simulates and estimates a manoeuvre many times, each with other noise and biases, in one compiled program.

    Args:
        task: An identification.
        variables: Of the manoeuvre, as `plan.variables`.
        draws: How many times.
        truth: The robot as it is; the estimator starts from the task's. That one itself if left out.
        seed: Of all random numbers.

    Raises:
        TaskError: If the task is no identification, draws is below 2, or float64 is off.
    """
    from scipy.stats import chi2

    if draws < 2:
        raise TaskError(f"draws is {draws!r}; a variance needs at least 2.")
    at, truth = setup(task, variables), truth or task.chaser
    phi = jnp.stack([inertial.nominal(truth.link(link))[0] for link in task.unknown.values()])
    chain, data, guess = sdyn.pack(truth), identify.data(task), first_guess(task)
    known = prepared(at, data, guess, passive(task), variables)
    errors, status, C = map(
        np.asarray, _study(at, draws, guess, phi, known, chain, data, variables, jax.random.key(seed))
    )
    p, size = phi.size, np.concatenate([inertial.nominal(truth.link(link))[1] for link in task.unknown.values()])
    whitened = np.linalg.solve(np.linalg.cholesky(C / np.outer(size, size)), (errors / size).T)
    band = lambda doubt, freedoms: tuple(chi2.ppf([doubt / 2, 1 - doubt / 2], freedoms) / freedoms)
    bound = np.sqrt(np.diag(C))
    return MonteCarlo(
        tuple(f"{body} {name}" for body in task.unknown for name in inertial.PARAMETERS),
        errors,
        bound,
        errors.var(axis=0, ddof=1) / bound**2,
        band(DOUBT / p, draws - 1),
        float((whitened**2).mean()),
        band(DOUBT, draws * p),
        {STATUSES[k]: int(count) for k, count in zip(*np.unique(status, return_counts=True), strict=True)},
    )


@functools.partial(jax.jit, static_argnums=(0, 1))
def _study(setup, draws, guess, phi, known, chain, data, x, key):
    """Errors [draws, p] of estimates from a guess against the truth phi [bodies, 10], statuses [draws], and the bound's
    covariance [p, p]: that of an estimate without any noise.
    """

    def one(row):
        key, noisy = row
        found = fit(setup, known, guess, recorded(setup, chain, data, x, key, noisy))
        return (found.phi - phi).ravel(), found.status, found.covariance

    count = BATCH * (draws // BATCH + 1)  # whole batches, or what is left would be compiled again
    rows = jax.random.split(key, count), jnp.ones(count).at[draws].set(0.0)
    errors, status, covariances = jax.lax.map(one, rows, batch_size=BATCH)
    return errors[:draws], status[:draws], covariances[draws]
