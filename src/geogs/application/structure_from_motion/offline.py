"""A video without tracking: sharp frames, structure from motion, every frame against the map."""

import math
from dataclasses import asdict, replace
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from geogs.application.checkpoints.checkpoint import Checkpoint
from geogs.application.driver import Driver, Outcome, Work
from geogs.application.results.verdict import Verdict, verdict
from geogs.application.structure_from_motion.chosen_frames import ChosenFrames, choose_frames
from geogs.application.structure_from_motion.completion import LostFrames
from geogs.application.structure_from_motion.photos import (
    PlacedVideo,
    localiser,
    place_frames,
)
from geogs.camera.straight_view import FrameViews, StraightView
from geogs.config import Config, ReconstructConfig, preset_of, reconstruct_preset
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.frame_source import Source
from geogs.reconstruction import Reconstruction
from geogs.stopwatch import StageProgress, Stopwatch
from geogs.tracking.frames.interpolation import bridged
from geogs.types import FoundFrames, Trajectory, Uncertainty

MIN_CLIP_FPS = 8.0
"""Images a second, as recorded, below which a readout that nobody gave is not searched in clips:
all images are placed then, and their residuals tell it with its error (docs/photographs.md)."""


def offline_config(config: Config) -> ReconstructConfig:
    """How the map is made of frames that were placed so, with the settings of a run."""
    made = reconstruct_preset(preset_of(config))
    return replace(made, seed=config.seed, input=config.input, mesh=config.mesh)


class PlacedOffline(Work):
    """Sharp frames of a video placed by structure from motion, all others against them.

    For a video that tracking cannot follow. The map is that of ``geogs reconstruct`` with the
    preset of the run, as far as its map is one's; else of its settings input, mesh and seed count.
    """

    scene: "OfflineScene"
    """The map and all poses, once there are any."""
    source: Source
    """The video, calibrated as soon as its sharp frames have been placed."""
    trajectory: Trajectory
    """Poses of all frames, once these have been placed."""

    def __init__(self, config: Config, video: Source, stopwatch: Stopwatch | None = None) -> None:
        """Settings are those of a run; a ``stopwatch`` may have run before."""
        self._config = offline_config(config)
        self.source = video
        self._stopwatch = stopwatch or Stopwatch()
        self._chosen: ChosenFrames | None = None

    @property
    def stopwatch(self) -> Stopwatch:
        """Seconds of placing and mapping."""
        return self._stopwatch

    def complete(self, driver: Driver, checkpoint: Checkpoint, new: Path) -> Outcome:
        """Place the frames, then map the sharp ones.

        Raises:
            InputError: pycolmap is missing, or the frames do not tell where they were taken.
            KeyboardInterrupt: it was stopped before there was a map.
        """
        self.choose(driver)
        self.place(driver)
        return self.map(driver, checkpoint)

    def choose(self, driver: Driver) -> None:
        """Choose the frames to be placed first. Raises KeyboardInterrupt if it was stopped."""
        video = self.source
        with self._stopwatch("choosing frames"):
            self._chosen = choose_frames(video, video.fps, video.length, driver.report)

    def place(self, driver: Driver) -> None:
        """Poses of the chosen frames by structure from motion, of the others against their points.

        Raises:
            InputError: pycolmap is missing, or the frames do not tell where they were taken.
            KeyboardInterrupt: it was stopped.
        """
        config, video, chosen = self._config, self.source, self._chosen
        assert chosen is not None, "no frames have been chosen"
        self._chosen = None  # it takes much memory
        with self._stopwatch("structure from motion"):
            refinement = video.calibration.refinement
            placed = place_frames(
                chosen, video.camera, not video.is_calibration_open,
                refinement is not None and refinement.failure is None,
                config.input.readout == "auto" and not video.shutter.readout, config.seed,
                driver.report,
            )  # fmt: skip
        del chosen
        driver.progress.write(
            f"{len(placed.numbers)} of {placed.sharp_frames} sharp frames have a pose; points are "
            f"{placed.error:.2f} pixels from where they were seen."
        )
        if self.source.is_calibration_open:
            self.source = self.source.with_calibration(_of_source(self.source, placed))
        scene = OfflineScene(placed, self.source.camera, config, str(driver.device))
        scene.stopwatch = self._stopwatch
        self.scene = scene
        with self._stopwatch("placing frames"):
            T_cw = _place_all(self.source, scene, placed, config, driver.report)
        self.trajectory = bridged(placed.timestamps, T_cw, [None] * len(T_cw))
        lost = LostFrames(
            self.source, FrameViews(StraightView.of_pinhole(self.source.camera)), self.trajectory,
            placed.numbers, scene.keyframe_trajectory(), config.seed,
        )  # fmt: skip
        scene.found = lost.search(driver, self._stopwatch)
        for number, pose in zip(scene.found.numbers, scene.found.T_cw, strict=True):
            T_cw[number] = torch.from_numpy(pose)
        self.trajectory = bridged(placed.timestamps, T_cw, [None] * len(T_cw))

    def judged(self) -> Verdict:
        """How far the poses are to be relied on, once there are some."""
        scene = self.scene
        return verdict(self.trajectory, scene.keyframe_trajectory(), scene.uncertainty())

    def map(self, driver: Driver, checkpoint: Checkpoint) -> Outcome:
        """The map from the sharp frames, once they have been placed.

        Raises:
            InputError: no two of them show the same thing from two places.
            KeyboardInterrupt: it was stopped before there was a map.
        """
        scene = self.scene
        outcome = driver.map_known(scene, lambda: scene.map(driver.report), checkpoint)
        # Not before, as it would say of which frames the map is to be made.
        scene.know(self.trajectory)
        return outcome


