"""A tracked video, with structure from motion as a fallback where much was lost."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float64

from geogs.application.checkpoints.checkpoint import Checkpoint
from geogs.application.driver import Driver, Outcome, Work
from geogs.application.results.result import Result
from geogs.application.results.verdict import MAX_POSITION_DEVIATION, MAX_SHAPE_DEVIATION, Verdict
from geogs.application.run_settings import RunSettings
from geogs.application.structure_from_motion.completion import LostFrames
from geogs.application.structure_from_motion.photos import has_pycolmap
from geogs.application.tracked_video import TrackedVideo
from geogs.camera.straight_view import FrameViews, StraightView
from geogs.errors import InputError, TrackingLost
from geogs.evaluation.rotation_errors import relative_rotation_error, rotation_angle
from geogs.io.sources.frame_source import Source
from geogs.slam import Slam
from geogs.types import FoundFrames, Trajectory

if TYPE_CHECKING:
    from geogs.application.structure_from_motion.offline import PlacedOffline


MAX_UNKNOWN = 0.1
"""Fraction of lost frames above which structure from motion is tried."""
CLEARLY_MORE = 0.05
"""Fraction of frames that it must locate in addition to tracking; a reliable result, where the
tracked one is not, need only locate as many."""


class TrackedOrPlaced(Work):
    """A tracked video, or its frames located by structure from motion where that is clearly better.

    That is tried after the last frame and the adjustment, before there is a map, where the verdict
    is that tracking is not reliable, or where many frames are lost. Until it is known to be
    better, and wherever it fails or is stopped, the tracked result is kept.
    """

    def __init__(self, tracked: TrackedVideo, opened: Source) -> None:
        """``opened`` is the video before the run's self-calibration."""
        self._tracked = tracked
        self._opened = opened
        self._take(tracked)

    @property
    def way_on(self) -> str:
        """A sentence on how to resume the tracked video."""
        return self._tracked.way_on

    def state(self) -> object | None:
        """The state of tracking."""
        return self._tracked.state()

    def complete(self, driver: Driver, checkpoint: Checkpoint, new: Path) -> Outcome:
        """Track; locate the frames by structure from motion if needed; map the better result.

        Raises TrackingLost if no frame could be tracked or located.
        """
        tracked = self._tracked
        failure = None
        try:
            outcome = tracked.locate(driver, checkpoint, new)
        except TrackingLost as error:
            outcome = Outcome.FINISHED
            failure = error
        if outcome is Outcome.FINISHED:
            judged = None if failure else self._judged(driver)
            if is_wanted(judged):
                placed = self._placed(driver, judged)
                if placed is not None and self._is_mapped(placed, driver, checkpoint):
                    return Outcome.STOPPED if driver.stop.requested else outcome
                if judged is not None and not judged.is_reliable:
                    self._find_lost(driver, self._result())
            outcome = Outcome.STOPPED if driver.stop.requested else outcome
        if failure is not None:
            raise failure
        self._take(tracked)  # with its final lens
        return tracked.map(driver, outcome)

    def _judged(self, driver: Driver) -> Verdict | None:
        """Verdict on tracking; for a reliable result, after the search for lost frames. For others,
        structure from motion of all frames comes first."""
        result = self._result()
        before = result.verdict
        if before is None or not before.is_reliable or not self._find_lost(driver, result):
            return before
        # The accuracy of the world is unchanged; only the number of located frames differs.
        after = self._result().verdict
        assert after is not None
        return replace(before, lost=after.lost, orientation_only=after.orientation_only)

    def _result(self) -> Result:
        return Result(self._tracked.scene, self._tracked.source)

    def _find_lost(self, driver: Driver, result: Result) -> bool:
        """Locate lost frames by the keyframes. Returns whether any was found."""
        slam = self._tracked.scene
        source = self._tracked.source
        stop = driver.stop
        may = self._tracked.metadata.settings.fallback and not source.is_live and has_pycolmap()
        if not may or stop.requested:
            return False
        keyframes = [slam.world.keyframes[i].frame_index for i in slam.segments.main.segment.free]
        lost = LostFrames(
            source, _views(slam), result.trajectory, keyframes, result.keyframes, slam.config.seed
        )
        found = FoundFrames.none()

        def find() -> None:
            nonlocal found
            found = lost.search(driver, slam.stopwatch)

        if not stop.lets_finish(find):
            driver.stop_early("The search for lost frames is stopped")
        slam.place_found(found)
        return len(found) > 0

    def _take(self, work: "TrackedVideo | PlacedOffline") -> None:
        self.scene = work.scene
        self.source = work.source

    def _placed(self, driver: Driver, tracked: Verdict | None) -> "PlacedOffline | None":
        """Locate the frames by structure from motion and report it; none if impossible or worse."""
        say = driver.progress.write
        settings = self._tracked.metadata.settings
        if not settings.fallback:
            return None
        why_not = impossible(settings, self._opened)
        if why_not:
            say(
                f"note: Structure from motion could locate more frames, but is not tried: {why_not}"
            )
            return None
        if not has_pycolmap():
            return None
        from geogs.application.structure_from_motion.offline import PlacedOffline, beginning_with

        video = beginning_with(self._opened, self._tracked.source)
        placed = PlacedOffline(settings.config, video, self._tracked.scene.stopwatch)
        if not self._succeeds(driver, lambda: placed.choose(driver)):
            return None
        say(f"{_in_words(tracked)} Trying structure from motion; Ctrl-C keeps the tracked result.")
        if not self._succeeds(driver, lambda: placed.place(driver)):
            return None
        placed.scene.lens_varies = tracked is not None and saw_lens_vary(tracked)
        found = placed.judged()
        is_other = tracked is not None and self._rotates_otherwise(placed)
        is_taken = is_better(found, tracked) and not is_other
        say(
            f"Structure from motion locates {_placed_part(found):.0%} of the frames, tracking "
            f"{_placed_part(tracked):.0%}. "
            + ("Their rotations disagree. " if is_other else "")
            + ("Its result is mapped." if is_taken else "The tracked result is kept.")
        )
        placed.scene.instead_of = _in_words(tracked)
        return placed if is_taken else None

    def _rotates_otherwise(self, placed: "PlacedOffline") -> bool:
        was = self._tracked.scene.trajectory()
        sharp = placed.scene.keyframe_trajectory()
        return not rotations_agree(was, placed.trajectory) or has_wrong_joint(was, sharp)

    def _is_mapped(self, placed: "PlacedOffline", driver: Driver, checkpoint: Checkpoint) -> bool:
        """Map the located frames. Returns false where that fails."""
        if not self._succeeds(driver, lambda: placed.map(driver, checkpoint)):
            return False
        self._take(placed)
        return True

    def _succeeds(self, driver: Driver, work: Callable[[], object]) -> bool:
        """Do some work. Returns whether it succeeded; a failure is reported."""
        try:
            if driver.stop.lets_finish(work):
                return True
            driver.stop_early("Structure from motion is stopped")
        except (InputError, RuntimeError) as error:  # of a library; or the GPU's memory is full
            if isinstance(error, torch.cuda.OutOfMemoryError):
                torch.cuda.empty_cache()
            driver.progress.write(
                f"Structure from motion failed; the tracked result is kept. {error}"
            )
        return False


