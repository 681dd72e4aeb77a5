"""The result of a run or a reconstruction, in memory."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from geogs.application.progress.run_progress import RunProgress
from geogs.application.results.surfaces import surface_of
from geogs.application.results.verdict import Verdict, verdict
from geogs.geometry.camera import Camera
from geogs.geometry.given_pose import GivenPose
from geogs.io.sources.frame_source import Source
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.mapping.rendered import RenderedView
from geogs.mesh.triangle_mesh import Mesh
from geogs.threads import on_one_torch_thread
from geogs.types import MapSnapshot, RenderedKeyframe, Trajectory, Uncertainty

if TYPE_CHECKING:
    from geogs.application.results.mapped_scene import MappedScene


@dataclass(frozen=True, repr=False)
class Result:
    """The result for a scene; each part is computed at its first use, then kept."""

    scene: "MappedScene"
    """A finished ``Slam`` or ``Reconstruction``."""
    source: Source | PosedSource
    """Its source, read to the end."""
    is_interrupted: bool = False
    """Whether the final stages were left out, or cut short."""
    progress: RunProgress = field(default_factory=RunProgress)
    """Follows the extraction of the mesh."""
    folder: Path | None = None
    """Folder to which it was written; none where it was not."""
    can_resume: bool = False
    """Whether it was interrupted, and a checkpoint in the folder holds the work so far."""

    def __repr__(self) -> str:
        where = "not written" if self.folder is None else repr(str(self.folder))
        counts = f"{self.scene.frames} frames, {len(self.map)} disks"
        return f"Result({where}: {counts})"

    @property
    def camera(self) -> Camera:
        """Camera of the frames."""
        return self.source.camera

    @on_one_torch_thread
    def render(self, T_cw: GivenPose, camera: Camera | None = None) -> RenderedView:
        """The map seen from a pose; as :meth:`MapRenderer.render`."""
        return self.scene.renderer().render(T_cw, camera)

    @cached_property
    def trajectory(self) -> Trajectory:
        """Poses of all frames."""
        return self.scene.trajectory()

    @cached_property
    def keyframes(self) -> Trajectory:
        """Poses of the keyframes alone."""
        return self.scene.keyframe_trajectory()

    @cached_property
    def uncertainty(self) -> Uncertainty | None:
        """Standard deviations of the frames; none where the poses were given."""
        return self.scene.uncertainty()

    @cached_property
    def verdict(self) -> Verdict | None:
        """Reliability of trajectory and shape; none where the poses were given."""
        if self.uncertainty is None:
            return None
        source = self.source
        said = source.calibration.refinement if isinstance(source, Source) else None
        return verdict(
            self.trajectory,
            self.keyframes,
            self.uncertainty,
            self.why_no_map or "",
            said is None or said.is_explained,
        )

    @property
    def why_no_map(self) -> str | None:
        """Reason why no map could be started, where only orientations are known; else none."""
        reason = self.scene.statistics().get("not_started")
        return None if reason is None else str(reason)

    @cached_property
    def map(self) -> MapSnapshot:
        """The disks."""
        return self.scene.snapshot()

    @cached_property
    def renders(self) -> Sequence[RenderedKeyframe]:
        """The map seen from every keyframe."""
        return self.scene.renders()

    @cached_property
    def mesh(self) -> Mesh | None:
        """The surface of the map; none where none was found, or where depths are too uncertain,
        which ``progress`` then reports."""
        if self.verdict is not None and not self.verdict.has_shape:
            self.progress.write("No mesh: the depths could not be determined.")
            return None
        renders = self.renders
        with self.scene.stopwatch("mesh"):
            return surface_of(renders, self.scene.config.mesh, self.progress)
