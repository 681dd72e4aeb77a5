"""The system as Python programs use it: images in, poses out, and a map to ask, keep and load."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from geogs.application.calibrate import self_calibrated, with_shutter_found
from geogs.application.progress import RunProgress
from geogs.application.results.keyframe_files import write_keyframes
from geogs.application.results.saved_result import load_result
from geogs.application.results.surfaces import surface_of
from geogs.application.results.write import write_config
from geogs.config import Config, InputConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.gpu.installation import require_device
from geogs.io.sources.sniff import Stream, open_source
from geogs.io.writers.atomic import prepare_output_folder
from geogs.io.writers.intrinsics_file import write_intrinsics
from geogs.io.writers.map_file import save_map_with_views
from geogs.io.writers.trajectories import write_trajectories
from geogs.io.writers.uncertainty import write_uncertainty
from geogs.mapping.rendered import SurfaceMaps
from geogs.mesh.triangle_mesh import Mesh
from geogs.priors.base import MonocularPrior
from geogs.slam import Slam as Algorithm
from geogs.slam import SlamStatus
from geogs.threads import on_one_torch_thread
from geogs.types import Frame
from geogs.world.segments import TrackState


@dataclass(frozen=True)
class PoseEstimate(SlamStatus):
    """Where the camera is, as far as it is known right after a frame.

    Later frames, loops and the final adjustment move it: ``Slam.trajectory`` has the poses of all
    frames as they are known by then.
    """

    timestamp: float
    """Seconds."""
    T_cw: Float64[Tensor, "4 4"] | None
    """World to camera; none unless the camera is tracked in the world of the map."""
    sigma_position: float
    """Standard deviation of the camera's centre relative to the map around it, map units, all axes
    together; infinite where nothing is known of it."""
    sigma_rotation: float
    """Of its orientation, radians."""

    @property
    def T_wc(self) -> Float64[Tensor, "4 4"] | None:
        """Camera to world."""
        return None if self.T_cw is None else se3_inverse(self.T_cw)

    @property
    def is_tracked(self) -> bool:
        """Whether there is a pose."""
        return self.T_cw is not None


class Slam(Algorithm):
    """Dense monocular SLAM: feed images, read poses at once, and surfaces, trajectory and map.

    ``Slam(camera)`` computes in order, the same each time on a CPU; with ``live=True`` it maps
    in a thread beside tracking, so that :meth:`process` returns soon. After the last image,
    :meth:`finish` adjusts everything together. Lengths are in a unit of the map's own.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        device: str = "cpu",
        prior: MonocularPrior | None = None,
        live: bool = False,
        mask: Bool[np.ndarray, "h w"] | None = None,
        black_is_masked: bool = False,
    ) -> None:
        """``camera`` is the pinhole of all images; ``device`` is cpu, cuda, cuda:1 or auto;
        ``mask``, of the images' size, is true where they may show the scene. What hides it in some
        images alone is painted black in them, and ``black_is_masked`` says so.

        Raises:
            InputError: images of that size cannot be tracked.
            DeviceError: there is no such device, or it cannot be used.
        """
        where = str(require_device(device))
        super().__init__(camera, config, where, prior, live, mask, black_is_masked)
        self.pose: PoseEstimate | None = None
        """After the last image; none before the first."""

    @classmethod
    def load(
        cls,
        folder: str | Path,
        config: Config | None = None,
        device: str = "cpu",
        live: bool = False,
        mask: Bool[np.ndarray, "h w"] | None = None,
    ) -> "Slam":
        """A system in the world of a saved map, or of the result of a run, to go on with there.

        The camera is that of the map. Its keyframes stay where they are; until an image is
        recognised at one of them, or images form a map of their own that loops join to it, there
        are no poses. Trajectories are those of new images alone.

        Raises:
            InputError: there is no map, it is damaged, or was kept without keyframe images.
        """
        former = load_result(folder, require_device(device))
        slam = cls(former.camera, config, device, live=live, mask=mask)
        slam.start_from(former.disks, former.keyframes)
        return slam

    def process(  # type: ignore[override]  # takes what the algorithm takes, and more
        self, image: Frame | np.ndarray, timestamp: float | None = None
    ) -> PoseEstimate:
        """Track an image and, where it completes a keyframe, train the map.

        Args:
            image: RGB, uint8, undistorted, of the camera's size; or a frame of a source.
            timestamp: seconds, later than that of the image before; of a frame, its own counts. If
                none is given, images come 30 times a second.

        Returns where the camera is. Raises InputError if the image cannot be used.
        """
        if isinstance(image, Frame):
            self._check(image.image, image.timestamp)
            frame = image
        else:
            seconds = self._next_time() if timestamp is None else float(timestamp)
            self._check(image, seconds)
            frame = Frame(self.frames, seconds, image)
        status = super().process(frame)
        self.pose = self._estimate(status, frame.timestamp)
        return self.pose

    def mesh(self) -> Mesh | None:
        """The surface of the map as it is now; none where there is none yet."""
        renders = self.renders()
        return surface_of(renders, self.config.mesh, RunProgress()) if len(renders) else None

    @on_one_torch_thread
    def render(
        self, T_cw: Float64[Tensor, "4 4"] | np.ndarray, camera: Camera | None = None
    ) -> SurfaceMaps:
        """Depth, normal and weight of the map as it is now, seen from a pose, world to camera.

        ``camera`` is that of the keyframes' depth maps if none is given.
        """
        pose = torch.as_tensor(T_cw, dtype=torch.float64)
        if pose.shape != (4, 4) or not bool(torch.isfinite(pose).all()):
            raise InputError("A pose to render from is a 4x4 matrix of finite numbers.")
        return self.renderer().surface(pose, camera)

    @on_one_torch_thread
    def save(self, folder: str | Path) -> Path:
        """Keep the map as it is now, to be loaded by :meth:`load` and ``geogs.load_result``.

        Trajectory, camera, disks, and the keyframes' poses and images; returns the folder.

        Raises:
            InputError: there is no map yet.
            OutputError: a file cannot be written.
        """
        renders = self.renders()
        if not len(renders):
            raise InputError("There is no map to save yet; no keyframe has been mapped.")
        output, trajectory = prepare_output_folder(folder), self.trajectory()
        write_trajectories(output, trajectory, self.keyframe_trajectory())
        known = self.uncertainty()
        if known is not None:
            write_uncertainty(output / "trajectory_uncertainty.csv", trajectory, known)
        write_intrinsics(output / "intrinsics.json", self.camera)
        write_config(output / "config.yaml", self.config)
        views = write_keyframes(output, self, self.camera, renders, with_images=True)
        facts = {"source": "a Python program", "seed": self.config.seed}
        save_map_with_views(output / "map.safetensors", self.snapshot(), views, facts)
        return output

    def _next_time(self) -> float:
        return 0.0 if self.pose is None else self.pose.timestamp + 1 / 30

    def _check(self, image: object, timestamp: float) -> None:
        """Raises InputError if an image cannot be used, before anything has changed."""
        if not isinstance(image, np.ndarray):
            raise InputError("An image is a NumPy array, uint8 of height x width x 3 (RGB).")
        size = self.camera.height, self.camera.width
        if image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 1):
            raise InputError(
                "The image is grey; give RGB, as of cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)."
            )
        if image.ndim != 3 or image.shape[2] != 3:
            shape = "x".join(map(str, image.shape))
            raise InputError(f"The image is an array of {shape}; give height x width x 3 (RGB).")
        if image.dtype != np.uint8:
            raise InputError(
                f"The image is of {image.dtype}; give uint8 in 0..255, as of "
                "(255 * image).round().astype(numpy.uint8) where it is in 0..1."
            )
        if image.shape[:2] != size:
            height, width = image.shape[:2]
            raise InputError(
                f"The image is {width} x {height} pixels, the camera {size[1]} x {size[0]}; all "
                "images must have the camera's size."
            )
        if not np.isfinite(timestamp):
            raise InputError("The time of an image is a finite number of seconds.")
        if self.pose is not None and timestamp <= self.pose.timestamp:
            raise InputError(
                f"The image is of {timestamp:g} s, the one before of "
                f"{self.pose.timestamp:g} s; times have to increase."
            )
        if self.is_ended:
            raise InputError("The stream has ended by finish(); save it, and load it to go on.")

    def _estimate(self, status: SlamStatus, timestamp: float) -> PoseEstimate:
        tracker = self.segments.current
        in_world = tracker is self.segments.main and status.state is TrackState.TRACKING
        T_cw = self.T_cw if in_world else None
        known = self.deviation() if T_cw is not None else None
        sigma = (np.inf, np.inf) if known is None else (known.position, known.rotation)
        return PoseEstimate(
            status.state, status.frames, status.keyframes, status.disks, timestamp,
            None if T_cw is None else T_cw.detach().double().cpu().clone(), *map(float, sigma),
        )  # fmt: skip


