"""Which body dynamics are best computed from: a base much lighter than what it carries loses all digits.

The inertia that a light base feels is the small difference of large ones. Seen from the heaviest body there is no such
difference: at a mass ratio of 1e8 errors fall from 4e-9 to 2e-15, and from garbage to 1e-6 in float32.
"""

SMALL = 1e-5
"""Share of the heaviest body's mass below which a base is too light. Down to there, one step of refinement restores
the digits in float64, see `aba.py`, and costs less: the other base takes 3.5 times as long (37 joints, batch 256)."""


def better_base(robot) -> str | None:
    """The link to compute from in place of a free base that is too light; None if the base will do."""
    if robot.grounded or len(robot.links) == 1:
        return None
    tree, body, mass = robot.tree, [0] * len(robot.links), {}
    for i in tree.order:
        alone = tree.parent[i] < 0 or robot.moves[tree.joint[i]]
        body[i] = i if alone else body[tree.parent[i]]
        mass[body[i]] = mass.get(body[i], 0.0) + robot.links[i].mass
    most = max(mass, key=mass.get)
    if mass[tree.order[0]] >= SMALL * mass[most]:
        return None
    return max((x for x, b in zip(robot.links, body, strict=True) if b == most), key=lambda x: x.mass).name
