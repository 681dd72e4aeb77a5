"""Structure from motion of photographs and videos, registered by another package."""

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
from geogs.extras import install_command
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
    "features": 0.1,
    "choosing pairs": 0.13,
    "matching": 0.9,
    "finding poses": 0.25,
}
"""Seconds of one core, by stage, to locate a frame: some 22 pairs of each are matched (50 frames of
512 pixels)."""


@dataclass(frozen=True, slots=True)
class PlacedVideo:
    """Sharp frames of a video that have a pose, in time order, and the points that they see."""

    timestamps: Float64[np.ndarray, "n"]
    """Times of all frames of the video, seconds."""
    sharp_frames: int
    """Number of input frames of structure from motion."""
    numbers: tuple[int, ...]
    """Numbers of the frames with a pose, ascending: the rows of the following arrays."""
    T_cw: Float64[np.ndarray, "m 4 4"]
    """World to camera."""
    deviation: Float64[np.ndarray, "m"]
    """Standard deviation of the camera's centre after the best-fitting similarity; infinite where
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
    """Calibration of the input frames."""
    error: float
    """Mean reprojection error, pixels."""

    def all_points(self) -> Float64[np.ndarray, "k 3"]:
        """Every point once."""
        return np.unique(np.concatenate(self.positions), axis=0)


def has_pycolmap() -> bool:
    """Whether the library for structure from motion is installed."""
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
    """Locate frames of one camera by structure from motion; the largest connected part is kept.

    Args:
        chosen: the frames.
        camera: camera of the frames; the initial value if it is not known.
        is_known: whether the camera is fixed.
        is_found: whether self-calibration estimated the focal length before; if another one
            results, poses and depths count as unknown.
        is_rolling: whether the shutter may be rolling, with unknown readout.
        seed: seed of the random choices.
        report: follows the work; an exception ends it.

    Raises:
        InputError: pycolmap is missing, or fewer than three frames are connected.
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
    """Locate frames without a pose by others around them, whose poses are fixed.

    Args:
        frames: these, and others of the same scene, in time order.
        T_cw: their poses, world to camera; none for those to be located.
        seen_by: the camera of all, with the distortion left in the images.
        seed: seed of the random choices.
        report: follows the work; an exception ends it.

    Raises:
        InputError: pycolmap is missing.
    """
    found: FoundFrames = _registered("place_lost")(frames, T_cw, seen_by, seed, report)
    return found


def localiser(video: PlacedVideo, camera: Camera, seed: int) -> Localise:
    """Function that localises any frame of ``camera`` against the points of a located video.

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
    """A source of photographs whose poses are estimated from them, or were before.

    Args:
        folder: the photographs.
        config: its ``input`` selects photographs and gives the known camera parameters.
        kept: the folder of the result: the poses go to ``sparse/0`` there, as a COLMAP model, and
            a list of left-out photographs to ``photographs.json``.
        hold_out: every ``hold_out``-th photograph with a pose is left out afterwards; none keeps
            all.
        again: whether to reuse the poses stored there before.
        progress: follows the work.
        stop: ends it.
        seconds: time for poses and map together; if it is short, the poses take less effort, and
            ``progress`` reports at once what does not fit. None is no limit.

    Raises:
        InputError: pycolmap is missing, or the photographs do not determine their poses.
        OutputError: the poses cannot be written.
        KeyboardInterrupt: it was stopped.
    """
    open_them = _registered("open_photographs")
    source: PosedSource = open_them(folder, config, kept, hold_out, again, progress, stop, seconds)
    return source


@dataclass(frozen=True)
class _PosedView:
    """An image of a source, with the common camera."""

    image: UInt8[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"] | None
    camera: Camera
    T_cw: Float64[np.ndarray, "4 4"]


def triangulated_points(
    source: PosedSource, which: Sequence[int], seed: int
) -> Float64[np.ndarray, "k 3"]:
    """Triangulate features of some images of a source, with their poses.

    Raises:
        InputError: the package for photographs is missing, or no point results.
    """
    images = [source[i] for i in which]
    views = [_PosedView(v.image, v.mask, source.camera, v.T_cw) for v in images]
    positions: Float64[np.ndarray, "k 3"] = _registered("find_start_points")(views, seed).positions
    return positions


def _registered(name: str) -> Any:
    for point in entry_points(group=GROUP, name=name):
        return point.load()
    raise InputError(
        "Poses of photographs and points of their features need geogs_photos: "
        f"{install_command('photos')}"
    )
