"""How long a run or a reconstruction will still take, final stages included."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from geogs.config import Config
from geogs.stopwatch import Stopwatch

SEARCH = 10.0
"""What the search of a keyframe's depth costs, in training steps of one view; measured on rendered
rooms on CPUs, as are the other factors here."""
FINAL_STEP = 0.85
"""What a step of the final training costs, in those of the training on the way."""
STEP_OF_TRACKING = {"cpu": 0.12, "cuda": 0.013}
"""What a training step costs where nothing was trained on the way, as a part of what tracking has
taken for each keyframe."""
ADJUSTMENT = 0.33
"""What the final adjustment of all keyframes costs, as a part of all tracking."""
MESH, MESH_SECONDS = 4.0, 3.0
"""What the mesh costs a keyframe, in training steps, and all of it besides."""
MESH_SHARES = {"fuse": 0.4, "colour": 0.3, "merge": 0.3}
"""Of its stages; what is done between two of them counts to the first."""
REPORT_STEPS, REPORT_SECONDS = 10.0, 1.5
"""What writing and the report cost: steps, but at least seconds."""
_FEW_MARKS = 8
"""Frames up to which the mean is that of all."""
_TRUST = 0.5
"""Part of the final stages as planned that counts as if it had been seen."""


@runtime_checkable
class Forecast(Protocol):
    """Tells how long the rest will take."""

    def after_frame(self, frames: int, keyframes: int) -> float | None:
        """Seconds left after so many frames; none where that cannot be said."""
        ...

    def after_stage(self, name: str, fraction: float) -> float | None:
        """Seconds left when a part of a stage, in [0, 1], is done."""
        ...


@dataclass
class StageForecast:
    """Stages one after the other, of each of which about how long it takes is known beforehand."""

    plan: Sequence[tuple[str, float]]
    """Beginnings of their names, and weights or seconds."""
    clock: Callable[[], float] = time.perf_counter
    trust: float = 0.0
    """Seconds of the plan that count as if they had been seen to last what they should; 0 where
    the plan has weights that are no seconds."""
    _begun: list[tuple[int, float]] = field(default_factory=list)
    """Number of each stage that has been, and when it began."""

    def after_frame(self, frames: int, keyframes: int) -> float | None:
        """Nothing: there are stages alone."""
        return None

    def after_stage(self, name: str, fraction: float) -> float | None:
        """Seconds that this stage, of which a part in [0, 1] is done, and all later ones will take;
        none where that cannot be said yet. Stages that are not planned take no time."""
        number = next((i for i, (n, _) in enumerate(self.plan) if name.startswith(n)), None)
        now = self.clock()
        if number is None:
            return None
        if not self._begun or number != self._begun[-1][0]:
            self._begun.append((number, now))
        first, start = self._begun[0][1], self._begun[-1][1]
        before = sum(self.plan[i][1] for i, _ in self._begun[:-1])
        planned = self.plan[number][1]
        inside = now - start
        # How much slower than planned it all went, the present stage as far as it is done.
        done = before + fraction * planned
        if done + self.trust <= 0 or now + self.trust <= first:
            return None
        pace = (now - first + self.trust) / (done + self.trust)
        rest = pace * planned * (1 - fraction)
        if fraction > 0:  # its own pace counts the more, the more of it is done
            rest += fraction * (inside * (1 - fraction) / fraction - rest)
        return rest + pace * sum(weight for _, weight in self.plan[number + 1 :])


@dataclass
class RunForecast:
    """The frames of a video, then the final stages."""

    config: Config
    stopwatch: Stopwatch
    """Of the run."""
    frames: int | None
    """Of the source, if that is known."""
    maps_at_the_end: bool = False
    """Whether all keyframes are mapped after the last frame."""
    device: str = "cpu"
    """cpu or cuda."""
    clock: Callable[[], float] = time.perf_counter

    def __post_init__(self) -> None:
        self._marks: list[tuple[int, float]] = []
        self._final: StageForecast | None = None
        self._keyframes = 0

    def after_frame(self, frames: int, keyframes: int) -> float | None:
        """Seconds left after so many frames; none where that cannot be said."""
        now = self.clock()
        if not self._keyframes:  # frames up to the first keyframes cost other than those after
            self._marks = []
        self._marks.append((frames, now))
        self._keyframes = keyframes
        if self.frames is None or len(self._marks) < 2 or not keyframes:
            return None
        share = frames / max(self.frames, frames)
        final = sum(seconds for _, seconds in self.final_stages(keyframes / share, 1 / share))
        return (self.frames - frames) * self._seconds_a_frame() + final

    def after_stage(self, name: str, fraction: float) -> float | None:
        """Seconds left within the stages after the last frame."""
        if self._final is None:
            plan = self.final_stages(self._keyframes, 1.0)
            trust = _TRUST * sum(seconds for _, seconds in plan)
            self._final = StageForecast(plan, self.clock, trust)
        return self._final.after_stage(name, fraction)

    def final_stages(self, keyframes: int | float, growth: float) -> list[tuple[str, float]]:
        """Stages after the last frame with their seconds, of a run of so many keyframes that has
        tracked for ``growth`` times as long as it has until now."""
        mapping, seconds = self.config.mapping, self.stopwatch.seconds
        tracking = growth * seconds.get("tracking", 0.0)
        on_gpu = self.device == "cuda"
        final, stage = float(mapping.final_steps(on_gpu)), "map refinement"
        if self.maps_at_the_end:
            final, stage = float(mapping.steps_at_once(round(keyframes), on_gpu)), "mapping"
            step = STEP_OF_TRACKING[self.device] * tracking / max(keyframes, 1)
        else:
            views = mapping.views_per_step or mapping.window + mapping.history
            a_keyframe = mapping.iterations * views + SEARCH
            step = growth * seconds.get("mapping", 0.0) / max(keyframes, 1) / a_keyframe
        if final and mapping.final_depth:
            final += SEARCH * keyframes
        return [
            ("bundle adjustment", ADJUSTMENT * tracking),
            (stage, FINAL_STEP * final * step),
            *mesh_stages(MESH * keyframes * step + MESH_SECONDS),
            ("report", max(REPORT_STEPS * step, REPORT_SECONDS)),
        ]

    def _seconds_a_frame(self) -> float:
        """The mean of the later half, as the first keyframes are trained with fewer views."""
        last, now = self._marks[-1]
        first, start = self._marks[len(self._marks) // 2 if len(self._marks) > _FEW_MARKS else 0]
        return (now - start) / max(last - first, 1)


FINDING_POSES = (
    ("features", 10.0), ("choosing pairs", 5.0), ("matching", 15.0), ("finding poses", 15.0),
    ("adjusting", 3.0), ("placing frames", 5.0),
)  # fmt: skip
"""Stages before a reconstruction whose poses have to be found."""


def reconstruction_forecast(finds_poses: bool = False) -> StageForecast:
    """That of a reconstruction from known poses, or from some that it finds before."""
    plan = list(FINDING_POSES) if finds_poses else []
    plan += [("first look", 6.0), ("reading", 4.0), ("depth", 35.0), ("training", 35.0)]
    return StageForecast([*plan, *mesh_stages(15.0), ("report", 5.0)])


def mesh_forecast() -> StageForecast:
    """That of a mesh alone."""
    return StageForecast(mesh_stages(1.0))


def mesh_stages(seconds: float) -> list[tuple[str, float]]:
    """The stages of a mesh that takes so long."""
    return [(f"mesh: {name}", share * seconds) for name, share in MESH_SHARES.items()]
