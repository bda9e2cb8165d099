"""What does leaving out save? The paper's robot of 37 degrees of freedom, reduced to 9 and to 13.

Accelerations and their Jacobians, in turns with the whole robot, and with a small one that was built by hand. The error
is that of `sdyn.reduce`: accelerations against those of the whole robot whose other joints are held.
"""

import harness
from rich.console import Console
from rich.table import Table

CASES = {"37 to 9": 3, "37 to 13": 7}
BATCHES = 64, 256


def main():
    """Measure, save, show."""
    harness.one_thread()
    import contenders
    import subjects

    import sdyn

    full = sdyn.models.load("paper37")
    result = dict(what="the whole robot against a reduced one, microseconds a sample") | harness.machine()
    found = {}
    for case, joints in CASES.items():
        moving = tuple(f"arm1_{k}" for k in range(1, joints + 1))
        found[case] = sdyn.reduce(full, sdyn.Scene(moving, frames=()))
    functions = {f"accelerations, batch {batch}": (contenders.forward, batch) for batch in BATCHES}
    functions[f"Jacobians, batch {BATCHES[0]}"] = contenders.columns, BATCHES[0]
    rows = []
    for what, (make, batch) in functions.items():
        robots = {"whole": full} | {case: small for case, (small, _) in found.items()}
        if make is contenders.forward:
            robots |= {f"{case}, by hand": subjects.chain(joints) for case, joints in CASES.items()}
        times, _ = harness.times({name: make(robot, batch) for name, robot in robots.items()})
        for case in CASES:
            row = dict(what=what, case=case, whole=harness.spread(times["whole"]), reduced=harness.spread(times[case]))
            row["ratio"] = harness.ratio(times["whole"], times[case])
            if (by_hand := times.get(f"{case}, by hand")) is not None:
                row["over_by_hand"] = harness.ratio(times[case], by_hand)
            rows.append(row)
            print(row, flush=True)
    result |= dict(rows=rows, error={case: report.error for case, (_, report) in found.items()})
    harness.save("reduce", result)
    show(result)


def show(result):
    """Print what was measured."""
    table = Table(title="The whole robot against a reduced one", title_justify="left", box=None)
    for column in ("", "", "whole", "reduced", "times faster", "over by hand"):
        table.add_column(column, no_wrap=True)
    for x in result["rows"]:
        whole, reduced = (f"{x[key]['median_us']:.2f} us" for key in ("whole", "reduced"))
        by_hand = f"{x['over_by_hand']:.2f}" if "over_by_hand" in x else ""
        table.add_row(x["what"], x["case"], whole, reduced, f"{x['ratio']:.1f}", by_hand)
    console = Console(highlight=False)
    console.print(table)
    for case, error in result["error"].items():
        console.print(f"{case}: accelerations differ by at most {error:.1e} of the largest")


if __name__ == "__main__":
    main()
