"""Settings of a fleet: which sources, where they are computed, what each may take."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from geogs.config import Config
from geogs.config.setting import Basic, Positional, Range, Settings, Time, Unnamed, Weight


@dataclass(frozen=True)
class FleetSettings(Settings):
    """All that a fleet of runs is given."""

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
