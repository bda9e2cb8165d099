"""The shipped identification manoeuvre, planned end to end."""

import numpy as np
import pytest

import planners


@pytest.mark.slow
def test_the_manoeuvre_is_planned_certified_and_tells_what_it_identifies():
    plan = planners.plan(planners.load("identify"), progress=False)
    assert plan.status == "solved", plan.verdict
    assert plan.certificate.passed, str(plan.certificate)
    assert plan.phases[0].robot.nv == 9
    assert "all ten parameters are identifiable" in plan.verdict
    assert np.isfinite(plan.info["cost"])
