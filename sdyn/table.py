"""The paper's connectivity table: link, parent, end-effector, connect, cflag.

`base=0` is the style of Table II (the base is 0 and not listed), `base=1` that of Table III (the base is row 1).
`connect` counts the links of the locked run that a link belongs to; `cflag(j) = i` says that link j is joined to
link i by a loop, 0 to ground, -1 not at all. `merged=True` shows each group of locked links as one body.
"""

from collections import Counter
from typing import NamedTuple


class Row(NamedTuple):
    """One row of the table."""

    link: int
    parent: int
    end_effector: int
    connect: int
    cflag: int


class Table(tuple):
    """Rows of the table; `names` holds the link of each row, `str()` prints it."""

    names: tuple[str, ...]

    def __new__(cls, rows, names):
        self = super().__new__(cls, rows)
        self.names = tuple(names)
        return self

    def __str__(self):
        titles = ("link", "parent", "end-effector", "connect", "cflag", "name")
        cells = [(*map(str, row), name) for row, name in zip(self, self.names, strict=True)]
        width = [max(map(len, column)) for column in zip(titles, *cells, strict=True)]
        line = lambda row: "  ".join(x.rjust(w) for x, w in zip(row[:-1], width[:-1], strict=True)) + "  " + row[-1]
        return "\n".join(line(row) for row in (titles, *cells))


def table(robot, base: int = 0, merged: bool = False) -> Table:
    """The connectivity table of a robot, numbered along its tree from the base."""
    tree, n = robot.tree, len(robot.links)
    locked = [tree.joint[i] >= 0 and robot.is_locked(robot.joints[tree.joint[i]]) for i in range(n)]
    head = list(range(n))  # the link that stands for each body
    run = list(range(n))  # the first link of each locked run
    for i in tree.order:
        p = tree.parent[i]
        if locked[i]:
            run[i] = run[p] if locked[p] else i
            head[i] = head[p] if merged else i
    length = Counter(run[i] for i in range(n) if locked[i])

    shown = [i for i in tree.order if head[i] == i]
    number = {i: base + k for k, i in enumerate(shown)}
    parent = {i: number[head[tree.parent[i]]] if tree.parent[i] >= 0 else 0 for i in shown}
    index = {link.name: i for i, link in enumerate(robot.links)}
    inner = {head[tree.parent[i]] for i in shown if tree.parent[i] >= 0}
    carries = {head[index[frame.link]] for frame in robot.frames}
    tips = [i for i in shown if i not in inner and i in carries]
    joined = _cflags(robot, lambda name: 0 if name == "ground" else number[head[index[name]]])

    rows, names = [], []
    for i in shown:
        if base == 0 and i == shown[0]:
            continue
        connect = 0 if merged or not locked[i] else length[run[i]]
        tip = tips.index(i) + 1 if i in tips else 0
        rows.append(Row(number[i], parent[i], tip, connect, joined.get(number[i], -1)))
        names.append(robot.links[i].name)
    return Table(rows, names)


def _cflags(robot, number) -> dict[int, int]:
    """Of the two links of each loop, the one with the larger number points to the other."""
    ends = [sorted((number(loop.frame_a.link), number(loop.frame_b.link))) for loop in robot.loops]
    return {high: low for low, high in reversed(ends)}