def is_wanted(tracked: Verdict | None) -> bool:
    """Whether structure from motion is worth its time; ``tracked`` is none if no frame was."""
    if tracked is None or tracked.is_reliable:
        return _placed_part(tracked) < 1 - MAX_UNKNOWN
    # As many frames are no more reliable where one lens for all of them is wrong.
    as_many = _is_shape_known(tracked) and not saw_lens_vary(tracked)
    return as_many or _placed_part(tracked) <= 1 - CLEARLY_MORE


def saw_lens_vary(tracked: Verdict) -> bool:
    """Whether nearly all of a video was tracked, with a lens that changes; where much was lost, its
    estimate of the lens is part of the failure."""
    return tracked.lens_varies and _placed_part(tracked) >= 1 - MAX_UNKNOWN


def is_better(placed: Verdict, tracked: Verdict | None) -> bool:
    """Whether the frames located by structure from motion are to be used.

    Their positions and depths must be accurate, or no worse than the tracked ones, and they must
    be clearly more, or as many and reliable where tracking is not. Where tracking does not
    determine the depths, as many are not enough: it has more matches, and its standard deviations
    of depths include the uncertainty of lens and rows.
    """
    position = MAX_POSITION_DEVIATION
    depth = MAX_SHAPE_DEVIATION
    if tracked is not None:
        position = max(position, tracked.position)
        depth = max(depth, tracked.depth)
    if not (placed.position <= position and placed.depth <= depth and placed.has_shape):
        return False
    more = _placed_part(placed) - _placed_part(tracked)
    may_replace = tracked is None or (not tracked.is_reliable and _is_shape_known(tracked))
    return more >= (0.0 if placed.is_reliable and may_replace else CLEARLY_MORE)


