"""What identification manoeuvres tell: estimates of simulated measurements against the Cramer-Rao bound, and the
optimised manoeuvre against random ones of its duration, as large as the same limits allow.

The simulated robot is not the task's: its unknown bodies differ by a few percent, and the estimator starts from the
task's. Everything is planned and certified before it is compared.
"""

import json
import sys

import harness
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import planners
from planners import inertial

TASKS, DRAWS, RANDOM = ("identify", "identify_load"), 200, 100
OFF = 0.03  # standard deviation of the changes of a simulated body, about relative to its size
CRITERIA = ("log_det", "trace_of_inverse", "smallest_eigenvalue", "condition_number")
BLUE, RED, GREY = "#0072B2", "#D55E00", "#A0A0A0"


def other(task):
    """The task's robot with other unknown bodies."""
    rng = np.random.default_rng(1)
    change = lambda phi: inertial.consistent(phi, jnp.asarray(OFF * rng.normal(size=10)))
    links = task.unknown.values()
    return inertial.replaced(task.chaser, {link: change(inertial.nominal(task.chaser.link(link))[0]) for link in links})


def studied(name) -> dict:
    """A manoeuvre and all that is compared with it."""
    task = planners.load(name)
    plan = planners.plan(task, progress=False)
    assert plan.status == "solved" and plan.certificate.passed, plan.verdict
    said = plan.info["results"]
    found = planners.monte_carlo(task, plan.variables, draws=DRAWS, truth=other(task))
    errors = found.errors / found.bound
    return dict(
        verdict=plan.verdict,
        duration_s=float(plan.variables["duration"][0]),
        criteria={key: said[key] for key in CRITERIA},
        identifiable=said["identifiable"],
        sigma_percent=said["sigma_percent"],
        volume_ratios=planners.volume_ratios(task, plan.variables, count=RANDOM).tolist(),
        monte_carlo=dict(
            draws=DRAWS,
            passed=found.passed,
            statuses=found.statuses,
            variance_over_bound=dict(zip(found.parameters, found.ratios.tolist(), strict=True)),
            band=found.band,
            mean_over_its_deviation=dict(
                zip(found.parameters, (errors.mean(axis=0) * np.sqrt(DRAWS)).tolist(), strict=True)
            ),
            normalised=found.normalised,
            normalised_band=found.normalised_band,
        ),
    )


def draw(result):
    """One row for each task: variances against their band, and the volumes of random manoeuvres."""
    tasks = [name for name in TASKS if name in result]
    figure = Figure(figsize=(11.0, 3.6 * len(tasks) + 0.4), layout="constrained")
    for (left, right), name in zip(figure.subplots(len(tasks), 2, squeeze=False), tasks, strict=True):
        found = result[name]["monte_carlo"]
        names, ratios = zip(*found["variance_over_bound"].items(), strict=True)
        left.axhspan(*found["band"], color="#DCEBF7", label="99 % of right estimators, all parameters together")
        left.axhline(1.0, color=GREY, linewidth=1.0)
        left.plot(range(len(names)), ratios, "o", color=BLUE)
        left.set_xticks(range(len(names)), names, rotation=90)
        left.set_title(
            f"{name}: variance of {found['draws']} estimates over the Cramer-Rao bound", fontsize=9, loc="left"
        )
        left.legend(fontsize=7, loc="upper right")
        left.set_ylim(0.4, 1.8)
        volumes = np.log10(result[name]["volume_ratios"])
        right.hist(volumes, bins=25, color=BLUE)
        right.axvline(1.0, color=RED, linestyle="--", linewidth=1.0)
        right.text(1.0, 0.97, " 10 times", color=RED, fontsize=7, va="top", transform=right.get_xaxis_transform())
        right.set_xlim(0.0, None)
        right.set_title(f"{name}: confidence ellipsoids of {len(volumes)} random manoeuvres", fontsize=9, loc="left")
        right.set_xlabel("log10 of the volume, over that of the optimised manoeuvre", fontsize=8)
        for panel in (left, right):
            panel.tick_params(labelsize=8)
            panel.spines[["top", "right"]].set_visible(False)
    figure.savefig(harness.RESULTS / "identification.png", dpi=110)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    path = harness.RESULTS / "identification.json"
    result = json.loads(path.read_text()) if path.is_file() and sys.argv[1:] else {}
    result["machine"] = harness.machine("scipy")
    for name in sys.argv[1:] or TASKS:  # nothing: all; else what is to be studied again
        result[name] = studied(name)
        print(name, result[name], flush=True)
        harness.save("identification", result)
    draw(result)
