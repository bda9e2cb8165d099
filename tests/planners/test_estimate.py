"""Estimating the parameters of base and load from simulated measurements, of a motion that nobody optimised."""

import re
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planners
import sdyn
from planners import identify, inertial
from planners.estimate import first_guess, passive, predicted, prepared
from planners.measure import NAMES, perfect, setup
from planners.problem import ONCE
from planners.task import parse

TEXT = planners.load("identify_load").source
ENCODERS = "encoder = 1e-5 # rad\nencoder_bias = true\n"
CHEAP = TEXT.replace("rate = 10.0", "rate = 2.72").replace(ENCODERS, "")


def motion(task, seconds=25.0):
    """Variables of a smooth motion from rest to rest."""
    rng, inner = np.random.default_rng(1), task.phases["excite"].control_points - 6
    s, n = np.linspace(0, 1, inner)[:, None], len(task.joints)
    waves = sum(rng.normal(size=n) * np.sin(np.pi * k * s) / k for k in range(1, 6))
    return {"duration": np.array([seconds]), "excite": task.start + 0.5 * waves}


@pytest.fixture(scope="module")
def scene():
    return shaken(CHEAP)


def shaken(text):
    """A task, a motion, and a robot whose base and load differ by about 5 percent from the task's."""
    task = parse(text, "shaken")
    x, rng = motion(task), np.random.default_rng(3)
    change = lambda phi: np.asarray(inertial.consistent(phi, jnp.asarray(0.05 * rng.normal(size=10))))
    phi = {link: change(phi) for link, phi in zip(task.unknown.values(), first_guess(task), strict=True)}
    at, data = setup(task, x), identify.data(task)
    return SimpleNamespace(
        task=task,
        x=x,
        truth=inertial.replaced(task.chaser, phi),
        phi=jnp.stack(list(phi.values())),
        setup=at,
        data=data,
        known=prepared(at, data, first_guess(task), passive(task), x),
    )


def test_every_parameter_is_that_of_a_body_and_every_body_is_reached(rng):
    arm = sdyn.models.load("paper37").link("arm1_link2")
    phi, size = inertial.nominal(arm)
    at = jax.jit(inertial.consistent)
    assert np.abs((at(phi, jnp.zeros(10)) - phi) / size).max() < 1e-14  # measured 2e-16
    for eta in rng.normal(size=(20, 10)):
        assert np.linalg.eigvalsh(inertial.pseudo_inertia(at(phi, eta))).min() > 0
    other, _ = inertial.nominal(sdyn.Link("long", 3.0, (0.4, -0.2, 1.0), np.diag([0.5, 0.6, 0.2])))
    flip, P = lambda S: S[::-1, ::-1], lambda phi: np.asarray(inertial.pseudo_inertia(phi))
    U = flip(np.linalg.cholesky(flip(P(phi))))
    E = flip(np.linalg.cholesky(flip(np.linalg.solve(U, np.linalg.solve(U, P(other)).T))))
    eta = np.r_[np.log(np.diag(E)), E[np.triu_indices(4, 1)]]
    assert np.abs((at(phi, eta) - other) / size).max() < 1e-9  # of 1e3
    assert inertial.replaced(sdyn.models.load("paper37"), {arm.name: phi}).link(arm.name).mass == arm.mass


def test_a_change_of_parameters_does_what_another_robot_does(scene):
    """Base motion and torques by the estimator's formula, and by the dynamics of a robot with those parameters."""
    ours = jax.jit(predicted, **ONCE)(scene.known, scene.phi - scene.known.nominal)
    exact = jax.jit(perfect, static_argnums=0, **ONCE)
    see = lambda robot: exact(scene.setup, sdyn.pack(robot), scene.data, scene.x)
    theirs, before = see(scene.truth), see(scene.task.chaser)
    for name in NAMES[:4]:
        there = getattr(theirs, name)
        change = float(jnp.abs(there - getattr(before, name)).max())
        assert jnp.abs(ours[name] - there).max() < 1e-11 * change, name  # measured 1e-14


def test_the_planner_and_the_estimator_promise_the_same(scene):
    """Sensitivities summed over the solver's grid, and the slope of residuals at the samples; biases in both."""
    said = identify.results(scene.task, identify.problem(scene.task), scene.x)
    found = planners.monte_carlo(scene.task, scene.x, draws=60)
    assert said["identifiable"] == 20 and list(found.parameters) == said["parameters"]
    np.testing.assert_allclose(
        100 * found.bound / np.array(said["magnitudes"]), list(said["sigma_percent"].values()), rtol=0.02
    )  # measured 5e-3


