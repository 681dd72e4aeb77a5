"""Live viewer of a run, which must not slow it down."""

import threading
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from geogs.application.viewer.browser_window import Window, reduced
from geogs.application.viewer.observer import RunObserver
from geogs.evaluation.held_camera import level_axes
from geogs.evaluation.pages.run_pictures import layer_picture
from geogs.geometry.camera import Camera
from geogs.types import Frame, MapSnapshot

if TYPE_CHECKING:
    from geogs.application.results.result import Result
    from geogs.pose_estimate import PoseEstimate
    from geogs.slam import Slam

MAX_TIME_FRACTION = 0.02
"""Largest fraction of the time for the viewer, in the run's thread and its own together."""
MAX_DISKS = 30_000
_MAP_SECONDS = 3.0
"""Least time between two copies of the map."""


@dataclass(frozen=True)
class Update:
    """Immutable state of a run for display."""

    words: tuple[str, str]
    picture: UInt8[np.ndarray, "h w 3"] | None
    camera: Camera
    T_wc: Float[np.ndarray, "4 4"] | None
    """Present camera pose, camera to world; none while it is not known."""
    keyframe_ids: tuple[int, ...]
    keyframes: Float[np.ndarray, "k 4 4"]
    """Camera to world."""
    disks: MapSnapshot | None = None
    """Disks of the map; none where they are unchanged."""


class LiveViewer(RunObserver):
    """Shows a run in a window, by a thread of its own.

    Updates that come while it is busy, or has used up its fraction of the time, are dropped.
    """

    def __init__(self, window: Window, max_fraction: float = MAX_TIME_FRACTION) -> None:
        self._window = window
        self._max_fraction = max_fraction
        self._follow = window.add_checkbox("Follow", True)
        self._pause = window.add_checkbox("Pause", False)
        self._next: Update | None = None
        self._wake = threading.Condition()
        self._ended = False
        self._start = time.perf_counter()
        self.used = 0.0
        """CPU time of the viewer in seconds, of both threads."""
        self._last_map = -_MAP_SECONDS
        self._thread = threading.Thread(target=self._serve, name="viewer", daemon=True)
        self._thread.start()

    def frame(self, frame: Frame, status: "PoseEstimate", slam: "Slam") -> None:
        """Take an update, if there is time for it."""
        now = time.perf_counter()
        if self._next is not None or self.used > self._max_fraction * (now - self._start):
            return
        if self._pause.value or not self._window.clients:
            return
        begin = time.thread_time()
        update = self._look(frame, status, slam, now)
        self.used += time.thread_time() - begin  # before the other thread adds its own
        with self._wake:
            self._next = update
            self._wake.notify()

    def result(self, result: "Result") -> None:
        """Show the mesh and the verdict."""
        with self._wake:
            self._ended = True
            self._wake.notify()
        self._thread.join(timeout=5)
        if result.mesh is not None:
            self._window.show_mesh(result.mesh)
        sentence = "" if result.verdict is None else result.verdict.sentence
        self._window.say(f"{result.source.name}: done", sentence)

    def _look(self, frame: Frame, status: "PoseEstimate", slam: "Slam", now: float) -> Update:
        ids = tuple(slam.segments.keyframe_ids)
        # The table keeps poses of keyframes that another thread may be removing.
        T_wc = [np.linalg.inv(slam.world.keyframes.poses[i].numpy()) for i in ids]
        seen = slam.T_cw if status.state.value == "tracking" else None
        loops = len(slam.world.loops.loops)
        words = (
            f"frame {status.frames}: {status.state.value}",
            f"{status.keyframes} keyframes, {status.disks} disks, {loops} loops",
        )
        picture = slam.straightened(frame.image)
        layer = self._window.layer
        if layer != "image" and (searched := slam.depth_maps()):
            picture = layer_picture(searched[len(searched) - 1], layer)
        disks = None
        if now - self._last_map >= _MAP_SECONDS and status.disks:
            self._last_map = now
            disks = thinned(slam.snapshot())
        return Update(
            words,
            reduced(picture, 320),
            slam.camera,
            None if seen is None else np.linalg.inv(seen.numpy()),
            ids,
            np.array(T_wc).reshape(-1, 4, 4),
            disks,
        )

    def _serve(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._next is not None or self._ended)
                update = self._next
                if update is None:
                    return
            begin = time.thread_time()
            self._show(update)
            self.used += time.thread_time() - begin
            self._next = None

    def _show(self, update: Update) -> None:
        window = self._window
        window.say(*update.words)
        if len(update.keyframes) > 1:
            extent = np.ptp(update.keyframes[:, :3, 3], axis=0)
            up = level_axes(update.keyframes)[2]
            window.stand_upright(up, 2.5 * float(np.linalg.norm(extent)) + 1.0)
            window.show_path(update.keyframes[:, :3, 3])
        for id, T_wc in zip(update.keyframe_ids, update.keyframes, strict=True):
            window.show_keyframe(id, T_wc, update.camera)
        if update.picture is not None:
            window.show_picture(update.picture)
        if update.T_wc is not None:
            window.show_camera(update.T_wc, update.camera, update.picture)
            if self._follow.value:
                window.follow(update.T_wc)
        if update.disks is not None:
            window.show_disks(update.disks)


def thinned(disks: MapSnapshot) -> MapSnapshot:
    """Subsample the disks to the number that can be sent."""
    step = -(-len(disks) // MAX_DISKS)
    kept = {name: getattr(disks, name)[::step].cpu() for name in MapSnapshot.__slots__}
    return replace(disks, **kept)
