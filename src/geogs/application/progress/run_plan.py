"""How long the stages of ``geogs run`` take, on a machine of reference."""

import math
from dataclasses import dataclass
from typing import ClassVar

from geogs.application.progress.mesh_plan import mesh_seconds, mesh_stage
from geogs.config import Config
from geogs.mapping.mapper import SEARCHED
from geogs.tracking.flow.classical_flow import SMALL_IMAGE

PIXELS = 320 * 240
"""Of the images of the reference on a CPU, and of its maps."""
BEFORE_MAP = ("calibration", "shutter", "frames", "bundle adjustment")
"""Stages of a run until all keyframes have been adjusted."""
AT_START = 12
"""Keyframes that the start of the map takes."""


@dataclass(frozen=True)
class StageCosts:
    """Seconds on a machine of reference."""

    calibration: float
    shutter: float
    frame: float
    start: float
    """Of the map, from the first frames."""
    keyframe: float
    """After those of the start."""
    adjusted_keyframe: float
    searched_keyframe: float
    step: float
    meshed_keyframe: float
    mesh: float
    report: float


# 600 x 340 on an H200 with eight cores, whatever the size; on a CPU two cores are the reference.
ON_GPU = StageCosts(1.5, 0.3, 0.006, 0.5, 0.03, 0.02, 0.02, 0.004, 0.05, 3.0, 1.0)


@dataclass(frozen=True)
class RunPlan:
    """What a run is going to do."""

    config: Config
    frames: int
    size: tuple[int, int]
    """Width and height of the working images."""
    on_gpu: bool
    calibrates: bool
    maps_at_end: bool
    end: ClassVar[None] = None
    """No time is given."""
    fixed: ClassVar[tuple[str, ...]] = ()
    """Stages that take their time whatever is given: none, as there is no end."""

    @property
    def costs(self) -> StageCosts:
        """On the machine of reference."""
        if self.on_gpu:
            return ON_GPU
        width, height = self.size
        worked_on, longer = width * height / PIXELS, max(width, height)
        fine = self.config.tracking.fine_adjustment
        matched = worked_on if fine or longer <= SMALL_IMAGE else worked_on / 4
        rendered = worked_on * min(self.config.mapping.render_long_edge / longer, 1.0) ** 2
        return StageCosts(
            calibration=3.0 + 6.0 * worked_on,
            shutter=0.7 * worked_on,
            frame=0.025 * worked_on,
            start=2.2 * worked_on,
            keyframe=0.36 * worked_on,
            adjusted_keyframe=(0.18 if fine else 0.08) * worked_on + 0.1 * matched,
            searched_keyframe=0.1 + 0.3 * rendered * self.config.mapping.depth.planes / 64,
            step=0.016 + 0.025 * rendered,
            meshed_keyframe=0.02 + 0.12 * rendered,
            mesh=1.0,
            report=0.6,
        )

    def tracked(self, frames: int, keyframes: float | int) -> float:
        """Seconds of so many frames, with what is mapped on the way."""
        c, mapping = self.costs, self.config.mapping
        first = c.start * min(keyframes / AT_START, 1.0)
        of_map = 0.0
        if not self.maps_at_end:
            of_map = c.searched_keyframe + c.step * mapping.iterations
        more = max(keyframes - AT_START, 0.0)
        return c.frame * frames + first + c.keyframe * more + of_map * keyframes

    def seconds(self, keyframes: float | int) -> dict[str, float]:
        """Of each stage in its order, with so many keyframes."""
        c, mapping = self.costs, self.config.mapping
        search, steps = c.searched_keyframe * keyframes, mapping.final_steps(self.on_gpu)
        if self.maps_at_end:
            steps = mapping.steps_at_once(math.ceil(keyframes), self.on_gpu)
        else:
            search *= mapping.final_depth
        return {
            "calibration": c.calibration * self.calibrates,
            "shutter": c.shutter,
            "frames": self.tracked(self.frames, keyframes),
            "bundle adjustment": c.adjusted_keyframe * keyframes,
            "depth": search,
            "training": c.step * steps,
            **mesh_seconds(c.mesh + c.meshed_keyframe * keyframes),
            "report": c.report,
        }

    def seconds_to_map(self, keyframes: float | int) -> float:
        """Of what is left once all keyframes have been adjusted."""
        stages = self.seconds(keyframes)
        return sum(stages.values()) - sum(stages[name] for name in BEFORE_MAP)

    def at(self, reported: str, fraction: float) -> tuple[str, float]:
        """Stage and its finished part, where so much of something is reported as done; another name
        where that is not planned. Mapping is the search of depths, then the training."""
        if reported not in ("mapping", "map refinement"):
            return mesh_stage(reported, fraction)
        searched = SEARCHED * (self.maps_at_end or self.config.mapping.final_depth)
        if fraction < searched:
            return "depth", fraction / searched
        return "training", (fraction - searched) / (1 - searched)
