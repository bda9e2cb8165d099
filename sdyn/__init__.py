"""Differentiable dynamics in JAX for robots whose kinematic structure changes while they work.

In reading order: parts and edits of a robot (host, raises), packing (the gate), dynamics (device, pure JAX).
"""

# host stage
from sdyn import convert, models
from sdyn.checks import RobotError
from sdyn.files import load, save
from sdyn.parts import Frame, Joint, Link, Loop
from sdyn.robot import Robot

# the gate
from sdyn.chain import Capacity, Chain, Params
from sdyn.pack import capacity, family, pack, pad, unpad

# device stage
from sdyn.kinematics import body_poses, frame_acceleration, frame_jacobian, frame_pose, frame_velocity
from sdyn.dynamics import bias_force, inverse_dynamics, mass_matrix, solve_mass
from sdyn.closures import loop_jacobian, loop_residual, loop_wrenches
from sdyn.constraints import Status, constrained_dynamics, constrained_inverse_dynamics, forward_dynamics
from sdyn.jacobians import forward_dynamics_jacobians
from sdyn.partition import Partition, partition
from sdyn.drift import project
from sdyn.conditioning import Trust, conditioning
from sdyn.momentum import centre_of_mass, kinetic_energy, momentum
from sdyn.floating import (
    floating_forward_dynamics,
    floating_inverse_dynamics,
    floating_velocity,
    generalised_jacobian,
    reaction_null_space,
    reduced_dynamics,
)
from sdyn.actuators import frame_wrench, wheels
from sdyn.params import params, regressor, with_locks, with_params
from sdyn.transition import transfer
from sdyn.accuracy import Accuracy, PRESETS
from sdyn.integrate import integrate
from sdyn.choose import Choice, choose
from sdyn.rollout import Phases, hybrid_rollout, rollout
from sdyn.diagnose import Diagnosis, diagnose, growth

# what a scene requires
from sdyn.reduce import Report, Scene, reduce
