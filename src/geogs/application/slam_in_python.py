"""SLAM for Python programs: poses of a whole source, and a map to show, save and load."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool

from geogs.application.calibrate import self_calibrated
from geogs.application.progress.run_progress import RunProgress
from geogs.application.results.keyframe_files import write_keyframes
from geogs.application.results.output_folder import claimed
from geogs.application.results.saved_result import SavedResult, load_result
from geogs.application.results.surfaces import surface_of
from geogs.application.results.write import write_config
from geogs.config import Config
from geogs.config.arguments import checks_arguments
from geogs.errors import InputError
from geogs.gpu.installation import require_device
from geogs.guard.replacement import replaced
from geogs.io.sources.frame_source import Source
from geogs.io.sources.sniff import open_source
from geogs.io.writers.intrinsics_file import write_intrinsics
from geogs.io.writers.map_file import save_map_with_views
from geogs.io.writers.trajectories import write_trajectories
from geogs.io.writers.uncertainty import write_uncertainty
from geogs.mesh.triangle_mesh import Mesh
from geogs.pose_estimate import PoseEstimate
from geogs.priors.monocular_prior import MonocularPrior
from geogs.slam import Slam
from geogs.threads import on_one_torch_thread
from geogs.tracking.keyframes.segment_map import add_saved_keyframes
from geogs.world.world import World


@checks_arguments
def track(
    source: str | Path | Sequence[str | Path] | Source,
    config: Config | None = None,
    device: str | torch.device = "auto",
    slam: Slam | None = None,
) -> Iterator[PoseEstimate]:
    """Yield the camera's pose after each frame of a video, a folder, a camera or a stream.

    Args:
        source: path for ``geogs.open_source``, or an opened source. For a path, the focal length
            and the readout of the shutter are estimated first as by ``geogs run``, if they are
            not given and there is no ``slam``; an opened source is used unchanged.
        config: settings, including those of reading the source.
        device: cpu, cuda, cuda:1, or auto for a GPU where there is one.
        slam: system to use instead of a new one, such as a loaded one; it can be queried meanwhile
            and finished afterwards.

    Raises:
        InputError: the source cannot be read, or is not of the camera of ``slam``.
        DeviceError: the device cannot be used.
    """
    settings = config or (Config() if slam is None else slam.config)
    stream = source if isinstance(source, Source) else open_source(source, settings.input)
    if slam is None:
        if stream is not source:
            stream = self_calibrated(stream, settings, require_device(device))
        slam = new_slam(stream, settings, require_device(device))
    for frame in stream:
        yield slam.process(frame)


def new_slam(
    source: Source,
    config: Config,
    device: torch.device,
    prior: MonocularPrior | None = None,
    defers_map: bool = False,
    world: World | None = None,
) -> Slam:
    """Make a system for the frames of a source, or continue with the ``world`` of another."""
    return Slam(
        source.image_camera,
        config,
        str(device),
        prior,
        source.is_live,
        source.mask,
        source.black_is_masked,
        defers_map,
        world,
        source.calibration.focal_deviation,
        source.camera,
    )


@on_one_torch_thread
def go_on_in(slam: Slam, saved: SavedResult) -> None:
    """Continue in a saved map, which stays fixed; to be called before the first frame.

    The camera is localised among its keyframes; frames that cannot be form a segment of their own
    until loops join it. Trajectories hold new frames only.

    Raises:
        InputError: there is no keyframe, one has no image, or one of another camera.
    """
    if slam.frames or not saved.keyframes:
        raise InputError("A map with keyframes has to be given, and before the first frame.")
    segment = slam.segments.main.segment
    ids = add_saved_keyframes(segment, saved.renders)
    segment.status.frames_lost = slam.config.tracking.patience  # no waiting period
    slam.loops.remember(ids)
    masks = {i: m for n, i in enumerate(ids) if (m := saved.image_mask(n)) is not None}
    with slam.stopwatch("mapping"):
        slam.executor.mapping.take_over(saved.disks, masks, ids)


@checks_arguments
def load_slam(
    folder: str | Path,
    config: Config | None = None,
    device: str | torch.device = "auto",
    live: bool = False,
    mask: Bool[np.ndarray, "h w"] | None = None,
) -> Slam:
    """Load a system that continues in a saved map, or in the result of a run.

    The camera is that of the map. Its keyframes stay fixed; there are no poses until an image is
    localised at one of them, or images form a map of their own that loops join to it.
    Trajectories hold new images only.

    Raises:
        InputError: there is no map, it is damaged, or was saved without keyframe images.
    """
    saved = load_result(folder, require_device(device))
    slam = Slam(saved.camera, config, device, live=live, mask=mask)
    go_on_in(slam, saved)
    return slam


@checks_arguments
@on_one_torch_thread
def save_slam(slam: Slam, folder: str | Path) -> Path:
    """Save the present map for :func:`load_slam` and ``geogs.load_result``. Returns the folder.

    Writes trajectory, camera, disks, and the keyframes' poses and images; an earlier result in the
    folder is replaced.

    Raises:
        InputError: there is no map yet.
        OutputError: a file cannot be written.
    """
    renders = slam.renders()
    if not len(renders):
        raise InputError("There is no map to save yet; no keyframe has been mapped.")
    trajectory = slam.trajectory()
    known = slam.uncertainty()
    with claimed(Path(folder)) as output, replaced(output, "result") as new:
        write_trajectories(new, trajectory, slam.keyframe_trajectory())
        if known is not None:
            write_uncertainty(new / "trajectory_uncertainty.csv", trajectory, known)
        write_intrinsics(new / "intrinsics.json", slam.camera)
        write_config(new / "config.yaml", slam.config)
        views = write_keyframes(new, slam, slam.camera, renders, with_images=True)
        metadata = {"source": "a Python program", "seed": slam.config.seed}
        save_map_with_views(new / "map.safetensors", views, metadata)
    return output


@checks_arguments
def slam_mesh(slam: Slam) -> Mesh | None:
    """The surface of the present map; none where there is none yet."""
    renders = slam.renders()
    return surface_of(renders, slam.config.mesh, RunProgress()) if len(renders) else None
