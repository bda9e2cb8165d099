"""All first derivatives of forward dynamics at once, for linearisation: dv̇ = M⁻¹ (dτ − dID)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sdyn.aba import aba_saving, mass_solve
from sdyn.chain import Chain
from sdyn.coordinates import join, rates_of
from sdyn.dynamics import operands_of, passive_force
from sdyn.inputs import expect
from sdyn.rnea_jacobian import rnea_jacobian


def forward_dynamics_jacobians(
    chain: Chain,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    tau: Float[Array, " nv"],
    *,
    gravity: Float[Array, "3"] | None = None,
) -> tuple[Float[Array, " nv"], Float[Array, "nv nv"], Float[Array, "nv nv"], Float[Array, "nv nv"]]:
    """Accelerations, and their derivatives with respect to q, v and tau; faster than `jax.jacrev`.

    Args:
        chain: Packed structure without closures and without moving spherical joints.
        q, v, tau: As for `forward_dynamics`.
        gravity: Acceleration of free fall, world axes [m/s^2].

    Returns:
        vdot, as of `forward_dynamics`.
        Derivatives by increments of q laid out like v (turn of the base in its own axes, displacement of its origin in
        world axes, joints), by v, and by tau, which is M^-1.

    Raises:
        ValueError: While tracing, if the structure has closures or moving spherical joints: use `jax.jacfwd`.

    Differentiable forward and reverse.

    Source:
        Singh, Russo, Wensing (2022), see `rnea_jacobian.py`; Carpentier and Mansard (2018) for M^-1.
    """
    if chain.capacity.rows or chain.capacity.quaternions:
        raise ValueError(
            "forward_dynamics_jacobians: the structure has closures or spherical joints, whose columns are not "
            "shared; use jax.jacfwd(sdyn.forward_dynamics, (1, 2, 3))."
        )
    q, v, tau, gravity = expect(chain, q=q, v=v, tau=tau, gravity=gravity)
    pose, structure, G, F = operands_of(chain, q, gravity, None)
    V0, qd = rates_of(chain, pose, v)
    f0, force = rates_of(chain, pose, tau)
    a0, qdd, *left = aba_saving(*structure, V0, qd, f0, force - passive_force(chain, pose, qd), G, F)
    of_q, of_v = rnea_jacobian(chain.ancestors, *structure, V0, qd, a0, qdd, G, F, left[0])
    nb = chain.capacity.base_nv
    of_q, of_v = (x[6 - nb :, 6 - nb :, 0] for x in (of_q, of_v))
    damping, stiffness, _ = chain.dof_value
    passive = lambda x: jnp.diag(jnp.concatenate([jnp.zeros(nb, x.dtype), x]))
    solved = lambda b: join(chain, pose, *mass_solve(*structure, *left, *rates_of(chain, pose, b)))
    Minv = jax.vmap(solved)(jnp.eye(chain.nv, dtype=chain.dtype))
    vdot = join(chain, pose, a0, qdd)
    return vdot, -Minv @ (of_q + passive(stiffness)), -Minv @ (of_v + passive(damping)), Minv