def track(
    source: str | Path | Sequence[str | Path] | Stream,
    config: Config | None = None,
    device: str = "auto",
    slam: Slam | None = None,
) -> Iterator[PoseEstimate]:
    """Where the camera is after each frame of a video, a folder, a camera or a stream.

    Args:
        source: what ``geogs.open_source`` opens, or has opened. Of a path, the focal length and the
            readout of the shutter are found beforehand as ``geogs run`` does, if nobody says them
            and no ``slam`` is given; what is opened already is taken as it is.
        config: settings, also those of how the source is read.
        device: cpu, cuda, cuda:1, or auto for a GPU where there is one.
        slam: to use instead of a new one, such as a loaded one; it can be asked meanwhile and
            finished afterwards.

    Raises:
        InputError: the source cannot be read, or is not of the camera of ``slam``.
        DeviceError: the device cannot be used.
    """
    settings = config or (Config() if slam is None else slam.config)
    stream = _opened(source, settings.input)
    if slam is None:
        if stream is not source:
            stream = self_calibrated(stream, settings, require_device(device))
            stream = with_shutter_found(stream)
        slam = Slam(
            stream.camera, settings, device, None, stream.is_live, stream.mask,
            stream.black_is_masked,
        )  # fmt: skip
    for frame in stream:
        yield slam.process(frame)


def _opened(source: str | Path | Sequence[str | Path] | Stream, config: InputConfig) -> Stream:
    if isinstance(source, str | Path):
        return open_source(source, config)
    return open_source(source, config) if isinstance(source, Sequence) else source
