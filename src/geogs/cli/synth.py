"""``geogs synth``: a synthetic room sequence with exact ground truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from geogs.cli.options import parse_options
from geogs.config import Seed
from geogs.config.setting import Positional, Range, Settings


@dataclass(frozen=True)
class SynthOptions(Settings):
    """Renders a furnished room, drawn at random, along a hand-held camera path."""

    output: Annotated[Path, Positional()]
    """Folder to write, in the layout of Replica."""
    frames: Annotated[int, Range(1, 100_000)] = 120
    """Number of frames; after 280 the camera is back at its start."""
    width: Annotated[int, Range(16, 8192)] = 320
    """Pixels."""
    height: Annotated[int, Range(16, 8192)] = 240
    """Pixels."""
    seed: Seed = 0
    """Another seed gives another room and another path."""
    depth: bool = True
    """Write depth images too."""
    image_format: Literal["jpg", "png"] = "jpg"
    """JPEG of quality 95, or lossless."""
    video: bool = False
    """Write video.mp4 too."""


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    options = parse_options(SynthOptions, argv, "synth")

    from rich.console import Console
    from rich.progress import Progress

    from geogs.synth.export import write_sequence

    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("rendering", total=options.frames)
        write_sequence(
            options.output,
            options.frames,
            options.width,
            options.height,
            options.seed,
            depth=options.depth,
            image_format=options.image_format,
            video=options.video,
            on_frame=lambda index: progress.update(task, completed=index + 1),
        )
    return 0
