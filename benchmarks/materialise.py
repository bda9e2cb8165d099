"""Does `sdyn.materialise.keep` still pay? Exits with 1 if not: then a JAX upgrade has lost its effect.

    python benchmarks/materialise.py

Forward dynamics of the 37-DOF robot and its gradient, as shipped and with `keep` replaced by the identity, in turns.
"""

import importlib
import sys
from types import ModuleType

import harness

LEAST = 2.0  # times faster; measured 4 to 9, and 1 where JAX drops the barriers (before 0.12)
BATCH = 256


def contenders(label: str) -> dict[str, harness.Contender]:
    """What is timed, from the copy of the library that is imported now."""
    modules = {name: importlib.import_module(name) for name in ("contenders", "subjects")}
    robot = modules["subjects"].compared()["paper37"]
    return {
        f"forward dynamics, {label}": modules["contenders"].forward(robot, BATCH),
        f"gradient, {label}": modules["contenders"].gradient(robot, BATCH),
    }


def without_barriers():
    """Forget the library, and import it anew with a `keep` that does nothing."""
    for name in [x for x in sys.modules if x.split(".")[0] in ("sdyn", "contenders", "subjects", "peers")]:
        del sys.modules[name]
    plain = ModuleType("sdyn.materialise")
    plain.keep = lambda x: x
    sys.modules["sdyn.materialise"] = plain


def main():
    """Measure, save, judge."""
    harness.one_thread()
    run = contenders("kept")
    without_barriers()
    run |= contenders("plain")
    times, first = harness.times(run)
    gain = {
        what: harness.ratio(times[f"{what}, plain"], times[f"{what}, kept"])
        for what in ("forward dynamics", "gradient")
    }
    for what, x in gain.items():
        print(f"{what}, batch {BATCH}: {x:.1f} times faster with keep; at least {LEAST} is asked")
    result = dict(what="gain of sdyn.materialise.keep, paper37", batch=BATCH, **harness.machine(), gain=gain)
    result |= dict(times={name: harness.spread(x) for name, x in times.items()}, first_call_s=first)
    harness.save("materialise", result)
    if min(gain.values()) < LEAST:
        sys.exit("keep has lost its effect: see sdyn/materialise.py.")


if __name__ == "__main__":
    main()