def beginning_with(video: Source, found: Source) -> Source:
    """A video with the shutter that was found of it, and the focal length, where nobody gave one:
    that is where structure from motion begins, which finds its own; see ``MIN_CLIP_FPS``, too."""
    begun = video if video.recorded_fps < MIN_CLIP_FPS else video.with_shutter(found.shutter)
    if not video.is_calibration_open:
        return begun
    lens = found.calibration
    return begun.with_calibration(
        replace(video.calibration, fx=lens.fx, fy=lens.fy, refinement=lens.refinement)
    )


class OfflineScene(Reconstruction):
    """A map of the sharp frames of a video, and the poses of all."""

    def __init__(
        self, placed: PlacedVideo, camera: Camera, config: ReconstructConfig, device: str
    ) -> None:
        super().__init__(camera, config, device)
        self._placed = placed
        self.localised = 0
        """Frames placed against the points of the others."""
        self.instead_of = ""
        """What was said of tracking, where the video was tracked before."""
        self.lens_varies = False
        """Whether tracking saw that: structure from motion has one lens for all frames."""
        self.found = FoundFrames.none()
        """Frames that were lost, and found once the others had been placed."""

    def map(self, progress: StageProgress) -> None:
        """Depths of the sharp frames, and the map from them."""
        self.finish(self._placed.all_points(), progress)

    def uncertainty(self) -> Uncertainty:
        """What the adjustment leaves open."""
        placed = self._placed
        times = placed.timestamps[list(placed.numbers)]
        lens_change = math.inf if self.lens_varies else 0.0
        known = Uncertainty(
            times, placed.deviation, placed.rotation, placed.depth, lens_change=lens_change
        )
        return known.with_found(self.found)

    def statistics(self) -> dict[str, object]:
        """How the poses were found, as nothing was tracked."""
        return {
            "offline": {
                "sharp_frames": self._placed.sharp_frames,
                "placed_by_structure": len(self._placed.numbers),
                "placed_against_the_map": self.localised,
                "placed_afterwards": len(self.found),
                "reprojection_error": self._placed.error,
                "instead_of": self.instead_of or None,
                "calibration": asdict(self._placed.calibration),
            }
        }


def _place_all(
    source: Source,
    scene: OfflineScene,
    placed: PlacedVideo,
    config: ReconstructConfig,
    report: StageProgress,
) -> list[Float64[Tensor, "4 4"] | None]:
    """Poses of the frames that find a place; those of structure from motion go to ``scene``."""
    localise = localiser(placed, source.camera, config.seed)
    of = dict(zip(placed.numbers, placed.T_cw, strict=True))
    count = len(placed.timestamps)
    T_cw: list[Tensor | None] = [None] * count
    for frame in source:
        pose = of.get(frame.index)
        if pose is not None:
            scene.add(frame.image, pose, frame.mask, frame.timestamp)
        else:
            pose = localise(frame)
            scene.localised += pose is not None
        if pose is not None:
            T_cw[frame.index] = torch.from_numpy(pose)
        report("placing frames", (frame.index + 1) / count)
    return T_cw


def _of_source(source: Source, placed: PlacedVideo) -> Calibration:
    """The camera that was found, for the images as they came."""
    was = source.calibration
    found = replace(placed.calibration, origin="structure from motion of the video")
    assert was.width is not None
    assert was.height is not None
    return found.fit(was.width, was.height)
