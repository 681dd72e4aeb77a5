"""How long a run is going to take, from its first frame to its last file."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from geogs.config import Config

Clock = Callable[[], float]

FIRST_KEYFRAMES, KEYFRAMES_PER_FRAME = 8.0, 0.25
"""Keyframes that are expected of a video before it has shown how many it has."""
SURE_OF_KEYFRAMES = 30
"""Frames after the first keyframes by which their rate is known as well as it was expected."""
SURE_OF_PACE = 4.0
"""Seconds of the reference by which the pace of a machine is known as well as it was expected."""
PARTS = {
    "mesh: fuse": ("mesh", 0.0, 0.25),
    "mesh: colour": ("mesh", 0.5, 0.65),
    "mesh: merge": ("mesh", 0.65, 1.0),
    "depth": ("mapping", 0.0, 0.45),
    "growing": ("mapping", 0.45, 0.45),
    "training": ("mapping", 0.45, 1.0),
}
"""Of which stage something that is reported is a part, and where that begins and ends."""
LONGER = 0.3
"""Fraction of what was left at the last report that stays left, however long ago that was."""
STEADY = 0.15
"""Fraction of the time left within which it follows what has changed."""


@dataclass(frozen=True)
class StageCosts:
    """Seconds on a machine of reference."""

    calibration: float
    shutter: float
    frame: float
    keyframe: float
    start: float
    """Of the map, from the first frames."""
    adjusted_keyframe: float
    searched_keyframe: float
    step: float
    meshed_keyframe: float
    mesh: float
    report: float


# 320 x 240 on two cores, rendered at that size, and 600 x 340 on an H200 with eight.
ON_CPU = StageCosts(9.0, 0.5, 0.045, 0.29, 3.4, 0.08, 0.55, 0.034, 0.13, 1.5, 0.5)
RENDERED = 320
"""Longer side of the maps of the former, pixels."""
ON_GPU = StageCosts(1.5, 0.3, 0.006, 0.03, 0.5, 0.02, 0.02, 0.004, 0.05, 3.0, 1.0)


@dataclass(frozen=True)
class RunPlan:
    """What a run is going to do."""

    config: Config
    frames: int
    on_gpu: bool
    calibrates: bool
    maps_at_end: bool

    @property
    def costs(self) -> StageCosts:
        """On the machine of reference, a map of fewer pixels taking less time on a CPU."""
        if self.on_gpu:
            return ON_GPU
        part, c = min(self.config.mapping.render_long_edge / RENDERED, 1.0) ** 2, ON_CPU
        return replace(c, searched_keyframe=part * c.searched_keyframe, step=part * c.step)

    def tracked(self, frames: int, keyframes: float | int) -> float:
        """Seconds of so many frames, with what is mapped on the way."""
        c, mapping = self.costs, self.config.mapping
        a_keyframe = c.keyframe
        if not self.maps_at_end:
            a_keyframe += c.searched_keyframe + c.step * mapping.iterations
        return c.frame * frames + (c.start if keyframes else 0.0) + a_keyframe * keyframes

    def seconds(self, keyframes: float | int) -> dict[str, float]:
        """Of each stage in its order, with so many keyframes."""
        c, mapping = self.costs, self.config.mapping
        search, steps = c.searched_keyframe * keyframes, mapping.final_steps(self.on_gpu)
        if self.maps_at_end:
            steps = mapping.steps_at_once(math.ceil(keyframes), self.on_gpu)
            final = {"mapping": search + c.step * steps}
        else:
            final = {"map refinement": search * mapping.final_depth + c.step * steps}
        return {
            "calibration": c.calibration * self.calibrates,
            "shutter": c.shutter,
            "frames": self.tracked(self.frames, keyframes),
            "bundle adjustment": c.adjusted_keyframe * keyframes,
            **final,
            "mesh": c.mesh + c.meshed_keyframe * keyframes,
            "report": c.report,
        }


@dataclass
class _Stage:
    """How far a stage is; mutable."""

    name: str
    began: float
    """By the clock, later by what was done aside since."""
    part: float = 0.0


class RunForecast:
    """Seconds left of a run by what it has reported: one steady figure for all of it."""

    def __init__(self, plan: RunPlan, clock: Clock = time.perf_counter) -> None:
        self._plan, self._clock = plan, clock
        self._began = self._said_at = clock()
        """The first is later by what was done aside."""
        self._said = math.nan
        self._stage: _Stage | None = None
        """The last of those that were planned."""
        self._aside: _Stage | None = None
        """What is done instead; none while the other goes on."""
        self._begun = self._first = self._now = (0, 0)
        """Frames and keyframes before it began, when there were keyframes first, and by now."""
        self._found_at = self._began
        self._keyframes = FIRST_KEYFRAMES + KEYFRAMES_PER_FRAME * plan.frames
        self._found = self._by_now()

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
        rate = (more + SURE_OF_KEYFRAMES * KEYFRAMES_PER_FRAME) / (seen + SURE_OF_KEYFRAMES)
        left = max(self._plan.frames - frames, 0)
        self._keyframes = (keyframes or FIRST_KEYFRAMES) + rate * left
        self.stage("frames", frames / max(self._plan.frames, frames))

    def stage(self, name: str, fraction: float) -> None:
        """After each part of a stage, such as ``mesh: fuse``."""
        name, begin, end = PARTS.get(name, (name, 0.0, 1.0))
        now, part = self._clock(), begin + (end - begin) * fraction
        if name not in self._plan.seconds(0.0):
            if self._aside is None or self._aside.name != name:
                self._end_aside(now)
                self._aside = _Stage(name, now)
            self._aside.part = part
        else:
            self._end_aside(now)
            if self._stage is None or self._stage.name != name:
                self._stage = _Stage(name, now)
            self._stage.part = part
        self._found, self._found_at = self._by_now(), now

    def _end_aside(self, now: float) -> None:
        """What was done aside counts for no stage, nor for the pace."""
        if self._aside is not None:
            self._began += now - self._aside.began
            if self._stage is not None:
                self._stage.began += now - self._aside.began
        self._aside = None

    def _planned(self) -> dict[str, float]:
        """Of each stage, without what was done before."""
        planned = self._plan.seconds(self._keyframes)
        planned["frames"] -= self._plan.tracked(*self._begun)
        return planned

    def left(self) -> float:
        """Seconds left now: it goes down with the clock, and follows news by and by."""
        now = self._clock()
        passed, self._said_at = now - self._said_at, now
        found = max(self._found - (now - self._found_at), LONGER * self._found)
        if math.isnan(self._said):
            self._said = found
        else:
            expected = max(self._said - passed, 0.0)
            news = 1 - math.exp(-passed / max(STEADY * found, 1e-3))
            self._said = expected + news * (found - expected)
        return self._said

    def _by_now(self) -> float:
        """Seconds left when something is reported, by all that has been."""
        stages, stage, now = self._planned(), self._stage, self._clock()
        names, until, own = list(stages), now if self._aside is None else self._aside.began, 0.0
        place = -1 if stage is None else names.index(stage.name)
        done = sum(stages[name] for name in names[: max(place, 0)])
        part = 0.0 if stage is None else self._part_of(stage, stages)
        here = 0.0 if stage is None else stages[stage.name]
        spent = until - self._began
        pace = (spent + SURE_OF_PACE) / (done + part * here + SURE_OF_PACE)
        if stage is not None:
            own = _left(pace * here, until - stage.began, part)
        if self._aside is not None:
            own += _left(0.0, now - self._aside.began, self._aside.part)
        return own + pace * sum(stages[name] for name in names[place + 1 :])

    def _part_of(self, stage: _Stage, stages: dict[str, float]) -> float:
        """How much of it is done, by time; of the frames those with keyframes take most."""
        if stage.name != "frames":
            return stage.part
        done = self._plan.tracked(*self._now) - self._plan.tracked(*self._begun)
        return min(done / max(stages["frames"], 1e-9), 1.0)


def _left(expected: float, since: float, part: float) -> float:
    """Seconds left of a stage that takes about so many, ``since`` so many: by how much of it is
    done, the better the more that is."""
    left = max(expected * (1 - part), 0.05 * since * (part < 1))
    if part > 0:
        left += min(1.0, 2 * part) * (since * (1 - part) / part - left)
    return left
