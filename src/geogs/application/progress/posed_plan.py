"""How long the stages take of a map from known poses, and what finds the poses, if they are not."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from geogs.application.progress.mesh_plan import mesh_seconds, mesh_stage
from geogs.application.progress.run_plan import PIXELS
from geogs.config import ReconstructConfig


@dataclass(frozen=True)
class PosedCosts:
    """Seconds on a machine of reference."""

    first_look: float
    view: float
    """Read."""
    searched_view: float
    grown_view: float
    step: float
    meshed_view: float
    mesh: float
    report: float


# Rendered at 800 pixels on an H200; on a CPU two cores are the reference.
ON_GPU = PosedCosts(1.0, 0.01, 0.02, 0.01, 0.006, 0.05, 3.0, 1.0)


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
        """What finds the poses."""
        return self.before

    def tracked(self, frames: int, keyframes: float | int) -> float:
        """No time."""
        return 0.0

    def seconds(self, keyframes: float | int) -> dict[str, float]:
        """Of each stage in its order."""
        (width, height), search = self.size, self.config.search
        smaller = min(self.config.mapping.render_long_edge / max(width, height), 1.0)
        rendered = width * height * smaller**2 / PIXELS
        c = ON_GPU if self.on_gpu else PosedCosts(
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
            **mesh_seconds(c.mesh + c.meshed_view * views),
            "report": c.report,
        }

    def at(self, reported: str, fraction: float) -> tuple[str, float]:
        """As reported."""
        return mesh_stage(reported, fraction)
