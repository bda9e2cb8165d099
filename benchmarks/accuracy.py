"""What an error costs: `sdyn bench accuracy`, some 12 minutes; less where `.cache/` holds what was compiled before.

Every method, type, loop method and stabilisation on every scene of `accuracy_scenes.py`, with more and more steps: the
error against the reference, which is not the library's own, over the time that the motion takes, in one
thread. Then `choose` for an error of 1e-6, against the presets. Results: results/accuracy.json, results/accuracy.png.
"""

import json
import os
import sys
from pathlib import Path

import harness
from accuracy_report import chart, show

LONGEST = 0.2  # seconds that a run may take
WILD = "Andrews", "stiff governor"
TOLERANCES = 1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13
SUBSTEPS = tuple(2**k for k in range(13))
WANTED, ROUNDS = "1e-6", 7


def contenders(chain, dt, gentle) -> dict:
    """What competes on a scene; where it is not `gentle`, the iteration of the variational method has nowhere to go."""
    from sdyn import Accuracy

    out = {
        "semi-implicit": Accuracy("semi_implicit", dtype="float64"),
        "RK4": Accuracy(dtype="float64"),
        "RK4, float32": Accuracy(dtype="float32"),
        "RK4, link frame": Accuracy(dtype="float64", frame="link"),
        "RK4, float32, link frame": Accuracy(dtype="float32", frame="link"),
        "implicit": Accuracy("implicit", dtype="float64"),
        "adaptive": Accuracy("adaptive", dtype="float64", derivatives="recomputed"),
    }
    if gentle and not chain.capacity.rows:
        out["variational"] = Accuracy("variational", dtype="float64")
    if chain.capacity.rows:
        out["RK4, partition"] = Accuracy(dtype="float64", loops="partition")
        out["RK4, Baumgarte"] = Accuracy(dtype="float64", drift=0.5 / float(dt))
        out["RK4, drifting"] = Accuracy(dtype="float64", drift=0.0)
    return out


def front(points):
    """Marks the points that no other beats in both."""
    for a in points:
        better = [b for b in points if b["error"] <= a["error"] and b["seconds"] <= a["seconds"] and b is not a]
        a["pareto"] = not better


def ladder(run, what, truth):
    """Points of one contender, until they take too long or rounding takes over."""
    import scenes

    from sdyn.choose import distance

    out, rising = [], 0
    for x in TOLERANCES if what.method == "adaptive" else SUBSTEPS:
        found, seconds = run(x)
        error = distance(scenes.unsigned(found, truth), truth)
        if error < 10:  # else it is no motion
            rising += bool(out) and what.method != "adaptive" and 0.7 * out[-1]["error"] < error < 1e-3
            out.append(dict(x=x, error=error, seconds=seconds))
        if seconds > LONGEST or rising > 1:
            break
    return out


def starter(scene):
    """accuracy -> what runs it on a scene, see `choose.runner`."""
    from functools import partial

    from sdyn.choose import runner
    from sdyn.march import forces

    chain, truth, force, dt, gravity = scene
    steps = len(truth[0]) - 1
    return partial(runner, chain, *(x[0] for x in truth), forces("", force, steps, 0)[0], dt, steps, gravity, None)


def measured(scene, name) -> dict:
    """All points of one scene."""
    (chain, truth, _, dt, _), start, points = scene, starter(scene), []
    for contender, what in contenders(chain, dt, name not in WILD).items():
        print(f"  {contender}", flush=True)
        points += [dict(contender=contender) | point for point in ladder(start(what), what, truth)]
    front(points)
    return dict(nv=chain.nv, rows=chain.capacity.rows, dt=float(dt), steps=len(truth[0]) - 1, points=points)


def chosen(scene) -> dict:
    """What `choose` takes for the wanted error, what that delivers, and its time over that of the cheapest preset that
    delivers it too, in turns."""
    import numpy as np
    import scenes

    import sdyn
    from sdyn.choose import distance

    chain, truth, force, dt, gravity = scene
    print("  choosing", flush=True)
    start, steps = starter(scene), len(truth[0]) - 1
    found = sdyn.choose(chain, truth[0][0], truth[1][0], force, dt, WANTED, steps=steps, gravity=gravity).accuracy
    all_of_them = {"chosen": found} | sdyn.PRESETS
    amount = lambda what: what.tolerance if what.method == "adaptive" else what.substeps
    runs = {name: (start(what), amount(what)) for name, what in all_of_them.items()}
    errors = {name: distance(scenes.unsigned(run(x)[0], truth), truth) for name, (run, x) in runs.items()}
    times = [{name: run(x)[1] for name, (run, x) in runs.items()} for _ in range(ROUNDS)]
    median = lambda name: float(np.median([turn[name] for turn in times]))
    cheapest = min((name for name in sdyn.PRESETS if errors[name] <= float(WANTED)), key=median)
    return dict(
        method=found.method, dtype=found.dtype, substeps=found.substeps, error=errors["chosen"], preset=cheapest,
        ratio=round(float(np.median([turn["chosen"] / turn[cheapest] for turn in times])), 3), errors=errors,
        seconds={name: median(name) for name in runs},
    )  # fmt: skip


def main(names):
    """Measure, save, show; where scenes are named only those, next to what is kept of the others."""
    os.environ |= harness.ONE_THREAD
    import accuracy_scenes
    import jax

    jax.config.update("jax_compilation_cache_dir", str(Path(__file__).parents[1] / ".cache" / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # `choose` compiles what has been before
    result = dict(what="error of a motion against an independent reference, over the seconds that it takes")
    result |= harness.machine("diffrax") | dict(scenes={}, chosen={})
    kept = harness.RESULTS / "accuracy.json"
    if names and kept.is_file():
        result |= {key: value for key, value in json.loads(kept.read_text()).items() if key in ("scenes", "chosen")}
    for name, make in accuracy_scenes.all_of_them().items():
        if names and name not in names:
            continue
        print(name, flush=True)
        scene = make()
        result["scenes"][name] = measured(scene, name)
        if name in accuracy_scenes.CHOSEN:
            result["chosen"][name] = chosen(scene)
    harness.save("accuracy", result)
    show(result)
    chart(result, harness.RESULTS / "accuracy.png")


if __name__ == "__main__":
    main(sys.argv[1:])
