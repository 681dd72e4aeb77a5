"""``geogs demo``: make a small room, reconstruct it as any other video, show the errors."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from geogs.cli.command import find_command
from geogs.cli.options import parse_options
from geogs.config import Seed
from geogs.config.setting import Basic, Range, Settings


@dataclass(frozen=True)
class DemoOptions(Settings):
    """Make a small synthetic room sequence, run everything on it, print the error table."""

    output: Annotated[Path, Basic("-o")] = Path("out/demo")
    """Folder for the sequence (room/) and the result (result/)."""
    frames: Annotated[int, Range(20, 100_000)] = 120
    """Frames of the sequence."""
    width: Annotated[int, Range(64, 8192)] = 320
    """Pixels."""
    height: Annotated[int, Range(48, 8192)] = 240
    """Pixels."""
    seed: Seed = 0
    """Another seed makes another room."""


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    return demo(parse_options(DemoOptions, argv, "demo"))


def demo(options: DemoOptions) -> int:
    """The three commands one after the other."""
    room, result = str(options.output / "room"), str(options.output / "result")
    steps = [
        ["synth", room, "--frames", str(options.frames), "--width", str(options.width),
         "--height", str(options.height), "--seed", str(options.seed)],
        ["run", room, "-o", result],
        ["eval", result, "--gt", room],
    ]  # fmt: skip
    for name, *arguments in steps:
        print(f"$ geogs {name} {' '.join(arguments)}", flush=True)
        code = find_command(name).run(arguments)
        if code:
            return code
    print(f"Open {result}/report/index.html in a browser.")
    return 0
