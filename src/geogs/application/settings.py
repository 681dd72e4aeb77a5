"""What a run is made of: plain records, so that a command, a script and a checkpoint say the same.

Nothing here is imported but the settings, so that a command line can be read at once.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

from geogs.config import Config, MeshConfig


@dataclass(frozen=True)
class RunSettings:
    """All that a run is told: what it reads, how it computes, what it writes."""

    source: tuple[Path, ...] = ()
    """Video file or folder; several of one place, by one camera, make one map."""
    config: Config = field(default_factory=Config)
    """How to compute."""
    output: Path | None = None
    """Folder for the results (also -o); out/NAME if none is given."""
    device: str = "auto"
    """Where to compute: auto (a GPU where there is one), cpu, cuda or cuda:1; see geogs doctor."""
    checkpoint_every: float = 60.0
    """Seconds between two checkpoints, from which --resume goes on; 0 makes none."""
    online_results: bool = False
    """Also write trajectory and mesh as they are before the final stages, to online/."""
    depth_mesh: bool = False
    """Also fuse the keyframes' depths without the disks, to depth_fusion/mesh.ply."""

    def absolute(self) -> "RunSettings":
        """The same with paths that hold wherever the run is resumed from, and without a folder."""
        config = self.config
        prior, tracking = config.prior, config.tracking
        return replace(
            self,
            source=tuple(path.expanduser().absolute() for path in self.source),
            output=None,
            config=replace(
                config,
                input=replace(config.input, intrinsics=_file(config.input.intrinsics)),
                tracking=replace(tracking, weights=_file(tracking.weights)),
                prior=replace(
                    prior, model=_file(prior.model), card=_file(prior.card),
                    normal_model=_file(prior.normal_model), normal_card=_file(prior.normal_card),
                ),
            ),
        )  # fmt: skip

    def deciding(self) -> "RunSettings":
        """Only what decides about poses and map; all else has its default.

        Two runs on the same kind of device that differ elsewhere compute the same.
        """
        config = replace(self.absolute().config, mesh=MeshConfig())
        return RunSettings(self.absolute().source, config)


def _file(name: str) -> str:
    """The absolute path where that names a file; other words, such as auto, as they are."""
    return str(Path(name).absolute()) if name and Path(name).is_file() else name
