"""Inputs and settings of a run or a reconstruction, for a command, a script and a checkpoint.

This module imports only the settings, so that a command line can be read at once.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from geogs.application.named_files import with_absolute_paths
from geogs.config import Config, MeshConfig, ReconstructConfig
from geogs.config.setting import (
    RARE,
    Basic,
    Formerly,
    Port,
    Positional,
    Positive,
    Range,
    Settings,
    Time,
    Unnamed,
    Weight,
)


@dataclass(frozen=True)
class RunSettings(Settings):
    """Settings of a run: what it reads, how it computes, what it writes."""

    source: Annotated[tuple[Path, ...], Positional(unless=("resume", "print-config"))] = ()
    """Video, folder or data set; several of one place, by one camera, make one map. Or a live
    source: camera:0, rtsp://HOST/PATH, - (raw frames from a pipe), play:FILE (a file at its
    pace)."""
    config: Annotated[Config, Unnamed] = field(default_factory=Config)
    """How to compute."""
    output: Annotated[Path | None, Basic("-o")] = None
    """Folder for the results; without it out/NAME, or out/NAME-2 where that is taken."""
    device: str = "auto"
    """Where to compute: auto (a GPU where there is one), cpu, cuda or cuda:1; see geogs doctor."""
    checkpoint_every: Annotated[Weight, RARE] = 60.0
    """Seconds between two checkpoints, from which --resume goes on; 0 makes none."""
    map: Annotated[Path | None, Basic()] = None
    """Folder of an earlier result to localise in: of the same place and camera; its map stays where
    it is, and the new one adds to it."""
    scale_from: Annotated[str, Basic()] = ""
    """What is known in metres; the result is then in metres: FRAME:u1,v1,u2,v2=1.25m (pixels of
    an image as it came; several with semicolons), aruco:DICT_5X5_50:0.12 (tags whose side is so
    long), height:1.6 (of the camera over the ground), or sensor (with --depth)."""
    sfm: Annotated[bool, Formerly({"--offline": "--sfm", "--no-offline": "--no-sfm"})] = False
    """Structure from motion instead of tracking: pycolmap locates sharp frames, and all others are
    located against them; for videos that tracking cannot follow."""
    fallback: Annotated[bool, RARE] = True
    """Locate lost frames by structure from motion; if many are lost, or the result is not reliable,
    try --sfm and keep the better result (needs geogs[photos])."""
    online_results: Annotated[bool, RARE] = False
    """Also write trajectory and mesh as they are after the stream, to online/, and after the final
    bundle adjustment and the map's update, to adjusted/, where a refinement follows; all appear
    at the run's end, with the result."""
    depth_mesh: Annotated[bool, RARE] = False
    """Also fuse the keyframes' depths without the disks, to depth_fusion/mesh.ply."""
    keyframe_images: Annotated[bool, RARE] = True
    """Keep the images of the keyframes in keyframes/, which geogs mesh and geogs export use."""
    overwrite: bool = False
    """Replace the result that is in the folder; it stays until the new one is complete."""

    def absolute(self) -> "RunSettings":
        """The same with absolute paths, and without an output folder."""
        return with_absolute_paths(replace(self, output=None))

    def deciding(self) -> "RunSettings":
        """Only the settings that affect poses and map; all others have their defaults.

        Two runs on the same kind of device that differ elsewhere compute the same.
        """
        own = self.absolute()
        return RunSettings(own.source, replace(own.config, mesh=MeshConfig()), map=own.map)


@dataclass(frozen=True)
class ReconstructSettings(Settings):
    """Settings of a reconstruction from known poses."""

    source: Annotated[Path, Positional(unless=("print-config",))] = Path()
    """Folder of images with poses, or the file with the poses; with --sfm a folder of
    photographs."""
    config: Annotated[ReconstructConfig, Unnamed] = field(default_factory=ReconstructConfig)
    """How to compute."""
    output: Annotated[Path | None, Basic("-o")] = None
    """Folder for the results; without it out/NAME, or out/NAME-2 where that is taken."""
    budget: Annotated[float | None, Range(above=0), Time] = None
    """About how long it may take in all, such as 90s, 10m or 1h; none trains until it is good."""
    sfm: Annotated[bool, Formerly({"--poses auto": "--sfm", "--poses given": "--no-sfm"})] = False
    """Structure from motion of photographs without poses: pycolmap estimates them."""
    check_poses: Annotated[bool, RARE] = True
    """Whether to see by matching images that the poses follow the expected convention."""
    hold_out: Annotated[int | None, Range(2), RARE] = None
    """Leave out every so many-th image, to judge the result by; none uses all."""
    snapshots: Annotated[tuple[Positive, ...], Time, RARE] = ()
    """Also keep the map as it stands after some seconds, such as 5,10,20, in snapshots/; they count
    from when the images have been read."""
    depth_mesh: Annotated[bool, RARE] = False
    """Also fuse the searched depths without the disks, to depth_fusion/mesh.ply."""
    keyframe_images: Annotated[bool, RARE] = True
    """Keep the images as they were used in keyframes/, which geogs mesh and geogs export use."""
    resume: Path | None = None
    """Go on with the reconstruction that stopped in this folder: give its source and settings."""
    checkpoint_every: Annotated[Weight, RARE] = 30.0
    """Seconds of training between two checkpoints (there is one after the depths, too); 0 makes
    none."""
    device: str = "auto"
    """Where to compute: auto (a GPU where there is one), cpu, cuda or cuda:1; see geogs doctor."""
    overwrite: bool = False
    """Replace the result that is in the folder; it stays until the new one is complete."""


@dataclass(frozen=True)
class LiveSettings(Settings):
    """Settings of a viewer of a run."""

    viewer: bool = False
    """Show the run in the browser while it goes on; needs pip install 'geogs[viewer]'."""
    viewer_port: Annotated[Port, RARE] = 8080
    """Where that page is served, to this machine alone; if it is taken, the next that is free."""
    record: Annotated[Path | None, RARE] = None
    """Also record the run in this file, .rrd, for the rerun viewer; needs pip install
    'geogs[record]'."""


@dataclass(frozen=True)
class Verbosity(Settings):
    """Verbosity on the terminal, and the log file."""

    verbose: Annotated[bool, Basic("-v")] = False
    """Say more, such as how long each phase took."""
    quiet: Annotated[bool, Basic("-q")] = False
    """Say nothing but warnings and errors."""
    log: Annotated[Path | None, RARE] = None
    """File to which everything is also written, with the time of day; added to if it exists."""
