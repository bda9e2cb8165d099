"""Motion planning by gradients through the dynamics of `sdyn`, across changes of the structure.

import jax; jax.config.update("jax_enable_x64", True)
import planners
plan = planners.plan(planners.load("grasp"))
plan.save("out/grasp")
"""

from planners.certify import Certificate, certify
from planners.compare import Table, compare
from planners.driver import plan
from planners.estimate import Estimate, estimate
from planners.follow import after
from planners.ik import Posture, inverse_kinematics
from planners.measure import Measurements, measure
from planners.monte_carlo import MonteCarlo, monte_carlo
from planners.outline import Outline, PhaseOutline, outline
from planners.plan import PhaseResult, Plan, PlanError
from planners.sections import Goal
from planners.sensitivity import Sensitivity, sensitivity
from planners.structures import Candidate, Structure, StructureChoice, choose_structure, lockings
from planners.study import StudyError, study
from planners.table import PlanTable, table
from planners.task import Task, TaskError, load
from planners.volumes import volume_ratios
