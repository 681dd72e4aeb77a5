"""``geogs run SOURCE``: a video in; trajectory, mesh and disk map out."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import cast

from geogs.application.settings import RunSettings
from geogs.cli.options import Given, parse_options, record
from geogs.config import Preset, preset
from geogs.errors import InputError


@dataclass(frozen=True)
class RunOptions(RunSettings):
    """Reconstruct a video, a folder of images, or a Replica, TUM RGB-D or 7-Scenes sequence.

    Every default works: ``geogs run video.mp4``. Intrinsics: ``--intrinsics fx,fy,cx,cy``.
    Several videos of one place: ``geogs run a.mp4 b.mp4``.
    """

    preset: Preset = "default"
    """Group of settings; single ones given beside it win."""
    resume: Path | None = None
    """Go on with the run that was interrupted or killed in this folder, with its source and its
    settings; beside it may be given what decides nothing about poses and map: --device, --mesh,
    --checkpoint-every, --online-results, --depth-mesh and --keyframe-images."""


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    options = parse(argv)

    from geogs.application.interrupt import Interruption
    from geogs.application.offline import run_offline
    from geogs.application.run import resume, run
    from geogs.application.terminal import TerminalProgress

    begin = run_offline if options.offline else run
    go = begin if options.resume is None else partial(resume, options.resume)
    with TerminalProgress() as progress:
        written = go(record(RunSettings, options), progress, Interruption())
    if written.can_resume:
        print(f"geogs run --resume {written.output} goes on from here.")
    print(f"Results are in {written.output}/")
    return 0


def parse(argv: Sequence[str]) -> RunOptions:
    """Options over those of a preset, or over those of the run that is gone on with.

    Raises:
        SystemExit: after ``--help``.
        InputError: an option is wrong or missing; there is nothing to resume, or a preset is asked
            for beside it.
    """
    return parse_options(RunOptions, argv, "run", _defaults)


def _defaults(given: Given) -> RunOptions:
    """The preset asked for, or what the run that is gone on with was begun with."""
    if "resume" not in given:
        name = cast(Preset, given.get("preset", "default"))
        return RunOptions(config=preset(name), preset=name)

    from geogs.application.run_checkpoint import SavedRun

    folder = Path(given["resume"])
    if "preset" in given:
        raise InputError("--resume goes on with the run's settings; leave out --preset.")
    return RunOptions(**vars(SavedRun(folder).facts.settings), resume=folder)
