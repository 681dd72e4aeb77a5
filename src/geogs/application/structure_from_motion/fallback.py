"""A tracked video; where tracking lost much of it, its frames placed by structure from motion."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from geogs.application.checkpoints.checkpoint import Checkpoint
from geogs.application.driver import Driver, Outcome, Work
from geogs.application.results.result import Result
from geogs.application.results.verdict import (
    MAX_DEPTH_DEVIATION,
    MAX_POSITION_DEVIATION,
    Verdict,
)
from geogs.application.run_settings import RunSettings
from geogs.application.structure_from_motion.agreement import has_wrong_joint, rotations_agree
from geogs.application.structure_from_motion.completion import LostFrames
from geogs.application.structure_from_motion.photos import has_pycolmap
from geogs.application.tracked_video import TrackedVideo
from geogs.camera.straight_view import FrameViews, StraightView
from geogs.errors import InputError, TrackingLost
from geogs.io.sources.frame_source import Source
from geogs.slam import Slam
from geogs.types import FoundFrames

if TYPE_CHECKING:
    from geogs.application.structure_from_motion.offline import PlacedOffline

MAX_UNKNOWN = 0.1
"""Part of the frames without a place from which on structure from motion is tried."""
CLEARLY_MORE = 0.05
"""Part of the frames by which it has to place more than tracking did; a result that is to be relied
on, where the tracked one is not, need only place as many."""


class TrackedOrPlaced(Work):
    """A tracked video, or its frames placed by structure from motion where that is clearly better.

    That is tried after the last frame and the adjustment, before there is a map, where the verdict
    is that tracking is not reliable, or where many frames have no place. Until it is known
    to be better, and wherever it fails or is stopped, the tracked result is what is kept.
    """

    def __init__(self, tracked: TrackedVideo, opened: Source) -> None:
        """``opened`` is the video as it came, before the run calibrated it."""
        self._tracked, self._opened = tracked, opened
        self._take(tracked)

    @property
    def way_on(self) -> str:
        """How to go on with the tracked video."""
        return self._tracked.way_on

    def state(self) -> object | None:
        """The state of tracking."""
        return self._tracked.state()

    def complete(self, driver: Driver, checkpoint: Checkpoint, new: Path) -> Outcome:
        """Track; place the frames otherwise if need be; map what is better.

        Raises TrackingLost if no frame could be tracked, nor placed.
        """
        tracked, failure = self._tracked, None
        try:
            outcome = tracked.locate(driver, checkpoint, new)
        except TrackingLost as error:
            outcome, failure = Outcome.FINISHED, error
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
        self._take(tracked)  # whose lens is known by now
        return tracked.map(driver, outcome)

    def _judged(self, driver: Driver) -> Verdict | None:
        """What is to be said of tracking, once lost frames were looked for about what is to be
        relied on: elsewhere all frames are placed otherwise first."""
        result = self._result()
        before = result.verdict
        if before is None or not before.is_reliable or not self._find_lost(driver, result):
            return before
        # The world is as well known as it was; what changes is how many frames have a place.
        after = self._result().verdict
        assert after is not None
        return replace(before, lost=after.lost, orientation_only=after.orientation_only)

    def _result(self) -> Result:
        return Result(self._tracked.scene, self._tracked.source)

    def _find_lost(self, driver: Driver, result: Result) -> bool:
        """Place the lost frames that are found about the keyframes; whether there are any."""
        slam, source, stop = self._tracked.scene, self._tracked.source, driver.stop
        may = self._tracked.metadata.settings.fallback and not source.is_live and has_pycolmap()
        if not may or stop.requested:
            return False
        keyframes = [slam.world.keyframes[i].frame_index for i in slam.segments.main.segment.free]
        lost = LostFrames(
            source, _views(slam), result.trajectory, keyframes, result.keyframes, slam.config.seed
        )  # fmt: skip
        found = FoundFrames.none()

        def find() -> None:
            nonlocal found
            found = lost.search(driver, slam.stopwatch)

        if not stop.lets_finish(find):
            driver.stop_early("The search for lost frames is stopped")
        slam.place_found(found)
        return len(found) > 0

    def _take(self, work: "TrackedVideo | PlacedOffline") -> None:
        self.scene, self.source = work.scene, work.source

    def _placed(self, driver: Driver, tracked: Verdict | None) -> "PlacedOffline | None":
        """The frames placed otherwise, if that can be tried and is better; what is said of it."""
        say, settings = driver.progress.write, self._tracked.metadata.settings
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
        was, sharp = self._tracked.scene.trajectory(), placed.scene.keyframe_trajectory()
        return not rotations_agree(was, placed.trajectory) or has_wrong_joint(was, sharp)

    def _is_mapped(self, placed: "PlacedOffline", driver: Driver, checkpoint: Checkpoint) -> bool:
        """Map the placed frames; false where nothing came of it."""
        if not self._succeeds(driver, lambda: placed.map(driver, checkpoint)):
            return False
        self._take(placed)
        return True

    def _succeeds(self, driver: Driver, work: Callable[[], object]) -> bool:
        """Whether some work ended with something to go on with; else it is said why not."""
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
    """Whether another way to place the frames is worth its time; none where nothing was tracked."""
    if tracked is None or tracked.is_reliable:
        return _placed_part(tracked) < 1 - MAX_UNKNOWN
    # As many frames are not reliable either where one lens for all of them is wrong.
    as_many = _is_shape_known(tracked) and not saw_lens_vary(tracked)
    return as_many or _placed_part(tracked) <= 1 - CLEARLY_MORE


def saw_lens_vary(tracked: Verdict) -> bool:
    """Whether tracking followed nearly all of a video, through a lens that changes; what it says of
    lenses where much was lost is part of that."""
    return tracked.lens_varies and _placed_part(tracked) >= 1 - MAX_UNKNOWN


def is_better(placed: Verdict, tracked: Verdict | None) -> bool:
    """Whether frames that were placed by structure from motion are to be taken.

    Their places and depths have to be well known, or no worse than those that were tracked, and
    they clearly more, or as many and to be relied on where what was tracked is not. Where tracking
    does not know the depths, as many do not either: its matches are more, and what it says of
    depths counts what is open of lens and rows, too.
    """
    position, depth = MAX_POSITION_DEVIATION, MAX_DEPTH_DEVIATION
    if tracked is not None:
        position, depth = max(position, tracked.position), max(depth, tracked.depth)
    if not (placed.position <= position and placed.depth <= depth and placed.has_shape):
        return False
    more = _placed_part(placed) - _placed_part(tracked)
    may_replace = tracked is None or (not tracked.is_reliable and _is_shape_known(tracked))
    return more >= (0.0 if placed.is_reliable and may_replace else CLEARLY_MORE)


def impossible(settings: RunSettings, source: Source) -> str:
    """Why the frames of a source cannot be placed once more; empty where they can."""
    if source.is_live:
        return "a live source comes but once; geogs run on its recording would."
    if settings.map is not None:
        return "a saved map is gone on with by tracking alone."
    if settings.scale_from or source.uses_depth or source.uses_poses:
        return "it knows no metres; geogs run --offline without them does it."
    return ""


def _views(slam: Slam) -> FrameViews:
    """How the frames of a tracked video are straightened, by what the adjustment found."""
    table, camera = slam.world.keyframes, slam.camera
    own = {table[id].frame_index: lens for id, lens in table.frame_lenses.items()}
    lens = slam.lens
    return FrameViews(StraightView(camera, lens) if lens else StraightView.of_pinhole(camera), own)


def _is_shape_known(judged: Verdict) -> bool:
    return judged.depth <= MAX_DEPTH_DEVIATION


def _placed_part(judged: Verdict | None) -> float:
    return 0.0 if judged is None else 1 - judged.lost - judged.orientation_only


def _in_words(tracked: Verdict | None) -> str:
    return "No frame could be tracked." if tracked is None else tracked.sentence
