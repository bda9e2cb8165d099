"""The task that begins where a plan ends: what a grasp has caught is brought to rest."""

import tomllib

from planners.plan import Plan
from planners.task import Task, TaskError, parse, written

STILL = 1e-6  # rad/s or m/s: rate of a joint at the end of a plan that counts as rest


def after(plan: Plan, task: Task) -> Task:
    """A task of detumbling, from the state at the end of a plan of a grasp.

    The joints' positions and rates and the base's twist are those of the plan's last point. The base is at the world's
    origin again, in its axes: nothing else is in the world. Joints that rested in the plan rest where they were.

    Args:
        plan: Of a grasp; its robot holds the target at the end.
        task: Of detumbling, with the same robot, hand and target.

    Raises:
        TaskError: If the two are about different things, or a joint that moves at the end is locked in the task.
    """
    before = plan.task
    if before.kind != "grasp" or task.kind != "detumble":
        raise TaskError(f"a detumbling can follow a grasp; these are {before.kind!r} and then {task.kind!r}.")
    for words, one, other in (
        ("[robot] model", before.robot.model, task.robot.model),
        ("[robot] frame", before.robot.frame, task.robot.frame),
        ("[target] model", before.target.model, task.target.model),
        ("[target] frame", before.target.frame, task.target.frame),
    ):
        if one != other:
            raise TaskError(f"the plan ends with {words} {one!r}, and {task.name!r} has {other!r}; make them the same.")
    last, names = plan.phases[-1], [joint.name for joint in before.joints]
    places = before.robot.joints | dict(zip(names, last.q[-1, 7:].tolist(), strict=True))
    rates = {name: x for name, x in zip(names, last.v[-1, 6:].tolist(), strict=True) if abs(x) > STILL}
    tree = tomllib.loads(task.source)
    tree["robot"]["joints"] = task.robot.joints | places
    tree["capture"] = {"twist": last.v[-1, :6].tolist(), "rates": rates}
    return parse(written(tree), f"{task.name}_after_{before.name}", task.folder)
