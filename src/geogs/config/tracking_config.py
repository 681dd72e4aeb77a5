"""Settings of the front end: self-calibration, tracking and loops."""

from dataclasses import dataclass
from typing import Annotated, Literal

from geogs.config.setting import (
    Basic,
    Count,
    CountOrZero,
    Fraction,
    NamesFile,
    Only,
    Range,
    Settings,
    Weight,
)


@dataclass(frozen=True)
class CalibrationConfig(Settings, group="calibration"):
    """Self-calibration from the video, where intrinsics are not given.

    Given intrinsics stay fixed before the run. The final adjustment changes them only if all
    matches, and both halves of the video, clearly contradict them.
    """

    refine: bool = True
    """Whether a guessed focal length, or one from EXIF, is refined before the run."""
    radial: bool = True
    """Find the distortion with it (OpenCV's k1 and k2), unless that is given. Off for a lens that
    bends nothing."""


@dataclass(frozen=True)
class TrackingConfig(Settings, group="tracking"):
    """Motion filter, frame graph and dense bundle adjustment.

    Distances in the image are fractions of its longer side, so that they hold at any resolution.
    """

    operator: Literal["auto", "classical", "own", "droid", "droid_if_found"] = "auto"
    """Estimator of image motion; auto takes classical, which needs no weights; droid_if_found
    takes droid, or classical where it finds no droid.pth."""
    weights: Annotated[str, NamesFile()] = ""
    """File with the operator's weights; empty searches for one (geogs weights shows where)."""
    keyframe_parallax: Fraction = 0.018
    """Median motion since the last keyframe that makes a frame a keyframe, of the long edge,
    without what the camera's rotation alone does; before depths are known, 1.4 times that in
    all."""
    keyframe_overlap: Annotated[Fraction, Only("python")] = 0.7
    """A frame that has moved a fifth of that becomes one, too, when less than this fraction of the
    last keyframe finds a match in it."""
    keyframe_mean_flow: Annotated[Fraction, Only("python")] = 0.0
    """Mean motion since the last keyframe, of the long edge, that makes a frame a keyframe whatever
    its parallax, overlap and sharpness, as in the paper; 0 leaves it to these."""
    keyframe_distance: Fraction = 0.009
    """A keyframe is removed again when the next one has come and less lies between it and the one
    before: DROID-SLAM's frame distance, of the long edge. 0 removes none, and each is final, and
    mapped, as soon as it exists."""
    init_keyframes: Annotated[int, Range(4, 1000)] = 12
    """Keyframes gathered before the map is started."""
    window: Annotated[int, Range(1, 1000), Only("python")] = 8
    """Most recent keyframes whose poses the local adjustment moves."""
    fine_adjustment: bool = True
    """Match at full resolution for the adjustment of all keyframes, and find the readout of a
    rolling shutter once more in it; off matches images of more than 400 pixels at half of it, as on
    the way, and keeps the readout."""
    patience: Count = 15
    """Frames with texture in which the camera stays lost before another segment is begun."""
    moving: Annotated[float, Range(0, 1000)] = 3.0
    """A region is held for something that moves, and left out, where its matches contradict a rigid
    scene by this many times what is usual; 0 leaves nothing out."""


@dataclass(frozen=True)
class LoopConfig(Settings, group="loop"):
    """Search for loops, and the number of them that is kept.

    Distances in the image are fractions of its longer side, so that they hold at any resolution.
    """

    enabled: bool = True
    """Search for loops and close them, and recognise keyframes when the camera is lost."""
    min_gap: Count = 15
    """Keyframes that lie at least between the two views of a loop."""
    appearance: CountOrZero = 5
    """Candidates taken from the index per keyframe; 0 looks only where the present poses say."""
    close_every: Annotated[Count, Only("python")] = 5
    """Keyframes between two corrections, at least."""
    residual: Annotated[Weight, Only("python")] = 5.0
    """Squared error of a loop at the present poses, in its own variances, from which it calls for a
    correction. Variances are cautious: right loops come to 1 or 2, where 7 would be exact."""
    matches: bool = False
    """Adjust the matches of loops and of the frame graph together with the relative poses, depths
    included, when a loop is closed (the paper's Sim(3) bundle adjustment); off leaves it at the
    relative poses."""
    min_change: Annotated[Weight, Only("python")] = 0.002
    """Corrections that move no keyframe by more than this are not worth it for the map: radians,
    parts of its median depth, or of its scale."""
    global_ba_every: Annotated[CountOrZero, Basic("--global-ba-every", is_common=False)] = 0
    """Keyframes between two bundle adjustments of all keyframes; 0 leaves that to the end."""
