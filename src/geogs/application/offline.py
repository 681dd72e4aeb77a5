"""A video without tracking: sharp frames, structure from motion, every frame against the map."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from geogs.application.forecast import reconstruction_forecast
from geogs.application.interrupt import Stop
from geogs.application.machine.device import compiled_kernels, full_memory_in_a_sentence
from geogs.application.photos import PlacedVideo, localiser, place_video
from geogs.application.progress import RunProgress
from geogs.application.results.output_folder import free_folder, only_writer
from geogs.application.results.result import Result, Written
from geogs.application.results.write import write_results
from geogs.application.settings import RunSettings
from geogs.config import ReconstructConfig
from geogs.errors import InputError
from geogs.gpu.installation import require_device
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.sniff import Stream, open_source
from geogs.io.writers.atomic import prepare_output_folder
from geogs.mapping.rendered import MapRenderer
from geogs.reconstruction import Reconstruction
from geogs.stopwatch import Stopwatch
from geogs.threads import on_one_torch_thread
from geogs.tracking.gaps import bridged
from geogs.types import MapSnapshot, RenderedKeyframe, SeenRows, Trajectory, Uncertainty


@on_one_torch_thread
def run_offline(
    settings: RunSettings, progress: RunProgress | None = None, stop: Stop | None = None
) -> Written:
    """Place sharp frames by structure from motion, all others against them, map, write.

    For a video that tracking cannot follow. The map is that of ``geogs reconstruct`` with its
    default settings; of the run's, input, mesh and seed count.

    Raises:
        InputError: pycolmap is missing, a source or a setting cannot be used, or the frames do not
            tell where they were taken.
        OutputError: a file cannot be written.
        DeviceError: the device cannot be used, or its memory is full.
        KeyboardInterrupt: it was stopped before there was a map; afterwards that is kept.
    """
    progress, stop = progress or RunProgress(), stop or Stop()
    config, device = settings.config, require_device(settings.device)
    if settings.scale_from or config.input.depth != "none":
        raise InputError("--offline knows no metres: leave out --scale-from and --depth.")
    opened = open_source(settings.source, config.input)
    wanted = settings.output or free_folder(Path("out") / opened.name, opened.fingerprint())
    output = prepare_output_folder(wanted)
    with only_writer(output):
        return _to_folder(settings, opened, output, device, progress, stop)


def _to_folder(
    settings: RunSettings,
    opened: Stream,
    output: Path,
    device: torch.device,
    progress: RunProgress,
    stop: Stop,
) -> Written:
    """The same once the source is opened and the folder is ours."""
    config = settings.config
    compiled_kernels(device)
    progress.plan(reconstruction_forecast(finds_poses=True))
    own = replace(ReconstructConfig(), seed=config.seed, input=config.input, mesh=config.mesh)
    stopwatch = Stopwatch()

    def report(stage: str, fraction: float) -> None:
        progress.stage(stage, fraction)
        stop.check()

    with full_memory_in_a_sentence(), stop:
        placed = place_video(opened, config.seed, report, stopwatch)
        progress.write(
            f"{len(placed.numbers)} of {placed.sharp_frames} sharp frames have a pose; points are "
            f"{placed.error:.2f} pixels from where they were seen."
        )
        source = opened
        if opened.is_calibration_open:
            source = opened.with_calibration(_of_source(opened, placed))
        scene = Reconstruction(source.camera, own, str(device))
        with stopwatch("placing frames"):
            T_cw = _place_all(source, scene, placed, own, report)
        try:
            scene.finish(placed.all_points(), report)
            finished = True
        except KeyboardInterrupt:
            if not (stop.requested and len(scene.snapshot())):
                raise
            progress.write("Stopping early; keeping what there is. Press Ctrl-C again to quit.")
            finished = False
        for stage, seconds in scene.stopwatch.seconds.items():
            stopwatch.seconds[stage] = stopwatch.seconds.get(stage, 0.0) + seconds
        video = OfflineScene(scene, stopwatch, placed, T_cw)
        result = Result(video, source, not finished, progress)
        write_results(output, result, (), settings.keyframe_images)
    return Written(output, result, False)


@dataclass(eq=False)
class OfflineScene:
    """A map of chosen frames, and the poses of all."""

    scene: Reconstruction
    stopwatch: Stopwatch
    placed: PlacedVideo
    T_cw: Sequence[Float64[Tensor, "4 4"] | None]
    """World to camera of all frames; none of those that found no place."""

    @property
    def config(self) -> ReconstructConfig:
        """By which the map was made."""
        return self.scene.config

    @property
    def frames(self) -> int:
        """Of the video."""
        return len(self.T_cw)

    def trajectory(self) -> Trajectory:
        """Poses of all frames, between others where one has none."""
        times = self.placed.timestamps[: self.frames]
        return bridged(times, self.T_cw, [None] * self.frames)

    def keyframe_trajectory(self) -> Trajectory:
        """Poses of the frames that structure from motion placed."""
        return self.scene.trajectory()

    def uncertainty(self) -> Uncertainty:
        """What the adjustment leaves open."""
        times = self.keyframe_trajectory().timestamps
        placed = self.placed
        return Uncertainty(times, placed.deviation, placed.rotation, placed.depth)

    def snapshot(self) -> MapSnapshot:
        """The disks."""
        return self.scene.snapshot()

    def renders(self) -> Sequence[RenderedKeyframe]:
        """The map seen from the frames that structure from motion placed."""
        return self.scene.renders()

    def renderer(self) -> MapRenderer:
        """What shows the map from anywhere."""
        return self.scene.renderer()

    def depth_maps(self) -> Sequence[RenderedKeyframe]:
        """Their depths as searched."""
        return self.scene.depth_maps()

    def rows(self) -> Mapping[int, SeenRows]:
        """None: rows of photographs are taken as they are."""
        return {}

    def particulars(self) -> Mapping[str, object]:
        """That nothing was tracked, and how the poses were found."""
        found = sum(pose is not None for pose in self.T_cw)
        return {
            "offline": {
                "sharp_frames": self.placed.sharp_frames,
                "placed_by_structure": len(self.placed.numbers),
                "placed_against_the_map": found - len(self.placed.numbers),
                "reprojection_error": self.placed.error,
                "calibration": asdict(self.placed.calibration),
            }
        }


def _place_all(
    source: Stream,
    scene: Reconstruction,
    placed: PlacedVideo,
    config: ReconstructConfig,
    report: Callable[[str, float], None],
) -> list[Float64[Tensor, "4 4"] | None]:
    """Poses of the frames that find a place; those of structure from motion go to ``scene``."""
    localise = localiser(placed, source.camera, config.seed)
    of = dict(zip(placed.numbers, placed.T_cw, strict=True))
    count = len(placed.timestamps)
    T_cw: list[Tensor | None] = [None] * count
    for frame in source:
        pose = of.get(frame.index)
        if pose is not None:
            scene.add(frame.image, pose, None, frame.timestamp)
        else:
            pose = localise(frame)
        if pose is not None:
            T_cw[frame.index] = torch.from_numpy(pose)
        report("placing frames", (frame.index + 1) / count)
    return T_cw


def _of_source(source: Stream, placed: PlacedVideo) -> Calibration:
    """The camera that was found, for the images as they came."""
    was = source.calibration
    found = replace(placed.calibration, origin="structure from motion of the video")
    assert was.width is not None
    assert was.height is not None
    return found.fit(was.width, was.height)
