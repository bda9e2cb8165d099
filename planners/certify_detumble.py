"""What a detumbling plan must keep besides limits and dynamics."""

import numpy as np

from planners import balance
from planners.certify import Row, see


def rows(task, plan) -> list[Row]:
    """Start, end, and the balances of momentum and energy."""
    (phase,) = plan.phases
    seen = see([(phase.robot, task.robot.frame, phase.q, phase.v)])
    start = max(np.abs(phase.q[0] - task.first).max(), np.abs(phase.v[0] - task.captured).max())
    base, rates = phase.v[-1, :6].reshape(2, 3), dict(zip(phase.robot.v_names[6:], phase.v[-1, 6:], strict=True))
    left = [abs(rate) for name, rate in rates.items() if name not in task.base.wheels]
    return [
        Row("start differs from the state after the capture", float(start), 1e-12, "m, rad, m/s, rad/s"),
        Row("speed at the end", float(max(*np.linalg.norm(base, axis=1), *left)), task.end.speed, "rad/s, m/s"),
        *balance.momentum(seen, plan.phases),
        balance.energy(phase),
    ]
