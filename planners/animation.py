"""`plan.html`: one self-contained file that plays the motion of a plan in a browser, without network.

The scene is recorded with viser's serializer, which embeds its player and the data in one page. viser has no recorder
without a server, so one listens on the local machine while the file is made; it is stopped before `write` returns.
"""

import contextlib
import html
import re
from pathlib import Path

import numpy as np

from planners import solids
from planners.motion import continuous, follow, quaternions, rotations
from planners.shapes import ORANGE, Shape, extent, keep_out, robot_shapes

FRAMES_PER_SECOND = 25.0
MAX_FRAMES = 1500  # of a long plan; what is slow looks smooth with fewer
BACKGROUND = (10, 12, 20)
THIN = 0.03  # m, of a spike
BLUE, RED = (60, 150, 230), (240, 90, 60)
VISIBLE = 2e-4  # m, and part of a quaternion: what moves less since it was last drawn is not drawn again


def write(plan, path) -> None:
    """Write the animation of a plan.

    Args:
        plan: A `Plan`.
        path: The html file; an existing one is replaced at the end, so a failure leaves it as it was.
    """
    path = Path(path)
    page = _page(plan)
    unfinished = path.with_name(f".{path.name}.unfinished")
    unfinished.write_text(page, encoding="utf-8")
    unfinished.replace(path)


def frame_times(plan) -> np.ndarray:
    """The times of the frames [s]: the plan's span at 25 frames a second, fewer if the plan is long."""
    start, end = plan.phases[0].times[0], plan.phases[-1].times[-1]
    count = int(np.clip((end - start) * FRAMES_PER_SECOND, 2, MAX_FRAMES))
    return np.linspace(start, end, count + 1)


