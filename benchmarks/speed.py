"""How fast forward dynamics and its derivatives are, next to other libraries: `sdyn bench speed`, about ten minutes.

Everything runs in one thread on one core, in turns, on the same robots; all must agree in their accelerations before
anything is timed. A ratio is the median of the ratios within a round. Results: results/speed.json, results/speed.png.
"""

import subprocess
import sys

import harness
from speed_report import chart, show

PADDED = "9-DOF form, padded"
AGREE = 1e-9  # of the largest acceleration; measured 2e-13 to 5e-12
BATCHES = {"MJX": 1024, "JaxSim": 256}
WIDTHS = (1, 2, 4, 8)
COLD = """
import time, jax, sdyn
jax.numpy.ones(3).sum().block_until_ready()
robot = sdyn.models.load("paper37")
chain, x = sdyn.pack(robot), jax.numpy.zeros((256, robot.nv))
q = jax.numpy.tile(robot.neutral(), (256, 1))
start = time.perf_counter()
lowered = jax.jit(jax.vmap(sdyn.forward_dynamics, (None, 0, 0, 0))).lower(chain, q, x, x)
middle = time.perf_counter()
lowered.compile()
print(middle - start, time.perf_counter() - middle)
"""


def present(kinds):
    """The peers that are installed, and a line for each that is not."""
    import peers

    missing = {kind.name: "not installed" for kind in kinds if peers.version(kind.package) is None}
    return [kind for kind in kinds if kind.name not in missing], missing


def agreement(robot, kinds) -> tuple[dict, dict]:
    """Largest difference of accelerations from ours, relative to the largest, and of Pinocchio's derivatives; and who
    fails, with the reason."""
    import jax
    import numpy as np
    import peers

    import sdyn

    merged, (q, v, tau) = peers.merged(robot), peers.states(robot, 4)
    fd = jax.jit(jax.vmap(sdyn.forward_dynamics, (None, 0, 0, 0)))
    ours, errors, failed = np.asarray(fd(sdyn.pack(robot), q, v, tau)), {}, {}
    error = lambda a: float(np.abs(a - ours).max() / np.abs(ours).max())
    errors["sdyn, float32"] = error(fd(sdyn.pack(robot, dtype="float32"), *(x.astype("f4") for x in (q, v, tau))))
    for kind in kinds:
        try:
            peer = kind(merged, q, v, tau)
            errors[kind.name] = error(peer.vdot())
            if hasattr(peer, "jacobians"):
                _, *mine = jax.jit(jax.vmap(sdyn.forward_dynamics_jacobians, (None, 0, 0, 0)))(
                    sdyn.pack(robot), q, v, tau
                )
                pairs = zip(mine, peer.jacobians().swapaxes(0, 1), strict=True)
                errors[f"{kind.name}, derivatives"] = max(
                    float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs
                )
        except Exception as reason:  # what goes wrong in a peer is reported, and the others go on
            failed[kind.name] = f"{type(reason).__name__}: {reason}".splitlines()[0]
    return errors, failed


def forward(robot, kinds):
    """Contenders for the forward dynamics of one robot."""
    import contenders
    import peers

    run = {"sdyn, batch 256": contenders.forward(robot, 256)}
    run["sdyn float32, batch 256"] = contenders.forward(robot, 256, dtype="float32")
    run |= {f"sdyn, batch 1, width {w}": contenders.forward(robot, 1, width=w) for w in WIDTHS}
    for kind in kinds:
        run |= contenders.of_peer(kind, peers.merged(robot), BATCHES.get(kind.name, 0))
    return run


def of_full(full, reduced):
    """The contenders of this library that only the table of ratios needs."""
    import contenders
    import jax

    import sdyn

    return {
        "sdyn, batch 1024": contenders.forward(full, 1024),
        "sdyn, gradient, batch 256": contenders.gradient(full, 256),
        "sdyn, jacrev, batch 64": contenders.jacobians(full, 64, jax.jacrev),
        "sdyn, jacfwd, batch 64": contenders.jacobians(full, 64, jax.jacfwd),
        "sdyn, all Jacobians, batch 64": contenders.columns(full, 64),
        "9-DOF form": contenders.forward(reduced, 256),
        PADDED: contenders.forward(reduced, 256, capacity=sdyn.capacity([full, reduced])),
    }


