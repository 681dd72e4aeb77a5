"""``geogs reconstruct SOURCE``: images with known poses in; mesh and disk map out."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, get_args

import tyro

from geogs.application.settings import ReconstructSettings
from geogs.cli.durations import Duration, Durations
from geogs.cli.options import SHORT, given, parse_options, record
from geogs.config import Preset, ReconstructConfig, reconstruct_preset


@dataclass(frozen=True)
class ReconstructOptions(ReconstructSettings):
    """Reconstruct images whose poses are known: a COLMAP model, nerfstudio, DTU, Replica, TUM...

    Lengths of the result are in the unit of the poses. Every default works.
    """

    source: Annotated[Path, tyro.conf.Positional] = Path()
    config: Annotated[ReconstructConfig, tyro.conf.arg(name="")] = field(
        default_factory=ReconstructConfig
    )
    budget: Duration = None
    snapshots: Durations = ()
    preset: Preset = "default"
    """Group of settings; single ones given beside it win. Without it, accurate on a GPU and default
    on a CPU."""


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    begin = time.perf_counter()
    settings = record(ReconstructSettings, parse(argv))

    from geogs.application.interrupt import Interruption
    from geogs.application.reconstruct import reconstruct_to_folder
    from geogs.application.terminal import TerminalProgress

    if settings.budget is not None:  # which counts from the start of the command
        settings = replace(settings, budget=settings.budget - (time.perf_counter() - begin))
    with TerminalProgress() as progress:
        written = reconstruct_to_folder(settings, progress, Interruption())
    print(f"Results are in {written.output}/")
    return 0


def parse(argv: Sequence[str]) -> ReconstructOptions:
    """Options with the preset as defaults, over which single settings win.

    Raises:
        SystemExit: after ``--help``, or after an option that is wrong or missing.
        InputError: a time is none.
    """
    name = _preset_name(argv)
    default = ReconstructOptions(source=tyro.MISSING, config=reconstruct_preset(name), preset=name)
    return parse_options(ReconstructOptions, argv, "reconstruct", default=default, short=SHORT)


def _preset_name(argv: Sequence[str]) -> Preset:
    """The preset asked for, else the one that suits the device.

    A wrong one is left for the option parser to complain about.
    """
    asked = given(argv, "preset")
    if asked is not None or "--help" in argv or "-h" in argv:
        return next((name for name in get_args(Preset) if name == asked), "default")
    device = given(argv, "device") or "auto"
    if device == "auto":
        from geogs.gpu.installation import gpu_problem

        device = "cpu" if gpu_problem() else "cuda"
    return "accurate" if device.startswith("cuda") else "default"
