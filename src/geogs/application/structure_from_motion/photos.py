"""Structure from motion of photographs and of videos, as another package registers it."""

import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from geogs.application.interrupt import Stop
from geogs.application.progress.run_progress import RunProgress
from geogs.application.structure_from_motion.chosen_frames import ChosenFrames
from geogs.config import ReconstructConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.stopwatch import StageProgress
from geogs.types import FoundFrames, Frame

GROUP = "geogs.photos"
"""Entry points: ``open_photographs``, ``place_frames``, ``place_lost``, ``find_start_points`` and
``Localiser``, as used below."""

Localise = Callable[[Frame], Float64[np.ndarray, "4 4"] | None]
"""The pose, world to camera, of any frame of a video; none where too few points agree on one."""

SECONDS_PER_FRAME = {
    "features": 0.1, "choosing pairs": 0.13, "matching": 0.9, "finding poses": 0.25
}  # fmt: skip
"""Seconds of one core, by stage, to find where such a frame was taken: some 22 pairs of each are
matched (50 frames of 512 pixels)."""
"""Seconds of one core to place another frame against their points, and to take one that has been
placed into the map."""


@dataclass(frozen=True, slots=True)
class PlacedVideo:
    """Sharp frames of a video that have a pose, in time order, and the points that they see."""

    timestamps: Float64[np.ndarray, "n"]
    """Times of all frames of the video, seconds."""
    sharp_frames: int
    """How many frames structure from motion was given."""
    numbers: tuple[int, ...]
    """Which frames of the video have a pose, ascending: the rows of what follows."""
    T_cw: Float64[np.ndarray, "m 4 4"]
    """World to camera."""
    deviation: Float64[np.ndarray, "m"]
    """Standard deviation of the camera's centre after the similarity that fits best; infinite where
    unknown."""
    rotation: Float64[np.ndarray, "m"]
    """Standard deviation of its orientation, radians."""
    depth: Float64[np.ndarray, "m"]
    """Relative standard deviation of its points' depths: the median."""
    positions: tuple[Float64[np.ndarray, "_k 3"], ...]
    """Points that each frame sees."""
    descriptors: tuple[UInt8[np.ndarray, "_k 128"], ...]
    """SIFT descriptors of the same points."""
    calibration: Calibration
    """Calibration of the frames as they were given."""
    error: float
    """Mean distance of the points from where they were seen, pixels."""

    def all_points(self) -> Float64[np.ndarray, "k 3"]:
        """Every point once."""
        return np.unique(np.concatenate(self.positions), axis=0)


def has_pycolmap() -> bool:
    """Whether the library that finds where pictures were taken is installed."""
    return importlib.util.find_spec("pycolmap") is not None


def place_frames(
    chosen: ChosenFrames,
    camera: Camera,
    is_known: bool,
    is_found: bool,
    is_rolling: bool,
    seed: int,
    report: StageProgress,
) -> PlacedVideo:
    """Find where frames of one camera were taken; of the largest part that hangs together.

    Args:
        chosen: the frames.
        camera: of the frames; where the search begins if it is not known.
        is_known: whether the camera is to stay as it is.
        is_found: whether the video told its focal length before; where another comes out, poses
            and depths count as unknown.
        is_rolling: whether rows may have been read one after the other by nobody knows what time.
        seed: of the random choices.
        report: follows the work; what it raises ends it.

    Raises:
        InputError: pycolmap is missing, or fewer than three frames hang together.
    """
    place = _registered("place_frames")
    placed: PlacedVideo = place(chosen, camera, is_known, is_found, is_rolling, seed, report)
    return placed


def place_lost(
    frames: Sequence[Frame],
    T_cw: Sequence[Float64[np.ndarray, "4 4"] | None],
    seen_by: Calibration,
    seed: int,
    report: StageProgress,
) -> FoundFrames:
    """Find where frames without a pose were taken by others around them, whose poses stay.

    Args:
        frames: those, and others that show the same, in time order.
        T_cw: their poses, world to camera; none of those to be found.
        seen_by: the camera of all, with its distortion where they still bend.
        seed: of the random choices.
        report: follows the work; what it raises ends it.

    Raises:
        InputError: pycolmap is missing.
    """
    found: FoundFrames = _registered("place_lost")(frames, T_cw, seen_by, seed, report)
    return found


def localiser(video: PlacedVideo, camera: Camera, seed: int) -> Localise:
    """What places any frame of ``camera`` against the points of a placed video.

    Raises:
        InputError: pycolmap is missing.
    """
    place: Localise = _registered("Localiser")(video, camera, seed).place
    return place


def open_photographs(
    folder: Path,
    config: ReconstructConfig,
    kept: Path,
    hold_out: int | None = None,
    again: bool = False,
    progress: RunProgress | None = None,
    stop: Stop | None = None,
    seconds: float | None = None,
) -> PosedSource:
    """A source of photographs whose poses are found from themselves, or were found before.

    Args:
        folder: the photographs.
        config: its ``input`` selects photographs and says what is known of the camera.
        kept: the folder of the result: the poses go to ``sparse/0`` there, as a COLMAP model, and
            what was left out to ``photographs.json``.
        hold_out: every so many-th photograph with a pose is left out afterwards; none leaves out
            none.
        again: whether to take the poses that were kept there before.
        progress: follows the work.
        stop: ends it.
        seconds: for poses and map together; where they are few the poses take less effort, and
            ``progress`` hears at once what does not fit. None is no limit.

    Raises:
        InputError: pycolmap is missing, or the photographs do not tell where they were taken.
        OutputError: the poses cannot be kept.
        KeyboardInterrupt: it was stopped.
    """
    open_them = _registered("open_photographs")
    source: PosedSource = open_them(folder, config, kept, hold_out, again, progress, stop, seconds)
    return source


@dataclass(frozen=True)
class _PosedView:
    """An image of a source beside the camera of all."""

    image: UInt8[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"] | None
    camera: Camera
    T_cw: Float64[np.ndarray, "4 4"]


def triangulated_points(
    source: PosedSource, which: Sequence[int], seed: int
) -> Float64[np.ndarray, "k 3"]:
    """World points of features of some images of a source, under their poses.

    Raises:
        InputError: the package for photographs is missing, or no point comes out.
    """
    images = [source[i] for i in which]
    views = [_PosedView(v.image, v.mask, source.camera, v.T_cw) for v in images]
    positions: Float64[np.ndarray, "k 3"] = _registered("find_start_points")(views, seed).positions
    return positions


def _registered(name: str) -> Any:
    for point in entry_points(group=GROUP, name=name):
        return point.load()
    raise InputError(
        "Poses of photographs and points of their features need geogs_photos; "
        "pip install 'geogs[photos]' brings it."
    )
