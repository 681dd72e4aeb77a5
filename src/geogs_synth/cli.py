"""``geogs synth``: a synthetic room sequence with exact ground truth."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, cast

from geogs.cli.options import Given, parse_options
from geogs.config import Seed
from geogs.config.setting import Positional, Range, Settings
from geogs_synth.camera.flaws import CameraKind, Flaws, camera_flaws
from geogs_synth.motion.motion_kinds import LampKind, MotionKind


@dataclass(frozen=True)
class SynthOptions(Settings):
    """Renders a random scene from a moving camera, and writes the exact truth with it.

    By default a perfect camera moves through a furnished room; ``--motion driving`` shows a street,
    ``--motion dining`` a table among thin things. ``--camera`` gives the camera typical flaws;
    options such as ``--flaws.readout 0.03`` set single ones.
    """

    output: Annotated[Path, Positional()]
    """Folder to write, in the layout of Replica."""
    frames: Annotated[int, Range(1, 100_000)] = 120
    """Number of frames; the hand-held camera is back at its start after 280."""
    width: Annotated[int, Range(16, 8192)] | None = None
    """Width of the images, pixels; none takes 320, on the street 1241."""
    height: Annotated[int, Range(16, 8192)] | None = None
    """Height of the images, pixels; none takes 240, on the street 376."""
    seed: Seed = 0
    """Seed of the scene, the path and the noise."""
    motion: MotionKind = "handheld"
    """Motion of the camera, and the place that it moves through."""
    camera: CameraKind = "clean"
    """Kind of camera; all but ``clean`` have typical flaws."""
    flaws: Flaws = field(default_factory=Flaws)
    """Single flaws, which replace those of the camera."""
    moving: Annotated[float, Range(0, 0.5)] = 0.0
    """Fraction of the image that moving people (on the street vehicles) cover; 0 has none."""
    lamps: LampKind = "steady"
    """Behaviour of the lamps: ``switched`` lights each third of the sequence in another way."""
    depth: bool = True
    """Whether depth images are written."""
    depth_sensor: bool = False
    """Whether depth has the noise, the holes and the range (5 m) of a depth sensor; otherwise it is
    exact."""
    image_format: Literal["jpg", "png"] = "jpg"
    """Format of the images: JPEG of quality 95, or PNG without loss."""
    video: bool = False
    """Whether video.mp4 is written as well."""


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    options = parse_options(SynthOptions, argv, "synth", _defaults)

    from rich.console import Console
    from rich.progress import Progress

    from geogs_synth.camera.sensors import DepthSensor
    from geogs_synth.sequence.replica_files import write_sequence

    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("rendering", total=options.frames)
        write_sequence(
            options.output,
            options.frames,
            options.width,
            options.height,
            options.seed,
            motion=options.motion,
            flaws=options.flaws,
            moving=options.moving,
            lamps=options.lamps,
            depth=options.depth,
            depth_sensor=DepthSensor() if options.depth_sensor else None,
            image_format=options.image_format,
            video=options.video,
            on_frame=lambda index: progress.update(task, completed=index + 1),
        )
    return 0


def _defaults(given: Given) -> SynthOptions:
    """Default options: the flaws of the given camera."""
    camera = cast(CameraKind, given.get("camera", "clean"))
    return SynthOptions(Path(), camera=camera, flaws=camera_flaws(camera))
