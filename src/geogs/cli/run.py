"""``geogs run SOURCE``: a video in; trajectory, mesh and disk map out."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, get_args

import tyro

from geogs.application.settings import RunSettings
from geogs.cli.options import SHORT, given, parse_options, record
from geogs.config import Config, Preset, preset
from geogs.errors import InputError

_SHORT = {
    **SHORT,
    "--intrinsics": "--input.intrinsics",
    "--global-ba-every": "--loop.global-ba-every",
}


@dataclass(frozen=True)
class RunOptions(RunSettings):
    """Reconstruct a video, a folder of images, or a Replica, TUM RGB-D or 7-Scenes sequence.

    Every default works: ``geogs run video.mp4``. Intrinsics: ``--intrinsics fx,fy,cx,cy``.
    Several videos of one place: ``geogs run a.mp4 b.mp4``.
    """

    source: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    config: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    preset: Preset = "default"
    """Group of settings; single ones given beside it win."""
    resume: Path | None = None
    """Go on with the run that was interrupted or killed in this folder, with its source and its
    settings; beside it may be given what decides nothing about poses and map: --device, --mesh,
    --checkpoint-every, --online-results and --depth-mesh."""


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    options = parse(argv)

    from geogs.application.interrupt import Interruption
    from geogs.application.run import resume, run
    from geogs.application.terminal import TerminalProgress

    go = run if options.resume is None else partial(resume, options.resume)
    with TerminalProgress() as progress:
        written = go(record(RunSettings, options), progress, Interruption())
    if written.can_resume:
        print(f"geogs run --resume {written.output} goes on from here.")
    print(f"Results are in {written.output}/")
    return 0


def parse(argv: Sequence[str]) -> RunOptions:
    """Options over those of a preset, or over those of the run that is gone on with.

    Raises:
        SystemExit: after ``--help``, or after an option that is wrong or missing.
        InputError: there is nothing to resume, or a preset is asked for beside it.
    """
    folder = given(argv, "resume")
    default = _saved(Path(folder), argv) if folder else _of_preset(argv)
    return parse_options(RunOptions, argv, "run", default=default, short=_SHORT)


def _of_preset(argv: Sequence[str]) -> RunOptions:
    """The preset asked for; a wrong one is left for the option parser to complain about."""
    asked = given(argv, "preset")
    name: Preset = next((p for p in get_args(Preset) if p == asked), "default")
    return RunOptions(source=tyro.MISSING, config=preset(name), preset=name)


def _saved(folder: Path, argv: Sequence[str]) -> RunOptions:
    """What the run in a folder was begun with."""
    from geogs.application.run_checkpoint import SavedRun

    if given(argv, "preset") is not None:
        raise InputError(f"--resume {folder} goes on with the run's settings; leave out --preset.")
    return RunOptions(**vars(SavedRun(folder).facts.settings), resume=folder)