def ratios(times) -> list[dict]:
    """What is compared with what, as the median over the rounds."""
    median = lambda name: sorted(times[name])[len(times[name]) // 2]
    best = lambda names: min((name for name in names if name in times), key=median, default="")
    aba = best(["pin.aba", "pin.aba (world)"])
    one = best([f"sdyn, batch 1, width {w}" for w in WIDTHS])
    all_slopes = best(["sdyn, all Jacobians, batch 64", "sdyn, jacrev, batch 64", "sdyn, jacfwd, batch 64"])
    rows = [
        ("forward dynamics, batch 256", aba, "sdyn, batch 256"),
        ("forward dynamics, batch 256, float32", aba, "sdyn float32, batch 256"),
        ("forward dynamics, batch 1, in a loop", aba, one),
        ("gradient (q, v, tau), batch 256", "pin.computeABADerivatives", "sdyn, gradient, batch 256"),
        ("Jacobians (q, v, tau), batch 64", "pin.computeABADerivatives", all_slopes),
        ("forward dynamics, batch 1024", "MJX, batch 1024", "sdyn, batch 1024"),
        ("forward dynamics, batch 256", "JaxSim, batch 256", "sdyn, batch 256"),
        ("forward dynamics, batch 256", "mj_forward", "sdyn, batch 256"),
        ("forward dynamics, batch 256", "mujoco.rollout", "sdyn, batch 256"),
        ("9-DOF form against all 37", "sdyn, batch 256", "9-DOF form"),
        ("9-DOF form, exact against padded sizes", PADDED, "9-DOF form"),
    ]
    return [
        dict(what=what, slow=slow, fast=fast, ratio=harness.ratio(times[slow], times[fast]))
        for what, slow, fast in rows
        if slow in times and fast in times
    ]


def cold_compile(repeats=3):
    """Seconds of tracing and of compiling forward dynamics, batch 256, in fresh processes without a cache."""
    import numpy as np

    once = lambda: subprocess.run([sys.executable, "-c", COLD], capture_output=True, text=True, check=True).stdout
    trace, compiled = np.median([[float(x) for x in once().split()] for _ in range(repeats)], 0)
    return dict(trace_s=round(float(trace), 3), compile_s=round(float(compiled), 3))


def measured(kinds, result):
    """Everything that is timed, into the result."""
    import contenders
    import growth
    import structure_change
    import subjects

    import sdyn

    full, reduced, _ = subjects.compared().values()
    for name, robot in subjects.compared().items():
        print(f"{name}: compiling and timing", flush=True)
        run = forward(robot, kinds) | (of_full(full, reduced) if name == "paper37" else {})
        times, first = harness.times(run)
        result["time"][name] = {key: harness.spread(x) for key, x in times.items()}
        result["first_call_s"][name] = first
        if name == "paper37":
            result["ratios"] = ratios(times)
    print("compiling in fresh processes, structure changes, long chains", flush=True)
    result["cold_compile"] = cold_compile()
    change = structure_change.timed(structure_change.edits(full)["lock 28 of 31"], sdyn.capacity([full, reduced]))
    result["structure_change"] = harness.spread(change[:, :2].sum(1) / 1e3)
    result["long_chain"] = growth.long_chain()
    result["pin.aba of one body"] = contenders.overhead(kinds)


def main():
    """Measure, save, show."""
    harness.one_thread()
    import peers
    import subjects

    kinds, absent = present(peers.ALL)
    result = dict(what="time per sample of forward dynamics and its derivatives, one thread on one core")
    result |= harness.machine(*(kind.package for kind in peers.ALL))
    result |= dict(absent=absent, agreement={}, time={}, first_call_s={})
    for name, robot in subjects.compared().items():
        print(f"{name}: do all agree?", flush=True)
        result["agreement"][name], failed = agreement(robot, kinds)
        absent |= failed
        kinds = [kind for kind in kinds if kind.name not in failed]
        worst = max((x for peer, x in result["agreement"][name].items() if "float32" not in peer), default=0.0)
        if not worst < AGREE:
            sys.exit(f"{name}: accelerations differ, nothing was timed: {result['agreement'][name]}")
    measured(kinds, result)
    harness.save("speed", result)
    show(result)
    chart(result, harness.RESULTS / "speed.png")


if __name__ == "__main__":
    main()
