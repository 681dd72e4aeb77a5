"""How long a command is going to take, from its first report to its last file."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from geogs.application.progress.plan import Plan

Clock = Callable[[], float]

FIRST_KEYFRAMES, KEYFRAMES_PER_FRAME = 12.0, 0.13
"""Keyframes that are expected of a video before it has shown how many it has."""
PRIOR_FRAMES = 15
"""Frames that the expected rate of keyframes weighs as much as, against those that were seen."""
MIN_START_FRAMES = 45
"""Frames within which a start of the map says nothing of that rate."""
QUARTER_WEIGHT_SECONDS, STAGE_WEIGHT = 5.0, 5.0
"""Seconds of the reference at which a stage weighs a quarter of a long one for the pace, and the
weight of that one, where the pace of the reference weighs 1."""
TOLERANCE_SECONDS = 0.5
"""Seconds by which stages may differ without saying anything."""
MAX_LOG_PACE = math.log(3.0)
"""Largest logarithm of the pace of a single stage: one may have had nothing to do."""
MIN_FRACTION_LEFT = 0.3
"""Fraction of what was left at the last report that stays left, however long ago that was."""
MIN_SECONDS_LEFT = 0.5
"""Seconds that are left until the end, where the time that was given is over."""
MIN_MAP_SECONDS = 17.0
"""Seconds that the smallest map takes with mesh and files where poses have used up the time."""
SMOOTHING = 0.04
"""Time constant of the shown figure, as a fraction of the time left."""


@dataclass
class _Stage:
    """How far a stage is; mutable."""

    name: str
    began: float
    """Time of its beginning, later by what was done aside since."""
    part: float = 0.0
    reported: float = 0.0
    """Time of its last report, by the same clock."""


class Forecast:
    """Seconds left of a command by what it has reported: one steady figure for all of it."""

    def __init__(self, plan: "Plan", clock: Clock = time.perf_counter) -> None:
        self._plan, self._clock = plan, clock
        self._said_at = self._rest_began = clock()
        """The latter is when what finds poses had ended, if anything has to."""
        self._said = math.nan
        self._stage: _Stage | None = None
        """The last of those that were planned."""
        self._aside: _Stage | None = None
        """What is done instead; none while the other goes on."""
        self._begun = self._first = self._now = (0, 0)
        """Frames and keyframes before it began, when there were keyframes first, and by now."""
        self._found_at = self._said_at
        self._keyframes = FIRST_KEYFRAMES + KEYFRAMES_PER_FRAME * plan.frames
        self._paces: dict[bool, list[tuple[float, float]]] = {True: [], False: []}
        """Seconds that each stage took, and takes on the reference: of the others, and of those
        that find poses, whose time depends on the pictures more than on the machine."""
        self._found = self._by_now()

    def change(self, plan: "Plan") -> None:
        """Something else is done from now on; the pace of the machine stays known."""
        now = self._clock()
        self._end_aside(now)
        self._end_stage(now)
        self._plan, self._stage, self._rest_began = plan, None, now
        self._found, self._found_at = self._by_now(), now

    def expect(self, begun: int) -> None:
        """Before the first frame, where so many were done before."""
        self._begun = begun, 0

    def frame(self, frames: int, keyframes: int) -> None:
        """After each frame."""
        self._now = frames, keyframes
        if frames == self._begun[0] + 1 > 1:
            self._begun = self._begun[0], keyframes
        if not self._first[1]:
            self._first = self._now
        seen, more = frames - self._first[0], keyframes - self._first[1]
        # What has not come yet by now comes seldom.
        of_start = FIRST_KEYFRAMES / max(self._first[0] - self._begun[0], MIN_START_FRAMES)
        expected = min(math.sqrt(KEYFRAMES_PER_FRAME * of_start), 1.0)
        rate = (more + PRIOR_FRAMES * expected) / (seen + PRIOR_FRAMES)
        left = max(self._plan.frames - frames, 0)
        self._keyframes = (keyframes or FIRST_KEYFRAMES) + rate * left
        self.stage("frames", frames / max(self._plan.frames, frames))

    def stage(self, name: str, fraction: float) -> None:
        """After each part of a stage, such as ``mesh: fuse``."""
        name, part = self._plan.at(name, fraction)
        now = self._clock()
        if name not in self._plan.seconds(0.0):
            if self._aside is None or self._aside.name != name:
                self._end_aside(now)
                self._aside = _Stage(name, now)
            self._aside.part = part
        else:
            self._end_aside(now)
            if self._stage is None or self._stage.name != name:
                self._stage = _Stage(name, self._end_stage(now))
            self._stage.part, self._stage.reported = part, now
        self._found, self._found_at = self._by_now(), now

    def _end_stage(self, now: float) -> float:
        """Count how long it took for the pace. Returns when it ended: what comes between it and the
        next one's first report counts for that."""
        if (stage := self._stage) is None:
            return now
        end = stage.reported if stage.part >= 1 else now
        if stage.name in self._plan.fixed:
            self._rest_began = end
        took = end - stage.began, self._planned()[stage.name]
        self._paces[stage.name not in self._plan.fixed].append(took)
        return end

    def _end_aside(self, now: float) -> None:
        """Count what was done aside for no stage, nor for the pace."""
        if self._aside is not None and self._stage is not None:
            self._stage.began += now - self._aside.began
            self._stage.reported += now - self._aside.began
        self._aside = None

    def _planned(self) -> dict[str, float]:
        """Seconds of each stage, without what was done before."""
        planned = self._plan.seconds(self._keyframes)
        if "frames" in planned:
            planned["frames"] -= self._plan.tracked(*self._begun)
        return planned

    def left(self) -> float:
        """Seconds left now: it goes down with the clock, and follows news by and by."""
        now = self._clock()
        passed, self._said_at = now - self._said_at, now
        found = max(self._found - (now - self._found_at), MIN_FRACTION_LEFT * self._found)
        if math.isnan(self._said):
            self._said = found
        else:
            expected = max(self._said - passed, 0.0)
            news = 1 - math.exp(-passed / max(SMOOTHING * found, 1e-3))
            self._said = expected + news * (found - expected)
        return self._said

    def _by_now(self) -> float:
        """Seconds left when something is reported, by all that has been."""
        stages, stage, now = self._planned(), self._stage, self._clock()
        names, until, own = list(stages), now if self._aside is None else self._aside.began, 0.0
        place, paces = -1, {of_map: list(said) for of_map, said in self._paces.items()}
        if stage is not None:
            place, part = names.index(stage.name), self._part_of(stage, stages)
            same = paces[stage.name not in self._plan.fixed]
            same.append((until - stage.began, part * stages[stage.name]))
            own = _left(pace_of(same) * stages[stage.name], until - stage.began, part)
        if self._aside is not None:
            own += _left(0.0, now - self._aside.began, self._aside.part)
        seconds = {True: 0.0, False: 0.0}
        for name in names[place + 1 :]:
            seconds[name not in self._plan.fixed] += stages[name]
        of_poses = pace_of(paces[False]) * seconds[False]
        if self._plan.end is None:
            return own + of_poses + pace_of(paces[True]) * seconds[True]
        rest = MIN_MAP_SECONDS
        if stage is None or stage.name in self._plan.fixed:
            of_poses += own
        else:
            rest -= until - self._rest_began
        # The map takes what the poses leave, but for the smallest one.
        return max(self._plan.end - now, of_poses + max(rest, MIN_SECONDS_LEFT))

    def _part_of(self, stage: _Stage, stages: dict[str, float]) -> float:
        """Finished fraction of its time; of the frames those with keyframes take most."""
        if stage.name != "frames":
            return stage.part
        done = self._plan.tracked(*self._now) - self._plan.tracked(*self._begun)
        return min(done / max(stages["frames"], 1e-9), 1.0)


def pace_of(stages: Sequence[tuple[float, float]]) -> float:
    """Time of a machine over that of the reference, by the seconds that stages took of both.

    Long stages all weigh the same, as each is expected wrongly for reasons of its own.
    """
    total_weight, total = 1.0, 0.0
    for took, expected in stages:
        weight = STAGE_WEIGHT * (expected / (expected + QUARTER_WEIGHT_SECONDS)) ** 2
        pace = math.log((took + TOLERANCE_SECONDS) / (expected + TOLERANCE_SECONDS))
        total_weight += weight
        total += weight * min(max(pace, -MAX_LOG_PACE), MAX_LOG_PACE)
    return math.exp(total / total_weight)


def _left(expected: float, since: float, part: float) -> float:
    """Seconds left of a stage that takes about so many, ``since`` so many: by how much of it is
    done, the better the more that is."""
    left = max(expected * (1 - part), 0.05 * since * (part < 1))
    if part > 0:
        left += min(1.0, 2 * part) * (since * (1 - part) / part - left)
    return left
