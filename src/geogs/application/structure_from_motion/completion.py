"""Lost frames at the end of the work: another search by structure from motion."""

import copy
import math
from bisect import bisect_left
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from geogs.application.driver import Driver
from geogs.application.results.verdict import MAX_POSITION_DEVIATION
from geogs.application.structure_from_motion.photos import SECONDS_PER_FRAME, place_lost
from geogs.camera.straight_view import FrameViews, StraightView
from geogs.errors import InputError
from geogs.evaluation.duration import duration
from geogs.evaluation.trajectory_errors import extent_of
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.frame_source import Source
from geogs.stopwatch import StageProgress, Stopwatch
from geogs.threads import worker_count
from geogs.types import FoundFrames, Frame, Trajectory, Uncertainty

NEIGHBOURS = 10
"""Number of located frames before each lost one, and after it, that are used to find it."""
STAGE = "lost frames"


class LostFrames:
    """Lost frames of a video, and the poses of the others."""

    def __init__(
        self,
        video: Source,
        views: FrameViews,
        trajectory: Trajectory,
        sharp: Iterable[int],
        keyframes: Trajectory,
        seed: int,
    ) -> None:
        """Prepare a search.

        Args:
            video: the video, which is read again.
            views: undistortion of its frames by the final lens.
            trajectory: poses of all frames.
            sharp: reference frames; those with a pose are used.
            keyframes: a frame whose position is uncertain relative to their extent stays lost.
            seed: seed of the random choices.
        """
        # A copy, as a source keeps its reading position.
        self._video = copy.copy(video)
        self._views = views
        self._seed = seed
        self._most_deviation = MAX_POSITION_DEVIATION * extent_of(keyframes.T_wc)
        self._times = trajectory.timestamps
        states = trajectory.states
        T_wc = trajectory.T_wc
        self.known = {k: np.linalg.inv(T_wc[k]) for k in sharp if states[k] == "tracked"}
        """World-to-camera poses of the reference frames."""
        self.numbers = [k for k, state in enumerate(states) if state != "tracked"]
        """Numbers of the lost frames, ascending."""

    @property
    def seconds(self) -> float:
        """Approximate time of the search."""
        looked_at = len({*self.numbers, *about(self.numbers, self.known)})
        return looked_at * sum(SECONDS_PER_FRAME.values()) / worker_count()

    def search(self, driver: Driver, stopwatch: Stopwatch) -> FoundFrames:
        """Find lost frames, and report the outcome; none where the search fails.

        Raises KeyboardInterrupt if it was stopped.
        """
        if not self.numbers or not self.known:
            return FoundFrames.none()
        say = driver.progress.write
        say(f"{len(self.numbers)} frames not located; searching, about {duration(self.seconds)}.")
        try:
            with stopwatch(STAGE):
                found = self._found(driver.report)
        except (InputError, RuntimeError) as error:  # of a library
            say(f"The search failed: {error}")
            return FoundFrames.none()
        say(f"Structure from motion locates {len(found)} of them.")
        return found

    def _found(self, report: StageProgress) -> FoundFrames:
        known = dict(self.known)
        # For time and memory, at most 250 are searched at once: of more, every second one first, or
        # every third, ...
        rounds = math.ceil(len(self.numbers) / 250)
        at = np.array([self._times[k] for k in sorted(known)])
        beside = Uncertainty(at, *np.zeros((3, len(at))))
        poses: dict[int, Float64[np.ndarray, "4 4"]] = {}
        for k in range(rounds):
            some = self._find(known, self.numbers[k::rounds], _in_all(report, k, rounds))
            beside = beside.with_found(some)
            poses |= dict(zip(some.numbers, some.T_cw, strict=True))
            known |= poses
        numbers = tuple(sorted(poses))
        times = np.array([self._times[k] for k in numbers])
        own = beside.at(times)
        T_cw = np.array([poses[k] for k in numbers]).reshape(-1, 4, 4)
        return FoundFrames(numbers, times, T_cw, own.position, own.rotation)

    def _find(
        self,
        known: Mapping[int, Float64[np.ndarray, "4 4"]],
        wanted: Sequence[int],
        report: StageProgress,
    ) -> FoundFrames:
        """Lost frames found by known ones, with sufficient accuracy."""
        near = about(wanted, known)
        if not near:
            return FoundFrames.none()
        frames = _read(self._video, {*wanted, *near})
        frames = [replace(f, image=self._views.alike(f.index, f.image)) for f in frames]
        T_cw = [known.get(frame.index) for frame in frames]
        view = self._views.view
        found = place_lost(frames, T_cw, as_seen(view), self._seed, report)
        # Factor on standard deviations where the readout is unknown, so rows were not rectified.
        # Measured on a phone's video with a truth (docs/notebook/photographs.md).
        times = 1.0 if self._video.shutter.is_told else 3.0
        # A lost frame's own lens change acts like a rotation, and is not known from keyframes.
        rotation = np.hypot(times * found.rotation, math.sqrt(2) * view.lens.varies_centre)
        found = replace(found, position=times * found.position, rotation=rotation)
        return found.of(found.position <= self._most_deviation)


def about(wanted: Iterable[int], known: Collection[int]) -> set[int]:
    """Known frames nearest to any wanted one, before and after it."""
    near = set[int]()
    ascending = sorted(known)
    for number in wanted:
        at = bisect_left(ascending, number)
        near.update(ascending[max(0, at - NEIGHBOURS) : at + NEIGHBOURS])
    return near


def as_seen(view: StraightView) -> Calibration:
    """Calibration of the working images, with what was found of it since."""
    return Calibration.of(view.seen_by)


def _read(video: Source, numbers: Collection[int]) -> list[Frame]:
    """Some frames of a video, in time order."""
    frames = list[Frame]()
    last = max(numbers)
    with closing(iter(video)) as stream:
        for frame in stream:
            if frame.index in numbers:
                frames.append(frame)
            if frame.index >= last:
                break
    return frames


def _in_all(report: StageProgress, round: int, rounds: int) -> StageProgress:
    """Map the progress of one stage of one round to that of the whole search."""
    stages = list(SECONDS_PER_FRAME)

    def of_all(stage: str, fraction: float) -> None:
        before = sum(SECONDS_PER_FRAME[s] for s in stages[: stages.index(stage)])
        done = before + SECONDS_PER_FRAME[stage] * fraction
        report(STAGE, (round + done / sum(SECONDS_PER_FRAME.values())) / rounds)

    return of_all
