"""The spanning tree of a robot, seen from its base: depth first, children in the order their joints are declared."""

from dataclasses import dataclass

from sdyn.checks import RobotError


@dataclass(frozen=True)
class Tree:
    """Links numbered from the base outwards; every tuple is indexed by the declared number of a link."""

    order: tuple[int, ...]
    """Declared numbers of the links, parents first (the paper's numbering rule)."""
    parent: tuple[int, ...]
    """Declared number of the parent link; -1 for the base."""
    joint: tuple[int, ...]
    """Declared number of the joint to the parent; -1 for the base."""
    forward: tuple[bool, ...]
    """Whether that joint is declared from the tree's parent to this link."""


def span(links, joints, base: str) -> Tree:
    """The tree that the joints make of the links.

    Raises:
        RobotError: If a joint names an unknown link, or the joints do not form one tree.
    """
    index = {link.name: i for i, link in enumerate(links)}
    neighbours = [[] for _ in links]
    for j, joint in enumerate(joints):
        for end in (joint.parent, joint.child):
            if end not in index:
                raise RobotError(f"joint {joint.name!r} names the link {end!r}, which does not exist; add it.")
        p, c = index[joint.parent], index[joint.child]
        neighbours[p].append((j, c, True))
        neighbours[c].append((j, p, False))

    n = len(links)
    order, parent, via, forward = [], [-1] * n, [-1] * n, [True] * n
    seen, todo = [False] * n, [(index[base], -1, -1, True)]
    while todo:
        i, p, j, ahead = todo.pop()
        if seen[i]:
            raise RobotError(_cycle(links, joints, parent, i, p, j))
        seen[i], parent[i], via[i], forward[i] = True, p, j, ahead
        order.append(i)
        todo += [(c, i, k, f) for k, c, f in reversed(neighbours[i]) if k != j]
    if len(order) < n:
        apart = [link.name for i, link in enumerate(links) if not seen[i]]
        raise RobotError(
            f"the links {apart} are not connected to the base {base!r}; add a joint, or make them a robot of their own."
        )
    return Tree(tuple(order), tuple(parent), tuple(via), tuple(forward))


def _cycle(links, joints, parent, i, p, j) -> str:
    """The sentence that names a cycle: the joint that closes it, and the links on it."""

    def ancestors(k):
        path = [k]
        while parent[path[-1]] >= 0:
            path.append(parent[path[-1]])
        return path

    a, b = ancestors(i), ancestors(p)
    meet = next(k for k in a if k in b)
    around = [*a[: a.index(meet) + 1], *reversed(b[: b.index(meet)])]
    names = ", ".join(repr(links[k].name) for k in around)
    return (
        f"joint {joints[j].name!r} closes a cycle of the links {names}; the joints must form a tree. "
        f"Leave the joint out and close the loop with robot.close(...)."
    )
