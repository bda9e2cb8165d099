"""Pictures of a structure: a tree for the terminal (rich) and one for a file (matplotlib)."""

import textwrap
from typing import NamedTuple

from rich.table import Table
from rich.text import Text
from rich.tree import Tree

from sdyn.robot import Robot

GREY, BLUE, RED, INK = "#9A9A9A", "#0072B2", "#D55E00", "#222222"
TINTS = ("#E8E8E8", "#DCEBF7", "#FCE9CF", "#DDF1E7", "#F4E3EE")  # of phases


def summary(robot: Robot) -> str:
    """One line: links, joints, base, degrees of freedom."""
    count = lambda n, what: f"{n} {what}{'' if n == 1 else 's'}"
    base = f"{'grounded' if robot.grounded else 'free'} base {robot.base!r}"
    moving, free = sum(joint.dof for joint in robot.moving), 0 if robot.grounded else 6
    parts = [count(len(robot.links), "link"), f"{count(len(robot.joints), 'joint')} ({len(robot.moving)} moving)", base]
    parts += [count(len(robot.loops), "loop")] if robot.loops else []
    total = count(robot.nv, "degree") + " of freedom"
    return f"{robot.name}: {', '.join(parts)}; {total} ({free} of the base, {moving} of the joints)"


# -- terminal ----------------------------------------------------------------------------------------------------------


def tree(robot: Robot) -> Tree:
    """The structure from the base outwards. A chain stays in one column; only a branching indents."""
    root = robot.tree.order[0]
    label = Text(robot.base, style="bold")
    label.append("  base, grounded" if robot.grounded else "  base, free", style="cyan")
    label.append(f"  {robot.links[root].mass:g} kg{_frames(robot, root)}", style="dim")
    picture = Tree(label, guide_style="dim")
    children = _children(robot)
    _grow(picture, robot, children, children[root])
    for loop in robot.loops:
        a, b = (f"{x.name} ({x.link})" if x.name != x.link else x.name for x in (loop.frame_a, loop.frame_b))
        picture.add(Text(f"loop {loop.name}: {loop.kind} of {a} and {b}", style="magenta"))
    return picture


def _children(robot) -> dict[int, list[int]]:
    out = {i: [] for i in robot.tree.order}
    for i in robot.tree.order[1:]:
        out[robot.tree.parent[i]].append(i)
    return out


def _grow(node, robot, children, starts):
    for i in starts:
        run = [i]
        while len(children[run[-1]]) == 1:
            run += children[run[-1]]
        _grow(node.add(_run(robot, run)), robot, children, children[run[-1]])


def _run(robot, links) -> Table:
    """Lines of an unbranched chain: joint, kind, link, mass, frames."""
    grid = Table.grid(padding=(0, 2, 0, 0))
    for i in links:
        joint, forward = robot.joints[robot.tree.joint[i]], robot.tree.forward[i]
        style = "yellow" if robot.is_locked(joint) else ""
        kind = "fixed" if joint.kind == "fixed" else joint.kind if forward else f"{joint.kind}, from its child"
        if joint.name in robot.locked:
            kind = "locked at " + " ".join(f"{x:g}" for x in robot.locked[joint.name])
        link = robot.links[i]
        tail = Text(f"{link.mass:g} kg{_frames(robot, i)}", style="dim")
        grid.add_row(Text(joint.name, style=style), Text(kind, style=style), Text(link.name, style="bold"), tail)
    return grid


def _frames(robot, i) -> str:
    names = [frame.name for frame in robot.frames if frame.link == robot.links[i].name]
    return f"  frame {', '.join(names)}" if names else ""


# -- file --------------------------------------------------------------------------------------------------------------


def save_picture(path, robots: dict[str, Robot]) -> None:
    """A PNG of one or more structures, one below the other.

    Args:
        path: The file.
        robots: Robots by their captions.
    """
    from matplotlib.figure import Figure

    places = {caption: _places(robot) for caption, robot in robots.items()}
    rows = [max(y for _, y in place.values()) + 1 for place in places.values()]
    columns = max(x for place in places.values() for x, _ in place.values()) + 1
    size = (max(6.0, 1.45 * columns + 1.0), sum(0.62 * n + 0.9 for n in rows))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(robots), 1, squeeze=False, height_ratios=[n + 0.8 for n in rows])[:, 0]
    for panel, (caption, robot) in zip(panels, robots.items(), strict=True):
        _paint(panel, robot, places[caption])
        panel.set_ylim(max(y for _, y in places[caption].values()) + 0.6, -0.6)
        panel.set_title(f"{caption}: {summary(robot).partition(': ')[2]}", fontsize=9, loc="left")
        panel.set_xlim(-0.6, columns - 0.3)
    figure.savefig(path, dpi=120)


class Stage(NamedTuple):
    """One phase of a motion."""

    name: str
    duration: tuple[float, float]  # s, shortest and longest
    robots: tuple[Robot, ...]  # what moves on its own
    change: str  # what becomes another structure where it begins; empty if nothing does


