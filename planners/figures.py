"""PNG figures of a plan, with matplotlib's own objects: no window, no global state.

In every figure the phases are tinted bands, named in the legend; limits are dashed.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

import sdyn
from planners import solids
from planners.motion import continuous, follow, quaternions

BLUE, RED, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#A0A0A0"  # Okabe and Ito's palette
BANDS = ("#E8E8E8", "#DCEBF7", "#FCE9CF", "#DDF1E7", "#F4E3EE")
ROUNDING = 1e-9  # of the largest momentum: less is drawn as none
FAR = 5.0  # a limit this many times beyond the curve is named, not drawn


def draw(plan, folder) -> list[Path]:
    """Draw all figures of a plan.

    Args:
        plan: A `Plan`.
        folder: Where the files go; existing ones are replaced.

    Returns:
        The paths of the files.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    figures = {f"joint_{what}": joints(plan, what) for what in QUANTITIES}
    motions = follow(plan)
    figures |= {"base": base(plan, motions), "momentum": momenta(plan, motions)}
    if plan.task.kind == "grasp":
        figures["grasp"] = grasp(plan, motions)
        if plan.task.clearance:
            figures["clearance"] = clearance(plan, motions)
    if plan.task.base:
        figures["wrench"] = wrench(plan)
    if plan.task.kind == "identify":
        figures |= {"gyro": gyro(plan, motions), "information": information(plan)}
    paths = []
    for name, figure in figures.items():
        paths.append(folder / f"{name}.png")
        figure.savefig(paths[-1], dpi=110)
    return paths


# -- joints ------------------------------------------------------------------------------------------------------------

QUANTITIES = {  # title, where it is, unit of a slide and of a turn
    "angles": ("Joint positions", "q", ("m", "rad")),
    "rates": ("Joint rates", "v", ("m/s", "rad/s")),
    "torques": ("Joint torques", "tau", ("N", "N m")),
}
SLIDES = (".slide", ".x", ".y")


def joints(plan, what: str) -> Figure:
    """One panel for each joint coordinate: `what` is angles, rates or torques."""
    title, key, units = QUANTITIES[what]
    bounds = _bounds(plan.task, what)
    names = list(dict.fromkeys(name for phase in plan.phases for name in _coordinates(phase.robot, key)))
    figure, panels = _sheet(plan, title, len(names), dashed="limit")
    for panel, name in zip(panels, names, strict=True):
        curves = []
        for phase in plan.phases:
            have = _coordinates(phase.robot, key)
            if name in have:
                curves.append((phase.times, getattr(phase, key)[:, have[name]]))
        for times, values in curves:
            panel.plot(times, values, color=BLUE, linewidth=1.3)
        joint = _joint_of(plan.phases[0].robot, name)
        unit = units[0] if joint.kind == "prismatic" or name.endswith(SLIDES) else units[1]
        panel.set_title(name, fontsize=9, loc="left")
        panel.set_ylabel(unit, fontsize=8)
        _limits(panel, np.concatenate([values for _, values in curves]), bounds.get(name))
    return figure


def _coordinates(robot, key) -> dict[str, int]:
    """Name and index of each coordinate of the joints, without the base."""
    names = robot.q_names if key == "q" else robot.v_names
    skip = 0 if robot.grounded else 7 if key == "q" else 6
    return {name: k for k, name in enumerate(names) if k >= skip}


def _joint_of(robot, coordinate) -> sdyn.Joint:
    """The joint that a coordinate belongs to."""
    return robot.joint(coordinate if coordinate in {j.name for j in robot.joints} else coordinate.rpartition(".")[0])


def _bounds(task, what) -> dict[str, tuple[float, float]]:
    """(lower, upper) for each joint of the task."""
    if what == "angles":
        pairs = task.position_limits
    else:
        most = task.rate_limits if what == "rates" else task.torque_limits
        pairs = np.column_stack([-most, most])
    return {joint.name: tuple(pair) for joint, pair in zip(task.joints, pairs, strict=True)}


