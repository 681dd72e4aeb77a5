"""Rendering of a suite of rooms: the room around the camera, and others through its doors."""

from collections import OrderedDict
from dataclasses import replace

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from geogs.geometry.camera import Camera
from geogs_synth.raycast.raycaster import Raycaster, RenderedView
from suite import Suite

_ROOMS_IN_MEMORY = 6
_DEPTH = 2
"""Largest number of consecutive doors to see through."""


class SuiteRaycaster:
    """Renders a suite from any camera inside; only rooms around it are in memory."""

    def __init__(self, suite: Suite, threads: int = 2) -> None:
        self.suite = suite
        self.threads = threads
        self._casters: OrderedDict[int, Raycaster] = OrderedDict()

    def render(
        self, camera: Camera, T_wc: Float64[np.ndarray, "4 4"]
    ) -> tuple[UInt8[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
        """RGB and z in metres of the rays through the pixel centres; z is 0 for rays that leave
        through the last open door."""
        own = self.suite.nearest(T_wc[:3, 3])
        view = self._room(own, camera, T_wc)
        image, depth = view.image, view.depth
        for away in range(1, _DEPTH + 1):
            hole = depth == 0
            if not hole.any():
                break
            top, left, part = _around(hole, camera)
            window = slice(top, top + part.height), slice(left, left + part.width)
            open_ = hole[window]
            found = np.where(open_, np.inf, 0).astype(np.float32)
            for room in {(own - away) % self.suite.rooms, (own + away) % self.suite.rooms}:
                seen = self._room(room, part, T_wc)
                nearer = (seen.depth > 0) & (seen.depth < found)
                image[window][nearer] = seen.image[nearer]
                found[nearer] = seen.depth[nearer]
            depth[window][open_] = np.where(np.isfinite(found), found, 0)[open_]
        return image, depth

    def _room(self, room: int, camera: Camera, T_wc: Float64[np.ndarray, "4 4"]) -> RenderedView:
        if room not in self._casters:
            self._casters[room] = Raycaster(self.suite.room(room), self.threads)
        self._casters.move_to_end(room)
        while len(self._casters) > _ROOMS_IN_MEMORY:
            self._casters.popitem(last=False)
        local = T_wc.copy()
        local[:3, 3] -= self.suite.origin(room)
        return self._casters[room].render(camera, local)


def _around(hole: np.ndarray, camera: Camera) -> tuple[int, int, Camera]:
    """Top and left of the smallest window around the true pixels, and its camera."""
    rows, columns = np.flatnonzero(hole.any(1)), np.flatnonzero(hole.any(0))
    # The kernels compute the size of a pixel from two of them.
    top, left = min(rows[0], camera.height - 2), min(columns[0], camera.width - 2)
    height, width = max(rows[-1] + 1 - top, 2), max(columns[-1] + 1 - left, 2)
    part = replace(
        camera, cx=camera.cx - left, cy=camera.cy - top, width=int(width), height=int(height)
    )
    return int(top), int(left), part
