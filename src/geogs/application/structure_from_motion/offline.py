"""A video without tracking: structure from motion of sharp frames, localisation of the others."""

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
from geogs.application.structure_from_motion.photos import PlacedVideo, localiser, place_frames
from geogs.camera.straight_view import FrameViews, StraightView
from geogs.config import Config, ReconstructConfig, preset_of, reconstruct_preset
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.frame_source import Source
from geogs.reconstruction import Reconstruction
from geogs.stopwatch import StageProgress, Stopwatch
from geogs.tracking.frames.interpolation import bridged
from geogs.types import FoundFrames, Trajectory, Uncertainty

MIN_READOUT_FPS = 8.0
"""Recorded frame rate below which a readout estimated before the run is not used: structure from
motion estimates its own by residuals (docs/photographs.md)."""


class PlacedOffline(Work):
    """Sharp frames of a video located by structure from motion, all others against them.

    For a video where tracking fails. The map is that of ``geogs reconstruct`` with its preset;
    of other settings, only input, mesh and seed are used.
    """

    scene: "OfflineScene"
    """The map and all poses, once they exist."""
    source: Source
    """The video, calibrated once its sharp frames are located."""
    trajectory: Trajectory
    """Poses of all frames, once located."""

    def __init__(self, config: Config, video: Source, stopwatch: Stopwatch | None = None) -> None:
        """``config`` is that of a run; a ``stopwatch`` may have run before."""
        made = reconstruct_preset(preset_of(config))
        self._config = replace(made, seed=config.seed, input=config.input, mesh=config.mesh)
        self.source = video
        self._stopwatch = stopwatch or Stopwatch()
        self._chosen: ChosenFrames | None = None

    @property
    def stopwatch(self) -> Stopwatch:
        """Seconds of localisation and mapping."""
        return self._stopwatch

    def complete(self, driver: Driver, checkpoint: Checkpoint, new: Path) -> Outcome:
        """Locate the frames, then map the sharp ones.

        Raises:
            InputError: pycolmap is missing, or the frames do not determine their poses.
            KeyboardInterrupt: it was stopped before there was a map.
        """
        self.choose(driver)
        self.place(driver)
        return self.map(driver, checkpoint)

    def choose(self, driver: Driver) -> None:
        """Select the frames to be located first. Raises KeyboardInterrupt if it was stopped."""
        video = self.source
        with self._stopwatch("choosing frames"):
            self._chosen = choose_frames(video, video.fps, video.length, driver.report)

    def place(self, driver: Driver) -> None:
        """Locate the selected frames by structure from motion, the others against their points.

        Raises:
            InputError: pycolmap is missing, or the frames do not determine their poses.
            KeyboardInterrupt: it was stopped.
        """
        config = self._config
        video = self.source
        chosen = self._chosen
        assert chosen is not None, "no frames have been chosen"
        self._chosen = None  # it takes much memory
        with self._stopwatch("structure from motion"):
            refinement = video.calibration.refinement
            placed = place_frames(
                chosen,
                video.camera,
                not video.is_calibration_open,
                refinement is not None and refinement.failure is None,
                config.input.readout == "auto" and not video.shutter.readout,
                config.seed,
                driver.report,
            )
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
            self.source,
            FrameViews(StraightView(self.source.camera, self.source.camera)),
            self.trajectory,
            placed.numbers,
            scene.keyframe_trajectory(),
            config.seed,
        )
        scene.found = lost.search(driver, self._stopwatch)
        for number, pose in zip(scene.found.numbers, scene.found.T_cw, strict=True):
            T_cw[number] = torch.from_numpy(pose)
        self.trajectory = bridged(placed.timestamps, T_cw, [None] * len(T_cw))

    def judged(self) -> Verdict:
        """Verdict on the poses, once they exist."""
        scene = self.scene
        return verdict(self.trajectory, scene.keyframe_trajectory(), scene.uncertainty())

    def map(self, driver: Driver, checkpoint: Checkpoint) -> Outcome:
        """Make the map from the sharp frames, once they are located.

        Raises:
            InputError: no two of them show the same surface from two positions.
            KeyboardInterrupt: it was stopped before there was a map.
        """
        scene = self.scene
        outcome = driver.map_known(scene, lambda: scene.map(driver.report), checkpoint)
        # Not before, as it would determine the frames of the map.
        scene.know(self.trajectory)
        return outcome


def beginning_with(video: Source, found: Source) -> Source:
    """A straight video with the estimated shutter, and focal length where none was given, as the
    start of structure from motion, which estimates its own; see ``MIN_READOUT_FPS``, too."""
    video = video.straight()
    begun = video if video.recorded_fps < MIN_READOUT_FPS else video.with_shutter(found.shutter)
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
        """Number of frames localised against the points of the others."""
        self.instead_of = ""
        """Verdict on tracking, where the video was tracked before."""
        self.lens_varies = False
        """Whether tracking found a varying lens; structure from motion has one for all frames."""
        self.found = FoundFrames.none()
        """Lost frames that were located after the others."""

    def map(self, progress: StageProgress) -> None:
        """Search depths of the sharp frames, and make the map from them."""
        self.finish(self._placed.all_points(), progress)

    def uncertainty(self) -> Uncertainty:
        """Standard deviations by the adjustment."""
        placed = self._placed
        times = placed.timestamps[list(placed.numbers)]
        lens_change = math.inf if self.lens_varies else 0.0
        known = Uncertainty(
            times, placed.deviation, placed.rotation, placed.depth, lens_change=lens_change
        )
        return known.with_found(self.found)

    def statistics(self) -> dict[str, object]:
        """Statistics of structure from motion, as nothing was tracked."""
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
    """Poses of all frames that can be located; those of structure from motion go to ``scene``."""
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
    """The estimated camera, for the stored images."""
    was = source.calibration
    found = replace(placed.calibration, origin="structure from motion of the video")
    assert was.width is not None
    assert was.height is not None
    return found.fit(was.width, was.height)
