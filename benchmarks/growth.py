"""What forward dynamics costs as the work grows: joints, batch, depth and width, padding, blocks,
what a batch shares, frames; and the memory.

    python benchmarks/growth.py [joints batch block shape padding sharing frame]

Time per sample, one thread on one core; results/growth.json and results/growth.png. All of it takes ten minutes; of
parts that are not named, the kept numbers stay, and each part says when it was measured.
"""

import json
import sys

import harness

JOINTS = (3, 10, 31, 100, 316, 1000)
BATCHES = (1, 4, 16, 64, 256, 1024, 4096, 16384)
WIDTHS = (1, 2, 4, 8)
BLOCKS = (32, 64, 128, 256, 512, 1024, 2048)


def memory(f, *args) -> int:
    """Bytes that a compiled function needs besides its arguments: results, and what is in between at its peak."""
    import jax

    sizes = jax.jit(f).lower(*args).compile().memory_analysis()
    return sizes.temp_size_in_bytes + sizes.output_size_in_bytes


def measured(contenders, rounds=7) -> dict[str, dict]:
    """Time per sample of each contender."""
    times, _ = harness.times({str(name): x for name, x in contenders.items()}, rounds)
    return {name: harness.spread(x) for name, x in times.items()}


def needed(robot, batch) -> int:
    """Memory of forward dynamics."""
    import contenders
    import peers

    import sdyn

    return memory(contenders.batched(sdyn.forward_dynamics), sdyn.pack(robot), *peers.states(robot, batch))


def by_joints(batch=64):
    """Chains."""
    import contenders
    import subjects

    out = measured({n: contenders.forward(subjects.chain(n), batch) for n in JOINTS})
    for n in JOINTS:
        out[str(n)]["memory_bytes"] = needed(subjects.chain(n), batch)
    return out


def by_batch():
    """The 37-DOF robot."""
    import contenders
    import subjects

    robot = subjects.compared()["paper37"]
    out = measured({n: contenders.forward(robot, n) for n in BATCHES})
    for n in BATCHES:
        out[str(n)]["memory_bytes"] = needed(robot, max(n, 2))
    return out


def by_shape():
    """32 joints, deep and wide, in steps of several bodies; one sample and many."""
    import contenders
    import subjects

    shapes = {"1 arm of 32": (1, 32), "4 arms of 8": (4, 8), "32 arms of 1": (32, 1)}
    return {
        f"batch {batch}": {
            name: measured({w: contenders.forward(subjects.arms(*shape), batch, width=w) for w in WIDTHS})
            for name, shape in shapes.items()
        }
        for batch in (1, 256)
    }


def by_padding():
    """The 37-DOF robot and its 9-DOF form, in exact sizes and in the capacity of both."""
    import contenders
    import subjects

    import sdyn

    full, reduced, _ = subjects.compared().values()
    size = sdyn.capacity([full, reduced])
    return {
        f"batch {batch}": measured(
            {
                "37 DOF, exact": contenders.forward(full, batch),
                "37 DOF, in the capacity": contenders.forward(full, batch, capacity=size),
                "9 DOF, exact": contenders.forward(reduced, batch),
                "9 DOF, in the capacity": contenders.forward(reduced, batch, capacity=size),
            }
        )
        for batch in (1, 256, 2048)
    }


def by_sharing(batch=64):
    """A batch that shares its structure and parameters; with masses of its own each; and a structure each."""
    import contenders
    import jax
    import jax.numpy as jnp
    import peers
    import subjects

    import sdyn

    robot = subjects.compared()["paper37"]
    chain, x = sdyn.pack(robot), peers.states(robot, batch)
    masses = jnp.linspace(0.9, 1.1, batch)[:, None] * chain.link_mass
    each, many = jax.vmap(sdyn.forward_dynamics), sdyn.family([robot] * batch)

    def one(mass, *x):
        params = sdyn.Params(mass, chain.link_com, chain.link_inertia)
        return sdyn.forward_dynamics(sdyn.with_params(chain, params), *x)

    heavier = lambda masses, x: jax.vmap(one)(masses, *x)
    run = {
        "all shared": contenders.forward(robot, batch),
        "parameters each": harness.Contender(harness.loop(heavier, masses, x), batch),
        "a structure each": harness.Contender(harness.loop(lambda chains, x: each(chains, *x), many, x), batch),
    }
    return measured(run)


