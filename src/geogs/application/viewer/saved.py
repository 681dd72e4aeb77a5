"""Viewer of a saved result."""

import threading

import numpy as np

from geogs.application.results.saved_result import SavedResult
from geogs.application.results.upright import tracked_poses
from geogs.application.viewer.browser_window import Window, reduced
from geogs.errors import InputError
from geogs.evaluation.model_view.levelling import facets
from geogs.evaluation.model_view.start_view import start_view
from geogs.evaluation.pages.run_pictures import layer_picture


def open_window(result: SavedResult, host: str, port: int) -> Window:
    """Show a result; the window serves until it is stopped.

    Raises:
        InputError: viser is not installed, or the result is damaged.
    """
    window = Window(f"geogs: {result.name}", host, port)
    mesh = result.mesh
    trajectory = result.trajectory
    points = result.disks.position.cpu().numpy() if mesh is None else mesh.vertices
    surface = None if mesh is None else facets(mesh.vertices, mesh.faces, mesh.normals)
    axes = result.upright.axes
    start = start_view(points, axes, tracked_poses(trajectory), surface)
    up = axes[2]
    window.stand_upright(up, float(np.linalg.norm(start.eye - start.target)))
    window.look_from(start, up)
    if mesh is not None:
        window.show_mesh(mesh)
    window.show_disks(result.disks)
    window.show_path(trajectory.T_wc[trajectory.tracked, :3, 3])
    _show_keyframes(result, window)
    _Inspector(result, window).begin()
    return window


def _show_keyframes(result: SavedResult, window: Window) -> None:
    views = result.views
    count = len(views.keyframe_id)
    # Largest number of keyframes shown, evenly along the path.
    shown = np.unique(np.linspace(0, count - 1, min(count, 24)).round().astype(int))
    for number in shown.tolist():
        image = result.image(number)
        image = None if image is None else reduced(image, 160)
        id = int(views.keyframe_id[number])
        T_wc = np.linalg.inv(views.T_cw[number])
        window.show_keyframe(id, T_wc, result.camera, image)


class _Inspector:
    """Shows the selected keyframe in the selected layer."""

    def __init__(self, result: SavedResult, window: Window) -> None:
        self._result = result
        self._window = window
        self._number = 0
        self._lock = threading.Lock()

    def begin(self) -> None:
        """Add the slider and show the first keyframe."""
        count = len(self._result.keyframes)
        if not count:
            return
        self._follow = self._window.add_checkbox("Follow", False)
        self._window.add_slider("Keyframe", count, self._choose)
        self._window.on_layer(self._show)
        self._show()

    def _choose(self, number: int) -> None:
        self._number = number - 1
        self._show()

    def _show(self) -> None:
        # Depth is rendered from the disks on demand: one at a time.
        with self._lock:
            result = self._result
            number = self._number
            views = result.views
            T_wc = np.linalg.inv(views.T_cw[number])
            try:
                picture = self._picture(number)
            except InputError as error:
                self._window.say(result.name, str(error))
                return
            self._window.show_picture(picture)
            self._window.show_camera(T_wc, result.camera, picture)
            if self._follow.value:
                self._window.follow(T_wc)
            self._window.say(result.name, *self._words(number))

    def _picture(self, number: int) -> np.ndarray:
        result = self._result
        layer = self._window.layer
        image = result.image(number) if layer == "image" else None
        if image is not None:
            return image
        return layer_picture(result.renders[number], layer)

    def _words(self, number: int) -> tuple[str, str]:
        result = self._result
        try:
            verdict = result.summary.get("verdict")
        except InputError:
            verdict = None
        sentence = verdict.get("sentence", "") if isinstance(verdict, dict) else ""
        seconds = result.views.timestamp[number] - result.views.timestamp[0]
        count = len(result.views.keyframe_id)
        return str(sentence), f"keyframe {number + 1} of {count}, {seconds:.1f} s"
