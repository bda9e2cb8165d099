"""What forward dynamics costs as the work grows: joints, batch, depth and width, sizes that are padded; and memory.

    python benchmarks/growth.py

One thread on one core; results/growth.json and results/growth.png.
"""

import harness


def memory(f, *args) -> int:
    """Bytes that a compiled function needs besides its arguments: results and what is in between, at its peak."""
    import jax

    sizes = jax.jit(f).lower(*args).compile().memory_analysis()
    return sizes.temp_size_in_bytes + sizes.output_size_in_bytes


def long_chain(few=100, many=1000, batch=16) -> dict:
    """A chain of 1000 joints: time against one of 100, error, memory.

    The error is against MuJoCo, because Pinocchio's data of so many joints takes more than 20 GB, and of inverse dynamics
    after forward dynamics.
    """
    import contenders
    import jax
    import numpy as np
    import peers
    import subjects

    import sdyn

    run = {str(n): contenders.forward(subjects.chain(n), batch) for n in (few, many)}
    times, _ = harness.times(run, 5)
    robot = subjects.chain(many)
    chain, (q, v, tau) = sdyn.pack(robot), peers.states(robot, batch)
    f = contenders.batched(sdyn.forward_dynamics)
    vdot = jax.jit(f)(chain, q, v, tau)
    back = jax.jit(contenders.batched(sdyn.inverse_dynamics))(chain, q, v, vdot)
    out = dict(
        joints=many,
        batch=batch,
        **harness.spread(times[str(many)]),
        times_ten_times_shorter=harness.ratio(times[str(many)], times[str(few)]),
        round_trip_error=float(np.abs(back - tau).max() / np.abs(tau).max()),
        memory_bytes=memory(f, chain, q, v, tau),
    )
    if peers.version("mujoco"):
        theirs = peers.MuJoCo(robot, q, v, tau).vdot()
        out["error_against_mujoco"] = float(np.abs(vdot - theirs).max() / np.abs(theirs).max())
    return out