def impossible(settings: RunSettings, source: Source) -> str:
    """Reason why the frames cannot be located by structure from motion; empty where they can."""
    if source.is_live:
        return "a live source cannot be read again; geogs run on its recording would."
    if settings.map is not None:
        return "a saved map needs tracking."
    if settings.scale_from or source.uses_depth or source.uses_poses:
        return "it gives no metric scale; geogs run --sfm without them does it."
    return ""


def _views(slam: Slam) -> FrameViews:
    """Undistortion of a tracked video's frames by the lens of the adjustment."""
    table = slam.world.keyframes
    own = {table[id].frame_index: lens for id, lens in table.frame_lenses.items()}
    return FrameViews(table.view or StraightView(table.camera, table.assumed), own)


def _is_shape_known(judged: Verdict) -> bool:
    return judged.depth <= MAX_SHAPE_DEVIATION


def _placed_part(judged: Verdict | None) -> float:
    return 0.0 if judged is None else 1 - judged.lost - judged.orientation_only


def _in_words(tracked: Verdict | None) -> str:
    return "No frame could be tracked." if tracked is None else tracked.sentence


FRAMES_APART = 5
"""Distance of the frames of a pair, counted in frames located by both trajectories."""


def rotations_agree(first: Trajectory, second: Trajectory) -> bool:
    """Whether the rotations of most frame pairs agree, or there are too few pairs.

    A wrong start may misplace the camera, but hardly its rotation between frames: a trajectory with
    other rotations than the tracked ones is wrong, however small its standard deviations. Frames
    are matched by their times; those count that both trajectories located.
    """
    known = first.of("tracked"), second.of("tracked")
    _, R = _common(*known)
    begin = np.arange(len(R[0]) - FRAMES_APART)
    if len(begin) < 10:  # too few for a test
        return True
    end = begin + FRAMES_APART
    difference = relative_rotation_error(R[1], R[0], begin, end)
    angle = rotation_angle(R[0][begin], R[0][end])
    # Rotations may differ by a degree, and by a fraction: wrong focal lengths scale them.
    return bool((difference <= 1.0 + 0.15 * angle).mean() > 0.5)


def has_wrong_joint(tracked: Trajectory, sharp: Trajectory) -> bool:
    """Whether the rotation between two consecutive sharp frames differs much from tracking, which
    lost no frame between them."""
    times, R = _common(tracked.of("tracked"), sharp)
    number = np.searchsorted(tracked.timestamps, times)
    lost = np.cumsum([state != "tracked" for state in tracked.states])[number]
    begin = np.flatnonzero(np.diff(lost) == 0)
    # Largest difference of the rotations between two consecutive frames in degrees.
    return bool((relative_rotation_error(R[1], R[0], begin, begin + 1) > 30.0).any())


def _common(
    first: Trajectory, second: Trajectory
) -> tuple[Float64[np.ndarray, "n"], list[Float64[np.ndarray, "n 3 3"]]]:
    """Times of the common frames, and their orientations by each trajectory."""
    times, *rows = np.intersect1d(first.timestamps, second.timestamps, return_indices=True)
    return times, [k.T_wc[row, :3, :3] for k, row in zip((first, second), rows, strict=True)]