def _limits(panel, values, pair):
    """Dash the limits that are near the curve; name those that are far off."""
    low, high = float(values.min()), float(values.max())
    finite = [x for x in pair or () if np.isfinite(x)]
    size = max(abs(low), abs(high), 1e-12)
    near = [x for x in finite if abs(x) <= FAR * size]
    for x in near:
        panel.axhline(x, color=RED, linestyle="--", linewidth=1.0)
    far = [x for x in finite if abs(x) > FAR * size]
    if far:
        same = len(far) == 2 and np.isclose(far[0], -far[1])
        text = f"\u00b1{far[1]:.3g}" if same else " and ".join(f"{x:.3g}" for x in far)
        panel.text(0.99, 0.97, f"limit {text}", transform=panel.transAxes, ha="right", va="top", fontsize=7, color=RED)
    low, high = min([low, *near]), max([high, *near])
    room = 0.08 * max([high - low, 1e-9, *(1e-3 * abs(x) for x in finite)])  # what is nearly zero looks so
    panel.set_ylim(low - room, high + (2.5 * room if far else room))


# -- base and momentum -------------------------------------------------------------------------------------------------


def base(plan, motions) -> Figure:
    """Position, attitude and angular velocity of the base, against its start."""
    name = plan.phases[0].robot.base
    figure, panels = _sheet(plan, f"Motion of the base, {name!r}", 3, columns=1, height=2.0, lines="xyz")
    zero = None
    for phase, (robot, _) in zip(plan.phases, motions, strict=True):
        R, p, twist = robot.of(sdyn.Frame("base", name))
        w = np.einsum("kji,kj->ki", R, twist[:, :3])
        zero = zero or (R[0], p[0])
        for panel, values in zip(panels, (p - zero[1], rotation_vectors(zero[0].T @ R), w), strict=True):
            _components(panel, phase.times, values)
    for panel, title, unit in zip(
        panels,
        ("Position, world axes, from the start", "Rotation vector from the start", "Angular velocity, base axes"),
        ("m", "rad", "rad/s"),
        strict=True,
    ):
        panel.set_title(title, fontsize=9, loc="left")
        panel.set_ylabel(unit, fontsize=8)
    return figure


def wrench(plan) -> Figure:
    """Moment and force on the base, its axes; moments alone where only its attitude is controlled."""
    count = 3 if plan.task.base.force is None else 6
    figure, panels = _sheet(plan, "What pushes the base", count, columns=3, height=2.3, dashed="limit")
    titles = [f"{what} {axis}" for what in ("torque about", "force along") for axis in "xyz"]
    for k, (panel, title, most) in enumerate(zip(panels, titles, plan.task.base_limits, strict=False)):
        curves = [(phase.times, phase.tau[:, k]) for phase in plan.phases]
        for times, values in curves:
            panel.plot(times, values, color=BLUE, linewidth=1.3)
        panel.set_title(title, fontsize=9, loc="left")
        _limits(panel, np.concatenate([values for _, values in curves]), (-most, most))
    for panel, unit in zip(panels[::3], ("N m", "N"), strict=False):
        panel.set_ylabel(unit, fontsize=8)
    return figure


def momenta(plan, motions) -> Figure:
    """Momentum of the chaser and of the target, or of the base and of the other links, and in total."""
    caught = {link.name for link in plan.task.body.links} if plan.task.body else set()
    base = plan.phases[0].robot.base
    lines = dict(zip(shares(motions[0], caught, base), (BLUE, RED, GREY), strict=True))
    figure, panels = _sheet(
        plan, "Momentum, world axes, angular about the origin", 6, columns=3, height=2.3, lines=lines
    )
    for phase, pair in zip(plan.phases, motions, strict=True):
        for name, values in shares(pair, caught, base).items():
            for panel, column in zip(panels, (3, 4, 5, 0, 1, 2), strict=True):
                under = {"linewidth": 4.0, "zorder": 1.5} if name == "total" else {"linewidth": 1.3}
                panel.plot(phase.times, values[:, column], color=lines[name], **under)
    largest = max(np.abs(panel.get_ylim()).max() for panel in panels)
    for panel, axis in zip(panels, "xyzxyz", strict=True):
        panel.set_title(axis, fontsize=9, loc="left")
        if np.abs(panel.get_ylim()).max() < ROUNDING * largest:
            panel.set_ylim(-largest, largest)
    panels[0].set_ylabel("linear, N s", fontsize=8)
    panels[3].set_ylabel("angular, N m s", fontsize=8)
    return figure


def shares(pair, caught, base) -> dict[str, np.ndarray]:
    """Momentum [k, 6] of the chaser, of the target and in total; of a robot alone, of its base and its other links.

    Args:
        pair: Motion of the robot, and of the target as long as it is apart.
        caught: Names of the target's links.
        base: Name of the robot's base.
    """
    robot, target = pair
    links = {link.name for link in robot.robot.links}
    if not caught:
        own, other = robot.momentum([base]), robot.momentum(sorted(links - {base}))
        return {"base": own, "other links": other, "total": own + other}
    own, other = robot.momentum(sorted(links - caught)), (target or robot).momentum(sorted(caught))
    return {"chaser": own, "target": other, "total": own + other}


