"""``geogs reconstruct SOURCE``: images with known poses, or photographs, in; mesh and map out."""

import itertools
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

from geogs.application.run_settings import ReconstructSettings, Verbosity
from geogs.cli.answer import Answer
from geogs.cli.config_options import ConfigOptions, printed, with_settings_file
from geogs.cli.options import Given, parse_options, record
from geogs.cli.terminal.speech import dry_answer, followed, say_loading
from geogs.config import Preset, reconstruct_preset
from geogs.errors import InputError
from geogs.gpu.early_start import is_gpu, start_gpu

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ReconstructOptions(Verbosity, ConfigOptions, ReconstructSettings):
    """Reconstruct images whose poses are known: a COLMAP model, nerfstudio, DTU, Replica, TUM...

    Lengths of the result are in the unit of the poses. Every default works. Photographs without
    poses: ``geogs reconstruct PHOTOS --sfm``.
    """

    preset: Preset = "default"
    """Group of settings: those of --config and single ones win. Without it, accurate on a GPU and
    default on a CPU."""
    dry_run: bool = False
    """Only say what the input holds and would be done; not with --sfm."""


def main(argv: Sequence[str]) -> Answer | int:
    """Run the command; returns its answer."""
    begin = time.perf_counter()
    options = parse(argv)
    if options.print_config:
        return printed(options.config)
    if options.dry_run:
        from geogs.application.plan import POSED_STAGES, plan_for
        from geogs.application.results.output_folder import chosen_folder
        from geogs.io.sources.posed.pose_check import with_focal_length
        from geogs.io.sources.reader import without_ending
        from geogs.io.sources.sniff import open_posed_source

        source = open_posed_source(options.source, options.config.input, options.hold_out)
        source = with_focal_length(source)
        name = without_ending(source.name, [options.source])
        output = chosen_folder(
            options.output, name, options.overwrite, fingerprint=source.fingerprint
        )
        device = "cuda" if is_gpu(options.device) else "cpu"
        plan = plan_for(POSED_STAGES, output, len(source), source.camera, device)
        return dry_answer(source, plan)
    say_loading(options)
    start_gpu(options.device)
    settings = record(ReconstructSettings, options)

    from geogs.application.interrupt import Interruption
    from geogs.application.reconstruct import left_of, reconstruct_to_folder

    # The budget counts from the start of the command.
    settings = replace(settings, budget=left_of(settings.budget, begin))
    stop = Interruption()
    return followed(
        options,
        lambda progress: reconstruct_to_folder(settings, progress, stop),
        stop,
        "The same command with --resume {folder} continues from here.",
    )


def parse(argv: Sequence[str]) -> ReconstructOptions:
    """Parse options; the preset gives the defaults, and single settings override it.

    Raises:
        SystemExit: after ``--help``.
        InputError: an option is wrong or missing.
    """
    return parse_options(ReconstructOptions, _with_folder(argv), "reconstruct", _defaults)


def _with_folder(argv: Sequence[str]) -> list[str]:
    """The arguments with the folder of ``-o`` after a ``--resume`` without one, as in the last
    version. Raises InputError where there is none."""
    words = list(argv)
    followed_by = itertools.zip_longest(words, words[1:], fillvalue="-")
    bare = [
        n for n, (word, after) in enumerate(followed_by) if word == "--resume" and after[:1] == "-"
    ]
    if not bare:
        return words
    folders = [after for word, after in itertools.pairwise(words) if word in ("-o", "--output")]
    if not folders:
        raise InputError("--resume needs the folder of the reconstruction that stopped.")
    _log.warning("--resume is now --resume %s; a bare one goes in the next version.", folders[-1])
    words.insert(bare[0] + 1, folders[-1])
    return words


def _defaults(given: Given) -> ReconstructOptions:
    """The given preset, else the one for the device."""
    asked = given.get("preset")
    if asked is None:
        asked = "accurate" if is_gpu(given.get("device", "auto")) else "default"
    name = cast(Preset, asked)
    config = with_settings_file(reconstruct_preset(name), given)
    return ReconstructOptions(config=config, preset=name)
