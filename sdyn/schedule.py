"""A static schedule of a tree: T steps of at most W bodies, each body in a later step than its parent."""


def schedule(parent: list[int], width: int) -> list[list[int]]:
    """List scheduling, longest remaining path first.

    Args:
        parent: Parent of each body, numbered parents first; -1 for the base.
        width: Bodies in a step, at least 1.

    Returns:
        Steps, each a list of at most `width` bodies.
    """
    height, children, ready = [1] * len(parent), [[] for _ in parent], []
    for i in reversed(range(len(parent))):
        if parent[i] >= 0:
            height[parent[i]] = max(height[parent[i]], height[i] + 1)
    for i, p in enumerate(parent):
        (children[p] if p >= 0 else ready).append(i)
    steps = []
    while ready:
        ready.sort(key=lambda i: -height[i])
        now, ready = ready[:width], ready[width:]
        steps.append(now)
        ready += [c for i in now for c in children[i]]
    return steps