def tracks(plan, times: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """The motion of every link at the given times: present [k], quaternions wxyz [k, 4], positions [k, 3] (m)."""
    out = {}
    for phase, now, pair in zip(plan.phases, _phase_masks(plan, times), follow(plan), strict=True):
        for motion in filter(None, pair):
            for i, link in enumerate(motion.robot.links):
                new = (np.zeros(len(times), bool), np.zeros((len(times), 4)), np.zeros((len(times), 3)))
                present, quaternion, position = out.setdefault(link.name, new)
                present |= now
                quaternion[now], position[now] = _at(times[now], phase.times, motion.R[:, i], motion.p[:, i])
    return out


def _phase_masks(plan, times) -> list[np.ndarray]:
    """Which of the times fall into each phase; a switching time belongs to the phase that begins."""
    starts = np.array([phase.times[0] for phase in plan.phases])
    number = np.clip(np.searchsorted(starts, times, side="right") - 1, 0, None)
    return [number == k for k in range(len(starts))]


def _at(times, grid, R, p):
    """Rotations and positions on a grid, interpolated: quaternions wxyz [k, 4], positions [k, 3]."""
    quaternion = continuous(quaternions(R))
    mix = lambda x: np.column_stack([np.interp(times, grid, column) for column in x.T])
    q = mix(quaternion)
    return q / np.linalg.norm(q, axis=1, keepdims=True), mix(p)


# -- the page ----------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _server():
    """A viser server that only this machine can reach, started and stopped without a word."""
    import viser  # takes a second

    with _silence():
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        yield server
    finally:
        with _silence():
            server.stop()


@contextlib.contextmanager
def _silence():
    """Nothing on rich's console, through which viser speaks in terminals and in notebooks."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


def _page(plan) -> str:
    times = frame_times(plan)
    motion = tracks(plan, times)
    shapes = _shapes(plan)
    parents = _parents(plan)
    with _server() as server:
        low, high = _bounds(motion, shapes)
        _place_camera(server.initial_camera, low, high)
        nodes = _build(server.scene, shapes, parents)
        for shape in _goal(plan.task, shapes):
            _add(server.scene, "/goal", shape)
        spikes = _spikes(server.scene, plan, times, 2 * extent(shapes[plan.phases[0].robot.base]))
        labels = _labels(server.scene, plan, ((low + high) / 2)[:2], high[2])
        recorder = server.get_scene_serializer()
        moves = {name: _seen_from(motion.get(parents[name]), motion[name]) for name in motion}
        _play(recorder, times, moves, nodes, labels, _phase_masks(plan, times), spikes)
        page = recorder.as_html(dark_mode=True)
    return _with_heading(page, plan)


def _shapes(plan) -> dict:
    """The solids of every link of the plan; the chaser's look wins over that of the compound."""
    shapes = {}
    for phase in plan.phases:
        shapes = {**robot_shapes(phase.robot), **shapes}
    for body in filter(None, (plan.task.body, plan.task.load_body)):
        shapes |= robot_shapes(body, ORANGE, panels=True)
    for solid in plan.task.shapes.values():
        shapes[solid.link] = [*shapes[solid.link], *keep_out(solid)]
    return shapes


def _goal(task, shapes) -> list[Shape]:
    """What shows where a reach is to end, world axes: the hand's axes, larger; a ball where any orientation will do."""
    if task.goal is None:
        return []
    longest = max(shape.size[0] for own in shapes.values() for shape in own if shape.kind == "axes")
    place = np.array(task.goal.position)
    if task.goal.quaternion is None:
        return [Shape("ball", (longest / 2,), place, color=ORANGE, opacity=0.5)]
    return [Shape("axes", (2 * longest,), place, rotations(np.array([task.goal.quaternion]))[0])]


def _parents(plan) -> dict[str, str | None]:
    """The link that each link hangs on in the scene: joints that rest then need no data. None: the world."""
    parents = {}
    for phase in plan.phases:
        if phase.passive:
            parents |= dict.fromkeys((link.name for link in phase.passive[0].links), None)
    for phase in plan.phases:
        robot = phase.robot
        for link, p in zip(robot.links, robot.tree.parent, strict=True):
            parents.setdefault(link.name, robot.links[p].name if p >= 0 and phase is plan.phases[0] else None)
    return parents


def _seen_from(parent, child):
    """The motion of a link seen from another: present [k], quaternions [k, 4], positions [k, 3] (m)."""
    if parent is None:
        return child
    present, (w, x, y, z), p = parent[0] & child[0], parent[1].T, parent[2]
    inverse = np.stack([[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]]).transpose(2, 0, 1)
    R = rotations(parent[1])
    return present, continuous((inverse @ child[1][..., None])[..., 0]), np.einsum("kji,kj->ki", R, child[2] - p)


def _bounds(motion, shapes) -> tuple[np.ndarray, np.ndarray]:
    """The corners of a box that holds all bodies at all times [m]."""
    reach = {name: extent(shapes[name]) for name in motion}
    low = np.min([p[present].min(axis=0) - reach[name] for name, (present, _, p) in motion.items()], axis=0)
    high = np.max([p[present].max(axis=0) + reach[name] for name, (present, _, p) in motion.items()], axis=0)
    return low, high


def _place_camera(camera, low, high):
    """Look at the middle of a box across its longer side, a little from above, and far enough to see all of it."""
    middle, half = (low + high) / 2, (high - low) / 2
    aside = np.array([0.0, -1.0, 0.0]) if half[0] >= half[1] else np.array([1.0, 0.0, 0.0])
    back = aside + np.array([0.35, 0.2, 0.45])
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right = right / np.linalg.norm(right)
    corners = half * [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    camera.fov = np.radians(40.0)
    slope = 1.15 * np.tan(camera.fov / 2)  # of what is seen above the middle; the box is roomy, the window wide
    across, up, near = (np.abs(corners @ right) / 1.3, np.abs(corners @ np.cross(back, right)), corners @ back)
    camera.look_at = middle
    camera.position = middle + np.max(np.maximum(across, up) / slope + near) * back


def _build(scene, shapes, parents) -> dict:
    """The solids, each under the node of its link; returns the nodes."""
    scene.set_background_image(np.full((4, 4, 3), BACKGROUND, np.uint8), format="png")
    paths, nodes = {None: ""}, {}
    for name in _outwards(parents):
        paths[name] = f"{paths[parents[name]]}/{name}"
        nodes[name] = scene.add_frame(paths[name], show_axes=False)
        for k, shape in enumerate(shapes[name]):
            _add(scene, f"{paths[name]}/{k}", shape)
    return nodes


def _outwards(parents):
    """The names, each after its parent."""
    depth = lambda name: 0 if name is None else 1 + depth(parents[name])
    return sorted(parents, key=depth)


def _add(scene, name, shape):
    place = {"position": shape.position, "wxyz": quaternions(shape.rotation)}
    look = {"color": shape.color, "opacity": shape.opacity, "cast_shadow": False, "receive_shadow": False}
    if shape.kind == "box":
        scene.add_box(name, dimensions=shape.size, **look, **place)
    elif shape.kind == "cylinder":
        scene.add_cylinder(name, radius=shape.size[0], height=shape.size[1], **look, **place)
    elif shape.kind == "ball":
        scene.add_icosphere(name, radius=shape.size[0], **look, **place)
    elif shape.kind == "ellipsoid":
        scene.add_icosphere(name, scale=shape.size, **look, **place)
    else:
        scene.add_frame(name, axes_length=shape.size[0], axes_radius=0.06 * shape.size[0], **place)


def _spikes(scene, plan, times, longest) -> list:
    """Spikes from the base's origin along the force and along the moment that push it, as long as the part of the limit
    that is used: (handle, vectors [k, 3]) each; none where nothing can push.
    """
    if plan.task.base is None:
        return []
    parts = np.zeros((len(times), 6))
    for phase, now in zip(plan.phases, _phase_masks(plan, times), strict=True):
        parts[now] = np.stack([np.interp(times[now], phase.times, x) for x in phase.tau[:, :6].T], axis=1)
    parts = longest * parts / np.maximum(plan.task.base_limits, 1e-300)
    looks = zip(("moment", "force"), (BLUE, RED), np.split(parts, 2, axis=1), strict=True)
    node = f"/{plan.phases[0].robot.base}/"
    return [(scene.add_icosphere(node + name, radius=0.5, color=color), x) for name, color, x in looks if x.any()]


def _along(x):
    """Rotation that turns the z axis along x [3]."""
    z = x / np.linalg.norm(x)
    aside = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    y = aside / np.linalg.norm(aside)
    return np.stack([np.cross(y, z), y, z], axis=1)


def _labels(scene, plan, middle, top) -> list:
    """A label for each phase, above the scene; it is shown in its phase only."""
    look = {"position": (*middle, top), "anchor": "bottom-center", "font_screen_scale": 1.5, "visible": False}
    spans = [f"{phase.name}, {phase.times[0]:.1f} to {phase.times[-1]:.1f} s" for phase in plan.phases]
    if plan.task.clearance:
        spans = [f"{text}, clearance {d:.3f} m" for text, d in zip(spans, _closest(plan), strict=True)]
    return [scene.add_label(f"/phase {k}", text, **look) for k, text in enumerate(spans)]


def _closest(plan):
    """Least distance in each phase of the shapes that are not in contact."""
    kept = solids.least(plan.task) == plan.task.clearance.distance
    return [solids.apart(plan.task, *pair)[:, kept].min() for pair in follow(plan)]


def _play(recorder, times, motion, nodes, labels, masks, spikes):
    """Record the motion, frame by frame; a body that rests sends nothing."""
    shown = {}

    def put(handle, key, value, slack=0.0):
        where, numbers = (handle.name, key), np.asarray(value, float)
        if where not in shown or np.abs(shown[where] - numbers).max() > slack:
            setattr(handle, key, value)
            shown[where] = numbers

    for k in range(len(times)):
        for label, mask in zip(labels, masks, strict=True):
            put(label, "visible", bool(mask[k]))
        for name, (present, quaternion, position) in motion.items():
            put(nodes[name], "visible", bool(present[k]))
            if present[k]:
                put(nodes[name], "wxyz", quaternion[k], VISIBLE)
                put(nodes[name], "position", position[k], VISIBLE)
        for spike, vectors in spikes:
            length = np.linalg.norm(vectors[k])
            put(spike, "visible", bool(length > THIN))
            if length > THIN:
                put(spike, "wxyz", quaternions(_along(vectors[k])), VISIBLE)
                put(spike, "position", vectors[k] / 2, VISIBLE)
                put(spike, "scale", (THIN, THIN, float(length)), VISIBLE)
        recorder.insert_sleep(float(times[min(k + 1, len(times) - 1)] - times[k]))


def _with_heading(page: str, plan) -> str:
    """The page with the task's name in its title and over the scene."""
    text = html.escape(f"{plan.task.name}: {plan.status}")
    style = "position:fixed;right:1em;top:.7em;z-index:9;color:#ddd;font:15px sans-serif;pointer-events:none"
    page = re.sub(r"<title>.*?</title>", f"<title>{text}</title>", page, count=1, flags=re.DOTALL)
    end = page.rindex("</body>")
    return f'{page[:end]}<div style="{style}">{text}</div>{page[end:]}'
