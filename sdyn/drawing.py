"""Pictures of a structure: a tree for the terminal (rich) and one for a file (matplotlib)."""

from rich.table import Table
from rich.text import Text
from rich.tree import Tree

from sdyn.robot import Robot

GREY, BLUE, RED, INK = "#9A9A9A", "#0072B2", "#D55E00", "#222222"


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
        panel.set_title(f"{caption}: {summary(robot).partition(': ')[2]}", fontsize=9, loc="left")
        panel.set_xlim(-0.6, columns - 0.3)
    figure.savefig(path, dpi=120)


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


def _paint(panel, robot, places):
    index = {link.name: i for i, link in enumerate(robot.links)}
    panel.invert_yaxis()
    panel.set_axis_off()
    panel.set_ylim(max(y for _, y in places.values()) + 0.6, -0.6)
    for i, (x, y) in places.items():
        if robot.tree.parent[i] >= 0:
            _paint_joint(panel, robot, robot.joints[robot.tree.joint[i]], places[robot.tree.parent[i]], (x, y))
    for loop in robot.loops:
        ends = [places[index[f.link]] for f in (loop.frame_a, loop.frame_b) if f.link in index]
        bow = {"arrowstyle": "-", "color": RED, "linestyle": "--", "connectionstyle": "arc3,rad=0.3"}
        if len(ends) == 2:
            panel.annotate("", ends[0], ends[1], arrowprops=bow)
        else:
            panel.plot(*ends[0], marker="s", markersize=15, markerfacecolor="none", color=RED)
    for i, (x, y) in places.items():
        base = robot.links[i].name == robot.base
        panel.plot(x, y, marker="s" if base and robot.grounded else "o", markersize=9, color=BLUE if base else INK)
        name = robot.links[i].name + _frames(robot, i).replace("  frame ", "\n")
        panel.annotate(name, (x, y), (0, -8), textcoords="offset points", ha="center", va="top", fontsize=6.5)


def _paint_joint(panel, robot, joint, start, end):
    locked = robot.is_locked(joint)
    color, dashes = (GREY, ":") if locked else (INK, "-")
    panel.plot((start[0], start[0] + 0.25, end[0]), (start[1], end[1], end[1]), color=color, linestyle=dashes, zorder=0)
    text = f"{joint.name}\n" + ("locked" if joint.name in robot.locked else joint.kind)
    panel.annotate(
        text, (end[0] - 0.5, end[1]), ha="center", va="center", fontsize=5.5, color=color, backgroundcolor="w"
    )
