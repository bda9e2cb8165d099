"""A static schedule of a tree: T steps of at most W bodies, each body in a later step than its parent."""

from heapq import heapify, heappop, heappush


def schedule(parent: list[int], width: int) -> list[list[int]]:
    """List scheduling, longest remaining path first, which for a tree takes the fewest steps (Hu 1961).

    Args:
        parent: Parent of each body, numbered parents first; -1 for the base.
        width: Bodies in a step, at least 1.

    Returns:
        Steps, each a list of at most `width` bodies.
    """
    height, children = [1] * len(parent), [[] for _ in parent]
    for i in reversed(range(len(parent))):
        if parent[i] >= 0:
            height[parent[i]] = max(height[parent[i]], height[i] + 1)
            children[parent[i]].append(i)
    ready = [(-height[i], i) for i, p in enumerate(parent) if p < 0]
    heapify(ready)
    steps = []
    while ready:
        now = [heappop(ready)[1] for _ in range(min(width, len(ready)))]
        steps.append(now)
        for i in now:
            for c in children[i]:
                heappush(ready, (-height[c], c))
    return steps
