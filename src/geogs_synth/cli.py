"""``geogs synth``: a synthetic room sequence with exact ground truth."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, cast

from geogs.cli.options import Given, parse_options
from geogs.config import Seed
from geogs.config.setting import Positional, Range, Settings
from geogs_synth.camera.flaws import CameraKind, Flaws, camera_flaws
from geogs_synth.motion.motion_kinds import MotionKind
from geogs_synth.scene.lamp_kinds import LampKind


@dataclass(frozen=True)
class SynthOptions(Settings):
    """Renders a scene, drawn at random, as a moving camera sees it, with exact truth.

    A furnished room and a perfect camera, if nothing else is said; ``--motion driving`` goes
    through a street, ``--motion dining`` around a table among thin things. Flaws of the camera:
    those of ``--camera``, and single ones beside it, ``--flaws.readout 0.03``.
    """

    output: Annotated[Path, Positional()]
    """Folder to write, in the layout of Replica."""
    frames: Annotated[int, Range(1, 100_000)] = 120
    """Number of frames; after 280 the camera is back at its start."""
    width: Annotated[int, Range(16, 8192)] | None = None
    """Pixels; none is 320, on the street 1241."""
    height: Annotated[int, Range(16, 8192)] | None = None
    """Pixels; none is 240, on the street 376."""
    seed: Seed = 0
    """Another seed gives another room and another path."""
    motion: MotionKind = "handheld"
    """How the camera is moved."""
    camera: CameraKind = "clean"
    """A camera with typical flaws, or none."""
    flaws: Flaws = field(default_factory=Flaws)
    """Single flaws, over those of the camera."""
    moving: Annotated[float, Range(0, 0.5)] = 0.0
    """Fraction of the image that people cover who cross the view; 0 lets nothing move."""
    lamps: LampKind = "steady"
    """Switched: each third of the sequence shows the room in another light."""
    depth: bool = True
    """Write depth images too."""
    depth_sensor: bool = False
    """Write depth as a sensor measures it: with noise that grows with its square, holes, and
    nothing beyond 5 m; else it is exact."""
    image_format: Literal["jpg", "png"] = "jpg"
    """JPEG of quality 95, or lossless."""
    video: bool = False
    """Write video.mp4 too."""


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    options = parse_options(SynthOptions, argv, "synth", _defaults)

    from rich.console import Console
    from rich.progress import Progress

    from geogs_synth.camera.depth_sensor import DepthSensor
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
