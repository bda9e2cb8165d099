"""How much more a manoeuvre tells than random ones: volumes of their confidence ellipsoids.

With F the information, the volume goes as det(F)^(-1/2).
"""

import numpy as np

from planners import identify
from planners.problem import summary
from planners.task import Task

HALVINGS = 12  # of the interval that holds the size at which a limit is reached
LARGEST = 4.0  # size of a random motion, rad


def volume_ratios(task: Task, variables: dict, *, count: int = 20, seed: int = 0) -> np.ndarray:
    """Volumes of the confidence ellipsoids of random manoeuvres over that of a given one.

    A random manoeuvre is as long as the given one, and as large as the limits allow: all of its joints swing by five
    sines, the higher ones less, and the largest size at which every limit of the task is kept is found by bisection.

    Args:
        task: An identification.
        variables: Of the manoeuvre, as `plan.variables`.
        count: Of random manoeuvres.
        seed: Of their random numbers.

    Returns:
        The ratios [count], smallest first.
    """
    problem, rng = identify.problem(task), np.random.default_rng(seed)
    told = [_log_det(task, problem, _random(task, problem, variables, rng)) for _ in range(count)]
    return np.sort(np.exp((_log_det(task, problem, variables) - np.array(told)) / 2))


def _random(task, problem, variables, rng) -> dict:
    """Variables of a random motion that just keeps the limits."""
    form, swing, small, large = problem.form, identify.waves(rng, np.shape(variables["excite"])), 0.0, LARGEST
    for _ in range(HALVINGS):
        size = (small + large) / 2
        motion = variables | {"excite": task.start + size * swing}
        kept = summary(form, form.join(motion), problem.numbers[0]).below.max() <= 0
        small, large = (size, large) if kept else (small, size)
    return variables | {"excite": task.start + small * swing}


def _log_det(task, problem, variables):
    return np.linalg.slogdet(identify.told(task, problem, variables))[1]
