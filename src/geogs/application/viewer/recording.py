"""A run as a recording for the rerun viewer: ``rerun file.rrd`` plays it."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geogs.application.viewer.live_viewer import thinned
from geogs.application.viewer.observer import RunObserver
from geogs.errors import InputError, OutputError
from geogs.extras import install_command
from geogs.types import Frame

if TYPE_CHECKING:
    from geogs.application.results.result import Result
    from geogs.pose_estimate import PoseEstimate
    from geogs.slam import Slam

_EVERY = 5
"""Interval of records of the map and the path, in keyframes."""


class Recorder(RunObserver):
    """Writes image and camera at every new keyframe, path and disks at intervals, and the mesh at
    the end; times are those of the frames."""

    def __init__(self, path: Path) -> None:
        """Begin a recording.

        Raises:
            InputError: rerun is not installed.
            OutputError: the file cannot be written.
        """
        try:
            import rerun
        except ImportError:
            raise InputError(f"Recordings need rerun: {install_command('record')}") from None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.open("wb").close()
        except OSError as error:
            raise OutputError(f"{path} cannot be written ({error.strerror}).") from None
        self._rerun = rerun
        self._stream = rerun.RecordingStream("geogs")
        self._stream.save(str(path))
        self._stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)
        self._keyframes = 0

    def frame(self, frame: Frame, status: "PoseEstimate", slam: "Slam") -> None:
        """Record the changes of a new keyframe."""
        seen = slam.T_cw
        if seen is None or status.keyframes <= self._keyframes:
            return
        before = self._keyframes
        self._keyframes = status.keyframes
        rerun = self._rerun
        stream = self._stream
        camera = slam.camera
        stream.set_time("frame", sequence=frame.index)
        stream.set_time("video", duration=frame.timestamp)
        T_wc = np.linalg.inv(seen.numpy())
        place = rerun.Transform3D(translation=T_wc[:3, 3], mat3x3=T_wc[:3, :3])
        stream.log("world/camera", place)
        lens = rerun.Pinhole(
            focal_length=(camera.fx, camera.fy),
            # Its first pixel's centre is at a half.
            principal_point=(camera.cx + 0.5, camera.cy + 0.5),
            width=camera.width,
            height=camera.height,
            image_plane_distance=0.2,
        )
        stream.log("world/camera/image", lens)
        # Quality of the JPEG images.
        stream.log("world/camera/image", rerun.Image(slam.straightened(frame.image)).compress(70))
        stream.log("keyframes", rerun.Scalars(status.keyframes))
        stream.log("disks", rerun.Scalars(status.disks))
        if status.keyframes // _EVERY > before // _EVERY:
            self._log_map(slam)

    def result(self, result: "Result") -> None:
        """Record the final path and mesh, and close the file."""
        rerun = self._rerun
        stream = self._stream
        path = result.trajectory.T_wc[result.trajectory.tracked, :3, 3]
        stream.log("world/path", rerun.LineStrips3D([path], colors=[(242, 163, 58)]))
        stream.log("world/disks", rerun.Clear(recursive=False))
        if (mesh := result.mesh) is not None:
            shape = rerun.Mesh3D(
                vertex_positions=mesh.vertices,
                triangle_indices=mesh.faces,
                vertex_normals=mesh.normals,
                vertex_colors=mesh.colours,
            )
            stream.log("world/mesh", shape)
        if result.verdict is not None:
            stream.log("verdict", rerun.TextDocument(result.verdict.sentence))
        stream.flush()
        stream.disconnect()

    def _log_map(self, slam: "Slam") -> None:
        rerun = self._rerun
        poses = slam.keyframe_trajectory().T_wc
        path = rerun.LineStrips3D([poses[:, :3, 3]], colors=[(242, 163, 58)])
        self._stream.log("world/path", path)
        disks = thinned(slam.snapshot())
        if len(disks):
            points = rerun.Points3D(
                disks.position.numpy(),
                radii=disks.scale.mean(1).numpy(),
                colors=(127.5 + 115 * disks.normal.numpy()).clip(0, 255).astype(np.uint8),
            )
            self._stream.log("world/disks", points)