def save_stages(path, stages: tuple[Stage, ...]) -> None:
    """A PNG of phases: their durations on one axis of time, and below it the structures, one beside the other.

    Args:
        path: The file.
        stages: The phases, in their order.
    """
    from matplotlib.figure import Figure

    placed = [[_places(robot) for robot in stage.robots] for stage in stages]
    width = lambda places: max(y for _, y in places.values()) + 1
    widths = [sum(map(width, places)) for places in placed]
    widths = [x * max(1.0, 6 / sum(widths)) for x in widths]
    depth = max(x for places in placed for place in places for x, _ in place.values()) + 1
    figure = Figure(figsize=(1.35 * sum(widths), 0.5 * depth + 2.7), layout="constrained")
    grid = figure.add_gridspec(2, len(stages), height_ratios=[0.9, 0.5 * depth + 1.1], width_ratios=widths)
    _paint_times(figure.add_subplot(grid[0, :]), stages)
    for k, (stage, places, columns) in enumerate(zip(stages, placed, widths, strict=True)):
        panel, at = figure.add_subplot(grid[1, k]), 0
        for robot, place in zip(stage.robots, places, strict=True):
            _paint(panel, robot, {i: (x, y + at) for i, (x, y) in place.items()}, down=True)
            at += width(place)
        panel.set_xlim(-0.3, columns - 0.1)
        panel.set_ylim(depth - 0.5, -1.2)
        wrapped = lambda text, columns=columns: "\n".join(textwrap.wrap(text, max(26, int(16 * columns))))
        have = " and ".join(f"{robot.name}, {robot.nv} degrees of freedom" for robot in stage.robots)
        panel.set_title(wrapped(f"{stage.name}: {have}"), fontsize=9, loc="left", backgroundcolor=TINTS[k % len(TINTS)])
        panel.text(-0.3, -0.45, wrapped(stage.change), fontsize=8, color=RED, va="bottom")
    figure.savefig(path, dpi=120)


def _paint_times(panel, stages):
    """The phases one after the other, each as long as it may be; solid as far as it must."""
    at = 0.0
    for k, stage in enumerate(stages):
        low, high = stage.duration
        panel.barh(0, high, left=at, color=TINTS[k % len(TINTS)], edgecolor="w")
        panel.barh(-0.4, low, left=at, height=0.12, color=BLUE)
        lasts = f"{low:g} s" if low == high else f"{low:g} to {high:g} s"
        panel.text(at + high / 2, 0.05, f"{stage.name}\n{lasts}", ha="center", va="center", fontsize=8)
        at += high
    panel.set_xlim(0, at)
    panel.set_yticks([])
    panel.spines[["left", "right", "top"]].set_visible(False)
    panel.set_xlabel("s, if all phases are as long as they may be; blue: as long as they must", fontsize=8)
    panel.tick_params(labelsize=8)


def _places(robot) -> dict[int, tuple[float, float]]:
    """Column (distance from the base) and row of each link; a link stands in the row of its first child."""
    children, column, row, free = _children(robot), {}, {}, 0
    for i in robot.tree.order:
        p = robot.tree.parent[i]
        column[i] = 0 if p < 0 else column[p] + 1
        if p >= 0 and children[p][0] == i:
            row[i] = row[p]
        else:
            row[i], free = free, free + 1
    return {i: (column[i], row[i]) for i in row}


def _paint(panel, robot, places, down=False):
    """Draw a tree that grows to the right, or down, with names where they then have room."""
    index = {link.name: i for i, link in enumerate(robot.links)}
    places = {i: (y, x) for i, (x, y) in places.items()} if down else places
    panel.invert_yaxis()
    panel.set_axis_off()
    for i, place in places.items():
        if robot.tree.parent[i] >= 0:
            _paint_joint(panel, robot, robot.joints[robot.tree.joint[i]], places[robot.tree.parent[i]], place, down)
    for loop in robot.loops:
        ends = [places[index[f.link]] for f in (loop.frame_a, loop.frame_b) if f.link in index]
        bow = {"arrowstyle": "-", "color": RED, "linestyle": "--", "connectionstyle": "arc3,rad=0.3"}
        if len(ends) == 2:
            panel.annotate("", ends[0], ends[1], arrowprops=bow)
        else:
            panel.plot(*ends[0], marker="s", markersize=15, markerfacecolor="none", color=RED)
    look = dict(xytext=(7, 3), ha="left", va="bottom") if down else dict(xytext=(0, -8), ha="center", va="top")
    for i, place in places.items():
        base = robot.links[i].name == robot.base
        panel.plot(*place, marker="s" if base and robot.grounded else "o", markersize=9, color=BLUE if base else INK)
        name = robot.links[i].name + _frames(robot, i).replace("  frame ", ", " if down else "\n")
        panel.annotate(name, place, textcoords="offset points", fontsize=6.5, **look)


def _paint_joint(panel, robot, joint, start, end, down):
    color, dashes = (GREY, ":") if robot.is_locked(joint) else (INK, "-")
    bend = (end[0], start[1] + 0.25) if down else (start[0] + 0.25, end[1])
    panel.plot(*zip(start, bend, end, strict=True), color=color, linestyle=dashes, zorder=0)
    kind = "locked" if joint.name in robot.locked else joint.kind
    text, at = (
        (f"{joint.name} {kind}", (end[0], end[1] - 0.5)) if down else (f"{joint.name}\n{kind}", (end[0] - 0.5, end[1]))
    )
    look = dict(xytext=(8, 0), ha="left") if down else dict(xytext=(0, 0), ha="center", backgroundcolor="w")
    panel.annotate(text, at, textcoords="offset points", va="center", fontsize=5.5, color=color, **look)
