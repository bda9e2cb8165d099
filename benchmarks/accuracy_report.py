"""The tables, the advice and the chart of results/accuracy.json; run it to see the kept results again."""

import json

import harness
from rich.console import Console
from rich.table import Table
from rich.text import Text

LOOK = dict(box=None, title_justify="left", padding=(0, 2, 0, 0))
ERRORS = 1e-3, 1e-6, 1e-9, 1e-12
COLOURS = {
    "semi-implicit": "#9aa5b1", "RK4": "#1f6fb4", "RK4, float32": "#63b3e8", "variational": "#2a9d5c",
    "implicit": "#d1495b", "adaptive": "#7b4fa3", "RK4, partition": "#e08a1e", "RK4, Baumgarte": "#8a6d3b",
    "RK4, drifting": "#444444", "RK4, link frame": "#0b3c6f", "RK4, float32, link frame": "#9fd3ef",
}  # fmt: skip
ADVICE = (
    ("a quick look, thousands of motions at once", "fast: float32, 1e-5 to 1e-6 where steps are short for the motion"),
    ("planning, control, most things", "balanced: RK4 in float64, one step for each of yours"),
    ("a result to be believed", "accurate: eight steps for each of yours, about 1e-3 to 1e-4 of the error"),
    ("a reference for the others", "reference: order 8, adaptive; cheapest of all below about 1e-8"),
    ("long motions, momentum, energy", "variational: errors of order 2, but none that grows in momentum or energy"),
    ("stiff springs, dampers, gains", "implicit: steps that RK4 cannot take; dear where nothing is stiff"),
    ("a wanted error", 'accuracy="1e-6": measures on your scene, once, and takes the cheapest'),
)


def show(result):
    """Print what was measured; at 80 columns nothing is cut."""
    console = Console(highlight=False, width=min(Console().width, 100))
    say = lambda text: console.print(Text(text), soft_wrap=not console.is_terminal)
    versions = ", ".join(f"{name} {version}" for name, version in result["versions"].items() if version)
    say(f"{result['cpu']}, one thread, {result['cores']} cores, load {result['load']}; {versions}")
    if "not_run" in result:
        say(f"not run {result['not_run']}")
    console.print(_cheapest(result))
    console.print(_chosen(result))
    table = Table(title="What to choose when", show_header=False, **LOOK)
    for row in ADVICE:
        table.add_row(*row)
    console.print(table)


def _cheapest(result):
    """The cheapest way to each error, and the smallest error, of each scene."""
    table = Table(title="Cheapest way to an error, ms for the motion", **LOOK)
    table.add_column("")
    for error in ERRORS:
        table.add_column(f"{error:.0e}", overflow="fold")
    table.add_column("least error", no_wrap=True)
    for name, scene in result["scenes"].items():
        cells = []
        for error in ERRORS:
            good = [point for point in scene["points"] if point["error"] <= error]
            best = min(good, key=lambda point: point["seconds"], default=None)
            cells.append(f"{1e3 * best['seconds']:.2g} {best['contender']}" if best else "-")
        table.add_row(name, *cells, f"{min(point['error'] for point in scene['points']):.0e}")
    return table


def _chosen(result):
    """What a wanted error of 1e-6 was turned into."""
    table = Table(title='accuracy="1e-6"', **LOOK)
    for column in ("", "chosen", "error", "cheapest preset", "time over it"):
        table.add_column(column)
    for name, x in result["chosen"].items():
        what = f"{x['method']} {x['dtype']}" + (f", {x['substeps']} substeps" if x["method"] != "adaptive" else "")
        table.add_row(name, what, f"{x['error']:.1e}", x["preset"], f"{x['ratio']:.2f}")
    return table


def chart(result, path):
    """Error over time, a panel for each scene; points that nothing beats are ringed, presets are named."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    count = len(result["scenes"])
    rows = -(-count // 3)
    figure, panels = plt.subplots(rows, min(count, 3), figsize=(13, 3.9 * rows + 1), squeeze=False)
    lines = {}
    for axes, (name, scene) in zip(panels.flat, result["scenes"].items(), strict=False):
        for contender, colour in COLOURS.items():
            points = [point for point in scene["points"] if point["contender"] == contender]
            if points:
                x, y = ([max(point[key], 1e-16) for point in points] for key in ("seconds", "error"))
                (lines[contender],) = axes.plot(x, y, ".-", color=colour, lw=1.2, ms=4)
        best = [point for point in scene["points"] if point["pareto"]]
        x, y = ([max(point[key], 1e-16) for point in best] for key in ("seconds", "error"))
        (lines["nothing is better"],) = axes.plot(x, y, "o", mfc="none", mec="black", ms=8, mew=0.9)
        for label, contender, value, side in PRESETS:
            for point in scene["points"]:
                if point["contender"] == contender and point["x"] == value:
                    at = (point["seconds"], max(point["error"], 1e-16))
                    place = dict(textcoords="offset points", ha="right" if side < 0 else "left", va="center")
                    axes.annotate(label, at, (7 * side, 3 * side), fontsize=7, **place)
        axes.margins(x=0.12)
        axes.set(xscale="log", yscale="log", title=f"{name}, {scene['dt'] * scene['steps']:.3g} s")
        axes.grid(alpha=0.25)
    for axes in panels.flat[count:]:
        axes.axis("off")
    for axes in panels[:, 0]:
        axes.set_ylabel("error")
    for axes in panels[-1]:
        axes.set_xlabel("seconds to compute")
    figure.suptitle(f"What an error costs: one thread, {result['cpu']}")
    figure.legend(lines.values(), lines.keys(), loc="lower center", ncols=5, frameon=False)
    figure.tight_layout(rect=(0, 0.9 / (3.9 * rows + 1), 1, 1))
    figure.savefig(path, dpi=130)
    plt.close(figure)


PRESETS = (  # label, contender, its number of substeps or tolerance, side of the point
    ("fast", "RK4, float32, link frame", 1, 1),
    ("balanced", "RK4", 1, -1),
    ("accurate", "RK4", 8, -1),
    ("reference", "adaptive", 1e-13, 1),
)


if __name__ == "__main__":
    kept = json.loads((harness.RESULTS / "accuracy.json").read_text())
    show(kept)
    chart(kept, harness.RESULTS / "accuracy.png")