# -- grasp -------------------------------------------------------------------------------------------------------------


def grasp(plan, motions) -> Figure:
    """Distance, angle and relative velocity between the hand and the grasp frame, up to the grasp."""
    figure, panels = _sheet(
        plan, "Hand and grasp frame, until the grasp", 4, height=2.3, dashed="tolerance of tracking"
    )
    tolerance = plan.task.tolerance
    before = [phase for phase in plan.phases if phase.passive]
    for phase, (robot, target) in zip(before, motions, strict=False):
        for panel, values in zip(panels, separation(plan.task, robot, target), strict=True):
            panel.semilogy(phase.times, np.maximum(values, 1e-16), color=BLUE, linewidth=1.3)
    bounds = (tolerance.position, tolerance.angle, tolerance.speed, None)
    titles = ("Distance", "Angle", "Relative speed", "Relative angular speed")
    for panel, title, unit, most in zip(panels, titles, ("m", "rad", "m/s", "rad/s"), bounds, strict=True):
        panel.set_title(title, fontsize=9, loc="left")
        panel.set_ylabel(unit, fontsize=8)
        panel.set_xlim(before[0].times[0], before[-1].times[-1])
        tracking = [phase for phase in before if phase.name == "track"]
        if most and tracking:
            panel.hlines(most, tracking[0].times[0], tracking[0].times[-1], color=RED, linestyle="--", linewidth=1.2)
        low, high = panel.get_ylim()
        panel.set_ylim(max(low, 1e-9 * high), high)
    return figure


def clearance(plan, motions) -> Figure:
    """Distance of every pair of shapes that keep apart, and the least that it may be."""
    task = plan.task
    names, least = solids.pairs(task), solids.least(task)
    figure, panels = _sheet(plan, "Clearance", len(names), dashed="least")
    curves = [solids.apart(task, *pair) for pair in motions]
    for k, (panel, (a, b)) in enumerate(zip(panels, names, strict=True)):
        for phase, values in zip(plan.phases, curves, strict=True):
            panel.plot(phase.times, values[:, k], color=BLUE, linewidth=1.3)
        panel.axhline(least[k], color=RED, linestyle="--", linewidth=1.0)
        panel.set_title(f"{a} from {b}: at least {min(x[:, k].min() for x in curves):.3f} m", fontsize=9, loc="left")
        panel.set_ylabel("m", fontsize=8)
    return figure


