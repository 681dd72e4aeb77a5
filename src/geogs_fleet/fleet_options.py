"""Options of a fleet and of a join: which sources, where they are computed, what each may take."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from geogs.config import Config, Preset
from geogs.config.setting import Basic, Positional, Range, Settings, Time, Unnamed, Weight


@dataclass(frozen=True)
class FleetOptions(Settings):
    """Reconstruct many videos, each on its own, on one machine or many: geogs fleet run clips/.

    Every machine needs Ray: pip install 'geogs[fleet]'. If the same command is started again, it
    skips finished videos and continues the others from their checkpoints.
    """

    source: Annotated[tuple[str, ...], Positional()] = ()
    """Videos, folders of images, folders that contain these, patterns such as 'clips/*.mp4', text
    files (.txt) with one source a line, or addresses such as https://host/clip.mp4."""
    config: Annotated[Config, Unnamed] = field(default_factory=Config)
    """Settings of each run, as for geogs run."""
    output: Annotated[str, Basic("-o")] = "out/fleet"
    """Folder for the results, or an address such as s3://bucket/folder. Each source gets its own
    subfolder. Every machine must be able to open it under this name."""
    address: Annotated[str, Basic()] = "auto"
    """Ray cluster to use: auto (a running one, else a new one on this machine), local (a new one on
    this machine), HOST:PORT or ray://HOST:PORT."""
    gpus: Annotated[float, Range(0, 16), Basic()] | Literal["auto"] = "auto"
    """GPUs for each source: with 0.5 two sources share a GPU, with 0 the CPU computes; auto is 1 if
    the cluster has a GPU, else 0."""
    cpus: Annotated[int, Range(1, 256), Basic()] | Literal["auto"] = "auto"
    """CPU cores and threads for each source; auto is 1 on the CPU, and on a GPU an equal part of
    the machine's cores."""
    time_limit: Annotated[float | None, Range(above=0), Time, Basic()] = None
    """Time limit for each source, such as 90s, 10m or 1h; no limit by default."""
    memory_limit: Annotated[float | None, Range(above=0), Basic()] = None
    """Memory limit for each source, GiB; no limit by default."""
    attempts: Annotated[int, Range(1, 100)] = 3
    """Number of attempts for a source if its machine or process fails."""
    checkpoint_every: Weight = 60.0
    """Seconds between two checkpoints of a source, from which another machine can continue."""
    keyframe_images: bool = True
    """Keep the images of the keyframes, which geogs mesh and geogs export need."""
    preset: Preset = "default"
    """Group of settings; options that are given as well override it."""
    quiet: Annotated[bool, Basic("-q")] = False
    """Print errors only."""


@dataclass(frozen=True)
class JoinOptions(FleetOptions):
    """Join overlapping videos of one place to one map: geogs fleet join a.mp4 b.mp4 c.mp4.

    Each video is reconstructed on its own, on one machine or many; then the results are joined
    where their keyframes show the same. Every machine needs Ray: pip install 'geogs[fleet]'.
    """

    source: Annotated[tuple[str, ...], Positional()] = ()
    """Overlapping parts of one place: videos and folders of images, which are reconstructed first,
    or results of geogs run and geogs fleet run."""
    output: Annotated[str, Basic("-o")] = "out/joined"
    """Folder for the joint result; parts that are reconstructed first go to its subfolder parts/.
    Every machine must be able to open it under this name."""
    adjust: Annotated[bool, Basic()] = True
    """Adjust the poses of all keyframes with the matches between overlapping parts; without it, the
    parts are only moved and bent to fit each other."""
    overwrite: bool = False
    """Replace the result that is in the folder; it stays until the new one is complete."""
