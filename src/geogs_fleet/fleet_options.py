"""Options of a fleet and of a join: which sources, where they are computed, what each may take."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from geogs.config import Config, Preset
from geogs.config.setting import Basic, Positional, Range, Settings, Time, Unnamed, Weight


@dataclass(frozen=True)
class FleetOptions(Settings):
    """Reconstruct many videos, each on its own, on one machine or many: geogs fleet run clips/.

    Needs pip install 'geogs[fleet]' (Ray) on every machine. Started again, it does what is missing,
    and goes on from the checkpoints of what was under way.
    """

    source: Annotated[tuple[str, ...], Positional()] = ()
    """Videos and folders of images, patterns such as 'clips/*.mp4', folders of such, or text files
    (.txt) that name one a line; also addresses such as https://host/clip.mp4."""
    config: Annotated[Config, Unnamed] = field(default_factory=Config)
    """How to compute, as of geogs run."""
    output: Annotated[str, Basic("-o")] = "out/fleet"
    """Folder for the results, with one for each source, or an address such as s3://bucket/folder;
    every machine has to reach it under this name."""
    address: Annotated[str, Basic()] = "auto"
    """Ray cluster: auto (one that runs, else one is started on this machine), local (always started
    on this machine), HOST:PORT or ray://HOST:PORT."""
    gpus: Annotated[float, Range(0, 16), Basic()] | Literal["auto"] = "auto"
    """GPUs for each source: 0.5 has two sources share one, 0 computes on the CPU; auto is one where
    the cluster has any."""
    cpus: Annotated[int, Range(1, 256), Basic()] | Literal["auto"] = "auto"
    """Cores, and threads, for each source; auto is one, or its GPU's share of the machine's."""
    time_limit: Annotated[float | None, Range(above=0), Time, Basic()] = None
    """How long one source may take, such as 90s, 10m or 1h; none lets it take what it needs."""
    memory_limit: Annotated[float | None, Range(above=0), Basic()] = None
    """Memory that one source may take, GiB; none lets it take what it needs."""
    attempts: Annotated[int, Range(1, 100)] = 3
    """How often a source is tried whose machine or process fails."""
    checkpoint_every: Weight = 60.0
    """Seconds between two checkpoints of a source, from which another machine goes on."""
    keyframe_images: bool = True
    """Keep the images of the keyframes, which geogs mesh and geogs export use."""
    preset: Preset = "default"
    """Group of settings; single ones given beside it win."""
    quiet: Annotated[bool, Basic("-q")] = False
    """Say nothing but errors."""


@dataclass(frozen=True)
class JoinOptions(FleetOptions):
    """Make one place of many videos that overlap: geogs fleet join a.mp4 b.mp4 c.mp4.

    Each is run by itself, on one machine or many; where keyframes of two show the same, they are
    joined. Needs pip install 'geogs[fleet]' (Ray) on every machine.
    """

    source: Annotated[tuple[str, ...], Positional()] = ()
    """Parts of one place that overlap: videos and folders of images, as of geogs fleet run, which
    are run first; results of geogs run, or of geogs fleet run."""
    output: Annotated[str, Basic("-o")] = "out/joined"
    """Folder for the joint result, with one for each part that is run in parts/; every machine has
    to see it under this name."""
    adjust: Annotated[bool, Basic()] = True
    """Adjust the keyframes with the matches of overlapping parts; else the parts, and the pairs of
    keyframes that show one place, alone say where they are."""
