"""`plan.html`: one self-contained file that plays the motion of a plan in a browser, without network.

The scene is recorded with viser's serializer, which embeds its player and the data in one page. viser has no recorder
without a server, so one listens on the local machine while the file is made; it is stopped before `write` returns.
"""

import contextlib
import html
import io
import re
from pathlib import Path

import numpy as np

from planners.motion import continuous, link_poses, quaternions
from planners.shapes import ORANGE, robot_shapes

FRAMES_PER_SECOND = 25.0
MAX_FRAMES = 1500  # of a long plan; what is slow looks smooth with fewer
BACKGROUND = (10, 12, 20)


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
    for phase, now in zip(plan.phases, _phase_masks(plan, times), strict=True):
        bodies = [(phase.robot, phase.q), *([phase.passive[:2]] if phase.passive else [])]
        for robot, q in bodies:
            R, p = link_poses(robot, q)
            for i, link in enumerate(robot.links):
                new = (np.zeros(len(times), bool), np.zeros((len(times), 4)), np.zeros((len(times), 3)))
                present, quaternion, position = out.setdefault(link.name, new)
                present |= now
                quaternion[now], position[now] = _at(times[now], phase.times, R[:, i], p[:, i])
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

    silence = lambda: contextlib.redirect_stdout(io.StringIO())
    with silence():
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        yield server
    finally:
        with silence():
            server.stop()


def _page(plan) -> str:
    times = frame_times(plan)
    motion = tracks(plan, times)
    with _server() as server:
        _place_camera(server, motion)
        nodes = _build(server.scene, plan, motion)
        labels = _labels(server.scene, plan, motion)
        recorder = server.get_scene_serializer()
        _play(recorder, times, motion, nodes, labels, _phase_masks(plan, times))
        page = recorder.as_html(dark_mode=True)
    return _with_heading(page, plan)


def _place_camera(server, motion):
    """Look at the scene's middle from aside and a little above, far enough to see all of it."""
    paths = [p[present] for present, _, p in motion.values()]
    low = np.min([p.min(axis=0) for p in paths], axis=0)
    high = np.max([p.max(axis=0) for p in paths], axis=0)
    middle = (low + high) / 2
    reach = np.max([np.linalg.norm(p - middle, axis=1).max() for p in paths]) + 0.6
    spread = (high - low) * [1.0, 1.0, 0.0]
    aside = np.array([0.0, -1.0, 0.0]) if spread[0] >= spread[1] else np.array([1.0, 0.0, 0.0])
    view = aside + np.array([0.35, 0.2, 0.45])
    camera = server.initial_camera
    camera.fov = np.radians(40.0)
    camera.look_at = middle
    camera.position = middle + reach / np.sin(camera.fov / 2) * view / np.linalg.norm(view)


def _build(scene, plan, motion) -> dict:
    """The solids, each under the node of its link; returns the nodes."""
    scene.set_background_image(np.full((4, 4, 3), BACKGROUND, np.uint8), format="png")
    shapes = {}
    for phase in plan.phases:
        shapes = {**robot_shapes(phase.robot), **shapes}
        if phase.passive:
            shapes |= robot_shapes(phase.passive[0], ORANGE, panels=True)
    nodes = {}
    for name, (present, quaternion, position) in motion.items():
        place = {"wxyz": quaternion[0], "position": position[0], "visible": bool(present[0])}
        nodes[name] = scene.add_frame(f"/{name}", show_axes=False, **place)
        for k, shape in enumerate(shapes[name]):
            _add(scene, f"/{name}/{k}", shape)
    return nodes


def _add(scene, name, shape):
    place = {"position": shape.position, "wxyz": quaternions(shape.rotation)}
    look = {"color": shape.color, "opacity": shape.opacity, "cast_shadow": False, "receive_shadow": False}
    if shape.kind == "box":
        scene.add_box(name, dimensions=shape.size, **look, **place)
    elif shape.kind == "cylinder":
        scene.add_cylinder(name, radius=shape.size[0], height=shape.size[1], **look, **place)
    elif shape.kind == "ball":
        scene.add_icosphere(name, radius=shape.size[0], **look, **place)
    else:
        scene.add_frame(name, axes_length=shape.size[0], axes_radius=0.06 * shape.size[0], **place)


def _labels(scene, plan, motion) -> list:
    """A label for each phase, above the scene; it is shown in its phase only."""
    paths = np.concatenate([p[present] for present, _, p in motion.values()])
    place = {"position": (*((paths.min(0) + paths.max(0)) / 2)[:2], paths[:, 2].max() + 0.8)}
    spans = [f"{phase.name}, {phase.times[0]:.1f} to {phase.times[-1]:.1f} s" for phase in plan.phases]
    look = {"anchor": "bottom-center", "font_screen_scale": 1.5, "visible": False}
    return [scene.add_label(f"/phase {k}", text, **look, **place) for k, text in enumerate(spans)]


def _play(recorder, times, motion, nodes, labels, masks):
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
                put(nodes[name], "wxyz", quaternion[k], 1e-6)
                put(nodes[name], "position", position[k], 1e-6)
        recorder.insert_sleep(float(times[min(k + 1, len(times) - 1)] - times[k]))


def _with_heading(page: str, plan) -> str:
    """The page with the task's name in its title and over the scene."""
    text = html.escape(f"{plan.task.name}: {plan.status}")
    style = "position:fixed;right:1em;top:.7em;z-index:9;color:#ddd;font:15px sans-serif;pointer-events:none"
    page = re.sub(r"<title>.*?</title>", f"<title>{text}</title>", page, count=1, flags=re.DOTALL)
    end = page.rindex("</body>")
    return f'{page[:end]}<div style="{style}">{text}</div>{page[end:]}'
