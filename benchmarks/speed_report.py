"""The table and the chart of results/speed.json; run it to see the kept results again."""

import json

import harness
from rich.console import Console
from rich.table import Table
from rich.text import Text

FIRST = ("sdyn, batch 256", "MJX, batch 1024", "JaxSim, batch 256")
LOOK = dict(box=None, title_justify="left", padding=(0, 2, 0, 0))


def show(result):
    """Print what was measured; at 80 columns nothing is cut."""
    console = Console(highlight=False, width=min(Console().width, 100))
    say = lambda text: console.print(Text(text), soft_wrap=not console.is_terminal)
    versions = ", ".join(f"{name} {version}" for name, version in result["versions"].items() if version)
    say(f"{result['cpu']}, one thread on one core of {result['cores']}, load {result['load']}; {versions}")
    for peer, reason in result["absent"].items():
        say(f"{peer} was left out: {reason}")
    rows = [row for errors in result["agreement"].values() for row in errors.items()]
    worst = max(x for name, x in rows if "," not in name)
    slopes = max((x for name, x in rows if "derivatives" in name), default=float("nan"))
    single = max(errors["sdyn, float32"] for errors in result["agreement"].values())
    say(f"accelerations agree to {worst:.0e} (float32: {single:.0e}) of the largest one, derivatives to {slopes:.0e}")
    console.print(_ratios(result))
    console.print(_times(result))
    cold, change, long = result["cold_compile"], result["structure_change"], result["long_chain"]
    first = result["first_call_s"]["paper37"]
    seconds = ", ".join(f"{first[key]:.0f} s {key}" for key in first if key in FIRST)
    say(f"first calls, which compile: {seconds}")
    say(f"cold compile of forward dynamics: {cold['compile_s']:.1f} s, and {cold['trace_s']:.1f} s of tracing")
    say(f"structure change, edit and pack: {change['median_us'] / 1e3:.2f} ms")
    say(
        f"chain of {long['joints']} joints: {long['median_us']:.0f} us a sample, {long['times_ten_times_shorter']:.1f} "
        f"times one of a tenth; error {long.get('error_against_mujoco', float('nan')):.0e} against MuJoCo, "
        f"{long['round_trip_error']:.0e} of the round trip; {long['memory_bytes'] / 2**20:.0f} MiB for {long['batch']}"
    )


def _ratios(result):
    table = Table(title="How many times faster, robot paper37", **LOOK)
    for column in ("what", "against"):
        table.add_column(column)
    for column in ("us", "us", "ratio"):
        table.add_column(column, justify="right", no_wrap=True)
    for row in result["ratios"]:
        slow, fast = (result["time"]["paper37"][row[key]]["median_us"] for key in ("slow", "fast"))
        table.add_row(row["what"], row["slow"], f"{slow:.2f}", f"{fast:.2f}", Text(f"{row['ratio']:.2f}", "bold"))
    return table


def _times(result):
    table = Table(title="Forward dynamics, time per sample, us: median (10 to 90 %)", **LOOK)
    table.add_column("")
    for name in result["time"]:
        table.add_column(name, justify="right", no_wrap=True)
    cell = lambda x: f"{x['median_us']:.3g} ({x['p10_us']:.3g}-{x['p90_us']:.3g})"
    for key in _forward(result):
        table.add_row(key, *(cell(times[key]) for times in result["time"].values()))
    return table


def _forward(result):
    """The contenders that compute accelerations."""
    return [key for key in result["time"]["iiwa_free"] if "Derivatives" not in key]


def chart(result, path):
    """Time per sample of every library on every robot."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    keys = _forward(result)
    figure, panels = plt.subplots(1, len(result["time"]), figsize=(12, 0.4 * len(keys) + 1.4), sharey=True)
    for axes, (name, times) in zip(panels, result["time"].items(), strict=True):
        medians = [times[key]["median_us"] for key in keys]
        spread = [[times[key]["median_us"] - times[key]["p10_us"] for key in keys]]
        spread.append([times[key]["p90_us"] - times[key]["median_us"] for key in keys])
        colours = ["#1f6fb4" if key.startswith("sdyn") else "#9aa5b1" for key in keys]
        axes.barh(keys, medians, xerr=spread, color=colours, ecolor="#444444")
        for k, key in enumerate(keys):
            axes.annotate(f" {medians[k]:.3g}", (times[key]["p90_us"], k), va="center", fontsize=8)
        axes.set(xscale="log", title=name, xlabel="us a sample")
        axes.margins(x=0.2)
    panels[0].invert_yaxis()
    figure.suptitle(f"Forward dynamics, one thread, {result['cpu']}")
    figure.tight_layout()
    figure.savefig(path, dpi=150)
    plt.close(figure)


if __name__ == "__main__":
    kept = json.loads((harness.RESULTS / "speed.json").read_text())
    show(kept)
    chart(kept, harness.RESULTS / "speed.png")