def test_a_bias_costs_what_the_schur_complement_over_it_costs(scene):
    data = scene.data._replace(biased=jnp.zeros_like(scene.data.biased))
    at = identify.detailed(*identify._shape(scene.task, 1.0), scene.x, data)
    S, h = np.asarray(jax.jit(identify.sensitivities, **ONCE)(data, at)), np.diff(at.times)
    known, biased = (identify.informed(d, at) for d in (data, scene.data))
    root = np.sqrt(np.r_[h[0], h[1:] + h[:-1], h[-1]] / 2)
    columns = np.asarray(data.sensors) * np.eye(S.shape[1])
    both = root[:, None, None] * np.concatenate([S, np.broadcast_to(columns, (len(S), *columns.shape))], axis=2)
    F = np.einsum("kij,kil->jl", both, both)
    schur = F[:20, :20] - F[:20, 20:] @ np.linalg.solve(F[20:, 20:], F[20:, :20])
    np.testing.assert_allclose(biased, schur, atol=1e-9 * schur.max())  # measured 1e-15
    more = np.linalg.eigvalsh(np.asarray(known - biased))
    assert more.min() > -1e-9 * schur.max() and more.max() > 0.1 * schur.max()


@pytest.mark.parametrize(
    ("without", "seen", "words"),
    [
        ((), 20, "all 20 parameters"),
        (("torque",), 20, "all 20 parameters"),  # the arm alone gives the scale: base mass to 49 % instead of 0.6
        (("accelerometer",), 19, "lost are +0.99 base m"),  # nothing tells the translation
        (("accelerometer", "star_tracker", "torque"), 19, "lost are +0.99 base m"),
    ],
)
def test_what_cannot_be_identified_is_said(scene, without, seen, words):
    text = CHEAP
    for name in without:
        text = re.sub(rf"^{name}(_bias)? = .*\n", "", text, flags=re.M)
    task = parse(text)
    said = identify.results(task, identify.problem(task), scene.x)
    assert said["identifiable"] == seen and words in said["subspace"], said["subspace"]
    assert ("sigma_percent" in said) == (seen == 20)
    if without == ("torque",):
        assert said["sigma_percent"]["base m"] > 10  # measured 49


@pytest.mark.slow
def test_an_estimate_is_as_far_off_as_it_says(scene):
    measured = planners.measure(scene.task, scene.x, truth=scene.truth, seed=1)
    found = planners.estimate(scene.task, scene.x, measured)
    assert found.status == "solved" and 0.8 < found.misfit < 1.2  # measured 0.97
    errors = np.concatenate(list(found.parameters.values())) - np.asarray(scene.phi).ravel()
    assert np.abs(errors / np.concatenate(list(found.deviations.values()))).max() < 4  # measured 2.1
    assert found.robot.link("base").mass == found.parameters["base"][0]
    unseen = measured._replace(gyro=measured.gyro.at[3, 0].set(jnp.nan))
    assert planners.estimate(scene.task, scene.x, unseen).status == "not finite"


@pytest.mark.slow
def test_encoders_and_their_bias_are_part_of_the_estimate():
    """The joints leave the planned path by ten times the encoders' noise; the estimate allows for that."""
    scene = shaken(TEXT.replace("rate = 10.0", "rate = 2.72"))
    measured = planners.measure(scene.task, scene.x, truth=scene.truth, seed=1)
    found = planners.estimate(scene.task, scene.x, measured)
    assert found.status == "solved" and 0.8 < found.misfit < 1.2  # measured 0.95
    errors = np.concatenate(list(found.parameters.values())) - np.asarray(scene.phi).ravel()
    assert 0.3 < errors @ np.linalg.solve(found.covariance, errors) / 20 < 2.0  # chi-square of 20; measured 0.96


def test_estimates_scatter_as_the_bound_says(scene):
    found = planners.monte_carlo(scene.task, scene.x, draws=60, truth=scene.truth)
    assert found.passed, (found.statuses, found.ratios, found.band, found.normalised)
    assert 0.85 < found.normalised < 1.15  # of 1200 normalised errors


@pytest.mark.slow
def test_two_hundred_estimates_scatter_as_the_bound_says(scene):
    found = planners.monte_carlo(scene.task, scene.x, draws=200, truth=scene.truth)
    assert found.passed, (found.statuses, found.ratios, found.band, found.normalised, found.normalised_band)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda x: planners.measure(planners.load("grasp"), x), "only identifications"),
        (lambda x: planners.monte_carlo(parse(CHEAP), x, draws=1), "at least 2"),
    ],
)
def test_what_cannot_be_studied_is_refused(scene, call, words):
    with pytest.raises(planners.TaskError, match=words):
        call(scene.x)
