"""``geogs demo``: make a small room, reconstruct it like any video, show the errors."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from geogs.cli import run
from geogs.cli.answer import Answer, shown
from geogs.cli.command import find_command
from geogs.cli.options import parse_options
from geogs.config import Seed
from geogs.config.setting import Basic, Range, Settings
from geogs.guard.terminal_text import printable, say


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


def main(argv: Sequence[str]) -> Answer | int:
    """Run the command; returns its answer."""
    return demo(parse_options(DemoOptions, argv, "demo"))


def demo(options: DemoOptions) -> Answer | int:
    """Run the three commands in turn; the second one's kernels are compiled during the first."""
    from geogs.application.machine.compilation import compiling
    from geogs.gpu.installation import require_device

    room = str(options.output / "room")
    result = str(options.output / "result")
    sizes = list[str]()
    for name in ("frames", "width", "height", "seed"):
        sizes += [f"--{name}", str(getattr(options, name))]
    run_words = [room, "-o", result, "--overwrite", "--no-strict"]
    with compiling(require_device("auto")) as kernels:
        steps: dict[str, tuple[Callable[[Sequence[str]], Answer | int], list[str]]] = {
            "synth": (find_command("synth").run, [room, *sizes]),
            "run": (partial(run.main, kernels=kernels), run_words),
            "eval": (find_command("eval").run, [result, "--gt", room]),
        }
        for name, (command, arguments) in steps.items():
            say(f"$ geogs {name} {' '.join(arguments)}")
            code = shown(command(arguments))
            if code:
                return code
    page = options.output / "result" / "report" / "index.html"
    words = f"Open {printable(page)} in a browser."
    return Answer(words, {"folder": options.output, "page": page})