def separation(task, robot, target) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Between hand and target: distance [m], angle [rad], relative speed [m/s] and angular speed [rad/s], each [k]."""
    R_H, p_H, v_H = robot.of(robot.robot.frame(task.robot.frame))
    R_T, p_T, v_T = target.of(target.robot.frame(f"target_{task.target.frame}"))
    gap = p_T - p_H
    relative = v_T - v_H
    relative[:, 3:] -= np.cross(v_H[:, :3], gap)  # seen from the hand
    turn = rotation_vectors(np.einsum("kji,kjl->kil", R_H, R_T))
    return tuple(np.linalg.norm(x, axis=1) for x in (gap, turn, relative[:, 3:], relative[:, :3]))


# -- identify ----------------------------------------------------------------------------------------------------------


def gyro(plan, motions) -> Figure:
    """What a gyro on the base reads, without its noise, which the title tells."""
    noise, name = plan.task.sensors.gyro, plan.phases[0].robot.base
    title = f"Angular velocity of {name!r}, own axes" + (f"; the gyro's noise is {noise:g} rad/s" if noise else "")
    figure, panels = _sheet(plan, title, 3)
    for phase, (robot, _) in zip(plan.phases, motions, strict=True):
        R, _, twist = robot.of(sdyn.Frame("gyro", name))
        for panel, values in zip(panels, np.einsum("kji,kj->ik", R, twist[:, :3]), strict=True):
            panel.plot(phase.times, values, color=BLUE, linewidth=1.3)
    for panel, axis in zip(panels, "xyz", strict=True):
        panel.set_title(axis, fontsize=9, loc="left")
        panel.set_ylabel("rad/s", fontsize=8)
    return figure


CRITERIA = ("log_det", "trace_of_inverse", "smallest_eigenvalue", "condition_number")


def information(plan) -> Figure:
    """How well the manoeuvre tells the parameters: standard deviations, singular values, and the usual criteria."""
    found = plan.info["results"]
    figure = Figure(figsize=(10.0, max(4.2, 0.28 * len(found["singular_values"]))), layout="constrained")
    left, right = figure.subplots(1, 2)
    deviations = found.get("sigma_percent")
    if deviations:
        bars = left.barh(list(deviations), list(deviations.values()), color=BLUE)
        left.bar_label(bars, fmt="%.2g", padding=3, fontsize=8)
        left.set_xscale("log")
        left.margins(x=0.15)
        left.invert_yaxis()
    else:
        left.set_axis_off()
        left.text(0.0, 0.5, found["subspace"], wrap=True, fontsize=9)
    left.set_title("Standard deviation of each parameter (Cramer-Rao), %", fontsize=9, loc="left")
    values = found["singular_values"]
    right.semilogy(range(1, len(values) + 1), values, "o", color=BLUE)
    right.set_xticks(range(1, len(values) + 1))
    right.set_title("Singular values of the scaled measurements", fontsize=9, loc="left")
    right.set_xlabel("direction", fontsize=8)
    said = [f"{name.replace('_', ' ')}: {found[name]:.4g}" for name in CRITERIA if found.get(name) is not None]
    right.text(0.99, 0.97, "\n".join(said), transform=right.transAxes, ha="right", va="top", fontsize=8)
    for panel in (left, right):
        panel.tick_params(labelsize=8)
        panel.spines[["top", "right"]].set_visible(False)
    figure.suptitle("Information about the parameters", fontsize=12, x=0.01, ha="left", fontweight="bold")
    return figure


# -- layout ------------------------------------------------------------------------------------------------------------


def rotation_vectors(R: np.ndarray) -> np.ndarray:
    """Rotation vectors [k, 3] (rad) of rotation matrices [k, 3, 3], without jumps along k."""
    q = continuous(quaternions(R))
    q = q if q[0, 0] >= 0 else -q
    size = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(size, q[:, :1])
    return np.where(size > 1e-12, angle / np.maximum(size, 1e-300), 2.0) * q[:, 1:]


def _sheet(plan, title, count, *, columns=None, height=1.7, lines=None, dashed=None):
    """A figure with `count` panels over time, the phases tinted, and one legend for all."""
    columns = columns or (1 if count <= 3 else 2 if count <= 8 else 3)
    rows = -(-count // columns)
    figure = Figure(figsize=(10.0, 0.9 + height * rows), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
    panels = list(grid.flat)
    for panel in panels[count:]:
        panel.remove()
    for panel in panels[:count]:
        panel.tick_params(labelsize=8)
        panel.grid(color="white", linewidth=0.8)
        panel.set_axisbelow(True)
        for tint, phase in zip(_tints(plan), plan.phases, strict=True):
            panel.axvspan(phase.times[0], phase.times[-1], color=tint, linewidth=0, zorder=0)
        for spine in ("top", "right"):
            panel.spines[spine].set_visible(False)
        panel.margins(x=0)
    for panel in panels[max(count - columns, 0) : count]:
        panel.tick_params(labelbottom=True)
    figure.supxlabel("time, s", fontsize=9)
    handles = _legend(plan, lines, dashed)
    text = {"title_fontproperties": {"size": 12, "weight": "bold"}, "fontsize": 9, "alignment": "left"}
    figure.legend(handles=handles, loc="outside upper left", ncols=len(handles), frameon=False, title=title, **text)
    return figure, panels[:count]


def _tints(plan):
    return [BANDS[k % len(BANDS)] for k in range(len(plan.phases))]


def _legend(plan, lines, dashed):
    """Handles for curves, limits and phases."""
    lines = dict(zip("xyz", (BLUE, RED, GREEN), strict=True)) if lines == "xyz" else lines or {}
    curves = [Line2D([], [], color=color, label=name) for name, color in lines.items()]
    limits = [Line2D([], [], color=RED, linestyle="--", label=dashed)] if dashed else []
    bands = [Patch(color=tint, label=phase.name) for tint, phase in zip(_tints(plan), plan.phases, strict=True)]
    return curves + limits + bands


def _components(panel, times, values):
    for color, column in zip((BLUE, RED, GREEN), values.T, strict=True):
        panel.plot(times, column, color=color, linewidth=1.3)
