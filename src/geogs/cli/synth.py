"""``geogs synth``: a synthetic room sequence with exact ground truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from geogs.cli.options import parse_options


@dataclass(frozen=True)
class SynthOptions:
    """Renders a furnished room, drawn at random, along a hand-held camera path."""

    output: Positional[Path]
    """Folder to write, in the layout of Replica."""
    frames: int = 120
    """Number of frames, at least 1; after 280 the camera is back at its start."""
    width: int = 320
    """Pixels."""
    height: int = 240
    """Pixels."""
    seed: int = 0
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
