"""How long the stages of a command take, on a machine of reference."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from geogs.config import Config, ReconstructConfig
from geogs.mapping.mapper import SEARCHED
from geogs.tracking.flow.classical_flow import SMALL_IMAGE

PIXELS = 320 * 240
"""Pixels of the images of the reference on a CPU, and of its maps."""
BEFORE_MAP = ("calibration", "frames", "bundle adjustment")
"""Stages of a run until all keyframes have been adjusted."""
AT_START = 12
"""Keyframes that the start of the map takes."""
_FUSED, _SURFACE, _COLOURED, _MERGED = 0.25, 0.25, 0.15, 0.35
"""Fractions of a mesh's time; the surface is found and cleaned once all views have been fused."""


@dataclass(frozen=True)
class RunCosts:
    """Seconds of each part of a run on a machine of reference."""

    calibration: float
    frame: float
    start: float
    """The start of the map, from the first frames."""
    keyframe: float
    """Each keyframe after those of the start."""
    adjusted_keyframe: float
    searched_keyframe: float
    step: float
    meshed_keyframe: float
    mesh: float
    report: float


@dataclass(frozen=True)
class PosedCosts:
    """Seconds of each part of a map from known poses on a machine of reference."""

    first_look: float
    view: float
    """Reading a view."""
    searched_view: float
    grown_view: float
    step: float
    meshed_view: float
    mesh: float
    report: float


# An H200: of runs at 600 x 340 with eight cores, whatever the size; of known poses at 800 pixels.
# On a CPU two cores are the reference.
RUN_ON_GPU = RunCosts(5.0, 0.006, 0.5, 0.03, 0.02, 0.02, 0.004, 0.05, 3.0, 1.0)
POSED_ON_GPU = PosedCosts(1.0, 0.01, 0.02, 0.01, 0.006, 0.05, 3.0, 1.0)


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
    def costs(self) -> RunCosts:
        """Seconds of each part on the machine of reference."""
        if self.on_gpu:
            return RUN_ON_GPU
        width, height = self.size
        worked_on, longer = width * height / PIXELS, max(width, height)
        fine = self.config.tracking.fine_adjustment
        matched = worked_on if fine or longer <= SMALL_IMAGE else worked_on / 4
        rendered = worked_on * min(self.config.mapping.render_long_edge / longer, 1.0) ** 2
        return RunCosts(
            calibration=2.0 + 4.0 * worked_on,
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
        """Seconds of each stage in its order, with so many keyframes."""
        c, mapping = self.costs, self.config.mapping
        search, steps = c.searched_keyframe * keyframes, mapping.final_steps(self.on_gpu)
        if self.maps_at_end:
            steps = mapping.steps_at_once(math.ceil(keyframes), self.on_gpu)
        else:
            search *= mapping.final_depth
        return {
            "calibration": c.calibration * self.calibrates,
            "frames": self.tracked(self.frames, keyframes),
            "bundle adjustment": c.adjusted_keyframe * keyframes,
            "depth": search,
            "training": c.step * steps,
            **_mesh_seconds(c.mesh + c.meshed_keyframe * keyframes),
            "report": c.report,
        }

    def seconds_to_map(self, keyframes: float | int) -> float:
        """Seconds left once all keyframes have been adjusted."""
        stages = self.seconds(keyframes)
        return sum(stages.values()) - sum(stages[name] for name in BEFORE_MAP)

    def at(self, reported: str, fraction: float) -> tuple[str, float]:
        """Stage and its finished part, where so much of something is reported as done; another name
        where that is not planned. Mapping is the search of depths, then the training."""
        if reported not in ("mapping", "map refinement"):
            return _mesh_stage(reported, fraction)
        searched = SEARCHED * (self.maps_at_end or self.config.mapping.final_depth)
        if fraction < searched:
            return "depth", fraction / searched
        return "training", (fraction - searched) / (1 - searched)


@dataclass(frozen=True)
class PosedPlan:
    """What a reconstruction is going to do, or a run that places frames without tracking."""

    config: ReconstructConfig
    views: int
    """Images that make the map."""
    size: tuple[int, int]
    """Width and height of the working images."""
    on_gpu: bool
    before: Mapping[str, float] = field(default_factory=dict)
    """Seconds of each stage before it, such as those that find the poses."""
    end: float | None = None
    """When it is to be done, by the performance counter, where a time is given."""
    frames: ClassVar[int] = 0
    """None is tracked."""

    @property
    def fixed(self) -> Collection[str]:
        """Stages that take their time whatever is given: what finds the poses."""
        return self.before

    def tracked(self, frames: int, keyframes: float | int) -> float:
        """No time."""
        return 0.0

    def seconds(self, keyframes: float | int) -> dict[str, float]:
        """Seconds of each stage in its order."""
        (width, height), search = self.size, self.config.search
        smaller = min(self.config.mapping.render_long_edge / max(width, height), 1.0)
        rendered = width * height * smaller**2 / PIXELS
        c = POSED_ON_GPU if self.on_gpu else PosedCosts(
            first_look=2.0, view=0.01, searched_view=0.1 + 1.3 * rendered, grown_view=0.03,
            step=0.04 + 0.03 * rendered, meshed_view=0.02 + 0.25 * rendered, mesh=1.0, report=0.6,
        )  # fmt: skip
        views = min(self.views, search.most_views)
        steps = max(search.least_steps, search.steps_per_view * views)
        return {
            **self.before,
            "first look": c.first_look,
            "reading": c.view * views,
            "depth": c.searched_view * views * (2 if search.repeat else 1),
            "growing": c.grown_view * views,
            "training": c.step * steps,
            **_mesh_seconds(c.mesh + c.meshed_view * views),
            "report": c.report,
        }

    def at(self, reported: str, fraction: float) -> tuple[str, float]:
        """Stage and its finished part, as reported."""
        return _mesh_stage(reported, fraction)


Plan = RunPlan | PosedPlan


def _mesh_seconds(whole: float) -> dict[str, float]:
    """Seconds of each stage of a mesh that takes so many."""
    parts = {"fuse": _FUSED + _SURFACE, "colour": _COLOURED, "merge": _MERGED}
    return {f"mesh: {name}": part * whole for name, part in parts.items()}


def _mesh_stage(reported: str, fraction: float) -> tuple[str, float]:
    """Stage and its finished part, by what is reported of a mesh: the surface has no word."""
    if reported == "mesh: fuse":
        fraction *= _FUSED / (_FUSED + _SURFACE)
    return reported, fraction