def by_frame(batch=64):
    """Common frame and links' frames, float64 and float32: time, and error against the links' frames in float64."""
    import contenders
    import jax
    import numpy as np
    import peers
    import subjects

    import sdyn

    def accelerations(robot, frame, dtype):
        chain, x = sdyn.pack(robot, frame=frame, dtype=dtype), (y.astype(dtype) for y in peers.states(robot, batch))
        return np.asarray(jax.jit(contenders.batched(sdyn.forward_dynamics))(chain, *x), float)

    out = {}
    robots = {"37 DOF": subjects.compared()["paper37"]} | {f"chain of {n}": subjects.chain(n) for n in (31, 316)}
    for name, robot in robots.items():
        how = [(frame, dtype) for dtype in ("float64", "float32") for frame in ("link", "common")]
        run = {" ".join(x): contenders.forward(robot, batch, frame=x[0], dtype=x[1]) for x in how}
        out[name], exact = measured(run), accelerations(robot, "link", "float64")
        for x in how:
            error = np.abs(accelerations(robot, *x) - exact).max() / np.abs(exact).max()
            out[name][" ".join(x)]["error"] = float(error)
    return out


def by_block(batch=4096):
    """A large batch handed over in blocks, one after the other; and whole."""
    import contenders
    import jax
    import subjects

    import sdyn

    robot = subjects.compared()["paper37"]

    def blocks(size):
        f = lambda chain, *x: jax.lax.map(lambda y: sdyn.forward_dynamics(chain, *y), x, batch_size=size)
        return contenders.forward(robot, batch, all_at_once=f)

    return measured({"whole": contenders.forward(robot, batch)} | {size: blocks(size) for size in BLOCKS})


def long_chain(few=100, many=1000, batch=16) -> dict:
    """A chain of 1000 joints: time against one of 100, error, memory.

    The error is against MuJoCo, because Pinocchio's data of so many joints takes more than 20 GB, and of inverse
    dynamics after forward dynamics.
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


def show(result):
    """Print the medians."""
    for key in ("joints", "batch", "block", "sharing"):
        print(f"by {key} [us a sample]:", ", ".join(f"{n}: {x['median_us']:.2f}" for n, x in result[key].items()))
    for batch, times in result["padding"].items():
        print(f"{batch}, by padding:", ", ".join(f"{n}: {x['median_us']:.2f}" for n, x in times.items()))
    for name, times in result["frame"].items():
        print(
            f"{name}, by frame:", ", ".join(f"{n}: {x['median_us']:.2f} ({x['error']:.0e})" for n, x in times.items())
        )
    for batch, shapes in result["shape"].items():
        for name, widths in shapes.items():
            print(f"{batch}, {name}, by width:", ", ".join(f"{w}: {x['median_us']:.2f}" for w, x in widths.items()))


def chart(result, path):
    """Time per sample and memory against joints, batch and block; depth against width."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, ((joints, batch), (block, shape)) = plt.subplots(2, 2, figsize=(10, 7))
    for axes, key, label in ((joints, "joints", "joints of a chain"), (batch, "batch", "batch, 37 DOF")):
        n = [int(x) for x in result[key]]
        axes.loglog(n, [x["median_us"] for x in result[key].values()], "o-", color="#1f6fb4")
        axes.set(xlabel=label, ylabel="us a sample")
        right = axes.twinx()
        right.loglog(n, [x["memory_bytes"] / 2**20 for x in result[key].values()], "s:", color="#9aa5b1")
        right.set_ylabel("memory, MiB (dotted)")
    whole = result["block"]["whole"]["median_us"]
    sizes = {int(n): x["median_us"] for n, x in result["block"].items() if n != "whole"}
    block.semilogx(list(sizes), list(sizes.values()), "o-", color="#1f6fb4")
    block.axhline(whole, color="#9aa5b1", ls=":", label="whole")
    block.set(xlabel="block of a batch of 4096, 37 DOF", ylabel="us a sample")
    block.legend()
    for name, widths in result["shape"]["batch 1"].items():
        shape.plot(list(widths), [x["median_us"] for x in widths.values()], "o-", label=name)
    shape.set(xlabel="width of a step, one sample, 32 joints", ylabel="us a sample", yscale="log")
    shape.legend()
    figure.suptitle(f"Forward dynamics, one thread, {result['cpu']}")
    figure.tight_layout()
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(wanted):
    """Measure, save, show."""
    harness.one_thread()
    kept = json.loads((harness.RESULTS / "growth.json").read_text()) if wanted else dict(measured={})
    result = kept | dict(what="time per sample of forward dynamics, one thread on one core") | harness.machine()
    for f in (by_padding, by_frame, by_sharing, by_joints, by_batch, by_block, by_shape):
        key = f.__name__.removeprefix("by_")
        if wanted and key not in wanted:
            continue
        print(f"by {key}", flush=True)
        result[key] = f()
        now = harness.machine()
        result["measured"][key] = dict(date=now["date"], load=now["load"])
        harness.save("growth", result)
    show(result)
    chart(result, harness.RESULTS / "growth.png")


if __name__ == "__main__":
    main(sys.argv[1:])
